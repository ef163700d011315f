"""``lake prune``: deletes objects by retention rules, and keeps a row about each (``formats/rows/catalog.py``, ``FORGOTTEN``).

It proceeds in this order: a row file with those rows, statements of the gap journal, the commit of the rows to shared tables, the
deletion of the objects, and a marker next to the row file. A run can be killed at any moment, and two can run at the same time:
an object can be listed as deleted while it still exists, until the next run deletes it, but never the reverse.

Objects of sensors without a rule are kept, and so are objects that a dataset, a label or an open request of a robot's mailbox
refers to. A bag, and the objects of a mission, are deleted completely or not at all.
"""

from __future__ import annotations

import hashlib
import re
from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import datetime, timezone
from functools import lru_cache
from itertools import groupby
from typing import Final, NamedTuple

import pyarrow as pa

from shadowhound_data_logger.bags.manifest import Manifest
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.config import DEFAULT_SENSORS
from shadowhound_data_logger.core.errors import AccessDenied, BagDamaged, LakeError, ObjectRefused, SettingError
from shadowhound_data_logger.core.mailbox import KeptFilter
from shadowhound_data_logger.core.retry import with_retries
from shadowhound_data_logger.core.times import moment
from shadowhound_data_logger.core.untrusted import MAX_DOCUMENT_BYTES
from shadowhound_data_logger.formats.rows import gaps as journal
from shadowhound_data_logger.formats.rows import parts
from shadowhound_data_logger.formats.rows.catalog import BUCKET, FORGOTTEN, FORMAT_VERSION, Row, place_of
from shadowhound_data_logger.formats.rows.catalog import OBJECTS as OBJECT_ROWS
from shadowhound_data_logger.lake import labels, pull
from shadowhound_data_logger.lake.bucket import THREADS, Bucket, put_part
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.gaps import HOUR_NS, OBJECTS
from shadowhound_data_logger.lake.ingest import ingest, pending
from shadowhound_data_logger.lake.row_files import RowFile, Scope, read, robots, row_files
from shadowhound_data_logger.lake.tables import INGESTED, Tables, answer, literal, quoted
from shadowhound_data_logger.lake.views import rows_of, views
from shadowhound_data_logger.stores.base import ObjectStore

FOREVER: Final = 'forever'
BAGS, EVENTS = 'bags', 'events'
"""Names of recordings in a rule; a recording's manifest shows whether an event started it."""
BAG_SENSORS: Final = frozenset({'bag', 'rosbags'})
MISSIONS: Final = 'missions'
EXPORT, LABEL, REQUEST, NO_MANIFEST = 'data set', 'label', 'request', 'no manifest'
"""Why an object that a rule would delete is kept."""
MAX_ROWS: Final = 10_000
"""Per row file."""
MAX_NAMES: Final = 20
"""Referrers listed per sensor."""
REPEATS: Final = '_repeats'
"""Part of the names of row files about repeats; other row files name the objects with their content, and cause the deletion."""
DELETED: Final = '.deleted'
"""Suffix of the marker next to a row file whose objects are deleted."""
KIND, CAUSE = 'forgotten', 'retention'
"""Kind and cause of the gaps."""
RULES: Final = "a text such as 'camera 90d, lidar 14d, events forever': a sensor and for how long to keep it, as often as needed"
DAY_NS: Final = 24 * HOUR_NS
_RULE: Final = re.compile(r'([A-Za-z0-9][\w-]*)\s+(\S+)', re.ASCII)
_DATE: Final = re.compile(r'(?<!\d)20\d{6}(?!\d)', re.ASCII)
_COLUMNS: Final = ('robot', 'sensor', 'topic', 'bucket', 'key', 'bytes', 't_start', 't_start_ns', 't_end_ns', 'count',
                   'mission_id', 'run_id', 'mission_type', 'x', 'y', 'latitude', 'longitude')  # fmt: skip


