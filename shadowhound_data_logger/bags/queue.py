"""The queue from the intake to the thread that writes bags: bounded in bytes, in order of arrival; ``put`` never blocks."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate, takewhile
from typing import Final, NamedTuple

from shadowhound_data_logger.core.model import Taken

QUEUE_FULL: Final = 'queue_full'
"""Reason for dropping messages that do not fit."""
MAX_BYTES: Final = 64 << 20
"""Maximum size of the queued messages; further messages are dropped."""
WAKE_BYTES: Final = 1 << 20
"""Wake the writer early when this much is queued: about a chunk."""


class MessageBatch(NamedTuple):
    """Messages of one topic that one drain took, oldest first."""

    topic: str
    type: str
    qos: str
    """As rosbag2 writes it (``mcap.rosbag2_metadata``)."""
    messages: Sequence[Taken]
    latched: int = 0
    """The number of publishers of the topic that keep their last message for late subscribers; 0 for most topics."""
    paused: bool = False
    """Whether the messages are only kept as latched ones, not recorded."""


Mark = Callable[[], None]
"""Called between the messages that were put before it and those put after it."""


class BagQueue:
    """Messages on their way from the intake to the bag writer, in order, bounded in bytes.

    Thread-safe. ``put`` and ``mark`` from any thread, ``wait`` and ``next`` by the writer.
    """

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self._max_bytes = max_bytes
        self._changed = threading.Condition()
        self._items: deque[tuple[MessageBatch | Mark, int]] = deque()
        self._marks = 0
        self._urgent = False
        self._lost = Counter[tuple[str, str]]()
        self.bytes = 0
        self.paused = False
        """Whether the intake should count messages instead of putting them."""
        self.dropped = 0
        """Messages that did not fit, in total."""

    def put(self, batch: MessageBatch) -> int:
        """Add the messages that fit; returns the number of those, at the end, that do not. Paused messages are not counted."""
        sizes = [len(message.cdr) for message in batch.messages]
        size, lost = sum(sizes), 0
        with self._changed:
            if self.bytes + size > self._max_bytes:
                if batch.paused:
                    return 0
                fitting = list(takewhile(lambda total: self.bytes + total <= self._max_bytes, accumulate(sizes)))
                lost = len(sizes) - len(fitting)
                self.dropped += lost
                self._lost[batch.topic, QUEUE_FULL] += lost
                batch, size = batch._replace(messages=batch.messages[: len(fitting)]), fitting[-1] if fitting else 0
            if batch.messages:
                self._items.append((batch, size))
                self.bytes += size
            if self.bytes >= WAKE_BYTES and not self._urgent:
                self._urgent = True
                self._changed.notify()
        return lost

    def count_dropped(self, topic: str, reason: str, count: int) -> None:
        """Count messages that are dropped without being put."""
        with self._changed:
            self._lost[topic, reason] += count

    def take_dropped(self) -> Mapping[tuple[str, str], int]:
        """The messages dropped since the last call, by topic and reason."""
        with self._changed:
            lost, self._lost = self._lost, Counter()
            return lost

    def mark(self, mark: Mark) -> None:
        """Have the writer call ``mark`` at this position; never dropped."""
        with self._changed:
            self._items.append((mark, 0))
            self._marks += 1
            self._changed.notify()

    def wait(self, seconds: float) -> None:
        """Wait until there are enough messages to write, or a mark, or the time is over."""
        with self._changed:
            self._changed.wait_for(lambda: self._marks or self._urgent, max(0.0, seconds))
            self._urgent = False

    def next(self) -> MessageBatch | Mark | None:
        """Remove the oldest item; None if the queue is empty."""
        with self._changed:
            if not self._items:
                return None
            item, size = self._items.popleft()
            self.bytes -= size
            self._marks -= not isinstance(item, MessageBatch)
            return item
