"""One bag while it records: messages into slices, slices into the spool, and at the end what makes it whole.

A disk that takes nothing costs the messages of that time, which are counted as dropped; the recording goes on as soon as it can.
"""

from __future__ import annotations

import errno
import itertools
import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

from shadowhound_data_logger.bags.manifest import Missing, MissionOf
from shadowhound_data_logger.bags.naming import BUCKET, prefix_of, slice_file
from shadowhound_data_logger.bags.notes import Notes
from shadowhound_data_logger.bags.objects import ending_objects, note_evicted, ros_distro, slice_object
from shadowhound_data_logger.bags.place import BagPlace
from shadowhound_data_logger.bags.queue import Lot
from shadowhound_data_logger.bags.salvage import Salvage
from shadowhound_data_logger.encode.definitions import describe
from shadowhound_data_logger.mcap.recovery import recover
from shadowhound_data_logger.mcap.slice_info import Channel, SliceInfo
from shadowhound_data_logger.mcap.writer import OPEN, SliceWriter
from shadowhound_data_logger.options import BagSettings
from shadowhound_data_logger.spool.retention import NO_ROOM

log = logging.getLogger(__name__)

RETRY_S: Final = 5.0
"""Between two tries to write to a disk that took nothing."""
UNWRITABLE: Final = 'unwritable'
"""Why messages are dropped that the disk refuses, unless it is full (NO_ROOM)."""
_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})


