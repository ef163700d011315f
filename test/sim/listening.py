"""Somebody who listens to the simulated Go2: polled raw subscriptions beside its process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from importlib.util import find_spec
from typing import Any

import rclpy
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState, PointCloud2

MODULE = 'shadowhound_sim.sim_go2_node'
COMMON = {
    'odom': 50, 'joint_states': 50, 'camera/image_raw': 30, 'camera/camera_info': 30, 'camera/compressed': 30, 'point_cloud2': 10,
}  # fmt: skip
GO2 = {'imu': 100, 'go2_states': 20, 'lowstate': 20}
RATES = {**COMMON, **GO2} if find_spec('go2_interfaces') else COMMON
BEST_EFFORT = {'camera/image_raw', 'camera/camera_info', 'point_cloud2'}
SECONDS = 5
"""Long enough for Fast DDS to find the publisher by its second announcement, 3 s after a first one that went amiss."""


def environment(domain: int, **more: str) -> dict[str, str]:
    return {**os.environ, 'ROS_DOMAIN_ID': str(domain), **more}


def command(*parameters: str) -> list[str]:
    """The robot as /tachi."""
    given = [word for parameter in parameters for word in ('-p', parameter)]
    return [sys.executable, '-m', MODULE, '--ros-args', '-r', '__ns:=/tachi', *given]


def published(output: str) -> dict[str, int]:
    """The one line on standard output."""
    lines = output.splitlines()
    assert len(lines) == 1, output
    counts: dict[str, int] = json.loads(lines[0])['published']
    return counts


def message_types() -> dict[str, Any]:
    types: dict[str, Any] = {
        'odom': Odometry, 'joint_states': JointState, 'camera/image_raw': Image, 'camera/camera_info': CameraInfo,
        'camera/compressed': CompressedImage, 'point_cloud2': PointCloud2,
    }  # fmt: skip
    if 'imu' in RATES:
        from go2_interfaces.msg import IMU, Go2State, LowState

        types |= {'imu': IMU, 'go2_states': Go2State, 'lowstate': LowState}
    return types


class Listener:
    """Polled raw subscriptions to all topics under ``/tachi``; ``taken`` holds what each one got, with its message info."""

    def __init__(self, domain: int) -> None:
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = Node('listener', namespace='/tachi', context=self._context, start_parameter_services=False)
        self.types = message_types()
        self.taken: dict[str, list[tuple[bytes, Any]]] = {name: [] for name in self.types}
        policy = QoSReliabilityPolicy
        self._subscriptions = {
            name: self.node.create_subscription(
                kind,
                name,
                lambda _message: None,
                QoSProfile(depth=200, reliability=policy.BEST_EFFORT if name in BEST_EFFORT else policy.RELIABLE),
            )
            for name, kind in self.types.items()
        }

    def poll(self) -> None:
        for name, subscription in self._subscriptions.items():
            with subscription.handle:
                while (taken := subscription.handle.take_message(self.types[name], True)) is not None:
                    self.taken[name].append((bytes(taken[0]), taken[1]))

    def last(self, name: str) -> Any:
        """The last message of a topic, deserialized."""
        return deserialize_message(self.taken[name][-1][0], self.types[name])

    def close(self) -> None:
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)


class Run:
    """Some seconds of the simulated Go2 as /tachi: what it said, what a listener got, what the graph showed."""

    def __init__(self, domain: int) -> None:
        listener = Listener(domain)
        try:
            process = subprocess.Popen(
                command(f'duration_s:={SECONDS}.0'),
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                env=environment(domain),
            )
            self.endpoints: dict[str, Any] = {}
            end = time.monotonic() + 120
            while process.poll() is None and time.monotonic() < end:
                listener.poll()
                if len(self.endpoints) < len(RATES):
                    self._look(listener)
                time.sleep(0.02)
            output, self.errors = process.communicate(timeout=60)
            listener.poll()
        finally:
            process.kill()
            listener.close()
        self.ended_ns = time.time_ns()
        self.listener, self.published, self.returncode = listener, published(output), process.returncode

    def _look(self, listener: Listener) -> None:
        for name in RATES:
            found = listener.node.get_publishers_info_by_topic(f'/tachi/{name}')
            if found:
                self.endpoints[name] = found[0]
