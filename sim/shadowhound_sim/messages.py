"""The messages of the real Go2 driver, filled from the simulated world.

Types, frames, order and QoS are those of go2_ros2_sdk's ``go2_driver_node.py`` and ``ros2_publisher.py``; ``camera/compressed``
is what ``image_transport republish`` makes of its images. Every message object is created once and reused: the result of
``fill`` is valid until the next ``fill``.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
import simplejpeg
from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState, PointCloud2, PointField

from shadowhound_data_logger.core.clock import SECOND, iso
from shadowhound_sim import camera, gait
from shadowhound_sim.camera import Camera
from shadowhound_sim.lidar import Lidar
from shadowhound_sim.world import World

JPEG_QUALITY: Final = 80
BASE_HEIGHT: Final = 0.07
"""The driver's offset to the height of the body in ``odom``, m."""
DRIVER_ORDER: Final = (1, 0, 3, 2)
"""The driver publishes joints as FL, FR, RL, RR; the robot itself counts FR, FL, RR, RL."""


class SimulatedTopic(NamedTuple):
    """A topic relative to the namespace; all are VOLATILE and KEEP_LAST."""

    name: str
    type: Any
    is_reliable: bool = True
    depth: int = 10


class SimulatedSensor(Protocol):
    """One sensor: its topics, its rate, and its messages."""

    @property
    def rate_hz(self) -> float: ...

    @property
    def topics(self) -> tuple[SimulatedTopic, ...]: ...

    def fill(self, t: float, stamp_ns: int, /) -> Iterator[Any]:
        """One message for each of ``topics``, in order: the world ``t`` seconds after the start."""


class CameraSource:
    """``camera/image_raw``, ``camera/camera_info``, ``camera/compressed``: one frame, one stamp."""

    rate_hz = 30.0

    def __init__(self, world: World, *, image_raw: bool, compressed: bool) -> None:
        self._world, self._camera, self._frames = world, Camera(world), 0
        self._raw, self._compressed = image_raw, compressed
        raw = (SimulatedTopic('camera/image_raw', Image, False, 1),) if image_raw else ()
        jpeg = (SimulatedTopic('camera/compressed', CompressedImage),) if compressed else ()
        self.topics: tuple[SimulatedTopic, ...] = (*raw, SimulatedTopic('camera/camera_info', CameraInfo, False, 1), *jpeg)
        self._image = Image(height=camera.HEIGHT, width=camera.WIDTH, encoding='bgr8', step=camera.WIDTH * 3)
        self._image.data = array('B', bytes(camera.WIDTH * camera.HEIGHT * 3))
        # Drawn in place, into the array in the message, which may be a copy of the original one.
        self._pixels = np.frombuffer(self._image.data, np.uint8).reshape(camera.HEIGHT, camera.WIDTH, 3)
        self._info = _camera_info()
        self._jpeg = CompressedImage(format='bgr8; jpeg compressed bgr8')
        for message in (self._image, self._info, self._jpeg):
            message.header.frame_id = 'front_camera'

    def fill(self, t: float, stamp_ns: int) -> Iterator[Any]:
        """The frame is drawn if a topic needs it; its number and time are drawn into it."""
        caption = f'{iso(stamp_ns)[:-4]}Z #{self._frames:06d} {self._world.room(t)}'
        self._frames += 1
        for message in (self._image, self._info, self._jpeg):
            _stamp(message.header.stamp, stamp_ns)
        if self._raw or self._compressed:
            self._camera.draw(t, caption, self._pixels)
        if self._raw:
            yield self._image
        yield self._info
        if self._compressed:
            encoded = simplejpeg.encode_jpeg(self._pixels, JPEG_QUALITY, 'BGR', '420', True)
            self._jpeg.data = array('B', encoded)
            yield self._jpeg


class CloudSource:
    """``point_cloud2``: x, y, z, intensity as float32 in the frame ``odom``."""

    rate_hz = 10.0
    topics = (SimulatedTopic('point_cloud2', PointCloud2, False, 1),)

    def __init__(self, world: World) -> None:
        self._lidar = Lidar(world)
        fields = [
            PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
            for i, name in enumerate(('x', 'y', 'z', 'intensity'))
        ]
        self._cloud = PointCloud2(height=1, fields=fields, is_bigendian=False, point_step=16, is_dense=True)
        self._cloud.header.frame_id = 'odom'

    def fill(self, t: float, stamp_ns: int) -> Iterator[Any]:
        points = self._lidar.scan(t).astype('<f4', copy=False)
        _stamp(self._cloud.header.stamp, stamp_ns)
        self._cloud.width, self._cloud.row_step = len(points), 16 * len(points)
        self._cloud.data = array('B', points.tobytes())
        yield self._cloud


class OdometrySource:
    """``odom``: a pose without a twist, as from the driver."""

    rate_hz = 50.0
    topics = (SimulatedTopic('odom', Odometry),)

    def __init__(self, world: World) -> None:
        self._world, self._odom = world, Odometry(child_frame_id='base_link')
        self._odom.header.frame_id = 'odom'

    def fill(self, t: float, stamp_ns: int) -> Iterator[Any]:
        pose, message = self._world.pose(t), self._odom.pose.pose
        _stamp(self._odom.header.stamp, stamp_ns)
        message.position.x, message.position.y, message.position.z = pose.x, pose.y, pose.z + BASE_HEIGHT
        turn = message.orientation
        turn.w, turn.x, turn.y, turn.z = pose.quaternion
        yield self._odom


class JointSource:
    """``joint_states``: twelve positions; the driver has no velocities or efforts."""

    rate_hz = 50.0
    topics = (SimulatedTopic('joint_states', JointState),)

    def __init__(self, world: World) -> None:
        self._world = world
        names = [f'{gait.LEGS[leg]}_{joint}_joint' for leg in DRIVER_ORDER for joint in ('hip', 'thigh', 'calf')]
        self._joints = JointState(name=names)

    def fill(self, t: float, stamp_ns: int) -> Iterator[Any]:
        legs = self._world.legs(t)
        _stamp(self._joints.header.stamp, stamp_ns)
        self._joints.position = array('d', [angle for leg in DRIVER_ORDER for angle in legs[leg].joints])
        yield self._joints


def sources(world: World, *, image_raw: bool, compressed: bool) -> list[SimulatedSensor]:
    """The sensors with standard ROS 2 message types."""
    return [
        OdometrySource(world),
        JointSource(world),
        CameraSource(world, image_raw=image_raw, compressed=compressed),
        CloudSource(world),
    ]


def _camera_info() -> Any:
    """The calibration of the simulated camera: an ideal pinhole."""
    f, cx, cy = camera.FOCAL, camera.WIDTH / 2, camera.HEIGHT / 2
    info = CameraInfo(height=camera.HEIGHT, width=camera.WIDTH, distortion_model='plumb_bob')
    info.d = array('d', [0.0] * 5)
    info.k = np.array([f, 0, cx, 0, f, cy, 0, 0, 1], np.float64)
    info.r = np.eye(3, dtype=np.float64).ravel()
    info.p = np.array([f, 0, cx, 0, 0, f, cy, 0, 0, 0, 1, 0], np.float64)
    return info


def _stamp(stamp: Time, stamp_ns: int) -> None:
    stamp.sec, stamp.nanosec = divmod(stamp_ns, SECOND)