class Recording:
    """New; ``write``, ``tick`` and ``split`` any number of times; ``close`` once. Owned by the thread that writes bags."""

    def __init__(self, notes: Notes, settings: BagSettings, place: BagPlace, salvage: Salvage,
                 monotonic: Callable[[], float] = time.monotonic) -> None:  # fmt: skip
        """``salvage`` gets a bag that waits for its date."""
        self.notes = notes
        self._place = place
        self.number = -1
        """Of the newest slice."""
        self.messages = self.dropped = 0
        self.refused = ''
        """Why nothing is written now; empty while all is well."""
        self._settings = settings
        self._salvage = salvage
        self._monotonic = monotonic
        self._writer: SliceWriter | None = None
        self._channels: dict[tuple[str, str], Channel] = {}
        self._written = Counter[str]()  # into the open slice
        self._unnumbered: dict[str, Iterator[int]] = {}
        """By topic, the numbers in this bag of messages that have none of their publisher."""
        self._lost = Counter[tuple[str, str]]()  # by topic and reason, not noted yet
        self._broken: list[tuple[Path, Counter[str], str]] = []
        """Slices that the disk refused to go on with, what was written into them, and why it refused."""
        self._closed_bytes = 0
        self._began_s = self._again_s = 0.0

    @property
    def bytes(self) -> int:
        """Of all slices, those that have left this disk as well."""
        writer = self._writer
        return self._closed_bytes + (writer.size if writer is not None else 0)

    def write(self, lot: Lot) -> None:
        """Record messages, or drop and count them while the disk takes nothing."""
        if self._writer is None and not self._begin():
            self._drop(lot)
            return
        writer = self._writer
        assert writer is not None
        self._written[lot.topic] += len(lot.messages)
        self.messages += len(lot.messages)
        channel, places = self._channel(lot), self._unnumbered.setdefault(lot.topic, itertools.count(1))
        try:
            for cdr, source_ns, _, number, received_ns in self._place.by_clock_of(self.notes, lot).messages:
                writer.write(channel, received_ns, source_ns, next(places) if number is None else number, cdr)
        except OSError as error:
            self._break(error)
        else:
            if writer.size >= self._settings.slice_bytes:
                self.split()

    def leave_out(self, lost: Mapping[tuple[str, str], int]) -> None:
        """Messages that were dropped before they came here, by topic and reason; they count in the accounts already."""
        self._lost.update(lost)

    def tick(self) -> None:
        """Make durable what was written; end the slice whose time is over, or when the disk has no room."""
        if self._writer is None:
            return
        try:
            self._writer.sync()
        except OSError as error:
            self._break(error)
            return
        if not self._place.spool.has_room():
            self.split()
            self._refuse(NO_ROOM, 'there is no room')
        elif self._monotonic() - self._began_s >= self._settings.slice_s:
            self.split()

    def split(self) -> None:
        """End the slice, if one is open; the next message begins another."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        try:
            info = writer.close()
        except OSError as error:
            self._writer = writer
            self._break(error)
        else:
            self._written.clear()
            self._hand_over(info)
            self._note_lost()

    def close(self, deadline_s: float) -> bool:
        """End the bag; False when it is left to the next start to make it whole. Without a date it waits for one."""
        self.split()
        self._again_s = 0.0
        if not self._mend():
            return False
        self._note_lost()
        notes = self.notes
        try:
            if notes.slices or notes.missing:
                notes.end()
                if not self._name():
                    return True
                if not self._place.writer.flush(deadline_s):
                    return False
                note_evicted(notes, self._place.spool.states(BUCKET, prefix_of(notes.robot, notes.bag)))
                for item in ending_objects(notes):
                    self._place.writer.put(item, wait=False)
                if not self._place.writer.flush(deadline_s):
                    return False
            notes.remove()
        except OSError as error:
            log.warning('the folder of bag %s is left to the next start: %s', notes.bag, error)
            return False
        return True

    def set_mission(self, mission: MissionOf) -> None:
        """More is known of the mission that it is recorded in."""
        try:
            self.notes.set_mission(mission)
        except OSError as error:
            log.warning('bag %s: %s', self.notes.bag, error)

    # -- slices ----------------------------------------------------------------------------------------------------

    def _channel(self, lot: Lot) -> Channel:
        channel = self._channels.get((lot.topic, lot.type))
        if channel is None:
            encoding, definition, type_hash = describe(lot.type)
            channel = Channel(lot.topic, lot.type, encoding, definition, type_hash, lot.qos)
            self._channels[lot.topic, lot.type] = channel
        return channel

    def _begin(self) -> bool:
        """Open the next slice; False while the disk takes nothing."""
        now_s = self._monotonic()
        if now_s < self._again_s:
            return False
        if not self._place.spool.has_room():
            self._refuse(NO_ROOM, 'there is no room')
            return False
        if not self._mend():
            return False
        path = self.notes.folder / slice_file(self.notes.folder.name, self.number + 1)
        try:
            path.with_name(path.name + OPEN).unlink(missing_ok=True)  # what a try that failed has left
            self._writer = SliceWriter(path, compression=self._settings.compression, ros_distro=ros_distro())
        except OSError as error:
            self._refuse(_reason(error), str(error))
            return False
        self._note_lost()
        self.number += 1
        self._began_s = now_s
        if self.refused:
            log.info('bag %s goes on', self.notes.bag)
        self.refused = ''
        return True

    def _break(self, error: OSError) -> None:
        """The disk refused a part of the open slice: what it has of it is saved as soon as it lets."""
        writer, self._writer = self._writer, None
        assert writer is not None
        writer.abort()
        self._broken.append((writer.path.with_name(writer.path.name + OPEN), self._written, _reason(error)))
        self._written = Counter()
        self._refuse(_reason(error), str(error))

    def _mend(self) -> bool:
        """Make whole slices of those that broke; what is not in them is dropped. False where the disk still refuses."""
        while self._broken:
            path, written, reason = self._broken[0]
            try:
                final = path.with_name(path.name.removesuffix(OPEN))
                info = recover(path, ros_distro=ros_distro()) if path.exists() else None
            except OSError as error:
                self._refuse(_reason(error), str(error))
                return False
            self._broken.pop(0)
            lost = written - Counter(info.counts if info else {})
            for topic, count in lost.items():
                self._count(topic, reason, count)
                self._note(Missing(final.name, 'the disk did not take it', count, topic, reason))
            if info is not None and info.messages:
                self._hand_over(replace(info, damage=None))
            elif info is not None:
                info.path.unlink(missing_ok=True)
        return True

    def _hand_over(self, info: SliceInfo) -> None:
        """A whole slice to the spool, which takes the file."""
        self._closed_bytes += info.bytes
        try:
            self.notes.add_slice(info)
        except OSError as error:
            log.warning('bag %s: %s', self.notes.bag, error)
        if self.notes.is_named:
            self._put_slice(info)

    def _put_slice(self, info: SliceInfo) -> None:
        self._place.writer.put(slice_object(self.notes, info, self._settings.priority), wait=False)

    def _name(self) -> bool:
        """Whether the bag has a name to leave by; one that gets it now lets go of its slices. Raises OSError."""
        notes = self.notes
        if notes.is_named:
            return True
        if not self._place.settle(notes):
            self._salvage.add(notes.folder)
            return False
        for info in notes.slices.values():
            self._put_slice(info)
        return True

    def _note_lost(self) -> None:
        """The manifest names what was dropped since the slice before, all of it in or after the newest slice."""
        lost, self._lost = self._lost, Counter()
        file = slice_file(self.notes.folder.name, max(0, self.number))
        found = sorted(lost.items())
        self._note(*(Missing(file, f'dropped: {reason}', count, topic, reason) for (topic, reason), count in found))

    def _note(self, *missing: Missing) -> None:
        try:
            self.notes.add_missing(*missing)
        except OSError as error:
            log.warning('bag %s: %s', self.notes.bag, error)

    def _drop(self, lot: Lot) -> None:
        reason, messages = self.refused or UNWRITABLE, lot.messages
        self._lost[lot.topic, reason] += len(messages)
        self._count(lot.topic, reason, len(messages), messages[0].source_ns, messages[-1].source_ns)

    def _count(self, topic: str, reason: str, count: int, from_ns: int = 0, to_ns: int = 0) -> None:
        self.dropped += count
        self._place.spool.accounts.drop(f'{self.notes.sink}{topic}', reason, count, from_ns, to_ns)

    def _refuse(self, reason: str, text: str) -> None:
        self._again_s = self._monotonic() + RETRY_S
        if not self.refused:
            log.error('bag %s: nothing is recorded while the disk takes nothing: %s', self.notes.bag, text)
        self.refused = reason


def _reason(error: OSError) -> str:
    return NO_ROOM if error.errno in _FULL else UNWRITABLE
