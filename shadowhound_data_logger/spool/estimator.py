"""Estimates how many messages of a publisher without numbers were lost, from the rhythm of those received.

A stamp is when a message was sent (ns), or the value of a counter in it. Stamps that come evenly have a period: declared, or
learned from ``LEARN`` intervals between them. An interval of n periods then says that n - 1 messages were lost. A late message
makes one interval long and the next one short, which cancel out.

What cannot be told: loss that is spread evenly from the start (half of the messages of 100 Hz look like 50 Hz), and whether
a publisher that is still there paused. That nothing came for more than ``SILENCE_S``, though it was asked for all the time,
is therefore a cause of its own, ``silence``.

A rhythm that does not hold any more (a fifth of the intervals are long or short) is given up, and what was counted by it since
it was last seen to hold is taken back.
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
"""Intervals that it takes to know a rhythm."""
JITTER: Final = 0.16
"""Most that the intervals may deviate from the period, root mean square: 10 % for each of the two stamps of an interval, and
what 200 of them say more than that by chance."""
LONG_SHARE: Final = 0.2
"""Most of the intervals that may be long, that is, lack a message; and most that may be short."""
LOST_SHARE: Final = 0.3
"""Most messages, of those received, that may be lost while a rhythm is learned, apart from the longest gap: what comes in groups
with pauses between them has no rhythm."""
HOLDS: Final = 1.25
"""A rhythm that is known may be so many times worse before it is given up."""
EVENLY: Final = 0.3
"""Deviation of the distances between long intervals, of their mean, below which they come regularly: in groups, not by chance."""
BLOCK: Final = 10
"""A gap of more periods says nothing of where the next message is due to the fraction of a period."""
SILENCE_S: Final = 1.0
STEP_S: Final = 1.0
"""So much younger, when it is taken, than all before it a message may be; beyond it a clock stepped."""
DRIFT: Final = 0.001
"""Most by which two clocks go apart; adjtimex(2) has them go 500 ppm off to set them."""
PENDING: Final = 5 * LEARN
"""Intervals that wait for a rhythm, to be counted by it once it is known."""
FOLLOW: Final = 0.5
"""Share of a message's deviation by which the place of the next one moves."""
STAMPS: Final = 'stamps'
TRANSPORT, RESTART, SILENCE = 'transport', 'restart', 'silence'
"""Causes."""


class Expectation(NamedTuple):
    """What is known of a topic's stamps before the first one."""

    of: str = STAMPS
    """``stamps``, or ``counter:FIELD``."""
    period: float = 0.0
    """Declared, ns or counts; 0 where it is to be learned."""
    wrap: int = 0
    """A counter starts again after so many values."""


UNDECLARED: Final = Expectation()


class ArrivalContext(NamedTuple):
    """The conditions under which some messages arrived."""

    now_s: float = 0.0
    """When they were taken, monotonic."""
    quiet_s: float = 0.0
    """How long nothing came before them although it was asked for."""
    alone: bool = True
    """Whether one publisher of the topic is known."""
    gid: str = ''
    """Its name, where it is alone, by which it is known again after a restart."""
    crowded: bool = False
    """Whether several have been known for so long that none of them can be one that died."""
    new: bool = False
    """Whether a publisher came meanwhile: what its predecessor did not publish is not lost."""


class Estimate(NamedTuple):
    """What some messages change of an estimate."""

    messages: int
    covered: int
    """So many more messages are counted by a rhythm than before; less than 0 where it is given up."""
    missed: Mapping[str, int]
    """By cause; less than 0 where it is taken back."""

    @property
    def lost(self) -> Mapping[str, int] | None:
        """What is missing before these messages, by cause; None where it is not known, or only learns it now."""
        return self.missed if self.covered == self.messages else None


