"""Definitions are found, decode what they describe, and turn hostile bytes into Rejected."""

from __future__ import annotations

import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.formats.types import MessageTypes, header_stamp_ns

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
def test_both_endiannesses(ros: Any, little_endian: bool) -> None:
    """Little- and big-endian CDR decode to the same values, arrays included."""
    quaternion = np.array([0.1, -2.5, 3e-38, np.inf], np.float32)
    cdr = ros.cdr(IMU, quaternion=quaternion, temperature=-7, little_endian=little_endian)
    message = ros.types.deserialize(IMU, cdr)
    np.testing.assert_array_equal(message.quaternion, quaternion)
    assert message.temperature == -7


@pytest.mark.parametrize('little_endian', [True, False])
def test_a_counter_is_read_where_it_is(ros: Any, little_endian: bool) -> None:
    """Behind arrays of messages, at the place that their sizes and alignments give it."""
    low = 'go2_interfaces/msg/LowState'
    cdr = ros.cdr(low, tick=4_000_000_000, little_endian=little_endian)
    counter = ros.types.counter(low, 'tick')
    assert (counter.read(cdr), counter.wrap) == (4_000_000_000, 1 << 32)
    assert counter.read(cdr[:100]) == 0
    cycle = ros.types.counter(low, 'bms_state.cycle')
    assert (cycle.read(cdr), cycle.wrap) == (0, 1 << 16)


@pytest.mark.parametrize('field', ['tock', 'imu_state', 'power_v', 'tick.of', 'foot_force', 'imu_state.tock', ''])
def test_what_is_no_counter(ros: Any, field: str) -> None:
    """A field that is not there, or no single whole number."""
    with pytest.raises(Rejected, match='unknown_field'):
        ros.types.counter('go2_interfaces/msg/LowState', field)


def test_a_counter_behind_a_text_has_no_place(ros: Any) -> None:
    """Its place changes from message to message."""
    assert ros.types.counter('sensor_msgs/msg/Image', 'header.stamp.nanosec').offset == 8
    with pytest.raises(Rejected, match='variable length'):
        ros.types.counter('sensor_msgs/msg/Image', 'height')


def test_the_machine_comes_before_the_shipped_definitions(ros: Any, tmp_path: Path) -> None:
    """A definition in a prefix wins over the one of the same name that rosbags ships, and the first prefix wins."""
    first = define(tmp_path / 'a', 'std_msgs', ColorRGBA='uint8 shade\n')
    second = define(tmp_path / 'b', 'std_msgs', ColorRGBA='float64 shade\n')
    types = MessageTypes([first, second])
    assert [name for name, _ in types.fields('std_msgs/msg/ColorRGBA')] == ['shade']
    assert types.deserialize('std_msgs/msg/ColorRGBA', b'\0\1\0\0\x2a').shade == 42
    assert [name for name, _ in ros.types.fields('std_msgs/msg/ColorRGBA')] == ['r', 'g', 'b', 'a']


def test_an_older_definition_of_a_nested_message(tmp_path: Path) -> None:
    """A dependency found on the machine replaces the shipped one inside a shipped message."""
    types = MessageTypes([define(tmp_path, 'geometry_msgs', Vector3='float32 x\r\nfloat32 y\r\n')])
    message = types.deserialize('geometry_msgs/msg/Vector3Stamped', b'\0\1\0\0' + bytes(8) + b'\1\0\0\0\0\0\0\0' + bytes(8))
    assert (message.vector.x, message.vector.y) == (0.0, 0.0)


@pytest.mark.parametrize('type_name', ['nobody_msgs/msg/Nothing', '../../etc/msg/passwd', 'std_msgs/String', '', 'a/srv/B'])
def test_unknown_types(ros: Any, type_name: str) -> None:
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
def test_unusable_definitions(tmp_path: Path, texts: dict[str, str]) -> None:
    """A definition that cannot be used makes its type unknown, and no other."""
    types = MessageTypes([define(tmp_path, 'bad_msgs', **texts)])
    assert reason_of(types, 'bad_msgs/msg/A', b'\0\1\0\0') == 'unknown_type'
    assert types.has_header('sensor_msgs/msg/Imu')


def test_a_definition_that_is_no_text(tmp_path: Path) -> None:
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
def test_no_cdr(ros: Any, cdr: bytes) -> None:
    """Too few bytes, or another encapsulation than plain CDR, is malformed."""
    assert reason_of(ros.types, IMU, cdr) == 'malformed'


def test_truncated_and_too_long(ros: Any) -> None:
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


def test_has_header(ros: Any) -> None:
    """Exactly the types whose first field is a std_msgs/msg/Header have one."""
    assert all(map(ros.types.has_header, ['nav_msgs/msg/Odometry', 'sensor_msgs/msg/Imu']))
    assert not any(map(ros.types.has_header, [IMU, 'tf2_msgs/msg/TFMessage', 'std_msgs/msg/Header', 'std_msgs/msg/Empty']))


@pytest.mark.parametrize('little_endian', [True, False])
def test_header_stamp(ros: Any, little_endian: bool) -> None:
    """The stamp is read from the bytes, in both endiannesses."""
    cdr = ros.cdr('nav_msgs/msg/Odometry', header=HEADER, little_endian=little_endian)
    assert header_stamp_ns(cdr) == 1_760_788_800_250_000_000


def test_header_stamp_of_too_few_bytes(ros: Any) -> None:
    """Bytes that end before the stamp does give 0, never an exception."""
    cdr = ros.cdr('std_msgs/msg/Header', **HEADER)
    assert [header_stamp_ns(cdr[:size]) for size in range(12)] == [0] * 12
    assert header_stamp_ns(cdr[:12]) == 1_760_788_800_250_000_000
