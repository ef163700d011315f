"""The part of a message that is sent to a browser."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
from e2e.live_frames import opened
from rosbags.typesys import Stores, get_typestore

from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.core.options import COMPRESSED_IMAGE, IMAGE, POINT_CLOUD
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.live.kinds import (
    FULL,
    HALF,
    KINDS,
    MAX_NAME,
    MAX_NAMES,
    SIZES,
    SMALLEST,
    LiveItem,
    clouds,
    frames,
    series,
)

STORE = get_typestore(Stores.LATEST)
TYPES = MessageTypes()
INTERFACES = Path(__file__).parents[2] / 'interfaces'
ODOMETRY, JOINTS = 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/JointState'


def new(type_name: str, /, **given: Any) -> Any:
    return STORE.types[type_name](**given)


def header(frame_id: str = 'odom') -> Any:
    return new('std_msgs/msg/Header', stamp=new('builtin_interfaces/msg/Time', sec=1, nanosec=2), frame_id=frame_id)


def cdr(message: Any, name: str) -> bytes:
    return bytes(STORE.serialize_cdr(message, name))


def cloud(points: Any, **changed: Any) -> bytes:
    fields = [
        new('sensor_msgs/msg/PointField', name=name, offset=4 * place, datatype=7, count=1) for place, name in enumerate('xyz')
    ]
    given = {'header': header(), 'height': 1, 'width': len(points), 'fields': fields, 'is_bigendian': False, 'point_step': 16,
             'row_step': 16 * len(points), 'is_dense': True,
             'data': np.hstack([points, np.zeros((len(points), 1))]).astype('<f4').view(np.uint8).reshape(-1)}  # fmt: skip
    return cdr(new(POINT_CLOUD, **{**given, **changed}), POINT_CLOUD)


def image(pixels: Any, kind: str, **changed: Any) -> bytes:
    height, width, channels = pixels.shape
    given = {'header': header(), 'height': height, 'width': width, 'encoding': kind, 'is_bigendian': 0,
             'step': width * channels, 'data': pixels.reshape(-1)}  # fmt: skip
    return cdr(new(IMAGE, **{**given, **changed}), IMAGE)


def test_points_round_trip_within_half_a_step() -> None:
    """uint16 in the bounding box of the cloud; points that are not finite are skipped."""
    points = np.random.default_rng(1).uniform(-30, 30, (20_000, 3)).astype('<f4')
    points[7] = np.nan
    full, half, smallest = clouds('/points', TYPES, 12.5, cloud(points), SIZES)
    assert (full.size, half.size, smallest.size) == (FULL, HALF, SMALLEST)
    assert len(full.body) == 19_999 * 6
    assert full.head is not None
    assert full.head['at'] == 12.5
    steps = np.frombuffer(full.body, '<u2').reshape(-1, 3)
    found = np.array(full.head['low']) + steps * np.array(full.head['step'])
    assert np.abs(found - np.delete(points, 7, axis=0)).max() < 0.6 * max(full.head['step'])
    assert len(half.body) == 5_000 * 6
    assert len(smallest.body) == 1_250 * 6


@pytest.mark.filterwarnings('error')
def test_absurdly_far_points_are_removed() -> None:
    """With them all others would collapse to one point."""
    points = np.zeros((100, 3))
    points[:4] = [[1e30, 0, 0], [0, -3.4e38, 3.4e38], [np.inf, -np.inf, np.nan], [5.0, 6.0, 7.0]]
    (item,) = clouds('/points', TYPES, 0.0, cloud(points), [FULL])
    assert item.head is not None
    assert (item.head['points'], item.head['low']) == (97, [0.0, 0.0, 0.0])
    assert np.frombuffer(item.body, '<u2')[:3].tolist() == [65_535] * 3


def test_an_empty_cloud_and_one_of_a_single_point_are_shown() -> None:
    """Their bounding box has no extent."""
    for points in (np.empty((0, 3)), np.array([[1.0, 2.0, 3.0]])):
        (item,) = clouds('/points', TYPES, 0.0, cloud(points), [FULL])
        assert len(item.body) == 6 * len(points)


@pytest.mark.parametrize(
    'changed', [{'width': 1 << 30}, {'point_step': 8}, {'fields': []}, {'point_step': 0}, {'width': 0, 'point_step': 0xFFFF_FFFF}]
)
def test_a_cloud_that_contradicts_itself_is_rejected(changed: dict[str, Any]) -> None:
    """Nothing is allocated for the announced size."""
    with pytest.raises(Rejected):
        list(clouds('/points', TYPES, 0.0, cloud(np.zeros((10, 3)), **changed), [FULL]))


@pytest.mark.parametrize(('encoding', 'channels'), [('bgr8', 3), ('rgb8', 3), ('rgba8', 4), ('mono8', 1)])
def test_a_raw_image_becomes_a_jpeg_of_each_size(encoding: str, channels: int) -> None:
    """With a half and a quarter of its sides."""
    pixels = np.full((240, 320, channels), 128, np.uint8)
    made = list(frames('/image', IMAGE, TYPES, 0.0, image(pixels, encoding), SIZES))
    assert [simplejpeg.decode_jpeg_header(item.body)[:2] for item in made] == [(240, 320), (120, 160), (60, 80)]


@pytest.mark.parametrize('kind', ['', 'jpeg', 'bgr8; jpeg compressed bgr8'])
def test_a_compressed_image_is_sent_unchanged(kind: str) -> None:
    """Only smaller versions are encoded; other formats are sent unchanged in all sizes."""
    jpeg = simplejpeg.encode_jpeg(np.zeros((480, 640, 3), np.uint8), 80, 'BGR')
    message = new(COMPRESSED_IMAGE, header=header(), format=kind, data=np.frombuffer(jpeg, np.uint8))
    full, small = frames('/image', COMPRESSED_IMAGE, TYPES, 0.0, cdr(message, COMPRESSED_IMAGE), [FULL, SMALLEST])
    assert full.body == jpeg
    assert simplejpeg.decode_jpeg_header(small.body)[:2] == (120, 160)


def of_too_many_pixels() -> bytes:
    """A small JPEG with a header for 65,500 x 65,500."""
    jpeg = bytes(simplejpeg.encode_jpeg(np.zeros((8, 8, 3), np.uint8), 80, 'BGR'))
    at = jpeg.index(b'\xff\xc0') + 5
    return jpeg[:at] + struct.pack('>HH', 65_500, 65_500) + jpeg[at + 4 :]


@pytest.mark.parametrize('size', SIZES)
def test_a_jpeg_of_too_many_pixels_is_rejected(size: int) -> None:
    """At each size: a browser would need 17 GB for it."""
    message = new(COMPRESSED_IMAGE, header=header(), format='jpeg', data=np.frombuffer(of_too_many_pixels(), np.uint8))
    with pytest.raises(Rejected, match='pixels'):
        list(frames('/image', COMPRESSED_IMAGE, TYPES, 0.0, cdr(message, COMPRESSED_IMAGE), [size]))


@pytest.mark.parametrize('changed', [{'encoding': 'bayer'}, {'step': 1}, {'height': 1 << 20}, {'width': 0}])
def test_an_image_that_cannot_be_shown_is_rejected(changed: dict[str, Any]) -> None:
    """With a reason, and without other effects."""
    with pytest.raises(Rejected):
        list(frames('/image', IMAGE, TYPES, 0.0, image(np.zeros((8, 8, 3), np.uint8), 'bgr8', **changed), [FULL]))


@pytest.mark.parametrize('type_name', KINDS)
def test_broken_bytes_are_rejected(type_name: str) -> None:
    """For each kind."""
    kind, broken = KINDS[type_name], b'\0\1\0\0xyz'

    def show() -> None:
        if kind.values is not None:
            series('/topic', kind, type_name, TYPES, [(0.0, broken)])
        elif kind.name == 'cloud':
            list(clouds('/topic', TYPES, 0.0, broken, [FULL]))
        else:
            list(frames('/topic', type_name, TYPES, 0.0, broken, [FULL]))

    with pytest.raises(Rejected):
        show()


def test_rows_of_figures_come_with_their_times() -> None:
    """All times, then a row for each."""
    name, empty = 'sensor_msgs/msg/JointState', np.array([])
    joints = [cdr(new(name, header=header(), name=['a', 'b'], position=np.array([turn, 2.0]), velocity=empty, effort=empty), name)
              for turn in (0.5, 1.5)]  # fmt: skip
    item = series('/joints', KINDS[name], name, TYPES, [(10.0, joints[0]), (20.0, joints[1])])
    assert item is not None
    assert item.head == {'names': ['a', 'b'], 'rows': 2, 'at': 20.0}
    assert np.frombuffer(item.body[:16], '<f8').tolist() == [10.0, 20.0]
    assert np.frombuffer(item.body[16:], '<f4').tolist() == [0.5, 2.0, 1.5, 2.0]


def test_joints_without_end_are_cut() -> None:
    """Their number and the length of their names are limited."""
    name, empty = 'sensor_msgs/msg/JointState', np.array([])
    names = [f'{place:04}' * 25 for place in range(2000)]
    joints = cdr(new(name, header=header(), name=names, position=np.zeros(2000), velocity=empty, effort=empty), name)
    item = series('/joints', KINDS[name], name, TYPES, [(10.0, joints)])
    assert item.head is not None
    assert (len(item.head['names']), max(map(len, item.head['names']))) == (MAX_NAMES, MAX_NAME)


@pytest.mark.parametrize(('unknown', 'names'), [
    ('orientation', ['gyro', 'accel']), ('angular_velocity', ['rpy', 'accel']), ('linear_acceleration', ['rpy', 'gyro']),
    ('', ['rpy', 'gyro', 'accel']),
])  # fmt: skip
def test_what_an_imu_does_not_measure_is_not_shown(unknown: str, names: list[str]) -> None:
    """It is marked by -1 as the first element of the covariance."""
    name, vector = 'sensor_msgs/msg/Imu', new('geometry_msgs/msg/Vector3', x=1.0, y=2.0, z=3.0)
    given: dict[str, Any] = {'orientation': new('geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=0.0, w=1.0),
                             'angular_velocity': vector, 'linear_acceleration': vector}  # fmt: skip
    covariances = {f'{field}_covariance': np.array([-1.0 if field == unknown else 0.0, *[0.0] * 8]) for field in given}
    message = cdr(new(name, header=header(), **given, **covariances), name)
    item = series('/imu', KINDS[name], name, TYPES, [(10.0, message)])
    assert item.head is not None
    assert item.head['names'] == [f'{part}.{axis}' for part in names for axis in 'xyz']


def test_the_imu_of_a_go2_reads_the_same_both_ways(tmp_path: Path) -> None:
    """In one step, and field by field; other lengths or byte orders use the second way."""
    (tmp_path / 'share').mkdir()
    (tmp_path / 'share' / 'go2_interfaces').symlink_to(INTERFACES / 'go2_interfaces')
    name, types = 'go2_interfaces/msg/IMU', MessageTypes([tmp_path])
    messages = [(float(turn), b'\0\1\0\0' + struct.pack('<13fb', *np.arange(13) * turn, -5 * turn)) for turn in (1, 2)]
    at_once = series('/imu', KINDS[name], name, types, messages)
    by_field = series('/imu', KINDS[name]._replace(table=None), name, types, messages)
    assert at_once.packed == by_field.packed
    assert np.frombuffer(at_once.body[16:], '<f4')[[0, 9, 19]].tolist() == [10.0, -5.0, -10.0]
    other = b'\0\0\0\0' + struct.pack('>13fb', *range(13), -5)
    assert np.frombuffer(series('/imu', KINDS[name], name, types, [(1.0, other)]).body[8:], '<f4')[9] == -5.0


def both_ways(name: str, messages: list[tuple[float, bytes]]) -> tuple[bytes, bytes]:
    """The browser's data for these messages, read at fixed CDR offsets and field by field."""
    kind = KINDS[name]
    assert kind.table is not None
    assert kind.table([cdr for _, cdr in messages]) is not None
    at_once = series('/topic', kind, name, TYPES, messages)
    return at_once.packed, series('/topic', kind._replace(table=None), name, TYPES, messages).packed


