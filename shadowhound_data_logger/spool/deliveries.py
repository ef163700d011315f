"""What the index calls delivered, for an audit that may be interrupted.

It reads the index as any viewer does, also while a node delivers. What was found sound is remembered in ``verify.db`` beside
it, by number, so that the next run asks for the rest and for what was delivered meanwhile; after a run that came to its end
the file is gone. One audit at a time: SQLite's own lock on that file sees to it.
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
"""Objects asked for between two notes of what was sound: what an interruption costs."""
BUSY_TIMEOUT_S: Final = 1.0
_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS audit (name TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS sound (id INTEGER PRIMARY KEY);
"""

_Answer = TypeVar('_Answer')


class Deliveries:
    """What the store confirmed, for an audit, and how far the audit came.

    Life: New; open once; use from one thread; close once. Errors are SpoolError, naming the file and what to do.
    """

    def __init__(self, spool: Path) -> None:
        self._index_path = spool / 'index.db'
        self._index = Index(self._index_path, read_only=True)
        self._notes = spool / 'verify.db'
        self._connection: sqlite3.Connection | None = None

    def open(self, audit: str, *, again: bool = False) -> None:
        """``audit`` says what is asked of whom: what is noted of another one, or of another index, is forgotten.

        ``again`` forgets an interrupted run in any case.
        """
        if not self._index_path.is_file():
            raise SpoolError(f'there is no spool in {self._index_path.parent}',
                             remedy='has the node run here? SHADOWHOUND_HOME names its folder')  # fmt: skip
        if again:
            self._notes.unlink(missing_ok=True)
        with self._telling():
            self._index.open()
            connection = self._connection = sqlite3.connect(
                self._notes.absolute().as_uri(), uri=True, timeout=BUSY_TIMEOUT_S, isolation_level=None)  # fmt: skip
            connection.execute('PRAGMA locking_mode = EXCLUSIVE')
            connection.execute('PRAGMA synchronous = NORMAL')
            connection.executescript(_SCHEMA)
            name = f'{audit} {self._index.accounts.first_session()}'
            if connection.execute('SELECT name FROM audit').fetchall() != [(name,)]:
                connection.executescript('BEGIN; DELETE FROM audit; DELETE FROM sound; COMMIT')
                connection.execute('INSERT INTO audit VALUES (?)', (name,))

    def close(self) -> None:
        """What is noted stays for the next run."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        self._index.close()

    def finish(self) -> None:
        """The audit came to its end: the next one starts again."""
        self.close()
        self._notes.unlink(missing_ok=True)

    def pages(self) -> Iterator[list[tuple[int, ObjectInfo]]]:
        """What is delivered and not noted yet, as the store has to describe it: at first what has a full row, by number.

        A row that becomes a short one meanwhile is asked for once.
        """
        last = 0
        asked: set[int] = set()
        while page := self._of_index(partial(self._index.history.delivered, last, PAGE)):
            last = page[-1][0]
            asked.update(number for number, _ in page)
            yield from self._not_noted(page)
        place = (0, '')
        while True:
            page, place = self._of_index(partial(self._index.history.delivered_compact, place, PAGE))
            if not page:
                return
            yield from self._not_noted([(number, item) for number, item in page if number not in asked])

    def _not_noted(self, page: list[tuple[int, ObjectInfo]]) -> Iterator[list[tuple[int, ObjectInfo]]]:
        noted = {number for number, _ in page if self._ask('SELECT 1 FROM sound WHERE id = ?', number)}
        if left := [(number, item) for number, item in page if number not in noted]:
            yield left

    def note(self, ids: Iterable[int]) -> None:
        """These are sound."""
        with self._telling():
            self._db.execute('BEGIN')
            self._db.executemany('INSERT OR IGNORE INTO sound VALUES (?)', ((number,) for number in ids))
            self._db.execute('COMMIT')

    def noted(self) -> int:
        """How many were found sound so far, in this run and in those that it goes on from."""
        return int(self._ask('SELECT count(*) FROM sound')[0][0])

    def known(self) -> int:
        """Delivered objects that the index remembers; those of longer ago are forgotten (``spool.remember_days``)."""
        return self._of_index(self._index.history.delivered_count)

    def forgotten(self) -> int:
        """Delivered objects of longer ago, which the index counts but cannot name any more; parts of the catalog among them."""
        return self._of_index(self._index.history.forgotten_count)

    def since_ns(self) -> int | None:
        """When the first of those that the index remembers was delivered; None without any."""
        return self._of_index(self._index.history.delivered_since_ns)

    @property
    def _db(self) -> sqlite3.Connection:
        if self._connection is None:
            raise SpoolError('the deliveries are not open')
        return self._connection

    def _ask(self, query: str, *values: object) -> list[tuple[Any, ...]]:
        with self._telling():
            return self._db.execute(query, values).fetchall()

    def _of_index(self, question: Callable[[], _Answer]) -> _Answer:
        with self._telling():
            return question()

    @contextmanager
    def _telling(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            self.close()
            busy = 'locked' in str(error)
            raise SpoolError(
                f'{self._index_path} and {self._notes} cannot be used: {error}',
                remedy='does another --verify run?'
                if busy
                else 'is the folder yours to write? --again starts from the beginning',
            ) from error
