"""Statistics of the numbers in an object: first, last, minimum, maximum, mean, their count, and the count of non-finite ones.

They describe the stored content, so a reader of the object computes the same: the decimals in a JSON, the brightness and
sharpness of a JPEG, the fields of the points in a PCD.

A field is named by its path, such as ``accelerometer.2`` or ``motor_state.0.q``. Each element of a list of at most
``MAX_ELEMENTS`` is a separate field; the elements of a longer list are one field, such as ``ranges.*``. The row ``ALL`` is about
the object: the number of its messages, and of its fields without statistics.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import fsum, isfinite
from operator import attrgetter
from typing import Any, Final

import orjson

MAX_FIELDS: Final = 64
"""Maximum fields of one object: the first ones, unless the sensor's parameter ``statistics`` selects fields."""
MAX_ELEMENTS: Final = 20
MAX_DEPTH: Final = 8
MAX_PACKED_BYTES: Final = 1 << 16
"""Maximum size of an object's packed statistics."""
MEAN_ERROR: Final = 2.0**-50
"""Relative to the largest magnitude: sums are rounded, those of the parts and their total."""
ALL: Final = ''
INFINITE: Final = ('Infinity', '-Infinity')
"""Infinities in JSON."""
NONE: Final = 'none'
"""Setting that disables statistics, in place of the names of fields."""
WITHOUT_STATISTICS: Final = frozenset({'stamp_ns', 'timestamp', 'header', 'non_finite'})
"""Top-level names that describe the document or its time, not a measurement."""


@dataclass(frozen=True, slots=True)
class Statistic:
    """Statistics of the finite numbers of a field in an object; None if it has none. The mean is None if the sum overflows.

    The mean is exact to ``max(abs(min), abs(max)) * MEAN_ERROR``.
    """

    first: float | None
    last: float | None
    min: float | None
    max: float | None
    mean: float | None
    count: int
    nan_count: int
    """Count of the non-finite numbers: NaN, which is null in JSON, and infinities. In ``ALL``: fields without statistics."""


NUMBERS: Final = ('first', 'last', 'min', 'max', 'mean', 'count', 'nan_count')
numbers_of: Final = attrgetter(*NUMBERS)
"""Returns the numbers of a statistic in the order of ``NUMBERS``."""


class FieldStatistics:
    """Computes the statistics of records, which are added in equal parts."""

    def __init__(self, chosen: Sequence[str] = ()) -> None:
        """``chosen``: names of fields, or name prefixes that end before a dot; empty means all fields."""
        self._chosen = tuple(name for name in chosen if name)
        self._found: dict[str, _FieldSummary] = {}
        self._omitted: set[str] = set()
        self._records = 0

    def add(self, records: Sequence[Mapping[str, Any]]) -> None:
        """Add records as they are in the JSON."""
        self._records += len(records)
        for name, values in _fields('', records, 0):
            if name not in self._found and (len(self._found) >= MAX_FIELDS or not self._is_chosen(name)):
                self._omitted.add(name)
                continue
            self._found.setdefault(name, _FieldSummary()).add(values)

    def result(self) -> dict[str, Statistic]:
        """The statistics by field, ``ALL`` first."""
        return {ALL: object_row(self._records, len(self._omitted)), **{name: each.result() for name, each in self._found.items()}}

    def _is_chosen(self, name: str) -> bool:
        return not self._chosen or any(covers(chosen, name) for chosen in self._chosen)


def covers(name: str, field: str) -> bool:
    """Whether a name selects a field: it is the field's name, or a prefix of it that ends before a dot."""
    return field == name or field.startswith(f'{name}.')


def field_values(record: Mapping[str, Any], wanted: str) -> list[float]:
    """The finite numbers of all fields of a record that the name ``wanted`` selects."""
    some = {name: value for name, value in record.items() if covers(wanted, name) or covers(name, wanted)}
    found = (values for name, values in _fields('', [some], 0) if covers(wanted, name))
    return [float(value) for values in found for value in values if value is not None]


