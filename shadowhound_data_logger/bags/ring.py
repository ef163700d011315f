"""The last seconds of some topics, serialized as they came: bounded in bytes, filled by the intake, which never waits for it.

It holds references to what was taken, never a copy. An event claims what is in it and what comes, and takes it out piece by
piece: what an event has taken is no longer in the ring, so that no message is in two events' bags. Latched messages are the
exception: the last one of each publisher stays, however old it is, and each event begins with them.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

from shadowhound_data_logger.bags.latched import MESSAGE_BYTES, Latched
from shadowhound_data_logger.bags.queue import Lot
from shadowhound_data_logger.core.model import Taken
from shadowhound_data_logger.spool.accounts import EVENT, Accounts, Losses

PIECE_BYTES: Final = 1 << 20
"""A lot that is larger is kept in pieces: what goes, goes by pieces, and what is written as well."""
RING_FULL: Final = 'ring_full'
"""Why messages are dropped that had to go from the ring before an event that asked for them could write them."""


class Held(NamedTuple):
    """A piece of what one drain took of a topic."""

    lot: Lot
    lost: Losses
    """What is estimated to have been lost before the last of it; None where it is not known."""
    at_s: float
    """When it was drained, by the monotonic clock."""
    size: int
    again: bool = False
    """Whether it is latched and came before all that is in the ring; it may have been in an event already."""


class Ring:
    """The latest messages of some topics, in memory, bounded in seconds and bytes.

    Thread-safe. ``put`` by the intake; ``claim``, ``next`` and ``release`` by whoever writes events.
    """

    def __init__(self, max_bytes: int, keep_s: float) -> None:
        self._max_bytes = max_bytes
        self.keep_s = keep_s
        """For how long what nobody claimed stays, as far as its bytes have room."""
        self._lock = threading.Lock()
        self._items: deque[Held] = deque()
        self._latched = Latched(max_bytes // 2)
        """Of what left the ring."""
        self._first: deque[Held] = deque()
        """What is latched, for the event that goes on."""
        self._claimed = False
        self._bytes = 0
        """Of ``_items``."""

    @property
    def max_bytes(self) -> int:
        return self._max_bytes

    @max_bytes.setter
    def max_bytes(self, value: int) -> None:
        self._max_bytes, self._latched.max_bytes = value, value // 2

    @property
    def bytes(self) -> int:
        """Of the messages in it, with what Python needs for them."""
        return self._bytes + self._latched.bytes

    @property
    def claimed(self) -> bool:
        """Whether an event asks for all that is in it."""
        return self._claimed

    @property
    def seconds(self) -> float:
        """From the oldest to the newest."""
        with self._lock:
            return self._items[-1].at_s - self._items[0].at_s if self._items else 0.0

    def put(self, lot: Lot, lost: Losses, now_s: float) -> list[Held]:
        """Take in messages; whatever is too old or too much goes, the oldest first. What an event asked for of that."""
        with self._lock:
            for piece in _pieces(lot, lost, now_s):
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
        """All of ``since_s`` and after is asked for now; returns the time of the oldest, None for an empty ring.

        What is latched comes first, as if it had been received with the oldest, or now (``now_ns``).
        """
        with self._lock:
            self._age(since_s)
            self._claimed = True
            oldest = self._items[0] if self._items else None
            start_ns, at_s = (oldest.lot.messages[0].received_ns, oldest.at_s) if oldest else (now_ns, since_s)
            self._first = deque(
                Held(single._replace(messages=[single.messages[0]._replace(received_ns=start_ns)]), {}, at_s, 0, again=True)
                for single in self._latched
            )
            return oldest.at_s if oldest else None

    def next(self, until_s: float) -> Held | None:
        """Take out the oldest piece; None when there is none that was drained until then."""
        with self._lock:
            if self._first:
                return self._first.popleft()
            return self._pop() if self._items and self._items[0].at_s <= until_s else None

    def release(self) -> None:
        """Nobody asks for what is left in it."""
        with self._lock:
            self._claimed = False
            self._first.clear()

    def _age(self, since_s: float) -> None:
        while self._items and self._items[0].at_s < since_s:
            self._pop()

    def _pop(self) -> Held:
        held = self._items.popleft()
        self._bytes -= held.size
        if held.lot.latched:
            self._latched.keep(held.lot)
        return held


def _pieces(lot: Lot, lost: Losses, now_s: float) -> Iterator[Held]:
    """A lot in parts of about ``PIECE_BYTES``; what was lost belongs to the last of them."""
    part: list[Taken] = []
    size = 0
    for message in lot.messages:
        cost = len(message.cdr) + MESSAGE_BYTES
        if part and size + cost > PIECE_BYTES:
            yield Held(lot._replace(messages=part), None if lost is None else {}, now_s, size)
            part, size = [], 0
        part.append(message)
        size += cost
    if part:
        yield Held(lot._replace(messages=part), lost, now_s, size)


class Claims:
    """Accounts for the messages that events claim of the ring.

    New; from any thread.
    """

    def __init__(self, accounts: Accounts) -> None:
        self._accounts = accounts
        self._lost: deque[tuple[tuple[str, str], int]] = deque()

    def begin(self) -> None:
        """What was published since the last event was not asked for, and is not missed."""
        self._accounts.rebase_all(EVENT)

    def receive(self, held: Held) -> list[Taken]:
        """An event has it now; what is not a repeat of it."""
        with self._accounts.entry(f'{EVENT}{held.lot.topic}') as account:
            account.type = held.lot.type
            if held.again:
                for each in held.lot.messages:
                    account.receive_again(each.publisher, each.number)
                return list(held.lot.messages)
            unknown = account.unknown
            fresh = [each for each in held.lot.messages if account.receive(each.publisher, each.number, each.times)]
            newest = held.lot.messages[-1].times
            account.appraise(account.unknown - unknown, held.lost, newest)
            account.gaps.heard = newest
        return fresh

    def lose(self, held: Iterable[Held], reason: str = RING_FULL) -> None:
        """An event asked for it and cannot have it."""
        for each in held:
            fresh = self.receive(each)
            if fresh:
                self._accounts.drop(f'{EVENT}{each.lot.topic}', reason, len(fresh), fresh[0].times, fresh[-1].times)
                self._lost.append(((each.lot.topic, reason), len(fresh)))

    def take_lost(self) -> Counter[tuple[str, str]]:
        """What was lost since the last call, by topic and reason."""
        found = Counter[tuple[str, str]]()
        while self._lost:
            what, count = self._lost.popleft()
            found[what] += count
        return found
