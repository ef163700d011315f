"""The order of uploads, their threads under a cap and with large objects, probes during an outage, and the drained state."""

from __future__ import annotations

import random
import time
from collections.abc import Iterator
from dataclasses import replace

import pytest
from shipping.drive import CAP_S, Drive
from shipping.fakes import FakeSpool, Time, until
from stores.fake_s3 import FakeS3, served

from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.core.errors import BucketMissing, StoreUnavailable
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.shipping.ahead import FEW, LOOK_EVERY_S
from shadowhound_data_logger.shipping.failures import Verdict
from shadowhound_data_logger.shipping.schedule import LARGE_BYTES, Look, Rest, Schedule, Ship
from shadowhound_data_logger.shipping.uploader import Uploader
from shadowhound_data_logger.stores.s3 import S3Store

AWAY = StoreUnavailable('Tower is away')


def test_important_objects_go_first_and_each_fourth_is_the_oldest(drive: Drive) -> None:
    """Neither the backlog nor live data starves, whichever is larger."""
    old = [item.id for item in drive.spool.add(100, priority=7)]
    new = [item.id for item in drive.spool.add(100, priority=2)]
    order = []
    for _ in range(40):
        item = drive.next()
        assert item is not None
        order.append(item.id)
        drive.deliver(item)
    assert [number for number in order if number in old] == order[3::4] == old[:10]
    assert [number for number in order if number in new] == new[:30]


def test_the_spool_is_polled_for_a_bounded_number(drive: Drive) -> None:
    """The cost of a claim does not depend on the backlog: a thousand objects take about 2 x 1000 / 60 queries."""
    drive.spool.add(1000)
    for _ in range(1000):
        item = drive.next()
        assert item is not None
        drive.deliver(item)
    assert drive.next() is None
    assert drive.spool.looks < 60


def test_urgent_objects_overtake_earlier_ones(drive: Drive) -> None:
    """A wake triggers the next poll immediately."""
    drive.spool.add(100, priority=7)
    assert drive.next()
    urgent = drive.spool.add(priority=0)[0]
    drive.schedule.wake()
    assert drive.next() == urgent


def test_announced_objects_are_shipped_without_a_poll(drive: Drive) -> None:
    """If nothing else is pending, newly spooled objects are known, and are sent in order."""
    assert drive.next() is None
    looks = drive.spool.looks
    later, sooner = drive.spool.add(priority=7)[0], drive.spool.add(priority=2)[0]
    drive.schedule.wake([later, sooner])
    assert drive.schedule.snapshot().ready == 2
    for expected in (sooner, later):
        assert drive.next() == expected
        drive.deliver(expected)
    assert drive.next() is None
    assert drive.spool.looks == looks


def test_a_backlog_is_read_from_the_spool(drive: Drive) -> None:
    """Announced objects are then just a part of the backlog."""
    assert drive.next() is None
    looks = drive.spool.looks
    drive.schedule.wake(drive.spool.add(FEW))
    assert drive.next()
    assert drive.spool.looks > looks


def test_an_object_is_claimed_once_until_it_is_settled(drive: Drive) -> None:
    """Delivered is not durable yet: until the commit the spool lists the object as pending, and the schedule ignores that."""
    drive.spool.add()
    item = drive.next()
    assert item is not None
    drive.schedule.wake()
    assert drive.next() is None
    drive.schedule.delivered(item)
    drive.schedule.wake()
    assert drive.next() is None


def test_a_query_during_a_settlement_does_not_return_the_object_again(drive: Drive) -> None:
    """What a slow query read before the commit is not shipped after it."""
    first, second = drive.spool.add(2)
    assert drive.next() == first
    assert drive.next() == second
    drive.schedule.wake()
    poll = drive.schedule.step()
    assert isinstance(poll, Look)
    drive.schedule.delivered(first)
    drive.schedule.settled([first.id])
    drive.schedule.found([first], [first])
    assert isinstance(drive.schedule.step(), Rest)


def test_only_one_thread_queries_the_spool_at_a_time(drive: Drive) -> None:
    """The others ship what was found, or wait."""
    drive.spool.add(5)
    assert isinstance(drive.schedule.step(), Look)
    drive.schedule.wake()
    assert isinstance(drive.schedule.step(), Rest)