@pytest.mark.parametrize('frame_id', ['', 'odom', 'a_frame', 'the_robot/odom'])
def test_an_odometry_reads_the_same_both_ways(frame_id: str) -> None:
    """Wherever the length of its text moves the numbers."""
    at_once, by_field = both_ways(ODOMETRY, [(10.0 * turn, odometry(frame_id, turn)) for turn in (1, 2)])
    assert at_once == by_field


@pytest.mark.parametrize('names', [['hip'], ['FL_hip', 'FL_calf_joint', ''], ['x' * 70, 'é']])
def test_joints_read_the_same_both_ways(names: list[str]) -> None:
    """With long names, with more positions than names, and with velocities."""
    cdrs = [joints(names, np.arange(len(names) + 1) * turn, np.zeros(turn)) for turn in (1, 2)]
    at_once, by_field = both_ways(JOINTS, [(10.0, cdrs[0]), (20.0, cdrs[1])])
    assert at_once == by_field


def test_joints_that_are_not_as_usual_are_read_by_field() -> None:
    """Duplicate names, none, fewer positions than names, and different names in each message."""
    table = KINDS[JOINTS].table
    assert table is not None
    usual = joints(['a', 'b'], np.zeros(2))
    assert table([usual]) is not None
    unusual = [[joints(['a', 'a'], np.zeros(2))], [joints([], np.zeros(0))], [joints(['a', 'b'], np.zeros(1))],
               [usual, joints(['a', 'c'], np.zeros(2))], [usual, joints(['a', 'b', 'c'], np.zeros(3))]]  # fmt: skip
    assert [table(cdrs) for cdrs in unusual] == [None] * len(unusual)


