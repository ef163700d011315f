"""Type supports made at run time from message definitions: a topic is received without the message package of its type.

Messages are taken serialized, so none of a type's code is needed, but rclpy, rcl and the RMW make a subscription only from a
``rosidl_message_type_support_t``. This module fills in the structures that rosidl generates and compiles for a type
(docs/decisions/0027), with ctypes, from the public headers of Humble, Jazzy and Kilted:

- rosidl_runtime_c: message_type_support_struct.h, type_hash.h and the structures of type_description (since Iron)
- rosidl_typesupport_introspection_c: message_introspection.h, field_types.h (``is_key_`` and ``has_any_key_member_`` since Jazzy)
- rosidl_typesupport_fastrtps_cpp: message_type_support.h (``key_callbacks`` since Jazzy)

What is incorrect in them crashes the process. So before the first use they are made for types whose package is installed, and
compared with what rosidl generated for those on this machine; any difference, any other rclpy and any other RMW than those it was
tested with is an error. It is the only module that makes structures for another library; ``SHADOWHOUND_TYPE_SUPPORT=off`` turns
it off. Everything passed to the middleware stays in memory, one type support per type.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
import sys
from collections.abc import Iterable, Mapping
from ctypes import POINTER, Structure, c_bool, c_char_p, c_size_t, c_uint8, c_uint32, c_uint64, c_void_p
from functools import cache
from threading import Lock
from typing import Any, Final, NamedTuple

from rclpy.utilities import get_rmw_implementation_identifier
from rosbags.interfaces import Nodetype

from shadowhound_data_logger.formats.definitions import describe
from shadowhound_data_logger.formats.types import PLACEHOLDER, MessageTypes
from shadowhound_data_logger.ros.reader import installed_class, rclpy_version

TESTED: Final = {
    ((3,), 'rmw_fastrtps_cpp'), ((3,), 'rmw_cyclonedds_cpp'), ((7,), 'rmw_fastrtps_cpp'), ((7,), 'rmw_cyclonedds_cpp'),
    ((9,), 'rmw_fastrtps_cpp'),
}  # fmt: skip
"""Major versions of rclpy (3: Humble, 7: Jazzy, 9: Kilted) and RMWs."""
FIRST_WITH_HASH: Final = 7
"""Types have hashes and keys since this major version of rclpy."""
RMWS: Final[Mapping[str, tuple[bytes, ...]]] = {
    'rmw_fastrtps_cpp': (b'rosidl_typesupport_introspection_c', b'rosidl_typesupport_fastrtps_c'),
    'rmw_cyclonedds_cpp': (b'rosidl_typesupport_introspection_c',),
}
"""RMWs, and the type supports that they use."""
INTROSPECTION, FAST_DDS = RMWS['rmw_fastrtps_cpp']
REFERENCES: Final = (
    'rcl_interfaces/msg/ParameterEvent',
    'rcl_interfaces/msg/ParameterDescriptor',
    'unique_identifier_msgs/msg/UUID',
)
"""Types of packages that rclpy needs: nested types, strings, arrays, sequences with and without bounds."""
MAX_FIELDS: Final = 4096
"""Fields of a type with those of its nested types."""
MAX_BYTES: Final = 1 << 30
"""Size of a message in memory; offsets have 32 bits."""
POINTER_BYTES: Final = 8
HASH_VERSION: Final = 'RIHS01_'


class Primitive(NamedTuple):
    """A type of a field."""

    introspection: int
    """``rosidl_typesupport_introspection_c__ROS_TYPE_``."""
    description: int
    """``rosidl_runtime_c__type_description__FieldType__FIELD_TYPE_``."""
    size: int


TEXT_BYTES: Final = 24
"""Size of ``rosidl_runtime_c__String`` and of every ``__Sequence``: a pointer, the size, the capacity."""
PRIMITIVES: Final[Mapping[str, Primitive]] = {
    'float32': Primitive(1, 10, 4), 'float64': Primitive(2, 11, 8), 'char': Primitive(8, 3, 1), 'bool': Primitive(6, 15, 1),
    'byte': Primitive(7, 16, 1), 'uint8': Primitive(8, 3, 1), 'int8': Primitive(9, 2, 1), 'uint16': Primitive(10, 5, 2),
    'int16': Primitive(11, 4, 2), 'uint32': Primitive(12, 7, 4), 'int32': Primitive(13, 6, 4), 'uint64': Primitive(14, 9, 8),
    'int64': Primitive(15, 8, 8), 'string': Primitive(16, 17, TEXT_BYTES), 'wstring': Primitive(17, 18, TEXT_BYTES),
}  # fmt: skip
MESSAGE: Final = Primitive(18, 1, 0)
BOUNDED_TEXT: Final = 4
"""Added to the description of a string or a wstring with an upper bound."""
ARRAY, BOUNDED_SEQUENCE, SEQUENCE = 48, 96, 144
"""Added to the description of an element."""


class Sequence(Structure):
    """``rosidl_runtime_c__String``, and any ``__Sequence``."""

    _fields_ = [('data', c_void_p), ('size', c_size_t), ('capacity', c_size_t)]


class TypeSupport(Structure):
    """``rosidl_message_type_support_t``; on Humble without the last three."""

    _fields_ = [(name, c_void_p) for name in ('identifier', 'data', 'func', 'get_hash', 'get_description', 'get_sources')]
    identifier: int
    data: int
    func: int
    get_hash: int
    get_description: int


class Callbacks(Structure):
    """``message_type_support_callbacks_t``; ``key_callbacks`` is not read on Humble."""

    _fields_ = [
        ('namespace', c_char_p), ('name', c_char_p), ('cdr_serialize', c_void_p), ('cdr_deserialize', c_void_p),
        ('get_serialized_size', c_void_p), ('max_serialized_size', c_void_p), ('key_callbacks', c_void_p),
    ]  # fmt: skip


class TypeHash(Structure):
    """``rosidl_type_hash_t``."""

    _fields_ = [('version', c_uint8), ('value', c_uint8 * 32)]


class FieldDescription(Structure):
    """``rosidl_runtime_c__type_description__Field``, with its ``FieldType``."""

    _fields_ = [
        ('name', Sequence), ('type_id', c_uint8), ('capacity', c_uint64), ('string_capacity', c_uint64), ('nested', Sequence),
        ('default_value', Sequence),
    ]  # fmt: skip


class IndividualDescription(Structure):
    """``rosidl_runtime_c__type_description__IndividualTypeDescription``."""

    _fields_ = [('name', Sequence), ('fields', Sequence)]


class Description(Structure):
    """``rosidl_runtime_c__type_description__TypeDescription``."""

    _fields_ = [('type', IndividualDescription), ('referenced', Sequence)]


class Layout(NamedTuple):
    """What is different in each distribution."""

    member: Any
    members: Any
    has_hash: bool


def _layout(*, has_hash: bool) -> Layout:
    """``rosidl_typesupport_introspection_c__MessageMember`` and ``__MessageMembers``."""

    class Member(Structure):
        _fields_ = [
            ('name', c_char_p), ('type_id', c_uint8), ('string_upper_bound', c_size_t), ('members', c_void_p),
            *([('is_key', c_bool)] if has_hash else []), ('is_array', c_bool), ('array_size', c_size_t),
            ('is_upper_bound', c_bool), ('offset', c_uint32), ('default_value', c_void_p),
            *((f'{of}_function', c_void_p) for of in ('size', 'get_const', 'get', 'fetch', 'assign', 'resize')),
        ]  # fmt: skip

    class Members(Structure):
        _fields_ = [
            ('namespace', c_char_p), ('name', c_char_p), ('count', c_uint32), ('size_of', c_size_t),
            *([('has_any_key', c_bool)] if has_hash else []), ('members', POINTER(Member)),
            ('init', c_void_p), ('fini', c_void_p),
        ]  # fmt: skip

    return Layout(Member, Members, has_hash)


_GetHandle = ctypes.CFUNCTYPE(c_void_p, c_void_p, c_char_p)
_Get = ctypes.CFUNCTYPE(c_void_p, c_void_p)
_Fail = ctypes.CFUNCTYPE(c_size_t)
_CONVERSIONS: Final = '_CREATE_ROS_MESSAGE', '_CONVERT_FROM_PY', '_CONVERT_TO_PY', '_DESTROY_ROS_MESSAGE'
_CLASSES: Final[dict[str, type]] = {}
_LOCK: Final = Lock()
"""Guards what is made."""
_KEPT: Final[list[object]] = []
"""Everything that the middleware has a pointer to, until the process ends."""
ctypes.pythonapi.Py_IncRef(ctypes.py_object(_KEPT))
_FAIL: Final = _Fail(int)
"""Answers 0, which is false, to any call: nothing that receives serialized messages calls what it stands for."""


class Unsupported(LookupError):
    """No type support can be made for a type here; the text is the reason."""


class Message(NamedTuple):
    """A type as rosidl generates it for the RMW, and the same for people and hashes."""

    support: TypeSupport
    members: Any
    size: int
    align: int
    fields: int
    """With those of nested types, each time they occur: so many that an RMW makes."""
    description: Mapping[str, Any]
    nested: frozenset[str]


class Maker:
    """Makes the structures of types, and keeps them until the process ends.

    ``get_handle`` is the address of ``get_message_typesupport_handle_function`` of rosidl_runtime_c.
    """

    def __init__(
        self, types: MessageTypes, layout: Layout, identifiers: Mapping[bytes, int], get_handle: int, max_serialized_size: int
    ) -> None:
        self._layout = layout
        self._identifiers, self._get_handle, self._max_serialized_size = identifiers, get_handle, max_serialized_size
        self._types = types
        self._made: dict[str, Message] = {}
        self._answers: tuple[dict[int, int], dict[int, int], dict[int, int]] = {}, {}, {}
        self._getters = [_Get(each.get) for each in self._answers]
        _KEPT.append(self)

    def support(self, type_name: str) -> TypeSupport:
        """The structure that a subscription is made from. Raises Unsupported or Rejected."""
        top = self.message(type_name)
        leaves = {INTROSPECTION: top.support}
        if FAST_DDS in self._identifiers:
            namespace, _, name = type_name.rpartition('/')
            callbacks = Callbacks(
                namespace.replace('/', '::').encode(), name.encode(), *[_address(_FAIL)] * 3, self._max_serialized_size, None
            )
            leaves[FAST_DDS] = self._leaf(FAST_DDS, callbacks)
        addresses = {identifier: ctypes.addressof(leaf) for identifier, leaf in leaves.items()}
        answer = _GetHandle(lambda _, identifier: addresses.get(identifier))
        made = TypeSupport(self._identifiers[INTROSPECTION], ctypes.addressof(top.members), _address(answer),
                           *map(_address, self._getters))  # fmt: skip
        _KEPT.extend((leaves, answer, made))
        if self._layout.has_hash:
            digest = bytes.fromhex(self.hash(type_name).removeprefix(HASH_VERSION))
            answers = TypeHash(1, (c_uint8 * 32)(*digest)), _description(self.description(type_name)), Sequence()
            _KEPT.extend(answers)
            for known, value in zip(self._answers, answers, strict=True):
                for each in (made, *leaves.values()):
                    known[ctypes.addressof(each)] = ctypes.addressof(value)
        return made

    def hash(self, type_name: str) -> str:
        """As in the graph; empty on Humble."""
        content = json.dumps(self.description(type_name)) if self._layout.has_hash else ''
        return f'{HASH_VERSION}{hashlib.sha256(content.encode()).hexdigest()}' if content else ''

    def description(self, type_name: str) -> Mapping[str, Any]:
        """The content of a TypeDescription, as it is hashed (REP 2016)."""
        top = self.message(type_name)
        return {
            'type_description': top.description,
            'referenced_type_descriptions': [self._made[name].description for name in sorted(top.nested)],
        }

    def message(self, type_name: str) -> Message:
        """The structures of a type for INTROSPECTION. Raises Unsupported or Rejected."""
        if type_name not in self._made:
            fields = self._types.fields(type_name) or [(PLACEHOLDER, (Nodetype.BASE, ('uint8', 0)))]
            self._made[type_name] = self._make(type_name, fields)
        return self._made[type_name]

    def difference(self, type_name: str) -> str:
        """What differs from what rosidl generated for the type, whose package is installed; empty if nothing does."""
        made = self.support(type_name)
        for identifier, address in self._identifiers.items():
            found = _GetHandle(made.func)(ctypes.addressof(made), identifier)
            ours, real = TypeSupport.from_address(found), _generated(type_name, identifier)
            if (ours.identifier, ours.func) != (real.identifier, real.func) or ours.identifier != address:
                return identifier.decode()
            if identifier == INTROSPECTION and not _equal_members(self._layout, ours.data, real.data):
                return 'structure'
            if identifier == FAST_DDS and _names(self._layout, ours.data) != _names(self._layout, real.data):
                return 'name'
            if self._layout.has_hash and _hash(ours) != _hash(real):
                return 'hash'
            if self._layout.has_hash and not _equal_descriptions(*map(_described, (ours, real))):
                return 'description'
        return ''

    def _make(self, type_name: str, fields: Any) -> Message:
        encoding, text, _ = describe(type_name)
        if '@key' in text:
            raise Unsupported(f'{type_name} has a key')
        members = (self._layout.member * len(fields))()
        count = offset = 0
        align, described, nested = 1, [], set[str]()
        for member, (name, (kind, content)) in zip(members, fields, strict=True):
            element, bound = ((kind, content), 0) if kind in (Nodetype.BASE, Nodetype.NAME) else content
            count += 1
            upper = 0
            if element[0] == Nodetype.NAME:
                inner = self.message(element[1])
                found, size, alignment = MESSAGE, inner.size, inner.align
                member.members = ctypes.addressof(inner.support)
                nested |= {element[1], *inner.nested}
                count += inner.fields
            elif element[0] == Nodetype.BASE and element[1][0] in PRIMITIVES and (element[1][0], encoding) != ('char', 'ros2idl'):
                found, upper = PRIMITIVES[element[1][0]], element[1][1]
                size, alignment = found.size, min(found.size, 8)
            else:
                raise Unsupported(f'{type_name} has a field {name} of a kind that is not supported: {element[1]}')
            described.append(_field(name, found, upper, kind, bound, element[1] if found is MESSAGE else ''))
            if kind == Nodetype.SEQUENCE:
                size, alignment = TEXT_BYTES, 8
            elif kind == Nodetype.ARRAY:
                size *= bound
            offset += -offset % alignment
            member.name, member.type_id, member.string_upper_bound, member.offset = (
                name.encode(),
                found.introspection,
                upper,
                offset,
            )
            member.is_array, member.array_size = kind in (Nodetype.ARRAY, Nodetype.SEQUENCE), bound
            member.is_upper_bound = kind == Nodetype.SEQUENCE and bound > 0
            offset, align = offset + size, max(align, alignment)
            if offset > MAX_BYTES or count > MAX_FIELDS:
                raise Unsupported(f'{type_name} is too large')
        size = offset + -offset % align
        namespace, _, short = type_name.rpartition('/')
        made = self._layout.members(namespace=namespace.replace('/', '__').encode(), name=short.encode(), count=len(fields),
                                    size_of=size, members=members, init=_address(_FAIL), fini=_address(_FAIL))  # fmt: skip
        description = {'type_name': type_name, 'fields': described}
        return Message(self._leaf(INTROSPECTION, made), made, size, align, count, description, frozenset(nested))

    def _leaf(self, identifier: bytes, data: Structure) -> TypeSupport:
        leaf = TypeSupport(self._identifiers[identifier], ctypes.addressof(data), self._get_handle, *map(_address, self._getters))
        _KEPT.extend((data, leaf))
        return leaf


def make(type_name: str) -> type:
    """A class that rclpy subscribes to and takes serialized messages with, and nothing else.

    Raises Unsupported, or Rejected if its definition is unknown.
    """
    maker, problem = _maker()
    if maker is None:
        raise Unsupported(problem)
    with _LOCK:
        return _CLASSES.get(type_name) or _make(type_name, maker)


def _make(type_name: str, maker: Maker) -> type:
    name, support = type_name.rpartition('/')[2], ctypes.addressof(maker.support(type_name))
    new = ctypes.pythonapi.PyCapsule_New
    new.restype, new.argtypes = ctypes.py_object, (c_void_p, c_char_p, c_void_p)
    attributes = {**dict.fromkeys(_CONVERSIONS, _FAIL), '_TYPE_SUPPORT': new(support, None, None)}
    made: type = type(f'Metaclass_{name}', (type,), attributes)(name, (), {'HASH': maker.hash(type_name)})
    _CLASSES[type_name] = made
    return made


@cache
def _maker() -> tuple[Maker | None, str]:
    """The maker of this process, or why there is none."""
    if os.environ.get('SHADOWHOUND_TYPE_SUPPORT', 'on').lower() in {'off', '0', 'false', 'no'}:
        return None, 'SHADOWHOUND_TYPE_SUPPORT is off'
    rmw, version = get_rmw_implementation_identifier(), rclpy_version()
    if (version[:1], rmw) not in TESTED or ctypes.sizeof(c_void_p) != POINTER_BYTES or sys.byteorder != 'little':
        return None, f'not tested with {rmw} and rclpy {".".join(map(str, version))}'
    try:
        return _verified(_layout(has_hash=version[0] >= FIRST_WITH_HASH), RMWS[rmw]), ''
    except (LookupError, AttributeError) as error:
        return None, f'the structures of this ROS are not as expected: {error}'


def _verified(layout: Layout, identifiers: Iterable[bytes]) -> Maker:
    """A maker whose types are as those that rosidl generated. Raises Unsupported."""
    first = {identifier: _generated(REFERENCES[0], identifier) for identifier in identifiers}
    limit = Callbacks.from_address(first[FAST_DDS].data).max_serialized_size if FAST_DDS in first else 0
    known = {identifier: each.identifier for identifier, each in first.items()}
    types = MessageTypes(os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep))
    maker = Maker(types, layout, known, first[INTROSPECTION].func, limit)
    for name in REFERENCES:
        if difference := maker.difference(name):
            raise Unsupported(f'{difference} of {name}')
    return maker


def _generated(type_name: str, identifier: bytes) -> TypeSupport:
    """What rosidl generated for an installed type. Raises Unsupported."""
    known: Any = type(installed_class(type_name))
    get = ctypes.pythonapi.PyCapsule_GetPointer
    get.restype, get.argtypes = c_void_p, (ctypes.py_object, c_char_p)
    address = get(known._TYPE_SUPPORT, None)
    found = _GetHandle(TypeSupport.from_address(address).func)(address, identifier)
    if not found:
        raise Unsupported(f'{type_name} has no {identifier.decode()}')
    return TypeSupport.from_address(found)


def _equal_members(layout: Layout, ours: int, theirs: int) -> bool:
    """Compare numbers before following a pointer next to them: in an unknown structure it may be something else."""
    made, real = layout.members.from_address(ours), layout.members.from_address(theirs)
    if (made.count, made.size_of, bool(real.members)) != (real.count, real.size_of, True) or (made.namespace, made.name) != (
        real.namespace,
        real.name,
    ):
        return False
    numbers = [name for name, of in layout.member._fields_ if of in (c_uint8, c_uint32, c_size_t, c_bool)]
    return all(
        [getattr(mine, name) for name in numbers] == [getattr(other, name) for name in numbers]
        and (bool(mine.members), mine.name) == (bool(other.members), other.name)
        and (not mine.members or _equal_members(layout, *(TypeSupport.from_address(each.members).data for each in (mine, other))))
        for mine, other in zip(made.members[: made.count], real.members[: made.count], strict=True)
    )


def _names(layout: Layout, callbacks: int) -> tuple[bytes, bytes, bool]:
    found = Callbacks.from_address(callbacks)
    return found.namespace, found.name, layout.has_hash and bool(found.key_callbacks)


def _described(support: TypeSupport) -> int:
    return int(_Get(support.get_description)(ctypes.addressof(support)) or 0)


def _hash(support: TypeSupport) -> bytes:
    return ctypes.string_at(_Get(support.get_hash)(ctypes.addressof(support)), ctypes.sizeof(TypeHash))


def _field(name: str, found: Primitive, upper: int, kind: int, bound: int, nested: str) -> dict[str, Any]:
    """A field in a type's description; the order of the keys is that of the hash."""
    of = {Nodetype.ARRAY: ARRAY, Nodetype.SEQUENCE: BOUNDED_SEQUENCE if bound else SEQUENCE}.get(Nodetype(kind), 0)
    type_id = found.description + of + BOUNDED_TEXT * (upper > 0)
    return {'name': name, 'type': {'type_id': type_id, 'capacity': bound, 'string_capacity': upper, 'nested_type_name': nested}}


