"""``manifest.json``: describes a complete bag. The recorder writes it once, at the end: a bag without one is still growing.

    {"version": 1, "bag": "patrol_20261121_120000", "robot": "thor", "state": "complete",
     "mission": {"type": "patrol", "mission_id": "...", "run_id": null}, "event": null, "clock": null,
     "missing": [{"file": "patrol_20261121_120000_3.mcap", "what": "...", "messages": null,
                 "topic": null, "reason": null}],
     "topics": [{"topic": "/imu", "type": "sensor_msgs/msg/Imu", "messages": 6000}],
     "slices": [{"file": "patrol_20261121_120000_0.mcap", "key": "thor/rosbags/...", "bytes": 1, "sha256": "...",
                 "messages": 1, "t_start_ns": 1, "t_end_ns": 1, "counts": {"/imu": 1}, "repeated": {}}]}

``mission`` is null for a bag without a mission, ``run_id`` if it was unknown. ``missing`` is empty if ``state`` is ``complete``;
its ``messages`` is null if the number is unknown, ``topic`` and ``reason`` if the loss is not of one topic. Unknown fields belong
to later versions and are ignored. Counts are those of the files, including the messages that a slice repeats.
``event`` describes the event that a bag was recorded for, with its triggers in order:

    {"name": "low_battery", "pre_s": 30.0, "held_s": 30.0, "post_s": 10.0,
     "triggers": [{"name": "low_battery", "by": "condition", "at_ns": 1, "detail": "low_battery: ...soc < 20: 19", "who": null},
                  {"name": "fall", "by": "page", "at_ns": 2, "detail": null, "who": "operator at 192.168.1.7"}]}

``clock`` is null if the clock of the machine was set. Otherwise all times of the bag are by the unset clock, and ``offset_ns``
must be added to get UTC (null if ``known`` is ``unset``: then the offset is unknown); ``wall_ns`` and ``boot_ns`` are the times
of that clock and of the boot clock when the bag started:

    {"known": "set_later", "boot_id": "...", "boot_ns": 12000000000, "wall_ns": 22000000000, "offset_ns": 1760788778000000000}
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

from shadowhound_data_logger.core.dataclass_json import as_plain, parse
from shadowhound_data_logger.core.errors import BagDamaged
from shadowhound_data_logger.core.untrusted import from_json, is_path
from shadowhound_data_logger.formats.mcap.slice_info import SliceInfo

VERSION: Final = 1
LIMIT: Final = 1 << 64
COMPLETE: Final = 'complete'
RECOVERED: Final = 'recovered'
"""The recording was interrupted: at least the messages that had not reached the disk are missing."""
GAPS: Final = 'gaps'
"""The recording ended normally, but some received messages are not in the bag."""
STATES: Final = frozenset({COMPLETE, GAPS, RECOVERED})
_SHA256: Final = re.compile('[0-9a-f]{64}')


@dataclass(frozen=True, slots=True)
class MissionOf:
    """The mission of a bag; ids are None until they are known."""

    type: str
    mission_id: str | None
    run_id: str | None


@dataclass(frozen=True, slots=True)
class TriggerOf:
    """What triggered an event.

    ``by`` is ``command``, ``service``, ``page``, ``log_event`` or ``condition``; ``at_ns`` is Unix nanoseconds.
    """

    name: str
    by: str
    at_ns: int
    detail: str | None
    who: str | None = None
    """The person who requested it, if the live page knows it."""


@dataclass(frozen=True, slots=True)
class EventOf:
    """The event of a bag; ``pre_s`` and ``post_s`` are the requested times before and after a trigger."""

    name: str
    pre_s: float
    held_s: float
    """How far before the first trigger the bag starts: less than ``pre_s`` if the ring was too small or too new."""
    post_s: float
    triggers: tuple[TriggerOf, ...]


@dataclass(frozen=True, slots=True)
class ClockOf:
    """The clock of a bag's times, if it was not set when the bag started."""

    known: str
    """``set_later`` or ``unset``, as in the metadata of objects."""
    boot_id: str
    boot_ns: int
    wall_ns: int
    offset_ns: int | None


