"""Finds message definitions by ROS type name and decodes CDR with them, in pure Python (``rosbags``, then ``cdr``).

For any input, this module raises only Rejected, and no length in the input makes it allocate memory.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.formats.cdr import ENCAPSULATION_BYTES, read_message
from shadowhound_data_logger.formats.definitions import LEARNED, read_definition, without_includes

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Fielddefs, FieldDesc, Typesdict

HEADER: Final = 'std_msgs/msg/Header'
MAX_UNKNOWN: Final = 1000
"""Limit of the remembered names of unknown types: publishers can invent any number of names."""
PLACEHOLDER: Final = 'structure_needs_at_least_one_member'
"""The field that rosidl adds to a message without fields; it has no meaning."""

_TYPE_NAME = re.compile(r'[A-Za-z]\w*/(?:msg|srv|action)/[A-Za-z]\w*', re.ASCII)
_INTEGERS: Final = {
    'int8': 'b',
    'uint8': 'B',
    'byte': 'B',
    'int16': 'h',
    'uint16': 'H',
    'int32': 'i',
    'uint32': 'I',
    'int64': 'q',
}
SIZES: Final = {
    **{name: struct.calcsize(code) for name, code in _INTEGERS.items()}, 'uint64': 8, 'float32': 4, 'float64': 8, 'bool': 1,
    'char': 1,
}  # fmt: skip
"""Size, and alignment, of each primitive type in CDR, in bytes."""
_STAMP_LE: Final = struct.Struct('<iI')
_STAMP_BE: Final = struct.Struct('>iI')
_LENGTH_LE: Final = struct.Struct('<I')
_LENGTH_BE: Final = struct.Struct('>I')


def header_stamp_ns(cdr: bytes | memoryview) -> int:
    """``header.stamp`` in ns of a message whose first field is a std_msgs/msg/Header; 0 if ``cdr`` is too short."""
    if len(cdr) < ENCAPSULATION_BYTES + _STAMP_LE.size:
        return 0
    sec, nanosec = (_STAMP_LE if cdr[1] & 1 else _STAMP_BE).unpack_from(cdr, ENCAPSULATION_BYTES)
    return int(sec) * SECOND + int(nanosec)


def header_frame_id(cdr: bytes) -> str:
    """``header.frame_id`` of such a message; empty if ``cdr`` is too short; U+FFFD replaces invalid UTF-8."""
    start = ENCAPSULATION_BYTES + _STAMP_LE.size + _LENGTH_LE.size
    if len(cdr) < start:
        return ''
    (length,) = (_LENGTH_LE if cdr[1] & 1 else _LENGTH_BE).unpack_from(cdr, start - _LENGTH_LE.size)
    return cdr[start : start + length].removesuffix(b'\0').decode('utf-8', 'replace') if length <= len(cdr) - start else ''


class CounterField(NamedTuple):
    """The position of an integer in the CDR of every message of a type."""

    offset: int
    little: struct.Struct
    big: struct.Struct

    @property
    def wrap(self) -> int:
        """The number of values after which the counter wraps around."""
        return 1 << 8 * self.little.size

    def read(self, cdr: bytes) -> int:
        """The number; 0 if ``cdr`` is too short, or its encapsulation is not plain CDR."""
        if len(cdr) < self.offset + self.little.size or cdr[1] > 1:
            return 0
        (value,) = (self.little if cdr[1] else self.big).unpack_from(cdr, self.offset)
        return int(value)


class MessageTypes:
    """Message definitions by type name (``sensor_msgs/msg/Imu``), read on first use and cached.

    Searches ``<prefix>/share/<package>/msg/<Name>.msg`` of each prefix (the entries of AMENT_PREFIX_PATH, in their order), then
    the ``.idl``, then the standard messages that ``rosbags`` ships. The messages of services and actions are types too
    (``std_srvs/srv/Trigger_Event``). A type that was not found stays unknown for the lifetime of the object. Thread-safe:
    ``_lock`` guards every change; readers only see complete definitions.
    """

    def __init__(self, prefixes: Iterable[str | Path] = ()) -> None:
        self._prefixes = tuple(Path(prefix) for prefix in prefixes if str(prefix))
        self._store = Typestore()
        self._known: dict[str, Fielddefs] = {}
        self._unknown: dict[str, str] = {}
        self._uncompiled: set[str] = set()
        self._lock = Lock()

    def deserialize(self, type_name: str, cdr: bytes | memoryview) -> Any:
        """The message as a ``rosbags`` dataclass: numbers, str, lists, numpy arrays that may be views of ``cdr``.

        U+FFFD replaces invalid UTF-8, as in rclpy.
        Raises Rejected: ``unknown_type``, or ``malformed`` (truncated, too long, wrong lengths, not CDR).
        """
        self.fields(type_name)
        if type_name not in self._uncompiled:
            try:
                return self._store.deserialize_cdr(cdr, type_name)
            except SerdeError:  # another vendor's CDR, or malformed
                pass
        return read_message(self._store, type_name, cdr)

    def fields(self, type_name: str) -> Fielddefs:
        """The fields in order, as (name in the definition, ``rosbags`` description). Raises Rejected: ``unknown_type``."""
        known = self._known.get(type_name)
        return self._load(type_name) if known is None else known

    def has_header(self, type_name: str) -> bool:
        """Whether the first field of the message is a std_msgs/msg/Header; False if the type is unknown."""
        try:
            _, description = self.fields(type_name)[0]
        except Rejected:
            return False
        return description == (Nodetype.NAME, HEADER)

    def counter(self, type_name: str, field: str) -> CounterField:
        """How to read the integer at ``field`` (dotted: bms_state.cycle) from the CDR of a message.

        Raises Rejected: ``unknown_type``, or ``unknown_field`` if there is no such integer or its offset varies.
        """
        place, kind = 0, ''
        rest: list[str] = field.split('.')
        while rest:
            wanted = rest.pop(0)
            for name, description in self.fields(type_name):
                if name == wanted:
                    break
                place = self._end(description, place)
            else:
                raise Rejected('unknown_field', f'{type_name} has no field {wanted!r}')
            if description[0] == Nodetype.NAME:
                type_name = description[1]
            elif description[0] == Nodetype.BASE and description[1][0] in _INTEGERS and not rest:
                kind = description[1][0]
            else:
                break
        if not kind:
            raise Rejected('unknown_field', f'{field!r} is not an integer field of {type_name}')
        size = struct.calcsize(_INTEGERS[kind])
        place += -place % size
        return CounterField(
            place + ENCAPSULATION_BYTES, struct.Struct(f'<{_INTEGERS[kind]}'), struct.Struct(f'>{_INTEGERS[kind]}')
        )

    def _end(self, description: FieldDesc, place: int) -> int:
        """The end of a field that starts at ``place``, aligned, in bytes after the encapsulation (XCDR1)."""
        if description[0] == Nodetype.BASE and description[1][0] in SIZES:
            size = SIZES[description[1][0]]
            return place + -place % size + size
        if description[0] == Nodetype.ARRAY:
            of, count = description[1]
            for _ in range(count):
                place = self._end(of, place)
            return place
        if description[0] == Nodetype.NAME:
            for _, each in self.fields(description[1]):
                place = self._end(each, place)
            return place
        raise Rejected('unknown_field', 'it follows a field of variable length, so its offset varies')

    def _load(self, type_name: str) -> Fielddefs:
        with self._lock:
            if type_name in self._unknown and type_name not in LEARNED:
                raise Rejected('unknown_type', self._unknown[type_name])
            try:
                definitions: Typesdict = {}
                self._collect(type_name, definitions, ())
                self._store.register(definitions)
                self._compile(type_name)
            except (LookupError, TypesysError, OSError, UnicodeDecodeError) as error:
                if len(self._unknown) >= MAX_UNKNOWN:
                    self._unknown.clear()
                self._unknown[type_name] = str(error.args[0] if isinstance(error, LookupError) else error)
                raise Rejected('unknown_type', self._unknown[type_name]) from error
            self._known[type_name] = self._store.fielddefs[type_name][1]
            return self._known[type_name]

    def _compile(self, type_name: str) -> None:
        """Compile the decoder of ``rosbags``, under the lock."""
        try:
            self._store.get_msgdef(type_name)
        except KeyError:  # ``rosbags`` cannot decode a wstring
            self._uncompiled.add(type_name)

    def _collect(self, type_name: str, definitions: Typesdict, within: tuple[str, ...]) -> None:
        """Add the definitions of a type and its nested types. Raises LookupError with a sentence."""
        if type_name in within:
            raise LookupError(f'{type_name} contains itself')
        if type_name in definitions or type_name in self._store.fielddefs:
            return
        definition = self._read_types(type_name)
        for _, description in definition[type_name][1]:
            nested = nested_type(description)
            if nested is not None:
                self._collect(nested, definitions, (*within, type_name))
        definitions.update(definition)

    def _read_types(self, type_name: str) -> Typesdict:
        if not _TYPE_NAME.fullmatch(type_name):
            raise LookupError(f'{type_name!r} is not a message type')
        with suppress(FileNotFoundError):
            found = get_types_from_msg(read_definition(self._prefixes, type_name, 'msg'), type_name)
            if not any((nested_type(description) or '').endswith('/wstring') for _, description in found[type_name][1]):
                return found
        with suppress(FileNotFoundError, KeyError):  # ``rosbags`` supports wstring only in .idl
            found = get_types_from_idl(without_includes(read_definition(self._prefixes, type_name, 'idl')))
            return {type_name: found[type_name]}
        if type_name not in self._standard_types.fielddefs:
            raise LookupError(f'no definition of {type_name}: install its package and source its workspace')
        return {type_name: self._standard_types.fielddefs[type_name]}

    @cached_property
    def _standard_types(self) -> Typestore:
        """The standard messages of the newest distribution; loaded late because loading takes 0.1 s."""
        return get_typestore(Stores.LATEST)


def nested_type(description: FieldDesc) -> str | None:
    """The type name of a field that is a message, or an array or sequence of messages; otherwise None."""
    if description[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return nested_type(description[1][0])
    return description[1] if description[0] == Nodetype.NAME else None
