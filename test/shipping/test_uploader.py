from __future__ import annotations

import logging
import random
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from shipping.fakes import FakeSpool, until
from stores.memory import MemoryStore

from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.core.errors import (
    AccessDenied,
    BucketMissing,
    CredentialsRejected,
    ForeignObject,
    ObjectRefused,
    StoreError,
    StoreUnavailable,
)
from shadowhound_data_logger.core.model import Put, SpooledObject, State
from shadowhound_data_logger.shipping.uploader import Uploader
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.base import ObjectStore

SETTINGS = UploadSettings(threads=3, max_backoff_s=0.1)
Start = Callable[..., Uploader]


class Recording(MemoryStore):
    """Counts the puts of each key that succeeded."""

    def __init__(self, fail: Callable[[SpooledObject | None], Exception | None] | None = None) -> None:
        super().__init__(fail)
        self.puts: list[str] = []

    def put(self, item: SpooledObject) -> Put:
        end = super().put(item)
        self.puts.append(item.key)
        return end


class Hanging(MemoryStore):
    """A put does not return before it is let go."""

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
    """Opens an uploader over the fake spool, and closes it."""
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
    """Before and after open, with a wake for what came later."""
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
    """It recovers by itself; two lines tell of it, however many objects wait."""
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
    """The rest is delivered, it stays, and it goes when it can."""
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
    """The error names the remedy; nothing is quarantined."""
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
def test_a_bucket_that_takes_nothing_waits_alone(spool: FakeSpool, start: Start, kind: type[StoreError]) -> None:
    """The others are delivered, the status names it, and it recovers."""
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


def test_terminal_failures_are_quarantined_with_their_reason_and_few_words(
    spool: FakeSpool, start: Start, caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    """A foreign writer is an error in the log; the second to ninth of a kind are not."""
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
    """Its file is gone: its outcome says so, the log has no error."""
    item = spool.add()[0]
    item.path.unlink()
    uploader = start(MemoryStore())
    assert uploader.drain(10.0)
    assert [(outcome.state, outcome.reason) for outcome in spool.outcomes] == [(State.QUARANTINED, 'missing')]
    assert lines(caplog, logging.ERROR) == []


def test_a_defect_is_counted_shown_and_survived(spool: FakeSpool, start: Start, caplog: pytest.LogCaptureFixture) -> None:
    """A traceback once; the thread goes on, the object is tried again, the others are delivered."""
    bad, *_ = spool.add(20)
    defects = [ZeroDivisionError('a defect')] * 3
    store = MemoryStore(lambda item: defects.pop() if item and item.id == bad.id and defects else None)
    uploader = start(store)
    until(lambda: not spool.items)
    assert uploader.status().worker_failures == 3
    assert 'a defect' in uploader.status().last_error
    [record] = [record for record in caplog.records if record.levelno == logging.ERROR]
    assert record.exc_info


def test_a_spool_that_cannot_be_asked_is_asked_again(spool: FakeSpool, start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    """A failing query ends no thread."""
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
    """It asks once a second; a drain does not wait for it."""
    spool.lock_is_free = False
    spool.add(3)
    uploader = start(MemoryStore())
    until(lambda: uploader.drain(0.01) is False)
    assert uploader.status().state == 'not_draining'
    assert len(spool.items) == 3
    spool.lock_is_free = True
    until(lambda: not spool.items)


def test_close_waits_for_what_is_in_flight_and_begins_nothing(spool: FakeSpool, start: Start) -> None:
    """Puts that end in time are settled."""
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
    """What hangs is reported to nobody when it comes back after all."""
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
    """A put that hangs is not an outage yet."""
    spool.add()
    store = Hanging()
    uploader = start(store)
    began = time.monotonic()
    assert uploader.drain(0.3) is False
    assert 0.25 < time.monotonic() - began < 60.0
    store.let_go.set()


def test_close_before_open_and_twice_is_fine(spool: FakeSpool) -> None:
    """Idempotent, and nothing to wait for."""
    uploader = Uploader(spool, MemoryStore(), SETTINGS, spool.settle)
    uploader.close(1.0)
    uploader.close(1.0)
    assert uploader.status().state == 'not_draining'


def test_into_a_folder(spool: FakeSpool, start: Start, tmp_path: Path) -> None:
    """With the store that is the default: every object is there with its content."""
    items = spool.add(40, content=b'\xff\xd8 a picture')
    store = open_store(StoreSettings(directory=tmp_path / 'store'), SETTINGS)
    uploader = start(store)
    assert uploader.drain(20.0)
    assert {info.key for info in store.list('b')} == {item.key for item in items}
    assert {store.get('b', item.key) for item in items} == {b'\xff\xd8 a picture'}
    store.close()
