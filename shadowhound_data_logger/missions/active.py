"""Which mission is active: a folder whose journal its agent holds locked. Read from the disk, not from topics or processes.

Costs a stat of the folder and a lock's probe of what is active at each look.
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
"""Whatever its boot is called: what is compared here is of one."""


@dataclass(frozen=True, slots=True)
class Active:
    """A mission, active when it was looked at."""

    folder: MissionFolder
    mission_type: str
    start_ns: int
    end_ns: int | None = None
    """Known once it is over."""
    clock: Clock = THIS_MACHINE

    @property
    def id(self) -> str:
        return self.folder.mission_id

    def has(self, stamp_ns: int) -> bool:
        """Whether a time is one of the mission; so is UTC of another machine where this one never knew it."""
        is_before_end = self.end_ns is None or stamp_ns <= self.end_ns or self.end_ns < EARLIEST_SANE_NS <= stamp_ns
        return self.start_ns <= stamp_ns and is_before_end

    def since_start_ns(self, stamp_ns: int) -> int:
        """How long it had been going on, though the clock was set meanwhile."""
        if self.start_ns < EARLIEST_SANE_NS <= stamp_ns:
            stamp_ns -= self.clock.wall_ns() - self.clock.boot_ns()
        return stamp_ns - self.start_ns


class MissionFinder:
    """Finds a robot's active mission, of several the one that began last. Not thread-safe."""

    def __init__(self, home: Path, robot: str) -> None:
        self._home = home
        self._robot = robot
        self._known: set[str] = set()
        self._open: dict[str, MissionFolder] = {}  # those that are not over, or have no first record yet
        self._starts: dict[str, Mapping[str, Any]] = {}
        self._looked_ns = -1
        self._told = ''

    def look(self) -> Active | None:
        """The mission that is active now; None where the folder cannot be read, which is logged once."""
        try:
            self._find()
            found = [active for folder in tuple(self._open.values()) if (active := self._judge(folder))]
        except OSError as error:
            if str(error) != self._told:
                self._told = str(error)
                log.warning('cannot look for missions: %s', error)
            return None
        return max(found, key=lambda active: active.start_ns, default=None)

    def _find(self) -> None:
        """Take up what is new; once more after a change, because two changes may have one time."""
        try:
            changed_ns = os.stat(self._home / MISSIONS).st_mtime_ns  # noqa: PTH116 - several times a second
        except FileNotFoundError:
            return
        if changed_ns == self._looked_ns:
            return
        folders = {folder.mission_id: folder for folder in missions(self._home)}
        self._open |= {name: folder for name, folder in folders.items() if name not in self._known}
        if self._known.issuperset(folders):
            self._looked_ns = changed_ns
        self._known = set(folders)

    def _judge(self, folder: MissionFolder) -> Active | None:
        """None for one that is over, or not yet begun, or another robot's."""
        name = folder.mission_id
        try:
            start = self._starts.get(name) or journal.first(folder.journal)
            is_locked = journal.is_locked(folder.journal)  # after that: whoever wrote the first record had the lock before
        except FileNotFoundError:
            if name not in self._known:
                self._forget(name)
            return None
        if not start:
            return None
        if not is_locked or start.get('k') != 'start' or start.get('robot') != self._robot:
            self._forget(name)
            return None
        self._starts[name] = start
        return Active(folder, str(start['type']), int(start['t']))

    def _forget(self, name: str) -> None:
        del self._open[name]
        self._starts.pop(name, None)


def ended(active: Active) -> Active:
    """The same with its end: what the agent recorded; a dead agent's mission has none, and ends at ``None``."""
    try:
        end = journal.last(active.folder.journal)
    except OSError:
        end = {}
    end_ns = int(end['t']) if end.get('k') == 'end' else None
    return replace(active, end_ns=end_ns)
