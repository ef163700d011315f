"""A spool in a separate folder, with a clock controlled by the test."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from spool.making import FakeClock, files, make, new_spool, put, settle

from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.spool.spool import Spool

Open = Callable[..., Spool]
Moments = Callable[[Callable[[], None]], list[Path]]
CALLS = frozenset({
    'open', 'write', 'flush', 'fsync', 'link', 'replace', 'unlink', 'mkdir', 'rmdir', 'setxattr', 'flock', 'close', 'execute',
    'executemany', 'executescript',
})  # fmt: skip
"""Built-in functions that change a spool, or run between two that do."""


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """The spool's folder."""
    return tmp_path / 'spool'


@pytest.fixture
def clock() -> FakeClock:
    """A clock that stops until the test moves it."""
    return FakeClock()


@pytest.fixture
def opened(root: Path, clock: FakeClock) -> Iterator[Open]:
    """Opens spools on ``root`` (several act as separate processes) and closes those left open."""
    spools: list[Spool] = []

    def open_one(robot: str = 'thor', **settings: float) -> Spool:
        spool = new_spool(root, clock, robot, **settings)
        spools.append(spool)
        spool.open()
        return spool

    yield open_one
    for spool in spools:
        spool.close()


@pytest.fixture
def spool(opened: Open) -> Spool:
    """An open, empty spool."""
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


@pytest.fixture
def moments(root: Path, tmp_path: Path) -> Moments:
    """Copies of the spool as a kill at each step of an operation would leave it: one before each system call that changes it.

    Whatever the kernel has received survives a killed process, and nothing else; so the copies are made during the operation.
    The last copy is that of a process that finished.
    """

    def copies(work: Callable[[], None]) -> list[Path]:
        out = tmp_path / 'moments'
        made: list[Path] = []
        before: dict[str, bytes] = {}

        def poll() -> None:
            nonlocal before
            now = {str(path): path.read_bytes() for path in root.rglob('*') if path.is_file() and path.suffix != '.db-shm'}
            if now != before:
                before = now
                made.append(Path(shutil.copytree(root, out / f'{len(made):03d}')))

        def watch(_: FrameType, event: str, called: Any) -> None:
            if event == 'c_call' and called.__name__ in CALLS:
                poll()

        sys.setprofile(watch)
        try:
            work()
        finally:
            sys.setprofile(None)
        poll()
        assert len(made) > 12
        return made

    return copies
