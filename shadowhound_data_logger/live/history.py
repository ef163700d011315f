"""The process that reads the past for the live page: a timeline, and the state of the robot at a moment.

It reads one request per line from standard input and answers on standard output: two uint32 (little-endian) with the lengths of
head and body, the head as JSON, the body. The live page starts it when a user looks at the past, and ends it a minute after the
last request. Whatever a hostile store does to it, the page continues.
"""

from __future__ import annotations

import json
import os
import re
import resource
import shlex
import sys
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
from shadowhound_data_logger.formats.mcap.messages import MessageFilter, RecordedMessage, read_messages
from shadowhound_data_logger.formats.mcap.ranges import Ranged
from shadowhound_data_logger.formats.rows.catalog import BUCKET
from shadowhound_data_logger.formats.statistics import INFINITE
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.lake import decode
from shadowhound_data_logger.live.kept import KeptSource, SpoolKept, StoreKept, offers
from shadowhound_data_logger.live.kinds import FULL, KINDS, LiveItem, clouds, frames, points_items, series, table_item
from shadowhound_data_logger.live.past import (
    BAG_SENSOR,
    FRESH_S,
    MAX_BATCH_NS,
    MAX_BATTERY,
    PastContents,
    PastObject,
    PastSource,
    Run,
    SpoolPast,
    StorePast,
    consecutive,
)
from shadowhound_data_logger.stores import open_store

MAX_SPAN_NS: Final = 50 * 3600 * SECOND
"""Of a timeline."""
RUNS: Final = 800
"""Resolution of a timeline; objects within ``RHYTHM_NS`` are one run at any resolution."""
RHYTHM_NS: Final = 5 * SECOND // 2
LATE_NS: Final = 30 * SECOND
"""Objects delivered later than this after they were recorded are marked on the timeline."""
INFINITE_MS: Final = float('inf')
STALE_NS: Final = 10 * SECOND
"""Maximum age of a value shown for a moment."""
SERIES_NS: Final = 10 * SECOND
"""Length of the plots before a moment."""
PATH_NS: Final = 600 * SECOND
RECENT_NS: Final = 30 * SECOND
"""How much of plots is read from the store for the live view, if it has left the spool."""
MAX_PLAN_CLOUDS: Final = 8
PLAN_EVERY: Final = 8
"""Every n-th point of the clouds that the plan of the live view starts with."""
AROUND_NS: Final = 5 * SECOND
"""Range around a moment, on either side, for its commands."""
LABELS_S: Final = 0.1
"""How long a timeline waits for the labels in the store; the page asks again for slower ones."""
READING_LABELS: Final = 'the labels in the store are still being read'
IN_BAG_NS: Final = 3 * SECOND // 2
"""Range before a moment that is read of a bag."""
BAG_BLOCK_NS: Final = SECOND // 2
"""Block of a bag that is read together."""
MAX_BAG_BYTES: Final = 64 << 20
"""Maximum bytes of cached messages of bags."""
MESSAGE_BYTES: Final = 300
"""Memory of a message besides its content."""
AHEAD_NS: Final = 2 * SECOND
"""Range that is read ahead while moments follow one another."""
MAX_TEXT: Final = 160
MAX_MARKS: Final = 500
MAX_OFFSETS: Final = 8
"""Offsets between stamp and arrival, in the messages around a moment."""
MAX_CUTS: Final = 3
"""Maximum commands that cut a bag."""
MAX_DATASET: Final = 60
MAX_COLUMNS: Final = 64
MAX_MESSAGES: Final = 2000
"""Of a series at a moment; and of one object."""
MAX_TOPICS: Final = 64
MAX_MEMORY: Final = 6 << 30
"""Address space of this process: a file that exceeds it ends this process, not the machine."""
_CLOUD, _CAMERA = 'cloud', 'camera'


