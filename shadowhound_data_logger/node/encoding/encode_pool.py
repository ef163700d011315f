"""A bounded queue of batches, and the threads that encode them into objects.

The queue never blocks the intake: when it is full, a batch of the lowest priority is dropped. Every sample taken from it ends up
stored, or rejected with a reason, even if an encoder has a bug.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from shadowhound_data_logger.core.config import QueueSettings, SensorSettings
from shadowhound_data_logger.core.model import Batch, DataObject
from shadowhound_data_logger.core.stamps import by_arrival
from shadowhound_data_logger.core.status import QueueStatus
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.formats.encoders import encode
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.encoding.rejections import ENCODER_FAILED, RejectionLog
from shadowhound_data_logger.spool.writer import SpoolWriter

log = logging.getLogger(__name__)

WAIT_S: Final = 5.0
THREADS: Final = min(max(2, len(os.sched_getaffinity(0)) // 2), 4)
"""Encoder threads: half the cores that this process may use, at least two, at most four."""
MAX_MESSAGES: Final = 50_000
"""Maximum number of messages that wait for an encoder, however small."""
PATIENCE_S: Final = 60.0
"""A batch that takes longer is stuck: the largest images and clouds take a second on a Jetson."""
Marking = Callable[[DataObject], DataObject]
"""Adds metadata to an object or renames it; called from any thread."""
Preview = Callable[[DataObject], 'DataObject | None']
Observe = Callable[[Batch, 'DataObject | None'], None]


class BatchQueue:
    """Batches by priority, first in first out within one. Thread-safe; ``_lock`` guards all state.

    The consumer calls ``done`` for each batch that it has finished, so that ``finished`` can wait for earlier batches.
    """

    def __init__(self, settings: QueueSettings, max_messages: int = MAX_MESSAGES) -> None:
        self._max_bytes, self._max_messages = settings.max_bytes, max_messages
        self._lock = threading.Lock()
        self._ready = threading.Condition(self._lock)
        self._left = threading.Condition(self._lock)
        self._unfinished: dict[int, tuple[int, Batch]] = {}  # id of a batch -> its sequence number
        self._put_count = self._done_count = 0
        self._lanes: dict[int, deque[Batch]] = {}
        self._messages = 0
        self._bytes = 0
        self._closed = False

    def put(self, batch: Batch, priority: int) -> list[Batch]:
        """Add a batch without blocking. Returns the batches dropped for it: lowest priority and oldest first; it may be among
        them.
        """
        dropped: list[Batch] = []
        with self._lock:
            lane = self._lanes.get(priority)
            if lane is None:
                self._lanes[priority] = lane = deque()
                self._lanes = dict(sorted(self._lanes.items()))
            lane.append(batch)
            self._put_count += 1
            self._unfinished[id(batch)] = self._put_count, batch
            self._messages += len(batch.samples)
            self._bytes += batch.size
            while self._messages > self._max_messages or self._bytes > self._max_bytes:
                dropped.append(self._remove(next(lane for lane in reversed(self._lanes.values()) if lane)))
                self._finish(dropped[-1])
            self._ready.notify()
        return dropped

    def get(self, timeout_s: float) -> Batch | None:
        """The most important batch; None after the timeout, or once the queue is closed and empty."""
        with self._lock:
            if not self._messages and not self._closed:
                self._ready.wait(timeout_s)
            for lane in self._lanes.values():
                if lane:
                    return self._remove(lane)
        return None

    def done(self, batch: Batch) -> None:
        """A batch from ``get`` has been passed on, or rejected."""
        with self._lock:
            self._done_count += 1
            self._finish(batch)

    def finished(self, deadline_s: float) -> bool:
        """Whether every batch that was put before this call is done, or dropped, before the deadline."""
        with self._lock:
            last = self._put_count
            return self._left.wait_for(lambda: self._first() > last, max(0.0, deadline_s))

    def is_busy(self) -> bool:
        """Whether a batch waits or is being encoded; reads without the lock, so it may be slightly out of date."""
        return bool(self._unfinished)

    def oldest(self) -> dict[str, int]:
        """Topic -> the first stamp of its batches that are not done."""
        with self._lock:
            found: dict[str, int] = {}
            for _, batch in self._unfinished.values():
                first_ns = batch.samples[0].stamp_ns
                found[batch.topic] = min(first_ns, found.get(batch.topic, first_ns))
            return found

    def close(self) -> None:
        """Wake all waiting threads; queued batches can still be taken."""
        with self._lock:
            self._closed = True
            self._ready.notify_all()

    @property
    def closed(self) -> bool:
        with self._lock:
            return self._closed

    def status(self) -> QueueStatus:
        with self._lock:
            batches = sum(len(lane) for lane in self._lanes.values())
            return QueueStatus(batches, self._messages, self._bytes, self._done_count, self._max_messages, self._max_bytes)

    def _first(self) -> int:
        """The sequence number of the oldest batch that is not done, or of the next one."""
        return next((number for number, _ in self._unfinished.values()), self._put_count + 1)

    def _remove(self, lane: deque[Batch]) -> Batch:
        batch = lane.popleft()
        self._messages -= len(batch.samples)
        self._bytes -= batch.size
        return batch

    def _finish(self, batch: Batch) -> None:
        self._unfinished.pop(id(batch), None)
        self._left.notify_all()


class EncodePool:
    """The threads that encode batches and pass the objects to the spool.

    New; open once; close once. Owns its threads; ``SpoolWriter.put`` may block them (a slow disk), never the intake.
    """

    def __init__(self, robot: str, queue: BatchQueue, sensors: Mapping[str, SensorSettings], types: MessageTypes,  # noqa: PLR0913 - each is a neighbor
                 writer: SpoolWriter, marks: Sequence[Marking], observe: Observe, *,
                 preview: Preview = lambda _: None, reports: RejectionLog | None = None,
                 threads: int = THREADS) -> None:  # fmt: skip
        """``sensors`` are the current settings. An object passes through the ``marks`` one after the other, then to ``writer``.

        ``observe`` receives each batch and its object, if there is one, after that was passed on; an exception in it loses
        nothing.
        ``preview`` may create a preview of an object, which is spooled before it. ``reports`` logs rejections.
        """
        self._queue = queue
        self._sensors = sensors
        self._robot = robot
        self._types = types
        self._writer = writer
        self._accounts = writer.spool.accounts
        self._marks = marks
        self._observe = observe
        self._preview = preview
        self._reports = RejectionLog() if reports is None else reports
        self.workers = [Worker(f'encode-{number}', self._step, patience_s=PATIENCE_S) for number in range(threads)]

    def open(self) -> None:
        for worker in self.workers:
            worker.start()

    def close(self, deadline_s: float) -> bool:
        """Encode the queued batches, then stop; False if that took longer than the deadline. Idempotent."""
        end = time.monotonic() + deadline_s
        self._queue.close()
        done = [worker.join(end - time.monotonic()) for worker in self.workers]
        for worker in self.workers:
            worker.stop()
        return all(done)

    def _step(self) -> None:
        self._reports.poll()
        batch = self._queue.get(WAIT_S)
        if batch is not None:
            try:
                self._encode(batch)
            finally:
                self._queue.done(batch)
        elif self._queue.closed:
            for worker in self.workers:
                worker.stop()

    def _encode(self, batch: Batch) -> None:
        first, last = (by_arrival(batch.samples[at].received_ns) for at in (0, -1))  # an invalid message may have any stamp
        try:
            encoding = encode(batch, self._sensors[batch.sensor], self._robot, self._types)
        except BaseException:
            self._accounts.reject(batch.topic, {ENCODER_FAILED: len(batch.samples)}, first, last)
            raise
        if encoding.rejected:
            self._accounts.reject(batch.topic, encoding.rejected, first, last)
            self._reports.add(batch.topic, batch.sensor, encoding.rejections)
        if encoding.object is not None:
            try:
                self._spool(encoding.object)
            except BaseException:
                self._accounts.reject(batch.topic, {ENCODER_FAILED: encoding.object.samples}, first, last)
                raise
            if encoding.corrected:
                self._accounts.correct(batch.topic, encoding.corrected)
        self._observe(batch, encoding.object)

    def _spool(self, item: DataObject) -> None:
        for mark in self._marks:
            item = mark(item)
        preview = self._preview(item)
        self._writer.put(*([preview] if preview is not None else []), item)
