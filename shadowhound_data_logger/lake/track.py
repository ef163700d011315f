"""The objects of one sensor of one robot, ordered by time: finds those that can contain the message nearest to a given time.

Stored as numpy and Arrow columns, because a dataset of a million objects is copied to every worker process.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

if TYPE_CHECKING:
    from numpy.typing import NDArray

NEEDED: Final = ('robot', 'sensor', 'type', 'bucket', 'key', 'bytes', 'sha256', 't_start', 't_start_ns', 't_end_ns', 'count',
                 'x', 'y', 'yaw', 'battery_pct', 'clock_offset_ns')  # fmt: skip
"""Required columns of the catalog."""
RECEIVED: Final = ('received_start_ns', 'received_end_ns')
"""Additional columns if the arrival of single messages is needed (``Track.received_ns``)."""
_WORDS: Final = ('robot', 'sensor', 'type', 'bucket')
"""Columns in which many rows have the same text."""
_DIGEST: Final = pa.binary(32)


class Object(NamedTuple):
    """One object, as described by the catalog."""

    bucket: str
    key: str
    size: int
    sha256: str
    """Empty if unknown."""


@dataclass(frozen=True, slots=True)
class Track:
    """Objects ordered by their first message. A repeat is a separate object with the key of its content. Created by ``of``."""

    robot: str
    sensor: str
    kind: str
    bucket: pa.Array
    """Dictionary-encoded text."""
    key: pa.Array
    """Text."""
    size: NDArray[np.signedinteger[Any]]
    sha256: pa.Array
    """32 bytes; null if unknown."""
    start_ns: NDArray[np.int64]
    end_ns: NDArray[np.int64]
    """The same array as ``start_ns`` if all objects have one message; then ``latest_ns`` is the same, too."""
    count: NDArray[np.signedinteger[Any]]
    offset_ns: NDArray[np.signedinteger[Any]]
    """Must be added to the times in the content."""
    pose: NDArray[np.float64]
    """(n, 3): x, y and yaw in the middle of the object's time; NaN if unknown."""
    battery_pct: NDArray[np.float64]
    latest_ns: NDArray[np.int64] = field(repr=False)
    """The latest end of this object and all before it."""
    received_ns: NDArray[np.int64] | None = None
    """(n, 2): arrival of the first and last message of each object, 0 if unknown; None without the columns ``RECEIVED``."""
    stamp_ns: NDArray[np.int64] | None = None
    """In a track by arrival, the stamp of each object's first message; None in a track by stamps."""

    @classmethod
    def of(cls, rows: pa.Table) -> Track:
        """Build a track from rows of one robot and sensor, at least one; duplicates are dropped.

        The rows have the columns ``NEEDED``, and ``RECEIVED`` if arrivals are needed.
        """
        if rows.schema.field('sha256').type != _DIGEST:
            rows = packed(rows)
        order = _order(rows)

        def taken(name: str) -> pa.Array:
            return _taken(rows, name, order)

        def numbers(name: str, missing: int = 0) -> NDArray[np.int64]:
            return np.array(pc.fill_null(taken(name), missing).to_numpy(zero_copy_only=False), np.int64)

        def real(name: str) -> NDArray[np.float64]:
            return np.array(taken(name).to_numpy(zero_copy_only=False), np.float64)

        def word(name: str) -> str:
            return str(rows[name][0].as_py() or '')

        start = numbers('t_start_ns')
        known = pc.coalesce(taken('t_end_ns'), taken('t_start_ns'))
        end = _shared(np.maximum(start, np.asarray(known.to_numpy(zero_copy_only=False), np.int64)), start)
        return cls(
            robot=word('robot'), sensor=word('sensor'), kind=word('type'),
            bucket=taken('bucket'), key=taken('key'), size=_narrow(numbers('bytes')), sha256=taken('sha256'),
            start_ns=start, end_ns=end, count=_narrow(np.maximum(numbers('count', 1), 1)),
            offset_ns=_narrow(numbers('clock_offset_ns')),
            pose=np.column_stack([real(name) for name in ('x', 'y', 'yaw')]), battery_pct=real('battery_pct'),
            latest_ns=_shared(np.maximum.accumulate(end), end),
            received_ns=np.column_stack([numbers(name) for name in RECEIVED]) if {*RECEIVED} <= {*rows.column_names} else None,
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.key)

    def only(self, numbers: NDArray[np.intp]) -> Track:
        """A track with only these objects, in this order."""
        columns = {
            each.name: getattr(self, each.name)
            for each in fields(self)
            if each.name not in {'robot', 'sensor', 'kind'} and getattr(self, each.name) is not None
        }
        kept = {name: column.take(pa.array(numbers)) if isinstance(column, pa.Array) else column[numbers]
                for name, column in columns.items()}  # fmt: skip
        kept['end_ns'] = _shared(kept['end_ns'], kept['start_ns'])
        kept['latest_ns'] = _shared(np.maximum.accumulate(kept['end_ns']), kept['end_ns'])
        return replace(self, **kept)

    def by_arrival(self) -> Track:
        """The same objects ordered by arrival; an object with unknown arrival keeps its time. Requires ``RECEIVED``."""
        assert self.received_ns is not None
        first, last = self.received_ns.T
        start, end = (np.where(first > 0, one, other) for one, other in ((first, self.start_ns), (last, self.end_ns)))
        moved = replace(self, start_ns=start, end_ns=np.maximum(start, end), stamp_ns=self.start_ns)
        return moved.only(np.argsort(start, kind='stable'))

    def object(self, number: int) -> Object:
        """An object by its index."""
        return Object(
            self.bucket[int(number)].as_py(),
            self.key[int(number)].as_py(),
            int(self.size[number]),
            (self.sha256[int(number)].as_py() or b'').hex(),
        )

    def stamps_ns(self, number: int) -> NDArray[np.int64]:
        """The stamps of an object's messages, evenly spread if there are several."""
        first, count = self.start_ns[number], int(self.count[number])
        return np.asarray(first + np.arange(count) * (self.end_ns[number] - first) // max(count - 1, 1), np.int64)

    def within(self, first_ns: int, last_ns: int) -> NDArray[np.intp]:
        """The indices of objects with messages in this time, both ends inclusive."""
        low = int(np.searchsorted(self.latest_ns, first_ns, 'left'))
        high = int(np.searchsorted(self.start_ns, last_ns, 'right'))
        return low + np.flatnonzero(self.end_ns[low:high] >= first_ns)

    def nearest(self, stamp_ns: int, before_ns: int, after_ns: int) -> Iterator[tuple[int, int]]:
        """(minimum distance in ns, index) of the objects that can have a message this long before or after, the nearest first."""
        found = self.within(stamp_ns - before_ns, stamp_ns + after_ns)
        away = np.maximum(np.maximum(self.start_ns[found] - stamp_ns, stamp_ns - self.end_ns[found]), 0)
        for index in np.argsort(away, kind='stable'):
            yield int(away[index]), int(found[index])

    def pose_at(self, number: int, stamp_ns: int, gap_ns: int) -> NDArray[np.float64]:
        """x, y and yaw at a time in an object: its own pose for a single message, otherwise interpolated to the neighbor's."""
        own: NDArray[np.float64] = self.pose[number]
        if self.count[number] == 1:
            return own
        other = number + (1 if 2 * stamp_ns >= int(self.start_ns[number]) + int(self.end_ns[number]) else -1)
        if not 0 <= other < len(self):
            return own
        here, there = ((int(self.start_ns[each]) + int(self.end_ns[each])) // 2 for each in (number, other))
        if abs(there - here) > gap_ns or here == there or np.isnan(self.pose[other]).any():
            return own
        turn = (self.pose[other, 2] - own[2] + np.pi) % (2 * np.pi) - np.pi
        change = np.array([*(self.pose[other, :2] - own[:2]), turn])
        return np.asarray(own + (stamp_ns - here) / (there - here) * change)


def packed(rows: pa.Table) -> pa.Table:
    """A copy that takes half of the memory: dictionary-encoded words, checksums as bytes.

    All columns are copied, because the original batch stays in memory as long as one of its columns is used.
    """
    made = {}
    for name in rows.column_names:
        column = rows[name].combine_chunks()
        if name == 'sha256':
            made[name] = pa.array(map(_digest, column.to_pylist()), _DIGEST)
        elif name in _WORDS:
            made[name] = column.cast(pa.large_string()).dictionary_encode()
        elif name != 't_start':  # only needed to detect objects without a date
            plain = column.cast(pa.large_string()) if name == 'key' else column
            made[name] = pa.concat_arrays([plain, plain[:0]])
    return pa.table(made)


def _digest(text: str | None) -> bytes | None:
    """32 bytes; None if unknown, and zeros, which match no content, for an invalid SHA-256."""
    if not text:
        return None
    try:
        found = bytes.fromhex(text)
    except ValueError:
        return bytes(32)
    return found if len(found) == 32 and found.hex() == text else bytes(32)


def _order(rows: pa.Table) -> pa.Array | None:
    """The indices of the rows ordered by time, without duplicates; None if the rows are already in this order."""
    start = rows['t_start_ns'].to_numpy()
    if (start[1:] > start[:-1]).all():
        return None
    names = ('t_start_ns', 'key', 'bucket')
    plain = rows.select(names).set_column(2, 'bucket', rows['bucket'].cast(pa.large_string()))
    order = pc.sort_indices(plain, sort_keys=[(name, 'ascending') for name in names])
    return order.filter(_is_first(plain, order))


def _taken(rows: pa.Table, name: str, order: pa.Array | None) -> pa.Array:
    """One column in the given order."""
    found = rows[name].unify_dictionaries().combine_chunks()
    if order is not None:
        found = found.take(order)
    return found.combine_chunks() if isinstance(found, pa.ChunkedArray) else found


def _narrow(numbers: NDArray[np.int64]) -> NDArray[np.signedinteger[Any]]:
    """The numbers in the smallest sufficient integer type."""
    low, high = int(numbers.min()), int(numbers.max())
    kinds = (np.int8, np.int16, np.int32, np.int64)
    return numbers.astype(next(kind for kind in kinds if np.iinfo(kind).min <= low and high <= np.iinfo(kind).max))


def _shared(numbers: NDArray[np.int64], like: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the other array if both are equal, so that only one is in memory and in a pickle."""
    return like if np.array_equal(numbers, like) else numbers


def _is_first(rows: pa.Table, order: pa.Array) -> pa.Array:
    """Which rows, in this order, differ from the previous one in object or time."""
    first = np.ones(len(order), bool)
    if len(order) > 1:
        same = np.ones(len(order) - 1, bool)
        for name in ('t_start_ns', 'key', 'bucket'):
            column = _taken(rows, name, order)
            same &= pc.equal(column[1:], column[:-1]).to_numpy(zero_copy_only=False).astype(bool)
        first[1:] = ~same
    return pa.array(first)
