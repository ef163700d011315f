"""The bounded queue between intake and the encode pool: it never blocks intake; when full, the least important loses."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

from shadowhound_data_logger.config import QueueSettings
from shadowhound_data_logger.model import Batch


@dataclass(frozen=True, slots=True)
class QueueStatus:
    """How full the queue is."""

    batches: int
    messages: int
    bytes: int
    finished: int = 0
    """Batches that were taken from it and are done."""


class BatchQueue:
    """Batches by priority, first in first out within one. Thread-safe; ``_lock`` guards all of it.

    Whoever takes a batch says ``done`` when it has left for good, so that one can wait for those before a moment.
    """

    def __init__(self, settings: QueueSettings) -> None:
        self._settings = settings
        self._lock = threading.Lock()
        self._ready = threading.Condition(self._lock)
        self._left = threading.Condition(self._lock)
        self._unfinished: dict[int, int] = {}  # id of a batch -> its number, rising
        self._put = self._finished = 0
        self._lanes: dict[int, deque[Batch]] = {}
        self._messages = 0
        self._bytes = 0
        self._closed = False

    def put(self, batch: Batch, priority: int) -> list[Batch]:
        """Add a batch, at once. Returns what had to be dropped for it: the least important, oldest first; maybe itself."""
        dropped: list[Batch] = []
        with self._lock:
            lane = self._lanes.get(priority)
            if lane is None:
                self._lanes[priority] = lane = deque()
                self._lanes = dict(sorted(self._lanes.items()))
            lane.append(batch)
            self._put += 1
            self._unfinished[id(batch)] = self._put
            self._messages += len(batch.samples)
            self._bytes += batch.size
            while self._messages > self._settings.max_messages or self._bytes > self._settings.max_bytes:
                dropped.append(self._remove(next(lane for lane in reversed(self._lanes.values()) if lane)))
                self._finish(dropped[-1])
            self._ready.notify()
        return dropped

    def get(self, timeout_s: float) -> Batch | None:
        """The most important batch, or None after the timeout or once the queue is closed and empty."""
        with self._lock:
            if not self._messages and not self._closed:
                self._ready.wait(timeout_s)
            for lane in self._lanes.values():
                if lane:
                    return self._remove(lane)
        return None

    def done(self, batch: Batch) -> None:
        """The batch that ``get`` gave out has been handed on, or rejected."""
        with self._lock:
            self._finished += 1
            self._finish(batch)

    def finished(self, deadline_s: float) -> bool:
        """Whether every batch that was put before this call is done, or dropped, in time."""
        with self._lock:
            last = self._put
            return self._left.wait_for(lambda: next(iter(self._unfinished.values()), last + 1) > last, max(0.0, deadline_s))

    def close(self) -> None:
        """Wake all who wait; what is inside can still be taken."""
        with self._lock:
            self._closed = True
            self._ready.notify_all()

    @property
    def closed(self) -> bool:
        with self._lock:
            return self._closed

    def status(self) -> QueueStatus:
        with self._lock:
            return QueueStatus(sum(len(lane) for lane in self._lanes.values()), self._messages, self._bytes, self._finished)

    def _remove(self, lane: deque[Batch]) -> Batch:
        batch = lane.popleft()
        self._messages -= len(batch.samples)
        self._bytes -= batch.size
        return batch

    def _finish(self, batch: Batch) -> None:
        self._unfinished.pop(id(batch), None)
        self._left.notify_all()
