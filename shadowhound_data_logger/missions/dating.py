"""Dates missions that begin while the clock of this machine is not set, by the rule of ``dating.py``.

Until it is set, records have the time of the boot clock, which shows: it is before 2024. The sender leaves such a mission where
it lies until the clock is set, because neither a run nor a key can be given another date later; then the difference of the
clocks is noted beside the journal (``clock.json``), once, and whoever reads the journal adds it.
"""

from __future__ import annotations

from typing import Final

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, Clock
from shadowhound_data_logger.core.dating import Dating
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


def give_date(folder: MissionFolder, dating: Dating) -> bool:
    """Whether the times of a mission are as good as they will ever be. Raises OSError."""
    if not waits(folder):
        return True
    start = journal.first(folder.journal)
    offset_ns = dating.offset_ns(str(start.get('boot_id')), int(start['t']))
    if offset_ns is not None:
        folder.set_clock_offset_ns(offset_ns)
    return offset_ns is not None
