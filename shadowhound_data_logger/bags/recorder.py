"""Decides which bag is recorded, and owns its writing thread: started and stopped by service, by missions, or with the node.

What the intake hands over lies in a bounded queue; starts, splits and stops lie in it as well, so that each comes between the
very messages where it was asked for. Nothing runs before the first recording.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from shadowhound_data_logger.bags.manifest import MissionOf
from shadowhound_data_logger.bags.place import BagPlace
from shadowhound_data_logger.bags.queue import BagQueue, Lot
from shadowhound_data_logger.bags.recording import Recording
from shadowhound_data_logger.bags.recovery import BagRecovery
from shadowhound_data_logger.bags.state import BagState
from shadowhound_data_logger.core.options import BagSettings
from shadowhound_data_logger.core.status import BagStatus
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.spool.accounts import BAG

log = logging.getLogger(__name__)

SYNC_S: Final = 0.5
"""Between two syncs: with a poll of the intake before it a message is less than a second from the disk."""
IDLE_S: Final = 10.0
"""Between two looks of a thread that has nothing to do; well below its patience."""
PATIENCE_S: Final = 30.0
"""A round that lasts longer hangs in the disk."""
STOP_S: Final = 5.0
SERVICE, MISSION, ALWAYS = 'service', 'mission', 'always'
"""Who began a recording; also the settings' words for when one begins."""
Answer = tuple[bool, str]
"""Whether it was done, and what, in words."""


@dataclass(slots=True)
class _Current:
    """A recording with who began it and when."""

    recording: Recording
    by: str
    began_s: float
    dropped_before: int


