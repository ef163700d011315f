"""MissionDataLogger, the mission agent's API. No call waits for Tower or raises because of it.

logger = MissionDataLogger()
with logger.mission('patrol', 'go round the house') as mission:
    mission.log_robot_state(battery_pct=87.0, temperature_c=41.0, step=0)
"""

from __future__ import annotations

import logging
import os
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import home as home_of
from shadowhound_data_logger.core.errors import NameRefused, SettingError
from shadowhound_data_logger.core.keys import check_name
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.missions.child import Replayer
from shadowhound_data_logger.missions.folder import MissionFolder
from shadowhound_data_logger.missions.mission import Mission, MissionStarter
from shadowhound_data_logger.missions.new_run import RunRequests
from shadowhound_data_logger.missions.overview import Report, has_arrived, report, sizes
from shadowhound_data_logger.missions.state import FAILED, KILLED
from shadowhound_data_logger.missions.values import text
from shadowhound_data_logger.spool.local_robot import robot_of_recorder

log = logging.getLogger(__name__)

SYNC_S: Final = 0.1
"""How often the journal is synced: even with a slow fsync, a record is on disk after 250 ms."""
IDLE_S: Final = 1.0
POLL_S: Final = 0.01
CLOSE_S: Final = 5.0


class MissionDataLogger:
    """Logs the missions of one agent, one mission at a time. No call waits for a server or raises because of one.

    Each call writes to a journal on disk before it returns. A child process, the sender, delivers the journal to MLflow and the
    store, and keeps running after the agent exits until everything is sent. In a frozen or embedded program, which has no
    interpreter to start, missions are only journaled, with one warning. All methods may be called from any thread.

    Lifecycle: New; any number of missions; ``close`` once, or never.
    """

    # ``_lock`` guards the active mission.

    def __init__(
        self, *, robot: str | None = None, home: str | os.PathLike[str] | None = None, tracking_uri: str | None = None,
        experiment: str | None = None, start_timeout_s: float = 2.0, frame_artifact_every_s: float = 5.0,
        replay: bool = True,
    ) -> None:  # fmt: skip
        """Start the sender and the thread that syncs journals.

        Args:
            robot: the robot's name, the first part of every key. By default ``SHADOWHOUND_ROBOT``, otherwise the robot whose node
                has run on this machine, otherwise, with a warning, the name that a node here would have.
            home: the folder of journals and spool. By default ``SHADOWHOUND_HOME``, otherwise ``~/.shadowhound``.
            tracking_uri: the MLflow server. By default ``MLFLOW_TRACKING_URI``, otherwise a SQLite file in ``home``.
            experiment: the MLflow experiment. By default ``ROBOT_missions``.
            start_timeout_s: the longest that the start of a mission waits for the run's id.
            frame_artifact_every_s: one camera frame per this many seconds becomes an artifact of the run; the store gets all
                frames.
            replay: False only writes journals; another logger with the same home sends them.

        Raises:
            SettingError: an argument or variable is invalid, such as a robot name that cannot be part of a key.
        """
        uri = _text('tracking_uri', tracking_uri)
        environ = dict(os.environ) | ({'MLFLOW_TRACKING_URI': uri} if uri else {})
        self.home = _home(environ | ({'SHADOWHOUND_HOME': given} if (given := _text('home', home)) else {}))
        self.robot = _robot(_text('robot', robot) or robot_of_recorder(environ, self.home / 'spool'))
        experiment = _text('experiment', experiment) or f'{self.robot}_missions'
        self._environ = environ | {'SHADOWHOUND_ROBOT': self.robot}
        self._start_timeout_s = _seconds('start_timeout_s', start_timeout_s)
        every_s = _seconds('frame_artifact_every_s', frame_artifact_every_s)
        self._runs = RunRequests(self._environ, experiment) if replay and RunRequests.is_supported(self._environ) else None
        self._starter = MissionStarter(self.home, self.robot, every_s, SystemClock.of_this_machine(), self._runs)
        self._lock = threading.RLock()  # guards the active mission
        self._mission: Mission | None = None
        self._ended: list[Mission] = []
        self._newest: MissionFolder | None = None
        self._warned: set[str] = set()
        self._wake = threading.Event()
        self._replayer = Replayer(self.home, experiment, self._environ) if replay else None
        self._worker = Worker('missions', self._step)
        self._closed = False
        _alive.add(self)
        if self._runs:
            self._runs.prepare()
        if self._replayer:
            self._replayer.start()
            if self._runs is None:  # only the sender can create runs
                self._replayer.wake()
        self._worker.start()

    def __repr__(self) -> str:
        return f'MissionDataLogger(robot={self.robot!r}, home={str(self.home)!r}, mission={self._mission!r})'

    # -- start and end ---------------------------------------------------------------------------------------------

    def start_mission(self, mission_type: str, mission_command: str) -> str:
        """Start a mission. If another one is active, it ends as KILLED.

        Args:
            mission_type: such as ``patrol``; at most 128 characters. In keys and file names, characters other than A-Z, a-z, 0-9,
                ``_``, ``-`` and ``.`` are replaced.
            mission_command: the robot's task, as free text.

        Returns:
            The MLflow run's id, or the mission's own id if no server answers within ``start_timeout_s``. Both identify the
            mission: the run has the tag ``shadowhound.mission_id``, and ``missions/MISSION_ID/run.json`` has the run's id.
        """
        mission = self._start(mission_type, mission_command)
        return mission.run_id or mission.id

    @contextmanager
    def mission(self, mission_type: str, mission_command: str) -> Iterator[Mission]:
        """A mission as a context manager, which yields the ``Mission``.

        The mission ends as FINISHED. An exception ends it as FAILED, is recorded in it, and propagates.
        """
        mission = self._start(mission_type, mission_command)
        try:
            yield mission
        except BaseException as error:
            message = text(error)
            mission.log_event('exception', type=type(error).__name__, text=message)
            mission.end(success=False, status=FAILED, error=f'{type(error).__name__}: {message}')
            raise
        else:
            mission.end(success=True)
        finally:
            self._detach(mission)

    def end_mission(self, success: bool, distance_m: float, duration_s: float) -> None:
        """End the active mission.

        Args:
            success: True for FINISHED, False for FAILED.
            distance_m: the distance covered in meters; 0 for what the node measured.
            duration_s: the duration in seconds; 0 for the measured one.
        """
        if mission := self._active('end_mission'):
            mission.end(success, distance_m, duration_s)
            self._detach(mission)

    # -- logging to the active mission -----------------------------------------------------------------------------

    def log_camera_frame(self, frame_data: Any, frame_id: int) -> None:
        """As ``Mission.log_camera_frame``, for the active mission. Without one, do nothing but warn once."""
        if mission := self._active('log_camera_frame'):
            mission.log_camera_frame(frame_data, frame_id)

    def log_robot_state(self, battery_pct: float, temperature_c: float, step: int) -> None:
        """As ``Mission.log_robot_state``, for the active mission."""
        if mission := self._active('log_robot_state'):
            mission.log_robot_state(battery_pct, temperature_c, step)

    def log_trajectory(self, trajectory_csv_path: str | os.PathLike[str]) -> None:
        """As ``Mission.log_trajectory``, for the active mission."""
        if mission := self._active('log_trajectory'):
            mission.log_trajectory(trajectory_csv_path)

    def log_metric(self, key: str, value: float, step: int | None = None) -> None:
        """As ``Mission.log_metric``, for the active mission."""
        if mission := self._active('log_metric'):
            mission.log_metric(key, value, step)

    def log_event(self, name: str, /, **data: Any) -> None:
        """As ``Mission.log_event``, for the active mission."""
        if mission := self._active('log_event'):
            mission.log_event(name, **data)

    def log_artifact(self, path: str | os.PathLike[str], artifact_path: str | None = None) -> None:
        """As ``Mission.log_artifact``, for the active mission."""
        if mission := self._active('log_artifact'):
            mission.log_artifact(path, artifact_path)

    # -- sending ---------------------------------------------------------------------------------------------------

    def flush(self, deadline_s: float = 10.0) -> Report:
        """Wait until everything that agent and node have logged is sent, for at most ``deadline_s`` seconds. Never raises.

        Returns:
            How far the newest mission is sent, and what it waits for.
        """
        self._sync()
        if self._replayer:
            self._replayer.wake()
        if (folder := self._newest) is None:
            return Report('', None, 0, 0, complete=True)
        logged = sizes(folder) if self._mission else None
        _until(lambda: has_arrived(folder, logged), deadline_s)
        return report(folder)

    def close(self, deadline_s: float = 0.0) -> Report:
        """End an active mission as KILLED and release the sender. Idempotent.

        Args:
            deadline_s: how long to wait for the sender. It keeps running and sends the rest; if it is stopped, the next one does.
        """
        if mission := self._mission:
            log.warning('mission %s was still active when its logger was closed: it ends as KILLED', mission.id)
            mission.end(success=False, status=KILLED, error='the logger was closed')
            self._detach(mission)
        found = self.flush(0.0 if self._closed else deadline_s)
        self._closed = True
        self._worker.stop()
        self._wake.set()
        self._worker.join(CLOSE_S)
        if self._replayer:
            self._replayer.release()
        return found

    # -- internal --------------------------------------------------------------------------------------------------

    def _start(self, mission_type: str, mission_command: str) -> Mission:
        """Start the active mission and wait for its run; if the disk is full, the mission is not logged."""
        with self._lock:
            before, self._mission = self._mission, None
            if before is not None:
                log.warning('mission %s is still active: it ends as KILLED', before.id)
                before.end(success=False, status=KILLED, error='another mission was started')
                self._ended.append(before)
            mission = self._starter.start(mission_type, mission_command)
            if mission is None:
                return self._starter.unlogged(mission_type)
            self._newest, self._mission = mission.folder, mission
            self._wake.set()
        if self._replayer:
            self._wait_for_run(mission, self._replayer)
        return mission

    def _wait_for_run(self, mission: Mission, replayer: Replayer) -> None:
        """Wait up to ``start_timeout_s``, but not for an unreachable server; wake the sender after this process's request."""
        end, new = time.monotonic() + self._start_timeout_s, mission.new_run
        if new is not None:
            new.is_settled.wait(self._start_timeout_s)
        replayer.wake()
        if new is not None and (new.run is not None or new.is_unreachable):
            return
        _until(lambda: mission.run_id is not None, end - time.monotonic())

    def _active(self, call: str) -> Mission | None:
        mission = self._mission
        if mission is None and call not in self._warned:
            self._warned.add(call)
            log.warning('%s without an active mission does nothing: call start_mission first', call)
        return mission

    def _detach(self, mission: Mission) -> None:
        """Let the thread sync and close the ended mission."""
        with self._lock:
            if self._mission is mission:
                self._mission = None
            self._ended.append(mission)
        self._wake.set()

    def _step(self) -> None:
        """One round of the thread: sync the journal, supervise the sender."""
        self._wake.wait(SYNC_S if self._mission else IDLE_S)
        self._wake.clear()
        self._sync()
        if self._replayer and not self._closed:
            self._replayer.supervise()

    def _sync(self) -> None:
        with self._lock:
            mission = self._mission
            ended, self._ended = self._ended, []
        for each in ended:
            each.close()
        if mission is not None:
            mission.sync()
        if self._replayer and ended:
            self._replayer.wake()

    def _forget_all(self) -> None:
        """In a forked child: threads, journal and sender belong to the parent."""
        self._lock = threading.RLock()
        for mission in (*self._ended, *((self._mission,) if self._mission else ())):
            mission.forget()
        self._mission, self._ended = None, []
        if self._runs:
            self._runs.forget()
            self._runs, self._starter = None, replace(self._starter, runs=None)
        if self._replayer:
            self._replayer.forget()
            self._replayer = None


