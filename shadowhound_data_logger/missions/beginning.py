"""How a mission begins: its folder, its journal with the first record; or none of it where the disk takes nothing."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shadowhound_data_logger.clock import EARLIEST_SANE_NS, Clock
from shadowhound_data_logger.missions import values
from shadowhound_data_logger.missions.dating import now_ns
from shadowhound_data_logger.missions.folder import FOLDER, MissionFolder, new_folder, safe_type, stamped
from shadowhound_data_logger.missions.journal import Journal
from shadowhound_data_logger.missions.recorder import Mission

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Beginning:
    """What all missions of one logger have in common."""

    home: Path
    robot: str
    frame_artifact_every_s: float
    clock: Clock

    def mission(self, mission_type: str, mission_command: str) -> Mission | None:
        """A new one; None when the disk does not take it, which is said."""
        time_ns, given = now_ns(self.clock), values.text(mission_type, values.MAX_PARAM)
        if safe_type(given) != given:
            log.warning('the mission type %.80r cannot stand in names: %s stands there', given, safe_type(given))
        start = {'k': 'start', 't': time_ns, 'type': given, 'command': values.text(mission_command), 'robot': self.robot,
                 'pid': os.getpid()}  # fmt: skip
        if time_ns < EARLIEST_SANE_NS:  # of which boot the clock is that this time is of
            start['boot_id'] = self.clock.boot_id
        try:
            folder = new_folder(self.home, given, time_ns)
            journal = _begun(folder, start)
        except OSError as error:
            log.error('the mission %.80s is not logged: %s', given, error)  # noqa: TRY400 - no defect
            return None
        return Mission(folder, journal, self.frame_artifact_every_s, self.clock)

    def nothing(self, mission_type: str) -> Mission:
        """A mission that is over: all its calls do nothing. For a disk that takes no journal."""
        name = stamped(values.text(mission_type, values.MAX_PARAM), now_ns(self.clock))
        folder = MissionFolder(self.home / FOLDER / f'{name}_unlogged')
        mission = Mission(folder, Journal(folder.journal), 0.0, self.clock)
        mission.end()
        return mission


def _begun(folder: MissionFolder, start: dict[str, Any]) -> Journal:
    """A journal with its first record; nothing is left open when the disk does not take it."""
    journal = Journal(folder.journal)
    journal.create()
    try:
        journal.append(start)
    except OSError:
        journal.close()
        raise
    return journal
