"""The node's part in a mission: finds the active one, logs the robot's state to its run, and marks objects with it.

It finds missions on the disk only. While none is active an encoder reads one attribute, and the thread one folder's time.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Final

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import SECOND, iso, now_ns
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.model import Batch, DataObject
from shadowhound_data_logger.core.status import MissionStatus
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.missions.active import THIS_MACHINE, ActiveMission, MissionFinder, ended
from shadowhound_data_logger.missions.node_log import NodeLog
from shadowhound_data_logger.node.encoding.encode_pool import BatchQueue
from shadowhound_data_logger.node.intake.intake import Intake
from shadowhound_data_logger.node.intake.sampling import Sampler
from shadowhound_data_logger.node.recording.mission_observer import MissionObserver
from shadowhound_data_logger.policies.folder import PolicyFolder

log = logging.getLogger(__name__)

LOOK_S: Final = 0.25
"""How late it detects a mission's start and end."""
WRITE_S: Final = 1.0
FLUSH_S: Final = 5.0
"""At the end of a mission, the time for its last messages to pass intake and encoders."""
PATIENCE_S: Final = 30.0
CLOSE_S: Final = 2.0


class MissionWatch:
    """Joins the robot's active mission: marks objects with it, and logs to its run.

    Lifecycle: New; open once; ``stop`` before the intake is closed, ``close`` after the encoders. Owns the thread ``mission``.

    ``mark`` and ``observe`` are called by the encoders; the mission that they see is replaced atomically.
    """

    def __init__(self, settings: Settings, intake: Intake, sampler: Sampler, queue: BatchQueue, observer: MissionObserver,
                 on_change: Callable[[MissionStatus], None]) -> None:  # fmt: skip
        """``on_change`` is called with ``status()`` whenever it changes."""
        self._settings = settings.mission
        self._intake = intake
        self._sampler = sampler
        self._queue = queue
        self._observer = observer
        self._on_change = on_change
        self._finder = MissionFinder(settings.home, settings.robot)
        self._policies = PolicyFolder(settings.home)
        self._mission: ActiveMission | None = None
        self._marks: Mapping[str, str] = {}
        self._last: tuple[ActiveMission, Mapping[str, str]] | None = None
        self._log: NodeLog | None = None
        self._due_s = 0.0
        self._wake = threading.Event()
        self.worker = Worker('mission', self._step, patience_s=PATIENCE_S)

    def open(self) -> None:
        """Call it before the intake is opened: with ``mission.capture: mission`` nothing is stored until a mission starts."""
        if self._settings.capture == 'mission':
            self._sampler.set_idle(idle=True)
        self.worker.start()

    def stop(self) -> None:
        """From now on the active mission does not change."""
        self.worker.stop()
        self._wake.set()
        self.worker.join(FLUSH_S)

    def close(self) -> None:
        """Write what is left; the next start of the node joins a mission that continues."""
        if self._log is not None:
            self._log.close()
            self._log = None

    def status(self) -> MissionStatus:
        """The active mission, as published on ``~/mission``; false if there is none."""
        mission = self._mission
        if mission is None:
            return MissionStatus()
        run_id, policy = self._marks.get(meta.RUN_ID), self._policies.current()
        return MissionStatus(mission.id, run_id, mission.mission_type, iso(mission.start_ns), policy)

    # -- for the encoders ------------------------------------------------------------------------------------------

    def mark(self, item: DataObject) -> DataObject:
        """The object with the ids of the mission that was active when it began."""
        mission, last = self._mission, self._last
        if mission is not None and mission.has(item.t_start_ns):
            return replace(item, metadata={**item.metadata, **self._marks})
        if last is not None and last[0].has(item.t_start_ns):  # it was in the pipeline when the mission ended
            return replace(item, metadata={**item.metadata, **last[1]})
        return item

    def observe(self, batch: Batch, item: DataObject | None) -> None:
        """Log facts from a batch; ``item`` is its encoded object."""
        node_log = self._log
        if node_log is not None:
            for fact in self._observer.facts(batch, item):
                node_log.add(fact)

    # -- the thread ------------------------------------------------------------------------------------------------

    def _step(self) -> None:
        found, before = self._finder.active(), self._mission
        if (found and found.id) != (before and before.id):
            if before is not None:
                self._leave(before)
            if found is not None:
                self._join(found)
        elif found is not None and meta.RUN_ID not in self._marks and self._find_run(found):
            self._on_change(self.status())
        if self._log is not None and time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + WRITE_S
            self._log.write()
        self._wake.wait(LOOK_S)

    def _join(self, mission: ActiveMission) -> None:
        """Join a mission: close the open batches first, so that no object spans its start."""
        self._marks = {meta.MISSION_ID: mission.id, meta.MISSION_TYPE: mission.mission_type}
        self._find_run(mission)
        if self._settings.join:
            node_log = NodeLog(mission, max(1, round(self._settings.period_s * SECOND)))
            try:
                node_log.open()
            except OSError as error:
                log.warning('nothing is logged to mission %s: %s', mission.id, error)
            else:
                self._log = node_log
        self._mission = mission
        if not self._set_idle(idle=False):
            log.warning('the intake did not begin mission %s within %.0f s; it will as soon as it can', mission.id, FLUSH_S)
        log.info('mission %s is active', mission.id)
        self._on_change(self.status())

    def _leave(self, mission: ActiveMission) -> None:
        """Leave a mission: close the open batches, so that all of it is encoded, and close its journal."""
        noticed_ns = now_ns(THIS_MACHINE)
        self._mission = over = ended(mission)
        end_s = time.monotonic() + FLUSH_S
        if not (self._set_idle(idle=True) and self._queue.finished(end_s - time.monotonic())):
            log.warning('not all of mission %s was encoded within %.0f s of its end', mission.id, FLUSH_S)
        node_log, self._log = self._log, None
        if node_log is not None:
            node_log.close(over)
        self._last = replace(over, end_ns=noticed_ns if over.end_ns is None else over.end_ns), self._marks
        self._mission, self._marks = None, {}
        log.info('mission %s has ended', mission.id)
        self._on_change(MissionStatus())

    def _set_idle(self, *, idle: bool) -> bool:
        if self._settings.capture == 'mission':
            return self._intake.flush(FLUSH_S, partial(self._sampler.set_idle, idle=idle))
        return self._intake.flush(FLUSH_S)

    def _find_run(self, mission: ActiveMission) -> bool:
        run = mission.folder.run()
        if run is not None:
            self._marks = {**self._marks, meta.RUN_ID: run.run_id}
        return run is not None
