"""``lake prune``: deletes objects that rules name, and keeps a row about each (``formats/rows/schema.py``, ``FORGOTTEN``).

In this order: a row file with those rows, statements of the gap journal, the commit of the rows to shared tables, the deletion
of the objects, and a mark next to the row file that says that they are deleted. So a run can be killed at any moment, and two can
run at a time: an object can be listed as deleted while it still exists, until the next run deletes it, but never the reverse.

What no rule names is kept, and so is what a dataset, a label or an open request of a robot's mailbox refers to. A bag, and what
a mission stored, is deleted completely or not at all.
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
from shadowhound_data_logger.core import metadata_words as words
from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.config import DEFAULT_SENSORS
from shadowhound_data_logger.core.errors import AccessDenied, BagDamaged, LakeError, ObjectRefused, SettingError
from shadowhound_data_logger.core.mailbox import KeptFilter
from shadowhound_data_logger.core.retry import steadily
from shadowhound_data_logger.core.times import moment
from shadowhound_data_logger.core.untrusted import MOST_DOCUMENT_BYTES
from shadowhound_data_logger.formats.rows import gaps as journal
from shadowhound_data_logger.formats.rows import parts
from shadowhound_data_logger.formats.rows.schema import BUCKET, FORGOTTEN, FORMAT_VERSION, Row, place_of
from shadowhound_data_logger.formats.rows.schema import OBJECTS as OBJECT_ROWS
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
"""Names of recordings in a rule; the manifest of a recording shows whether an event started it."""
BAG_SENSORS: Final = frozenset({'bag', 'rosbags'})
MISSIONS: Final = 'missions'
EXPORT, LABEL, REQUEST, UNTOLD = 'data set', 'label', 'request', 'no manifest'
"""Why an object that a rule names is kept."""
MOST_ROWS: Final = 10_000
"""Of a row file."""
MOST_NAMES: Final = 20
"""Listed per sensor."""
REPEATS: Final = '_repeats'
"""In the names of row files about repeats: their objects are named in other files, by which they are deleted."""
DELETED: Final = '.deleted'
"""Appended to the key of a row file whose objects are deleted."""
KIND, CAUSE = 'forgotten', 'retention'
"""Of the gaps."""
RULES: Final = "a text such as 'camera 90d, lidar 14d, events forever': a sensor and for how long to keep it, as often as needed"
DAY_NS: Final = 24 * HOUR_NS
_RULE: Final = re.compile(r'([A-Za-z0-9][\w-]*)\s+(\S+)', re.ASCII)
_DATE: Final = re.compile(r'(?<!\d)20\d{6}(?!\d)', re.ASCII)
_COLUMNS: Final = ('robot', 'sensor', 'topic', 'bucket', 'key', 'bytes', 't_start', 't_start_ns', 't_end_ns', 'count',
                   'mission_id', 'run_id', 'mission_type', 'x', 'y', 'latitude', 'longitude')  # fmt: skip


class RetentionRule(NamedTuple):
    """For how long the objects of a sensor are kept."""

    sensor: str
    text: str
    since_ns: int | None
    """Objects that ended before it are deleted; None: none."""


def keep_rules(text: str, now_ns: int) -> tuple[RetentionRule, ...]:
    """Raises SettingError for invalid rules."""
    found: dict[str, RetentionRule] = {}
    for part in text.split(','):
        match = _RULE.fullmatch(part.strip())
        if match is None:
            raise SettingError('--keep', text, RULES)
        sensor = BAGS if match[1] in BAG_SENSORS else match[1]
        if sensor in found:
            raise SettingError('--keep', text, f'one rule for each sensor, and there are two for {sensor}')
        since_ns = None if match[2] == FOREVER else moment('--keep', match[2], now_ns)
        if since_ns is not None and since_ns > now_ns:
            raise SettingError('--keep', text, f'a time that has passed, which {match[2]} has not')
        found[sensor] = RetentionRule(sensor, f'{sensor} {match[2]}', since_ns)
    return tuple(found.values())


@dataclass(slots=True)
class PrunedSensor:
    """What the store has of a sensor, and what of it will be deleted."""

    sensor: str
    rule: str = ''
    objects: int = 0
    bytes: int = 0
    going: int = 0
    going_bytes: int = 0
    protected: Counter[str] = field(default_factory=Counter)
    """Reason -> how many objects are kept that the rules would delete."""
    referrers: set[str] = field(default_factory=set)
    """The first of the datasets, labels and requests that refer to those."""

    @property
    def is_all(self) -> bool:
        """Whether nothing of it will be left."""
        return 0 < self.objects == self.going


class Protection:
    """What must be kept, whatever the rules are: objects and times to which something refers."""

    def __init__(self, exported: Mapping[tuple[str, str], str] | None = None, labelled: Iterable[labels.Label] = (),
                 requests: Mapping[str, Sequence[tuple[str, KeptFilter]]] | None = None) -> None:  # fmt: skip
        self._exported = exported or {}
        self._requests = requests or {}
        self._keys: dict[tuple[str, str], str] = {}
        self._spans: defaultdict[str, list[tuple[int, int, str]]] = defaultdict(list)
        for each in labelled:
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
        """Why an object is kept, and what refers to it; None if nothing does."""
        name = row['bucket'], row['key']
        if (data_set := self._exported.get(name)) is not None:
            return EXPORT, data_set
        if (label := self._keys.get(name) or self._label_of(row)) is not None:
            return LABEL, label
        metadata = {word: row[word] for word in (words.MISSION_ID, words.RUN_ID, words.MISSION_TYPE) if row[word] is not None}
        metadata |= place_of(row)
        begin_ns, end_ns = row['t_start_ns'], _end_ns(row)
        for request, want in self._requests.get(row['robot'], ()):
            if want.takes(row['key'], row['sensor'] or '', row['topic'], begin_ns, end_ns, metadata):
                return REQUEST, request
        return None

    def any_of(self, row: Row) -> tuple[str, str] | None:
        """The same for an object with its repeats."""
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
    """What a prune will do; ``apply`` does it."""

    rules: tuple[RetentionRule, ...]
    robots: tuple[str, ...]
    sensors: dict[str, PrunedSensor]
    is_forced: bool
    protection: Protection = field(repr=False)
    cut_ns: int = 0
    """To reach the size, objects that ended before this are deleted as well, of sensors whose rule is not ``forever``."""
    over_bytes: int = 0
    """How much the requested size is exceeded afterwards."""
    unfinished: int = 0
    """Row files of an earlier run, which may not have deleted all of their objects."""
    groups: dict[str, _Group] = field(repr=False, default_factory=dict)

    @property
    def going(self) -> int:
        return sum(each.going for each in self.sensors.values())

    @property
    def going_bytes(self) -> int:
        return sum(each.going_bytes for each in self.sensors.values())

    def known_sensors(self) -> tuple[str, ...]:
        """What a rule can name: the sensors with objects, and those that every robot and store can have."""
        there = [name for name, each in self.sensors.items() if each.objects]
        return (*there, *DEFAULT_SENSORS, BAGS, EVENTS, MISSIONS) if there else ()

    def lets_go(self, why: tuple[str, str] | None) -> bool:
        """Whether an object that the rules name is deleted although this protects it."""
        return why is None or (self.is_forced and why[0] != UNTOLD)

    def since_ns(self, sensor: str) -> int | None:
        """Objects of a sensor that ended before this are deleted; None: none."""
        found = next((rule.since_ns for rule in self.rules if rule.sensor == sensor), None)
        return None if found is None else max(found, self.cut_ns)


@dataclass(slots=True)
class Pruned:
    """What a prune did."""

    objects: int = 0
    bytes: int = 0
    mended: int = 0
    """Objects of an earlier run that it may not have deleted."""


def protection(source: Bucket, named: Sequence[str], exported: Mapping[tuple[str, str], str]) -> Protection:
    """What refers to data of these robots; ``exported`` maps (bucket, key) to the dataset that has values of it.

    Raises LakeError if a label or a mailbox cannot be read, because it is unknown what it refers to. Raises StoreError.
    """
    left_out = Findings(lambda _: None)
    found = [one for name in named for one in labels.read(source, name, findings=left_out)]
    for one in left_out:
        raise LakeError(f'the labels cannot be read: {one}', remedy='move the part away: nothing is deleted until they can')
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
         most_bytes: int | None = None, is_forced: bool = False, findings: Findings,
         tell: Callable[[str], None] = lambda _: None) -> PrunePlan:  # fmt: skip
    """What these rules delete and, if more than ``most_bytes`` is left, also the oldest days of the sensors that they name.

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
            for _ in pool.map(lambda group: _tell_events_apart(source, group), made.groups.values()):
                pass
    for group in made.groups.values():
        counts.add(group.sensor, group.objects, group.bytes, group.end_ns, lambda group=group: group.why)  # type: ignore[misc]
    if most_bytes is not None:
        counts.cut(most_bytes)
    made.unfinished = sum(len(_begun(source, name, findings)[1]) for name in named)
    return made


