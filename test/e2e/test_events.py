"""Events of the node: the seconds before and after any kind of trigger are in a separate bag."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from e2e.bag_reading import Bag, bags
from e2e.processes import GENTLE, Node, Processes, Publisher, until
from e2e.reading import STRING, TYPES, decode, texts
from e2e.station import Station
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.formats.mcap.recovery import scan
from shadowhound_data_logger.spool.status import file
from shadowhound_data_logger.stores.base import ObjectStore

TOPIC, OTHER = '/e_one', '/e_two'
SETTINGS = {'events.regex': '^/e_', 'events.pre_s': 60.0, 'events.post_s': 1.0, 'sensors': ['odom']}


def publisher_of(processes: Processes, topic: str = TOPIC) -> Publisher:
    publisher = processes.publisher()
    publisher.create(topic, STRING)
    publisher.matched(topic)
    return publisher


def status(node: Node) -> dict[str, Any]:
    """The node's status of its events."""
    path = file(node.home / 'spool', node.robot)
    until(path.exists, 'the node has written its status')
    found: dict[str, Any] = json.loads(path.read_text())['events']
    return found


def numbers(bag: Bag) -> list[int]:
    return [int(decode(STRING, message.cdr).data) for message in bag.messages()]


def marks(bag: Bag) -> list[tuple[str, int, int]]:
    """The identity of each of its messages."""
    return [(each.topic, each.publish_ns, each.sequence) for each in bag.messages()]


def triggers(bag: Bag) -> list[tuple[str, str]]:
    return [(each['name'], each['by']) for each in bag.manifest['event']['triggers']]


def event_of(node: Node, processes: Processes, store: ObjectStore, folder: Path) -> Bag:
    """The only event, once it is delivered."""
    until(lambda: status(node)['written'] == 1, 'the event is written')
    node.delivered()
    (bag,) = bags(store, processes.robot, folder)
    return bag


def test_messages_before_and_after_a_trigger_are_in_a_bag(
    processes: Processes, seaweed: Tower, store: ObjectStore, station: Station
) -> None:
    """For topics without a sensor; the manifest names the trigger, the ledger counts only the requested messages."""
    node = processes.node(seaweed.environment(), SETTINGS)
    publisher = publisher_of(processes)
    publisher.publish(TOPIC, texts(range(20)))
    until(lambda: status(node)['bytes'] > 20 * 256, 'the ring has them')
    assert node.ledger()['events'] == {}
    done, text = station.event()
    assert done, text
    publisher.publish(TOPIC, texts(range(20, 30)))
    assert station.event()[1].endswith('is extended')
    bag = event_of(node, processes, store, processes.folder / 'bags')
    publisher.publish(TOPIC, texts(range(30, 40)))
    assert bag.folder.name.startswith('event_manual_')
    assert text == f'{bag.folder.name} starts'
    assert bag.check() == {TOPIC: 30}
    assert numbers(bag) == list(range(30))
    event = bag.manifest['event']
    assert (event['name'], event['pre_s'], event['post_s']) == ('manual', 60.0, 1.0)
    assert triggers(bag) == [('manual', 'service')] * 2
    row = node.ledger()['events'][TOPIC]
    assert (row['received'], row['stored'], row['missed'], row['open']) == (30, 30, node.known(0), 0)
    with sqlite3.connect(node.home / 'spool' / 'index.db') as db:
        slices = db.execute("SELECT priority, protected FROM objects WHERE key LIKE '%.mcap'").fetchall()
    assert slices == [(1, 1)]
    assert node.stop()['events'][TOPIC]['received'] == 30


