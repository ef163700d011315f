"""Where room for what is kept runs short, rate goes before time: the oldest hour is halved, again and again, then the next."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from shadowhound_data_logger.core.clock import SECOND, iso
from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.core.options import BULK
from shadowhound_data_logger.spool.kept_objects import ThinnableObject, Thinned
from shadowhound_data_logger.spool.spool import Spool

log = logging.getLogger(__name__)

HOUR_NS: Final = 3600 * SECOND
WINDOW: Final = 4096
"""Objects of one pass, at most."""
TOLERANCE: Final = 0.99
"""Of a rate: times of messages are never quite even."""

Halve = Callable[[ThinnableObject], 'Thinned | None']
"""Half of the pictures and clouds in an object; None where there are none, or too few. Raises DataLoggerError, OSError."""


def may_halve(count: int, span_ns: float, min_hz: float) -> bool:
    """Whether half of so many messages in this time still come at this rate."""
    return count > 1 and -(-count // 2) * SECOND >= TOLERANCE * min_hz * span_ns


def span_of(count: int, first_ns: int, last_ns: int) -> float:
    """The time that so many messages stand for, the last one as long as those before it."""
    return (last_ns - first_ns) * count / max(count - 1, 1)


class Thinner:
    """Thins what a spool keeps, a little at each step.

    New; ``step`` from one thread. Requested or protected objects are not thinned. It remembers how far it came; a new one begins
    again with the oldest.
    """

    def __init__(self, spool: Spool, min_hz: float, halve: Halve) -> None:
        """Down to ``min_hz``; 0 thins nothing."""
        self._spool = spool
        self._min_hz = min_hz
        self._halve = halve
        self._work = self._all()

    def step(self) -> bool:
        """Thin an object, or a sensor's frames of an hour; False where there is room, or nothing to thin.

        Raises OSError or sqlite3.Error.
        """
        return bool(self._min_hz) and self._spool.kept.is_short() and next(self._work)

    def _all(self) -> Iterator[bool]:
        after = reported_ns = 0
        while True:
            window = self._window(after)
            if not window:
                yield False
                continue
            after = window[-1].id
            if window[0].t_start_ns >= reported_ns:  # what is new comes in small windows
                reported_ns = window[0].t_start_ns + HOUR_NS
                log.info('room for what is kept runs short: pictures and clouds of the hour from %s on are thinned, to %g Hz',
                         iso(window[0].t_start_ns), self._min_hz)  # fmt: skip
            while window:
                left: list[ThinnableObject] = []
                frames = defaultdict[str, list[ThinnableObject]](list)
                for item in window:
                    if item.samples == 1 and item.type in BULK:
                        frames[item.sensor].append(item)
                    elif (smaller := self._halved(item)) is not None:
                        left.append(smaller)
                        yield True
                for of_sensor in frames.values():
                    left += self._halve_frames(of_sensor)
                    yield True
                window = sorted(left, key=lambda item: item.id)

    def _window(self, after: int) -> list[ThinnableObject]:
        found = self._spool.kept.thinnable(after, WINDOW)
        return [item for item in found if item.t_start_ns < found[0].t_start_ns + HOUR_NS or item is found[0]]

    def _halved(self, item: ThinnableObject) -> ThinnableObject | None:
        try:
            thinned = self._halve(item)
        except (DataLoggerError, FileNotFoundError) as error:
            if item.path.exists():  # not evicted since
                log.warning('%s cannot be thinned: %s', item.path, error)
            return None
        return None if thinned is None else self._spool.kept.thin(item, thinned)

    def _halve_frames(self, frames: Sequence[ThinnableObject]) -> list[ThinnableObject]:
        """Every second one goes; what may lose half once more."""
        ordered = sorted(frames, key=lambda item: item.t_start_ns)
        span_ns = span_of(len(ordered), ordered[0].t_start_ns, ordered[-1].t_start_ns)
        if not may_halve(len(ordered), span_ns, self._min_hz):
            return []
        self._spool.kept.evict(ordered[1::2])
        return ordered[::2]
