"""What a robot recorded on a day, and its content: from the index of its spool, or from the catalog in the store.

On the robot the spool's index has waiting objects and those delivered in the last weeks; content that left the spool is read from
the store. On another machine everything is from the catalog. Data from a store is not trusted: keys must be paths, sizes are
bounded, texts are only displayed.
"""

from __future__ import annotations

import os
import sqlite3
import time
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from functools import cached_property, lru_cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import numpy as np

from shadowhound_data_logger.bags.manifest import Manifest
from shadowhound_data_logger.bags.naming import MANIFEST
from shadowhound_data_logger.core.clock import SECOND, SystemClock, utc
from shadowhound_data_logger.core.config import home, store_settings
from shadowhound_data_logger.core.errors import BagDamaged, LakeError, SpoolError, StoreError
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.core.options import UploadSettings
from shadowhound_data_logger.core.stamps import BY_RECEIVED, BY_STAMP
from shadowhound_data_logger.core.untrusted import MAX_DOCUMENT_BYTES, MAX_OBJECT_BYTES, is_path
from shadowhound_data_logger.formats.mcap.ranges import LocalFile, Ranged, StoredFile
from shadowhound_data_logger.formats.rows import catalog
from shadowhound_data_logger.formats.rows.gaps import GAP
from shadowhound_data_logger.live.figures import DAY_NS, SpoolFigures, gap_rows
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.listing import STATES_IN_SPOOL
from shadowhound_data_logger.stores import open_reader, open_store

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from shadowhound_data_logger.stores.base import ObjectStore

MAX_ROWS: Final = 1_500_000
"""Of a day: a robot that stores every message has some 600,000."""
MAX_DAYS_KEPT: Final = 3
FRESH_S: Final = 10.0
"""How long a recent time is cached."""
SETTLED_S: Final = 300.0
"""The same for an older one: objects may still arrive."""
MAX_BATCH_NS: Final = 15 * SECOND
BLOCK_NS: Final = 60 * SECOND
"""Block of a spool that is read together."""
MAX_BLOCKS: Final = 60
"""Maximum cached blocks, each with some 1,000 objects."""
MAX_MISSIONS: Final = 1000
MAX_BATTERY: Final = 800
"""Points of the battery's line on a timeline."""
BAG_SENSOR: Final = 'bag'
KEPT_BYTES: Final = 48 << 20
"""Cache of contents: neighboring moments use the same objects."""
MAX_BAGS: Final = 200
"""Of a day."""
_COLUMNS: Final = ('bucket', 'key', 'sensor', 'topic', 'type', 'bytes', 't_start_ns', 't_end_ns', 'mission_id', 'mission_type',
                   'x', 'y', 'yaw', 'battery_pct', 'received_start_ns', 'clock_offset_ns')  # fmt: skip


@dataclass(frozen=True)
class PastObject:
    """An object in the past."""

    bucket: str
    key: str
    sensor: str
    topic: str
    """Empty if unknown."""
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
    """Delay of arrival after the stamps of its messages."""
    offset_ns: int = 0
    """Offset to add to the times in its content."""
    path: str = ''
    """Its file in the spool; empty for objects only in the store."""


