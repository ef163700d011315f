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

from shadowhound_data_logger.bags.latched import MAX_LATCHED_BYTES, Latched
from shadowhound_data_logger.bags.manifest import EventOf, Missing, MissionOf
from shadowhound_data_logger.bags.naming import slice_file
from shadowhound_data_logger.bags.objects import finish, ros_distro, slice_object
from shadowhound_data_logger.bags.place import BagPlace
from shadowhound_data_logger.bags.queue import Lot
from shadowhound_data_logger.bags.recovery import BagRecovery
from shadowhound_data_logger.bags.state import ENDED, RECORD, BagState
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS
from shadowhound_data_logger.core.model import RecordingRows
from shadowhound_data_logger.core.options import BagSettings
from shadowhound_data_logger.core.stamps import NO_TIMES, Times
from shadowhound_data_logger.formats.definitions import describe
from shadowhound_data_logger.formats.mcap.recovery import recover
from shadowhound_data_logger.formats.mcap.slice_info import Channel, SliceInfo
from shadowhound_data_logger.formats.mcap.writer import OPEN_SUFFIX, SliceWriter
from shadowhound_data_logger.spool.retention import NO_ROOM

log = logging.getLogger(__name__)

REPEAT_LEAD_NS: Final = 300_000_000
"""How much earlier than the first message of a slice the latched ones are logged. The intake drains topics one after the other,
up to a quarter of a second apart, so the next topic's messages may be older than this first one."""
RETRY_S: Final = 5.0
"""Between two tries to write to a disk that took nothing."""
UNWRITABLE: Final = 'unwritable'
"""Why messages are dropped that the disk refuses, unless it is full (NO_ROOM)."""
_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})


