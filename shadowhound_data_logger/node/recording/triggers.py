"""Detects triggers of events: a number that crosses a threshold, or an event logged by the active mission's agent.

Messages are deserialized here, not in the intake, and only some of them (``Inbox``). Missions are read from the disk.
"""

from __future__ import annotations

import json
import logging
import math
import re
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from shadowhound_data_logger.bags.manifest import MissionOf
from shadowhound_data_logger.bags.recorder import Answer
from shadowhound_data_logger.core.clock import SECOND, Clock, now_ns
from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.core.expression import Condition
from shadowhound_data_logger.core.model import Taken
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.missions import journal
from shadowhound_data_logger.missions.folder import MISSIONS, MissionFolder
from shadowhound_data_logger.node.recording.mission_observer import number_at

log = logging.getLogger(__name__)

SEEN: Final = 10
"""Messages per drain that conditions check, evenly spaced: 50 per second."""
LARGE_BYTES: Final = 64 << 10
"""On topics with larger messages, only the newest is checked."""
REARM_S: Final = 1.0
"""Minimum time for which a condition must be false before it triggers again."""
LATE_NS: Final = 10 * 10**9
"""Older events of an agent are not triggers: the node has just been started, or the clock was set."""
LOOK_S: Final = 0.2
PATIENCE_S: Final = 30.0
DETAIL_BYTES: Final = 1000
"""Maximum size of the data an agent logged with an event, in the manifest."""
CONDITION, LOG_EVENT = 'condition', 'log_event'
"""What triggered."""
Trigger = Callable[[str, str, str, float], Answer]


