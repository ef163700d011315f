"""Statistics of the numbers in an object: first, last, least, greatest, mean, how many, and how many are not finite.

They are those of the content as it is stored, so whoever opens the object finds the same: of JSON its numbers as the shortest
decimals that stand there, of a JPEG its brightness and sharpness, of a PCD the fields of its points.

A field has the path of its names, such as ``accelerometer.2`` or ``motor_state.0.q``. Each element of a list of at most
``MAX_ELEMENTS`` is a field of its own; those of a longer one are one field together, such as ``ranges.*``. ``ALL`` is a row of
the object as a whole: its messages, and how many of its fields have no statistics.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import fsum, isfinite
from operator import attrgetter
from typing import Any, Final

import orjson

MOST_FIELDS: Final = 64
"""Of one object. Those of a type with more are chosen by the sensor's parameter ``statistics``, else these are the first."""
MAX_ELEMENTS: Final = 20
MAX_DEPTH: Final = 8
MAX_SAID: Final = 1 << 16
"""Bytes of the statistics of an object as they are kept."""
MEAN_ERROR: Final = 2.0**-22
"""A float32 and its shortest decimal are within 2^-24 of each other, and the mean is kept as a float32."""
ALL: Final = ''
INFINITE: Final = ('Infinity', '-Infinity')
"""What infinities are in JSON."""
NONE: Final = 'none'
"""Instead of names of fields: no statistics."""
UNCOUNTED: Final = frozenset({'stamp_ns', 'timestamp', 'header', 'non_finite'})
"""Top-level names that tell of the document or its time, not what was measured."""


@dataclass(frozen=True, slots=True)
class Statistic:
    """Of the finite numbers of a field in an object; None where it has none. Their mean is None where their sum has no double.

    The mean need not be the nearest double: the greatest magnitude among ``min`` and ``max`` times ``MEAN_ERROR`` is as far as
    it may be from that of the decimals in the JSON, which an encoder does not read again for it.
    """

    first: float | None
    last: float | None
    min: float | None
    max: float | None
    mean: float | None
    count: int
    nan_count: int
    """Numbers that are not finite: NaN, which JSON has as null, and infinities. Of ``ALL``, the fields that are left out."""


NUMBERS: Final = ('first', 'last', 'min', 'max', 'mean', 'count', 'nan_count')
numbers_of: Final = attrgetter(*NUMBERS)
"""The numbers of a statistic, in this order."""


class FieldStatistics:
    """Collects the statistics of records, which are handed to it some at a time, always the same number in a row."""

    def __init__(self, chosen: Sequence[str] = ()) -> None:
        """``chosen``: fields, or what the names of several begin with up to a dot; none means all."""
        self._chosen = tuple(name for name in chosen if name)
        self._found: dict[str, _Running] = {}
        self._left_out: set[str] = set()
        self._records = 0

    def add(self, records: Sequence[Mapping[str, Any]]) -> None:
        """Records as they are in JSON."""
        self._records += len(records)
        for name, values in _fields('', records, 0):
            if name not in self._found and (len(self._found) >= MOST_FIELDS or not self._is_chosen(name)):
                self._left_out.add(name)
                continue
            self._found.setdefault(name, _Running()).add(values)

    def told(self) -> dict[str, Statistic]:
        """By field, ``ALL`` first."""
        return {ALL: of_whole(self._records, len(self._left_out)), **{name: each.told() for name, each in self._found.items()}}

    def _is_chosen(self, name: str) -> bool:
        return not self._chosen or any(covers(chosen, name) for chosen in self._chosen)


def covers(asked: str, field: str) -> bool:
    """Whether a name means this field: its own, or what it begins with up to a dot."""
    return field == asked or field.startswith(f'{asked}.')


def values_of(record: Mapping[str, Any], asked: str) -> list[float]:
    """The finite numbers of all fields of a record that a name means."""
    some = {name: value for name, value in record.items() if covers(asked, name) or covers(name, asked)}
    found = (values for name, values in _fields('', [some], 0) if covers(asked, name))
    return [float(value) for values in found for value in values if value is not None]


class _Running:
    """The statistics of a field so far."""

    def __init__(self) -> None:
        self.first: float | None = None
        self.last: float | None = None
        self.least: list[float] = []
        self.greatest: list[float] = []
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
        self.least.append(float(min(present)))
        self.greatest.append(float(max(present)))
        self.sums.append(_sum(present))
        self.count += len(present)

    def told(self) -> Statistic:
        if not self.count:
            return Statistic(None, None, None, None, None, 0, self.nan_count)
        mean = _sum(self.sums) / self.count
        return Statistic(self.first, self.last, min(self.least), max(self.greatest), mean if isfinite(mean) else None, self.count,
                         self.nan_count)  # fmt: skip


