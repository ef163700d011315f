"""Dates missions that start while the clock of this machine is not set, by the rule of ``core/dating.py``.

Until it is set, records have the time of the boot clock, recognizable because it is before 2024. The sender does not send such a
mission until the clock is set, because the date of a run or a key cannot be changed later; then the difference between the
clocks is written next to the journal (``clock.json``), once, and readers of the journal add it.
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
    """UTC, or the time of the boot clock while UTC is unknown."""
    wall_ns = clock.wall_ns()
    return wall_ns if wall_ns >= EARLIEST_SANE_NS else clock.boot_ns()


def waits(folder: MissionFolder) -> bool:
    """Whether a mission has no date yet. Raises OSError."""
    return int(journal.first(folder.journal).get('t', EARLIEST_SANE_NS)) < EARLIEST_SANE_NS and folder.clock_offset_ns() is None


def give_date(folder: MissionFolder, dating: Dating) -> bool:
    """Whether the times of a mission are final. Raises OSError."""
    if not waits(folder):
        return True
    start = journal.first(folder.journal)
    offset_ns = dating.offset_ns(str(start.get('boot_id')), int(start['t']))
    if offset_ns is not None:
        folder.set_clock_offset_ns(offset_ns)
    return offset_ns is not None
