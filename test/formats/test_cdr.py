"""CDR of other DDS vendors reads as rclpy reads it, or is rejected with a reason; compared with rclpy's own deserializer."""

from __future__ import annotations

import os
import random
import struct
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype

from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.formats.types import CounterField, MessageTypes, header_frame_id, header_stamp_ns

pytest.importorskip('rclpy')
from formats.test_types import plain
from rclpy.serialization import deserialize_message, serialize_message

pytestmark = pytest.mark.ros

STRING = 'std_msgs/msg/String'
TYPES = [
    STRING, 'std_msgs/msg/Empty', 'std_msgs/msg/Bool', 'std_msgs/msg/Header', 'std_msgs/msg/Float64MultiArray',
    'sensor_msgs/msg/JointState', 'sensor_msgs/msg/PointCloud2', 'sensor_msgs/msg/CameraInfo', 'sensor_msgs/msg/BatteryState',
    'nav_msgs/msg/Odometry', 'diagnostic_msgs/msg/DiagnosticArray', 'action_msgs/msg/GoalStatusArray',
    'go2_interfaces/msg/LowState', 'go2_interfaces/msg/VoxelMapCompressed',
    *(f'test_msgs/msg/{name}' for name in (
        'Arrays', 'BasicTypes', 'BoundedPlainSequences', 'BoundedSequences', 'Builtins', 'Constants', 'Defaults', 'Empty',
        'MultiNested', 'Nested', 'Strings', 'UnboundedSequences', 'WStrings')),
]  # fmt: skip
TEXTS = ('', 'a', 'hello', 'näme', '漢字', 'x' * 300, '𝄞')


@pytest.fixture(scope='module')
def types() -> MessageTypes:
    return MessageTypes(os.environ.get('AMENT_PREFIX_PATH', '').split(':'))


class Writer:
    """Writes random messages of a type as a DDS vendor with these rules would."""

    def __init__(self, types: MessageTypes, rng: random.Random, *, order: str = '<', nul: bool = True, align: int = 8) -> None:
        self.types, self.rng, self.order, self.nul, self.align = types, rng, order, nul, align
        self.body = bytearray()

    def message(self, type_name: str) -> bytes:
        self._fields(type_name)
        kind = {8: 0, 4: 6}[self.align] + (self.order == '<')
        return bytes([0, kind, 0, 0]) + bytes(self.body)

    def _fields(self, type_name: str) -> None:
        for _, description in self.types.fields(type_name):
            self._field(description)

    def _field(self, description: Any) -> None:
        kind, of = description
        if kind == Nodetype.NAME:
            self._fields(of)
        elif kind == Nodetype.BASE:
            self._base(*of)
        else:
            inner, count = of
            has_size = self.align == 4 and (inner[0] == Nodetype.NAME or 'string' in inner[1][0])  # DDS-XTypes 1.3, 7.4.3.5.3
            if has_size:
                self._pack('I', 0)
            start = len(self.body)
            if kind == Nodetype.SEQUENCE:
                count = self.rng.randrange(min(count or 4, 4) + 1)
                self._pack('I', count)
            for _ in range(count):
                self._field(inner)
            if has_size:
                struct.pack_into(f'{self.order}I', self.body, start - 4, len(self.body) - start)

    def _base(self, name: str, bound: int) -> None:
        if name == 'string':
            text = self.rng.choice(TEXTS)[: bound or None].encode()
            text += b'\0' if self.nul or not self.rng.randrange(3) else b''
            self._pack('I', len(text))
            self.body += text
        elif name == 'wstring':
            units = np.frombuffer(self.rng.choice(TEXTS).encode('utf-16-le'), '<u2')
            self._pack('I', len(units))
            self.body += units.astype(f'{self.order}u4').tobytes()
        elif name in {'float32', 'float64'}:
            self._pack({'float32': 'f', 'float64': 'd'}[name], self.rng.choice((0.0, -1.5, 2.0**20, float('inf'))))
        else:
            code = {'bool': '?', 'byte': 'B', 'char': 'B', 'int8': 'b', 'uint8': 'B', 'int16': 'h', 'uint16': 'H', 'int32': 'i',
                    'uint32': 'I', 'int64': 'q', 'uint64': 'Q'}[name]  # fmt: skip
            self._pack(code, self.rng.randrange(2 if name == 'bool' else 128))

    def _pack(self, code: str, value: Any) -> None:
        size = struct.calcsize(code)
        self.body += bytes(-len(self.body) % min(size, self.align))
        self.body += struct.pack(self.order + code, value)


