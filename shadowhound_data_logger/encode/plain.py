"""Decoded messages as plain values that ``orjson`` can write: one compiled expression a type, made from its definition.

Numbers come out exact: ``float32`` scalars become ``numpy.float32``, because then the shortest decimal that reads back as that
float32 is written, as it is for arrays.
"""

from __future__ import annotations

from binascii import b2a_base64
from collections.abc import Callable, Collection
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys.base import normalize_fieldname

from shadowhound_data_logger.encode.types import PLACEHOLDER, MessageTypes, nested_type

if TYPE_CHECKING:
    from rosbags.interfaces.typing import FieldDesc

Convert = Callable[[Any], dict[str, Any]]
_BYTES: Final = frozenset({'uint8', 'byte', 'char', 'octet'})


@lru_cache(maxsize=1024)
def converter(types: MessageTypes, type_name: str, taken: frozenset[str] = frozenset()) -> Convert:
    """The function from a decoded message of a type to a dict of its fields in order. Raises Rejected: ``unknown_type``.

    Nested messages become dicts, arrays and sequences of numbers stay numpy arrays, sequences of bytes (``uint8[]``, bounded
    or not, but no fixed arrays) become base64 text. A field whose name is ``taken`` gets an underscore behind it.
    """
    # One expression, such as ``{'stamp': {'sec': m.stamp.sec}, 'q': float32(m.q)}``: a call for each nested message
    # costs more than its values. All names in it are identifiers of a definition that was parsed.
    source = f'lambda m: {_message(types, type_name, "m", taken)}'
    convert: Convert = eval(source, {'float32': np.float32, 'base64': _base64, 'unsigned': _unsigned})  # noqa: S307
    return convert


def _message(types: MessageTypes, type_name: str, at: str, taken: frozenset[str] = frozenset()) -> str:
    """The expression for a message that is the value of the expression ``at``."""
    fields = {name: description for name, description in types.fields(type_name) if name != PLACEHOLDER}
    entries = []
    for name, description in fields.items():
        value = _value(types, description, f'{at}.{normalize_fieldname(name)}')
        entries.append(f'{_free(name, taken, fields)!r}: {value}')
    return f'{{{", ".join(entries)}}}'


def _free(name: str, taken: Collection[str], fields: Collection[str]) -> str:
    """The name, or the first one like it that is neither taken nor another field's."""
    free = name
    while free in taken or (free != name and free in fields):
        free += '_'
    return free


def _value(types: MessageTypes, description: FieldDesc, at: str) -> str:
    """The expression for a field; ``at`` itself where orjson writes its value rightly as it is."""
    nested = nested_type(description)
    if nested is not None:
        if description[0] == Nodetype.NAME:
            return _message(types, nested, at)
        return f'[{_message(types, nested, "i")} for i in {at}]'
    if description[0] == Nodetype.BASE:
        return {'float32': f'float32({at})', 'byte': f'{at} & 255'}.get(description[1][0], at)
    base = description[1][0][1][0]
    if description[0] == Nodetype.SEQUENCE and base in _BYTES:
        return f'base64({at})'
    return f'unsigned({at})' if base == 'byte' else at


def _unsigned(values: Any) -> Any:
    """An array of ``byte`` as ROS 2 means it, 0 to 255; ``rosbags`` reads it signed."""
    return values.view(np.uint8)


def _base64(data: Any) -> str:
    return b2a_base64(data, newline=False).decode('ascii')


def widened(value: Any) -> Any:
    """The same plain value with every float32 as the float64 that equals it."""
    if isinstance(value, dict):
        return {key: widened(item) for key, item in value.items()}
    if isinstance(value, list):
        return [widened(item) for item in value]
    if isinstance(value, np.float32):
        return float(value)
    if isinstance(value, np.ndarray) and value.dtype == np.float32:
        return value.astype(np.float64)
    return value
