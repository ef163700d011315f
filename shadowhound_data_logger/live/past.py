"""What a robot recorded on a day, and the bytes of it: by the index of its spool, or by the catalog in the store.

On the robot the spool's index knows what waits and what was delivered in the last weeks; what left the spool is read from the
store. On another machine the catalog says all of it. Everything that comes out of a store is somebody else's: keys must be
paths, sizes are bounded, texts are only ever shown.
"""

from __future__ import annotations

import os
import re
import sqlite3
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from shadowhound_data_logger.bags.manifest import Manifest
from shadowhound_data_logger.bags.naming import MANIFEST
from shadowhound_data_logger.core.clock import SECOND, SystemClock, utc
from shadowhound_data_logger.core.config import home, store_settings
from shadowhound_data_logger.core.errors import BagDamaged, LakeError, SpoolError, StoreError
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.core.options import UploadSettings
from shadowhound_data_logger.core.stamps import BY_RECEIVED, BY_STAMP
from shadowhound_data_logger.core.untrusted import MOST_DOCUMENT_BYTES, MOST_OBJECT_BYTES, is_path
from shadowhound_data_logger.formats.mcap.ranges import LocalFile, Ranged, StoredFile
from shadowhound_data_logger.formats.rows import schema
from shadowhound_data_logger.formats.rows.gaps import GAP
from shadowhound_data_logger.live.figures import DAY_NS, SpoolFigures, told_gaps
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.listing import HERE
from shadowhound_data_logger.spool.status import read as read_status
from shadowhound_data_logger.stores import open_reader, open_store

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from shadowhound_data_logger.stores.base import ObjectStore

MOST_ROWS: Final = 1_500_000
"""Of a day: a robot that stores every message of everything makes some 600,000."""
MAX_DAYS_KEPT: Final = 3
FRESH_S: Final = 10.0
"""A day that goes on is read again after so long."""
KEPT_BYTES: Final = 48 << 20
"""Of contents that were read: neighbouring moments are of the same objects."""
MAX_BAGS: Final = 200
"""Of a day."""
_IN_KEY: Final = re.compile(r'/(\d{8})/(\d{6})(?:_(\d{3}))?[_.]', re.ASCII)
_IN_BAG: Final = re.compile(r'_(\d{8})_(\d{6})(?:_\d+)?$', re.ASCII)
_COLUMNS: Final = ('bucket', 'key', 'sensor', 'topic', 'type', 'bytes', 't_start_ns', 't_end_ns', 'mission_id', 'mission_type',
                   'x', 'y', 'yaw', 'battery_pct', 'received_start_ns', 'clock_offset_ns')  # fmt: skip


@dataclass(frozen=True)
class PastObject:
    """An object as it is known here."""

    bucket: str
    key: str
    sensor: str
    topic: str
    """Empty where nobody knows it."""
    type: str
    size: int
    begin_ns: int
    end_ns: int
    mission_id: str = ''
    mission_type: str = ''
    pose: tuple[float, float, float] | None = None
    """x, y, yaw."""
    battery: float | None = None
    late_ns: int = 0
    """How much later than their stamps its messages arrived."""
    offset_ns: int = 0
    """To be added to the times in its content."""
    path: str = ''
    """Of its file in the spool; empty for what lies in the store alone."""


