"""The intake thread: it alone creates, drains and destroys subscriptions, on its own clock (D1, D2).

Nothing here touches disk or network or parses a message. What the bounded queue has no room for is dropped and counted.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

from rclpy.node import Node

from shadowhound_data_logger.capture.reader import PolledGroup
from shadowhound_data_logger.capture.source import Source
from shadowhound_data_logger.config import Settings
from shadowhound_data_logger.encode.queue import BatchQueue
from shadowhound_data_logger.encode.types import MessageTypes
from shadowhound_data_logger.model import Batch
from shadowhound_data_logger.spool.accounts import Accounts
from shadowhound_data_logger.worker import Worker

REFRESH_S: Final = 0.25
"""How often the graph is looked at."""


class Intake:
    """New; open once; close once. Others ask the thread for something by ``post``."""

    def __init__(self, node: Node, settings: Settings, accounts: Accounts, types: MessageTypes, queue: BatchQueue) -> None:
        self._settings = settings
        self._accounts = accounts
        self._queue = queue
        self._priorities = {sensor.name: sensor.priority for sensor in settings.sensors}
        group = PolledGroup()
        self._sources = deque(
            Source(node, sensor, settings.intake, accounts, types, group, self._offer)
            for sensor in settings.sensors
            if sensor.enabled
        )
        self._requests: deque[Callable[[], None]] = deque()
        self._wake = threading.Event()
        self._next_poll_s = self._next_refresh_s = 0.0
        self.worker = Worker('intake', self._step)

    @property
    def topics(self) -> Sequence[str]:
        """The resolved topics it listens to, or would."""
        return [source.topic for source in self._sources]

    def open(self) -> None:
        self.worker.start()

    def close(self, deadline_s: float) -> bool:
        """Take what waits, close the batches and the subscriptions, end the thread; False if that took too long."""
        if self.worker.stopping:
            return True
        done = threading.Event()
        self.post(lambda: self._finish(done))
        self._wake.set()
        finished = done.wait(deadline_s)
        self.worker.stop()
        self._wake.set()
        return self.worker.join(deadline_s) and finished

    def post(self, request: Callable[[], None]) -> None:
        """Have the intake thread do something between two drains."""
        self._requests.append(request)

    def _step(self) -> None:
        """One round: wait for the next poll, drain every source, follow the graph."""
        now_s = time.monotonic()
        self._wake.wait(max(0.0, self._next_poll_s - now_s))
        now_s = time.monotonic()
        self._next_poll_s = now_s + self._settings.intake.poll_s
        if now_s >= self._next_refresh_s:
            self._next_refresh_s = now_s + REFRESH_S
            for _ in range(len(self._sources)):
                self._sources.rotate(-1)  # should one fail, it is the turn of the next one in the next round
                self._sources[-1].refresh(now_s)
        for source in self._sources:
            source.drain(now_s)
        while self._requests:
            self._requests.popleft()()

    def _finish(self, done: threading.Event) -> None:
        for source in self._sources:
            source.close(time.monotonic())
        self._sources.clear()
        self.worker.stop()
        done.set()

    def _offer(self, batch: Batch) -> None:
        for lost in self._queue.put(batch, self._priorities[batch.sensor]):
            self._accounts.drop(lost.topic, 'queue_full', len(lost.samples))
