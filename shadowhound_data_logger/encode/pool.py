"""The encode pool: threads that turn batches into objects and hand them to the spool writer.

Every sample that goes in comes out as stored or as rejected with a reason, also when an encoder has a fault of its own.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from typing import Final

from shadowhound_data_logger.config import SensorSettings
from shadowhound_data_logger.encode.queue import BatchQueue
from shadowhound_data_logger.encode.registry import encode
from shadowhound_data_logger.encode.types import MessageTypes
from shadowhound_data_logger.model import Batch, DataObject
from shadowhound_data_logger.worker import Worker

log = logging.getLogger(__name__)

WAIT_S: Final = 0.5
PATIENCE_S: Final = 60.0
"""A batch that takes longer is stuck: the largest images and clouds take a second on a Jetson."""
Reject = Callable[[str, Mapping[str, int]], None]


class EncodePool:
    """New; open once; close once. Owns its threads; ``put`` may block them (a slow disk), never the intake."""

    def __init__(self, queue: BatchQueue, sensors: Mapping[str, SensorSettings], robot: str, types: MessageTypes,
                 put: Callable[[DataObject], None], reject: Reject, threads: int) -> None:  # fmt: skip
        self._queue = queue
        self._sensors = sensors
        self._robot = robot
        self._types = types
        self._put = put
        self._reject = reject
        self.observe: Callable[[Batch], None] = lambda _: None
        """Set before ``open``: shown each batch after its object is on its way; what it raises loses nothing."""
        self._told: set[tuple[str, str]] = set()
        self.workers = [Worker(f'encode-{number}', self._step, patience_s=PATIENCE_S) for number in range(threads)]

    def open(self) -> None:
        for worker in self.workers:
            worker.start()

    def close(self, deadline_s: float) -> bool:
        """Encode what is queued, then end; False if that took longer than the deadline. Idempotent."""
        end = time.monotonic() + deadline_s
        self._queue.close()
        done = [worker.join(end - time.monotonic()) for worker in self.workers]
        for worker in self.workers:
            worker.stop()
        return all(done)

    def _step(self) -> None:
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
        try:
            encoding = encode(batch, self._sensors[batch.sensor], self._robot, self._types)
        except BaseException:
            self._reject(batch.topic, {'encoder_failed': len(batch.samples)})
            raise
        if encoding.rejected:
            self._reject(batch.topic, encoding.rejected)
            self._tell(batch.topic, encoding.details)
        if encoding.object is not None:
            try:
                self._put(encoding.object)
            except BaseException:
                self._reject(batch.topic, {'encoder_failed': encoding.object.samples})
                raise
        self.observe(batch)

    def _tell(self, topic: str, details: Mapping[str, str]) -> None:
        """Say once for each topic and reason what is wrong; the ledger counts the rest."""
        for reason, text in details.items():
            if (topic, reason) not in self._told:
                self._told.add((topic, reason))
                log.warning('%s: a message cannot be stored: %s; more of these are only counted', topic, text)
