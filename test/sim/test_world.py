"""The simulated robot's poses, sensors and building are consistent."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from shadowhound_sim import gait
from shadowhound_sim.floor_plan import ROOMS
from shadowhound_sim.patrol import SPEED, Patrol, wrapped
from shadowhound_sim.world import GRAVITY, World

STEP = 1e-4


@pytest.fixture(scope='module')
def world() -> World:
    return World.of(1)


@pytest.fixture(scope='module')
def lap(world: World) -> float:
    """Seconds for one round."""
    return Patrol.through(world.plan.patrol).length / SPEED


def test_the_robot_starts_at_the_origin_of_odom_heading_along_x(world: World) -> None:
    """The origin of odom is the robot's start."""
    motion = world.motion(0.0)
    assert (motion.x, motion.y, motion.yaw) == pytest.approx((0, 0, 0), abs=1e-9)
    assert (motion.vx, motion.vy) == pytest.approx((SPEED, 0))


def test_the_patrol_closes_in_about_a_minute(world: World, lap: float) -> None:
    """A one-minute demo covers the whole building, and the second lap equals the first."""
    assert 50 < lap < 62
    assert world.motion(lap + 12.3) == pytest.approx(world.motion(12.3))


def test_the_patrol_visits_every_room(world: World, lap: float) -> None:
    """One lap passes through all rooms and never outside."""
    assert {world.room(t) for t in np.arange(0, lap, 0.1)} == {room.name for room in ROOMS}


def test_the_body_never_touches_anything(world: World, lap: float) -> None:
    """A circle of 0.3 m around the robot stays clear of every wall and every piece of furniture at its height."""
    low = [box for box in world.plan.boxes if box.z0 < 0.5]
    for t in np.arange(0, lap, 0.05):
        motion = world.motion(float(t))
        for box in low:
            dx, dy = max(box.x0 - motion.x, 0, motion.x - box.x1), max(box.y0 - motion.y, 0, motion.y - box.y1)
            assert math.hypot(dx, dy) > 0.3, (t, box)


def test_velocity_is_the_derivative_of_the_pose(world: World, lap: float) -> None:
    """Position, velocity, heading and yaw rate are consistent at every moment."""
    for t in np.arange(0.01, lap, 0.173):
        before, now, after = (world.motion(float(t) + d) for d in (-STEP, 0.0, STEP))
        assert (after.x - before.x) / (2 * STEP) == pytest.approx(now.vx, abs=1e-3)
        assert (after.y - before.y) / (2 * STEP) == pytest.approx(now.vy, abs=1e-3)
        if before.yaw_rate == after.yaw_rate:
            assert wrapped(after.yaw - before.yaw) / (2 * STEP) == pytest.approx(now.yaw_rate, abs=1e-6)
        assert now.yaw == pytest.approx(math.atan2(now.vy, now.vx))


def test_the_gyroscope_reads_the_rate_of_turn(world: World, lap: float) -> None:
    """Gyro z is the yaw rate except for noise and the sway of the trot."""
    for t in np.arange(0, lap, 0.11):
        assert world.imu(float(t)).gyroscope[2] == pytest.approx(world.motion(float(t)).yaw_rate, abs=0.03)


def test_the_gyroscope_integrates_to_the_orientation(world: World) -> None:
    """Over a round the mean of gyro z times the time is one full turn of the heading."""
    lap = Patrol.through(world.plan.patrol).length / SPEED
    times = np.arange(0, lap, 0.01)
    turned = sum(world.imu(float(t)).gyroscope[2] for t in times) * 0.01
    assert abs(turned) == pytest.approx(math.tau, abs=0.15)


def test_the_accelerometer_reads_gravity_on_average(world: World, lap: float) -> None:
    """Specific force points up: +9.81 on z over a round, nothing forward, the centripetal part to the side in a turn."""
    readings = np.array([world.imu(float(t)).accelerometer for t in np.arange(0, lap, 0.01)])
    assert readings[:, 2].mean() == pytest.approx(GRAVITY, abs=0.05)
    assert readings[:, 0].mean() == pytest.approx(0, abs=0.05)
    turning = [t for t in np.arange(0, lap, 0.01) if world.motion(float(t)).yaw_rate > 0]
    side = np.mean([world.imu(float(t)).accelerometer[1] for t in turning])
    assert side == pytest.approx(SPEED * world.motion(float(turning[0])).yaw_rate, abs=0.1)


def test_the_quaternion_is_the_rpy(world: World) -> None:
    """(w, x, y, z) turns into the same roll, pitch and yaw, and has length 1."""
    for t in np.arange(0, 60, 0.37):
        pose = world.pose(float(t))
        w, x, y, z = pose.quaternion
        assert w * w + x * x + y * y + z * z == pytest.approx(1)
        assert math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)) == pytest.approx(pose.roll, abs=1e-9)
        assert math.asin(2 * (w * y - z * x)) == pytest.approx(pose.pitch, abs=1e-9)
        assert wrapped(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) - pose.yaw) == pytest.approx(0, abs=1e-9)


