"""When the numbers in the objects were so: from a condition such as ``imu.accelerometer.2 > 15`` to ranges of time.

A name is that of a sensor and of a field (encode/statistics.py), or what several fields begin with: then any of them will do.
A plain name is about each message; ``max(...)`` and the other statistics are about each object, a batch of messages, as a whole.
``and``, ``or`` and parentheses join comparisons. What is missing, NaN or infinite compares as false.

The statistics in the catalogue say of most objects that all or none of their messages meet the condition. Only the others are
opened, and what they say counts: the answer is that of a loop over all messages.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from shadowhound_data_logger.catalogue.statistics import STATISTICS
from shadowhound_data_logger.clock import SECOND
from shadowhound_data_logger.conditions import COMPARISONS, NUMBER
from shadowhound_data_logger.encode.image import of_jpeg
from shadowhound_data_logger.encode.pointcloud import of_points
from shadowhound_data_logger.encode.records import AT_ONCE
from shadowhound_data_logger.encode.statistics import (
    ALL,
    MEAN_ERROR,
    NUMBERS,
    FieldStatistics,
    Statistic,
    covers,
    values_of,
)
from shadowhound_data_logger.errors import DataLoggerError, LakeError, ObjectRefused, SettingError
from shadowhound_data_logger.lake import query
from shadowhound_data_logger.lake.bucket import THREADS, Bucket
from shadowhound_data_logger.lake.decode import cloud_points, extension_of, records
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.gaps import OBJECTS, newest, watermarks
from shadowhound_data_logger.lake.reading import arrow_schema, narrow, tables
from shadowhound_data_logger.lake.scan import folders
from shadowhound_data_logger.lake.select import LONGEST_BATCH_NS, TimeSpan, Wanted, wanted
from shadowhound_data_logger.untrusted import MOST_OBJECT_BYTES

ALLOWED: Final = (
    "comparisons such as 'imu.accelerometer.2 > 15' or 'max(states.foot_force) > 200': sensor.field, or one of first last min "
    'max mean count nan_count of it, then < <= > >= = != and a number; joined by and, or and parentheses'
)
JOIN_S: Final = 1.0
"""What is no further apart is one range."""
OPENED_AT_A_TIME: Final = 64
MOST_LEAVES: Final = 32
MOST_TEXT: Final = 10_000
"""Of a condition."""
MOST_SHOWN: Final = 200
"""Of one that is refused."""
_PATH: Final = r'[A-Za-z_][\w-]*(?:\.(?:\w+|\*))+'
_COMPARISON: Final = re.compile(
    rf'\s*(?:(?P<function>{"|".join(NUMBERS)})\s*\(\s*(?P<inner>{_PATH})\s*\)|(?P<plain>{_PATH}))'
    rf'\s*(?P<sign><=|>=|==|!=|<>|<|>|=)\s*(?P<number>{NUMBER})(?![\w.])', re.ASCII,
)  # fmt: skip
_WORD: Final = re.compile(r'\s*(and\b|or\b|\(|\)|$)', re.ASCII | re.IGNORECASE)
_IS_VALUE: Final = re.compile(rf'(?<![\w.]){_PATH}', re.ASCII)
_TEXT: Final = re.compile(r"'[^']*'")
_TINY: Final = 2.0**-140
"""Beyond what separates the least float32 from its decimal."""
_SIGNS: Final = {'=': '==', '<>': '!='}
_JSON, _JPEG, _PCD = 'json', 'jpg', 'pcd'
_KEY: Final = ('bucket', 'key', 't_start_ns')
_TIMES: Final = ('robot', 'topic', 't_start_ns', 't_end_ns', 'count')
_OBJECT: Final = (*_TIMES, 'bucket', 'key')
_WHOLE: Final = ('t_start_ns', 'field', 'count', 'nan_count')
_STATISTIC: Final = (*_KEY, 'field', *NUMBERS)
Bound = tuple[str, float, float]
Mask = NDArray[np.bool_]


class Comparison(NamedTuple):
    """A field of a sensor against a number; ``function`` is empty where it is about each message."""

    function: str
    sensor: str
    field: str
    sign: str
    number: float

    def holds(self, values: Any) -> Any:
        """Of a number or an array; NaN never does."""
        return COMPARISONS[self.sign](values, self.number) & (values == values)  # noqa: PLR0124 - false for NaN alone


class Joined(NamedTuple):
    """Expressions, of which all must hold (``and``) or any (``or``)."""

    word: str
    parts: tuple[Comparison | Joined, ...]


Expression = Comparison | Joined


@dataclass(frozen=True, slots=True)
class Range:
    """A time in which messages met the condition: from the first to the last of them."""

    robot: str
    sensor: str
    since_ns: int
    until_ns: int
    """Inclusive."""
    messages: int


@dataclass(frozen=True, slots=True)
class Freshness:
    """Up to when a stream is in the answer. None: not known."""

    robot: str
    topic: str
    newest_ns: int | None
    """End of the newest object that the catalogue has."""
    complete_ns: int | None
    """The watermark: what was lost before is in the gap journal."""

    @property
    def fresh_ns(self) -> int | None:
        """What was stored or lost until then is known here; an object that is still on the robot comes later."""
        known = [each for each in (self.newest_ns, self.complete_ns) if each is not None]
        return min(known) if len(known) == 2 else None


@dataclass(frozen=True, slots=True)
class ValueAnswer:
    """When a condition held, and what was looked at to find out."""

    ranges: tuple[Range, ...]
    objects: int
    """Of the sensor, in the time that was asked for."""
    opened: int
    unknown: int
    """Without statistics of these fields, and not opened: the condition may hold in them as well."""
    fresh: tuple[Freshness, ...]
    fields: tuple[str, ...] = ()
    """Where a field is in no object: those that are there."""


def is_about_values(text: str) -> bool:
    """Whether a ``--where`` is a condition on values, and not SQL over the columns of the catalogue, which have no dots."""
    return _IS_VALUE.search(_TEXT.sub('', text)) is not None


def parse(text: str) -> Expression:
    """Raises SettingError."""
    if len(text) > MOST_TEXT:
        raise SettingError('where', f'{text[:80]}...', f'at most {MOST_TEXT:,} letters')
    found, at = _any(text, 0, 0)
    if text[at:].strip():
        raise SettingError('where', text[:MOST_SHOWN], ALLOWED)
    asked = leaves(found)
    if len(asked) > MOST_LEAVES:
        raise SettingError('where', text[:MOST_SHOWN], f'at most {MOST_LEAVES} comparisons')
    sensors = {each.sensor for each in asked}
    if len(sensors) > 1:
        raise SettingError('where', text[:MOST_SHOWN], f'one sensor at a time, not {" and ".join(sorted(sensors))}: write the '
                           'ranges of one with --json to a file, and ask for the other with --ranges')  # fmt: skip
    return found


def leaves(expression: Expression) -> list[Comparison]:
    """All comparisons, from left to right."""
    if isinstance(expression, Comparison):
        return [expression]
    return [leaf for part in expression.parts for leaf in leaves(part)]


def _any(text: str, at: int, depth: int) -> tuple[Expression, int]:
    return _joined('or', text, at, depth)


def _joined(word: str, text: str, at: int, depth: int) -> tuple[Expression, int]:
    parts: list[Expression] = []
    while True:
        part, at = _joined('and', text, at, depth) if word == 'or' else _one(text, at, depth)
        parts.append(part)
        after = _WORD.match(text, at)
        if after is None or after[1].lower() != word or len(parts) >= MOST_LEAVES:
            return parts[0] if len(parts) == 1 else Joined(word, tuple(parts)), at
        at = after.end()


def _one(text: str, at: int, depth: int) -> tuple[Expression, int]:
    if found := _COMPARISON.match(text, at):
        sensor, _, name = (found['inner'] or found['plain']).partition('.')
        sign = _SIGNS.get(found['sign'], found['sign'])
        return Comparison(found['function'] or '', sensor, name, sign, float(found['number'])), found.end()
    bracket = _WORD.match(text, at)
    if bracket is None or bracket[1] != '(' or depth >= MOST_LEAVES:
        raise SettingError('where', text[:MOST_SHOWN], ALLOWED)
    inner, at = _any(text, bracket.end(), depth + 1)
    close = _WORD.match(text, at)
    if close is None or close[1] != ')':
        raise SettingError('where', text[:MOST_SHOWN], ALLOWED)
    return inner, close.end()


# -- the question --------------------------------------------------------------------------------------------------------------


def ranges(condition: str, source: Bucket | None = None, *, scan: bool = False, join_s: float = JOIN_S, pad_s: float = 0.0,
           findings: Findings | None = None, **flags: Any) -> ValueAnswer:  # fmt: skip
    """When a condition held; ``flags`` are those of ``lake.objects`` and choose objects of its sensor.

    ``scan`` opens objects without statistics as well. Ranges at most ``join_s`` apart are one, and each gets ``pad_s`` before and
    after it. Raises SettingError, LakeError for what is not a question, StoreError.
    """
    expression = parse(condition)
    sensor = leaves(expression)[0].sensor
    if flags.get('sensor', sensor) != sensor:
        raise SettingError('sensor', flags['sensor'], f'{sensor}, of which the condition is; leave it out')
    findings = Findings() if findings is None else findings
    source = source or query.default_source()
    flags = {**flags, 'sensor': sensor}
    asked = query.labelled(source, wanted(time.time_ns(), **flags), findings)
    rows, statistics, objects = _candidates(source, asked, flags, expression, findings)
    told = _Told(rows, statistics, findings)
    may, must, is_known = told.judged(expression)
    to_open = np.flatnonzero(may & ~must & (is_known | scan))
    found = [*_whole(rows, np.flatnonzero(must), sensor)]
    unread = int(np.count_nonzero(may & ~must & ~is_known)) if not scan else 0
    for number, some in _opened(source, rows, to_open, expression, findings):
        if some is None:
            unread += 1
        else:
            found += [Range(rows['robot'][number].as_py(), sensor, *each) for each in some]
    joined = _joined_ranges(found, round(join_s * SECOND))
    for chosen in asked.chosen:
        joined = joined if chosen.keys else _clipped(joined, chosen.spans)
    padded = _joined_ranges((replace(each, since_ns=each.since_ns - round(pad_s * SECOND), until_ns=each.until_ns + round(
        pad_s * SECOND)) for each in joined), 0) if pad_s else joined  # fmt: skip
    return ValueAnswer(tuple(padded), len(objects), len(to_open), unread, tuple(_freshness(source, asked, objects, findings)),
                  () if found or unread else tuple(_fields_instead(source, asked, expression, objects, findings)))  # fmt: skip


def _candidates(source: Bucket, asked: Wanted, flags: Mapping[str, Any], expression: Expression,
                findings: Findings) -> tuple[pa.Table, pa.Table, pa.Table]:  # fmt: skip
    """The objects that have to be judged, their statistics, and the times of all objects.

    Where every object has statistics of all its fields, those that first comparisons rule out are left out, and most row groups
    are not even read. Keys and names make most of a part's bytes: they are read only where an object has to be told by them.
    """
    times = _catalogue(source, flags, _TIMES, findings)
    whole = _read_all(source, asked, findings, (ALL, ALL), _WHOLE)
    is_plain = len(pc.unique(times['robot'])) == 1 and not pc.any(pc.greater(whole['nan_count'], 0)).as_py()
    stamps, told = np.sort(_stamps(times)), np.sort(_stamps(whole))
    if is_plain and np.array_equal(stamps, told) and (np.diff(stamps) > 0).all():
        return *_led(source, asked, expression, findings, times, whole), times
    rows = _catalogue(source, flags, _OBJECT, findings).sort_by([('robot', 'ascending'), ('t_start_ns', 'ascending')])
    return rows, _statistics(source, asked, leaves(expression), findings), times


def _led(source: Bucket, asked: Wanted, expression: Expression, findings: Findings, times: pa.Table,
         whole: pa.Table) -> tuple[pa.Table, pa.Table]:  # fmt: skip
    """The objects for which the first comparisons may hold, each told from all others by its time, and their statistics."""
    leads = _leads(expression)
    of_leads = []
    for lead in dict.fromkeys(leads):
        first = _statistics(source, asked, [lead], findings, _bounds_of(lead))
        told = {name: _numbers(first, name) for name in NUMBERS}
        some, _ = _by_statistics(lead, told)
        of_leads.append(first.filter(pa.array(some | _contradictory(told))))
    chosen = np.unique(_stamps(pa.concat_tables(of_leads)))
    others = [leaf for leaf in leaves(expression) if leaf not in leads]
    found = pa.concat_tables([*of_leads, *([_only_at(_statistics(source, asked, others, findings), chosen)] if others else [])])
    keys = found.select(['bucket', 'key', 't_start_ns']).group_by(list(_KEY)).aggregate([])
    objects = _only_at(times, chosen).join(keys, keys='t_start_ns', join_type='inner')
    common = _only_at(whole, chosen).join(keys, keys='t_start_ns', join_type='inner')
    nothing = {name: pa.nulls(len(common), pa.float64()) for name in ('first', 'last', 'min', 'max', 'mean')}
    wholes = pa.table({**{name: common[name] for name in common.column_names}, **nothing}).select(_STATISTIC)
    objects = objects.select([name for name in _OBJECT if name in objects.column_names])
    return objects.sort_by('t_start_ns').combine_chunks(), pa.concat_tables([found, wholes.cast(found.schema)]).combine_chunks()


def _leads(expression: Expression) -> list[Comparison]:
    """Comparisons of which at least one must hold for the expression to hold: as few as there are."""
    if isinstance(expression, Comparison):
        return [expression]
    found = [_leads(part) for part in expression.parts]
    return min(found, key=len) if expression.word == 'and' else [lead for part in found for lead in part]


def _bounds_of(leaf: Comparison) -> tuple[Bound, ...]:
    """What a statistic must be at least and at most where the comparison may hold."""
    name = leaf.function or {'>': 'max', '>=': 'max', '<': 'min', '<=': 'min'}.get(leaf.sign)
    if name is None or leaf.sign in {'==', '!='} or name in {'count', 'nan_count', 'mean'}:
        return ()
    low, high = (leaf.number, math.inf) if leaf.sign in {'>', '>='} else (-math.inf, leaf.number)
    return ((name, low, high),)


def _catalogue(source: Bucket, flags: Mapping[str, Any], columns: Sequence[str], findings: Findings) -> pa.Table:
    with query.answering():
        found = query.objects(source, findings=findings, **flags).select(*columns, 't_start').to_arrow()
    found = found.cast(narrow([*columns, 't_start'])).combine_chunks()
    return found.filter(pc.is_valid(found['t_start'])).select(columns)


def _stamps(table: pa.Table) -> NDArray[np.int64]:
    return np.asarray(table['t_start_ns'].to_numpy())


def _only_at(table: pa.Table, stamps: NDArray[np.int64]) -> pa.Table:
    return table.filter(pc.is_in(table['t_start_ns'], value_set=pa.array(stamps)))


def _statistics(source: Bucket, asked: Wanted, of: Sequence[Comparison], findings: Findings,
                bounds: tuple[Bound, ...] | None = None) -> pa.Table:  # fmt: skip
    """The rows of the fields that are asked for; without bounds those of the objects as a whole, too."""
    names = sorted({each.field for each in of})
    is_wide = bounds is None
    found = [arrow_schema(STATISTICS).empty_table().select(_STATISTIC)]
    for table in _read(source, asked, findings, (ALL if is_wide else names[0], f'{names[-1]}.\U0010ffff'), bounds=bounds or ()):
        kept = pc.equal(table['field'], ALL) if is_wide else pa.scalar(value=False)
        for name in names:
            kept = pc.or_(kept, pc.or_(pc.equal(table['field'], name), pc.starts_with(table['field'], f'{name}.')))
        found.append(table.filter(kept).select(_STATISTIC))
    return pa.concat_tables(found).combine_chunks()


def _read_all(source: Bucket, asked: Wanted, findings: Findings, names: tuple[str, str], columns: Sequence[str]) -> pa.Table:
    nothing = arrow_schema(STATISTICS).empty_table().select(columns)
    found = (
        table.filter(pc.equal(table['field'], ALL)).select(columns) for table in _read(source, asked, findings, names, columns)
    )
    return pa.concat_tables([nothing, *found]).combine_chunks()


def _read(source: Bucket, asked: Wanted, findings: Findings, names: tuple[str, str], columns: Sequence[str] = (),
          bounds: tuple[Bound, ...] = ()) -> Iterator[pa.Table]:  # fmt: skip
    """The statistics of a sensor in the time that is asked for, of fields whose names lie between two."""
    found = folders(source, asked, findings, STATISTICS)
    entries = [entry for day in sorted(found, key=lambda day: day.robot) for entry in day.entries]
    narrowed = Wanted(robot=asked.robot, sensor=asked.sensor, since_ns=asked.since_ns, until_ns=asked.until_ns,
                      bounds=(('field', *names), *bounds))  # fmt: skip
    for table in tables(source, entries, ('sensor', *(columns or _STATISTIC)), findings, narrowed, STATISTICS):
        kept = pc.equal(table['sensor'], asked.sensor)
        for low, keep in ((asked.since_ns, pc.greater_equal), (asked.until_ns, pc.less)):
            if low is not None:
                kept = pc.and_(kept, keep(table['t_start_ns'], low))
        yield table.filter(pc.fill_null(kept, fill_value=False))


def _fields_instead(source: Bucket, asked: Wanted, expression: Expression, objects: pa.Table, findings: Findings) -> list[str]:
    """The fields of the newest objects, where one that is asked for is not among them."""
    newest_ns = pc.max(objects['t_start_ns']).as_py()
    if newest_ns is None:
        return []
    found: set[str] = set()
    for table in _read(source, replace(asked, since_ns=newest_ns - LONGEST_BATCH_NS), findings, (ALL, '\U0010ffff')):
        found.update(pc.unique(table['field']).to_pylist())
    found -= {ALL}
    is_there = all(any(covers(leaf.field, name) for name in found) for leaf in leaves(expression))
    return [] if is_there else sorted(found)


class _Told:
    """What the statistics say of each object, by its row."""

    def __init__(self, rows: pa.Table, statistics: pa.Table, findings: Findings) -> None:
        self._objects = len(rows)
        numbered = rows.select(_KEY).append_column('_row', pa.array(np.arange(len(rows)), pa.int64()))
        found = statistics.join(numbered, keys=list(_KEY), join_type='inner').combine_chunks()
        self._rows = _numbers(found, '_row').astype(np.int64)
        encoded = found['field'].combine_chunks().dictionary_encode()
        if isinstance(encoded, pa.ChunkedArray):
            encoded = encoded.combine_chunks()
        self._names: list[str] = encoded.dictionary.to_pylist()
        self._fields = np.asarray(encoded.indices)
        self._values = {name: _numbers(found, name) for name in NUMBERS}
        whole = self._of(lambda name: name == ALL)
        self._messages = np.zeros(self._objects)
        self._messages[self._rows[whole]] = self._values['count'][whole]
        self._has = np.zeros(self._objects, bool)
        self._has[self._rows[whole]] = True
        self._left_out = np.zeros(self._objects, bool)
        self._left_out[self._rows[whole]] = self._values['nan_count'][whole] > 0
        self._false = ~whole & _contradictory(self._values)
        self._has[self._rows[self._false]] = False
        for key in pc.unique(found['key'].filter(pa.array(self._false))).to_pylist():
            findings.add(key, 'its statistics contradict each other')

    def judged(self, expression: Expression) -> tuple[Mask, Mask, Mask]:
        """Whether the condition may hold in an object; must hold in all of it; may hold by what is known alone."""
        if isinstance(expression, Comparison):
            may, must, unknown = self._leaf(expression)
            return may | unknown, must, may
        join = np.logical_and if expression.word == 'and' else np.logical_or
        parts = [self.judged(part) for part in expression.parts]
        may, must, known = (reduce(join, each) for each in zip(*parts, strict=True))
        return may, must, known

    def _of(self, wanted_name: Any) -> Mask:
        codes = [code for code, name in enumerate(self._names) if wanted_name(name)]
        return np.isin(self._fields, codes)

    def _leaf(self, leaf: Comparison) -> tuple[Mask, Mask, Mask]:
        chosen = self._of(lambda name: name != ALL and covers(leaf.field, name)) & ~self._false
        is_exact = self._of(lambda name: name == leaf.field)
        is_scalar = ~self._of(lambda name: '*' in name.split('.'))
        rows = self._rows[chosen]
        some, every = _by_statistics(leaf, {name: values[chosen] for name, values in self._values.items()})
        if not leaf.function:
            messages, count = self._messages[rows], self._values['count'][chosen]
            is_one_each = (count == messages) & (self._values['nan_count'][chosen] == 0) & is_scalar[chosen]
            # Of a single message any of its values will do, and where they are told by their ends one of the two is it.
            every = (every & is_one_each) | (some & (messages == 1) & (leaf.sign != '=='))
        may, must, exact = (np.zeros(self._objects, bool) for _ in range(3))
        may[rows[some]] = True
        must[rows[every]] = True
        exact[self._rows[is_exact]] = True
        return may, must, ~self._has | (self._left_out & ~exact)


def _by_statistics(leaf: Comparison, values: Mapping[str, NDArray[np.float64]]) -> tuple[Mask, Mask]:
    """Whether it holds for some of the numbers, and for all; of a statistic both are one, but for a mean that is near."""
    low, high, number = values['min'], values['max'], leaf.number
    if leaf.function and leaf.function != 'mean':
        found: Mask = leaf.holds(values[leaf.function])
        return found, found
    if leaf.function:
        reach = MEAN_ERROR * np.maximum(np.abs(low), np.abs(high)) + _TINY
        mean = values['mean']
        is_open = np.isnan(mean) & (values['count'] > 0)  # the sum has no double, or not in that order
        low, high = np.where(is_open, -np.inf, mean - reach), np.where(is_open, np.inf, mean + reach)
    if leaf.sign == '==':
        return (low <= number) & (number <= high), (low == number) & (number == high)
    if leaf.sign == '!=':
        return leaf.holds(low) | leaf.holds(high), (number < low) | (high < number)
    some, every = (high, low) if leaf.sign in {'>', '>='} else (low, high)
    return leaf.holds(some), leaf.holds(every)


def _contradictory(values: Mapping[str, NDArray[np.float64]]) -> Mask:
    """Of statistics of fields: which cannot be true."""
    low, high, count = values['min'], values['max'], values['count']
    found: Mask = (low > high) | (count < 0) | (values['nan_count'] < 0) | ((count > 0) & (np.isnan(low) | np.isnan(high)))
    for name in ('first', 'last'):
        found |= (values[name] < low) | (values[name] > high)
    return found


def _numbers(table: pa.Table, name: str) -> NDArray[np.float64]:
    """Null is NaN."""
    return np.asarray(table[name].cast(pa.float64(), safe=False).to_numpy())


# -- opened --------------------------------------------------------------------------------------------------------------------


_Run = tuple[int, int, int]
"""First and last stamp of messages that follow each other, and how many they are."""


def _opened(source: Bucket, rows: pa.Table, numbers: NDArray[np.intp], expression: Expression,
            findings: Findings) -> Iterator[tuple[int, list[_Run] | None]]:  # fmt: skip
    """The runs in each of these objects; None where it cannot be read."""

    def body(row: dict[str, Any]) -> bytes | DataLoggerError:
        try:
            return Bucket(source.settings, row['bucket']).get(row['key'], MOST_OBJECT_BYTES)
        except ObjectRefused as error:
            return error

    with ThreadPoolExecutor(THREADS, 'lake-values') as pool:
        for start in range(0, len(numbers), OPENED_AT_A_TIME):
            some = [int(number) for number in numbers[start : start + OPENED_AT_A_TIME]]
            asked = rows.take(some).to_pylist()
            for number, row, content in zip(some, asked, pool.map(body, asked), strict=True):
                try:
                    if isinstance(content, DataLoggerError):
                        raise content
                    yield number, list(_runs(row, content, expression))
                except DataLoggerError as error:
                    findings.add(row['key'], str(error))
                    yield number, None


def _runs(row: Mapping[str, Any], body: bytes, expression: Expression) -> Iterator[_Run]:
    """Raises LakeError."""
    extension = extension_of(row['key'])
    if extension == _JSON:
        messages = records(body)
        stamps = np.array([each['stamp_ns'] for each in messages], np.int64)
        met = _met(expression, messages)
    elif extension in {_JPEG, _PCD}:
        points = cloud_points(body) if extension == _PCD else None
        found = statistics_of(row['key'], body)
        stamps, met = np.zeros(1, np.int64), np.array([_met_by(expression, found, points)])
    else:
        raise LakeError(f'values cannot be looked for in a .{extension}', remedy='store the sensor as json, jpeg or pcd')
    if not len(stamps):
        return
    order = np.argsort(stamps, kind='stable')
    # Of a repeat, and of what was stored before the clock was set, the row has the time.
    stamps, met = stamps[order] + (row['t_start_ns'] - stamps.min()), met[order]
    edges = np.flatnonzero(np.diff(np.concatenate(([False], met, [False])).astype(np.int8)))
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        yield int(stamps[first]), int(stamps[end - 1]), int(end - first)


def statistics_of(key: str, body: bytes, chosen: Sequence[str] = ()) -> dict[str, Statistic]:
    """Of the content of an object, as its encoder told them; empty for what none is told of. Raises LakeError."""
    extension = extension_of(key)
    if extension == _JSON:
        return _collected(records(body), chosen)
    if extension == _PCD:
        return of_points(cloud_points(body))
    return of_jpeg(body) if extension == _JPEG else {}


def _collected(messages: Sequence[Mapping[str, Any]], chosen: Sequence[str]) -> dict[str, Statistic]:
    collected = FieldStatistics(chosen)
    for start in range(0, len(messages), AT_ONCE):
        collected.add(messages[start : start + AT_ONCE])
    return collected.told()


def _met(expression: Expression, messages: Sequence[Mapping[str, Any]]) -> Mask:
    """Of each message."""
    if isinstance(expression, Joined):
        join = np.logical_and if expression.word == 'and' else np.logical_or
        found: Mask = reduce(join, [_met(part, messages) for part in expression.parts])
        return found
    if expression.function:
        return np.full(len(messages), _met_by(expression, _collected(messages, (expression.field,)), None))
    return np.array([any(map(expression.holds, values_of(each, expression.field))) for each in messages], bool)


def _met_by(expression: Expression, found: Mapping[str, Statistic], points: NDArray[Any] | None) -> bool:
    """Of an object of one message, or of a statistic."""
    if isinstance(expression, Joined):
        return (all if expression.word == 'and' else any)(_met_by(part, found, points) for part in expression.parts)
    named = [(name, each) for name, each in found.items() if name != ALL and covers(expression.field, name)]
    if expression.function:
        values = [getattr(each, expression.function) for _, each in named]
        return any(value is not None and bool(expression.holds(float(value))) for value in values)
    if points is not None and expression.sign == '==' and expression.field in (points.dtype.names or ()):
        return bool(expression.holds(points[expression.field].astype(np.float64)).any())
    ends = [value for _, each in named for value in (each.min, each.max) if value is not None]
    return any(bool(expression.holds(value)) for value in ends)


# -- ranges --------------------------------------------------------------------------------------------------------------------


def _whole(rows: pa.Table, numbers: NDArray[np.intp], sensor: str) -> Iterator[Range]:
    some = rows.select(['robot', 't_start_ns', 't_end_ns', 'count']).take(numbers)
    for robot, first, last, count in zip(*(each.to_pylist() for each in some.columns), strict=True):
        yield Range(robot, sensor, first, max(first, first if last is None else last), count or 1)


def _joined_ranges(found: Iterable[Range], apart_ns: int) -> list[Range]:
    joined: list[Range] = []
    for each in sorted(found, key=lambda each: (each.robot, each.since_ns, each.until_ns)):
        last = joined[-1] if joined else None
        if last is not None and last.robot == each.robot and each.since_ns - last.until_ns <= apart_ns:
            joined[-1] = replace(last, until_ns=max(last.until_ns, each.until_ns), messages=last.messages + each.messages)
        else:
            joined.append(each)
    return joined


def _clipped(found: Iterable[Range], within: Sequence[TimeSpan]) -> list[Range]:
    """What of them lies in the ranges that were given; messages are then those of all of a range."""
    clipped = []
    for each in found:
        for span in within:
            low, high = max(each.since_ns, span.since_ns), min(each.until_ns, span.until_ns)
            if low <= high and span.robot in {None, each.robot}:
                clipped.append(replace(each, since_ns=low, until_ns=high))
    return clipped


def _freshness(source: Bucket, asked: Wanted, rows: pa.Table, findings: Findings) -> Iterator[Freshness]:
    ends = rows.select(['robot', 'topic', 't_end_ns']).group_by(['robot', 'topic']).aggregate([('t_end_ns', 'max')])
    for robot, topic, newest_ns in zip(*(ends[name].to_pylist() for name in ('robot', 'topic', 't_end_ns_max')), strict=True):
        told = newest(source, robot=robot, topic=topic, sink=OBJECTS, since_ns=asked.since_ns, findings=findings)
        marks = [row['to_ns'] for row in watermarks(told.to_pylist())]
        yield Freshness(robot, topic, newest_ns, max(marks, default=None))
