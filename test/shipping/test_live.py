"""What is made while a backlog is delivered: it is served beside it, and the backlog beside what is live."""

from __future__ import annotations

from collections import Counter

from shipping.drive import Drive

from shadowhound_data_logger.core.errors import BucketMissing, StoreUnavailable
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.shipping.ahead import LIVE


def shipped(drive: Drive, count: int) -> list[SpooledObject]:
    """The next so many, each delivered at once."""
    found = []
    for _ in range(count):
        item = drive.next()
        assert item is not None
        drive.deliver(item)
        found.append(item)
    return found


def test_new_objects_are_sent_next_to_a_backlog(drive: Drive) -> None:
    """Every second turn, as long as some is there: in turns the most important, and the priority that waits for the longest."""
    old = drive.spool.add(200, priority=2)
    drive.schedule.wake(clouds := drive.spool.add(3, priority=7))
    drive.schedule.wake(poses := drive.spool.add(2, priority=3))
    order = shipped(drive, 30)
    assert order[1:11:2] == [poses[0], clouds[0], poses[1], clouds[1], clouds[2]]
    assert [item for item in order if item not in (*poses, *clouds)] == old[:25]


def test_live_data_keep_up_while_a_backlog_is_delivered(drive: Drive) -> None:
    """At a tenth of the store's rate the newest are delivered at once, and the backlog gets the rest."""
    old = {item.id for item in drive.spool.add(1000, priority=2)}
    waited = []
    for _ in range(50):
        drive.schedule.wake(new := drive.spool.add(priority=9))
        order = shipped(drive, 10)
        waited.append(new[0] in order)
        assert sum(item.id in old for item in order) >= 8
    assert sum(waited) >= 48


def test_few_of_the_newest_are_remembered(drive: Drive) -> None:
    """More at once than are remembered are delivered all the same, in the other orders."""
    drive.schedule.wake(new := drive.spool.add(10 * LIVE))
    assert Counter(item.id for item in shipped(drive, len(new))) == Counter(item.id for item in new)
    assert drive.next() is None


def test_a_new_object_is_claimed_once(drive: Drive) -> None:
    """Told of as new after a look has found it already, it is not shipped twice."""
    (item,) = drive.spool.add()
    assert drive.next() == item
    drive.schedule.wake([item])
    assert drive.next() is None
    drive.deliver(item)
    assert drive.next() is None


def test_a_new_object_of_a_bucket_that_takes_nothing_waits(drive: Drive) -> None:
    """It is not tried before the bucket's next probe, and goes on as soon as that gets through."""
    (first,) = drive.spool.add()
    assert drive.next() == first
    drive.fail(first, BucketMissing('no such bucket'))
    drive.schedule.wake(drive.spool.add(20))
    assert drive.next() is None
    drive.deliver(drive.wait())
    assert len({item.id for item in shipped(drive, 20)}) == 20
    assert drive.next() is None


def test_new_objects_do_not_probe_an_unreachable_store(drive: Drive) -> None:
    """One object is tried at a time, whatever comes."""
    (first,) = drive.spool.add()
    assert drive.next() == first
    drive.fail(first, StoreUnavailable('Tower is away'))
    drive.schedule.wake(drive.spool.add(20))
    assert drive.next() is None
    probe = drive.wait()
    assert drive.next() is None
    drive.deliver(probe)
    assert len({item.id for item in shipped(drive, 20)}) == 20
