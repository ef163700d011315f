"""Program of a test: a robot other than a Go2, with lidar, map, GPS, color and depth cameras, and texts that contain code.

The argument is the number of additional topics.
"""

from __future__ import annotations

import math
import sys
import time
from typing import Any

import numpy as np
import rclpy
import simplejpeg
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import BatteryState, CompressedImage, Image, Imu, JointState, LaserScan, NavSatFix
from std_msgs.msg import Float32, String

HOSTILE = '<img src=x onerror="window.attacked = 1">'
PERIOD_S = 0.05
WIDTH, HEIGHT, CELL = 12.0, 8.0, 0.05
"""Size of its room in meters."""
LATITUDE, LONGITUDE = 47.3769, 8.5417
DESCRIPTION = """<robot name="turtle"><link name="base_link">
<visual><geometry><cylinder radius="0.18" length="0.1"/></geometry></visual>
<visual><geometry><mesh filename="package://turtle/meshes/body.dae"/></geometry></visual></link>
<joint name="wheel" type="continuous"><axis xyz="0 1 0"/><parent link="base_link"/><child link="wheel"/>
<origin xyz="0 0.2 0"/></joint>
<link name="wheel"><visual><geometry><cylinder radius="0.07" length="0.03"/></geometry></visual></link></robot>"""


def room() -> OccupancyGrid:
    """Its walls."""
    found = OccupancyGrid()
    found.header.frame_id = 'odom'
    found.info.resolution, found.info.width, found.info.height = CELL, round(WIDTH / CELL), round(HEIGHT / CELL)
    found.info.origin.position.x, found.info.origin.position.y, found.info.origin.orientation.w = -WIDTH / 2, -HEIGHT / 2, 1.0
    cells = np.zeros((found.info.height, found.info.width), np.int8)
    cells[:2] = cells[-2:] = cells[:, :2] = cells[:, -2:] = 100
    found.data = cells.ravel().tolist()
    return found


def ranges(x: float, y: float, yaw: float) -> list[float]:
    """Distances to the walls in all directions."""
    angles = yaw - math.pi + np.arange(360) * math.pi / 180
    with np.errstate(divide='ignore'):
        to_sides = np.where(np.cos(angles) > 0, WIDTH / 2 - x, -WIDTH / 2 - x) / np.cos(angles)
        to_ends = np.where(np.sin(angles) > 0, HEIGHT / 2 - y, -HEIGHT / 2 - y) / np.sin(angles)
    return [float(each) for each in np.minimum(to_sides, to_ends)]


class Robot(Node):
    """Publishes all topics."""

    def __init__(self, more: int) -> None:
        super().__init__('turtle')
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        types = {
            '/scan': LaserScan, '/fix': NavSatFix, '/depth/image_raw': Image, '/front/compressed': CompressedImage,
            '/rear/compressed': CompressedImage, '/diagnostics': DiagnosticArray, '/odom': Odometry, '/imu/data': Imu,
            '/battery_state': BatteryState, '/joint_states': JointState, '/wheel/speed': Float32, '/wheel/name': String,
        }  # fmt: skip
        self.publishers_of: dict[str, Any] = {topic: self.create_publisher(kind, topic, 5) for topic, kind in types.items()}
        self.more = [self.create_publisher(Float32, f'/a/n{number}', 1) for number in range(more)]
        self.latched = [
            self.create_publisher(OccupancyGrid, '/map', latched),
            self.create_publisher(String, '/robot_description', latched),
        ]
        self.latched[0].publish(room())
        self.latched[1].publish(String(data=DESCRIPTION))

    def send(self, topic: str, message: Any) -> None:
        if hasattr(message, 'header'):
            message.header.stamp = self.get_clock().now().to_msg()
        self.publishers_of[topic].publish(message)

    def step(self, number: int) -> None:
        """Twenty times per second."""
        turn = number * PERIOD_S * 0.25
        x, y, yaw = 3 * math.cos(turn), 2 * math.sin(turn), math.atan2(2 * math.cos(turn), -3 * math.sin(turn))
        odometry, imu = Odometry(), Imu()
        odometry.header.frame_id = 'odom'
        odometry.pose.pose.position.x, odometry.pose.pose.position.y = x, y
        for orientation in (odometry.pose.pose.orientation, imu.orientation):
            orientation.z, orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
        self.send('/odom', odometry)
        self.send('/imu/data', imu)
        self.send('/wheel/speed', Float32(data=float(number)))
        if number % 2 == 0:
            scan = LaserScan(
                angle_min=-math.pi, angle_increment=math.pi / 180, range_min=0.1, range_max=20.0, ranges=ranges(x, y, yaw)
            )
            scan.header.frame_id = 'laser'
            self.send('/scan', scan)
            self.send('/joint_states', JointState(name=['wheel'], position=[turn]))
        if number % 4 == 0:
            for topic, shade in (('/front/compressed', 60), ('/rear/compressed', 200)):
                jpeg = simplejpeg.encode_jpeg(np.full((120, 160, 3), shade, np.uint8), 80)
                self.send(topic, CompressedImage(format='jpeg', data=bytes(jpeg)))
            depth = np.tile(np.linspace(500, 3800, 160), (120, 1)).astype('<u2')
            self.send('/depth/image_raw', Image(encoding='16UC1', width=160, height=120, step=320, data=depth.tobytes()))
        if number % 10 == 0:
            fix = NavSatFix(
                latitude=LATITUDE + y * 9e-6, longitude=LONGITUDE + x * 1.3e-5, altitude=408.0, position_covariance_type=1
            )
            self.send('/fix', fix)
            self.send('/battery_state', BatteryState(percentage=0.78, voltage=15.8))
            self.send('/wheel/name', String(data=HOSTILE))
            warning = DiagnosticStatus(level=b'\1', name='wifi', message=HOSTILE, values=[KeyValue(key='rssi', value='-71')])
            error = DiagnosticStatus(level=b'\2', name='motor', message='too hot')
            self.send('/diagnostics', DiagnosticArray(status=[DiagnosticStatus(name='lidar', message='10 Hz'), warning, error]))
            self.get_logger().warning(f'a wheel slips {HOSTILE}')


def main() -> None:
    rclpy.init()
    robot = Robot(int(sys.argv[1]))
    print('ready', flush=True)  # noqa: T201 - for the test
    due_s, number = time.monotonic(), 0
    while True:
        robot.step(number)
        number += 1
        due_s += PERIOD_S
        time.sleep(max(0.0, due_s - time.monotonic()))


if __name__ == '__main__':
    main()