def test_objects_of_another_process_are_found_without_a_wake(drive: Drive) -> None:
    """An idle drain polls once per second."""
    assert drive.next() is None
    item = drive.spool.add()[0]
    assert drive.next() is None
    drive.clock.now += LOOK_EVERY_S
    assert drive.next() == item


def test_without_the_drain_lock_nothing_is_shipped(drive: Drive) -> None:
    """Another process drains: every step waits until it releases the lock."""
    drive.spool.add()
    drive.schedule.activate(False)
    assert drive.next() is None
    assert drive.schedule.drained() is False
    drive.schedule.activate(True)
    assert drive.next()


def test_drained_means_that_nothing_is_pending_and_all_is_durable(drive: Drive) -> None:
    """Not before the spool was queried, and not before every outcome is settled."""
    assert isinstance(drive.schedule.drained(), Rest)
    assert drive.next() is None
    assert drive.schedule.drained() is True
    item = drive.spool.add()[0]
    drive.schedule.wake()
    assert isinstance(drive.schedule.drained(), Rest)
    assert drive.next() == item
    assert isinstance(drive.schedule.drained(), Rest)
    drive.schedule.delivered(item)
    assert isinstance(drive.schedule.drained(), Rest)
    drive.schedule.settled([item.id])
    drive.spool.items.clear()
    assert drive.next() is None
    assert drive.schedule.drained() is True


def test_waiting_for_the_drain_ends_when_the_store_is_unreachable(drive: Drive) -> None:
    """One failure may be transient, the second is an outage."""
    drive.spool.add(3)
    drive.fail(drive.wait(), AWAY)
    assert isinstance(drive.schedule.drained(), Rest)
    drive.fail(drive.wait(), AWAY)
    assert drive.schedule.drained() is False


def test_waiting_for_the_drain_ends_when_only_blocked_buckets_are_left(drive: Drive) -> None:
    """Everything that can be delivered is, then it returns False."""
    drive.spool.add(bucket='missing', priority=0)
    other = drive.spool.add(bucket='there')[0]
    item = drive.next()
    assert item is not None
    drive.fail(item, BucketMissing('x'))
    assert isinstance(drive.schedule.drained(), Rest)
    assert drive.next() == other
    drive.deliver(other)
    assert drive.next() is None
    assert drive.schedule.drained() is False


def test_after_stop_nothing_starts_but_current_uploads_are_reported(drive: Drive) -> None:
    """A shutdown loses no outcome of a put that ends before the deadline."""
    drive.spool.add(2)
    item = drive.next()
    assert item is not None
    drive.schedule.stop()
    assert drive.schedule.step() is None
    drive.deliver(item)
    assert drive.schedule.snapshot().delivered == 1


class Threads:
    """A Schedule with threads whose uploads never finish."""

    def __init__(self, spool: FakeSpool, clock: Time, count: int) -> None:
        self.spool = spool
        self.bytes_per_s = 10.0
        self.schedule = Schedule(count, CAP_S, clock, random.Random(3), lambda seconds: seconds * self.bytes_per_s)
        self.schedule.activate(True)

    def next(self) -> SpooledObject | None:
        """What one more thread ships; None if it waits."""
        self.schedule.wake()
        self.schedule.step()  # a poll
        self.schedule.found(self.spool.pending(100), self.spool.pending(100, oldest=True))
        step = self.schedule.step()
        assert isinstance(step, Ship | Rest)
        return step.item if isinstance(step, Ship) else None


def test_under_a_cap_the_last_thread_is_reserved_for_more_important_objects(spool: FakeSpool, clock: Time) -> None:
    """Four large unimportant bodies would delay an urgent object for minutes."""
    threads = Threads(spool, clock, 4)
    spool.add(10, priority=7)
    assert [threads.next() is not None for _ in range(4)] == [True, True, True, False]
    urgent = spool.add(priority=6)[0]
    assert threads.next() == urgent


def test_equally_important_objects_do_not_take_the_last_thread(spool: FakeSpool, clock: Time) -> None:
    """The most important upload in progress counts."""
    threads = Threads(spool, clock, 3)
    spool.add(priority=2)
    spool.add(10, priority=7)
    assert threads.next() is not None
    assert threads.next() is not None
    spool.add(priority=2)
    assert threads.next() is None


