"""Deliveries with real threads and a real spool: after outages, failures, kills and random faults each object arrives once."""

from __future__ import annotations

import itertools
import logging
import random
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from faults.campaign import simulated
from faults.kinds import given_seed
from faults.report import Summary
from faults.simulated_day import Day
from shipping.fakes import FakeSpool, until
from stores.memory import MemoryStore

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import SpoolSettings, StoreSettings, UploadSettings
from shadowhound_data_logger.core.errors import (
    AccessDenied,
    BucketMissing,
    CredentialsRejected,
    ForeignObject,
    ObjectRefused,
    StoreError,
    StoreUnavailable,
)
from shadowhound_data_logger.core.model import EVENTS_WHEN, UPLOAD_WHEN, DataObject, Outcome, Put, SpooledObject, State, waits_for
from shadowhound_data_logger.shipping.uploader import Uploader
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.writer import SpoolWriter
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.base import ObjectStore

SETTINGS = UploadSettings(threads=3, max_backoff_s=0.1)
Start = Callable[..., Uploader]


class Recording(MemoryStore):
    """Counts the successful puts of each key."""

    def __init__(self, fail: Callable[[SpooledObject | None], Exception | None] | None = None) -> None:
        super().__init__(fail)
        self.puts: list[str] = []

    def put(self, item: SpooledObject) -> Put:
        end = super().put(item)
        self.puts.append(item.key)
        return end


class Hanging(MemoryStore):
    """A put does not return until the test releases it."""

    def __init__(self) -> None:
        super().__init__()
        self.entered = threading.Semaphore(0)
        self.let_go = threading.Event()

    def put(self, item: SpooledObject) -> Put:
        self.entered.release()
        assert self.let_go.wait(60)
        return super().put(item)


@pytest.fixture
def start(spool: FakeSpool) -> Iterator[Start]:
    """Opens an uploader for the fake spool, and closes it."""
    opened: list[Uploader] = []

    def start(store: ObjectStore, settings: UploadSettings = SETTINGS) -> Uploader:
        uploader = Uploader(spool, store, settings, spool.settle, rng=random.Random(5))
        spool.uploader = uploader
        opened.append(uploader)
        uploader.open()
        return uploader

    yield start
    for uploader in opened:
        uploader.close(60.0)


def lines(caplog: pytest.LogCaptureFixture, level: int) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno == level]


def test_drain_delivers_everything_once(spool: FakeSpool, start: Start) -> None:
    """Before and after open, with a wake for later objects."""
    items = spool.add(150)
    store = Recording()
    uploader = start(store)
    assert uploader.drain(10.0)
    items += spool.add(10)
    uploader.wake()
    assert uploader.drain(10.0)
    assert sorted(store.puts) == sorted(item.key for item in items)
    assert spool.ended_as(State.DELIVERED) == [item.id for item in items]
    status = uploader.status()
    assert (status.state, status.delivered, status.in_flight, status.retries) == ('idle', 160, 0, 0)


