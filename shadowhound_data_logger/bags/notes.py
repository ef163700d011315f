"""What is known of a bag until it is whole in the spool: a file of JSON lines in its folder, synced line by line.

    {"bag": "patrol_20251018_120000", "robot": "thor", "mission": {"type": "patrol", "mission_id": "...", "run_id": null}}
    {"slice": {"file": "patrol_20251018_120000_0.mcap", "bytes": 1, ...}}      each slice that was closed
    {"missing": {"file": "...", "what": "...", "messages": 3, ...}}            what is known to be lost
    {"mission": {...}}                                                         when more is known of the mission
    {"event": {...}}                                                           what triggered it, and whenever more did
    {"ended": true}                                                            the recording ended by itself

Slices leave the folder as soon as they are spooled; manifest and metadata are made from these lines, after a death as well.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.bags.channel import Channel
from shadowhound_data_logger.bags.manifest import EventOf, Missing, MissionOf, TriggerOf
from shadowhound_data_logger.bags.slice_info import SliceInfo
from shadowhound_data_logger.disk import sync
from shadowhound_data_logger.spool.accounts import BAG, EVENT

FILE: Final = 'recording.jsonl'


@dataclass(slots=True)
class Notes:
    """A bag on this disk. Life: ``begin`` or ``read`` one; ``add...``. One thread at a time."""

    folder: Path
    bag: str
    robot: str
    mission: MissionOf | None
    slices: dict[str, SliceInfo] = field(default_factory=dict)
    """Of closed slices, by file; their channels are without definitions. They may have left the folder."""
    missing: list[Missing] = field(default_factory=list)
    ended: bool = False
    event: EventOf | None = None
    """What it was made for; None for a recording."""

    @classmethod
    def begin(cls, folder: Path, robot: str, mission: MissionOf | None, event: EventOf | None = None) -> Notes:
        """Make the folder of a new bag. Raises OSError."""
        folder.mkdir(mode=0o700, parents=True)
        notes = cls(folder, folder.name, robot, mission, event=event)
        notes._append({
            'bag': notes.bag, 'robot': robot, 'mission': mission and asdict(mission), 'event': event and asdict(event),
        })  # fmt: skip
        sync(folder)
        sync(folder.parent)
        return notes

    @classmethod
    def read(cls, folder: Path, robot: str) -> Notes:
        """What was written as far as it makes sense: a power cut tears the last line. Raises OSError."""
        notes = cls(folder, folder.name, robot, None)
        try:
            lines = (folder / FILE).read_bytes().splitlines()
        except FileNotFoundError:
            return notes
        for line in lines:
            try:
                notes._take(json.loads(line))
            except (ValueError, TypeError, LookupError, AttributeError):
                continue
        return notes

    @property
    def sink(self) -> str:
        """Before the names of the accounts in which its messages count."""
        return BAG if self.event is None else EVENT

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
        descriptor = os.open(self.folder / FILE, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
        try:
            content = ''.join(f'{json.dumps(line)}\n' for line in lines)
            os.write(descriptor, b'\n' + content.encode())  # whatever a line that failed has left
            os.fdatasync(descriptor)
        finally:
            os.close(descriptor)

    def _take(self, line: Mapping[str, Any]) -> None:
        if 'slice' in line:
            said = dict(line['slice'])
            channels = tuple(Channel(**channel) for channel in said.pop('channels'))
            info = SliceInfo(path=self.folder / said.pop('file'), channels=channels, **said)
            self.slices[info.path.name] = info
        elif 'missing' in line:
            self.missing.append(Missing(**line['missing']))
        elif line.get('mission'):
            self.mission = MissionOf(**line['mission'])
        if line.get('event'):
            said = dict(line['event'])
            self.event = EventOf(triggers=tuple(TriggerOf(**trigger) for trigger in said.pop('triggers')), **said)
        self.ended = self.ended or line.get('ended') is True


def discard(folder: Path) -> None:
    """Take away what a bag that could not be begun has left, as far as the disk lets."""
    with suppress(OSError):
        (folder / FILE).unlink(missing_ok=True)
        folder.rmdir()
