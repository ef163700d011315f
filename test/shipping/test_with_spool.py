from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from shipping.fakes import until
from stores.memory import MemoryStore

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import SpoolSettings, UploadSettings
from shadowhound_data_logger.core.errors import AccessDenied, ObjectRefused, StoreUnavailable
from shadowhound_data_logger.core.model import DataObject, Outcome, SpooledObject
from shadowhound_data_logger.shipping.uploader import Uploader
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.spool import Spool

SETTINGS = UploadSettings(threads=3, max_backoff_s=0.1)


def data_object(number: int, bucket: str = 'sensor-data', priority: int = 5, size: int = 20) -> DataObject:
    return DataObject(bucket=bucket, key=f'thor/odom/20251018/{number:06d}_odom.json', body=b'%*d' % (size, number),
                      content_type='application/json', sensor='odom', topic=None, type='t', samples=1, t_start_ns=0,
                      t_end_ns=0, priority=priority)  # fmt: skip


class Draining:
    """A real spool with an uploader whose outcomes are committed one by one."""

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
    """Through an outage in the middle: every object is in the store once, no file is left."""
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
    """Under its reason; the rest is delivered."""

    def fail(item: SpooledObject | None) -> Exception | None:
        return ObjectRefused('no', reason='KeyTooLongError') if item and item.key.endswith('000003_odom.json') else None

    store.fail = fail
    draining.spool.commit([data_object(number) for number in range(10)])
    draining.uploader.open()
    assert draining.uploader.drain(10.0)
    assert files(draining.spool.root, 'quarantine/KeyTooLongError/sensor-data') == ['000003_odom.json']
    assert len(list(store.list('sensor-data'))) == 9


def test_buckets_that_are_denied_keep_their_objects(draining: Draining, store: MemoryStore) -> None:
    """Nothing of them is quarantined, whatever the number of tries; the others go."""
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


def test_two_on_one_spool_take_turns(draining: Draining, store: MemoryStore, tmp_path: Path) -> None:
    """One drains; when it closes, the other one takes over within some seconds, and nothing is sent twice."""
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
    """What was evicted is not sent any more and not quarantined; what is left is delivered."""
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
