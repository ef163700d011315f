"""A store, or one bucket of it, that takes nothing for a while: since when, why, and when the next probe may go (D8)."""

from __future__ import annotations

import logging
import random
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

from shadowhound_data_logger.errors import StoreError
from shadowhound_data_logger.model import SpooledObject
from shadowhound_data_logger.ship.retry import Verdict
from shadowhound_data_logger.stores.retry import backoff

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
            what = f'bucket {self.bucket} takes objects again' if self.bucket else 'delivery goes on'
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
    """Id of the one object that is being tried meanwhile."""
    confirmed: bool = False
    announced: set[Verdict] = field(default_factory=set)

    def may_probe(self, now: float) -> bool:
        return self.probe is None and now >= self.retry_at

    def fail(self, item: SpooledObject, verdict: Verdict, error: StoreError, pause_s: float, now: float) -> list[Notice]:
        """One more put failed; what is to be said about it, if anything."""
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

    def open_since(self, now: float) -> list[float]:
        """Since when probes may go, of each outage that waits for one."""
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
