"""The catalog: one row for each object in the store, its columns, and how a row is made from an object's metadata.

A row holds nothing that is not in the object's S3 metadata and in a listing: a catalog that is lost is made again from those.
Every object of a robot is a row but the files of the catalog itself. Parts lie at
``<robot>/_catalog/date=YYYY-MM-DD/<robot>_<YYYYMMDDTHHMMSS>_<...>.jsonl.zst``; the date is that of ``t_start``, UTC.
Beside them lie the parts of the gap journal (formats/rows/gaps.py), in ``<robot>/_gaps/``, and of the statistics of the objects
(formats/rows/statistics.py), in ``<robot>/_stats/``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from shadowhound_data_logger.core import metadata_words as words
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, utc

STRING, INT32, INT64, DOUBLE, TIME = 'string', 'int32', 'int64', 'double', 'time'
"""Kinds of columns. ``TIME`` is whole microseconds since 1970, UTC."""
SUFFIX: Final = '.jsonl.zst'
"""Of the names of row files."""
FORMAT_VERSION: Final = 1
"""Of the rows. Columns are only ever added, at the end."""
BUCKET: Final = 'sensor-data'
"""Of the catalog; its rows name objects of any bucket."""
COLUMNS: Final[Mapping[str, str]] = {
    'robot': STRING,
    'sensor': STRING,
    'topic': STRING,
    'type': STRING,
    'bucket': STRING,
    'key': STRING,
    'bytes': INT64,
    'sha256': STRING,
    't_start': TIME,
    't_end': TIME,
    't_start_ns': INT64,
    't_end_ns': INT64,
    'count': INT64,
    'mission_id': STRING,
    'run_id': STRING,
    'mission_type': STRING,
    'x': DOUBLE,
    'y': DOUBLE,
    'yaw': DOUBLE,
    'pose_frame': STRING,
    'battery_pct': DOUBLE,
    'clock': STRING,
    'clock_offset_ns': INT64,
    'content_type': STRING,
    'format_version': INT32,
    'received_start_ns': INT64,
    'received_end_ns': INT64,
    'by_arrival': INT64,
}
"""Name -> kind. ``bucket``, ``key``, ``bytes`` and ``format_version`` are always there; all else is null where it is not known.

Times are in microseconds, because Spark reads no TIMESTAMP(NANOS); the exact ones stand beside them as int64.
``x y yaw`` are meters and radians (REP-103) in the odometry's frame ``pose_frame``, at the object's time: ``t_start`` of a single
message, the middle of a batch. ``clock`` is how well the times are known (spool/redating.py). With ``unset`` there is no date:
``t_start`` and ``t_end`` are null, the ns count from the robot's boot, and the part lies under ``date=1970-01-01``.
``clock_offset_ns`` is to be added to the times in the content, with ``set_later``. ``received_*`` is when its messages arrived;
``by_arrival`` of them are dated by that, because their stamps were not trusted.
"""
REQUIRED: Final = ('bucket', 'key', 'bytes', 'format_version')
UNDATED: Final = '1970-01-01'
SENSOR: Final = '_catalog'
"""Of the catalog's own objects and of the gap journal's, which have no rows in it."""


@dataclass(frozen=True, slots=True, eq=False)
class TableSchema:
    """A table whose parts lie in the store: their folder below the robot's name, and their columns."""

    folder: str
    columns: Mapping[str, str]
    """Name -> kind."""
    required: tuple[str, ...]
    """Columns without nulls."""
    about: Mapping[str, str]
    """The key-value metadata of each part."""
    is_apart: bool = False
    """Whether the parts lie beside the robots' own folders: a robot's credentials may not write them."""

    def prefix(self, robot: str) -> str:
        """What the keys of a robot's parts begin with."""
        return f'{self.folder}/{robot}/' if self.is_apart else f'{robot}/{self.folder}/'

    def robot_of(self, key: str) -> str:
        """Whose part this is."""
        return ''.join(key.split('/')[1:2]) if self.is_apart else key.partition('/')[0]

    def part_key(self, robot: str, date: str, name: str) -> str:
        """The key of a part with rows of one date (``YYYY-MM-DD``); ``name`` makes it unique."""
        return f'{self.prefix(robot)}date={date}/{robot}_{name}{SUFFIX}'