def _text(value: str) -> Sequence:
    data = ctypes.create_string_buffer(value.encode())
    _KEPT.append(data)
    return Sequence(ctypes.addressof(data), len(data) - 1, len(data))


def _sequence(of: type[Structure], items: list[Any]) -> Sequence:
    data = (of * len(items))(*items)
    _KEPT.append(data)
    return Sequence(ctypes.addressof(data) if items else None, len(items), len(items))


def _individual(content: Mapping[str, Any]) -> IndividualDescription:
    fields = [
        FieldDescription(_text(each['name']), each['type']['type_id'], each['type']['capacity'], each['type']['string_capacity'],
                         _text(each['type']['nested_type_name']), _text(''))
        for each in content['fields']
    ]  # fmt: skip
    return IndividualDescription(_text(content['type_name']), _sequence(FieldDescription, fields))


def _description(content: Mapping[str, Any]) -> Description:
    referenced = [_individual(each) for each in content['referenced_type_descriptions']]
    return Description(_individual(content['type_description']), _sequence(IndividualDescription, referenced))


def _address(function: Any) -> int:
    return ctypes.cast(function, c_void_p).value or 0


def _equal_descriptions(ours: int, theirs: int) -> bool:
    """Compares all but the default values, which are not part of the hash."""
    made, real = Description.from_address(ours), Description.from_address(theirs)
    counts = [(each.type.name.size, each.type.fields.size, each.referenced.size) for each in (made, real)]
    return counts[0] == counts[1] and _read_description(made) == _read_description(real)


def _read_description(description: Description) -> list[object]:
    types = [description.type, *_items(IndividualDescription, description.referenced)]
    return [
        (_read(each.name), [(_read(field.name), field.type_id, field.capacity, field.string_capacity, _read(field.nested))
                            for field in _items(FieldDescription, each.fields)])
        for each in types
    ]  # fmt: skip


def _read(text: Sequence) -> bytes:
    return ctypes.string_at(text.data, text.size)


def _items(of: type[Structure], sequence: Sequence) -> Any:
    return (of * sequence.size).from_address(sequence.data) if sequence.size else ()