class Recording:
    """One bag while it records: writes messages to slices, and spools each slice.

    New; ``write``, ``tick`` and ``split`` any number of times; ``close`` once. Owned by the thread that writes bags.
    """

    def __init__(self, state: BagState, settings: BagSettings, place: BagPlace, recovery: BagRecovery,
                 monotonic: Callable[[], float] = time.monotonic) -> None:  # fmt: skip
        """``recovery`` gets a bag that waits for its date."""
        self.state = state
        self._place = place
        self.number = -1
        """Of the newest slice."""
        self.messages = self.dropped = 0
        self.refused = ''
        """Why nothing is written now; empty while all is well."""
        self._settings = settings
        self._recovery = recovery
        self._monotonic = monotonic
        self._writer: SliceWriter | None = None
        self._channels: dict[tuple[str, str, bool], Channel] = {}
        self._latched = Latched(min(MAX_LATCHED_BYTES, settings.slice_bytes))
        self._repeated_bytes = 0
        """Of the open slice: a slice does not end early because much is latched."""
        self._written = Counter[str]()  # into the open slice
        self._unnumbered: dict[str, Iterator[int]] = {}
        """By topic, the numbers in this bag of messages that have none of their publisher."""
        self._lost = Counter[tuple[str, str]]()  # by topic and reason, not noted yet
        self._broken: list[tuple[Path, Counter[str], str]] = []
        """Slices that the disk refused to go on with, what was written into them, and why it refused."""
        self._closed_bytes = 0
        self._began_s = self._again_s = 0.0
        place.writer.put(rows=[state.rows()], wait=False)

    @property
    def bytes(self) -> int:
        """Of all slices, those that have left this disk as well."""
        writer = self._writer
        return self._closed_bytes + (writer.size if writer is not None else 0)

    def write(self, lot: Lot) -> None:
        """Record messages, or drop and count them while the disk takes nothing; later slices begin with the latched ones."""
        if not lot.paused:
            self._record(self._place.by_clock_of(self.state, lot))
        if lot.latched:
            self._latched.keep(lot)

    def _record(self, lot: Lot) -> None:
        if self._writer is None and not self._begin():
            self._drop(lot)
            return
        writer = self._writer
        assert writer is not None
        is_first = not self._written
        self._written[lot.topic] += len(lot.messages)
        self.messages += len(lot.messages)
        channel, places = self._channel(lot), self._unnumbered.setdefault(lot.topic, itertools.count(1))
        try:
            if is_first:
                self._began_s = self._monotonic()
                self._repeat(writer, lot.messages[0].received_ns)
            for cdr, source_ns, _, number, received_ns, stamp_ns, *_ in lot.messages:
                publish_ns = stamp_ns if stamp_ns >= EARLIEST_SANE_NS else source_ns
                writer.write(channel, received_ns, publish_ns, next(places) if number is None else number, cdr)
        except OSError as error:
            self._break(error)
        else:
            if writer.size - self._repeated_bytes >= self._settings.slice_bytes:
                self.split()

    def _repeat(self, writer: SliceWriter, first_ns: int) -> None:
        """Begin a slice with what is latched. Raises OSError."""
        log_ns, size = max(0, first_ns - REPEAT_LEAD_NS), writer.size
        for lot in self._latched:
            channel = self._channel(lot, repeated=True)
            for cdr, source_ns, _, number, _, stamp_ns, *_ in lot.messages:
                writer.write(channel, log_ns, stamp_ns if stamp_ns >= EARLIEST_SANE_NS else source_ns, number or 0, cdr)
        self._repeated_bytes = writer.size - size

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
            self.split()  # the next one is refused
        elif self._monotonic() - self._began_s >= self._settings.slice_s:
            self.split()

    def split(self) -> None:
        """End the slice, if it has messages, and begin the next one."""
        if self._end_slice():
            self._begin()

    def close(self, deadline_s: float) -> bool:
        """End the bag; False when it is left to the next start to make it whole. Without a date it waits for one."""
        self._again_s = 0.0
        has_slice = self._end_slice()
        if not self._mend():
            return False
        self._note_lost()
        state, place = self.state, self._place
        state.ended = True
        is_waiting = not state.is_named
        if has_slice:
            self._begin()  # until the bag is whole it says what is known of it
        self._tell(state.record(place.spool.owner, self.number))  # also what was lost since the slice began
        try:
            self._leave()
            if (state.slices or state.missing) and not place.settle(state):
                self._recovery.add(state)
                return True
            if is_waiting:
                for info in state.slices.values():
                    self._put_slice(info)
            return finish(state, place.writer, deadline_s)
        except OSError as error:
            log.warning('the folder of bag %s is left to the next start: %s', state.bag, error)
            return False

    def set_mission(self, mission: MissionOf) -> None:
        """More is known of the mission that it is recorded in."""
        self.state.mission = mission
        self._tell()

    def set_event(self, event: EventOf) -> None:
        """There are more triggers."""
        self.state.event = event
        self._tell()

    def _tell(self, record: Mapping[str, str] | None = None) -> None:
        """The index and the open slice what is known of the bag now."""
        self._place.writer.put(rows=[self.state.rows()], wait=False)
        if self._writer is not None:
            try:
                self._writer.add_metadata(RECORD, record or self.state.news())
                self._writer.sync()
            except OSError as error:
                self._break(error)

    def _leave(self) -> None:
        """Let go of the open slice, which has no messages, under a name that says so. Raises OSError."""
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.abort()
            writer.path.with_name(writer.path.name + OPEN_SUFFIX).replace(writer.path.with_name(writer.path.name + ENDED))

    # -- slices ----------------------------------------------------------------------------------------------------

    def _channel(self, lot: Lot, *, repeated: bool = False) -> Channel:
        channel = self._channels.get((lot.topic, lot.type, repeated))
        if channel is None:
            encoding, definition, type_hash = describe(lot.type)
            channel = Channel(lot.topic, lot.type, encoding, definition, type_hash, lot.qos, repeated=repeated)
            self._channels[lot.topic, lot.type, repeated] = channel
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
        path = self.state.folder / slice_file(self.state.folder.name, self.number + 1)
        try:
            path.with_name(path.name + OPEN_SUFFIX).unlink(missing_ok=True)  # what a try that failed has left
            writer = SliceWriter(path, compression=self._settings.compression, ros_distro=ros_distro())
            try:
                writer.add_metadata(RECORD, self.state.record(self._place.spool.owner, self.number + 1))
                writer.sync()
            except OSError:
                writer.abort()
                raise
        except OSError as error:
            self._refuse(_reason(error), str(error))
            return False
        self._writer = writer
        self._note_lost()
        self.number += 1
        if self.refused:
            log.info('bag %s goes on', self.state.bag)
        self.refused = ''
        return True

    def _break(self, error: OSError) -> None:
        """The disk refused a part of the open slice: what it has of it is saved as soon as it lets."""
        writer, self._writer = self._writer, None
        assert writer is not None
        writer.abort()
        self._broken.append((writer.path.with_name(writer.path.name + OPEN_SUFFIX), self._written, _reason(error)))
        self._written = Counter()
        self._refuse(_reason(error), str(error))

    def _mend(self) -> bool:
        """Make whole slices of those that broke; what is not in them is dropped. False where the disk still refuses."""
        while self._broken:
            path, written, reason = self._broken[0]
            try:
                final = path.with_name(path.name.removesuffix(OPEN_SUFFIX))
                info = recover(path, ros_distro=ros_distro()) if path.exists() else None
            except OSError as error:
                self._refuse(_reason(error), str(error))
                return False
            self._broken.pop(0)
            lost = written - Counter(info.recorded if info else {})
            for topic, count in lost.items():
                self._count(topic, reason, count)
                self._note(Missing(final.name, 'the disk did not take it', count, topic, reason))
            if info is not None and any(info.recorded.values()):
                self._hand_over(replace(info, damage=None))
            elif info is not None:
                info.path.unlink(missing_ok=True)
        return True

    def _end_slice(self) -> bool:
        """Close the open slice and hand it over; whether there was one with messages."""
        writer = self._writer
        if writer is None or not self._written:
            return False
        try:
            info = writer.close()
        except OSError as error:
            self._break(error)
            return True
        self._writer = None
        self._written.clear()
        self._hand_over(info)
        self._note_lost()
        return True

    def _hand_over(self, info: SliceInfo) -> None:
        """A whole slice to the spool, which takes the file; that of a bag without a name waits in the folder."""
        self._closed_bytes += info.bytes
        rows = self.state.add_slice(info)
        if self.state.is_named:
            self._put_slice(info, rows)
        else:
            self._place.writer.put(rows=[rows], wait=False)

    def _put_slice(self, info: SliceInfo, *rows: RecordingRows) -> None:
        self._place.writer.put(
            slice_object(self.state, info, self._settings.priority, is_kept=self._place.keeps(self.state)), rows=rows, wait=False
        )

    def _note_lost(self) -> None:
        """The manifest names what was dropped since the slice before, all of it in or after the newest slice."""
        lost, self._lost = self._lost, Counter()
        file = slice_file(self.state.folder.name, max(0, self.number))
        found = sorted(lost.items())
        self._note(*(Missing(file, f'dropped: {reason}', count, topic, reason) for (topic, reason), count in found))

    def _note(self, *missing: Missing) -> None:
        if missing:
            self._place.writer.put(rows=[self.state.add_missing(*missing)], wait=False)

    def _drop(self, lot: Lot) -> None:
        reason, messages = self.refused or UNWRITABLE, lot.messages
        self._lost[lot.topic, reason] += len(messages)
        self._count(lot.topic, reason, len(messages), messages[0].times, messages[-1].times)

    def _count(self, topic: str, reason: str, count: int, first: Times = NO_TIMES, last: Times = NO_TIMES) -> None:
        self.dropped += count
        self._place.spool.accounts.drop(f'{self.state.sink}{topic}', reason, count, first, last)

    def _refuse(self, reason: str, text: str) -> None:
        self._again_s = self._monotonic() + RETRY_S
        if not self.refused:
            log.error('bag %s: nothing is recorded while the disk takes nothing: %s', self.state.bag, text)
        self.refused = reason


def _reason(error: OSError) -> str:
    return NO_ROOM if error.errno in _FULL else UNWRITABLE
