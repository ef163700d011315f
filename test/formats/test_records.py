"""JSON records and batches hold every field, every bit of every number, and say what could not be written."""

from __future__ import annotations

import base64
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from profiles import examples
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.core.model import Batch, Sample
from shadowhound_data_logger.formats.encoders import encode
from shadowhound_data_logger.formats.rows.catalog import row_of
from shadowhound_data_logger.formats.statistics import ALL, FieldStatistics
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.lake import decode

IMU = 'go2_interfaces/msg/IMU'
LOWSTATE = 'go2_interfaces/msg/LowState'
ODOMETRY = 'nav_msgs/msg/Odometry'
JOINTS = 'sensor_msgs/msg/JointState'
STAMP_NS = 1_760_788_800_250_000_000
EVERY_KIND = """
int64 low
uint64 high
bool yes
bool[2] flags
uint8[3] fixed
int8[] signed
uint8[] data
byte[<=4] bounded
char[] chars
byte octet
byte[2] octets
string text
string[2] pair
string[] list
uint16[<=3] shorts
builtin_interfaces/Time when
builtin_interfaces/Duration[2] spans
geometry_msgs/Point[] points
float64[] none
"""


def document(encoding: Any) -> Any:
    """The object's content, read by Python's own strict reader."""

    def refuse(word: str) -> None:
        raise AssertionError(f'{word} is not JSON')

    return json.loads(encoding.object.body, parse_constant=refuse)


def own_type(tmp_path: Path, text: str) -> MessageTypes:
    folder = tmp_path / 'share' / 'own_msgs' / 'msg'
    folder.mkdir(parents=True)
    (folder / 'Own.msg').write_text(text)
    return MessageTypes([tmp_path])


def record(types: MessageTypes, cdr: bytes, **settings_: Any) -> Any:
    sensor = SensorSettings(name='own', topics=('own',), **settings_)
    return document(encode(Batch('own', '/own', 'own_msgs/msg/Own', (Sample(STAMP_NS, cdr),), len(cdr)), sensor, 'thor', types))


def test_a_batch_has_each_sample_with_its_stamp(ros: Any) -> None:
    """A batch names its origin, its span and every sample with its own stamp and all fields in order."""
    cdrs = [ros.cdr(IMU, quaternion=np.array([index, 0, 0, 1], np.float32), temperature=index) for index in range(3)]
    encoding = ros.encode(IMU, *cdrs)
    batch = document(encoding)
    samples = batch.pop('samples')
    assert batch == {
        'robot': 'thor', 'sensor': 'imu', 'topic': '/imu', 'type': IMU, 'count': 3, 't_start_ns': STAMP_NS,
        't_end_ns': STAMP_NS + 20_000_000,
    }  # fmt: skip
    names = ['stamp_ns', 'quaternion', 'gyroscope', 'accelerometer', 'rpy', 'temperature']
    assert [list(sample) for sample in samples] == [names] * 3
    assert [sample['stamp_ns'] for sample in samples] == [STAMP_NS, STAMP_NS + 10_000_000, STAMP_NS + 20_000_000]
    assert samples[2]['quaternion'] == [2.0, 0.0, 0.0, 1.0]
    assert encoding.object.content_type == 'application/json'
    assert encoding.object.key == 'thor/imu/20251018/120000_imu.json'


def test_a_large_batch_is_complete_and_in_order(ros: Any) -> None:
    """However many messages a batch has, all are in it once and in order, and what is not finite is counted over all."""
    values = {index: float(index) for index in range(251)} | {0: np.nan, 150: -np.inf, 250: np.nan}
    cdrs = [ros.cdr(JOINTS, name=[str(index)], position=np.array([value])) for index, value in values.items()]
    batch = document(ros.encode(JOINTS, *cdrs[:100], b'', *cdrs[100:]))
    assert [sample['name'] for sample in batch['samples']] == [[str(index)] for index in range(251)]
    assert [batch['samples'][index]['position'][0] for index in (0, 1, 150, 249, 250)] == [None, 1.0, '-Infinity', 249.0, None]
    assert (batch['count'], batch['non_finite']) == (251, 3)


