"""The state of a bag until it is complete in the spool: rows of the index, and a copy in a metadata record of each slice.

    shadowhound_recording: recording=patrol_20251018_120000 owner=thor number=3 channels=[...] slices=[...] missing=[...]
                           facts={"bag": "patrol_20251018_120000", "robot": "thor", "mission": {...}, ...} left_out=0

``recording`` is the name of the bag's folder. ``facts``, ``channels`` and the rows of ``slices`` and ``missing`` (before this
slice) are as in ``model.RecordingRows``, in JSON. A later record in a slice has only ``facts``, with newer information. A record
takes at most a hundredth of a slice, so the oldest rows are omitted if there are too many: ``left_out`` is their number.

Slices are removed from the folder as soon as they are spooled. Manifest and metadata are built from this state, also after a
crash. The records in the slices are read if the index is lost. Invalid records are ignored: slices that are still in the folder
are then read themselves.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.bags.manifest import ClockOf, EventOf, Missing, MissionOf, check_numbers
from shadowhound_data_logger.bags.naming import slice_file, slice_number
from shadowhound_data_logger.core.dataclass_json import parse
from shadowhound_data_logger.core.durable_files import sync
from shadowhound_data_logger.core.errors import BagDamaged, NameRefused
from shadowhound_data_logger.core.keys import check_key
from shadowhound_data_logger.core.model import MissingRow, RecordingRows, SliceRow
from shadowhound_data_logger.core.untrusted import from_json
from shadowhound_data_logger.formats.mcap.slice_info import Channel, SliceInfo, count_by_channel
from shadowhound_data_logger.formats.mcap.writer import OPEN_SUFFIX
from shadowhound_data_logger.spool.topic_account import BAG, EVENT

log = logging.getLogger(__name__)

RECORD: Final = 'shadowhound_recording'
"""Name of the metadata record."""
RECORD_SHARE: Final = 100
"""The record takes at most this fraction (1/100) of the previous slice, but rows may always take ``MIN_ROWS_BYTES``."""
MIN_ROWS_BYTES: Final = 4096
"""Enough for the rows of some twenty slices."""
ENDED: Final = '.ended'
"""Suffix of a slice without messages, which an ended bag keeps for its record until the bag is complete in the spool."""
LEFT_OUT: Final = 'the index was lost: {} earlier slices or losses are not listed here'
"""For a bag with more slices than the records in its slices can list."""


@dataclass(frozen=True, slots=True)
class _Description:
    """What is known about a bag as a whole."""

    bag: str
    robot: str
    mission: MissionOf | None
    event: EventOf | None
    clock: ClockOf | None
    named: bool
    ended: bool


@dataclass(slots=True)
class BagState:
    """The state of a bag on this disk that is not complete in the spool yet.

    Lifecycle: created by ``begin``, ``of_rows`` or ``of_record``. One thread at a time.

    Methods that change it return the rows to store in the index.
    """

    folder: Path
    """The names of its files start with its name, which may differ from the bag's."""
    bag: str
    robot: str
    mission: MissionOf | None = None
    slices: dict[str, SliceInfo] = field(default_factory=dict)
    """The closed slices by file name, with channels without definitions. The files may have been spooled already."""
    missing: list[Missing] = field(default_factory=list)
    ended: bool = False
    event: EventOf | None = None
    """The event that it was recorded for; None for a recording."""
    clock: ClockOf | None = None
    """The clock of its times, if it was not set when the bag started."""
    is_named: bool = True
    """Whether its name is final. Before that, nothing may be uploaded."""
    is_ending: bool = False
    """Whether metadata and manifest were passed to the spool."""
    _channels: dict[tuple[str, str, bool], Channel] = field(default_factory=dict)

    @classmethod
    def begin(cls, folder: Path, robot: str, mission: MissionOf | None, event: EventOf | None = None,
              clock: ClockOf | None = None) -> BagState:  # fmt: skip
        """Create the folder of a new bag. Raises OSError."""
        folder.mkdir(mode=0o700, parents=True)
        try:
            sync(folder.parent)
        except OSError:
            folder.rmdir()
            raise
        return cls(folder, folder.name, robot, mission, event=event, clock=clock, is_named=clock is None)

    @classmethod
    def of_rows(cls, folder: Path, robot: str, rows: RecordingRows) -> BagState:
        """The state from rows of the index, or from a slice's record. Raises BagDamaged if they are invalid."""
        state = cls(folder, folder.name, robot)
        try:
            state._load(from_json(rows.facts.encode()))
            channels = [_read_channel(one) for one in _list(from_json(rows.channels.encode()))]
            state._channels = {_channel_id(one): one for one in channels}
            for row in rows.slices:
                info = state._read_slice_row(row)
                state.slices[info.path.name] = info
            for one in rows.missing:
                check_numbers(one._asdict(), 'missing')
                state.missing.append(parse(Missing, one._asdict(), 'missing'))
        except (ValueError, TypeError, AttributeError, NameRefused) as error:
            raise BagDamaged(f'the state of bag {folder.name} is invalid: {error}', path=str(folder)) from error
        return state

    @classmethod
    def of_record(cls, folder: Path, robot: str, record: Mapping[str, str]) -> BagState:
        """The state from the metadata record of a slice. Raises BagDamaged if it is invalid."""
        try:
            slices = tuple(SliceRow(*_list(row)) for row in _list(from_json(record['slices'].encode())))
            missing = tuple(MissingRow(*_list(row)) for row in _list(from_json(record['missing'].encode())))
            rows = RecordingRows(folder.name, record['facts'], record['channels'], slices, missing)
            omitted = int(record['left_out'])
        except (LookupError, ValueError, TypeError) as error:
            raise BagDamaged(f'the record in a slice of bag {folder.name} is invalid: {error}', path=str(folder)) from error
        state = cls.of_rows(folder, robot, rows)
        if omitted > 0:
            state.missing.insert(0, Missing(slice_file(folder.name, 0), LEFT_OUT.format(omitted), None))
        return state

    @property
    def sink(self) -> str:
        """Prefix of the names of the accounts for its messages."""
        return BAG if self.event is None else EVENT

    def final(self, file: str) -> str:
        """The name in the store of a file in the folder."""
        return self.bag + file.removeprefix(self.folder.name) if file.startswith(self.folder.name) else file

    def rows(self, slices: Sequence[SliceInfo] = (), missing: int = 0) -> RecordingRows:
        """The rows of the bag itself, with these slices and the last ``missing`` losses."""
        first = len(self.missing) - missing
        return RecordingRows(
            self.folder.name, self._description(), json.dumps([_channel_fields(one) for one in self._channels.values()]),
            tuple(self._slice_row(info) for info in slices),
            tuple(MissingRow(index, one.file, one.what, one.messages, one.topic, one.reason)
                  for index, one in enumerate(self.missing[first:], first)),
        )  # fmt: skip

    def all_rows(self) -> list[RecordingRows]:
        """All rows, to replace those of the index."""
        return [self.completed(), self.rows(list(self.slices.values()), len(self.missing))]

    def completed(self) -> RecordingRows:
        """The row that marks the bag as complete in the spool, which removes its other rows."""
        return RecordingRows(self.folder.name, is_whole=True)

    def record(self, owner: str, number: int) -> dict[str, str]:
        """The metadata record (RECORD) at the start of the slice ``number``."""
        rows = self.rows(list(self.slices.values()), len(self.missing))
        last = rows.slices[-1].bytes if rows.slices else 0
        room = max(MIN_ROWS_BYTES, last // RECORD_SHARE - len(rows.facts) - len(rows.channels))
        missing = _newest(rows.missing, room // 4)
        slices = _newest(rows.slices, room - len(json.dumps(missing)))
        omitted = len(rows.slices) + len(rows.missing) - len(slices) - len(missing)
        return {
            'recording': self.folder.name, 'owner': owner, 'number': str(number), 'facts': rows.facts, 'channels': rows.channels,
            'slices': json.dumps(slices), 'missing': json.dumps(missing), 'left_out': str(omitted),
        }  # fmt: skip

    def news(self) -> dict[str, str]:
        """The metadata record for newer information within a slice."""
        return {'facts': self._description()}

    def add_slice(self, info: SliceInfo) -> RecordingRows:
        """Add a closed slice."""
        channels = count_by_channel(
            (self._channels.setdefault(_channel_id(channel), replace(channel, definition='')), count)
            for channel, count in info.channels.items()
        )
        self.slices[info.path.name] = info = replace(info, channels=channels, damage=None)
        return self.rows([info])

    def add_missing(self, *missing: Missing) -> RecordingRows:
        """Add losses."""
        self.missing.extend(missing)
        return self.rows(missing=len(missing))

    def set_name(self, bag: str, clock: ClockOf) -> RecordingRows:
        """Set the final name of the bag."""
        self.bag, self.clock, self.is_named = bag, clock, True
        return self.rows()

    def remove(self) -> None:
        """Delete the folder, once everything is durable in the spool. Raises OSError."""
        for suffix in (OPEN_SUFFIX, ENDED):
            for path in self.folder.glob(f'*{suffix}'):
                path.unlink(missing_ok=True)
        for file in self.slices:
            (self.folder / file).unlink(missing_ok=True)
        with suppress(FileNotFoundError):
            self.folder.rmdir()

    def _description(self) -> str:
        facts = _Description(self.bag, self.robot, self.mission, self.event, self.clock, self.is_named, self.ended)
        return json.dumps(asdict(facts))

    def _load(self, given: Any) -> None:
        """The inverse of ``_description``. Raises ValueError, NameRefused."""
        check_numbers(given, 'facts')
        facts = parse(_Description, given, 'facts')
        check_key(slice_file(facts.bag, 0))
        self.bag, self.mission, self.event, self.clock = facts.bag, facts.mission, facts.event, facts.clock
        self.is_named, self.ended = facts.named, facts.ended

    def _slice_row(self, info: SliceInfo) -> SliceRow:
        counts = json.dumps([info.channels.get(one) for one in self._channels.values()])
        return SliceRow(slice_number(self.folder.name, info.path.name) or 0, info.bytes, info.sha256, info.t_start_ns,
                        info.t_end_ns, info.messages, counts)  # fmt: skip

    def _read_slice_row(self, row: SliceRow) -> SliceInfo:
        """The inverse of ``_slice_row``. Raises ValueError."""
        found = _list(from_json(row.counts.encode()))
        numbers = [row.number, row.bytes, row.t_start_ns, row.t_end_ns, row.messages, *(one for one in found if one is not None)]
        if not isinstance(row.sha256, str) or not all(type(one) is int and 0 <= one < 1 << 64 for one in numbers):  # type: ignore[redundant-expr]
            raise ValueError(f'a row of a slice is {row!r:.200}')
        channels = {one: count for one, count in zip(self._channels.values(), found, strict=False) if count is not None}
        return SliceInfo(self.folder / slice_file(self.folder.name, row.number), row.bytes, row.sha256, row.t_start_ns,
                         row.t_end_ns, row.messages, channels)  # fmt: skip


def _channel_id(channel: Channel) -> tuple[str, str, bool]:
    """Identifies a channel within a bag."""
    return channel.topic, channel.type, channel.repeated


def _channel_fields(channel: Channel) -> list[str | bool]:
    return [channel.topic, channel.type, channel.encoding, channel.type_hash, channel.qos, channel.repeated]


def _read_channel(fields: Any) -> Channel:
    topic, kind, encoding, type_hash, qos, repeated = _list(fields)
    if not all(isinstance(text, str) for text in (topic, kind, encoding, type_hash, qos)) or not isinstance(repeated, bool):
        raise TypeError(f'a channel is {fields!r:.200}')
    return Channel(topic, kind, encoding, '', type_hash, qos, repeated=repeated)


def _newest(rows: Sequence[Any], most_bytes: int) -> Sequence[Any]:
    """The last rows that fit into ``most_bytes`` as JSON."""
    for count, row in enumerate(reversed(rows)):
        most_bytes -= len(json.dumps(row)) + 2
        if most_bytes < 0:
            return rows[len(rows) - count :]
    return rows


def _list(found: Any) -> list[Any]:
    if not isinstance(found, list):
        raise TypeError(f'{found!r:.80} is not a list')
    return found
