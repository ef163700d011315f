"""The only thread that writes the spool: it groups finished objects and outcomes of deliveries into durable commits.

It commits at most once every ``commit_s``. The first commit after a quiet time waits up to half of that for the rest of its
burst, because the messages of one poll become several objects and one commit takes less time than two. Objects that are kept
until requested wait up to ``HEARTBEAT_S`` for others to be committed with. A failed commit (full or read-only disk) is retried
with everything that was in it; until it succeeds, ``put`` blocks the encoders but not the intake.

Files of delivered objects are removed between commits, by this thread and by threads that call ``settle``; before a commit if
the disk is nearly full.
"""

from __future__ import annotations

import math
import sqlite3
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Final, NamedTuple

from shadowhound_data_logger.core.keys import check_key
from shadowhound_data_logger.core.model import DataObject, FileBody, Outcome, RecordingRows, SpooledObject, State
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.spool.ballast import unwritable
from shadowhound_data_logger.spool.spool import MAX_OBJECTS, Spool

COMMIT_S: Final = 0.1
"""Minimum time between two commits."""
MAX_WAITING_BYTES: Final = 32 << 20
"""Encoded bytes in memory above which encoders wait."""
QUIET_S: Final = 0.01
"""A burst has ended when no object was added for this long and none is expected."""
HEARTBEAT_S: Final = 1.0
"""How often accounts and outcomes become durable if no object is committed."""
MANY_OUTCOMES: Final = 64
"""This many outcomes are committed without waiting for an object."""
FILES_PER_OUTCOME: Final = 2
"""Files of earlier objects that ``settle`` removes for each outcome; with one, a backlog of files would never shrink."""
MAX_BYTES: Final = 4 << 20
"""Per commit, because writing and syncing its files blocks the spool."""
HANGING_S: Final = 10.0
"""A commit that takes longer hangs in the disk: 10 ms is usual, a slow SD card needs a few seconds at worst."""


class _Unit(NamedTuple):
    """What must be committed together."""

    objects: tuple[DataObject, ...]
    rows: tuple[RecordingRows, ...]

    @property
    def may_wait(self) -> bool:
        """Whether its commit may be delayed, because it only has objects that are kept on the robot."""
        return not self.rows and all(item.is_on_request for item in self.objects)


_Group = tuple[Sequence[_Unit], Sequence[Outcome]]


