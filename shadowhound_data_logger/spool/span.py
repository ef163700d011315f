"""The numbers of one publisher on one topic: which came, which are missing between, and why. Guarded by the Accounts' lock."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from shadowhound_data_logger.core.stamps import NO_TIMES, Times
from shadowhound_data_logger.spool.gaps import MISSED, GapKey, TopicGaps

MAX_RANGES: Final = 512
"""Ranges of numbers that are remembered per publisher (the newest, which may still come late): every second message lost of
2,000 a second, between two drains. A publisher chooses its numbers, so they are never remembered one by one."""

MAX_MISSED: Final = 1 << 40
"""More than anybody publishes. Numbers that leap further lie, and that is believed to be no loss: sums stay within SQLite."""


class NumberRun(NamedTuple):
    """Messages of one publisher whose numbers follow one another, in a file that has the low 32 bits of these."""

    start: int
    stop: int
    """Of the first one that is not in it."""
    first: Times
    """Those of its first message."""
    last: Times
    """Those of its last message."""


class Ranges:
    """Numbers in sorted ranges that do not touch, each with a word; at most ``MAX_RANGES``, of which the lowest are forgotten."""

    __slots__ = ('_rows',)

    def __init__(self) -> None:
        self._rows: list[tuple[int, int, GapKey | str]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def __contains__(self, number: int) -> bool:
        return self._find(number) is not None

    def append(self, start: int, stop: int, word: GapKey | str) -> None:
        """A range above all others, ``stop`` not in it."""
        self._rows.append((start, stop, word))
        del self._rows[:-MAX_RANGES]

    def within(self, start: int, stop: int) -> list[tuple[int, int, GapKey | str]]:
        """What of the ranges lies from ``start`` on and before ``stop``."""
        at = max(bisect_right(self._rows, (start + 1,)) - 1, 0)
        found = []
        while at < len(self._rows) and self._rows[at][0] < stop:
            low, high, word = self._rows[at]
            if high > start:
                found.append((max(low, start), min(high, stop), word))
            at += 1
        return found

    def cut(self, start: int, stop: int) -> None:
        """Take out numbers that are all in one range."""
        at = self._find(start)
        assert at is not None
        low, high, word = self._rows[at]
        rest = [(low, start, word), (stop, high, word)]
        self._rows[at : at + 1] = [row for row in rest if row[0] < row[1]]
        del self._rows[:-MAX_RANGES]

    def add(self, number: int) -> bool:
        """Put in one number that is not in it; False where that would be a range too many."""
        at = bisect_right(self._rows, (number,))
        below = at > 0 and self._rows[at - 1][1] == number
        above = at < len(self._rows) and self._rows[at][0] == number + 1
        if not (below or above) and len(self._rows) >= MAX_RANGES:
            return False
        start = self._rows[at - 1][0] if below else number
        stop = self._rows[at][1] if above else number + 1
        self._rows[at - below : at + above] = [(start, stop, '')]
        return True

    def _find(self, number: int) -> int | None:
        at = bisect_right(self._rows, (number + 1,)) - 1
        return at if at >= 0 and self._rows[at][0] <= number < self._rows[at][1] else None


@dataclass(slots=True)
class Span:
    """The numbers of one publisher on one topic, from the first one taken.

    ``published`` = ``received`` + sum of ``missed``, always. A span inherited from an earlier session starts with zero
    counts and that session's ``first`` and ``last``: the gap before its first message is then missed by ``restart``.
    """

    first: int | None = None
    last: int | None = None
    inherited: bool = False
    heard: Times = NO_TIMES
    """Those of the message with the number ``last``; zeros if they are unknown."""
    name: str = ''
    gaps: TopicGaps = field(default_factory=TopicGaps)
    """Where the times of what is missed go: those of its topic."""
    published: int = 0
    received: int = 0
    missed: Counter[str] = field(default_factory=Counter)
    older: bool = False
    """Whether rows of earlier sessions have it."""
    used: int = 0
    """When it was last observed, by the count of its topic."""
    _holes: Ranges = field(default_factory=Ranges)
    """Numbers below ``last`` that were not taken, with the cause they are missed by; '' where they were not listened to."""
    _early: Ranges = field(default_factory=Ranges)
    _base: int | None = None
    _rebased: bool = False
    changed: bool = False
    """Since the last snapshot."""
    _late: int = 0
    """Messages after the inherited ``last`` that are counted already: they are not part of the gap before the next one."""

    def __post_init__(self) -> None:
        self._base = self.first
        self.older = self.inherited

    def observe(self, number: int, times: Times = NO_TIMES) -> bool:
        """Count a message by its sequence number; False if it was counted before (a repeat)."""
        if self.first is None or self._base is None or self.last is None:
            self.first = self._base = self.last = number
            self.heard = times
        elif number > self.last:
            if number > self.last + 1:
                self._skip(self.last + 1, number, times)
            self.last = number
            self.heard = times
            self.inherited = self._rebased = False
            self._late = 0
        elif holes := self._holes.within(number, number + 1):
            self.published -= self._fill(holes)
        elif number < self._base and number not in self._early:
            # TRANSIENT_LOCAL delivers history from before the first number taken.
            if not self._early.add(number):
                return False
            self.first = min(self.first, number)
        else:
            return False
        self.count()
        return True

    def count(self) -> None:
        """Count a message that has no number."""
        self.received += 1
        self.published += 1
        self.changed = True

    def lose(self, count: int) -> None:
        """Count messages that the middleware reports to have lost."""
        self.missed['transport'] += count
        self.published += count
        self.changed = True

    def find(self, count: int) -> int:
        """So many of what a restart cost were recorded after all; returns how many could be among them."""
        found = min(count, self.missed['restart'])
        self.missed['restart'] -= found
        self.received += found
        self.changed = self.changed or bool(found)
        return found

    def late(self, count: int) -> None:
        """Count messages after the inherited ``last``, whose numbers are not known."""
        if count:
            self.received += count
            self.published += count
            if self.inherited:
                self._late += count
            self.changed = True

    def recall(self, runs: Sequence[NumberRun], count: int) -> bool:
        """Count messages of the session before that turned up in a file, ``count`` of them for the first time.

        ``runs`` are all that the file has of the topic. False, and nothing is changed, where they do not show that these
        messages are this publisher's: they begin with the number after its last, or have that one with its stamp.
        """
        if self.last is None or not runs:
            return False
        more = (self.last - runs[0].start + (1 << 31)) >> 32 << 32
        runs = [run._replace(start=run.start + more, stop=run.stop + more) for run in runs]
        return self._go_on(runs, count) if self.inherited else self._fill_in(runs, count)

    def _go_on(self, runs: Sequence[NumberRun], count: int) -> bool:
        """As ``recall``, before the first message of this session."""
        last = self.last
        assert last is not None
        is_own = any(
            run.start == last + 1
            or (run.start <= last < run.stop and run.first.stamp_ns <= self.heard.stamp_ns <= run.last.stamp_ns)
            for run in runs
        )
        fresh = [run._replace(start=max(run.start, last + 1)) for run in runs if run.stop > last + 1]
        if not is_own or sum(run.stop - run.start for run in fresh) != count:
            return False
        for run in fresh:
            if run.start > last + 1:
                self._skip(last + 1, run.start, run.first)
            self.last = last = run.stop - 1
            self.heard = run.last
        self.received += count
        self.published += count
        self.changed = True
        return True

    def _fill_in(self, runs: Iterable[NumberRun], count: int) -> bool:
        """As ``recall``, after the gap of the restart was counted."""
        holes = [hole for run in runs for hole in self._holes.within(run.start, run.stop)
                 if isinstance(hole[2], GapKey) and hole[2].cause == 'restart']  # fmt: skip
        if sum(stop - start for start, stop, _ in holes) != count or self.missed['restart'] < count:
            return False
        self._fill(holes)
        self.received += count
        self.changed = True
        return True

    def absorb(self, other: Span) -> None:
        """Take over the counts of a publisher that is not followed any more; their numbers are nobody's then."""
        self.published += other.received
        self.received += other.received
        if self.missed.total() + other.missed.total() <= MAX_MISSED:
            self.published += other.missed.total()
            self.missed.update(other.missed)
        self.changed = True

    def rebase(self) -> None:
        """What is published until the next new message was not listened to on purpose: that gap is not missed."""
        self._rebased = True

    def _fill(self, holes: Iterable[tuple[int, int, GapKey | str]]) -> int:
        """Numbers of holes came after all; how many of them were missed until now."""
        filled = 0
        for start, stop, key in holes:
            before = len(self._holes)
            self._holes.cut(start, stop)
            if isinstance(key, GapKey) and (count := min(stop - start, self.missed[key.cause])) > 0:
                self.missed[key.cause] -= count
                self.gaps.fill(key, count, len(self._holes) - before)
                filled += count
        return filled

    def _skip(self, start: int, stop: int, times: Times) -> None:
        """Count the numbers of a gap as missed, unless nobody listened, and remember them: they may come late."""
        cause = '' if self._rebased else 'restart' if self.inherited else 'transport'
        if self.missed.total() + stop - start > MAX_MISSED:
            cause = ''
        hole: GapKey | str = ''
        if cause:
            known = min(self._late, stop - start)
            self._late -= known
            count = stop - start - known
            self.missed[cause] += count
            self.published += count
            hole = self.gaps.add(MISSED, cause, count, self.heard if any(self.heard) else self.gaps.heard, times, self.name)
        self._holes.append(start, stop, hole)
