"""What is known of a stream between two times: what the store has, what was lost and why, and where nobody knows.

``known`` is the one question for everything that shows data or trains on it. It reads the statements of the gap journal
(formats/rows/gaps.py): the newest about each gap counts, whatever else was said before and in whatever part it lies. No gap is
known to be none only where a watermark reaches; a robot that is off, or out of reach, leaves the time open until it tells.
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

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.config import home, store_settings
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.core.times import moment
from shadowhound_data_logger.formats.rows.gaps import COMPLETE, GAP, GAPS
from shadowhound_data_logger.formats.rows.schema import BUCKET, UNDATED
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.tables import answer, literal, quoted
from shadowhound_data_logger.lake.views import views

OBJECTS, BAGS, EVENTS = 'objects', 'bags', 'events'
SINKS: Final = (OBJECTS, BAGS, EVENTS)
"""Where messages go, each with gaps of its own."""
HOUR_NS: Final = 3600 * SECOND
OTHER_TYPE: Final = 'wrong_type'
"""Rejected messages of another type than the topic's: nothing of the topic's own is missing."""
RECEIVED_ONLY: Final = 'received-only'
MOST_CAUSES: Final = 64
"""Of a topic, by name; all further ones are one, ``MORE_CAUSES``. Ours are some twenty; a part may have one for each row."""
MORE_CAUSES: Final = '(more)'
_NEWEST: Final = (
    f'SELECT {", ".join(map(quoted, GAPS.columns))} FROM (SELECT *, row_number() OVER (PARTITION BY robot, id '  # noqa: S608
    'ORDER BY revision DESC, what ASC, to_ns DESC, from_ns DESC) AS _place FROM all_gaps WHERE {}) WHERE _place = 1 '
    'ORDER BY robot, id'
)
"""The newest statement first; a gap before the withdrawal of the same revision, with which it moved to another day."""
_ORDER: Final = [('robot', 'ascending'), ('id', 'ascending'), ('revision', 'descending'), ('what', 'ascending')]
_FIRST: Final = [*_ORDER, *((name, 'descending') for name in GAPS.columns if name not in dict(_ORDER))]
"""The newest statement first; a gap before the withdrawal of the same revision, with which it moved to another day."""


@dataclass(frozen=True, slots=True)
class StatedGap:
    """A statement of the gap journal about messages that are not in the store; what is not known is None."""

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
    """So many gaps within one second are one here."""
    grade: str | None
    mission_id: str | None
    clock: str | None


class Stretch(NamedTuple):
    """A time in which the same is known all along: from ``begin_ns`` until before ``end_ns``."""

    begin_ns: int
    end_ns: int
    causes: tuple[str, ...]
    """Why messages of this time are not in the store; empty where none is missing, or nobody knows."""
    grade: str
    """How well it is known that no other message is missing: ``exact``, ``estimated``; '' where it is not known."""

    @property
    def is_whole(self) -> bool:
        """Whether all of it is in the store, as far as the robot's settings want it there."""
        return bool(self.grade) and not self.causes

    @property
    def is_open(self) -> bool:
        """Whether nobody knows what is missing: it may be nothing."""
        return not self.grade and not self.causes


@dataclass(frozen=True, slots=True)
class Known:
    """What is known of one sink and topic of a robot between two times."""

    robot: str
    sink: str
    topic: str
    begin_ns: int
    end_ns: int
    stretches: tuple[Stretch, ...]
    """One after the other, all of the time."""
    gaps: tuple[StatedGap, ...]
    """Those that reach into the time, in its order; a gap that reaches beyond it is told whole."""
    untimed: tuple[StatedGap, ...]
    """Gaps of which nobody knows the time; they can lie anywhere."""

    @property
    def is_whole(self) -> bool:
        """Whether it is known that nothing is missing in all of the time."""
        return all(each.is_whole for each in self.stretches)

    @property
    def complete_ns(self) -> int:
        """Up to here it is known what is missing: the watermark, as far as this time goes."""
        return next((each.begin_ns for each in self.stretches if each.is_open), self.end_ns)

    def between(self, begin_ns: int, end_ns: int) -> Known:
        """Of a part of the time, without reading again. Raises ValueError for a time that is not in it."""
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
        gaps = tuple(gap for gap in self.gaps if _reaches(gap.from_ns, gap.to_ns, begin_ns, end_ns))
        return Known(self.robot, self.sink, self.topic, begin_ns, end_ns, tuple(found), gaps, self.untimed)


def known(robot: str, topic: str, since: str | datetime | int, until: str | datetime | int = 'now', *, sink: str = OBJECTS,
          source: Bucket | None = None, findings: Findings | None = None) -> Known:  # fmt: skip
    """What is known of a topic from ``since`` until before ``until``: in words as of ``query``, or in ns since 1970.

    Three answers, stretch by stretch: it is whole; messages are missing, with the gaps; or nobody knows. Without numbers or a
    rhythm (``received-only``) nobody knows. Ask once for a long time, and ``Known.between`` for its parts. Without a source it
    asks the store that the environment names. Parts that are none are left out: ``findings`` has them, else the log warns.
    Raises SettingError, StoreError.
    """
    now_ns = time.time_ns()
    if sink not in SINKS:
        raise SettingError('sink', sink, ' or '.join(SINKS))
    begin_ns, end_ns = moment_ns('since', since, now_ns), moment_ns('until', until, now_ns)
    if end_ns < begin_ns:
        raise SettingError('until', until, f'a time after {since}')
    found = newest(source, robot=robot, topic=topic, sink=sink, since_ns=begin_ns, findings=findings)
    return of_rows(robot, sink, topic, begin_ns, end_ns, found.to_pylist())


