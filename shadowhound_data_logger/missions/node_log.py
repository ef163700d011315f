"""The node's journal of the active mission: ``node/journal`` in the mission's folder, separate from the agent's.

It has the same records (``metrics``, ``frame``), and ``poses`` (p: a list of [ns, x, y, yaw, z]), from which the sender writes
trajectory.csv. Nothing is deserialized here, and only the disk can block.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.durable_files import replacing
from shadowhound_data_logger.missions import copies, journal
from shadowhound_data_logger.missions.active import ActiveMission
from shadowhound_data_logger.missions.mission import MAX_FRAME_ARTIFACTS
from shadowhound_data_logger.missions.odometer import MAX_SPEED_MPS, Odometer, Pose
from shadowhound_data_logger.missions.state import DISTANCE, MissionState

if TYPE_CHECKING:
    from numpy.typing import NDArray

log = logging.getLogger(__name__)

FIRST_FRAME: Final = 900_000
"""Agents number their frames from 0: at 10 Hz they reach this number after 25 hours."""
REORDER_NS: Final = 2 * SECOND
"""How long a pose waits for earlier poses from another encoder thread."""
MAX_QUEUED: Final = 100_000
"""Facts that wait for a hanging disk; later ones are dropped."""
LOW_M, HIGH_M = 0.15, 1.5
"""Heights of the points in the floor plan, above the origin of odometry: neither ground nor ceiling."""
MAX_CLOUD_POINTS: Final = 2000
MAX_FLOOR_POINTS: Final = 400_000
"""3 MB."""


class Reading(NamedTuple):
    """The value of a metric at a time."""

    stamp_ns: int
    key: str
    value: float


class Frame(NamedTuple):
    """A JPEG and its time."""

    stamp_ns: int
    body: bytes
    marks: Mapping[str, str] = {}
    """Additional metadata of the frame's object, such as the pose of the robot."""


class Cloud(NamedTuple):
    """Points of the lidar: x, y and z in meters, one row per point."""

    stamp_ns: int
    frame_id: str
    xyz: NDArray[np.float32]


MissionFact = Reading | Pose | Frame | Cloud


