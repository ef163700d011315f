"""A publisher or a subscriber as a process: ``publisher_and_listener.py publisher|listener|guarded FILE``."""

from __future__ import annotations

import array
import sys
import time
from pathlib import Path

import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import UInt8MultiArray

from shadowhound_data_logger.ros.shared_memory import PortGuard, dead_ports_avoided

TOPIC = 'topic'
QOS = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


def publish(count: Path) -> None:
    """Publish in an endless loop, with a byte in the file for each message."""
    with dead_ports_avoided(rclpy.utilities.get_default_context().get_domain_id()):
        node = rclpy.create_node('publisher')
    publisher = node.create_publisher(UInt8MultiArray, TOPIC, QOS)
    message = UInt8MultiArray(data=array.array('B', bytes(10_000)))
    with count.open('wb', buffering=0) as file:
        while True:
            publisher.publish(message)
            file.write(b'.')
            time.sleep(0.02)


def listen(heard: Path, *, is_guarded: bool) -> None:
    """The file is created with the first message."""
    with dead_ports_avoided(rclpy.utilities.get_default_context().get_domain_id()):
        node = rclpy.create_node('listener')
    guard = PortGuard() if is_guarded else None
    node.create_subscription(UInt8MultiArray, TOPIC, lambda _: heard.touch(), QOS)
    rclpy.spin(node)
    if guard is not None:
        guard.close()


if __name__ == '__main__':
    rclpy.init()
    if sys.argv[1] == 'publisher':
        publish(Path(sys.argv[2]))
    listen(Path(sys.argv[2]), is_guarded=sys.argv[1] == 'guarded')
