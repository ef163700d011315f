"""Message definitions by ROS type name, and what they make of CDR bytes, in pure Python (``rosbags``, then ``cdr``).

Owns the definitions. Whatever the bytes are, only Rejected leaves this module, and no length in them makes it allocate.
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
from shadowhound_data_logger.formats.definitions import read_definition, without_includes

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Fielddefs, FieldDesc, Typesdict

HEADER: Final = 'std_msgs/msg/Header'
MAX_UNKNOWN: Final = 1000
"""Names of types that were not found and are remembered, whoever invents how many."""
PLACEHOLDER: Final = 'structure_needs_at_least_one_member'
"""The field that rosidl puts into a message without any; it carries nothing."""

_TYPE_NAME = re.compile(r'[A-Za-z]\w*/(?:msg|srv|action)/[A-Za-z]\w*', re.ASCII)
_WHOLE: Final = {'int8': 'b', 'uint8': 'B', 'byte': 'B', 'int16': 'h', 'uint16': 'H', 'int32': 'i', 'uint32': 'I', 'int64': 'q'}
SIZES: Final = {
    **{name: struct.calcsize(code) for name, code in _WHOLE.items()}, 'uint64': 8, 'float32': 4, 'float64': 8, 'bool': 1,
    'char': 1,
}  # fmt: skip
"""Bytes of a field of a type in CDR, and what it is aligned to."""
_STAMP_LE: Final = struct.Struct('<iI')
_STAMP_BE: Final = struct.Struct('>iI')
_LENGTH_LE: Final = struct.Struct('<I')
_LENGTH_BE: Final = struct.Struct('>I')


def header_stamp_ns(cdr: bytes | memoryview) -> int:
    """``header.stamp`` in ns of a message whose first field is a std_msgs/msg/Header; 0 where the bytes are too few."""
    if len(cdr) < ENCAPSULATION_BYTES + _STAMP_LE.size:
        return 0
    sec, nanosec = (_STAMP_LE if cdr[1] & 1 else _STAMP_BE).unpack_from(cdr, ENCAPSULATION_BYTES)
    return int(sec) * SECOND + int(nanosec)


def header_frame_id(cdr: bytes) -> str:
    """``header.frame_id`` of such a message; empty where the bytes are too few, U+FFFD where they are not UTF-8."""
    start = ENCAPSULATION_BYTES + _STAMP_LE.size + _LENGTH_LE.size
    if len(cdr) < start:
        return ''
    (length,) = (_LENGTH_LE if cdr[1] & 1 else _LENGTH_BE).unpack_from(cdr, start - _LENGTH_LE.size)
    return cdr[start : start + length].removesuffix(b'\0').decode('utf-8', 'replace') if length <= len(cdr) - start else ''


class CounterField(NamedTuple):
    """Where a whole number is in the CDR of every message of a type."""

    offset: int
    little: struct.Struct
    big: struct.Struct

    @property
    def wrap(self) -> int:
        """It starts again after so many values."""
        return 1 << 8 * self.little.size

    def read(self, cdr: bytes) -> int:
        """The number; 0 if the bytes are too few, or not aligned as CDR is."""
        if len(cdr) < self.offset + self.little.size or cdr[1] > 1:
            return 0
        (value,) = (self.little if cdr[1] else self.big).unpack_from(cdr, self.offset)
        return int(value)


class MessageTypes:
    """Finds message definitions by type name (``sensor_msgs/msg/Imu``), read when first asked for, then kept.

    Looked for in ``<prefix>/share/<package>/msg/<Name>.msg`` of each prefix (the entries of AMENT_PREFIX_PATH, in their
    order), then in its ``.idl``, then among the standard messages that ``rosbags`` ships. The messages of services and actions
    are types too (``std_srvs/srv/Trigger_Event``). What was not found once stays unknown for the life of the object.
    Thread-safe: ``_lock`` guards every change, readers see only what is complete.
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

        Text that is not UTF-8 is kept with U+FFFD in place of the bad bytes, as rclpy does.
        Raises Rejected: ``unknown_type``, or ``malformed`` (truncated, too long, wrong lengths, no CDR at all).
        """
        self.fields(type_name)
        if type_name not in self._uncompiled:
            try:
                return self._store.deserialize_cdr(cdr, type_name)
            except SerdeError:  # of another vendor, or malformed
                pass
        return read_message(self._store, type_name, cdr)

    def fields(self, type_name: str) -> Fielddefs:
        """The fields in order, as (name in the definition, ``rosbags`` description). Raises Rejected: ``unknown_type``."""
        known = self._known.get(type_name)
        return self._load(type_name) if known is None else known

    def has_header(self, type_name: str) -> bool:
        """Whether the message begins with a std_msgs/msg/Header; False where the type is not known."""
        try:
            _, description = self.fields(type_name)[0]
        except Rejected:
            return False
        return description == (Nodetype.NAME, HEADER)

    def counter(self, type_name: str, field: str) -> CounterField:
        """How to read a whole number at ``field`` (dotted: bms_state.cycle) from the CDR of a message.

        Raises Rejected: ``unknown_type``, or ``unknown_field`` where there is none, or none at a place that is always the same.
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
            elif description[0] == Nodetype.BASE and description[1][0] in _WHOLE and not rest:
                kind = description[1][0]
            else:
                break
        if not kind:
            raise Rejected('unknown_field', f'{field!r} is not a field of {type_name} with a whole number')
        size = struct.calcsize(_WHOLE[kind])
        place += -place % size
        return CounterField(place + ENCAPSULATION_BYTES, struct.Struct(f'<{_WHOLE[kind]}'), struct.Struct(f'>{_WHOLE[kind]}'))

    def _end(self, description: FieldDesc, place: int) -> int:
        """Where a field ends that begins at ``place`` or, aligned, after it, in bytes after the encapsulation (XCDR1)."""
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
        raise Rejected('unknown_field', 'it comes after a field whose length changes')

    def _load(self, type_name: str) -> Fielddefs:
        with self._lock:
            if type_name in self._unknown:
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
        """Under the lock, with all that is nested in it; ``rosbags`` has no code for a ``wstring``."""
        try:
            self._store.get_msgdef(type_name)
        except KeyError:
            self._uncompiled.add(type_name)

    def _collect(self, type_name: str, definitions: Typesdict, within: tuple[str, ...]) -> None:
        """Add the definition of a type and of all it is made of. Raises LookupError with a sentence."""
        if type_name in within:
            raise LookupError(f'{type_name} contains itself')
        if type_name in definitions or type_name in self._store.fielddefs:
            return
        definition = self._find(type_name)
        for _, description in definition[type_name][1]:
            nested = nested_type(description)
            if nested is not None:
                self._collect(nested, definitions, (*within, type_name))
        definitions.update(definition)

    def _find(self, type_name: str) -> Typesdict:
        if not _TYPE_NAME.fullmatch(type_name):
            raise LookupError(f'{type_name!r} is not a message type')
        with suppress(FileNotFoundError):
            found = get_types_from_msg(read_definition(self._prefixes, type_name, 'msg'), type_name)
            if not any((nested_type(description) or '').endswith('/wstring') for _, description in found[type_name][1]):
                return found
        with suppress(FileNotFoundError, KeyError):  # ``rosbags`` knows a wstring only there
            found = get_types_from_idl(without_includes(read_definition(self._prefixes, type_name, 'idl')))
            return {type_name: found[type_name]}
        if type_name not in self._shipped.fielddefs:
            raise LookupError(f'no definition of {type_name}: is its package installed and sourced?')
        return {type_name: self._shipped.fielddefs[type_name]}

    @cached_property
    def _shipped(self) -> Typestore:
        """The standard messages of the newest distribution; loaded late because it takes 0.1 s."""
        return get_typestore(Stores.LATEST)


def nested_type(description: FieldDesc) -> str | None:
    """The type name of a field that is a message, or an array or sequence of them; else None."""
    if description[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return nested_type(description[1][0])
    return description[1] if description[0] == Nodetype.NAME else None