class SpoolWriter:
    """Collects objects and outcomes, and commits them on one thread.

    Lifecycle: new; ``on_commit``; open once; put, settle, flush from any thread; close once. The lock of ``_changed`` guards the
    lists, except for ``_leaving``: only the writer's thread appends to it, and only the holder of ``_removing`` removes from it.
    """

    def __init__(self, spool: Spool, commit_s: float = COMMIT_S, expects: Callable[[], bool] = lambda: False) -> None:
        """``expects``, called on the writer's thread, returns whether more objects of the burst are being encoded."""
        self.spool = spool
        self._commit_s = commit_s
        self._expects = expects
        self._spooled: Callable[[Sequence[SpooledObject]], None] = lambda _: None
        self._settled: Callable[[Collection[int]], None] = lambda _: None
        lock = threading.RLock()
        self._changed = threading.Condition(lock)
        self._hurried = threading.Condition(lock)  # ends the pause before a commit, which ``put`` must not
        self._units: deque[_Unit] = deque()
        self._outcomes: deque[Outcome] = deque()
        self._leaving: deque[Outcome] = deque()
        """Durable outcomes whose files are not removed yet."""
        self._removing = threading.Lock()
        self._bytes = 0
        self._added = self._done = 0
        self._written = Counter[str]()
        self._urgent = False
        self.prompt = False
        """Whether to commit outcomes without waiting for an object, for example during shutdown."""
        self._last_commit = -HEARTBEAT_S
        self.damaged = False
        """Whether the index is damaged; only the recovery at the next startup can repair it."""
        self.worker = Worker('spool-writer', self._step, patience_s=HEARTBEAT_S + commit_s + HANGING_S)

    def on_commit(self, *, spooled: Callable[[Sequence[SpooledObject]], None] | None = None,
                  settled: Callable[[Collection[int]], None] | None = None) -> None:  # fmt: skip
        """After each commit, call ``spooled`` with the new objects and ``settled`` with the ids of the outcomes.

        The writer's thread calls them. In a node they are ``Uploader.wake``, which queues the objects for upload, and
        ``Uploader.settled``.
        """
        self._spooled = spooled or self._spooled
        self._settled = settled or self._settled

    def open(self) -> None:
        self.worker.start()

    def put(self, *items: DataObject, rows: Sequence[RecordingRows] = (), wait: bool = True) -> None:
        """Queue objects and rows of recordings for the next commit; with ``wait``, block while too many bytes are queued.

        Raises NameRefused for an invalid key.
        """
        for item in items:
            check_key(item.key)
        with self._changed:
            if wait:
                self._changed.wait_for(lambda: self._bytes < MAX_WAITING_BYTES or self.worker.stopping)
            self._units.append(_Unit(items, tuple(rows)))
            self._bytes += sum(map(_in_memory, items))
            self._added += 1
            self._changed.notify_all()

    def settle(self, outcomes: Sequence[Outcome]) -> None:
        """Queue outcomes of deliveries for the next commit; never waits for a commit.

        It also removes files of some objects settled before, because one thread alone cannot keep up while a backlog is uploaded.
        """
        with self._changed:
            was_due = self._due()
            self._outcomes.extend(outcomes)
            self._added += len(outcomes)
            if self._due() and not was_due:  # otherwise the thread is awake already
                self._changed.notify_all()
        self._remove_files(FILES_PER_OUTCOME * len(outcomes), wait=False)

    def set_damaged(self) -> None:
        """The index is damaged: end every wait for a commit."""
        with self._changed:
            self.damaged = True
            self._changed.notify_all()

    def written(self) -> tuple[int, int]:
        """How many objects, and messages in them, became durable since the writer was opened."""
        with self._changed:
            return self._written['objects'], self._written['messages']

    def flush(self, deadline_s: float) -> bool:
        """Whether everything put and settled before this call became durable in time; False immediately if it cannot."""
        with self._changed:
            target = self._added
            self._urgent = True
            self._changed.notify_all()
            self._hurried.notify_all()
            self._changed.wait_for(lambda: self._done >= target or self.damaged, deadline_s)
            return self._done >= target

    def close(self, deadline_s: float) -> bool:
        """Commit what is queued and end the thread; False if that takes longer than the deadline. Idempotent."""
        end = time.monotonic() + deadline_s
        flushed = self.flush(deadline_s)
        self.worker.stop()
        with self._changed:
            self._changed.notify_all()
            self._hurried.notify_all()
        ended = self.worker.join(end - time.monotonic() + HEARTBEAT_S)
        if ended:
            self._remove_files(until=lambda: time.monotonic() >= end)
        return ended and flushed

    def _step(self) -> None:
        heartbeat_s = time.monotonic() + HEARTBEAT_S
        self._remove_files(until=lambda: time.monotonic() >= heartbeat_s or self._may_commit(), wait=False)
        with self._changed:
            if self._changed.wait_for(lambda: self._due() or self.worker.stopping, heartbeat_s - time.monotonic()):
                self._await_burst()
            self._pause(self._last_commit + self._commit_s - time.monotonic())
            units, outcomes = list(self._units), list(self._outcomes)
        self._last_commit = time.monotonic()
        try:
            groups = self._groups(units, outcomes)
            for group in groups:
                if len(groups) > 1:
                    self.spool.accounts.unsettle()
                self._commit(*group)
        except (OSError, sqlite3.OperationalError) as error:
            raise unwritable(self.spool.root, error) from error
        except sqlite3.DatabaseError:
            self.set_damaged()
            raise

    def _remove_files(self, limit: float = math.inf, until: Callable[[], bool] = lambda: False, *, wait: bool = True) -> None:
        """Remove files of settled objects; without ``wait``, do nothing while another thread does."""
        if self._removing.acquire(blocking=wait):
            try:
                while limit > 0 and self._leaving and not until():
                    self.spool.remove_files((self._leaving[0],))
                    self._leaving.popleft()
                    limit -= 1
            finally:
                self._removing.release()

    def _may_commit(self) -> bool:
        """Whether a commit is due and its pause is over."""
        with self._changed:
            is_now = time.monotonic() >= self._last_commit + self._commit_s
            return self._urgent or self.worker.stopping or (is_now and self._due())

    def _await_burst(self) -> None:
        """Wait for the last object of the burst, up to half of ``commit_s``; the caller holds the lock."""
        end_s = time.monotonic() + self._commit_s / 2
        while (left_s := end_s - time.monotonic()) > 0:
            added = self._added
            if self._pause(min(QUIET_S, left_s)) or (self._added == added and not self._expects()):
                return

    def _pause(self, seconds: float) -> bool:
        """Wait; True if the commit became urgent before. The caller holds the lock."""
        return self._hurried.wait_for(lambda: self._urgent or self.worker.stopping, max(0.0, seconds))

    def _groups(self, units: Sequence[_Unit], outcomes: Sequence[Outcome]) -> list[_Group]:
        """The groups to commit one by one: as few as possible if the disk has room.

        Otherwise first the outcomes, because their commit frees files; then objects whose files exist and may be evicted; last
        those that must be written.
        """
        objects = [item for unit in units for item in unit.objects]
        if not objects or self.spool.room.fits(objects):
            first, *more = list(_split(units)) or [[]]
            return [(first, outcomes), *((part, []) for part in more)]
        files = [unit for unit in units if all(isinstance(item.body, FileBody) for item in unit.objects)]
        rest = [unit for unit in units if not all(isinstance(item.body, FileBody) for item in unit.objects)]
        groups: list[_Group] = [([], outcomes), (files, []), (rest, [])]
        return [group for group in groups if any(group)]

    def _commit(self, units: Sequence[_Unit], outcomes: Sequence[Outcome]) -> None:
        objects, rows = [item for unit in units for item in unit.objects], [each for unit in units for each in unit.rows]
        if self._leaving and self.spool.room.is_short(objects):
            self._remove_files()
        spooled = self.spool.commit(objects, outcomes, rows, leave_files=True)
        self._leaving.extend(outcome for outcome in outcomes if outcome.state is not State.QUARANTINED)
        self._committed(units, outcomes, spooled)

    def _due(self) -> bool:
        """Whether something needs a commit now; the caller holds the lock."""
        if self._urgent or len(self._outcomes) >= (1 if self.prompt else MANY_OUTCOMES):
            return True
        return self._bytes >= MAX_BYTES or not all(unit.may_wait for unit in self._units)

    def _committed(self, units: Sequence[_Unit], outcomes: Sequence[Outcome], spooled: Sequence[SpooledObject]) -> None:
        """Remove what is durable from the queues, and call the listeners."""
        objects = [item for unit in units for item in unit.objects]
        with self._changed:
            done = {id(unit) for unit in units}
            self._units = deque(unit for unit in self._units if id(unit) not in done)
            self._bytes -= sum(map(_in_memory, objects))
            for _ in outcomes:
                self._outcomes.popleft()
            self._done += len(units) + len(outcomes)
            self._written.update(objects=len(objects), messages=sum(item.samples for item in objects))
            self._urgent = self._urgent and bool(self._units or self._outcomes)
            self._changed.notify_all()
        if outcomes:
            self._settled({outcome.item.id for outcome in outcomes})
        if spooled:
            self._spooled(spooled)


def _split(units: Sequence[_Unit]) -> Iterator[list[_Unit]]:
    """The units in order, split into groups that fit into one commit."""
    part: list[_Unit] = []
    count = size = 0
    for unit in units:
        more = sum(map(_in_memory, unit.objects))
        if part and (count + len(unit.objects) > MAX_OBJECTS or size + more > MAX_BYTES):
            yield part
            part, count, size = [], 0, 0
        part.append(unit)
        count += len(unit.objects)
        size += more
    if part:
        yield part


def _in_memory(item: DataObject) -> int:
    return len(item.body) if isinstance(item.body, bytes) else 0
