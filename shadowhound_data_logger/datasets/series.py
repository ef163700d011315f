"""What one mission recorded, sensor by sensor: all messages of a time, from objects or bags, whichever have more.

A series is in memory except for its images: those in objects are read again when needed, those in a bag are kept in a file of the
work folder.
"""

from __future__ import annotations

import hashlib
import re
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from shadowhound_data_logger.bags import naming
from shadowhound_data_logger.bags.contents import McapFile
from shadowhound_data_logger.bags.manifest import Manifest, SliceEntry
from shadowhound_data_logger.bags.remote import find_bags, read_manifest
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND
from shadowhound_data_logger.core.errors import BagDamaged, LakeError, Rejected
from shadowhound_data_logger.core.model import Batch, ObjectInfo, Sample
from shadowhound_data_logger.core.options import COMPRESSED_IMAGE, DEFAULT_SENSORS, IMAGE, SensorSettings
from shadowhound_data_logger.core.stamps import BY_RECEIVED, BY_STAMP
from shadowhound_data_logger.formats.definitions import SEPARATOR
from shadowhound_data_logger.formats.image import encode_png
from shadowhound_data_logger.formats.mcap.messages import MessageFilter, RecordedMessage
from shadowhound_data_logger.formats.mcap.ranges import StoredFile
from shadowhound_data_logger.formats.mcap.slice_info import Channel
from shadowhound_data_logger.formats.payload import Job
from shadowhound_data_logger.formats.types import MessageTypes, header_stamp_ns
from shadowhound_data_logger.lake import decode
from shadowhound_data_logger.lake.gaps import BAGS, OBJECTS
from shadowhound_data_logger.lake.prefetch import Place, Prefetch
from shadowhound_data_logger.lake.track import Object, Track
from shadowhound_data_logger.stores.base import ObjectStore

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from typing_extensions import Self

KEEP_BYTES: Final = 16 << 20
THREADS: Final = 8
MIN_SPAN_NS: Final = 2 * SECOND
"""Minimum span of a slice from which a rate is computed."""
AS_MUCH: Final = 0.5
"""A recording is a candidate if it covers at least this share of what the best one covers."""
NEARLY_ALL: Final = 0.9
"""An event's bag is an excerpt, unless it has this share of a mission."""
MIN_ADDED_NS: Final = SECOND
"""Another mission's bag, or one of no mission, must add more than this: our recorder needs that long to notice a mission."""
HOLE: Final = 10
"""This many periods without an object count as a gap."""
AHEAD: Final = 16
"""Images that are fetched ahead."""
_MESSAGE_TITLE: Final = re.compile(r'^MSG: ([A-Za-z]\w*)/(?:msg/)?([A-Za-z]\w*)\s*$', re.ASCII)
_ODOMETRY: Final = 'nav_msgs/msg/Odometry'


class Interval(NamedTuple):
    """A time span, both ends included, ns."""

    first_ns: int
    last_ns: int

    @property
    def length(self) -> int:
        return max(0, self.last_ns - self.first_ns)

    def within(self, other: Interval) -> Interval:
        """The intersection; its end is before its start if empty."""
        return Interval(max(self.first_ns, other.first_ns), min(self.last_ns, other.last_ns))

    def without(self, others: Sequence[Interval]) -> list[Interval]:
        """The parts that are in none of the others."""
        left = [self]
        for other in others:
            before = [Interval(one.first_ns, min(one.last_ns, other.first_ns - 1)) for one in left]
            after = [Interval(max(one.first_ns, other.last_ns + 1), one.last_ns) for one in left]
            left = before + after
        return sorted({one for one in left if one.first_ns <= one.last_ns})


@dataclass(frozen=True, slots=True)
class _SlicePart:
    """A slice of a bag, and the times it is read for."""

    bag: Manifest
    slice: SliceEntry
    messages: int
    """Of one topic, in the complete slice."""
    whole: Interval
    times: tuple[Interval, ...]

    def covered(self, counted: Interval) -> int:
        """How much of a time it is read for, ns."""
        return sum(time.within(counted).length for time in self.times)

    def share(self, counted: Interval) -> float:
        """The share of its messages that is read for a time, if they are evenly spread."""
        if self.whole.length:
            return self.covered(counted) / self.whole.length
        return float(any(counted.first_ns <= time.first_ns <= counted.last_ns for time in self.times))