class PastDay:
    """The objects that begin on one day, by time."""

    def __init__(self, begins: NDArray[np.int64], ends: NDArray[np.int64], names: Sequence[str], codes: NDArray[np.int32],
                 rows: Any, problem: str = '') -> None:  # fmt: skip
        self.begins, self.ends, self.names, self.codes = begins, ends, names, codes
        """``names[codes[n]]`` is the topic of row n, or its sensor where nobody knows the topic."""
        self._rows = rows
        self.problem = problem

    def between(self, begin_ns: int, end_ns: int) -> list[PastObject]:
        """Those that begin in this time."""
        low, high = (int(np.searchsorted(self.begins, at_ns)) for at_ns in (begin_ns, end_ns))
        if isinstance(self._rows, list):
            return self._rows[low:high]
        return [_of_catalog(row) for row in self._rows.slice(low, max(0, high - low)).to_pylist()]

    @cached_property
    def missions(self) -> list[tuple[str, str, int, int]]:
        """(id, type, first, last)."""
        found: dict[str, list[Any]] = {}
        if isinstance(self._rows, list):
            for one in self._rows:
                if one.mission_id:
                    _widen(found, one.mission_id, one.mission_type, one.begin_ns, one.end_ns)
        else:
            known = self._rows.select(['mission_id', 'mission_type', 't_start_ns', 't_end_ns'])
            told = known.group_by('mission_id').aggregate([('mission_type', 'max'), ('t_start_ns', 'min'), ('t_end_ns', 'max')])
            for row in told.to_pylist():
                if row['mission_id']:
                    begin_ns, end_ns = row['t_start_ns_min'], row['t_end_ns_max'] or 0
                    _widen(found, row['mission_id'], row['mission_type_max'] or '', begin_ns, max(begin_ns, end_ns))
        return [(name, *values) for name, values in found.items()]

    @cached_property
    def bag_files(self) -> dict[str, list[PastObject]]:
        """Files of bags, by bag."""
        files: dict[str, list[PastObject]] = {}
        if isinstance(self._rows, list):
            chosen = [one for one in self._rows if '/rosbags/' in one.key]
        else:
            import pyarrow.compute as pc  # noqa: PLC0415 - only where the rows are pyarrow's

            chosen = [
                _of_catalog(row) for row in self._rows.filter(pc.match_substring(self._rows['key'], '/rosbags/')).to_pylist()
            ]
        for one in chosen:
            bag, slash, _ = one.key.partition('/rosbags/')[2].partition('/')
            if slash and (bag in files or len(files) < MAX_BAGS):
                files.setdefault(bag, []).append(one)
        return files


