"""Copies the readable rows of a damaged file of rosbag2's SQLite storage into a new file.

Committed rows that are still in the write-ahead log (``-wal``, next to the file) are included, and an uncommitted transaction is
rolled back (``-journal``).
"""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.bags.contents import check_schema
from shadowhound_data_logger.core.durable_files import sync
from shadowhound_data_logger.core.errors import BagDamaged
from shadowhound_data_logger.core.untrusted import MAX_CHUNK_BYTES

TABLES: Final = ('schema', 'metadata', 'topics', 'message_definitions', 'messages')
_TYPES: Final = frozenset({'INTEGER', 'TEXT', 'BLOB'})
_LAST: Final = 1 << 62
_LOGS: Final = ('-wal', '-journal')
LEFTOVERS: Final = (*_LOGS, '-shm')
"""Suffixes of the files that remain next to a database that was not closed; they belong to that database only."""
LOST: Final = 'rows that cannot be read'


def copy_readable_rows(source: Path, target: Path) -> str:
    """Create ``target``, which must not exist; returns a description of the losses, or ''. Raises BagDamaged if unreadable."""
    with tempfile.TemporaryDirectory(prefix='.shadowhound-', dir=target.parent) as folder:
        copy = Path(folder, 'source.db3')
        shutil.copyfile(source, copy)
        _fit(copy)
        for suffix in _LOGS:
            if (log := source.with_name(source.name + suffix)).is_file():
                shutil.copyfile(log, copy.with_name(copy.name + suffix))
        try:
            with closing(sqlite3.connect(copy)) as database, closing(sqlite3.connect(target)) as new:
                lost = _copy(database, new)
        except (sqlite3.Error, UnicodeDecodeError, ValueError) as error:
            target.unlink(missing_ok=True)
            raise BagDamaged(f'{source} cannot be read: {error}', path=str(source)) from error
    sync(target)
    return LOST if lost else ''


def _fit(path: Path) -> None:
    """Set the page count in the header to the number of complete pages: SQLite does not open a file that is shorter.

    Rows on missing pages then fail to read, instead of being read as zeros.
    """
    with path.open('r+b') as file:
        head = file.read(32)
        page = int.from_bytes(head[16:18], 'big')
        page = 65_536 if page == 1 else page
        pages = path.stat().st_size // page if page else 0
        if head.startswith(b'SQLite format 3\0') and 0 < pages < int.from_bytes(head[28:32], 'big'):
            file.seek(28)
            file.write(pages.to_bytes(4, 'big'))
            file.truncate(pages * page)


def _copy(database: sqlite3.Connection, new: sqlite3.Connection) -> bool:
    """Copy the tables; returns whether rows were lost."""
    if why := check_schema(database):
        raise ValueError(why)
    there = {str(name) for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    is_lost = False
    for table in TABLES:
        if table not in there:
            continue
        columns = [(str(name), str(kind).upper(), bool(key)) for _, name, kind, _, _, key in
                   database.execute(f'PRAGMA table_info({table})')]  # fmt: skip
        if not all(name.isidentifier() for name, _, _ in columns):
            raise ValueError(f'{table} has a column without a name')
        fields = (f'"{name}" {kind if kind in _TYPES else ""}{" PRIMARY KEY" * key}' for name, kind, key in columns)
        new.execute(f'CREATE TABLE {table} ({", ".join(fields)})')
        rows = _Rows(database, table, [name for name, _, _ in columns])
        marks = ', '.join('?' * len(columns))
        new.executemany(f'INSERT OR IGNORE INTO {table} VALUES ({marks})', rows)  # noqa: S608 - of TABLES, and question marks
        is_lost |= rows.is_lost
    new.execute('CREATE INDEX timestamp_idx ON messages (timestamp ASC)')
    new.commit()
    return is_lost


class _Rows:
    """The rows of a table in the order of their rowid; unreadable rows are skipped."""

    def __init__(self, database: sqlite3.Connection, table: str, columns: list[str]) -> None:
        names = ', '.join(f'"{name}"' for name in columns)
        small = ' AND '.join(f'ifnull(length("{name}"), 0) <= {MAX_CHUNK_BYTES}' for name in columns)
        if table == 'messages':
            small += " AND typeof(topic_id) = 'integer' AND typeof(timestamp) = 'integer' AND typeof(data) = 'blob'"
        self._query = f'SELECT rowid, {names} FROM {table} WHERE rowid > ? AND {small} ORDER BY rowid'  # noqa: S608 - checked by the caller
        self._database = database
        self.is_lost = False

    def __iter__(self) -> Iterator[tuple[Any, ...]]:
        last = -1
        while last < _LAST:
            try:
                for number, *fields in self._database.execute(self._query, (last,)):
                    last = number
                    yield tuple(fields)
            except sqlite3.DatabaseError:
                self.is_lost = True
                last = self._skip(last)
            else:
                return

    def _skip(self, last: int) -> int:
        """The rowid after which the next readable row is."""
        step = 1
        while not self._is_readable(last + step):
            step *= 2
            if last + step >= _LAST:
                return _LAST
        low, high = last + step // 2, last + step
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if self._is_readable(middle) else (middle, high)
        return high

    def _is_readable(self, number: int) -> bool:
        """Whether the first row after this rowid is readable."""
        try:
            return self._database.execute(f'{self._query} LIMIT 1', (number,)).fetchone() is not None
        except sqlite3.DatabaseError:
            return False