class _Counts:
    """Adds up what each sensor has, and what of it will be deleted."""

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
        is_free = self._made.lets_go(why)
        if end_ns < since_ns and why is not None:
            one.protected[why[0]] += objects
            if len(one.referrers) < MOST_NAMES:
                one.referrers.add(f'{why[0]} {why[1]}')
        if end_ns < since_ns and is_free:
            one.going += objects
            one.going_bytes += size
        elif is_free:
            day = self._younger[end_ns // DAY_NS].setdefault(sensor, [0, 0])
            day[0] += objects
            day[1] += size

    def cut(self, most_bytes: int) -> None:
        """Also delete the oldest days, until so much is left."""
        left = self.total - self._made.going_bytes
        for day in sorted(self._younger):
            if left <= most_bytes:
                break
            self._made.cut_ns = (day + 1) * DAY_NS
            for sensor, (objects, size) in self._younger[day].items():
                self._made.sensors[sensor].going += objects
                self._made.sensors[sensor].going_bytes += size
                left -= size
        self._made.over_bytes = max(0, left - most_bytes)


def apply(source: Bucket, store: ObjectStore, made: PrunePlan, *, now_ns: int, findings: Findings,
          tell: Callable[[str], None] = lambda _: None) -> Pruned:  # fmt: skip
    """Finish an earlier run, then do what was planned. Raises LakeError, StoreError: a later run continues."""
    done = Pruned()
    try:
        for robot in made.robots:
            done.mended += _settle(source, store, robot, findings, tell)
            for rows in _by_day(source, [robot], findings, tell):
                going = [row for row in rows if _goes(made, row)]
                _state_bags(store, made, going)
                _put_rows(store, made, robot, [each for row in going for each in row['repeats']], now_ns, REPEATS)
                _put_rows(store, made, robot, going, now_ns)
                done.objects += len(going)
                done.bytes += sum(row['bytes'] for row in going)
            _settle(source, store, robot, findings, tell)
    except AccessDenied as error:
        raise LakeError(f'these credentials may not prune: {error.what}',
                        remedy='use those of the user `prune` (docs/tower.md)') from error  # fmt: skip
    return done


def _put_rows(store: ObjectStore, made: PrunePlan, robot: str, rows: Iterable[Row], now_ns: int, mark: str = '') -> None:
    for _, date, numbered in parts.by_folder(enumerate(rows)):
        some = [_forgotten_row(made, row, now_ns) for _, row in numbered]
        for start in range(0, len(some), MOST_ROWS):
            part = some[start : start + MOST_ROWS]
            key = FORGOTTEN.part_key(robot, date, f'{date.replace("-", "")}{mark}_{_digest(part)}')
            put_part(store, key, robot, parts.encode(part, FORGOTTEN), len(part))


def _goes(made: PrunePlan, row: Row) -> bool:
    group = None if row['group'] is None else made.groups.get(row['group'])
    if row['group'] is not None and group is None:
        return False  # it was added after the plan was made
    sensor, end_ns = (row['name'], row['end_ns']) if group is None else (group.sensor, max(group.end_ns, row['end_ns']))
    since_ns = made.since_ns(sensor)
    if since_ns is None or end_ns >= since_ns:
        return False
    return made.lets_go(made.protection.any_of(row) if group is None else group.why)


def _by_day(source: Bucket, named: Sequence[str], findings: Findings, tell: Callable[[str], None]) -> Iterator[list[Row]]:
    """The rows of what the store has, the newest day of a robot first; each object once.

    Each with ``name`` (what a rule calls its sensor), ``group``, ``end_ns``, and as ``repeats`` the other rows that name it as
    their content: it is as old as the youngest of them.
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
    """``later`` has the rows of younger days whose key has another date than theirs; those of this day are added to it.

    Such a row is a repeat of an older object, or forged: nothing is deleted because of it alone.
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


def _tell_events_apart(source: Bucket, group: _Group) -> None:
    """By the manifest. A bag without one is kept: an event may have started it, or it may still be recorded."""
    if group.sensor != BAGS:
        return
    try:
        body = source.get(f'{group.prefix}manifest.json', MOST_DOCUMENT_BYTES)
        group.manifest = Manifest.from_json(body)
    except (ObjectRefused, BagDamaged):
        group.why = UNTOLD, group.prefix
        return
    group.sensor = BAGS if group.manifest.event is None else EVENTS


def _end_ns(row: Row) -> int:
    start_ns: int = row['t_start_ns']
    return max(start_ns, row['t_end_ns'] or start_ns)


def _key_ns(key: str) -> int:
    """The latest date in a key, 0 without one: a robot can write a row with an older time, but not another key."""
    return max((_begin_ns(date) for date in _DATE.findall(key)), default=0)


@lru_cache(maxsize=4096)
def _begin_ns(date: str) -> int:
    try:
        day = datetime.strptime(date, '%Y%m%d').replace(tzinfo=timezone.utc)
    except ValueError:
        return 0
    return round(day.timestamp()) * SECOND


def _forgotten_row(made: PrunePlan, row: Row, now_ns: int) -> Row:
    of = row['name'] if row['group'] is None else made.groups[row['group']].sensor
    rule = next(rule.text for rule in made.rules if rule.sensor == of)
    told = {name: row[name] for name in FORGOTTEN.columns if name in row}
    return {**told, 't_start': row['t_start_ns'] // 1000, 'rule': rule, 'forgotten': now_ns // 1000, 'forgotten_ns': now_ns,
            'format_version': FORMAT_VERSION}  # fmt: skip


def _digest(rows: Iterable[Row]) -> str:
    names = sorted(f'{row["bucket"]}/{row["key"]}' for row in rows)
    return hashlib.sha256('\n'.join(names).encode()).hexdigest()[:16]


def forgotten(source: Bucket, robot: str | None, findings: Findings) -> pa.Table:
    """What was deleted, with the columns of ``FORGOTTEN``, by time; each object once. Raises StoreError, LakeError."""
    return rows_of(source, FORGOTTEN, findings, robot=robot, order='t_start_ns, forgotten_ns')


def dates_of_deletion(rows: pa.Table) -> dict[tuple[str, str], str]:
    """(bucket, key) -> the UTC date on which it was deleted."""
    names = zip(rows['bucket'].to_pylist(), rows['key'].to_pylist(), strict=True)
    return dict(zip(names, (f'{utc(stamp_ns):%Y-%m-%d}' for stamp_ns in rows['forgotten_ns'].to_pylist()), strict=True))


# -- objects that are listed as deleted -----------------------------------------------------------------------------------------


def _settle(source: Bucket, store: ObjectStore, robot: str, findings: Findings, tell: Callable[[str], None]) -> int:
    """Delete what has a row and is not marked as deleted yet; how many objects that were."""
    files, unmarked = _begun(source, robot, findings)
    for date in sorted({file.date for file in unmarked}):
        _state(store, robot, source, [file for file in files if file.date == date], findings)
    tables = Tables.of(source)
    if tables.is_shared and unmarked:  # no reader of the tables alone may expect an object that is deleted
        ingest(source, tables, findings, pending(tables.open(INGESTED), unmarked))
    done = 0
    with ThreadPoolExecutor(THREADS, 'prune') as pool:
        for file in unmarked:
            keys: set[tuple[str, str]] = set()
            for found in read(source, [] if f'{REPEATS}_' in file.entry.key.rpartition('/')[2] else [file], findings):
                keys.update((row['bucket'], row['key']) for row in found.rows)
            tell(f'{robot}: deleting {len(keys):,} objects')
            for _ in pool.map(lambda pair: steadily(lambda: store.delete(*pair)), sorted(keys)):
                done += 1
            put_part(store, file.entry.key + DELETED, robot, b'{}\n', len(keys))
    return done


def _begun(source: Bucket, robot: str, findings: Findings) -> tuple[list[RowFile], list[RowFile]]:
    """The row files about deleted objects, and those of them that are not marked: some of their objects may still exist."""
    marks = {entry.key for entry in source.list(FORGOTTEN.prefix(robot)) if entry.key.endswith(DELETED)}
    files = row_files(source, findings, Scope((FORGOTTEN,), robot))
    return files, [file for file in files if file.entry.key + DELETED not in marks]


def _state(store: ObjectStore, robot: str, source: Bucket, files: Sequence[RowFile], findings: Findings) -> None:
    """Statements of the gap journal about the deleted objects of a date, one per topic and hour; the newest one counts."""
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


def _state_bags(store: ObjectStore, made: PrunePlan, going: Iterable[Row]) -> None:
    """For each bag that is deleted, one statement per topic, from its manifest, which is deleted as well."""
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
        said = '\n'.join(f'{row["id"]} {row["revision"]}' for row in part)
        name = f'{date.replace("-", "")}_{KIND}_{hashlib.sha256(said.encode()).hexdigest()[:16]}'
        put_part(store, journal.GAPS.part_key(robot, date, name), robot, parts.encode(part, journal.GAPS), len(part))
