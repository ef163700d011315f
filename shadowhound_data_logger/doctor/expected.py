"""What a Go2's driver publishes: rates of the integration guide, reliability of go2_ros2_sdk's code."""

from __future__ import annotations

from typing import Final, NamedTuple


class Stream(NamedTuple):
    """A topic as it should be."""

    rate_hz: float
    reliable: bool | None = None
    """None where either will do."""
    optional: bool = False
    """Whether many robots do without."""


STREAMS: Final = {
    'camera/image_raw': Stream(30.0),
    'camera/compressed': Stream(30.0),
    'camera/camera_info': Stream(30.0),
    'point_cloud2': Stream(10.0),
    'imu': Stream(100.0, reliable=True),
    'odom': Stream(50.0, reliable=True),
    'go2_states': Stream(20.0, reliable=True),
    'joint_states': Stream(50.0, reliable=True),
    'lowstate': Stream(20.0, optional=True),
    'utlidar/voxel_map_compressed': Stream(10.0, optional=True),
}
"""By the topic's name in the settings."""
UNKNOWN: Final = Stream(0.0)
"""Nothing is expected of it."""
