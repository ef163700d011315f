"""Space reserved for the spool on a disk that others fill: without it, not even an eviction could be recorded."""

from __future__ import annotations

import errno
import logging
import os
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeVar

log = logging.getLogger(__name__)

BALLAST_BYTES: Final = 8 << 20
"""The index's log grows to 4 MB before it is written over; the rest is for rows, folders and the first objects."""
BEGIN_BYTES: Final = 1 << 20
"""Less than this is none: SQLite needs some 100 KB at once."""
T = TypeVar('T')
_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})


class Ballast:
    """Keeps space for a full disk: a file of zeros, deleted when the disk is full and made again when there is space.

    Guarded by the spool's lock.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._there = False

    def work(self, work: Callable[[], T]) -> T:
        """Do something; where the disk is full, give up the ballast and do it once again. Raises what the work raises."""
        try:
            return work()
        except (OSError, sqlite3.Error) as error:
            if not self._gives_up(error):
                raise
            return work()

    def keep(self, free_bytes: Callable[[], int], reserve: int) -> None:
        """Have it, if there is more space than is to be left free. Never raises OSError: what was committed is committed."""
        if self._there:
            return
        try:
            if free_bytes() >= reserve + BALLAST_BYTES:
                self._make()
        except OSError as error:
            log.debug('no ballast in %s: %s', self._path, error)

    def _make(self) -> None:
        descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            os.posix_fallocate(descriptor, 0, BALLAST_BYTES)
            self._there = True
        except OSError:
            os.ftruncate(descriptor, 0)
            raise
        finally:
            os.close(descriptor)

    def _gives_up(self, error: Exception) -> bool:
        """Whether the disk is full, and there was a ballast that makes trying again worth while."""
        if not is_disk_full(error, self._path.parent):
            return False
        self._there = False
        try:
            size = self._path.stat().st_size
            self._path.unlink()
        except OSError:
            return False
        log.warning('the disk is full: the spool %s gives up its ballast of %d bytes', self._path.parent, size)
        return size > 0


def is_disk_full(error: Exception, folder: Path) -> bool:
    """Whether an error means that the disk is full. SQLite calls it an I/O error where its log cannot even be begun."""
    if isinstance(error, OSError):
        return error.errno in _FULL
    if 'disk I/O' not in str(error):
        return 'full' in str(error)
    try:
        status = os.statvfs(folder)
    except OSError:
        return False
    return status.f_bavail * status.f_frsize < BEGIN_BYTES
