"""Sends spooled objects to the store: threads that do what the Schedule decides.

An object leaves the spool after the store has confirmed it, or with the reason why it never will. The log has the beginning and
the end of an outage, not each of its objects.
"""

from __future__ import annotations

import logging
import random
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Final, Protocol

from shadowhound_data_logger.core.config import Settings, UploadSettings
from shadowhound_data_logger.core.errors import StoreError
from shadowhound_data_logger.core.model import EVENTS_WHEN, UPLOAD_WHEN, Outcome, SpooledObject, State
from shadowhound_data_logger.core.status import DeliveryStatus
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.shipping.ahead import IMPORTANT, OLDEST
from shadowhound_data_logger.shipping.failures import Notice, Verdict
from shadowhound_data_logger.shipping.schedule import Look, Rest, Schedule, Ship, Step
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.writer import SpoolWriter
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.base import ObjectStore

log = logging.getLogger(__name__)

LOCK_EVERY_S: Final = 1.0
"""How often the drain lock is tried while another process holds it."""
DRAINED_EVERY_S: Final = 0.02
"""How often ``drain`` looks: a wake for each object delivered would cost more."""


class Backlog(Protocol):
    """What delivery asks of the spool."""

    def pending(self, limit: int, *, exclude: Collection[int] = (), oldest: bool = False,
                without: Sequence[str] = (), waiting_for: Collection[str] = ()) -> list[SpooledObject]: ...  # fmt: skip

    def pending_count(self) -> int: ...

    def drain_lock(self) -> AbstractContextManager[bool]: ...


@dataclass(frozen=True, slots=True)
class UploadStatus(DeliveryStatus):
    """Delivery at one instant, for the status and the progress line."""

    worker_failures: int = 0
    """Defects that the supervision of the threads caught; 0 in a healthy program."""
    sent_bytes: int = 0
    """Payload bytes sent in this session, including repeats; it grows while a body is sent, so its slope is the rate."""