_alive: weakref.WeakSet[MissionDataLogger] = weakref.WeakSet()


def _after_fork() -> None:
    for logger in tuple(_alive):
        logger._forget_all()


os.register_at_fork(after_in_child=_after_fork)


def _text(name: str, value: object) -> str:
    """A text or path, empty for None. Raises SettingError."""
    try:
        found = os.fspath(value) if value is not None else ''  # type: ignore[call-overload]
    except TypeError as error:
        raise SettingError(name, value, 'a text') from error
    if not isinstance(found, str) or '\0' in found:
        raise SettingError(name, type(value).__name__, 'a text without null characters')  # the value may contain a password
    return found


def _seconds(name: str, value: object) -> float:
    if not isinstance(value, (int, float)) or not value >= 0.0:
        raise SettingError(name, value, 'a number of seconds, 0 or more')
    return float(value)


def _home(environ: Mapping[str, str]) -> Path:
    try:
        return home_of(environ)
    except OSError as error:  # a relative path in a working directory that was deleted
        raise SettingError('home', environ.get('SHADOWHOUND_HOME', ''), 'an absolute path') from error


def _robot(name: str) -> str:
    try:
        return check_name(name, 'the robot name')
    except NameRefused as error:
        raise SettingError('robot', name, error.remedy) from error


def _until(done: Callable[[], bool], seconds: float) -> None:
    """Poll for a file that another process writes."""
    end = time.monotonic() + seconds
    while not done() and time.monotonic() < end:
        time.sleep(POLL_S)