class Recorder:
    """Starts, splits and stops recordings, and writes their messages.

    Life: New; open once; start, stop, ... from any thread; ``close`` before the intake is closed.

    ``_control`` makes each of these one step; the recording itself belongs to the thread ``bag-writer``.
    """

    def __init__(self, settings: BagSettings, place: BagPlace, queue: BagQueue, recovery: BagRecovery,
                 listen: Callable[[bool, float], bool]) -> None:  # fmt: skip
        """``listen`` has the intake begin (True) or end, and says whether that was done within so many seconds."""
        self._settings = settings
        self._place = place
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
        """Those that have something to do."""
        return *([self._worker] if self._started else []), *([self._recovery.worker] if self._recovery.is_busy else [])

    def open(self) -> None:
        """After the intake: make whole what was cut off, and begin if that is wanted."""
        self._recovery.open()
        if self._settings.record == ALWAYS:
            self._begin_by(ALWAYS)

    def close(self, deadline_s: float) -> bool:
        """End the bag and the threads; False when that took too long, and the next start goes on with it."""
        end_s = time.monotonic() + deadline_s
        with self._control:
            ended = self._current is None or self._stop(deadline_s)[0]
            self._recovery.close(max(0.0, end_s - time.monotonic()))
            self._worker.stop()
            self._queue.mark(lambda: None)
            return self._worker.join(max(0.1, end_s - time.monotonic())) and ended

    def status(self) -> BagStatus:
        """From any thread."""
        current = self._current
        if current is None:
            return BagStatus()
        recording = current.recording
        return BagStatus(
            recording=True, paused=self._queue.paused, bag=recording.state.bag, slice=max(0, recording.number),
            messages=recording.messages, bytes=recording.bytes,
            dropped=recording.dropped + self._queue.dropped - current.dropped_before,
            duration_s=round(time.monotonic() - current.began_s, 1), queue_bytes=self._queue.bytes, refused=recording.refused,
        )  # fmt: skip

    # -- what can be asked -----------------------------------------------------------------------------------------

    def start(self) -> Answer:
        """Begin a bag, of the mission where one is active."""
        with self._control:
            if self._current is not None:
                return False, f'{self._current.recording.state.bag} is recorded already'
            return self._start(SERVICE, self._mission)

    def stop(self, deadline_s: float = STOP_S) -> Answer:
        """End the bag; it is whole in the spool then."""
        with self._control:
            if self._current is None:
                return False, 'nothing is recorded'
            return self._stop(deadline_s)

    def split(self, deadline_s: float = STOP_S) -> Answer:
        """End the slice; the next message begins another."""
        with self._control:
            if self._current is None:
                return False, 'nothing is recorded'
            recording, done = self._current.recording, threading.Event()

            def split() -> None:
                recording.split()
                done.set()

            self._queue.mark(split)
            if not done.wait(deadline_s):
                return False, f'the slice was not closed within {deadline_s:g} s; it is as soon as that is possible'
            return True, f'{recording.state.bag} has {len(recording.state.slices)} slices that are closed'

    def pause(self, *, paused: bool) -> Answer:
        """Begin or end a pause: what comes meanwhile is counted, and dropped."""
        with self._control:
            if self._current is None:
                return False, 'nothing is recorded'
            self._queue.paused = paused
            return True, f'{self._current.recording.state.bag} is {"paused" if paused else "recorded"}'

    def on_mission(self, mission: MissionOf | None) -> None:
        """The mission that is active now."""
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
                self._turn(mission)

    def look(self) -> None:
        """Every second or so: what began before the clock was set ends when it is, and another bag follows without a pause."""
        if not self._control.acquire(blocking=False):
            return  # somebody begins or ends one now
        try:
            current = self._current
            if current is not None and self._place.is_due(current.recording.state):
                self._start(current.by, current.recording.state.mission, after=current)
        finally:
            self._control.release()

    # -- starts and stops, under the lock --------------------------------------------------------------------------

    def _turn(self, mission: MissionOf | None) -> None:
        """A mission began or ended, and bags follow missions. One bag follows the other without a message between them."""
        current = self._current
        if mission is None and self._settings.record == MISSION:
            if current is not None:
                self._stop(STOP_S)
            return
        if current is None and self._settings.record == ALWAYS:
            return  # somebody stopped it
        self._start(ALWAYS if mission is None else MISSION, mission, after=current)

    def _begin_by(self, by: str) -> None:
        with self._control:
            self._start(by, self._mission)

    def _start(self, by: str, mission: MissionOf | None, *, after: _Current | None = None) -> Answer:
        """``after``: the recording that this one follows."""
        place = self._place
        unset = place.unset()
        name = place.name(mission.type if mission is not None else '', unset)
        try:
            state = BagState.begin(place.root / name, place.robot, mission, clock=unset)
        except OSError as error:
            log.error('no bag is recorded: %s', error)  # noqa: TRY400 - an operator's matter
            if after is not None:
                self._stop(STOP_S)
            return False, f'no bag can be made in {place.root}: {error.strerror}'
        goes_on = by == ALWAYS or after is not None or (mission is not None and mission.mission_id in self._recovery.missions)
        if not goes_on:
            self._place.spool.accounts.rebase_all(BAG)
        recording = Recording(state, self._settings, place, self._recovery)
        self._current = _Current(recording, by, time.monotonic(), self._queue.dropped)
        self._queue.paused = self._queue.paused and after is not None
        if after is None:
            self._queue.take_lost()
        if not self._started:
            self._started = True
            self._worker.start()
        if after is None:
            self._queue.mark(lambda: self._write_to(recording))
        else:
            self._end_after(after.recording, STOP_S, then=recording)
        if not self._listen(True, STOP_S):
            log.warning('the intake did not begin to record within %.0f s; it will as soon as it can', STOP_S)
        log.info('recording bag %s', name)
        return True, name

    def _stop(self, deadline_s: float) -> Answer:
        current, end_s = self._current, time.monotonic() + deadline_s
        assert current is not None
        if not self._listen(False, deadline_s):
            log.warning('the intake did not end the recording within %.1f s', deadline_s)
        done = self._end_after(current.recording, max(0.5, end_s - time.monotonic()))
        self._current = None
        recording = current.recording
        if not done.wait(max(0.0, end_s - time.monotonic())):
            return False, f'{recording.state.bag} is not whole within {deadline_s:g} s; it is as soon as that is possible'
        text = f'{recording.state.bag}: {recording.messages:,} messages in {len(recording.state.slices)} slices'
        if not recording.state.is_named:
            text += '; it waits for the clock of this machine to be set'
        log.info('%s', text)
        return True, text

    def _end_after(self, recording: Recording, deadline_s: float, then: Recording | None = None) -> threading.Event:
        """Have the thread end a bag after all that waits for it, and write to the next one without a message between them."""
        done = threading.Event()

        def end() -> None:
            self._writing = None
            recording.leave_out(self._queue.take_lost())
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
        """Wait until there is something to write, and write it; sync when it is time."""
        self._queue.wait(self._due_s - time.monotonic() if self._writing is not None else IDLE_S)
        while (item := self._queue.next()) is not None:
            if not isinstance(item, Lot):
                item()
            elif self._writing is not None:
                self._writing.write(item)
            elif not item.paused:
                messages = item.messages
                self._place.spool.accounts.drop(f'{BAG}{item.topic}', 'stopped', len(messages), messages[0].times,
                                                messages[-1].times)  # fmt: skip
            self._sync()
        self._sync()

    def _sync(self) -> None:
        if self._writing is not None and time.monotonic() >= self._due_s:
            self._writing.leave_out(self._queue.take_lost())
            self._writing.tick()
            self._due_s = time.monotonic() + SYNC_S
