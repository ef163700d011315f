"""Estimates how many messages of a publisher without sequence numbers were lost, from the rhythm of those received.

A stamp is the time at which a message was sent (ns), or the value of a counter in it. Regular stamps have a period, which is
declared or learned from ``LEARN`` intervals. An interval of n periods means that n - 1 messages were lost. A late message makes
one interval long and the next one short, which cancel out.

Two cases cannot be detected: loss that is spread evenly from the start (every second message of 100 Hz looks like 50 Hz), and
whether a publisher paused. So a gap of more than ``SILENCE_S`` during which the node kept polling has a separate cause,
``silence``.

A rhythm that no longer fits (a fifth of the intervals are long or short) is discarded, and losses counted by it since it last
fitted are taken back.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import sub
from statistics import fmean, median, pstdev
from typing import Final, NamedTuple

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.spool.account_rows import RhythmRow

LEARN: Final = 200
"""Intervals from which a rhythm is learned."""
MAX_JITTER: Final = 0.16
"""Maximum RMS deviation of the intervals from the period: 10 % for each of the two stamps of an interval, plus what 200 of
them deviate further by chance."""
MAX_LONG_SHARE: Final = 0.2
"""Maximum share of intervals that are long, that is, lack a message; also the maximum share of short ones."""
MAX_LOST_SHARE: Final = 0.3
"""Maximum of lost messages, relative to those received, while a rhythm is learned, not counting the longest gap: messages that
arrive in groups with pauses between them have no rhythm."""
HYSTERESIS: Final = 1.25
"""A known rhythm may be this many times worse before it is discarded."""
REGULAR: Final = 0.3
"""If the distances between long intervals deviate by less, relative to their mean, they are pauses between groups, not losses."""
BLOCK: Final = 10
"""After a gap of more periods, the next message may have any phase."""
SILENCE_S: Final = 1.0
STEP_S: Final = 1.0
"""A message that is younger when taken than all messages before it, by more than this, means that a clock stepped."""
DRIFT: Final = 0.001
"""Maximum drift between two clocks; adjtimex(2) slews by up to 500 ppm."""
MAX_PENDING: Final = 5 * LEARN
"""Intervals that are kept until a rhythm is known, to be counted by it then."""
PHASE_GAIN: Final = 0.5
"""The share of a message's deviation that is added to the phase."""
STAMPS: Final = 'stamps'
TRANSPORT, RESTART, SILENCE = 'transport', 'restart', 'silence'
"""Causes."""


class Expectation(NamedTuple):
    """What is declared about a topic's stamps."""

    source: str = STAMPS
    """``stamps``, or ``counter:FIELD``."""
    period: float = 0.0
    """In ns or counts; 0 to learn it."""
    wrap: int = 0
    """The number of values after which a counter starts again; 0 if there is no counter."""


UNDECLARED: Final = Expectation()


class ArrivalContext(NamedTuple):
    """The conditions under which some messages arrived."""

    now_s: float = 0.0
    """When they were taken, monotonic."""
    silent_s: float = 0.0
    """For how long polling had returned no message before them."""
    is_only: bool = True
    """Whether the topic has one publisher in the graph."""
    gid: str = ''
    """The only publisher's, which identifies it after a restart; '' otherwise."""
    is_shared: bool = False
    """Whether several publishers have been in the graph for longer than a crashed one stays in it."""
    has_new: bool = False
    """Whether a publisher appeared before them: what its predecessor did not publish is not lost."""


class Estimate(NamedTuple):
    """How some messages change an estimate."""

    messages: int
    covered: int
    """How many more messages are covered by a rhythm than before; negative if the rhythm is discarded."""
    missed: Mapping[str, int]
    """By cause; negative if losses are taken back."""

    @property
    def lost(self) -> Mapping[str, int] | None:
        """The losses before these messages, by cause; None if unknown, or if the rhythm has just been learned."""
        return self.missed if self.covered == self.messages else None