class PastSource(Protocol):
    """Where the past is read."""

    def robots(self) -> list[str]: ...

    def days(self, robot: str) -> list[str]:
        """Dates with something recorded, ``YYYY-MM-DD``."""

    def day(self, robot: str, date: str, by: str = BY_STAMP) -> PastDay:
        """The objects that begin on it, by their stamps or by the arrival of their messages."""

    def gaps(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> dict[str, Any]:
        """As ``SpoolFigures.gaps``."""


class PastContents:
    """The bytes of objects, from the spool or the store, whichever has them. Keeps what it read last.

    Thread-safe but for ``close``.
    """

    def __init__(self) -> None:
        self._store: ObjectStore | None = None
        self._kept: OrderedDict[str, bytes] = OrderedDict()
        self._size = 0

    @property
    def store(self) -> ObjectStore:
        """Raises SettingError."""
        if self._store is None:
            settings = store_settings(os.environ, home(os.environ))
            is_light = settings.endpoint_url and find_spec('obstore') is None  # a robot has boto3 alone
            self._store = open_store(settings, UploadSettings()) if is_light else open_reader(settings)
        return self._store

    def close(self) -> None:
        if self._store is not None:
            self._store.close()

    def get(self, one: PastObject, most: int = MOST_OBJECT_BYTES) -> bytes:
        """Raises StoreError, LakeError for a key that is none."""
        kept = self._kept.get(one.key)
        if kept is not None:
            return kept
        body = self._read(one, most)
        self._kept[one.key] = body
        self._size += len(body)
        while self._size > KEPT_BYTES and len(self._kept) > 1:
            with suppress(KeyError):
                self._size -= len(self._kept.popitem(last=False)[1])
        return body

    def _read(self, one: PastObject, most: int) -> bytes:
        if one.path:
            with suppress(OSError), Path(one.path).open('rb') as file:
                body = file.read(most + 1)
                if len(body) <= most:
                    return body
        if not is_path(one.key):
            raise LakeError('the key of the object is not a path')
        return self.store.get(one.bucket, one.key, most)

    def ranged(self, one: PastObject) -> Ranged:
        """The file, to be read in pieces. Raises BagDamaged, LakeError."""
        if one.path and os.path.isfile(one.path):  # noqa: PTH113 - never raises
            return LocalFile(Path(one.path))
        if not is_path(one.key):
            raise LakeError('the key of the object is not a path')
        return StoredFile(self.store, one.bucket, one.key, one.size)

    def manifest(self, files: Sequence[PastObject]) -> Manifest | None:
        """What a bag says of itself; None while it is not whole, or where that cannot be read."""
        one = next((file for file in files if file.key.endswith(f'/{MANIFEST}')), None)
        if one is None:
            return None
        try:
            return Manifest.from_json(self.get(one, MOST_DOCUMENT_BYTES), one.key)
        except (BagDamaged, StoreError, LakeError):
            return None


class SpoolPast:
    """One robot's past, by the index of its spool."""

    def __init__(self, spool: Path, robot: str) -> None:
        self._spool, self._robot = spool, robot
        self._tree = Tree(spool)
        self._clock = SystemClock.of_this_machine()
        self._kept: OrderedDict[str, tuple[float, PastDay]] = OrderedDict()

    def robots(self) -> list[str]:
        return [self._robot]

    def days(self, robot: str) -> list[str]:
        """Raises SpoolError."""
        with closing(self._index()) as index, _reading(self._spool):
            numbers, folders = index.overview.recorded_days(robot), index.overview.folders(robot)
        found = {f'{utc(number * DAY_NS):%Y-%m-%d}' for number in numbers}
        for folder in folders:
            at_ns = _stamp(f'{folder}000000_') or _bag_begin(folder.rstrip('/'))
            if at_ns:
                found.add(f'{utc(at_ns):%Y-%m-%d}')
        return sorted(found)

    def day(self, robot: str, date: str, by: str = BY_STAMP) -> PastDay:
        """Raises SpoolError."""
        return _kept(self._kept, f'{date} {by}', lambda: self._read(robot, date, by))

    def _read(self, robot: str, date: str, by: str) -> PastDay:
        begin_ns = date_ns(date)
        topics = {row.sensor: topic for topic, row in read_status(self._spool, robot, self._clock).node.topics.items()}
        with closing(self._index()) as index, _reading(self._spool):
            found = [self._of_row(row, by) for row in index.overview.recorded(robot, begin_ns, begin_ns + DAY_NS, by)]
            topics |= {one.sensor: one.topic for one in found if one.topic}
            for bucket, key, sensor, size, settled_s, late_ms in _compact_rows(index, robot, begin_ns, by):
                bag = key.partition('/rosbags/')[2].partition('/')[0]
                late_ns = late_ms * (SECOND // 1000)
                offset_ns = late_ns if by == BY_RECEIVED else 0
                at_ns = ((_bag_begin(bag) if bag else _stamp(key)) or 0) + offset_ns
                if begin_ns <= at_ns < begin_ns + DAY_NS:
                    end_ns = max(at_ns, settled_s * SECOND) if bag else at_ns
                    found.append(PastObject(bucket, key, sensor, topics.get(sensor, ''), '', size, at_ns, end_ns,
                                            late_ns=late_ns, offset_ns=offset_ns))  # fmt: skip
        found.sort(key=lambda one: one.begin_ns)
        return _day(found[:MOST_ROWS], 'this is not all of the day' if len(found) > MOST_ROWS else '')

    def _of_row(self, row: tuple[Any, ...], by: str) -> PastObject:
        """Of a row of ``OverviewTable.recorded``."""
        (bucket, key, state, reason, sensor, topic, kind, size, begin_ns, end_ns, received_ns, received_end_ns, mission,
         mission_type, pose, battery, content) = row  # fmt: skip
        late_ns = 0 if received_ns is None else received_ns - begin_ns
        offset_ns = late_ns if by == BY_RECEIVED else 0
        if offset_ns:
            begin_ns, end_ns = received_ns, received_end_ns or received_ns
        is_here = State(state) in HERE
        path = str(self._tree.path(State(state), reason, bucket, key)) if is_here else ''
        return PastObject(
            bucket, content or key, sensor, topic or '', kind or '', size, begin_ns, max(begin_ns, end_ns), mission or '',
            mission_type or '', _pose(pose), _number(battery), late_ns, offset_ns, path,
        )  # fmt: skip

    def gaps(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> dict[str, Any]:
        """Raises SpoolError."""
        return SpoolFigures(self._spool, robot, self._clock).gaps(begin_ns, end_ns, by)

    def _index(self) -> Index:
        """Raises SpoolError where there is none."""
        path = self._spool / 'index.db'
        if not path.is_file():
            raise SpoolError(f'there is no spool in {self._spool}', remedy='has the node run here?')
        index = Index(path, read_only=True)
        index.open()
        return index


class StorePast:
    """The past of all robots whose catalog is in the store that the environment names. It needs the extra ``lake``."""

    def __init__(self) -> None:
        """Raises LakeError where pyarrow is not installed, SettingError for settings of a store that are none."""
        if find_spec('pyarrow') is None:
            raise LakeError('the past of a store needs pyarrow', remedy='install the extra lake')
        from shadowhound_data_logger.lake.bucket import Bucket  # noqa: PLC0415 - the extra lake
        from shadowhound_data_logger.lake.findings import Findings  # noqa: PLC0415

        self._source = Bucket(store_settings(os.environ, home(os.environ)), schema.BUCKET)
        self._findings = Findings(lambda _: None)
        self._kept: OrderedDict[str, tuple[float, PastDay]] = OrderedDict()

    def robots(self) -> list[str]:
        """Raises StoreError."""
        from shadowhound_data_logger.lake.row_files import robots  # noqa: PLC0415

        return robots(self._source)

    def days(self, robot: str) -> list[str]:
        """Raises StoreError."""
        from shadowhound_data_logger.lake.views import dates  # noqa: PLC0415

        found = dates(self._source, robot, (schema.OBJECTS, schema.KEPT), self._findings)
        return [date for date in found if date > schema.UNDATED]

    def day(self, robot: str, date: str, by: str = BY_STAMP) -> PastDay:
        """Raises StoreError."""
        return _kept(self._kept, f'{robot} {date} {by}', lambda: self._read(robot, date, by))

    def _read(self, robot: str, date: str, by: str) -> PastDay:
        import pyarrow as pa  # noqa: PLC0415 - the extra lake
        import pyarrow.compute as pc  # noqa: PLC0415

        from shadowhound_data_logger.lake.findings import Findings  # noqa: PLC0415
        from shadowhound_data_logger.lake.views import rows_of  # noqa: PLC0415

        findings = Findings(lambda _: None)
        where, has_date = f"date = '{date}' AND t_start_ns IS NOT NULL", date.__eq__
        if by == BY_RECEIVED:  # the dates of rows are those of stamps
            begin_ns = date_ns(date)
            where, has_date = f't_start_ns >= {begin_ns} AND t_start_ns < {begin_ns + DAY_NS}', schema.UNDATED.__ne__
        table = rows_of(self._source, schema.OBJECTS, findings, robot=robot, has_date=has_date, where=where,
                        columns=_COLUMNS, order='t_start_ns, key', limit=MOST_ROWS, by=by)  # fmt: skip
        begins = table['t_start_ns'].to_numpy()
        ends = np.maximum(begins, pc.fill_null(table['t_end_ns'], 0).to_numpy())
        names = pc.dictionary_encode(pc.coalesce(table['topic'], table['sensor'], pa.scalar(''))).combine_chunks()
        codes = names.indices.to_numpy().astype(np.int32)
        left = [f'{one.key}: {one.why}' for one in findings][:3]
        problem = f'{len(findings)} parts of the catalog cannot be read, such as {left[0]}' if left else ''
        return PastDay(begins, ends, [str(name) for name in names.dictionary.to_pylist()], codes, table,
                       problem or ('this is not all of the day' if len(table) >= MOST_ROWS else ''))  # fmt: skip

    def gaps(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> dict[str, Any]:
        """Raises StoreError."""
        from shadowhound_data_logger.lake import gaps as journal  # noqa: PLC0415 - pyarrow

        rows = journal.newest(self._source, robot=robot, since_ns=begin_ns, findings=self._findings, by=by).to_pylist()
        gaps = [
            (row['sink'], row['topic'], row['kind'] or '', row['cause'] or '', row['from_ns'], row['to_ns'], row['count'] or 0,
             row['grade'] or '')
            for row in rows if row['what'] == GAP and row['from_ns'] is not None and row['to_ns'] is not None
            and row['clock'] != 'unset' and row['to_ns'] >= begin_ns and row['from_ns'] <= end_ns
        ]  # fmt: skip
        known = [
            (row['topic'], row['from_ns'], row['to_ns']) for row in journal.watermarks(rows)
            if row['sink'] == journal.OBJECTS and row['grade'] != journal.RECEIVED_ONLY
            and row['to_ns'] >= begin_ns and row['from_ns'] <= end_ns
        ]  # fmt: skip
        return told_gaps(sorted(gaps, key=lambda gap: gap[4]), known, begin_ns, end_ns, time.time_ns())


# -- parts ---------------------------------------------------------------------------------------------------------


def date_ns(date: str) -> int:
    """Where a date begins, UTC. Raises ValueError."""
    return int(datetime.strptime(date, '%Y-%m-%d').replace(tzinfo=timezone.utc).timestamp()) * SECOND


def dates_between(begin_ns: int, end_ns: int) -> list[str]:
    """The dates that a time touches."""
    first, last = utc(begin_ns).date(), utc(max(begin_ns, end_ns - 1)).date()
    return [str(first + timedelta(days=number)) for number in range((last - first).days + 1)]


def _kept(kept: OrderedDict[str, tuple[float, PastDay]], name: str, read: Callable[[], PastDay]) -> PastDay:
    """The day as it was read, again after a while: it may go on, and older days still arrive."""
    now_s = time.monotonic()
    known = kept.get(name)
    if known is None or now_s - known[0] > FRESH_S:
        known = kept[name] = (time.monotonic(), read())
        while len(kept) > MAX_DAYS_KEPT:
            kept.popitem(last=False)
    kept.move_to_end(name)
    return known[1]


@contextmanager
def _reading(spool: Path) -> Iterator[None]:
    try:
        yield
    except sqlite3.Error as error:
        raise SpoolError(f'the index of {spool} cannot be read: {error}') from error


def _compact_rows(index: Index, robot: str, begin_ns: int, by: str) -> Iterator[tuple[str, str, str, int, int, int]]:
    """Of objects that may be of the day that begins then: their keys have the date of the stamp."""
    around = (-DAY_NS, 0, DAY_NS) if by == BY_RECEIVED else (0,)
    for step_ns in around:
        yield from index.overview.recorded_compact(robot, f'{utc(begin_ns + step_ns):%Y%m%d}')


def _day(found: list[PastObject], problem: str) -> PastDay:
    names = sorted({one.topic or one.sensor for one in found})
    places = {name: place for place, name in enumerate(names)}
    return PastDay(
        np.array([one.begin_ns for one in found], np.int64), np.array([one.end_ns for one in found], np.int64), names,
        np.array([places[one.topic or one.sensor] for one in found], np.int32), found, problem,
    )  # fmt: skip


def _of_catalog(row: Mapping[str, Any]) -> PastObject:
    pose = (row['x'], row['y'], row['yaw']) if None not in (row['x'], row['y'], row['yaw']) else None
    return PastObject(
        row['bucket'], row['key'], row['sensor'] or '', row['topic'] or '', row['type'] or '', row['bytes'], row['t_start_ns'],
        max(row['t_start_ns'], row['t_end_ns'] or 0), row['mission_id'] or '', row['mission_type'] or '', pose,
        row['battery_pct'], 0 if row['received_start_ns'] is None else row['received_start_ns'] - row['t_start_ns'],
        row['clock_offset_ns'] or 0,
    )  # fmt: skip


def _widen(found: dict[str, list[Any]], name: str, kind: str, begin_ns: int, end_ns: int) -> None:
    known = found.setdefault(name, [kind, begin_ns, end_ns])
    known[:] = known[0] or kind, min(known[1], begin_ns), max(known[2], end_ns)


def _stamp(key: str) -> int | None:
    """The time that stands in a key of the shape ``.../20261018/120005_250_front.jpg``."""
    found = _IN_KEY.search(key)
    return _parsed(found[1] + found[2], int(found[3] or 0)) if found else None


def _bag_begin(bag: str) -> int | None:
    found = _IN_BAG.search(bag)
    return _parsed(found[1] + found[2], 0) if found else None


def _parsed(text: str, millis: int) -> int | None:
    try:
        at = datetime.strptime(text, '%Y%m%d%H%M%S').replace(tzinfo=timezone.utc)
    except ValueError:
        return None
    return int(at.timestamp()) * SECOND + millis * (SECOND // 1000)


def _pose(text: object) -> tuple[float, float, float] | None:
    parts = [_number(part) for part in str(text or '').split(' ')[:3]]
    x, y, yaw = parts if len(parts) == 3 else (None, None, None)
    return None if x is None or y is None or yaw is None else (x, y, yaw)


def _number(text: object) -> float | None:
    try:
        value = float(str(text))
    except ValueError:
        return None
    return value if np.isfinite(value) else None