def rclpy_class(type_name: str) -> Any:
    package, kind, name = type_name.split('/')
    return getattr(pytest.importorskip(f'{package}.{kind}'), name)


def as_rclpy(type_name: str, cdr: bytes) -> Any:
    return normal(plain(deserialize_message(cdr, rclpy_class(type_name))))


def normal(value: Any) -> Any:
    """The same value in both representations of a byte: rclpy has bytes, ``rosbags`` a signed number."""
    if isinstance(value, dict):
        return {name: unsigned(normal(item)) if 'byte' in name else normal(item) for name, item in value.items()
                if name != 'structure_needs_at_least_one_member'}  # fmt: skip
    if isinstance(value, (list, tuple)):
        return [normal(item) for item in value]
    return value[0] if isinstance(value, bytes) else value


def unsigned(value: Any) -> Any:
    return [unsigned(item) for item in value] if isinstance(value, list) else value % 256


def check(types: MessageTypes, type_name: str, cdr: bytes) -> None:
    ours = normal(plain(types.deserialize(type_name, cdr)))
    assert repr(ours) == repr(as_rclpy(type_name, cdr))


@pytest.mark.parametrize('type_name', TYPES)
@pytest.mark.parametrize('form', [{}, {'nul': False}, {'order': '>'}, {'nul': False, 'order': '>'}], ids=str)
def test_cdr_is_read_like_rclpy_does(types: MessageTypes, type_name: str, form: dict[str, Any]) -> None:
    """Random messages of every kind of field read as rclpy reads them: without NULs, big-endian, and padded."""
    rclpy_class(type_name)
    for seed in range(20):
        rng = random.Random(seed)
        cdr = Writer(types, rng, **form).message(type_name)
        check(types, type_name, cdr + bytes(seed % 5))


@pytest.mark.parametrize('type_name', TYPES)
@pytest.mark.parametrize('order', ['<', '>'])
def test_xcdr2_is_read(types: MessageTypes, type_name: str, order: str) -> None:
    """XCDR2 of final types, which rclpy cannot read in general, has the values that the same message has in CDR."""
    rclpy_class(type_name)
    for seed in range(20):
        cdr, xcdr2 = (Writer(types, random.Random(seed), order=order, align=align).message(type_name) for align in (8, 4))
        ours = normal(plain(types.deserialize(type_name, xcdr2)))
        assert repr(ours) == repr(as_rclpy(type_name, cdr))


@pytest.mark.parametrize('is_xcdr2', [False, True])
def test_messages_of_cyclone_dds_are_read(types: MessageTypes, is_xcdr2: bool) -> None:
    """A message of an application of Cyclone DDS without ROS is read, in CDR and in XCDR2."""
    pytest.importorskip('cyclonedds')
    from formats.cyclone import Header, JointState, Time

    made = JointState(Header(Time(1, 2), 'odom'), ['a', 'bcd', ''], [1.5, 2.5], [], [3.0])
    message = types.deserialize('sensor_msgs/msg/JointState', made.serialize(use_version_2=is_xcdr2))
    assert (message.header.stamp.nanosec, message.header.frame_id, message.name) == (2, 'odom', ['a', 'bcd', ''])
    assert [each.tolist() for each in (message.position, message.velocity, message.effort)] == [[1.5, 2.5], [], [3.0]]


@pytest.mark.parametrize('type_name', TYPES)
def test_messages_of_rclpy_are_read(types: MessageTypes, type_name: str) -> None:
    """Random messages read the same after rclpy has written them once more, with as many bytes as it adds."""
    kind = rclpy_class(type_name)
    for seed in range(60):
        made = deserialize_message(Writer(types, random.Random(seed)).message(type_name), kind)
        check(types, type_name, serialize_message(made))


@pytest.mark.parametrize(('body', 'text'), [
    (struct.pack('<I', 6) + b'hello\0', 'hello'), (struct.pack('<I', 5) + b'hello', 'hello'), (struct.pack('<I', 0), ''),
    (struct.pack('<I', 1) + b'\0', ''), (struct.pack('<I', 2) + b'\xff\0', '\ufffd'), (struct.pack('<I', 1) + b'\xff', '\ufffd'),
])  # fmt: skip
@pytest.mark.parametrize('padding', range(5))
def test_unusual_strings_are_read(types: MessageTypes, body: bytes, text: str, padding: int) -> None:
    """A string may lack its NUL, have the length 0, not be UTF-8, and be followed by up to four bytes."""
    cdr = b'\0\1\0\0' + body + bytes(padding)
    assert types.deserialize(STRING, cdr).data == text == deserialize_message(cdr, rclpy_class(STRING)).data


