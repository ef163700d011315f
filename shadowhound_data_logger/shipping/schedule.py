"""Decides which object is sent next, and what a failure means for the others: every decision of delivery, and no I/O.

A thread asks ``step`` what to do, does it outside the lock, and reports back with ``found``, ``delivered``, ``failed`` or
``crashed``. A failure is held against the store, or the bucket, unless a later delivery shows that it is the
object's: then the object alone waits (or is quarantined if it is denied repeatedly while its bucket accepts others).
"""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from shadowhound_data_logger.core.errors import StoreError
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.shipping.ahead import LOOK_EVERY_S, Ahead
from shadowhound_data_logger.shipping.failures import Breakers, Notice, RetryQueue, Verdict, decide, quarantine_reason

MANY_DEFERRED: Final = 64
"""From here on most probes are objects that failed before: a long outage does not touch ever more objects."""
FRESH_PROBE_EVERY: Final = 16
ENOUGH_S: Final = 0.5
"""Bodies under way for so long at the cap: another one would only make them slower, for round trips are shorter."""
SHORTEST_REST_S: Final = 0.01
LARGE_BYTES: Final = 4 << 20
"""From here on an object keeps a thread for seconds or, over a slow link, minutes."""


@dataclass(frozen=True, slots=True)
class Ship:
    """Put this object, then call ``delivered``, ``failed`` or ``crashed``."""

    item: SpooledObject


@dataclass(frozen=True, slots=True)
class Look:
    """Ask the spool for what is pending, then call ``found`` or ``crashed``."""

    exclude: frozenset[int]
    without: tuple[str, ...]
    waiting_for: frozenset[str] = frozenset()
    """Rules that do not hold (``model.waits_for``)."""


@dataclass(frozen=True, slots=True)
class Rest:
    """There is nothing to do for so long, or until something changes: call ``rest`` with it."""

    seconds: float
    version: int


Step = Ship | Look | Rest


