"""What is known of a bag until it is whole in the spool: a file of JSON lines in its folder, synced line by line.

    {"bag": "patrol_20251018_120000", "robot": "thor", "mission": {"type": "patrol", "mission_id": "...", "run_id": null}}
    {"slice": {"file": "patrol_20251018_120000_0.mcap", "bytes": 1, ...}}      each slice that was closed
    {"missing": {"file": "...", "what": "...", "messages": 3, ...}}            what is known to be lost
    {"mission": {...}}                                                         when more is known of the mission
    {"event": {...}}                                                           what triggered it, and whenever more did
    {"ended": true}                                                            the recording ended by itself
    {"named": {"bag": "patrol_20251018_120000", "clock": {...}}}               of one that began without a date (place.py)

Slices leave the folder as soon as they are spooled; manifest and metadata are made from these lines, after a death as well.
What makes no sense there is left out, whatever it is: a slice that is in the folder still is looked into then.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.bags.json_object import JsonObject
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
from shadowhound_data_logger.disk import sync
from shadowhound_data_logger.errors import BagDamaged, NameRefused
from shadowhound_data_logger.keys import check_key
from shadowhound_data_logger.mcap.slice_info import Channel, SliceInfo
from shadowhound_data_logger.spool.accounts import BAG, EVENT

log = logging.getLogger(__name__)

FILE: Final = 'recording.jsonl'
MOST_LINE_BYTES: Final = 4 << 20
"""What one slice can say of itself: some hundred topics with all their QoS are 100 KB."""
MOST_BYTES: Final = 256 << 20
"""Of the file: slices of a month."""


@dataclass(slots=True)
class Notes:
    """A bag on this disk. Life: ``begin`` or ``read`` one; ``add...``. One thread at a time."""

    folder: Path
    """Its files have its name, whatever the bag's is."""
    bag: str
    robot: str
    mission: MissionOf | None
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

    @classmethod
    def begin(cls, folder: Path, robot: str, mission: MissionOf | None, event: EventOf | None = None,
              clock: ClockOf | None = None) -> Notes:  # fmt: skip
        """Make the folder of a new bag. Raises OSError."""
        folder.mkdir(mode=0o700, parents=True)
        notes = cls(folder, folder.name, robot, mission, event=event, clock=clock, is_named=clock is None)
        notes._append({
            'bag': notes.bag, 'robot': robot, 'mission': mission and asdict(mission), 'event': event and asdict(event),
            'clock': clock and asdict(clock),
        })  # fmt: skip
        sync(folder)
        sync(folder.parent)
        return notes

    @classmethod
    def read(cls, folder: Path, robot: str) -> Notes:
        """What was written as far as it makes sense: a power cut tears the last line. Raises OSError."""
        notes = cls(folder, folder.name, robot, None)
        wrong = ''
        for line in _lines(folder / FILE):
            try:
                notes._take(JsonObject(json.loads(line), FILE, ''))
            except (ValueError, RecursionError, BagDamaged, NameRefused) as error:
                wrong = wrong or f'{type(error).__name__} {error}'
        if wrong:
            log.warning('%s has lines that make no sense, the first: %.300s', folder / FILE, wrong)
        return notes

    @property
    def sink(self) -> str:
        """Before the names of the accounts in which its messages count."""
        return BAG if self.event is None else EVENT

    def final(self, file: str) -> str:
        """The name that a file of the folder has in the store."""
        return self.bag + file.removeprefix(self.folder.name) if file.startswith(self.folder.name) else file

    def add_slice(self, info: SliceInfo) -> None:
        """A slice was closed. It is known here whether or not the disk takes the line, which raises OSError."""
        bare = replace(info, channels=tuple(replace(channel, definition='') for channel in info.channels))
        self.slices[info.path.name] = bare
        said = asdict(replace(bare, path=Path(info.path.name)))
        said['file'] = said.pop('path').name
        del said['damage']
        self._append({'slice': said})

    def add_missing(self, *missing: Missing) -> None:
        """Something is lost. Raises OSError, as above."""
        self.missing.extend(missing)
        self._append(*({'missing': asdict(one)} for one in missing))

    def set_mission(self, mission: MissionOf) -> None:
        """More is known of the mission. Raises OSError, as above."""
        self.mission = mission
        self._append({'mission': asdict(mission)})

    def set_event(self, event: EventOf) -> None:
        """There are more triggers. Raises OSError, as above."""
        self.event = event
        self._append({'event': asdict(event)})

    def set_name(self, bag: str, clock: ClockOf) -> None:
        """The bag's name is known for good. Raises OSError: then it is not."""
        self._append({'named': {'bag': bag, 'clock': asdict(clock)}})
        self.bag, self.clock, self.is_named = bag, clock, True

    def end(self) -> None:
        """The recording is over and all its slices are closed. Raises OSError, as above."""
        self.ended = True
        self._append({'ended': True})

    def remove(self) -> None:
        """All is durable in the spool, which may be about to remove the slices it linked. Raises OSError."""
        for file in self.slices:
            (self.folder / file).unlink(missing_ok=True)
        (self.folder / FILE).unlink(missing_ok=True)
        self.folder.rmdir()

    def _append(self, *lines: Mapping[str, Any]) -> None:
        if not lines:
            return
        descriptor = os.open(self.folder / FILE, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        try:
            content = ''.join(f'{json.dumps(line)}\n' for line in lines)
            os.write(descriptor, b'\n' + content.encode())  # whatever a line that failed has left
            os.fdatasync(descriptor)
        finally:
            os.close(descriptor)

    def _take(self, line: JsonObject) -> None:
        if line.has('slice'):
            info = self._slice(line.object('slice'))
            self.slices[info.path.name] = info
        elif line.has('missing'):
            self.missing.append(read_missing(line.object('missing')))
        elif line.has('named'):
            named = line.object('named')
            bag, clock = named.text('bag'), read_clock(named.object('clock'))
            check_key(slice_file(bag, 0))
            self.bag, self.clock, self.is_named = bag, clock, True
        if line.has('mission'):
            self.mission = read_mission(line.object('mission'))
        if line.has('event'):
            self.event = read_event(line.object('event'))
        if line.has('clock'):
            self.clock, self.is_named = read_clock(line.object('clock')), False
        self.ended = self.ended or line.has('ended')

    def _slice(self, said: JsonObject) -> SliceInfo:
        file = said.text('file')
        if file != slice_file(self.folder.name, slice_number(self.folder.name, file) or 0):
            raise said.wrong('file', f'one of {self.folder.name}')
        channels = tuple(
            Channel(one.text('topic'), one.text('type'), one.text_or_none('encoding') or '', '',
                    one.text_or_none('type_hash') or '', one.text_or_none('qos') or '')
            for one in said.objects('channels')
        )  # fmt: skip
        return SliceInfo(self.folder / file, said.count('bytes'), said.text_or_none('sha256') or '', said.count('t_start_ns'),
                         said.count('t_end_ns'), said.count('messages'), said.counts('counts'), channels)  # fmt: skip


def _lines(path: Path) -> Iterator[bytes]:
    """In bounded memory; what is no regular file has none. Raises OSError."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        return
    with os.fdopen(descriptor, 'rb') as file:
        whole, left = True, MOST_BYTES
        while left > 0 and (line := file.readline(MOST_LINE_BYTES)):
            left -= len(line)
            if whole and line.strip():
                yield line
            whole = line.endswith(b'\n')
        if left <= 0:
            log.error('%s has more than %d bytes: the rest of it is not read', path, MOST_BYTES)


def discard(folder: Path) -> None:
    """Take away what a bag that could not be begun has left, as far as the disk lets."""
    with suppress(OSError):
        (folder / FILE).unlink(missing_ok=True)
        folder.rmdir()
