"""The delivered objects of an index, for an audit that may be interrupted.

It only reads the index, so a node may deliver at the same time. Ids of objects that were verified are remembered in
``verify.db``, next to the index, so the next run checks the rest and newer deliveries; a run that finishes removes the file.
SQLite's lock on that file ensures that only one audit runs at a time.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar

from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.spool.index import Index

PAGE: Final = 256
"""Objects read at a time: an interruption loses at most the results of so many."""
BUSY_TIMEOUT_S: Final = 1.0
_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS audit (name TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS verified (id INTEGER PRIMARY KEY);
"""

_Answer = TypeVar('_Answer')


class Deliveries:
    """The deliveries that the store confirmed, and the progress of an audit.

    Lifecycle: new; open once; use from one thread; close once. Raises SpoolError, which names the file and what to do.
    """

    def __init__(self, spool: Path) -> None:
        self._index_path = spool / 'index.db'
        self._index = Index(self._index_path, read_only=True)
        self._progress = spool / 'verify.db'
        self._connection: sqlite3.Connection | None = None

    def open(self, audit: str, *, again: bool = False) -> None:
        """``audit`` identifies the audit and its store: progress of another audit or another index is discarded.

        ``again`` discards the progress of an interrupted run.
        """
        if not self._index_path.is_file():
            raise SpoolError(f'there is no spool in {self._index_path.parent}',
                             remedy='has the node run here? set SHADOWHOUND_HOME to its folder')  # fmt: skip
        if again:
            self._progress.unlink(missing_ok=True)
        with self._translating():
            self._index.open()
            connection = self._connection = sqlite3.connect(
                self._progress.absolute().as_uri(), uri=True, timeout=BUSY_TIMEOUT_S, isolation_level=None)  # fmt: skip
            connection.execute('PRAGMA locking_mode = EXCLUSIVE')
            connection.execute('PRAGMA synchronous = NORMAL')
            connection.executescript(_SCHEMA)
            name = f'{audit} {self._index.accounts.first_session()}'
            if connection.execute('SELECT name FROM audit').fetchall() != [(name,)]:
                connection.executescript('BEGIN; DELETE FROM audit; DELETE FROM verified; COMMIT')
                connection.execute('INSERT INTO audit VALUES (?)', (name,))

    def close(self) -> None:
        """Close, keeping the progress for the next run."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        self._index.close()

    def finish(self) -> None:
        """Close and remove the progress of a finished audit: the next one starts again."""
        self.close()
        self._progress.unlink(missing_ok=True)

    def pages(self) -> Iterator[list[tuple[int, ObjectInfo]]]:
        """Delivered objects that are not verified yet, as the store must describe them, by id."""
        last = 0
        while page := self._read(partial(self._index.history.delivered, last, PAGE)):
            last = page[-1][0]
            verified = {number for number, _ in page if self._query('SELECT 1 FROM verified WHERE id = ?', number)}
            if left := [(number, item) for number, item in page if number not in verified]:
                yield left

    def set_verified(self, ids: Iterable[int]) -> None:
        """Remember that these objects were verified."""
        with self._translating():
            self._db.execute('BEGIN')
            self._db.executemany('INSERT OR IGNORE INTO verified VALUES (?)', ((number,) for number in ids))
            self._db.execute('COMMIT')

    def verified(self) -> int:
        """How many objects were verified so far, in this run and in the runs that it continues."""
        return int(self._query('SELECT count(*) FROM verified')[0][0])

    def known(self) -> int:
        """Delivered objects that the index remembers; it forgets them after ``spool.remember_days``."""
        return self._read(self._index.history.delivered_count)

    def forgotten(self) -> int:
        """Earlier deliveries, which the index counts but can no longer name; including parts of the catalog."""
        return self._read(self._index.history.forgotten_count)

    def since_ns(self) -> int | None:
        """When the first remembered object was delivered; None if there is none."""
        return self._read(self._index.history.delivered_since_ns)

    @property
    def _db(self) -> sqlite3.Connection:
        if self._connection is None:
            raise SpoolError('the progress of the audit is not open')
        return self._connection

    def _query(self, query: str, *values: object) -> list[tuple[Any, ...]]:
        with self._translating():
            return self._db.execute(query, values).fetchall()

    def _read(self, read: Callable[[], _Answer]) -> _Answer:
        with self._translating():
            return read()

    @contextmanager
    def _translating(self) -> Iterator[None]:
        """Close and raise SpoolError after an SQLite error."""
        try:
            yield
        except sqlite3.Error as error:
            self.close()
            busy = 'locked' in str(error)
            raise SpoolError(
                f'{self._index_path} and {self._progress} cannot be used: {error}',
                remedy='is another --verify running?'
                if busy
                else 'may this user write to the folder? --again starts from the beginning',
            ) from error
