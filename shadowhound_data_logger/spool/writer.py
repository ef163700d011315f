"""The one thread that writes the spool: it groups finished objects and outcomes of deliveries into durable commits.

At most one commit every ``commit_s``; the first after a quiet time waits for the rest of its burst, half of that at most, because
what one poll took comes as several objects, and one commit costs less than two. Objects that stay here until somebody asks for
them wait up to ``HEARTBEAT_S`` for others to be committed with. A commit that fails (a full or read-only disk) is tried again
with everything that was in it; meanwhile ``put`` blocks the encoders, not the intake.

Files of delivered objects are removed between commits, by this thread and by those that settle, or before one where the disk is
short.
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
from shadowhound_data_logger.spool.spool import MOST_OBJECTS, Spool

COMMIT_S: Final = 0.1
"""Least time between two commits."""
MAX_WAITING_BYTES: Final = 32 << 20
"""Encoded bytes in memory before encoders have to wait."""
QUIET_S: Final = 0.01
"""A burst is over when nothing came for so long and nothing is expected."""
HEARTBEAT_S: Final = 1.0
"""How often accounts and outcomes become durable when there is no object to commit them with."""
MANY_OUTCOMES: Final = 64
"""So many outcomes are worth a commit of their own."""
FILES_A_SETTLEMENT: Final = 2
"""Files of earlier objects that ``settle`` removes for each outcome: more than one, or they would become no fewer."""
MOST_BYTES: Final = 4 << 20
"""In one commit: nothing else is done in the spool while its files are written and synced."""
HANGING_S: Final = 10.0
"""A commit that takes longer hangs in the disk: usual is a hundredth of a second, a slow card at its worst takes a few."""


class _Unit(NamedTuple):
    """What one commit takes, all of it."""

    objects: tuple[DataObject, ...]
    rows: tuple[RecordingRows, ...]

    @property
    def may_wait(self) -> bool:
        """Whether nobody waits for any of it."""
        return not self.rows and all(item.is_on_request for item in self.objects)


_Group = tuple[Sequence[_Unit], Sequence[Outcome]]


class SpoolWriter:
    """Collects objects and outcomes, and commits them on one thread.

    New; ``on_commit``; open once; put, settle, flush from any thread; close once. The lock of ``_changed`` guards the lists,
    but for ``_leaving``, to which the thread alone adds, and from which takes who holds ``_removing``.
    """

    def __init__(self, spool: Spool, commit_s: float = COMMIT_S, expects: Callable[[], bool] = lambda: False) -> None:
        """``expects``, called by the writer's thread, says whether more objects are being made that are worth waiting for."""
        self.spool = spool
        self._commit_s = commit_s
        self._expects = expects
        self._spooled: Callable[[Sequence[SpooledObject]], None] = lambda _: None
        self._settled: Callable[[Collection[int]], None] = lambda _: None
        lock = threading.RLock()
        self._changed = threading.Condition(lock)
        self._hurried = threading.Condition(lock)  # ends the pause before a commit; what is put meanwhile wakes nobody
        self._units: deque[_Unit] = deque()
        self._outcomes: deque[Outcome] = deque()
        self._leaving: deque[Outcome] = deque()
        """Outcomes that are durable and whose files are still here."""
        self._removing = threading.Lock()
        self._bytes = 0
        self._added = self._done = 0
        self._written = Counter[str]()
        self._urgent = False
        self.prompt = False
        """Whether outcomes wait for no object to be committed with: somebody waits for them, at a stop say."""
        self._last_commit = -HEARTBEAT_S
        self.damaged = False
        """Whether the index was found damaged: only the recovery at the next start can repair it."""
        self.worker = Worker('spool-writer', self._step, patience_s=HEARTBEAT_S + commit_s + HANGING_S)

    def on_commit(self, *, spooled: Callable[[Sequence[SpooledObject]], None] | None = None,
                  settled: Callable[[Collection[int]], None] | None = None) -> None:  # fmt: skip
        """After each commit, its thread calls ``spooled`` with the new objects, and ``settled`` with the ids of the outcomes.

        In a node these are ``Uploader.wake``, which adds the objects to what is to be sent, and ``Uploader.settled``.
        """
        self._spooled = spooled or self._spooled
        self._settled = settled or self._settled

    def open(self) -> None:
        self.worker.start()

    def put(self, *items: DataObject, rows: Sequence[RecordingRows] = (), wait: bool = True) -> None:
        """Queue objects for the next commit, and what it writes of recordings; waits while too many bytes wait.

        Raises NameRefused for a bad key.
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
        """Queue outcomes of deliveries for the next commit; never waits for one.

        It also removes files of some objects settled before: while a backlog leaves, one thread does not keep up with that.
        """
        with self._changed:
            was_due = self._due()
            self._outcomes.extend(outcomes)
            self._added += len(outcomes)
            if self._due() and not was_due:  # else it is awake, and one wake an outcome would only cost
                self._changed.notify_all()
        self._remove_files(FILES_A_SETTLEMENT * len(outcomes), wait=False)

    def written(self) -> tuple[int, int]:
        """Objects that became durable since it was opened, and the messages in them."""
        with self._changed:
            return self._written['objects'], self._written['messages']

    def flush(self, deadline_s: float) -> bool:
        """Whether everything put and settled before this call became durable in time; False at once where nothing can."""
        with self._changed:
            target = self._added
            self._urgent = True
            self._changed.notify_all()
            self._hurried.notify_all()
            self._changed.wait_for(lambda: self._done >= target or self.damaged, deadline_s)
            return self._done >= target

    def close(self, deadline_s: float) -> bool:
        """Commit what is queued and end the thread; False when that did not work in time. Idempotent."""
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
            raise self.spool.unwritable(error) from error
        except sqlite3.DatabaseError:
            with self._changed:
                self.damaged = True
                self._changed.notify_all()
            raise

    def _remove_files(self, most: float = math.inf, until: Callable[[], bool] = lambda: False, *, wait: bool = True) -> None:
        """Let files of what is settled follow their rows; unless ``wait``, not while another thread does."""
        if self._removing.acquire(blocking=wait):
            try:
                while most > 0 and self._leaving and not until():
                    self.spool.remove_files((self._leaving[0],))
                    self._leaving.popleft()
                    most -= 1
            finally:
                self._removing.release()

    def _may_commit(self) -> bool:
        """Whether a commit is due and its pause is over."""
        with self._changed:
            is_now = time.monotonic() >= self._last_commit + self._commit_s
            return self._urgent or self.worker.stopping or (is_now and self._due())

    def _await_burst(self) -> None:
        """Wait until its last object has come, half of ``commit_s`` at most; the caller holds the lock."""
        end_s = time.monotonic() + self._commit_s / 2
        while (left_s := end_s - time.monotonic()) > 0:
            added = self._added
            if self._pause(min(QUIET_S, left_s)) or (self._added == added and not self._expects()):
                return

    def _pause(self, seconds: float) -> bool:
        """Wait. True if it ended early, because somebody waits for the commit; the caller holds the lock."""
        return self._hurried.wait_for(lambda: self._urgent or self.worker.stopping, max(0.0, seconds))

    def _groups(self, units: Sequence[_Unit], outcomes: Sequence[Outcome]) -> list[_Group]:
        """One commit of all, or several of a burst; also where the disk has no room, since files leave only after a commit.

        Then first what was delivered, then the files, which lie there already and of which some may be given up, last what is
        written.
        """
        objects = [item for unit in units for item in unit.objects]
        if not objects or self.spool.fits(objects):
            first, *more = list(_parted(units)) or [[]]
            return [(first, outcomes), *((part, []) for part in more)]
        files = [unit for unit in units if all(isinstance(item.body, FileBody) for item in unit.objects)]
        rest = [unit for unit in units if not all(isinstance(item.body, FileBody) for item in unit.objects)]
        groups: list[_Group] = [([], outcomes), (files, []), (rest, [])]
        return [group for group in groups if any(group)]

    def _commit(self, units: Sequence[_Unit], outcomes: Sequence[Outcome]) -> None:
        objects, rows = [item for unit in units for item in unit.objects], [each for unit in units for each in unit.rows]
        if self._leaving and self.spool.is_short(objects):
            self._remove_files()
        spooled = self.spool.commit(objects, outcomes, rows, leave_files=True)
        self._leaving.extend(outcome for outcome in outcomes if outcome.state is not State.QUARANTINED)
        self._committed(units, outcomes, spooled)

    def _due(self) -> bool:
        """Whether there is something that waits for a commit; the caller holds the lock."""
        if self._urgent or len(self._outcomes) >= (1 if self.prompt else MANY_OUTCOMES):
            return True
        return self._bytes >= MOST_BYTES or not all(unit.may_wait for unit in self._units)

    def _committed(self, units: Sequence[_Unit], outcomes: Sequence[Outcome], spooled: Sequence[SpooledObject]) -> None:
        """All of it is durable: let it go and tell who waits for that."""
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


def _parted(units: Sequence[_Unit]) -> Iterator[list[_Unit]]:
    """The same in their order, as many at a time as one commit takes."""
    part: list[_Unit] = []
    count = size = 0
    for unit in units:
        more = sum(map(_in_memory, unit.objects))
        if part and (count + len(unit.objects) > MOST_OBJECTS or size + more > MOST_BYTES):
            yield part
            part, count, size = [], 0, 0
        part.append(unit)
        count += len(unit.objects)
        size += more
    if part:
        yield part


def _in_memory(item: DataObject) -> int:
    return len(item.body) if isinstance(item.body, bytes) else 0
