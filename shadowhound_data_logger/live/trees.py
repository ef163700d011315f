"""A message of any type as a tree for the page, and single numbers of it. A tree is small whatever the message contains.

A node of a tree is a scalar of JSON, a message (``{"t": type, "f": {field: node}}``), or an array (``{"t": type, "n": length,
"a": [first nodes]}``). Numbers that JavaScript cannot represent are text. A path names one number: ``pose.position.x`` or
``ranges[7]``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from functools import lru_cache
from itertools import islice
from typing import Any, Final

import numpy as np
from rosbags.interfaces import Nodetype

from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.formats.types import PLACEHOLDER, MessageTypes, nested_type

MAX_NODES: Final = 1500
MAX_SHOWN: Final = 32
"""Elements of an array."""
MAX_TEXT: Final = 300
MAX_CHARACTERS: Final = 40_000
"""Of all text in a tree."""
MAX_DEPTH: Final = 20
MAX_PATH: Final = 200
CUT: Final = '…'
"""Replaces what a tree omits."""
_EXACT: Final = 1 << 53
_PATH: Final = re.compile(r'[A-Za-z]\w*(?:\.[A-Za-z]\w*|\[\d{1,7}\])*', re.ASCII)
_PART: Final = re.compile(r'(\w+)(\])?')


class _Builder:
    """Builds one tree, within the limits."""

    def __init__(self, types: MessageTypes) -> None:
        self._types = types
        self._nodes, self._characters = MAX_NODES, MAX_CHARACTERS

    def message(self, type_name: str, value: Any, depth: int = 0) -> Any:
        fields: dict[str, Any] = {}
        for name, description in self._types.fields(type_name):
            if self._nodes <= 0 or depth > MAX_DEPTH:
                fields[CUT] = CUT
                break
            if name != PLACEHOLDER:
                is_single = _is_single(description)
                fields[name] = self._node(nested_type(description), getattr(value, name), depth + 1, is_single=is_single)
        return {'t': type_name, 'f': fields}

    def _node(self, nested: str | None, value: Any, depth: int, *, is_single: bool = False) -> Any:
        self._nodes -= 1
        if isinstance(value, (list, tuple, np.ndarray)):
            shown = []
            for each in islice(value, MAX_SHOWN):
                if self._nodes <= 0:
                    break
                shown.append(self._node(nested, each, depth, is_single=is_single))
            kind = nested or (str(value.dtype) if isinstance(value, np.ndarray) else '')
            return {'t': kind, 'n': len(value), 'a': shown}
        if nested is not None:
            return self.message(nested, value, depth)
        plain = value.item() if isinstance(value, np.generic) else value
        return self._scalar(float(f'{plain:.7g}') if is_single else plain)

    def _scalar(self, value: Any) -> Any:
        if isinstance(value, bool):
            return value
        if isinstance(value, float):
            return value if math.isfinite(value) else str(value)
        if isinstance(value, int):
            return value if abs(value) < _EXACT else str(value)
        text = str(value)
        most = max(0, min(MAX_TEXT, self._characters))
        self._characters -= min(len(text), most)
        return text if len(text) <= most else text[:most] + CUT


def _is_single(description: Any) -> bool:
    """Whether a field is float32, which has seven significant digits."""
    kind, of = description
    return _is_single(of[0]) if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) else kind == Nodetype.BASE and of[0] == 'float32'


def tree(types: MessageTypes, type_name: str, message: Any) -> Any:
    """The tree of a message of ``rosbags``."""
    return _Builder(types).message(type_name, message)


@lru_cache(maxsize=256)
def parsed(path: str) -> tuple[str | int, ...]:
    """The names and indexes of a path. Raises Rejected."""
    if len(path) > MAX_PATH or not _PATH.fullmatch(path):
        raise Rejected('unknown_field', f'{path[:80]!r} is not a path such as pose.position.x or ranges[7]')
    return tuple(int(part) if is_index else part for part, is_index in _PART.findall(path))


def number(message: Any, path: str) -> float:
    """The number at a path; NaN if an array is shorter. Raises Rejected if the type has no such number."""
    value = message
    for part in parsed(path):
        if isinstance(part, int):
            if not isinstance(value, (list, tuple, np.ndarray)):
                break
            if part >= len(value):
                return math.nan
            value = value[part]
        elif part in getattr(value, '__dataclass_fields__', ()):
            value = getattr(value, part)
        else:
            break
    else:
        if isinstance(value, (bool, int, float, np.number, np.bool_)):
            return float(value)
    raise Rejected('unknown_field', f'{path[:80]!r} is not a number of this message')


def numbers(messages: Iterable[tuple[float, Any]], path: str) -> list[tuple[float, dict[str, float]]]:
    """Rows with one value, with the times of the messages."""
    return [(at_ms, {path: number(message, path)}) for at_ms, message in messages]
