"""Message definitions are found and decode what ROS serialized; hostile bytes are rejected."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from rosbags.typesys import get_types_from_msg

from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.formats.types import MessageTypes, header_stamp_ns

pytest.importorskip('rclpy')

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


@pytest.mark.ros
@pytest.mark.parametrize('type_name', TYPES)
def test_messages_serialized_by_ros_are_decoded(ros: Any, prefix: Any, type_name: str) -> None:
    """Every field of a message that rclpy serialized comes out with its value, by this machine's and the shipped definitions."""
    package, _, name = type_name.split('/')
    module = pytest.importorskip(f'{package}.msg')
    message = filled(getattr(module, name)(), np.random.default_rng(5))
    types = MessageTypes([*os.environ.get('AMENT_PREFIX_PATH', '').split(':'), prefix])
    cdr = serialize_message(message)
    assert plain(types.deserialize(type_name, cdr)) == plain(message)
    assert plain(ros.types.deserialize(type_name, cdr)) == plain(message), 'the shipped definition differs'


@pytest.mark.ros
def test_floats_are_exact(ros: Any) -> None:
    """The float32 values that a robot published are equal to those in the JSON."""
    module = pytest.importorskip('go2_interfaces.msg')
    message = module.IMU(quaternion=np.array([0.1, -0.2, 1e-30, 1 / 3], np.float32))
    sample = json.loads(ros.encode('go2_interfaces/msg/IMU', serialize_message(message)).object.body)['samples'][0]
    assert np.array(sample['quaternion'], np.float32).tobytes() == message.quaternion.tobytes()


IMU = 'go2_interfaces/msg/IMU'
HEADER = {'stamp': {'sec': 1_760_788_800, 'nanosec': 250_000_000}, 'frame_id': 'base_link'}


def define(prefix: Path, package: str, **texts: str) -> Path:
    folder = prefix / 'share' / package / 'msg'
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / f'{name}.msg').write_text(text)
    return prefix


def reason_of(types: MessageTypes, type_name: str, cdr: bytes) -> str:
    with pytest.raises(Rejected) as caught:
        types.deserialize(type_name, cdr)
    return caught.value.reason


@pytest.mark.parametrize('little_endian', [True, False])
def test_both_endiannesses_are_decoded(ros: Any, little_endian: bool) -> None:
    """Little- and big-endian CDR decode to the same values, arrays included."""
    quaternion = np.array([0.1, -2.5, 3e-38, np.inf], np.float32)
    cdr = ros.cdr(IMU, quaternion=quaternion, temperature=-7, little_endian=little_endian)
    message = ros.types.deserialize(IMU, cdr)
    np.testing.assert_array_equal(message.quaternion, quaternion)
    assert message.temperature == -7


@pytest.mark.parametrize('little_endian', [True, False])
def test_a_counter_is_read_at_its_offset(ros: Any, little_endian: bool) -> None:
    """Behind arrays of messages, at the place that their sizes and alignments give it."""
    low = 'go2_interfaces/msg/LowState'
    cdr = ros.cdr(low, tick=4_000_000_000, little_endian=little_endian)
    counter = ros.types.counter(low, 'tick')
    assert (counter.read(cdr), counter.wrap) == (4_000_000_000, 1 << 32)
    assert counter.read(cdr[:100]) == 0
    cycle = ros.types.counter(low, 'bms_state.cycle')
    assert (cycle.read(cdr), cycle.wrap) == (0, 1 << 16)


@pytest.mark.parametrize('field', ['tock', 'imu_state', 'power_v', 'tick.of', 'foot_force', 'imu_state.tock', ''])
def test_fields_that_cannot_be_counters_are_refused(ros: Any, field: str) -> None:
    """A field that is not there, or no single whole number."""
    with pytest.raises(Rejected, match='unknown_field'):
        ros.types.counter('go2_interfaces/msg/LowState', field)


def test_a_counter_behind_a_text_has_no_place(ros: Any) -> None:
    """Its place changes from message to message."""
    assert ros.types.counter('sensor_msgs/msg/Image', 'header.stamp.nanosec').offset == 8
    with pytest.raises(Rejected, match='variable length'):
        ros.types.counter('sensor_msgs/msg/Image', 'height')


