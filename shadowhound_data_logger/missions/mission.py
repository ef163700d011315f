"""An active mission as the agent sees it, and how one is started."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND, Clock, now_ns
from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.missions import values
from shadowhound_data_logger.missions.folder import MISSIONS, MissionFolder, new_folder, timestamped_name
from shadowhound_data_logger.missions.journal import Journal
from shadowhound_data_logger.missions.new_run import NewRun, RunRequests
from shadowhound_data_logger.missions.recorder import MissionRecorder
from shadowhound_data_logger.missions.state import BATTERY, FAILED, FINISHED, TEMPERATURE
from shadowhound_data_logger.policies.folder import PolicyFolder

log = logging.getLogger(__name__)

MAX_FRAME_ARTIFACTS: Final = 500
"""Per run, because MLflow's page lists them all; the store has every frame."""


class Mission:
    """An active mission. Every method writes to the journal, returns within a millisecond, and never raises.

    Data that cannot be logged, such as a value that is not a number, is skipped and counted in the mission's summary, with one
    warning per reason.

    Lifecycle: created by MissionDataLogger; ``log_...`` from any thread; ``end`` once, after which calls only warn once.
    """

    def __init__(self, recorder: MissionRecorder, clock: Clock, frame_artifact_every_s: float,
                 new_run: NewRun | None = None) -> None:  # fmt: skip
        self.folder = recorder.folder
        self.new_run = new_run
        """The run that this process creates; None if the sender creates it."""
        self._recorder = recorder
        self._clock = clock
        self._start_ns = clock.boot_ns()
        self._sample_every_s = frame_artifact_every_s
        self._samples_left = MAX_FRAME_ARTIFACTS
        self._next_sample_s = float('-inf')
        self._lock = threading.Lock()  # guards the three above

    def __repr__(self) -> str:
        return f'Mission({self.id!r}, {"active" if self.is_active else "ended"})'

    @property
    def id(self) -> str:
        """The mission's own id, which does not depend on MLflow."""
        return self.folder.mission_id

    @property
    def run_id(self) -> str | None:
        """The id of the MLflow run; None until the run is created."""
        run = (self.new_run and self.new_run.run) or self.folder.run()
        return run.run_id if run else None

    @property
    def is_active(self) -> bool:
        """Whether the mission has not ended."""
        return not self._recorder.has_ended

    def log_camera_frame(self, frame_data: Any, frame_id: int) -> None:
        """Log one image of the robot's camera. All images are stored; a sample also becomes artifacts of the run.

        Args:
            frame_data: the bytes of a JPEG; or an array of uint8 in the shape (height, width), (height, width, 3) RGB or
                (height, width, 4) RGBA, which this call encodes: a numpy array, a Pillow image or another object that numpy can
                read.
            frame_id: the number of the image.
        """
        with self._recorder.counting_errors():
            number = values.integer(frame_id, 'frame_id')
            data = values.jpeg(frame_data, f'frame {number}')
            if not self._recorder.is_over():
                self._recorder.append_frame(data, id=number, artifact=self._is_sampled())

    def log_robot_state(self, battery_pct: float, temperature_c: float, step: int) -> None:
        """Log the battery's charge (percent) and the temperature (degrees Celsius) as two metrics of the same time."""
        self._log_metrics({BATTERY: battery_pct, TEMPERATURE: temperature_c}, step)

    def log_metric(self, key: str, value: float, step: int | None = None) -> None:
        """Log one value of a metric. The default step is 0, as in MLflow."""
        self._log_metrics({key: value}, 0 if step is None else step)

    def log_event(self, name: str, /, **data: Any) -> None:
        """Log an event. The run's ``events.jsonl`` has all events; the summary lists those named ``error`` as errors.

        Args:
            name: the kind of event, such as ``door_open``.
            data: details, as values that JSON can represent.
        """
        with self._recorder.counting_errors():
            self._recorder.append('event', name=values.text(name, values.MAX_KEY), data=values.bounded(values.plain(data)))

    def log_trajectory(self, trajectory_csv_path: str | os.PathLike[str]) -> None:
        """Copy the current content of a CSV file with the header ``timestamp,x,y,yaw``. It is stored unchanged."""
        self._log_file('trajectory', trajectory_csv_path, {})

    def log_artifact(self, path: str | os.PathLike[str], artifact_path: str | None = None) -> None:
        """Copy the current content of a file to the run's artifacts, in the folder ``artifact_path``.

        A name that MLflow does not accept, such as ``map#1.png``, is changed (``map=231.png``), with a warning; the summary has
        both names.
        """
        with self._recorder.counting_errors():
            try:
                given = os.path.basename(os.fsdecode(path)) or 'artifact'  # noqa: PTH119 - a text, bytes or a Path
            except TypeError as error:
                raise Rejected('no_file', str(error)) from error
            fields = {'name': values.artifact_name(given), 'folder': values.artifact_folder(artifact_path)}
            if (fields['name'], fields['folder']) != (given, artifact_path or ''):
                fields['given'] = values.text(f'{artifact_path}/{given}' if artifact_path else given)
                self._recorder.warn(
                    'renamed', 'mission %s: the artifact %r is named %r in the run, because MLflow does not accept its name',
                    self.id, fields['given'], f'{fields["folder"]}/{fields["name"]}'.lstrip('/'))  # fmt: skip
            self._log_file('artifact', path, fields)

    def end(self, success: bool = True, distance_m: float | None = None, duration_s: float | None = None, *,
            status: str | None = None, error: str | None = None) -> None:  # fmt: skip
        """End the mission. Values that are not given are measured.

        Args:
            success: True for FINISHED, False for FAILED.
            distance_m: the distance traveled, in meters.
            duration_s: the duration in seconds.
            status: another MLflow status, such as KILLED.
            error: why the mission failed.
        """
        elapsed_s = (self._clock.boot_ns() - self._start_ns) / SECOND
        stated: dict[str, Any] = {'success': values.boolean(success), 'elapsed_s': round(elapsed_s, 6)}
        for name, value in (('distance_m', distance_m), ('duration_s', duration_s)):
            with self._recorder.counting_errors():
                stated[name] = None if value is None else values.number(value, name)
        stated['lost'] = self._recorder.lost
        if error:
            stated['error'] = values.text(error, values.MAX_PARAM)
        self._recorder.record_policy_change()
        with self._recorder.counting_errors():
            self._recorder.append('end', status=status or (FINISHED if stated['success'] else FAILED), **stated)

    def sync(self) -> None:
        """Sync everything that was logged to disk. The logger's thread calls it ten times per second."""
        self._recorder.sync()

    def close(self) -> None:
        """Sync and close the journal, after ``end``. MissionDataLogger calls it. Idempotent."""
        self._recorder.close()

    def forget(self) -> None:
        """In a forked child: only the parent logs."""
        self._lock = threading.Lock()
        self._recorder.forget()

    def _log_metrics(self, metrics: Mapping[str, Any], step: Any) -> None:
        with self._recorder.counting_errors():
            number, found = values.integer(step, 'step'), {}
            for key, value in metrics.items():
                with self._recorder.counting_errors():  # the other metrics are still logged
                    found[values.metric_key(key)] = values.number(value, key)
            if found:
                self._recorder.append('metrics', m=found, s=number)

    def _log_file(self, kind: str, path: str | os.PathLike[str], fields: Mapping[str, str]) -> None:
        if not self._recorder.is_over():
            with self._recorder.counting_errors():
                self._recorder.append_copy(kind, path, **fields)

    def _is_sampled(self) -> bool:
        """Whether this frame also becomes an artifact of the run."""
        now_s = time.monotonic()
        with self._lock:
            if now_s < self._next_sample_s or not self._samples_left:
                return False
            self._next_sample_s, self._samples_left = now_s + self._sample_every_s, self._samples_left - 1
            return True


@dataclass(frozen=True, slots=True)
class MissionStarter:
    """Starts the missions of one logger, with the settings that they share."""

    home: Path
    robot: str
    frame_artifact_every_s: float
    clock: Clock
    runs: RunRequests | None = None
    """Creates runs in this process."""

    def start(self, mission_type: str, mission_command: str) -> Mission | None:
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
        recorder = MissionRecorder(folder, journal, self.clock, policy)
        return Mission(recorder, self.clock, self.frame_artifact_every_s, new_run)

    def unlogged(self, mission_type: str) -> Mission:
        """An ended mission, whose calls do nothing: for a disk that accepts no writes."""
        name = timestamped_name(values.text(mission_type, values.MAX_TYPE), now_ns(self.clock))
        folder = MissionFolder(self.home / MISSIONS / f'{name}_unlogged')
        mission = Mission(MissionRecorder(folder, Journal(folder.journal), self.clock), self.clock, 0.0)
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
