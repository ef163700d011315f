"""A spool in a folder of its own, with a clock that the test owns."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from spool.making import FakeClock, new_spool

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
