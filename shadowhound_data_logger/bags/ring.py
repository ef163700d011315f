"""The last seconds of some topics, serialized, in memory: bounded in bytes, filled by the intake, which never waits for it.

The ring holds references to the received messages, not copies. An event claims the messages in the ring and those that follow,
and removes them piece by piece, so that no message is in the bags of two events. Latched messages are the exception: the last
one of each publisher is kept regardless of its age, and each event starts with them.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

from shadowhound_data_logger.bags.latched import MESSAGE_BYTES, Latched
from shadowhound_data_logger.bags.queue import MessageBatch
from shadowhound_data_logger.core.model import Taken
from shadowhound_data_logger.spool.accounts import Accounts
from shadowhound_data_logger.spool.topic_account import EVENT, Losses

PIECE_BYTES: Final = 1 << 20
"""Larger batches are split into pieces of this size, which are evicted and written separately."""
RING_FULL: Final = 'ring_full'
"""Reason for dropping messages that were evicted before the event that claimed them could write them."""


class RingItem(NamedTuple):
    """A piece of the messages that one drain took from a topic."""

    batch: MessageBatch
    lost: Losses
    """Estimated losses before the last message; None if unknown."""
    at_s: float
    """Time of the drain, monotonic clock."""
    size: int
    repeated: bool = False
    """Whether it is a latched message from before everything in the ring; an earlier event may have it already."""


class Ring:
    """The latest messages of some topics, bounded in seconds and bytes.

    Thread-safe. ``put`` by the intake; ``claim``, ``next`` and ``release`` by the thread that writes events.
    """

    def __init__(self, max_bytes: int, keep_s: float) -> None:
        self._max_bytes = max_bytes
        self.keep_s = keep_s
        """How long unclaimed messages are kept, if there is room."""
        self._lock = threading.Lock()
        self._items: deque[RingItem] = deque()
        self._latched = Latched(max_bytes // 2)
        """The latched messages among those that were removed from the ring."""
        self._first: deque[RingItem] = deque()
        """The latched messages with which the active event starts."""
        self._claimed = False
        self._bytes = 0
        """Size of ``_items``."""

    @property
    def max_bytes(self) -> int:
        return self._max_bytes

    @max_bytes.setter
    def max_bytes(self, value: int) -> None:
        self._max_bytes, self._latched.max_bytes = value, value // 2

    @property
    def bytes(self) -> int:
        """Size of the messages, including Python's overhead."""
        return self._bytes + self._latched.bytes

    @property
    def claimed(self) -> bool:
        """Whether an event has claimed the messages."""
        return self._claimed

    @property
    def seconds(self) -> float:
        """Time from the oldest message to the newest one."""
        with self._lock:
            return self._items[-1].at_s - self._items[0].at_s if self._items else 0.0

    def put(self, batch: MessageBatch, lost: Losses, now_s: float) -> list[RingItem]:
        """Add messages and evict the oldest ones beyond the limits; returns evicted messages that an event had claimed."""
        with self._lock:
            for piece in _pieces(batch, lost, now_s):
                self._items.append(piece)
                self._bytes += piece.size
            gone = []
            while self.bytes > self.max_bytes and self._items:
                gone.append(self._pop())
            if self._claimed:
                return gone
            self._age(now_s - self.keep_s)
            return []

    def claim(self, since_s: float, now_ns: int = 0) -> float | None:
        """Claim all messages since ``since_s``; returns the time of the oldest one, None if the ring is empty.

        Latched messages come first, with the arrival time of the oldest message, or ``now_ns`` if there is none.
        """
        with self._lock:
            self._age(since_s)
            self._claimed = True
            oldest = self._items[0] if self._items else None
            start_ns, at_s = (oldest.batch.messages[0].received_ns, oldest.at_s) if oldest else (now_ns, since_s)
            self._first = deque(
                RingItem(
                    single._replace(messages=[single.messages[0]._replace(received_ns=start_ns)]), {}, at_s, 0, repeated=True
                )
                for single in self._latched
            )
            return oldest.at_s if oldest else None

    def next(self, until_s: float) -> RingItem | None:
        """Remove the oldest piece; None if none was drained until then."""
        with self._lock:
            if self._first:
                return self._first.popleft()
            return self._pop() if self._items and self._items[0].at_s <= until_s else None

    def release(self) -> None:
        """End the claim on the remaining messages."""
        with self._lock:
            self._claimed = False
            self._first.clear()

    def _age(self, since_s: float) -> None:
        while self._items and self._items[0].at_s < since_s:
            self._pop()

    def _pop(self) -> RingItem:
        held = self._items.popleft()
        self._bytes -= held.size
        if held.batch.latched:
            self._latched.keep(held.batch)
        return held


def _pieces(batch: MessageBatch, lost: Losses, now_s: float) -> Iterator[RingItem]:
    """A batch in pieces of about ``PIECE_BYTES``; the losses are attributed to the last piece."""
    part: list[Taken] = []
    size = 0
    for message in batch.messages:
        cost = len(message.cdr) + MESSAGE_BYTES
        if part and size + cost > PIECE_BYTES:
            yield RingItem(batch._replace(messages=part), None if lost is None else {}, now_s, size)
            part, size = [], 0
        part.append(message)
        size += cost
    if part:
        yield RingItem(batch._replace(messages=part), lost, now_s, size)


class EventAccounts:
    """Accounts for the messages that events claim from the ring. Thread-safe."""

    def __init__(self, accounts: Accounts) -> None:
        self._accounts = accounts
        self._lost: deque[tuple[tuple[str, str], int]] = deque()

    def begin(self) -> None:
        """Start an event: messages published since the last event were not claimed, so they do not count as missed."""
        self._accounts.rebase_all(EVENT)

    def receive(self, held: RingItem) -> list[Taken]:
        """Account for messages that an event received; returns those that are not duplicates."""
        with self._accounts.entry(f'{EVENT}{held.batch.topic}') as account:
            account.type = held.batch.type
            if held.repeated:
                for each in held.batch.messages:
                    account.receive_again(each.publisher, each.number)
                return list(held.batch.messages)
            unknown = account.unknown
            fresh = [each for each in held.batch.messages if account.receive(each.publisher, each.number, each.times)]
            newest = held.batch.messages[-1].times
            account.add_estimate(account.unknown - unknown, held.lost, newest)
            account.gaps.newest = newest
        return fresh

    def lose(self, held: Iterable[RingItem], reason: str = RING_FULL) -> None:
        """Account for claimed messages that the event cannot write."""
        for each in held:
            fresh = self.receive(each)
            if fresh:
                self._accounts.drop(f'{EVENT}{each.batch.topic}', reason, len(fresh), fresh[0].times, fresh[-1].times)
                self._lost.append(((each.batch.topic, reason), len(fresh)))

    def take_dropped(self) -> Counter[tuple[str, str]]:
        """The messages lost since the last call, by topic and reason."""
        found = Counter[tuple[str, str]]()
        while self._lost:
            what, count = self._lost.popleft()
            found[what] += count
        return found
