"""An active mission, as the agent sees it: every method writes to the journal, returns within a millisecond and never raises.

What cannot be logged (not a number, a full disk) is counted in the mission's summary, with one warning per reason.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND, Clock
from shadowhound_data_logger.core.durable_files import sync
from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.missions import copies, values
from shadowhound_data_logger.missions.dating import now_ns
from shadowhound_data_logger.missions.folder import MISSIONS, MissionFolder, new_folder, stamped
from shadowhound_data_logger.missions.journal import Journal
from shadowhound_data_logger.missions.new_run import NewRun, RunRequests
from shadowhound_data_logger.missions.state import BATTERY, FAILED, FINISHED, TEMPERATURE
from shadowhound_data_logger.policies.folder import PolicyFolder

log = logging.getLogger(__name__)

MOST_FRAME_ARTIFACTS: Final = 500
"""Per run, because MLflow's page lists them all; the store has every frame."""


class Mission:
    """An active mission. Every method writes to the journal, returns within a millisecond, and never raises.

    What cannot be logged, such as a value that is not a number, is skipped and counted in the mission's summary, with one warning
    per reason.

    Lifecycle: created by MissionDataLogger; ``log_...`` from any thread; ``end`` once, after which calls only warn once.
    """

    # ``_lock`` guards the journal together with the list of what must be synced and the flag that the mission has ended.

    def __init__(self, folder: MissionFolder, journal: Journal, frame_artifact_every_s: float, clock: Clock,
                 policy: str | None = None, new_run: NewRun | None = None) -> None:  # fmt: skip
        self.folder = folder
        self.new_run = new_run
        """The run that this process creates; None if it leaves that to the sender."""
        self._clock = clock
        self._policies = PolicyFolder(folder.path.parents[1])
        self._policy = policy
        self._began_ns = clock.boot_ns()
        self._journal = journal
        self._frames = copies.Spares(folder.files)
        self._every_s = frame_artifact_every_s
        self._left = MOST_FRAME_ARTIFACTS
        self._next_s = float('-inf')
        self._lock = threading.Lock()
        self._numbers = count(1)
        self._lost = 0
        self._unsynced: list[Path] = []
        self._is_dirty = True
        self._warned: set[str] = set()
        self._ended = False

    def __repr__(self) -> str:
        return f'Mission({self.id!r}, {"ended" if self._ended else "active"})'

    @property
    def id(self) -> str:
        """The mission's own id, which does not depend on MLflow."""
        return self.folder.mission_id

    @property
    def run_id(self) -> str | None:
        """The MLflow run's id; None until the run is created."""
        run = (self.new_run and self.new_run.run) or self.folder.run()
        return run.run_id if run else None

    @property
    def is_active(self) -> bool:
        """Whether it has not ended yet."""
        return not self._ended

    def log_camera_frame(self, frame_data: Any, frame_id: int) -> None:
        """Log one image of the robot's camera. All of them are stored; a sample also becomes artifacts of the run.

        Args:
            frame_data: the bytes of a JPEG; or a uint8 array (height, width), (height, width, 3) RGB or (height, width, 4) RGBA,
                which this call encodes.
            frame_id: its number.
        """
        try:
            number = values.integer(frame_id, 'frame_id')
            data = values.jpeg(frame_data, f'frame {number}')
            if self._is_over():
                return
            self._append('frame', id=number, file=self._frames.write(data), artifact=self._is_sampled())
        except Rejected as error:
            self._refuse(error)
        except OSError as error:
            self._lose(error)

    def log_robot_state(self, battery_pct: float, temperature_c: float, step: int) -> None:
        """Log battery (percent) and temperature (degrees Celsius) as two metrics with the same time and step."""
        self._log({BATTERY: battery_pct, TEMPERATURE: temperature_c}, step)

    def log_metric(self, key: str, value: float, step: int | None = None) -> None:
        """Log one value of a metric. Without a step, the step is 0, as in MLflow."""
        self._log({key: value}, 0 if step is None else step)

    def log_event(self, name: str, /, **data: Any) -> None:
        """Log something that happened. The run's ``events.jsonl`` has all events; the summary also lists those named ``error``.

        Args:
            name: what happened, such as ``door_open``.
            data: details, as values that JSON can hold.
        """
        try:
            self._append('event', name=values.text(name, values.MAX_KEY), data=values.bounded(values.plain(data)))
        except Rejected as error:
            self._refuse(error)
        except OSError as error:
            self._lose(error)

    def log_trajectory(self, trajectory_csv_path: str | os.PathLike[str]) -> None:
        """Copy the current content of a CSV file with the header ``timestamp,x,y,yaw``. It is stored unchanged."""
        self._log_file('trajectory', trajectory_csv_path, {})

    def log_artifact(self, path: str | os.PathLike[str], artifact_path: str | None = None) -> None:
        """Copy the current content of a file to the run's artifacts, in the folder ``artifact_path``.

        A name that MLflow cannot hold, such as ``map#1.png``, is changed (``values.artifact_name``), with a warning; the summary
        has both names.
        """
        try:
            given = os.path.basename(os.fsdecode(path)) or 'artifact'  # noqa: PTH119 - a text, bytes or a Path
            more = {'name': values.artifact_name(given), 'folder': values.artifact_folder(artifact_path)}
            if (more['name'], more['folder']) != (given, artifact_path or ''):
                more['given'] = values.text(f'{artifact_path}/{given}' if artifact_path else given)
                self._warn('renamed', 'mission %s: the artifact %r is called %r in its run, because MLflow cannot hold that name',
                           self.id, more['given'], f'{more["folder"]}/{more["name"]}'.lstrip('/'))  # fmt: skip
        except Rejected as error:
            self._refuse(error)
        except TypeError as error:
            self._refuse(Rejected('no_file', str(error)))
        else:
            self._log_file('artifact', path, more)

    def end(self, success: bool = True, distance_m: float | None = None, duration_s: float | None = None, *,
            status: str | None = None, error: str | None = None) -> None:  # fmt: skip
        """End the mission. Values that are not given are measured.

        Args:
            success: True for FINISHED, False for FAILED.
            distance_m: the distance covered in meters.
            duration_s: the duration in seconds.
            status: another MLflow status, such as KILLED.
            error: why it failed.
        """
        elapsed_s = (self._clock.boot_ns() - self._began_ns) / SECOND
        stated: dict[str, Any] = {'success': values.boolean(success), 'elapsed_s': round(elapsed_s, 6)}
        for name, value in (('distance_m', distance_m), ('duration_s', duration_s)):
            try:
                stated[name] = None if value is None else values.number(value, name)
            except Rejected as refused:
                self._refuse(refused)
        stated['lost'] = self._lost
        if error:
            stated['error'] = values.text(error, values.MAX_PARAM)
        self._note_policy()
        try:
            self._append('end', status=status or (FINISHED if stated['success'] else FAILED), **stated)
        except OSError as refused:
            self._lose(refused)

    def close(self) -> None:
        """Sync and close the journal, after ``end``. MissionDataLogger calls it. Idempotent."""
        self.sync()
        self._frames.close()
        self._journal.close()

    def forget(self) -> None:
        """In a forked child: only the parent logs, and it owns the files that were made ahead."""
        self._lock, self._ended = threading.Lock(), True
        self._frames.forget()

    def sync(self) -> None:
        """Sync what was logged, and record a change of the policy. Called by the logger's thread; never raises OSError."""
        self._note_policy()
        with self._lock:
            files, self._unsynced = self._unsynced, []
            dirty, self._is_dirty = self._is_dirty, False
        if not dirty:
            return
        try:
            for path in (*files, *((self.folder.files,) if files else ())):
                with suppress(FileNotFoundError):  # the sender was faster: it is in the spool
                    sync(path)
            self._journal.sync()
        except OSError as error:
            self._lose(error)
        self._frames.fill()

    # -- within ----------------------------------------------------------------------------------------------------

    def _note_policy(self) -> None:
        """Record a change of the active policy."""
        now = self._policies.current()
        with self._lock:
            if now != self._policy and not self._ended:
                with suppress(OSError):  # the next sync tries again
                    self._journal.append({'k': 'policy', 't': now_ns(self._clock), 'policy': now})
                    self._policy, self._is_dirty = now, True

    def _log(self, metrics: Mapping[str, Any], step: Any) -> None:
        found: dict[str, float] = {}
        try:
            number = values.integer(step, 'step')
        except Rejected as error:
            self._refuse(error)
            return
        for key, value in metrics.items():
            try:
                found[values.metric_key(key)] = values.number(value, key)
            except Rejected as error:
                self._refuse(error)
        if found:
            try:
                self._append('metrics', m=found, s=number)
            except OSError as error:
                self._lose(error)

    def _log_file(self, kind: str, path: str | os.PathLike[str], more: Mapping[str, str]) -> None:
        if self._is_over():
            return
        name = f'{next(self._numbers):08d}'
        try:
            copies.copy(path, self.folder.files / name)
            self._append(kind, file=name, **more)
        except Rejected as error:
            self._refuse(error)
        except OSError as error:
            self._lose(error)

    def _append(self, kind: str, **fields: Any) -> None:
        record = {'k': kind, 't': now_ns(self._clock), **fields}
        with self._lock:
            ended = self._ended
            if not ended:
                self._ended = kind == 'end'
                self._journal.append(record)
                self._is_dirty = True
                if 'file' in fields:
                    self._unsynced.append(self.folder.files / fields['file'])
        if ended:
            self._is_over()

    def _is_over(self) -> bool:
        """Whether it has ended, with a warning: later calls must leave no file behind."""
        if self._ended:
            self._warn('ended', 'mission %s has ended: what is logged to it now is ignored', self.id)
        return self._ended

    def _is_sampled(self) -> bool:
        """Whether this frame also becomes an artifact of the run."""
        now_s = time.monotonic()
        with self._lock:
            if now_s < self._next_s or not self._left:
                return False
            self._next_s, self._left = now_s + self._every_s, self._left - 1
            return True

    def _refuse(self, error: Rejected) -> None:
        """Count in the journal what cannot be logged."""
        self._warn(error.reason, 'mission %s skips what cannot be logged: %s', self.id, error)
        try:
            self._append('refused', reason=error.reason)
        except OSError as full:
            self._lose(full)

    def _lose(self, error: OSError) -> None:
        """Count what a full disk loses: the mission continues."""
        with self._lock:
            self._lost += 1
        self._warn('lost', 'mission %s loses what is logged while the disk accepts no writes: %s', self.id, error)

    def _warn(self, reason: str, text: str, *values_: object) -> None:
        """Once per reason."""
        with self._lock:
            known = reason in self._warned
            self._warned.add(reason)
        if not known:
            log.warning(text, *values_)


