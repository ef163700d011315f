"""What waits for a rule waits, and nothing else does: with the real spool, however much waits."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from shipping.fakes import until
from shipping.test_with_spool import Draining, data_object, draining, store
from stores.memory import MemoryStore

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.errors import StoreUnavailable
from shadowhound_data_logger.core.model import EVENTS_WHEN, UPLOAD_WHEN, DataObject, State, waits_for
from shadowhound_data_logger.spool.index import Index

__all__ = ['draining', 'store']
MANY = 300
"""More than is looked up at a time, and more important than what may go."""


def plain(first: int, count: int) -> list[DataObject]:
    return [data_object(number, priority=0) for number in range(first, first + count)]


def event(number: int) -> DataObject:
    return replace(data_object(number, 'bags', priority=1), protected=True, sensor='bag', metadata={meta.EVENT: 'fall'})


def serve_policy_topics(number: int) -> DataObject:
    return replace(data_object(number, priority=9), sensor='_catalog')


def keys(store: MemoryStore) -> set[str]:
    return {info.key for bucket in ('sensor-data', 'bags') for info in store.list(bucket)}


def spool(draining: Draining, items: Sequence[DataObject]) -> set[str]:
    draining.spool.commit(items)
    draining.uploader.wake()
    return {item.key for item in items}


def test_only_what_waits_for_the_rule_waits(draining: Draining, store: MemoryStore) -> None:
    """Events and what tells of objects pass a backlog of more important ones; once the rule holds, all of it goes."""
    draining.uploader.wait_for({UPLOAD_WHEN: 'wifi.ssid == "lab": it is "cafe"'})
    waiting = spool(draining, plain(0, MANY))
    free = spool(draining, [event(1000), serve_policy_topics(1001)])
    draining.uploader.open()
    until(lambda: keys(store) == free)
    until(lambda: draining.uploader.status().state == 'waiting')
    status = draining.uploader.status()
    assert status.waits_for == {UPLOAD_WHEN: 'wifi.ssid == "lab": it is "cafe"'}
    assert not draining.uploader.drain(5.0), 'waiting is no use'
    until(lambda: draining.spool.pending_count() == MANY)
    free |= spool(draining, [event(1002)])
    until(lambda: keys(store) == free)
    draining.uploader.wait_for({})
    until(lambda: keys(store) == free | waiting)
    assert draining.uploader.drain(10.0)
    assert draining.spool.pending_count() == 0


def test_events_may_wait_for_a_rule_of_their_own(draining: Draining, store: MemoryStore) -> None:
    draining.uploader.wait_for({EVENTS_WHEN: 'mission: no mission is active'})
    events = spool(draining, [event(1), event(2)])
    others = spool(draining, [*plain(10, 5), serve_policy_topics(20)])
    draining.uploader.open()
    until(lambda: keys(store) == others)
    assert not draining.uploader.drain(5.0)
    draining.uploader.wait_for({})
    until(lambda: keys(store) == others | events)


def test_a_rule_that_ends_to_hold_stops_what_was_looked_up(draining: Draining, store: MemoryStore) -> None:
    """And what failed before waits with it; nothing of that is asked for again and again meanwhile."""
    store.fail = lambda _: StoreUnavailable('away')
    draining.uploader.open()
    waiting = spool(draining, plain(0, 20))
    until(lambda: draining.uploader.status().deferred >= 1)
    draining.uploader.wait_for({UPLOAD_WHEN: 'it does not'})
    until(lambda: draining.uploader.status().in_flight == 0)
    store.fail = None
    free = spool(draining, [serve_policy_topics(100)])
    until(lambda: keys(store) == free)
    until(lambda: draining.spool.pending_count() == 20)
    draining.uploader.wait_for({})
    until(lambda: keys(store) == free | waiting)


def test_drained_where_nothing_waits_for_the_rule(draining: Draining) -> None:
    draining.uploader.wait_for({UPLOAD_WHEN: 'it does not'})
    draining.uploader.open()
    spool(draining, [serve_policy_topics(1)])
    until(lambda: draining.spool.pending_count() == 0)
    assert draining.uploader.drain(10.0)


def test_an_object_that_is_protected_later_waits_for_the_same_rule(tmp_path: Path) -> None:
    """The column that ``protect`` changes has the value that ``waits_for`` gives an object that was protected from the start."""
    sensors = ('odom', '_catalog', '_', 'camera_previews', '_previews', 'previews', 'x_previewsx')
    facts: tuple[dict[str, str], ...] = ({}, {meta.EVENT: 'fall'}, {meta.EVENT: ''})
    index = Index(tmp_path / 'index.db')
    index.open()
    with closing(index), index.transaction():
        for place, (sensor, said) in enumerate(itertools.product(sensors, facts)):
            item = replace(data_object(place), sensor=sensor, protected=False)
            index.states.insert(item, item.key, '0' * 64, State.PENDING, None, said, 0)
            for protected in (False, True):
                row = index.objects.row(item.bucket, item.key)
                assert row is not None
                assert row['waits_for'] == waits_for(sensor, said, protected=protected), (sensor, said, protected)
                index.states.protect(item.bucket, item.key)


@pytest.mark.parametrize('oldest', [False, True])
def test_what_waits_costs_a_look_nothing(tmp_path: Path, oldest: bool) -> None:
    """The few that may go are found by an index of their own."""
    opened = Draining(tmp_path / 'spool', MemoryStore())
    try:
        opened.spool.commit([*plain(0, 50), serve_policy_topics(100), event(101)])
        found = opened.spool.pending(10, oldest=oldest, waiting_for={UPLOAD_WHEN})
        assert {item.waits_for for item in found} == {'', EVENTS_WHEN}
        assert [item.waits_for for item in opened.spool.pending(10, oldest=oldest, waiting_for={UPLOAD_WHEN, EVENTS_WHEN})] == [
            ''
        ]
    finally:
        opened.close()