class _FieldSummary:
    """The statistics of one field so far."""

    def __init__(self) -> None:
        self.first: float | None = None
        self.last: float | None = None
        self.minima: list[float] = []
        self.maxima: list[float] = []
        self.sums: list[float] = []
        self.count = self.nan_count = 0

    def add(self, values: Sequence[Any]) -> None:
        present = [value for value in values if value is not None] if None in values else values
        self.nan_count += len(values) - len(present)
        if not present:
            return
        if self.first is None:
            self.first = float(present[0])
        self.last = float(present[-1])
        self.minima.append(float(min(present)))
        self.maxima.append(float(max(present)))
        self.sums.append(_sum(present))
        self.count += len(present)

    def result(self) -> Statistic:
        if not self.count:
            return Statistic(None, None, None, None, None, 0, self.nan_count)
        mean = _sum(self.sums) / self.count
        return Statistic(self.first, self.last, min(self.minima), max(self.maxima), mean if isfinite(mean) else None, self.count,
                         self.nan_count)  # fmt: skip


def _sum(values: Sequence[float]) -> float:
    """The sum, rounded once regardless of the order; NaN on overflow."""
    try:
        return fsum(values)
    except (OverflowError, ValueError):
        return float('nan')


def _fields(name: str, values: Sequence[Any], depth: int) -> Iterator[tuple[str, Sequence[Any]]]:
    """(field, its numbers in their order, None for non-finite ones) of each field in the values of one name."""
    kinds = set(map(type, values))
    if str in kinds and not {value for value in values if type(value) is str}.isdisjoint(INFINITE):
        values = [None if value in INFINITE else value for value in values]
        kinds = set(map(type, values))
    if kinds <= _NUMBERS:
        if values:
            yield name, values
    elif depth > MAX_DEPTH:
        return
    elif kinds == {dict}:
        for key in dict.fromkeys(key for value in values for key in value) if _have_different_keys(values) else values[0]:
            if name or key not in WITHOUT_STATISTICS:
                below = [value[key] for value in values if key in value]
                yield from _fields(f'{name}.{key}' if name else key, below, depth + 1)
    elif kinds == {list}:
        yield from _elements(name, values, depth)
    elif len(kinds) > 1:  # not written by us: handle each kind separately
        for kind in (_NUMBERS, {dict}, {list}):
            if some := [value for value in values if type(value) in kind]:
                yield from _fields(name, some, depth + 1)


_NUMBERS: Final[set[type]] = {float, int, bool, type(None)}


def _have_different_keys(values: Sequence[dict[str, Any]]) -> bool:
    names = values[0].keys()
    return any(value.keys() != names for value in values)


def _elements(name: str, values: Sequence[list[Any]], depth: int) -> Iterator[tuple[str, Sequence[Any]]]:
    sizes = set(map(len, values))
    if sizes == {max(sizes)} and max(sizes) <= MAX_ELEMENTS:
        for index, some in enumerate(zip(*values, strict=True)):
            yield from _fields(f'{name}.{index}', some, depth + 1)
        return
    for index in range(min(max(sizes), MAX_ELEMENTS)):
        if short := [value[index] for value in values if index < len(value) <= MAX_ELEMENTS]:
            yield from _fields(f'{name}.{index}', short, depth + 1)
    if long := [element for value in values if len(value) > MAX_ELEMENTS for element in value]:
        yield from _fields(f'{name}.*', long, depth + 1)


def object_row(messages: int, omitted: int = 0) -> Statistic:
    """The row ``ALL``."""
    return Statistic(None, None, None, None, None, messages, omitted)


def single_value(value: float) -> Statistic:
    """The statistic of a field with one number."""
    number = float(value)
    return Statistic(number, number, number, number, number, 1, 0)


# -- packed --------------------------------------------------------------------------------------------------------------------


def pack_statistics(found: Mapping[str, Statistic]) -> bytes:
    """The statistics as JSON; empty if there are none or they exceed ``MAX_PACKED_BYTES``."""
    if ALL not in found:
        return b''
    packed = orjson.dumps({name: numbers_of(one) for name, one in found.items()})
    return packed if len(packed) <= MAX_PACKED_BYTES else b''


def unpack_statistics(packed: bytes) -> dict[str, Statistic]:
    """The statistics that were packed; empty if the bytes are damaged."""
    try:
        return {str(name): Statistic(*numbers) for name, numbers in orjson.loads(packed).items()} if packed else {}
    except (ValueError, TypeError, AttributeError):
        return {}
