"""Events: a trigger records a bag of the seconds before and after it. A separate thread writes it from the ring.

A trigger during an event extends the event and is listed in its manifest. If that would exceed the maximum length, another event
follows, with no message lost between them and none in both. The writer removes the messages from the ring piece by piece: there
is no second copy, and the intake never waits.

The messages that events claim have separate accounts (EVENT): they are stored, dropped (``ring_full``: evicted before they were
written; ``paused``; rejected by the disk) or open. Messages that no event claims are in no account.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from shadowhound_data_logger.bags.context import BagContext
from shadowhound_data_logger.bags.manifest import ClockOf, EventOf, MissionOf, TriggerOf
from shadowhound_data_logger.bags.recorder import SYNC_S, Answer
from shadowhound_data_logger.bags.recording import UNWRITABLE, Recording
from shadowhound_data_logger.bags.recovery import BagRecovery
from shadowhound_data_logger.bags.ring import EventAccounts, Ring
from shadowhound_data_logger.bags.state import BagState
from shadowhound_data_logger.core.clock import SECOND, iso
from shadowhound_data_logger.core.options import BagSettings, EventSettings
from shadowhound_data_logger.core.status import EventStatus, Trigger
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.missions.folder import safe_type

log = logging.getLogger(__name__)

PREFIX: Final = 'event_'
NOTICE_S: Final = 1.0
"""The ring keeps messages this much longer than ``pre_s``, because a trigger may arrive late."""
STEP_S: Final = 0.2
IDLE_S: Final = 10.0
"""Maximum wait without an event; well below ``PATIENCE_S``, or the idle writer would be reported as blocked."""
RETRY_S: Final = 5.0
"""Time between attempts to create a bag on a disk that accepts no writes."""
FLUSH_S: Final = 5.0
MAX_WAIT_NS: Final = 24 * 3600 * SECOND
"""No trigger waits longer than this for its event; a larger difference is one between two clocks."""
PATIENCE_S: Final = 30.0


@dataclass(slots=True)
class _Event:
    """The active event. ``bag``, ``of`` and ``until_s`` change under the lock; ``recording`` belongs to the writer."""

    bag: str
    of: EventOf
    until_s: float
    at_most_s: float
    unset_clock: ClockOf | None
    """The clock, if it was not set when the event was triggered."""
    recording: Recording | None = None
    again_s: float = 0.0
    refused: str = ''


class Events:
    """Records events: for each trigger, a bag of the messages in the ring and of those that follow.

    Lifecycle: new; ``open`` once; ``trigger`` and ``status`` from any thread; ``close`` after the intake is closed.

    ``_lock`` guards the active event and its triggers; the thread ``event-writer`` writes the bags.
    """

    def __init__(self, settings: EventSettings, bag: BagSettings, context: BagContext, ring: Ring, recovery: BagRecovery,
                 poll_s: float, monotonic: Callable[[], float] = time.monotonic) -> None:  # fmt: skip
        """``poll_s``: maximum delay with which the intake takes a message."""
        self._settings = settings
        self._bag = bag
        self._context = context
        self._ring = ring
        self.claims = EventAccounts(context.spool.accounts)
        self._recovery = recovery
        self._poll_s = poll_s
        self._monotonic = monotonic
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._current: _Event | None = None
        self._waiting: list[TriggerOf] = []
        self._mission: MissionOf | None = None
        self._closed = False
        self._ended = threading.Event()
        self._ended.set()
        self._due_s = 0.0
        self._triggers = self._written = 0
        self._last = Trigger()
        self._worker = Worker('event-writer', self._step, patience_s=PATIENCE_S)

    @property
    def workers(self) -> Sequence[Worker]:
        return [self._worker] if self._settings.enabled else []

    def open(self) -> None:
        if self._settings.enabled:
            self._worker.start()

    def close(self, deadline_s: float) -> bool:
        """End the active event with the messages in the ring; False if that timed out: then the next start completes it."""
        end_s = time.monotonic() + deadline_s
        with self._lock:
            self._closed = True
            self._waiting.clear()
            if self._current is not None:
                self._current.until_s = min(self._current.until_s, self._monotonic() - self._poll_s)
        self._wake.set()
        is_complete = self._ended.wait(max(0.0, deadline_s))
        self._worker.stop()
        self._wake.set()
        return self._worker.join(max(0.1, end_s - time.monotonic())) and is_complete

    def update(self, settings: EventSettings) -> None:
        """Use new values of the settings that can be changed at run time."""
        self._settings = settings
        self._ring.max_bytes, self._ring.keep_s = settings.max_bytes, settings.pre_s + NOTICE_S

    def on_mission(self, mission: MissionOf | None) -> None:
        """Set the active mission."""
        self._mission = mission

    def status(self) -> EventStatus:
        """The status, from any thread."""
        if not self._settings.enabled:
            return EventStatus()
        event, ring = self._current, self._ring
        refused = '' if event is None else event.refused or (event.recording.refused if event.recording is not None else '')
        return EventStatus(
            enabled=True, seconds=round(ring.seconds, 1), bytes=ring.bytes, max_bytes=ring.max_bytes,
            bag=event.bag if event is not None else '', refused=refused, triggers=self._triggers, written=self._written,
            last=self._last,
        )  # fmt: skip

    def trigger(self, name: str, by: str, detail: str | None = None, age_s: float = 0.0, who: str = '') -> Answer:
        """Start an event about something that happened ``age_s`` ago, or extend the active one. The answer names the bag.

        ``who`` is the person who requested it, if known.
        """
        with self._lock:
            if not self._settings.enabled:
                return False, 'no events: neither events.topics nor events.regex names a topic to keep'
            if self._closed:
                return False, 'no event can start: the node is shutting down'
            self._triggers += 1
            now_s, event = self._monotonic(), self._current
            unset_clock = self._context.unset_clock() if event is None else event.unset_clock
            trigger = TriggerOf(
                name, by, max(0, self._context.now_ns(unset_clock) - round(age_s * SECOND)), detail or None, who or None
            )
            if event is None:
                event = self._current = self._begin([trigger], now_s - age_s)
                self._ended.clear()
                text = f'{event.bag} starts'
            elif now_s - age_s + self._settings.post_s <= event.at_most_s:
                event.of = replace(event.of, triggers=(*event.of.triggers, trigger))
                event.until_s = max(event.until_s, now_s - age_s + self._settings.post_s)
                text = f'{event.bag} is extended'
            else:
                self._waiting.append(trigger)
                text = f'another event follows {event.bag}, which has reached its maximum length'
            self._last = Trigger(name, by, iso(trigger.at_ns), event.bag)
            self._wake.set()
        log.info('event %s (%s): %s', name, by, text)
        return True, text

    # -- under the lock --------------------------------------------------------------------------------------------

    def _begin(self, triggers: Sequence[TriggerOf], at_s: float, since_s: float | None = None) -> _Event:
        """An event about the time ``at_s``; ``since_s`` is the end of the event that it follows."""
        settings = self._settings
        oldest_s = self._ring.claim(at_s - settings.pre_s if since_s is None else since_s, self._context.clock.wall_ns())
        held_s = 0.0 if oldest_s is None or since_s is not None else min(max(0.0, at_s - oldest_s), settings.pre_s)
        name = safe_type(triggers[0].name)
        if since_s is None:
            self.claims.begin()
        age_ns = max(0, self._context.clock.wall_ns() - triggers[0].at_ns)
        age_ns = age_ns if age_ns < MAX_WAIT_NS else 0
        unset_clock = self._context.unset_clock(age_ns)
        bag = self._context.name(f'{PREFIX}{name}', unset_clock, age_ns)
        of = EventOf(name, settings.pre_s, round(held_s, 3), settings.post_s, tuple(triggers))
        return _Event(bag, of, at_s + settings.post_s, at_s + settings.max_s, unset_clock)

    def _end(self, event: _Event) -> bool:
        """Whether the event has ended; if so, the next waiting one starts, or the ring is released."""
        with self._lock:
            now_s = self._monotonic()
            if now_s < event.until_s + self._poll_s:
                return False
            waiting, self._waiting = self._waiting, []
            if waiting:
                self._current = self._begin(waiting, now_s, event.until_s)
                self._wake.set()
            else:
                self._ring.release()
                self._current = None
                self._ended.set()
            return True

    # -- the thread ------------------------------------------------------------------------------------------------

    def _step(self) -> None:
        """Wait for messages and write them; sync when it is due."""
        self._wake.wait(STEP_S if self._current is not None else IDLE_S)
        self._wake.clear()
        event = self._current
        if event is None:
            return
        is_over = self._monotonic() >= event.until_s + self._poll_s
        if event.recording is None and not self._open_bag(event):
            if is_over:
                self._give_up(event)
            return
        self._write(event)
        if is_over and self._end(event):
            self._close_bag(event)

    def _open_bag(self, event: _Event) -> bool:
        """Create the bag's folder; False while the disk accepts no writes."""
        now_s = self._monotonic()
        if now_s < event.again_s:
            return False
        try:
            state = BagState.begin(
                self._context.root / event.bag, self._context.robot, self._mission, event.of, event.unset_clock
            )
        except OSError as error:
            event.again_s = now_s + RETRY_S
            if not event.refused:
                log.error('%s is not written while the disk accepts no writes: %s', event.bag, error)  # noqa: TRY400 - an operator's
            event.refused = UNWRITABLE
            return False
        event.refused = ''
        event.recording = Recording(state, self._bag, self._context, self._recovery)
        self._due_s = now_s + SYNC_S
        return True

    def _write(self, event: _Event) -> None:
        """Write the messages that the ring has for the event."""
        recording = event.recording
        assert recording is not None
        self._store_triggers(event, recording)
        while held := self._ring.next(event.until_s + self._poll_s):
            fresh = self.claims.receive(held)
            if fresh:
                recording.write(held.batch._replace(messages=fresh))
            self._sync(recording)
        recording.output.count_dropped(self.claims.take_dropped())
        self._sync(recording)

    def _sync(self, recording: Recording) -> None:
        if self._monotonic() >= self._due_s:
            recording.tick()
            self._due_s = self._monotonic() + SYNC_S

    def _store_triggers(self, event: _Event, recording: Recording) -> None:
        if recording.state.event is not event.of:
            recording.set_event(event.of)

    def _close_bag(self, event: _Event) -> None:
        recording = event.recording
        assert recording is not None
        before, mission = recording.state.mission, self._mission
        self._store_triggers(event, recording)
        if mission is not None and before is not None and before.mission_id == mission.mission_id:
            recording.set_mission(mission)
        is_complete = recording.close(FLUSH_S)
        self._written += 1
        log.log(logging.INFO if is_complete else logging.WARNING, '%s: %d messages%s', event.bag, recording.messages,
                '' if is_complete else '; the next start completes it')  # fmt: skip

    def _give_up(self, event: _Event) -> None:
        """The disk accepted no writes during the event: drop its messages."""
        while held := self._ring.next(event.until_s + self._poll_s):
            self.claims.lose([held], UNWRITABLE)
        if self._end(event):
            log.error('%s is lost: the disk accepted no writes', event.bag)
