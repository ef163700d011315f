#!/usr/bin/env python3
"""Runs the active policy on the robot: odometry in, ``cmd_vel`` out, within limits. A reference to copy from.

    python examples/policy_node.py --ros-args -p max_speed:=0.6 -p max_turn:=1.0

At each step, at the rate in the manifest (``fps``), it takes the newest message at or before now, as the export does, and never
one
older than ``max_age_s``. Speeds and their changes are limited, and any failure (no fresh odometry, a model that fails or returns
no
numbers, no policy) stops the robot: it publishes zero until the problem is gone. If this program exits or hangs, nothing is
published: the robot's driver must then stop it, as the simulated one does after half a second. Latency and failures of each step
are
reported; a policy that violates the limits in its manifest is rolled back, and the version before runs from the next step on.

``observation.state`` may contain what ``export --state pose,twist`` makes of odometry; a policy that needs more is rejected.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Mapping
from functools import reduce
from typing import Final

import numpy as np
import onnxruntime
import rclpy
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

from shadowhound_data_logger.core.errors import PolicyError
from shadowhound_data_logger.datasets.features import COMMAND, STATE_PARTS
from shadowhound_data_logger.policies import active
from shadowhound_data_logger.policies.running import ActivePolicy

STATE, ACTION = 'observation.state', 'action'
_PATHS: Final = {
    'pose': [*(f'pose.pose.position.{axis}' for axis in 'xyz'), *(f'pose.pose.orientation.{axis}' for axis in 'xyzw')],
    'twist': [f'twist.twist.{kind}.{axis}' for kind in ('linear', 'angular') for axis in 'xyz'],
}
FIELDS: Final[Mapping[str, str]] = {
    name: path for part, paths in _PATHS.items() for name, path in zip(STATE_PARTS[part].names, paths, strict=True)
}
"""Name of an element of the state -> its path in nav_msgs/Odometry."""


class Steps:
    """One policy, as a function of odometry. Raises PolicyError for a policy that this program cannot run."""

    def __init__(self, policy: ActivePolicy) -> None:
        inputs = {one.name: one for one in policy.manifest.inputs}
        outputs = {one.name: one for one in policy.manifest.outputs}
        if inputs.keys() != {STATE} or not set(inputs[STATE].names) <= FIELDS.keys():
            raise PolicyError(f'{policy.id} needs more than the pose and the twist of odometry')
        if ACTION not in outputs or outputs[ACTION].names != COMMAND.names:
            raise PolicyError(f'{policy.id} gives no {" ".join(COMMAND.names)}')
        self._state, self._shape = inputs[STATE], outputs[ACTION].shape
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(str(policy.model), options, providers=['CPUExecutionProvider'])

    def __call__(self, odometry: Odometry) -> NDArray[np.float64]:
        """x, y (m/s) and yaw rate (rad/s) in the frame of the body. Raises ValueError if the policy returns no numbers."""
        values = [reduce(getattr, FIELDS[name].split('.'), odometry) for name in self._state.names]
        given = np.array(values, self._state.dtype).reshape(self._state.shape)
        (wanted,) = self._session.run([ACTION], {STATE: given})
        action = np.asarray(wanted, float).reshape(-1)
        if action.shape != (3,) or not np.isfinite(action).all():
            raise ValueError('the policy gives no numbers')
        return action


class PolicyNode(Node):
    """Drives while there is a policy and fresh odometry."""

    def __init__(self) -> None:
        super().__init__('policy')
        self.max_speed, self.max_turn = self._number('max_speed', 0.6), self._number('max_turn', 1.0)
        self.max_change, self.max_age_s = self._number('max_change', 2.0), self._number('max_age_s', 0.5)
        self._odometry: Odometry | None = None
        self._arrived_s = 0.0
        self._last_command = np.zeros(3)
        self._commands = self.create_publisher(Twist, 'cmd_vel', 1)
        self.create_subscription(Odometry, 'odom', self._on_odometry, qos_profile_sensor_data)

    def _number(self, name: str, default: float) -> float:
        value = float(self.declare_parameter(name, default).value)
        if not (math.isfinite(value) and value >= 0.0):
            raise SystemExit(f'{name} = {value} is refused: a number from 0')
        return value

    def _on_odometry(self, message: Odometry) -> None:
        self._odometry, self._arrived_s = message, time.monotonic()

    def drive(self, policy: ActivePolicy, is_stopped: Callable[[], bool]) -> None:
        """Run until another policy is active, this one violates its limits, or the node is stopped."""
        try:
            steps = Steps(policy)
        except PolicyError:
            raise
        except Exception as error:  # noqa: BLE001 - whatever a model does, the robot stands
            self.get_logger().error(f'{policy.id} cannot be loaded: {error}')
            for _ in range(policy.manifest.failures + 1):
                policy.report(0.0, failed=True)
            return
        period_s = 1.0 / policy.manifest.fps
        due = time.monotonic()
        while not is_stopped() and policy.is_current():
            due = max(due + period_s, time.monotonic())
            rclpy.spin_once(self, timeout_sec=0.0)  # also if a step took longer than its period
            while (left := due - time.monotonic()) > 0:
                rclpy.spin_once(self, timeout_sec=left)
            if not self._step(policy, steps, period_s):
                self.get_logger().error(f'{policy.id} broke its limits and was rolled back')
                return

    def _step(self, policy: ActivePolicy, steps: Steps, period_s: float) -> bool:
        odometry = self._fresh()
        if odometry is None:  # not the policy's fault
            self.publish_command(np.zeros(3), period_s)
            return True
        began = time.perf_counter()
        try:
            wanted = steps(odometry)
        except Exception as error:  # noqa: BLE001 - whatever a model does, the robot stands
            self.get_logger().warning(f'a step failed: {error}', throttle_duration_sec=5.0)
            self.publish_command(np.zeros(3), period_s)
            return policy.report(time.perf_counter() - began, failed=True)
        self.publish_command(wanted, period_s)
        return policy.report(time.perf_counter() - began)

    def _fresh(self) -> Odometry | None:
        """The newest message, unless it is too old, both by its stamp and by its arrival: a stamp may be wrong, or ahead."""
        if self._odometry is None:
            return None
        stamp = self._odometry.header.stamp
        age_s = self.get_clock().now().nanoseconds * 1e-9 - stamp.sec - stamp.nanosec * 1e-9
        is_fresh = abs(age_s) <= self.max_age_s and time.monotonic() - self._arrived_s <= self.max_age_s
        return self._odometry if is_fresh else None

    def publish_command(self, wanted: NDArray[np.float64], period_s: float) -> None:
        """Apply the limits of speed, of turning, and of their changes. Zero is published immediately."""
        top = np.array([self.max_speed, self.max_speed, self.max_turn])
        limited = np.clip(wanted, -top, top)
        if limited.any():
            change = self.max_change * period_s
            limited = np.clip(limited, self._last_command - change, self._last_command + change)
        self._last_command = limited
        command = Twist()
        command.linear.x, command.linear.y, command.angular.z = map(float, limited)
        self._commands.publish(command)


def main() -> int:
    """Run until Ctrl-C."""
    rclpy.init()
    node = PolicyNode()
    try:
        while rclpy.ok():
            try:
                with active() as policy:
                    node.get_logger().info(f'{policy.id} drives')
                    node.drive(policy, lambda: not rclpy.ok())
            except (PolicyError, OSError) as error:
                node.get_logger().warning(f'no policy drives: {error}', throttle_duration_sec=30.0)
                node.publish_command(np.zeros(3), 1.0)
                rclpy.spin_once(node, timeout_sec=1.0)
    except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
