"""What the intake hands to the thread that writes bags: bounded in bytes, in the order of arrival, never waited for."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate, takewhile
from typing import Final, NamedTuple

from shadowhound_data_logger.core.model import Taken

QUEUE_FULL: Final = 'queue_full'
"""Why messages are dropped that do not fit."""
MAX_BYTES: Final = 64 << 20
"""Of messages that wait for the disk; what comes beyond it is dropped."""
WAKE_BYTES: Final = 1 << 20
"""So much is worth a wake before the writer's time has come: about a chunk."""


class Lot(NamedTuple):
    """Messages of one topic, oldest first, as one drain took them."""

    topic: str
    type: str
    qos: str
    """As rosbag2 writes it (``mcap.rosbag2_metadata``)."""
    messages: Sequence[Taken]
    latched: int = 0
    """How many publishers of the topic keep their last message for subscribers that join later; 0 for most topics."""
    paused: bool = False
    """Whether they are only to be remembered as latched, not recorded."""


Mark = Callable[[], None]
"""Something to do between what came before it and what comes after."""


class BagQueue:
    """Messages on their way from the intake to the bag writer, in order, bounded in bytes.

    Thread-safe. ``put`` and ``mark`` from any thread, ``wait`` and ``next`` by the writer.
    """

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self._max_bytes = max_bytes
        self._changed = threading.Condition()
        self._items: deque[tuple[Lot | Mark, int]] = deque()
        self._marks = 0
        self._urgent = False
        self._lost = Counter[tuple[str, str]]()
        self.bytes = 0
        self.paused = False
        """Whether messages are to be counted only, instead of put."""
        self.dropped = 0
        """Messages, since it was made."""

    def put(self, lot: Lot) -> int:
        """Take in what fits; how many messages, the last ones, did not. Those of a pause count nowhere."""
        sizes = [len(message.cdr) for message in lot.messages]
        size, lost = sum(sizes), 0
        with self._changed:
            if self.bytes + size > self._max_bytes:
                if lot.paused:
                    return 0
                fitting = list(takewhile(lambda total: self.bytes + total <= self._max_bytes, accumulate(sizes)))
                lost = len(sizes) - len(fitting)
                self.dropped += lost
                self._lost[lot.topic, QUEUE_FULL] += lost
                lot, size = lot._replace(messages=lot.messages[: len(fitting)]), fitting[-1] if fitting else 0
            if lot.messages:
                self._items.append((lot, size))
                self.bytes += size
            if self.bytes >= WAKE_BYTES and not self._urgent:
                self._urgent = True
                self._changed.notify()
        return lost

    def leave_out(self, topic: str, reason: str, count: int) -> None:
        """Messages that are not put at all."""
        with self._changed:
            self._lost[topic, reason] += count

    def take_lost(self) -> Mapping[tuple[str, str], int]:
        """What did not get in since this was last asked, by topic and reason."""
        with self._changed:
            lost, self._lost = self._lost, Counter()
            return lost

    def mark(self, mark: Mark) -> None:
        """Have the writer do something at this place; always taken in."""
        with self._changed:
            self._items.append((mark, 0))
            self._marks += 1
            self._changed.notify()

    def wait(self, seconds: float) -> None:
        """Until there is enough to write or something to do, or for so long."""
        with self._changed:
            self._changed.wait_for(lambda: self._marks or self._urgent, max(0.0, seconds))
            self._urgent = False

    def next(self) -> Lot | Mark | None:
        """The oldest; None when there is nothing."""
        with self._changed:
            if not self._items:
                return None
            item, size = self._items.popleft()
            self.bytes -= size
            self._marks -= not isinstance(item, Lot)
            return item
