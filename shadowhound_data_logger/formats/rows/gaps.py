"""The gap journal as it is delivered: statements of what was lost and of how far that is known, in row files.

A row is a statement, and nothing is ever changed in the store: a later statement about the same thing has the same ``id`` and a
higher ``revision``. The newest counts; ``withdrawn`` says that there is no such gap any more (a late message filled it, an object
was retried). So statements may arrive in any order, twice, or be merged in any order: the answer is the same.

``complete`` statements are the watermark of a sink and topic: whatever was lost between their two times is stated, and the rest
is in the store. After the last such statement, losses are unknown. Parts are at
``<robot>/_gaps/date=YYYY-MM-DD/<robot>_<YYYYMMDDTHHMMSS>_<...>.jsonl.zst``; the date is that of ``to_ns``, UTC: a query for a
time looks at its own date and at the later ones.
"""

from __future__ import annotations

import hashlib
from typing import Any, Final

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND, utc
from shadowhound_data_logger.formats.rows.schema import GAPS_FOLDER, INT32, INT64, STRING, TIME, UNDATED, TableSchema

FORMAT_VERSION: Final = 1
"""Of the statements. Columns are only ever added, at the end."""
GAP, WITHDRAWN, COMPLETE = 'gap', 'withdrawn', 'complete'
STATEMENT_KINDS: Final = (GAP, WITHDRAWN, COMPLETE)
"""What a statement can be (``what``)."""
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
    about={'shadowhound.gaps': str(FORMAT_VERSION)},
)
"""``sink topic publisher session kind cause count merged grade mission_id`` are those of ``shadowhound-data ledger --gaps``.

Of a gap, ``from_ns`` is the stamp of the last message before it and ``to_ns`` that of the first one after it;
``received_from_ns`` and ``received_to_ns`` are when these two messages arrived. Of a ``complete`` statement, ``from_ns`` to
``to_ns`` is the time that it covers. All are null where the time is not known. ``clock`` is ``unset`` where they
count from the robot's boot: ``t_from`` and ``t_to`` are null then. ``received`` and ``skipped`` (downsampled) are messages of the
session until ``to_ns``, in ``complete`` statements alone.
"""
WATERMARK_NS: Final = 600 * SECOND
"""Of the ``complete`` statements of a session within so much time, the newest counts."""

Statement = dict[str, Any]
"""Column -> value; a time as an int of microseconds."""


def statement(robot: str, what: str, name: str, revision: int, **columns: Any) -> Statement:
    """A row; what is not given is null. ``name`` tells what it speaks of from all else of the robot."""
    found: Statement = dict.fromkeys(GAPS.columns)
    found.update(columns, robot=robot, what=what, id=name, revision=revision, format_version=FORMAT_VERSION)
    is_dated = found['clock'] != 'unset'
    for time, stamp in (('t_from', 'from_ns'), ('t_to', 'to_ns')):
        stamp_ns = found[stamp]
        found[time] = stamp_ns // 1000 if is_dated and stamp_ns is not None and stamp_ns >= EARLIEST_SANE_NS else None
    return found


def name_of(*parts: object) -> str:
    """What tells a gap from all others of a robot, by whatever names it in the journal."""
    return hashlib.blake2b('\0'.join(map(str, parts)).encode(errors='replace'), digest_size=10).hexdigest()


def complete(robot: str, journal: str, revision: int, **columns: Any) -> Statement:
    """A watermark; ``columns`` has ``sink topic session from_ns to_ns grade received skipped``."""
    place = f'{columns["session"]}/{columns["to_ns"] // WATERMARK_NS}/{columns["sink"]}{columns["topic"]}'
    return statement(robot, COMPLETE, f'{journal}/{place}', revision, **columns)


def date_of(row: Statement) -> str:
    """The folder of a statement, ``YYYY-MM-DD``."""
    return UNDATED if row['t_to'] is None else f'{utc(row["to_ns"]):%Y-%m-%d}'