@dataclass(frozen=True, slots=True)
class Missing:
    """A loss; ``file`` is the slice in or after which the messages are missing."""

    file: str
    what: str
    messages: int | None
    topic: str | None = None
    reason: str | None = None
    """Why the messages were dropped, as in the ledger."""


@dataclass(frozen=True, slots=True)
class RecordedTopic:
    """A recorded topic with one type; it may have no messages."""

    topic: str
    type: str
    """Empty for another recorder's channel without a schema."""
    messages: int


@dataclass(frozen=True, slots=True)
class SliceEntry:
    """A slice in the store; times as in SliceInfo."""

    file: str
    key: str
    bytes: int
    sha256: str
    messages: int
    t_start_ns: int
    t_end_ns: int
    counts: Mapping[str, int]
    repeated: Mapping[str, int]
    """The messages among ``counts`` that repeat latched messages of earlier slices, on separate channels."""

    @property
    def recorded(self) -> Mapping[str, int]:
        """``counts`` without the repeated messages, as in SliceInfo."""
        return {topic: count - self.repeated.get(topic, 0) for topic, count in self.counts.items()}

    @classmethod
    def of(cls, info: SliceInfo, key: str) -> SliceEntry:
        return cls(info.path.name, key, info.bytes, info.sha256, info.messages, info.t_start_ns, info.t_end_ns, info.counts,
                   info.repeated)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Manifest:
    """The description of a complete bag."""

    bag: str
    robot: str
    mission: MissionOf | None
    state: str
    missing: tuple[Missing, ...]
    topics: tuple[RecordedTopic, ...]
    slices: tuple[SliceEntry, ...]
    event: EventOf | None = None
    clock: ClockOf | None = None

    def to_json(self) -> bytes:
        """The content of the file."""
        document = {'version': VERSION, **asdict(self)}
        return json.dumps(document, ensure_ascii=False, indent=1).encode(errors='replace') + b'\n'

    @classmethod
    def from_json(cls, content: bytes, name: str = 'manifest.json') -> Manifest:
        """Raises BagDamaged, which names the file (``name``) and the first invalid field."""
        try:
            found = from_json(content)
            version = found.get('version') if isinstance(found, dict) else None
            if version != VERSION:
                raise BagDamaged(
                    f'{name}: version is {version!r:.80}; this program reads {VERSION}', remedy='update it', path=name
                )
            manifest = checked(parse(cls, found))
        except ValueError as error:
            raise BagDamaged(f'{name} is not a manifest: {error}', path=name) from error
        return manifest


def checked(manifest: Manifest) -> Manifest:
    """The manifest unchanged. Raises ValueError, with the path of the field, for a value that no manifest has."""
    if manifest.state not in STATES:
        raise ValueError(f'state is {manifest.state!r:.80} and must be one of {", ".join(sorted(STATES))}')
    for index, one in enumerate(manifest.slices):
        if not is_path(one.file):
            raise ValueError(f'slices[{index}].file is {one.file!r:.80} and must be the name of a file')
        if not _SHA256.fullmatch(one.sha256):
            raise ValueError(f'slices[{index}].sha256 is {one.sha256!r:.80} and must be a SHA-256 in hex')
    check_numbers(as_plain(manifest))
    return manifest


def check_numbers(value: Any, at: str = '') -> None:
    """Raises ValueError, with its path, for an integer that does not fit into uint64, as times in MCAP are."""
    if isinstance(value, dict):
        for name, part in value.items():
            check_numbers(part, f'{at}.{name}' if at else name)
    elif isinstance(value, list):
        for index, part in enumerate(value):
            check_numbers(part, f'{at}[{index}]')
    elif isinstance(value, int) and not 0 <= value < LIMIT:
        raise ValueError(f'{at} is {value} and must be from 0 to 2^64')


def topics_of(slices: Sequence[SliceInfo]) -> tuple[RecordedTopic, ...]:
    """The recorded topics, in the order of their first slices."""
    counts: dict[tuple[str, str], int] = {}
    for one in slices:
        for channel, count in one.channels.items():
            name = channel.topic, channel.type
            counts[name] = counts.get(name, 0) + count
    return tuple(RecordedTopic(topic, kind, count) for (topic, kind), count in counts.items())
