"""Which objects of a real spool leave first."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from shipping.test_with_spool import data_object
from stores.memory import MemoryStore

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import SpoolSettings, UploadSettings
from shadowhound_data_logger.core.model import Put, SpooledObject
from shadowhound_data_logger.shipping.uploader import Uploader
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.writer import SpoolWriter


class Ordered(MemoryStore):
    """Remembers in which order objects came."""

    def __init__(self) -> None:
        super().__init__()
        self.came: list[tuple[int, int]] = []
        """(priority, number of the object in the spool)."""

    def put(self, item: SpooledObject) -> Put:
        self.came.append((item.priority, item.id))
        return super().put(item)


@pytest.fixture
def spool(tmp_path: Path) -> Iterator[Spool]:
    opened = Spool(tmp_path / 'spool', SpoolSettings(min_free_bytes=0), SystemClock('boot'), 'thor')
    opened.open()
    yield opened
    opened.close()


def drained(spool: Spool) -> list[tuple[int, int]]:
    """Everything delivered by one thread, in order."""
    store = Ordered()
    writer = SpoolWriter(spool, 0.05)
    uploader = Uploader(spool, store, UploadSettings(threads=1), writer.settle)
    writer.on_commit(settled=uploader.settled)
    writer.open()
    uploader.open()
    try:
        assert uploader.drain(20.0)
    finally:
        uploader.close(5.0)
        writer.close(5.0)
    return store.came


def test_the_most_important_leave_first_and_each_fourth_is_the_oldest(spool: Spool) -> None:
    """Over more objects than one look finds, in the order that the index has."""
    spool.commit([data_object(number, priority=8) for number in range(100)])
    spool.commit([data_object(number, priority=number % 3) for number in range(100, 400)])
    came = drained(spool)
    assert len({number for _, number in came}) == 400
    important = [entry for place, entry in enumerate(came[:300]) if place % 4 != 3]
    assert important == sorted((priority, number) for priority, number in came if priority != 8)[: len(important)]
    assert came[3::4][:100] == [(8, number) for number in range(1, 101)]


def test_a_priority_that_changes_holds_for_what_comes_after(spool: Spool) -> None:
    """What lies in the spool keeps the one it was spooled with."""
    spool.commit([data_object(1, priority=7), data_object(2, priority=5)])
    spool.commit([data_object(3, priority=1)])
    assert [priority for priority, _ in drained(spool)] == [1, 5, 7]
