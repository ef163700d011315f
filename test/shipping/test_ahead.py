"""New data and a backlog are delivered side by side, also by a store that is too slow for both."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import pytest
from shipping.drive import Drive

from shadowhound_data_logger.core.errors import BucketMissing, StoreUnavailable
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.shipping.ahead import LIVE


def shipped(drive: Drive, count: int) -> list[SpooledObject]:
    """The next objects, each delivered immediately."""
    found = []
    for _ in range(count):
        item = drive.next()
        assert item is not None
        drive.deliver(item)
        found.append(item)
    return found


def test_new_objects_are_sent_next_to_a_backlog(drive: Drive) -> None:
    """Every second turn, while there are any: alternately the most important, and the priority that has waited the longest."""
    old = drive.spool.add(200, priority=2)
    drive.schedule.wake(clouds := drive.spool.add(3, priority=7))
    drive.schedule.wake(poses := drive.spool.add(2, priority=3))
    order = shipped(drive, 30)
    assert order[1:11:2] == [poses[0], clouds[0], poses[1], clouds[1], clouds[2]]
    assert [item for item in order if item not in (*poses, *clouds)] == old[:25]


def test_live_data_keep_up_while_a_backlog_is_delivered(drive: Drive) -> None:
    """At a tenth of the store's rate the newest are delivered immediately, and the backlog gets the rest."""
    old = {item.id for item in drive.spool.add(1000, priority=2)}
    waited = []
    for _ in range(50):
        drive.schedule.wake(new := drive.spool.add(priority=9))
        order = shipped(drive, 10)
        waited.append(new[0] in order)
        assert sum(item.id in old for item in order) >= 8
    assert sum(waited) >= 48


def test_only_a_few_of_the_newest_are_remembered(drive: Drive) -> None:
    """More than are remembered at the same time are delivered in the other orders."""
    drive.schedule.wake(new := drive.spool.add(10 * LIVE))
    assert Counter(item.id for item in shipped(drive, len(new))) == Counter(item.id for item in new)
    assert drive.next() is None


def test_a_new_object_is_claimed_once(drive: Drive) -> None:
    """An object announced as new after a poll has found it is not shipped twice."""
    (item,) = drive.spool.add()
    assert drive.next() == item
    drive.schedule.wake([item])
    assert drive.next() is None
    drive.deliver(item)
    assert drive.next() is None


def test_a_new_object_of_a_bucket_that_takes_nothing_waits(drive: Drive) -> None:
    """It is not tried before the bucket's next probe, and is sent as soon as that succeeds."""
    (first,) = drive.spool.add()
    assert drive.next() == first
    drive.fail(first, BucketMissing('no such bucket'))
    drive.schedule.wake(drive.spool.add(20))
    assert drive.next() is None
    drive.deliver(drive.wait())
    assert len({item.id for item in shipped(drive, 20)}) == 20
    assert drive.next() is None


def test_new_objects_do_not_probe_an_unreachable_store(drive: Drive) -> None:
    """One object is tried at a time, whatever arrives."""
    (first,) = drive.spool.add()
    assert drive.next() == first
    drive.fail(first, StoreUnavailable('Tower is away'))
    drive.schedule.wake(drive.spool.add(20))
    assert drive.next() is None
    probe = drive.wait()
    assert drive.next() is None
    drive.deliver(probe)
    assert len({item.id for item in shipped(drive, 20)}) == 20


LIVE_PRIORITY = (3, 3, 4, 6, 7)
"""Priorities of the objects created each second, all at the same time."""
SECONDS = 90
IDS = ('more important', 'less important', 'alike')
LONG = pytest.mark.long('a second of CPU or more')


@dataclass(slots=True)
class Shared:
    """The deliveries while a backlog was drained."""

    old: list[int] = field(default_factory=list)
    """Priorities of the delivered backlog objects."""
    live: Counter[int] = field(default_factory=Counter)
    """Priority -> delivered objects among those created in that time."""
    waits_s: list[float] = field(default_factory=list)


def share(drive: Drive, backlog: tuple[int, ...], per_s: float) -> Shared:
    """A store that accepts ``per_s`` objects per second, for 90 s; the backlog cycles through these priorities."""
    for place in range(1200):
        drive.spool.add(priority=backlog[place % len(backlog)])
    found, made = Shared(), dict[int, float]()
    began = drive.clock.now
    while (passed := drive.clock.now - began) < SECONDS:
        while len(made) <= len(LIVE_PRIORITY) * int(passed):
            new = [item for priority in LIVE_PRIORITY for item in drive.spool.add(priority=priority)]
            made.update((item.id, drive.clock.now) for item in new)
            drive.schedule.wake(new)
        item = drive.next()
        drive.clock.now += 1 / per_s
        if item is None:
            continue
        drive.deliver(item)
        if item.id in made:
            found.live[item.priority] += 1
            found.waits_s.append(drive.clock.now - made[item.id])
        else:
            found.old.append(item.priority)
    return found


@pytest.mark.parametrize('backlog', [pytest.param((3,), marks=LONG), pytest.param((9,), marks=LONG), (3, 4, 6, 7, 9)], ids=IDS)
def test_a_store_of_twice_the_rate_keeps_up_with_what_is_live(drive: Drive, backlog: tuple[int, ...]) -> None:
    """Whatever the backlog contains, each new object is delivered within two seconds, and the backlog gets the rest."""
    found = share(drive, backlog, per_s=2 * len(LIVE_PRIORITY))
    assert found.live.total() >= len(LIVE_PRIORITY) * (SECONDS - 2)
    assert max(found.waits_s) <= 2.0
    assert len(found.old) >= len(LIVE_PRIORITY) * (SECONDS - 1)


@LONG
@pytest.mark.parametrize(('backlog', 'least'), [((3,), 1 / 2), ((9,), 1 / 8), ((3, 4, 6, 7, 9), 1 / 2)], ids=IDS)
def test_a_store_that_is_too_slow_is_shared_evenly(drive: Drive, backlog: tuple[int, ...], least: float) -> None:
    """Every second turn is for live objects, with no priority starved; the oldest of the backlog continue to be sent.

    New objects that could not be delivered soon become backlog as well, and may be more important than the old.
    """
    found = share(drive, backlog, per_s=len(LIVE_PRIORITY) * 0.8)
    turns = len(found.old) + found.live.total()
    assert turns // 2 <= found.live.total() <= turns * (1 - least) + 1
    assert found.live[3] == max(found.live.values())
    assert min(found.live[priority] for priority in LIVE_PRIORITY) >= turns / 4 / len(set(LIVE_PRIORITY))
    assert found.old.count(backlog[-1]) >= turns // 8 // len(backlog)


def test_without_a_backlog_every_turn_is_live(drive: Drive) -> None:
    """No turns are reserved for a missing backlog."""
    for _ in range(20):
        new = [item for priority in LIVE_PRIORITY for item in drive.spool.add(priority=priority)]
        drive.schedule.wake(new)
        came = [drive.next() for _ in LIVE_PRIORITY]
        assert sorted(item.id for item in came if item) == [item.id for item in new]
        for item in new:
            drive.deliver(item)
        assert drive.next() is None
