"""Delivery under a cap: a thread is kept for what is more important, the cap can change, and a stop does not wait for it."""

from __future__ import annotations

import random
import time
from collections.abc import Iterator

import pytest
from shipping.drive import CAP_S
from shipping.fakes import FakeSpool, Time, until
from stores.fake_s3 import FakeS3, served

from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.shipping.schedule import Rest, Schedule, Ship
from shadowhound_data_logger.shipping.uploader import Uploader
from shadowhound_data_logger.stores.s3 import S3Store


class Threads:
    """A Schedule whose threads ship without ever getting done."""

    def __init__(self, spool: FakeSpool, clock: Time, count: int) -> None:
        self.spool = spool
        self.bytes_per_s = 10.0
        self.schedule = Schedule(count, CAP_S, clock, random.Random(3), lambda seconds: seconds * self.bytes_per_s)
        self.schedule.activate(True)

    def next(self) -> SpooledObject | None:
        """What one more thread ships; None when it rests."""
        self.schedule.wake()
        self.schedule.step()  # a look
        self.schedule.found(self.spool.pending(100), self.spool.pending(100, oldest=True))
        step = self.schedule.step()
        assert isinstance(step, Ship | Rest)
        return step.item if isinstance(step, Ship) else None


def test_under_a_cap_the_last_thread_is_kept_for_what_is_more_important(spool: FakeSpool, clock: Time) -> None:
    """Four large bodies of no importance would keep an urgent object waiting for minutes."""
    threads = Threads(spool, clock, 4)
    spool.add(10, priority=7)
    assert [threads.next() is not None for _ in range(4)] == [True, True, True, False]
    urgent = spool.add(priority=6)[0]
    assert threads.next() == urgent


def test_what_is_as_important_as_what_is_under_way_does_not_take_the_last_thread(spool: FakeSpool, clock: Time) -> None:
    """The most important one under way counts."""
    threads = Threads(spool, clock, 3)
    spool.add(priority=2)
    spool.add(10, priority=7)
    assert threads.next() is not None
    assert threads.next() is not None
    spool.add(priority=2)
    assert threads.next() is None


def test_as_long_as_the_cap_has_little_to_do_all_threads_ship(spool: FakeSpool, clock: Time) -> None:
    """Then the round trips are what takes the time."""
    threads = Threads(spool, clock, 4)
    threads.bytes_per_s = 1000.0
    spool.add(10, priority=7)
    assert all(threads.next() for _ in range(4))


def test_one_thread_alone_ships_under_a_cap(spool: FakeSpool, clock: Time) -> None:
    """There is none to be kept."""
    threads = Threads(spool, clock, 1)
    spool.add(2)
    assert threads.next() is not None


@pytest.fixture
def server() -> Iterator[FakeS3]:
    with served(FakeS3()) as opened:
        yield opened


def started(spool: FakeSpool, server: FakeS3, max_mbps: float) -> tuple[Uploader, S3Store]:
    settings = UploadSettings(threads=3, max_backoff_s=0.1, max_mbps=max_mbps)
    store = S3Store(StoreSettings(endpoint_url=server.url, access_key_id='a', secret_access_key='b'), settings)
    store.open()
    spool.uploader = Uploader(spool, store, settings, spool.settle)
    spool.uploader.open()
    return spool.uploader, store


def test_a_stop_does_not_wait_for_the_cap(spool: FakeSpool, server: FakeS3) -> None:
    """What is under way is given up, reported to nobody and still pending: it is sent again."""
    items = spool.add(3, content=bytes(500_000))
    uploader, store = started(spool, server, 0.1)
    until(lambda: uploader.status().sent_bytes)
    began = time.monotonic()
    uploader.close(0.2)
    until(lambda: not any(worker.alive for worker in uploader.workers))
    assert time.monotonic() - began < 90.0  # at this cap it would be two minutes
    assert list(spool.items) == [item.id for item in items]
    assert uploader.status().last_error == ''
    store.close()


def test_the_cap_can_be_changed_while_it_ships(spool: FakeSpool, server: FakeS3) -> None:
    """At once; the status says which one holds and how much was sent."""
    spool.add(3, content=bytes(100_000))
    uploader, store = started(spool, server, 0.05)
    until(lambda: uploader.status().sent_bytes)
    assert uploader.status().max_mbps == 0.05
    assert uploader.status().delivered == 0
    uploader.set_max_mbps(0.0)
    assert uploader.drain(10.0)
    now = uploader.status()
    assert (now.max_mbps, now.delivered) == (0.0, 3)
    assert now.sent_bytes >= 4 * 100_000  # one more: the proof that nothing is overwritten
    uploader.close(5.0)
    store.close()