def test_a_single_odometry_is_the_documented_record(ros: Any) -> None:
    """A single Odometry is the documented record: these names, no others."""
    pose = {'pose': {'position': {'x': 1.0, 'y': -2.5, 'z': 0.3}, 'orientation': {'w': 1.0}}}
    twist = {'twist': {'linear': {'x': 0.5}, 'angular': {'z': -0.1}}}
    cdr = ros.cdr(ODOMETRY, header={'frame_id': 'odom'}, child_frame_id='base_link', pose=pose, twist=twist)
    encoding = ros.encode(ODOMETRY, cdr)
    assert document(encoding) == {
        'timestamp': '2025-10-18T12:00:00.250000Z',
        'stamp_ns': STAMP_NS,
        'frame_id': 'odom',
        'child_frame_id': 'base_link',
        'position': {'x': 1.0, 'y': -2.5, 'z': 0.3},
        'orientation': {'x': 0.0, 'y': 0.0, 'z': 0.0, 'w': 1.0},
        'linear_velocity': {'x': 0.5, 'y': 0.0, 'z': 0.0},
        'angular_velocity': {'x': 0.0, 'y': 0.0, 'z': -0.1},
    }
    assert encoding.object.key == 'thor/odom/20251018/120000_odom.json'


def test_batched_odometry_has_all_fields(ros: Any) -> None:
    """Batched odometry has all the fields of the message, covariances too."""
    batch = document(ros.encode(ODOMETRY, ros.cdr(ODOMETRY), batch_s=1.0))
    assert list(batch['samples'][0]) == ['stamp_ns', 'header', 'child_frame_id', 'pose', 'twist']
    assert len(batch['samples'][0]['pose']['covariance']) == 36


def test_a_record_of_any_other_type_has_all_fields(ros: Any) -> None:
    """A single message of any other type is next to its origin, time and stamp; headers and times are objects."""
    header = {'stamp': {'sec': 7, 'nanosec': 8}, 'frame_id': 'front'}
    info = document(ros.encode('sensor_msgs/msg/CameraInfo', ros.cdr('sensor_msgs/msg/CameraInfo', header=header, width=640)))
    assert list(info)[:6] == ['robot', 'sensor', 'topic', 'type', 'timestamp', 'stamp_ns']
    assert info['timestamp'] == '2025-10-18T12:00:00.250000Z'
    assert info['header'] == header
    assert info['width'] == 640
    assert (info['k'], info['d']) == ([0.0] * 9, [])
    assert info['roi'] == {'x_offset': 0, 'y_offset': 0, 'height': 0, 'width': 0, 'do_rectify': False}


def test_colliding_field_names_are_kept_apart(ros: Any, tmp_path: Path) -> None:
    """The document's own names win; a field of the same name gets an underscore, and never displaces another field."""
    types = own_type(tmp_path, 'int8 type\nint8 stamp_ns\nint8 non_finite\nint8 topic\nint8 topic_\n')
    cdr = b'\0\1\0\0\1\2\3\4\5'
    single = record(types, cdr)
    assert (single['type'], single['stamp_ns'], single['topic']) == ('own_msgs/msg/Own', STAMP_NS, '/own')
    assert [single[name] for name in ('type_', 'stamp_ns_', 'non_finite_', 'topic__', 'topic_')] == [1, 2, 3, 4, 5]
    sample = record(types, cdr, batch_s=1.0)['samples'][0]
    assert sample == {'stamp_ns': STAMP_NS, 'type': 1, 'stamp_ns_': 2, 'non_finite_': 3, 'topic': 4, 'topic_': 5}


def test_python_words_as_names(tmp_path: Path) -> None:
    """A field that is called like a Python keyword keeps its name."""
    assert record(own_type(tmp_path, 'int8 from\nint8 class\n'), b'\0\1\0\0\1\2')['from'] == 1


def test_constants_and_placeholders_are_not_fields(ros: Any, tmp_path: Path) -> None:
    """Constants of the definition, and the byte of a message without fields, are not written."""
    types = own_type(tmp_path, 'int8 LEFT=1\nstring NAME="x"\nint8 value\n')
    assert set(record(types, b'\0\1\0\0\5')) == {'robot', 'sensor', 'topic', 'type', 'timestamp', 'stamp_ns', 'value'}
    empty = document(ros.encode('std_msgs/msg/Empty', ros.cdr('std_msgs/msg/Empty'), sensor='odom'))
    assert list(empty) == ['robot', 'sensor', 'topic', 'type', 'timestamp', 'stamp_ns']


