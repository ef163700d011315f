"""How to log a topic that no sensor names, by its message type (``capture.topics``)."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from typing import Any, Final

from shadowhound_data_logger.core.config import NOT_SETTINGS
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.core.options import ARCHIVES, COMPRESSED_IMAGE, GROUPS, IMAGE, POINT_CLOUD, SensorSettings

UNITREE_PACKAGES: Final = ('go2_interfaces', 'unitree_go', 'unitree_hg')
"""Only Unitree robots publish types of these packages; the default sensors were made for them."""
_BATCHED: Final[Mapping[str, Any]] = {'rate_hz': 0.0, 'batch_s': 1.0, 'priority': 4}
_SLOW: Final[Mapping[str, Any]] = {'rate_hz': 0.0, 'batch_s': 10.0, 'priority': 3}
_ON_CHANGE: Final[Mapping[str, Any]] = {'rate_hz': 0.0, 'on_change': True, 'priority': 2}
_GEOMETRY: Final = (
    'Accel AccelStamped Point PointStamped Pose Pose2D PoseStamped PoseWithCovariance PoseWithCovarianceStamped Quaternion '
    'QuaternionStamped Transform TransformStamped Twist TwistStamped TwistWithCovariance TwistWithCovarianceStamped Vector3 '
    'Vector3Stamped Wrench WrenchStamped'
)
_SENSOR: Final = (
    'FluidPressure Illuminance Imu JointState Joy LaserScan MagneticField MultiDOFJointState NavSatFix NavSatStatus Range '
    'RelativeHumidity Temperature TimeReference'
)
_STD: Final = (
    'Bool Byte Char Float32 Float32MultiArray Float64 Float64MultiArray Header Int16 Int16MultiArray Int32 Int32MultiArray Int64 '
    'Int64MultiArray Int8 String UInt16 UInt16MultiArray UInt32 UInt32MultiArray UInt64 UInt64MultiArray UInt8'
)
RULES: Final[Mapping[str, Mapping[str, Any]]] = {
    COMPRESSED_IMAGE: {'format': 'jpeg', 'priority': 6},
    IMAGE: {'format': 'jpeg', 'priority': 6},
    POINT_CLOUD: {'format': 'pcd', 'priority': 7},
    'sensor_msgs/msg/CameraInfo': _ON_CHANGE,
    'nav_msgs/msg/OccupancyGrid': {**_ON_CHANGE, 'format': 'cdr', 'priority': 6},
    'nav_msgs/msg/Path': _ON_CHANGE,
    'nav_msgs/msg/Odometry': {**_BATCHED, 'priority': 3},
    'tf2_msgs/msg/TFMessage': _BATCHED,
    'sensor_msgs/msg/BatteryState': _SLOW,
    'diagnostic_msgs/msg/DiagnosticArray': _SLOW,
    'rcl_interfaces/msg/Log': _SLOW,
    'unitree_go/msg/WirelessController': _BATCHED,
    'unitree_go/msg/Go2FrontVideoData': {**_BATCHED, 'format': 'tar', 'priority': 6},
    'unitree_hg/msg/BmsState': _SLOW,
    **{f'sensor_msgs/msg/{name}': _BATCHED for name in _SENSOR.split()},
    **{f'geometry_msgs/msg/{name}': _BATCHED for name in _GEOMETRY.split()},
    **{f'std_msgs/msg/{name}': _BATCHED for name in _STD.split()},
}
"""Message type -> settings of its sensor. Images and clouds once per second, numbers in batches of a second; other types are
not logged. Latched topics are logged on change, whatever their type.
"""
_LATCHED: Final = frozenset({COMPRESSED_IMAGE, IMAGE, POINT_CLOUD})
"""Types whose rule also applies to latched publishers."""


NOT_LOGGED: Final = frozenset({'/parameter_events', '/rosout', '/clock'})
"""Topics of ROS itself, such as the node's own log."""


def is_of_unitree(type_name: str) -> bool:
    """Whether only a Unitree robot publishes this type."""
    return type_name.partition('/')[0] in UNITREE_PACKAGES


def not_logged(topic: str, type_name: str, graph: Mapping[str, Collection[str]]) -> str:
    """Why no sensor is created for a topic, given the types of all topics; empty if one is."""
    if type_name not in RULES:
        return f'there is no rule for {type_name}; name a sensor for it in the settings'
    if type_name == IMAGE and COMPRESSED_IMAGE in graph.get(f'{topic}/compressed', ()):
        return f'{topic}/compressed is'
    return ''


def sensor_for(topic: str, type_name: str, taken: Collection[str], *, is_latched: bool) -> SensorSettings | None:
    """The sensor of a topic (full name), with a name that is not in ``taken``; None for a type without a rule."""
    rule = RULES.get(type_name)
    if rule is None:
        return None
    if is_latched and type_name not in _LATCHED:
        of_type = rule.get('format', 'json')
        rule = {**_ON_CHANGE, 'format': 'cdr' if of_type in ARCHIVES else of_type}
    base = re.sub(r'[^A-Za-z0-9_]', '_', topic.strip('/'))[:60]
    names = [base, *(f'{base}_{number}' for number in range(2, 100))]
    reserved = {'robot', 'sensors', *GROUPS, *NOT_SETTINGS, *taken}
    name = next((name for name in names if is_name(name) and name not in reserved), None)
    return None if name is None else SensorSettings(name=name, topics=(topic,), types=(type_name,), **rule)
