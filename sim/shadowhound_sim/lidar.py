"""The simulated 4D lidar: every ray hits a wall, an object, the floor or the ceiling of the building, with noise."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shadowhound_sim.floor_plan import CEILING, REFLECTIVITY, Crossings, cross
from shadowhound_sim.world import BodyPose, World

AZIMUTHS: Final = 800
RINGS: Final = 25
MOUNT: Final = (0.28, 0.05)
"""Position of the sensor ahead of and above the center of the body, m."""
RANGE_NOISE: Final = 0.006
"""Standard deviation of a range, m."""
DROPPED: Final = 1.9
"""A ray whose noise is above this many standard deviations is lost: 2.9 % of them."""
_STREAM: Final = 8
_FLOOR, _CEILING_LIGHT = 0.35, 0.8


class Lidar:
    """Scans of one world; holds only what is constant across scans."""

    def __init__(self, world: World) -> None:
        self.world = world
        elevations = np.radians(np.linspace(-47.5, 56.5, RINGS, dtype=np.float32))
        self.slope: NDArray[np.float32] = np.tan(elevations)[:, None]
        self.cosine: NDArray[np.float32] = np.cos(elevations)[:, None]
        self.reflectivity = np.array([REFLECTIVITY[box.material] for box in world.plan.boxes], np.float32)
        self.partial = np.flatnonzero(~world.plan.is_full)

    def origin(self, pose: BodyPose) -> tuple[float, float, float]:
        """Position of the sensor in ``odom``."""
        return pose.x + MOUNT[0] * math.cos(pose.yaw), pose.y + MOUNT[0] * math.sin(pose.yaw), pose.z + MOUNT[1]

    def scan(self, t: float) -> NDArray[np.float32]:
        """The points of the scan at ``t``: (n, 4) of x, y, z in ``odom`` (m) and intensity (0 ... 255)."""
        x, y, z = self.origin(self.world.pose(t))
        turn = (t * 7.3) % 1.0
        angles = self.world.motion(t).yaw + (np.arange(AZIMUTHS, dtype=np.float32) + turn) * (math.tau / AZIMUTHS)
        dx, dy = np.cos(angles), np.sin(angles)
        distance, light = self._ranges(cross(self.world.plan.bounds, x, y, dx, dy), z, dx, dy)
        noise = self.world.noise.array(_STREAM, t, AZIMUTHS * RINGS).reshape(RINGS, AZIMUTHS)
        distance += RANGE_NOISE * self.cosine * noise
        cloud = np.empty((RINGS, AZIMUTHS, 4), np.float32)
        np.multiply(distance, dx, out=cloud[..., 0])
        np.multiply(distance, dy, out=cloud[..., 1])
        np.multiply(distance, self.slope, out=cloud[..., 2])
        cloud[..., :3] += np.array((x, y, z), np.float32)
        cloud[..., 3] = np.clip(light * (255.0 + 8.0 * noise) / (1.0 + 0.015 * distance * distance), 0.0, 255.0)
        return cloud[noise < DROPPED]

    def _ranges(
        self, hits: Crossings, height: float, dx: NDArray[np.float32], dy: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Horizontal distance (m) and reflected share of each ray, both (RINGS, AZIMUTHS)."""
        incidence = 0.35 + 0.65 * np.where(hits.through_x, np.abs(dx), np.abs(dy))
        shine = self.reflectivity[:, None] * incidence
        walls = np.where(self.world.plan.is_full[:, None], hits.near, np.inf)
        nearest, rays = walls.argmin(axis=0), np.arange(AZIMUTHS)
        wall = walls[nearest, rays].astype(np.float32)
        up = self.slope > 0
        level = np.where(up, (CEILING - height) / self.slope, -height / self.slope).astype(np.float32)
        distance = np.minimum(wall, level)
        light = np.where(wall <= level, shine[nearest, rays], np.where(up, _CEILING_LIGHT, _FLOOR)).astype(np.float32)
        bounds = self.world.plan.bounds
        for index in self.partial[(hits.near[self.partial] < wall).any(axis=1)]:
            columns = np.flatnonzero(hits.near[index] < wall)
            near, far = hits.near[index, columns], hits.far[index, columns]
            z0, z1 = bounds[4, index] - height, bounds[5, index] - height
            enter, leave = self.slope * near, self.slope * far
            top, bottom = z1 / self.slope, z0 / self.slope
            meets = np.where(enter > z1, top, np.where(enter < z0, bottom, near))
            before = distance[:, columns]
            is_hit = (np.minimum(enter, leave) <= z1) & (np.maximum(enter, leave) >= z0) & (meets < before)
            distance[:, columns] = np.where(is_hit, meets, before)
            light[:, columns] = np.where(is_hit, shine[index, columns], light[:, columns])
        return distance, light