def test_every_kind_of_field_has_its_form_in_json(tmp_path: Path) -> None:
    """Scalars, arrays, sequences, bytes and nested messages each have their form, in big-endian CDR as well."""
    types = own_type(tmp_path, EVERY_KIND)
    store = get_typestore(Stores.LATEST)
    store.register(get_types_from_msg(EVERY_KIND, 'own_msgs/msg/Own'))
    make: Any = store.types
    time, span = make['builtin_interfaces/msg/Time'], make['builtin_interfaces/msg/Duration']
    message = make['own_msgs/msg/Own'](
        low=-(2**63),
        high=2**64 - 1,
        yes=True,
        flags=np.array([True, False]),
        fixed=np.array([1, 2, 255], np.uint8),
        signed=np.array([-1, 2], np.int8),
        data=np.array([0, 255, 7], np.uint8),
        bounded=np.array([1, 2], np.int8),
        chars=np.array([65], np.uint8),
        octet=-1,
        octets=np.array([-1, 2], np.int8),
        text='ünï\0"',
        pair=['a', ''],
        list=['null'],
        shorts=np.array([1, 65535], np.uint16),
        when=time(-5, 6),
        spans=[span(1, 2), span(3, 4)],
        points=[make['geometry_msgs/msg/Point'](1.0, 2.0, 3.0)],
        none=np.zeros(0),
    )
    for little_endian in (True, False):
        value = record(types, bytes(store.serialize_cdr(message, 'own_msgs/msg/Own', little_endian=little_endian)))
        assert {name: value[name] for name in list(value)[6:]} == {
            'low': -(2**63), 'high': 2**64 - 1, 'yes': True, 'flags': [True, False], 'fixed': [1, 2, 255], 'signed': [-1, 2],
            'data': base64.b64encode(b'\0\xff\7').decode(), 'bounded': base64.b64encode(b'\1\2').decode(), 'chars': 'QQ==',
            'octet': 255, 'octets': [255, 2],
            'text': 'ünï\0"', 'pair': ['a', ''], 'list': ['null'], 'shorts': [1, 65535], 'when': {'sec': -5, 'nanosec': 6},
            'spans': [{'sec': 1, 'nanosec': 2}, {'sec': 3, 'nanosec': 4}], 'points': [{'x': 1.0, 'y': 2.0, 'z': 3.0}], 'none': [],
        }  # fmt: skip


def test_empty_sequences_are_empty_lists(ros: Any) -> None:
    """Empty sequences at the end of a message are empty lists."""
    batch = document(ros.encode(JOINTS, ros.cdr(JOINTS, name=['a', 'b'], position=np.array([0.1, 0.2]))))
    sample = batch['samples'][0]
    assert (sample['name'], sample['position'], sample['velocity'], sample['effort']) == (['a', 'b'], [0.1, 0.2], [], [])


def test_nested_messages_become_objects(ros: Any) -> None:
    """Nested messages and arrays of them become objects; float32 scalars are as short and exact as float32 arrays."""
    motor = ros.make('go2_interfaces/msg/MotorState', q=0.1, temperature=-4, reserve=np.array([1, 2], np.uint32))
    remote = np.arange(40, dtype=np.uint8)
    cdr = ros.cdr(LOWSTATE, motor_state=[motor] * 20, bms_state={'soc': 87}, power_v=28.7, wireless_remote=remote)
    body = ros.encode(LOWSTATE, cdr).object.body
    sample = json.loads(body)['samples'][0]
    assert len(sample['motor_state']) == 20
    assert sample['motor_state'][19]['reserve'] == [1, 2]
    assert sample['bms_state']['soc'] == 87
    assert sample['wireless_remote'] == list(range(40))
    assert b'"q":0.1,' in body
    assert b'"power_v":28.7,' in body


def test_non_finite_numbers_have_a_form_in_json_and_are_counted(ros: Any) -> None:
    """NaN is null, infinities are texts, in arrays and scalars, and the document says how many there were."""
    bad = np.array([np.nan, 1, np.inf, -np.inf], np.float32)
    batch = document(ros.encode(IMU, ros.cdr(IMU, quaternion=bad), ros.cdr(IMU)))
    assert batch['samples'][0]['quaternion'] == [None, 1.0, 'Infinity', '-Infinity']
    assert batch['non_finite'] == 3
    odometry = document(ros.encode(ODOMETRY, ros.cdr(ODOMETRY, pose={'pose': {'position': {'x': float('nan')}}})))
    assert odometry['position'] == {'x': None, 'y': 0.0, 'z': 0.0}
    assert odometry['non_finite'] == 1
    lowstate = document(ros.encode(LOWSTATE, ros.cdr(LOWSTATE, power_a=float('-inf'))))
    assert (lowstate['samples'][0]['power_a'], lowstate['non_finite']) == ('-Infinity', 1)


