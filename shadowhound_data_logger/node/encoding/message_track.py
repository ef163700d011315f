"""Recent messages of a topic, verbatim; a message is deserialized when an encoder first asks for its time."""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from shadowhound_data_logger.core.clock import SECOND

SPAN_NS: Final = 60 * SECOND
"""How long messages are kept: batches, queues and slow encoders ask late."""


@dataclass(slots=True)
class _Kept:
    """A message and, once read, its value."""

    stamp_ns: int
    cdr: bytes
    value: Any = None


class MessageTrack:
    """Messages of one topic and type: one per ``every_ns``, and the newest. One thread adds, any reads; ``_lock`` guards."""

    def __init__(self, every_ns: int, type_name: str, read: Callable[[str, bytes], Any]) -> None:
        """``read`` converts a message to a value; None if it has none."""
        self._every_ns = every_ns
        self.type = type_name
        self._read = read
        self._lock = threading.Lock()
        self._stamps: list[int] = []
        self._kept: list[_Kept] = []

    def add(self, stamp_ns: int, cdr: bytes) -> None:
        """Add a message, in order of time; after a backward clock step the track starts again."""
        with self._lock:
            stamps, kept = self._stamps, self._kept
            if stamps and stamp_ns <= stamps[-1]:
                if stamps[-1] - stamp_ns < SECOND:
                    return
                stamps.clear()
                kept.clear()
            if len(stamps) > 1 and stamps[-1] - stamps[-2] < self._every_ns:
                stamps[-1], kept[-1] = stamp_ns, _Kept(stamp_ns, cdr)
                return
            stamps.append(stamp_ns)
            kept.append(_Kept(stamp_ns, cdr))
            if stamp_ns - stamps[0] > 2 * SPAN_NS:
                old = bisect_left(stamps, stamp_ns - SPAN_NS)
                del stamps[:old], kept[:old]

    def nearby(self, stamp_ns: int) -> list[tuple[int, Any]]:
        """(time, value) of the two messages around a time; at an end of the track the last two, or the only one."""
        with self._lock:
            after = bisect_left(self._stamps, stamp_ns)
            first = max(0, min(after - 1, len(self._stamps) - 2))
            found = self._kept[first : first + 2]
            if after == len(self._stamps) > 2 and self._stamps[-1] - self._stamps[-2] < self._every_ns // 2:
                found[0] = self._kept[-3]  # too close to each other for a speed
        return [(kept.stamp_ns, value) for kept in found if (value := self._value(kept)) is not None]

    @property
    def newest_ns(self) -> int:
        """The time of the newest message; 0 before the first."""
        with self._lock:
            return self._stamps[-1] if self._stamps else 0

    def newest(self) -> Any:
        """The value of the newest message; None if it has none."""
        with self._lock:
            found = self._kept[-1] if self._kept else None
        return None if found is None else self._value(found)

    def _value(self, kept: _Kept) -> Any:
        if kept.value is None:
            kept.value = self._read(self.type, kept.cdr)
        return kept.value
