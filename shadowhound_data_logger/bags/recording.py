"""One bag during its recording: writes messages to slices, and passes slices, losses and the manifest to the spool.

While the disk accepts no writes, messages are dropped and counted; the recording continues as soon as the disk accepts writes.
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

from shadowhound_data_logger.bags.context import BagContext
from shadowhound_data_logger.bags.latched import MAX_LATCHED_BYTES, Latched
from shadowhound_data_logger.bags.manifest import EventOf, Missing, MissionOf
from shadowhound_data_logger.bags.naming import slice_file
from shadowhound_data_logger.bags.objects import finish, ros_distro, slice_object
from shadowhound_data_logger.bags.queue import MessageBatch
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
"""Latched messages are logged this much earlier than the first message of a slice: the intake drains one topic after the other,
up to a quarter of a second apart, so messages of the next topic may be older than this first one."""
RETRY_S: Final = 5.0
"""Time between attempts to write to a disk that accepts no writes."""
UNWRITABLE: Final = 'unwritable'
"""Reason for dropping messages if a write fails, unless the disk is full (NO_ROOM)."""
_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})


class _BagOutput:
    """Passes the slices, rows and losses of one bag to the spool and its accounts.

    Lifecycle: new; any number of calls. Owned by the thread that writes bags.
    """

    def __init__(self, state: BagState, context: BagContext, priority: int) -> None:
        self.state = state
        self.bytes = 0
        """Total size of the closed slices."""
        self.dropped = 0
        """Messages that this recording dropped."""
        self._context = context
        self._priority = priority
        self._unreported = Counter[tuple[str, str]]()
        """Dropped messages that the manifest does not list yet, by topic and reason."""

    def put_rows(self, rows: RecordingRows | None = None) -> None:
        """Store the current state of the bag in the index."""
        self._context.writer.put(rows=[rows or self.state.rows()], wait=False)

    def add_slice(self, info: SliceInfo) -> None:
        """Pass a complete slice to the spool; without a final name of the bag, it waits in the folder."""
        self.bytes += info.bytes
        rows = self.state.add_slice(info)
        if self.state.is_named:
            self.put_slice(info, rows)
        else:
            self.put_rows(rows)

    def put_slice(self, info: SliceInfo, *rows: RecordingRows) -> None:
        item = slice_object(self.state, info, self._priority, is_kept=self._context.keeps(self.state))
        self._context.writer.put(item, rows=rows, wait=False)

    def drop(self, batch: MessageBatch, reason: str) -> None:
        """Count messages that cannot be written."""
        messages = batch.messages
        self._unreported[batch.topic, reason] += len(messages)
        self._account(batch.topic, reason, len(messages), messages[0].times, messages[-1].times)

    def drop_written(self, file: str, topic: str, reason: str, count: int) -> None:
        """Count messages that were written to a slice but did not reach the disk."""
        self._account(topic, reason, count)
        self._report(Missing(file, 'the disk rejected them', count, topic, reason))

    def count_dropped(self, lost: Mapping[tuple[str, str], int]) -> None:
        """Add messages, by topic and reason, that were dropped and accounted for before they reached the recording."""
        self._unreported.update(lost)

    def report_dropped(self, file: str) -> None:
        """List the messages dropped since the last call in the manifest, as missing in or after a slice."""
        dropped, self._unreported = sorted(self._unreported.items()), Counter()
        self._report(*(Missing(file, f'dropped: {reason}', count, topic, reason) for (topic, reason), count in dropped))

    def _report(self, *missing: Missing) -> None:
        if missing:
            self.put_rows(self.state.add_missing(*missing))

    def _account(self, topic: str, reason: str, count: int, first: Times = NO_TIMES, last: Times = NO_TIMES) -> None:
        self.dropped += count
        self._context.spool.accounts.drop(f'{self.state.sink}{topic}', reason, count, first, last)


class Recording:
    """One bag during its recording: writes messages to slices, and passes each complete slice on.

    Lifecycle: new; ``write``, ``tick`` and ``split`` any number of times; ``close`` once. Owned by the thread that writes bags.
    """

    def __init__(self, state: BagState, settings: BagSettings, context: BagContext, recovery: BagRecovery,
                 monotonic: Callable[[], float] = time.monotonic) -> None:  # fmt: skip
        """``recovery`` receives the bag if it must wait for its date."""
        self.state = state
        self.number = -1
        """Number of the newest slice."""
        self.messages = 0
        self.refused = ''
        """Reason why nothing is being written; empty if the disk accepts writes."""
        self._context = context
        self.output = _BagOutput(state, context, settings.priority)
        self._settings = settings
        self._recovery = recovery
        self._monotonic = monotonic
        self._writer: SliceWriter | None = None
        self._channels: dict[tuple[str, str, bool], Channel] = {}
        self._latched = Latched(min(MAX_LATCHED_BYTES, settings.slice_bytes))
        self._repeated_bytes = 0
        """Size of the latched messages in the open slice; they do not count towards the slice's limit."""
        self._written = Counter[str]()  # into the open slice
        self._sequences: dict[str, Iterator[int]] = {}
        """Sequence numbers in this bag, by topic, for messages without the publisher's number."""
        self._broken: list[tuple[Path, Counter[str], str]] = []
        """Slices with a failed write: path, the messages written to it, and the reason."""
        self._slice_started_s = self._retry_at_s = 0.0
        self.output.put_rows()

    @property
    def bytes(self) -> int:
        """Size of all slices, including those that were delivered."""
        writer = self._writer
        return self.output.bytes + (writer.size if writer is not None else 0)

    @property
    def dropped(self) -> int:
        """Messages that this recording dropped."""
        return self.output.dropped

    def write(self, batch: MessageBatch) -> None:
        """Record messages, or drop and count them if the disk accepts no writes. Later slices repeat the latched ones."""
        if not batch.paused:
            self._record(self._context.with_bag_times(self.state, batch))
        if batch.latched:
            self._latched.keep(batch)

    def _record(self, batch: MessageBatch) -> None:
        if self._writer is None and not self._open_slice():
            self.output.drop(batch, self.refused or UNWRITABLE)
            return
        writer = self._writer
        assert writer is not None
        is_first = not self._written
        self._written[batch.topic] += len(batch.messages)
        self.messages += len(batch.messages)
        channel, sequence = self._channel(batch), self._sequences.setdefault(batch.topic, itertools.count(1))
        try:
            if is_first:
                self._slice_started_s = self._monotonic()
                self._repeat_latched(writer, batch.messages[0].received_ns)
            for cdr, source_ns, _, number, received_ns, stamp_ns, *_ in batch.messages:
                publish_ns = stamp_ns if stamp_ns >= EARLIEST_SANE_NS else source_ns
                writer.write(channel, received_ns, publish_ns, next(sequence) if number is None else number, cdr)
        except OSError as error:
            self._abandon_slice(error)
        else:
            if writer.size - self._repeated_bytes >= self._settings.slice_bytes:
                self.split()

    def _repeat_latched(self, writer: SliceWriter, first_ns: int) -> None:
        """Write the latched messages at the start of a slice. Raises OSError."""
        log_ns, size = max(0, first_ns - REPEAT_LEAD_NS), writer.size
        for batch in self._latched:
            channel = self._channel(batch, repeated=True)
            for cdr, source_ns, _, number, _, stamp_ns, *_ in batch.messages:
                writer.write(channel, log_ns, stamp_ns if stamp_ns >= EARLIEST_SANE_NS else source_ns, number or 0, cdr)
        self._repeated_bytes = writer.size - size

    def tick(self) -> None:
        """Sync what was written; end the slice if its duration is over or the disk has no room."""
        if self._writer is None:
            return
        try:
            self._writer.sync()
        except OSError as error:
            self._abandon_slice(error)
            return
        if not self._context.spool.room.has_for_bags():
            self.split()  # the next slice is refused
        elif self._monotonic() - self._slice_started_s >= self._settings.slice_s:
            self.split()

    def split(self) -> None:
        """End the slice if it has messages, and start the next one."""
        if self._end_slice():
            self._open_slice()

    def close(self, deadline_s: float) -> bool:
        """End the bag; False if the next start must complete it. Without a date, the bag waits for one."""
        self._retry_at_s = 0.0
        has_slice = self._end_slice()
        if not self._recover_broken():
            return False
        self._report_dropped()
        state, context = self.state, self._context
        state.ended = True
        is_waiting = not state.is_named
        if has_slice:
            self._open_slice()  # its record describes the bag until the bag is complete in the spool
        self._update(state.record(context.spool.robot, self.number))  # includes losses since the slice started
        try:
            self._release_slice()
            if (state.slices or state.missing) and not context.settle_name(state):
                self._recovery.add(state)
                return True
            if is_waiting:
                for info in state.slices.values():
                    self.output.put_slice(info)
            return finish(state, context.writer, deadline_s)
        except OSError as error:
            log.warning('bag %s: the next start completes its folder: %s', state.bag, error)
            return False

    def set_mission(self, mission: MissionOf) -> None:
        """Store new information about the bag's mission."""
        self.state.mission = mission
        self._update()

    def set_event(self, event: EventOf) -> None:
        """Store additional triggers of the event."""
        self.state.event = event
        self._update()

    def _update(self, record: Mapping[str, str] | None = None) -> None:
        """Store the state of the bag in the index and in the open slice."""
        self.output.put_rows()
        if self._writer is not None:
            try:
                self._writer.add_metadata(RECORD, record or self.state.news())
                self._writer.sync()
            except OSError as error:
                self._abandon_slice(error)

    # -- slices ----------------------------------------------------------------------------------------------------

    def _channel(self, batch: MessageBatch, *, repeated: bool = False) -> Channel:
        channel = self._channels.get((batch.topic, batch.type, repeated))
        if channel is None:
            encoding, definition, type_hash = describe(batch.type)
            channel = Channel(batch.topic, batch.type, encoding, definition, type_hash, batch.qos, repeated=repeated)
            self._channels[batch.topic, batch.type, repeated] = channel
        return channel

    def _open_slice(self) -> bool:
        """Open the next slice; False while the disk accepts no writes."""
        now_s = self._monotonic()
        if now_s < self._retry_at_s:
            return False
        if not self._context.spool.room.has_for_bags():
            self._refuse(NO_ROOM, 'there is no room')
            return False
        if not self._recover_broken():
            return False
        path = self.state.folder / slice_file(self.state.folder.name, self.number + 1)
        try:
            path.with_name(path.name + OPEN_SUFFIX).unlink(missing_ok=True)  # left by a failed attempt
            writer = SliceWriter(path, compression=self._settings.compression, ros_distro=ros_distro())
            try:
                writer.add_metadata(RECORD, self.state.record(self._context.spool.robot, self.number + 1))
                writer.sync()
            except OSError:
                writer.abort()
                raise
        except OSError as error:
            self._refuse(_reason(error), str(error))
            return False
        self._writer = writer
        self._report_dropped()
        self.number += 1
        if self.refused:
            log.info('bag %s: recording continues', self.state.bag)
        self.refused = ''
        return True

    def _end_slice(self) -> bool:
        """Close the open slice and pass it on; False if there was none with messages."""
        writer = self._writer
        if writer is None or not self._written:
            return False
        try:
            info = writer.close()
        except OSError as error:
            self._abandon_slice(error)
            return True
        self._writer = None
        self._written.clear()
        self.output.add_slice(info)
        self._report_dropped()
        return True

    def _release_slice(self) -> None:
        """Close the open slice, which has no messages, and rename it to ``ENDED``. Raises OSError."""
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.abort()
            writer.path.with_name(writer.path.name + OPEN_SUFFIX).replace(writer.path.with_name(writer.path.name + ENDED))

    def _abandon_slice(self, error: OSError) -> None:
        """A write failed: keep the open slice for recovery."""
        writer, self._writer = self._writer, None
        assert writer is not None
        writer.abort()
        self._broken.append((writer.path.with_name(writer.path.name + OPEN_SUFFIX), self._written, _reason(error)))
        self._written = Counter()
        self._refuse(_reason(error), str(error))

    def _recover_broken(self) -> bool:
        """Complete slices with a failed write, and drop messages that are not in them. False if the disk accepts no writes."""
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
                self.output.drop_written(final.name, topic, reason, count)
            if info is not None and any(info.recorded.values()):
                self.output.add_slice(replace(info, damage=None))
            elif info is not None:
                info.path.unlink(missing_ok=True)
        return True

    def _report_dropped(self) -> None:
        self.output.report_dropped(slice_file(self.state.folder.name, max(0, self.number)))

    def _refuse(self, reason: str, text: str) -> None:
        self._retry_at_s = self._monotonic() + RETRY_S
        if not self.refused:
            log.error('bag %s: nothing is recorded while the disk accepts no writes: %s', self.state.bag, text)
        self.refused = reason


def _reason(error: OSError) -> str:
    return NO_ROOM if error.errno in _FULL else UNWRITABLE