@dataclass(frozen=True, slots=True)
class SourceFile:
    """An object, or a slice of a bag, that values were taken from."""

    bucket: str
    key: str
    sha256: str
    """Empty if unknown."""


@dataclass(frozen=True, slots=True)
class RecordedSensor:
    """The messages of one sensor in a time, before they are read: where they are and how many."""

    sensor: str
    topic: str
    type: str
    sink: str
    """``objects`` or ``bags``, as in the gap journal."""
    messages: int
    """In the time that counts. Estimated if an object or slice is only partly in that time."""
    rate_hz: float
    """Of the recorded parts, without gaps; 0 if unknown."""
    covered: float
    """Share of the time that counts in which it was recorded, 0 to 1."""


@dataclass(slots=True)
class Series:
    """The messages of one sensor in the order of their stamps."""

    recording: RecordedSensor
    stamps: NDArray[np.int64]
    """ns since 1970 by the robot's clock, sorted."""
    values: NDArray[np.float64]
    """(messages, numbers); of pictures (messages, 0)."""
    file: NDArray[np.int64]
    """For each message, its index in ``files``."""
    files: Sequence[SourceFile]
    received: NDArray[np.int64]
    """Arrival of each, by the clock of the recording machine; 0 if unknown."""
    names: tuple[str, ...] = ()
    """Of joints, from the first message."""
    previous: NDArray[np.int64] | None = None
    """For values that are derived from two messages, (messages, 4): time, stamp, arrival and file of the earlier one."""
    image: Callable[[int], tuple[bytes, str]] = field(default=lambda _: (b'', ''))
    """Content and extension (``jpg``, ``png``) of a camera's message."""
    own_stamps: NDArray[np.int64] | None = None
    """The stamps of the messages, if ``stamps`` has other times: the robot's instead of another machine's, or arrivals."""

    def __len__(self) -> int:
        return len(self.stamps)

    def only(self, chosen: NDArray[Any]) -> Series:
        """A selection of the messages."""
        own = None if self.own_stamps is None else self.own_stamps[chosen]
        return replace(self, stamps=self.stamps[chosen], values=self.values[chosen], file=self.file[chosen],
                       received=self.received[chosen], own_stamps=own)  # fmt: skip

    @property
    def period_ns(self) -> int:
        """The usual time between two messages."""
        return int(np.median(np.diff(self.stamps))) if len(self.stamps) > 1 else 0


