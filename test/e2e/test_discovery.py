"""Two machines in one network, made of namespaces: we discover what the robot's Cyclone DDS discovers, in each setting."""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from e2e.finding import TOPICS
from e2e.machines import OTHER, ROBOT, Machines
from e2e.processes import WAIT_S

pytestmark = pytest.mark.skipif(find_spec('cyclonedds') is None, reason='cyclonedds is not installed')  # imported by children

MORE_S = 2.0
"""Enough time to discover a publisher that must not be discovered."""
BOTH, ONE, NONE = ['/here', '/there'], ['/here'], list[str]()


def uri(general: str = '', discovery: str = '') -> dict[str, str]:
    text = f'<CycloneDDS><Domain><General>{general}</General><Discovery>{discovery}</Discovery></Domain></CycloneDDS>'
    return {'CYCLONEDDS_URI': text}


def on(*names: str) -> dict[str, str]:
    return uri(f'<Interfaces>{"".join(f"<NetworkInterface {name}/>" for name in names)}</Interfaces>')


def peers(*addresses: str) -> dict[str, str]:
    listed = ''.join(f'<Peer address="{address}"/>' for address in addresses)
    return uri('<AllowMulticast>false</AllowMulticast>', f'<ParticipantIndex>auto</ParticipantIndex><Peers>{listed}</Peers>')


HUMBLE = {'AS_HUMBLE': 'yes'}
OWN = on('name="eth0"')
"""With two interfaces Cyclone DDS chooses one, which is not specified: so it is configured wherever that matters."""
CASES: dict[str, tuple[dict[str, str], dict[str, str], list[str]]] = {
    'default': (OWN, {}, BOTH),
    'humble': ({**HUMBLE, **OWN}, HUMBLE, BOTH),
    'localhost only': ({'ROS_LOCALHOST_ONLY': '1', **OWN}, {}, ONE),
    'localhost only, humble': ({**HUMBLE, 'ROS_LOCALHOST_ONLY': '1'}, HUMBLE, ONE),
    'localhost': ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', **OWN}, {}, ONE),
    'localhost, static peer': (
        {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_STATIC_PEERS': OTHER, **OWN},
        {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_STATIC_PEERS': ROBOT}, BOTH,
    ),
    'subnet': ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET', **OWN}, {}, BOTH),
    'subnet, static peer': ({'ROS_STATIC_PEERS': OTHER, **OWN}, {}, BOTH),
    'system default': ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SYSTEM_DEFAULT', **OWN}, {}, BOTH),
    'off': ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF', **OWN}, {}, NONE),
    'interface by address': (on(f'address="{ROBOT}"'), {}, BOTH),
    'the other interface': (on('name="wlan0"'), {}, ONE),
    'loopback': (on('name="lo"'), {}, ONE),
    'peers only': (peers(ROBOT, OTHER), peers(OTHER, ROBOT), BOTH),
    'peers on this machine': (peers(ROBOT), peers(OTHER), ONE),
}  # fmt: skip
"""Variables of the robot, of the other machine, and the topics that must be received."""
RANGES = ('ROS_AUTOMATIC_DISCOVERY_RANGE', 'ROS_STATIC_PEERS', 'ROS_LOCALHOST_ONLY')
if os.environ.get('ROS_DISTRO') == 'humble':  # whose librcl has no range, and its Cyclone DDS gets no peers of ROS
    CASES = {
        name: ({**HUMBLE, **robot}, {**HUMBLE, **other}, topics)
        for name, (robot, other, topics) in CASES.items()
        if 'AS_HUMBLE' in robot or robot.keys().isdisjoint(RANGES)
    }


def ready(process: subprocess.Popen[str]) -> subprocess.Popen[str]:
    assert process.stdout is not None
    assert process.stdout.readline() == 'ready\n'
    return process


def received_by(process: subprocess.Popen[str]) -> Any:
    """What it has received so far."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write('\n')
    process.stdin.flush()
    return json.loads(process.stdout.readline())


@pytest.fixture(scope='module')
def found(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, tuple[list[str], list[str]]]]:
    """By case: what a reader with the robot's Cyclone DDS received, and what we received. All cases together, one domain each."""
    domains = {name: {'ROS_DOMAIN_ID': str(number)} for number, name in enumerate(CASES, 1)}
    rmw = {'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp'}
    robot = [{**CASES[name][0], **domains[name], **rmw} for name in CASES]
    other = [{**CASES[name][1], **domains[name]} for name in CASES]
    humble = as_humble(tmp_path_factory.mktemp('humble'))
    with ExitStack() as stack:
        machines = Machines(stack)
        started = [
            machines.start('publish', '/here', json.dumps(robot)),
            machines.start('publish', '/there', json.dumps(other), other=True),
            reader := machines.start('listen', json.dumps(robot)),
        ]
        finders = [machines.start('find', json.dumps({**(humble if 'AS_HUMBLE' in case else {}), **case})) for case in robot]
        for process in (*started, *finders):
            ready(process)
        expected = [case[2] for case in CASES.values()]
        end, settled_s = time.monotonic() + WAIT_S, 0.0
        while time.monotonic() < end:
            by_cyclone, by_us = received_by(reader), [received_by(finder) for finder in finders]
            is_whole = all(set(names) <= set(ours) for names, ours in zip(expected, by_us, strict=True))
            settled_s = settled_s or (time.monotonic() if is_whole else 0.0)
            if settled_s and time.monotonic() > settled_s + MORE_S:
                break
            time.sleep(0.1)
        yield dict(zip(CASES, zip(by_cyclone, by_us, strict=True), strict=True))


def as_humble(folder: Path) -> Mapping[str, str]:
    """Variables with which rmw_fastrtps_cpp has the version of Humble, so that the range has no effect."""
    index = folder / 'share/ament_index/resource_index/rmw_typesupport'
    index.mkdir(parents=True)
    (index / 'rmw_fastrtps_cpp').touch()
    (folder / 'share/rmw_fastrtps_cpp').mkdir()
    (folder / 'share/rmw_fastrtps_cpp/package.xml').write_text('<package><version>6.2.7</version></package>')
    return {'AMENT_PREFIX_PATH': f'{folder}:{os.environ["AMENT_PREFIX_PATH"]}'}


@pytest.mark.long('machines of their own, one after the other')
@pytest.mark.parametrize('case', CASES)
def test_publishers_that_cyclone_dds_finds_are_found(found: dict[str, tuple[list[str], list[str]]], case: str) -> None:
    """Nothing that the robot's own RMW receives is lost, and no other publisher is received."""
    by_cyclone, by_us = found[case]
    assert set(by_cyclone) <= set(by_us), 'the robot receives a topic that we do not'
    assert by_us == CASES[case][2]
    assert set(by_cyclone) <= set(TOPICS)