class PastDay:
    """Catalog rows of the objects that start on one day, sorted by time."""

    def __init__(self, rows: Any, problem: str = '') -> None:
        """``rows`` is a pyarrow table with ``_COLUMNS``, sorted by ``t_start_ns``."""
        import pyarrow as pa  # noqa: PLC0415 - the extra lake
        import pyarrow.compute as pc  # noqa: PLC0415

        self._rows, self.problem = rows, problem
        self.begins: NDArray[np.int64] = rows['t_start_ns'].to_numpy()
        self.ends: NDArray[np.int64] = np.maximum(self.begins, pc.fill_null(rows['t_end_ns'], 0).to_numpy())
        names = pc.dictionary_encode(pc.coalesce(rows['topic'], rows['sensor'], pa.scalar(''))).combine_chunks()
        self._codes = names.indices.to_numpy().astype(np.int32)
        self._names = [str(name) for name in names.dictionary.to_pylist()]

    def runs(self, begin_ns: int, end_ns: int, grain_ns: int) -> Iterator[Run]:
        """Runs without a pause longer than ``grain_ns``."""
        inside = (self.begins < end_ns) & (self.ends >= begin_ns)
        codes, begins, ends = self._codes[inside], self.begins[inside], self.ends[inside]
        for code, name in enumerate(self._names):
            chosen = codes == code
            if _is_bookkeeping(name) or not chosen.any():
                continue
            starts, reached = begins[chosen], np.maximum.accumulate(ends[chosen])
            breaks = np.flatnonzero(starts[1:] - reached[:-1] > grain_ns) + 1
            for low, high in zip((0, *breaks.tolist()), (*breaks.tolist(), len(starts)), strict=True):
                yield Run(name, int(starts[low]), int(reached[high - 1]))

    def battery(self, begin_ns: int, end_ns: int) -> list[tuple[int, float]]:
        """(time, percent)."""
        low, high = (int(np.searchsorted(self.begins, at_ns)) for at_ns in (begin_ns, end_ns))
        column = self._rows['battery_pct'].slice(low, max(0, high - low)).to_numpy()
        known = np.flatnonzero(~np.isnan(column.astype(np.float64)))
        return [(int(self.begins[low + index]), float(column[index])) for index in known[:: len(known) // MAX_BATTERY + 1]]

    def between(self, begin_ns: int, end_ns: int) -> list[PastObject]:
        """Objects that start in this time."""
        low, high = (int(np.searchsorted(self.begins, at_ns)) for at_ns in (begin_ns, end_ns))
        return [_from_catalog(row) for row in self._rows.slice(low, max(0, high - low)).to_pylist()]

    @cached_property
    def missions(self) -> list[PastMission]:
        known = self._rows.select(['mission_id', 'mission_type', 't_start_ns', 't_end_ns'])
        missions = known.group_by('mission_id').aggregate([('mission_type', 'max'), ('t_start_ns', 'min'), ('t_end_ns', 'max')])
        return [
            PastMission(row['mission_id'], row['mission_type_max'] or '', row['t_start_ns_min'],
                        max(row['t_start_ns_min'], row['t_end_ns_max'] or 0))
            for row in missions.to_pylist() if row['mission_id']
        ]  # fmt: skip

    @cached_property
    def bag_files(self) -> dict[str, list[PastObject]]:
        """Files of bags, by bag."""
        import pyarrow.compute as pc  # noqa: PLC0415 - the extra lake

        chosen = self._rows.filter(pc.match_substring(self._rows['key'], '/rosbags/'))
        return _by_bag([_from_catalog(row) for row in chosen.to_pylist()])


class Run(NamedTuple):
    """Consecutive objects of one topic, or a part of them."""

    name: str
    """The topic, or the sensor if the topic is unknown."""
    begin_ns: int
    end_ns: int
    settled_ns: int | None = None
    """When they left the spool; None if unknown."""
    waits: bool = False
    """Whether some of them are in the spool."""


class PastMission(NamedTuple):
    """The known times of a mission."""

    id: str
    type: str
    begin_ns: int
    end_ns: int


class PastSource(Protocol):
    """A source of the past."""

    def robots(self) -> list[str]: ...

    def fleet(self) -> list[dict[str, Any]]:
        """Overview of all robots (``live/fleet.py``), the most important first; empty on a robot."""

    def days(self, robot: str) -> list[str]:
        """Dates with recorded data, ``YYYY-MM-DD``."""

    def runs(self, robot: str, begin_ns: int, end_ns: int, grain_ns: int, by: str = BY_STAMP) -> list[Run]:
        """What was recorded in this time, by stamps or by arrival of messages; pauses below ``grain_ns`` may be missing.

        Sorted by time per topic; runs of a topic may touch.
        """

    def missions(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> list[PastMission]:
        """Missions in this time, as far as known after ``runs`` was called for it."""

    def battery(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> list[tuple[int, float]]:
        """(time, percent) in this time, as far as known after ``runs`` was called for it."""

    def between(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> list[PastObject]:
        """Objects that start in this time, in order."""

    def bag_files(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> dict[str, list[PastObject]]:
        """Files of bags that start on the dates of this time, by bag."""

    def problem(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> str:
        """What cannot be read of this time; empty if everything can."""

    def gaps(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> dict[str, Any]:
        """As ``SpoolFigures.gaps``."""


class PastContents:
    """The content of objects, from the spool or the store, whichever has it. Caches the last ones.

    Thread-safe except for ``close``.
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
            is_light = settings.endpoint_url and find_spec('obstore') is None  # a robot only has boto3
            self._store = open_store(settings, UploadSettings()) if is_light else open_reader(settings)
        return self._store

    def close(self) -> None:
        if self._store is not None:
            self._store.close()

    def get(self, one: PastObject, most: int = MAX_OBJECT_BYTES) -> bytes:
        """Raises StoreError, LakeError for an invalid key."""
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
        """The file, for reading in pieces. Raises BagDamaged, LakeError."""
        if one.path and os.path.isfile(one.path):  # noqa: PTH113 - never raises
            return LocalFile(Path(one.path))
        if not is_path(one.key):
            raise LakeError('the key of the object is not a path')
        return StoredFile(self.store, one.bucket, one.key, one.size)

    def manifest(self, files: Sequence[PastObject]) -> Manifest | None:
        """The manifest of a bag; None while the bag is incomplete, or if it is unreadable."""
        one = next((file for file in files if file.key.endswith(f'/{MANIFEST}')), None)
        if one is None:
            return None
        try:
            return Manifest.from_json(self.get(one, MAX_DOCUMENT_BYTES), one.key)
        except (BagDamaged, StoreError, LakeError):
            return None


class SpoolPast:
    """One robot's past, from the index of its spool."""

    def __init__(self, spool: Path, robot: str) -> None:
        self._spool, self._robot = spool, robot
        self._folder = lru_cache(64)(lambda state, reason, bucket: str(Tree(spool).path(State(state), reason, bucket, '')))
        self._clock = SystemClock.of_this_machine()
        self._blocks: OrderedDict[tuple[str, str, int], tuple[float, list[PastObject]]] = OrderedDict()
        self._bags: dict[tuple[str, str, str], tuple[float, dict[str, list[PastObject]]]] = {}
        self._missions: dict[tuple[str, str, str], PastMission] = {}
        self._battery: list[tuple[int, float]] = []

    def robots(self) -> list[str]:
        return [self._robot]

    def fleet(self) -> list[dict[str, Any]]:
        return []

    def days(self, robot: str) -> list[str]:
        """Raises SpoolError."""
        with closing(self._index()) as index, _reading(self._spool):
            return [f'{utc(number * DAY_NS):%Y-%m-%d}' for number in index.overview.recorded_days(robot)]

    def runs(self, robot: str, begin_ns: int, end_ns: int, grain_ns: int, by: str = BY_STAMP) -> list[Run]:
        """Reads only the first and the last object of each ``grain_ns``. Raises SpoolError."""
        found: list[Run] = []
        self._battery = []
        with closing(self._index()) as index, _reading(self._spool):
            for sensor in index.overview.sensors():
                if not _is_bookkeeping(sensor):
                    found += self._runs_of_sensor(index, robot, sensor, begin_ns, end_ns, grain_ns, by)
        return sorted(found, key=lambda run: (run.name, run.begin_ns))

    def _runs_of_sensor(self, index: Index, robot: str, sensor: str, begin_ns: int, end_ns: int, grain_ns: int,
                        by: str) -> Iterator[Run]:  # fmt: skip
        edge = partial(index.overview.edge, robot, sensor, by=by)
        at_ns = begin_ns - MAX_BATCH_NS
        while at_ns < end_ns and (first := edge(at_ns, end_ns, is_last=False)) is not None:
            at_ns = first[0] + grain_ns
            both = first, edge(first[0], min(at_ns, end_ns), is_last=True) or first
            ends_ns = [max(start_ns, (received_ns or start_ns) if by == BY_RECEIVED else last_ns)
                       for start_ns, _, last_ns, received_ns, *_ in both]  # fmt: skip
            for start_ns, _, _, _, _, _, _, mission, kind, battery in both:
                if (percent := _number(battery)) is not None:
                    self._battery.append((start_ns, percent))
                if mission:
                    self._widen(robot, by, PastMission(mission, kind or '', start_ns, max(ends_ns)))
            settled = [settled_ns for *_, settled_ns, _, _, _ in both if settled_ns is not None]
            yield Run(both[0][4] or sensor, first[0], max(ends_ns), max(settled, default=None),
                      any(row[5] == State.PENDING.value for row in both))  # fmt: skip

    def battery(self, *_: object) -> list[tuple[int, float]]:
        return sorted(self._battery)

    def _widen(self, robot: str, by: str, one: PastMission) -> None:
        known = self._missions.pop((robot, by, one.id), one)
        self._missions[robot, by, one.id] = PastMission(one.id, known.type or one.type, min(known.begin_ns, one.begin_ns),
                                                        max(known.end_ns, one.end_ns))  # fmt: skip
        while len(self._missions) > MAX_MISSIONS:
            del self._missions[next(iter(self._missions))]

    def missions(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> list[PastMission]:
        return [one for (of, clock, _), one in self._missions.items()
                if (of, clock) == (robot, by) and one.end_ns >= begin_ns and one.begin_ns <= end_ns]  # fmt: skip

    def between(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> list[PastObject]:
        """Read in blocks, which neighboring moments share. Raises SpoolError."""
        numbers = range(begin_ns // BLOCK_NS, (max(begin_ns, end_ns - 1)) // BLOCK_NS + 1)
        now_s, now_ns = time.monotonic(), self._clock.wall_ns()
        lacking = []
        for number in numbers:
            is_new = (number + 1) * BLOCK_NS > now_ns - 2 * BLOCK_NS
            known = self._blocks.get((robot, by, number))
            if known is None or now_s - known[0] > (FRESH_S if is_new else SETTLED_S):
                lacking.append(number)
        for first, last in consecutive(lacking):
            found: dict[int, list[PastObject]] = {number: [] for number in range(first, last + 1)}
            for one in self._read(robot, first * BLOCK_NS, (last + 1) * BLOCK_NS, by):
                found[one.begin_ns // BLOCK_NS].append(one)
            for number, block in found.items():
                self._blocks[robot, by, number] = now_s, block
        chosen = []
        for number in numbers:
            chosen += [one for one in self._blocks[robot, by, number][1] if begin_ns <= one.begin_ns < end_ns]
            self._blocks.move_to_end((robot, by, number))
        while len(self._blocks) > max(MAX_BLOCKS, len(numbers)):
            self._blocks.popitem(last=False)
        return chosen

    def _read(self, robot: str, begin_ns: int, end_ns: int, by: str) -> list[PastObject]:
        with closing(self._index()) as index, _reading(self._spool):
            sensors = [sensor for sensor in index.overview.sensors() if sensor != BAG_SENSOR]
            found = [self._from_row(row, by) for row in index.overview.recorded(robot, begin_ns, end_ns, by, sensors)]
        return sorted(found, key=lambda one: one.begin_ns)

    def bag_files(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> dict[str, list[PastObject]]:
        """Raises SpoolError."""
        found: dict[str, list[PastObject]] = {}
        now_s = time.monotonic()
        for date in dates_between(begin_ns, end_ns):
            known = self._bags.get((robot, by, date))
            if known is None or now_s - known[0] > FRESH_S:
                known = self._bags[robot, by, date] = now_s, _by_bag(self._read_bags(robot, date_ns(date), by))
            for bag, files in known[1].items():
                found.setdefault(bag, []).extend(files)
        while len(self._bags) > MAX_DAYS_KEPT:
            del self._bags[next(iter(self._bags))]
        return found

    def _read_bags(self, robot: str, begin_ns: int, by: str) -> list[PastObject]:
        end_ns = begin_ns + DAY_NS
        with closing(self._index()) as index, _reading(self._spool):
            return [self._from_row(row, by) for row in index.overview.recorded(robot, begin_ns, end_ns, by, [BAG_SENSOR])]

    def problem(self, *_: object) -> str:
        """Empty: an unreadable index is an error."""
        return ''

    def _from_row(self, row: tuple[Any, ...], by: str) -> PastObject:
        """From a row of ``OverviewTable.recorded``."""
        (bucket, key, state, reason, sensor, topic, kind, size, begin_ns, end_ns, received_ns, received_end_ns, mission,
         mission_type, pose, battery, content) = row  # fmt: skip
        late_ns = 0 if received_ns is None else received_ns - begin_ns
        offset_ns = late_ns if by == BY_RECEIVED else 0
        if offset_ns:
            begin_ns, end_ns = received_ns, received_end_ns or received_ns
        is_here = State(state) in STATES_IN_SPOOL
        path = f'{self._folder(state, reason, bucket)}/{key}' if is_here else ''
        return PastObject(
            bucket, content or key, sensor, topic or '', kind or '', size, begin_ns, max(begin_ns, end_ns), mission or '',
            mission_type or '', _pose(pose), _number(battery), late_ns, offset_ns, path,
        )  # fmt: skip

    def gaps(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> dict[str, Any]:
        """Raises SpoolError."""
        return SpoolFigures(self._spool, robot, self._clock).gaps(begin_ns, end_ns, by)

    def _index(self) -> Index:
        """Raises SpoolError if there is none."""
        path = self._spool / 'index.db'
        if not path.is_file():
            raise SpoolError(f'there is no spool in {self._spool}', remedy='has the node run here?')
        index = Index(path, read_only=True)
        index.open()
        return index


class StorePast:
    """The past of all robots with a catalog in the store that the environment names. It needs the extra ``lake``."""

    def __init__(self) -> None:
        """Raises LakeError without pyarrow, SettingError for invalid settings of a store."""
        if find_spec('pyarrow') is None:
            raise LakeError('the past of a store needs pyarrow', remedy='install the extra lake')
        from shadowhound_data_logger.lake.bucket import Bucket  # noqa: PLC0415 - the extra lake
        from shadowhound_data_logger.lake.findings import Findings  # noqa: PLC0415

        self._source = Bucket(store_settings(os.environ, home(os.environ)), catalog.BUCKET)
        self._findings = Findings(lambda _: None)
        self._kept: OrderedDict[str, tuple[float, PastDay]] = OrderedDict()

    def robots(self) -> list[str]:
        """Raises StoreError."""
        from shadowhound_data_logger.lake.row_files import robots  # noqa: PLC0415

        return robots(self._source)

    def fleet(self) -> list[dict[str, Any]]:
        """Raises StoreError, LakeError."""
        from shadowhound_data_logger.live.fleet import overview  # noqa: PLC0415 - the extra lake

        now_ns = time.time_ns()
        return [row.to_json(now_ns) for row in overview(self._source, self._findings, now_ns)]

    def days(self, robot: str) -> list[str]:
        """Raises StoreError."""
        from shadowhound_data_logger.lake.views import dates  # noqa: PLC0415

        found = dates(self._source, robot, (catalog.OBJECTS, catalog.KEPT), self._findings)
        return [date for date in found if date > catalog.UNDATED]

    def runs(self, robot: str, begin_ns: int, end_ns: int, grain_ns: int, by: str = BY_STAMP) -> list[Run]:
        """Raises StoreError."""
        days = self._days(robot, begin_ns - MAX_BATCH_NS, end_ns, by)
        return sorted(run for day in days for run in day.runs(begin_ns, end_ns, grain_ns))

    def missions(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> list[PastMission]:
        """Raises StoreError."""
        found: dict[str, PastMission] = {}
        for one in (one for day in self._days(robot, begin_ns, end_ns, by) for one in day.missions):
            known = found.get(one.id, one)
            found[one.id] = PastMission(
                one.id, known.type or one.type, min(known.begin_ns, one.begin_ns), max(known.end_ns, one.end_ns)
            )
        return list(found.values())

    def battery(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> list[tuple[int, float]]:
        """Raises StoreError."""
        return [each for day in self._days(robot, begin_ns, end_ns, by) for each in day.battery(begin_ns, end_ns)]

    def between(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> list[PastObject]:
        """Raises StoreError."""
        return [one for day in self._days(robot, begin_ns, end_ns, by) for one in day.between(begin_ns, end_ns)]

    def bag_files(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> dict[str, list[PastObject]]:
        """Raises StoreError."""
        found: dict[str, list[PastObject]] = {}
        for day in self._days(robot, begin_ns, end_ns, by):
            for bag, files in day.bag_files.items():
                found.setdefault(bag, []).extend(files)
        return found

    def problem(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> str:
        """Raises StoreError."""
        return next((day.problem for day in self._days(robot, begin_ns, end_ns, by) if day.problem), '')

    def _days(self, robot: str, begin_ns: int, end_ns: int, by: str) -> list[PastDay]:
        return [self._day(robot, date, by) for date in dates_between(begin_ns, end_ns)]

    def _day(self, robot: str, date: str, by: str) -> PastDay:
        """The cached day, read again after a while: it may continue, and older days still get objects."""
        name, now_s = f'{robot} {date} {by}', time.monotonic()
        known = self._kept.get(name)
        fresh_s = FRESH_S if date_ns(date) + 2 * DAY_NS > time.time_ns() else SETTLED_S
        if known is None or now_s - known[0] > fresh_s:
            known = self._kept[name] = (time.monotonic(), self._read(robot, date, by))
            while len(self._kept) > MAX_DAYS_KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(name)
        return known[1]

    def _read(self, robot: str, date: str, by: str) -> PastDay:
        from shadowhound_data_logger.lake.findings import Findings  # noqa: PLC0415 - the extra lake
        from shadowhound_data_logger.lake.views import rows_of  # noqa: PLC0415

        findings = Findings(lambda _: None)
        where, has_date = f"date = '{date}' AND t_start_ns IS NOT NULL", date.__eq__
        if by == BY_RECEIVED:  # the dates of rows are those of stamps
            begin_ns = date_ns(date)
            where, has_date = f't_start_ns >= {begin_ns} AND t_start_ns < {begin_ns + DAY_NS}', catalog.UNDATED.__ne__
        table = rows_of(self._source, catalog.OBJECTS, findings, robot=robot, has_date=has_date, where=where,
                        columns=_COLUMNS, order='t_start_ns, key', limit=MAX_ROWS, by=by)  # fmt: skip
        left = [f'{one.key}: {one.why}' for one in findings][:3]
        problem = f'{len(findings)} parts of the catalog cannot be read, such as {left[0]}' if left else ''
        return PastDay(table, problem or ('this day is incomplete' if len(table) >= MAX_ROWS else ''))

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
        return gap_rows(sorted(gaps, key=lambda gap: gap[4]), known, begin_ns, end_ns, time.time_ns())


# -- parts ---------------------------------------------------------------------------------------------------------


def date_ns(date: str) -> int:
    """Start of a date, UTC. Raises ValueError."""
    return int(datetime.strptime(date, '%Y-%m-%d').replace(tzinfo=timezone.utc).timestamp()) * SECOND


def dates_between(begin_ns: int, end_ns: int) -> list[str]:
    """The dates that a time overlaps."""
    first, last = utc(begin_ns).date(), utc(max(begin_ns, end_ns - 1)).date()
    return [str(first + timedelta(days=number)) for number in range((last - first).days + 1)]


@contextmanager
def _reading(spool: Path) -> Iterator[None]:
    try:
        yield
    except sqlite3.Error as error:
        raise SpoolError(f'the index of {spool} cannot be read: {error}') from error


def _is_bookkeeping(name: str) -> bool:
    """Whether a sensor has no data of the robot: bags are marked separately."""
    return not name or name in {BAG_SENSOR, 'missions'} or name.startswith('_')


def _by_bag(files: Iterable[PastObject]) -> dict[str, list[PastObject]]:
    found: dict[str, list[PastObject]] = {}
    for one in files:
        bag, slash, _ = one.key.partition('/rosbags/')[2].partition('/')
        if slash and (bag in found or len(found) < MAX_BAGS):
            found.setdefault(bag, []).append(one)
    return found


def consecutive(numbers: Sequence[int]) -> Iterator[tuple[int, int]]:
    """First and last of each run of consecutive numbers."""
    for index, number in enumerate(numbers):
        if not index or numbers[index - 1] != number - 1:
            first = number
        if index + 1 == len(numbers) or numbers[index + 1] != number + 1:
            yield first, number


def _from_catalog(row: Mapping[str, Any]) -> PastObject:
    pose = (row['x'], row['y'], row['yaw']) if None not in (row['x'], row['y'], row['yaw']) else None
    return PastObject(
        row['bucket'], row['key'], row['sensor'] or '', row['topic'] or '', row['type'] or '', row['bytes'], row['t_start_ns'],
        max(row['t_start_ns'], row['t_end_ns'] or 0), row['mission_id'] or '', row['mission_type'] or '', pose,
        row['battery_pct'], 0 if row['received_start_ns'] is None else row['received_start_ns'] - row['t_start_ns'],
        row['clock_offset_ns'] or 0,
    )  # fmt: skip


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