class Recordings:
    """Finds and reads the recordings of one mission.

    Enter once; call ``series`` any number of times while entered; one thread.
    """

    def __init__(self, place: Place, store: ObjectStore, tracks: Mapping[str, Track], topics: Mapping[str, str],  # noqa: PLR0913
                 span_ns: tuple[int, int], bags: Sequence[Manifest], work: Path, *, early_ns: int = 0,
                 by: str = BY_STAMP) -> None:  # fmt: skip
        """``tracks`` and ``topics`` are by sensor; ``span_ns`` is the time to read, both ends included.

        Messages in the first ``early_ns`` of it do not count when recordings are compared. ``bags`` are in order of preference
        (``select_bags``). ``by`` is the time that messages are placed by; the tracks use the same.
        """
        self._place = place
        self._store = store
        self._tracks = tracks
        self._topics = topics
        self._span = span_ns
        self._counted = Interval(span_ns[0] + early_ns, span_ns[1])
        self._bags = bags
        self._work = work
        self._by = by
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self._work.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def best(self, sensor: str) -> RecordedSensor | None:
        """The recording with the most messages in the time that counts, among those that cover at least half as much as the best.

        None if there is no message in that time.
        """
        found = [each for each in (self._in_objects(sensor), *self._in_bags(sensor)) if each is not None and each.messages]
        enough = AS_MUCH * max((each.covered for each in found), default=0.0)
        return max((each for each in found if each.covered >= enough), key=lambda each: each.messages, default=None)

    def series(self, recording: RecordedSensor, fields: Sequence[str] = ()) -> Series:
        """All messages of the time. Raises StoreError, LakeError, BagDamaged."""
        is_image = recording.type in {COMPRESSED_IMAGE, IMAGE}
        if recording.sink == OBJECTS:
            track = self._within(recording.sensor)
            return self._read_images(recording, track) if is_image else self._numbers(recording, track, fields)
        return self._from_bag(recording, fields, is_image=is_image)

    # -- objects ---------------------------------------------------------------------------------------------------

    def _within(self, sensor: str) -> Track:
        track = self._tracks[sensor]
        return track.only(track.within(*self._span))

    def _in_objects(self, sensor: str) -> RecordedSensor | None:
        if sensor not in self._tracks:
            return None
        track = self._tracks[sensor]
        track = track.only(track.within(*self._counted))
        if not len(track):
            return None
        several = track.count > 1
        if several.any():
            spans = (track.end_ns - track.start_ns)[several]
            rates = (track.count[several] - 1) / np.maximum(spans, 1) * 1e9
            rate = float(np.median(rates))
        else:
            steps = np.diff(np.unique(track.start_ns))
            rate = 1e9 / float(np.median(steps)) if len(steps) else 0.0
        messages, covered = self._extent(track)
        return RecordedSensor(sensor, self._topics.get(sensor, ''), track.kind, OBJECTS, messages, rate, covered)

    def _extent(self, track: Track) -> tuple[int, float]:
        """How many messages of these objects are in the time that counts, and the share of it between consecutive objects."""
        first, last = self._counted
        begin, end = track.start_ns.clip(first, last), track.end_ns.clip(first, last)
        parts = np.where(track.end_ns > track.start_ns, (end - begin) / np.maximum(track.end_ns - track.start_ns, 1), 1.0)
        steps = np.diff(begin)
        usual = float(np.median(steps)) if len(steps) else float(end[0] - begin[0])
        covered = np.minimum(steps, np.maximum(HOLE * usual, (end - begin)[:-1])).sum() + max(usual, end[-1] - begin[-1])
        return max(1, round(float((track.count * parts).sum()))), min(1.0, float(covered) / max(last - first, 1))

    def _numbers(self, recording: RecordedSensor, track: Track, fields: Sequence[str]) -> Series:
        tables: list[decode.Table] = []
        arrived: list[NDArray[np.int64]] = []
        counts: list[int] = []
        names: tuple[str, ...] = ()
        with Prefetch(self._place.read, KEEP_BYTES, THREADS) as prefetch:
            objects = [track.object(number) for number in range(len(track))]
            for number, wanted in enumerate(objects):
                prefetch.ahead(objects[number : number + AHEAD])
                found = decode.records(prefetch.get(wanted))
                if found and not names and isinstance(found[0].get('name'), list):
                    names = tuple(map(str, found[0]['name']))
                tables.append(decode.table(found, track.kind, tuple(fields), int(track.offset_ns[number])))
                stamped = np.array([each['stamp_ns'] for each in found], np.int64) + int(track.offset_ns[number])
                arrived.append(_arrivals(track, number, stamped)[np.argsort(stamped, kind='stable')])
                counts.append(len(found))
        width = tables[0].values.shape[1] if tables else 0
        if any(each.values.shape[1] != width for each in tables):
            raise LakeError(f'{recording.topic} changes the number of its values within the mission')
        stamps = np.concatenate([np.empty(0, np.int64), *(each.stamps for each in tables)])
        values = np.concatenate([np.empty((0, width)), *(each.values for each in tables)])
        file = np.repeat(np.arange(len(tables)), counts)
        received = np.concatenate([np.empty(0, np.int64), *arrived])
        return self._ordered(recording, stamps, values, file, [_file(each) for each in objects], received, names)

    def _read_images(self, recording: RecordedSensor, track: Track) -> Series:
        """The content of an object is only read for stamps if it is an archive."""
        prefetch = self._stack.enter_context(Prefetch(self._place.read, KEEP_BYTES, THREADS))
        stamps: list[int] = []
        arrived: list[int] = []
        where: list[tuple[int, int]] = []
        objects = [track.object(number) for number in range(len(track))]
        members = lru_cache(maxsize=2)(partial(_unpacked, prefetch))
        for number, wanted in enumerate(objects):
            if decode.extension_of(wanted.key) in decode.ARCHIVES:
                times = np.array([each.stamp_ns for each in members(wanted)], np.int64) + int(track.offset_ns[number])
                where += [(number, member) for member in range(len(times))]
            else:
                times = (track.start_ns if track.stamp_ns is None else track.stamp_ns)[number : number + 1]
                where.append((number, -1))
            stamps += times.tolist()
            arrived += _arrivals(track, number, times).tolist()
        times_of = self._times(np.array(stamps, np.int64), np.array(arrived, np.int64))
        order = np.argsort(times_of, kind='stable')

        def image(message: int) -> tuple[bytes, str]:
            coming = {where[int(order[index])][0] for index in range(message, min(message + AHEAD, len(order)))}
            prefetch.ahead([objects[number] for number in sorted(coming)])
            number, member = where[int(order[message])]
            if member < 0:
                return prefetch.get(objects[number]), decode.extension_of(objects[number].key)
            found = members(objects[number])[member]
            return found.body, found.extension

        file = np.array([number for number, _ in where], np.int64)
        made = self._ordered(
            recording, np.array(stamps, np.int64), np.empty((len(stamps), 0)), file, [_file(each) for each in objects],
            np.array(arrived, np.int64),
        )  # fmt: skip
        return _with_images(made, image, order, times_of, self._span)

    def _times(self, stamps: NDArray[np.int64], received: NDArray[np.int64]) -> NDArray[np.int64]:
        """The times that place messages: stamps, or arrivals where known."""
        return np.where(received > 0, received, stamps) if self._by == BY_RECEIVED else stamps

    def _ordered(self, recording: RecordedSensor, stamps: NDArray[np.int64], values: NDArray[np.float64], file: NDArray[np.int64],
                 files: Sequence[SourceFile], received: NDArray[np.int64], names: tuple[str, ...] = ()) -> Series:  # fmt: skip
        times = self._times(stamps, received)
        order = np.argsort(times, kind='stable')
        inside = order[(times[order] >= self._span[0]) & (times[order] <= self._span[1])]
        own = stamps[inside] if self._by == BY_RECEIVED else None
        return Series(recording, times[inside], values[inside], file[inside], files, received[inside], names, own_stamps=own)

    # -- bags ------------------------------------------------------------------------------------------------------

    def _in_bags(self, sensor: str) -> Iterator[RecordedSensor]:
        topics = {(topic.topic, topic.type): None for bag in self._bags for topic in bag.topics}
        for topic, kind in topics:
            if self._has_fields(sensor, topic, kind):
                parts = self._parts(topic)
                counts = [each.messages * each.share(self._counted) for each in parts]
                # A slice's span is that of all its topics: a short one says little about one of them.
                rates = [(each.bag, each.messages / each.whole.length * 1e9) for each in parts
                         if each.share(self._counted) and each.whole.length >= MIN_SPAN_NS]  # fmt: skip
                rate = max((rate for bag, rate in rates if bag is rates[0][0]), default=0.0)
                covered = sum(each.covered(self._counted) for each in parts) / max(self._counted.length, 1)
                yield RecordedSensor(sensor, topic, kind, BAGS, round(sum(counts)), rate, min(1.0, covered))

    def _has_fields(self, sensor: str, topic: str, kind: str) -> bool:
        known = self._topics.get(sensor)
        if known is not None:
            return topic == known
        defaults = DEFAULT_SENSORS.get(sensor, {})
        names = zip(defaults.get('topics', ()), defaults.get('types', ()), strict=False)
        return any(kind == wanted and (topic == f'/{name}' or topic.endswith(f'/{name}')) for name, wanted in names)

    def _parts(self, topic: str) -> list[_SlicePart]:
        """The slices with messages of a topic, and the times each is read for: two bags of one time contain each message twice.

        A later bag adds what the earlier ones lack: all of that if the bag is of the same mission as the first one, otherwise
        only if it is more than a second of the time that counts.
        """
        found: list[_SlicePart] = []
        for bag in self._bags:
            step = _clock_offset(bag)
            covered = [time for each in found for time in each.times]
            mine = []
            for each in bag.slices:
                whole = Interval(each.t_start_ns + step, each.t_end_ns + step)
                if each.recorded.get(topic) and whole.first_ns <= self._span[1] and whole.last_ns >= self._span[0]:
                    mine.append(_SlicePart(bag, each, each.recorded[topic], whole, tuple(whole.without(covered))))
            added = sum(each.covered(self._counted) for each in mine)
            first = found[0].bag.mission if found else bag.mission
            is_first = not found or (first is not None and _belongs_to_mission(bag, first.mission_id, first.run_id))
            if added > MIN_ADDED_NS or (is_first and any(each.share(self._counted) for each in mine)):
                found += [each for each in mine if each.times]
        return found

    def _from_bag(self, recording: RecordedSensor, fields: Sequence[str], *, is_image: bool) -> Series:
        stamps: list[int] = []
        rows: list[NDArray[np.float64]] = []
        where: list[tuple[int, int, str]] = []
        file: list[int] = []
        arrived: list[int] = []
        files: list[SourceFile] = []
        names: tuple[str, ...] = ()
        bodies = self._stack.enter_context(tempfile.TemporaryFile(dir=self._work)) if is_image else None  # noqa: SIM115
        for part in self._parts(recording.topic):
            files.append(SourceFile(naming.BUCKET, part.slice.key, part.slice.sha256))
            step = _clock_offset(part.bag)
            for message, types in self._messages(part.slice, recording.topic):
                if not any(first <= message.log_ns + step <= last for first, last in part.times):
                    continue
                stamp = _stamp(message, types) + step
                try:
                    if bodies is not None:
                        content, extension = _read_image(message, types)
                        where.append((bodies.tell(), len(content), extension))
                        bodies.write(content)
                    else:
                        decoded = types.deserialize(message.channel.type, message.cdr)
                        names = names or tuple(map(str, getattr(decoded, 'name', ()) or ()))
                        rows.append(_values(decoded, message.channel.type, fields))
                except Rejected:
                    continue
                stamps.append(stamp)
                arrived.append(message.log_ns + step)
                file.append(len(files) - 1)
        values = np.array(rows, np.float64).reshape(len(stamps), -1) if rows else np.empty((len(stamps), 0))
        stamped = np.array(stamps, np.int64)
        made = self._ordered(recording, stamped, values, np.array(file, np.int64), files, np.array(arrived, np.int64), names)
        if bodies is None:
            return made
        times = self._times(stamped, np.array(arrived, np.int64))
        order = np.argsort(times, kind='stable')

        def image(message: int) -> tuple[bytes, str]:
            start, size, extension = where[int(order[message])]
            bodies.seek(start)
            return bodies.read(size), extension

        return _with_images(made, image, order, times, self._span)

    def _messages(self, each: SliceEntry, topic: str) -> Iterator[tuple[RecordedMessage, MessageTypes]]:
        source = StoredFile(self._store, naming.BUCKET, each.key, each.bytes)
        wanted = MessageFilter(0, 1 << 64, lambda channel: channel.topic == topic and not channel.repeated)
        known: dict[Channel, MessageTypes] = {}
        for message in McapFile(source).messages(wanted):
            if message.channel not in known:
                folder = self._stack.enter_context(tempfile.TemporaryDirectory(dir=self._work))
                known[message.channel] = _message_types(message.channel, Path(folder))
            yield message, known[message.channel]


