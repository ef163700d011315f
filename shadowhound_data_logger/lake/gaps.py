"""Reports what is known about a topic between two times: what is stored, what was lost and why, and where losses are unknown.

All code that shows data or trains on it calls ``known``. It reads the statements of the gap journal (formats/rows/gaps.py); the
newest statement about each gap counts. Only within a watermark does the absence of a gap mean that nothing was lost: while a
robot is off or unreachable, losses are unknown until it reports.
"""

from __future__ import annotations

import os
import time
from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final, NamedTuple

import pyarrow as pa

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.config import home, store_settings
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.core.stamps import BY_RECEIVED, BY_STAMP
from shadowhound_data_logger.core.times import moment
from shadowhound_data_logger.formats.rows.catalog import BUCKET, UNDATED
from shadowhound_data_logger.formats.rows.gaps import COMPLETE, GAP, GAPS
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.tables import answer, literal, quoted
from shadowhound_data_logger.lake.views import views

OBJECTS, BAGS, EVENTS = 'objects', 'bags', 'events'
SINKS: Final = (OBJECTS, BAGS, EVENTS)
"""Where messages are stored; each has its own gaps."""
HOUR_NS: Final = 3600 * SECOND
OTHER_TYPE: Final = 'wrong_type'
"""Rejected messages whose type differs from the topic's: no message of the topic itself is missing."""
RECEIVED_ONLY: Final = 'received-only'
MAX_CAUSES: Final = 64
"""Causes per topic that are listed by name; others are counted as ``MORE_CAUSES``. The node has about 20, but a hostile file can
have one per row."""
MORE_CAUSES: Final = '(more)'
_NEWEST: Final = (
    f'SELECT {", ".join(map(quoted, GAPS.columns))} FROM (SELECT *, row_number() OVER (PARTITION BY robot, id '  # noqa: S608
    'ORDER BY revision DESC, what ASC, to_ns DESC, from_ns DESC) AS _place FROM all_gaps WHERE {}) WHERE _place = 1 '
    'ORDER BY robot, id'
)
"""The newest statement about each gap. A gap precedes a withdrawal with the same revision, which moved it to another day."""


@dataclass(frozen=True, slots=True)
class StatedGap:
    """A statement of the gap journal about messages that are not in the store; unknown values are None."""

    robot: str
    sink: str
    topic: str
    publisher: str | None
    session: int | None
    kind: str | None
    """``missed``, ``dropped``, ``rejected``, ``evicted`` or ``quarantined``."""
    cause: str | None
    from_ns: int | None
    """Stamp of the last message before."""
    to_ns: int | None
    """Stamp of the first message after."""
    count: int | None
    merged: int | None
    """How many gaps within one second are combined in this one."""
    grade: str | None
    mission_id: str | None
    clock: str | None


class Stretch(NamedTuple):
    """A part of a time that has one state: complete, with losses, or unknown. ``end_ns`` is exclusive."""

    begin_ns: int
    end_ns: int
    causes: tuple[str, ...]
    """Why messages of this time are not in the store; empty if none is missing, or if that is unknown."""
    grade: str
    """How it is known that no other message is missing: ``exact``, ``estimated``; '' if it is unknown."""

    @property
    def is_whole(self) -> bool:
        """Whether everything that the robot's settings select is in the store."""
        return bool(self.grade) and not self.causes

    @property
    def is_open(self) -> bool:
        """Whether it is unknown what is missing, if anything."""
        return not self.grade and not self.causes


