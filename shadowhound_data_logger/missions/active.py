"""Finds the active mission: the one whose journal is locked by its agent. Reads the disk, not topics or processes.

Each poll takes one stat of the folder, and a probe of the lock of each active mission.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, Clock, SystemClock
from shadowhound_data_logger.missions import journal
from shadowhound_data_logger.missions.folder import MISSIONS, MissionFolder, missions

log = logging.getLogger(__name__)

THIS_MACHINE: Final = SystemClock('')
"""Without a boot id: only times of one boot are compared here."""


@dataclass(frozen=True, slots=True)
class ActiveMission:
    """A mission that was active when the disk was read."""

    folder: MissionFolder
    mission_type: str
    start_ns: int
    end_ns: int | None = None
    """None until it has ended."""
    clock: Clock = THIS_MACHINE

    @property
    def id(self) -> str:
        return self.folder.mission_id

    def has(self, stamp_ns: int) -> bool:
        """Whether a time is within the mission. If this machine never knew UTC, any UTC time of another machine is."""
        is_before_end = self.end_ns is None or stamp_ns <= self.end_ns or self.end_ns < EARLIEST_SANE_NS <= stamp_ns
        return self.start_ns <= stamp_ns and is_before_end

    def since_start_ns(self, stamp_ns: int) -> int:
        """The age of the mission at this time, even if the clock was set since the start."""
        if self.start_ns < EARLIEST_SANE_NS <= stamp_ns:
            stamp_ns -= self.clock.wall_ns() - self.clock.boot_ns()
        return stamp_ns - self.start_ns


class MissionFinder:
    """Finds the active mission of a robot, or of any (None); of several, the one that started last. Not thread-safe."""

    def __init__(self, home: Path, robot: str | None) -> None:
        self._home = home
        self._folder = home / MISSIONS
        self._robot = robot
        self._known: set[str] = set()
        self._open: dict[str, MissionFolder] = {}  # missions that have not ended, or have no first record yet
        self._starts: dict[str, Mapping[str, Any]] = {}
        self._listed_ns = -1
        self._logged_error = ''

    def active(self) -> ActiveMission | None:
        """The mission that is active now; None if the folder cannot be read, which is logged once."""
        try:
            self._find()
            found = [active for folder in tuple(self._open.values()) if (active := self._check(folder))]
        except OSError as error:
            if str(error) != self._logged_error:
                self._logged_error = str(error)
                log.warning('cannot read the missions: %s', error)
            return None
        return max(found, key=lambda active: active.start_ns, default=None)

    def _find(self) -> None:
        """Find new missions. List the folder once more after a change, because two changes may have the same time."""
        try:
            changed_ns = os.stat(self._folder).st_mtime_ns  # noqa: PTH116 - several times a second
        except FileNotFoundError:
            return
        if changed_ns == self._listed_ns:
            return
        folders = {folder.mission_id: folder for folder in missions(self._home)}
        self._open |= {name: folder for name, folder in folders.items() if name not in self._known}
        if self._known.issuperset(folders):
            self._listed_ns = changed_ns
        self._known = set(folders)

    def _check(self, folder: MissionFolder) -> ActiveMission | None:
        """None for a mission that has ended, has not started yet, or belongs to another robot."""
        name = folder.mission_id
        try:
            start = self._starts.get(name) or journal.first(folder.journal)
            is_locked = journal.is_locked(folder.journal)  # in this order: the lock is taken before the first record is written
        except FileNotFoundError:
            if name not in self._known:
                self._forget(name)
            return None
        if not start:
            return None
        if not is_locked or start.get('k') != 'start' or self._robot not in (None, start.get('robot')):
            self._forget(name)
            return None
        self._starts[name] = start
        return ActiveMission(folder, str(start['type']), int(start['t']))

    def _forget(self, name: str) -> None:
        del self._open[name]
        self._starts.pop(name, None)


def ended(active: ActiveMission) -> ActiveMission:
    """The same mission with the end time that the agent recorded; None if the agent was killed."""
    try:
        end = journal.last(active.folder.journal)
    except OSError:
        end = {}
    end_ns = int(end['t']) if end.get('k') == 'end' else None
    return replace(active, end_ns=end_ns)
