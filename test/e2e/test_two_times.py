"""A real node, real DDS: stored data and reports of publishers with stamps that differ from the arrivals."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from e2e.processes import Node, Processes, Publisher, until
from e2e.reading import Objects
from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.spool.status import read

TYPE = 'nav_msgs/msg/Odometry'
HZ, SECONDS = 20, 8
SECOND = 10**9
SKEWS = {'late': [146.0], 'apart': [0.0, 300.0], 'ahead': [-3600.0], 'fine': [0.0], 'stuck': [0.0]}
"""Sensor -> the delay of the stamps of each of its publishers in seconds."""


def odometry(sensor: str, skew_s: float) -> Iterator[bytes]:
    """Messages for ``publish`` from now on. A stuck stamp does not advance after the first second."""
    began_ns = time.time_ns()
    for number in range(HZ * SECONDS):
        message = Odometry()
        at = min(number, HZ) if sensor == 'stuck' else number
        stamp_ns = began_ns + at * SECOND // HZ - round(skew_s * SECOND)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, SECOND)
        yield bytes(serialize_message(message))


@pytest.fixture(scope='module')
def node(shared: Processes, seaweed: Tower) -> Node:
    parameters: dict[str, object] = {'sensors': list(SKEWS)}
    for name in SKEWS:
        parameters |= {f'{name}.topics': [name], f'{name}.types': [TYPE], f'{name}.rate_hz': 1.0 if name == 'apart' else 0.0}
        parameters |= {f'{name}.batch_s': 0.0 if name == 'apart' else 1.0}
    found = shared.node(seaweed.environment(), parameters)
    publishers: list[tuple[Publisher, str, float]] = []
    for name, skews in SKEWS.items():
        for skew_s in skews:
            publisher = shared.publisher()
            publisher.create(f'/{name}', TYPE)
            publishers.append((publisher, name, skew_s))
    for publisher, name, _ in publishers:
        publisher.matched(f'/{name}')
    with ThreadPoolExecutor(len(publishers)) as pool:
        list(pool.map(lambda each: each[0].publish(f'/{each[1]}', list(odometry(each[1], each[2])), 1 / HZ), publishers))
    return found


@pytest.fixture(scope='module')
def objects(node: Node, shared: Processes, stored: Callable[..., Objects]) -> Objects:
    for name, skews in SKEWS.items():
        row = node.settled(f'/{name}', HZ * SECONDS * len(skews))
        assert (row['rejected'], row['dropped'], row['missed']) == ({}, {}, node.known(0))
    found = stored(shared.robot)
    assert {name for name in SKEWS if found.sensor(name)} == set(SKEWS)
    return found


@pytest.mark.long('publishers with clocks of their own')
def test_both_times_of_each_object_are_stored(objects: Objects) -> None:
    """Keys and ``t_start_ns`` have the stamps, however wrong; the arrivals are stored next to them."""
    for name, skew_s in (('late', 146.0), ('ahead', -3600.0), ('fine', 0.0)):
        for key in objects.sensor(name):
            report = objects.infos[key].metadata
            for begin in ('start', 'end'):
                off_s = (int(report[f'received_{begin}_ns']) - int(report[f't_{begin}_ns'])) / SECOND
                assert abs(off_s - skew_s) < 2.0, key
            assert 'by_arrival' not in report


@pytest.mark.long('publishers with clocks of their own')
def test_publishers_on_different_clocks_are_sampled_separately(objects: Objects) -> None:
    """One message per second from each: neither all of them, nor those of one clock alone."""
    times = [int(objects.infos[key].metadata['t_start_ns']) / SECOND for key in objects.sensor('apart')]
    newest = max(times)
    by_clock = [sum(newest - at < 150 for at in times), sum(newest - at >= 150 for at in times)]
    assert all(SECONDS - 1 <= count <= SECONDS + 2 for count in by_clock), by_clock


@pytest.mark.long('publishers with clocks of their own')
def test_wrong_stamps_do_not_split_batches(objects: Objects) -> None:
    """A constant offset, and a stamp that is stuck, do not split a topic into single messages."""
    for name in ('late', 'ahead', 'fine', 'stuck'):
        assert SECONDS - 1 <= len(objects.sensor(name)) <= SECONDS + 3, name
    by_arrival = sum(int(objects.infos[key].metadata.get('by_arrival', 0)) for key in objects.sensor('stuck'))
    assert HZ * (SECONDS - 4) <= by_arrival <= HZ * (SECONDS - 1)


@pytest.mark.long('publishers with clocks of their own')
def test_wrong_clocks_are_reported(node: Node, objects: Objects) -> None:
    """With the offset and the likely cause; a topic without a problem is not mentioned."""
    assert objects.contents

    def findings() -> str:
        return '\n'.join(read(node.home / 'spool', node.robot, SystemClock.of_this_machine()).findings)

    until(lambda: '/late: stamps' in findings(), findings)
    found = findings()
    assert '/late: stamps are 146.' in found
    assert '/ahead: stamps are 3,' in found
    assert 'newer than their arrival' in found
    assert '/apart: stamps are ' in found
    assert '/stuck: stamps do not advance' in found
    assert '/fine' not in found
    rows = json.loads((node.home / 'spool' / f'status-{node.robot}.json').read_text(encoding='utf-8'))['topics']
    assert rows['/fine']['stamps'] is None
    assert rows['/late']['stamps']['cause'] == 'late'
