"""The process that reads the past for the live page: a timeline of a time, and what the robot saw at a moment of it.

It reads a request a line on its standard input and answers each on its standard output: two uint32 (little-endian) with the
lengths of head and body, the head as JSON, the body. The live page starts it when somebody looks back, and ends it a minute
after the last request. Whatever a hostile store does to it, the page goes on.
"""

from __future__ import annotations

import json
import os
import re
import resource
import shlex
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYet
from contextlib import closing, suppress
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import simplejpeg

from shadowhound_data_logger.bags.manifest import Manifest
from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.core.config import home, store_settings
from shadowhound_data_logger.core.errors import BagDamaged, DataLoggerError, LakeError, Rejected, SettingError
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.core.mailbox import KeptFilter
from shadowhound_data_logger.core.model import ON_ROBOT
from shadowhound_data_logger.core.options import UploadSettings
from shadowhound_data_logger.core.stamps import BY_RECEIVED, BY_STAMP, CLOCKS, SAME_NS
from shadowhound_data_logger.core.untrusted import check_pixels, visible
from shadowhound_data_logger.formats.mcap.index import McapIndex, read_summary
from shadowhound_data_logger.formats.mcap.messages import MessageFilter, read_messages
from shadowhound_data_logger.formats.mcap.ranges import Ranged
from shadowhound_data_logger.formats.rows.schema import BUCKET
from shadowhound_data_logger.formats.statistics import INFINITE
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.lake import decode
from shadowhound_data_logger.live.kept import KeptSource, SpoolKept, StoreKept, offers
from shadowhound_data_logger.live.kinds import FULL, KINDS, LiveItem, clouds, frames, points_items, series, table_item
from shadowhound_data_logger.live.past import (
    FRESH_S,
    PastContents,
    PastDay,
    PastObject,
    PastSource,
    SpoolPast,
    StorePast,
    dates_between,
)
from shadowhound_data_logger.stores import open_store

MAX_SPAN_NS: Final = 50 * 3600 * SECOND
"""Of a timeline."""
RUNS: Final = 800
"""A timeline is told this fine; and what follows within ``RHYTHM_NS`` is one run however fine it is."""
RHYTHM_NS: Final = 5 * SECOND // 2
LONGEST_BATCH_NS: Final = 15 * SECOND
STALE_NS: Final = 10 * SECOND
"""What is older at a moment is not shown for it."""
SERIES_NS: Final = 10 * SECOND
"""So much before a moment the plots show."""
PATH_NS: Final = 600 * SECOND
AROUND_NS: Final = 5 * SECOND
"""Of a moment, on either side: what its commands ask for."""
LABELS_S: Final = 1.0
"""A timeline waits so long for the labels in the store."""
IN_BAG_NS: Final = 3 * SECOND // 2
"""So much before a moment is read of a bag."""
MOST_TEXT: Final = 160
MAX_MARKS: Final = 500
MAX_OFFSETS: Final = 8
"""Between stamp and arrival, in the messages about a moment."""
MAX_CUTS: Final = 3
"""Commands that cut a bag."""
MAX_COLUMNS: Final = 64
MAX_MESSAGES: Final = 2000
"""Of a series at a moment; and of one object."""
MAX_TOPICS: Final = 64
MAX_MEMORY: Final = 6 << 30
"""Address space of this process: a file that makes it ask for more ends it, and not the machine."""
_CLOUD, _CAMERA = 'cloud', 'camera'


