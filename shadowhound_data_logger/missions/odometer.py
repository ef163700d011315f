"""The distance that a robot has traveled, from its odometry: without jumps, noise at rest and changes of the frame."""

from __future__ import annotations

from math import hypot, isfinite
from typing import Final, NamedTuple

from shadowhound_data_logger.core.clock import SECOND

MAX_SPEED_MPS: Final = 5.0
"""A step that is faster, and is not one of several in about the same direction, is a jump of the estimate: drones fly faster."""
REST_M: Final = 0.02
"""Smaller movements are the noise of a robot at rest: one millimeter at 50 Hz would add up to 3 m per minute."""


class Pose(NamedTuple):
    """A pose in the odometry frame: meters and radians."""

    stamp_ns: int
    x: float
    y: float
    yaw: float
    z: float = 0.0
    frame_id: str = ''

    @property
    def is_finite(self) -> bool:
        return all(map(isfinite, (self.x, self.y, self.yaw, self.z)))


class Odometer:
    """Adds up the distance over the ground. Lifecycle: New, with the distance so far; ``add`` poses in order of time."""

    def __init__(self, max_speed_mps: float = MAX_SPEED_MPS, distance_m: float = 0.0) -> None:
        """A step faster than ``max_speed_mps`` (m/s), and than twice the one before it, is a jump and is not counted."""
        self.distance_m = distance_m
        self.jumps = 0
        self._max_speed_mps = max_speed_mps
        self._last: Pose | None = None
        self._from: Pose | None = None  # the distance includes the path up to here
        self._velocity = (0.0, 0.0)
        """Of the last step, meters per second."""

    def add(self, pose: Pose) -> bool:
        """Add a pose; returns whether it is valid: finite, and later than the previous one."""
        last = self._last
        if not pose.is_finite or (last is not None and pose.stamp_ns <= last.stamp_ns):
            return False
        self._last = pose
        if last is None or self._from is None or pose.frame_id != last.frame_id:
            self._from, self._velocity = pose, (0.0, 0.0)
        elif self._is_jump(last, pose):
            self.jumps += 1
            self._from = pose
        elif (step_m := hypot(pose.x - self._from.x, pose.y - self._from.y)) >= REST_M:
            self.distance_m += step_m
            self._from = pose
        return True

    def _is_jump(self, last: Pose, pose: Pose) -> bool:
        seconds = (pose.stamp_ns - last.stamp_ns) / SECOND
        before, now = self._velocity, ((pose.x - last.x) / seconds, (pose.y - last.y) / seconds)
        self._velocity = now
        is_steady = hypot(*now) <= 2 * hypot(*before) and before[0] * now[0] + before[1] * now[1] > 0
        return hypot(*now) > self._max_speed_mps and not is_steady
