"""The latched messages of a recording: what a subscriber that joined now would still receive of each TRANSIENT_LOCAL publisher.

Each slice of a bag, and each event, begins with them, so that it can be played on its own. How many messages a publisher keeps
(its depth) is not part of DDS discovery, so the last one of each is kept, as `ros2 bag record --repeat-all-transient-local` does.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterator
from typing import Final

from shadowhound_data_logger.bags.queue import Lot
from shadowhound_data_logger.core.model import Taken

log = logging.getLogger(__name__)

MESSAGE_BYTES: Final = 304
"""What CPython needs for a message beside its content: a tuple of eight, the header of its bytes, integers, a place in a list."""
MAX_LATCHED_BYTES: Final = 64 << 20
"""Of all latched messages that a bag repeats."""
MAX_PER_TOPIC: Final = 100
"""Publishers of one topic; of more, those that published last."""


class Latched:
    """Keeps the last message of each latched publisher, bounded in bytes; holds references, no copies.

    New; used by one thread or under its owner's lock.
    """

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self.bytes = 0
        """Of the messages kept, with what Python needs for them."""
        self._topics: dict[tuple[str, str], deque[Lot]] = {}
        """By topic and type, one message each, the oldest first."""
        self._too_large: set[str] = set()

    def __iter__(self) -> Iterator[Lot]:
        """One message each, in the order of arrival within a topic."""
        return (lot for kept in self._topics.values() for lot in kept)

    def keep(self, lot: Lot) -> None:
        """Take in messages of a topic with ``lot.latched`` latched publishers; each replaces the one before it.

        Where the middleware does not report who published what, as many messages are kept as there are publishers. When there
        is no room, the oldest messages of the same topic are dropped, then the new one: other topics are not affected.
        """
        kept = self._topics.setdefault((lot.topic, lot.type), deque())
        for message in lot.messages:
            before = [each for each in kept if _replaces(message, each.messages[0])]
            if not before and not message.publisher and len(kept) >= lot.latched:
                before = [kept[0]]
            for each in before:
                kept.remove(each)
                self.bytes -= _size(each)
            single = lot._replace(messages=[message])
            room = self.max_bytes - _size(single)
            if self.bytes - sum(map(_size, kept)) <= room:
                while kept and (self.bytes > room or len(kept) >= MAX_PER_TOPIC):
                    self.bytes -= _size(kept.popleft())
                kept.append(single)
                self.bytes += _size(single)
            elif lot.topic not in self._too_large:
                self._too_large.add(lot.topic)
                log.warning('%s: a latched message of %d bytes is not repeated: all latched messages together may have %d bytes',
                            lot.topic, len(message.cdr), self.max_bytes)  # fmt: skip


def _size(single: Lot) -> int:
    return len(single.messages[0].cdr) + MESSAGE_BYTES


def _replaces(message: Taken, kept: Taken) -> bool:
    """Whether a message replaces an earlier one: of the same publisher, or the same content."""
    return message.cdr == kept.cdr or bool(message.publisher and message.publisher == kept.publisher)