class PastReader:
    """Answers questions about the past, one at a time. Close once."""

    def __init__(self, source: PastSource, kept: KeptSource, prefixes: Sequence[str] = ()) -> None:
        self._source, self._kept = source, kept
        self._contents = PastContents()
        self._types = MessageTypes(prefixes)
        self._pool = ThreadPoolExecutor(8, 'past')
        self._index = lru_cache(maxsize=16)(self._read_index)
        self._labels = PastLabels(self._pool)

    def close(self) -> None:
        self._pool.shutdown()
        self._contents.close()

    def answer(self, asked: Mapping[str, Any]) -> tuple[dict[str, Any], bytes]:
        """Head and body. Raises DataLoggerError, ValueError for what is no question."""
        do, robot = asked.get('do'), asked.get('robot', '')
        if do == 'robots':
            return {'robots': self._source.robots()}, b''
        if not isinstance(robot, str) or not is_name(robot):
            raise ValueError('robot is the name of a robot')
        if do == 'days':
            return {'days': self._source.days(robot)}, b''
        if do == 'timeline':
            return self.timeline(robot, int(asked['from']) * 1_000_000, int(asked['to']) * 1_000_000, _clock(asked)), b''
        if do == 'moment':
            return self.moment(robot, int(asked['at']) * 1_000_000, _clock(asked))
        if do == 'label':
            if robot not in self._source.robots():
                raise LabelRefused(f'there is no robot {robot!r} here')
            return {'id': self._labels.add(robot, asked)}, b''
        if do == 'kept':
            begin_ns, end_ns = _times(asked)
            return {'kept': {sensor: each.to_json() for sensor, each in offers(self._kept, robot, begin_ns, end_ns).items()}}, b''
        if do == 'requests':
            return self.requests(robot), b''
        if do == 'pull':
            return self.pull(robot, asked), b''
        raise ValueError('do is robots, days, timeline, moment, label, kept, requests or pull')

    # -- what is kept on the robot ---------------------------------------------------------------------------------

    def requests(self, robot: str) -> dict[str, Any]:
        """What is asked of a robot: ``sensor``, ``from`` and ``to`` (UTC in ms) instead of what each request wants.

        Raises StoreError, LakeError, SpoolError.
        """
        found = []
        for one in self._kept.requests(robot)[::-1]:
            want = one.want
            times = {name: want[word] / 1e6 for name, word in (('from', 'since_ns'), ('to', 'until_ns')) if word in want}
            found.append({'id': one.id, 'by': _text(one.by), 'state': _text(one.state), 'why': _text(one.why),
                          'objects': one.objects, 'bytes': one.bytes, 'sent': one.sent, 'sent_bytes': one.sent_bytes,
                          'sensor': _text(want.get('sensor', '')), **times})  # fmt: skip
        return {'requests': found, 'mbps': self._kept.mbps(robot)}

    def pull(self, robot: str, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Ask for a sensor's objects of a time, or take a request back. Raises as ``KeptSource.ask``, LakeError."""
        by = re.sub(r'[^A-Za-z0-9_.-]', '_', str(asked['by']))
        if 'cancel' in asked:
            if all(one.id != asked['cancel'] for one in self._kept.requests(robot)):
                raise PullRefused('there is no such request any more')
            self._kept.cancel(robot, asked['cancel'], by)
            return {'id': asked['cancel']}
        begin_ns, end_ns = _times(asked)
        sensor = str(asked['sensor'])
        offered = offers(self._kept, robot, begin_ns, end_ns).get(sensor)
        if offered is None or not offered.objects:
            raise PullRefused(f'{robot} keeps nothing of {visible(sensor)[:MOST_TEXT]} in this time')
        return {'id': self._kept.ask(robot, KeptFilter(sensor=sensor, since_ns=begin_ns, until_ns=end_ns), by)}

    # -- a time ----------------------------------------------------------------------------------------------------

    def timeline(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> dict[str, Any]:
        """What was recorded between two times, the gaps, and what happened; ``by`` which of the two times of messages.

        Missions, bags, events and labels have the robot's own time, which is that of arrival.
        ``recorded``: [topic, from, to]; ``kept`` the same of what is on the robot alone; ``marks``: [kind, name, from, to, text];
        times are UTC in ms, the rest is as in ``SpoolFigures.gaps``. Raises ValueError, DataLoggerError.
        """
        if not 0 < end_ns - begin_ns <= MAX_SPAN_NS:
            raise ValueError(f'a timeline has at most {MAX_SPAN_NS // SECOND // 3600} hours')
        days = [self._source.day(robot, date, by) for date in dates_between(begin_ns - LONGEST_BATCH_NS, end_ns)]
        found = {**self._source.gaps(robot, begin_ns, end_ns, by), 'by': by}
        found['recorded'] = [
            [_text(topic), round(from_ns / 1e6, 1), round(to_ns / 1e6, 1)]
            for topic, from_ns, to_ns in _runs(days, begin_ns, end_ns)
        ]  # fmt: skip
        labels, lacking = self._labels.marks(robot)
        marks = sorted([*self._marks_of_missions(days), *self._marks_of_bags(days), *labels], key=lambda mark: mark[2])
        inside = [mark for mark in marks if mark[3] >= begin_ns and mark[2] <= end_ns][:MAX_MARKS]
        found['marks'] = [
            [kind, _text(name), round(from_ns / 1e6, 1), round(to_ns / 1e6, 1), _text(text)]
            for kind, name, from_ns, to_ns, text in inside
        ]  # fmt: skip
        rows = [] if self._kept.is_recorded else self._kept.rows(robot, begin_ns, end_ns)
        kept = [(row['topic'] or row['sensor'] or '', *_kept_times(row, by)) for row in rows if row['where'] == ON_ROBOT]
        found['kept'] = [[_text(name), round(from_ns / 1e6, 1), round(to_ns / 1e6, 1)] for name, from_ns, to_ns in
                         _spans(kept, begin_ns, end_ns)]  # fmt: skip
        found['problem'] = _text(next((day.problem for day in days if day.problem), lacking), 400)
        found['commands'] = commands(robot, begin_ns, end_ns, [mark[1] for mark in inside if mark[0] == 'bag'], by)
        return found

    @staticmethod
    def _marks_of_missions(days: Sequence[PastDay]) -> Iterator[tuple[str, str, int, int, str]]:
        spans: dict[str, tuple[str, int, int]] = {}
        for day in days:
            for name, kind, begin_ns, end_ns in day.missions:
                known = spans.get(name, (kind, begin_ns, end_ns))
                spans[name] = known[0] or kind, min(known[1], begin_ns), max(known[2], end_ns)
        for name, (kind, begin_ns, end_ns) in spans.items():
            yield 'mission', name, begin_ns, end_ns, kind

    def _marks_of_bags(self, days: Sequence[PastDay]) -> Iterator[tuple[str, str, int, int, str]]:
        for day in days:
            told = self._pool.map(self._contents.manifest, day.bag_files.values())
            for (bag, files), manifest in zip(day.bag_files.items(), told, strict=True):
                slices = manifest.slices if manifest is not None else ()
                begin_ns = min((one.t_start_ns for one in slices), default=min(one.begin_ns for one in files))
                end_ns = max((one.t_end_ns for one in slices), default=max(one.end_ns for one in files))
                yield 'bag', bag, begin_ns, end_ns, '' if manifest is None else manifest.state
                for trigger in manifest.event.triggers if manifest is not None and manifest.event is not None else ():
                    text = f'{trigger.by}: {trigger.detail}' if trigger.detail else trigger.by
                    yield 'event', trigger.name, trigger.at_ns, trigger.at_ns, text

    # -- a moment --------------------------------------------------------------------------------------------------

    def moment(self, robot: str, at_ns: int, by: str = BY_STAMP) -> tuple[dict[str, Any], bytes]:
        """What there is of a moment: the newest of each topic at or before it, as items, each after a uint32 with its length.

        ``by`` says by which of their two times messages are of the moment, and their age is measured. The head has ``shown``:
        [topic, kind, ms before the moment, where it was read]. Raises DataLoggerError.
        """
        days = [self._source.day(robot, date, by) for date in dates_between(at_ns - PATH_NS, at_ns + 1)]
        near = [one for day in days for one in day.between(at_ns - LONGEST_BATCH_NS, at_ns + 1)]
        shown: dict[str, tuple[LiveItem, str]] = {}
        late = _offsets(near) if by == BY_STAMP else [0]
        dates = sorted({date for late_ns in late for date in dates_between(at_ns + late_ns - PATH_NS, at_ns + late_ns + 1)})
        bag_files = [pair for date in dates for pair in self._source.day(robot, date, by).bag_files.items()]
        for item, where in (*self._of_objects(near, at_ns, by), *self._of_bags(bag_files, at_ns, by, late)):
            known = shown.get(item.topic)
            if known is None or (item.head or {})['at'] > (known[0].head or {})['at'] + 1:
                shown[item.topic] = item, where
        walked = [one for day in days for one in day.between(at_ns - PATH_NS, at_ns + 1)]
        poses = [((one.begin_ns + one.end_ns) // 2, one.pose) for one in walked if one.pose]
        items = [*(item for item, _ in shown.values()), *_track(poses)]
        covering = [bag for bag, files in bag_files
                    if any(_slices(files, self._contents.manifest(files), at_ns + late_ns) for late_ns in late)]  # fmt: skip
        last = max((one for one in near if one.mission_id), key=lambda one: one.begin_ns, default=None)
        head = {
            'at': at_ns / 1e6, 'by': by, 'mission': _text(last.mission_id) if last is not None else '',
            'commands': commands(robot, at_ns - AROUND_NS, at_ns + AROUND_NS, covering, by, (min(late), max(late))),
            'shown': [[_text(item.topic), item.kind, round(at_ns / 1e6 - (item.head or {})['at'], 1), _text(where, 300)]
                      for item, where in shown.values()],
        }  # fmt: skip
        return head, b''.join(len(item.packed).to_bytes(4, 'little') + item.packed for item in items)

    def _of_objects(self, near: Sequence[PastObject], at_ns: int, by: str) -> list[tuple[LiveItem, str]]:
        chosen: dict[str, list[PastObject]] = {}
        for one in near:
            if '/rosbags/' not in one.key and '/missions/' not in one.key:
                topic = one.topic or one.sensor
                if topic in chosen or len(chosen) < MAX_TOPICS:
                    chosen.setdefault(topic, []).append(one)
        found = self._pool.map(lambda pair: self._of_topic(pair[0], pair[1], at_ns, by), chosen.items())
        return [item for item in found if item is not None]

    def _of_topic(self, topic: str, objects: Sequence[PastObject], at_ns: int, by: str) -> tuple[LiveItem, str] | None:
        """The newest of a topic that can be read."""
        last = objects[-1]
        extension = decode.extension_of(last.key)
        with suppress(DataLoggerError, *_BROKEN):
            if extension == 'json':
                return self._series(topic, [one for one in objects if one.end_ns >= at_ns - SERIES_NS], at_ns, by)
            is_known = extension in decode.CLOUDS | decode.IMAGES | decode.ARCHIVES
            if not is_known or at_ns - last.begin_ns > STALE_NS:
                return None
            body, stamp_ns = self._contents.get(last), last.begin_ns
            if extension in decode.ARCHIVES:
                members = decode.members(body, extension)
                dated = zip(_message_times(last, [one.stamp_ns for one in members], by), members, strict=True)
                shown = [(time_ns, one) for time_ns, one in dated if time_ns <= at_ns]
                if not shown:
                    return None
                stamp_ns, newest = max(shown, key=lambda each: each[0])
                body, extension = newest.body, newest.extension
            if item := _picture(topic, extension, body, stamp_ns / 1e6):
                return item, _where(last)
        return None

    def _series(self, topic: str, objects: Sequence[PastObject], at_ns: int, by: str) -> tuple[LiveItem, str] | None:
        if not objects or (objects[-1].type and objects[-1].type not in KINDS):
            return None
        rows: list[tuple[float, Mapping[str, float]]] = []
        name = ''
        for one in objects[-MAX_TOPICS:]:
            told, samples = _samples(self._contents.get(one))
            name = one.type or told
            kind = KINDS.get(name)
            if kind is None or kind.values is None:
                return None
            times = _message_times(one, [sample['stamp_ns'] for sample in samples], by)
            dated = [*zip(times, samples, strict=True)][-MAX_MESSAGES:]
            rows += [
                (time_ns / 1e6, _checked(kind.values(_message(name, sample))))
                for time_ns, sample in dated if at_ns - SERIES_NS <= time_ns <= at_ns
            ]  # fmt: skip
        if not rows:
            return None
        rows.sort(key=lambda row: row[0])
        return table_item(topic, KINDS[name], rows[-MAX_MESSAGES:]), _where(objects[-1])

    # -- bags ------------------------------------------------------------------------------------------------------

    def _of_bags(self, bag_files: Sequence[tuple[str, Sequence[PastObject]]], at_ns: int, by: str,
                 late: Sequence[int]) -> list[tuple[LiveItem, str]]:  # fmt: skip
        """Messages of a moment. Bags are sorted by arrival: with these offsets that is so much after the stamp."""
        found: list[tuple[LiveItem, str]] = []
        for _, files in bag_files:
            manifest = self._contents.manifest(files)
            slices = {one.key: one for late_ns in late for one in _slices(files, manifest, at_ns + late_ns)}
            for one in slices.values():
                with suppress(DataLoggerError, *_BROKEN):
                    found += self._of_slice(one, at_ns, by, late)
        return found

    def _of_slice(self, one: PastObject, at_ns: int, by: str, late: Sequence[int]) -> list[tuple[LiveItem, str]]:
        source, index = self._index(one)
        if index is None:
            return []
        came: dict[tuple[str, str], dict[int, bytes]] = {}
        waiting, read = list(late), set[int]()
        while waiting:
            late_ns = waiting.pop(0)
            read.add(late_ns)
            for message in read_messages(source, index, _around(at_ns + late_ns, by)):
                is_by_stamp, offset_ns = by == BY_STAMP, message.log_ns - message.publish_ns
                if is_by_stamp and len(read) + len(waiting) < MAX_OFFSETS and _is_new(offset_ns, (*read, *waiting)):
                    waiting.append(offset_ns)
                message_ns = message.publish_ns if is_by_stamp else message.log_ns
                name = message.channel.topic, message.channel.type
                if at_ns - IN_BAG_NS <= message_ns <= at_ns and (name in came or len(came) < MAX_TOPICS):
                    of = came.setdefault(name, {})
                    of[message_ns] = message.cdr
                    if KINDS[name[1]].is_bulk or len(of) > MAX_MESSAGES:
                        for oldest in sorted(of)[:-1]:
                            del of[oldest]
        found: list[tuple[LiveItem, str]] = []
        for (topic, type_name), messages in came.items():
            with suppress(Rejected, *_BROKEN):
                ordered = [(message_ns / 1e6, messages[message_ns]) for message_ns in sorted(messages)]
                found.append((self._of_messages(topic, type_name, ordered), _where(one)))
        return found

    def _of_messages(self, topic: str, type_name: str, messages: Sequence[tuple[float, bytes]]) -> LiveItem:
        kind, (at_ms, cdr) = KINDS[type_name], messages[-1]
        if kind.name == _CLOUD:
            return next(clouds(topic, self._types, at_ms, cdr, (FULL,)))
        if kind.name == _CAMERA:
            return next(frames(topic, type_name, self._types, at_ms, cdr, (FULL,)))
        return series(topic, kind, type_name, self._types, messages)

    def _read_index(self, one: PastObject) -> tuple[Ranged, McapIndex | None]:
        """A file without a complete summary, which the node does not write, is not searched."""
        source = self._contents.ranged(one)
        return source, read_summary(source)


class PullRefused(DataLoggerError):
    """What nobody can be asked for."""

    DEFAULT_REMEDY = 'choose another time or sensor'


class LabelRefused(DataLoggerError):
    """What is no label."""

    DEFAULT_REMEDY = 'a label is a text on one line, for a time that ends after it begins'


class PastLabels:
    """The labels that stand in the store, and new ones. They are read beside the rest: a store that is away delays nothing."""

    def __init__(self, pool: ThreadPoolExecutor) -> None:
        self._pool = pool
        self._reading: dict[str, tuple[float, Future[list[_Mark]]]] = {}
        self._known: dict[str, list[_Mark]] = {}

    def marks(self, robot: str) -> tuple[list[_Mark], str]:
        """As they were read last, and why they are not known or old."""
        if find_spec('pyarrow') is None:
            return [], ''
        now_s = time.monotonic()
        since_s, reading = self._reading.get(robot, (-FRESH_S, None))
        if reading is None or (reading.done() and now_s - since_s > FRESH_S):
            reading = self._pool.submit(_labels_of, robot)
            self._reading[robot] = now_s, reading
        try:
            self._known[robot] = reading.result(LABELS_S)
        except NotYet:
            return self._known.get(robot, []), 'the labels in the store are still being read'
        except (DataLoggerError, *_BROKEN) as error:
            return self._known.get(robot, []), f'the labels in the store cannot be read: {error}'
        return self._known[robot], ''

    def add(self, robot: str, asked: Mapping[str, Any]) -> str:
        """Its id. Raises LakeError, SettingError, StoreError."""
        if find_spec('pyarrow') is None:
            raise LakeError('labels need pyarrow', remedy='install the extra lake')
        from shadowhound_data_logger.lake import labels  # noqa: PLC0415 - the extra lake

        label, note, by = (str(asked[name]) for name in ('label', 'note', 'by'))
        since_ns, until_ns = (int(asked[name]) * 1_000_000 for name in ('from', 'to'))
        try:
            one = labels.Label(robot=robot, label=label, since_ns=since_ns, until_ns=until_ns, note=note).checked()
        except SettingError as error:
            raise LabelRefused(str(error)) from error
        with closing(open_store(store_settings(os.environ, home(os.environ)), UploadSettings())) as store:
            labels.write(store, robot, [one], by=by)
        self._reading.pop(robot, None)
        return one.id


def _labels_of(robot: str) -> list[_Mark]:
    """Raises LakeError, StoreError, SettingError."""
    from shadowhound_data_logger.lake import labels  # noqa: PLC0415 - the extra lake
    from shadowhound_data_logger.lake.bucket import Bucket  # noqa: PLC0415
    from shadowhound_data_logger.lake.findings import Findings  # noqa: PLC0415

    found = labels.read(Bucket(store_settings(os.environ, home(os.environ)), BUCKET), robot, findings=Findings(lambda _: None))
    return [
        ('label', one.label, one.since_ns, one.until_ns, f'{one.note} by {one.by}' if one.note else f'by {one.by}')
        for one in found if one.robot == robot
    ]  # fmt: skip


_Mark = tuple[str, str, int, int, str]
"""Kind, name, begin and end in ns, what else there is to say."""
_BROKEN: Final = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError, MemoryError, OSError)
"""What comes of content that is not what its name says."""


def commands(robot: str, begin_ns: int, end_ns: int, bags: Sequence[str], by: str = BY_STAMP,
             late_ns: tuple[int, int] = (0, 0)) -> list[list[str]]:  # fmt: skip
    """[what, command line] for this time, to be pasted into a shell: names of a store are quoted.

    Bags are cut by arrival, which is at least and at most ``late_ns`` after the stamps.
    """
    since, until, start, end = (
        f'{utc(at_ns):%Y-%m-%dT%H:%M:%S.%f}'[:-3] + 'Z'
        for at_ns in (begin_ns, end_ns, begin_ns + late_ns[0], end_ns + late_ns[1])
    )
    of = f'--robot {shlex.quote(robot)}'
    span = f'{of} --since {since} --until {until}'
    cuts = [
        ['bag cut', f'shadowhound-data bag cut {shlex.quote(bag)} {of} --start {start} --end {end} --to cut']
        for bag in [bag for bag in dict.fromkeys(bags) if is_name(bag)][:MAX_CUTS]
    ]
    if by == BY_RECEIVED:
        return [['query', f'shadowhound-data query {span} --by {by}'], *cuts]
    return [['query', f'shadowhound-data query {span}'], ['fetch', f'shadowhound-data fetch {span} --to data'], *cuts]


def _around(log_ns: int, by: str) -> MessageFilter:
    """The messages of a bag that may be of a moment; offsets that differ by less than ``SAME_NS`` are the same."""
    slack_ns = SAME_NS if by == BY_STAMP else 0
    return MessageFilter(log_ns - IN_BAG_NS - slack_ns, log_ns + slack_ns + 1, lambda channel: channel.type in KINDS)


def _is_new(offset_ns: int, known: Iterable[int]) -> bool:
    return all(abs(offset_ns - each) > SAME_NS // 2 for each in known)


def _offsets(objects: Sequence[PastObject]) -> list[int]:
    """How much later than their stamps messages of some objects arrived: 0, and what differs from that by more than a second."""
    found = [0]
    for one in objects:
        if len(found) < MAX_OFFSETS and _is_new(one.late_ns, found) and abs(one.late_ns) > SAME_NS:
            found.append(one.late_ns)
    return found


def _kept_times(row: Mapping[str, Any], by: str) -> tuple[int, int]:
    """First and last of an object that is kept."""
    start_ns, end_ns = row['t_start_ns'], row['t_end_ns'] or row['t_start_ns']
    if by == BY_RECEIVED and (received_ns := row['received_start_ns']) is not None:
        return received_ns, row['received_end_ns'] or received_ns
    return start_ns, end_ns


def _clock(asked: Mapping[str, Any]) -> str:
    """Raises ValueError."""
    if (by := asked.get('by', BY_STAMP)) not in CLOCKS:
        raise ValueError(f'by is {" or ".join(CLOCKS)}')
    return str(by)


def _times(asked: Mapping[str, Any]) -> tuple[int, int]:
    """``from`` and ``to`` in ns. Raises ValueError."""
    begin_ns, end_ns = int(asked['from']) * 1_000_000, int(asked['to']) * 1_000_000
    if not 0 < end_ns - begin_ns <= MAX_SPAN_NS:
        raise ValueError(f'a time has at most {MAX_SPAN_NS // SECOND // 3600} hours')
    return begin_ns, end_ns


def _spans(found: Sequence[tuple[str, int, int]], begin_ns: int, end_ns: int) -> Iterator[tuple[str, int, int]]:
    """As ``_runs``, of (topic, from, to)."""
    grain_ns = max(RHYTHM_NS, (end_ns - begin_ns) // RUNS)
    spans: dict[str, tuple[int, int]] = {}
    for name, from_ns, to_ns in sorted(found, key=lambda one: one[1]):
        known = spans.get(name)
        if known is None and len(spans) >= MAX_TOPICS:
            continue
        if known is not None and from_ns - known[1] > grain_ns:
            yield name, max(begin_ns, known[0]), min(end_ns, known[1])
            known = None
        spans[name] = (from_ns, to_ns) if known is None else (known[0], max(known[1], to_ns))
    yield from ((name, max(begin_ns, from_ns), min(end_ns, to_ns)) for name, (from_ns, to_ns) in spans.items())


def _slices(files: Sequence[PastObject], manifest: Manifest | None, at_ns: int) -> list[PastObject]:
    """The files of a bag that may have messages of a moment."""
    spans = {} if manifest is None else {one.file: (one.t_start_ns, one.t_end_ns) for one in manifest.slices}
    found = []
    for one in files:
        begin_ns, end_ns = spans.get(one.key.rpartition('/')[2], (one.begin_ns, one.end_ns))
        if one.key.endswith('.mcap') and begin_ns <= at_ns and end_ns >= at_ns - IN_BAG_NS:
            found.append(one)
    return found[:4]


def _runs(days: Sequence[PastDay], begin_ns: int, end_ns: int) -> Iterator[tuple[str, int, int]]:
    """(topic, from, to) of the times in which objects follow one another."""
    grain_ns = max(RHYTHM_NS, (end_ns - begin_ns) // RUNS)
    for day in days:
        inside = (day.begins < end_ns) & (day.ends >= begin_ns)
        codes, begins, ends = day.codes[inside], day.begins[inside], day.ends[inside]
        for code, name in list(enumerate(day.names))[:MAX_TOPICS]:
            chosen = codes == code
            if not name or name == 'bag' or not chosen.any():
                continue
            starts, reached = begins[chosen], np.maximum.accumulate(ends[chosen])
            breaks = np.flatnonzero(starts[1:] - reached[:-1] > grain_ns) + 1
            for low, high in zip((0, *breaks.tolist()), (*breaks.tolist(), len(starts)), strict=True):
                yield name, max(begin_ns, int(starts[low])), min(end_ns, int(reached[high - 1]))


def _track(poses: Sequence[tuple[int, tuple[float, float, float]]]) -> Iterator[LiveItem]:
    """Where the robot went, by poses and the times that they are of (of a batch its middle)."""
    ordered = sorted(poses, key=lambda each: each[0])
    if not ordered:
        return
    places = np.array([pose for _, pose in ordered[:: len(ordered) // MAX_MESSAGES + 1]], '<f4')
    yield LiveItem('', 'path', head={'points': len(places)}, body=places.tobytes())


def _picture(topic: str, extension: str, body: bytes, at_ms: float) -> LiveItem | None:
    if extension in decode.CLOUDS:
        table = decode.cloud(body)[:, :3]
        return next(points_items(topic, at_ms, table[:: len(table) // 200_000 + 1], 'odom', (FULL,)))
    if extension in {'jpg', 'jpeg'}:
        height, width, *_ = simplejpeg.decode_jpeg_header(body)
        check_pixels(width, height)
        return LiveItem(topic, _CAMERA, head={'at': round(at_ms, 1)}, body=body)
    if extension in decode.IMAGES:
        pixels = decode.image(body)
        if pixels.dtype != np.uint8 or pixels.ndim != 3:
            return None
        body = bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(pixels), 75, 'RGB'))
        return LiveItem(topic, _CAMERA, head={'at': round(at_ms, 1)}, body=body)
    return None


def _samples(body: bytes) -> tuple[str, list[dict[str, Any]]]:
    """The type that a document names, and its messages."""
    found = decode.records(body)
    told = json.loads(body).get('type')
    return told if isinstance(told, str) else '', found


def _message_times(one: PastObject, stamps_ns: Sequence[int], by: str) -> list[int]:
    """Those of the messages of an object."""
    times = np.array(stamps_ns, np.int64) + one.offset_ns
    return [int(each) for each in (decode.arrivals(times, one.begin_ns, one.end_ns) if by == BY_RECEIVED else times)]


def _message(type_name: str, sample: Mapping[str, Any]) -> Any:
    """A sample as the message that it was made of; the short document of odometry too (docs/formats.md)."""
    if type_name == 'nav_msgs/msg/Odometry' and 'pose' not in sample:
        sample = {'pose': {'pose': {'position': sample['position'], 'orientation': sample['orientation']}}}
    return _space(sample)


def _space(value: Any) -> Any:
    if isinstance(value, dict):
        return SimpleNamespace(**{name: _space(inner) for name, inner in value.items()})
    if isinstance(value, list):
        return [_space(inner) for inner in value]
    return float(value) if isinstance(value, str) and value in INFINITE else value


def _checked(values: Mapping[Any, Any]) -> Mapping[str, float]:
    """Raises ValueError for names that are none: those of joints are in the message."""
    if len(values) > MAX_COLUMNS or not all(isinstance(name, str) and len(name) <= MOST_TEXT for name in values):
        raise ValueError('too many figures, or their names are none')
    return {name: float(value) for name, value in values.items()}


def _where(one: PastObject) -> str:
    is_here = one.path != '' and os.path.isfile(one.path)  # noqa: PTH113 - never raises
    return f'{"the spool" if is_here else "the store"}: {one.bucket}/{one.key}'


def _text(text: str, most: int = MOST_TEXT) -> str:
    return visible(text[:most].encode(errors='replace').decode())


def main() -> None:
    """Serve until the input ends. The arguments: the spool's folder and the robot; without them it is the store's past."""
    resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY, MAX_MEMORY))
    with suppress(OSError):
        os.nice(10)  # whoever records goes first
    out = os.fdopen(os.dup(1), 'wb')
    os.dup2(2, 1)  # whatever prints does not answer
    history: PastReader | None = None
    for line in sys.stdin.buffer:
        head: dict[str, Any]
        body = b''
        try:
            if history is None:
                source: PastSource
                kept: KeptSource
                if len(sys.argv) > 2:
                    source, kept = SpoolPast(Path(sys.argv[1]), sys.argv[2]), SpoolKept(Path(sys.argv[1]), sys.argv[2])
                else:
                    source, kept = StorePast(), StoreKept()
                history = PastReader(source, kept, os.environ.get('AMENT_PREFIX_PATH', '').split(':'))
            head, body = history.answer(json.loads(line))
        except DataLoggerError as error:
            head = {'error': visible(str(error))[:1000], 'is_wrong': isinstance(error, (LabelRefused, PullRefused))}
        except (*_BROKEN, LakeError, BagDamaged) as error:
            head = {'error': f'this cannot be read: {type(error).__name__}: {visible(str(error))[:300]}', 'is_wrong': True}
        told = json.dumps(head, separators=(',', ':')).encode()
        out.write(len(told).to_bytes(4, 'little') + len(body).to_bytes(4, 'little') + told + body)
        out.flush()


if __name__ == '__main__':
    main()
