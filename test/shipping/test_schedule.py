"""What is shipped next, by whom, and when all is delivered."""

from __future__ import annotations

from shipping.drive import Drive

from shadowhound_data_logger.core.errors import BucketMissing, StoreUnavailable
from shadowhound_data_logger.shipping.ahead import FEW, LOOK_EVERY_S
from shadowhound_data_logger.shipping.schedule import Look, Rest

AWAY = StoreUnavailable('Tower is away')


def test_important_objects_go_first_and_each_fourth_is_the_oldest(drive: Drive) -> None:
    """Neither the backlog nor what is live starves, whatever is larger."""
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
    """What a claim costs does not depend on the backlog: a thousand objects take some 2 x 1000 / 60 queries."""
    drive.spool.add(1000)
    for _ in range(1000):
        item = drive.next()
        assert item is not None
        drive.deliver(item)
    assert drive.next() is None
    assert drive.spool.looks < 60


def test_what_is_urgent_overtakes_what_was_looked_up_before(drive: Drive) -> None:
    """A wake makes the next look happen at once."""
    drive.spool.add(100, priority=7)
    assert drive.next()
    urgent = drive.spool.add(priority=0)[0]
    drive.schedule.wake()
    assert drive.next() == urgent


def test_announced_objects_are_shipped_without_a_poll(drive: Drive) -> None:
    """Where nothing else waits, what has just been spooled is known, and goes in its order."""
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
    """What was told of is then a part of the backlog only."""
    assert drive.next() is None
    looks = drive.spool.looks
    drive.schedule.wake(drive.spool.add(FEW))
    assert drive.next()
    assert drive.spool.looks > looks


def test_an_object_is_claimed_once_until_it_is_settled(drive: Drive) -> None:
    """Delivered is not yet durable: until the spool knows, it calls the object pending, and we do not believe it."""
    drive.spool.add()
    item = drive.next()
    assert item is not None
    drive.schedule.wake()
    assert drive.next() is None
    drive.schedule.delivered(item)
    drive.schedule.wake()
    assert drive.next() is None


def test_a_look_that_overlaps_with_a_settlement_does_not_bring_an_object_back(drive: Drive) -> None:
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


def test_only_one_thread_looks_at_a_time(drive: Drive) -> None:
    """The others ship what is there, or rest."""
    drive.spool.add(5)
    assert isinstance(drive.schedule.step(), Look)
    drive.schedule.wake()
    assert isinstance(drive.schedule.step(), Rest)


def test_what_another_process_spooled_is_found_without_a_wake(drive: Drive) -> None:
    """An idle drain looks once a second."""
    assert drive.next() is None
    item = drive.spool.add()[0]
    assert drive.next() is None
    drive.clock.now += LOOK_EVERY_S
    assert drive.next() == item


def test_without_the_drain_lock_nothing_is_shipped(drive: Drive) -> None:
    """Another process drains: every step is a rest, until it is ours."""
    drive.spool.add()
    drive.schedule.activate(False)
    assert drive.next() is None
    assert drive.schedule.drained() is False
    drive.schedule.activate(True)
    assert drive.next()


def test_drained_means_that_nothing_is_pending_and_all_is_durable(drive: Drive) -> None:
    """Not before the spool was asked, and not before every outcome is settled."""
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


def test_waiting_for_the_drain_is_no_use_once_the_store_is_known_to_be_away(drive: Drive) -> None:
    """One failure may be a hiccup, the second is an outage."""
    drive.spool.add(3)
    drive.fail(drive.wait(), AWAY)
    assert isinstance(drive.schedule.drained(), Rest)
    drive.fail(drive.wait(), AWAY)
    assert drive.schedule.drained() is False


def test_waiting_is_no_use_when_only_blocked_buckets_are_left(drive: Drive) -> None:
    """What can be delivered is, then the answer is no."""
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


def test_after_stop_no_step_is_given_but_what_is_in_flight_may_be_reported(drive: Drive) -> None:
    """A shutdown loses no outcome of a put that ends in time."""
    drive.spool.add(2)
    item = drive.next()
    assert item is not None
    drive.schedule.stop()
    assert drive.schedule.step() is None
    drive.deliver(item)
    assert drive.schedule.snapshot().delivered == 1
