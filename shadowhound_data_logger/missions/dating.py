"""Dates missions that started before the clock of this machine was set, by the rule of ``core/dating.py``.

Until the clock is set, records have the time of the boot clock, which is recognizable because it is before 2024. The sender holds
such a mission until the clock is set, because the date of a run or a key cannot be changed later. The offset between the clocks
is then written once next to the journal (``clock.json``), and readers of the journal add it.
"""

from __future__ import annotations

from typing import Final

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, Clock
from shadowhound_data_logger.core.dating import Dating
from shadowhound_data_logger.missions import journal
from shadowhound_data_logger.missions.folder import MissionFolder

NO_DATE: Final = 'the clock of this machine was not set when the mission started: it is sent once the clock is set'
REMEDY: Final = 'check with `timedatectl` that this machine reaches a time server'


def now_ns(clock: Clock) -> int:
    """UTC, or the time of the boot clock while UTC is unknown."""
    wall_ns = clock.wall_ns()
    return wall_ns if wall_ns >= EARLIEST_SANE_NS else clock.boot_ns()


def is_undated(folder: MissionFolder) -> bool:
    """Whether a mission has no date yet. Raises OSError."""
    return int(journal.first(folder.journal).get('t', EARLIEST_SANE_NS)) < EARLIEST_SANE_NS and folder.clock_offset_ns() is None


def assign_date(folder: MissionFolder, dating: Dating) -> bool:
    """Date a mission if possible; returns whether its times are final. Raises OSError."""
    if not is_undated(folder):
        return True
    start = journal.first(folder.journal)
    offset_ns = dating.offset_ns(str(start.get('boot_id')), int(start['t']))
    if offset_ns is not None:
        folder.set_clock_offset_ns(offset_ns)
    return offset_ns is not None