@pytest.mark.parametrize(('kind', 'values'), [
    ('sensor_msgs/msg/Imu', {'orientation_covariance': [-1.0, *[0.0] * 8]}),
    ('sensor_msgs/msg/NavSatFix', {'status': {'status': -1, 'service': 1}, 'latitude': 48.1, 'position_covariance_type': 0}),
    ('sensor_msgs/msg/Temperature', {'temperature': 41.5, 'variance': 0.0}),
    ('sensor_msgs/msg/FluidPressure', {'fluid_pressure': 101325.0, 'variance': 0.0}),
    ('sensor_msgs/msg/RelativeHumidity', {'relative_humidity': 0.42, 'variance': 0.0}),
    ('sensor_msgs/msg/BatteryState', {'percentage': 0.73, 'capacity': 10.0}),
])  # fmt: skip
def test_values_and_marks_are_those_of_the_message(ros: Any, kind: str, values: dict[str, Any]) -> None:
    """Marks of what is unknown (REP 145: -1) and units (degrees Celsius, pascal, 0 to 1) are stored unchanged."""
    given = {name: np.array(value) if isinstance(value, list) else value for name, value in values.items()}
    (sample,) = document(ros.encode(kind, ros.cdr(kind, **given), sensor='imu'))['samples']
    assert {
        name: pytest.approx(sample[name], rel=1e-6) if isinstance(sample[name], float) else sample[name] for name in values
    } == values


def test_the_text_null_is_not_a_number(ros: Any) -> None:
    """Text that contains ``null`` counts as nothing missing."""
    batch = document(ros.encode(JOINTS, ros.cdr(JOINTS, name=['null', 'a null', ',null,'])))
    assert batch['samples'][0]['name'] == ['null', 'a null', ',null,']
    assert 'non_finite' not in batch


def test_the_float_that_short_decimals_lose_is_exact(ros: Any) -> None:
    """7.038531e-26 read by way of float64 is another float32: it and its negative are written longer."""
    awkward = float.fromhex('0x1.5c87fap-84')
    assert np.float32(float('7.038531e-26')) != np.float32(awkward), 'the reason for this test is gone'
    values = np.array([awkward, -awkward, 0.1, 1], np.float32)
    sample = document(ros.encode(IMU, ros.cdr(IMU, quaternion=values)))['samples'][0]
    assert np.array(sample['quaternion'], np.float32).tobytes() == values.tobytes()
    power = document(ros.encode(LOWSTATE, ros.cdr(LOWSTATE, power_v=awkward)))['samples'][0]['power_v']
    assert np.float32(power) == np.float32(awkward)


def unlike(value: Any) -> str | None:
    """What JSON has of a number that is not finite."""
    return None if np.isnan(value) else 'Infinity' if value > 0 else '-Infinity'


def test_infinities_of_a_scan_round_trip(ros: Any) -> None:
    """REP 117: nothing within range, too close, and an invalid reading are three things, to a strict parser and ``decode``."""
    scan, ranges = 'sensor_msgs/msg/LaserScan', [1.5, math.inf, -math.inf, math.nan, 0.1]
    cdrs = [ros.cdr(scan, ranges=np.array(ranges, np.float32), range_max=math.inf)] * 2
    batch = Batch('scan', '/scan', scan, tuple(Sample(STAMP_NS, cdr) for cdr in cdrs), 1000)
    body = encode(batch, SensorSettings(name='scan', topics=('scan',), batch_s=1.0), 'thor', ros.types).object.body
    assert isinstance(body, bytes)
    data = json.loads(body, parse_constant=pytest.fail)
    assert data['samples'][0]['ranges'] == [1.5, 'Infinity', '-Infinity', None, 0.1]
    assert data['non_finite'] == 8
    values = decode.table(decode.records(body), scan, ('ranges', 'range_max'), 0).values
    assert np.array_equal(values.astype(np.float32), np.array([[*ranges, math.inf]] * 2, np.float32), equal_nan=True)
    assert decode.table(decode.records(body), scan, (), 0).values.shape == (2, len(ranges) + 7)


