"""What the node logs of the active mission: a separate journal in the mission's folder, ``node/journal``.

Its records are those of the agent's journal (``metrics``, ``frame``), and ``poses`` (p: [ns, x, y, yaw, z] each), of which the
sender makes trajectory.csv. Nothing here is deserialized, and nothing waits but for the disk.
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
from shadowhound_data_logger.missions.story import DISTANCE, Story

if TYPE_CHECKING:
    from numpy.typing import NDArray

log = logging.getLogger(__name__)

FIRST_FRAME: Final = 900_000
"""Agents number their frames from 0: at 10 Hz one comes here after 25 hours."""
PATIENCE_NS: Final = 2 * SECOND
"""How long a pose waits for earlier ones that another encoder still has."""
MOST_WAITING: Final = 100_000
"""Readings and poses that wait for a disk that hangs; what comes then is left out."""
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
    """What its object says besides: where the robot was, say."""


class Cloud(NamedTuple):
    """What the lidar saw: x, y and z in metres, a row a point."""

    stamp_ns: int
    frame_id: str
    xyz: NDArray[np.float32]


MissionFact = Reading | Pose | Frame | Cloud


class Floor:
    """The floor plan under a mission's path: where the lidar saw walls and furniture, from above.

    It keeps points, evenly thinned out when there are too many. New; ``add`` and ``save`` on one thread.
    """

    def __init__(self) -> None:
        self._parts: list[NDArray[np.float32]] = []
        self._count = 0
        self._step = 1

    def load(self, path: Path) -> None:
        """Go on with what an earlier node saw; none is fine, and so is one that cannot be read."""
        try:
            found = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError):
            return
        if found.ndim == 2 and found.shape[1] == 2:
            self._keep(found.astype(np.float32))

    def add(self, xyz: NDArray[np.float32]) -> None:
        """A cloud in the frame of odometry, metres, a row a point."""
        seen = xyz[(xyz[:, 2] > LOW_M) & (xyz[:, 2] < HIGH_M) & np.isfinite(xyz).all(axis=1), :2]
        self._keep(seen[:: self._step * max(1, -(-len(seen) // MOST_CLOUD_POINTS))].copy())

    def save(self, path: Path) -> None:
        """Where anything was seen. Raises OSError."""
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

    Life: New; open once; ``add`` from any thread, ``write`` from one; close once. ``_lock`` guards what waits.
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
        self._told = False

    def open(self) -> None:
        """Begin, or go on where a node that ended in this mission left off. Raises OSError."""
        self._folder.path.mkdir(mode=0o700, exist_ok=True)
        self._folder.files.mkdir(mode=0o700, exist_ok=True)
        self._journal.reopen()
        story = Story()
        for line in journal.read(self._folder.journal):
            story.add(line.record)
        self._odometer = Odometer(self._max_speed_mps, story.last.get(DISTANCE, 0.0))
        self._frames = story.counts['frame']
        self._floor.load(self.mission.folder.floor)

    def add(self, fact: MissionFact) -> None:
        """Take what was seen; what is not of the mission's time is left out when it is written."""
        with self._lock:
            if len(self._waiting) < MOST_WAITING:
                self._waiting.append(fact)

    def write(self, *, all_of_it: bool = False) -> None:
        """Journal what waits and sync it; poses of the last moments only with ``all_of_it``. A disk that refuses is said once."""
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
        """Write the rest, of ``mission`` that has its end now, and let go of the journal: the sender waits for that."""
        self.mission = mission or self.mission
        self.write(all_of_it=True)
        self._journal.close()

    def _move(self, *, all_of_it: bool) -> None:
        """Journal the poses that no earlier one can come before any more."""
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
        if all_of_it and taken:  # how far it came, to the last pose
            last = taken[-1].stamp_ns
            self._append('metrics', last, m={DISTANCE: self._odometer.distance_m}, s=self._step(last) + 1)

    def _keep(self, frame: Frame) -> None:
        """A frame for the run's artifacts and the mission's folder in the store."""
        if self._frames >= MOST_FRAME_ARTIFACTS:
            return
        number = FIRST_FRAME + self._frames
        name = f'{number:08d}.jpg'
        path = self._folder.files / name
        try:
            path.unlink(missing_ok=True)  # of a node that was killed before it journalled the frame
            copies.write(path, memoryview(frame.body))
        except OSError as error:  # the journal has room when frames have none any more
            self._lose(error)
            return
        self._append('frame', frame.stamp_ns, id=number, file=name, artifact=True, marks=dict(frame.marks))
        self._frames += 1

    def _lose(self, error: OSError) -> None:
        if not self._told:
            self._told = True
            log.warning('mission %s loses what the node logs while the disk accepts no writes: %s', self.mission.id, error)

    def _step(self, stamp_ns: int) -> int:
        """Whole seconds since the start: what MLflow draws the points over."""
        return self.mission.since_start_ns(stamp_ns) // SECOND

    def _append(self, kind: str, time_ns: int, **fields: Any) -> None:
        self._journal.append({'k': kind, 't': time_ns, **fields})