@pytest.mark.parametrize('size', [-1, -8, 60, 20, 1])
def test_truncated_messages_are_rejected(size: int) -> None:
    """Even if everything shown is there."""
    for name, whole in ((ODOMETRY, odometry('odom', 1)), (JOINTS, joints(['a', 'b'], np.zeros(2), np.zeros(2)))):
        with pytest.raises(Rejected):
            series('/topic', KINDS[name], name, TYPES, [(1.0, whole[:size])])


def test_what_is_too_large_for_float32_is_infinite() -> None:
    """As in numpy, which reads unusual messages."""
    with np.errstate(over='ignore'):
        item = series('/odom', KINDS[ODOMETRY], ODOMETRY, TYPES, [(1.0, odometry('odom', 1e300))])
    assert np.isinf(np.frombuffer(item.body[8:], '<f4')[0])


def odometry(frame_id: str, value: float) -> bytes:
    point, turn = (
        new('geometry_msgs/msg/Point', x=value, y=2.0, z=3.0),
        new('geometry_msgs/msg/Quaternion', x=0.1, y=0.2, z=0.3, w=0.9),
    )
    zero = new('geometry_msgs/msg/Vector3', x=0.0, y=0.0, z=0.0)
    pose = new('geometry_msgs/msg/PoseWithCovariance', pose=new('geometry_msgs/msg/Pose', position=point, orientation=turn),
               covariance=np.zeros(36))  # fmt: skip
    twist = new('geometry_msgs/msg/TwistWithCovariance', twist=new('geometry_msgs/msg/Twist', linear=zero, angular=zero),
                covariance=np.zeros(36))  # fmt: skip
    return cdr(new(ODOMETRY, header=header(frame_id), child_frame_id='base', pose=pose, twist=twist), ODOMETRY)


