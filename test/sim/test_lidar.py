"""Scans are made of the building around the robot."""

from __future__ import annotations

import numpy as np
import pytest
from shadowhound_sim.floor_plan import CEILING
from shadowhound_sim.lidar import Lidar
from shadowhound_sim.world import World

TIMES = [0.0, 5.0, 11.3, 19.9, 27.5, 38.0, 52.1]


@pytest.fixture(scope='module')
def lidar() -> Lidar:
    return Lidar(World.of(1))


def _gaps(points: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Distance (m) of each point to the nearest box, negative inside it, or to floor and ceiling."""
    low, high = bounds[0::2].T[:, None, :], bounds[1::2].T[:, None, :]
    outside = np.maximum(np.maximum(low - points, points - high), 0)
    inside = np.minimum(points - low, high - points).min(axis=2)
    gaps = np.where(inside > 0, inside, np.linalg.norm(outside, axis=2)).min(axis=0)
    return np.minimum(gaps, np.minimum(np.abs(points[:, 2]), np.abs(points[:, 2] - CEILING)))


@pytest.mark.parametrize('t', TIMES)
def test_every_point_is_on_a_surface(lidar: Lidar, t: float) -> None:
    """No point floats in the air: each is within five standard deviations of a box, the floor or the ceiling."""
    points = lidar.scan(t)[::7, :3].astype(np.float64)
    assert _gaps(points, lidar.world.plan.bounds).max() < 0.04


@pytest.mark.parametrize('t', TIMES)
def test_no_object_is_between_sensor_and_point(lidar: Lidar, t: float) -> None:
    """The ray to each point passes through no box, except in its last centimeters."""
    points = lidar.scan(t)[::41, :3].astype(np.float64)
    origin = np.array(lidar.origin(lidar.world.pose(t)))
    bounds = lidar.world.plan.bounds.astype(np.float64)
    low, high = bounds[0::2].T + 0.005, bounds[1::2].T - 0.005
    for point in points:
        length = np.linalg.norm(point - origin)
        way = np.linspace(0, max(1 - 0.05 / length, 0), 400)[:, None, None] * (point - origin) + origin
        assert not ((way > low) & (way < high)).all(axis=2).any(), point


def test_a_scan_has_the_size_it_has_in_the_field(lidar: Lidar) -> None:
    """15,000 to 20,000 points of 16 bytes, all finite, intensities from 0 to 255 that differ."""
    cloud = lidar.scan(4.0)
    assert cloud.dtype == np.float32
    assert cloud.shape[1] == 4
    assert 15_000 <= len(cloud) <= 20_000
    assert np.isfinite(cloud).all()
    assert cloud[:, 3].min() >= 0
    assert cloud[:, 3].max() <= 255
    assert cloud[:, 3].std() > 10


def test_scans_are_in_the_frame_odom(lidar: Lidar) -> None:
    """Scans from two places agree on the walls: the outer walls do not move while the robot walks."""
    for t in (3.0, 30.0):
        cloud = lidar.scan(t)
        x0, y0 = lidar.world.plan.corner
        assert cloud[:, 0].min() > x0 - 0.1
        assert cloud[:, 1].min() > y0 - 0.1
        assert cloud[:, 0].max() < x0 + 12.1
        assert cloud[:, 1].max() < y0 + 8.1


def test_scans_repeat_with_the_seed_and_differ_with_time() -> None:
    """A scan depends only on seed and time."""
    one, two, other = Lidar(World.of(5)), Lidar(World.of(5)), Lidar(World.of(6))
    one.scan(1.0)
    assert np.array_equal(one.scan(8.1), two.scan(8.1))
    assert not np.array_equal(one.scan(8.1), one.scan(8.2))
    assert not np.array_equal(one.scan(8.1), other.scan(8.1))
