"""A simulated SO-ARM100 on the robot's back: its joints, and a separate machine whose clock is off and drifts.

``python -m shadowhound_sim.so_arm`` publishes it next to the simulated Go2 (docs/datasets.md): ``/soarm/joint_states`` and
``/soarm/joint_commands`` by the arm's clock, and once per second ``/soarm/clock``, an event timed by both clocks.
"""

from __future__ import annotations

import argparse
import math
import random
import signal
import sys
import threading
import time
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from shadowhound_data_logger.core.clock import SECOND

NAMESPACE: Final = 'soarm'
JOINTS: Final = ('shoulder_pan', 'shoulder_lift', 'elbow_flex', 'wrist_flex', 'wrist_roll', 'gripper')
"""https://github.com/huggingface/lerobot, src/lerobot/robots/so_follower"""
RATE_HZ: Final = 50.0
CLOCK_HZ: Final = 1.0
JITTER_NS: Final = 200_000
"""Jitter of the robot's time of such an event: 0.2 ms."""
LAG_S: Final = 0.06
"""Delay of the joints behind their commands."""


@dataclass(frozen=True, slots=True)
class ArmClock:
    """The arm's clock: ``offset_ns`` ahead of the robot's at ``at_ns``, and ``drift`` faster (1e-6: a ppm)."""

    at_ns: int
    offset_ns: int = 37_000_000
    drift: float = 20e-6

    def of(self, robot_ns: int) -> int:
        """The arm's time at a time of the robot."""
        return robot_ns + self.offset_ns + round((robot_ns - self.at_ns) * self.drift)


def commanded(robot_ns: int) -> list[float]:
    """The commanded joint positions, rad; the gripper 0 to 1."""
    t = robot_ns % (3600 * SECOND) / SECOND
    return [0.6 * math.sin(0.5 * t + number) * (1.0 - 0.1 * number) for number in range(5)] + [0.5 + 0.5 * math.sin(0.8 * t)]


def positions(robot_ns: int) -> list[float]:
    """The actual positions."""
    return commanded(robot_ns - round(LAG_S * SECOND))


def main(arguments: Sequence[str] | None = None) -> int:
    """Publish until SIGINT, or for a duration."""
    parser = argparse.ArgumentParser(prog='so_arm', description=__doc__.partition('\n')[0])
    parser.add_argument('--duration', type=float, default=0.0, metavar='S', help='seconds (default: until interrupted)')
    parser.add_argument('--offset-ms', type=float, default=37.0, help="how far the arm's clock is ahead (default 37)")
    parser.add_argument('--drift-ppm', type=float, default=20.0, help='and how much faster it runs (default 20)')
    options = parser.parse_args(arguments)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    _publish(ArmClock(time.time_ns(), round(options.offset_ms * 1e6), options.drift_ppm * 1e-6), options.duration, stop)
    return 0


def _publish(clock: ArmClock, duration_s: float, stop: threading.Event) -> None:
    import rclpy  # noqa: PLC0415 - the formulas are for machines without ROS, too
    from rclpy.signals import SignalHandlerOptions  # noqa: PLC0415
    from sensor_msgs.msg import JointState, TimeReference  # noqa: PLC0415

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node('so_arm', namespace=NAMESPACE)
    try:
        told = node.create_publisher(JointState, 'joint_states', 10)
        asked = node.create_publisher(JointState, 'joint_commands', 10)
        event = node.create_publisher(TimeReference, 'clock', 10)
        noise, begun, number = random.Random(1), time.time_ns(), 0
        while not stop.is_set() and (not duration_s or number < duration_s * RATE_HZ):
            due = begun + round(number * SECOND / RATE_HZ)
            stop.wait(max(0.0, (due - time.time_ns()) / SECOND))
            stamp = clock.of(due)
            for publisher, values in ((told, positions(due)), (asked, commanded(due))):
                message = JointState(name=list(JOINTS), position=array('d', values))
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, SECOND)
                publisher.publish(message)
            if number % round(RATE_HZ / CLOCK_HZ) == 0:
                reference, seen = TimeReference(source=NAMESPACE), due + noise.randrange(-JITTER_NS, JITTER_NS)
                reference.header.stamp.sec, reference.header.stamp.nanosec = divmod(seen, SECOND)
                reference.time_ref.sec, reference.time_ref.nanosec = divmod(stamp, SECOND)
                event.publish(reference)
            number += 1
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == '__main__':
    sys.exit(main())