def joints(names: list[str], position: Any, velocity: Any = ()) -> bytes:
    return cdr(new(JOINTS, header=header(), name=names, position=np.array(position, 'f8'), velocity=np.zeros(len(velocity)),
                   effort=np.zeros(0)), JOINTS)  # fmt: skip


def test_a_header_is_valid_json_whatever_it_contains() -> None:
    """Half a surrogate, in a relayed name, and an integer that other readers reject are written anyway."""
    packed = LiveItem('/a', 'topics', head={'problem': 'ö', 'rate': float('nan')}).packed
    assert opened(packed)[0] == {'topic': '/a', 'kind': 'topics', 'problem': 'ö', 'rate': None}
    head = {'problem': 'a \ud800', 'number': 10**30}
    assert opened(LiveItem('/a', 'topics', head=head).packed)[0] == {'topic': '/a', 'kind': 'topics', **head}


def depth(values: Any, encoding: str, *, is_bigendian: bool = False) -> bytes:
    """A depth image."""
    height, width = values.shape
    pixels = np.frombuffer(values.tobytes(), np.uint8)
    message = new(IMAGE, header=header(), height=height, width=width, encoding=encoding, is_bigendian=int(is_bigendian),
                  step=width * values.itemsize, data=pixels)  # fmt: skip
    return cdr(message, IMAGE)