@dataclass(frozen=True, slots=True)
class Known:
    """What is known about one sink and topic of a robot between two times."""

    robot: str
    sink: str
    topic: str
    begin_ns: int
    end_ns: int
    stretches: tuple[Stretch, ...]
    """Consecutive; together they are the whole time."""
    gaps: tuple[StatedGap, ...]
    """Those that overlap the time, in order; they are not cut at its ends."""
    untimed: tuple[StatedGap, ...]
    """Gaps at unknown times."""

    @property
    def is_whole(self) -> bool:
        """Whether nothing is missing in the whole time, and that is known."""
        return all(each.is_whole for each in self.stretches)

    @property
    def complete_ns(self) -> int:
        """Up to here all losses are known: the watermark, within this time."""
        return next((each.begin_ns for each in self.stretches if each.is_open), self.end_ns)

    def between(self, begin_ns: int, end_ns: int) -> Known:
        """A part of the time, without reading the store again. Raises ValueError for a time outside of it."""
        if not self.begin_ns <= begin_ns <= end_ns <= self.end_ns:
            raise ValueError(f'{begin_ns} to {end_ns} is not within {self.begin_ns} to {self.end_ns}')
        first = max(0, bisect_right(self.stretches, begin_ns, key=lambda each: each.begin_ns) - 1)
        found: list[Stretch] = []
        for each in self.stretches[first:]:
            if each.begin_ns >= end_ns:
                break
            low, high = max(each.begin_ns, begin_ns), min(each.end_ns, end_ns)
            if low < high:
                found.append(each._replace(begin_ns=low, end_ns=high))
        gaps = tuple(gap for gap in self.gaps if _overlaps(gap.from_ns, gap.to_ns, begin_ns, end_ns))
        return Known(self.robot, self.sink, self.topic, begin_ns, end_ns, tuple(found), gaps, self.untimed)


def known(robot: str, topic: str, since: str | datetime | int, until: str | datetime | int = 'now', *,  # noqa: PLR0913 - parts of a query
          sink: str = OBJECTS, source: Bucket | None = None, findings: Findings | None = None,
          by: str = BY_STAMP) -> Known:  # fmt: skip
    """What is known about a topic in a time: which parts are complete, have gaps, or are unknown.

    Without sequence numbers or a regular rate (``received-only``) losses are unknown. For several times, call it once for all of
    them and use ``Known.between``.

    Args:
        robot: its name.
        topic: such as ``/imu``.
        since: the start, as in ``query`` (``yesterday``, ``2h``, ``2026-11-20T12:30``), or in ns since 1970.
        until: the end, exclusive.
        sink: ``objects``, ``bags`` or ``events``.
        source: the store; by default the one that the environment names.
        findings: receives invalid row files, which are skipped; by default they are logged.
        by: ``stamp``, or ``received`` for the times of arrival.

    Raises:
        SettingError: an argument is invalid.
        StoreError: the store cannot be read.
    """
    now_ns = time.time_ns()
    if sink not in SINKS:
        raise SettingError('sink', sink, ' or '.join(SINKS))
    begin_ns, end_ns = moment_ns('since', since, now_ns), moment_ns('until', until, now_ns)
    if end_ns < begin_ns:
        raise SettingError('until', until, f'a time after {since}')
    found = newest(source, robot=robot, topic=topic, sink=sink, since_ns=begin_ns, findings=findings, by=by)
    return of_rows(robot, sink, topic, begin_ns, end_ns, found.to_pylist())


def moment_ns(name: str, given: str | datetime | int, now_ns: int) -> int:
    """A time in ns since 1970. Raises SettingError."""
    return given if isinstance(given, int) else moment(name, given, now_ns)


def newest(source: Bucket | None = None, *, robot: str | None = None, topic: str | None = None, sink: str | None = None,
           since_ns: int | None = None, findings: Findings | None = None, by: str = BY_STAMP) -> pa.Table:  # fmt: skip
    """The newest statements about times from ``since_ns`` or unknown times, with the columns of ``GAPS``.

    If ``by`` is ``received``, ``from_ns``, ``to_ns``, ``t_from`` and ``t_to`` are arrival times, null if unknown.

    Raises StoreError, LakeError.
    """
    source = source or Bucket(store_settings(os.environ, home(os.environ)), BUCKET)
    findings = Findings() if findings is None else findings
    first = '' if since_ns is None or by == BY_RECEIVED else f'{utc(max(since_ns, 0)):%Y-%m-%d}'
    conditions = [f'(date >= {literal(first)} OR date = {literal(UNDATED)})'] if first else []
    conditions += [f'{name} = {literal(value)}' for name, value in (('topic', topic), ('sink', sink)) if value is not None]
    conditions += [] if robot is None else [f'robot = {literal(robot)}']
    has_date = (lambda date: date >= first or date == UNDATED) if first else None
    with views(source, [GAPS], findings, robot=robot, has_date=has_date, by=by) as ready:
        return answer(ready, _NEWEST.format(' AND '.join(conditions) or 'true'))


