"""Program of tests: another participant in the robot's ROS domain, with many topics, and publishers that come and go.

Standard input: ``topics N BYTES`` creates N publishers of Strings that publish once per second from then on, ``churn N``
creates N more that publish a few messages each and leave, ``leave`` removes all of them. The response to each is ``done``.
"""

from __future__ import annotations

import random
import sys
import threading
import time
from contextlib import suppress
from typing import Any, Final

import rclpy
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Int32, String

AT_ONCE: Final = 50
"""Publishers that exist at the same time; two of three on existing topics."""
MESSAGES: Final = 3
REST_S: Final = 0.05
KINDS: Final = (
    (ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE), (ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE),
    (ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL),
)  # fmt: skip


class Crowd:
    """One participant; a separate thread publishes for the permanent publishers."""

    def __init__(self) -> None:
        self.node = Node('crowd', start_parameter_services=False, enable_rosout=False)
        self.standing: list[Any] = []
        self.message = String()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._talk)
        self._thread.start()

    def topics(self, count: int, size: int) -> None:
        self.message = String(data='x' * size)
        for number in range(count):
            self.standing.append(self.node.create_publisher(String, f'/crowd/topic_{number}', _profile(number)))

    def churn(self, count: int) -> None:
        done = 0
        while done < count:
            group = []
            for number in range(done, min(done + AT_ONCE, count)):
                is_new = number % 3 == 0
                topic = f'/crowd/passing_{number}' if is_new else f'/crowd/topic_{random.randrange(len(self.standing))}'
                kind, message = (Int32, Int32()) if is_new and number % 2 else (String, self.message)
                group.append((self.node.create_publisher(kind, topic, _profile(number)), message))
            for _ in range(MESSAGES):
                time.sleep(REST_S)
                for publisher, message in group:
                    publisher.publish(message)
            time.sleep(10 * REST_S)
            for publisher, _ in group:
                self.node.destroy_publisher(publisher)
            done += len(group)

    def leave(self) -> None:
        standing, self.standing = self.standing, []
        for publisher in standing:
            self.node.destroy_publisher(publisher)

    def end(self) -> None:
        self._ended.set()
        self._thread.join()
        self.node.destroy_node()

    def _talk(self) -> None:
        while not self._ended.wait(1.0):
            for publisher in tuple(self.standing):
                with suppress(InvalidHandle):  # it has just been destroyed
                    publisher.publish(self.message)


def _profile(number: int) -> QoSProfile:
    reliability, durability = KINDS[number % len(KINDS)]
    return QoSProfile(depth=10, reliability=reliability, durability=durability)


def main() -> None:
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    crowd = Crowd()
    for line in sys.stdin:
        word, *figures = line.split()
        getattr(crowd, word)(*map(int, figures))
        sys.stdout.write('done\n')
        sys.stdout.flush()
    crowd.end()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