class RetentionRule(NamedTuple):
    """How long the objects of a sensor are kept."""

    sensor: str
    text: str
    since_ns: int | None
    """Objects that ended before this time are deleted; None: none."""


def keep_rules(text: str, now_ns: int) -> tuple[RetentionRule, ...]:
    """Parse rules such as ``camera 90d, events forever``. Raises SettingError."""
    found: dict[str, RetentionRule] = {}
    for part in text.split(','):
        match = _RULE.fullmatch(part.strip())
        if match is None:
            raise SettingError('--keep', text, RULES)
        sensor = BAGS if match[1] in BAG_SENSORS else match[1]
        if sensor in found:
            raise SettingError('--keep', text, f'one rule per sensor, but there are two for {sensor}')
        since_ns = None if match[2] == FOREVER else moment('--keep', match[2], now_ns)
        if since_ns is not None and since_ns > now_ns:
            raise SettingError('--keep', text, f'a time in the past, but {match[2]} is in the future')
        found[sensor] = RetentionRule(sensor, f'{sensor} {match[2]}', since_ns)
    return tuple(found.values())


@dataclass(slots=True)
class PrunedSensor:
    """The objects of a sensor in the store, and those of them that will be deleted."""

    sensor: str
    rule: str = ''
    objects: int = 0
    bytes: int = 0
    going: int = 0
    going_bytes: int = 0
    protected: Counter[str] = field(default_factory=Counter)
    """Reason -> number of objects that are kept although the rules would delete them."""
    referrers: set[str] = field(default_factory=set)
    """The first datasets, labels and requests that refer to these."""

    @property
    def is_all(self) -> bool:
        """Whether all objects of the sensor will be deleted."""
        return 0 < self.objects == self.going


class Protection:
    """Objects and times that must be kept regardless of the rules, because something refers to them."""

    def __init__(self, exported: Mapping[tuple[str, str], str] | None = None, labeled: Iterable[labels.Label] = (),
                 requests: Mapping[str, Sequence[tuple[str, KeptFilter]]] | None = None) -> None:  # fmt: skip
        self._exported = exported or {}
        self._requests = requests or {}
        self._keys: dict[tuple[str, str], str] = {}
        self._spans: defaultdict[str, list[tuple[int, int, str]]] = defaultdict(list)
        for each in labeled:
            if each.key is not None:
                self._keys[each.bucket or BUCKET, each.key] = each.label
            else:
                self._spans[each.robot].append((each.since_ns, each.until_ns, each.label))
        self._latest: dict[str, list[int]] = {}
        for robot, spans in self._spans.items():
            spans.sort()
            latest = 0
            self._latest[robot] = [latest := max(latest, until_ns) for _, until_ns, _ in spans]

    def why(self, row: Row) -> tuple[str, str] | None:
        """Why an object is kept, and what refers to it; None if it is not protected."""
        name = row['bucket'], row['key']
        if (dataset := self._exported.get(name)) is not None:
            return EXPORT, dataset
        if (label := self._keys.get(name) or self._label_of(row)) is not None:
            return LABEL, label
        metadata = {word: row[word] for word in (meta.MISSION_ID, meta.RUN_ID, meta.MISSION_TYPE) if row[word] is not None}
        metadata |= place_of(row)
        begin_ns, end_ns = row['t_start_ns'], _end_ns(row)
        for request, want in self._requests.get(row['robot'], ()):
            if want.matches(row['key'], row['sensor'] or '', row['topic'], begin_ns, end_ns, metadata):
                return REQUEST, request
        return None

    def any_of(self, row: Row) -> tuple[str, str] | None:
        """The same for an object and its repeats."""
        return next((found for each in (row, *row['repeats']) if (found := self.why(each)) is not None), None)

    def _label_of(self, row: Row) -> str | None:
        """The label of a time that the object overlaps."""
        spans, latest = self._spans.get(row['robot'], []), self._latest.get(row['robot'], [])
        first = bisect_left(latest, row['t_start_ns'])
        end_ns = _end_ns(row)
        for since_ns, until_ns, label in spans[first:]:
            if since_ns > end_ns:
                return None
            if until_ns >= row['t_start_ns']:
                return label
        return None


