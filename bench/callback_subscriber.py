"""The minimal rclpy subscriber: raw messages, a callback that counts, a SingleThreadedExecutor.

It answers each line of standard input with the number of received messages. The baseline of ``intake.py``.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Imu

DEPTH = 2000


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--topic', default='/imu')
    options = parser.parse_args()
    received = 0

    def count(_: bytes) -> None:
        nonlocal received
        received += 1

    def answer() -> None:
        for _ in sys.stdin:
            print(json.dumps({'received': received}), flush=True)

    rclpy.init(args=[])
    node = Node('callback_subscriber', start_parameter_services=False, enable_rosout=False)
    node.create_subscription(Imu, options.topic, count, QoSProfile(depth=DEPTH), raw=True)
    threading.Thread(target=answer, daemon=True).start()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()
