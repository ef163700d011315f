"""Writes the files that a mission keeps until they are sent: completely or not at all, and never to an almost full disk."""

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
"""With less free space no file is written: the journal needs the rest."""
COPY_BYTES: Final = 1 << 20
PREALLOCATED: Final = 4
"""Files. At 10 Hz, one is used between two syncs."""


class PreallocatedFiles:
    """Writes the frames of a mission to files that were created in advance.

    After a sync, ext4 takes longer to create the next file in a folder than to write a frame (its journal copies the data that it
    is committing), so the thread that syncs creates the files. Lifecycle: New; ``write`` and ``fill`` from any thread; close
    once. ``_lock`` guards the files created in advance.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._numbers = count(1)
        self._ready: deque[tuple[Path, int]] = deque()
        self._lock = threading.Lock()
        self._is_open = True

    def write(self, data: memoryview) -> str:
        """Write a file and return its name. Raises OSError, and then leaves no file behind."""
        _check_free_space(self._folder)
        try:
            target, descriptor = self._ready.popleft()
        except IndexError:
            target, descriptor = self._create()
        _write(target, descriptor, data)
        return target.name

    def fill(self) -> None:
        """Create files in advance if there is free space."""
        with self._lock, suppress(OSError):
            while self._is_open and len(self._ready) < PREALLOCATED:
                _check_free_space(self._folder)
                self._ready.append(self._create())

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

    def _create(self) -> tuple[Path, int]:
        target = self._folder / f'{next(self._numbers):08d}.jpg'
        return target, _create(target)


def write(target: Path, data: memoryview) -> None:
    """Write a new file. Raises OSError, and then leaves no file behind."""
    _check_free_space(target.parent)
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
        raise OSError(f'{target} was only partly written')


def copy(source: str | os.PathLike[str], target: Path) -> None:
    """Copy a file. Raises Rejected if ``source`` is not a readable file, OSError if the disk is full; then leaves no copy."""
    try:
        if not os.path.isfile(source):  # noqa: PTH113 - a text or a Path; reading a pipe would not end
            raise FileNotFoundError(f'{source!s:.200} is not a file')
        opened = open(source, 'rb')  # noqa: PTH123, SIM115 - closed below
    except (OSError, TypeError, ValueError) as error:
        raise Rejected('no_file', str(error)) from error
    with opened:
        _check_free_space(target.parent)
        try:
            with os.fdopen(_create(target), 'wb') as file:
                shutil.copyfileobj(opened, file, COPY_BYTES)
        except OSError:
            target.unlink(missing_ok=True)
            raise


def _check_free_space(folder: Path) -> None:
    status = os.statvfs(folder)
    if status.f_bavail * status.f_frsize < MIN_FREE_BYTES:
        raise OSError(f'the disk of {folder} has less than {MIN_FREE_BYTES >> 20} MiB free')
