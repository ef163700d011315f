"""The encoders count every sample, name the object and never raise, also for hostile messages; examples of the page."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
from formats.hostile import TYPES, Fuzzer
from hypothesis import given, settings
from hypothesis import strategies as st
from profiles import examples
from rosbags.typesys import Stores, get_typestore

from shadowhound_data_logger.core.config import FORMATS
from shadowhound_data_logger.formats.definitions import describe
from shadowhound_data_logger.formats.encoders import ENCODERS
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import metadata_yaml
from shadowhound_data_logger.formats.mcap.slice_info import Channel
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.formats.rows.catalog import row_of
from shadowhound_data_logger.formats.rows.parts import encode
from shadowhound_data_logger.formats.types import header_frame_id, header_stamp_ns

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


def test_a_batch_without_valid_samples_gives_no_object(ros: Any) -> None:
    """A batch of nothing but bad samples gives no object."""
    encoding = ros.encode(IMU, b'x', b'y')
    assert encoding.object is None
    assert encoding.rejected == {'malformed': 2}


@pytest.mark.parametrize('format_name', ['jpeg', 'png', 'pcd'])
def test_a_type_that_the_format_does_not_support_is_rejected(ros: Any, format_name: str) -> None:
    """Every sample of a type that a format cannot hold is rejected as such."""
    encoding = ros.encode(IMU, ros.cdr(IMU), ros.cdr(IMU), format=format_name)
    assert encoding.object is None
    assert encoding.rejected == {'wrong_type': 2}


@pytest.mark.parametrize('format_name', FORMATS)
def test_a_type_without_a_definition_is_rejected_where_it_must_be_read(ros: Any, format_name: str) -> None:
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
def test_format_cdr_stores_the_serialized_bytes(ros: Any, type_name: str) -> None:
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


def test_an_invalid_key_is_rejected(ros: Any) -> None:
    """A key that a store could not hold rejects the samples instead of raising."""
    encoding = ros.encode(IMU, ros.cdr(IMU), key='{robot}/{date}/{time}/' + 'x' * 300)
    assert encoding.object is None
    assert encoding.rejected == {'unsafe_key': 1}


@pytest.mark.parametrize('type_name', SENSOR_OF)
@pytest.mark.parametrize('little_endian', [True, False])
def test_a_message_truncated_anywhere_is_counted(ros: Any, type_name: str, little_endian: bool) -> None:
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
def test_hostile_bytes_are_accounted_for(ros: Any, type_name: str, data: st.DataObject) -> None:
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
def test_every_standard_type_can_be_logged_as_json(ros: Any) -> None:
    """A message of every type of a ROS distribution can be logged as JSON without a line of code for it."""
    names = [name for name in get_typestore(Stores.ROS2_KILTED).types if '/msg/' in name]
    assert len(names) > 100
    failed = {name: outcome.rejected for name in names if (outcome := ros.encode(name, ros.cdr(name), sensor='imu')).rejected}
    assert not failed


ROUNDS = examples(1500)


def test_hostile_messages_take_bounded_memory(ros: Any) -> None:
    """No batch of hostile messages raises, takes memory beyond its size, or leaves a message unaccounted."""
    fuzzer = Fuzzer(ros)
    for seed in range(ROUNDS):
        try:
            fuzzer.round(seed)
        except Exception as error:
            raise AssertionError(f'seed {seed}') from error
    assert {'encoded', 'malformed', 'wrong_type', 'unknown_type', 'size_mismatch'} <= fuzzer.outcomes.keys()
    assert fuzzer.outcomes['encoded'] > ROUNDS / 10


def test_a_false_length_at_any_word_is_harmless(ros: Any) -> None:
    """Each 4-byte word of a message of each type, replaced by the largest number, is refused or harmless at once."""
    fuzzer = Fuzzer(ros)
    for type_name in TYPES:
        for cdr in fuzzer._valid.get(type_name, []):
            for at in range(4, min(len(cdr) - 3, 400), 4):
                ros.encode(type_name, cdr[:at] + b'\xff\xff\xff\xff' + cdr[at + 4 :], sensor='imu', format='json')


@settings(derandomize=True, deadline=None, max_examples=examples(200))
@given(
    st.one_of(
        st.binary(max_size=40), st.builds(bytes.__add__, st.sampled_from([b'\0\1\0\0', b'\0\0\0\0']), st.binary(max_size=60))
    )
)
def test_a_header_of_any_bytes_is_read_or_ignored(cdr: bytes) -> None:
    """What the intake reads of a message is a number and a text, whatever the bytes are; text never exceeds them."""
    assert abs(header_stamp_ns(cdr)) < 2**63
    assert len(header_frame_id(cdr).encode(errors='surrogatepass')) <= 3 * len(cdr)


ROOT = Path(__file__).parents[2]
PAGE = (ROOT / 'docs' / 'formats.md').read_text(encoding='utf-8')
START, *EXAMPLES = re.findall(r'^```python\n(.*?)^```', PAGE, re.DOTALL | re.MULTILINE)
CLOUD = 'sensor_msgs/msg/PointCloud2'
IMAGE = 'sensor_msgs/msg/Image'


def write_bag(folder: Path, imu: bytes) -> None:
    """One slice with a message that can be read."""
    folder.mkdir()
    writer = SliceWriter(folder / f'{folder.name}_0.mcap')
    channel = Channel('/imu', 'go2_interfaces/msg/IMU', *describe('go2_interfaces/msg/IMU'), '')
    writer.write(channel, 1_800_000_000_000_000_000, 1_800_000_000_000_000_000, 1, imu)
    (folder / 'metadata.yaml').write_bytes(metadata_yaml([writer.close()], ros_distro='humble'))


@pytest.fixture
def bucket(ros: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with one object of each kind under the name that the page gives it."""
    field = [ros.make('sensor_msgs/msg/PointField', name=name, offset=4 * at, datatype=7, count=1)
             for at, name in enumerate(('x', 'y', 'z', 'intensity'))]  # fmt: skip
    points = np.arange(12, dtype='<f4').view(np.uint8)
    cloud = ros.cdr(CLOUD, height=1, width=3, point_step=16, row_step=48, fields=field, data=points)
    depth = ros.cdr(IMAGE, height=1, width=2, step=4, encoding='16UC1', data=np.array([0, 5000], '<u2').view(np.uint8))
    jpeg = np.frombuffer(simplejpeg.encode_jpeg(np.zeros((4, 6, 3), np.uint8)), np.uint8)
    frame = ros.cdr(COMPRESSED, header={'frame_id': 'front'}, data=jpeg)
    imu, voxels = ros.cdr('go2_interfaces/msg/IMU'), ros.cdr('go2_interfaces/msg/VoxelMapCompressed', data=points)
    made = {
        '120000_front.jpg': ros.encode(COMPRESSED, frame),
        '120000_depth.png': ros.encode(IMAGE, depth),
        '120000_scan.pcd': ros.encode(CLOUD, cloud),
        '120000_imu.json': ros.encode('go2_interfaces/msg/IMU', imu, imu),
        '120000_voxel_map.cdr': ros.encode('go2_interfaces/msg/VoxelMapCompressed', voxels, sensor='voxel_map'),
        '120000_front.tar': ros.encode(COMPRESSED, frame, frame, format='tar', batch_s=1.0),
        '120001_front.tar': ros.encode(COMPRESSED, frame, format='tar', batch_s=1.0),
    }
    for name, encoding in made.items():
        (tmp_path / name).write_bytes(encoding.object.body)
    day = tmp_path / 'thor' / '_catalog' / 'date=2025-10-18'
    day.mkdir(parents=True)
    (day / 'part.jsonl.zst').write_bytes(encode([row_of('sensor-data', 'thor/camera/a.jpg', 1, '', {'pose': '3 1 0 odom'})]))
    shutil.copy(ROOT / 'interfaces' / 'go2_interfaces' / 'msg' / 'VoxelMapCompressed.msg', tmp_path)
    write_bag(tmp_path / 'patrol_20261121_120000', imu)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize('example', EXAMPLES, ids=[example.splitlines()[0][:40] for example in EXAMPLES])
def test_the_examples_of_the_page_on_formats_run(bucket: Path, example: str) -> None:
    """Each example runs unchanged; those of libraries that are not installed here are skipped."""
    for name in re.findall(r'^(?:import|from) (\w+)', example, re.MULTILINE):
        pytest.importorskip(name)
    exec(f'{START}\nfrom PIL import Image\n{example}', {})  # noqa: S102


def test_the_page_on_formats_has_an_example_of_every_kind() -> None:
    """The page opens a file of each extension that the encoder gives."""
    text = '\n'.join(EXAMPLES)
    assert not [ext for ext in ('jpg', 'png', 'tiff', 'pcd', 'json', 'cdr', 'tar', 'zip') if ext not in text]
