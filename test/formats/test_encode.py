"""The one call of the encode stage: it counts every sample, names the object, and never raises for what it is given."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from profiles import examples
from rosbags.typesys import Stores, get_typestore

from shadowhound_data_logger.core.config import FORMATS
from shadowhound_data_logger.formats.encoders import ENCODERS

IMU = 'go2_interfaces/msg/IMU'
COMPRESSED = 'sensor_msgs/msg/CompressedImage'
STAMP_NS = 1_760_788_800_250_000_000
JPEG = bytes.fromhex('ffd8ffc0000b080001000101011100ffda0008010100003f0000ffd9')
"""The smallest file with a frame header, a scan header and a byte of scan: one gray pixel."""
SENSOR_OF = {
    COMPRESSED: 'camera',
    'sensor_msgs/msg/Image': 'camera',
    'sensor_msgs/msg/PointCloud2': 'lidar',
    IMU: 'imu',
    'go2_interfaces/msg/Go2State': 'states',
    'go2_interfaces/msg/LowState': 'lowstate',
    'sensor_msgs/msg/JointState': 'joints',
    'sensor_msgs/msg/CameraInfo': 'camera_info',
    'nav_msgs/msg/Odometry': 'odom',
}
"""The default types."""


def content(type_name: str, ros: Any) -> dict[str, Any]:
    """Fields that give a valid message with something in it."""
    header = {'stamp': {'sec': 1, 'nanosec': 2}, 'frame_id': 'odom'}
    field = ros.make('sensor_msgs/msg/PointField', name='x', datatype=7, count=1)
    zeros = np.zeros(12, np.uint8)
    contents: dict[str, dict[str, Any]] = {
        COMPRESSED: {'header': header, 'format': 'jpeg', 'data': np.frombuffer(JPEG, np.uint8)},
        'sensor_msgs/msg/Image': {'height': 2, 'width': 2, 'step': 6, 'encoding': 'bgr8', 'data': zeros},
        'sensor_msgs/msg/PointCloud2': {
            'height': 1,
            'width': 3,
            'point_step': 4,
            'row_step': 12,
            'fields': [field],
            'data': zeros,
        },
        'sensor_msgs/msg/JointState': {'header': header, 'name': ['a', 'bc'], 'position': np.ones(2)},
        'sensor_msgs/msg/CameraInfo': {'header': header, 'distortion_model': 'plumb_bob', 'd': np.ones(5)},
        'nav_msgs/msg/Odometry': {'header': header, 'child_frame_id': 'base_link'},
    }
    return contents.get(type_name, {})


def test_every_format_of_the_settings_has_an_encoder() -> None:
    """The registry and the settings know the same formats."""
    assert set(ENCODERS) == set(FORMATS)


@pytest.mark.parametrize('type_name', SENSOR_OF)
def test_the_object_describes_itself(ros: Any, type_name: str) -> None:
    """Each default type gives an object with its sensor's bucket and priority, its topic, and metadata S3 can hold."""
    made = ros.encode(type_name, ros.cdr(type_name, **content(type_name, ros))).object
    sensor = ros.sensors[SENSOR_OF[type_name]]
    assert (made.bucket, made.sensor, made.topic, made.type) == ('sensor-data', sensor.name, f'/{sensor.name}', type_name)
    assert (made.priority, made.samples, made.t_start_ns, made.t_end_ns) == (sensor.priority, 1, STAMP_NS, STAMP_NS)
    assert made.metadata.items() >= {
        'robot': 'thor', 'sensor': sensor.name, 'topic': made.topic, 'type': type_name, 'count': '1', 't_start_ns': str(STAMP_NS),
        't_end_ns': str(STAMP_NS),
    }.items()  # fmt: skip
    assert all(name == name.lower() and value.isascii() and value.isprintable() for name, value in made.metadata.items())
    assert type(made.body) is bytes


def test_bad_samples_are_counted_and_the_rest_is_stored(ros: Any) -> None:
    """A batch loses exactly its bad samples; name and span come from those that are inside."""
    good = [ros.cdr(IMU, temperature=index) for index in range(3)]
    second = 1_000_000_000
    stamps = [STAMP_NS, STAMP_NS + second, STAMP_NS + 3 * second, STAMP_NS + 2 * second, STAMP_NS + 9 * second]
    encoding = ros.encode(IMU, b'', good[0], good[1], good[2], good[0][:-9], stamps=stamps)
    assert encoding.rejected == {'malformed': 2}
    assert encoding.object.samples == 3
    assert encoding.object.key == 'thor/imu/20251018/120001_imu.json'
    assert (encoding.object.t_start_ns, encoding.object.t_end_ns) == (stamps[1], stamps[2])
    assert [sample['temperature'] for sample in json.loads(encoding.object.body)['samples']] == [0, 1, 2]


def test_nothing_left(ros: Any) -> None:
    """A batch of nothing but bad samples gives no object."""
    encoding = ros.encode(IMU, b'x', b'y')
    assert encoding.object is None
    assert encoding.rejected == {'malformed': 2}


@pytest.mark.parametrize('format_name', ['jpeg', 'png', 'pcd'])
def test_a_type_the_format_is_not_for(ros: Any, format_name: str) -> None:
    """Every sample of a type that a format cannot hold is rejected as such."""
    encoding = ros.encode(IMU, ros.cdr(IMU), ros.cdr(IMU), format=format_name)
    assert encoding.object is None
    assert encoding.rejected == {'wrong_type': 2}


