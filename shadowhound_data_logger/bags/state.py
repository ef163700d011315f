"""What is known of a bag until it is whole in the spool: rows of the index, and the same in a metadata record of each slice.

    shadowhound_recording: recording=patrol_20251018_120000 owner=thor number=3 channels=[...] slices=[...] missing=[...]
                           said={"bag": "patrol_20251018_120000", "robot": "thor", "mission": {...}, ...} left_out=0

``recording`` is the name of the bag's folder. ``said``, ``channels`` and the rows of ``slices`` and ``missing`` (those of before
this slice) are as in ``model.RecordingRows``, in JSON. A record further down in a slice has ``said`` alone: more was known then.
All of it takes a hundredth of a slice, so the oldest rows are left out where there are too many: ``left_out`` says how many.

Slices leave the folder as soon as they are spooled; manifest and metadata are made from what is known here, after a death as
well. The slices' own records are read where the index is lost, and what makes no sense anywhere is left out, whatever it is: a
slice that is in the folder still is looked into then.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.bags.json_object import MOST, JsonObject
from shadowhound_data_logger.bags.manifest import (
    ClockOf,
    EventOf,
    Missing,
    MissionOf,
    read_clock,
    read_event,
    read_missing,
    read_mission,
)
from shadowhound_data_logger.bags.naming import slice_file, slice_number
from shadowhound_data_logger.core.durable_files import sync
from shadowhound_data_logger.core.errors import BagDamaged, NameRefused
from shadowhound_data_logger.core.keys import check_key
from shadowhound_data_logger.core.model import MissingRow, RecordingRows, SliceRow
from shadowhound_data_logger.core.untrusted import from_json
from shadowhound_data_logger.formats.mcap.slice_info import Channel, SliceInfo, count_by_channel
from shadowhound_data_logger.formats.mcap.writer import OPEN_SUFFIX
from shadowhound_data_logger.spool.accounts import BAG, EVENT

log = logging.getLogger(__name__)

RECORD: Final = 'shadowhound_recording'
"""Name of the metadata record."""
RECORD_SHARE: Final = 100
"""Such a record takes a hundredth of the slice before at most ..."""
MIN_ROWS_BYTES: Final = 4096
"""... but for this much of rows: some twenty slices."""
ENDED: Final = '.ended'
"""Ends the name of a slice without messages that a bag which ended keeps until it is whole in the spool, for its record."""
LEFT_OUT: Final = 'the index was lost: {} slices or losses of before are not listed here'
"""Of a bag that was longer than its slices can tell."""


@dataclass(slots=True)
class BagState:
    """What is known of a bag on this disk that is not whole yet.

    Life: ``begin`` one, or read it by one of the ``of_...``. One thread at a time.

    What changes it returns what the index has to be told.
    """

    folder: Path
    """Its files have its name, whatever the bag's is."""
    bag: str
    robot: str
    mission: MissionOf | None = None
    slices: dict[str, SliceInfo] = field(default_factory=dict)
    """Of closed slices, by file; their channels are without definitions. They may have left the folder."""
    missing: list[Missing] = field(default_factory=list)
    ended: bool = False
    event: EventOf | None = None
    """What it was made for; None for a recording."""
    clock: ClockOf | None = None
    """By which its times are, where it was not set when the bag began."""
    is_named: bool = True
    """Whether its name is for good. Before that nothing of it may leave."""
    is_ending: bool = False
    """Whether what makes it whole is on its way into the spool."""
    _channels: dict[tuple[str, str, bool], Channel] = field(default_factory=dict)

    @classmethod
    def begin(cls, folder: Path, robot: str, mission: MissionOf | None, event: EventOf | None = None,
              clock: ClockOf | None = None) -> BagState:  # fmt: skip
        """Make the folder of a new bag. Raises OSError."""
        folder.mkdir(mode=0o700, parents=True)
        try:
            sync(folder.parent)
        except OSError:
            folder.rmdir()
            raise
        return cls(folder, folder.name, robot, mission, event=event, clock=clock, is_named=clock is None)

    @classmethod
    def of_rows(cls, folder: Path, robot: str, rows: RecordingRows) -> BagState:
        """As it was told to the index or to a slice. Raises BagDamaged for what makes no sense."""
        state = cls(folder, folder.name, robot)
        try:
            state._take(JsonObject(from_json(rows.said.encode()), RECORD, 'said'))
            channels = [_channel(one) for one in _list(from_json(rows.channels.encode()))]
            state._channels = {_kind(one): one for one in channels}
            for row in rows.slices:
                info = state._slice(row)
                state.slices[info.path.name] = info
            for one in rows.missing:
                state.missing.append(read_missing(JsonObject(one._asdict(), RECORD, 'missing')))
        except (ValueError, TypeError, AttributeError, NameRefused) as error:
            raise BagDamaged(f'what is known of bag {folder.name} makes no sense: {error}', path=str(folder)) from error
        return state

    @classmethod
    def of_record(cls, folder: Path, robot: str, said: Mapping[str, str]) -> BagState:
        """As a slice tells it (``metadata``). Raises BagDamaged, as above."""
        try:
            slices = tuple(SliceRow(*_list(row)) for row in _list(from_json(said['slices'].encode())))
            missing = tuple(MissingRow(*_list(row)) for row in _list(from_json(said['missing'].encode())))
            rows = RecordingRows(folder.name, said['said'], said['channels'], slices, missing)
            left_out = int(said['left_out'])
        except (LookupError, ValueError, TypeError) as error:
            raise BagDamaged(f'a slice of bag {folder.name} tells nothing of it: {error}', path=str(folder)) from error
        state = cls.of_rows(folder, robot, rows)
        if left_out > 0:
            state.missing.insert(0, Missing(slice_file(folder.name, 0), LEFT_OUT.format(left_out), None))
        return state

    @property
    def sink(self) -> str:
        """Before the names of the accounts in which its messages count."""
        return BAG if self.event is None else EVENT

    def final(self, file: str) -> str:
        """The name that a file of the folder has in the store."""
        return self.bag + file.removeprefix(self.folder.name) if file.startswith(self.folder.name) else file

    def rows(self, slices: Sequence[SliceInfo] = (), missing: int = 0) -> RecordingRows:
        """What is known of the bag itself, with these slices and so many of what was found missing last."""
        first = len(self.missing) - missing
        return RecordingRows(
            self.folder.name, self._said(), json.dumps([_fields(one) for one in self._channels.values()]),
            tuple(self._row(info) for info in slices),
            tuple(MissingRow(place, one.file, one.what, one.messages, one.topic, one.reason)
                  for place, one in enumerate(self.missing[first:], first)),
        )  # fmt: skip

    def all_rows(self) -> list[RecordingRows]:
        """All that is known, in place of what the index has."""
        return [self.whole(), self.rows(list(self.slices.values()), len(self.missing))]

    def whole(self) -> RecordingRows:
        """The spool has all of it."""
        return RecordingRows(self.folder.name, is_whole=True)

    def record(self, owner: str, number: int) -> dict[str, str]:
        """What the slice ``number`` says of the bag at its beginning (RECORD)."""
        rows = self.rows(list(self.slices.values()), len(self.missing))
        last = rows.slices[-1].bytes if rows.slices else 0
        room = max(MIN_ROWS_BYTES, last // RECORD_SHARE - len(rows.said) - len(rows.channels))
        missing = _newest(rows.missing, room // 4)
        slices = _newest(rows.slices, room - len(json.dumps(missing)))
        left_out = len(rows.slices) + len(rows.missing) - len(slices) - len(missing)
        return {
            'recording': self.folder.name, 'owner': owner, 'number': str(number), 'said': rows.said, 'channels': rows.channels,
            'slices': json.dumps(slices), 'missing': json.dumps(missing), 'left_out': str(left_out),
        }  # fmt: skip

    def news(self) -> dict[str, str]:
        """What a slice says as soon as more is known."""
        return {'said': self._said()}

    def add_slice(self, info: SliceInfo) -> RecordingRows:
        """A slice was closed."""
        channels = count_by_channel(
            (self._channels.setdefault(_kind(channel), replace(channel, definition='')), count)
            for channel, count in info.channels.items()
        )
        self.slices[info.path.name] = info = replace(info, channels=channels, damage=None)
        return self.rows([info])

    def add_missing(self, *missing: Missing) -> RecordingRows:
        """Something is lost."""
        self.missing.extend(missing)
        return self.rows(missing=len(missing))

    def set_name(self, bag: str, clock: ClockOf) -> RecordingRows:
        """The bag's name is known for good."""
        self.bag, self.clock, self.is_named = bag, clock, True
        return self.rows()

    def remove(self) -> None:
        """All is durable in the spool, which may be about to remove the slices it linked. Raises OSError."""
        for suffix in (OPEN_SUFFIX, ENDED):
            for path in self.folder.glob(f'*{suffix}'):
                path.unlink(missing_ok=True)
        for file in self.slices:
            (self.folder / file).unlink(missing_ok=True)
        with suppress(FileNotFoundError):
            self.folder.rmdir()

    def _said(self) -> str:
        mission, event, clock = (part and asdict(part) for part in (self.mission, self.event, self.clock))
        return json.dumps({'bag': self.bag, 'robot': self.robot, 'mission': mission, 'event': event, 'clock': clock,
                           'named': self.is_named, 'ended': self.ended})  # fmt: skip

    def _take(self, said: JsonObject) -> None:
        """The opposite of ``_said``."""
        mission, event, clock = said.object_or_none('mission'), said.object_or_none('event'), said.object_or_none('clock')
        bag = said.text('bag')
        check_key(slice_file(bag, 0))
        self.bag, self.ended, self.is_named = bag, said.flag('ended'), said.flag('named')
        self.mission, self.event = read_mission(mission) if mission else None, read_event(event) if event else None
        self.clock = read_clock(clock) if clock else None

    def _row(self, info: SliceInfo) -> SliceRow:
        counts = json.dumps([info.channels.get(one) for one in self._channels.values()])
        return SliceRow(slice_number(self.folder.name, info.path.name) or 0, info.bytes, info.sha256, info.t_start_ns,
                        info.t_end_ns, info.messages, counts)  # fmt: skip

    def _slice(self, row: SliceRow) -> SliceInfo:
        """The opposite of ``_row``. Raises ValueError."""
        found = _list(from_json(row.counts.encode()))
        numbers = [row.number, row.bytes, row.t_start_ns, row.t_end_ns, row.messages, *(one for one in found if one is not None)]
        if not isinstance(row.sha256, str) or not all(type(one) is int and 0 <= one < MOST for one in numbers):  # type: ignore[redundant-expr]
            raise ValueError(f'a row of a slice is {row!r:.200}')
        channels = {one: count for one, count in zip(self._channels.values(), found, strict=False) if count is not None}
        return SliceInfo(self.folder / slice_file(self.folder.name, row.number), row.bytes, row.sha256, row.t_start_ns,
                         row.t_end_ns, row.messages, channels)  # fmt: skip


def _kind(channel: Channel) -> tuple[str, str, bool]:
    """What a channel is known by."""
    return channel.topic, channel.type, channel.repeated


def _fields(channel: Channel) -> list[str | bool]:
    return [channel.topic, channel.type, channel.encoding, channel.type_hash, channel.qos, channel.repeated]


def _channel(fields: Any) -> Channel:
    topic, kind, encoding, type_hash, qos, repeated = _list(fields)
    if not all(isinstance(text, str) for text in (topic, kind, encoding, type_hash, qos)) or not isinstance(repeated, bool):
        raise TypeError(f'a channel is {fields!r:.200}')
    return Channel(topic, kind, encoding, '', type_hash, qos, repeated=repeated)


def _newest(rows: Sequence[Any], most_bytes: int) -> Sequence[Any]:
    """As many of the last rows as fit, in JSON."""
    for count, row in enumerate(reversed(rows)):
        most_bytes -= len(json.dumps(row)) + 2
        if most_bytes < 0:
            return rows[len(rows) - count :]
    return rows


def _list(found: Any) -> list[Any]:
    if not isinstance(found, list):
        raise TypeError(f'{found!r:.80} is no list')
    return found