def read_manifests(store: ObjectStore, robot: str) -> list[Manifest]:
    """Manifests of all bags of a robot with known times, with the slices that the store has.

    The robot may keep other slices until requested. A bag without a manifest (of another recorder, or still growing) is skipped.
    Raises StoreError.
    """
    found = []
    for bag in find_bags(store, robot):
        if bag.is_archive:
            continue
        try:
            manifest = read_manifest(store, bag)
        except BagDamaged:
            continue
        if manifest is None or (manifest.clock is not None and manifest.clock.offset_ns is None):
            continue
        there = {file.name for file in bag.files}
        found.append(replace(manifest, slices=tuple(each for each in manifest.slices if each.file in there)))
    return found


def select_bags(manifests: Iterable[Manifest], mission_id: str, run_id: str, counted: Interval) -> list[Manifest]:
    """The bags with messages of a mission's time, the preferred ones first.

    Order: the mission's own bags, those of no mission, those of other missions, those of events if they have nearly all of it;
    within each, the one with most of the mission first.
    """
    found = []
    for manifest in manifests:
        step = _clock_offset(manifest)
        times = [Interval(each.t_start_ns + step, each.t_end_ns + step) for each in manifest.slices]
        covered = sum(each.within(counted).length for each in times)
        is_excerpt = manifest.event is not None and covered < NEARLY_ALL * counted.length
        if not is_excerpt and any(first <= counted.last_ns and last >= counted.first_ns for first, last in times):
            found.append(((_rank(manifest, mission_id, run_id), -covered, manifest.bag), manifest))
    return [manifest for _, manifest in sorted(found, key=lambda each: each[0])]


