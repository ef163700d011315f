"""A plain logger as sketched by the integration guide (its Pattern 1), extended to all topics of a Go2.

One callback per message; an S3 put inside the callback; keys by the current second. Differences from the sketch are noted. It
is the baseline of ``node_cpu.py``, and also runs on its own: ``python bench/baseline_node.py``. On SIGINT it prints what it
received and put.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections import Counter
from datetime import datetime
from typing import Any

import boto3
import rclpy
from botocore.exceptions import BotoCoreError, ClientError
from go2_interfaces.msg import IMU, Go2State, LowState
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import CameraInfo, CompressedImage, JointState, PointCloud2

CAMERA_SKIP = 30
CLOUD_SKIP = 10
LOWSTATE_SKIP = 20
BATCH_S = 1.0


class BaselineNode(Node):  # type: ignore[misc]  # rclpy has no types
    """Subscribes, converts and uploads, all on the executor's only thread."""

    def __init__(self, odom_skip: int, robot: str) -> None:
        super().__init__('baseline_node')
        self.robot, self.odom_skip = robot, odom_skip
        self.received, self.puts, self.failures, self.put_s = Counter[str](), 0, 0, 0.0
        self.batches: dict[str, list[dict[str, Any]]] = {'imu': [], 'states': [], 'joints': []}
        self.began = dict.fromkeys(self.batches, time.monotonic())
        self.info: CameraInfo | None = None
        self.s3 = boto3.client(
            's3',
            endpoint_url=os.getenv('AWS_ENDPOINT_URL'),
            aws_access_key_id=os.getenv('AWS_ACCESS_KEY_ID'),
            aws_secret_access_key=os.getenv('AWS_SECRET_ACCESS_KEY'),
        )
        self.create_subscription(CompressedImage, '/camera/compressed', self.on_camera, 10)
        self.create_subscription(Odometry, '/odom', self.on_odom, 10)
        self.create_subscription(IMU, '/imu', self.on_imu, 10)
        self.create_subscription(Go2State, '/go2_states', self.on_state, 10)
        self.create_subscription(JointState, '/joint_states', self.on_joints, 10)
        self.create_subscription(LowState, '/lowstate', self.on_lowstate, 10)
        # With the guide's depth alone (RELIABLE) these two would receive nothing: their publishers are BEST_EFFORT.
        self.create_subscription(PointCloud2, '/point_cloud2', self.on_cloud, qos_profile_sensor_data)
        self.create_subscription(CameraInfo, '/camera/camera_info', self.on_camera_info, qos_profile_sensor_data)

    def on_camera(self, msg: Any) -> None:
        """Every 30th frame, as in the guide."""
        self.received['/camera/compressed'] += 1
        if self.received['/camera/compressed'] % CAMERA_SKIP == 0:
            self.upload('camera', 'front.jpg', bytes(msg.data), 'image/jpeg')

    def on_odom(self, msg: Any) -> None:
        """Each message, as in the guide; every 50th with ``--odom-skip 50``."""
        self.received['/odom'] += 1
        if self.received['/odom'] % self.odom_skip:
            return
        position, orientation, velocity = msg.pose.pose.position, msg.pose.pose.orientation, msg.twist.twist.linear
        odom = {
            'timestamp': datetime.now().strftime('%Y%m%d/%H%M%S'),  # noqa: DTZ005 - as in the guide
            'position': {'x': position.x, 'y': position.y, 'z': position.z},
            'orientation': {'x': orientation.x, 'y': orientation.y, 'z': orientation.z, 'w': orientation.w},
            'linear_velocity': {'x': velocity.x, 'y': velocity.y, 'z': velocity.z},
        }
        self.upload('odom', 'odom.json', json.dumps(odom).encode(), 'application/json')

    def on_cloud(self, msg: Any) -> None:
        """One per second, its points unchanged: the guide wants PCD, which adds only a header."""
        self.received['/point_cloud2'] += 1
        if self.received['/point_cloud2'] % CLOUD_SKIP == 0:
            self.upload('lidar', 'scan.bin', bytes(msg.data), 'application/octet-stream')

    def on_camera_info(self, msg: Any) -> None:
        """The first one."""
        self.received['/camera/camera_info'] += 1
        if self.info is None:
            self.info = msg
            body = {'width': msg.width, 'height': msg.height, 'd': list(msg.d), 'k': msg.k.tolist(), 'p': msg.p.tolist()}
            self.upload('camera_info', 'front.json', json.dumps(body).encode(), 'application/json')

    def on_imu(self, msg: Any) -> None:
        """The guide's batches of one second."""
        self.received['/imu'] += 1
        self.batch('imu', {
            'quaternion': msg.quaternion.tolist(), 'gyroscope': msg.gyroscope.tolist(), 'rpy': msg.rpy.tolist(),
            'accelerometer': msg.accelerometer.tolist(), 'temperature': msg.temperature,
        })  # fmt: skip

    def on_state(self, msg: Any) -> None:
        self.received['/go2_states'] += 1
        self.batch('states', {
            'mode': msg.mode, 'progress': msg.progress, 'gait_type': msg.gait_type, 'body_height': msg.body_height,
            'foot_raise_height': msg.foot_raise_height, 'position': msg.position.tolist(), 'velocity': msg.velocity.tolist(),
            'range_obstacle': msg.range_obstacle.tolist(), 'foot_force': msg.foot_force.tolist(),
            'foot_position_body': msg.foot_position_body.tolist(), 'foot_speed_body': msg.foot_speed_body.tolist(),
        })  # fmt: skip

    def on_joints(self, msg: Any) -> None:
        self.received['/joint_states'] += 1
        self.batch('joints', {'name': list(msg.name), 'position': list(msg.position)})

    def on_lowstate(self, msg: Any) -> None:
        """One per second: battery and motors."""
        self.received['/lowstate'] += 1
        if self.received['/lowstate'] % LOWSTATE_SKIP:
            return
        low = {
            'soc': msg.bms_state.soc, 'current': msg.bms_state.current, 'power_v': msg.power_v, 'power_a': msg.power_a,
            'motors': [{'q': motor.q, 'dq': motor.dq, 'temperature': motor.temperature} for motor in msg.motor_state],
        }  # fmt: skip
        self.upload('lowstate', 'lowstate.json', json.dumps(low).encode(), 'application/json')

    def batch(self, sensor: str, sample: dict[str, Any]) -> None:
        """Collect for a second, then upload as one JSON document."""
        self.batches[sensor].append(sample)
        if time.monotonic() - self.began[sensor] >= BATCH_S:
            body = json.dumps(self.batches[sensor]).encode()
            self.batches[sensor], self.began[sensor] = [], time.monotonic()
            self.upload(sensor, f'{sensor}.json', body, 'application/json')

    def upload(self, sensor: str, name: str, body: bytes, content_type: str) -> None:
        """Synchronously, with a key by the second, as in the guide."""
        now = datetime.now().strftime('%Y%m%d/%H%M%S')  # noqa: DTZ005 - as in the guide
        start = time.perf_counter()
        try:
            key = f'{self.robot}/{sensor}/{now}_{name}'
            self.s3.put_object(Bucket='sensor-data', Key=key, Body=body, ContentType=content_type)
            self.puts += 1
        except (BotoCoreError, ClientError) as error:
            self.failures += 1
            self.get_logger().error(f'Upload failed: {error}')
        self.put_s += time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--odom-skip', type=int, default=1, help='store every N-th odometry message (default 1: each)')
    parser.add_argument('--robot', default='baseline', help='what its keys begin with')
    options = parser.parse_args(remove_ros_args(sys.argv)[1:])
    rclpy.init()
    node = BaselineNode(options.odom_skip, options.robot)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        report = {'received': node.received, 'puts': node.puts, 'failures': node.failures, 'put_s': node.put_s}
        print(json.dumps(report), flush=True)
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()
