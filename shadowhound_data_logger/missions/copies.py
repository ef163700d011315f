"""Files that a mission keeps until they are sent: complete or not at all, and never on a disk that is almost full."""

from __future__ import annotations

import os
import shutil
import threading
from collections import deque
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.errors import Rejected

MIN_FREE_BYTES: Final = 64 << 20
"""Below it no file is kept: the journal needs the rest."""
COPY_BYTES: Final = 1 << 20
SPARES: Final = 4
"""At 10 Hz, one is needed between two syncs."""


class Spares:
    """Frames of a mission, in files that were made before they are needed.

    After each sync, creating the next file in a folder takes ext4 longer than writing a frame (its journal copies what it is
    committing), so the thread that syncs does it. Lifecycle: New; ``write`` and ``fill`` from any thread; close once.
    ``_lock`` guards the files that were made ahead.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._numbers = count(1)
        self._ready: deque[tuple[Path, int]] = deque()
        self._lock = threading.Lock()
        self._is_open = True

    def write(self, data: memoryview) -> str:
        """The name of a file with this content. Raises OSError, and then nothing is there."""
        _check_room(self._folder)
        try:
            target, descriptor = self._ready.popleft()
        except IndexError:
            target, descriptor = self._new()
        _write(target, descriptor, data)
        return target.name

    def fill(self) -> None:
        """Make some ahead if there is room."""
        with self._lock, suppress(OSError):
            while self._is_open and len(self._ready) < SPARES:
                _check_room(self._folder)
                self._ready.append(self._new())

    def close(self) -> None:
        """Remove unused files; idempotent."""
        with self._lock:
            self._is_open = False
            while self._ready:
                target, descriptor = self._ready.popleft()
                os.close(descriptor)
                target.unlink(missing_ok=True)

    def forget(self) -> None:
        """In a forked child: close what the parent opened."""
        self._lock, self._is_open = threading.Lock(), False
        while self._ready:
            os.close(self._ready.popleft()[1])

    def _new(self) -> tuple[Path, int]:
        target = self._folder / f'{next(self._numbers):08d}.jpg'
        return target, _create(target)


def write(target: Path, data: memoryview) -> None:
    """Raises OSError, and then nothing is there."""
    _check_room(target.parent)
    _write(target, _create(target), data)


def _create(target: Path) -> int:
    return os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)


def _write(target: Path, descriptor: int, data: memoryview) -> None:
    try:
        written = os.write(descriptor, data)
    except OSError:
        target.unlink()
        raise
    finally:
        os.close(descriptor)
    if written != len(data):
        target.unlink()
        raise OSError(f'only a part of {target} was written')


def copy(source: str | os.PathLike[str], target: Path) -> None:
    """Raises Rejected for what is not a file that can be read, OSError when there is no room; then nothing is there."""
    try:
        if not os.path.isfile(source):  # noqa: PTH113 - a text or a Path; reading a pipe would not end
            raise FileNotFoundError(f'{source!s:.200} is not a file')
        opened = open(source, 'rb')  # noqa: PTH123, SIM115 - closed below
    except (OSError, TypeError, ValueError) as error:
        raise Rejected('no_file', str(error)) from error
    with opened:
        _check_room(target.parent)
        try:
            with os.fdopen(_create(target), 'wb') as file:
                shutil.copyfileobj(opened, file, COPY_BYTES)
        except OSError:
            target.unlink(missing_ok=True)
            raise


def _check_room(folder: Path) -> None:
    status = os.statvfs(folder)
    if status.f_bavail * status.f_frsize < MIN_FREE_BYTES:
        raise OSError(f'the disk of {folder} is full')
