"""The tables of the spool's index (schema.sql): creates and checks them, and defines which of their values are plausible.

``Table`` is what the classes with their statements share.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.errors import SpoolError

SCHEMA: Final = Path(__file__).with_name('schema.sql').read_text(encoding='utf-8')
SCHEMA_VERSION: Final = 1
VERSION_LIMIT: Final = 1000
"""A version from here on means damage, not a newer program."""
_COUNTS: Final = frozenset({
    'again', 'answers', 'bytes', 'count', 'estimated', 'folder', 'id', 'merged', 'messages', 'number', 'objects', 'place',
    'published', 'received', 'samples', 'seq', 'session', 'skipped', 'stored', 'unknown', 'version',
})  # fmt: skip
"""Columns that are never negative nor absurdly large. Times and sequence numbers may have any value that a publisher sends."""
_MAX: Final = 1 << 53
_JSON: Final = {
    'accounts': ('rejected', 'dropped', 'by_arrival', 'corrected', 'stamps'), 'publishers': ('missed',), 'estimates': ('missed',),
    'objects': ('metadata',), 'requests': ('selection', 'unavailable'),
}  # fmt: skip
_CONDITIONS: Final = {
    'objects': (
        "length(key) > 1024 OR length(bucket) > 64 OR bucket GLOB '*[^A-Za-z0-9_.-]*' OR bucket IN ('', '.', '..')"
        " OR '/' || key || '/' GLOB '*/../*' OR '/' || key || '/' GLOB '*/./*' OR '/' || key || '/' GLOB '*//*'"
        " OR length(reason) > 200 OR reason GLOB '*/*' OR reason IN ('.', '..')"
    ),
    'rhythms': f'period NOT BETWEEN 0 AND {_MAX}',
}


class Table:
    """A part of the index. Methods that write must be called in one of its transactions, under the lock of the spool."""

    def __init__(self, connection: Callable[[], sqlite3.Connection]) -> None:
        """``connection`` raises SpoolError while the index is not open."""
        self._connection = connection

    @property
    def _db(self) -> sqlite3.Connection:
        return self._connection()


def after(prefix: str) -> str:
    """The first text after all texts that start with ``prefix``."""
    return f'{prefix[:-1]}{chr(ord(prefix[-1]) + 1)}' if prefix else '\U0010ffff'


def marks(count: int) -> str:
    """Placeholders for a statement."""
    return ', '.join('?' * count)


def version_of(connection: sqlite3.Connection, path: Path) -> int:
    """The version of an index; 0 if it has no tables yet.

    Raises sqlite3.DatabaseError for an impossible version, SpoolError for that of a newer program, whose index is not touched.
    """
    version = int(connection.execute('PRAGMA user_version').fetchone()[0])
    if not 0 <= version < VERSION_LIMIT or (version > SCHEMA_VERSION and definitions(connection) == expected()):
        raise sqlite3.DatabaseError(f'the version {version} is invalid')
    if version > SCHEMA_VERSION:
        raise SpoolError(f'the spool index {path} has version {version}, this program reads version {SCHEMA_VERSION}',
                         remedy='update shadowhound_data_logger')  # fmt: skip
    return version


def prepare(connection: sqlite3.Connection, path: Path, *, read_only: bool) -> None:
    """Create the tables of a new index and make its commits durable. Raises as ``version_of``."""
    version = version_of(connection, path)
    if read_only:
        return
    connection.execute('PRAGMA journal_mode = WAL')
    connection.execute('PRAGMA synchronous = FULL')
    if version == 0:
        connection.executescript(f'BEGIN IMMEDIATE; {SCHEMA} COMMIT;')


def definitions(db: sqlite3.Connection) -> set[tuple[str, str]]:
    """The names and statements of all tables, views, indexes and triggers."""
    return set(db.execute('SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL'))


@cache
def expected() -> frozenset[tuple[str, str]]:
    """The definitions of a complete index."""
    with closing(_empty()) as db:
        return frozenset(definitions(db))


@cache
def implausible() -> Mapping[str, str]:
    """Table -> the condition of a row with a value that this program cannot have written.

    A flipped bit may give a record any value, which SQLite does not detect: a text in a numeric column would fail every startup,
    and a key with ``..`` would escape the spool's folder. It takes 4 us per row.
    """
    with closing(_empty()) as db:
        tables = [name for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        return {table: _implausible(db, table) for table in tables}


def _empty() -> sqlite3.Connection:
    db = sqlite3.connect(':memory:')
    db.executescript(SCHEMA)
    return db


def _implausible(db: sqlite3.Connection, table: str) -> str:
    columns = {name: kind.lower() for _, name, kind, *_ in db.execute(f'PRAGMA table_info({table})')}
    if table == 'sqlite_sequence':  # SQLite's own, declared without types
        columns = {'name': 'text', 'seq': 'integer'}
    return ' OR '.join(_conditions(table, columns))


def _conditions(table: str, columns: Mapping[str, str]) -> Iterator[str]:
    """The conditions that hold for an implausible row; the table's constraints check NULL."""
    for name, kind in columns.items():
        yield f"typeof({name}) NOT IN ('{kind}', 'null')"
        if kind == 'integer' and name in _COUNTS:
            yield f'{name} NOT BETWEEN 0 AND {_MAX}'
    yield from (f"{name} NOT GLOB '{{*}}'" for name in _JSON.get(table, ()))
    if table in _CONDITIONS:
        yield _CONDITIONS[table]