def test_the_battery_drains_and_never_charges(world: World) -> None:
    """A minute costs more than five percent, and charge and voltage belong together."""
    charge = [world.power(t).soc for t in range(0, 1000, 5)]
    assert charge[0] == 100
    assert charge[12] <= 94
    assert all(a >= b >= 0 for a, b in pairwise(charge))
    assert world.power(0).voltage > world.power(300).voltage > 20


def test_everything_warms_up(world: World) -> None:
    """IMU, battery and motors are warmer after a minute."""
    assert world.imu(60).temperature > world.imu(0).temperature
    assert world.power(60).temperature > world.power(0).temperature
    assert world.power(60).motor_temperature > world.power(0).motor_temperature


def test_the_range_ahead_is_free_space(world: World, lap: float) -> None:
    """Nothing solid lies within the distance that the range sensors call free, and something lies just behind it."""
    for t in np.arange(0, lap, 1.7):
        motion, ranges = world.motion(float(t)), world.obstacle_ranges(float(t))
        for side, free in enumerate(ranges):
            yaw = motion.yaw + side * math.pi / 2
            reach = np.arange(0, free - 0.01, 0.01)
            assert not _solid(world, motion.x + reach * math.cos(yaw), motion.y + reach * math.sin(yaw)).any()
            if free < 6.0:
                edge = np.array([free + 0.005])
                assert _solid(world, motion.x + edge * math.cos(yaw), motion.y + edge * math.sin(yaw)).all()


def _solid(world: World, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    x0, x1, y0, y1 = world.solid[:4, :, None]
    return ((x0 < x) & (x < x1) & (y0 < y) & (y < y1)).any(axis=0)


def test_the_same_seed_gives_the_same_readings() -> None:
    """Readings depend on seed and time alone, whatever was asked before."""
    first, second, other = World.of(7), World.of(7), World.of(8)
    first.imu(99.0)
    for t in (0.0, 3.14, 77.7):
        assert first.imu(t) == second.imu(t)
        assert first.foot_forces(t) == second.foot_forces(t)
        assert first.power(t) == second.power(t)
    assert first.imu(3.14) != other.imu(3.14)
    assert first.imu(3.14).rpy == other.imu(3.14).rpy


def test_a_side_too_short_for_its_corners_is_refused() -> None:
    """A floor plan that cannot be walked fails when it is built."""
    with pytest.raises(ValueError, match='too short'):
        Patrol.through([(0, 0), (0.5, 0), (0.5, 4), (0, 4)])


@pytest.mark.parametrize('index', range(4))
def test_joints_put_the_foot_where_the_gait_wants_it(index: int) -> None:
    """Forward kinematics of the joint angles gives the foot back, within the limits of the Go2's joints."""
    for t in np.arange(0, 0.5, 0.013):
        for yaw_rate in (0.0, 1.5, -1.5):
            leg = gait.leg(index, float(t), SPEED, yaw_rate)
            assert gait.foot_of(index, leg.joints) == pytest.approx(leg.foot, abs=1e-9)
            hip, thigh, calf = leg.joints
            assert abs(hip) < 1.05
            assert -1.57 < thigh < 3.49
            assert -2.72 < calf < -0.84


def test_foot_speed_is_the_derivative_of_the_foot() -> None:
    """Foot positions and velocities belong together, in stance and in swing."""
    for index in range(4):
        for t in np.arange(0.013, 0.5, 0.031):
            before, now, after = (gait.leg(index, float(t) + d, SPEED, 0.7) for d in (-STEP, 0.0, STEP))
            for axis in range(3):
                speed = (after.foot[axis] - before.foot[axis]) / (2 * STEP)
                assert speed == pytest.approx(now.foot_velocity[axis], abs=1e-3)


def test_a_standing_foot_does_not_slip() -> None:
    """In stance the foot moves back under the body as fast as the body moves on, and it touches the floor."""
    leg = gait.leg(0, 0.1, SPEED, 0.0)
    assert leg.foot_velocity == pytest.approx((-SPEED, 0, 0))
    assert leg.foot[2] == -gait.STANCE_HEIGHT


def test_diagonal_legs_carry_the_robot_in_turns(world: World) -> None:
    """FR and RL stand while FL and RR swing, and the other way round."""
    for t in np.arange(0.05, 10, 0.25):
        fr, fl, rr, rl = world.foot_forces(float(t))
        assert min(fr, rl) > 30 > max(fl, rr) or min(fl, rr) > 30 > max(fr, rl)
    assert (world.foot_forces(0.05)[0] > 30) != (world.foot_forces(0.30)[0] > 30)
