"""Queries by value: from a condition such as ``imu.accelerometer.2 > 15`` to the times at which it was true.

A name is a sensor and a field (formats/statistics.py), or the common start of several fields; then any of them may match. A plain
name applies to each message; ``max(...)`` and other statistics apply to each object, that is, a batch of messages. ``and``,
``or`` and parentheses join comparisons. Comparisons with missing, NaN or infinite values are false.

For most objects, the statistics show that all or none of their messages meet the condition. Only the others are opened, so the
result is the same as that of a loop over all messages.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from deltalake import QueryBuilder
from numpy.typing import NDArray

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND
from shadowhound_data_logger.core.errors import DataLoggerError, LakeError, ObjectRefused, SettingError
from shadowhound_data_logger.core.expression import MAX_SHOWN, STORED, Comparison, Expression, Joined, comparisons
from shadowhound_data_logger.core.expression import parse as parse_expression
from shadowhound_data_logger.core.stamps import BY_STAMP
from shadowhound_data_logger.core.untrusted import MAX_OBJECT_BYTES
from shadowhound_data_logger.formats.image import jpeg_statistics
from shadowhound_data_logger.formats.pointcloud import point_statistics
from shadowhound_data_logger.formats.records import RECORDS_PER_PART
from shadowhound_data_logger.formats.rows.catalog import OBJECTS as OBJECT_ROWS
from shadowhound_data_logger.formats.rows.statistics import STATISTICS
from shadowhound_data_logger.formats.statistics import (
    ALL,
    MEAN_ERROR,
    NUMBERS,
    FieldStatistics,
    Statistic,
    covers,
    field_values,
)
from shadowhound_data_logger.lake import labels
from shadowhound_data_logger.lake.bucket import THREADS, Bucket, default_source
from shadowhound_data_logger.lake.decode import cloud_points, extension_of, records
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.gaps import OBJECTS, newest, watermarks
from shadowhound_data_logger.lake.row_files import robots
from shadowhound_data_logger.lake.select import MAX_BATCH_NS, TimeSpan, Wanted, date_of, wanted
from shadowhound_data_logger.lake.tables import among, answer, literal, narrow, quoted
from shadowhound_data_logger.lake.views import views

MIN_JOIN_S: Final = 1.0
"""Messages that are at most this far apart belong to one range, unless the sensor is slower."""
MAX_JOIN_S: Final = 60.0
"""Limit for sensors without a period, whose messages are stored on a change."""
JOIN_PERIODS: Final = 2
"""A sampler keeps the first message of each period: consecutive ones are up to two periods apart."""
OPENED_AT_A_TIME: Final = 64
MAX_COMPARISONS: Final = 32
_TINY: Final = 2.0**-140
"""More than the difference between the smallest float32 and its decimal representation."""
_JSON, _JPEG, _PCD = 'json', 'jpg', 'pcd'
_KEY: Final = ('bucket', 'key', 't_start_ns')
_SEEN: Final = ('sensor', 'topic', 't_start_ns', 't_end_ns')
"""The columns that determine which objects are examined."""
_OBJECT: Final = (*_SEEN, 'count', 'bucket', 'key')
_STATISTIC: Final = ('t_start_ns', 'field', *NUMBERS)
_BY_QUERY: Final = ('near', 'near_gps', 'mission', 'mission_type', 'success', 'policy', 'where')
"""Flags of `query`."""
MAX_NAMED_TIMES: Final = 5000
"""Times in an SQL query; for more, all rows between the first and the last are read."""
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Range:
    """A time in which messages met the condition, from the first to the last of them."""

    robot: str
    sensor: str
    since_ns: int
    until_ns: int
    """Inclusive."""
    messages: int


@dataclass(frozen=True, slots=True)
class Freshness:
    """The time up to which the result includes a topic. None: unknown."""

    robot: str
    topic: str
    newest_ns: int | None
    """End of the newest object with a row."""
    complete_ns: int | None
    """The watermark: earlier losses are in the gap journal."""

    @property
    def fresh_ns(self) -> int | None:
        """Everything that was stored or lost until this time is known; later objects may still be on the robot."""
        known = [each for each in (self.newest_ns, self.complete_ns) if each is not None]
        return min(known) if len(known) == 2 else None


@dataclass(frozen=True, slots=True)
class ValueAnswer:
    """The times at which a condition was true, and how many objects were examined."""

    ranges: tuple[Range, ...]
    objects: int
    """Objects of the sensor in the requested time."""
    opened: int
    unknown: int
    """Objects without statistics of these fields that were not opened: the condition may be true in them, too."""
    fresh: tuple[Freshness, ...]
    fields: tuple[str, ...] = ()
    """The existing fields, if no object has a requested one."""


def parse(text: str) -> Expression:
    """Parse the condition of ``--when``, about the values of one sensor. Raises SettingError."""
    found = parse_expression(text, 'when', STORED)
    asked = comparisons(found)
    if len(asked) > MAX_COMPARISONS:
        raise SettingError('when', text[:MAX_SHOWN], f'at most {MAX_COMPARISONS} comparisons')
    sensors = {each.source for each in asked}
    if len(sensors) > 1:
        raise SettingError('when', text[:MAX_SHOWN], f'one sensor at a time, not {" and ".join(sorted(sensors))}: write the '
                           'ranges of one with --json to a file, and query the other with --ranges')  # fmt: skip
    return found


# -- query ---------------------------------------------------------------------------------------------------------------------


def ranges(condition: str, source: Bucket | None = None, *, scan: bool = False, join_s: float | None = None, pad_s: float = 0.0,
           findings: Findings | None = None, **flags: Any) -> ValueAnswer:  # fmt: skip
    """The times at which a condition was true; ``flags`` are those of ``lake.objects`` and select objects of its sensor.

    ``scan`` also opens objects without statistics. Ranges at most ``join_s`` apart are joined (None: 1 s, or two periods of a
    slower sensor), and extended by ``pad_s`` on both sides. Raises SettingError, LakeError for an invalid query, StoreError.
    """
    expression = parse(condition)
    sensor = comparisons(expression)[0].source
    if flags.get('sensor', sensor) != sensor:
        raise SettingError('sensor', flags['sensor'], f'{sensor}, the sensor of the condition, or no sensor')
    if flags.get('by', BY_STAMP) != BY_STAMP:
        raise SettingError('by', flags['by'], f'{BY_STAMP}: statistics of values have only stamps')
    findings = Findings() if findings is None else findings
    source = source or default_source()
    flags = {**flags, 'sensor': sensor}
    asked = labels.with_label_resolved(source, wanted(time.time_ns(), **flags), findings)
    found: list[Range] = []
    fresh: list[Freshness] = []
    fields: set[str] = set()
    objects = opened = unknown = 0
    for robot in [asked.robot] if asked.robot else robots(source):
        of = _RobotQuery(source, replace(asked, robot=robot), {**flags, 'robot': robot}, robot, expression, findings)
        answer = of.answer(scan=scan, join_ns=None if join_s is None else round(join_s * SECOND), pad_ns=round(pad_s * SECOND))
        found += answer.ranges
        fresh += answer.fresh
        fields.update(answer.fields)
        objects, opened, unknown = objects + answer.objects, opened + answer.opened, unknown + answer.unknown
    return ValueAnswer(tuple(found), objects, opened, unknown, tuple(fresh), () if found or unknown else tuple(sorted(fields)))


def sensor_of(condition: str) -> str:
    """The sensor of a condition. Raises SettingError."""
    return comparisons(parse(condition))[0].source


def field_of(condition: str, there: Sequence[str]) -> str:
    """The first field of a condition that is not among the existing ones. Raises SettingError."""
    asked = [leaf.path for leaf in comparisons(parse(condition))]
    return next((field for field in asked if not any(covers(field, name) for name in there)), asked[0])


class _RobotQuery:
    """The query for one robot."""

    def __init__(self, source: Bucket, asked: Wanted, flags: Mapping[str, Any], robot: str, expression: Expression,
                 findings: Findings) -> None:  # fmt: skip
        self._source = source
        self._asked = asked
        self._flags = flags
        self._robot = robot
        self._expression = expression
        self._findings = findings
        self._ready: QueryBuilder

    def answer(self, *, scan: bool, join_ns: int | None, pad_ns: int) -> ValueAnswer:
        asked = self._asked
        has_date = asked.has_date if asked.since_ns is not None or asked.until_ns is not None else None
        with views(self._source, [OBJECT_ROWS, STATISTICS], self._findings, robot=self._robot, has_date=has_date) as self._ready:
            return self._answer(scan=scan, join_ns=join_ns, pad_ns=pad_ns)

    def _answer(self, *, scan: bool, join_ns: int | None, pad_ns: int) -> ValueAnswer:
        rows, statistics, seen = self._candidates()
        may, must, is_known = statistics.evaluate(self._expression)
        to_open = np.flatnonzero(may & ~must & (is_known | scan))
        unknown = 0 if scan else int(np.count_nonzero(may & ~must & ~is_known))
        spans = [_whole(rows, np.flatnonzero(must))]
        for some in _opened(self._source, rows, to_open, self._expression, self._findings):
            if some is None:
                unknown += 1
            else:
                spans.append(np.array(some, np.int64).reshape(-1, 3))
        if join_ns is None:
            join_ns = round(min(max(MIN_JOIN_S, JOIN_PERIODS * seen.period_ns() / SECOND), MAX_JOIN_S) * SECOND)
        found = _joined_spans(np.concatenate(spans), join_ns)
        for chosen in self._asked.chosen:
            found = (
                found if chosen.keys else _clipped(found, [span for span in chosen.spans if span.robot in {None, self._robot}])
            )
        if pad_ns:
            found = _joined_spans(found + np.array([-pad_ns, pad_ns, 0]), 0)
        sensor = comparisons(self._expression)[0].source
        return ValueAnswer(
            tuple(Range(self._robot, sensor, *each) for each in found.tolist()), seen.objects, len(to_open), unknown,
            tuple(self._freshness(seen)), () if len(found) or unknown else tuple(self._existing_fields(seen)),
        )  # fmt: skip

    def _candidates(self) -> tuple[pa.Table, _ObjectStatistics, _RowFilter]:
        """The objects that must be examined, with their statistics; no other object can meet the condition.

        For objects with a unique time, the necessary comparisons decide this. Keys take most of the bytes of a table, so they
        are read only for the remaining objects.
        """
        wholes = self._totals()
        stamps = _stamps(wholes)
        known, counts = np.unique(stamps, return_counts=True)
        known = np.setdiff1d(known[counts == 1], stamps[_invalid_totals(wholes)], assume_unique=True)
        leads = list(dict.fromkeys(_necessary_comparisons(self._expression)))
        left_out = stamps[_numbers(wholes, 'nan_count') > 0]
        found = [self._statistics_for(lead, with_exact=len(left_out) > 0) for lead in leads]
        chosen = np.unique(np.concatenate([_stamps(table) for table, _ in found]))
        for _, exact in found:
            chosen = np.union1d(chosen, np.setdiff1d(left_out, exact))
        rows, seen = self._rows(chosen, known)
        if len(repeated := seen.repeated()):
            rows, seen = self._rows(chosen, np.setdiff1d(known, repeated, assume_unique=True))
        stamps = _stamps(rows)
        if not _is_among(stamps, known).all() or len(repeated):  # times do not identify all objects
            statistics = self._statistics(comparisons(self._expression), stamps, _KEY)
            return rows, _ObjectStatistics(rows, statistics, _KEY, self._findings), seen
        others = [leaf for leaf in comparisons(self._expression) if leaf not in leads]
        tables = [wholes.filter(pa.array(_is_among(_stamps(wholes), stamps))), *(table for table, _ in found)]
        if others:
            tables.append(self._statistics(others, stamps))
        return rows, _ObjectStatistics(rows, pa.concat_tables(tables).combine_chunks(), _KEY[-1:], self._findings), seen

    def _rows(self, chosen: NDArray[np.int64], known: NDArray[np.int64]) -> tuple[pa.Table, _RowFilter]:
        """The rows of objects at the chosen times, and of those without statistics."""
        sieve = _RowFilter(self._asked, chosen, known)
        if self._asked.chosen or any(self._flags.get(name) is not None for name in _BY_QUERY):
            from shadowhound_data_logger.lake import query  # noqa: PLC0415 - only for these flags

            table = query.objects(self._source, findings=self._findings, columns=_OBJECT, **self._flags)
            return table.filter(pa.array(sieve(table))).sort_by('t_start_ns').combine_chunks(), sieve
        where = self._where() if self._asked.topic is None else f'{self._where()} AND topic = {literal(self._asked.topic)}'
        seen = self._select(_SEEN, 'objects', where)
        stamps = np.unique(_stamps(seen)[sieve(seen)])
        if not len(stamps):
            return narrow(_OBJECT).empty_table(), sieve
        table = self._select(_OBJECT, 'objects', f'{where} AND {_at_times(stamps)}')
        return table.filter(pa.array(_is_among(_stamps(table), stamps))).sort_by('t_start_ns').combine_chunks(), sieve

    def _totals(self) -> pa.Table:
        """The statistics of objects as a whole: their numbers of messages."""
        columns = ('t_start_ns', 'field', 'count', 'nan_count')
        table = self._fields([ALL], columns).combine_chunks()
        nothing = pa.nulls(len(table), pa.float64())
        given = [table[name] if name in columns else nothing for name in _STATISTIC]
        return pa.table(given, schema=narrow(_STATISTIC, STATISTICS))

    def _statistics_for(self, lead: Comparison, *, with_exact: bool) -> tuple[pa.Table, NDArray[np.int64]]:
        """The statistics that do not rule out a comparison; if requested, also the times of all objects with this field."""
        table = self._fields([lead.path], _STATISTIC, 'true' if with_exact else _may_hold(lead))
        values = {name: _numbers(table, name) for name in NUMBERS}
        kept = _by_statistics(lead, values)[0] | _contradictory(values)
        exact = _stamps(table)[_are(table['field'], lead.path)] if with_exact else np.zeros(0, np.int64)
        return _filtered(table, kept), exact

    def _statistics(self, of: Sequence[Comparison], stamps: NDArray[np.int64], key: Sequence[str] = ()) -> pa.Table:
        """The statistics of the requested fields at these times; with a ``key``, also those of the objects as a whole."""
        columns = tuple(dict.fromkeys((*key, *_STATISTIC)))
        names = [*([ALL] if key else []), *sorted({each.path for each in of})]
        if not len(stamps):
            return narrow(columns, STATISTICS).empty_table()
        table = self._fields(names, columns, _at_times(stamps))
        return _filtered(table, _is_among(_stamps(table), stamps)).combine_chunks()

    def _fields(self, names: Sequence[str], columns: Sequence[str], condition: str = 'true') -> pa.Table:
        """The statistics in the requested time of the fields with one of these names or below one of them."""
        below = [f'starts_with(field, {literal(f"{name}.")})' for name in names if name != ALL]
        fields = ' OR '.join([among('field', names), *below])
        return self._select(columns, 'statistics', f'{self._where()} AND ({fields}) AND {condition}')

    def _where(self) -> str:
        """A condition in SQL for robot, sensor and time."""
        asked = self._asked
        found = [f'robot = {literal(self._robot)}', f'sensor = {literal(asked.sensor or "")}']
        found.append(f't_start_ns >= {max(asked.since_ns or 0, 0)}')
        if asked.since_ns is not None:
            found.append(f'date >= {literal(date_of(asked.since_ns))}')
        if asked.until_ns is not None:
            found.append(f't_start_ns < {asked.until_ns} AND date <= {literal(date_of(asked.until_ns - 1))}')
        return ' AND '.join(found)

    def _select(self, columns: Sequence[str], table: str, where: str) -> pa.Table:
        return answer(self._ready, f'SELECT {", ".join(map(quoted, columns))} FROM all_{table} WHERE {where}')  # noqa: S608

    def _existing_fields(self, seen: _RowFilter) -> Iterator[str]:
        """The fields of the newest objects, if a requested one is not among them."""
        found: set[str] = set()
        where = f'{self._where()} AND t_start_ns >= {max(seen.newest_ns - MAX_BATCH_NS, 0)}'
        fields = answer(self._ready, f'SELECT DISTINCT field FROM all_statistics WHERE {where}')  # noqa: S608
        found.update(fields['field'].to_pylist())
        found -= {ALL}
        if not all(any(covers(leaf.path, name) for name in found) for leaf in comparisons(self._expression)):
            yield from found

    def _freshness(self, seen: _RowFilter) -> Iterator[Freshness]:
        for topic, newest_ns in seen.ends.items():
            statements = newest(self._source, robot=self._robot, topic=topic, sink=OBJECTS, since_ns=self._asked.since_ns,
                                findings=self._findings)  # fmt: skip
            marks = [row['to_ns'] for row in watermarks(statements.to_pylist())]
            yield Freshness(self._robot, topic, newest_ns, max(marks, default=None))


class _RowFilter:
    """Selects the rows of objects that must be examined from batches of rows, and counts what it has seen."""

    def __init__(self, asked: Wanted, chosen: NDArray[np.int64], known: NDArray[np.int64]) -> None:
        """``chosen`` are the times of objects that are always selected, ``known`` of those with statistics; both are sorted."""
        self._asked = asked
        self._chosen = chosen
        self._known = known
        self._seen: list[NDArray[np.int64]] = []
        self._last: list[NDArray[np.int64]] = []
        self.objects = 0
        self.newest_ns = 0
        self.ends: dict[str, int | None] = {}
        """Topic -> end of its newest object."""

    def __call__(self, table: pa.Table) -> Mask:
        asked = self._asked
        stamps = np.asarray(pc.fill_null(table['t_start_ns'], -1).to_numpy())
        kept: Mask = (stamps >= max(asked.since_ns or 0, EARLIEST_SANE_NS)) & _are(table['sensor'], asked.sensor)
        if asked.until_ns is not None:
            kept &= stamps < asked.until_ns
        if asked.topic is not None:
            kept &= _are(table['topic'], asked.topic)
        self._count(_filtered(table, kept))
        inside = np.sort(stamps[kept])
        self._seen.append(inside)
        self._last.append(np.sort(pc.coalesce(table['t_end_ns'], table['t_start_ns']).filter(pa.array(kept)).to_numpy()))
        low, high = np.searchsorted(self._known, inside[[0, -1]]) if len(inside) else (0, 0)
        if len(inside) and np.array_equal(self._known[low : high + 1], inside):
            return kept & _is_among(stamps, self._chosen)
        return kept & (_is_among(stamps, self._chosen) | ~_is_among(stamps, self._known))

    def repeated(self) -> NDArray[np.int64]:
        """The times that several rows have."""
        stamps = np.sort(np.concatenate([np.zeros(0, np.int64), *self._seen]), kind='stable')
        return np.unique(stamps[1:][np.diff(stamps) == 0])

    def period_ns(self) -> int:
        """The median time between two messages according to the rows, at most that of a batch; 0 if unknown."""
        first, last = (np.sort(np.concatenate([np.zeros(0, np.int64), *some])) for some in (self._seen, self._last))
        if len(first) < 2:
            return 0
        lasting, apart = np.median(last - first), np.median(np.maximum(first[1:] - last[:-1], 0))
        return int(min(apart, lasting) if lasting > 0 else apart)

    def _count(self, table: pa.Table) -> None:
        self.objects += len(table)
        if not len(table):
            return
        self.newest_ns = max(self.newest_ns, pc.max(table['t_start_ns']).as_py())
        for topic in pc.unique(table['topic']).to_pylist():
            of = table['t_end_ns'] if topic is None else table['t_end_ns'].filter(pa.array(_are(table['topic'], topic)))
            self.ends[topic] = max(
                (each for each in (self.ends.get(topic), pc.max(of).as_py()) if each is not None), default=None
            )


def _necessary_comparisons(expression: Expression) -> list[Comparison]:
    """The smallest set of comparisons that must not all be false for the expression to be true."""
    if isinstance(expression, Comparison):
        return [expression]
    assert isinstance(expression, Joined)
    found = [_necessary_comparisons(part) for part in expression.parts]
    return min(found, key=len) if expression.word == 'and' else [lead for part in found for lead in part]


def _at_times(stamps: NDArray[np.int64]) -> str:
    """A condition in SQL for rows at these times (at least one); for many times, a range from the first to the last."""
    if len(stamps) <= MAX_NAMED_TIMES:
        return f't_start_ns IN ({", ".join(map(str, stamps.tolist()))})'
    return f't_start_ns BETWEEN {stamps.min()} AND {stamps.max()}'


def _may_hold(lead: Comparison) -> str:
    """A condition in SQL for statistics that do not rule out a comparison, and for contradictory ones."""
    number = repr(float(lead.value))
    low, high = (lead.function, lead.function) if lead.function and lead.function != 'mean' else ('min', 'max')
    by_sign = {
        '>': f'"{high}" > {number}', '>=': f'"{high}" >= {number}', '<': f'"{low}" < {number}', '<=': f'"{low}" <= {number}',
        '==': f'("{low}" <= {number} AND "{high}" >= {number})',
    }  # fmt: skip
    if lead.function == 'mean' or lead.sign not in by_sign:
        return 'true'
    huge = repr(sys.float_info.max)
    ends = ' OR '.join(f'"{name}" IS NULL OR isnan("{name}") OR abs("{name}") > {huge}' for name in dict.fromkeys((low, high)))
    counts = ' OR '.join(f'"{name}" NOT BETWEEN 0 AND {MAX_OBJECT_BYTES}' for name in ('count', 'nan_count'))
    return f'({by_sign[lead.sign]} OR "min" > "max" OR {ends} OR {counts})'


def _stamps(table: pa.Table) -> NDArray[np.int64]:
    """The times; -1, which no valid row has, if missing."""
    return np.asarray(pc.fill_null(table['t_start_ns'], -1).to_numpy())


def _is_among(stamps: NDArray[np.int64], of: NDArray[np.int64]) -> Mask:
    """Whether each is among the others, which are sorted."""
    if not len(of):
        return np.zeros(len(stamps), bool)
    found: Mask = of[np.minimum(np.searchsorted(of, stamps), len(of) - 1)] == stamps
    return found


def _are(column: pa.ChunkedArray, value: str | None) -> Mask:
    return np.asarray(pc.fill_null(pc.equal(column, value), fill_value=False).to_numpy())


def _filtered(table: pa.Table, kept: Mask) -> pa.Table:
    """The filtered rows, without a copy if all are kept."""
    return table if kept.all() else table.filter(pa.array(kept))


class _ObjectStatistics:
    """The statistics of objects, and what they show about a condition."""

    def __init__(self, rows: pa.Table, statistics: pa.Table, key: Sequence[str], findings: Findings) -> None:
        """``key`` are the columns that match rows with statistics."""
        self._objects = len(rows)
        numbered = rows.select(key).append_column('_row', pa.array(np.arange(len(rows)), pa.int64()))
        found = statistics.join(numbered, keys=list(key), join_type='inner').combine_chunks()
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
        self._has_nan = np.zeros(self._objects, bool)
        self._has_nan[self._rows[whole]] = self._values['nan_count'][whole] > 0
        self._invalid = np.where(whole, _invalid_totals(found), _contradictory(self._values))
        self._has[self._rows[self._invalid]] = False
        for number in np.unique(self._rows[self._invalid]):
            findings.add(rows['key'][int(number)].as_py(), 'its statistics contradict each other')

    def evaluate(self, expression: Expression) -> tuple[Mask, Mask, Mask]:
        """For each object, whether the condition may be true; is true for all messages; may be true by its statistics alone."""
        if isinstance(expression, Comparison):
            may, must, unknown = self._evaluate_comparison(expression)
            return may | unknown, must, may
        assert isinstance(expression, Joined)
        join = np.logical_and if expression.word == 'and' else np.logical_or
        parts = [self.evaluate(part) for part in expression.parts]
        may, must, known = (reduce(join, each) for each in zip(*parts, strict=True))
        return may, must, known

    def _of(self, wanted_name: Any) -> Mask:
        codes = [code for code, name in enumerate(self._names) if wanted_name(name)]
        return np.isin(self._fields, codes)

    def _evaluate_comparison(self, leaf: Comparison) -> tuple[Mask, Mask, Mask]:
        chosen = self._of(lambda name: name != ALL and covers(leaf.path, name)) & ~self._invalid
        is_exact = self._of(lambda name: name == leaf.path)
        is_scalar = ~self._of(lambda name: '*' in name.split('.'))
        rows = self._rows[chosen]
        some, every = _by_statistics(leaf, {name: values[chosen] for name, values in self._values.items()})
        if not leaf.function:
            messages, count = self._messages[rows], self._values['count'][chosen]
            is_one_each = (count == messages) & (self._values['nan_count'][chosen] == 0) & is_scalar[chosen]
            # For an object with a single message, any of its values is enough, and minimum and maximum are among them.
            every = (every & is_one_each) | (some & (messages == 1) & (leaf.sign != '=='))
        may, must, exact = (np.zeros(self._objects, bool) for _ in range(3))
        may[rows[some]] = True
        must[rows[every]] = True
        exact[self._rows[is_exact]] = True
        return may, must, ~self._has | (self._has_nan & ~exact)


def _by_statistics(leaf: Comparison, values: Mapping[str, NDArray[np.float64]]) -> tuple[Mask, Mask]:
    """Whether a comparison may be true for some of the numbers, and is true for all.

    For a comparison of a statistic both are equal, except for a mean that is close to the value.
    """
    low, high, number = values['min'], values['max'], leaf.value
    if leaf.function and leaf.function != 'mean':
        found: Mask = leaf.holds(values[leaf.function])
        return found, found
    if leaf.function:
        reach = MEAN_ERROR * np.maximum(np.abs(low), np.abs(high)) + _TINY
        mean = values['mean']
        is_open = np.isnan(mean) & (values['count'] > 0)  # the sum overflowed a double
        low, high = np.where(is_open, -np.inf, mean - reach), np.where(is_open, np.inf, mean + reach)
    if leaf.sign == '==':
        return (low <= number) & (number <= high), (low == number) & (number == high)
    if leaf.sign == '!=':
        return leaf.holds(low) | leaf.holds(high), (number < low) | (high < number)
    some, every = (high, low) if leaf.sign in {'>', '>='} else (low, high)
    return leaf.holds(some), leaf.holds(every)


def _contradictory(values: Mapping[str, NDArray[np.float64]]) -> Mask:
    """Which statistics of fields contradict themselves."""
    low, high, count = values['min'], values['max'], values['count']
    found: Mask = (low > high) | np.isinf(low) | np.isinf(high)
    for name in ('count', 'nan_count'):
        found |= ~((values[name] >= 0) & (values[name] <= MAX_OBJECT_BYTES))
    for name in ('first', 'last', 'min', 'max'):
        if (value := values.get(name)) is not None:
            found |= (value < low) | (value > high) | (np.isnan(value) == (count > 0))
    if (mean := values.get('mean')) is not None:
        reach = MEAN_ERROR * np.maximum(np.abs(low), np.abs(high)) + _TINY
        found |= (mean < low - reach) | (mean > high + reach)
    return found


def _invalid_totals(table: pa.Table) -> Mask:
    """Which rows of objects as a whole contradict themselves."""
    found: Mask = np.zeros(len(table), bool)
    for name in ('count', 'nan_count'):
        values = _numbers(table, name)
        found |= ~((values >= 0) & (values <= MAX_OBJECT_BYTES))
    return found


def _numbers(table: pa.Table, name: str) -> NDArray[np.float64]:
    """A column as floats; null becomes NaN."""
    return np.asarray(table[name].cast(pa.float64(), safe=False).to_numpy())


# -- opened objects ------------------------------------------------------------------------------------------------------------


_Run = tuple[int, int, int]
"""First and last stamp of consecutive messages, and their number."""


def _opened(source: Bucket, rows: pa.Table, numbers: NDArray[np.intp], expression: Expression,
            findings: Findings) -> Iterator[list[_Run] | None]:  # fmt: skip
    """The runs in each of these objects; None for one that cannot be read."""

    def body(row: dict[str, Any]) -> bytes | DataLoggerError:
        try:
            return Bucket(source.settings, row['bucket']).get(row['key'], MAX_OBJECT_BYTES)
        except ObjectRefused as error:
            return error

    with ThreadPoolExecutor(THREADS, 'lake-values') as pool:
        for start in range(0, len(numbers), OPENED_AT_A_TIME):
            some = [int(number) for number in numbers[start : start + OPENED_AT_A_TIME]]
            asked = rows.take(some).to_pylist()
            for row, content in zip(asked, pool.map(body, asked), strict=True):
                try:
                    if isinstance(content, DataLoggerError):
                        raise content
                    yield list(_runs(row, content, expression))
                except DataLoggerError as error:
                    findings.add(row['key'], str(error))
                    yield None


def _runs(row: Mapping[str, Any], body: bytes, expression: Expression) -> Iterator[_Run]:
    """The runs of messages in an object that meet the condition. Raises LakeError."""
    extension = extension_of(row['key'])
    if extension == _JSON:
        messages = records(body)
        stamps = np.array([each['stamp_ns'] for each in messages], np.int64)
        met = _matches(expression, messages)
    elif extension in {_JPEG, _PCD}:
        points = cloud_points(body) if extension == _PCD else None
        found = statistics_of(row['key'], body)
        stamps, met = np.zeros(1, np.int64), np.array([_object_matches(expression, found, points)])
    else:
        raise LakeError(f'values in .{extension} objects cannot be queried', remedy='store the sensor as json, jpeg or pcd')
    if not len(stamps):
        return
    order = np.argsort(stamps, kind='stable')
    # The row has the correct time of a repeat, and of an object that was stored before the clock was set.
    stamps, met = stamps[order] + (row['t_start_ns'] - stamps.min()), met[order]
    edges = np.flatnonzero(np.diff(np.concatenate(([False], met, [False])).astype(np.int8)))
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        yield int(stamps[first]), int(stamps[end - 1]), int(end - first)


def statistics_of(key: str, body: bytes) -> dict[str, Statistic]:
    """Statistics of an image or a cloud, as its encoder computes them. Raises LakeError."""
    return point_statistics(cloud_points(body)) if extension_of(key) == _PCD else jpeg_statistics(body)


def _collected(messages: Sequence[Mapping[str, Any]], chosen: Sequence[str]) -> dict[str, Statistic]:
    collected = FieldStatistics(chosen)
    for start in range(0, len(messages), RECORDS_PER_PART):
        collected.add(messages[start : start + RECORDS_PER_PART])
    return collected.result()


def _matches(expression: Expression, messages: Sequence[Mapping[str, Any]]) -> Mask:
    """Whether each message meets the condition."""
    if isinstance(expression, Joined):
        join = np.logical_and if expression.word == 'and' else np.logical_or
        found: Mask = reduce(join, [_matches(part, messages) for part in expression.parts])
        return found
    assert isinstance(expression, Comparison)
    if expression.function:
        return np.full(len(messages), _object_matches(expression, _collected(messages, (expression.path,)), None))
    return np.array([any(map(expression.holds, field_values(each, expression.path))) for each in messages], bool)


def _object_matches(expression: Expression, found: Mapping[str, Statistic], points: NDArray[Any] | None) -> bool:
    """Whether an object of one message, or a comparison of a statistic, meets the condition."""
    if isinstance(expression, Joined):
        return (all if expression.word == 'and' else any)(_object_matches(part, found, points) for part in expression.parts)
    assert isinstance(expression, Comparison)
    named = [(name, each) for name, each in found.items() if name != ALL and covers(expression.path, name)]
    if expression.function:
        values = [getattr(each, expression.function) for _, each in named]
        return any(value is not None and bool(expression.holds(float(value))) for value in values)
    if points is not None and expression.sign == '==' and expression.path in (points.dtype.names or ()):
        return bool(expression.holds(points[expression.path].astype(np.float64)).any())
    ends = [value for _, each in named for value in (each.min, each.max) if value is not None]
    return any(bool(expression.holds(value)) for value in ends)


# -- ranges --------------------------------------------------------------------------------------------------------------------


Spans = NDArray[np.int64]
"""Each row is a time: start, end, and number of messages."""


def _whole(rows: pa.Table, numbers: NDArray[np.intp]) -> Spans:
    """The times of objects whose messages all meet the condition."""
    some = rows.select(['t_start_ns', 't_end_ns', 'count']).take(pa.array(numbers))
    first, last, count = (np.asarray(pc.fill_null(column, 0).to_numpy()) for column in some.columns)
    return np.stack((first, np.maximum(first, last), np.maximum(count, 1)), axis=1)


def _joined_spans(found: Spans, apart_ns: int) -> Spans:
    """The spans ordered by time; those that are at most ``apart_ns`` apart are joined."""
    if not len(found):
        return found
    found = found[np.lexsort((found[:, 1], found[:, 0]))]
    ends = np.maximum.accumulate(found[:, 1])
    first = np.flatnonzero(np.concatenate(([True], found[1:, 0] - ends[:-1] > apart_ns)))
    last = np.maximum.reduceat(found[:, 1], first)
    return np.stack((found[first, 0], last, np.add.reduceat(found[:, 2], first)), axis=1)


def _clipped(found: Spans, within: Iterable[TimeSpan]) -> Spans:
    """The parts of the spans within given times; each keeps the number of messages of the whole span."""
    inside = [np.stack((np.maximum(found[:, 0], span.since_ns), np.minimum(found[:, 1], span.until_ns), found[:, 2]), axis=1)
              for span in within]  # fmt: skip
    clipped = np.concatenate((found[:0], *inside))
    clipped = clipped[clipped[:, 0] <= clipped[:, 1]]
    return clipped[np.lexsort((clipped[:, 1], clipped[:, 0]))]
