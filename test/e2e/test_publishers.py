"""Publishers of every kind, early and late, alone and together: all they send after the match is stored, and once."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import pytest
from e2e.processes import Node, Processes, Publisher
from e2e.reading import STRING, Objects, cdr, texts

from shadowhound_data_logger.sim.tower import Tower

INT = 'std_msgs/msg/Int32'
WARM_UP = texts(['warm-up'])[0]
QUALITIES = {
    'best_effort': {'reliable': False, 'latched': False},
    'reliable': {'reliable': True, 'latched': False},
    'transient_local': {'reliable': True, 'latched': True},
}
EARLY = [f'early_{name}' for name in QUALITIES]
LATE = [f'late_{name}' for name in QUALITIES]
EXPECTED = ['expected_first', *(f'expected_{name}' for name in QUALITIES)]
OTHERS = ['ended', 'killed', 'two_best_effort', 'two_reliable', 'mixed', 'retyped', 'vanishing', 'both']
COUNT = 300
HISTORY = 20


@dataclass(frozen=True, slots=True)
class Listening:
    """A node that listens, a process with publishers that was there before it, and one that came after it."""

    processes: Processes
    node: Node
    early: Publisher
    late: Publisher
    stored: Callable[..., Objects]

    def numbers(self, sensor: str, least: int) -> list[int]:
        """The numbers in the store once so many messages of the sensor are there; nothing of the topic was missed."""
        row = self.node.settled(f'/{sensor}', least)
        objects = self.stored(f'{self.processes.robot}/{sensor}')
        assert len(objects.samples(sensor)) == row['stored'] == row['received']
        assert (row['rejected'], row['dropped']) == ({}, {})
        assert (row['accounting'] == 'exact') is self.node.hears_numbers
        assert (row['missed'], row['published']) == (self.node.known(0), self.node.known(row['received']))
        return objects.numbers(sensor)


def sensors(names: list[str]) -> dict[str, Any]:
    """Parameters with which each topic of Strings is logged whole; some know their type before."""
    parameters: dict[str, Any] = {'sensors': names, 'spool.commit_s': 0.05}
    for name in names:
        parameters |= {f'{name}.topics': [name], f'{name}.rate_hz': 0.0, f'{name}.batch_s': 0.2}
        if name in EXPECTED:
            parameters |= {f'{name}.types': [STRING]}
    return parameters


@pytest.fixture(scope='module')
def listening(shared: Processes, seaweed: Tower, stored: Callable[..., Objects]) -> Listening:
    early = shared.publisher()
    for topic, (name, quality) in zip(EARLY, QUALITIES.items(), strict=True):
        early.create(f'/{topic}', STRING, **quality)
        if name == 'transient_local':
            early.publish(f'/{topic}', texts(range(HISTORY)))
    node = shared.node(seaweed.environment(), sensors([*EARLY, *LATE, *EXPECTED, *OTHERS]))
    return Listening(shared, node, early, shared.publisher(), stored)


@pytest.mark.parametrize('topic', [name for name in EARLY if name != 'early_transient_local'])
def test_a_publisher_that_starts_before_the_node(listening: Listening, topic: str) -> None:
    """Everything that it publishes after the match is stored, and once."""
    listening.early.heard(f'/{topic}', listening.node, WARM_UP)
    listening.early.publish(f'/{topic}', texts(range(COUNT)))
    assert listening.numbers(topic, COUNT + 1) == list(range(COUNT))


def test_what_a_transient_local_publisher_sent_before(listening: Listening) -> None:
    """The history of a TRANSIENT_LOCAL publisher is stored too, and what follows it once."""
    listening.node.received('/early_transient_local', HISTORY)
    listening.early.publish('/early_transient_local', texts(range(HISTORY, COUNT)))
    assert listening.numbers('early_transient_local', COUNT) == list(range(COUNT))


def test_a_history_beside_a_publisher_that_has_none(listening: Listening) -> None:
    """The history of the one that is TRANSIENT_LOCAL and the messages of the one that is not are stored, and once."""
    listening.late.create('/both', STRING)
    listening.late.heard('/both', listening.node, WARM_UP)
    listening.early.create('/both', STRING, latched=True)
    listening.early.publish('/both', texts(range(HISTORY)))
    for publisher, first in ((listening.early, HISTORY), (listening.late, COUNT)):
        publisher.publish('/both', texts(range(first, first + COUNT - HISTORY)))
    numbers = listening.numbers('both', 2 * (COUNT - HISTORY) + HISTORY + 1)
    assert numbers == [*range(COUNT), *range(COUNT, 2 * COUNT - HISTORY)]


@pytest.mark.parametrize('kind', ['late', 'expected'])
@pytest.mark.parametrize('name', QUALITIES)
def test_a_publisher_that_starts_after_the_node(listening: Listening, kind: str, name: str) -> None:
    """Everything is stored once, whether its type was known before or is taken from the graph."""
    topic, publisher = f'{kind}_{name}', listening.late
    publisher.create(f'/{topic}', STRING, **QUALITIES[name])
    publisher.heard(f'/{topic}', listening.node, WARM_UP)
    publisher.publish(f'/{topic}', texts(range(COUNT)))
    assert listening.numbers(topic, COUNT + 1) == list(range(COUNT))


def test_an_expected_topic_is_matched_from_its_first_message_on(listening: Listening) -> None:
    """A publisher of the expected type that waits for its match loses nothing, its first message included."""
    listening.late.create('/expected_first', STRING)
    listening.late.matched('/expected_first')
    listening.late.publish('/expected_first', texts(range(COUNT)))
    assert listening.numbers('expected_first', COUNT) == list(range(COUNT))


@pytest.mark.parametrize('topic', ['ended', 'killed'])
def test_a_publisher_that_restarts(listening: Listening, topic: str) -> None:
    """The messages of both of its lives are stored once, however the first one ended."""
    for life in range(2):
        publisher = listening.processes.publisher()
        publisher.create(f'/{topic}', STRING)
        publisher.heard(f'/{topic}', listening.node, WARM_UP)
        publisher.publish(f'/{topic}', texts(range(life * COUNT, (life + 1) * COUNT)))
        listening.node.received(f'/{topic}', (life + 1) * (COUNT + 1))
        publisher.kill() if topic == 'killed' else publisher.end()
    assert listening.numbers(topic, 2 * COUNT + 2) == list(range(2 * COUNT))


@pytest.mark.parametrize(
    ('topic', 'reliable'), [('two_best_effort', (False, False)), ('two_reliable', (True, True)), ('mixed', (False, True))]
)
def test_two_publishers_on_a_topic(listening: Listening, topic: str, reliable: tuple[bool, bool]) -> None:
    """The messages of both are stored once, also where one is BEST_EFFORT and the other RELIABLE."""
    both = (listening.early, listening.late)
    for publisher, quality in zip(both, reliable, strict=True):
        publisher.create(f'/{topic}', STRING, reliable=quality)
        publisher.heard(f'/{topic}', listening.node, WARM_UP)
    with ThreadPoolExecutor(2) as pool:
        halves = [texts(range(COUNT)), texts(range(COUNT, 2 * COUNT))]
        list(pool.map(lambda pair: pair[0].publish(f'/{topic}', pair[1]), zip(both, halves, strict=True)))
    assert listening.numbers(topic, 2 * COUNT + 2) == list(range(2 * COUNT))


def test_a_topic_that_changes_its_type(listening: Listening) -> None:
    """What is published after the change is stored as the new type, what came before as the old one."""
    publisher = listening.late
    publisher.create('/retyped', STRING)
    publisher.heard('/retyped', listening.node, WARM_UP)
    publisher.publish('/retyped', texts(range(COUNT)))
    listening.node.received('/retyped', COUNT + 1)
    publisher.destroy('/retyped')
    publisher.create('/retyped', INT)
    publisher.heard('/retyped', listening.node, cdr(INT, data=-1))
    publisher.publish('/retyped', [cdr(INT, data=number) for number in range(COUNT, 2 * COUNT)])
    assert listening.numbers('retyped', 2 * COUNT + 2) == list(range(2 * COUNT))
    documents = listening.stored(f'{listening.processes.robot}/retyped').documents('retyped')
    kinds = {document['type']: [sample['data'] for sample in document['samples']] for document in documents}
    assert set(kinds) == {STRING, INT}
    assert all(isinstance(data, int) for data in kinds[INT])


def test_a_publisher_that_vanishes_leaves_the_others_alone(listening: Listening) -> None:
    """When one of two publishers ends, nothing of the other one is lost, though the subscriptions change."""
    staying, leaving = listening.early, listening.late
    for publisher, reliable in ((staying, False), (leaving, True)):
        publisher.create('/vanishing', STRING, reliable=reliable)
        publisher.heard('/vanishing', listening.node, WARM_UP)
    with ThreadPoolExecutor(1) as pool:
        publishing = pool.submit(staying.publish, '/vanishing', texts(range(4 * COUNT)))
        leaving.destroy('/vanishing')
        publishing.result(60)
    assert listening.numbers('vanishing', 4 * COUNT + 2) == list(range(4 * COUNT))
