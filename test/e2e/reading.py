"""Stored objects and recorded messages, read by libraries other than those that wrote them."""

from __future__ import annotations

import base64
import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message

from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.stores.base import ObjectStore

TYPES = {
    '/camera/compressed': 'sensor_msgs/msg/CompressedImage',
    '/camera/camera_info': 'sensor_msgs/msg/CameraInfo',
    '/point_cloud2': 'sensor_msgs/msg/PointCloud2',
    '/imu': 'go2_interfaces/msg/IMU',
    '/odom': 'nav_msgs/msg/Odometry',
    '/go2_states': 'go2_interfaces/msg/Go2State',
    '/joint_states': 'sensor_msgs/msg/JointState',
    '/lowstate': 'go2_interfaces/msg/LowState',
}
"""The sensors of the default profile."""
STRING = 'std_msgs/msg/String'


@dataclass(frozen=True, slots=True)
class Objects:
    """The stored objects of one robot (or below ``robot/sensor``), except housekeeping such as ledger and catalog."""

    contents: Mapping[str, bytes]
    """Key -> content."""
    infos: Mapping[str, ObjectInfo]

    @classmethod
    def of(cls, store: ObjectStore, bucket: str, robot: str) -> Objects:
        keys = [info.key for info in store.list(bucket, f'{robot}/') if not info.key.startswith(f'{robot}/_')]
        infos = {key: store.head(bucket, key) for key in keys}
        return cls({key: store.get(bucket, key) for key in keys}, {key: info for key, info in infos.items() if info})

    def without(self, prefix: str) -> Objects:
        """The objects not under these sensors."""
        keys = [key for key in self.contents if not key.startswith(prefix)]
        return Objects({key: self.contents[key] for key in keys}, {key: self.infos[key] for key in keys if key in self.infos})

    def sensor(self, name: str) -> dict[str, bytes]:
        return {key: body for key, body in self.contents.items() if key.split('/')[1] == name}

    def documents(self, name: str) -> list[dict[str, Any]]:
        return [json.loads(body) for body in self.sensor(name).values()]

    def samples(self, name: str) -> list[dict[str, Any]]:
        """All samples of a batched sensor."""
        found = []
        for document in self.documents(name):
            assert document['count'] == len(document['samples'])
            found += document['samples']
        return found

    def numbers(self, name: str) -> list[int]:
        """The numbers in the payloads of a sensor of Strings, sorted."""
        data = [str(sample['data']) for sample in self.samples(name)]
        return sorted(int(text) for text in data if text.isdigit())

    def counted(self) -> Counter[str]:
        """Topic -> samples, according to the objects' metadata."""
        counts: Counter[str] = Counter()
        for info in self.infos.values():
            counts[info.metadata['topic']] += int(info.metadata['count'])
        return counts


def message_class(type_name: str) -> Any:
    package, _, name = type_name.split('/')
    return getattr(import_module(f'{package}.msg'), name)


def decode(type_name: str, cdr: bytes) -> Any:
    """By rclpy, not by the encoders' library."""
    return deserialize_message(cdr, message_class(type_name))


def cdr(type_name: str, **fields: Any) -> bytes:
    return bytes(serialize_message(message_class(type_name)(**fields)))


def texts(words: Iterable[object]) -> list[bytes]:
    """Serialized Strings."""
    return [cdr(STRING, data=str(word)) for word in words]


def stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def assert_same(recorded: Any, value: Any, kind: str, where: str = '') -> None:
    """A JSON value equals the message's value of a ROS type, floats bit for bit."""
    if kind.startswith('sequence<uint8'):
        assert base64.b64decode(recorded) == bytes(value), where
    elif kind.endswith(']') or kind.startswith('sequence<'):
        item = (
            kind.removeprefix('sequence<').split(',')[0].rstrip('>')
            if kind.startswith('sequence<')
            else kind.split('[', maxsplit=1)[0]
        )
        assert len(recorded) == len(value), where
        for number, (one, other) in enumerate(zip(recorded, value, strict=True)):
            assert_same(one, other, item, f'{where}[{number}]')
    elif '/' in kind:
        fields = value.get_fields_and_field_types()
        assert set(fields) == set(recorded) - {'stamp_ns'}, where
        for name, inner in fields.items():
            assert_same(recorded[name], getattr(value, name), inner, f'{where}.{name}')
    elif kind == 'float':
        assert np.float32(recorded).tobytes() == np.float32(value).tobytes(), where
    elif kind == 'double':
        assert np.float64(recorded).tobytes() == np.float64(value).tobytes(), where
    else:
        assert recorded == value, where
