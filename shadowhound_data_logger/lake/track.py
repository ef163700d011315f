"""What one sensor of one robot stored, in the order of time: which objects can hold the message that is nearest to a moment.

Plain arrays, because a data set of a million objects is handed to every worker process.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

NEEDED: Final = ('robot', 'sensor', 'type', 'bucket', 'key', 'bytes', 'sha256', 't_start', 't_start_ns', 't_end_ns', 'count',
                 'x', 'y', 'yaw', 'battery_pct', 'clock_offset_ns')  # fmt: skip
"""Columns of the catalogue."""


class Object(NamedTuple):
    """One object as the catalogue has it."""

    bucket: str
    key: str
    size: int
    sha256: str
    """Empty where it is not known."""


@dataclass(frozen=True, slots=True)
class Track:
    """Objects by their first message. ``of`` makes one; a repeat is an object of its own with the key that holds its content."""

    robot: str
    sensor: str
    kind: str
    bucket: NDArray[np.bytes_]
    key: NDArray[np.bytes_]
    size: NDArray[np.int64]
    sha256: NDArray[np.bytes_]
    start_ns: NDArray[np.int64]
    end_ns: NDArray[np.int64]
    count: NDArray[np.int64]
    offset_ns: NDArray[np.int64]
    """To be added to the times in the content."""
    pose: NDArray[np.float64]
    """(n, 3): x y yaw in the middle of the object's time; NaN where it is not known."""
    battery_pct: NDArray[np.float64]
    latest_ns: NDArray[np.int64] = field(repr=False)
    """The latest end of this object and those before it."""

    @classmethod
    def of(cls, rows: Sequence[Mapping[str, Any]]) -> Track:
        """Of rows of one robot and sensor, at least one, each once even where it is in two parts."""
        ordered = sorted(rows, key=lambda row: (row['t_start_ns'], row['key']))
        once = [row for row, before in zip(ordered, [None, *ordered], strict=False) if not _same(row, before)]

        def numbers(name: str, missing: int = 0) -> NDArray[np.int64]:
            return np.array([missing if row[name] is None else row[name] for row in once], np.int64)

        def text(name: str) -> NDArray[np.bytes_]:
            return np.array([(row[name] or '').encode() for row in once], np.bytes_)

        start = numbers('t_start_ns')
        end = np.maximum(
            start, np.array([row['t_start_ns'] if row['t_end_ns'] is None else row['t_end_ns'] for row in once], np.int64)
        )
        pose = np.array([[row[name] for name in ('x', 'y', 'yaw')] for row in once], np.float64)
        return cls(
            robot=once[0]['robot'] or '', sensor=once[0]['sensor'] or '', kind=once[0]['type'] or '', bucket=text('bucket'),
            key=text('key'), size=numbers('bytes'), sha256=text('sha256'), start_ns=start, end_ns=end,
            count=np.maximum(numbers('count', 1), 1), offset_ns=numbers('clock_offset_ns'), pose=pose,
            battery_pct=np.array([row['battery_pct'] for row in once], np.float64), latest_ns=np.maximum.accumulate(end),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.key)

    def only(self, numbers: NDArray[np.intp]) -> Track:
        """These objects of it, in their order."""
        kept = {
            each.name: getattr(self, each.name)[numbers] for each in fields(self) if each.name not in {'robot', 'sensor', 'kind'}
        }
        kept['latest_ns'] = np.maximum.accumulate(kept['end_ns'])
        return replace(self, **kept)

    def object(self, number: int) -> Object:
        return Object(
            self.bucket[number].decode(), self.key[number].decode(), int(self.size[number]), self.sha256[number].decode()
        )

    def stamps_ns(self, number: int) -> NDArray[np.int64]:
        """Of the messages of an object, evenly spread where there are several."""
        first, count = self.start_ns[number], int(self.count[number])
        return np.asarray(first + np.arange(count) * (self.end_ns[number] - first) // max(count - 1, 1), np.int64)

    def within(self, first_ns: int, last_ns: int) -> NDArray[np.intp]:
        """The objects that have messages in this time, both ends included."""
        low = int(np.searchsorted(self.latest_ns, first_ns, 'left'))
        high = int(np.searchsorted(self.start_ns, last_ns, 'right'))
        return low + np.flatnonzero(self.end_ns[low:high] >= first_ns)

    def nearest(self, stamp_ns: int, tolerance_ns: int) -> Iterator[tuple[int, int]]:
        """(least distance in ns, object) of those that can have a message at most so far from it, the nearest first."""
        found = self.within(stamp_ns - tolerance_ns, stamp_ns + tolerance_ns)
        away = np.maximum(np.maximum(self.start_ns[found] - stamp_ns, stamp_ns - self.end_ns[found]), 0)
        for place in np.argsort(away, kind='stable'):
            yield int(away[place]), int(found[place])

    def pose_at(self, number: int, stamp_ns: int, gap_ns: int) -> NDArray[np.float64]:
        """X y yaw at a moment in the object: its own, of a single message; else straight on between it and its neighbour's."""
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


def _same(row: Mapping[str, Any], other: Mapping[str, Any] | None) -> bool:
    return other is not None and all(row[name] == other[name] for name in ('bucket', 'key', 't_start_ns'))
