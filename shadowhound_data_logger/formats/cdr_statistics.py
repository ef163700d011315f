"""Statistics of a batch from its CDR bytes: one numpy pass over all messages, without decoding them.

If the strings and sequences of all messages are as long as those of the first one, each number has the same offset in all
messages. This is checked for every batch. For other batches, formats/statistics.py computes the statistics from the JSON.

The numbers equal those in the JSON, except for the mean, which is accurate to ``MEAN_ERROR`` (formats/statistics.py).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype

from shadowhound_data_logger.formats.cdr import ENCAPSULATION_BYTES
from shadowhound_data_logger.formats.statistics import MAX_DEPTH, MAX_ELEMENTS, MAX_FIELDS, covers, pack_parts
from shadowhound_data_logger.formats.types import PLACEHOLDER, SIZES, MessageTypes

if TYPE_CHECKING:
    from numpy.typing import NDArray

_LENGTH: Final = struct.Struct('<I')
_FLOAT32: Final = '<f4'
_CODES: Final = {
    'bool': '?', 'byte': 'u1', 'char': 'u1', 'int8': 'i1', 'uint8': 'u1', 'int16': '<i2', 'uint16': '<u2', 'int32': '<i4',
    'uint32': '<u4', 'int64': '<i8', 'uint64': '<u8', 'float32': _FLOAT32, 'float64': '<f8',
}  # fmt: skip
_TEXT_BYTES: Final = frozenset({'uint8', 'byte', 'char', 'octet'})
"""Sequences of these become text in the JSON."""


class _Unsupported(Exception):
    """A layout that this module does not support."""


class _Run(NamedTuple):
    """Adjacent numbers in a message."""

    code: str
    offset: int
    size: int


@dataclass(frozen=True, slots=True)
class _Layout:
    """The offsets of the numbers in all messages with the same lengths."""

    fixed: NDArray[np.intp]
    """Offsets of the bytes that contain the endianness and the lengths."""
    content: NDArray[np.uint8]
    """The values of these bytes."""
    dtype: np.dtype[Any]
    """A message as a structured type: each run of numbers is a field, named by its index in ``starts``."""
    starts: tuple[int, ...]
    """First column of each run of fields that have one number per message, then the end."""
    names: tuple[list[str], list[str]]
    """The names of these fields: the float32 ones, and the others."""
    columns: tuple[NDArray[np.intp], NDArray[np.intp]]
    """Their columns."""
    multiples: tuple[tuple[str, tuple[str, ...]], ...]
    """Fields with several numbers per message, and their runs."""
    omitted: int
    """The number of fields without statistics."""

    def fits(self, rows: NDArray[np.uint8]) -> bool:
        """Whether messages, one per row, have this layout."""
        return rows.shape[1] == self.dtype.itemsize and bool((rows[:, self.fixed] == self.content).all())


class BatchStatistics:
    """Computes the statistics of batches of one type, in any thread. Caches the last layout."""

    def __init__(self, types: MessageTypes, type_name: str, chosen: tuple[str, ...], named: Callable[[str], str | None]) -> None:
        """``named`` maps the path of a field in the message to its name in the document; None if it is not in the document."""
        self._types, self._type, self._named = types, type_name, named
        self._chosen = tuple(name for name in chosen if name)
        self._layout: _Layout | None = None

    def compute(self, messages: Sequence[bytes]) -> bytes | None:
        """The packed statistics; None if the messages differ in their layouts."""
        size = len(messages[0])
        if size <= ENCAPSULATION_BYTES or len(set(map(len, messages))) > 1:
            return None
        joined = b''.join(messages)
        rows = np.frombuffer(joined, np.uint8).reshape(len(messages), size)
        layout = self._layout
        if layout is None or not layout.fits(rows):
            try:
                layout = _LayoutReader(self._types, messages[0], self._named).layout(self._type, self._chosen)
            except (_Unsupported, struct.error):
                return None
            if not layout.fits(rows):
                return None
            self._layout = layout
        return _compute(layout, np.frombuffer(joined, layout.dtype))


class _LayoutReader:
    """Walks through one message to find the offsets of its numbers."""

    def __init__(self, types: MessageTypes, cdr: bytes, named: Callable[[str], str | None]) -> None:
        self._types, self._cdr, self._named = types, cdr, named
        self._at = ENCAPSULATION_BYTES
        self._lengths: list[int] = []
        self._found: dict[str, list[_Run]] = {}

    def layout(self, type_name: str, chosen: tuple[str, ...]) -> _Layout:
        """Raises _Unsupported, or struct.error if the message is truncated."""
        if self._cdr[1] != 1:
            raise _Unsupported
        self._message(type_name, '', 0, is_seen=True)
        if self._at > len(self._cdr):
            raise _Unsupported
        names = [name for name in self._found if not chosen or any(covers(each, name) for each in chosen)][:MAX_FIELDS]
        singles: list[tuple[str, list[_Run]]] = []
        multiples: list[tuple[str, list[_Run]]] = []
        for name in names:
            runs = self._found[name]
            (singles if len(runs) == runs[0].size == 1 else multiples).append((name, runs))
        joined = _join_runs(runs[0] for _, runs in singles)
        wide = [(name, [f'{number} {place}' for place in range(len(runs))]) for number, (name, runs) in enumerate(multiples)]
        fields = [(str(number), run) for number, run in enumerate(joined)]
        fields += [
            pair for (_, places), (_, runs) in zip(wide, multiples, strict=True) for pair in zip(places, runs, strict=True)
        ]
        layout: Any = {'names': [name for name, _ in fields], 'formats': [(run.code, (run.size,)) for _, run in fields]}
        layout |= {'offsets': [run.offset for _, run in fields], 'itemsize': len(self._cdr)}
        are_floats = [runs[0].code == _FLOAT32 for _, runs in singles]
        of_floats, of_others = np.flatnonzero(are_floats), np.flatnonzero(np.logical_not(are_floats))
        fixed = np.array([1, *(at + byte for at in self._lengths for byte in range(_LENGTH.size))], np.intp)
        return _Layout(
            fixed, np.frombuffer(self._cdr, np.uint8)[fixed], np.dtype(layout), (0, *accumulate(run.size for run in joined)),
            ([singles[place][0] for place in of_floats], [singles[place][0] for place in of_others]), (of_floats, of_others),
            tuple((name, tuple(places)) for name, places in wide), len(self._found) - len(names),
        )  # fmt: skip

    def _message(self, type_name: str, name: str, depth: int, *, is_seen: bool) -> None:
        for field, description in self._types.fields(type_name):
            path = f'{name}.{field}' if name else field
            self._value(description, path, depth + 1, is_seen=is_seen and depth <= MAX_DEPTH and field != PLACEHOLDER)

    def _value(self, description: Any, name: str, depth: int, *, is_seen: bool) -> None:
        kind, of = description
        if kind == Nodetype.NAME:
            self._message(of, name, depth, is_seen=is_seen)
        elif kind == Nodetype.BASE:
            if of[0] == 'string':
                length = self._length()
                self._at += length
            else:
                self._numbers(of[0], 1, name, is_seen=is_seen)
        else:
            inner, count = of
            is_text = kind == Nodetype.SEQUENCE and inner[0] == Nodetype.BASE and inner[1][0] in _TEXT_BYTES
            count = self._length() if kind == Nodetype.SEQUENCE else count
            self._elements(inner, count, name, depth, is_seen=is_seen and not is_text and depth <= MAX_DEPTH)

    def _elements(self, inner: Any, count: int, name: str, depth: int, *, is_seen: bool) -> None:
        if inner[0] == Nodetype.BASE and inner[1][0] != 'string' and (count > MAX_ELEMENTS or not is_seen):
            self._numbers(inner[1][0], count, f'{name}.*', is_seen=is_seen)
            return
        for place in range(count):
            if self._at > len(self._cdr):
                raise _Unsupported
            self._value(inner, f'{name}.{place if count <= MAX_ELEMENTS else "*"}', depth + 1, is_seen=is_seen)

    def _numbers(self, base: str, count: int, name: str, *, is_seen: bool) -> None:
        size = SIZES.get(base)
        if size is None:
            raise _Unsupported
        if not count:
            return
        self._at += -(self._at - ENCAPSULATION_BYTES) % size
        if is_seen and (field := self._named(name)) is not None:
            self._found.setdefault(field, []).append(_Run(_CODES[base], self._at, count))
        self._at += count * size

    def _length(self) -> int:
        self._at += -(self._at - ENCAPSULATION_BYTES) % _LENGTH.size
        (length,) = _LENGTH.unpack_from(self._cdr, self._at)
        self._lengths.append(self._at)
        self._at += _LENGTH.size
        return int(length)


def _join_runs(runs: Iterable[_Run]) -> list[_Run]:
    """Adjacent runs of the same type, joined."""
    found: list[_Run] = []
    for run in runs:
        last = found[-1] if found else None
        if last and last.code == run.code and last.offset + last.size * np.dtype(last.code).itemsize == run.offset:
            found[-1] = last._replace(size=last.size + run.size)
        else:
            found.append(run)
    return found


def _compute(layout: _Layout, rows: NDArray[Any]) -> bytes:
    messages, parts = len(rows), []
    table = np.empty((messages, layout.starts[-1]))
    for number, (start, end) in enumerate(pairwise(layout.starts)):
        table[:, start:end] = rows[str(number)]
    with np.errstate(all='ignore'):
        numbers = table if messages == 1 else _numbers(table)
        for names, columns, is_float in zip(layout.names, layout.columns, (True, False), strict=True):
            if not names:
                continue
            some = numbers.take(columns, axis=1)
            if np.isfinite(some[-2:]).all():
                parts.append(_part(names, some, messages, is_float=is_float))
            else:
                parts += [_one(name, table[:, column], is_float=is_float) for name, column in zip(names, columns, strict=True)]
        for name, runs in layout.multiples:
            values = (rows[runs[0]] if len(runs) == 1 else np.concatenate([rows[run] for run in runs], axis=1)).reshape(-1)
            parts.append(_one(name, values, is_float=values.dtype == np.float32))
    return pack_parts(messages, layout.omitted, parts)


def _numbers(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows first, last, mean, min, max. A non-finite number in a column makes its min or max non-finite."""
    found = np.empty((5, table.shape[1]))
    found[0], found[1] = table[0], table[-1]
    np.add.reduce(table, 0, None, found[2])
    found[2] /= len(table)
    np.minimum.reduce(table, 0, None, found[3])
    np.maximum.reduce(table, 0, None, found[4])
    return found


def _one(name: str, values: NDArray[Any], *, is_float: bool) -> dict[str, Any]:
    """The part of one field, whose numbers may be non-finite."""
    present = values[np.isfinite(values)]
    if not len(present):
        return {'fields': [name], 'numbers': [], 'count': 0, 'nan_count': len(values)}
    numbers = np.array([present[0], present[-1], present.mean(dtype=np.float64), present.min(), present.max()], np.float64)
    return _part([name], numbers[:, np.newaxis], len(present), len(values) - len(present), is_float=is_float)


def _part(names: list[str], numbers: NDArray[np.float64], count: int, nan_count: int = 0, *, is_float: bool) -> dict[str, Any]:
    # The JSON has the shortest decimals of float32, so orjson must write float32 here too.
    return {
        'fields': names,
        'numbers': numbers.astype(np.float32) if is_float else numbers,
        'count': count,
        'nan_count': nan_count,
    }
