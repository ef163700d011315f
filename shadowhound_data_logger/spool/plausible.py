"""Whether the values in an index can be ours: a flipped bit gives a record any value, and SQLite sees nothing wrong with it.

Asked at each start, before a value is used: a text among numbers would end every start, a key with ``..`` in it lead out of
the spool. It takes 4 us a row.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from typing import Final

_NUMBERS: Final = {
    'objects': ('id', 'priority', 'protected', 'samples', 'bytes', 't_start_ns', 't_end_ns', 'created_ns', 'settled_ns'),
    'sessions': ('id', 'pid', 'started_ns', 'ended_ns'),
    'accounts': ('session', 'received', 'skipped', 'stored', 'last_kept_ns', 'first_ns', 'heard_ns', 'complete_ns'),
    'publishers': ('session', 'first', 'last', 'published', 'received', 'heard_ns'),
    'other_types': ('session', 'messages'),
    'estimates': ('session', 'estimated', 'unknown'),
    'rhythms': ('last',),
    'tally': ('objects', 'bytes', 'samples'),
    'contents': ('id', 'samples'),
    'gaps': ('session', 'begin_ns', 'from_ns', 'to_ns', 'count', 'merged', 'version'),
    'sqlite_sequence': ('seq',),
}
_COUNTS: Final = frozenset({'id', 'samples', 'bytes', 'received', 'skipped', 'stored', 'published', 'objects', 'seq', 'session',
                            'messages', 'estimated', 'unknown', 'count', 'merged', 'version'})  # fmt: skip
"""Never below 0, and no more than can be counted. Times and the numbers of messages are whatever a publisher says."""
_MOST: Final = 1 << 53
_TEXTS: Final = {
    'objects': ('bucket', 'key', 'state', 'reason', 'sensor', 'topic', 'type', 'sha256', 'content_type', 'metadata'),
    'sessions': ('robot', 'boot_id'),
    'accounts': ('topic', 'type', 'accounting', 'rejected', 'dropped'),
    'publishers': ('topic', 'publisher', 'missed'),
    'other_types': ('topic', 'type', 'publishers'),
    'estimates': ('topic', 'missed'),
    'rhythms': ('topic', 'publisher', 'of'),
    'tally': ('topic', 'state'),
    'contents': ('topic',),
    'gaps': ('topic', 'kind', 'cause', 'grade', 'publisher', 'mission'),
    'sqlite_sequence': ('name',),
}
_JSON: Final = {
    'accounts': ('rejected', 'dropped'), 'publishers': ('missed',), 'estimates': ('missed',), 'objects': ('metadata',),
}  # fmt: skip
_UNSAFE: Final = (
    "length(key) > 1024 OR length(bucket) > 64 OR bucket GLOB '*[^A-Za-z0-9_.-]*' OR bucket IN ('', '.', '..')"
    " OR '/' || key || '/' GLOB '*/../*' OR '/' || key || '/' GLOB '*/./*' OR '/' || key || '/' GLOB '*//*'"
    " OR length(reason) > 200 OR reason GLOB '*/*' OR reason IN ('.', '..')"
)
_IN_SPOOL: Final = """
SELECT ifnull(topic, '') AS name, state, count(*), sum(bytes), sum(samples) FROM objects
WHERE state IN ('pending', 'held', 'quarantined') GROUP BY name, state
UNION ALL SELECT contents.topic, state, 0, 0, sum(contents.samples) FROM contents JOIN objects USING (id)
WHERE state IN ('pending', 'held', 'quarantined') GROUP BY contents.topic, state HAVING sum(contents.samples)"""
_TALLY: Final = """
SELECT topic, state, objects, bytes, samples FROM tally
WHERE state IN ('pending', 'held', 'quarantined') AND (objects OR bytes OR samples)"""


def check(db: sqlite3.Connection) -> None:
    """Raises sqlite3.DatabaseError for a value that cannot be."""
    for table in _NUMBERS:
        query = f'SELECT rowid FROM {table} WHERE {_wrong(table)} LIMIT 1'  # noqa: S608 - own constants only
        if table not in {'objects', 'sessions', 'sqlite_sequence'}:  # these have no rowid
            query = query.replace('rowid', 'topic')
        found = db.execute(query).fetchone()
        if found is not None:
            raise sqlite3.DatabaseError(f'a value of {table} {found[0]!r} cannot be')


def uncounted(db: sqlite3.Connection) -> Iterator[str]:
    """A sentence for each total that is not that of the objects in the spool."""
    db.execute('BEGIN')  # other processes commit meanwhile: both of one moment
    try:
        counted = {row[:2]: row[2:] for row in db.execute(_IN_SPOOL)}
        said = {row[:2]: row[2:] for row in db.execute(_TALLY)}
    finally:
        db.execute('COMMIT')
    for what in sorted(counted.keys() | said.keys()):
        if counted.get(what) != said.get(what):
            yield f'{what[0] or "bookkeeping"}: {what[1]} {said.get(what)}, but in the spool {counted.get(what)}'


def _wrong(table: str) -> str:
    """The condition for rows with a value that cannot be; NULL is judged by the table's own constraints."""
    conditions = [f"typeof({column}) NOT IN ('text', 'null')" for column in _TEXTS[table]]
    for column in _NUMBERS[table]:
        conditions.append(f"typeof({column}) NOT IN ('integer', 'null')")
        if column in _COUNTS:
            conditions.append(f'{column} NOT BETWEEN 0 AND {_MOST}')
    if table == 'rhythms':
        conditions.append(f"typeof(period) <> 'real' OR period NOT BETWEEN 0 AND {_MOST}")
    conditions += [f"{column} NOT GLOB '{{*}}'" for column in _JSON.get(table, ())]
    return ' OR '.join((*conditions, *([_UNSAFE] if table == 'objects' else [])))
