"""Statistics of a batch from its CDR bytes at once, one numpy pass for all messages, without decoding any of them.

In messages of one type whose strings and sequences are all as long as those of the first, each number has the same place. That
is checked on every batch. Of other batches nothing is told here: formats/statistics.py then looks into the JSON.

The numbers are those that stand in the JSON, but the mean, which is right to ``MEAN_ERROR`` (formats/statistics.py).
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
from shadowhound_data_logger.formats.statistics import MAX_DEPTH, MAX_ELEMENTS, MOST_FIELDS, covers, packed_parts
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
"""Sequences of these are text in the JSON."""


class _Unknown(Exception):
    """A layout that this module does not know."""


class _Run(NamedTuple):
    """Numbers that lie side by side in a message."""

    code: str
    offset: int
    size: int


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where the numbers are in all messages with the same lengths."""

    fixed: NDArray[np.intp]
    """Places of the bytes that tell the endianness and the lengths."""
    content: NDArray[np.uint8]
    """What they are."""
    dtype: np.dtype[Any]
    """A message, and in it each run of numbers by its place in ``starts``."""
    starts: tuple[int, ...]
    """First column of each run of fields that have one number in a message, then the end."""
    names: tuple[list[str], list[str]]
    """Those of these fields that are float32, and the others."""
    columns: tuple[NDArray[np.intp], NDArray[np.intp]]
    manies: tuple[tuple[str, tuple[str, ...]], ...]
    """Fields with several numbers in a message, and their runs."""
    left_out: int

    def fits(self, rows: NDArray[np.uint8]) -> bool:
        """Whether messages, a row each, have it."""
        return rows.shape[1] == self.dtype.itemsize and bool((rows[:, self.fixed] == self.content).all())


class BatchStatistics:
    """Of batches of one type. Any thread; the layout that was seen last is kept."""

    def __init__(self, types: MessageTypes, type_name: str, chosen: tuple[str, ...], named: Callable[[str], str | None]) -> None:
        """``named``: what a field is called in the document, by its path in the message; None where it is not in it."""
        self._types, self._type, self._named = types, type_name, named
        self._chosen = tuple(name for name in chosen if name)
        self._layout: _Layout | None = None

    def told(self, messages: Sequence[bytes]) -> bytes | None:
        """As ``packed``; None where the messages are not of one layout."""
        size = len(messages[0])
        if size <= ENCAPSULATION_BYTES or len(set(map(len, messages))) > 1:
            return None
        joined = b''.join(messages)
        rows = np.frombuffer(joined, np.uint8).reshape(len(messages), size)
        layout = self._layout
        if layout is None or not layout.fits(rows):
            try:
                layout = _Walk(self._types, messages[0], self._named).layout(self._type, self._chosen)
            except (_Unknown, struct.error):
                return None
            if not layout.fits(rows):
                return None
            self._layout = layout
        return _told(layout, np.frombuffer(joined, layout.dtype))


class _Walk:
    """Goes through a message once to find where everything is."""

    def __init__(self, types: MessageTypes, cdr: bytes, named: Callable[[str], str | None]) -> None:
        self._types, self._cdr, self._named = types, cdr, named
        self._at = ENCAPSULATION_BYTES
        self._lengths: list[int] = []
        self._found: dict[str, list[_Run]] = {}

    def layout(self, type_name: str, chosen: tuple[str, ...]) -> _Layout:
        """Raises _Unknown, or struct.error at the end of the bytes."""
        if self._cdr[1] != 1:
            raise _Unknown
        self._message(type_name, '', 0, is_seen=True)
        if self._at > len(self._cdr):
            raise _Unknown
        names = [name for name in self._found if not chosen or any(covers(each, name) for each in chosen)][:MOST_FIELDS]
        singles: list[tuple[str, list[_Run]]] = []
        manies: list[tuple[str, list[_Run]]] = []
        for name in names:
            runs = self._found[name]
            (singles if len(runs) == runs[0].size == 1 else manies).append((name, runs))
        joined = _joined(runs[0] for _, runs in singles)
        wide = [(name, [f'{number} {place}' for place in range(len(runs))]) for number, (name, runs) in enumerate(manies)]
        fields = [(str(number), run) for number, run in enumerate(joined)]
        fields += [pair for (_, places), (_, runs) in zip(wide, manies, strict=True) for pair in zip(places, runs, strict=True)]
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
                raise _Unknown
            self._value(inner, f'{name}.{place if count <= MAX_ELEMENTS else "*"}', depth + 1, is_seen=is_seen)

    def _numbers(self, base: str, count: int, name: str, *, is_seen: bool) -> None:
        size = SIZES.get(base)
        if size is None:
            raise _Unknown
        if not count:
            return
        self._at += -(self._at - ENCAPSULATION_BYTES) % size
        if is_seen and (told := self._named(name)) is not None:
            self._found.setdefault(told, []).append(_Run(_CODES[base], self._at, count))
        self._at += count * size

    def _length(self) -> int:
        self._at += -(self._at - ENCAPSULATION_BYTES) % _LENGTH.size
        (length,) = _LENGTH.unpack_from(self._cdr, self._at)
        self._lengths.append(self._at)
        self._at += _LENGTH.size
        return int(length)


def _joined(runs: Iterable[_Run]) -> list[_Run]:
    """Runs of one kind that lie side by side as one."""
    found: list[_Run] = []
    for run in runs:
        last = found[-1] if found else None
        if last and last.code == run.code and last.offset + last.size * np.dtype(last.code).itemsize == run.offset:
            found[-1] = last._replace(size=last.size + run.size)
        else:
            found.append(run)
    return found


def _told(layout: _Layout, rows: NDArray[Any]) -> bytes:
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
        for name, runs in layout.manies:
            values = (rows[runs[0]] if len(runs) == 1 else np.concatenate([rows[run] for run in runs], axis=1)).reshape(-1)
            parts.append(_one(name, values, is_float=values.dtype == np.float32))
    return packed_parts(messages, layout.left_out, parts)


def _numbers(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """A row for each of first, last, mean, min, max; a number that is not finite shows in the last two."""
    found = np.empty((5, table.shape[1]))
    found[0], found[1] = table[0], table[-1]
    np.add.reduce(table, 0, None, found[2])
    found[2] /= len(table)
    np.minimum.reduce(table, 0, None, found[3])
    np.maximum.reduce(table, 0, None, found[4])
    return found


def _one(name: str, values: NDArray[Any], *, is_float: bool) -> dict[str, Any]:
    """Of one field, whose numbers need not be finite."""
    present = values[np.isfinite(values)]
    if not len(present):
        return {'fields': [name], 'numbers': [], 'count': 0, 'nan_count': len(values)}
    numbers = np.array([present[0], present[-1], present.mean(dtype=np.float64), present.min(), present.max()], np.float64)
    return _part([name], numbers[:, np.newaxis], len(present), len(values) - len(present), is_float=is_float)


def _part(names: list[str], numbers: NDArray[np.float64], count: int, nan_count: int = 0, *, is_float: bool) -> dict[str, Any]:
    """The shortest decimals of float32 are those in the JSON."""
    said = numbers.astype(np.float32) if is_float else numbers
    return {'fields': names, 'numbers': said, 'count': count, 'nan_count': nan_count}
