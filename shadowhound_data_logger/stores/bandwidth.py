"""How fast payload is sent: one token bucket for all puts of a store, so that the radio stays free for the robot.

Under a cap a body leaves in small pieces, each when its time has come: never at line rate with silence afterwards. The most
important body goes first, but each fourth piece is of the one that waited longest: none starves, and no server gives up on one.
"""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, Protocol

PIECE_S: Final = 0.02
"""Time on the radio that one piece takes at the cap: what a control message may have to wait for."""
SMALLEST_PIECE: Final = 1 << 10
LARGEST_PIECE: Final = 1 << 16
"""Without a cap, too: a socket's timeout is over one piece, so the slowest link that works carries 64 KiB in that time."""
LATE_S: Final = 0.05
"""So much of the cap a thread that woke late may catch up with."""
LONGEST_EVERY: Final = 4
BYTES_PER_MEGABIT: Final = 125_000


class Body(Protocol):
    """What is sent: a file, or a part of one."""

    def seek(self, place: int, /) -> int: ...

    def read(self, size: int, /) -> bytes: ...


class PacedBody:
    """A body that is read once, from its start to its end: each ``read`` waits until its piece may leave."""

    def __init__(self, pieces: Iterator[bytes]) -> None:
        self._pieces = pieces

    def read(self, _: int = -1, /) -> bytes:
        """The next piece, of any size; empty at the end. Raises ConnectionAbortedError as ``Pace.pieces``."""
        return next(self._pieces, b'')


@dataclass(frozen=True, slots=True, eq=False)
class _Waiter:
    """One body that wants to send its next piece."""

    rank: tuple[int, bool, int]
    """Priority, whether it stands back, order of arrival: the smallest goes first."""
    turn: threading.Condition


class Pace:
    """Limits how fast all puts of a store send, together.

    Thread-safe: ``_lock`` guards all of it, and each waiter's condition is one of this lock.
    """

    def __init__(self, max_mbps: float = 0.0, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._now = monotonic
        self._lock = threading.Lock()
        self._waiting: list[_Waiter] = []  # who waits longest first
        self._max_mbps = 0.0
        self._yielded_mbps = 0.0
        self._yields_until = 0.0
        self._free_at = 0.0  # when the next piece may leave
        self._bodies = self._pieces = self._sent_bytes = self._abandoned = 0
        self.set(max_mbps)

    def __repr__(self) -> str:
        return f'Pace({self.max_mbps:g} Mbit/s)' if self.max_mbps else 'Pace(no cap)'

    def set(self, max_mbps: float) -> None:
        """The cap in megabits a second of payload, 0 for none; at once, for bodies under way as well."""
        if not 0.0 <= max_mbps < float('inf'):
            raise ValueError(f'{max_mbps} Mbit/s is not a cap')
        with self._lock:
            self._max_mbps = max_mbps
            self._free_at = self._now()
            self._wake_all()

    def yield_to(self, max_mbps: float, seconds: float) -> None:
        """For so long no more than this, whatever the cap is: it ends by itself, and a later call takes its place."""
        if not 0.0 < max_mbps < float('inf'):
            raise ValueError(f'{max_mbps} Mbit/s is not a cap')
        with self._lock:
            self._yielded_mbps = max_mbps
            self._yields_until = self._now() + seconds
            self._wake_all()

    @property
    def max_mbps(self) -> float:
        """The cap that is in force now; 0 for none."""
        if self._now() >= self._yields_until:
            return self._max_mbps
        return min(self._max_mbps or self._yielded_mbps, self._yielded_mbps)

    @property
    def sent_bytes(self) -> int:
        """Payload bytes that left since this was made: repeats among them, headers not."""
        return self._sent_bytes

    def bytes_in(self, seconds: float) -> float:
        """What the cap lets leave in that time; infinite without one."""
        return self.max_mbps * BYTES_PER_MEGABIT * seconds or float('inf')

    def count(self, size: int) -> None:
        """So many bytes left by a way that knows no cap."""
        with self._lock:
            self._sent_bytes += size

    def body(self, body: bytes | Body, priority: int, *, stands_back: bool = False) -> PacedBody:
        """The body as a file for an HTTP client: ``pieces`` of it, read once."""
        return PacedBody(self.pieces(body, priority, stands_back=stands_back))

    def pieces(self, body: bytes | Body, priority: int, *, stands_back: bool = False) -> Iterator[bytes]:
        """The whole body, each piece when it may leave. Raises ConnectionAbortedError after a later ``abandon``.

        One that ``stands_back`` comes after all others of its priority, for it is one of very many.
        """
        with self._lock:
            self._bodies += 1
            return self._leave(body, (priority, stands_back, self._bodies), self._abandoned)

    def abandon(self) -> None:
        """No piece leaves any more of the bodies that are under way."""
        with self._lock:
            self._abandoned += 1
            self._wake_all()

    def _leave(self, body: bytes | Body, rank: tuple[int, bool, int], abandoned: int) -> Iterator[bytes]:
        file = io.BytesIO(body) if isinstance(body, bytes) else body
        file.seek(0)
        while piece := file.read(self._piece_bytes()):
            self._take(len(piece), rank, abandoned)
            yield piece

    def _take(self, size: int, rank: tuple[int, bool, int], abandoned: int) -> None:
        """Wait until so many bytes of the body may leave."""
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
                raise ConnectionAbortedError('the upload was given up')
            finally:
                self._waiting.remove(waiter)
                if self._waiting:
                    self._next().turn.notify()

    # -- under the lock --------------------------------------------------------------------------------------------

    def _pause(self, waiter: _Waiter) -> float | None:
        """How long the waiter has to wait; None when it is another one's turn."""
        if not self.max_mbps:
            return 0.0
        return self._free_at - self._now() if self._next() is waiter else None

    def _next(self) -> _Waiter:
        if self._pieces % LONGEST_EVERY == LONGEST_EVERY - 1:
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