class Uploader:
    """Delivers what is spooled to the store.

    Lifecycle: New; open once; wake, settled, status, drain from any thread; close any number of times.

    It owns the threads ``upload-0`` ... and ``upload-lock``, which holds the drain lock while they run. ``settle`` is
    called from its threads (``SpoolWriter.settle``); the writer calls ``settled`` when the outcomes are durable
    (``SpoolWriter.on_commit``).
    """

    def __init__(
        self, spool: Backlog, store: ObjectStore, settings: UploadSettings, settle: Callable[[Sequence[Outcome]], None], *,
        monotonic: Callable[[], float] = time.monotonic, rng: random.Random | None = None,
    ) -> None:  # fmt: skip
        self._spool = spool
        self._store = store
        self._settle = settle
        self._monotonic = monotonic
        self._rng = rng or random.Random()
        self._schedule = Schedule(settings.threads, settings.max_backoff_s, monotonic, self._rng, store.pace.bytes_in)
        reported: set[str] = set()
        self._threads = [Worker(f'upload-{n}', self._round, reported=reported) for n in range(settings.threads)]
        self._keeper = Worker('upload-lock', self._keep_lock, reported=reported)
        self._ended = threading.Event()
        self._lock = threading.Lock()  # guards the counter below
        self._quarantined: Counter[tuple[str, str]] = Counter()
        self._waits_for: Mapping[str, str] = {}

    def open(self) -> None:
        """Begin to deliver."""
        for worker in self.workers:
            worker.start()

    @property
    def workers(self) -> Sequence[Worker]:
        """Its threads, for who supervises them."""
        return self._keeper, *self._threads

    def wake(self, new: Sequence[SpooledObject] = ()) -> None:
        """The spool has new objects; those in ``new`` need not wait behind a backlog. Cheap, from any thread."""
        self._schedule.wake(new)

    def settled(self, ids: Iterable[int]) -> None:
        """Outcomes of these objects are durable in the spool."""
        self._schedule.settled(ids)

    def set_max_mbps(self, max_mbps: float) -> None:
        """Another cap (megabits of payload a second, 0 for none), at once. Raises ValueError for one below 0."""
        self._store.pace.set(max_mbps)

    def yield_to(self, max_mbps: float, seconds: float) -> None:
        """Limit the rate for some seconds; the limit then expires. Raises ValueError for 0 and below."""
        self._store.pace.yield_to(max_mbps, seconds)

    def wait_for(self, rules: Mapping[str, str]) -> None:
        """Send nothing that waits for these rules, which are false (and why); transfers in progress continue."""
        self._waits_for = rules
        self._schedule.wait_for(frozenset(rules) & {UPLOAD_WHEN, EVENTS_WHEN})

    def drain(self, deadline_s: float) -> bool:
        """Wait until nothing is pending and every outcome is durable; whether that is so.

        False after ``deadline_s`` seconds, and immediately if waiting is pointless: the store is unreachable, the credentials are
        rejected, the rest belongs to buckets that are unavailable or waits for a rule, or another process drains.
        """
        self._schedule.wake()
        end = self._monotonic() + deadline_s
        while isinstance(answer := self._schedule.drained(), Rest):
            left = end - self._monotonic()
            if left <= 0:
                return False
            self._ended.wait(min(left, answer.seconds, DRAINED_EVERY_S))
        return answer or (bool(self._waits_for) and not self._spool.pending_count())

    def close(self, deadline_s: float) -> None:
        """Begin no put any more and wait for those under way, at most ``deadline_s`` seconds; idempotent.

        What is still under way then is left to its daemon thread and not reported: it is still pending, and is sent again.
        """
        for worker in self.workers:
            worker.stop()
        self._schedule.stop()
        end = self._monotonic() + deadline_s
        hung = [worker.name for worker in self._threads if not worker.join(end - self._monotonic())]
        if hung and not self._ended.is_set():
            log.warning('%d uploads did not end within %g s; their objects will be sent again next time', len(hung), deadline_s)
        self._ended.set()
        self._store.pace.abandon()  # a body that waits for the cap would take minutes
        self._keeper.join(max(end - self._monotonic(), 0.1))

    def status(self) -> UploadStatus:
        now = self._schedule.snapshot()
        if not now.active:
            state = 'not_draining'
        elif now.outage:
            state = 'paused' if now.outage is Verdict.PAUSE else 'store_down'
        elif now.in_flight or now.ready:
            state = 'shipping'
        elif now.blocked:
            state = 'paused'
        else:
            state = 'waiting' if now.waiting_for else 'shipping' if now.deferred else 'idle'
        with self._lock:
            quarantined = self._quarantined.total()
        failures = sum(worker.failures for worker in self.workers)
        pace = self._store.pace
        return UploadStatus(state, now.last_error, now.delivered, now.in_flight, now.deferred, now.retries, quarantined,
                            now.blocked, pace.max_mbps, self._waits_for, failures, pace.sent_bytes)  # fmt: skip

    # -- the threads -----------------------------------------------------------------------------------------------

    def _round(self) -> None:
        """One step; whatever ends it, what it was about is accounted for."""
        step: Step | None = None
        try:
            step = self._schedule.step()
            if step is not None:
                self._do(step)
        except BaseException as error:
            if isinstance(step, (Ship, Look)):
                self._schedule.crashed(step, error)
            if not (self._ended.is_set() and isinstance(error, Exception)):  # the spool is closed under a thread that hung
                raise

    def _do(self, step: Step) -> None:
        if isinstance(step, Rest):
            self._schedule.rest(step)
        elif isinstance(step, Look):
            pending = partial(self._spool.pending, exclude=step.exclude, without=step.without, waiting_for=step.waiting_for)
            important = pending(IMPORTANT)
            oldest = pending(OLDEST, oldest=True) if len(important) == IMPORTANT else important
            self._schedule.found(important, sorted(oldest, key=lambda item: item.id)[:OLDEST])
        else:
            self._ship(step.item)

    def _ship(self, item: SpooledObject) -> None:
        try:
            self._store.put(item)
        except StoreError as error:
            if not self._ended.is_set():
                self._failed(item, error)
        else:
            if not self._ended.is_set():
                notices = self._schedule.delivered(item)
                self._settle((Outcome(item, State.DELIVERED),))
                self._announce(notices)

    def _failed(self, item: SpooledObject, error: StoreError) -> None:
        ruling = self._schedule.failed(item, error)
        if ruling.quarantine is not None:
            gone = not item.path.exists()
            self._settle((Outcome(item, State.QUARANTINED, 'missing' if gone else ruling.quarantine),))
            if gone:  # usually evicted since it was looked up: the index does not change it then
                log.debug('%s/%s is no longer in the spool', item.bucket, item.key)
            else:
                self._announce_quarantine(item, ruling.quarantine, error)
        self._announce(ruling.notices)

    def _keep_lock(self) -> None:
        """Drain while the lock is ours; until then, ask for it every second."""
        try:
            with self._spool.drain_lock() as mine:
                self._schedule.activate(mine)
                if mine:
                    self._ended.wait()
        except BaseException:
            self._schedule.activate(False)
            raise
        self._ended.wait(LOCK_EVERY_S)

    # -- words -----------------------------------------------------------------------------------------------------

    def _announce(self, notices: Iterable[Notice]) -> None:
        for notice in notices:
            log.log(notice.level, '%s', notice.text(self._spool.pending_count()))

    def _announce_quarantine(self, item: SpooledObject, reason: str, error: StoreError) -> None:
        """The 1st, 10th, 100th, ... of a kind: each one is listed in the spool, with its reason."""
        with self._lock:
            self._quarantined[item.bucket, reason] += 1
            count = self._quarantined[item.bucket, reason]
        if str(count).strip('0') == '1':
            log.error('quarantined (%s, number %d in bucket %s): %s', reason, count, item.bucket, error)


@contextmanager
def delivering(spool: Spool, settings: Settings, close_s: float) -> Iterator[tuple[Uploader, SpoolWriter]]:
    """Delivery for a while by a process that is not a node: store, writer and uploader, opened and closed together.

    What waits in an open spool goes to the store of the settings, unless another process has the drain lock.

    On leaving, puts under way and their outcomes have ``close_s`` seconds each. Raises SettingError.
    """
    with ExitStack() as opened:
        store = open_store(settings.store, settings.upload)
        opened.callback(store.close)
        writer = SpoolWriter(spool)
        uploader = Uploader(spool, store, settings.upload, writer.settle)
        writer.on_commit(settled=uploader.settled)
        writer.open()
        opened.callback(writer.close, close_s)
        uploader.open()
        opened.callback(uploader.close, close_s)
        yield uploader, writer