class Inbox:
    """Messages for the conditions. ``put`` by the intake, ``take`` by one other thread; the oldest are dropped."""

    def __init__(self, watched: Iterable[tuple[str, Condition]]) -> None:
        """Conditions with the full names of their topics."""
        self.conditions: dict[str, list[Condition]] = {}
        for topic, condition in watched:
            self.conditions.setdefault(topic, []).append(condition)
        self._received: dict[str, deque[tuple[float, str, Taken]]] = {topic: deque(maxlen=2 * SEEN) for topic in self.conditions}
        self._single = {topic: all(each.test.hold_s for each in found) for topic, found in self.conditions.items()}

    def put(self, topic: str, type_name: str, taken: Sequence[Taken], now_s: float) -> None:
        """A condition with a hold time needs only one message per drain."""
        few = self._single[topic] or len(taken[-1].cdr) > LARGE_BYTES
        step = len(taken) if few else -(-len(taken) // SEEN)
        received = self._received[topic]
        if few:
            received.clear()
        received.extend((now_s, type_name, message) for message in taken[(len(taken) - 1) % step :: step])

    def take(self, topic: str) -> Iterable[tuple[float, str, Taken]]:
        """Time of the drain, type and message; oldest first."""
        received = self._received[topic]
        while received:
            try:
                yield received.popleft()
            except IndexError:  # the intake has just cleared it
                return


class ConditionState:
    """Evaluates one condition. New; ``poll`` with each number. One thread.

    It triggers once the condition has been true for its time, and again only after it has been false for as long, at least a
    second:
    a number that oscillates around its threshold makes one event.
    """

    def __init__(self, condition: Condition) -> None:
        self.condition = condition
        self._armed = True
        self._since_s: float | None = None
        """Since when it has been true while armed, false otherwise; None while it is the opposite."""

    def poll(self, value: float, now_s: float) -> bool:
        """Whether this number, at that time of the monotonic clock, triggers. NaN triggers nothing."""
        if not math.isfinite(value):
            return False
        if bool(self.condition.test.holds(value)) is not self._armed:
            self._since_s = None
            return False
        if self._since_s is None:
            self._since_s = now_s
        hold_s = self.condition.test.hold_s if self._armed else max(self.condition.test.hold_s, REARM_S)
        if now_s - self._since_s < hold_s:
            return False
        self._armed, self._since_s = not self._armed, None
        return not self._armed


class Logged(NamedTuple):
    """An event logged by an agent with ``log_event``."""

    name: str
    age_ns: int
    """Time since it was logged."""
    data: Any


class JournalTail:
    """Reads what is appended to the journal of a mission. New; call ``new`` repeatedly. One thread."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0

    def new(self, now_ns: int) -> Iterator[Logged]:
        """The events since the last call; old ones are skipped. An unreadable journal has none."""
        try:
            if self._path.stat().st_size <= self._offset:
                return
            for line in journal.read(self._path, self._offset):
                self._offset = line.end
                record = line.record or {}
                if record.get('k') == 'event':
                    age_ns = now_ns - int(record['t'])
                    if age_ns <= LATE_NS:
                        yield Logged(str(record['name']), max(0, age_ns), record.get('data'))
        except OSError:
            return


class EventWatch:
    """Watches for triggers of events: conditions, and events logged by agents.

    Lifecycle: New; open once; ``on_mission`` from any thread; close once. Owns the thread ``event-watch``.
    """

    def __init__(self, inbox: Inbox, types: MessageTypes, home: Path, clock: Clock, log_event: str, trigger: Trigger) -> None:
        """``log_event`` is a regular expression for names of events logged by agents; empty for none."""
        self._inbox = inbox
        self._types = types
        self._home = home
        self._clock = clock
        self._trigger = trigger
        self._conditions = {topic: [ConditionState(each) for each in found] for topic, found in inbox.conditions.items()}
        self._wanted = _compiled(log_event)
        self._missions: Sequence[str] = ()
        self._tails: dict[str, JournalTail] = {}
        self._logged: set[str] = set()
        self._wake = threading.Event()
        self.worker = Worker('event-watch', self._step, patience_s=PATIENCE_S)

    def open(self) -> None:
        self.worker.start()

    def close(self, deadline_s: float) -> bool:
        self.worker.stop()
        self._wake.set()
        return self.worker.join(deadline_s)

    def update(self, log_event: str) -> None:
        """Apply another expression."""
        self._wanted = _compiled(log_event)

    def on_mission(self, mission: MissionOf | None) -> None:
        """The active mission changed."""
        self._missions = (mission.mission_id,) if mission is not None and mission.mission_id else ()

    def _step(self) -> None:
        self._wake.wait(LOOK_S)
        for topic, states in self._conditions.items():
            for now_s, type_name, message in self._inbox.take(topic):
                self._evaluate(topic, type_name, message.cdr, states, now_s)
        self._follow()

    def _evaluate(self, topic: str, type_name: str, cdr: bytes, states: Sequence[ConditionState], now_s: float) -> None:
        try:
            message = self._types.deserialize(type_name, cdr)
        except Rejected as error:
            self._log_once(topic, f'{topic} cannot be used in conditions: {error}')
            return
        for state in states:
            condition = state.condition
            test = condition.test
            value = number_at(message, test.path.split('.'))
            if value is None:
                self._log_once(condition.name, f'{type_name} has no number {test.path} ({test.text})')
            elif state.poll(value, now_s):
                self._trigger(condition.name, CONDITION, f'{test.text}: {value:g}', 0.0)

    def _follow(self) -> None:
        """Read the events of agents; the journal of a mission that ended is read once more."""
        missions = self._missions
        for name in missions:
            if name not in self._tails:
                self._tails[name] = JournalTail(MissionFolder(self._home / MISSIONS / name).journal)
        for name in tuple(self._tails):
            for logged in self._tails[name].new(now_ns(self._clock)):
                if self._wanted is not None and self._wanted.search(logged.name):
                    detail = json.dumps(logged.data, ensure_ascii=False)[:DETAIL_BYTES] if logged.data else ''
                    self._trigger(logged.name, LOG_EVENT, detail, logged.age_ns / SECOND)
            if name not in missions:
                del self._tails[name]

    def _log_once(self, what: str, text: str) -> None:
        """Log once."""
        if what not in self._logged:
            self._logged.add(what)
            log.warning('%s', text)


def _compiled(expression: str) -> re.Pattern[str] | None:
    return re.compile(expression) if expression else None
