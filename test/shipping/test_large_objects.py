"""Slices in the queue: large objects never have all threads, so what is live waits for none of them."""

from __future__ import annotations

from dataclasses import replace

import pytest
from shipping.drive import Drive
from shipping.fakes import FakeSpool, Time

from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.shipping.schedule import LARGE_BYTES, Ship


@pytest.fixture
def large(spool: FakeSpool) -> list[SpooledObject]:
    """Slices that wait, more important than anything else."""
    slices = [replace(item, size=LARGE_BYTES) for item in spool.add(6, priority=0)]
    spool.items.update((item.id, item) for item in slices)
    return slices


def test_large_objects_have_half_of_the_threads(spool: FakeSpool, clock: Time, large: list[SpooledObject]) -> None:
    """However many wait and however important they are; the other half ships what is small."""
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
    """There is none to be kept, and nothing waits for ever."""
    assert Drive(spool, clock, threads=1).next() == large[0]


def test_a_failed_large_object_keeps_to_its_share(spool: FakeSpool, clock: Time, large: list[SpooledObject]) -> None:
    """A retry is a large object as well."""
    drive = Drive(spool, clock, threads=2)
    spool.add(50, priority=9)
    first = drive.next()
    assert first == large[0]
    drive.schedule.crashed(Ship(first), RuntimeError('for a while'))
    second = drive.next()
    clock.now += 1000.0
    under_way = [second, drive.next(), drive.next()]
    assert sum(item.size >= LARGE_BYTES for item in under_way if item) == 1
