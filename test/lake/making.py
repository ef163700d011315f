"""A small lake for the tests: two days of a robot, with two patrols, one of them failed, and a bucket that counts requests."""

from __future__ import annotations

import hashlib
import json
import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.model import ObjectInfo, SpooledObject
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows import catalog, parts
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.ingest import ingest, maintain
from shadowhound_data_logger.lake.tables import Tables
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.content import warn_of

NOON_NS: Final = 1_793_188_800 * SECOND
"""2026-10-28T12:00:00Z."""
DAY_NS: Final = 86_400 * SECOND
MINUTE_NS: Final = 60 * SECOND
FAILED, FINISHED = 'mfailed', 'mfinished'
SENSORS: Final = {
    'camera': ('/camera/compressed', 'sensor_msgs/msg/CompressedImage', 'jpg', 'image/jpeg'),
    'odom': ('/odom', 'nav_msgs/msg/Odometry', 'json', 'application/json'),
}


def row(sensor: str, stamp_ns: int, robot: str = 'thor', **more: str) -> catalog.Row:
    """The row of one object as a robot writes it; position and battery follow from the time."""
    topic, kind, extension, content_type = SENSORS[sensor]
    turn = stamp_ns % DAY_NS / DAY_NS * 48 * math.pi
    minute = stamp_ns // MINUTE_NS
    mission = {10: FAILED, 40: FINISHED}.get(minute % 60 // 10 * 10)
    metadata = {
        'robot': robot, 'sensor': sensor, 'topic': topic, 'type': kind, 'count': '1', 't_start_ns': str(stamp_ns),
        't_end_ns': str(stamp_ns), 'sha256': hashlib.sha256(content(sensor, stamp_ns)).hexdigest(),
        'pose': f'{6 * math.cos(turn):.3f} {4 * math.sin(turn):.3f} {turn % 6.28:.4f} odom',
        'battery_pct': f'{100 - stamp_ns % DAY_NS / DAY_NS * 80:.1f}',
        **({'mission_id': mission, 'run_id': f'run-{mission}', 'mission_type': 'patrol'} if mission else {}), **more,
    }  # fmt: skip
    key = f'{robot}/{sensor}/{utc(stamp_ns):%Y%m%d/%H%M%S}_x.{extension}'
    return catalog.row_of(catalog.BUCKET, key, len(content(sensor, stamp_ns)), content_type, metadata)


def content(sensor: str, stamp_ns: int) -> bytes:
    """The content of a row's object."""
    return f'{sensor} {stamp_ns} '.encode() * 20


Minute = tuple[int, list[catalog.Row]]


def minutes(days: Sequence[int] = (0, 1), hours: Sequence[int] = (11, 12), robot: str = 'thor') -> Iterator[Minute]:
    """(start, rows) of every fifth minute of these hours; 0 is the day of ``NOON_NS``."""
    for day in days:
        for hour in hours:
            for minute in range(0, 60, 5):
                begin_ns = NOON_NS - 12 * 60 * MINUTE_NS + day * DAY_NS + (hour * 60 + minute) * MINUTE_NS
                rows = [row(sensor, begin_ns + second * SECOND, robot) for second in range(0, 60, 15) for sensor in SENSORS]
                yield begin_ns, rows


def add_part(store: ObjectStore, rows: Sequence[catalog.Row], name: str, folder: Path) -> str:
    """A row file, as the robot delivers it."""
    robot = str(rows[0]['robot'])
    key = catalog.OBJECTS.part_key(robot, catalog.date_of(rows[0]), name)
    add(store, folder, key, parts.encode(rows), {'robot': robot})
    return key


def add(store: ObjectStore, folder: Path, key: str, body: bytes, metadata: dict[str, str] | None = None,
        bucket: str = catalog.BUCKET, content_type: str = 'application/octet-stream') -> None:  # fmt: skip
    """An object in the store."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / 'body'
    path.write_bytes(body)
    sha256 = hashlib.sha256(body).hexdigest()
    store.put(SpooledObject(id=0, bucket=bucket, key=key, path=path, size=len(body), sha256=sha256, content_type=content_type,
                            metadata=metadata or {}, priority=5, created_ns=0))  # fmt: skip


def add_objects(store: ObjectStore, times: Sequence[int], folder: Path) -> None:
    """An object per sensor and time, and a part of the catalog per sensor."""
    for sensor in SENSORS:
        for stamp_ns in times:
            add(store, folder, row(sensor, stamp_ns)['key'], content(sensor, stamp_ns))
        add_part(store, [row(sensor, stamp_ns) for stamp_ns in times], sensor, folder)


def fill(settings: StoreSettings, folder: Path, **which: Any) -> list[catalog.Row]:
    """Deliver the row files of some minutes, and the missions' summaries; returns the rows of the catalog."""
    every: list[catalog.Row] = []
    with closing(open_store(settings, UploadSettings())) as store:
        for begin_ns, rows in minutes(**which):
            add_part(store, rows, f'{utc(begin_ns):%Y%m%dT%H%M%S}_boot', folder)
            every += rows
        for mission, success in ((FAILED, False), (FINISHED, True)):
            fields = {
                'mission_id': mission, 'success': success, 'result': 'FINISHED' if success else 'FAILED', 'distance_m': 12.5,
                'mission_type': 'patrol', 'mission_command': 'go round', 'duration_s': 600,
            }  # fmt: skip
            add(store, folder, f'thor/missions/run-{mission}/summary.json', json.dumps(fields).encode())
    return every


def folder_store(root: Path) -> StoreSettings:
    return StoreSettings(directory=root / 'store')


class Watched:
    """A bucket that records the requests, and can fail on request."""

    def __init__(self, inner: Bucket) -> None:
        self.inner = inner
        self.settings, self.name = inner.settings, inner.name
        self.asked: list[tuple[str, str]] = []
        self._lock = threading.Lock()

    def describe(self) -> str:
        return self.inner.describe()

    def _ask(self, verb: str, key: str) -> None:
        with self._lock:
            self.asked.append((verb, key))

    def folders(self, prefix: str) -> Sequence[str]:
        self._ask('folders', prefix)
        return self.inner.folders(prefix)

    def list(self, prefix: str, skipped: Callable[[str, str], None] = warn_of) -> Sequence[ObjectInfo]:
        self._ask('list', prefix)
        return self.inner.list(prefix, skipped)

    def get(self, key: str, most: int) -> bytes:
        self._ask('get', key)
        return self.inner.get(key, most)

    def ranges(self, key: str, spans: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        self._ask('ranges', key)
        return self.inner.ranges(key, spans)

    def head(self, key: str) -> Any:
        self._ask('head', key)
        return self.inner.head(key)

    def delete(self, key: str) -> None:
        self._ask('delete', key)
        self.inner.delete(key)


def watched(settings: StoreSettings, bucket: str = catalog.BUCKET) -> Watched:
    return Watched(Bucket(settings, bucket))


def keys(rows: Sequence[catalog.Row]) -> list[str]:
    return sorted(row['key'] for row in rows)


def merge(settings: StoreSettings) -> int:
    """Ingest all row files, and merge them into one file per day; returns how many files were merged."""
    source = Bucket(settings, catalog.BUCKET)
    tables = Tables.for_ingest(source)
    ingest(source, tables, Findings(lambda _: None))
    return maintain(source, tables, Findings(lambda _: None)).merged