def moment_ns(name: str, given: str | datetime | int, now_ns: int) -> int:
    """A time in ns since 1970. Raises SettingError."""
    return given if isinstance(given, int) else moment(name, given, now_ns)


def newest(source: Bucket | None = None, *, robot: str | None = None, topic: str | None = None, sink: str | None = None,
           since_ns: int | None = None, findings: Findings | None = None) -> pa.Table:  # fmt: skip
    """The statements that count, about times from then on or none, with the columns of ``catalogue.gaps.GAPS``.

    Raises StoreError, LakeError.
    """
    source = source or Bucket(store_settings(os.environ, home(os.environ)), BUCKET)
    findings = Findings() if findings is None else findings
    first = '' if since_ns is None else f'{utc(max(since_ns, 0)):%Y-%m-%d}'
    conditions = [f'(date >= {literal(first)} OR date = {literal(UNDATED)})'] if first else []
    conditions += [f'{name} = {literal(value)}' for name, value in (('topic', topic), ('sink', sink)) if value is not None]
    conditions += [] if robot is None else [f'robot = {literal(robot)}']
    has_date = (lambda date: date >= first or date == UNDATED) if first else None
    with views(source, [GAPS], findings, robot=robot, has_date=has_date) as ready:
        return answer(ready, _NEWEST.format(' AND '.join(conditions) or 'true'))


def folded(rows: pa.Table) -> pa.Table:
    """The newest statement about each thing, withdrawals among them: in whatever order and how often they are given.

    Whatever is folded again, alone or with others, gives what all at once would have given.
    """
    if not len(rows):
        return rows
    found = rows.take(pc.sort_indices(rows, sort_keys=_FIRST)).combine_chunks()
    is_first = np.ones(len(found), bool)
    same = [pc.equal(found[name][1:], found[name][:-1]).to_numpy() for name in ('robot', 'id')]
    is_first[1:] = ~(same[0] & same[1])
    return found.filter(pa.array(is_first))


def of_rows(robot: str, sink: str, topic: str, begin_ns: int, end_ns: int, rows: Iterable[Mapping[str, Any]]) -> Known:
    """As ``known``, of newest statements of that robot, sink and topic."""
    rows = list(rows)
    told = [_gap(row) for row in rows if row['what'] == GAP]
    gaps = sorted((gap for gap in told if _reaches(gap.from_ns, gap.to_ns, begin_ns, end_ns)), key=_by_time)
    untimed = tuple(gap for gap in told if _is_untimed(gap))
    marks = [(row['from_ns'], row['to_ns'], row['grade']) for row in watermarks(rows) if row['grade'] != RECEIVED_ONLY]
    stretches = _stretches(begin_ns, end_ns, marks, [gap for gap in gaps if gap.cause != OTHER_TYPE and not _is_untimed(gap)])
    return Known(robot, sink, topic, begin_ns, end_ns, tuple(stretches), tuple(gaps), untimed)


def watermarks(rows: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The newest ``complete`` statement of each session, sink and topic: it speaks of ``from_ns`` to ``to_ns``."""
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


def _reaches(from_ns: int | None, to_ns: int | None, begin_ns: int, end_ns: int) -> bool:
    return from_ns is not None and to_ns is not None and from_ns < end_ns and (to_ns > begin_ns or from_ns >= begin_ns)


def _stretches(
    begin_ns: int, end_ns: int, marks: Sequence[tuple[int, int, str | None]], gaps: Sequence[StatedGap]
) -> Iterator[Stretch]:
    """One pass over all times at which something begins or ends."""
    changes: defaultdict[int, list[tuple[Counter[str], str, int]]] = defaultdict(list)
    causes, grades = Counter[str](), Counter[str]()
    words: dict[str, str] = {}
    for gap in gaps:
        word = gap.cause or gap.kind or '?'
        words.setdefault(word, word if len(words) < MOST_CAUSES else MORE_CAUSES)
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
    """Begin of each UTC hour -> seconds of ``stored``, ``downsampled``, ``not known yet``, and of each cause of gaps.

    Where several causes hold at a time, it counts for the first of them by name.
    """
    downsampled: tuple[tuple[int, int], ...]
    """Times from which messages were left out on purpose, since the rate of the topic is set lower than it comes."""


def coverage(since_ns: int, until_ns: int, *, robot: str | None = None, topic: str | None = None, sink: str = OBJECTS,
             source: Bucket | None = None, findings: Findings | None = None) -> list[Coverage]:  # fmt: skip
    """Of each robot and topic of which anything is known, or of the one that is named. Raises StoreError."""
    found = newest(source, robot=robot, topic=topic, sink=sink, since_ns=since_ns, findings=findings)
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
    """Between two watermarks of a session by which more messages were skipped."""
    sessions: defaultdict[tuple[Any, ...], list[Mapping[str, Any]]] = defaultdict(list)
    for row in rows:
        if row['what'] == COMPLETE and row['from_ns'] is not None and row['to_ns'] is not None:
            sessions[row['session'], row['from_ns']].append(row)
    for told in sessions.values():
        at_ns, skipped = told[0]['from_ns'], 0
        for row in sorted(told, key=lambda row: row['to_ns']):
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
    """(begin, end, word) of all of the time: ``stored``, ``downsampled``, ``not known yet`` or the cause of a gap."""
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
