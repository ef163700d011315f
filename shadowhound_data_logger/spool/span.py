"""The numbers of one publisher on one topic: which came, which are missing between, and why. Guarded by the Accounts' lock."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from dataclasses import dataclass, field
from typing import Final

from shadowhound_data_logger.spool.gaps import MISSED, GapKey, TopicGaps

MAX_RANGES: Final = 512
"""Ranges of numbers that are remembered per publisher (the newest, which may still come late): every second message lost of
2,000 a second, between two drains. A publisher chooses its numbers, so they are never remembered one by one."""

MAX_MISSED: Final = 1 << 40
"""More than anybody publishes. Numbers that leap further lie, and that is believed to be no loss: sums stay within SQLite."""


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

    def take(self, number: int) -> GapKey | str | None:
        """Take the number out; the word of its range, None where it is in none."""
        at = self._find(number)
        if at is None:
            return None
        start, stop, word = self._rows[at]
        rest = [(start, number, word), (number + 1, stop, word)]
        self._rows[at : at + 1] = [row for row in rest if row[0] < row[1]]
        del self._rows[:-MAX_RANGES]
        return word

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
    heard_ns: int = 0
    """Stamp of ``last``; 0 where it is not known."""
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
    """Messages after the inherited ``last`` that are counted already: they are not part of the gap that follows."""

    def __post_init__(self) -> None:
        self._base = self.first
        self.older = self.inherited

    def observe(self, number: int, stamp_ns: int = 0) -> bool:
        """Count a message by its sequence number; False if it was counted before (a repeat)."""
        if self.first is None or self._base is None or self.last is None:
            self.first = self._base = self.last = number
            self.heard_ns = stamp_ns
        elif number > self.last:
            if number > self.last + 1:
                self._skip(self.last + 1, number, stamp_ns)
            self.last = number
            self.heard_ns = stamp_ns
            self.inherited = self._rebased = False
        elif (hole := self._take_hole(number)) is not None:
            key, more = hole
            if isinstance(key, GapKey) and self.missed[key.cause] > 0:
                self.missed[key.cause] -= 1
                self.published -= 1
                self.gaps.fill(key, more)
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

    def late(self, count: int, *, alone: bool = False) -> None:
        """Count messages after the inherited ``last``, whose numbers are not known.

        Of a publisher that is ``alone`` they are the next ones; a death before its next message then does not count them again.
        That is a guess: where one of these numbers comes after all, it is a message as any other.
        """
        if count:
            self.received += count
            self.published += count
            if alone and self.inherited and self.last is not None:
                self._holes.append(self.last + 1, self.last + 1 + count, '')
                self.last += count
            elif self.inherited:
                self._late += count
            self.changed = True

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

    def _take_hole(self, number: int) -> tuple[GapKey | str, int] | None:
        """The hole that the number was in, and how many holes more there are now; None where it was in none."""
        before = len(self._holes)
        hole = self._holes.take(number)
        return None if hole is None else (hole, len(self._holes) - before)

    def _skip(self, start: int, stop: int, stamp_ns: int) -> None:
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
            hole = self.gaps.add(MISSED, cause, count, self.heard_ns or self.gaps.heard_ns, stamp_ns, self.name)
        self._holes.append(start, stop, hole)