@dataclass(frozen=True, slots=True)
class MissionStarter:
    """Starts the missions of one logger: what they have in common."""

    home: Path
    robot: str
    frame_artifact_every_s: float
    clock: Clock
    runs: RunRequests | None = None
    """Creates runs in this process."""

    def mission(self, mission_type: str, mission_command: str) -> Mission | None:
        """A new mission; None if the disk accepts no writes, which is logged."""
        time_ns, given = now_ns(self.clock), values.text(mission_type, values.MAX_TYPE)
        start = {'k': 'start', 't': time_ns, 'type': given, 'command': values.text(mission_command), 'robot': self.robot,
                 'pid': os.getpid()}  # fmt: skip
        if policy := PolicyFolder(self.home).current():
            start['policy'] = policy
        if time_ns < EARLIEST_SANE_NS:  # the boot to which this time belongs
            start['boot_id'] = self.clock.boot_id
        new_run = None
        try:
            folder = new_folder(self.home, given, time_ns)
            if self.runs is not None and time_ns >= EARLIEST_SANE_NS:
                with suppress(OSError):  # a file system that cannot lock folders: the sender creates the run
                    new_run = NewRun(folder)  # before the sender sees the journal
            journal = _new_journal(folder, start)
        except OSError as error:
            if new_run is not None:
                new_run.settle()
            log.error('the mission %.80s is not logged: %s', given, error)  # noqa: TRY400 - no defect
            return None
        if self.runs is not None and new_run is not None:
            self.runs.create(new_run, start)
        return Mission(folder, journal, self.frame_artifact_every_s, self.clock, policy, new_run)

    def nothing(self, mission_type: str) -> Mission:
        """An ended mission: all its calls do nothing. For a disk that accepts no writes."""
        name = stamped(values.text(mission_type, values.MAX_TYPE), now_ns(self.clock))
        folder = MissionFolder(self.home / MISSIONS / f'{name}_unlogged')
        mission = Mission(folder, Journal(folder.journal), 0.0, self.clock)
        mission.end()
        return mission


def _new_journal(folder: MissionFolder, start: dict[str, Any]) -> Journal:
    """A journal with its first record; closed again if the disk accepts no writes."""
    journal = Journal(folder.journal)
    journal.create()
    try:
        journal.append(start)
    except OSError:
        journal.close()
        raise
    return journal