OBJECTS: Final = TableSchema(SENSOR, COLUMNS, REQUIRED, {'shadowhound.catalog': str(FORMAT_VERSION)})
KEPT: Final = TableSchema(
    '_kept', {**COLUMNS, 'where': STRING, 'reason': STRING}, (*REQUIRED, 'where'), {'shadowhound.kept': str(FORMAT_VERSION)}
)
"""What robots keep until somebody asks for it: rows as of the catalog, and ``where`` each object is.

``robot``: on the robot's disk. ``lost``: it was evicted there, or refused; ``reason`` says why. A row of the same object in the
catalog, which says that the store has it, supersedes both, and ``lost`` supersedes ``robot``, whatever comes first. Readers of
the catalog that know nothing of this table see only what the store has.
"""
FORGOTTEN: Final = TableSchema(
    '_forgotten',
    {
        'robot': STRING,
        'sensor': STRING,
        'topic': STRING,
        'bucket': STRING,
        'key': STRING,
        'bytes': INT64,
        't_start': TIME,
        't_start_ns': INT64,
        't_end_ns': INT64,
        'count': INT64,
        'rule': STRING,
        'forgotten': TIME,
        'forgotten_ns': INT64,
        'format_version': INT32,
    },
    ('bucket', 'key', 'bytes', 't_start_ns', 'forgotten_ns', 'format_version'),
    {'shadowhound.forgotten': '1'},
    is_apart=True,
)
"""What ``lake prune`` deleted from the store on purpose: of each object the columns of its row in the catalog, ``forgotten``
when, and by which ``rule``.

The row in the catalog stays; one here, under the same date, supersedes it. It is there before the object is deleted: a robot
that could write one could have an object deleted.
"""
GAPS_FOLDER: Final = '_gaps'
"""Of the gap journal's parts."""
STATISTICS_FOLDER: Final = '_stats'
LABELS_FOLDER: Final = '_labels'

Row = dict[str, Any]
"""Column -> value; a time as an int of microseconds."""


def is_row(bucket: str, key: str) -> bool:
    """Whether an object belongs into the catalog: all do but its own files, and those of the tables beside it."""
    folders = {SENSOR, GAPS_FOLDER, KEPT.folder, STATISTICS_FOLDER, LABELS_FOLDER}
    return bucket != BUCKET or ''.join(key.split('/')[1:2]) not in folders


def date_of(row: Row) -> str:
    """The folder of a row, ``YYYY-MM-DD``."""
    return f'{utc(row["t_start_ns"]):%Y-%m-%d}' if row['t_start'] is not None else UNDATED


def row_of(bucket: str, key: str, size: int, content_type: str, metadata: Mapping[str, str]) -> Row:
    """The row of an object by its S3 metadata; never raises: what is missing or senseless there is null.

    ``robot`` is that of its key, whatever the object says; ``sensor`` of one that tells nothing too.
    """
    parts = key.split('/')
    start_ns, end_ns = _int(metadata, words.T_START_NS, words.BOOT_START_NS), _int(metadata, words.T_END_NS, words.BOOT_END_NS)
    pose = metadata.get(words.POSE, '').split(' ')
    x, y, yaw = (_number(value) for value in (pose[:3] if len(pose) == 4 else ('', '', '')))
    known = None not in (x, y, yaw)
    return {
        'robot': (parts[0] if len(parts) > 1 else metadata.get(words.ROBOT)) or None,
        'sensor': metadata.get(words.SENSOR) or (parts[1] if len(parts) > 2 else None),
        'topic': metadata.get(words.TOPIC) or None,
        'type': metadata.get(words.TYPE) or None,
        'bucket': bucket,
        'key': key,
        'bytes': size,
        'sha256': metadata.get(words.SHA256) or None,
        't_start': _micros(start_ns),
        't_end': _micros(end_ns),
        't_start_ns': start_ns,
        't_end_ns': end_ns,
        'count': _int(metadata, words.COUNT, words.MESSAGES),
        'mission_id': metadata.get(words.MISSION_ID) or None,
        'run_id': metadata.get(words.RUN_ID) or None,
        'mission_type': metadata.get(words.MISSION_TYPE) or None,
        'x': x if known else None,
        'y': y if known else None,
        'yaw': yaw if known else None,
        'pose_frame': pose[3] if known else None,
        'battery_pct': _number(metadata.get(words.BATTERY, '')),
        'clock': metadata.get(words.CLOCK) or None,
        'clock_offset_ns': _int(metadata, words.CLOCK_OFFSET_NS),
        'content_type': content_type or None,
        'format_version': FORMAT_VERSION,
        'received_start_ns': _int(metadata, words.RECEIVED_START_NS),
        'received_end_ns': _int(metadata, words.RECEIVED_END_NS),
        'by_arrival': _int(metadata, words.BY_ARRIVAL),
    }


def _micros(stamp_ns: int | None) -> int | None:
    return stamp_ns // 1000 if stamp_ns is not None and stamp_ns >= EARLIEST_SANE_NS else None


def _int(metadata: Mapping[str, str], *names: str) -> int | None:
    """The first of these that is there, as a whole number of 64 bits; None where it is none."""
    for name in names:
        if name in metadata:
            try:
                value = int(metadata[name])
            except ValueError:
                return None
            return value if abs(value) < 1 << 63 else None
    return None


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
