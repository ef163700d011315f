"""The latched messages of a recording: those that a subscriber that joins now still receives from TRANSIENT_LOCAL publishers.

Each slice of a bag, and each event, starts with them, so that it can be played on its own. DDS discovery does not announce the
number of messages that a publisher keeps (its depth), so the last one of each publisher is kept, as in
`ros2 bag record --repeat-all-transient-local`.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterator
from typing import Final

from shadowhound_data_logger.bags.queue import MessageBatch
from shadowhound_data_logger.core.model import Taken

log = logging.getLogger(__name__)

MESSAGE_BYTES: Final = 304
"""CPython's overhead per message: a tuple of eight, the header of its bytes, integers, a list entry."""
MAX_LATCHED_BYTES: Final = 64 << 20
"""Maximum size of all latched messages that a bag repeats."""
MAX_PER_TOPIC: Final = 100
"""Maximum publishers per topic: those that published last."""


class Latched:
    """The last message of each latched publisher, bounded in bytes; holds references, not copies.

    Not thread-safe: used by one thread, or under its owner's lock.
    """

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self.bytes = 0
        """Size of the kept messages, including Python's overhead."""
        self._topics: dict[tuple[str, str], deque[MessageBatch]] = {}
        """Batches of one message by topic and type, oldest first."""
        self._too_large: set[str] = set()

    def __iter__(self) -> Iterator[MessageBatch]:
        """Batches of one message, in order of arrival within a topic."""
        return (batch for kept in self._topics.values() for batch in kept)

    def keep(self, batch: MessageBatch) -> None:
        """Add messages of a topic with ``batch.latched`` latched publishers; each replaces its publisher's previous one.

        If the middleware does not report the publisher of a message, as many messages are kept as there are publishers. If
        there is no room, the oldest messages of the same topic are dropped, then the new one: other topics are not affected.
        """
        kept = self._topics.setdefault((batch.topic, batch.type), deque())
        for message in batch.messages:
            before = [each for each in kept if _replaces(message, each.messages[0])]
            if not before and not message.publisher and len(kept) >= batch.latched:
                before = [kept[0]]
            for each in before:
                kept.remove(each)
                self.bytes -= _size(each)
            single = batch._replace(messages=[message])
            room = self.max_bytes - _size(single)
            if self.bytes - sum(map(_size, kept)) <= room:
                while kept and (self.bytes > room or len(kept) >= MAX_PER_TOPIC):
                    self.bytes -= _size(kept.popleft())
                kept.append(single)
                self.bytes += _size(single)
            elif batch.topic not in self._too_large:
                self._too_large.add(batch.topic)
                log.warning('%s: a latched message of %d bytes is not repeated: the limit for all latched messages is %d bytes',
                            batch.topic, len(message.cdr), self.max_bytes)  # fmt: skip


def _size(single: MessageBatch) -> int:
    return len(single.messages[0].cdr) + MESSAGE_BYTES


def _replaces(message: Taken, kept: Taken) -> bool:
    """Whether a message replaces a kept one: it has the same publisher or the same content."""
    return message.cdr == kept.cdr or bool(message.publisher and message.publisher == kept.publisher)