@dataclass(frozen=True, slots=True)
class Ruling:
    """What follows from a failure: the reason to quarantine the object, if any, and what must be logged."""

    quarantine: str | None = None
    notices: Sequence[Notice] = ()


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The schedule at one instant."""

    active: bool | None
    """Whether this process drains; None while it is not known yet."""
    outage: Verdict | None
    blocked: Mapping[str, str]
    """Bucket -> why its objects wait."""
    in_flight: int
    ready: int
    deferred: int
    delivered: int
    retries: int
    last_error: str
    waiting_for: frozenset[str]
    """Rules that do not hold."""


class Schedule:
    """Decides which object is sent next, and what a failure means for the others.

    Thread-safe; ``_changed`` is the one lock over all of it. Times are seconds of the clock that is handed in.
    """

    def __init__(self, threads: int, max_backoff_s: float, monotonic: Callable[[], float], rng: random.Random,
                 bytes_in: Callable[[float], float] = lambda _: float('inf')) -> None:  # fmt: skip
        self._threads = threads
        self._now = monotonic
        self._bytes_in = bytes_in
        self._changed = threading.Condition()
        self._version = 0
        self._active: bool | None = None
        self._stopped = False
        self._waiting_for: frozenset[str] = frozenset()
        self._ahead = Ahead()
        self._breakers = Breakers(max_backoff_s, rng)
        self._history = RetryQueue(max_backoff_s, rng)
        self._in_flight: dict[int, tuple[SpooledObject, int]] = {}  # by id; deliveries when it was claimed
        self._unsettled: set[int] = set()
        self._retries = 0
        self._last_error = ''

    # -- what to do ------------------------------------------------------------------------------------------------

    def step(self) -> Step | None:
        """What the calling thread does next; None when it is to end."""
        with self._changed:
            now = self._now()
            if self._stopped:
                return None
            store = self._breakers.store
            if not self._active or (store and not store.may_probe(now)):
                return self._rest(now)
            if self._ahead.wants_look(now, self._breakers.probe_times(now)):
                self._ahead.begin_look(now)
                return Look(self._taken(), self._breakers.without(now), self._waiting_for)
            item = self._claim(now)
            return Ship(item) if item else self._rest(now)

    def rest(self, rest: Rest) -> None:
        """Block until something changed since that ``step``, at most ``rest.seconds``."""
        with self._changed:
            if self._version == rest.version:
                self._changed.wait(rest.seconds)

    # -- what became of it -----------------------------------------------------------------------------------------

    def found(self, important: Sequence[SpooledObject], oldest: Sequence[SpooledObject]) -> None:
        """The answer to a Look, each in its order."""
        with self._changed:
            now = self._now()
            closed = self._breakers.without(now)
            self._ahead.end_look(important, oldest, taken=self._taken(), without=closed)
            self._ahead.drop(self._waits)
            self._notify(len(self._ahead))

    def delivered(self, item: SpooledObject) -> Sequence[Notice]:
        """The store confirmed it: it counts as pending until ``settled``."""
        with self._changed:
            if any(True for _ in self._breakers):
                self._ahead.outdate()
            self._history.deliver(item)
            held_back = any(True for _ in self._breakers) or self._bytes_in(ENOUGH_S) < float('inf')
            notices = self._breakers.succeed(item, self._now())
            self._let_go(item)
            self._unsettled.add(item.id)
            self._notify(self._threads if held_back else 0)
            return notices

    def failed(self, item: SpooledObject, error: StoreError) -> Ruling:
        """The store did not take it. With a reason to quarantine, it counts as pending until ``settled``."""
        with self._changed:
            now, verdict = self._now(), decide(error)
            self._last_error = str(error)
            if verdict is Verdict.QUARANTINE or (verdict is Verdict.DENIED and self._history.is_to_blame(item)):
                self._history.forget(item)
                self._let_go(item)
                self._unsettled.add(item.id)
                self._notify()
                return Ruling(quarantine_reason(error))
            alone = verdict is Verdict.DENIED and self._history.is_denied_alone(item)
            alone |= verdict is Verdict.RETRY and self._history.fails_alone(item, self._in_flight[item.id][1])
            if verdict in {Verdict.RETRY, Verdict.DENIED}:
                self._history.defer(item, verdict, now)
            notices = [] if alone else self._breakers.fail(item, verdict, error, now)
            self._retries += 1
            self._ahead.outdate()
            self._let_go(item)
            self._notify()
            return Ruling(notices=notices)

    def crashed(self, step: Ship | Look, error: BaseException) -> None:
        """This program failed, not the store: that object alone waits, or the spool is asked again."""
        with self._changed:
            self._last_error = f'{type(error).__name__}: {error}'
            if isinstance(step, Look):
                self._ahead.fail_look()
            else:
                self._history.defer(step.item, None, self._now())
                self._retries += 1
                self._unsettled.discard(step.item.id)
                self._let_go(step.item)
            self._notify()

    def settled(self, ids: Iterable[int]) -> None:
        """Their outcomes are durable: the spool does not call them pending any more."""
        with self._changed:
            durable = frozenset(ids)
            self._unsettled -= durable
            self._ahead.settled(durable)

    # -- from outside ----------------------------------------------------------------------------------------------

    def wake(self, new: Sequence[SpooledObject] = ()) -> None:
        """The spool has new objects (``new``, where they are known), or has given some up."""
        with self._changed:
            if new:
                taken = self._taken()
                self._ahead.add([item for item in new if item.id not in taken and not self._waits(item)])
            else:
                self._ahead.outdate()
            self._notify(max(len(new), 1))

    def activate(self, active: bool) -> None:
        """Whether this process drains; while it does not, every step is a Rest."""
        with self._changed:
            if active is not self._active:
                self._active = active
                self._ahead.outdate()
                self._notify()

    def wait_for(self, rules: frozenset[str]) -> None:
        """Send nothing that waits for these rules, which are false; transfers in progress continue."""
        with self._changed:
            if rules != self._waiting_for:
                self._waiting_for = rules
                self._ahead.drop(self._waits)
                self._ahead.outdate()
                self._notify()

    def stop(self) -> None:
        """No step any more; what is in flight may still be reported."""
        with self._changed:
            self._stopped = True
            self._notify()

    def drained(self) -> bool | Rest:
        """True: nothing is pending. False: waiting is no use. Else how long to rest before asking again."""
        with self._changed:
            now, store, blocked = self._now(), self._breakers.store, self._breakers.buckets
            if self._stopped or self._active is False or (store and store.confirmed):
                return False
            busy = self._in_flight or self._unsettled or len(self._ahead) or not self._ahead.is_known
            waiting = any(bucket not in blocked for bucket in self._history.buckets(lambda item: not self._waits(item)))
            unsure = store or any(not outage.confirmed for outage in blocked.values())
            return self._rest(now) if busy or waiting or unsure else not (blocked or self._waiting_for)

    def snapshot(self) -> Snapshot:
        with self._changed:
            store = self._breakers.store
            return Snapshot(
                active=self._active, outage=store.verdict if store else None,
                blocked={bucket: outage.error for bucket, outage in self._breakers.buckets.items()},
                in_flight=len(self._in_flight), ready=len(self._ahead), deferred=len(self._history),
                delivered=self._history.delivered, retries=self._retries, last_error=self._last_error,
                waiting_for=self._waiting_for,
            )  # fmt: skip

    # -- under the lock --------------------------------------------------------------------------------------------

    def _notify(self, threads: int | None = None) -> None:
        """Let so many resting threads look again, all by default. A wake for nothing costs as much as one for an object."""
        self._version += 1
        self._changed.notify(self._threads if threads is None else threads)

    def _waits(self, item: SpooledObject) -> bool:
        """Whether the rule that it waits for does not hold."""
        return item.waits_for in self._waiting_for

    def _taken(self) -> frozenset[int]:
        """What the spool calls pending and we have in hand."""
        return frozenset((*self._in_flight, *self._unsettled, *self._history))

    def _let_go(self, item: SpooledObject) -> None:
        self._in_flight.pop(item.id, None)
        self._breakers.release(item)

    def _claim(self, now: float) -> SpooledObject | None:
        """An object whose own wait is over goes first; a probe is rather one that has not failed yet."""
        ours = [each for each, _ in self._in_flight.values()]

        def has_room(item: SpooledObject) -> bool:
            """Large objects have half of the threads, so that none of what is live waits for one of them to end.

            Where a cap has enough to do, one thread is kept for what is more important than all that is under way.
            """
            if item.size >= LARGE_BYTES and sum(each.size >= LARGE_BYTES for each in ours) >= max(self._threads // 2, 1):
                return False
            if not ours or len(ours) + 1 < self._threads or sum(each.size for each in ours) <= self._bytes_in(ENOUGH_S):
                return True
            return item.priority < min(each.priority for each in ours)

        def fresh() -> SpooledObject | None:
            return self._ahead.take(lambda item: self._breakers.lets(item.bucket, now) and has_room(item))

        def may_retry(item: SpooledObject) -> bool:
            """Where a bucket is out, an object that failed there is its probe only if the spool has no other of that bucket."""
            if item.id in self._in_flight or self._waits(item) or not self._breakers.lets(item.bucket, now):
                return False
            outage = self._breakers.buckets.get(item.bucket)
            is_probe = outage and self._ahead.has_looked_since(outage.retry_at) and not self._ahead.holds(item.bucket)
            return has_room(item) and (not outage or bool(is_probe))

        store = self._breakers.store
        if store and (len(self._history) < MANY_DEFERRED or store.failures % FRESH_PROBE_EVERY == 0):
            item = fresh() or self._history.soonest(may_retry)
        else:
            item = self._history.due(now, may_retry) or fresh()
        if item is not None:
            self._in_flight[item.id] = item, self._history.delivered
            self._breakers.claim(item)
            if item.bucket in self._breakers.buckets:  # one probe at a time; the others would only hide what can go
                bucket = item.bucket
                self._ahead.drop(lambda other: other.bucket == bucket)
        return item

    def _rest(self, now: float) -> Rest:
        until = [now + LOOK_EVERY_S, self._history.next_due(now)]
        until += [outage.retry_at for outage in self._breakers if outage.retry_at > now]
        return Rest(max(min(until) - now, SHORTEST_REST_S), self._version)