@dataclass(slots=True)
class PrunePlan:
    """The plan of a prune, which ``apply`` carries out."""

    rules: tuple[RetentionRule, ...]
    robots: tuple[str, ...]
    sensors: dict[str, PrunedSensor]
    is_forced: bool
    protection: Protection = field(repr=False)
    cut_ns: int = 0
    """To reach the size, objects that ended before this time are also deleted, if the rule of their sensor is not ``forever``."""
    over_bytes: int = 0
    """By how much the store exceeds the requested size afterwards."""
    unfinished: int = 0
    """Row files of an earlier run that may not have deleted all of their objects."""
    groups: dict[str, _Group] = field(repr=False, default_factory=dict)

    @property
    def going(self) -> int:
        return sum(each.going for each in self.sensors.values())

    @property
    def going_bytes(self) -> int:
        return sum(each.going_bytes for each in self.sensors.values())

    def known_sensors(self) -> tuple[str, ...]:
        """The names that a rule can have: the sensors with objects, and those that every robot and store can have."""
        there = [name for name, each in self.sensors.items() if each.objects]
        return (*there, *DEFAULT_SENSORS, BAGS, EVENTS, MISSIONS) if there else ()

    def may_delete(self, why: tuple[str, str] | None) -> bool:
        """Whether an object may be deleted in spite of this protection."""
        return why is None or (self.is_forced and why[0] != NO_MANIFEST)

    def since_ns(self, sensor: str) -> int | None:
        """The time before which objects of a sensor must have ended to be deleted; None: none is deleted."""
        found = next((rule.since_ns for rule in self.rules if rule.sensor == sensor), None)
        return None if found is None else max(found, self.cut_ns)


@dataclass(slots=True)
class Pruned:
    """The result of a prune."""

    objects: int = 0
    bytes: int = 0
    resumed: int = 0
    """Objects whose deletion an earlier run may not have finished."""


def protection(source: Bucket, named: Sequence[str], exported: Mapping[tuple[str, str], str]) -> Protection:
    """Find everything that refers to data of these robots; ``exported`` maps (bucket, key) to the dataset with its values.

    Raises LakeError if a label or a mailbox cannot be read, because then it is unknown what it refers to. Raises StoreError.
    """
    skipped = Findings(lambda _: None)
    found = [one for name in named for one in labels.read(source, name, findings=skipped)]
    for one in skipped:
        raise LakeError(f'the labels cannot be read: {one}', remedy='move that file away; until then nothing is deleted')
    requests = {name: [(each.id, each.want) for each in pull.unanswered(source, name)] for name in named}
    return Protection(exported, found, requests)


@dataclass(slots=True)
class _Group:
    """Objects that are deleted together: those of a bag, or of a mission."""

    sensor: str
    robot: str
    prefix: str
    begin_ns: int
    end_ns: int
    objects: int = 0
    bytes: int = 0
    why: tuple[str, str] | None = None
    manifest: Manifest | None = None


