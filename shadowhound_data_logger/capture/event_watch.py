"""Watches for what triggers events by itself: conditions on messages, and what the active mission's agent logs.

Messages are deserialized here, off the intake, some of them only (``event_tap.Inbox``). Of missions it reads the disk.
"""

from __future__ import annotations

import json
import logging
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.bags.recorder import Answer
from shadowhound_data_logger.bags.triggers import JournalTail, Judge
from shadowhound_data_logger.capture.event_tap import Inbox
from shadowhound_data_logger.capture.mission_tap import number_at
from shadowhound_data_logger.clock import SECOND, Clock
from shadowhound_data_logger.encode.types import MessageTypes
from shadowhound_data_logger.errors import Rejected
from shadowhound_data_logger.missions.dating import now_ns
from shadowhound_data_logger.missions.folder import FOLDER, MissionFolder
from shadowhound_data_logger.worker import Worker

log = logging.getLogger(__name__)

LOOK_S: Final = 0.2
PATIENCE_S: Final = 30.0
DETAIL_BYTES: Final = 1000
"""Of what an agent logged with an event, in the manifest."""
CONDITION, LOG_EVENT = 'condition', 'log_event'
"""What triggered."""
Trigger = Callable[[str, str, str, float], Answer]


class EventWatch:
    """Life: New; open once; ``on_mission`` from any thread; close once. Owns the thread ``event-watch``."""

    def __init__(self, inbox: Inbox, types: MessageTypes, home: Path, clock: Clock, log_event: str, trigger: Trigger) -> None:
        """``log_event`` is a regular expression for names of what an agent logs; empty for none."""
        self._inbox = inbox
        self._types = types
        self._home = home
        self._clock = clock
        self._trigger = trigger
        self._judges = {topic: [Judge(each) for each in found] for topic, found in inbox.conditions.items()}
        self._wanted = _compiled(log_event)
        self._missions: Sequence[str] = ()
        self._tails: dict[str, JournalTail] = {}
        self._told: set[str] = set()
        self._wake = threading.Event()
        self.worker = Worker('event-watch', self._step, patience_s=PATIENCE_S)

    def open(self) -> None:
        self.worker.start()

    def close(self, deadline_s: float) -> bool:
        self.worker.stop()
        self._wake.set()
        return self.worker.join(deadline_s)

    def update(self, log_event: str) -> None:
        """Go on by another expression."""
        self._wanted = _compiled(log_event)

    def on_mission(self, told: Mapping[str, Any]) -> None:
        """Which mission is active now (``MissionWatch.status``); empty for none."""
        self._missions = (str(told['mission_id']),) if told else ()

    def _step(self) -> None:
        self._wake.wait(LOOK_S)
        for topic, judges in self._judges.items():
            for now_s, type_name, message in self._inbox.take(topic):
                self._judge(topic, type_name, message.cdr, judges, now_s)
        self._follow()

    def _judge(self, topic: str, type_name: str, cdr: bytes, judges: Sequence[Judge], now_s: float) -> None:
        try:
            message = self._types.deserialize(type_name, cdr)
        except Rejected as error:
            self._tell(topic, f'{topic} tells no condition anything: {error}')
            return
        for judge in judges:
            condition = judge.condition
            value = number_at(message, list(condition.field))
            if value is None:
                self._tell(condition.name, f'{type_name} has no number {".".join(condition.field)} ({condition.text})')
            elif judge.look(value, now_s):
                self._trigger(condition.name, CONDITION, f'{condition.text}: {value:g}', 0.0)

    def _follow(self) -> None:
        """Read what agents logged; the journal of a mission that is over once more."""
        missions = self._missions
        for name in missions:
            if name not in self._tails:
                self._tails[name] = JournalTail(MissionFolder(self._home / FOLDER / name).journal)
        for name in tuple(self._tails):
            for logged in self._tails[name].new(now_ns(self._clock)):
                if self._wanted is not None and self._wanted.search(logged.name):
                    detail = json.dumps(logged.data, ensure_ascii=False)[:DETAIL_BYTES] if logged.data else ''
                    self._trigger(logged.name, LOG_EVENT, detail, logged.age_ns / SECOND)
            if name not in missions:
                del self._tails[name]

    def _tell(self, what: str, text: str) -> None:
        """Once."""
        if what not in self._told:
            self._told.add(what)
            log.warning('%s', text)


def _compiled(expression: str) -> re.Pattern[str] | None:
    return re.compile(expression) if expression else None
