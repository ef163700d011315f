"""What triggers events by itself: a number that crosses a threshold, or what a mission's agent logs. Plain Python."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

from shadowhound_data_logger.conditions import Condition
from shadowhound_data_logger.missions import journal

REARM_S: Final = 1.0
"""Shortest time in which a condition must not hold before it triggers again."""
LATE_NS: Final = 10 * 10**9
"""What an agent logged longer ago is no trigger: the node has just been started, or the clock was set."""


class Judge:
    """Watches one condition. New; ``look`` at one number after the other. One thread.

    It triggers once it has held for its time, and again only after it has not held for as long, a second at least: a number
    that trembles about its threshold makes one event.
    """

    def __init__(self, condition: Condition) -> None:
        self.condition = condition
        self._armed = True
        self._since_s: float | None = None
        """Since when it is as it is now: true while armed, false else; None while it is the other way round."""

    def look(self, value: float, now_s: float) -> bool:
        """Whether this number, of that time by the monotonic clock, triggers. One that is none (NaN) tells nothing."""
        if not math.isfinite(value):
            return False
        if self.condition.holds(value) is not self._armed:
            self._since_s = None
            return False
        if self._since_s is None:
            self._since_s = now_s
        hold_s = self.condition.hold_s if self._armed else max(self.condition.hold_s, REARM_S)
        if now_s - self._since_s < hold_s:
            return False
        self._armed, self._since_s = not self._armed, None
        return not self._armed


class Logged(NamedTuple):
    """What an agent said with ``log_event``."""

    name: str
    age_ns: int
    """How long ago it was said."""
    data: Any


class JournalTail:
    """What comes new into the journal of a mission. New; ``new`` again and again. One thread."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0

    def new(self, now_ns: int) -> Iterator[Logged]:
        """The events since the last call; what was logged long ago is left out. A journal that cannot be read has none."""
        try:
            if self._path.stat().st_size <= self._offset:
                return
            for line in journal.read(self._path, self._offset):
                self._offset = line.end
                record = line.record or {}
                if record.get('k') == 'event':
                    age_ns = now_ns - int(record['t'])
                    if age_ns <= LATE_NS:
                        yield Logged(str(record['name']), max(0, age_ns), record.get('data'))
        except OSError:
            return
