"""The gap journal in the store: row files with statements about losses, and about the time up to which losses are known.

A row is a statement and never changes: a later statement about the same gap has the same ``id`` and a higher ``revision``. The
newest one is valid; ``withdrawn`` means that the gap no longer exists (a late message filled it, an object was retried). The
result does not depend on the order in which statements arrive, or on duplicates.

``complete`` statements are the watermark of a sink and topic: all losses between their two times have statements, and all other
messages are in the store. After the last such statement, losses are unknown. Row files are at
``<robot>/_gaps/date=YYYY-MM-DD/<robot>_<YYYYMMDDTHHMMSS>_<...>.jsonl.zst``; the date is that of ``to_ns``, UTC: a query for a
time reads its own date and the later ones.
"""

from __future__ import annotations

import hashlib
from typing import Any, Final

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND, utc
from shadowhound_data_logger.formats.rows.catalog import GAPS_FOLDER, INT32, INT64, STRING, TIME, UNDATED, TableSchema

FORMAT_VERSION: Final = 1
"""Version of the statements. Columns are only ever added, at the end."""
GAP, WITHDRAWN, COMPLETE = 'gap', 'withdrawn', 'complete'
"""Values of ``what``."""
GAPS: Final = TableSchema(
    folder=GAPS_FOLDER,
    columns={
        'robot': STRING,
        'what': STRING,
        'id': STRING,
        'revision': INT64,
        'sink': STRING,
        'topic': STRING,
        'publisher': STRING,
        'session': INT64,
        'kind': STRING,
        'cause': STRING,
        't_from': TIME,
        't_to': TIME,
        'from_ns': INT64,
        'to_ns': INT64,
        'received_from_ns': INT64,
        'received_to_ns': INT64,
        'count': INT64,
        'merged': INT64,
        'grade': STRING,
        'mission_id': STRING,
        'clock': STRING,
        'received': INT64,
        'skipped': INT64,
        'format_version': INT32,
    },
    required=('robot', 'what', 'id', 'revision', 'sink', 'topic', 'format_version'),
)
"""``sink topic publisher session kind cause count merged grade mission_id`` are those of ``shadowhound-data ledger --gaps``.

In a gap, ``from_ns`` is the stamp of the last message before it and ``to_ns`` that of the first one after it;
``received_from_ns`` and ``received_to_ns`` are when these two messages arrived. A ``complete`` statement covers ``from_ns`` to
``to_ns``. All are null if the time is unknown. ``clock`` is ``unset`` if they count from the robot's boot: then ``t_from`` and
``t_to`` are null. ``received`` and ``skipped`` (downsampled) are the messages of the session until ``to_ns``; only ``complete``
statements have them.
"""
WATERMARK_NS: Final = 600 * SECOND
"""In each period of this length, the newest ``complete`` statement of a session is valid."""

Statement = dict[str, Any]
"""Column -> value; a time as an int of microseconds."""


def statement(robot: str, what: str, name: str, revision: int, **columns: Any) -> Statement:
    """A row; columns that are not given are null. ``name`` identifies the gap among all gaps of the robot."""
    found: Statement = dict.fromkeys(GAPS.columns)
    found.update(columns, robot=robot, what=what, id=name, revision=revision, format_version=FORMAT_VERSION)
    is_dated = found['clock'] != 'unset'
    for time, stamp in (('t_from', 'from_ns'), ('t_to', 'to_ns')):
        stamp_ns = found[stamp]
        found[time] = stamp_ns // 1000 if is_dated and stamp_ns is not None and stamp_ns >= EARLIEST_SANE_NS else None
    return found


def name_of(*parts: object) -> str:
    """The id of a gap: a hash of everything that identifies it in the journal."""
    return hashlib.blake2b('\0'.join(map(str, parts)).encode(errors='replace'), digest_size=10).hexdigest()


def complete(robot: str, journal: str, revision: int, **columns: Any) -> Statement:
    """A watermark; ``columns`` has ``sink topic session from_ns to_ns grade received skipped``."""
    place = f'{columns["session"]}/{columns["to_ns"] // WATERMARK_NS}/{columns["sink"]}{columns["topic"]}'
    return statement(robot, COMPLETE, f'{journal}/{place}', revision, **columns)


def date_of(row: Statement) -> str:
    """The folder of a statement, ``YYYY-MM-DD``."""
    return UNDATED if row['t_to'] is None else f'{utc(row["to_ns"]):%Y-%m-%d}'