@pytest.mark.parametrize('format_name', FORMATS)
def test_a_type_without_a_definition(ros: Any, format_name: str) -> None:
    """Samples of an unknown type are rejected by all formats that have to read them; serialized bytes need no definition."""
    encoding = ros.encode('nobody_msgs/msg/X', b'\0\1\0\0', sensor='imu', format=format_name)
    reason = {'json': 'unknown_type', 'cdr': None, 'zip': None, 'tar': None}.get(format_name, 'wrong_type')
    assert encoding.rejected == ({reason: 1} if reason else {})
    assert (encoding.object is None) == bool(reason)


def test_the_first_of_each_reason_is_reported(ros: Any) -> None:
    """In addition to its count, each reason has a sentence about the first sample."""
    encoding = ros.encode('sensor_msgs/msg/Image', b'', b'', ros.cdr('sensor_msgs/msg/Image', encoding='bayer_rggb8'))
    assert encoding.rejected == {'malformed': 2, 'empty': 1}
    assert list(encoding.details) == ['malformed', 'empty']
    assert '0 x 0 pixels' in encoding.details['empty']


@pytest.mark.parametrize('type_name', [IMU, 'go2_interfaces/msg/VoxelMapCompressed', 'nobody_msgs/msg/X'])
def test_serialized_bytes(ros: Any, type_name: str) -> None:
    """With format cdr, the object is the received message, whatever its type; messages too short for CDR are rejected."""
    cdr = b'\0\1\0\0' + bytes(range(40))
    made = ros.encode(type_name, cdr, sensor='voxel_map').object
    assert made.body == cdr
    assert (made.key, made.content_type) == ('thor/voxel_map/20251018/120000_voxel_map.cdr', 'application/octet-stream')
    assert (made.type, made.metadata['type']) == (type_name, type_name)
    assert ros.encode(type_name, cdr[:3], sensor='voxel_map').rejected == {'malformed': 1}


def test_a_batch_of_images_counts_every_loss(ros: Any) -> None:
    """A format of one message takes the first good one of a batch and counts the others."""
    good = ros.cdr(COMPRESSED, data=np.frombuffer(JPEG, np.uint8))
    encoding = ros.encode(COMPRESSED, b'', good, good, b'')
    assert encoding.object.samples == 1
    assert encoding.rejected == {'malformed': 1, 'surplus': 2}


def test_a_key_that_cannot_be(ros: Any) -> None:
    """A key that a store could not hold rejects the samples instead of raising."""
    encoding = ros.encode(IMU, ros.cdr(IMU), key='{robot}/{date}/{time}/' + 'x' * 300)
    assert encoding.object is None
    assert encoding.rejected == {'unsafe_key': 1}


@pytest.mark.parametrize('type_name', SENSOR_OF)
@pytest.mark.parametrize('little_endian', [True, False])
def test_every_truncation(ros: Any, type_name: str, little_endian: bool) -> None:
    """A valid message of each default type, cut anywhere, is counted and raises nothing; whole it is kept."""
    cdr = ros.cdr(type_name, little_endian=little_endian, **content(type_name, ros))
    step = max(1, len(cdr) // 100)
    for length in range(0, len(cdr) - 3, step):
        encoding = ros.encode(type_name, cdr[:length])
        assert encoding.rejected == {'malformed': 1}, length
    assert ros.encode(type_name, cdr).object.samples == 1


@pytest.mark.parametrize('type_name', [*SENSOR_OF, 'visualization_msgs/msg/Marker', 'tf2_msgs/msg/TFMessage'])
@settings(derandomize=True, deadline=None, max_examples=examples(60))
@given(data=st.data())
def test_hostile_bytes(ros: Any, type_name: str, data: st.DataObject) -> None:
    """Random bytes, and valid messages with random changes, raise nothing and are all accounted for."""
    valid = bytearray(ros.cdr(type_name, **content(type_name, ros)))
    change = st.tuples(st.integers(0, len(valid) - 1), st.sampled_from([0, 1, 127, 128, 255]))
    for position, value in data.draw(st.lists(change, max_size=8)):
        valid[position] = value
    noise = data.draw(st.binary(max_size=200))
    samples = (bytes(valid), noise, b'\0\1\0\0' + noise, b'\0\0\0\0' + noise, bytes(valid[: len(valid) // 2]) + noise)
    for changes in ({}, {'format': data.draw(st.sampled_from(FORMATS))}):
        encoding = ros.encode(type_name, *samples, sensor=SENSOR_OF.get(type_name, 'imu'), **changes)
        kept = 0 if encoding.object is None else encoding.object.samples
        assert kept + sum(encoding.rejected.values()) == len(samples)
        assert encoding.details.keys() == encoding.rejected.keys()


@pytest.mark.long('more than a hundred types')
def test_any_standard_type(ros: Any) -> None:
    """A message of every type of a ROS distribution can be logged as JSON without a line of code for it."""
    names = [name for name in get_typestore(Stores.ROS2_KILTED).types if '/msg/' in name]
    assert len(names) > 100
    failed = {name: outcome.rejected for name in names if (outcome := ros.encode(name, ros.cdr(name), sensor='imu')).rejected}
    assert not failed
