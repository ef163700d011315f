"""Limits the upload rate: one token bucket for all puts of a store, which keeps the radio free for the robot.

Under a cap, a body is sent in small, evenly spaced pieces, never in bursts at line rate. The body with the highest priority is
sent first, but every fourth piece is from the one that has waited longest, so that none starves until the server times out.
"""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, Protocol

PIECE_S: Final = 0.02
"""Time that one piece takes at the cap, which is the longest delay of a control message."""
SMALLEST_PIECE: Final = 1 << 10
LARGEST_PIECE: Final = 1 << 16
"""Also without a cap: the socket's timeout applies to one piece, so the slowest usable link sends 64 KiB in that time."""
LATE_S: Final = 0.05
"""A thread that wakes up late may catch up this much."""
OLDEST_EVERY: Final = 4
"""Every so many pieces, the body that has waited longest is served."""
BYTES_PER_MEGABIT: Final = 125_000


class Body(Protocol):
    """The content to send: a file, or a part of one."""

    def seek(self, place: int, /) -> int: ...

    def read(self, size: int, /) -> bytes: ...


class PacedBody:
    """A body that is read once from start to end; each ``read`` waits until the piece may be sent."""

    def __init__(self, pieces: Iterator[bytes]) -> None:
        self._pieces = pieces

    def read(self, _: int = -1, /) -> bytes:
        """The next piece, of any size; empty at the end. Raises ConnectionAbortedError as ``Pace.pieces``."""
        return next(self._pieces, b'')


@dataclass(frozen=True, slots=True, eq=False)
class _Waiter:
    """A body that waits to send its next piece."""

    rank: tuple[int, bool, int]
    """(priority, ``is_background``, order of arrival); the smallest is sent first."""
    turn: threading.Condition


class Pace:
    """Limits the total rate of all puts of a store.

    Thread-safe: ``_lock`` guards all of it; the waiters' conditions share it.
    """

    def __init__(self, max_mbps: float = 0.0, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._now = monotonic
        self._lock = threading.Lock()
        self._waiting: list[_Waiter] = []  # longest waiting first
        self._max_mbps = 0.0
        self._yielded_mbps = 0.0
        self._yields_until = 0.0
        self._free_at = 0.0  # when the next piece may be sent
        self._bodies = self._pieces = self._sent_bytes = self._abandoned = 0
        self.set(max_mbps)

    def __repr__(self) -> str:
        return f'Pace({self.max_mbps:g} Mbit/s)' if self.max_mbps else 'Pace(no cap)'

    def set(self, max_mbps: float) -> None:
        """Set the cap on payload in Mbit/s, 0 for none; it applies immediately, also to bodies that are being sent."""
        if not 0.0 <= max_mbps < float('inf'):
            raise ValueError(f'{max_mbps} Mbit/s is not a cap')
        with self._lock:
            self._max_mbps = max_mbps
            self._free_at = self._now()
            self._wake_all()

    def yield_to(self, max_mbps: float, seconds: float) -> None:
        """Temporarily lower the cap; it ends after ``seconds``, and a later call replaces it."""
        if not 0.0 < max_mbps < float('inf'):
            raise ValueError(f'{max_mbps} Mbit/s is not a cap')
        with self._lock:
            self._yielded_mbps = max_mbps
            self._yields_until = self._now() + seconds
            self._wake_all()

    @property
    def max_mbps(self) -> float:
        """The current cap in Mbit/s; 0 for none."""
        if self._now() >= self._yields_until:
            return self._max_mbps
        return min(self._max_mbps or self._yielded_mbps, self._yielded_mbps)

    @property
    def sent_bytes(self) -> int:
        """Payload bytes sent so far, with retries, without headers."""
        return self._sent_bytes

    def bytes_in(self, seconds: float) -> float:
        """How many bytes the cap allows in that time; infinite without one."""
        return self.max_mbps * BYTES_PER_MEGABIT * seconds or float('inf')

    def count(self, size: int) -> None:
        """Count bytes that were sent without the cap."""
        with self._lock:
            self._sent_bytes += size

    def body(self, body: bytes | Body, priority: int, *, is_background: bool = False) -> PacedBody:
        """The body as a file for an HTTP client, to be read once; as ``pieces``."""
        return PacedBody(self.pieces(body, priority, is_background=is_background))

    def pieces(self, body: bytes | Body, priority: int, *, is_background: bool = False) -> Iterator[bytes]:
        """The pieces of a body, each when it may be sent. Raises ConnectionAbortedError after a later ``abandon``.

        A background body is sent after all others of its priority, because it is one of many parts.
        """
        with self._lock:
            self._bodies += 1
            return self._send(body, (priority, is_background, self._bodies), self._abandoned)

    def abandon(self) -> None:
        """Abort all bodies that are being sent."""
        with self._lock:
            self._abandoned += 1
            self._wake_all()

    def _send(self, body: bytes | Body, rank: tuple[int, bool, int], abandoned: int) -> Iterator[bytes]:
        file = io.BytesIO(body) if isinstance(body, bytes) else body
        file.seek(0)
        while piece := file.read(self._piece_bytes()):
            self._take(len(piece), rank, abandoned)
            yield piece

    def _take(self, size: int, rank: tuple[int, bool, int], abandoned: int) -> None:
        """Wait until so many bytes of the body may be sent."""
        with self._lock:
            waiter = _Waiter(rank, threading.Condition(self._lock))
            self._waiting.append(waiter)
            try:
                while self._abandoned == abandoned:
                    pause_s = self._pause(waiter)
                    if pause_s is not None and pause_s <= 0.0:
                        self._grant(size)
                        return
                    waiter.turn.wait(pause_s)
                raise ConnectionAbortedError('the upload was aborted')
            finally:
                self._waiting.remove(waiter)
                if self._waiting:
                    self._next().turn.notify()

    # -- under the lock --------------------------------------------------------------------------------------------

    def _pause(self, waiter: _Waiter) -> float | None:
        """How long the waiter must wait; None if it is another one's turn."""
        if not self.max_mbps:
            return 0.0
        return self._free_at - self._now() if self._next() is waiter else None

    def _next(self) -> _Waiter:
        if self._pieces % OLDEST_EVERY == OLDEST_EVERY - 1:
            return self._waiting[0]
        return min(self._waiting, key=lambda waiter: waiter.rank)

    def _grant(self, size: int) -> None:
        self._sent_bytes += size
        self._pieces += 1
        if max_mbps := self.max_mbps:
            self._free_at = max(self._free_at, self._now() - LATE_S) + size / (max_mbps * BYTES_PER_MEGABIT)

    def _wake_all(self) -> None:
        for waiter in self._waiting:
            waiter.turn.notify()

    def _piece_bytes(self) -> int:
        max_mbps = self.max_mbps
        if not max_mbps:
            return LARGEST_PIECE
        return min(max(round(max_mbps * BYTES_PER_MEGABIT * PIECE_S), SMALLEST_PIECE), LARGEST_PIECE)