def test_after_an_outage_everything_is_delivered_once(
    spool: FakeSpool, start: Start, caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    """It recovers on its own; two lines are logged, however many objects are pending."""
    caplog.set_level(logging.INFO)
    items = spool.add(100)
    store = Recording(lambda _: StoreUnavailable('Tower is away', remedy='switch it on'))
    uploader = start(store)
    until(lambda: uploader.status().state == 'store_down' and uploader.status().retries > 3)
    assert 'switch it on' in uploader.status().last_error
    assert not uploader.drain(60.0)
    store.fail = None
    until(lambda: not spool.items)
    assert sorted(store.puts) == sorted(item.key for item in items)
    assert spool.ended_as(State.DELIVERED) == [item.id for item in items]
    until(lambda: uploader.status().state == 'idle')
    assert [line.split(':')[0] for line in lines(caplog, logging.WARNING)] == ['the store is away']
    assert len(lines(caplog, logging.INFO)) == 1


def test_one_failing_object_stops_no_other_upload(spool: FakeSpool, start: Start) -> None:
    """The rest is delivered, it stays pending, and is sent when possible."""
    bad, *rest = spool.add(60)
    store = Recording(lambda item: StoreUnavailable('broken') if item and item.id == bad.id else None)
    uploader = start(store)
    until(lambda: len(spool.items) == 1)
    assert spool.ended_as(State.DELIVERED) == [item.id for item in rest]
    store.fail = None
    assert uploader.drain(10.0)


def test_rejected_credentials_pause_with_one_log_line_and_resume(
    spool: FakeSpool, start: Start, caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    """The error includes the remedy; nothing is quarantined."""
    caplog.set_level(logging.INFO)
    spool.add(30)
    store = Recording(lambda _: CredentialsRejected('Tower refuses the key', remedy='check AWS_SECRET_ACCESS_KEY'))
    uploader = start(store)
    until(lambda: uploader.status().retries > 3)
    assert uploader.status().state == 'paused'
    assert uploader.drain(60.0) is False
    store.fail = None
    until(lambda: not spool.items)
    assert len(spool.ended_as(State.DELIVERED)) == 30
    [line] = lines(caplog, logging.ERROR)
    assert 'check AWS_SECRET_ACCESS_KEY' in line


@pytest.mark.parametrize('kind', [BucketMissing, AccessDenied])
def test_a_blocked_bucket_delays_no_other(spool: FakeSpool, start: Start, kind: type[StoreError]) -> None:
    """The others are delivered, the status names the bucket, and it recovers."""
    spool.add(100, bucket='closed', priority=0)
    spool.add(100, bucket='open')
    store = Recording(lambda item: kind('not this bucket') if item and item.bucket == 'closed' else None)
    uploader = start(store)
    assert uploader.drain(20.0) is False
    assert {item.bucket for item in spool.items.values()} == {'closed'}
    assert len(spool.items) == 100
    assert uploader.status().blocked_buckets == {'closed': 'not this bucket'}
    until(lambda: uploader.status().state == 'paused')
    store.fail = None
    until(lambda: not spool.items)
    assert uploader.drain(10.0)
    assert len(spool.ended_as(State.DELIVERED)) == 200


def test_terminal_failures_are_quarantined_with_their_reason_and_little_logging(
    spool: FakeSpool, start: Start, caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    """A foreign writer is logged as an error; the second to ninth of the same kind are not."""
    items = spool.add(12)
    foreign = {item.id for item in items[:8]}
    refused = items[8].id

    def fail(item: SpooledObject | None) -> Exception | None:
        assert item is not None
        if item.id in foreign:
            return ForeignObject('holds other content already')
        return ObjectRefused('no such name', reason='name') if item.id == refused else None

    uploader = start(MemoryStore(fail))
    assert uploader.drain(10.0)
    reasons = {outcome.item.id: outcome.reason for outcome in spool.outcomes if outcome.state is State.QUARANTINED}
    assert reasons == {**dict.fromkeys(foreign, 'foreign'), refused: 'name'}
    assert uploader.status().quarantined == 9
    assert len(lines(caplog, logging.ERROR)) == 2


def test_an_object_evicted_during_upload_is_not_an_error(
    spool: FakeSpool, start: Start, caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    """Its file is gone: its outcome records that, and the log has no error."""
    item = spool.add()[0]
    item.path.unlink()
    uploader = start(MemoryStore())
    assert uploader.drain(10.0)
    assert [(outcome.state, outcome.reason) for outcome in spool.outcomes] == [(State.QUARANTINED, 'missing')]
    assert lines(caplog, logging.ERROR) == []


def test_a_defect_is_counted_shown_and_survived(spool: FakeSpool, start: Start, caplog: pytest.LogCaptureFixture) -> None:
    """A traceback once; the thread continues, the object is retried, the others are delivered."""
    bad, *_ = spool.add(20)
    defects = [ZeroDivisionError('a defect')] * 3
    store = MemoryStore(lambda item: defects.pop() if item and item.id == bad.id and defects else None)
    uploader = start(store)
    until(lambda: not spool.items)
    assert uploader.status().worker_failures == 3
    assert 'a defect' in uploader.status().last_error
    [record] = [record for record in caplog.records if record.levelno == logging.ERROR]
    assert record.exc_info


def test_a_spool_that_cannot_be_read_is_tried_again(spool: FakeSpool, start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    """A failing query stops no thread."""
    spool.add(5)
    failures = [OSError('disk I/O error')] * 2
    pending = spool.pending

    def failing(*arguments: Any, **options: Any) -> list[SpooledObject]:
        if failures:
            raise failures.pop()
        return pending(*arguments, **options)

    monkeypatch.setattr(spool, 'pending', failing)
    uploader = start(MemoryStore())
    until(lambda: not spool.items)
    assert uploader.status().worker_failures == 2


def test_while_another_process_drains_nothing_is_sent_and_then_it_takes_over(spool: FakeSpool, start: Start) -> None:
    """It tries once per second; a drain does not wait for it."""
    spool.lock_is_free = False
    spool.add(3)
    uploader = start(MemoryStore())
    until(lambda: uploader.drain(0.01) is False)
    assert uploader.status().state == 'not_draining'
    assert len(spool.items) == 3
    spool.lock_is_free = True
    until(lambda: not spool.items)


def test_close_waits_for_what_is_in_flight_and_begins_nothing(spool: FakeSpool, start: Start) -> None:
    """Puts that end before the deadline are settled."""
    spool.add(20)
    store = Hanging()
    uploader = start(store)
    for _ in range(SETTINGS.threads):
        assert store.entered.acquire(timeout=60)
    assert uploader.status().in_flight == 3
    assert uploader.status().state == 'shipping'
    threading.Timer(0.2, store.let_go.set).start()
    uploader.close(60.0)
    assert len(spool.ended_as(State.DELIVERED)) == 3
    assert not store.entered.acquire(blocking=False)


def test_close_does_not_wait_longer_than_its_deadline_for_a_put_that_hangs(
    spool: FakeSpool, start: Start, caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    """The result of the hung put is ignored when it returns later."""
    spool.add(20)
    store = Hanging()
    uploader = start(store)
    assert store.entered.acquire(timeout=60)
    began = time.monotonic()
    uploader.close(0.3)
    assert 0.25 < time.monotonic() - began < 60.0
    assert len(lines(caplog, logging.WARNING)) == 1
    uploader.close(0.0)
    store.let_go.set()
    until(lambda: not [thread for thread in threading.enumerate() if thread.name.startswith('upload-')])
    assert spool.outcomes == []


def test_drain_gives_up_at_its_deadline(spool: FakeSpool, start: Start) -> None:
    """A hung put is not an outage yet."""
    spool.add()
    store = Hanging()
    uploader = start(store)
    began = time.monotonic()
    assert uploader.drain(0.3) is False
    assert 0.25 < time.monotonic() - began < 60.0
    store.let_go.set()


def test_close_before_open_and_twice_is_fine(spool: FakeSpool) -> None:
    """It is idempotent, and there is nothing to wait for."""
    uploader = Uploader(spool, MemoryStore(), SETTINGS, spool.settle)
    uploader.close(1.0)
    uploader.close(1.0)
    assert uploader.status().state == 'not_draining'


def test_objects_are_delivered_into_a_folder(spool: FakeSpool, start: Start, tmp_path: Path) -> None:
    """With the default store: every object is there with its content."""
    items = spool.add(40, content=b'\xff\xd8 a picture')
    store = open_store(StoreSettings(directory=tmp_path / 'store'), SETTINGS)
    uploader = start(store)
    assert uploader.drain(20.0)
    assert {info.key for info in store.list('b')} == {item.key for item in items}
    assert {store.get('b', item.key) for item in items} == {b'\xff\xd8 a picture'}
    store.close()


def data_object(number: int, bucket: str = 'sensor-data', priority: int = 5, size: int = 20) -> DataObject:
    return DataObject(bucket=bucket, key=f'thor/odom/20251018/{number:06d}_odom.json', body=b'%*d' % (size, number),
                      content_type='application/json', sensor='odom', topic=None, type='t', samples=1, t_start_ns=0,
                      t_end_ns=0, priority=priority)  # fmt: skip


class Draining:
    """A real spool with an uploader that commits each outcome separately."""

    def __init__(self, root: Path, store: MemoryStore) -> None:
        self.spool = Spool(root, SpoolSettings(min_free_bytes=0), SystemClock('boot'), 'thor')
        self.uploader = Uploader(self.spool, store, SETTINGS, self._settle)
        self.spool.open()

    def _settle(self, outcomes: Sequence[Outcome]) -> None:
        self.spool.commit((), outcomes)
        self.uploader.settled([outcome.item.id for outcome in outcomes])

    def close(self) -> None:
        self.uploader.close(5.0)
        self.spool.close()


@pytest.fixture
def store() -> MemoryStore:
    return MemoryStore()


@pytest.fixture
def draining(tmp_path: Path, store: MemoryStore) -> Iterator[Draining]:
    opened = Draining(tmp_path / 'spool', store)
    yield opened
    opened.close()


def files(root: Path, folder: str) -> list[str]:
    return sorted(path.name for path in (root / folder).rglob('*') if path.is_file())


def test_delivered_objects_are_removed_from_the_spool(draining: Draining, store: MemoryStore) -> None:
    """With an outage in the middle: every object is in the store once, no file is left."""
    draining.uploader.open()
    draining.spool.commit([data_object(number) for number in range(60)])
    draining.uploader.wake()
    until(lambda: any(True for _ in store.list('sensor-data')))
    store.fail = lambda _: StoreUnavailable('away')
    draining.spool.commit([data_object(number) for number in range(60, 120)])
    draining.uploader.wake()
    until(lambda: draining.uploader.status().state == 'store_down')
    store.fail = None
    until(lambda: draining.spool.pending_count() == 0)
    assert draining.uploader.drain(10.0)
    assert len(list(store.list('sensor-data'))) == 120
    assert files(draining.spool.root, 'ready') == []
    assert draining.uploader.status().delivered == 120


def test_rejected_objects_are_quarantined(draining: Draining, store: MemoryStore) -> None:
    """Under their reason; the rest is delivered."""

    def fail(item: SpooledObject | None) -> Exception | None:
        return ObjectRefused('no', reason='KeyTooLongError') if item and item.key.endswith('000003_odom.json') else None

    store.fail = fail
    draining.spool.commit([data_object(number) for number in range(10)])
    draining.uploader.open()
    assert draining.uploader.drain(10.0)
    assert files(draining.spool.root, 'quarantine/KeyTooLongError/sensor-data') == ['000003_odom.json']
    assert len(list(store.list('sensor-data'))) == 9


def test_buckets_that_are_denied_keep_their_objects(draining: Draining, store: MemoryStore) -> None:
    """None of them are quarantined, however many tries; the others are sent."""
    store.fail = lambda item: AccessDenied('no') if item and item.bucket == 'trajectories' else None
    draining.spool.commit([data_object(number, 'trajectories', 0) for number in range(80)])
    draining.spool.commit([data_object(number) for number in range(80)])
    draining.uploader.open()
    until(lambda: draining.spool.pending_count() == 80)
    until(lambda: draining.uploader.status().retries > 10)
    assert draining.spool.pending_count() == 80
    store.fail = None
    assert not files(draining.spool.root, 'quarantine')
    until(lambda: draining.spool.pending_count() == 0)


def test_two_uploaders_of_one_spool_take_turns(draining: Draining, store: MemoryStore, tmp_path: Path) -> None:
    """One drains; when it closes, the other takes over within a few seconds, and nothing is sent twice."""
    draining.uploader.open()
    until(lambda: draining.uploader.status().state == 'idle')
    second = Draining(tmp_path / 'spool', store)
    try:
        second.uploader.open()
        second.spool.commit([data_object(1)])
        until(lambda: draining.spool.pending_count() == 0)
        assert second.uploader.status().state == 'not_draining'
        draining.uploader.close(5.0)
        second.spool.commit([data_object(2)])
        second.uploader.wake()
        until(lambda: second.spool.pending_count() == 0)
        assert second.uploader.status().delivered == 1
    finally:
        second.close()


@pytest.mark.long('a second of CPU or more')
def test_a_spool_that_is_full_evicts_while_objects_wait(tmp_path: Path, store: MemoryStore) -> None:
    """Evicted objects are not sent or quarantined; the remaining ones are delivered."""
    spool = Spool(tmp_path / 'spool', SpoolSettings(max_bytes=1 << 20, min_free_bytes=0), SystemClock('boot'), 'thor')
    spool.open()
    uploader: Uploader

    def settle(outcomes: Sequence[Outcome]) -> None:
        spool.commit((), outcomes)
        uploader.settled([outcome.item.id for outcome in outcomes])

    uploader = Uploader(spool, store, SETTINGS, settle)
    store.fail = lambda _: StoreUnavailable('away')
    uploader.open()
    try:
        for number in range(300):
            spool.commit([data_object(number, size=8192)])
            uploader.wake()
        until(lambda: uploader.status().retries > 3)
        left = spool.pending_count()
        assert 50 < left < 200
        store.fail = None
        until(lambda: spool.pending_count() == 0)
        assert len(list(store.list('sensor-data'))) == left
    finally:
        uploader.close(5.0)
        spool.close()
    index = Index(tmp_path / 'spool' / 'index.db', read_only=True)
    index.open()
    objects = {state: count for _, state, count, _, _ in index.overview.tally() if count}
    index.close()
    assert objects == {'spooled': 300, 'delivered': left, 'evicted': 300 - left}


__all__ = ['draining', 'store']
MANY = 300
"""More objects than one query returns, and more important than those that may be sent."""


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


def test_only_objects_under_the_rule_wait(draining: Draining, store: MemoryStore) -> None:
    """Events and records about objects overtake a backlog of more important ones; once the rule holds, everything is sent."""
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


def test_objects_already_read_stop_when_the_rule_no_longer_holds(draining: Draining, store: MemoryStore) -> None:
    """Earlier failures wait as well; none of them is queried repeatedly during that time."""
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


def test_the_spool_is_drained_when_only_objects_under_the_rule_wait(draining: Draining) -> None:
    draining.uploader.wait_for({UPLOAD_WHEN: 'it does not'})
    draining.uploader.open()
    spool(draining, [serve_policy_topics(1)])
    until(lambda: draining.spool.pending_count() == 0)
    assert draining.uploader.drain(10.0)


def test_an_object_that_is_protected_later_waits_for_the_same_rule(tmp_path: Path) -> None:
    """The column changed by ``protect`` has the value that ``waits_for`` returns for an object protected from the start."""
    sensors = ('odom', '_catalog', '_', 'camera_previews', '_previews', 'previews', 'x_previewsx')
    facts: tuple[dict[str, str], ...] = ({}, {meta.EVENT: 'fall'}, {meta.EVENT: ''})
    index = Index(tmp_path / 'index.db')
    index.open()
    with closing(index), index.transaction():
        for place, (sensor, report) in enumerate(itertools.product(sensors, facts)):
            item = replace(data_object(place), sensor=sensor, protected=False)
            index.states.insert(item, item.key, '0' * 64, State.PENDING, None, report, 0)
            for protected in (False, True):
                row = index.objects.row(item.bucket, item.key)
                assert row is not None
                assert row['waits_for'] == waits_for(sensor, report, protected=protected), (sensor, report, protected)
                index.states.protect(item.bucket, item.key)


@pytest.mark.parametrize('oldest', [False, True])
def test_waiting_objects_do_not_slow_down_queries(tmp_path: Path, oldest: bool) -> None:
    """The few that may be sent are found with a separate index."""
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


class Ordered(MemoryStore):
    """Records the order in which objects arrive."""

    def __init__(self) -> None:
        super().__init__()
        self.came: list[tuple[int, int]] = []
        """(priority, number of the object in the spool)."""

    def put(self, item: SpooledObject) -> Put:
        self.came.append((item.priority, item.id))
        return super().put(item)


@pytest.fixture
def real_spool(tmp_path: Path) -> Iterator[Spool]:
    opened = Spool(tmp_path / 'spool', SpoolSettings(min_free_bytes=0), SystemClock('boot'), 'thor')
    opened.open()
    yield opened
    opened.close()


def drained(real_spool: Spool) -> list[tuple[int, int]]:
    """Everything delivered by one thread, in order."""
    store = Ordered()
    writer = SpoolWriter(real_spool, 0.05)
    uploader = Uploader(real_spool, store, UploadSettings(threads=1), writer.settle)
    writer.on_commit(settled=uploader.settled)
    writer.open()
    uploader.open()
    try:
        assert uploader.drain(20.0)
    finally:
        uploader.close(5.0)
        writer.close(5.0)
    return store.came


def test_the_most_important_are_sent_first_and_each_fourth_is_the_oldest(real_spool: Spool) -> None:
    """For more objects than one query finds, in the order of the index."""
    real_spool.commit([data_object(number, priority=8) for number in range(100)])
    real_spool.commit([data_object(number, priority=number % 3) for number in range(100, 400)])
    came = drained(real_spool)
    assert len({number for _, number in came}) == 400
    important = [entry for place, entry in enumerate(came[:300]) if place % 4 != 3]
    assert important == sorted((priority, number) for priority, number in came if priority != 8)[: len(important)]
    assert came[3::4][:100] == [(8, number) for number in range(1, 101)]


def test_a_changed_priority_applies_to_new_objects(real_spool: Spool) -> None:
    """Objects in the spool keep the priority with which they were spooled."""
    real_spool.commit([data_object(1, priority=7), data_object(2, priority=5)])
    real_spool.commit([data_object(3, priority=1)])
    assert [priority for priority, _ in drained(real_spool)] == [1, 5, 7]


class Deadly(MemoryStore):
    """Puts of one object raise the exceptions in ``deaths``."""

    def __init__(self, victim: int = 0) -> None:
        super().__init__()
        self.victim = victim
        self.deaths: list[BaseException] = [SystemExit(1), MemoryError()]

    def put(self, item: SpooledObject) -> Put:
        if item.id == self.victim and self.deaths:
            raise self.deaths.pop()
        return super().put(item)


def test_a_thread_that_fails_in_a_put_loses_nothing(spool: FakeSpool, start: Callable[[MemoryStore], Uploader]) -> None:
    """Its object stays pending and is sent again, by the same thread or another; each crash is counted."""
    victim, *rest = spool.add(20)
    uploader = start(Deadly(victim.id))
    until(lambda: not spool.items)
    assert spool.ended_as(State.DELIVERED) == [victim.id, *(item.id for item in rest)]
    assert sum(worker.failures for worker in uploader.workers) == uploader.status().worker_failures == 2


def test_a_drain_lock_that_cannot_be_opened_is_tried_again(spool: FakeSpool, start: Callable[[MemoryStore], Uploader],
                                               monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    """Nothing is sent during that time, and opening it is retried."""
    spool.add(3)
    failures, lock = [SystemExit(1), OSError('no locks available')], spool.drain_lock

    def failing() -> Any:
        if failures:
            raise failures.pop()
        return lock()

    monkeypatch.setattr(spool, 'drain_lock', failing)
    uploader = start(MemoryStore())
    until(lambda: not spool.items)
    keeper = uploader.workers[0]
    assert (keeper.name, keeper.failures, keeper.last_error) == ('upload-lock', 2, 'SystemExit: 1')


DAYS = 3
"""``torture.faults`` runs thousands."""


def check_days(summary: Summary, first: int, days: int) -> None:
    """Every day succeeded; otherwise the seeds and the values are shown."""
    assert summary.days == days, '\n'.join((f'seeds {first} to {first + days - 1}', *summary.lines()))


def test_random_faults_of_simulated_days_lose_nothing() -> None:
    """With a simulated clock, pauses and network, and everything else real."""
    first = given_seed()
    check_days(simulated(range(first, first + DAYS)), first, DAYS)


def test_a_simulated_day_is_the_same_each_time(tmp_path: Path) -> None:
    """Down to the last request, so that a seed is a bug report."""
    first, second = (Day(7, tmp_path / name).run() for name in ('first', 'second'))
    assert first == second
    assert first.requests