def of_rows(robot: str, sink: str, topic: str, begin_ns: int, end_ns: int, rows: Iterable[Mapping[str, Any]]) -> Known:
    """Like ``known``, from the newest statements of that robot, sink and topic."""
    rows = list(rows)
    stated = [_gap(row) for row in rows if row['what'] == GAP]
    gaps = sorted((gap for gap in stated if _overlaps(gap.from_ns, gap.to_ns, begin_ns, end_ns)), key=_by_time)
    untimed = tuple(gap for gap in stated if _is_untimed(gap))
    marks = [(row['from_ns'], row['to_ns'], row['grade']) for row in watermarks(rows) if row['grade'] != RECEIVED_ONLY]
    stretches = _stretches(begin_ns, end_ns, marks, [gap for gap in gaps if gap.cause != OTHER_TYPE and not _is_untimed(gap)])
    return Known(robot, sink, topic, begin_ns, end_ns, tuple(stretches), tuple(gaps), untimed)


def watermarks(rows: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The newest ``complete`` statement of each session, sink and topic; it covers ``from_ns`` to ``to_ns``."""
    best: dict[tuple[Any, ...], Mapping[str, Any]] = {}
    for row in rows:
        if row['what'] == COMPLETE and row['from_ns'] is not None and row['to_ns'] is not None and row['clock'] != 'unset':
            name = tuple(row[each] for each in ('robot', 'sink', 'topic', 'session', 'from_ns'))
            before = best.get(name)
            if before is None or (row['revision'], row['to_ns']) > (before['revision'], before['to_ns']):
                best[name] = row
    return list(best.values())


def _gap(row: Mapping[str, Any]) -> StatedGap:
    return StatedGap(*(row[name] for name in StatedGap.__slots__))


def _is_untimed(gap: StatedGap) -> bool:
    return gap.from_ns is None or gap.to_ns is None or gap.clock == 'unset'


def _by_time(gap: StatedGap) -> tuple[int, int, str]:
    return gap.from_ns or 0, gap.to_ns or 0, gap.cause or ''


def _overlaps(from_ns: int | None, to_ns: int | None, begin_ns: int, end_ns: int) -> bool:
    return from_ns is not None and to_ns is not None and from_ns < end_ns and (to_ns > begin_ns or from_ns >= begin_ns)


def _stretches(
    begin_ns: int, end_ns: int, marks: Sequence[tuple[int, int, str | None]], gaps: Sequence[StatedGap]
) -> Iterator[Stretch]:
    """The stretches, in one pass over all times at which the state changes."""
    changes: defaultdict[int, list[tuple[Counter[str], str, int]]] = defaultdict(list)
    causes, grades = Counter[str](), Counter[str]()
    words: dict[str, str] = {}
    for gap in gaps:
        word = gap.cause or gap.kind or '?'
        words.setdefault(word, word if len(words) < MAX_CAUSES else MORE_CAUSES)
    spans_of = [(gap.from_ns, gap.to_ns, words[gap.cause or gap.kind or '?']) for gap in gaps]
    for active, spans in ((causes, spans_of), (grades, marks)):
        for from_ns, to_ns, name in spans:
            low, high = max(from_ns or 0, begin_ns), min(to_ns or 0, end_ns)
            if low < high:
                changes[low].append((active, name or RECEIVED_ONLY, 1))
                changes[high].append((active, name or RECEIVED_ONLY, -1))
    last: Stretch | None = None
    at_ns = begin_ns
    for next_ns in (*sorted(changes), end_ns):
        if next_ns > at_ns:
            grade = next((name for name in ('exact', 'estimated') if grades[name] > 0), '')
            each = Stretch(at_ns, next_ns, tuple(sorted(+causes)), grade)
            if last is not None and last[2:] == each[2:]:
                last = last._replace(end_ns=next_ns)
            else:
                if last is not None:
                    yield last
                last = each
            at_ns = next_ns
        for active, name, step in changes.get(next_ns, ()):
            active[name] += step
    if last is not None:
        yield last


# -- coverage ------------------------------------------------------------------------------------------------------------------

STORED, DOWNSAMPLED, NOT_KNOWN = 'stored', 'downsampled', 'not known yet'


@dataclass(frozen=True, slots=True)
class Coverage:
    """How much of the time of one robot, sink and topic is in the store."""

    known: Known
    hours: tuple[tuple[int, Mapping[str, float]], ...]
    """Start of each UTC hour -> seconds of ``stored``, ``downsampled``, ``not known yet``, and of each cause of gaps.

    A time with several causes counts for the first of them by name.
    """
    downsampled: tuple[tuple[int, int], ...]
    """Times in which messages were skipped on purpose, because the sensor's rate is lower than the topic's."""


def coverage(since_ns: int, until_ns: int, *, robot: str | None = None, topic: str | None = None,  # noqa: PLR0913 - as above
             sink: str = OBJECTS, source: Bucket | None = None, findings: Findings | None = None,
             by: str = BY_STAMP) -> list[Coverage]:  # fmt: skip
    """The coverage of each robot and topic with statements, or of the given one. Raises StoreError."""
    found = newest(source, robot=robot, topic=topic, sink=sink, since_ns=since_ns, findings=findings, by=by)
    grouped: defaultdict[tuple[str, str], list[Mapping[str, Any]]] = defaultdict(list)
    for row in found.to_pylist():
        grouped[row['robot'], row['topic']].append(row)
    if robot and topic and not grouped:
        grouped[robot, topic] = []
    covered = []
    for (name, of), rows in sorted(grouped.items()):
        each = of_rows(name, sink, of, since_ns, until_ns, rows)
        downsampled = tuple(downsampled_times(rows))
        covered.append(Coverage(each, tuple(_hours(each, downsampled)), downsampled))
    return covered


def downsampled_times(rows: Iterable[Mapping[str, Any]]) -> Iterator[tuple[int, int]]:
    """The times between two watermarks of a session between which messages were skipped."""
    sessions: defaultdict[tuple[Any, ...], list[Mapping[str, Any]]] = defaultdict(list)
    for row in rows:
        if row['what'] == COMPLETE and row['from_ns'] is not None and row['to_ns'] is not None:
            sessions[row['session'], row['from_ns']].append(row)
    for marks in sessions.values():
        at_ns, skipped = marks[0]['from_ns'], 0
        for row in sorted(marks, key=lambda row: row['to_ns']):
            if (row['skipped'] or 0) > skipped:
                yield at_ns, row['to_ns']
            at_ns, skipped = row['to_ns'], row['skipped'] or 0


def _hours(of: Known, downsampled: Sequence[tuple[int, int]]) -> Iterator[tuple[int, Mapping[str, float]]]:
    hours: dict[int, Counter[str]] = {}
    for begin_ns in range(of.begin_ns // HOUR_NS * HOUR_NS, of.end_ns, HOUR_NS):
        hours[begin_ns] = Counter()
    for begin_ns, end_ns, word in named(of, downsampled):
        for hour in range(begin_ns // HOUR_NS * HOUR_NS, end_ns, HOUR_NS):
            hours[hour][word] += min(end_ns, hour + HOUR_NS) - max(begin_ns, hour)
    for hour, spent in hours.items():
        yield hour, {word: spent_ns / SECOND for word, spent_ns in sorted(spent.items())}


def named(of: Known, downsampled: Sequence[tuple[int, int]]) -> Iterator[tuple[int, int, str]]:
    """(begin, end, state) of the whole time: ``stored``, ``downsampled``, ``not known yet`` or the cause of a gap."""
    marks = sorted(downsampled)
    for each in of.stretches:
        if not each.is_whole:
            yield each.begin_ns, each.end_ns, each.causes[0] if each.causes else NOT_KNOWN
            continue
        at_ns = each.begin_ns
        for begin_ns, end_ns in marks[max(0, bisect_right(marks, (at_ns, at_ns)) - 1) :]:
            if begin_ns >= each.end_ns:
                break
            low, high = max(begin_ns, at_ns), min(end_ns, each.end_ns)
            if low < high:
                if at_ns < low:
                    yield at_ns, low, STORED
                yield low, high, DOWNSAMPLED
                at_ns = high
        if at_ns < each.end_ns:
            yield at_ns, each.end_ns, STORED
