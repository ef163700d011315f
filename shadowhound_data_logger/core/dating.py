"""Dates what began while the clock of this machine was not set: objects, bags and missions, all by the same rule.

A time before 2024 is one of the boot clock. What makes UTC of it is the difference of the two clocks, which is known as soon as
the wall clock is set; of an earlier boot it is known where somebody noted it while that lasted. Until then whatever has no date
waits, for a key, a name or a run cannot be given another date later. It does not wait forever: where the clock is not set for
too long, or the boot ended before it was, it goes without a date.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND, Clock


@dataclass(frozen=True, slots=True)
class Dating:
    """The rule by which objects, bags and missions get their dates.

    It has no state of its own; use it from any thread.
    """

    clock: Clock
    hold_s: float
    """How long something waits for its date."""
    offsets: Callable[[], Mapping[str, int]]
    """UTC less boot clock of earlier boots of this machine, by boot id, as far as that is known."""

    def offset_ns(self, boot_id: str, since_ns: int) -> int | None:
        """What makes UTC of the boot clock for what waits since then, by the clock of that boot.

        None where it is not known yet: it has to wait. 0 where nobody will ever know it: it goes without a date.
        """
        if boot_id != self.clock.boot_id:
            return self.offsets().get(boot_id, 0)
        wall_ns, boot_ns = self.clock.wall_ns(), self.clock.boot_ns()
        if wall_ns >= EARLIEST_SANE_NS:
            return wall_ns - boot_ns
        return 0 if boot_ns - since_ns > self.hold_s * SECOND else None
