"""Threads of delivery that die: what they held is sent again, and the death is counted."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from shipping.fakes import FakeSpool, until
from stores.memory import MemoryStore

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.model import Put, SpooledObject, State
from shadowhound_data_logger.shipping.uploader import Uploader


class Deadly(MemoryStore):
    """Puts of one object raise what is in ``deaths``."""

    def __init__(self, victim: int = 0) -> None:
        super().__init__()
        self.victim = victim
        self.deaths: list[BaseException] = [SystemExit(1), MemoryError()]

    def put(self, item: SpooledObject) -> Put:
        if item.id == self.victim and self.deaths:
            raise self.deaths.pop()
        return super().put(item)


@pytest.fixture
def start(spool: FakeSpool) -> Iterator[Callable[[MemoryStore], Uploader]]:
    """Opens an uploader over the fake spool, and closes it."""
    opened: list[Uploader] = []

    def start(store: MemoryStore) -> Uploader:
        spool.uploader = Uploader(spool, store, UploadSettings(threads=3, max_backoff_s=0.1), spool.settle, rng=random.Random(5))
        opened.append(spool.uploader)
        spool.uploader.open()
        return spool.uploader

    yield start
    for uploader in opened:
        uploader.close(5.0)


def test_a_thread_that_dies_in_a_put(spool: FakeSpool, start: Callable[[MemoryStore], Uploader]) -> None:
    """What it held stays pending and is sent again, by the same thread or another; each death is counted."""
    victim, *rest = spool.add(20)
    uploader = start(Deadly(victim.id))
    until(lambda: not spool.items)
    assert spool.ended_as(State.DELIVERED) == [victim.id, *(item.id for item in rest)]
    assert sum(worker.failures for worker in uploader.workers) == uploader.status().worker_failures == 2


def test_a_drain_lock_that_cannot_be_opened(spool: FakeSpool, start: Callable[[MemoryStore], Uploader],
                                               monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    """Nothing is sent meanwhile, and it is asked for again."""
    spool.add(3)
    failures, lock = [SystemExit(1), OSError('no locks available')], spool.drain_lock

    def failing() -> Any:
        if failures:
            raise failures.pop()
        return lock()

    monkeypatch.setattr(spool, 'drain_lock', failing)
    uploader = start(MemoryStore())
    until(lambda: not spool.items)
    keeper = uploader.workers[0]
    assert (keeper.name, keeper.failures, keeper.last_error) == ('upload-lock', 2, 'SystemExit: 1')
