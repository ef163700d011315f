"""What the node logs of the active mission: a separate journal in the mission's folder, ``node/journal``.

Its records are those of the agent's journal (``metrics``, ``frame``), and ``poses`` (p: [ns, x, y, yaw, z] each), from which the
sender writes trajectory.csv. Nothing is deserialized here, and only the disk can block.
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
from shadowhound_data_logger.missions.active import Active
from shadowhound_data_logger.missions.odometer import MAX_SPEED_MPS, Odometer, Pose
from shadowhound_data_logger.missions.recorder import MOST_FRAME_ARTIFACTS
from shadowhound_data_logger.missions.state import DISTANCE, MissionState

if TYPE_CHECKING:
    from numpy.typing import NDArray

log = logging.getLogger(__name__)

FIRST_FRAME: Final = 900_000
"""Agents number their frames from 0: at 10 Hz they reach this number after 25 hours."""
PATIENCE_NS: Final = 2 * SECOND
"""How long a pose waits for earlier poses from another encoder thread."""
MOST_WAITING: Final = 100_000
"""Readings and poses that wait for a disk that hangs; later ones are dropped."""
LOW_M, HIGH_M = 0.15, 1.5
"""Of the floor plan, above the origin of odometry: neither ground nor ceiling."""
MOST_CLOUD_POINTS: Final = 2000
MOST_FLOOR_POINTS: Final = 400_000
"""3 MB."""


class Reading(NamedTuple):
    """A value of a metric at a time."""

    stamp_ns: int
    key: str
    value: float


class Frame(NamedTuple):
    """A JPEG and its time."""

    stamp_ns: int
    body: bytes
    marks: Mapping[str, str] = {}
    """Further metadata of its object, such as the pose of the robot."""


class Cloud(NamedTuple):
    """Points of the lidar: x, y and z in meters, one row per point."""

    stamp_ns: int
    frame_id: str
    xyz: NDArray[np.float32]


MissionFact = Reading | Pose | Frame | Cloud


class Floor:
    """The floor plan under a mission's path: walls and furniture that the lidar saw, from above.

    It keeps points, evenly thinned out if there are too many. Lifecycle: New; ``add`` and ``save`` on one thread.
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
            self._keep(found.astype(np.float32))

    def add(self, xyz: NDArray[np.float32]) -> None:
        """A cloud in the odometry frame, meters, one row per point."""
        seen = xyz[(xyz[:, 2] > LOW_M) & (xyz[:, 2] < HIGH_M) & np.isfinite(xyz).all(axis=1), :2]
        self._keep(seen[:: self._step * max(1, -(-len(seen) // MOST_CLOUD_POINTS))].copy())

    def save(self, path: Path) -> None:
        """Write the points, if there are any. Raises OSError."""
        if self._count:
            with replacing(path) as file:
                np.save(file, np.concatenate(self._parts))

    def _keep(self, xy: NDArray[np.float32]) -> None:
        self._parts.append(xy)
        self._count += len(xy)
        if self._count > MOST_FLOOR_POINTS:
            thinned = np.concatenate(self._parts)[::2]
            self._parts, self._count, self._step = [thinned], len(thinned), 2 * self._step


class NodeLog:
    """The node's own journal of a mission.

    Lifecycle: New; open once; ``add`` from any thread, ``write`` from one; close once. ``_lock`` guards ``_waiting``.
    """

    def __init__(self, mission: Active, period_ns: int, max_speed_mps: float = MAX_SPEED_MPS) -> None:
        """Of the poses, one every ``period_ns`` becomes points of the metrics pose_x, pose_y, pose_yaw and the distance."""
        self.mission = mission
        self._folder = mission.folder.node
        self._journal = journal.Journal(self._folder.journal)
        self._period_ns = period_ns
        self._odometer = Odometer(max_speed_mps)
        self._max_speed_mps = max_speed_mps
        self._lock = threading.Lock()
        self._waiting: list[MissionFact] = []
        self._floor = Floor()
        self._frame_id = ''
        self._poses: list[Pose] = []
        self._frames = 0
        self._period = -1
        self._is_logged = False

    def open(self) -> None:
        """Start, or continue after an earlier node of this mission. Raises OSError."""
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
        """Take a fact; facts outside the mission's time are skipped when they are written."""
        with self._lock:
            if len(self._waiting) < MOST_WAITING:
                self._waiting.append(fact)

    def write(self, *, all_of_it: bool = False) -> None:
        """Journal what waits and sync it; the last poses only with ``all_of_it``. A disk error is logged once."""
        with self._lock:
            waiting, self._waiting = self._waiting, []
        facts = sorted((fact for fact in waiting if self.mission.has(fact.stamp_ns)), key=lambda fact: fact.stamp_ns)
        try:
            for fact in facts:
                if isinstance(fact, Pose):
                    self._poses.append(fact)
                    self._frame_id = fact.frame_id
                elif isinstance(fact, Frame):
                    self._keep(fact)
                elif isinstance(fact, Cloud):
                    if fact.frame_id == self._frame_id:
                        self._floor.add(fact.xyz)
                else:
                    self._append('metrics', fact.stamp_ns, m={fact.key: fact.value}, s=self._step(fact.stamp_ns))
            self._move(all_of_it=all_of_it)
            if facts:
                self._journal.sync()
            if all_of_it:
                self._floor.save(self.mission.folder.floor)
        except OSError as error:
            self._lose(error)

    def close(self, mission: Active | None = None) -> None:
        """Write the rest, with the end of ``mission``, and close the journal: the sender waits for that."""
        self.mission = mission or self.mission
        self.write(all_of_it=True)
        self._journal.close()

    def _move(self, *, all_of_it: bool) -> None:
        """Journal the poses before which no other can arrive any more."""
        self._poses.sort()
        until_ns = self._poses[-1].stamp_ns - PATIENCE_NS if self._poses else 0
        due = [pose for pose in self._poses if (all_of_it or pose.stamp_ns <= until_ns) and self.mission.has(pose.stamp_ns)]
        self._poses = [] if all_of_it else [pose for pose in self._poses if pose.stamp_ns > until_ns]
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
        if all_of_it and taken:  # the distance up to the last pose
            last = taken[-1].stamp_ns
            self._append('metrics', last, m={DISTANCE: self._odometer.distance_m}, s=self._step(last) + 1)

    def _keep(self, frame: Frame) -> None:
        """Keep a frame for the run's artifacts and the mission's folder in the store."""
        if self._frames >= MOST_FRAME_ARTIFACTS:
            return
        number = FIRST_FRAME + self._frames
        name = f'{number:08d}.jpg'
        path = self._folder.files / name
        try:
            path.unlink(missing_ok=True)  # of a node that was killed before it journaled the frame
            copies.write(path, memoryview(frame.body))
        except OSError as error:  # the journal still has room when frames have none
            self._lose(error)
            return
        self._append('frame', frame.stamp_ns, id=number, file=name, artifact=True, marks=dict(frame.marks))
        self._frames += 1

    def _lose(self, error: OSError) -> None:
        if not self._is_logged:
            self._is_logged = True
            log.warning('mission %s loses what the node logs while the disk accepts no writes: %s', self.mission.id, error)

    def _step(self, stamp_ns: int) -> int:
        """Whole seconds since the start, the x axis of MLflow's charts."""
        return self.mission.since_start_ns(stamp_ns) // SECOND

    def _append(self, kind: str, time_ns: int, **fields: Any) -> None:
        self._journal.append({'k': kind, 't': time_ns, **fields})