@pytest.mark.parametrize(('encoding', 'dtype', 'factor'), [('16UC1', '<u2', 1000), ('16UC1', '>u2', 1000), ('32FC1', '<f4', 1)])
def test_an_image_of_distances_has_colors_and_their_scale(encoding: str, dtype: str, factor: int) -> None:
    """The same colors for the same depth in all encodings; gray for unmeasured pixels."""
    meters = np.tile(np.linspace(0.5, 3.9, 64), (48, 1))
    meters[:, :8] = math.nan if encoding == '32FC1' else 0.0
    message = depth((meters * factor).astype(dtype), encoding, is_bigendian=dtype.startswith('>'))
    found = [*frames('/depth', IMAGE, TYPES, 7.0, message, SIZES)]
    assert [item.head for item in found] == [{'at': 7.0, 'scale': {'low': 0, 'high': 4.0, 'unit': 'm'}}] * 3
    pixels = simplejpeg.decode_jpeg(found[0].body, 'RGB')
    assert np.abs(pixels[20, 2].astype(int) - 118).max() < 12
    assert np.abs(pixels[20, 60].astype(int) - (24, 26, 76)).max() < 30
    assert simplejpeg.decode_jpeg(found[1].body, 'RGB').shape == (24, 32, 3)


def test_an_image_of_distances_that_contradicts_itself_is_rejected() -> None:
    """Its size differs from its header."""
    message = new(
        IMAGE, header=header(), height=48, width=64, encoding='16UC1', is_bigendian=0, step=128, data=np.zeros(99, np.uint8)
    )
    with pytest.raises(Rejected, match='size_mismatch'):
        list(frames('/depth', IMAGE, TYPES, 7.0, cdr(message, IMAGE), (FULL,)))


def test_a_place_on_earth_is_exact_to_a_centimeter() -> None:
    """Degrees do not fit into a float32; without a fix there is no position."""
    fix = 'sensor_msgs/msg/NavSatFix'
    for status, has_fix in ((0, True), (-1, False)):
        message = new(
            fix, header=header(), status=new('sensor_msgs/msg/NavSatStatus', status=status, service=1), latitude=47.123456789,
            longitude=-122.98765432, altitude=12.0, position_covariance=np.full(9, 4.0), position_covariance_type=1,
        )  # fmt: skip
        item = series('/fix', KINDS[fix], fix, TYPES, [(1.0, cdr(message, fix))])
        assert item.head is not None
        row = dict(zip(item.head['names'], np.frombuffer(item.body[8:], '<f4').astype(float), strict=True))
        if has_fix:
            assert row['lat'] + row['lat_rest'] == pytest.approx(47.123456789, abs=1e-8)
            assert row['lon'] + row['lon_rest'] == pytest.approx(-122.98765432, abs=1e-8)
            assert row['error'] == 2.0
        else:
            assert math.isnan(row['lat'])
