"""How a backlog and what is live share a store that cannot take both at once, by simulation."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import pytest
from shipping.drive import Drive

LIVE = (3, 3, 4, 6, 7)
"""Priorities of the objects that are made each second, all at one instant."""
SECONDS = 90
IDS = ('more important', 'less important', 'alike')
LONG = pytest.mark.long('a second of CPU or more')


@dataclass(slots=True)
class Shared:
    """Who was served while a backlog was drained."""

    old: list[int] = field(default_factory=list)
    """Priorities of what was delivered of the backlog."""
    live: Counter[int] = field(default_factory=Counter)
    """Priority -> objects delivered of those that were made meanwhile."""
    waits_s: list[float] = field(default_factory=list)


def share(drive: Drive, backlog: tuple[int, ...], per_s: float) -> Shared:
    """A store that takes ``per_s`` objects a second, for a minute and a half; the backlog has these priorities, over and over."""
    for place in range(1200):
        drive.spool.add(priority=backlog[place % len(backlog)])
    found, made = Shared(), dict[int, float]()
    began = drive.clock.now
    while (passed := drive.clock.now - began) < SECONDS:
        while len(made) <= len(LIVE) * int(passed):
            new = [item for priority in LIVE for item in drive.spool.add(priority=priority)]
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
    """Whatever lies in the backlog, all that is made meanwhile is there within two seconds, and the rest is the backlog's."""
    found = share(drive, backlog, per_s=2 * len(LIVE))
    assert found.live.total() >= len(LIVE) * (SECONDS - 2)
    assert max(found.waits_s) <= 2.0
    assert len(found.old) >= len(LIVE) * (SECONDS - 1)


@LONG
@pytest.mark.parametrize(('backlog', 'least'), [((3,), 1 / 2), ((9,), 1 / 8), ((3, 4, 6, 7, 9), 1 / 2)], ids=IDS)
def test_a_store_that_is_too_slow_is_shared_evenly(drive: Drive, backlog: tuple[int, ...], least: float) -> None:
    """Every second turn is that of the live ones, of which no priority goes without; the oldest of the backlog go on leaving.

    What was made meanwhile and could not be delivered soon is backlog as well, and may be more important than the old.
    """
    found = share(drive, backlog, per_s=len(LIVE) * 0.8)
    turns = len(found.old) + found.live.total()
    assert turns // 2 <= found.live.total() <= turns * (1 - least) + 1
    assert found.live[3] == max(found.live.values())
    assert min(found.live[priority] for priority in LIVE) >= turns / 4 / len(set(LIVE))
    assert found.old.count(backlog[-1]) >= turns // 8 // len(backlog)


def test_without_a_backlog_every_turn_is_live(drive: Drive) -> None:
    """Nothing is kept free for what is not there."""
    for _ in range(20):
        new = [item for priority in LIVE for item in drive.spool.add(priority=priority)]
        drive.schedule.wake(new)
        came = [drive.next() for _ in LIVE]
        assert sorted(item.id for item in came if item) == [item.id for item in new]
        for item in new:
            drive.deliver(item)
        assert drive.next() is None
