"""The trot of a Go2: where its feet, joints and body are at any time, from walking speed and rate of turn.

Diagonal legs move together, the two pairs in antiphase. Legs are in the robot's own order: FR, FL, RR, RL.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

STRIDE_HZ: Final = 2.0
"""Strides per second; the body bobs at twice that, once for each pair of legs."""
LEGS: Final = ('FR', 'FL', 'RR', 'RL')
PHASE: Final = (0.0, 0.5, 0.5, 0.0)
"""Phase of each leg as a share of the stride."""
HIP: Final = 0.0955
THIGH: Final = 0.213
CALF: Final = 0.213
"""Lengths of the links of a leg, m (Go2 URDF)."""
HIP_X: Final = 0.1934
HIP_Y: Final = 0.0465
"""Distance of the hip joints from the middle of the body, m (Go2 URDF)."""
STANCE_HEIGHT: Final = 0.31
"""Mean height of the body above the floor, m."""
STEP_HEIGHT: Final = 0.08
BOB: Final = 0.004
"""How far the body rises and falls, m."""
WEIGHT: Final = 150.0
"""Weight of the robot, N."""

_OMEGA: Final = math.tau * STRIDE_HZ
_ROLL: Final = 0.018
_PITCH: Final = 0.009


class Sway(NamedTuple):
    """The effect of the trot on the body: angles in rad, height in m, and their time derivatives."""

    roll: float
    pitch: float
    height: float
    roll_rate: float
    pitch_rate: float
    climb: float
    lift: float
    """Vertical acceleration, m/s^2."""


class Leg(NamedTuple):
    """One leg in the frame of the body (x forward, y left, z up): foot in m and m/s, joints in rad, force in N."""

    foot: tuple[float, float, float]
    foot_velocity: tuple[float, float, float]
    joints: tuple[float, float, float]
    """Hip, thigh and calf."""
    force: float


def sway(t: float) -> Sway:
    """The body's sway at time ``t``."""
    once, twice = _OMEGA * t, 2 * _OMEGA * t
    return Sway(
        roll=_ROLL * math.sin(once),
        pitch=_PITCH * math.sin(twice + 0.4),
        height=STANCE_HEIGHT + BOB * math.sin(twice),
        roll_rate=_ROLL * _OMEGA * math.cos(once),
        pitch_rate=_PITCH * 2 * _OMEGA * math.cos(twice + 0.4),
        climb=BOB * 2 * _OMEGA * math.cos(twice),
        lift=-BOB * (2 * _OMEGA) ** 2 * math.sin(twice),
    )


def leg(index: int, t: float, speed: float, yaw_rate: float) -> Leg:
    """Leg ``index`` of LEGS at time ``t``: the foot stands for half of the stride while the body passes over it."""
    front = 1.0 if index < 2 else -1.0
    left = 1.0 if index % 2 else -1.0
    phase = (t * STRIDE_HZ + PHASE[index]) % 1.0
    hip_x, hip_y = front * HIP_X, left * (HIP_Y + HIP)
    vx, vy = speed - yaw_rate * hip_y, yaw_rate * hip_x
    stance_s = 0.5 / STRIDE_HZ
    if phase < 0.5:
        share, rate = 0.5 - 2 * phase, -1.0
        lift, lift_rate = 0.0, 0.0
        force = WEIGHT / 2 * math.pi / 2 * math.sin(math.tau * phase)
    else:
        swing = 2 * phase - 1.0
        share, rate = -0.5 * math.cos(math.pi * swing), 0.5 * math.pi * math.sin(math.pi * swing)
        lift = STEP_HEIGHT * math.sin(math.pi * swing) ** 2
        lift_rate = STEP_HEIGHT * math.pi / stance_s * math.sin(math.tau * swing)
        force = 0.0
    foot = (hip_x + share * vx * stance_s, hip_y + share * vy * stance_s, lift - STANCE_HEIGHT)
    return Leg(foot, (rate * vx, rate * vy, lift_rate), joints(index, foot), force)


def joints(index: int, foot: tuple[float, float, float]) -> tuple[float, float, float]:
    """Inverse kinematics of one leg: hip, thigh and calf angle (rad) that put its foot at ``foot`` (m, body frame)."""
    front = 1.0 if index < 2 else -1.0
    left = 1.0 if index % 2 else -1.0
    x, y, z = foot[0] - front * HIP_X, foot[1] - left * HIP_Y, foot[2]
    reach = math.sqrt(y * y + z * z - HIP * HIP)
    hip = math.atan2(z, y) - math.atan2(-reach, left * HIP)
    squared = x * x + reach * reach
    calf = math.acos((squared - THIGH**2 - CALF**2) / (2 * THIGH * CALF))
    length = math.sqrt(squared)
    thigh = math.atan2(-x, reach) + math.acos((squared + THIGH**2 - CALF**2) / (2 * length * THIGH))
    return hip, thigh, -calf


def foot_of(index: int, angles: tuple[float, float, float]) -> tuple[float, float, float]:
    """Forward kinematics: the place of the foot (m, body frame) for hip, thigh and calf angle (rad)."""
    front = 1.0 if index < 2 else -1.0
    left = 1.0 if index % 2 else -1.0
    hip, thigh, calf = angles
    x = -THIGH * math.sin(thigh) - CALF * math.sin(thigh + calf)
    reach = THIGH * math.cos(thigh) + CALF * math.cos(thigh + calf)
    y = left * HIP * math.cos(hip) + reach * math.sin(hip)
    z = left * HIP * math.sin(hip) - reach * math.cos(hip)
    return front * HIP_X + x, left * HIP_Y + y, z
