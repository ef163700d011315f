"""What ROS itself serializes is decoded to what was put in: the definitions and the CDR reader agree with the middleware."""

from __future__ import annotations

import importlib
import json
import os
from typing import Any

import numpy as np
import pytest

from shadowhound_data_logger.formats.types import MessageTypes

pytest.importorskip('rclpy')
from rclpy.serialization import serialize_message

pytestmark = pytest.mark.ros

TYPES = ['go2_interfaces/msg/IMU', 'go2_interfaces/msg/LowState', 'sensor_msgs/msg/Imu', 'sensor_msgs/msg/PointCloud2',
         'nav_msgs/msg/Odometry', 'sensor_msgs/msg/JointState']  # fmt: skip


def filled(message: Any, rng: np.random.Generator) -> Any:
    """Every field of a message filled with random content of its type."""
    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        if hasattr(value, 'get_fields_and_field_types'):
            filled(value, rng)
        elif kind.startswith('sequence<') and '/' in kind:
            setattr(message, name, [filled(nested(kind), rng) for _ in range(3)])
        elif kind.startswith('sequence<string'):
            setattr(message, name, ['left', 'right', 'ünï'])
        elif kind.startswith('sequence<'):
            setattr(message, name, numbers(kind, 5, rng).tolist())
        elif isinstance(value, list):
            setattr(message, name, [filled(item, rng) for item in value])
        elif isinstance(value, np.ndarray):
            setattr(message, name, rng.integers(0, 100, value.shape).astype(value.dtype) + value.dtype.type(0.5))
        elif isinstance(value, str):
            setattr(message, name, 'näme')
        else:
            setattr(message, name, type(value)(numbers(kind, 1, rng)[0]))
    return message


def nested(kind: str) -> Any:
    package, name = kind.removeprefix('sequence<').rstrip('>').split('/')
    return getattr(importlib.import_module(f'{package}.msg'), name)()


def numbers(kind: str, count: int, rng: np.random.Generator) -> Any:
    return rng.integers(0, 100, count) + (0.5 if 'float' in kind or 'double' in kind else 0)


def plain(value: Any) -> Any:
    """A ROS message, or a decoded one, as nested lists and dicts."""
    if hasattr(value, 'get_fields_and_field_types'):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if hasattr(value, '__dataclass_fields__'):
        return {name: plain(item) for name, item in vars(value).items() if name.islower() and not name.startswith('_')}
    if isinstance(value, list):
        return [plain(item) for item in value]
    return value.tolist() if hasattr(value, 'tolist') else value


@pytest.mark.parametrize('type_name', TYPES)
def test_decodes_what_ros_serialized(ros: Any, prefix: Any, type_name: str) -> None:
    """Every field of a message that rclpy serialized comes out with its value, by this machine's and the shipped definitions."""
    package, _, name = type_name.split('/')
    module = pytest.importorskip(f'{package}.msg')
    message = filled(getattr(module, name)(), np.random.default_rng(5))
    types = MessageTypes([*os.environ.get('AMENT_PREFIX_PATH', '').split(':'), prefix])
    cdr = serialize_message(message)
    assert plain(types.deserialize(type_name, cdr)) == plain(message)
    assert plain(ros.types.deserialize(type_name, cdr)) == plain(message), 'the shipped definition differs'


def test_floats_of_an_imu(ros: Any) -> None:
    """The float32 values that a robot published are equal to those in the JSON."""
    module = pytest.importorskip('go2_interfaces.msg')
    message = module.IMU(quaternion=np.array([0.1, -0.2, 1e-30, 1 / 3], np.float32))
    sample = json.loads(ros.encode('go2_interfaces/msg/IMU', serialize_message(message)).object.body)['samples'][0]
    assert np.array(sample['quaternion'], np.float32).tobytes() == message.quaternion.tobytes()
