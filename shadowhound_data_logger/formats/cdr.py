"""Reads CDR that rclpy accepts and ``rosbags`` rejects, as DDS vendors other than those of ROS write it.

Strings may lack the terminating NUL or have length 0, up to ``MAX_PADDING`` bytes may follow the message, 8-byte numbers may be
aligned to 4 (XCDR2), and text may be a ``wstring`` or invalid UTF-8. For any input, this module raises only Rejected, and no
length in the input makes it allocate memory. It is slower than ``rosbags`` and only used for messages that ``rosbags`` rejects.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from rosbags.interfaces import Nodetype

from shadowhound_data_logger.core.errors import Rejected

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

ENCAPSULATION_BYTES: Final = 4
"""The encapsulation precedes the message; its second byte is the endianness. If the first field is a std_msgs/msg/Header, its
stamp (8 bytes), the length of its frame_id with the NUL (4 bytes) and the frame_id follow directly."""
MAX_PADDING: Final = 4
"""Maximum number of bytes after the message: CDR is padded to a multiple of 4, and some writers always add 4 bytes."""
_SLACK_BYTES: Final = 4
"""Additional bytes allowed for each empty sequence and each wstring: rclpy's ``serialize_message``, which bags written in Python
use, returns as many bytes as rmw_fastrtps estimates, and that aligns an empty sequence of float64 and adds a NUL to a wstring."""
_ENCAPSULATIONS: Final = {0: ('>', 8), 1: ('<', 8), 6: ('>', 4), 7: ('<', 4)}
"""Second byte -> byte order and maximum alignment: CDR, and XCDR2 of final types (DDS-XTypes 1.3, table 60). The other
encapsulations have member headers; no RMW sends them, nor XCDR2."""
_CODES: Final = {
    'bool': '?', 'byte': 'b', 'char': 'B', 'int8': 'b', 'uint8': 'B', 'int16': 'h', 'uint16': 'H', 'int32': 'i', 'uint32': 'I',
    'int64': 'q', 'uint64': 'Q', 'float32': 'f', 'float64': 'd',
}  # fmt: skip
_REMEDY: Final = 'check that the publisher uses the same definition: ros2 topic info -v shows the type hash of each'
_WCHAR_BYTES: Final = 4
"""Size of each UTF-16 code unit of a wstring, as Fast CDR and rmw_cyclonedds write them."""


def read_message(store: Typestore, type_name: str, cdr: bytes | memoryview) -> Any:
    """The message as a dataclass of ``store``, which must contain the type and its nested types.

    Raises Rejected: ``malformed``, or ``unknown_type`` if a nested type is missing.
    """
    encapsulation = _ENCAPSULATIONS.get(cdr[1]) if len(cdr) >= ENCAPSULATION_BYTES and cdr[0] == 0 else None
    if encapsulation is None:
        raise Rejected('malformed', f'{bytes(cdr[:2]).hex() or "nothing"} is not the encapsulation of plain CDR')
    reader = _Reader(store, memoryview(cdr)[ENCAPSULATION_BYTES:], *encapsulation)
    try:
        message = reader.message(type_name)
    except KeyError as error:
        raise Rejected('unknown_type', f'{type_name} has a field of type {error}') from error
    except (struct.error, ValueError) as error:
        text = f'the {len(cdr)} bytes end within a {type_name}: {error}'
        raise Rejected('malformed', text, remedy=_REMEDY) from error
    surplus = len(cdr) - ENCAPSULATION_BYTES - reader.at
    if surplus > MAX_PADDING + reader.slack:
        raise Rejected('malformed', f'{surplus} bytes follow the {type_name}', remedy=_REMEDY)
    return message


class _Reader:
    """Decodes one message, field by field."""

    def __init__(self, store: Typestore, data: memoryview, order: str, max_align: int) -> None:
        self._store, self._data, self._order, self._max_align = store, data, order, max_align
        self.at = self.slack = 0

    def message(self, type_name: str) -> Any:
        values: list[Any] = [self._value(description) for _, description in self._store.fielddefs[type_name][1]]
        kind: Any = self._store.types[type_name]
        return kind(*values)

    def _value(self, description: Any) -> Any:
        kind, of = description
        if kind == Nodetype.NAME:
            return self.message(of)
        if kind == Nodetype.BASE:
            name = of[0]
            return self._text() if name == 'string' else self._wide_text() if name == 'wstring' else self._number(_CODES[name])
        inner, count = of
        is_primitive = inner[0] == Nodetype.BASE and inner[1][0] in _CODES
        if self._max_align < 8 and not is_primitive:
            self._number('I')  # XCDR2: the size of the elements
        if kind == Nodetype.SEQUENCE:
            count = self._number('I')
            self.slack += 0 if count else _SLACK_BYTES
        if is_primitive:
            return self._numbers(_CODES[inner[1][0]], count)
        return [self._value(inner) for _ in range(count)]  # bounded by the input: each element takes at least one byte

    def _number(self, code: str) -> Any:
        size = struct.calcsize(code)
        self._align(size)
        (value,) = struct.unpack_from(self._order + code, self._data, self.at)
        self.at += size
        return value

    def _numbers(self, code: str, count: int) -> Any:
        if not count:
            return np.zeros(0, code)
        size = struct.calcsize(code)
        self._align(size)
        found = np.frombuffer(self._take(count * size), f'{self._order}{code}')
        return found.astype(code) if self._order == '>' else found

    def _text(self) -> str:
        text = bytes(self._take(self._number('I')))
        return (text[:-1] if text.endswith(b'\0') else text).decode('utf-8', 'replace')

    def _wide_text(self) -> str:
        self.slack += _SLACK_BYTES
        units = self._take(self._number('I') * _WCHAR_BYTES)
        return np.frombuffer(units, f'{self._order}u4').astype('<u2').tobytes().decode('utf-16-le', 'replace')

    def _take(self, size: int) -> memoryview:
        start, self.at = self.at, self.at + size
        if self.at > len(self._data):
            raise ValueError(f'{size} bytes at {start} of {len(self._data)}')
        return self._data[start : self.at]

    def _align(self, size: int) -> None:
        self.at += -self.at % min(size, self._max_align)