def test_statistics_count_infinities(ros: Any) -> None:
    """Among what is not finite, also where they are read from the JSON again."""
    found = FieldStatistics()
    found.add([{'a': ['Infinity', 1.0, None], 'b': '-Infinity', 'c': 'text'}, {'a': [2.0, 1.0, 3.0], 'b': 4.0, 'c': 'Infinite'}])
    assert {name: (each.count, each.nan_count, each.max) for name, each in found.result().items() if name != ALL} == {
        'a.0': (1, 1, 2.0), 'a.1': (2, 0, 1.0), 'a.2': (1, 1, 3.0), 'b': (1, 1, 4.0),
    }  # fmt: skip


@settings(derandomize=True, deadline=None, max_examples=examples(150))
@given(
    words=st.lists(st.integers(0, 2**32 - 1), min_size=4, max_size=4),
    longs=st.lists(st.integers(0, 2**64 - 1), max_size=5),
    names=st.lists(st.text(st.characters(exclude_categories=['Cs']), max_size=8), max_size=3),
)
def test_numbers_and_text_read_back_bit_for_bit(ros: Any, words: list[int], longs: list[int], names: list[str]) -> None:
    """Any finite float32 or float64 and any text comes out of the JSON as it went in; the rest is null and counted."""
    singles, doubles = np.array(words, np.uint32).view(np.float32), np.array(longs, np.uint64).view(np.float64)
    batch = document(ros.encode(IMU, ros.cdr(IMU, quaternion=singles)))
    power = document(ros.encode(LOWSTATE, ros.cdr(LOWSTATE, power_v=float(singles[0]))))['samples'][0]['power_v']
    for value, back in zip([*singles, singles[0]], [*batch['samples'][0]['quaternion'], power], strict=True):
        assert back == unlike(value) if not np.isfinite(value) else np.float32(back).tobytes() == value.tobytes()
    assert batch.get('non_finite', 0) == 4 - np.isfinite(singles).sum()
    sample = document(ros.encode(JOINTS, ros.cdr(JOINTS, name=names, position=doubles)))['samples'][0]
    assert sample['name'] == names
    for value, back in zip(doubles, sample['position'], strict=True):
        assert back == unlike(value) if not np.isfinite(value) else np.float64(back).tobytes() == value.tobytes()


@pytest.mark.parametrize('batch_s', [0.0, 1.0])
def test_a_batch_of_several_messages_keeps_them_all(ros: Any, batch_s: float) -> None:
    """Whatever the settings say, a batch of several messages is written as a batch."""
    encoding = ros.encode(ODOMETRY, ros.cdr(ODOMETRY), ros.cdr(ODOMETRY), batch_s=batch_s)
    assert document(encoding)['count'] == encoding.object.samples == 2


def test_an_object_has_both_times_of_its_messages() -> None:
    """When they were measured, when they arrived, and of those that are dated by their arrival what their stamps were."""
    cdr, second = b'\0\1\0\0' + bytes(8), 10**9
    samples = (Sample(STAMP_NS, cdr, STAMP_NS + second), Sample(STAMP_NS + 2 * second, cdr, STAMP_NS + 2 * second, None, 77))
    batch = Batch('talk', '/talk', 'std_msgs/msg/Int64', samples, 24)
    made = encode(batch, SensorSettings(name='talk', batch_s=5.0, format='json'), 'thor', MessageTypes()).object
    assert made is not None
    assert {name: int(made.metadata[name]) for name in made.metadata if name.endswith('_ns')} == {
        't_start_ns': STAMP_NS, 't_end_ns': STAMP_NS + 2 * second, 'received_start_ns': STAMP_NS + second,
        'received_end_ns': STAMP_NS + 2 * second, 'stamp_start_ns': 77, 'stamp_end_ns': 77,
    }  # fmt: skip
    assert made.metadata['by_arrival'] == '1'
    row = row_of('sensor-data', made.key, 24, made.content_type, made.metadata)
    assert (row['received_start_ns'], row['received_end_ns'], row['by_arrival']) == (STAMP_NS + second, STAMP_NS + 2 * second, 1)
