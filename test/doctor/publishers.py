"""Program of a test: several robots in one domain, each in its namespace, each except the first with one fault."""

from __future__ import annotations

import os
import sys
import threading
import time

import rclpy
from geometry_msgs.msg import PoseStamped, Twist
from go2_interfaces.msg import IMU
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image, LaserScan, PointCloud2

RATE_HZ = 20.0
SLOW_EVERY = 20
"""One in this many."""
RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


def main() -> None:
    """Publish in an endless loop."""
    rclpy.init()
    node = Node('robots', start_parameter_services=False, enable_rosout=False)
    steady = []
    for name in ('well', 'mute', 'soft', 'deaf', 'two', 'squatted', 'slow', 'unheard'):
        kind = PoseStamped if name == 'squatted' else Odometry
        odometry = node.create_publisher(kind, f'/{name}/odom', BEST_EFFORT if name == 'soft' else RELIABLE)
        steady += [(odometry, kind())] if name not in {'mute', 'slow'} else []
        if name == 'slow':
            slow = odometry
        if name != 'unheard':
            steady.append((node.create_publisher(IMU, f'/{name}/imu', RELIABLE), IMU()))
        steady.append((node.create_publisher(PointCloud2, f'/{name}/point_cloud2', BEST_EFFORT), PointCloud2()))
    steady.append((node.create_publisher(LaserScan, '/other/scan', RELIABLE), LaserScan()))
    silent = [
        node.create_publisher(Image, '/other/front/image', RELIABLE),
        node.create_publisher(Twist, '/other/cmd_vel', RELIABLE),
    ]
    context = rclpy.Context()  # a participant has one type per topic
    rclpy.init(context=context)
    another = Node('another', context=context, start_parameter_services=False, enable_rosout=False)
    another.create_publisher(PoseStamped, '/two/odom', RELIABLE)
    node.create_subscription(PointCloud2, '/deaf/point_cloud2', lambda _: None, RELIABLE)
    assert all(silent)
    sys.stdout.write('ready\n')
    sys.stdout.flush()
    due, count = time.monotonic(), 0
    while True:
        for publisher, message in steady:
            publisher.publish(message)
        if count % SLOW_EVERY == 0:
            slow.publish(Odometry())
        count += 1
        due += 1 / RATE_HZ
        time.sleep(max(0.0, due - time.monotonic()))


def end() -> None:
    """Exit along with the parent."""
    sys.stdin.read()
    os._exit(0)


if __name__ == '__main__':
    threading.Thread(target=end, daemon=True).start()
    main()