@dataclass(slots=True)
class LossEstimator:
    """Estimates the losses of one publisher of one topic: ``observe`` its messages in the order of arrival."""

    expected: Expectation = UNDECLARED
    period: float = 0.0
    """The current period; 0 while it is unknown."""
    last: int | None = None
    """The newest stamp."""
    inherited: bool = False
    """Whether ``last`` is from an earlier session."""
    refuted: bool = False
    """Whether messages arrive more often than declared; the period is then learned."""
    _phase: float = 0.0
    """How late the last message was, in periods."""
    _youngest_s: float | None = None
    """The minimum time between sending and taking a message, up to the offset between the two clocks."""
    _taken_s: float = 0.0
    """When ``_youngest_s`` was updated."""
    _intervals: list[int] = field(default_factory=list)
    """Since the rhythm last fitted; without those across another publisher, a restart or a step of the clock."""
    _silences: set[int] = field(default_factory=set)
    """The intervals during which polling returned nothing."""
    _messages: int = 0
    """Received since the rhythm last fitted."""
    _counted: Counter[str] = field(default_factory=Counter)
    """Losses counted since the rhythm last fitted, to be taken back if it no longer fits."""
    _long: int = 0
    _short: int = 0
    _try_at: int = LEARN
    """The number of intervals at which learning is tried again."""

    def __post_init__(self) -> None:
        self.period = self.expected.period or self.period

    def observe(self, stamps: Sequence[int], context: ArrivalContext) -> Estimate:
        """Count the messages with these stamps."""
        if not self.period and not context.is_only:  # several publishers: their stamps together have no rhythm
            self._reset()
            self.last = stamps[-1]
            return Estimate(len(stamps), 0, {})
        known, missed = bool(self.period), Counter[str]()
        self._messages += len(stamps)
        if self._is_regular(stamps, context):
            self.last = stamps[-1]
            self._is_ahead(self.last, context.now_s)
        else:
            for stamp in stamps:
                self._observe_one(stamp, context, missed)
        covered = len(stamps) if known else 0
        return Estimate(len(stamps), covered + self._check_rhythm(missed), missed)

    def suspend(self) -> None:
        """Ignore the messages so far for the rhythm, because several publishers cannot be distinguished."""
        self._reset()
        self.last = None

    def rebase(self) -> None:
        """Do not count what is published until the next message as missed: the topic is deliberately not subscribed."""
        self.last = None

    # -- one by one ------------------------------------------------------------------------------------------------

    def _is_regular(self, stamps: Sequence[int], context: ArrivalContext) -> bool:
        """Whether all stamps fit the rhythm, which is the usual case and needs no further work."""
        if self.last is None or self.inherited or not self.period or abs(self._phase) > 0.2:
            return False
        gaps = [stamps[0] - self.last, *map(sub, stamps[1:], stamps)]
        if min(gaps) <= 0.5 * self.period or max(gaps) >= 1.5 * self.period or context.has_new:
            return False
        self._phase = 0.0
        self._intervals += gaps
        return True

    def _observe_one(self, stamp: int, context: ArrivalContext, missed: Counter[str]) -> None:
        last, inherited, self.inherited = self.last, self.inherited, False
        self.last = stamp
        gap = 0 if last is None else self._gap(stamp, last)
        if self._has_stepped(stamp, gap, context.now_s) or last is None:
            self._phase = 0.0
            return
        if gap <= 0:
            self.last = last  # out of order
        if not self.period:
            if context.has_new:
                self._reset(1)
            elif not inherited:
                self._intervals.append(gap)
                if context.silent_s > SILENCE_S:
                    self._silences.add(gap)
            return
        count = self._periods(gap)
        if count > 1 and context.has_new:
            self._phase = 0.0
            return
        if inherited:
            if count > 1:
                missed[RESTART] += count - 1
            return
        self._intervals.append(gap)
        self._count(count, SILENCE if context.silent_s > SILENCE_S and count > BLOCK else TRANSPORT, missed)

    def _has_stepped(self, stamp: int, gap: int, now_s: float) -> bool:
        """Whether the counter restarted, or a clock stepped."""
        if self.expected.wrap:
            return gap < 0
        if gap < -STEP_S * SECOND:
            self._youngest_s = None
        return self._is_ahead(stamp, now_s) or gap < -STEP_S * SECOND

    def _is_ahead(self, stamp: int, now_s: float) -> bool:
        """Whether the message is younger than possible, which means that a clock stepped."""
        age_s, youngest_s, drift_s = now_s - stamp / SECOND, self._youngest_s, DRIFT * (now_s - self._taken_s)
        self._taken_s = now_s
        self._youngest_s = age_s if youngest_s is None else min(age_s, youngest_s + drift_s)
        return youngest_s is not None and age_s < youngest_s - drift_s - STEP_S

    def _gap(self, stamp: int, last: int) -> int:
        wrap = self.expected.wrap
        return (stamp - last + wrap // 2) % wrap - wrap // 2 if wrap else stamp - last

    def _periods(self, gap: int) -> int:
        """The number of periods between a message and the previous one."""
        place = gap / self.period + self._phase
        if place > BLOCK:
            self._phase = 0.0
            return round(gap / self.period)
        count = max(0, round(place))
        self._phase = (place - count) * PHASE_GAIN
        return count

    def _count(self, periods: int, cause: str, missed: Counter[str]) -> None:
        if periods > 1:
            self._long += 1
            self._counted[cause] += periods - 1
            missed[cause] += periods - 1
        elif periods == 0 and self._counted[TRANSPORT] > 0:  # the message that made an interval long was late, not lost
            self._counted[TRANSPORT] -= 1
            missed[TRANSPORT] -= 1
        elif periods == 0:
            self._short += 1

    # -- the rhythm ------------------------------------------------------------------------------------------------

    def _check_rhythm(self, missed: Counter[str]) -> int:
        """Discard a rhythm that does not fit, or try to learn one; returns the change of ``Estimate.covered``."""
        limit = HYSTERESIS * MAX_LONG_SHARE * max(LEARN, len(self._intervals))
        if self.expected.period and not self.refuted:
            if self._short > limit:
                self.refuted = True
                return self._discard(missed)
            if len(self._intervals) >= LEARN:
                self._reset()
        elif self.period:
            if self._long > limit or self._short > limit:
                return self._discard(missed)
            if len(self._intervals) >= LEARN:
                return self._confirm(missed)
        elif len(self._intervals) >= self._try_at:
            return self._learn(missed)
        return 0

    def _discard(self, missed: Counter[str]) -> int:
        missed.subtract(self._counted)
        self._counted.clear()
        self.period, self._phase = 0.0, 0.0
        self._long = self._short = 0
        return -self._messages

    def _confirm(self, missed: Counter[str]) -> int:
        period = learn_period(self._intervals, HYSTERESIS)
        if not period:
            return self._discard(missed)
        if abs(period - self.period) > 0.05 * self.period:
            return self._discard(missed) + self._learn(missed)
        self.period = period
        self._reset()
        return 0

    def _learn(self, missed: Counter[str]) -> int:
        period = learn_period(self._intervals[-LEARN:])
        if not period:
            del self._intervals[:-MAX_PENDING]
            self._messages = min(self._messages, MAX_PENDING)
            self._try_at = len(self._intervals) + LEARN // 2
            return 0
        self.period, self._phase = period, 0.0
        intervals, covered = self._intervals, self._messages
        if len(intervals) > LEARN and not _fit(intervals, period):
            intervals, covered = intervals[-LEARN:], LEARN
        for gap in intervals:
            count = self._periods(gap)
            self._count(count, SILENCE if gap in self._silences and count > BLOCK else TRANSPORT, missed)
        self._reset()
        return covered

    def _reset(self, messages: int = 0) -> None:
        self._intervals = []
        self._silences.clear()
        self._counted.clear()
        self._messages = messages
        self._long = self._short = 0
        self._try_at = LEARN


def learn_period(intervals: Sequence[int], slack: float = 1.0) -> float:
    """The period of these intervals; 0 if they have none.

    It is their mean, with intervals of n times the median counted n times. At most ``MAX_LONG_SHARE`` may be long, and the others
    may deviate by ``MAX_JITTER``; long ones that are regular, or lack too many messages, are pauses between groups. ``slack``
    multiplies all limits.
    """
    middle = median(intervals)
    if middle <= 0:
        return 0.0
    counts = [max(0, int(gap / middle + 0.5)) for gap in intervals]
    places = [index for index, count in enumerate(counts) if count > 1]
    limit = slack * MAX_LONG_SHARE * len(intervals)
    if len(places) > limit or sum(gap < 0.5 * middle for gap in intervals) > limit:
        return 0.0
    lost = sum(count - 1 for count in counts if count) - (max(counts) - 1)
    if lost > slack * MAX_LOST_SHARE * len(counts):
        return 0.0
    if len(places) > MAX_LONG_SHARE * LEARN / 4:
        distances = list(map(sub, places[1:], places))
        if pstdev(distances) < REGULAR * fmean(distances):
            return 0.0
    near = [(gap, count) for gap, count in zip(intervals, counts, strict=True) if count <= BLOCK]
    period = sum(gap for gap, _ in near) / sum(count for _, count in near)
    deviation = fmean((gap / period - 1) ** 2 for gap, count in near if count == 1) ** 0.5
    return period if deviation <= slack * MAX_JITTER else 0.0


def _fit(intervals: Sequence[int], period: float) -> bool:
    """Whether the intervals fit the period."""
    limit = MAX_LONG_SHARE * len(intervals)
    return sum(gap > 1.5 * period for gap in intervals) <= limit and sum(gap < 0.5 * period for gap in intervals) <= limit


@dataclass(slots=True)
class TopicEstimate:
    """Estimates the losses of one topic without sequence numbers, over all its publishers. Guarded by its owner's lock."""

    expected: Expectation = UNDECLARED
    before: RhythmRow | None = None
    """The rhythm of an earlier session."""
    estimators: dict[str, LossEstimator] = field(default_factory=dict)
    """By the publisher's gid; '' if the middleware does not provide it."""
    known: bool = False
    """Whether the newest messages are covered by a rhythm."""
    _newest: LossEstimator | None = None
    _gid: str = ''

    @property
    def refuted(self) -> bool:
        """Whether the declared period is wrong."""
        return any(each.refuted for each in self.estimators.values())

    def expect(self, expected: Expectation) -> None:
        """Set what is declared about the stamps from now on."""
        if expected != self.expected:
            self.expected = expected
            self.estimators.clear()
            self._newest = None

    def observe(self, stamps: Mapping[str, Sequence[int]], context: ArrivalContext) -> Estimate:
        """Count messages: their stamps by the publisher's gid, '' if the middleware does not provide it."""
        messages, covered, missed = 0, 0, Counter[str]()
        for publisher, sent in stamps.items():
            found = self._observe(publisher, sent, context)
            messages += found.messages
            covered += found.covered
            missed.update(found.missed)
        return Estimate(messages, covered, missed)

    def _observe(self, publisher: str, stamps: Sequence[int], context: ArrivalContext) -> Estimate:
        each = self.estimators.get(publisher)
        if each is None:
            each = self.estimators[publisher] = self._new_estimator(context.gid)
        self._newest, self._gid = each, context.gid
        if context.is_shared and not publisher:
            each.suspend()
            self.known = False
            return Estimate(len(stamps), 0, {})
        found = each.observe(stamps, context._replace(is_only=context.is_only or bool(publisher)))
        self.known = bool(each.period)
        return found

    def rebase(self) -> None:
        """Do not count what is published until the next message as missed: the topic is deliberately not subscribed."""
        for each in self.estimators.values():
            each.rebase()
        if self.before is not None:
            self.before = replace(self.before, publisher='')

    def row(self, topic: str) -> RhythmRow | None:
        """The rhythm for the next session; None before the first message."""
        newest = self._newest
        if newest is None:
            return None
        gid = self._gid if newest.last is not None else ''
        return RhythmRow(topic, gid, self.expected.source, newest.period, newest.last or 0)

    def _new_estimator(self, gid: str) -> LossEstimator:
        before = self.before if self.before is not None and self.before.source == self.expected.source else None
        if before is None:
            return LossEstimator(self.expected)
        last = before.last if gid and gid == before.publisher else None
        return LossEstimator(self.expected, before.period, last, inherited=last is not None)