def test_installed_definitions_take_precedence(ros: Any, tmp_path: Path) -> None:
    """A definition in a prefix wins over the one of the same name that rosbags ships, and the first prefix wins."""
    first = define(tmp_path / 'a', 'std_msgs', ColorRGBA='uint8 shade\n')
    second = define(tmp_path / 'b', 'std_msgs', ColorRGBA='float64 shade\n')
    types = MessageTypes([first, second])
    assert [name for name, _ in types.fields('std_msgs/msg/ColorRGBA')] == ['shade']
    assert types.deserialize('std_msgs/msg/ColorRGBA', b'\0\1\0\0\x2a').shade == 42
    assert [name for name, _ in ros.types.fields('std_msgs/msg/ColorRGBA')] == ['r', 'g', 'b', 'a']


def test_an_installed_nested_definition_takes_precedence(tmp_path: Path) -> None:
    """A dependency found on the machine replaces the shipped one inside a shipped message."""
    types = MessageTypes([define(tmp_path, 'geometry_msgs', Vector3='float32 x\r\nfloat32 y\r\n')])
    message = types.deserialize('geometry_msgs/msg/Vector3Stamped', b'\0\1\0\0' + bytes(8) + b'\1\0\0\0\0\0\0\0' + bytes(8))
    assert (message.vector.x, message.vector.y) == (0.0, 0.0)


@pytest.mark.parametrize('type_name', ['nobody_msgs/msg/Nothing', '../../etc/msg/passwd', 'std_msgs/String', '', 'a/srv/B'])
def test_unknown_types_are_rejected(ros: Any, type_name: str) -> None:
    """A type without a definition, or that is not a message type's name, is rejected every time and has no header."""
    assert [reason_of(ros.types, type_name, b'\0\1\0\0') for _ in range(2)] == ['unknown_type'] * 2
    assert not ros.types.has_header(type_name)


@pytest.mark.parametrize(
    'texts',
    [
        {'A': 'this is not a definition'},
        {'A': 'other_msgs/Missing x\n'},
        {'A': 'B b\n', 'B': 'A a\n'},
        {'A': 'wstring text\n'},
        {'A': 'int32 from\nint32 from_\n'},
    ],
    ids=['garbage', 'missing dependency', 'recursive', 'unsupported', 'ambiguous'],
)
def test_an_unusable_definition_affects_only_its_type(tmp_path: Path, texts: dict[str, str]) -> None:
    """A definition that cannot be used makes its type unknown, and no other."""
    types = MessageTypes([define(tmp_path, 'bad_msgs', **texts)])
    assert reason_of(types, 'bad_msgs/msg/A', b'\0\1\0\0') == 'unknown_type'
    assert types.has_header('sensor_msgs/msg/Imu')


def test_a_definition_that_is_not_text_is_unusable(tmp_path: Path) -> None:
    """A definition file that is not UTF-8 makes its type unknown."""
    (define(tmp_path, 'bad_msgs', A='') / 'share/bad_msgs/msg/A.msg').write_bytes(b'\xff\xfe\0')
    assert reason_of(MessageTypes([tmp_path]), 'bad_msgs/msg/A', b'\0\1\0\0') == 'unknown_type'


def test_a_nested_type_is_usable_alone(ros: Any) -> None:
    """A type that was loaded as part of another can be requested afterwards."""
    types = MessageTypes()
    assert types.has_header('sensor_msgs/msg/PointCloud2')
    assert not types.has_header('sensor_msgs/msg/PointField')
    assert types.deserialize('sensor_msgs/msg/PointField', ros.cdr('sensor_msgs/msg/PointField', name='x')).name == 'x'


def test_bad_text_does_not_lose_the_message(ros: Any) -> None:
    """Bytes that are not UTF-8 become U+FFFD; the rest of the message, arrays too, is what it was."""
    names = ['ankle', 'knee']
    cdr = ros.cdr('sensor_msgs/msg/JointState', header=HEADER, name=names, position=np.array([1.5, 2.5]))
    message = ros.types.deserialize('sensor_msgs/msg/JointState', cdr.replace(b'ankle', b'an\xff\xc3e'))
    assert message.name == ['an\ufffd\ufffde', 'knee']
    assert message.position.tolist() == [1.5, 2.5]
    assert message.header.frame_id == 'base_link'


