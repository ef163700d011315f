"""Disk space reserved for the spool: on a full disk without it, not even an eviction could be recorded."""

from __future__ import annotations

import errno
import logging
import os
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeVar

from shadowhound_data_logger.core.errors import SpoolError

log = logging.getLogger(__name__)

BALLAST_BYTES: Final = 8 << 20
"""The index's write-ahead log grows to 4 MB before SQLite reuses it; the rest is for rows, folders and the first objects."""
FULL_BELOW_BYTES: Final = 1 << 20
"""A disk with less free space counts as full: SQLite needs some 100 KB at a time."""
T = TypeVar('T')
_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})


class Ballast:
    """A file of zeros that is deleted when the disk is full, and created again when there is space.

    Guarded by the spool's lock.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._exists = False

    def work(self, work: Callable[[], T]) -> T:
        """Call ``work``; if the disk is full, delete the ballast and call it once more. Raises what ``work`` raises."""
        try:
            return work()
        except (OSError, sqlite3.Error) as error:
            if not self._release(error):
                raise
            return work()

    def keep(self, free_bytes: Callable[[], int], reserve: int) -> None:
        """Create the ballast if that leaves ``reserve`` bytes free. Never raises OSError, because the commit has succeeded."""
        if self._exists:
            return
        try:
            if free_bytes() >= reserve + BALLAST_BYTES:
                self._create()
        except OSError as error:
            log.debug('no ballast in %s: %s', self._path, error)

    def _create(self) -> None:
        descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            os.posix_fallocate(descriptor, 0, BALLAST_BYTES)
            self._exists = True
        except OSError:
            os.ftruncate(descriptor, 0)
            raise
        finally:
            os.close(descriptor)

    def _release(self, error: Exception) -> bool:
        """Delete the ballast if the disk is full; whether that freed space for another try."""
        if not is_disk_full(error, self._path.parent):
            return False
        self._exists = False
        try:
            size = self._path.stat().st_size
            self._path.unlink()
        except OSError:
            return False
        log.warning('the disk is full: the spool %s uses its reserve of %d bytes; free some space', self._path.parent, size)
        return size > 0


def unwritable(root: Path, error: OSError | sqlite3.Error) -> SpoolError:
    """The error to show an operator after a failed commit."""
    full = os.strerror(errno.ENOSPC)  # one text for SQLite's and the kernel's error, so that it is logged once
    reason = full if is_disk_full(error, root) else getattr(error, 'strerror', None) or error
    return SpoolError(f'the spool {root} cannot be written: {reason}', remedy='is its disk full, read-only or broken?')


def is_disk_full(error: Exception, folder: Path) -> bool:
    """Whether an error means that the disk is full. SQLite reports an I/O error if it cannot even start its log."""
    if isinstance(error, OSError):
        return error.errno in _FULL
    if 'disk I/O' not in str(error):
        return 'full' in str(error)
    try:
        status = os.statvfs(folder)
    except OSError:
        return False
    return status.f_bavail * status.f_frsize < FULL_BELOW_BYTES