def _rank(bag: Manifest, mission_id: str, run_id: str) -> int:
    """Lower is better."""
    if bag.event is not None:
        return 3
    if bag.mission is None:
        return 1
    return 0 if _belongs_to_mission(bag, mission_id, run_id) else 2


def _belongs_to_mission(bag: Manifest, mission_id: str | None, run_id: str | None) -> bool:
    """By the mission's id; by its run's while a bag has no other."""
    if bag.mission is None:
        return False
    known = bag.mission.mission_id
    return known == mission_id if known and mission_id else bool(run_id) and bag.mission.run_id == run_id


def _file(wanted: Object) -> SourceFile:
    return SourceFile(wanted.bucket, wanted.key, wanted.sha256)


def _arrivals(track: Track, number: int, times: NDArray[np.int64]) -> NDArray[np.int64]:
    """Arrivals of the messages of an object, in stored order; zeros if unknown."""
    first, last = (0, 0) if track.received_ns is None else map(int, track.received_ns[number])
    if not first:
        return np.zeros(len(times), np.int64)
    return decode.arrivals(times + (first - int(times.min())), first, last)


def _unpacked(prefetch: Prefetch, wanted: Object) -> list[decode.ArchiveMember]:
    return decode.members(prefetch.get(wanted), decode.extension_of(wanted.key))


