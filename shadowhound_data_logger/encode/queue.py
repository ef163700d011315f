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


class BatchQueue:
    """Batches by priority, first in first out within one. Thread-safe; ``_ready`` guards all of it."""

    def __init__(self, settings: QueueSettings) -> None:
        self._settings = settings
        self._ready = threading.Condition()
        self._lanes: dict[int, deque[Batch]] = {}
        self._messages = 0
        self._bytes = 0
        self._closed = False

    def put(self, batch: Batch, priority: int) -> list[Batch]:
        """Add a batch, at once. Returns what had to be dropped for it: the least important, oldest first; maybe itself."""
        dropped: list[Batch] = []
        with self._ready:
            lane = self._lanes.get(priority)
            if lane is None:
                self._lanes[priority] = lane = deque()
                self._lanes = dict(sorted(self._lanes.items()))
            lane.append(batch)
            self._messages += len(batch.samples)
            self._bytes += batch.size
            while self._messages > self._settings.max_messages or self._bytes > self._settings.max_bytes:
                dropped.append(self._remove(next(lane for lane in reversed(self._lanes.values()) if lane)))
            self._ready.notify()
        return dropped

    def get(self, timeout_s: float) -> Batch | None:
        """The most important batch, or None after the timeout or once the queue is closed and empty."""
        with self._ready:
            if not self._messages and not self._closed:
                self._ready.wait(timeout_s)
            for lane in self._lanes.values():
                if lane:
                    return self._remove(lane)
        return None

    def close(self) -> None:
        """Wake all who wait; what is inside can still be taken."""
        with self._ready:
            self._closed = True
            self._ready.notify_all()

    @property
    def closed(self) -> bool:
        with self._ready:
            return self._closed

    def status(self) -> QueueStatus:
        with self._ready:
            return QueueStatus(sum(len(lane) for lane in self._lanes.values()), self._messages, self._bytes)

    def _remove(self, lane: deque[Batch]) -> Batch:
        batch = lane.popleft()
        self._messages -= len(batch.samples)
        self._bytes -= batch.size
        return batch
