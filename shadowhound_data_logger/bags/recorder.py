"""Starts and stops recordings (by service, by missions, or with the node), and owns the thread that writes them.

Messages from the intake wait in a bounded queue. Starts, splits and stops are put into the same queue, so that each takes effect
between the messages where it was requested. The thread starts with the first recording.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from shadowhound_data_logger.bags.context import BagContext
from shadowhound_data_logger.bags.manifest import MissionOf
from shadowhound_data_logger.bags.queue import BagQueue, MessageBatch
from shadowhound_data_logger.bags.recording import Recording
from shadowhound_data_logger.bags.recovery import BagRecovery
from shadowhound_data_logger.bags.state import BagState
from shadowhound_data_logger.core.options import BagSettings
from shadowhound_data_logger.core.status import BagStatus
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.spool.topic_account import BAG

log = logging.getLogger(__name__)

SYNC_S: Final = 0.5
"""Time between syncs: with the poll interval of the intake, a message is on the disk in less than a second."""
IDLE_S: Final = 10.0
"""Maximum wait of an idle thread; well below ``PATIENCE_S``."""
PATIENCE_S: Final = 30.0
"""A round that takes longer is blocked by the disk."""
STOP_S: Final = 5.0
SERVICE, MISSION, ALWAYS = 'service', 'mission', 'always'
"""What started a recording; also values of the setting ``bag.record``."""
Answer = tuple[bool, str]
"""Whether a request was carried out, and a sentence about the result."""


@dataclass(slots=True)
class _Current:
    """The active recording, with what started it and when."""

    recording: Recording
    by: str
    started_s: float
    dropped_at_start: int


class Recorder:
    """Starts, splits and stops recordings, and writes their messages.

    Lifecycle: new; ``open`` once; ``start``, ``stop``, ... from any thread; ``close`` before the intake is closed.

    ``_control`` serializes these calls; the recording itself belongs to the thread ``bag-writer``.
    """

    def __init__(self, settings: BagSettings, context: BagContext, queue: BagQueue, recovery: BagRecovery,
                 listen: Callable[[bool, float], bool]) -> None:  # fmt: skip
        """``listen(on, timeout_s)`` starts or stops the recording in the intake; False if that timed out."""
        self._settings = settings
        self._context = context
        self._queue = queue
        self._recovery = recovery
        self._listen = listen
        self._control = threading.Lock()
        self._current: _Current | None = None
        self._mission: MissionOf | None = None
        self._writing: Recording | None = None
        self._due_s = 0.0
        self._started = False
        self._worker = Worker('bag-writer', self._step, patience_s=PATIENCE_S)

    @property
    def workers(self) -> Sequence[Worker]:
        """The workers that are running."""
        return *([self._worker] if self._started else []), *([self._recovery.worker] if self._recovery.is_busy else [])

    def open(self) -> None:
        """Complete interrupted bags, and start recording if the settings say so. Call it after the intake is open."""
        self._recovery.open()
        if self._settings.record == ALWAYS:
            self._start_by(ALWAYS)

    def close(self, deadline_s: float) -> bool:
        """End the bag and the threads; False if that timed out: then the next start completes the bag."""
        end_s = time.monotonic() + deadline_s
        with self._control:
            ended = self._current is None or self._stop(deadline_s)[0]
            self._recovery.close(max(0.0, end_s - time.monotonic()))
            self._worker.stop()
            self._queue.mark(lambda: None)
            return self._worker.join(max(0.1, end_s - time.monotonic())) and ended

    def status(self) -> BagStatus:
        """The status, from any thread."""
        current = self._current
        if current is None:
            return BagStatus()
        recording = current.recording
        return BagStatus(
            recording=True, paused=self._queue.paused, bag=recording.state.bag, slice=max(0, recording.number),
            messages=recording.messages, bytes=recording.bytes,
            dropped=recording.dropped + self._queue.dropped - current.dropped_at_start,
            duration_s=round(time.monotonic() - current.started_s, 1), queue_bytes=self._queue.bytes, refused=recording.refused,
        )  # fmt: skip

    # -- requests --------------------------------------------------------------------------------------------------

    def start(self) -> Answer:
        """Start a bag, of the active mission if there is one."""
        with self._control:
            if self._current is not None:
                return False, f'{self._current.recording.state.bag} is being recorded already'
            return self._start(SERVICE, self._mission)

    def stop(self, deadline_s: float = STOP_S) -> Answer:
        """End the bag, and wait until it is complete in the spool."""
        with self._control:
            if self._current is None:
                return False, 'nothing is recorded'
            return self._stop(deadline_s)

    def split(self, deadline_s: float = STOP_S) -> Answer:
        """End the slice and start another one."""
        with self._control:
            if self._current is None:
                return False, 'nothing is recorded'
            recording, done = self._current.recording, threading.Event()

            def split() -> None:
                recording.split()
                done.set()

            self._queue.mark(split)
            if not done.wait(deadline_s):
                return False, f'the slice was not closed within {deadline_s:g} s; it will be closed as soon as possible'
            return True, f'{recording.state.bag} has {len(recording.state.slices)} closed slices'

    def pause(self, *, paused: bool) -> Answer:
        """Pause or resume: messages during a pause are counted and dropped."""
        with self._control:
            if self._current is None:
                return False, 'nothing is recorded'
            self._queue.paused = paused
            return True, f'{self._current.recording.state.bag} is {"paused" if paused else "being recorded"}'

    def on_mission(self, mission: MissionOf | None) -> None:
        """Set the active mission, and start or end the bag that follows it."""
        with self._control:
            before, self._mission = self._mission, mission
            current = self._current
            if mission is None and before is None:
                return
            if mission is not None and before is not None and before.mission_id == mission.mission_id:
                if current is not None and current.recording.state.mission is not None:
                    recording = current.recording
                    self._queue.mark(lambda: recording.set_mission(mission))
            elif self._settings.record != SERVICE and (current is None or current.by != SERVICE):
                self._follow_mission(mission)

    def check_clock(self) -> None:
        """Call about once per second: after the clock was set, end a bag that started before, and start another one at once."""
        if not self._control.acquire(blocking=False):
            return  # another thread is starting or stopping a recording
        try:
            current = self._current
            if current is not None and self._context.can_be_dated(current.recording.state):
                self._start(current.by, current.recording.state.mission, after=current)
        finally:
            self._control.release()

    # -- starts and stops, under the lock --------------------------------------------------------------------------

    def _follow_mission(self, mission: MissionOf | None) -> None:
        """A mission started or ended: end its bag, and start the next one without losing a message between them."""
        current = self._current
        if mission is None and self._settings.record == MISSION:
            if current is not None:
                self._stop(STOP_S)
            return
        if current is None and self._settings.record == ALWAYS:
            return  # the operator stopped it
        self._start(ALWAYS if mission is None else MISSION, mission, after=current)

    def _start_by(self, by: str) -> None:
        with self._control:
            self._start(by, self._mission)

    def _start(self, by: str, mission: MissionOf | None, *, after: _Current | None = None) -> Answer:
        """``after``: the recording that this one follows."""
        context = self._context
        unset_clock = context.unset_clock()
        name = context.name(mission.type if mission is not None else '', unset_clock)
        try:
            state = BagState.begin(context.root / name, context.robot, mission, clock=unset_clock)
        except OSError as error:
            log.error('no bag is recorded: %s', error)  # noqa: TRY400 - for the operator, without a traceback
            if after is not None:
                self._stop(STOP_S)
            return False, f'no bag can be created in {context.root}: {error.strerror}'
        continues = by == ALWAYS or after is not None or (mission is not None and mission.mission_id in self._recovery.missions)
        if not continues:
            self._context.spool.accounts.rebase_all(BAG)
        recording = Recording(state, self._settings, context, self._recovery)
        self._current = _Current(recording, by, time.monotonic(), self._queue.dropped)
        self._queue.paused = self._queue.paused and after is not None
        if after is None:
            self._queue.take_dropped()
        if not self._started:
            self._started = True
            self._worker.start()
        if after is None:
            self._queue.mark(lambda: self._write_to(recording))
        else:
            self._stop_after(after.recording, STOP_S, then=recording)
        if not self._listen(True, STOP_S):
            log.warning('the intake did not start recording within %.0f s; it will start as soon as possible', STOP_S)
        log.info('recording bag %s', name)
        return True, name

    def _stop(self, deadline_s: float) -> Answer:
        current, end_s = self._current, time.monotonic() + deadline_s
        assert current is not None
        if not self._listen(False, deadline_s):
            log.warning('the intake did not stop recording within %.1f s', deadline_s)
        done = self._stop_after(current.recording, max(0.5, end_s - time.monotonic()))
        self._current = None
        recording = current.recording
        if not done.wait(max(0.0, end_s - time.monotonic())):
            return False, f'{recording.state.bag} was not completed within {deadline_s:g} s; it will be as soon as possible'
        text = f'{recording.state.bag}: {recording.messages:,} messages in {len(recording.state.slices)} slices'
        if not recording.state.is_named:
            text += '; it waits until the clock of this machine is set'
        log.info('%s', text)
        return True, text

    def _stop_after(self, recording: Recording, deadline_s: float, then: Recording | None = None) -> threading.Event:
        """Have the thread end a bag after the queued messages, and write the following ones to the next bag."""
        done = threading.Event()

        def end() -> None:
            self._writing = None
            recording.output.count_dropped(self._queue.take_dropped())
            try:
                if recording.close(deadline_s):
                    done.set()
            finally:
                if then is not None:
                    self._write_to(then)

        self._queue.mark(end)
        return done

    # -- the thread ------------------------------------------------------------------------------------------------

    def _write_to(self, recording: Recording) -> None:
        self._writing = recording
        self._due_s = time.monotonic() + SYNC_S

    def _step(self) -> None:
        """Wait for messages and write them; sync when it is due."""
        self._queue.wait(self._due_s - time.monotonic() if self._writing is not None else IDLE_S)
        while (item := self._queue.next()) is not None:
            if not isinstance(item, MessageBatch):
                item()
            elif self._writing is not None:
                self._writing.write(item)
            elif not item.paused:
                messages = item.messages
                self._context.spool.accounts.drop(f'{BAG}{item.topic}', 'stopped', len(messages), messages[0].times,
                                                messages[-1].times)  # fmt: skip
            self._sync()
        self._sync()

    def _sync(self) -> None:
        if self._writing is not None and time.monotonic() >= self._due_s:
            self._writing.output.count_dropped(self._queue.take_dropped())
            self._writing.tick()
            self._due_s = time.monotonic() + SYNC_S
