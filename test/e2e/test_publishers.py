"""Publishers in separate processes, a node and a store: everything sent after the match is stored once.

Publishers of every kind in the test's own process are in test/node/intake/test_intake.py.
"""

from __future__ import annotations

import signal
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import pytest
from e2e.processes import Node, Processes
from e2e.reading import STRING, Objects, texts
from shadowhound_tower.embedded import Tower

WARM_UP = texts(['warm-up'])[0]
TOPICS = ['killed', 'mixed']
COUNT = 300


@dataclass(frozen=True, slots=True)
class Listening:
    """A node that subscribes, and the contents of its store."""

    processes: Processes
    node: Node
    stored: Callable[..., Objects]

    def numbers(self, sensor: str, least: int) -> list[int]:
        """The numbers in the store once this many messages of the sensor are there; none of the topic were missed."""
        row = self.node.settled(f'/{sensor}', least)
        objects = self.stored(f'{self.processes.robot}/{sensor}')
        assert len(objects.samples(sensor)) == row['stored'] == row['received']
        assert (row['rejected'], row['dropped']) == ({}, {})
        assert (row['accounting'] == 'exact') is self.node.hears_numbers
        assert (row['missed'], row['published']) == (self.node.known(0), self.node.known(row['received']))
        return objects.numbers(sensor)


@pytest.fixture(scope='module')
def listening(shared: Processes, seaweed: Tower, stored: Callable[..., Objects]) -> Listening:
    parameters: dict[str, object] = {'sensors': TOPICS}
    for name in TOPICS:
        parameters |= {f'{name}.topics': [name], f'{name}.rate_hz': 0.0, f'{name}.batch_s': 0.2}
    return Listening(shared, shared.node(seaweed.environment(), parameters), stored)


@pytest.mark.long('kills')
def test_a_publisher_is_counted_across_a_kill_and_restart(listening: Listening) -> None:
    """The messages before and after the restart are stored once."""
    for life in range(2):
        publisher = listening.processes.publisher()
        publisher.create('/killed', STRING)
        publisher.heard('/killed', listening.node, WARM_UP)
        publisher.publish('/killed', texts(range(life * COUNT, (life + 1) * COUNT)))
        listening.node.received('/killed', (life + 1) * (COUNT + 1))
        publisher.kill()
    assert listening.numbers('killed', 2 * COUNT + 2) == list(range(2 * COUNT))


def test_two_publishers_on_a_topic_are_stored_once(listening: Listening) -> None:
    """The messages of both are stored once, one BEST_EFFORT and the other RELIABLE."""
    both = [listening.processes.publisher() for _ in range(2)]
    for publisher, reliable in zip(both, (False, True), strict=True):
        publisher.create('/mixed', STRING, reliable=reliable)
        publisher.heard('/mixed', listening.node, WARM_UP)
    with ThreadPoolExecutor(2) as pool:
        halves = [texts(range(COUNT)), texts(range(COUNT, 2 * COUNT))]
        list(pool.map(lambda pair: pair[0].publish('/mixed', pair[1]), zip(both, halves, strict=True)))
    assert listening.numbers('mixed', 2 * COUNT + 2) == list(range(2 * COUNT))


def test_a_node_stays_off_the_port_of_a_killed_one(processes: Processes, seaweed: Tower) -> None:
    """A process still writing there may never notice a new reader; at its own port the node receives what is published."""
    parameters = {'sensors': ['killed'], 'killed.topics': ['killed'], 'killed.rate_hz': 0.0}
    node = processes.node(seaweed.environment(), parameters)
    publisher = processes.publisher()
    publisher.create('/killed', STRING)
    publisher.heard('/killed', node, WARM_UP)
    node.kill()
    publisher.signal(signal.SIGSTOP)  # so that it does not notice first
    again = processes.node(seaweed.environment(), parameters)
    again.await_log('that killed processes left are not reused')
    publisher.signal(signal.SIGCONT)
    publisher.heard('/killed', again, WARM_UP)