class FloorPlan:
    """The floor plan under a mission's path: the walls and furniture that the lidar saw, from above.

    Keeps points, and every second one if there are too many. Lifecycle: New; ``add`` and ``save`` on one thread.
    """

    def __init__(self) -> None:
        self._parts: list[NDArray[np.float32]] = []
        self._count = 0
        self._step = 1

    def load(self, path: Path) -> None:
        """Continue with the points of an earlier node; a missing or unreadable file is ignored."""
        try:
            found = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError):
            return
        if found.ndim == 2 and found.shape[1] == 2:
            self._append(found.astype(np.float32))

    def add(self, xyz: NDArray[np.float32]) -> None:
        """Add a cloud in the odometry frame, in meters, one row per point."""
        seen = xyz[(xyz[:, 2] > LOW_M) & (xyz[:, 2] < HIGH_M) & np.isfinite(xyz).all(axis=1), :2]
        self._append(seen[:: self._step * max(1, -(-len(seen) // MAX_CLOUD_POINTS))].copy())

    def save(self, path: Path) -> None:
        """Write the points, if any. Raises OSError."""
        if self._count:
            with replacing(path) as file:
                np.save(file, np.concatenate(self._parts))

    def _append(self, xy: NDArray[np.float32]) -> None:
        self._parts.append(xy)
        self._count += len(xy)
        if self._count > MAX_FLOOR_POINTS:
            thinned = np.concatenate(self._parts)[::2]
            self._parts, self._count, self._step = [thinned], len(thinned), 2 * self._step


class NodeLog:
    """The node's journal of a mission.

    Lifecycle: New; open once; ``add`` from any thread, ``write`` from one; close once. ``_lock`` guards ``_queue``.
    """

    def __init__(self, mission: ActiveMission, period_ns: int, max_speed_mps: float = MAX_SPEED_MPS) -> None:
        """One pose per ``period_ns`` becomes points of the metrics pose_x, pose_y, pose_yaw and distance_traveled_m."""
        self.mission = mission
        self._folder = mission.folder.node
        self._journal = journal.Journal(self._folder.journal)
        self._period_ns = period_ns
        self._odometer = Odometer(max_speed_mps)
        self._max_speed_mps = max_speed_mps
        self._lock = threading.Lock()
        self._queue: list[MissionFact] = []
        self._floor = FloorPlan()
        self._frame_id = ''
        self._poses: list[Pose] = []
        self._frames = 0
        self._period = -1
        self._is_logged = False

    def open(self) -> None:
        """Open the journal, or continue that of an earlier node. Raises OSError."""
        self._folder.path.mkdir(mode=0o700, exist_ok=True)
        self._folder.files.mkdir(mode=0o700, exist_ok=True)
        self._journal.reopen()
        state = MissionState()
        for line in journal.read(self._folder.journal):
            state.add(line.record)
        self._odometer = Odometer(self._max_speed_mps, state.last.get(DISTANCE, 0.0))
        self._frames = state.counts['frame']
        self._floor.load(self.mission.folder.floor)

    def add(self, fact: MissionFact) -> None:
        """Queue a fact; facts outside the mission's time are skipped when the queue is written."""
        with self._lock:
            if len(self._queue) < MAX_QUEUED:
                self._queue.append(fact)

    def write(self, *, is_final: bool = False) -> None:
        """Journal the queued facts and sync; the poses of the last ``REORDER_NS`` only if ``is_final``.

        A disk error is logged once.
        """
        with self._lock:
            queue, self._queue = self._queue, []
        facts = sorted((fact for fact in queue if self.mission.has(fact.stamp_ns)), key=lambda fact: fact.stamp_ns)
        try:
            for fact in facts:
                if isinstance(fact, Pose):
                    self._poses.append(fact)
                    self._frame_id = fact.frame_id
                elif isinstance(fact, Frame):
                    self._write_frame(fact)
                elif isinstance(fact, Cloud):
                    if fact.frame_id == self._frame_id:
                        self._floor.add(fact.xyz)
                else:
                    self._append('metrics', fact.stamp_ns, m={fact.key: fact.value}, s=self._step(fact.stamp_ns))
            self._write_poses(is_final=is_final)
            if facts:
                self._journal.sync()
            if is_final:
                self._floor.save(self.mission.folder.floor)
        except OSError as error:
            self._log_loss(error)

    def close(self, mission: ActiveMission | None = None) -> None:
        """Write the rest, up to the end of ``mission``, and close the journal: the sender waits for that."""
        self.mission = mission or self.mission
        self.write(is_final=True)
        self._journal.close()

    def _write_poses(self, *, is_final: bool) -> None:
        """Journal the poses before which no other pose can arrive any more."""
        self._poses.sort()
        until_ns = self._poses[-1].stamp_ns - REORDER_NS if self._poses else 0
        due = [pose for pose in self._poses if (is_final or pose.stamp_ns <= until_ns) and self.mission.has(pose.stamp_ns)]
        self._poses = [] if is_final else [pose for pose in self._poses if pose.stamp_ns > until_ns]
        taken: list[Pose] = []
        points: list[Mapping[str, Any]] = []
        for pose in due:
            if not self._odometer.add(pose):
                continue
            taken.append(pose)
            if pose.stamp_ns // self._period_ns != self._period:
                self._period = pose.stamp_ns // self._period_ns
                values = {'pose_x': pose.x, 'pose_y': pose.y, 'pose_yaw': pose.yaw, DISTANCE: self._odometer.distance_m}
                points.append({'time_ns': pose.stamp_ns, 'm': values, 's': self._step(pose.stamp_ns)})
        if taken:
            self._append('poses', taken[-1].stamp_ns, p=[[pose.stamp_ns, pose.x, pose.y, pose.yaw, pose.z] for pose in taken])
        for point in points:
            self._append('metrics', **point)
        if is_final and taken:  # the distance up to the last pose
            last = taken[-1].stamp_ns
            self._append('metrics', last, m={DISTANCE: self._odometer.distance_m}, s=self._step(last) + 1)

    def _write_frame(self, frame: Frame) -> None:
        """Store a frame for the run's artifacts and the mission's folder in the store."""
        if self._frames >= MAX_FRAME_ARTIFACTS:
            return
        number = FIRST_FRAME + self._frames
        name = f'{number:08d}.jpg'
        path = self._folder.files / name
        try:
            path.unlink(missing_ok=True)  # left by a node that was killed before it journaled the frame
            copies.write(path, memoryview(frame.body))
        except OSError as error:  # frames need more free space than the journal: continue with the journal
            self._log_loss(error)
            return
        self._append('frame', frame.stamp_ns, id=number, file=name, artifact=True, marks=dict(frame.marks))
        self._frames += 1

    def _log_loss(self, error: OSError) -> None:
        if not self._is_logged:
            self._is_logged = True
            log.warning('mission %s loses data of the node because the disk accepts no writes: %s', self.mission.id, error)

    def _step(self, stamp_ns: int) -> int:
        """Whole seconds since the start, the x axis of MLflow's charts."""
        return self.mission.since_start_ns(stamp_ns) // SECOND

    def _append(self, kind: str, time_ns: int, **fields: Any) -> None:
        self._journal.append({'k': kind, 't': time_ns, **fields})
