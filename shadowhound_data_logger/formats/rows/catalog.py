"""The catalog: one row per object in the store, its columns, and how a row is made from the metadata of an object.

A row contains nothing that is not in the object's S3 metadata and in a listing: a lost catalog can be rebuilt from those.
Every object of a robot has a row, except the row files themselves. These are at
``<robot>/_catalog/date=YYYY-MM-DD/<robot>_<YYYYMMDDTHHMMSS>_<...>.jsonl.zst``; the date is that of ``t_start``, UTC.
Those of the gap journal (formats/rows/gaps.py) are in ``<robot>/_gaps/``, and those of the statistics of the objects
(formats/rows/statistics.py) in ``<robot>/_stats/``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, utc
from shadowhound_data_logger.core.earth import is_place
from shadowhound_data_logger.core.stamps import DAY_NS

STRING, INT32, INT64, DOUBLE, TIME = 'string', 'int32', 'int64', 'double', 'time'
"""Kinds of columns. ``TIME`` is whole microseconds since 1970, UTC."""
SUFFIX: Final = '.jsonl.zst'
"""Suffix of the names of row files."""
FORMAT_VERSION: Final = 1
"""Version of the rows. Columns are only ever added, at the end."""
BUCKET: Final = 'sensor-data'
"""The catalog's bucket; its rows name objects in any bucket."""
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
    'latitude': DOUBLE,
    'longitude': DOUBLE,
    'altitude': DOUBLE,
}
"""Name -> kind. ``bucket``, ``key``, ``bytes`` and ``format_version`` are never null; others are null if unknown.

Times are in microseconds, because Spark cannot read TIMESTAMP(NANOS); the ``_ns`` columns have the exact times.
``x y yaw`` are meters and radians (REP-103) in the frame ``pose_frame``, the map or that of the odometry, and ``latitude
longitude altitude`` are degrees and meters (WGS 84), at the object's time: ``t_start`` of a single message, the middle of a
batch. ``clock`` is how well the times are known (unsynced_objects.py). With ``unset`` there is no date: ``t_start`` and ``t_end``
are null, the ns count from the robot's boot, and the file is below ``date=1970-01-01``. With ``set_later``, ``clock_offset_ns``
must be added to the times in the content. ``received_*`` is when the messages arrived; ``by_arrival`` is the number of messages
dated by their arrival because their stamps were not trusted.
"""
REQUIRED: Final = ('bucket', 'key', 'bytes', 'format_version')
UNDATED: Final = '1970-01-01'
SENSOR: Final = '_catalog'
"""The folder of the catalog's row files, which have no rows themselves."""


@dataclass(frozen=True, slots=True, eq=False)
class TableSchema:
    """A table with row files in the store: their folder below the robot's name, and their columns."""

    folder: str
    columns: Mapping[str, str]
    """Name -> kind."""
    required: tuple[str, ...]
    """Columns without nulls."""
    is_apart: bool = False
    """Whether the files are outside the robots' folders, where a robot's credentials cannot write them."""

    def prefix(self, robot: str) -> str:
        """The start of the keys of a robot's row files."""
        return f'{self.folder}/{robot}/' if self.is_apart else f'{robot}/{self.folder}/'

    def robot_of(self, key: str) -> str:
        """The robot of a row file."""
        return ''.join(key.split('/')[1:2]) if self.is_apart else key.partition('/')[0]

    def part_key(self, robot: str, date: str, name: str) -> str:
        """The key of a row file with rows of one date (``YYYY-MM-DD``); ``name`` makes it unique."""
        return f'{self.prefix(robot)}date={date}/{robot}_{name}{SUFFIX}'


OBJECTS: Final = TableSchema(SENSOR, COLUMNS, REQUIRED)
KEPT: Final = TableSchema('_kept', {**COLUMNS, 'where': STRING, 'reason': STRING}, (*REQUIRED, 'where'))
"""Objects that robots keep until they are requested: rows like those of the catalog, and ``where`` each object is.

``robot``: on the robot's disk. ``lost``: evicted there, or rejected by the store; ``reason`` is why. A row of the same object in
the catalog supersedes both, because the store has the object then, and ``lost`` supersedes ``robot``, in any order. The catalog
itself has only objects that are in the store.
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
    is_apart=True,
)
"""Objects that ``lake prune`` deleted from the store: columns of the object's row in the catalog, the time (``forgotten``), and
the ``rule``.

