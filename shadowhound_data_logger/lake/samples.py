"""Samples of a dataset: a message of the anchor as arrays, with the messages of other sensors at the same time."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.core.stamps import BY_RECEIVED, BY_STAMP
from shadowhound_data_logger.lake import decode
from shadowhound_data_logger.lake.decode import ARCHIVES, CLOUDS, ArchiveMember, Table, table
from shadowhound_data_logger.lake.prefetch import Prefetch
from shadowhound_data_logger.lake.track import Object, Track

if TYPE_CHECKING:
    from numpy.typing import NDArray

AlignedSample = dict[str, Any]
POSE_GAP_NS: Final = 1_500_000_000
"""Poses that are farther apart are not interpolated, as on the robot (node/encoding/pose_track.py)."""
DECODED_BYTES: Final = 48 << 20
"""Limit for cached tables and archives: a batch of 1 s is used by all frames of that second."""


@dataclass(frozen=True, slots=True)
class Near:
    """Align the one message of a sensor that is nearest in time."""

    tolerance_s: float
    """The maximum distance in seconds."""
    fields: tuple[str, ...] = ()
    """Numbers of the message, such as ``bms_state.soc``; by default the usual ones of its type (``lake.decode.FIELDS``)."""
    is_causal: bool = False
    """Only messages at or before the anchor's time count: what a robot would have known then."""

    @property
    def reach_ns(self) -> tuple[int, int]:
        """How long before and after the anchor's time a message may be."""
        tolerance = round(self.tolerance_s * SECOND)
        return tolerance, 0 if self.is_causal else tolerance


@dataclass(frozen=True, slots=True)
class Window:
    """Align the last ``rows`` messages of a sensor around the anchor's time, oldest first.

    If there are fewer, the first rows are NaN, so that all samples have the same shape.
    """

    before_s: float
    """From so many seconds before the anchor's time."""
    rows: int
    """How many messages."""
    after_s: float = 0.0
    """To so many seconds after it."""
    fields: tuple[str, ...] = ()
    """As in ``Near``."""

    @property
    def reach_ns(self) -> tuple[int, int]:
        """How long before and after the anchor's time a message may be."""
        return round(self.before_s * SECOND), round(self.after_s * SECOND)


@dataclass(frozen=True, slots=True)
class Selection:
    """The content of a dataset; a value that can be pickled."""

    anchors: tuple[Track, ...]
    """One track per robot."""
    aligned: Mapping[str, Near | Window]
    sides: Mapping[tuple[str, str], Track]
    """(robot, sensor) -> the objects of an aligned sensor."""
    size: tuple[int, int] | None
    """(height, width) of images; None: not scaled."""
    by: str = BY_STAMP
    """Which of the two times of messages the tracks use."""

    def like(self, robot: str, sensor: str) -> Track | None:
        """A track that defines the number of values of a sensor: the robot's own, or another robot's if it stored nothing."""
        own = self.sides.get((robot, sensor))
        others = (track for (_, name), track in self.sides.items() if name == sensor)
        return own or next((track for track in others if len(track)), None)

    def needed(self, track: Track, number: int) -> Iterator[Object]:
        """The objects from which the samples of an anchor's object are built, including the object itself."""
        yield track.object(number)
        first, last = int(track.start_ns[number]), int(track.end_ns[number])
        for sensor, how in self.aligned.items():
            side = self.sides.get((track.robot, sensor))
            if side is None:
                continue
            before, after = how.reach_ns
            if isinstance(how, Near) and first == last:
                best = list(side.nearest(first, before, after))[:1]
                yield from (side.object(found) for _, found in best)
            else:
                if isinstance(how, Near):  # only the objects closest to each time in the object
                    before, after = (min(reach, SECOND) for reach in (before, after))
                yield from (side.object(int(found)) for found in side.within(first - before, last + after))

    def has_aligned_data(self, track: Track, number: int) -> bool:
        """Whether the catalog has messages of all aligned sensors at the time of an object."""
        first, last = int(track.start_ns[number]), int(track.end_ns[number])
        for sensor, how in self.aligned.items():
            side, (before, after) = self.sides.get((track.robot, sensor)), how.reach_ns
            if side is None or not len(side.within(first - before, last + after)):
                return False
        return True