def plan(source: Bucket, rules: Sequence[RetentionRule], *, robot: str | None = None, exported: Mapping[tuple[str, str], str],  # noqa: PLR0913
         max_bytes: int | None = None, is_forced: bool = False, findings: Findings,
         tell: Callable[[str], None] = lambda _: None) -> PrunePlan:  # fmt: skip
    """Plan which objects these rules delete; if more than ``max_bytes`` would be left, also the oldest days of their sensors.

    Raises LakeError, StoreError.
    """
    named = tuple([robot] if robot else robots(source))
    made = PrunePlan(tuple(rules), named, {}, is_forced, protection(source, named, exported))
    for rule in rules:
        made.sensors[rule.sensor] = PrunedSensor(rule.sensor, rule.text)
    counts = _Counts(made)
    for rows in _by_day(source, named, findings, tell):
        for row in rows:
            counts.total += row['bytes']
            if row['group'] is None:
                counts.add(row['name'], 1, row['bytes'], row['end_ns'], lambda row=row: made.protection.any_of(row))  # type: ignore[misc]
            else:
                _grouped(made, row)
    if not {BAGS, EVENTS}.isdisjoint(made.sensors):
        with ThreadPoolExecutor(THREADS, 'prune') as pool:
            for _ in pool.map(lambda group: _read_manifest(source, group), made.groups.values()):
                pass
    for group in made.groups.values():
        counts.add(group.sensor, group.objects, group.bytes, group.end_ns, lambda group=group: group.why)  # type: ignore[misc]
    if max_bytes is not None:
        counts.cut(max_bytes)
    made.unfinished = sum(len(_unfinished(source, name, findings)[1]) for name in named)
    return made


