"""``manifest.json``: what a bag's writer says of the whole bag. Written once, when it ended: a bag without one still grows.

    {"version": 1, "bag": "patrol_20261121_120000", "robot": "thor", "state": "complete",
     "mission": {"type": "patrol", "mission_id": "...", "run_id": null}, "event": null,
     "missing": [{"file": "patrol_20261121_120000_3.mcap", "what": "...", "messages": null,
                 "topic": null, "reason": null}],
     "topics": [{"topic": "/imu", "type": "sensor_msgs/msg/Imu", "messages": 6000}],
     "slices": [{"file": "patrol_20261121_120000_0.mcap", "key": "thor/rosbags/...", "bytes": 1, "sha256": "...",
                 "messages": 1, "t_start_ns": 1, "t_end_ns": 1, "counts": {"/imu": 1}}]}

``mission`` is null for a bag of no mission, ``run_id`` where it was not known yet. ``missing`` is empty where ``state`` is
``complete``; its ``messages`` is null where nobody counted them, ``topic`` and ``reason`` where it is not of one topic. Unknown
fields are a later version's, and ignored.
``event`` is what made the bag of an event, in the order of the triggers:

    {"name": "low_battery", "pre_s": 30.0, "held_s": 30.0, "post_s": 10.0,
     "triggers": [{"name": "low_battery", "by": "condition", "at_ns": 1, "detail": "low_battery: ...soc < 20: 19"}]}
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

from shadowhound_data_logger.bags.slice_info import SliceInfo
from shadowhound_data_logger.errors import BagDamaged

VERSION: Final = 1
COMPLETE: Final = 'complete'
RECOVERED: Final = 'recovered'
"""The recording did not end by itself: what had not reached the disk is missing, at least."""
GAPS: Final = 'gaps'
"""It did end by itself, but not all that came is in the bag."""
STATES: Final = frozenset({COMPLETE, GAPS, RECOVERED})
_SHA256: Final = re.compile('[0-9a-f]{64}')


@dataclass(frozen=True, slots=True)
class MissionOf:
    """The mission that a bag was recorded in; ids are None until they are known."""

    type: str
    mission_id: str | None
    run_id: str | None


@dataclass(frozen=True, slots=True)
class TriggerOf:
    """What asked for an event: ``by`` is ``service``, ``log_event`` or ``condition``; ``at_ns`` is Unix nanoseconds."""

    name: str
    by: str
    at_ns: int
    detail: str | None


@dataclass(frozen=True, slots=True)
class EventOf:
    """What an event's bag was made for; ``pre_s`` and ``post_s`` are what was asked of before and after a trigger."""

    name: str
    pre_s: float
    held_s: float
    """How far back from the first trigger the ring went: less than ``pre_s`` where its bytes or its time did not suffice."""
    post_s: float
    triggers: tuple[TriggerOf, ...]


@dataclass(frozen=True, slots=True)
class Missing:
    """Something that should have been in the bag; ``file`` is the slice in or after which it is missing."""

    file: str
    what: str
    messages: int | None
    topic: str | None = None
    reason: str | None = None
    """Why the messages were dropped, in the words of the ledger."""


@dataclass(frozen=True, slots=True)
class RecordedTopic:
    """A topic that was recorded, also one without messages."""

    topic: str
    type: str
    messages: int


@dataclass(frozen=True, slots=True)
class SliceEntry:
    """A slice as it lies in the store; times as in SliceInfo."""

    file: str
    key: str
    bytes: int
    sha256: str
    messages: int
    t_start_ns: int
    t_end_ns: int
    counts: Mapping[str, int]

    @classmethod
    def of(cls, info: SliceInfo, key: str) -> SliceEntry:
        return cls(info.path.name, key, info.bytes, info.sha256, info.messages, info.t_start_ns, info.t_end_ns, dict(info.counts))


@dataclass(frozen=True, slots=True)
class Manifest:
    """A whole bag."""

    bag: str
    robot: str
    mission: MissionOf | None
    state: str
    missing: tuple[Missing, ...]
    topics: tuple[RecordedTopic, ...]
    slices: tuple[SliceEntry, ...]
    event: EventOf | None = None

    def to_json(self) -> bytes:
        """The file's content."""
        said = {'version': VERSION, **asdict(self)}
        return json.dumps(said, ensure_ascii=False, indent=1).encode(errors='replace') + b'\n'

    @classmethod
    def from_json(cls, content: bytes, name: str = 'manifest.json') -> Manifest:
        """Raises BagDamaged, naming the first field that is not as it must be; ``name`` is the file's, for that."""
        try:
            found = json.loads(content)
        except (ValueError, RecursionError) as error:
            raise BagDamaged(f'{name} is no JSON: {error}', path=name) from error
        top = _Object(found, name, '')
        if (version := top.count('version')) != VERSION:
            raise BagDamaged(f'{name} has version {version}; this program reads {VERSION}', remedy='update it', path=name)
        state = top.text('state')
        if state not in STATES:
            raise top.wrong('state', f'one of {", ".join(sorted(STATES))}')
        mission, event = top.object_or_none('mission'), top.object_or_none('event')
        return cls(
            top.text('bag'), top.text('robot'), _mission(mission) if mission else None, state,
            tuple(map(_missing, top.objects('missing'))),
            tuple(RecordedTopic(one.text('topic'), one.text('type'), one.count('messages')) for one in top.objects('topics')),
            tuple(map(_slice, top.objects('slices'))), _event(event) if event else None,
        )  # fmt: skip