class Samples:
    """Builds the samples of a dataset, and caches what it decoded, because neighboring samples need it again.

    One thread at a time.
    """

    def __init__(self, selection: Selection, prefetch: Prefetch) -> None:
        self._selection = selection
        self._prefetch = prefetch
        self._decoded: OrderedDict[tuple[str, str, str], tuple[Any, int]] = OrderedDict()
        self._decoded_bytes = 0

    def sample(self, track: Track, number: int, member: int = 0) -> AlignedSample:
        """The sample of the message ``member`` of an object of an anchor. Raises StoreError, LakeError."""
        wanted = track.object(number)
        name, content, stamp_ns = self._anchor(track, number, member, wanted)
        sample: AlignedSample = {
            name: content,
            'stamp_ns': np.int64(stamp_ns),
            'pose': track.pose_at(number, stamp_ns, POSE_GAP_NS).copy(),
            'battery_pct': np.float64(track.battery_pct[number]),
        }
        for sensor, how in self._selection.aligned.items():
            sample |= self._aligned(sensor, how, track.robot, stamp_ns)
        return sample

    def _anchor(self, track: Track, number: int, member: int, wanted: Object) -> tuple[str, NDArray[Any], int]:
        extension = decode.extension_of(wanted.key)
        if extension not in ARCHIVES:
            return (*self._picture(wanted, self._prefetch.get(wanted), extension), int(track.start_ns[number]))
        found = self._members(wanted)
        if member >= len(found):
            raise LakeError(f'{wanted.key} has {len(found)} messages, but {track.count[number]} by the catalog', key=wanted.key)
        one = found[member]
        return (*self._picture(wanted, one.body, one.extension), self._times(track, number, found)[member])

    def _picture(self, wanted: Object, body: bytes, extension: str) -> tuple[str, NDArray[Any]]:
        with _naming(wanted):
            return ('cloud', decode.cloud(body)) if extension in CLOUDS else ('image', decode.image(body, self._selection.size))

    def _received(self, track: Track, number: int) -> tuple[int, int] | None:
        """The arrival of an object's first and last message, if the times are arrivals; otherwise None."""
        return (int(track.start_ns[number]), int(track.end_ns[number])) if self._selection.by == BY_RECEIVED else None

    def _times(self, track: Track, number: int, members: Sequence[ArchiveMember]) -> list[int]:
        """The times of the messages of an archive."""
        times = np.array([each.stamp_ns for each in members], np.int64) + int(track.offset_ns[number])
        received = self._received(track, number)
        return [int(each) for each in (times if received is None else decode.arrivals(times, *received))]

    def _members(self, wanted: Object) -> list[ArchiveMember]:
        def read() -> list[ArchiveMember]:
            return decode.members(self._prefetch.get(wanted), decode.extension_of(wanted.key))

        found: list[ArchiveMember] = self._once(('members', wanted.bucket, wanted.key), wanted, read)
        return found

    def _aligned(self, sensor: str, how: Near | Window, robot: str, stamp_ns: int) -> AlignedSample:
        like = self._selection.like(robot, sensor)
        side = like if like is not None and like.robot == robot else None
        if isinstance(how, Window):
            values, present = self._window(how, side, self._width(like, how.fields), stamp_ns)
            return {sensor: values, f'{sensor}_ok': present}
        if like is not None and _is_cloud(like):
            points, away_ns = self._nearest_cloud(how, side, stamp_ns)
            return {sensor: points, f'{sensor}_ok': np.bool_(away_ns is not None), f'{sensor}_dt_s': _seconds(away_ns)}
        row, away_ns = self._nearest(how, side, stamp_ns)
        if row is None:
            row = np.full(self._width(like, how.fields), np.nan)
        return {sensor: row, f'{sensor}_ok': np.bool_(away_ns is not None), f'{sensor}_dt_s': _seconds(away_ns)}

    def _nearest(self, how: Near, side: Track | None, stamp_ns: int) -> tuple[NDArray[np.float64] | None, int | None]:
        """The numbers of the nearest message, and how much later than the anchor it is; None if there is none."""
        best: tuple[int, NDArray[np.float64]] | None = None
        if side is not None:
            before, after = how.reach_ns
            for least, number in side.nearest(stamp_ns, before, after):
                if best is not None and abs(best[0]) <= least:
                    break
                found = self._table(side, number, how.fields)
                place = _closest(found.stamps, stamp_ns, after)
                if place is not None:
                    away = int(found.stamps[place]) - stamp_ns
                    if -before <= away <= after and (best is None or abs(away) < abs(best[0])):
                        best = away, found.values[place]
        return (None, None) if best is None else (best[1].copy(), best[0])

    def _nearest_cloud(self, how: Near, side: Track | None, stamp_ns: int) -> tuple[NDArray[np.float32], int | None]:
        best: tuple[int, Object, ArchiveMember | None] | None = None
        if side is None:
            return np.empty((0, 4), np.float32), None
        before, after = how.reach_ns
        for least, number in side.nearest(stamp_ns, before, after):
            if best is not None and abs(best[0]) <= least:
                break
            wanted = side.object(number)
            options: list[tuple[int, ArchiveMember | None]] = [(int(side.start_ns[number]), None)]
            if decode.extension_of(wanted.key) in ARCHIVES:
                members = self._members(wanted)
                options = list(zip(self._times(side, number, members), members, strict=True))
            for time_ns, one in options:
                away = time_ns - stamp_ns
                if -before <= away <= after and (best is None or abs(away) < abs(best[0])):
                    best = away, wanted, one
        if best is None:
            return np.empty((0, 4), np.float32), None
        away, wanted, one = best
        with _naming(wanted):
            return decode.cloud(self._prefetch.get(wanted) if one is None else one.body), away

    def _window(self, how: Window, side: Track | None, width: int,
                stamp_ns: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:  # fmt: skip
        values, present = np.full((how.rows, width), np.nan), np.zeros(how.rows, np.bool_)
        if side is None:
            return values, present
        before, after = how.reach_ns
        found = [self._table(side, int(number), how.fields) for number in side.within(stamp_ns - before, stamp_ns + after)]
        stamps = np.concatenate([each.stamps for each in found]) if found else np.empty(0, np.int64)
        inside = np.flatnonzero((stamps >= stamp_ns - before) & (stamps <= stamp_ns + after))
        last = inside[np.argsort(stamps[inside], kind='stable')][-how.rows :]
        if len(last):
            values[-len(last) :] = np.concatenate([each.values for each in found])[last]
            present[-len(last) :] = True
        return values, present

    def _width(self, like: Track | None, fields: tuple[str, ...]) -> int:
        """The number of columns of a sensor, by its first object; 0 if no robot has stored it."""
        return 0 if like is None else int(self._table(like, 0, fields).values.shape[1])

    def _table(self, side: Track, number: int, fields: tuple[str, ...]) -> Table:
        wanted = side.object(number)

        def read() -> Table:
            found = decode.records(self._prefetch.get(wanted))
            return table(found, side.kind, fields, int(side.offset_ns[number]), self._received(side, number))

        made: Table = self._once((side.sensor, wanted.bucket, wanted.key), wanted, read)
        return made

    def _once(self, name: tuple[str, str, str], wanted: Object, make: Callable[[], Any]) -> Any:
        if name not in self._decoded:
            with _naming(wanted):
                made = make()
            size = made.nbytes if isinstance(made, Table) else sum(len(one.body) for one in made)
            self._decoded[name] = made, size
            self._decoded_bytes += size
            while self._decoded_bytes > DECODED_BYTES and len(self._decoded) > 1:
                self._decoded_bytes -= self._decoded.popitem(last=False)[1][1]
        self._decoded.move_to_end(name)
        return self._decoded[name][0]


@contextmanager
def _naming(wanted: Object) -> Iterator[None]:
    """Add the object's name to a LakeError about its content."""
    try:
        yield
    except LakeError as error:
        if 'key' in error.data:
            raise
        name = f'{wanted.bucket}/{wanted.key}'
        raise LakeError(f'{name}: {error}', bucket=wanted.bucket, key=wanted.key) from error


def _is_cloud(side: Track) -> bool:
    return side.kind == 'sensor_msgs/msg/PointCloud2'


def _closest(stamps: NDArray[np.int64], stamp_ns: int, after_ns: int) -> int | None:
    """The index of the nearest of sorted stamps, at most ``after_ns`` later."""
    possible = stamps[: int(np.searchsorted(stamps, stamp_ns + after_ns, 'right'))]
    return int(np.argmin(np.abs(possible - stamp_ns))) if len(possible) else None


def _seconds(away_ns: int | None) -> Any:
    return np.float64(np.nan if away_ns is None else away_ns / SECOND)


def is_complete(sample: AlignedSample, aligned: Mapping[str, Near | Window]) -> bool:
    """Whether the sample has the pose and all aligned sensors; for a window, one message is enough."""
    return not bool(np.isnan(sample['pose']).any()) and all(bool(np.any(sample[f'{name}_ok'])) for name in aligned)
