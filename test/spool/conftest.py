"""A spool in a folder of its own, with a clock that the test owns."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from spool.making import FakeClock, files, make, new_spool, put, settle

from shadowhound_data_logger.model import State
from shadowhound_data_logger.spool.spool import Spool

Open = Callable[..., Spool]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Where the spool is."""
    return tmp_path / 'spool'


@pytest.fixture
def clock() -> FakeClock:
    """A clock that stands still until it is moved."""
    return FakeClock()


@pytest.fixture
def opened(root: Path, clock: FakeClock) -> Iterator[Open]:
    """Opens spools on ``root`` (several: those of other processes) and closes what is left open."""
    spools: list[Spool] = []

    def open_one(**settings: float) -> Spool:
        spool = new_spool(root, clock, **settings)
        spools.append(spool)
        spool.open()
        return spool

    yield open_one
    for spool in spools:
        spool.close()


@pytest.fixture
def spool(opened: Open) -> Spool:
    """An open spool, empty."""
    return opened()


@pytest.fixture
def used(opened: Open, root: Path) -> dict[str, bytes]:
    """A closed spool with objects in every state; returns its files."""
    spool = opened()
    items = put(spool, *(make(f'thor/a/{number}.jpg', b'%d' % number, samples=2, priority=number) for number in range(6)))
    put(spool, make('thor/held.jpg', b'held', held='clock'), make('thor/book.json', b'{}', topic=None, protected=True))
    settle(spool, items[0], State.DELIVERED)
    settle(spool, items[1], State.QUARANTINED, 'refused')
    spool.close()
    return files(root)