def _with_images(made: Series, image: Callable[[int], tuple[bytes, str]], order: NDArray[np.intp], times: NDArray[np.int64],
                   span: tuple[int, int]) -> Series:  # fmt: skip
    """``image`` counts all messages in their order; the series may start later."""
    before = int((times[order] < span[0]).sum())
    made.image = lambda message: image(before + message)
    return made


def _clock_offset(bag: Manifest) -> int:
    return 0 if bag.clock is None else bag.clock.offset_ns or 0


def _message_types(channel: Channel, folder: Path) -> MessageTypes:
    """The definitions in the bag: a machine that trains has no ROS."""
    text, named = channel.definition, re.fullmatch(r'([A-Za-z]\w*)/(?:msg/)?([A-Za-z]\w*)', channel.type, re.ASCII)
    if channel.encoding == 'ros2msg' and named is not None:
        first, *others = text.split(f'{SEPARATOR}\n')
        definitions = [(named[1], named[2], first)]
        for other in others:
            title, _, body = other.partition('\n')
            if (found := _MESSAGE_TITLE.match(title)) is not None:
                definitions.append((found[1], found[2], body))
        for package, name, body in definitions:
            path = folder / 'share' / package / 'msg' / f'{name}.msg'
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(body, encoding='utf-8')
    return MessageTypes([folder])


