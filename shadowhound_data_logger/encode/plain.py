"""Decoded messages as plain values that ``orjson`` can write: one compiled function a type, made from its definition.

Numbers come out exact: ``float32`` scalars stay ``numpy.float32``, because then the shortest decimal that reads back as that
float32 is written, as it is for arrays.
"""

from __future__ import annotations

from binascii import b2a_base64
from collections.abc import Callable
from functools import lru_cache
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys.base import normalize_fieldname

from shadowhound_data_logger.encode.types import PLACEHOLDER, MessageTypes, nested_type

if TYPE_CHECKING:
    from rosbags.interfaces.typing import FieldDesc

Convert = Callable[[Any], Any]
_BYTES: Final = frozenset({'uint8', 'byte', 'char', 'octet'})


@lru_cache(maxsize=1024)
def converter(types: MessageTypes, type_name: str) -> Callable[[Any], dict[str, Any]]:
    """The function from a decoded message of a type to a dict of its fields in order. Raises Rejected: ``unknown_type``.

    Nested messages become dicts, arrays and sequences of numbers stay numpy arrays, sequences of bytes (``uint8[]``, bounded
    or not, but no fixed arrays) become base64 text.
    """
    fields = [(name, description) for name, description in types.fields(type_name) if name != PLACEHOLDER]
    keys = tuple(name for name, _ in fields)
    attributes = tuple(normalize_fieldname(name) for name in keys)
    conversions = [(key, _conversion(types, description)) for key, (_, description) in zip(keys, fields, strict=True)]
    needed = tuple((key, convert) for key, convert in conversions if convert is not None)
    read = _reader(attributes)

    def convert_message(message: Any) -> dict[str, Any]:
        values = dict(zip(keys, read(message), strict=True))
        for key, convert in needed:
            values[key] = convert(values[key])
        return values

    return convert_message


def _reader(attributes: tuple[str, ...]) -> Callable[[Any], tuple[Any, ...]]:
    """Like attrgetter, but gives a tuple for any number of attributes."""
    if len(attributes) > 1:
        return attrgetter(*attributes)
    return lambda message: tuple(getattr(message, name) for name in attributes)


def _conversion(types: MessageTypes, description: FieldDesc) -> Convert | None:
    """What has to be done to a field's value; None where orjson writes it rightly as it is."""
    nested = nested_type(description)
    if nested is not None:
        convert = converter(types, nested)
        if description[0] == Nodetype.NAME:
            return convert
        return lambda messages: [convert(message) for message in messages]
    if description[0] == Nodetype.BASE:
        return _SCALARS.get(description[1][0])
    base = description[1][0][1][0]
    if description[0] == Nodetype.SEQUENCE and base in _BYTES:
        return _base64
    return _unsigned_array if base == 'byte' else None


def _unsigned(value: int) -> int:
    """A ``byte`` as ROS 2 means it, 0 to 255; ``rosbags`` reads it signed."""
    return value & 0xFF


def _unsigned_array(values: Any) -> Any:
    return values.view(np.uint8)


_SCALARS: Final[dict[str, Convert]] = {'float32': np.float32, 'byte': _unsigned}


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