def _sum(values: Sequence[float]) -> float:
    """Rounded once, whatever their order; NaN where it is no double."""
    try:
        return fsum(values)
    except (OverflowError, ValueError):
        return float('nan')


def _fields(name: str, values: Sequence[Any], depth: int) -> Iterator[tuple[str, Sequence[Any]]]:
    """(field, its numbers in their order, None for those that are not finite) below the values of one name."""
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
        for key in dict.fromkeys(key for value in values for key in value) if _differ(values) else values[0]:
            if name or key not in UNCOUNTED:
                below = [value[key] for value in values if key in value]
                yield from _fields(f'{name}.{key}' if name else key, below, depth + 1)
    elif kinds == {list}:
        yield from _elements(name, values, depth)
    elif len(kinds) > 1:  # not ours: each by its own kind
        for kind in (_NUMBERS, {dict}, {list}):
            if some := [value for value in values if type(value) in kind]:
                yield from _fields(name, some, depth + 1)


_NUMBERS: Final[set[type]] = {float, int, bool, type(None)}


def _differ(values: Sequence[dict[str, Any]]) -> bool:
    names = values[0].keys()
    return any(value.keys() != names for value in values)


def _elements(name: str, values: Sequence[list[Any]], depth: int) -> Iterator[tuple[str, Sequence[Any]]]:
    sizes = set(map(len, values))
    if sizes == {max(sizes)} and max(sizes) <= MAX_ELEMENTS:
        for place, some in enumerate(zip(*values, strict=True)):
            yield from _fields(f'{name}.{place}', some, depth + 1)
        return
    for place in range(min(max(sizes), MAX_ELEMENTS)):
        if short := [value[place] for value in values if place < len(value) <= MAX_ELEMENTS]:
            yield from _fields(f'{name}.{place}', short, depth + 1)
    if long := [element for value in values if len(value) > MAX_ELEMENTS for element in value]:
        yield from _fields(f'{name}.*', long, depth + 1)


def of_whole(messages: int, left_out: int = 0) -> Statistic:
    """The row ``ALL``."""
    return Statistic(None, None, None, None, None, messages, left_out)


def of_number(value: float) -> Statistic:
    """Of the only message."""
    number = float(value)
    return Statistic(number, number, number, number, number, 1, 0)


# -- as they are kept ----------------------------------------------------------------------------------------------------------


def packed(found: Mapping[str, Statistic]) -> bytes:
    """The statistics as JSON; empty where there are none, or too much of them."""
    if ALL not in found:
        return b''
    names = [name for name in found if name != ALL]
    rows = [[getattr(found[name], each) for name in names] for each in _IN_PART]
    part = {'fields': names, 'numbers': rows, **{each: [getattr(found[name], each) for name in names] for each in _COUNTS}}
    return packed_parts(found[ALL].count, found[ALL].nan_count, [part] if names else [])


def packed_parts(messages: int, left_out: int, parts: Sequence[Mapping[str, Any]]) -> bytes:
    """The same of ``fields`` in parts, each with its ``numbers``, a row for each of first, last, mean, min and max.

    One row stands for all of them, none for fields without finite numbers; ``count`` and ``nan_count`` are of each or of all.
    """
    said = orjson.dumps({'messages': messages, 'left_out': left_out, 'parts': parts}, option=orjson.OPT_SERIALIZE_NUMPY)
    return said if len(said) <= MAX_SAID else b''


def unpacked_statistics(said: bytes) -> dict[str, Statistic]:
    """What was packed; empty where that is damaged."""
    try:
        return dict(_unpacked(orjson.loads(said))) if said else {}
    except (ValueError, TypeError, LookupError, AttributeError):
        return {}


def _unpacked(told: Any) -> Iterator[tuple[str, Statistic]]:
    yield ALL, of_whole(int(told['messages']), int(told['left_out']))
    for part in told['parts']:
        names, rows = part['fields'], part['numbers'] or [[None] * len(part['fields'])]
        rows = rows * len(_IN_PART) if len(rows) == 1 else rows
        counts = [part[each] if isinstance(part[each], list) else [part[each]] * len(names) for each in _COUNTS]
        for name, *numbers, count, nan_count in zip(names, *rows, *counts, strict=True):
            yield str(name), Statistic(**dict(zip(_IN_PART, numbers, strict=True)), count=count, nan_count=nan_count)


_IN_PART: Final = ('first', 'last', 'mean', 'min', 'max')
_COUNTS: Final = ('count', 'nan_count')