def topics_of(slices: Sequence[SliceInfo]) -> tuple[RecordedTopic, ...]:
    """What was recorded, in the order in which it first appeared."""
    types: dict[str, str] = {}
    counts: dict[str, int] = {}
    for one in slices:
        for channel in one.channels:
            types.setdefault(channel.topic, channel.type)
        for topic, count in one.counts.items():
            counts[topic] = counts.get(topic, 0) + count
    return tuple(RecordedTopic(topic, kind, counts.get(topic, 0)) for topic, kind in types.items())


class _Object:
    """A JSON object of a manifest, read field by field; what is not as it must be raises BagDamaged with its place."""

    def __init__(self, value: object, file: str, place: str) -> None:
        self._file, self._place = file, place
        if not isinstance(value, dict):
            raise BagDamaged(f'{file}: {place or "it"} is no JSON object', path=file)
        self._fields: dict[str, Any] = value

    def text(self, name: str) -> str:
        found = self._fields.get(name)
        if not isinstance(found, str) or not found:
            raise self.wrong(name, 'a text')
        return found

    def text_or_none(self, name: str) -> str | None:
        return None if self._fields.get(name) is None else self.text(name)

    def count(self, name: str) -> int:
        found = self._fields.get(name)
        if type(found) is not int or found < 0:
            raise self.wrong(name, 'a whole number, not negative')
        return found

    def count_or_none(self, name: str) -> int | None:
        return None if self._fields.get(name) is None else self.count(name)

    def number(self, name: str) -> float:
        found = self._fields.get(name)
        if not isinstance(found, (int, float)) or isinstance(found, bool):
            raise self.wrong(name, 'a number')
        return float(found)

    def counts(self, name: str) -> dict[str, int]:
        inner = _Object(self._fields.get(name), self._file, self._at(name))
        return {key: inner.count(key) for key in inner._fields}

    def object_or_none(self, name: str) -> _Object | None:
        found = self._fields.get(name)
        return None if found is None else _Object(found, self._file, self._at(name))

    def objects(self, name: str) -> list[_Object]:
        found = self._fields.get(name)
        if not isinstance(found, list):
            raise self.wrong(name, 'a list')
        return [_Object(one, self._file, f'{self._at(name)}[{place}]') for place, one in enumerate(found)]

    def wrong(self, name: str, allowed: str) -> BagDamaged:
        found = json.dumps(self._fields[name])[:80] if name in self._fields else 'nothing'
        return BagDamaged(
            f'{self._file}: {self._at(name)} is {found} and must be {allowed}', path=self._file, field=self._at(name)
        )

    def _at(self, name: str) -> str:
        return f'{self._place}.{name}' if self._place else name


def _missing(one: _Object) -> Missing:
    return Missing(one.text('file'), one.text('what'), one.count_or_none('messages'), one.text_or_none('topic'),
                   one.text_or_none('reason'))  # fmt: skip


def _mission(one: _Object) -> MissionOf:
    return MissionOf(one.text('type'), one.text_or_none('mission_id'), one.text_or_none('run_id'))


def _event(one: _Object) -> EventOf:
    triggers = tuple(
        TriggerOf(each.text('name'), each.text('by'), each.count('at_ns'), each.text_or_none('detail'))
        for each in one.objects('triggers')
    )
    return EventOf(one.text('name'), one.number('pre_s'), one.number('held_s'), one.number('post_s'), triggers)


def _slice(one: _Object) -> SliceEntry:
    sha256 = one.text('sha256')
    if not _SHA256.fullmatch(sha256):
        raise one.wrong('sha256', 'a SHA-256 in hex')
    return SliceEntry(
        one.text('file'), one.text('key'), one.count('bytes'), sha256, one.count('messages'), one.count('t_start_ns'),
        one.count('t_end_ns'), one.counts('counts'),
    )  # fmt: skip