def test_text_after_a_nul_is_kept(types: MessageTypes) -> None:
    """Text is stored in full where rclpy stops at the first NUL."""
    assert types.deserialize(STRING, b'\0\1\0\0' + struct.pack('<I', 4) + b'a\0b\0').data == 'a\0b'


@pytest.mark.parametrize(('cdr', 'why'), [
    (b'\0\1\0\0' + struct.pack('<I', 6) + b'hello\0' + bytes(5), '5 bytes follow the std_msgs/msg/String'),
    (b'\0\1\0\0' + struct.pack('<I', 7) + b'hello\0', 'end within'),
    (b'\0\1\0\0' + struct.pack('<I', 2**32 - 1) + b'hello\0', 'end within'),
    (b'\0\1\0\0', 'end within'), (b'\0\1', 'not the encapsulation'), (b'', 'nothing is not the encapsulation'),
    *((bytes([0, kind, 0, 0]) + struct.pack('<I', 6) + b'hello\0', 'not the encapsulation')
      for kind in (2, 3, 4, 5, 8, 9, 10, 11, 12)),
    (b'\1\1\0\0' + struct.pack('<I', 6) + b'hello\0', 'not the encapsulation'),
])  # fmt: skip
def test_bytes_that_are_not_a_message_are_rejected(types: MessageTypes, cdr: bytes, why: str) -> None:
    """Too many bytes, too few, and encapsulations with headers in front of members are malformed, with what is wrong."""
    with pytest.raises(Rejected, match=why) as rejected:
        types.deserialize(STRING, cdr)
    assert rejected.value.reason == 'malformed'


@pytest.mark.parametrize('type_name', TYPES)
def test_a_damaged_message_is_read_like_rclpy_or_rejected(types: MessageTypes, type_name: str) -> None:
    """A damaged message is read as rclpy reads it, or rejected as malformed."""
    rclpy_class(type_name)
    for seed in range(60):
        rng = random.Random(seed)
        cdr = bytearray(Writer(types, rng, nul=bool(seed % 2)).message(type_name))
        for _ in range(rng.choice((1, 2))):
            at = 4 + rng.randrange(max(1, len(cdr) - 4))
            cdr[at : at + 1] = rng.choice((b'', b'\xff', b'\0', b'\3'))
        ours, theirs = read(types, type_name, bytes(cdr)), read_by_rclpy(type_name, bytes(cdr))
        if ours is not None and theirs is not None:
            assert repr(cut(ours)) == repr(theirs)


def read(types: MessageTypes, type_name: str, cdr: bytes) -> Any:
    """None if it is malformed."""
    try:
        return normal(plain(types.deserialize(type_name, cdr)))
    except Rejected as error:
        if error.reason != 'malformed':
            raise
        return None


def read_by_rclpy(type_name: str, cdr: bytes) -> Any:
    """None if rclpy refuses it: the bytes end, or there are more elements than the definition allows."""
    try:
        return as_rclpy(type_name, cdr)
    except Exception as error:
        if 'failed to deserialize' not in str(error) and 'bound' not in str(error):
            raise
        return None


def cut(value: Any) -> Any:
    """Text up to its first NUL, as rclpy has it, unless it is a wstring."""
    if isinstance(value, dict):
        return {name: item if 'wstring' in name else cut(item) for name, item in value.items()}
    if isinstance(value, list):
        return [cut(item) for item in value]
    return value.partition('\0')[0] if isinstance(value, str) else value


@pytest.mark.parametrize('kind', [0, 1, 6, 7])
def test_a_header_without_nul_is_read(kind: int) -> None:
    """Stamp and frame of a header are read in each encapsulation, also without the NUL."""
    order = '<' if kind & 1 else '>'
    for text in (b'odom', b'odom\0'):
        cdr = bytes([0, kind, 0, 0]) + struct.pack(f'{order}iII', 5, 7, len(text)) + text
        assert (header_stamp_ns(cdr), header_frame_id(cdr)) == (5_000_000_007, 'odom')


def test_a_counter_at_another_alignment_is_unknown() -> None:
    """The position of a counter is that in CDR; in XCDR2 it is unknown."""
    field = CounterField(4, struct.Struct('<I'), struct.Struct('>I'))
    assert [field.read(bytes([0, kind, 0, 0, 0, 0, 0, 1])) for kind in (0, 6)] == [1, 0]
