"""The one thread that writes the spool: it groups finished objects and outcomes of deliveries into durable commits.

At most one commit every ``commit_s``; the first after a quiet time happens at once. A commit that fails (a full or
read-only disk) is tried again with everything that was in it; meanwhile ``put`` blocks the encoders, not the intake.
"""

from __future__ import annotations

import sqlite3
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Final

from shadowhound_data_logger.keys import check_key
from shadowhound_data_logger.model import DataObject, FileBody, Outcome, SpooledObject
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.worker import Worker

COMMIT_S: Final = 0.1
"""Least time between two commits."""
MAX_WAITING_BYTES: Final = 32 << 20
"""Encoded bytes in memory before encoders have to wait."""
HEARTBEAT_S: Final = 1.0
"""How often accounts and outcomes become durable when there is no object to commit them with."""
MANY_OUTCOMES: Final = 64
"""So many outcomes are worth a commit of their own."""
MOST_OBJECTS: Final = 32
MOST_BYTES: Final = 4 << 20
"""In one commit: its files are written and synced with the index locked, for which other processes wait."""
HANGING_S: Final = 10.0
"""A commit that takes longer hangs in the disk: usual is a hundredth of a second, a slow card at its worst takes a few."""


_Group = tuple[Sequence[DataObject], Sequence[Outcome]]


class SpoolWriter:
    """Collects objects and outcomes, and commits them on one thread.

    New; ``on_commit``; open once; put, settle, flush from any thread; close once. ``_changed`` guards the lists.
    """

    def __init__(self, spool: Spool, commit_s: float = COMMIT_S) -> None:
        self.spool = spool
        self._commit_s = commit_s
        self._spooled: Callable[[Sequence[SpooledObject]], None] = lambda _: None
        self._settled: Callable[[Collection[int]], None] = lambda _: None
        self._changed = threading.Condition()
        self._objects: deque[DataObject] = deque()
        self._outcomes: deque[Outcome] = deque()
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
        """After each commit, its thread calls ``spooled`` with the new objects, and ``settled`` with the ids of the outcomes."""
        self._spooled = spooled or self._spooled
        self._settled = settled or self._settled

    def open(self) -> None:
        self.worker.start()

    def put(self, item: DataObject, *, wait: bool = True) -> None:
        """Queue an object for the next commit; waits while too many bytes wait. Raises NameRefused for a bad key."""
        check_key(item.key)
        with self._changed:
            if wait:
                self._changed.wait_for(lambda: self._bytes < MAX_WAITING_BYTES or self.worker.stopping)
            self._objects.append(item)
            self._bytes += _in_memory(item)
            self._added += 1
            self._changed.notify_all()

    def settle(self, outcomes: Sequence[Outcome]) -> None:
        """Queue outcomes of deliveries for the next commit; never waits."""
        with self._changed:
            was_due = self._due()
            self._outcomes.extend(outcomes)
            self._added += len(outcomes)
            if self._due() and not was_due:  # else it is awake, and one wake an outcome would only cost
                self._changed.notify_all()

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
            self._changed.wait_for(lambda: self._done >= target or self.damaged, deadline_s)
            return self._done >= target

    def close(self, deadline_s: float) -> bool:
        """Commit what is queued and end the thread; False when that did not work in time. Idempotent."""
        end = time.monotonic() + deadline_s
        flushed = self.flush(deadline_s)
        self.worker.stop()
        with self._changed:
            self._changed.notify_all()
        return self.worker.join(end - time.monotonic() + HEARTBEAT_S) and flushed

    def _step(self) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._due() or self.worker.stopping, HEARTBEAT_S)
            pause_s = self._last_commit + self._commit_s - time.monotonic()
            if pause_s > 0 and not self._urgent:
                self._changed.wait_for(lambda: self._urgent or self.worker.stopping, pause_s)
            objects, outcomes = list(self._objects), list(self._outcomes)
        self._last_commit = time.monotonic()
        try:
            groups = self._groups(objects, outcomes)
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

    def _groups(self, objects: Sequence[DataObject], outcomes: Sequence[Outcome]) -> list[_Group]:
        """One commit of all, or several of a burst; also where the disk has no room, since files leave only after a commit.

        Then first what was delivered, then the files, which lie there already and of which some may be given up, last what is
        written.
        """
        if not objects or self.spool.fits(objects):
            first, *more = list(_parted(objects)) or [[]]
            return [(first, outcomes), *((part, []) for part in more)]
        files = [item for item in objects if isinstance(item.body, FileBody)]
        rest = [item for item in objects if not isinstance(item.body, FileBody)]
        groups: list[_Group] = [([], outcomes), (files, []), (rest, [])]
        return [group for group in groups if any(group)]

    def _commit(self, objects: Sequence[DataObject], outcomes: Sequence[Outcome]) -> None:
        self.spool.commit(objects, outcomes, durable=lambda spooled: self._committed(objects, outcomes, spooled))

    def _due(self) -> bool:
        """Whether there is something that waits for a commit; the caller holds the lock."""
        return bool(self._objects) or self._urgent or len(self._outcomes) >= (1 if self.prompt else MANY_OUTCOMES)

    def _committed(self, objects: Sequence[DataObject], outcomes: Sequence[Outcome], spooled: Sequence[SpooledObject]) -> None:
        """All of it is durable: let it go and tell who waits for that."""
        with self._changed:
            done = {id(item) for item in objects}
            self._objects = deque(item for item in self._objects if id(item) not in done)
            self._bytes -= sum(map(_in_memory, objects))
            for _ in outcomes:
                self._outcomes.popleft()
            self._done += len(objects) + len(outcomes)
            self._written.update(objects=len(objects), messages=sum(item.samples for item in objects))
            self._urgent = self._urgent and bool(self._objects or self._outcomes)
            self._changed.notify_all()
        if outcomes:
            self._settled({outcome.item.id for outcome in outcomes})
        if spooled:
            self._spooled(spooled)


def _parted(objects: Sequence[DataObject]) -> Iterator[list[DataObject]]:
    """The same in their order, as many at a time as one commit takes."""
    part: list[DataObject] = []
    size = 0
    for item in objects:
        if part and (len(part) >= MOST_OBJECTS or size + _in_memory(item) > MOST_BYTES):
            yield part
            part, size = [], 0
        part.append(item)
        size += _in_memory(item)
    if part:
        yield part


def _in_memory(item: DataObject) -> int:
    return len(item.body) if isinstance(item.body, bytes) else 0
