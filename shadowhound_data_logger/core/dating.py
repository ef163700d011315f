"""Dates objects, bags and missions that began while the clock of this machine was not set.

A time before 2024 is a time of the boot clock. The difference of the two clocks converts it to UTC; it is known as soon as the
wall clock is set, and for an earlier boot if it was recorded during that boot. Until then everything without a date waits,
because a key, a name or a run cannot be dated again later. If the clock is not set for too long, or the boot ended before it
was, it is uploaded without a date.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND, Clock


@dataclass(frozen=True, slots=True)
class Dating:
    """The rule that dates objects, bags and missions. Stateless; use it from any thread."""

    clock: Clock
    hold_s: float
    """How long an object waits for its date."""
    offsets: Callable[[], Mapping[str, int]]
    """UTC minus boot clock of earlier boots of this machine, by boot id, where known."""

    def offset_ns(self, boot_id: str, since_ns: int) -> int | None:
        """What to add to the boot clock of that boot to get UTC, for something that has waited since ``since_ns``.

        None if it is not known yet: keep waiting. 0 if it will never be known: continue without a date.
        """
        if boot_id != self.clock.boot_id:
            return self.offsets().get(boot_id, 0)
        wall_ns, boot_ns = self.clock.wall_ns(), self.clock.boot_ns()
        if wall_ns >= EARLIEST_SANE_NS:
            return wall_ns - boot_ns
        return 0 if boot_ns - since_ns > self.hold_s * SECOND else None
