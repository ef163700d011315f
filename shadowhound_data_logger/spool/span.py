"""The sequence numbers of one publisher on one topic: which were received, which are missing, and why."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from shadowhound_data_logger.core.stamps import NO_TIMES, Times
from shadowhound_data_logger.spool.gaps import MISSED, GapKey, TopicGaps

MAX_RANGES: Final = 512
"""Ranges of numbers remembered per publisher (the newest ones, which may still arrive late): enough for a loss of every second
message at 2,000/s between two drains. Numbers are never remembered one by one, because a publisher may send any numbers."""

MAX_MISSED: Final = 1 << 40
"""A jump by more cannot be real and is not counted as a loss, so that sums fit into SQLite's integers."""


class NumberRun(NamedTuple):
    """Consecutive sequence numbers of one publisher in a file, which stores their low 32 bits."""

    start: int
    stop: int
    """Exclusive."""
    first: Times
    """Of the first message."""
    last: Times
    """Of the last message."""


class Ranges:
    """Numbers in sorted, disjoint ranges with a label each; at most ``MAX_RANGES``: the lowest are forgotten."""

    __slots__ = ('_rows',)

    def __init__(self) -> None:
        self._rows: list[tuple[int, int, GapKey | str]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def __contains__(self, number: int) -> bool:
        return self._find(number) is not None

    def append(self, start: int, stop: int, label: GapKey | str) -> None:
        """Add a range above all others; ``stop`` is exclusive."""
        self._rows.append((start, stop, label))
        del self._rows[:-MAX_RANGES]

    def within(self, start: int, stop: int) -> list[tuple[int, int, GapKey | str]]:
        """The parts of the ranges between ``start`` and ``stop`` (exclusive)."""
        at = max(bisect_right(self._rows, (start + 1,)) - 1, 0)
        found = []
        while at < len(self._rows) and self._rows[at][0] < stop:
            low, high, label = self._rows[at]
            if high > start:
                found.append((max(low, start), min(high, stop), label))
            at += 1
        return found

    def cut(self, start: int, stop: int) -> None:
        """Remove numbers that are all in one range."""
        at = self._find(start)
        assert at is not None
        low, high, label = self._rows[at]
        rest = [(low, start, label), (stop, high, label)]
        self._rows[at : at + 1] = [row for row in rest if row[0] < row[1]]
        del self._rows[:-MAX_RANGES]

    def add(self, number: int) -> bool:
        """Add one number that is in no range; False if that would exceed ``MAX_RANGES``."""
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
    """The sequence numbers of one publisher on one topic, from the first one taken. Guarded by the lock of the ``Accounts``.

    ``published`` = ``received`` + sum of ``missed``, always. A span inherited from an earlier session starts with zero
    counts and that session's ``first`` and ``last``, so the gap before its first message has the cause ``restart``.
    """

    first: int | None = None
    last: int | None = None
    inherited: bool = False
    last_times: Times = NO_TIMES
    """Times of the message with the number ``last``; zeros if unknown."""
    name: str = ''
    gaps: TopicGaps = field(default_factory=TopicGaps)
    """The gap journal of its topic."""
    published: int = 0
    received: int = 0
    missed: Counter[str] = field(default_factory=Counter)
    has_older_rows: bool = False
    """Whether earlier sessions have rows of this publisher."""
    last_used: int = 0
    """The topic's ``received`` when this publisher was last received."""
    _holes: Ranges = field(default_factory=Ranges)
    """Numbers below ``last`` that were not received, with the key of their gap; '' if they do not count as missed."""
    _early: Ranges = field(default_factory=Ranges)
    """Numbers received from before the first one taken."""
    _base: int | None = None
    """The first number taken."""
    _rebased: bool = False
    changed: bool = False
    """Since the last snapshot."""
    _unnumbered: int = 0
    """Messages after the inherited ``last`` that are already counted, and so are not part of the gap before the next one."""

    def __post_init__(self) -> None:
        self._base = self.first
        self.has_older_rows = self.inherited

    def observe(self, number: int, times: Times = NO_TIMES) -> bool:
        """Count a message by its sequence number; False for a repeat."""
        if self.first is None or self._base is None or self.last is None:
            self.first = self._base = self.last = number
            self.last_times = times
        elif number > self.last:
            if number > self.last + 1:
                self._add_gap(self.last + 1, number, times)
            self.last = number
            self.last_times = times
            self.inherited = self._rebased = False
            self._unnumbered = 0
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
        """Count one received message."""
        self.received += 1
        self.published += 1
        self.changed = True

    def recover_count(self, count: int) -> int:
        """Count up to ``count`` messages missed by a restart as received after all; returns how many."""
        found = min(count, self.missed['restart'])
        self.missed['restart'] -= found
        self.received += found
        self.changed = self.changed or bool(found)
        return found

    def add_unnumbered(self, count: int) -> None:
        """Count messages after the inherited ``last`` whose numbers are unknown."""
        if count:
            self.received += count
            self.published += count
            if self.inherited:
                self._unnumbered += count
            self.changed = True

    def recover(self, runs: Sequence[NumberRun], count: int) -> bool:
        """Count messages of the previous session found in a file, ``count`` of them for the first time.

        ``runs`` are all messages of the topic in the file. False, and nothing changes, unless they are this publisher's for
        certain: they start with the number after its last one, or contain its last one with the same stamp.
        """
        if self.last is None or not runs:
            return False
        more = (self.last - runs[0].start + (1 << 31)) >> 32 << 32
        runs = [run._replace(start=run.start + more, stop=run.stop + more) for run in runs]
        return self._extend(runs, count) if self.inherited else self._fill_restart_gap(runs, count)

    def _extend(self, runs: Sequence[NumberRun], count: int) -> bool:
        """``recover`` before the first message of this session."""
        last = self.last
        assert last is not None
        is_own = any(
            run.start == last + 1
            or (run.start <= last < run.stop and run.first.stamp_ns <= self.last_times.stamp_ns <= run.last.stamp_ns)
            for run in runs
        )
        fresh = [run._replace(start=max(run.start, last + 1)) for run in runs if run.stop > last + 1]
        if not is_own or sum(run.stop - run.start for run in fresh) != count:
            return False
        for run in fresh:
            if run.start > last + 1:
                self._add_gap(last + 1, run.start, run.first)
            self.last = last = run.stop - 1
            self.last_times = run.last
        self.received += count
        self.published += count
        self.changed = True
        return True

    def _fill_restart_gap(self, runs: Iterable[NumberRun], count: int) -> bool:
        """``recover`` after the gap of the restart was counted."""
        holes = [hole for run in runs for hole in self._holes.within(run.start, run.stop)
                 if isinstance(hole[2], GapKey) and hole[2].cause == 'restart']  # fmt: skip
        if sum(stop - start for start, stop, _ in holes) != count or self.missed['restart'] < count:
            return False
        self._fill(holes)
        self.received += count
        self.changed = True
        return True

    def absorb(self, other: Span) -> None:
        """Add the counts of a former publisher."""
        self.published += other.received
        self.received += other.received
        if self.missed.total() + other.missed.total() <= MAX_MISSED:
            self.published += other.missed.total()
            self.missed.update(other.missed)
        self.changed = True

    def rebase(self) -> None:
        """Do not count the gap before the next new message as missed: the topic is deliberately not subscribed."""
        self._rebased = True

    def _fill(self, holes: Iterable[tuple[int, int, GapKey | str]]) -> int:
        """Remove numbers that arrived late from the holes; returns how many of them counted as missed."""
        filled = 0
        for start, stop, key in holes:
            before = len(self._holes)
            self._holes.cut(start, stop)
            if isinstance(key, GapKey) and (count := min(stop - start, self.missed[key.cause])) > 0:
                self.missed[key.cause] -= count
                self.gaps.fill(key, count, len(self._holes) - before)
                filled += count
        return filled

    def _add_gap(self, start: int, stop: int, times: Times) -> None:
        """Count the numbers of a gap as missed, unless the topic was not subscribed, and remember them: they may arrive late."""
        cause = '' if self._rebased else 'restart' if self.inherited else 'transport'
        if self.missed.total() + stop - start > MAX_MISSED:
            cause = ''
        hole: GapKey | str = ''
        if cause:
            known = min(self._unnumbered, stop - start)
            self._unnumbered -= known
            count = stop - start - known
            self.missed[cause] += count
            self.published += count
            before = self.last_times if any(self.last_times) else self.gaps.newest
            hole = self.gaps.add(MISSED, cause, count, before, times, self.name)
        self._holes.append(start, stop, hole)
