"""What a failed put means, in one table: what caused it, and when the object, its bucket or the store is tried again.

A store or bucket that rejects everything is an Outage, with one probe at a time. An object that fails alone waits in the
RetryQueue.
"""

from __future__ import annotations

import logging
import random
import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from shadowhound_data_logger.core.errors import (
    AccessDenied,
    BucketMissing,
    CredentialsRejected,
    ForeignObject,
    ObjectRefused,
    StoreError,
    StoreUntrusted,
)
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.core.retry import backoff

_REASON: Final = re.compile(r'[A-Za-z0-9][A-Za-z0-9_-]{0,63}')


class Verdict(Enum):
    """What delivery does next with the object and with the others."""

    RETRY = 'retry'
    """The store is away, or this object does not get through: wait, then try again, forever."""
    PAUSE = 'pause'
    """No object's fault: nothing is sent until credentials and certificate are right, but for one probe at a time."""
    BUCKET = 'bucket'
    """The objects of this bucket wait, those of others are sent."""
    DENIED = 'denied'
    """This object's fault if others of its bucket are taken, else the bucket waits."""
    QUARANTINE = 'quarantine'
    """Terminal for this object."""


_TABLE: Final[tuple[tuple[type[StoreError], Verdict], ...]] = (
    (CredentialsRejected, Verdict.PAUSE),
    (StoreUntrusted, Verdict.PAUSE),
    (BucketMissing, Verdict.BUCKET),
    (AccessDenied, Verdict.DENIED),
    (ObjectRefused, Verdict.QUARANTINE),
    (ForeignObject, Verdict.QUARANTINE),
)


def decide(error: StoreError) -> Verdict:
    """The first row of the table that fits; what is not known is tried again, for quarantine needs a reason."""
    return next((verdict for kind, verdict in _TABLE if isinstance(error, kind)), Verdict.RETRY)


def quarantine_reason(error: StoreError) -> str:
    """One word for the ledger and for the name of a folder; a server's own word only where it is safe as one."""
    if isinstance(error, ForeignObject):
        return 'foreign'
    if isinstance(error, AccessDenied):
        return 'access_denied'
    reason = error.data.get('reason')
    return reason if isinstance(reason, str) and _REASON.fullmatch(reason) else 'refused'


_AT_ONCE: Final = frozenset({Verdict.PAUSE, Verdict.BUCKET})
"""No single object can cause these; the others are an outage only once a second put has failed as well."""


@dataclass(frozen=True, slots=True)
class Notice:
    """An outage that began (``lasted_s`` is None) or that is over; logged once each, outside any lock."""

    verdict: Verdict
    bucket: str | None
    error: str
    lasted_s: float | None = None

    @property
    def level(self) -> int:
        if self.lasted_s is not None:
            return logging.INFO
        return logging.WARNING if self.verdict is Verdict.RETRY else logging.ERROR

    def text(self, pending: int) -> str:
        """The line for the log; ``pending`` is what the spool holds for delivery."""
        held = f'{pending} objects wait in the spool'
        if self.lasted_s is not None:
            what = f'bucket {self.bucket} takes objects again' if self.bucket else 'delivery continues'
            return f'{what} after {self.lasted_s:.1f} s; {held}'
        if self.bucket:
            return f'bucket {self.bucket} gets nothing, others do: {self.error}; {held}'
        what = 'delivery is paused' if self.verdict is Verdict.PAUSE else 'the store is away'
        return f'{what}: {self.error}; {held}, it is tried again until it works'


@dataclass(slots=True)
class Outage:
    """A circuit breaker that is open; gone with the first success."""

    bucket: str | None
    began: float
    verdict: Verdict = Verdict.RETRY
    error: str = ''
    failures: int = 0
    """Tries that each waited for the one before; puts that were under way together are one."""
    retry_at: float = 0.0
    probe: int | None = None
    """Id of the one object that is tried during that time."""
    confirmed: bool = False
    announced: set[Verdict] = field(default_factory=set)

    def may_probe(self, now: float) -> bool:
        return self.probe is None and now >= self.retry_at

    def fail(self, item: SpooledObject, verdict: Verdict, error: StoreError, pause_s: float, now: float) -> list[Notice]:
        """Count another failed put; returns the notices to log."""
        self.confirmed = self.confirmed or self.failures > 0 or verdict in _AT_ONCE
        self.verdict, self.error = verdict, str(error)
        if not self.failures or self.probe == item.id:
            self.failures += 1
            self.retry_at = now + pause_s
            self.probe = None
        if not self.confirmed or verdict in self.announced:
            return []
        self.announced.add(verdict)
        return [Notice(verdict, self.bucket, self.error)]

    def end(self, now: float) -> list[Notice]:
        """It is over; silent where its beginning was."""
        return [Notice(self.verdict, self.bucket, self.error, now - self.began)] if self.announced else []


class Breakers:
    """The outage of the store, if there is one, and those of single buckets. Guarded by the lock of the Schedule."""

    def __init__(self, cap_s: float, rng: random.Random) -> None:
        self._cap_s = cap_s
        self._rng = rng
        self.store: Outage | None = None
        self.buckets: dict[str, Outage] = {}

    def __iter__(self) -> Iterator[Outage]:
        if self.store:
            yield self.store
        yield from self.buckets.values()

    def lets(self, bucket: str, now: float) -> bool:
        """Whether an object of the bucket may be tried now, be it as a probe."""
        return bucket not in self.buckets or self.buckets[bucket].may_probe(now)

    def without(self, now: float) -> tuple[str, ...]:
        return tuple(bucket for bucket in self.buckets if not self.lets(bucket, now))

    def probe_times(self, now: float) -> list[float]:
        """When the probes of outages became due that have not been sent."""
        return [outage.retry_at for outage in self if outage.may_probe(now)]

    def claim(self, item: SpooledObject) -> None:
        """A put of the item begins: it is the probe of whatever is out."""
        for outage in (self.store, self.buckets.get(item.bucket)):
            if outage:
                outage.probe = item.id

    def release(self, item: SpooledObject) -> None:
        """The put ended without saying anything about the store: another probe may go at once."""
        for outage in self:
            if outage.probe == item.id:
                outage.probe = None

    def fail(self, item: SpooledObject, verdict: Verdict, error: StoreError, now: float) -> list[Notice]:
        """The failure is the store's, or with BUCKET and DENIED the bucket's, which means that the store answered."""
        notices: list[Notice] = []
        if verdict in {Verdict.BUCKET, Verdict.DENIED}:
            notices += self._end_store(now)
            outage = self.buckets.setdefault(item.bucket, Outage(item.bucket, now))
        else:
            outage = self.store = self.store or Outage(None, now)
        pause_s = backoff(outage.failures + 1, self._cap_s, self._rng)
        notices += outage.fail(item, verdict, error, pause_s, now)
        return notices

    def succeed(self, item: SpooledObject, now: float) -> list[Notice]:
        """A put was confirmed: store and bucket work."""
        bucket = self.buckets.pop(item.bucket, None)
        return [*self._end_store(now), *(bucket.end(now) if bucket else ())]

    def _end_store(self, now: float) -> list[Notice]:
        over, self.store = self.store, None
        return over.end(now) if over else []


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


class RetryQueue:
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
        """Whether this denial is the last one needed to conclude that the object will never be accepted."""
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

    def buckets(self, wanted: Callable[[SpooledObject], bool]) -> set[str]:
        """Where those of the objects that wait want to go."""
        return {entry.item.bucket for entry in self._failures.values() if wanted(entry.item)}
