"""The two connections of one process to the spool's index: one writes, under a lock; the other reads, and waits for no commit.

When the index file is deleted while processes run, the first of them to commit puts it back, and the others open the copy.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.spool.index import Index, lost

log = logging.getLogger(__name__)


class Connections:
    """The index of a spool, opened once to write and once to read.

    Lifecycle: new; ``Spool.open`` opens both; ``keep_in_place`` before each commit; close once. ``lock`` guards ``writing``; any
    thread may use ``reading``.
    """

    def __init__(self, root: Path) -> None:
        self.lock = threading.Lock()
        self._path = root / 'index.db'
        self._recovery_lock = root / 'recovery.lock'
        self.writing = Index(self._path)
        self.reading = Index(self._path, read_only=True)
        self.session = 0
        """The number of this process's session; 0 while the spool is not open."""
        self._replaced: list[Index] = []
        """Connections to deleted files, which other threads may still be reading."""

    @contextmanager
    def transaction(self) -> Iterator[Index]:
        """The writing index, under the lock and in a transaction. Raises OSError, sqlite3.Error."""
        with self.lock, self.writing.transaction():
            yield self.writing

    @contextmanager
    def moving_files(self) -> Iterator[Index]:
        """The writing index, under the lock, while no process recovers the spool: it would adopt files of a running change."""
        with flock(self._recovery_lock), self.lock:
            yield self.writing

    @contextmanager
    def snapshot(self) -> Iterator[Index]:
        """A further connection; everything read through it is of one instant. Raises SpoolError, sqlite3.Error."""
        with closing(Index(self._path, read_only=True)) as index:
            index.open()
            with index.snapshot():
                yield index

    @contextmanager
    def lock_within(self, seconds: float) -> Iterator[None]:
        """The lock. Raises SpoolError where a commit does not release it in time: the next startup then ends the session."""
        if not self.lock.acquire(timeout=seconds):
            raise SpoolError(f'the spool {self._path.parent} cannot be closed: its disk does not answer', remedy='is it broken?')
        try:
            yield
        finally:
            self.lock.release()

    def keep_in_place(self) -> None:
        """Put back a deleted index, or open the copy that another process has put back.

        Raises sqlite3.DatabaseError where another index is in its place, OSError.
        """
        if not self.session or self.writing.is_in_place():
            return
        with self.moving_files():
            if self.writing.is_in_place():
                return
            copy, view = Index(self._path), Index(self._path, read_only=True)
            try:
                first = self.writing.accounts.first_session()
                if not self._path.exists():
                    self.writing.put_back()
                    log.error('the spool index %s was deleted and has been restored', self._path)
                copy.open()
                is_copy = copy.accounts.first_session() == first and self.session in copy.accounts.sessions(ended=False)
                view.open()
            except sqlite3.Error as error:
                copy.close()
                raise lost(self._path) from error
            if not is_copy:
                copy.close()
                view.close()
                raise lost(self._path)
            self.writing.close()
            self.writing = copy
            self._replaced.append(self.reading)
            self.reading = view

    def close(self) -> None:
        """Close all connections; idempotent."""
        for index in (*self._replaced, self.reading, self.writing):
            index.close()
        self._replaced.clear()