@pytest.mark.long('fifteen seconds of events')
def test_conditions_and_agent_events_trigger(processes: Processes, seaweed: Tower, store: ObjectStore) -> None:
    """For all topics of the robot, with the subscriptions that also serve objects and a bag; none of their messages are lost."""
    parameters = {
        'events.regex': '.*', 'events.exclude': 'image_raw|rosout|events|sensor_logger_node|diagnostics', 'events.post_s': 8.0,
        'events.conditions': ['awake: imu:temperature > -100 for 1', 'never: odom:pose.pose.position.x > 1e9'],
        'events.log_event': '^f', 'bag.record': 'always',
    }  # fmt: skip
    node = processes.node(seaweed.environment(), parameters)
    logger = MissionDataLogger(home=node.home, robot=processes.robot, replay=False, start_timeout_s=0.0)
    try:
        mission_id = logger.start_mission('patrol', 'go round')
        processes.sim('duration_s:=60.0', GENTLE)
        until(lambda: status(node)['bag'], 'the condition triggers')
        logger.log_event('way_point', number=1)
        logger.log_event('fall', leg=2)
        until(lambda: status(node)['triggers'] == 2, 'what the agent logs triggers')
        until(lambda: status(node)['written'] == 1, 'the event is written')
        logger.end_mission(True, 0.0, 0.0)
    finally:
        logger.close()
    ledger = node.stop()
    found = bags(store, processes.robot, processes.folder / 'bags')
    (event,) = [bag for bag in found if bag.folder.name.startswith('event_')]
    assert event.folder.name.startswith('event_awake_')
    assert triggers(event) == [('awake', 'condition'), ('fall', 'log_event')]
    assert [json.loads(each['detail']) for each in event.manifest['event']['triggers'][1:]] == [{'leg': 2}]
    assert event.manifest['mission'] in (None, {'type': 'patrol', 'mission_id': mission_id, 'run_id': None})
    counts = event.check()
    assert set(counts) == set(TYPES)
    for topic in TYPES:
        row = ledger['events'][topic]
        assert (row['received'], row['stored'], row['missed'], row['dropped']) == (
            counts[topic],
            counts[topic],
            node.known(0),
            {},
        )
        assert ledger['topics'][topic]['missed'] == ledger['bags'][topic]['missed'] == node.known(0)
    recorded = {mark for bag in found if bag is not event for mark in marks(bag)}
    in_event = marks(event)
    assert len(in_event) == len(set(in_event))
    assert sorted(set(in_event) - recorded) == [], {topic: row['dropped'] for topic, row in ledger['bags'].items()}


def messages_in(open_slice: Path) -> int:
    """The number of messages that a kill would leave."""
    with open_slice.open('rb') as file:
        return scan(file.fileno()).contents.messages


@pytest.mark.long('a kill')
def test_the_next_start_completes_an_event_that_a_kill_interrupted(
    processes: Processes, seaweed: Tower, store: ObjectStore, station: Station
) -> None:
    """The next start completes its bag with what was written; the bag and the ledger report what is missing."""
    node = processes.node(seaweed.environment(), {**SETTINGS, 'events.post_s': 60.0})
    publisher = publisher_of(processes)
    publisher.publish(TOPIC, texts(range(20)))
    until(lambda: status(node)['bytes'] > 20 * 256, 'the ring has them')
    done, text = station.event()
    assert done
    bag_name = text.partition(' ')[0]
    open_slice = node.home / 'bags' / processes.robot / bag_name / f'{bag_name}_0.mcap.open'
    until(lambda: open_slice.exists() and messages_in(open_slice) == 20, 'it is written and synced')
    publisher.publish(TOPIC, texts(range(20, 30)))
    node.kill()
    node = processes.node(seaweed.environment(), SETTINGS)
    until(lambda: node.ledger()['events'].get(TOPIC, {}).get('stored'), 'what there was is spooled')
    node.delivered(3)
    (bag,) = bags(store, processes.robot, processes.folder / 'bags')
    assert bag.folder.name == bag_name
    assert numbers(bag)[:20] == list(range(20))
    assert bag.check() == {TOPIC: len(numbers(bag))}
    assert bag.manifest['state'] == 'recovered'
    assert triggers(bag) == [('manual', 'service')]
    row = node.stop()['events'][TOPIC]
    assert row['received'] == row['stored'] + row['dropped'].get('restart', 0)
    assert row['open'] == 0