class PastReader:
    """Answers requests about the past, one at a time. Close once."""

    def __init__(self, source: PastSource, kept: KeptSource, prefixes: Sequence[str] = ()) -> None:
        self._source, self._kept = source, kept
        self._contents = PastContents()
        self._types = MessageTypes(prefixes)
        self._pool = ThreadPoolExecutor(8, 'past')
        self._index = lru_cache(maxsize=16)(self._read_index)
        self._labels = PastLabels(self._pool)
        self._blocks = BagBlocks()
        self._shown: tuple[str, int, str] = ('', 0, '')
        self._ahead: Future[None] | None = None

    def close(self) -> None:
        self._pool.shutdown()
        self._contents.close()

    def answer(self, request: Mapping[str, Any]) -> tuple[dict[str, Any], bytes]:
        """Head and body. Raises DataLoggerError, ValueError for an invalid request."""
        do, robot = request.get('do'), request.get('robot', '')
        if do == 'robots':
            return {'robots': self._source.robots()}, b''
        if do == 'fleet':
            return {'fleet': self._source.fleet()}, b''
        if not robot and not (robot := next(iter(self._source.robots()), '')):  # the page of a store shows its first robot
            raise ValueError('no robot has stored anything yet')
        if not isinstance(robot, str) or not is_name(robot):
            raise ValueError('robot is the name of a robot')
        if do == 'moment':
            return self.moment(robot, int(request['at']) * 1_000_000, _clock(request))
        if do == 'recent':
            return self.recent(robot, time.time_ns())
        answers: dict[str, Callable[[], dict[str, Any]]] = {
            'days': lambda: {'days': self._source.days(robot)},
            'timeline': lambda: self.timeline(robot, *_times(request), _clock(request), is_fitted=bool(request.get('fit'))),
            'range': lambda: self.range(robot, *_times(request), _clock(request)),
            'label': lambda: self.label(robot, request),
            'kept': lambda: {
                'kept': {name: each.to_json() for name, each in offers(self._kept, robot, *_times(request)).items()}
            },
            'requests': lambda: self.requests(robot),
            'pull': lambda: self.pull(robot, request),
        }  # fmt: skip
        if do not in answers:
            raise ValueError(f'do is robots, moment, {", ".join(answers)}')
        return answers[do](), b''

    def label(self, robot: str, request: Mapping[str, Any]) -> dict[str, Any]:
        """Raises LabelRefused, LakeError, SettingError, StoreError."""
        if robot not in self._source.robots():
            raise LabelRefused(f'there is no robot {robot!r} here')
        return {'id': self._labels.add(robot, request)}

    # -- objects kept on the robot ---------------------------------------------------------------------------------

    def requests(self, robot: str) -> dict[str, Any]:
        """Requests to a robot: ``sensor``, ``from`` and ``to`` (UTC in ms) instead of the complete filter.

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

    def pull(self, robot: str, request: Mapping[str, Any]) -> dict[str, Any]:
        """Request a sensor's objects of a time, or cancel a request. Raises as ``KeptSource.request``, LakeError."""
        by = re.sub(r'[^A-Za-z0-9_.-]', '_', str(request['by']))
        if 'cancel' in request:
            if all(one.id != request['cancel'] for one in self._kept.requests(robot)):
                raise PullRefused('this request does not exist any more')
            self._kept.cancel(robot, request['cancel'], by)
            return {'id': request['cancel']}
        begin_ns, end_ns = _times(request)
        sensor = str(request['sensor'])
        offered = offers(self._kept, robot, begin_ns, end_ns).get(sensor)
        if offered is None or not offered.objects:
            raise PullRefused(f'{robot} keeps no data of {visible(sensor)[:MAX_TEXT]} in this time')
        return {'id': self._kept.ask(robot, KeptFilter(sensor=sensor, since_ns=begin_ns, until_ns=end_ns), by)}

    # -- a time range ----------------------------------------------------------------------------------------------

    def timeline(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP, *, is_fitted: bool = False) -> dict[str, Any]:
        """What was recorded between two times, the gaps, and events; ``by`` is which of the two times of messages counts.

        Missions, bags, events and labels have the robot's own time, which is that of arrival. ``is_fitted``: only the part in
        which something was recorded. ``recorded``: [topic, from, to]; ``kept``: the same for objects only on the robot;
        ``marks``: [kind, name, from, to, text]; ``deliveries``: [from, to, delivered or null] of late deliveries; ``battery``:
        [at, percent]; times are UTC in ms, the rest is as in ``SpoolFigures.gaps``. Raises ValueError, DataLoggerError.
        """
        grain_ns = max(RHYTHM_NS, (end_ns - begin_ns) // RUNS)
        runs = self._runs(robot, begin_ns, end_ns, grain_ns, by)
        bags = list(self._bag_marks(robot, begin_ns, end_ns, by))
        rows = [] if self._kept.is_recorded else self._kept.rows(robot, begin_ns, end_ns)
        on_robot = [(row['topic'] or row['sensor'] or '', *_kept_times(row, by)) for row in rows if row['where'] == ON_ROBOT]
        kept = list(_spans(on_robot, begin_ns, end_ns))
        times = [*((run.begin_ns, run.end_ns) for run in runs), *(one[1:] for one in kept), *(mark[2:4] for mark in bags)]
        if is_fitted and times:
            begins, ends = zip(*times, strict=True)
            spare_ns = max(SECOND, (max(ends) - min(begins)) // 40)
            begin_ns, end_ns = max(begin_ns, min(begins) - spare_ns), min(end_ns, max(ends) + spare_ns)
            grain_ns = max(RHYTHM_NS, (end_ns - begin_ns) // RUNS)
            runs = self._runs(robot, begin_ns, end_ns, grain_ns, by)
        found = {**self._source.gaps(robot, begin_ns, end_ns, by), 'by': by}
        found['recorded'] = [_row(name, from_ns, to_ns, begin_ns, end_ns) for name, from_ns, to_ns in _joined(runs, grain_ns)]
        found['kept'] = [_row(*one, begin_ns, end_ns) for one in kept]
        found['deliveries'] = [
            [round(from_ns / 1e6), round(to_ns / 1e6), None if settled_ns is None else round(settled_ns / 1e6)]
            for from_ns, to_ns, settled_ns in _deliveries(runs, grain_ns, time.time_ns())
        ]  # fmt: skip
        battery = self._source.battery(robot, begin_ns, end_ns, by)
        found['battery'] = [
            [round(at_ns / 1e6), round(percent, 1)]
            for at_ns, percent in battery[:: len(battery) // MAX_BATTERY + 1] if begin_ns <= at_ns <= end_ns
        ]  # fmt: skip
        labels, lacking = self._labels.marks(robot)
        missions = [('mission', one.id, one.begin_ns, one.end_ns, one.type)
                    for one in self._source.missions(robot, begin_ns, end_ns, by)]  # fmt: skip
        marks = sorted([*missions, *bags, *labels], key=lambda mark: mark[2])
        inside = [mark for mark in marks if mark[3] >= begin_ns and mark[2] <= end_ns][:MAX_MARKS]
        found['marks'] = [
            [kind, _text(name), round(from_ns / 1e6, 1), round(to_ns / 1e6, 1), _text(text)]
            for kind, name, from_ns, to_ns, text in inside
        ]  # fmt: skip
        found['labels'] = 'reading' if lacking == READING_LABELS else ''
        found['problem'] = _text(self._source.problem(robot, begin_ns, end_ns, by) or ('' if found['labels'] else lacking), 400)
        return found

    def _runs(self, robot: str, begin_ns: int, end_ns: int, grain_ns: int, by: str) -> list[Run]:
        names: dict[str, None] = {}
        found = []
        for run in self._source.runs(robot, begin_ns, end_ns, grain_ns, by):
            if run.end_ns >= begin_ns and (run.name in names or len(names) < MAX_TOPICS):
                names[run.name] = None
                found.append(run)
        return found

    def range(self, robot: str, begin_ns: int, end_ns: int, by: str = BY_STAMP) -> dict[str, Any]:
        """The data of a time range, and commands to get it. Raises ValueError, DataLoggerError.

        ``bags``: [name, bytes of the slices that cover it, from, to], of the bags that can be cut, by arrival.
        """
        near = self._source.between(robot, begin_ns - PATH_NS, min(end_ns, begin_ns + PATH_NS), by)
        late = _offsets(near) if by == BY_STAMP else [0]
        bags = {}
        for late_ns in late:
            for bag, files in self._source.bag_files(robot, begin_ns + late_ns, end_ns + late_ns, by).items():
                if covering := _slices(files, self._contents.manifest(files), end_ns + late_ns, end_ns - begin_ns):
                    bags[bag] = sum(one.size for one in covering)
        kept = {sensor: each for sensor, each in offers(self._kept, robot, begin_ns, end_ns).items() if each.objects}
        missions = [one.id for one in self._source.missions(robot, begin_ns, end_ns, by)]
        return {
            'from': begin_ns / 1e6, 'to': end_ns / 1e6,
            'bags': [[bag, size, (begin_ns + min(late)) // 1_000_000, (end_ns + max(late)) // 1_000_000]
                     for bag, size in bags.items() if is_name(bag)],
            'commands': commands(robot, begin_ns, end_ns, list(bags), by, (min(late), max(late)), missions, is_kept=bool(kept)),
        }  # fmt: skip

    def _bag_marks(self, robot: str, begin_ns: int, end_ns: int, by: str) -> Iterator[_Mark]:
        bags = self._source.bag_files(robot, begin_ns, end_ns, by)
        manifests = self._pool.map(self._contents.manifest, bags.values())
        for (bag, files), manifest in zip(bags.items(), manifests, strict=True):
            slices = manifest.slices if manifest is not None else ()
            first_ns = min((one.t_start_ns for one in slices), default=min(one.begin_ns for one in files))
            last_ns = max((one.t_end_ns for one in slices), default=max(one.end_ns for one in files))
            yield 'bag', bag, first_ns, last_ns, '' if manifest is None else manifest.state
            for trigger in manifest.event.triggers if manifest is not None and manifest.event is not None else ():
                text = f'{trigger.by}: {trigger.detail}' if trigger.detail else trigger.by
                yield 'event', trigger.name, trigger.at_ns, trigger.at_ns, text

    # -- a moment --------------------------------------------------------------------------------------------------

    def moment(self, robot: str, at_ns: int, by: str = BY_STAMP) -> tuple[dict[str, Any], bytes]:
        """The newest message of each topic at or before a moment, as items, each after a uint32 with its length.

        ``by`` is the time that decides, and that ages refer to. The head has ``shown``: [topic, kind, ms before the moment,
        source].
        Raises DataLoggerError.
        """
        walked = self._source.between(robot, at_ns - PATH_NS, at_ns + 1, by)
        near = [one for one in walked if one.begin_ns >= at_ns - MAX_BATCH_NS]
        late = _offsets(near) if by == BY_STAMP else [0]
        bag_files = {bag: files for late_ns in late for bag, files in
                     self._source.bag_files(robot, at_ns + late_ns - PATH_NS, at_ns + late_ns + 1, by).items()}  # fmt: skip
        shown = self._object_items(near, at_ns, by)
        for item, where in self._bag_items(list(bag_files.values()), at_ns, by, late):
            known = shown.get(item.topic)
            if known is None:
                shown[item.topic] = item, where
            elif (item.head or {})['at'] > (known[0].head or {})['at'] + 1:
                shown[item.topic] = _after(known[0], item), where
        poses = [((one.begin_ns + one.end_ns) // 2, one.pose) for one in walked if one.pose]
        items = [*(item for item, _ in shown.values()), *_track(poses)]
        covering = [bag for bag, files in bag_files.items()
                    if any(_slices(files, self._contents.manifest(files), at_ns + late_ns) for late_ns in late)]  # fmt: skip
        last = max((one for one in near if one.mission_id), key=lambda one: one.begin_ns, default=None)
        head = {
            'at': at_ns / 1e6, 'by': by, 'mission': _text(last.mission_id) if last is not None else '',
            'commands': commands(robot, at_ns - AROUND_NS, at_ns + AROUND_NS, covering, by, (min(late), max(late))),
            'shown': [[_text(item.topic), item.kind, round(at_ns / 1e6 - (item.head or {})['at'], 1), _text(where, 300)]
                      for item, where in shown.values()],
        }  # fmt: skip
        self._read_ahead(robot, at_ns, by, list(bag_files.values()), late)
        return head, b''.join(len(item.packed).to_bytes(4, 'little') + item.packed for item in items)

    def recent(self, robot: str, now_ns: int) -> tuple[dict[str, Any], bytes]:
        """The initial plots, path and plan of the live view, as items like those of a moment.

        Series of the last seconds; earlier ones only from the spool, and a few clouds. ``at`` is by the clock of this machine,
        as in live items. Raises DataLoggerError.
        """
        walked = self._source.between(robot, now_ns - PATH_NS, now_ns + 1, BY_RECEIVED)
        by_topic: dict[str, list[PastObject]] = {}
        for one in walked:
            if '/rosbags/' not in one.key and '/missions/' not in one.key and len(by_topic) < MAX_TOPICS:
                by_topic.setdefault(one.topic or one.sensor, []).append(one)
        offset_ms = time.monotonic() * 1e3 - time.time() * 1e3
        items: list[LiveItem] = []
        for topic, objects in by_topic.items():
            near = [one for one in objects if one.path or one.begin_ns >= now_ns - RECENT_NS]
            extension = decode.extension_of(objects[-1].key)
            with suppress(DataLoggerError, *_BROKEN):
                if extension == 'json' and (found := self._series(topic, near, now_ns, BY_RECEIVED, PATH_NS)) is not None:
                    items.append(_shifted(found[0], offset_ms))
                if extension in decode.CLOUDS:
                    for one in near[:: len(near) // MAX_PLAN_CLOUDS + 1]:
                        table = decode.cloud(self._contents.get(one))[::PLAN_EVERY, :3]
                        items.append(next(points_items(topic, one.begin_ns / 1e6 + offset_ms, table, 'odom', (FULL,))))
        items += _track([((one.begin_ns + one.end_ns) // 2, one.pose) for one in walked if one.pose])
        return {'at': now_ns / 1e6}, b''.join(len(item.packed).to_bytes(4, 'little') + item.packed for item in items)

    def _read_ahead(self, robot: str, at_ns: int, by: str, bags: Sequence[Sequence[PastObject]], late: Sequence[int]) -> None:
        """Read the next contents while the page shows this moment, if it plays or is scrubbed forward."""
        last_robot, last_ns, last_by = self._shown
        self._shown = robot, at_ns, by
        is_next = (robot, by) == (last_robot, last_by) and 0 < at_ns - last_ns <= AHEAD_NS
        if not is_next or (self._ahead is not None and not self._ahead.done()):
            return
        objects = [one for one in self._source.between(robot, at_ns + 1, at_ns + AHEAD_NS, by) if one.sensor != BAG_SENSOR]

        def read() -> None:
            for one in objects[:MAX_TOPICS]:
                with suppress(DataLoggerError, *_BROKEN):
                    self._contents.get(one)
            for files in bags:
                for one in _slices(files, self._contents.manifest(files), at_ns + late[0] + AHEAD_NS, AHEAD_NS):
                    with suppress(DataLoggerError, *_BROKEN):
                        source, index = self._index(one)
                        if index is not None:
                            begin_ns = at_ns + late[0]
                            deque(self._blocks.messages(one.key, source, index, begin_ns, begin_ns + AHEAD_NS, 0), maxlen=0)

        self._ahead = self._pool.submit(read)

    def _object_items(self, near: Sequence[PastObject], at_ns: int, by: str) -> dict[str, tuple[LiveItem, str]]:
        chosen: dict[str, list[PastObject]] = {}
        for one in near:
            if '/rosbags/' not in one.key and '/missions/' not in one.key:
                topic = one.topic or one.sensor
                if topic in chosen or len(chosen) < MAX_TOPICS:
                    chosen.setdefault(topic, []).append(one)
        found = self._pool.map(lambda pair: self._topic_item(pair[0], pair[1], at_ns, by), chosen.items())
        return {item[0].topic: item for item in found if item is not None}

    def _topic_item(self, topic: str, objects: Sequence[PastObject], at_ns: int, by: str) -> tuple[LiveItem, str] | None:
        """The newest readable message of a topic."""
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
            if item := _image_item(topic, extension, body, stamp_ns / 1e6):
                return item, _where(last)
        return None

    def _series(self, topic: str, objects: Sequence[PastObject], at_ns: int, by: str,
                before_ns: int = SERIES_NS) -> tuple[LiveItem, str] | None:  # fmt: skip
        if not objects or (objects[-1].type and objects[-1].type not in KINDS):
            return None
        rows: list[tuple[float, Mapping[str, float]]] = []
        name = ''
        for one in objects[-MAX_TOPICS:]:
            type_name, samples = _samples(self._contents.get(one))
            name = one.type or type_name
            kind = KINDS.get(name)
            if kind is None or kind.values is None:
                return None
            times = _message_times(one, [sample['stamp_ns'] for sample in samples], by)
            dated = [*zip(times, samples, strict=True)][-MAX_MESSAGES:]
            rows += [
                (time_ns / 1e6, _checked(kind.values(_message(name, sample))))
                for time_ns, sample in dated if at_ns - before_ns <= time_ns <= at_ns
            ]  # fmt: skip
        if not rows:
            return None
        rows.sort(key=lambda row: row[0])
        return table_item(topic, KINDS[name], rows[-MAX_MESSAGES:]), _where(objects[-1])

    # -- bags ------------------------------------------------------------------------------------------------------

    def _bag_items(self, bag_files: Sequence[Sequence[PastObject]], at_ns: int, by: str,
                 late: Sequence[int]) -> list[tuple[LiveItem, str]]:  # fmt: skip
        """Messages of a moment. Bags are sorted by arrival, which is later than the stamp by these offsets."""
        found: list[tuple[LiveItem, str]] = []
        for files in bag_files:
            manifest = self._contents.manifest(files)
            slices = {one.key: one for late_ns in late for one in _slices(files, manifest, at_ns + late_ns)}
            for one in slices.values():
                with suppress(DataLoggerError, *_BROKEN):
                    found += self._slice_items(one, at_ns, by, late)
        return found

    def _slice_items(self, one: PastObject, at_ns: int, by: str, late: Sequence[int]) -> list[tuple[LiveItem, str]]:
        source, index = self._index(one)
        if index is None:
            return []
        came: dict[tuple[str, str], dict[int, bytes]] = {}
        waiting, read = list(late), set[int]()
        while waiting:
            late_ns = waiting.pop(0)
            read.add(late_ns)
            slack_ns = SAME_NS if by == BY_STAMP else 0  # offsets that differ by less are equal
            until_ns = at_ns + late_ns + slack_ns + 1
            for message in self._blocks.messages(
                one.key, source, index, until_ns - IN_BAG_NS - 2 * slack_ns, until_ns, SERIES_NS
            ):
                is_by_stamp, offset_ns = by == BY_STAMP, message.log_ns - message.publish_ns
                if is_by_stamp and len(read) + len(waiting) < MAX_OFFSETS and _is_new(offset_ns, (*read, *waiting)):
                    waiting.append(offset_ns)
                message_ns = message.publish_ns if is_by_stamp else message.log_ns
                name = message.channel.topic, message.channel.type
                least_ns = at_ns - (IN_BAG_NS if KINDS[name[1]].is_bulk else SERIES_NS)
                if least_ns <= message_ns <= at_ns and (name in came or len(came) < MAX_TOPICS):
                    of = came.setdefault(name, {})
                    of[message_ns] = message.cdr
                    if KINDS[name[1]].is_bulk or len(of) > MAX_MESSAGES:
                        for oldest in sorted(of)[:-1]:
                            del of[oldest]
        found: list[tuple[LiveItem, str]] = []
        for (topic, type_name), messages in came.items():
            with suppress(Rejected, *_BROKEN):
                ordered = [(message_ns / 1e6, messages[message_ns]) for message_ns in sorted(messages)]
                found.append((self._message_item(topic, type_name, ordered), _where(one)))
        return found

    def _message_item(self, topic: str, type_name: str, messages: Sequence[tuple[float, bytes]]) -> LiveItem:
        kind, (at_ms, cdr) = KINDS[type_name], messages[-1]
        if kind.name == _CLOUD:
            return next(clouds(topic, self._types, at_ms, cdr, (FULL,)))
        if kind.name == _CAMERA:
            return next(frames(topic, type_name, self._types, at_ms, cdr, (FULL,)))
        return series(topic, kind, type_name, self._types, messages)

    def _read_index(self, one: PastObject) -> tuple[Ranged, McapIndex | None]:
        """A file without a complete summary, which the node does not write, is skipped."""
        source = self._contents.ranged(one)
        return source, read_summary(source)


class BagBlocks:
    """Messages of bags, cached in blocks of time: consecutive moments only read new blocks. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._blocks: OrderedDict[tuple[str, int], list[RecordedMessage]] = OrderedDict()
        self._size = 0

    def messages(
        self, key: str, source: Ranged, index: McapIndex, begin_ns: int, end_ns: int, before_ns: int
    ) -> Iterator[RecordedMessage]:
        """Messages of a time range, and of ``before_ns`` before its end if cached. Raises BagDamaged, StoreError."""
        first, last = begin_ns // BAG_BLOCK_NS, (end_ns - 1) // BAG_BLOCK_NS
        with self._lock:
            lacking = [number for number in range(first, last + 1) if (key, number) not in self._blocks]
        for low, high in consecutive(lacking):
            self._read(key, source, index, low, high)
        with self._lock:
            earlier = first
            while (key, earlier - 1) in self._blocks and earlier * BAG_BLOCK_NS > end_ns - before_ns:
                earlier -= 1
            blocks = [self._blocks[key, number] for number in range(earlier, last + 1) if (key, number) in self._blocks]
        for block in blocks:
            yield from (message for message in block if message.log_ns < end_ns)

    def _read(self, key: str, source: Ranged, index: McapIndex, low: int, high: int) -> None:
        found: dict[int, list[RecordedMessage]] = {number: [] for number in range(low, high + 1)}
        wanted = MessageFilter(low * BAG_BLOCK_NS, (high + 1) * BAG_BLOCK_NS, lambda channel: channel.type in KINDS)
        for message in read_messages(source, index, wanted):
            found[message.log_ns // BAG_BLOCK_NS].append(message)
        with self._lock:
            for number, messages in found.items():
                self._size += _size(messages) - _size(self._blocks.pop((key, number), ()))
                self._blocks[key, number] = messages
            while self._size > MAX_BAG_BYTES and len(self._blocks) > len(found):
                self._size -= _size(self._blocks.popitem(last=False)[1])


def _size(messages: Sequence[RecordedMessage]) -> int:
    return sum(len(message.cdr) + MESSAGE_BYTES for message in messages)


class PullRefused(DataLoggerError):
    """The data cannot be requested."""

    DEFAULT_REMEDY = 'choose another time or sensor'


class LabelRefused(DataLoggerError):
    """An invalid label."""

    DEFAULT_REMEDY = 'a label is a text on one line, for a time that ends after it begins'


class PastLabels:
    """The labels in the store, and new ones. They are read in parallel: an unreachable store delays nothing."""

    def __init__(self, pool: ThreadPoolExecutor) -> None:
        self._pool = pool
        self._reading: dict[str, tuple[float, Future[list[_Mark]]]] = {}
        self._known: dict[str, list[_Mark]] = {}

    def marks(self, robot: str) -> tuple[list[_Mark], str]:
        """The labels as last read, and why they are unknown or outdated."""
        if find_spec('pyarrow') is None:
            return [], ''
        now_s = time.monotonic()
        since_s, reading = self._reading.get(robot, (-FRESH_S, None))
        if reading is None or (reading.done() and now_s - since_s > FRESH_S):
            reading = self._pool.submit(_read_labels, robot)
            self._reading[robot] = now_s, reading
        try:
            self._known[robot] = reading.result(LABELS_S)
        except NotYet:
            return self._known.get(robot, []), READING_LABELS
        except (DataLoggerError, *_BROKEN) as error:
            return self._known.get(robot, []), f'the labels in the store cannot be read: {error}'
        return self._known[robot], ''

    def add(self, robot: str, request: Mapping[str, Any]) -> str:
        """Returns its id. Raises LakeError, SettingError, StoreError."""
        if find_spec('pyarrow') is None:
            raise LakeError('labels need pyarrow', remedy='install the extra lake')
        from shadowhound_data_logger.lake import labels  # noqa: PLC0415 - the extra lake

        label, note, by = (str(request[name]) for name in ('label', 'note', 'by'))
        since_ns, until_ns = (int(request[name]) * 1_000_000 for name in ('from', 'to'))
        try:
            one = labels.Label(robot=robot, label=label, since_ns=since_ns, until_ns=until_ns, note=note).checked()
        except SettingError as error:
            raise LabelRefused(str(error)) from error
        with closing(open_store(store_settings(os.environ, home(os.environ)), UploadSettings())) as store:
            labels.write(store, robot, [one], by=by)
        self._reading.pop(robot, None)
        return one.id


def _read_labels(robot: str) -> list[_Mark]:
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
"""Kind, name, start and end in ns, text."""
_BROKEN: Final = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError, MemoryError, OSError)
"""Errors of content that does not match its name."""


def commands(robot: str, begin_ns: int, end_ns: int, bags: Sequence[str], by: str = BY_STAMP,  # noqa: PLR0913 - parts of commands
             late_ns: tuple[int, int] = (0, 0), missions: Sequence[str] = (), *,
             is_kept: bool = False) -> list[list[str]]:  # fmt: skip
    """[what, command line] for this time range, to paste into a shell: names from a store are quoted.

    Bags are cut by arrival, which is later than the stamps by ``late_ns`` (minimum, maximum).
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
    exports = [
        ['export', f'shadowhound-data export lerobot {_dataset(mission)} {of} --mission {shlex.quote(mission)}']
        for mission in [mission for mission in dict.fromkeys(missions) if _is_readable(mission)][:MAX_CUTS]
    ]
    if by == BY_RECEIVED:
        return [['query', f'shadowhound-data query {span} --by {by}'], *cuts]
    pulls = [['pull', f'shadowhound-data pull {span}']] if is_kept else []
    fetch = ['fetch', f'shadowhound-data fetch {span} --to data']
    return [['query', f'shadowhound-data query {span}'], fetch, *cuts, *exports, *pulls]


def _is_readable(name: str) -> bool:
    """Whether an operator can check it in a command line: on one line, and not truncated."""
    return bool(name) and len(name) <= MAX_TEXT and visible(name) == name


def _dataset(mission: str) -> str:
    """A name for the dataset of a mission."""
    name = re.sub(r'[^A-Za-z0-9_]+', '_', mission).strip('_')[:MAX_DATASET]
    return mission if is_name(mission) else name or 'mission'


def _is_new(offset_ns: int, known: Iterable[int]) -> bool:
    return all(abs(offset_ns - each) > SAME_NS // 2 for each in known)


def _offsets(objects: Sequence[PastObject]) -> list[int]:
    """Distinct offsets from stamp to arrival of some objects: 0, and those that differ by more than a second."""
    found = [0]
    for one in objects:
        if len(found) < MAX_OFFSETS and _is_new(one.late_ns, found) and abs(one.late_ns) > SAME_NS:
            found.append(one.late_ns)
    return found


def _kept_times(row: Mapping[str, Any], by: str) -> tuple[int, int]:
    """First and last time of a kept object."""
    start_ns, end_ns = row['t_start_ns'], row['t_end_ns'] or row['t_start_ns']
    if by == BY_RECEIVED and (received_ns := row['received_start_ns']) is not None:
        return received_ns, row['received_end_ns'] or received_ns
    return start_ns, end_ns


def _clock(request: Mapping[str, Any]) -> str:
    """Raises ValueError."""
    if (by := request.get('by', BY_STAMP)) not in CLOCKS:
        raise ValueError(f'by is {" or ".join(CLOCKS)}')
    return str(by)


def _times(request: Mapping[str, Any]) -> tuple[int, int]:
    """``from`` and ``to`` in ns. Raises ValueError."""
    begin_ns, end_ns = int(request['from']) * 1_000_000, int(request['to']) * 1_000_000
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


def _slices(files: Sequence[PastObject], manifest: Manifest | None, at_ns: int, before_ns: int = IN_BAG_NS) -> list[PastObject]:
    """The files of a bag that may have messages of a moment, or of the time before it."""
    spans = {} if manifest is None else {one.file: (one.t_start_ns, one.t_end_ns) for one in manifest.slices}
    found = []
    for one in files:
        begin_ns, end_ns = spans.get(one.key.rpartition('/')[2], (one.begin_ns, one.end_ns))
        if one.key.endswith('.mcap') and begin_ns <= at_ns and end_ns >= at_ns - before_ns:
            found.append(one)
    return found[:4] if before_ns == IN_BAG_NS else found


def _joined(runs: Sequence[Run], grain_ns: int) -> list[tuple[str, int, int]]:
    """(topic, from, to) of consecutive runs, merged."""
    found: list[tuple[str, int, int]] = []
    for name, begin_ns, end_ns, *_ in runs:
        last = found[-1] if found else ('', 0, 0)
        if last[0] == name and begin_ns - last[2] <= grain_ns:
            found[-1] = name, last[1], max(last[2], end_ns)
        else:
            found.append((name, begin_ns, end_ns))
    return found


def _row(name: str, from_ns: int, to_ns: int, begin_ns: int, end_ns: int) -> list[Any]:
    """A row for the page, clipped to the visible time."""
    return [_text(name), round(max(from_ns, begin_ns) / 1e6, 1), round(min(to_ns, end_ns) / 1e6, 1)]


def _deliveries(runs: Sequence[Run], grain_ns: int, now_ns: int) -> Iterator[tuple[int, int, int | None]]:
    """(from, to, delivered) of times whose objects left the spool late; None if some still wait."""
    steps: dict[int, list[Any]] = {}
    for run in runs:
        step = steps.setdefault(run.begin_ns // grain_ns, [run.begin_ns, run.end_ns, 0, False])
        step[:] = min(step[0], run.begin_ns), max(step[1], run.end_ns), max(step[2], run.settled_ns or 0), step[3] or run.waits
    last: list[Any] | None = None
    for _, (begin_ns, end_ns, settled_ns, waits) in sorted(steps.items()):
        is_late = (now_ns if waits else settled_ns) - end_ns > LATE_NS
        if last is not None and (not is_late or last[3] != waits):
            yield last[0], last[1], None if last[3] else last[2]
            last = None
        if is_late:
            last = last or [begin_ns, end_ns, settled_ns, waits]
            last[1:3] = max(last[1], end_ns), max(last[2], settled_ns)
    if last is not None:
        yield last[0], last[1], None if last[3] else last[2]


def _shifted(item: LiveItem, offset_ms: float) -> LiveItem:
    """A series with its times converted to another clock."""
    head = item.head or {}
    times = np.frombuffer(item.body, '<f8', head['rows']) + offset_ms
    return LiveItem(item.topic, item.kind, head={**head, 'at': round(head['at'] + offset_ms, 1)},
                    body=times.tobytes() + item.body[8 * head['rows'] :])  # fmt: skip


def _after(before: LiveItem, item: LiveItem) -> LiveItem:
    """A series of a bag, extended with earlier rows from objects: a plot keeps its range."""
    head, old = item.head or {}, before.head or {}
    if 'rows' not in head or old.get('names') != head.get('names'):
        return item
    rows, count, width = head['rows'], old['rows'], len(head['names'])
    first_ms = float(np.frombuffer(item.body, '<f8', rows)[0]) if rows else INFINITE_MS
    times = np.frombuffer(before.body, '<f8', count)
    left = int(np.searchsorted(times, first_ms))
    body = times[:left].tobytes() + item.body[: 8 * rows] + before.body[8 * count :][: 4 * width * left] + item.body[8 * rows :]
    return LiveItem(item.topic, item.kind, head={**head, 'rows': rows + left}, body=body)


def _track(poses: Sequence[tuple[int, tuple[float, float, float]]]) -> Iterator[LiveItem]:
    """The robot's path, from poses and their times (the middle of a batch)."""
    ordered = sorted(poses, key=lambda each: each[0])
    if not ordered:
        return
    places = np.array([pose for _, pose in ordered[:: len(ordered) // MAX_MESSAGES + 1]], '<f4')
    yield LiveItem('', 'path', head={'points': len(places)}, body=places.tobytes())


def _image_item(topic: str, extension: str, body: bytes, at_ms: float) -> LiveItem | None:
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
    """The type named in a document, and its messages."""
    found = decode.records(body)
    type_name = json.loads(body).get('type')
    return type_name if isinstance(type_name, str) else '', found


def _message_times(one: PastObject, stamps_ns: Sequence[int], by: str) -> list[int]:
    """The times of an object's messages."""
    times = np.array(stamps_ns, np.int64) + one.offset_ns
    return [int(each) for each in (decode.arrivals(times, one.begin_ns, one.end_ns) if by == BY_RECEIVED else times)]


def _message(type_name: str, sample: Mapping[str, Any]) -> Any:
    """A sample as the original message, including the short document of odometry (docs/formats.md)."""
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
    """Raises ValueError for invalid names: those of joints are in the message."""
    if len(values) > MAX_COLUMNS or not all(isinstance(name, str) and len(name) <= MAX_TEXT for name in values):
        raise ValueError('too many values, or invalid names')
    return {name: float(value) for name, value in values.items()}


def _where(one: PastObject) -> str:
    is_here = one.path != '' and os.path.isfile(one.path)  # noqa: PTH113 - never raises
    return f'{"the spool" if is_here else "the store"}: {one.bucket}/{one.key}'


def _text(text: str, most: int = MAX_TEXT) -> str:
    return visible(text[:most].encode(errors='replace').decode())


def main() -> None:
    """Serve until the input ends. The arguments: the spool's folder and the robot; without them it reads the store's past."""
    resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY, MAX_MEMORY))
    with suppress(OSError):
        os.nice(10)  # recording has priority
    out = os.fdopen(os.dup(1), 'wb')
    os.dup2(2, 1)  # print statements of libraries must not answer
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
        encoded_head = json.dumps(head, separators=(',', ':')).encode()
        out.write(len(encoded_head).to_bytes(4, 'little') + len(body).to_bytes(4, 'little') + encoded_head + body)
        out.flush()


if __name__ == '__main__':
    main()