class _Counts:
    """Counts the objects of each sensor, and those that will be deleted."""

    def __init__(self, made: PrunePlan) -> None:
        self._made = made
        self._younger: defaultdict[int, dict[str, list[int]]] = defaultdict(dict)
        self.total = 0
        """Bytes of all objects."""

    def add(self, sensor: str, objects: int, size: int, end_ns: int, ask_why: Callable[[], tuple[str, str] | None]) -> None:
        one = self._made.sensors.setdefault(sensor, PrunedSensor(sensor))
        one.objects += objects
        one.bytes += size
        since_ns = self._made.since_ns(sensor)
        if since_ns is None:
            return
        why = ask_why()
        is_free = self._made.may_delete(why)
        if end_ns < since_ns and why is not None:
            one.protected[why[0]] += objects
            if len(one.referrers) < MAX_NAMES:
                one.referrers.add(f'{why[0]} {why[1]}')
        if end_ns < since_ns and is_free:
            one.going += objects
            one.going_bytes += size
        elif is_free:
            day = self._younger[end_ns // DAY_NS].setdefault(sensor, [0, 0])
            day[0] += objects
            day[1] += size

    def cut(self, max_bytes: int) -> None:
        """Also delete the oldest days, until at most ``max_bytes`` are left."""
        left = self.total - self._made.going_bytes
        for day in sorted(self._younger):
            if left <= max_bytes:
                break
            self._made.cut_ns = (day + 1) * DAY_NS
            for sensor, (objects, size) in self._younger[day].items():
                self._made.sensors[sensor].going += objects
                self._made.sensors[sensor].going_bytes += size
                left -= size
        self._made.over_bytes = max(0, left - max_bytes)


def apply(source: Bucket, store: ObjectStore, made: PrunePlan, *, now_ns: int, findings: Findings,
          tell: Callable[[str], None] = lambda _: None) -> Pruned:  # fmt: skip
    """Finish an earlier run, then carry out the plan. Raises LakeError, StoreError; after an error, a later run continues."""
    done = Pruned()
    try:
        for robot in made.robots:
            done.resumed += _finish_deletion(source, store, robot, findings, tell)
            for rows in _by_day(source, [robot], findings, tell):
                going = [row for row in rows if _is_deleted(made, row)]
                _put_bag_statements(store, made, going)
                _put_rows(store, made, robot, [each for row in going for each in row['repeats']], now_ns, REPEATS)
                _put_rows(store, made, robot, going, now_ns)
                done.objects += len(going)
                done.bytes += sum(row['bytes'] for row in going)
            _finish_deletion(source, store, robot, findings, tell)
    except AccessDenied as error:
        raise LakeError(f'these credentials do not permit pruning: {error.what}',
                        remedy='use those of the user `prune` (docs/tower.md)') from error  # fmt: skip
    return done


def _put_rows(store: ObjectStore, made: PrunePlan, robot: str, rows: Iterable[Row], now_ns: int, mark: str = '') -> None:
    for _, date, numbered in parts.by_folder(enumerate(rows)):
        some = [_forgotten_row(made, row, now_ns) for _, row in numbered]
        for start in range(0, len(some), MAX_ROWS):
            part = some[start : start + MAX_ROWS]
            key = FORGOTTEN.part_key(robot, date, f'{date.replace("-", "")}{mark}_{_digest(part)}')
            put_part(store, key, robot, parts.encode(part, FORGOTTEN), len(part))


def _is_deleted(made: PrunePlan, row: Row) -> bool:
    group = None if row['group'] is None else made.groups.get(row['group'])
    if row['group'] is not None and group is None:
        return False  # it was added after the plan was made
    sensor, end_ns = (row['name'], row['end_ns']) if group is None else (group.sensor, max(group.end_ns, row['end_ns']))
    since_ns = made.since_ns(sensor)
    if since_ns is None or end_ns >= since_ns:
        return False
    return made.may_delete(made.protection.any_of(row) if group is None else group.why)


def _by_day(source: Bucket, named: Sequence[str], findings: Findings, tell: Callable[[str], None]) -> Iterator[list[Row]]:
    """The rows of all objects in the store, the newest day of each robot first; each object once.

    Each row has ``name`` (the sensor's name in rules), ``group``, ``end_ns``, and ``repeats``: the other rows with this object as
    their content. An object is as old as the youngest of them.
    """
    columns = ', '.join(map(quoted, _COLUMNS))
    for robot in named:
        later: defaultdict[tuple[str, str], list[Row]] = defaultdict(list)
        with views(source, [OBJECT_ROWS], findings, robot=robot) as ready:
            of_robot = f'robot = {literal(robot)} AND t_start IS NOT NULL AND t_start_ns IS NOT NULL'
            dates = answer(ready, f'SELECT DISTINCT date FROM all_objects WHERE {of_robot} ORDER BY date DESC')  # noqa: S608
            for date in dates['date'].to_pylist():
                tell(f'{robot} {date}')
                of_day = f'{of_robot} AND date = {literal(date)} ORDER BY t_start_ns'
                found = answer(ready, f'SELECT {columns} FROM all_objects WHERE {of_day}')  # noqa: S608
                yield list(_rows_of(found, robot, date, later))


def _rows_of(found: pa.Table, robot: str, date: str, later: defaultdict[tuple[str, str], list[Row]]) -> Iterator[Row]:
    """``later`` collects the rows of younger days whose key has another date than the row, including those of this day.

    Such a row is a repeat of an older object, or forged; on its own it never causes a deletion.
    """
    day = date.replace('-', '')
    own: dict[tuple[str, str], Row] = {}
    for row in found.to_pylist():
        object_name = row['bucket'], row['key']
        row['robot'] = robot
        row['name'], row['group'] = _group_of(row)
        if row['group'] is None and day not in row['key']:
            later[object_name].append(row)
        elif object_name in own:
            own[object_name]['repeats'].append(row)
        else:
            row['repeats'] = []
            own[object_name] = row
    for object_name, row in own.items():
        row['repeats'] += later.pop(object_name, ())
        row['end_ns'] = max(_key_ns(row['key']), *map(_end_ns, (row, *row['repeats'])))
        yield row


def _group_of(row: Row) -> tuple[str, str | None]:
    sensor = row['sensor'] or ''
    place = row['key'].split('/')
    if sensor in BAG_SENSORS:
        return BAGS, f'{row["bucket"]}/{"/".join(place[:3])}/' if len(place) > 3 else None
    if sensor == MISSIONS:
        return MISSIONS, f'{row["bucket"]}/{"/".join(place[:3])}/' if len(place) > 3 else None
    return sensor, None


def _grouped(made: PrunePlan, row: Row) -> None:
    group = made.groups.get(row['group'])
    if group is None:
        group = _Group(row['name'], row['robot'], row['group'].partition('/')[2], row['t_start_ns'], row['end_ns'])
        made.groups[row['group']] = group
    group.begin_ns, group.end_ns = min(group.begin_ns, row['t_start_ns']), max(group.end_ns, row['end_ns'])
    group.objects += 1
    group.bytes += row['bytes']
    group.why = group.why or made.protection.any_of(row)


def _read_manifest(source: Bucket, group: _Group) -> None:
    """Read the manifest of a bag, and whether an event started it.

    A bag without a manifest is kept: an event may have started it, or it may still be recorded.
    """
    if group.sensor != BAGS:
        return
    try:
        body = source.get(f'{group.prefix}manifest.json', MAX_DOCUMENT_BYTES)
        group.manifest = Manifest.from_json(body)
    except (ObjectRefused, BagDamaged):
        group.why = NO_MANIFEST, group.prefix
        return
    group.sensor = BAGS if group.manifest.event is None else EVENTS


def _end_ns(row: Row) -> int:
    start_ns: int = row['t_start_ns']
    return max(start_ns, row['t_end_ns'] or start_ns)


def _key_ns(key: str) -> int:
    """The latest date in a key, 0 without a date: a robot can forge the time in a row, but not the key of the object."""
    return max((_start_of_day_ns(date) for date in _DATE.findall(key)), default=0)


@lru_cache(maxsize=4096)
def _start_of_day_ns(date: str) -> int:
    try:
        day = datetime.strptime(date, '%Y%m%d').replace(tzinfo=timezone.utc)
    except ValueError:
        return 0
    return round(day.timestamp()) * SECOND


def _forgotten_row(made: PrunePlan, row: Row, now_ns: int) -> Row:
    of = row['name'] if row['group'] is None else made.groups[row['group']].sensor
    rule = next(rule.text for rule in made.rules if rule.sensor == of)
    kept = {name: row[name] for name in FORGOTTEN.columns if name in row}
    return {**kept, 't_start': row['t_start_ns'] // 1000, 'rule': rule, 'forgotten': now_ns // 1000, 'forgotten_ns': now_ns,
            'format_version': FORMAT_VERSION}  # fmt: skip


def _digest(rows: Iterable[Row]) -> str:
    names = sorted(f'{row["bucket"]}/{row["key"]}' for row in rows)
    return hashlib.sha256('\n'.join(names).encode()).hexdigest()[:16]


def forgotten(source: Bucket, robot: str | None, findings: Findings) -> pa.Table:
    """The deleted objects, with the columns of ``FORGOTTEN``, by time; each object once. Raises StoreError, LakeError."""
    return rows_of(source, FORGOTTEN, findings, robot=robot, order='t_start_ns, forgotten_ns')


def dates_of_deletion(rows: pa.Table) -> dict[tuple[str, str], str]:
    """(bucket, key) -> the UTC date on which it was deleted."""
    names = zip(rows['bucket'].to_pylist(), rows['key'].to_pylist(), strict=True)
    return dict(zip(names, (f'{utc(stamp_ns):%Y-%m-%d}' for stamp_ns in rows['forgotten_ns'].to_pylist()), strict=True))


# -- objects that are listed as deleted -----------------------------------------------------------------------------------------


def _finish_deletion(source: Bucket, store: ObjectStore, robot: str, findings: Findings, tell: Callable[[str], None]) -> int:
    """Delete the objects that are listed as deleted but not marked yet; returns their number."""
    files, unmarked = _unfinished(source, robot, findings)
    for date in sorted({file.date for file in unmarked}):
        _put_gap_statements(store, robot, source, [file for file in files if file.date == date], findings)
    tables = Tables.of(source)
    if tables.is_shared and unmarked:  # before the deletion: readers of the tables must not expect deleted objects
        ingest(source, tables, findings, pending(tables.open(INGESTED), unmarked))
    done = 0
    with ThreadPoolExecutor(THREADS, 'prune') as pool:
        for file in unmarked:
            keys: set[tuple[str, str]] = set()
            for found in read(source, [] if f'{REPEATS}_' in file.entry.key.rpartition('/')[2] else [file], findings):
                keys.update((row['bucket'], row['key']) for row in found.rows)
            tell(f'{robot}: deleting {len(keys):,} objects')
            for _ in pool.map(lambda pair: with_retries(lambda: store.delete(*pair)), sorted(keys)):
                done += 1
            put_part(store, file.entry.key + DELETED, robot, b'{}\n', len(keys))
    return done


def _unfinished(source: Bucket, robot: str, findings: Findings) -> tuple[list[RowFile], list[RowFile]]:
    """The row files about deleted objects, and those of them without a marker, whose objects may still exist."""
    marks = {entry.key for entry in source.list(FORGOTTEN.prefix(robot)) if entry.key.endswith(DELETED)}
    files = row_files(source, findings, Scope((FORGOTTEN,), robot))
    return files, [file for file in files if file.entry.key + DELETED not in marks]


def _put_gap_statements(store: ObjectStore, robot: str, source: Bucket, files: Sequence[RowFile], findings: Findings) -> None:
    """Upload statements of the gap journal about the deleted objects of a date, one per topic and hour; the newest counts."""
    hours: defaultdict[tuple[str, int], dict[tuple[str, str, int], Row]] = defaultdict(dict)
    for found_in in read(source, files, findings):
        for row in found_in.rows:
            if row['topic'] is not None:
                hours[row['topic'], row['t_start_ns'] // HOUR_NS][row['bucket'], row['key'], row['t_start_ns']] = row
    found = []
    for (topic, hour), of_hour in sorted(hours.items()):
        rows_of = list(of_hour.values())
        first, last = min(row['t_start_ns'] for row in rows_of), max(_end_ns(row) for row in rows_of)
        period_ns = (max(row['t_start_ns'] for row in rows_of) - first) // (len(rows_of) - 1) if len(rows_of) > 1 else SECOND
        counts = [row['count'] for row in rows_of]
        found.append(journal.statement(
            robot, journal.GAP, journal.name_of(KIND, OBJECTS, topic, hour), len(rows_of), sink=OBJECTS, topic=topic, kind=KIND,
            cause=CAUSE, from_ns=first, to_ns=max(last + 1, min(last + period_ns, (hour + 1) * HOUR_NS)),
            count=None if None in counts else sum(counts), grade='exact',
        ))  # fmt: skip
    _put_statements(store, robot, found)


def _put_bag_statements(store: ObjectStore, made: PrunePlan, going: Iterable[Row]) -> None:
    """For each deleted bag, upload one statement per topic, from its manifest, which is deleted as well."""
    for name in sorted({row['group'] for row in going if row['group'] is not None}):
        group = made.groups[name]
        if group.manifest is None:
            continue
        _put_statements(store, group.robot, [
            journal.statement(
                group.robot, journal.GAP, journal.name_of(KIND, group.sensor, one.topic, name), 1, sink=group.sensor,
                topic=one.topic, kind=KIND, cause=CAUSE, from_ns=group.begin_ns, to_ns=group.end_ns + 1, count=one.messages,
                grade='exact',
            ) for one in group.manifest.topics if one.messages
        ])  # fmt: skip


def _put_statements(store: ObjectStore, robot: str, found: Sequence[journal.Statement]) -> None:
    for date, rows in groupby(sorted(found, key=journal.date_of), journal.date_of):
        part = list(rows)
        ids = '\n'.join(f'{row["id"]} {row["revision"]}' for row in part)
        name = f'{date.replace("-", "")}_{KIND}_{hashlib.sha256(ids.encode()).hexdigest()[:16]}'
        put_part(store, journal.GAPS.part_key(robot, date, name), robot, parts.encode(part, journal.GAPS), len(part))
