"""Compares the wall clock with the boot clock: whether it was ever set, when it steps, and how boot times become UTC.

A robot without a battery for its clock starts in 1970 (or in the year of its image) and learns the time minutes later, or
never. The boot clock never steps; the difference between the two changes when the wall clock is set.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND, Clock
from shadowhound_data_logger.core.status import ClockState

log = logging.getLogger(__name__)

STEP_NS: Final = SECOND
"""A slewed clock (at most 0.5 ms per second) never moves this far between two polls."""


@dataclass(frozen=True, slots=True)
class UtcOffsets:
    """UTC minus the boot clock, for objects, bags and missions that began while the clock was not set. Stateless.

    A time before 2024 is a time of the boot clock. Its offset is known as soon as the wall clock is set, and for an earlier boot
    if it was recorded during that boot. Until then everything without a date waits, because a key, a name or a run cannot be
    changed later. If the clock is not set for too long, or the boot ended before it was, it is uploaded without a date.
    """

    clock: Clock
    hold_s: float
    """How long an object waits for its date."""
    recorded: Callable[[], Mapping[str, int]]
    """The offsets of earlier boots of this machine, by boot id, where known."""

    def of(self, boot_id: str, since_ns: int) -> int | None:
        """What to add to the boot clock of that boot to get UTC, for something that has waited since ``since_ns``.

        None if it is not known yet: keep waiting. 0 if it will never be known: continue without a date.
        """
        if boot_id != self.clock.boot_id:
            return self.recorded().get(boot_id, 0)
        wall_ns, boot_ns = self.clock.wall_ns(), self.clock.boot_ns()
        if wall_ns >= EARLIEST_SANE_NS:
            return wall_ns - boot_ns
        return 0 if boot_ns - since_ns > self.hold_s * SECOND else None


class ClockWatch:
    """A Clock that reports whether it can be trusted. New; call ``poll`` once per second on one thread, the rest on any thread.

    ``_lock`` guards the results of the last poll. ``steps`` counts the steps seen by earlier processes.
    """

    def __init__(self, clock: Clock, hold_s: float, steps: int = 0) -> None:
        self._clock = clock
        self.hold_s = hold_s
        self._hold_ns = round(hold_s * SECOND)
        self._lock = threading.Lock()
        self._offset_ns = clock.wall_ns() - clock.boot_ns()
        self._unset_since_ns = clock.boot_ns()
        self._was_set = self.is_set
        self._warned = self._gave_up = False
        self._steps = steps
        self._last_step_ns: int | None = None
        self._stepped_ns = 0

    @property
    def boot_id(self) -> str:
        return self._clock.boot_id

    def wall_ns(self) -> int:
        return self._clock.wall_ns()

    def boot_ns(self) -> int:
        return self._clock.boot_ns()

    @property
    def unset_since_ns(self) -> int:
        """Since when the clock has not been set, by the boot clock, as far as this process knows. Meaningless while it is set."""
        with self._lock:
            return self._unset_since_ns

    @property
    def is_set(self) -> bool:
        return self._clock.wall_ns() >= EARLIEST_SANE_NS

    def offset_ns(self) -> int | None:
        """UTC minus boot clock; None while the clock is not set."""
        wall_ns = self._clock.wall_ns()
        return wall_ns - self._clock.boot_ns() if wall_ns >= EARLIEST_SANE_NS else None

    def state(self) -> ClockState:
        with self._lock:
            now_ns, is_set = self._clock.boot_ns(), self.is_set
            unset_ns = 0 if is_set else now_ns - self._unset_since_ns
            step, age_s = self._last_step_ns, round((now_ns - self._stepped_ns) / SECOND, 1)
            return ClockState(is_set, unset_ns > self._hold_ns, round(unset_ns / SECOND, 1), self._steps,
                              None if step is None else round(step / SECOND, 3), None if step is None else age_s)  # fmt: skip

    def poll(self) -> bool:
        """Compare with the last poll and log what changed; return whether anything did."""
        with self._lock:
            was_set, self._was_set = self._was_set, self.is_set
            before_ns, self._offset_ns = self._offset_ns, self._clock.wall_ns() - self._clock.boot_ns()
            step_ns = self._offset_ns - before_ns
            stepped = abs(step_ns) > STEP_NS
            if was_set and not self._was_set:
                self._unset_since_ns = self._clock.boot_ns()
            if stepped:
                self._steps += 1
                self._last_step_ns, self._stepped_ns = step_ns, self._clock.boot_ns()
        self._log_changes(step_ns if stepped else None, was_set=was_set)
        return stepped or was_set != self._was_set

    def _log_changes(self, step_ns: int | None, *, was_set: bool) -> None:
        state = self.state()
        if state.is_set and not was_set:
            log.warning('the clock was set; it stepped by %.3f s', (step_ns or 0) / SECOND)
        elif step_ns is not None:
            log.warning('the clock stepped by %.3f s', step_ns / SECOND)
        if not state.is_set and not self._warned:
            log.warning('the clock of this machine is not set: objects wait up to %.0f s for their date; does it reach a time'
                        ' server? `timedatectl`', self._hold_ns / SECOND)  # fmt: skip
        if state.gave_up and not self._gave_up:
            log.warning('the clock was not set for %.0f s: objects are uploaded under _unsynced/%s', state.unset_s, self.boot_id)
        self._warned, self._gave_up = not state.is_set, state.gave_up
