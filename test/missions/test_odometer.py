"""The traveled distance, despite errors of odometry."""

from __future__ import annotations

import math
import random

import pytest

from shadowhound_data_logger.missions.odometer import Odometer, Pose

SECOND = 10**9


def walked(*steps: tuple[float, float, float], frame_id: str = 'odom', max_speed_mps: float = 5.0) -> Odometer:
    """The distance for odometry of (seconds, x, y)."""
    odometer = Odometer(max_speed_mps)
    for seconds, x, y in steps:
        odometer.add(Pose(round(seconds * SECOND), x, y, 0.0, frame_id=frame_id))
    return odometer


def test_a_distance_is_the_sum_of_its_steps() -> None:
    """The way there and back counts twice."""
    assert walked((0, 0, 0), (1, 3, 0), (2, 3, 4), (3, 3, 0)).distance_m == pytest.approx(3 + 4 + 4)


def test_a_fast_drone_is_counted() -> None:
    """At 15 m/s its path counts, except for the first step; jumps do not, nor an estimate that jumps back and forth."""
    odometer = Odometer()
    for number in range(101):
        odometer.add(Pose(number * SECOND // 10, 1.5 * number + (200 if number >= 50 else 0), 0.0, 0.0))
    assert (odometer.distance_m, odometer.jumps) == (pytest.approx(150 - 2 * 1.5), 2)
    odometer = Odometer()
    for number in range(11):
        odometer.add(Pose(number * SECOND // 10, 3.0 * (number % 2), 0.0, 0.0))
    assert (odometer.distance_m, odometer.jumps) == (0.0, 10)


def test_a_jump_is_not_counted() -> None:
    """A step faster than the robot is not counted, and the path continues after it."""
    odometer = walked((0, 0, 0), (1, 1, 0), (2, 100, 0), (3, 101, 0))
    assert (odometer.distance_m, odometer.jumps) == (pytest.approx(2), 1)


def test_a_jump_after_a_rest_is_not_counted() -> None:
    """However long the robot was at rest: the jump itself took one period."""
    rest = [(number / 10, 0.001 * (number % 2), 0.0) for number in range(600)]
    assert walked(*rest, (60.0, 8, 0), (60.1, 8.2, 0)).distance_m == pytest.approx(0.2)


def test_another_frame_has_another_origin() -> None:
    """There is no distance between poses of two frames."""
    odometer = walked((0, 0, 0), (1, 1, 0))
    odometer.add(Pose(2 * SECOND, 2.0, 0.0, 0.0, frame_id='map'))
    odometer.add(Pose(3 * SECOND, 3.0, 0.0, 0.0, frame_id='map'))
    assert odometer.distance_m == pytest.approx(2)


def test_noise_at_rest_is_not_counted() -> None:
    """A minute of millimeter noise at 50 Hz is zero."""
    rng = random.Random(1)
    assert walked(*((number / 50, rng.gauss(0, 0.002), rng.gauss(0, 0.002)) for number in range(3000))).distance_m < 0.1


def test_slow_walking_at_a_high_rate_is_counted() -> None:
    """Steps below the noise add up."""
    assert walked(*((number / 200, number * 0.001, 0.0) for number in range(2001))).distance_m == pytest.approx(2.0, abs=0.03)


@pytest.mark.parametrize('x', [math.nan, math.inf])
def test_an_invalid_pose_is_skipped(x: float) -> None:
    """Neither NaN nor an earlier time moves it."""
    odometer = walked((0, 0, 0), (1, 1, 0))
    assert not odometer.add(Pose(2 * SECOND, x, 0.0, 0.0, frame_id='odom'))
    assert not odometer.add(Pose(SECOND, 2.0, 0.0, 0.0, frame_id='odom'))
    assert odometer.distance_m == pytest.approx(1)