@pytest.mark.parametrize('cdr', [b'', b'\0', b'\0\1\0', b'\0\1\0\0', b'\0\3\0\0' + bytes(53), b'\x7f\1\0\0' + bytes(53)])
def test_other_encapsulations_are_malformed(ros: Any, cdr: bytes) -> None:
    """Too few bytes, or another encapsulation than plain CDR, is malformed."""
    assert reason_of(ros.types, IMU, cdr) == 'malformed'


def test_truncated_and_overlong_messages_are_malformed(ros: Any) -> None:
    """A message that is truncated or too long is malformed; up to four bytes of padding do not belong to the message."""
    cdr = ros.cdr(IMU)
    assert reason_of(ros.types, IMU, cdr[:-1]) == 'malformed'
    assert reason_of(ros.types, IMU, cdr + bytes(5)) == 'malformed'
    assert ros.types.deserialize(IMU, cdr + bytes(4)).temperature == 0


LYING = """
import resource, sys
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.core.errors import Rejected
types = MessageTypes()
names = ['sensor_msgs/msg/PointCloud2', 'sensor_msgs/msg/JointState', 'std_msgs/msg/Float64MultiArray', 'tf2_msgs/msg/TFMessage']
for name in names:
    types.fields(name)
resource.setrlimit(resource.RLIMIT_AS, (2**31, 2**31))
reasons = []
for name in names:
    for fill in (b'\\xff', b'\\x7f', b'\\x00\\xff'):
        for start in range(4, 40, 4):
            cdr = b'\\0\\1\\0\\0' + bytes(start) + fill * 200
            try:
                types.deserialize(name, cdr)
            except Rejected as error:
                reasons.append(error.reason)
print(len(reasons), set(reasons))
"""


@pytest.mark.parametrize('flags', [[], ['-O']], ids=['plain', 'optimized'])
def test_false_lengths_allocate_nothing(flags: list[str]) -> None:
    """Lengths such as 0xFFFFFFFF are malformed within 2 GiB of address space, with assertions on or off."""
    done = subprocess.run([sys.executable, *flags, '-c', LYING], capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout.endswith("{'malformed'}\n"), done.stdout + done.stderr
    assert int(done.stdout.split()[0]) > 50


def test_threads_may_read_concurrently(ros: Any, prefix: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight threads that ask one fresh object for the same types all get right answers, and each file is read once."""
    read = []

    def parse(text: str, name: str) -> Any:
        read.append(name)
        time.sleep(0.001)  # lets the other threads in, where nothing keeps them out
        return get_types_from_msg(text, name)

    monkeypatch.setattr('shadowhound_data_logger.formats.types.get_types_from_msg', parse)
    types = MessageTypes([prefix])
    names = ['go2_interfaces/msg/LowState', 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/Imu', IMU] * 8
    cdrs = {name: ros.cdr(name) for name in set(names)}
    with ThreadPoolExecutor(8) as pool:
        messages = list(pool.map(lambda name: types.deserialize(name, cdrs[name]), names))
    assert [message.__msgtype__ for message in messages] == names
    assert sorted(read) == [f'go2_interfaces/msg/{name}' for name in ('BmsState', 'IMU', 'LowState', 'MotorState')]


def test_types_with_a_header_are_recognized(ros: Any) -> None:
    """Exactly the types whose first field is a std_msgs/msg/Header have one."""
    assert all(map(ros.types.has_header, ['nav_msgs/msg/Odometry', 'sensor_msgs/msg/Imu']))
    assert not any(map(ros.types.has_header, [IMU, 'tf2_msgs/msg/TFMessage', 'std_msgs/msg/Header', 'std_msgs/msg/Empty']))


@pytest.mark.parametrize('little_endian', [True, False])
def test_the_header_stamp_is_read_from_the_bytes(ros: Any, little_endian: bool) -> None:
    """The stamp is read from the bytes, in both endiannesses."""
    cdr = ros.cdr('nav_msgs/msg/Odometry', header=HEADER, little_endian=little_endian)
    assert header_stamp_ns(cdr) == 1_760_788_800_250_000_000


def test_too_few_bytes_have_no_header_stamp(ros: Any) -> None:
    """Bytes that end before the stamp does give 0, never an exception."""
    cdr = ros.cdr('std_msgs/msg/Header', **HEADER)
    assert [header_stamp_ns(cdr[:size]) for size in range(12)] == [0] * 12
    assert header_stamp_ns(cdr[:12]) == 1_760_788_800_250_000_000
