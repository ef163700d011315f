"""Messages for the encoder tests, serialized by ``rosbags``: no ROS is needed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.model import Batch, Sample
from shadowhound_data_logger.formats.encoders import Encoding, encode
from shadowhound_data_logger.formats.types import MessageTypes

GO2_MESSAGES = Path(__file__).parents[2] / 'interfaces' / 'go2_interfaces' / 'msg'
STAMP_NS = 1_760_788_800_250_000_000
"""2025-10-18T12:00:00.25Z"""
TOPICS = {
    'sensor_msgs/msg/CompressedImage': 'camera',
    'sensor_msgs/msg/Image': 'camera',
    'sensor_msgs/msg/PointCloud2': 'lidar',
    'go2_interfaces/msg/IMU': 'imu',
    'go2_interfaces/msg/Go2State': 'states',
    'go2_interfaces/msg/LowState': 'lowstate',
    'sensor_msgs/msg/JointState': 'joints',
    'sensor_msgs/msg/CameraInfo': 'camera_info',
    'nav_msgs/msg/Odometry': 'odom',
}
"""Type of each default topic -> its sensor."""


class Ros:
    """Makes messages of any type, their CDR, and runs the encoder on them."""

    def __init__(self, prefix: Path) -> None:
        self.store = get_typestore(Stores.LATEST)
        for path in sorted(GO2_MESSAGES.glob('*.msg')):
            self.store.register(get_types_from_msg(path.read_text(), f'go2_interfaces/msg/{path.stem}'))
        self.types = MessageTypes([prefix])
        self.sensors = {sensor.name: sensor for sensor in Settings.load({}, {}).sensors}

    def make(self, type_name: str, **values: Any) -> Any:
        """A message of zeros and empty sequences, except for the given values (a dict makes the nested message)."""
        made = {}
        for name, description in self.store.fielddefs[type_name][1]:
            value = values.pop(name, None)
            if isinstance(value, dict):
                value = self.make(str(description[1]), **value)
            made[name] = self._default(description) if value is None else value
        assert not values, f'{type_name} has no {sorted(values)}'
        constants = {name: value for name, _, value in self.store.fielddefs[type_name][0]}
        kind: Any = self.store.types[type_name]
        return kind(**made, **{name: constants[name] for name in constants if name in kind.__dataclass_fields__})

    def _default(self, description: Any) -> Any:
        kind, inner = description
        if kind == Nodetype.NAME:
            return self.make(inner)
        if kind == Nodetype.BASE:
            return {'string': '', 'bool': False, 'float32': 0.0, 'float64': 0.0}.get(inner[0], 0)
        (item_kind, item), length = inner
        length = length if kind == Nodetype.ARRAY else 0
        if item_kind == Nodetype.NAME or item[0] == 'string':
            return [self._default(inner[0]) for _ in range(length)]
        return np.zeros(length, {'bool': np.bool_, 'byte': np.int8, 'char': np.uint8}.get(item[0], item[0]))

    def cdr(self, type_name: str, message: Any = None, *, little_endian: bool = True, **values: Any) -> bytes:
        message = self.make(type_name, **values) if message is None else message
        return bytes(self.store.serialize_cdr(message, type_name, little_endian=little_endian))

    def encode(self, type_name: str, *cdrs: bytes, sensor: str = '', stamps: Sequence[int] = (), **changes: Any) -> Encoding:
        """The encoder's result for these messages with the default settings of the type's sensor, and these changes."""
        name = sensor or TOPICS[type_name]
        settings = self.sensors[name]
        settings = type(settings)(**{field: getattr(settings, field) for field in settings.__slots__} | changes)
        stamps = stamps or [STAMP_NS + 10_000_000 * index for index in range(len(cdrs))]
        samples = tuple(Sample(stamp, cdr) for stamp, cdr in zip(stamps, cdrs, strict=True))
        return encode(Batch(name, f'/{name}', type_name, samples, sum(map(len, cdrs))), settings, 'thor', self.types)


@pytest.fixture(scope='session')
def prefix(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An ament prefix with go2_interfaces only."""
    share = tmp_path_factory.mktemp('prefix') / 'share' / 'go2_interfaces'
    share.mkdir(parents=True)
    (share / 'msg').symlink_to(GO2_MESSAGES, target_is_directory=True)
    return share.parents[1]


@pytest.fixture(scope='session')
def ros(prefix: Path) -> Ros:
    return Ros(prefix)
