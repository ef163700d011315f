"""Each bag of the node starts with the latched messages, as if it were the only one: events and later bags as well."""

from __future__ import annotations

import json

import pytest
from e2e.bag_reading import Bag, bags
from e2e.processes import Processes, until
from e2e.reading import STRING, decode, texts
from e2e.station import Station
from rosbags.highlevel import AnyReader
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.spool.status import file
from shadowhound_data_logger.stores.base import ObjectStore

STATIC, TALK = '/l_static', '/l_talk'
PARAMETERS = {
    'sensors': ['map'], 'map.topics': ['/l_map'], 'map.rate_hz': 0.0, 'bag.record': 'always', 'bag.regex': '^/l_',
    'events.regex': '^/l_', 'events.pre_s': 1.0, 'events.post_s': 0.5,
}  # fmt: skip


def latched(bag: Bag) -> list[tuple[str, str]]:
    return sorted((each.topic, decode(STRING, each.cdr).data) for each in bag.messages() if each.topic != TALK)


@pytest.mark.long('twelve seconds of bags')
def test_latched_messages_are_at_the_start_of_every_bag(
    processes: Processes, seaweed: Tower, store: ObjectStore, station: Station
) -> None:
    """The last message of both publishers of a topic, and of one with a sensor too; none of them count as missed."""
    node = processes.node(seaweed.environment(), PARAMETERS)

    def recorded(topic: str) -> int:
        return int(node.ledger()['bags'].get(topic, {}).get('received', 0))

    publishers = {name: processes.publisher() for name in ('left', 'right')}
    for publisher in publishers.values():
        publisher.create(STATIC, STRING, latched=True, depth=1)
        publisher.matched(STATIC)
    # In sequence: with a depth of 1, the next message replaces one that is not delivered yet. Alternating: with a middleware
    # that does not name publishers the events' ring keeps the last two messages, whichever publisher sent them.
    for count, text in enumerate(['left before', 'right before', 'left', 'right'], 1):
        publishers[text.split()[0]].publish(STATIC, texts([text]))
        until(lambda count=count: recorded(STATIC) == count, f'{text!r} is recorded')
    publisher.create('/l_map', STRING, latched=True, depth=1)
    publisher.create(TALK, STRING)
    publisher.matched(TALK)
    publisher.publish('/l_map', texts(['map']))
    until(lambda: recorded('/l_map') == 1, 'what a sensor takes is recorded')
    publisher.publish(TALK, texts(range(20)), 0.1)
    assert station.event()[0]
    publisher.publish(TALK, texts(range(20, 30)), 0.1)
    path = file(node.home / 'spool', node.robot)
    until(lambda: json.loads(path.read_text())['events']['written'] == 1, 'the event is written')
    logger = MissionDataLogger(home=node.home, robot=processes.robot, replay=False, start_timeout_s=0.0)
    try:
        logger.start_mission('patrol', 'go round')
        until(lambda: (recorded(STATIC), recorded('/l_map')) == (6, 2), 'the bag of the mission has what is latched')
        publisher.publish(TALK, texts(range(30, 40)))
        logger.end_mission(True, 0.0, 0.0)
        until(lambda: (recorded(STATIC), recorded('/l_map')) == (8, 3), 'the bag after it has it')
    finally:
        logger.close()
    ledger = node.stop()
    event, mission, first, last = bags(store, processes.robot, processes.folder / 'bags')
    static = [('/l_map', 'map'), (STATIC, 'left'), (STATIC, 'right')]
    assert latched(event) == latched(mission) == latched(last) == static
    assert latched(first) == sorted([*static, (STATIC, 'left before'), (STATIC, 'right before')])
    for bag in (event, mission, first, last):
        bag.check()
    began_ns = min(each.log_ns for each in event.messages())
    assert {each.log_ns for each in event.messages() if each.topic != TALK} == {began_ns}
    talked = [each for bag in (first, mission, last) for each in bag.messages() if each.topic == TALK]
    assert [int(decode(STRING, each.cdr).data) for each in talked] == list(range(40))
    for row in (*ledger['bags'].values(), *ledger['events'].values()):
        assert not row['missed']  # unknown if publishers have no names
        assert (row['open'], row['received']) == (0, row['stored'])


def test_each_slice_can_be_played_on_its_own(processes: Processes, seaweed: Tower, store: ObjectStore, station: Station) -> None:
    """Another reader finds the latched messages of both publishers in the second slice alone, before all others."""
    parameters = {'sensors': ['talk'], 'talk.topics': ['/l_other'], 'bag.record': 'always', 'bag.regex': '^/l_'}
    node = processes.node(seaweed.environment(), parameters)

    def recorded(topic: str) -> int:
        return int(node.ledger()['bags'].get(topic, {}).get('received', 0))

    publisher = processes.publisher()
    for name in ('left', 'right'):
        publisher = processes.publisher()
        publisher.create(STATIC, STRING, latched=True, depth=1)
        publisher.matched(STATIC)
        publisher.publish(STATIC, texts([name]))
    until(lambda: recorded(STATIC) == 2, 'both are recorded')
    publisher.create(TALK, STRING)
    publisher.matched(TALK)
    for part in range(3):
        publisher.publish(TALK, texts(range(10 * part, 10 * part + 10)), 0.01)
        until(lambda part=part: recorded(TALK) == 10 * part + 10, 'all messages are recorded')
        assert station.bag('split')[0]
    ledger = node.stop()
    (bag,) = bags(store, processes.robot, processes.folder / 'bags')
    bag.check()
    assert [each['repeated'] for each in bag.manifest['slices']] == [{}, {STATIC: 2}, {STATIC: 2}]
    assert (ledger['bags'][STATIC]['received'], ledger['bags'][STATIC]['stored']) == (2, 2)
    for path in bag.slices[1:]:
        with AnyReader([path]) as reader:
            found = [(connection.topic, decode(STRING, bytes(cdr)).data) for connection, _, cdr in reader.messages()]
        assert sorted(found[:2]) == [(STATIC, 'left'), (STATIC, 'right')]
        assert {topic for topic, _ in found[2:]} == {TALK}
        assert len(found) == 12
