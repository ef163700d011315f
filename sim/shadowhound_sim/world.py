"""The simulated Go2 in its building: its sensor readings at any time, pure and deterministic.

On its patrol everything is a function of (seed, t): no clock, no state, no ROS. A driven robot also depends on its commands.
``t`` is in seconds since the start, units are SI, and all sensors derive from one motion, so that they agree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shadowhound_sim import gait
from shadowhound_sim.floor_plan import FloorPlan, cross
from shadowhound_sim.patrol import SPEED, Driven, Motion, Patrol

GRAVITY: Final = 9.81
DISCHARGE_S: Final = 5.0
"""Seconds per percent of the battery: some sixty times faster than real, so that a short run shows it."""
EMPTY: Final = 8
"""Minimum state of charge (percent)."""
RANGE_LIMIT: Final = 6.0
_IMU, _FOOT, _POWER = range(3)
_NORMALS: Final = 1 << 16


class Noise:
    """Noise that depends only on seed, stream and time: a run can be reproduced sample by sample.

    A table of standard normal numbers, read at an index derived from (stream, time).
    """

    def __init__(self, seed: int) -> None:
        self.table: NDArray[np.float32] = np.random.default_rng(seed).standard_normal(_NORMALS).astype(np.float32)

    def at(self, stream: int, t: float, count: int) -> list[float]:
        """``count`` normal numbers for one sample of ``stream``, as Python floats."""
        return self.array(stream, t, count).tolist()  # type: ignore[no-any-return]

    def array(self, stream: int, t: float, count: int) -> NDArray[np.float32]:
        """``count`` (at most 65,536) normal numbers for one sample of ``stream``."""
        start = (round(t * 1000) * 7919 + stream * 104_729) % _NORMALS
        if start + count <= _NORMALS:
            return self.table[start : start + count]
        return np.concatenate((self.table[start:], self.table[: start + count - _NORMALS]))


class BodyPose(NamedTuple):
    """The body in ``odom``: position in m, angles in rad, quaternion as (w, x, y, z)."""

    x: float
    y: float
    z: float
    roll: float
    pitch: float
    yaw: float
    quaternion: tuple[float, float, float, float]


class Imu(NamedTuple):
    """One reading: gyroscope in rad/s and accelerometer in m/s^2, both in the frame of the body; degrees Celsius."""

    quaternion: tuple[float, float, float, float]
    gyroscope: tuple[float, float, float]
    accelerometer: tuple[float, float, float]
    rpy: tuple[float, float, float]
    temperature: int


class Power(NamedTuple):
    """Battery and temperatures: percent, V, mA (negative: discharging), mV per cell, degrees Celsius."""

    soc: int
    voltage: float
    current_ma: int
    cell_mv: tuple[int, ...]
    temperature: int
    motor_temperature: int


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """One robot on its path."""

    plan: FloorPlan
    path: Patrol | Driven
    noise: Noise
    solid: NDArray[np.float32]
    """Bounds of the boxes at the height of the body."""

    @classmethod
    def of(cls, seed: int, driven: Driven | None = None) -> World:
        """On its patrol, or driven."""
        plan = FloorPlan.build()
        bounds = plan.bounds
        solid = bounds[:, (bounds[4] < gait.STANCE_HEIGHT) & (bounds[5] > gait.STANCE_HEIGHT)].copy()
        return cls(plan, driven or Patrol.through(plan.patrol), Noise(seed), solid)

    def motion(self, t: float) -> Motion:
        """Position, heading and velocity in the plane."""
        return self.path.at(t)

    def room(self, t: float) -> str:
        """The room the robot is in."""
        motion = self.path.at(t)
        return self.plan.room_at(motion.x, motion.y)

    def pose(self, t: float) -> BodyPose:
        """The pose of the body, with the sway of the trot."""
        motion, sway = self.path.at(t), gait.sway(t)
        quaternion = _quaternion(sway.roll, sway.pitch, motion.yaw)
        return BodyPose(motion.x, motion.y, sway.height, sway.roll, sway.pitch, motion.yaw, quaternion)

    def imu(self, t: float) -> Imu:
        """The IMU's reading; specific force, so that a robot at rest reads +9.81 upwards."""
        motion, sway = self.path.at(t), gait.sway(t)
        noise = self.noise.at(_IMU, t, 6)
        sin_r, cos_r = math.sin(sway.roll), math.cos(sway.roll)
        sin_p, cos_p = math.sin(sway.pitch), math.cos(sway.pitch)
        gyroscope = (
            sway.roll_rate - motion.yaw_rate * sin_p + 0.004 * noise[0],
            sway.pitch_rate * cos_r + motion.yaw_rate * cos_p * sin_r + 0.004 * noise[1],
            motion.yaw_rate * cos_p * cos_r - sway.pitch_rate * sin_r + 0.004 * noise[2],
        )
        left, up = SPEED * motion.yaw_rate, sway.lift + GRAVITY
        accelerometer = (
            -sin_p * up + 0.05 * noise[3],
            cos_r * left + sin_r * cos_p * up + 0.05 * noise[4],
            -sin_r * left + cos_r * cos_p * up + 0.05 * noise[5],
        )
        quaternion = _quaternion(sway.roll, sway.pitch, motion.yaw)
        return Imu(quaternion, gyroscope, accelerometer, (sway.roll, sway.pitch, motion.yaw), _warmth(t, 38.0, 58.0))

    def legs(self, t: float) -> tuple[gait.Leg, gait.Leg, gait.Leg, gait.Leg]:
        """The four legs in the order of gait.LEGS."""
        yaw_rate = self.path.at(t).yaw_rate
        return (
            gait.leg(0, t, SPEED, yaw_rate), gait.leg(1, t, SPEED, yaw_rate),
            gait.leg(2, t, SPEED, yaw_rate), gait.leg(3, t, SPEED, yaw_rate),
        )  # fmt: skip

    def foot_forces(self, t: float) -> tuple[int, int, int, int]:
        """The force under each foot (N) as its noisy sensor rounds it; never negative."""
        noise = self.noise.at(_FOOT, t, 4)
        a, b, c, d = (max(0, round(leg.force + 3 + 1.5 * n)) for leg, n in zip(self.legs(t), noise, strict=True))
        return a, b, c, d

    def power(self, t: float) -> Power:
        """The battery, which empties, and the motors, which warm up."""
        soc = max(float(EMPTY), 100.0 - t / DISCHARGE_S)
        noise = self.noise.at(_POWER, t, 9)
        load = 1.0 + 0.25 * math.sin(2 * math.tau * gait.STRIDE_HZ * t)
        cells = tuple(round(3350 + 7.6 * soc - 25 * load + 2 * n) for n in noise[:8])
        current = round(-5200 * load + 120 * noise[8])
        return Power(round(soc), sum(cells) / 1000, current, cells, _warmth(t, 27.0, 41.0), _warmth(t, 31.0, 64.0))

    def obstacle_ranges(self, t: float) -> tuple[float, float, float, float]:
        """Free distance (m) from the body ahead, to the left, behind and to the right, at most RANGE_LIMIT."""
        motion = self.path.at(t)
        yaws = motion.yaw + np.arange(4) * (math.pi / 2)
        hits = cross(self.solid, motion.x, motion.y, np.cos(yaws), np.sin(yaws))
        ahead, left, behind, right = np.minimum(hits.near.min(axis=0), RANGE_LIMIT).tolist()
        return ahead, left, behind, right


def _warmth(t: float, cold: float, warm: float) -> int:
    """A temperature rising from ``cold`` to ``warm``, most of it within 40 seconds."""
    return round(warm + (cold - warm) * math.exp(-t / 40.0))


def _quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """(w, x, y, z) of the rotations about z, y and x, in this order; the Go2's own order of the elements."""
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
