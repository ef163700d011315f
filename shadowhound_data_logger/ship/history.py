"""What was delivered and what failed: whose fault a failure is, and when an object that failed is tried again (D8)."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

from shadowhound_data_logger.model import SpooledObject
from shadowhound_data_logger.ship.retry import Verdict
from shadowhound_data_logger.stores.retry import backoff

DENIALS: Final = 8
"""An object denied so often, its bucket having taken others between each two of these times, is to blame itself.

By then it was tried for half a minute. Rights that come and go deny any object, but not the same one eight times: it goes
as soon as it is tried at a better moment.
"""


@dataclass(frozen=True, slots=True)
class _Failure:
    """One object's last failure."""

    item: SpooledObject
    failures: int
    not_before: float
    denials: int
    """How often it was denied; all the times between two deliveries to its bucket are one."""
    delivered: int
    """What the store had taken when it failed."""
    delivered_to_bucket: int


class History:
    """Deliveries, and the objects that wait for their own next try. Guarded by the lock of the Schedule it belongs to.

    An object stays in it while it is tried again, until it is forgotten.
    """

    def __init__(self, cap_s: float, rng: random.Random) -> None:
        self._cap_s = cap_s
        self._rng = rng
        self._failures: dict[int, _Failure] = {}
        self._delivered: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._failures)

    def __iter__(self) -> Iterator[int]:
        return iter(self._failures)

    @property
    def delivered(self) -> int:
        return self._delivered.total()

    def deliver(self, item: SpooledObject) -> None:
        self._delivered[item.bucket] += 1
        self.forget(item)

    def forget(self, item: SpooledObject) -> None:
        self._failures.pop(item.id, None)

    def defer(self, item: SpooledObject, verdict: Verdict | None, now: float) -> None:
        """It failed (``verdict`` None: by a defect of this program) and waits, each time longer."""
        before = self._failures.get(item.id)
        failures = before.failures + 1 if before else 1
        not_before = now + backoff(failures, self._cap_s, self._rng)
        denials = before.denials if before else 0
        if verdict is Verdict.DENIED and (not denials or self.is_denied_alone(item)):
            denials += 1
        counts = self.delivered, self._delivered[item.bucket]
        self._failures[item.id] = _Failure(item, failures, not_before, denials, *counts)

    def fails_alone(self, item: SpooledObject, delivered: int) -> bool:
        """Whether anything was delivered since it was claimed (``delivered`` then), or since it failed last."""
        before = self._failures.get(item.id)
        return self.delivered > (min(before.delivered, delivered) if before else delivered)

    def is_denied_alone(self, item: SpooledObject) -> bool:
        """Whether its bucket took something since it was denied the last time.

        The first denial is not: the rights may have been taken away while a put that began earlier still succeeded.
        """
        before = self._failures.get(item.id)
        return before is not None and before.denials > 0 and self._delivered[item.bucket] > before.delivered_to_bucket

    def is_to_blame(self, item: SpooledObject) -> bool:
        """Whether the denial just now is the last one that is needed to tell that the object will never be taken."""
        return self.is_denied_alone(item) and self._failures[item.id].denials + 1 >= DENIALS

    def due(self, now: float, allowed: Callable[[SpooledObject], bool]) -> SpooledObject | None:
        """One whose wait is over and that is allowed now."""
        entries = self._failures.values()
        return next((entry.item for entry in entries if entry.not_before <= now and allowed(entry.item)), None)

    def soonest(self, allowed: Callable[[SpooledObject], bool]) -> SpooledObject | None:
        """The one whose wait is over first, whether it is over or not."""
        entries = (entry for entry in self._failures.values() if allowed(entry.item))
        found = min(entries, key=lambda entry: entry.not_before, default=None)
        return found.item if found else None

    def next_due(self, now: float) -> float:
        """When the next wait is over; infinite without one."""
        return min((entry.not_before for entry in self._failures.values() if entry.not_before > now), default=float('inf'))

    def buckets(self) -> set[str]:
        """Where the objects that wait want to go."""
        return {entry.item.bucket for entry in self._failures.values()}