def test_all_threads_ship_while_the_cap_is_not_reached(spool: FakeSpool, clock: Time) -> None:
    """In that case latency takes most of the time."""
    threads = Threads(spool, clock, 4)
    threads.bytes_per_s = 1000.0
    spool.add(10, priority=7)
    assert all(threads.next() for _ in range(4))


def test_one_thread_alone_ships_under_a_cap(spool: FakeSpool, clock: Time) -> None:
    """No thread can be reserved."""
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
    """Current uploads are aborted without an outcome and stay pending: they are sent again."""
    items = spool.add(3, content=bytes(500_000))
    uploader, store = started(spool, server, 0.1)
    until(lambda: uploader.status().sent_bytes)
    began = time.monotonic()
    uploader.close(0.2)
    until(lambda: not any(worker.alive for worker in uploader.workers))
    assert time.monotonic() - began < 90.0  # at this cap it would take two minutes
    assert list(spool.items) == [item.id for item in items]
    assert uploader.status().last_error == ''
    store.close()


def test_the_cap_can_be_changed_while_it_ships(spool: FakeSpool, server: FakeS3) -> None:
    """Immediately; the status shows the current cap and the bytes sent."""
    spool.add(3, content=bytes(100_000))
    uploader, store = started(spool, server, 0.05)
    until(lambda: uploader.status().sent_bytes)
    assert uploader.status().max_mbps == 0.05
    assert uploader.status().delivered == 0
    uploader.set_max_mbps(0.0)
    assert uploader.drain(10.0)
    now = uploader.status()
    assert (now.max_mbps, now.delivered) == (0.0, 3)
    assert now.sent_bytes >= 4 * 100_000  # one more: the check that nothing is overwritten
    uploader.close(5.0)
    store.close()


@pytest.fixture
def large(spool: FakeSpool) -> list[SpooledObject]:
    """Pending slices, more important than anything else."""
    slices = [replace(item, size=LARGE_BYTES) for item in spool.add(6, priority=0)]
    spool.items.update((item.id, item) for item in slices)
    return slices


def test_large_objects_have_half_of_the_threads(spool: FakeSpool, clock: Time, large: list[SpooledObject]) -> None:
    """However many are pending and however important they are; the other half ships small objects."""
    drive = Drive(spool, clock, threads=4)
    assert [drive.next(), drive.next()] == large[:2]
    assert drive.next() is None
    small = spool.add(9, priority=9)
    drive.schedule.wake(small)
    assert all(drive.next() in small for _ in range(2))


def test_the_next_large_object_follows_the_last(spool: FakeSpool, clock: Time, large: list[SpooledObject]) -> None:
    """Its thread is free for another one once it is delivered."""
    drive = Drive(spool, clock, threads=2)
    first = drive.next()
    assert first == large[0]
    assert drive.next() is None
    drive.deliver(first)
    assert drive.next() == large[1]


def test_a_single_thread_ships_large_objects_too(spool: FakeSpool, clock: Time, large: list[SpooledObject]) -> None:
    """No thread can be reserved, and nothing waits indefinitely."""
    assert Drive(spool, clock, threads=1).next() == large[0]


def test_a_failed_large_object_keeps_to_its_share(spool: FakeSpool, clock: Time, large: list[SpooledObject]) -> None:
    """A retry counts as a large object."""
    drive = Drive(spool, clock, threads=2)
    spool.add(50, priority=9)
    first = drive.next()
    assert first == large[0]
    drive.schedule.crashed(Ship(first), RuntimeError('for a while'))
    second = drive.next()
    clock.now += 1000.0
    under_way = [second, drive.next(), drive.next()]
    assert sum(item.size >= LARGE_BYTES for item in under_way if item) == 1


def test_an_unreachable_store_gets_one_probe_at_a_time(drive: Drive) -> None:
    """After a failure all threads wait for the backoff, and then one probes."""
    drive.spool.add(5)
    first = drive.next()
    assert first is not None
    drive.fail(first, AWAY)
    assert drive.next() is None
    drive.wait()
    assert drive.next() is None
    drive.clock.now += 1000.0
    assert drive.next() is None


