"""Bags recorded by the node: published messages are in them byte for byte, slices are uploaded while the next one is recorded."""

from __future__ import annotations

import sqlite3
from typing import Any

import pytest
from bags.recording import journaled, missing
from e2e.bag_reading import BUCKET, bags
from e2e.processes import Processes, until
from e2e.reading import STRING, TYPES, decode, stamp_ns, texts
from e2e.session import DURATION_S, SLICE_S, Session
from e2e.station import Station
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.stores.base import ObjectStore

SOON_NS = 30 * 10**9
"""From the end of a slice to its delivery."""

pytestmark = pytest.mark.timeout(300 + 2 * DURATION_S)


def test_the_bag_is_complete_in_every_reader(session: Session) -> None:
    """mcap, rosbags, metadata.yaml and manifest.json agree on the contents, and nothing is missing."""
    assert session.bag.manifest['state'] == 'complete'
    assert session.bag.manifest['missing'] == []
    assert session.bag.check() == {topic: len(found) for topic, found in session.messages.items()}


@pytest.mark.parametrize('topic', TYPES)
def test_every_message_is_in_the_bag_as_published(session: Session, topic: str) -> None:
    """Equal bytes in the same order, with the time of the header or of sending and, not before it, the time of arrival.

    The first ones on a robot with another RMW may be in any order: one of a new node's two subscriptions gets messages from
    before it discovered the publisher, the other one new messages at the same time.
    """
    found, received = session.messages[topic], session.heard[topic]
    decoded = [decode(TYPES[topic], message.cdr) for message in received]
    stamps = [
        stamp_ns(one) if hasattr(one, 'header') else message.source_ns for one, message in zip(decoded, received, strict=True)
    ]
    assert len(found) == session.said[topic]
    if session.node.is_beside:
        found = sorted(found, key=lambda message: message.publish_ns)
    assert [message.publish_ns for message in found] == stamps
    assert [message.cdr for message in found] == [message.cdr for message in received]
    assert all(0 <= message.log_ns - message.publish_ns < SOON_NS for message in found)
    assert len({message.sequence for message in found}) == len(found)


def test_bags_are_a_separate_sink_in_the_ledger(session: Session) -> None:
    """Everything published was recorded and delivered, whichever messages the sensors kept."""
    assert set(session.ledger['bags']) == set(TYPES)
    for topic, row in session.ledger['bags'].items():
        known, report = session.node.known, session.said[topic]
        assert (topic, row['published'], row['received'], row['missed']) == (topic, known(report), report, known(0))
        assert (row['stored'], row['stored_in']['delivered'], row['open']) == (row['received'], row['received'], 0)
    camera = session.ledger['topics']['/camera/compressed']
    assert camera['stored'] <= DURATION_S + 2
    assert camera['skipped'] == camera['received'] - camera['stored']


def test_slices_are_delivered_while_the_next_one_records(session: Session, store: ObjectStore) -> None:
    """The first is in the store before the last one starts, with the metadata that a listing needs."""
    assert len(session.bag.slices) >= DURATION_S / SLICE_S * 0.8 - 1  # a slice ends with the first sync after its time
    first, last = session.bag.manifest['slices'][0], session.bag.manifest['slices'][-1]
    info = store.head(BUCKET, first['key'])
    assert info is not None
    assert {'robot', 'bag', 'slice', 'messages', 't_start_ns', 't_end_ns', 'sha256'} <= set(info.metadata)
    assert info.metadata['sha256'] == first['sha256']
    row = _row(session, first['key'])
    assert row['settled_ns'] < last['t_start_ns'] + SOON_NS // 2
    assert row['settled_ns'] - first['t_end_ns'] < SOON_NS


def _row(session: Session, key: str) -> dict[str, Any]:
    with sqlite3.connect(session.folder / 'home' / 'spool' / 'index.db') as db:
        db.row_factory = sqlite3.Row
        return dict(db.execute('SELECT * FROM objects WHERE key = ?', (key,)).fetchone())


def test_the_services_start_pause_split_and_stop_a_bag(
    processes: Processes, seaweed: Tower, store: ObjectStore, station: Station
) -> None:
    """For a topic without a sensor: messages between start and stop are in the bag except for the pause, in two slices."""
    node = processes.node(seaweed.environment(), {'bag.regex': '^/b_', 'bag.exclude': 'not', 'sensors': ['odom']})
    publisher = processes.publisher()
    for topic in ('/b_one', '/b_not'):
        publisher.create(topic, STRING)
    assert station.bag('stop') == (False, 'nothing is recorded')
    done, name = station.bag('start')
    assert done
    assert name.startswith('recording_')
    assert not station.bag('start')[0]
    publisher.matched('/b_one')
    publisher.publish('/b_one', texts(range(20)))
    until(lambda: node.ledger()['bags'].get('/b_one', {}).get('received') == 20, 'all are received')
    assert station.bag('split')[0]
    assert station.bag_pause(paused=True)[0]
    publisher.publish('/b_one', texts(range(20, 30)))
    until(lambda: node.ledger()['bags']['/b_one']['received'] == 30, 'all are received')
    assert station.bag_pause(paused=False)[0]
    publisher.publish('/b_one', texts(range(30, 40)))
    until(lambda: node.ledger()['bags']['/b_one']['received'] == 40, 'all are received')
    assert station.bag('stop')[0]
    ledger = node.stop()
    (bag,) = bags(store, processes.robot, processes.folder / 'bags')
    assert bag.folder.name == name
    assert bag.check() == {'/b_one': 30}
    assert [int(decode(STRING, message.cdr).data) for message in bag.messages()] == [*range(20), *range(30, 40)]
    assert [report['messages'] for report in bag.manifest['slices']] == [20, 10]
    assert ledger['bags']['/b_one']['dropped'] == {'paused': 10}
    assert missing(bag.manifest) == journaled(node.home / 'spool', 'bags') == {('/b_one', 'paused'): 10}
    assert '/b_one' not in ledger['topics']
    assert not list((processes.folder / 'home' / 'bags' / processes.robot).iterdir())


def test_a_bag_starts_with_latched_messages(processes: Processes, seaweed: Tower, store: ObjectStore, station: Station) -> None:
    """A latched message from before the recording is in the bag, once, though a sensor received it long before."""
    parameters = {'sensors': ['map'], 'map.topics': ['/b_map'], 'map.rate_hz': 0.0}
    node = processes.node(seaweed.environment(), parameters)
    publisher = processes.publisher()
    publisher.create('/b_map', STRING, latched=True, depth=1)
    publisher.matched('/b_map')
    publisher.publish('/b_map', texts([1]))
    node.received('/b_map', 1)
    assert station.bag('start')[0]
    until(lambda: node.ledger()['bags'].get('/b_map', {}).get('received') == 1, 'what was latched is received')
    publisher.publish('/b_map', texts([2]))
    node.received('/b_map', 2)
    until(lambda: node.ledger()['bags']['/b_map']['received'] == 2, 'the later messages are received')
    assert station.bag('stop')[0]
    ledger = node.stop()
    (bag,) = bags(store, processes.robot, processes.folder / 'bags')
    assert [int(decode(STRING, message.cdr).data) for message in bag.messages()] == [1, 2]
    assert ledger['topics']['/b_map']['received'] == ledger['bags']['/b_map']['received'] == 2
