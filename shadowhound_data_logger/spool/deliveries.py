"""What the index calls delivered, for an audit that may be interrupted.

It reads the index as any viewer does, also while a node delivers. What was found sound is remembered in ``verify.db`` beside
it, by number, so that the next run asks for the rest and for what was delivered meanwhile; after a run that came to its end
the file is gone. One audit at a time: SQLite's own lock on that file sees to it.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.errors import SpoolError
from shadowhound_data_logger.model import ObjectInfo

PAGE: Final = 256
"""Objects asked for between two notes of what was sound: what an interruption costs."""
_DELIVERED: Final = "FROM spool.objects AS object WHERE state = 'delivered' AND sensor <> '_catalog'"
"""Without the catalogue's parts (catalogue/schema.py): others stand for them in time, and they go; they can be made again."""
_NOT_NOTED: Final = 'AND NOT EXISTS (SELECT 1 FROM sound WHERE sound.id = object.id)'
BUSY_TIMEOUT_S: Final = 1.0
_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS audit (name TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS sound (id INTEGER PRIMARY KEY);
"""


class Deliveries:
    """Life: New; open once; use from one thread; close once. Errors are SpoolError, naming the file and what to do."""

    def __init__(self, spool: Path) -> None:
        self._index = spool / 'index.db'
        self._notes = spool / 'verify.db'
        self._connection: sqlite3.Connection | None = None

    def open(self, audit: str, *, again: bool = False) -> None:
        """``audit`` says what is asked of whom: what is noted of another one, or of another index, is forgotten.

        ``again`` forgets an interrupted run in any case.
        """
        if not self._index.is_file():
            raise SpoolError(f'there is no spool in {self._index.parent}',
                             remedy='has the node run here? SHADOWHOUND_HOME names its folder')  # fmt: skip
        if again:
            self._notes.unlink(missing_ok=True)
        with self._telling():
            connection = self._connection = sqlite3.connect(
                self._notes.absolute().as_uri(), uri=True, timeout=BUSY_TIMEOUT_S, isolation_level=None)  # fmt: skip
            connection.execute('ATTACH ? AS spool', (f'{self._index.absolute().as_uri()}?mode=ro',))
            connection.execute('PRAGMA main.locking_mode = EXCLUSIVE')
            connection.execute('PRAGMA main.synchronous = NORMAL')
            connection.executescript(_SCHEMA)
            first = connection.execute('SELECT started_ns, boot_id FROM spool.sessions ORDER BY id LIMIT 1').fetchone()
            name = f'{audit} {first}'
            if connection.execute('SELECT name FROM audit').fetchall() != [(name,)]:
                connection.executescript('BEGIN; DELETE FROM audit; DELETE FROM sound; COMMIT')
                connection.execute('INSERT INTO audit VALUES (?)', (name,))

    def close(self) -> None:
        """What is noted stays for the next run."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def finish(self) -> None:
        """The audit came to its end: the next one begins anew."""
        self.close()
        self._notes.unlink(missing_ok=True)

    def pages(self) -> Iterator[list[tuple[int, ObjectInfo]]]:
        """What is delivered and not noted yet, by number and as the store has to describe it."""
        query = f'SELECT id, bucket, key, bytes, sha256 {_DELIVERED} AND id > ? {_NOT_NOTED} ORDER BY id LIMIT ?'
        last = 0
        while page := self._ask(query, last, PAGE):
            yield [(number, ObjectInfo(bucket, key, size, sha256)) for number, bucket, key, size, sha256 in page]
            last = page[-1][0]

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
        return int(self._ask(f'SELECT count(*) {_DELIVERED}')[0][0])

    def forgotten(self) -> int:
        """Delivered objects of longer ago, which the index counts but cannot name any more; parts of the catalogue among them."""
        ever = int(self._ask("SELECT ifnull(sum(objects), 0) FROM spool.tally WHERE state = 'delivered'")[0][0])
        return ever - int(self._ask("SELECT count(*) FROM spool.objects WHERE state = 'delivered'")[0][0])

    def since_ns(self) -> int | None:
        """When the first of those that the index remembers was delivered; None without any."""
        (found,) = self._ask(f'SELECT min(settled_ns) {_DELIVERED}')[0]
        return None if found is None else int(found)

    @property
    def _db(self) -> sqlite3.Connection:
        if self._connection is None:
            raise SpoolError('the deliveries are not open')
        return self._connection

    def _ask(self, query: str, *values: object) -> list[tuple[Any, ...]]:
        with self._telling():
            return self._db.execute(query, values).fetchall()

    @contextmanager
    def _telling(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            self.close()
            busy = 'locked' in str(error)
            raise SpoolError(
                f'{self._index} and {self._notes} cannot be used: {error}',
                remedy='does another --verify run?' if busy else 'is the folder yours to write? --again begins anew',
            ) from error
