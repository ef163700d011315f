"""Dates missions that begin while the clock of this machine is not set, as spool/redating.py does objects.

Until it is set, records have the time of the boot clock, which shows: it is before 2024. The sender leaves such a mission where
it lies until the clock is set, because neither a run nor a key can be given another date later; then the difference of the
clocks is noted beside the journal (``clock.json``), once, and whoever reads the journal adds it. Where the clock is not set for
too long (``clock.hold_s``), or the boot ended before it was, the mission goes as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from shadowhound_data_logger.clock import EARLIEST_SANE_NS, SECOND, Clock
from shadowhound_data_logger.missions import journal
from shadowhound_data_logger.missions.folder import MissionFolder

WAITS: Final = 'the clock of this machine was not set when the mission began: it waits for its date'
REMEDY: Final = 'does it reach a time server? `timedatectl`'


def now_ns(clock: Clock) -> int:
    """UTC, or the time of the boot clock while nobody knows UTC."""
    wall_ns = clock.wall_ns()
    return wall_ns if wall_ns >= EARLIEST_SANE_NS else clock.boot_ns()


def waits(folder: MissionFolder) -> bool:
    """Whether a mission has no date yet. Raises OSError."""
    return int(journal.first(folder.journal).get('t', EARLIEST_SANE_NS)) < EARLIEST_SANE_NS and folder.clock_offset_ns() is None


@dataclass(frozen=True, slots=True)
class Dating:
    """Decides on the dates of missions; no state of its own."""

    clock: Clock
    hold_s: float
    """How long a mission waits for its date."""
    offsets: Callable[[], Mapping[str, int]]
    """UTC less boot clock of this machine's boots, by boot id, as far as that is known."""

    def settle(self, folder: MissionFolder) -> bool:
        """Whether the times of a mission are as good as they will ever be. Raises OSError."""
        if not waits(folder):
            return True
        start = journal.first(folder.journal)
        offset_ns = self.offset_ns(str(start.get('boot_id')), int(start['t']))
        if offset_ns is not None:
            folder.set_clock_offset_ns(offset_ns)
        return offset_ns is not None

    def offset_ns(self, boot_id: str, start_ns: int) -> int | None:
        """What makes UTC of the boot clock for what began at ``start_ns``; 0 where it will never be known, None where it may."""
        if boot_id != self.clock.boot_id:
            return self.offsets().get(boot_id, 0)
        wall_ns, boot_ns = self.clock.wall_ns(), self.clock.boot_ns()
        if wall_ns >= EARLIEST_SANE_NS:
            return wall_ns - boot_ns
        return 0 if boot_ns - start_ns > self.hold_s * SECOND else None