@dataclass(slots=True)
class LossEstimator:
    """Estimates what one publisher of one topic lost. ``observe`` what was received, in the order in which it came."""

    expected: Expectation = UNDECLARED
    period: float = 0.0
    """In force; 0 while it is not known."""
    last: int | None = None
    """The newest stamp."""
    inherited: bool = False
    """Whether that is one of an earlier session."""
    refuted: bool = False
    """Whether messages come more often than was declared: it is learned then."""
    _phase: float = 0.0
    """How far the last message came after its time, in periods."""
    _youngest_s: float | None = None
    """The least time between the sending of a message and its taking, up to what is between their clocks."""
    _taken_s: float = 0.0
    """When that was known."""
    _intervals: list[int] = field(default_factory=list)
    """Since the rhythm was last seen to hold; without those that say nothing (another publisher, a restart, a step)."""
    _quiet: set[int] = field(default_factory=set)
    """Those of them in which nothing came though it was asked for."""
    _messages: int = 0
    """Received since then."""
    _counted: Counter[str] = field(default_factory=Counter)
    """Counted since then: to be taken back if the rhythm does not hold."""
    _long: int = 0
    _short: int = 0
    _try_at: int = LEARN
    """Intervals with which the rhythm is looked for again."""

    def __post_init__(self) -> None:
        self.period = self.expected.period or self.period

    def observe(self, stamps: Sequence[int], hearing: ArrivalContext) -> Estimate:
        """Count the messages with these stamps."""
        if not self.period and not hearing.alone:  # nobody knows whose rhythm that is
            self._begin()
            self.last = stamps[-1]
            return Estimate(len(stamps), 0, {})
        known, missed = bool(self.period), Counter[str]()
        self._messages += len(stamps)
        if self._is_regular(stamps, hearing):
            self.last = stamps[-1]
            self._is_ahead(self.last, hearing.now_s)
        else:
            for stamp in stamps:
                self._place(stamp, hearing, missed)
        covered = len(stamps) if known else 0
        return Estimate(len(stamps), covered + self._judge(missed), missed)

    def suspend(self) -> None:
        """Several publish now, and nobody knows who: what they send says nothing of the rhythm."""
        self._begin()
        self.last = None

    def rebase(self) -> None:
        """What is published until the next message was not listened to on purpose."""
        self.last = None

    # -- one by one ------------------------------------------------------------------------------------------------

    def _is_regular(self, stamps: Sequence[int], hearing: ArrivalContext) -> bool:
        """Whether all of it is as the rhythm has it, the usual case: then nothing else is to be done."""
        if self.last is None or self.inherited or not self.period or abs(self._phase) > 0.2:
            return False
        gaps = [stamps[0] - self.last, *map(sub, stamps[1:], stamps)]
        if min(gaps) <= 0.5 * self.period or max(gaps) >= 1.5 * self.period or hearing.new:
            return False
        self._phase = 0.0
        self._intervals += gaps
        return True

    def _place(self, stamp: int, hearing: ArrivalContext, missed: Counter[str]) -> None:
        last, inherited, self.inherited = self.last, self.inherited, False
        self.last = stamp
        gap = 0 if last is None else self._gap(stamp, last)
        if self._has_stepped(stamp, gap, hearing.now_s) or last is None:
            self._phase = 0.0
            return
        if gap <= 0:
            self.last = last  # overtaken by others
        if not self.period:
            if hearing.new:
                self._begin(1)
            elif not inherited:
                self._intervals.append(gap)
                if hearing.quiet_s > SILENCE_S:
                    self._quiet.add(gap)
            return
        count = self._periods(gap)
        if count > 1 and hearing.new:
            self._phase = 0.0
            return
        if inherited:
            if count > 1:
                missed[RESTART] += count - 1
            return
        self._intervals.append(gap)
        self._count(count, SILENCE if hearing.quiet_s > SILENCE_S and count > BLOCK else TRANSPORT, missed)

    def _has_stepped(self, stamp: int, gap: int, now_s: float) -> bool:
        """Whether the counter began anew, or a clock stepped."""
        if self.expected.wrap:
            return gap < 0
        if gap < -STEP_S * SECOND:
            self._youngest_s = None
        return self._is_ahead(stamp, now_s) or gap < -STEP_S * SECOND

    def _is_ahead(self, stamp: int, now_s: float) -> bool:
        """Whether the message is younger than one can be: not by what the node took late, but by a clock that stepped."""
        age_s, youngest_s, drift_s = now_s - stamp / SECOND, self._youngest_s, DRIFT * (now_s - self._taken_s)
        self._taken_s = now_s
        self._youngest_s = age_s if youngest_s is None else min(age_s, youngest_s + drift_s)
        return youngest_s is not None and age_s < youngest_s - drift_s - STEP_S

    def _gap(self, stamp: int, last: int) -> int:
        wrap = self.expected.wrap
        return (stamp - last + wrap // 2) % wrap - wrap // 2 if wrap else stamp - last

    def _periods(self, gap: int) -> int:
        """How many periods lie between a message and the one before it."""
        place = gap / self.period + self._phase
        if place > BLOCK:
            self._phase = 0.0
            return round(gap / self.period)
        count = max(0, round(place))
        self._phase = (place - count) * FOLLOW
        return count

    def _count(self, periods: int, cause: str, missed: Counter[str]) -> None:
        if periods > 1:
            self._long += 1
            self._counted[cause] += periods - 1
            missed[cause] += periods - 1
        elif periods == 0 and self._counted[TRANSPORT] > 0:  # what made an interval long was late, and not lost
            self._counted[TRANSPORT] -= 1
            missed[TRANSPORT] -= 1
        elif periods == 0:
            self._short += 1

    # -- whether it holds ------------------------------------------------------------------------------------------

    def _judge(self, missed: Counter[str]) -> int:
        """Give the rhythm up where it does not hold, find it where it is not known; the change of what is covered."""
        most = HOLDS * LONG_SHARE * max(LEARN, len(self._intervals))
        if self.expected.period and not self.refuted:
            if self._short > most:
                self.refuted = True
                return self._give_up(missed)
            if len(self._intervals) >= LEARN:
                self._begin()
        elif self.period:
            if self._long > most or self._short > most:
                return self._give_up(missed)
            if len(self._intervals) >= LEARN:
                return self._confirm(missed)
        elif len(self._intervals) >= self._try_at:
            return self._learn(missed)
        return 0

    def _give_up(self, missed: Counter[str]) -> int:
        """Returns the change of what is covered."""
        missed.subtract(self._counted)
        self._counted.clear()
        self.period, self._phase = 0.0, 0.0
        self._long = self._short = 0
        return -self._messages

    def _confirm(self, missed: Counter[str]) -> int:
        period = learned(self._intervals, HOLDS)
        if not period:
            return self._give_up(missed)
        if abs(period - self.period) > 0.05 * self.period:
            return self._give_up(missed) + self._learn(missed)
        self.period = period
        self._begin()
        return 0

    def _learn(self, missed: Counter[str]) -> int:
        period = learned(self._intervals[-LEARN:])
        if not period:
            del self._intervals[:-PENDING]  # of these nobody will ever know
            self._messages = min(self._messages, PENDING)
            self._try_at = len(self._intervals) + LEARN // 2
            return 0
        self.period, self._phase = period, 0.0
        intervals, covered = self._intervals, self._messages
        if len(intervals) > LEARN and not _agree(intervals, period):
            intervals, covered = intervals[-LEARN:], LEARN
        for gap in intervals:
            count = self._periods(gap)
            self._count(count, SILENCE if gap in self._quiet and count > BLOCK else TRANSPORT, missed)
        self._begin()
        return covered

    def _begin(self, messages: int = 0) -> None:
        self._intervals = []
        self._quiet.clear()
        self._counted.clear()
        self._messages = messages
        self._long = self._short = 0
        self._try_at = LEARN


def learned(intervals: Sequence[int], slack: float = 1.0) -> float:
    """The period of these intervals; 0 where they have none.

    It is their mean where those that are n times the median count n times. At most a fifth may be long, and the others may
    deviate by ``JITTER``; long ones that come regularly, or lack too much, are pauses between groups. ``slack`` widens it all.
    """
    middle = median(intervals)
    if middle <= 0:
        return 0.0
    counts = [max(0, int(gap / middle + 0.5)) for gap in intervals]
    places = [place for place, count in enumerate(counts) if count > 1]
    most = slack * LONG_SHARE * len(intervals)
    if len(places) > most or sum(gap < 0.5 * middle for gap in intervals) > most:
        return 0.0
    lost = sum(count - 1 for count in counts if count) - (max(counts) - 1)
    if lost > slack * LOST_SHARE * len(counts):
        return 0.0
    if len(places) > LONG_SHARE * LEARN / 4:
        distances = list(map(sub, places[1:], places))
        if pstdev(distances) < EVENLY * fmean(distances):
            return 0.0
    near = [(gap, count) for gap, count in zip(intervals, counts, strict=True) if count <= BLOCK]
    period = sum(gap for gap, _ in near) / sum(count for _, count in near)
    deviation = fmean((gap / period - 1) ** 2 for gap, count in near if count == 1) ** 0.5
    return period if deviation <= slack * JITTER else 0.0


def _agree(intervals: Sequence[int], period: float) -> bool:
    """Whether the rhythm held all the time."""
    most = LONG_SHARE * len(intervals)
    return sum(gap > 1.5 * period for gap in intervals) <= most and sum(gap < 0.5 * period for gap in intervals) <= most


@dataclass(slots=True)
class TopicEstimate:
    """Estimates what was lost of one topic whose messages have no numbers, over all its publishers.

    Guarded by its owner's lock.
    """

    expected: Expectation = UNDECLARED
    before: RhythmRow | None = None
    """What an earlier session knew."""
    estimators: dict[str, LossEstimator] = field(default_factory=dict)
    """By the publisher's name, '' where only the graph tells who it is."""
    known: bool = False
    """Whether the messages that came last are counted by a rhythm."""
    _newest: LossEstimator | None = None
    _gid: str = ''

    @property
    def refuted(self) -> bool:
        """Whether what was declared is wrong."""
        return any(each.refuted for each in self.estimators.values())

    def expect(self, expected: Expectation) -> None:
        """What is known of the stamps from now on."""
        if expected != self.expected:
            self.expected = expected
            self.estimators.clear()
            self._newest = None

    def observe(self, stamps: Mapping[str, Sequence[int]], hearing: ArrivalContext) -> Estimate:
        """Count what publishers sent: the stamps by their names, '' where the middleware does not name them."""
        messages, covered, missed = 0, 0, Counter[str]()
        for publisher, sent in stamps.items():
            found = self._observe(publisher, sent, hearing)
            messages += found.messages
            covered += found.covered
            missed.update(found.missed)
        return Estimate(messages, covered, missed)

    def _observe(self, publisher: str, stamps: Sequence[int], hearing: ArrivalContext) -> Estimate:
        each = self.estimators.get(publisher)
        if each is None:
            each = self.estimators[publisher] = self._begun(hearing.gid)
        self._newest, self._gid = each, hearing.gid
        if hearing.crowded and not publisher:
            each.suspend()
            self.known = False
            return Estimate(len(stamps), 0, {})
        found = each.observe(stamps, hearing._replace(alone=hearing.alone or bool(publisher)))
        self.known = bool(each.period)
        return found

    def rebase(self) -> None:
        """What is published until the next message was not listened to on purpose."""
        for each in self.estimators.values():
            each.rebase()
        if self.before is not None:
            self.before = replace(self.before, publisher='')

    def row(self, topic: str) -> RhythmRow | None:
        """What the next session is to know; None where nothing is known yet."""
        newest = self._newest
        if newest is None:
            return None
        return RhythmRow(topic, self._gid if newest.last is not None else '', self.expected.of, newest.period, newest.last or 0)

    def _begun(self, gid: str) -> LossEstimator:
        before = self.before if self.before is not None and self.before.of == self.expected.of else None
        if before is None:
            return LossEstimator(self.expected)
        last = before.last if gid and gid == before.publisher else None
        return LossEstimator(self.expected, before.period, last, inherited=last is not None)