The row in the catalog is kept; one here, with the same date, supersedes it. It is written before the object is deleted: a robot
that could write such a row could have objects deleted.
"""
GAPS_FOLDER: Final = '_gaps'
"""The folder of the gap journal's row files."""
STATISTICS_FOLDER: Final = '_stats'
LABELS_FOLDER: Final = '_labels'

Row = dict[str, Any]
"""Column -> value; a time as an int of microseconds."""


def is_row(bucket: str, key: str) -> bool:
    """Whether an object has a row in the catalog: all have one except row files."""
    folders = {SENSOR, GAPS_FOLDER, KEPT.folder, STATISTICS_FOLDER, LABELS_FOLDER}
    return bucket != BUCKET or ''.join(key.split('/')[1:2]) not in folders


def date_of(row: Row) -> str:
    """The folder of a row, ``YYYY-MM-DD``."""
    return _day(row['t_start_ns'] // DAY_NS) if row['t_start'] is not None else UNDATED


@lru_cache(64)
def _day(number: int) -> str:
    """``YYYY-MM-DD`` of a day since 1970; every row of a file needs one, and most have the same."""
    return f'{utc(number * DAY_NS):%Y-%m-%d}'


def row_of(bucket: str, key: str, size: int, content_type: str, metadata: Mapping[str, str]) -> Row:
    """The row of an object from its S3 metadata; never raises: missing or invalid values are null.

    ``robot`` always comes from the key; ``sensor`` comes from the key if the metadata does not have it.
    """
    parts = key.split('/')
    start_ns, end_ns = _int(metadata, meta.T_START_NS, meta.BOOT_START_NS), _int(metadata, meta.T_END_NS, meta.BOOT_END_NS)
    pose = metadata.get(meta.POSE, '').split(' ')
    x, y, yaw = (_number(value) for value in (pose[:3] if len(pose) == 4 else ('', '', '')))
    known = None not in (x, y, yaw)
    fix = metadata.get(meta.GPS, '').split(' ')
    latitude, longitude, altitude = (_number(value) for value in (fix if len(fix) == 3 else ('', '', '')))
    on_earth = latitude is not None and longitude is not None and is_place(latitude, longitude)
    return {
        'robot': (parts[0] if len(parts) > 1 else metadata.get(meta.ROBOT)) or None,
        'sensor': metadata.get(meta.SENSOR) or (parts[1] if len(parts) > 2 else None),
        'topic': metadata.get(meta.TOPIC) or None,
        'type': metadata.get(meta.TYPE) or None,
        'bucket': bucket,
        'key': key,
        'bytes': size,
        'sha256': metadata.get(meta.SHA256) or None,
        't_start': _micros(start_ns),
        't_end': _micros(end_ns),
        't_start_ns': start_ns,
        't_end_ns': end_ns,
        'count': _int(metadata, meta.COUNT, meta.MESSAGES),
        'mission_id': metadata.get(meta.MISSION_ID) or None,
        'run_id': metadata.get(meta.RUN_ID) or None,
        'mission_type': metadata.get(meta.MISSION_TYPE) or None,
        'x': x if known else None,
        'y': y if known else None,
        'yaw': yaw if known else None,
        'pose_frame': pose[3] if known else None,
        'battery_pct': _number(metadata.get(meta.BATTERY, '')),
        'clock': metadata.get(meta.CLOCK) or None,
        'clock_offset_ns': _int(metadata, meta.CLOCK_OFFSET_NS),
        'content_type': content_type or None,
        'format_version': FORMAT_VERSION,
        'received_start_ns': _int(metadata, meta.RECEIVED_START_NS),
        'received_end_ns': _int(metadata, meta.RECEIVED_END_NS),
        'by_arrival': _int(metadata, meta.BY_ARRIVAL),
        'latitude': latitude if on_earth else None,
        'longitude': longitude if on_earth else None,
        'altitude': altitude if on_earth else None,
    }


def place_of(row: Mapping[str, Any]) -> dict[str, str]:
    """Where the robot was, in the form of an object's metadata, to compare places: without its yaw and its height."""
    found = {}
    if row['x'] is not None and row['y'] is not None:
        found[meta.POSE] = f'{row["x"]} {row["y"]} 0 odom'
    if row['latitude'] is not None and row['longitude'] is not None:
        found[meta.GPS] = f'{row["latitude"]} {row["longitude"]} 0'
    return found


def _micros(stamp_ns: int | None) -> int | None:
    return stamp_ns // 1000 if stamp_ns is not None and stamp_ns >= EARLIEST_SANE_NS else None


def _int(metadata: Mapping[str, str], *names: str) -> int | None:
    """The first of these that exists, as a 64-bit integer; None if it is not one."""
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
