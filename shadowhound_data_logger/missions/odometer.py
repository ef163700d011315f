"""The distance that a robot has traveled, from its odometry: without jumps, noise at rest and changes of the frame."""

from __future__ import annotations

from math import hypot, isfinite
from typing import Final, NamedTuple

from shadowhound_data_logger.core.clock import SECOND

MAX_SPEED_MPS: Final = 5.0
"""No Go2 walks faster."""
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
        """A step faster than ``max_speed_mps`` (m/s) is a jump of the estimate and is not counted."""
        self.distance_m = distance_m
        self.jumps = 0
        self._max_speed_mps = max_speed_mps
        self._last: Pose | None = None
        self._from: Pose | None = None  # the distance includes the path up to here

    def add(self, pose: Pose) -> bool:
        """Add a pose; returns whether it is valid: finite, and later than the previous one."""
        last = self._last
        if not pose.is_finite or (last is not None and pose.stamp_ns <= last.stamp_ns):
            return False
        self._last = pose
        if last is None or self._from is None or pose.frame_id != last.frame_id:
            self._from = pose
        elif hypot(pose.x - last.x, pose.y - last.y) * SECOND > self._max_speed_mps * (pose.stamp_ns - last.stamp_ns):
            self.jumps += 1
            self._from = pose
        elif (step_m := hypot(pose.x - self._from.x, pose.y - self._from.y)) >= REST_M:
            self.distance_m += step_m
            self._from = pose
        return True
