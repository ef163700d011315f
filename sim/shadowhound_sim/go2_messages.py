"""The messages of go2_interfaces, filled from the simulated world; importing this needs that package.

None of them has a header: the Go2 sends none. Legs and motors are in the robot's own order (FR, FL, RR, RL), quaternions
are (w, x, y, z).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from go2_interfaces.msg import IMU, Go2State, LowState

from shadowhound_sim import gait
from shadowhound_sim.messages import SimulatedSensor, SimulatedTopic
from shadowhound_sim.world import Imu, World

TROT: Final = 3
"""``mode`` (locomotion) of the sport mode while it walks, and its ``gait_type`` 1 (trot)."""


class ImuSource:
    """``imu``."""

    rate_hz = 100.0
    topics = (SimulatedTopic('imu', IMU),)

    def __init__(self, world: World) -> None:
        self._world, self._imu = world, IMU()

    def fill(self, t: float, _stamp_ns: int) -> Iterator[Any]:
        _fill_imu(self._imu, self._world.imu(t))
        yield self._imu


class StateSource:
    """``go2_states``: position and velocity in ``odom``, feet in the frame of the body."""

    rate_hz = 20.0
    topics = (SimulatedTopic('go2_states', Go2State),)

    def __init__(self, world: World) -> None:
        self._world = world
        self._state = Go2State(mode=TROT, gait_type=1, foot_raise_height=gait.STEP_HEIGHT)

    def fill(self, t: float, _stamp_ns: int) -> Iterator[Any]:
        world, state = self._world, self._state
        pose, motion, sway = world.pose(t), world.motion(t), gait.sway(t)
        state.position[:] = (pose.x, pose.y, pose.z)
        state.velocity[:] = (motion.vx, motion.vy, sway.climb)
        state.body_height = pose.z
        state.range_obstacle[:] = world.obstacle_ranges(t)
        state.foot_force[:] = world.foot_forces(t)
        legs = world.legs(t)
        state.foot_position_body[:] = [value for leg in legs for value in leg.foot]
        state.foot_speed_body[:] = [value for leg in legs for value in leg.foot_velocity]
        yield state


class LowStateSource:
    """``lowstate`` at the rate of the robot's low-frequency topic (``rt/lf/lowstate``), with the battery.

    The robot itself publishes it, not the driver, to every participant in its DDS network. Its type there is
    ``unitree_go/msg/LowState``, which has the same fields.
    """

    rate_hz = 20.0
    topics = (SimulatedTopic('lowstate', LowState),)

    def __init__(self, world: World) -> None:
        self._world, self._low = world, LowState(level_flag=0xFF)
        self._low.head[:] = (0xFE, 0xEF)
        self._low.fan_frequency[:] = (2900, 2880, 2910, 2890)
        for motor in self._low.motor_state[:12]:
            motor.mode = 1

    def fill(self, t: float, _stamp_ns: int) -> Iterator[Any]:
        world, low = self._world, self._low
        power = world.power(t)
        _fill_imu(low.imu_state, world.imu(t))
        angles = [angle for leg in world.legs(t) for angle in leg.joints]
        for motor, angle in zip(low.motor_state, angles, strict=False):
            motor.q = motor.q_raw = angle
            motor.temperature = power.motor_temperature
        battery = low.bms_state
        battery.soc, battery.current, battery.status = power.soc, power.current_ma, 8
        battery.cell_vol[:8] = power.cell_mv
        battery.bq_ntc[:] = battery.mcu_ntc[:] = power.temperature
        low.foot_force[:] = low.foot_force_est[:] = world.foot_forces(t)
        low.tick = round(t * 1000) % (1 << 32)
        low.power_v, low.power_a = power.voltage, abs(power.current_ma) / 1000
        low.temperature_ntc1 = low.temperature_ntc2 = power.temperature
        yield low


def go2_sources(world: World, *, lowstate: bool = True) -> list[SimulatedSensor]:
    """The sensors that require go2_interfaces."""
    return [ImuSource(world), StateSource(world), *([LowStateSource(world)] if lowstate else [])]


def _fill_imu(message: Any, reading: Imu) -> None:
    message.quaternion[:] = reading.quaternion
    message.gyroscope[:] = reading.gyroscope
    message.accelerometer[:] = reading.accelerometer
    message.rpy[:] = reading.rpy
    message.temperature = reading.temperature