def _stamp(message: RecordedMessage, types: MessageTypes) -> int:
    """The stamp of its header if set, otherwise the time of publication."""
    stamp = header_stamp_ns(message.cdr) if types.has_header(message.channel.type) else 0
    return stamp if stamp >= EARLIEST_SANE_NS else message.publish_ns or message.log_ns


def _read_image(message: RecordedMessage, types: MessageTypes) -> tuple[bytes, str]:
    """A compressed image as published, a raw one as PNG."""
    sample = Sample(message.log_ns, message.cdr)
    batch = Batch('camera', message.channel.topic, message.channel.type, (sample,), len(message.cdr))
    made = encode_png(Job(batch, SensorSettings(name='camera', format='png'), 'robot', types), sample)
    return made.body, made.ext


def _values(message: Any, kind: str, fields: Sequence[str]) -> NDArray[np.float64]:
    paths = fields or decode.FIELDS.get(kind, ())
    if kind == _ODOMETRY:
        paths = decode.whole_odometry(paths or decode.ODOMETRY)
    found = []
    for path in paths:
        values, marker = np.atleast_1d(np.asarray(attrgetter(path)(message), np.float64)).ravel(), decode.marker_of(kind, path)
        is_unknown = marker is not None and np.atleast_1d(attrgetter(marker)(message))[0] == -1
        found.append(np.full_like(values, np.nan) if is_unknown else values)
    return np.concatenate(found) if found else np.empty(0)


def read_images(
    store: ObjectStore, requested: Collection[tuple[str, str, int, str]], topic: str, work: Path
) -> dict[tuple[str, int], bytes]:
    """(key, stamp) -> the image, for (bucket, key, stamp, sha256); missing ones are skipped.

    Raises StoreError; LakeError for an object that changed.
    """
    found: dict[tuple[str, int], bytes] = {}
    with ExitStack() as stack:
        for bucket, key, sha256 in sorted({(bucket, key, sha256) for bucket, key, _, sha256 in requested}):
            stamps = {stamp for _, other, stamp, _ in requested if other == key}
            held = store.head(bucket, key)
            if held is None:
                continue
            if key.endswith('.mcap'):
                found |= _images_in_slice(store, held, stamps, topic, stack, work)
                continue
            body = store.get(bucket, key)
            if sha256 and hashlib.sha256(body).hexdigest() != sha256:
                raise LakeError(f'the source {bucket}/{key} has changed')
            extension = decode.extension_of(key)
            if extension in decode.ARCHIVES:
                offset = int(held.metadata.get(meta.CLOCK_OFFSET_NS, 0))
                members = decode.members(body, extension)
                found |= {(key, each.stamp_ns + offset): each.body for each in members if each.stamp_ns + offset in stamps}
            else:
                found |= {(key, stamp): body for stamp in stamps}
    return found


def _images_in_slice(store: ObjectStore, held: ObjectInfo, stamps: Collection[int], topic: str, stack: ExitStack,
                       work: Path) -> dict[tuple[str, int], bytes]:  # fmt: skip
    found: dict[tuple[str, int], bytes] = {}
    known: dict[Channel, MessageTypes] = {}
    offset = int(held.metadata.get(meta.CLOCK_OFFSET_NS, 0))
    wanted = MessageFilter(0, 1 << 64, lambda channel: channel.topic == topic and not channel.repeated)
    for message in McapFile(StoredFile(store, held.bucket, held.key, held.size)).messages(wanted):
        if message.channel not in known:
            folder = stack.enter_context(tempfile.TemporaryDirectory(dir=work))
            known[message.channel] = _message_types(message.channel, Path(folder))
        stamp = _stamp(message, known[message.channel]) + offset
        if stamp in stamps:
            found[held.key, stamp] = _read_image(message, known[message.channel])[0]
    return found
