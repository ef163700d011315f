"""The numbers of one publisher on one topic: what came, what is missing between, and why. Guarded by the Accounts' lock."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Final

MAX_REMEMBERED: Final = 4096
"""Single numbers remembered per publisher (the newest that may still come late): a bound, far above any history depth."""


@dataclass(slots=True)
class Span:
    """The numbers of one publisher on one topic, from the first one taken.

    ``published`` = ``received`` + sum of ``missed``, always. A span inherited from an earlier session starts with zero
    counts and that session's ``first`` and ``last``: the gap before its first message is then missed by ``restart``.
    """

    first: int | None = None
    last: int | None = None
    inherited: bool = False
    published: int = 0
    received: int = 0
    missed: Counter[str] = field(default_factory=Counter)
    _holes: dict[int, str] = field(default_factory=dict)
    """Number below ``last`` that was not taken -> the cause it is missed by; '' where it was not listened to."""
    _early: set[int] = field(default_factory=set)
    _base: int | None = None
    _rebased: bool = False
    changed: bool = False
    """Since the last snapshot."""
    _late: int = 0
    """Messages after the inherited ``last`` that are counted already: they are no part of the gap that follows."""

    def __post_init__(self) -> None:
        self._base = self.first

    def observe(self, number: int) -> bool:
        """Count a message by its sequence number; False if it was counted before (a repeat)."""
        if self.first is None or self._base is None or self.last is None:
            self.first = self._base = self.last = number
        elif number > self.last:
            if number > self.last + 1:
                self._skip(self.last + 1, number)
            self.last = number
            self.inherited = self._rebased = False
        elif number in self._holes:
            cause = self._holes.pop(number)
            if cause and self.missed[cause] > 0:
                self.missed[cause] -= 1
                self.published -= 1
        elif number < self._base and number not in self._early:
            # TRANSIENT_LOCAL delivers history from before the first number taken.
            if len(self._early) >= MAX_REMEMBERED:
                return False
            self._early.add(number)
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
        """
        if count:
            self.received += count
            self.published += count
            if alone and self.inherited and self.last is not None:
                self.last += count
            elif self.inherited:
                self._late += count
            self.changed = True

    def rebase(self) -> None:
        """What is published until the next new message was not listened to on purpose: that gap is not missed."""
        self._rebased = True

    def _skip(self, start: int, stop: int) -> None:
        """Count the numbers of a gap as missed, unless nobody listened, and remember them: they may come late."""
        cause = '' if self._rebased else 'restart' if self.inherited else 'transport'
        if cause:
            known = min(self._late, stop - start)
            self._late -= known
            self.missed[cause] += stop - start - known
            self.published += stop - start - known
        self._holes.update(dict.fromkeys(range(max(start, stop - MAX_REMEMBERED), stop), cause))
        while len(self._holes) > MAX_REMEMBERED:
            del self._holes[next(iter(self._holes))]