def test_the_next_probe_is_another_object(drive: Drive) -> None:
    """If it is delivered, the store was reachable, and only the first object waits."""
    drive.spool.add(3)
    first = drive.next()
    assert first is not None
    drive.fail(first, AWAY)
    probe = drive.wait()
    assert probe != first
    drive.deliver(probe)
    assert drive.schedule.snapshot().outage is None
    assert drive.schedule.snapshot().deferred == 1
    assert drive.said() == []


def test_one_failing_object_does_not_block_others(drive: Drive) -> None:
    """It failed again after others succeeded: the breaker stays closed, and the object is retried with growing pauses."""
    bad = drive.spool.add(priority=0)[0]
    drive.spool.add(500)
    tries, opened = 0, 0
    while len(drive.spool.items) > 1:
        item = drive.wait()
        if item == bad:
            tries += 1
            drive.fail(item, AWAY)
            opened += drive.schedule.snapshot().outage is not None
        else:
            drive.clock.now += 0.05
            drive.deliver(item)
    assert 3 <= tries <= 15
    assert opened == 1
    assert drive.said() == []


def test_a_put_that_fails_while_another_succeeds_is_an_error_of_its_object(drive: Drive) -> None:
    """A put that hung for 30 s is no evidence about a store that accepted others in that time."""
    slow, quick = drive.spool.add(2)
    assert drive.next() == slow
    assert drive.next() == quick
    drive.deliver(quick)
    drive.fail(slow, AWAY)
    assert drive.schedule.snapshot().outage is None


def test_an_outage_is_announced_once_and_its_end_once(drive: Drive) -> None:
    """It starts with the second failure, with the remedy; the first success ends it, with its duration."""
    drive.spool.add(5)
    began = drive.clock.now
    for _ in range(20):
        drive.fail(drive.wait(), StoreUnavailable('Tower is away', remedy='switch it on'))
    lasted = drive.clock.now - began
    assert lasted > 60.0
    while drive.spool.items:
        drive.deliver(drive.wait())
    assert drive.said() == [(Verdict.RETRY, None, False), (Verdict.RETRY, None, True)]
    begin, end = drive.notices
    assert begin.text(5) == ('the store is away: Tower is away (switch it on); 5 objects wait in the spool, '
                             'it is tried again until it works')  # fmt: skip
    assert end.lasted_s is not None
    assert end.lasted_s >= lasted
    assert 'delivery continues after' in end.text(4)


def test_concurrent_failures_count_as_one(spool: FakeSpool, clock: Time) -> None:
    """Four threads that lose the store at the same time do not multiply the first pause by sixteen."""
    drive = Drive(spool, clock, threads=4)
    spool.add(10)
    together = [drive.next() for _ in range(4)]
    for item in together:
        assert item is not None
        drive.fail(item, AWAY)
    before = clock.now
    drive.wait()
    assert clock.now - before <= 0.5
    assert len(drive.notices) == 1


def test_the_pause_grows_to_its_maximum(drive: Drive) -> None:
    """It retries indefinitely, at least once per minute."""
    drive.spool.add(3)
    pauses = []
    for _ in range(200):
        failed = drive.clock.now
        item = drive.wait()
        pauses.append(drive.clock.now - failed)
        drive.fail(item, AWAY)
    assert max(pauses[1:3]) <= 1.1
    assert 50.0 < max(pauses[20:]) <= CAP_S + 0.1


@pytest.mark.long('a second of CPU or more')
def test_a_long_outage_touches_few_objects(drive: Drive) -> None:
    """The number of remembered failures stays small, however long it lasts."""
    drive.spool.add(1000)
    for _ in range(800):
        drive.fail(drive.wait(), AWAY)
    assert drive.schedule.snapshot().deferred < 200
    while drive.spool.items:
        drive.deliver(drive.wait())


def test_a_single_object_probes_the_store(drive: Drive) -> None:
    """One object and an unreachable store: it is sent as soon as the breaker allows it."""
    item = drive.spool.add()[0]
    for _ in range(3):
        assert drive.wait() == item
        drive.fail(item, AWAY)
    assert drive.wait() == item
    drive.deliver(item)
    assert drive.next() is None
    assert drive.schedule.drained() is True
