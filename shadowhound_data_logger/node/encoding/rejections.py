"""Logs rejected messages with a remedy, once per minute for each topic, reason and publishing node.

The ledger counts every rejected message; the log reports what is wrong and what to change, as long as it continues.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

from shadowhound_data_logger.formats.payload import Rejection

log = logging.getLogger(__name__)

PERIOD_S: Final = 60.0
MAX_KNOWN: Final = 1000
"""Maximum number of remembered publishers, and of pairs of reason and node; a robot in trouble has a few."""
ENCODER_FAILED: Final = 'encoder_failed'
"""The reason for samples whose encoder has a bug."""
REMEDIES: Final = {
    'size_mismatch': 'the message is inconsistent, report it there; {sensor}.format: cdr stores such messages unchanged',
    'unknown_type': 'install and source the package of its type; {sensor}.format: cdr needs no definition',
    'wrong_type': '{sensor}.format: json or cdr stores every type',
    'too_large': '{sensor}.format: png has no such limit',
    'unsafe_key': 'change {sensor}.key',
    'surplus': '{sensor}.format holds one message: set {sensor}.batch_s to 0, or use tar or zip',
    ENCODER_FAILED: 'this is a bug of the logger: report it with the traceback from this log',
}
"""By reason."""
_OTHERWISE: Final = '{sensor}.format: cdr stores such messages unchanged'
NodeOf = Callable[[str, str], str]
"""From a topic and a publisher's gid to the full name of its node; '' if unknown."""


@dataclass(slots=True)
class _Entry:
    """The state of one topic, reason and node."""

    sensor: str
    newest: Rejection
    reported_s: float
    waiting: int = 0
    """Messages since the last report."""


class RejectionLog:
    """Writes the reports. Thread-safe; ``_lock`` guards all state."""

    def __init__(self, node_of: NodeOf = lambda _topic, _gid: '', monotonic: Callable[[], float] = time.monotonic) -> None:
        self._node_of = node_of
        self._monotonic = monotonic
        self._lock = threading.Lock()
        self._names: dict[tuple[str, str], str] = {}
        self._entries: dict[tuple[str, str, str], _Entry] = {}
        self._due_s = 0.0

    def add(self, topic: str, sensor: str, rejections: Iterable[Rejection], *, is_known: bool = False) -> None:
        """Messages of a topic were rejected: log the first of a kind immediately, unless it ``is_known``; further ones after a
        minute.
        """
        now_s = self._monotonic()
        with self._lock:
            for each in rejections:
                key = topic, each.reason, self._name(topic, each.publisher)
                entry = self._entries.get(key)
                if entry is None:
                    if len(self._entries) >= MAX_KNOWN:
                        self._entries.clear()
                    entry = self._entries[key] = _Entry(sensor, each, now_s)
                    if not is_known:
                        self._report(key, sensor, each, 'a message')
                        entry.waiting = -1
                entry.waiting, entry.newest = entry.waiting + each.count, each
        self.poll()

    def poll(self) -> None:
        """Log the reports that are due; cheap to call often."""
        now_s = self._monotonic()
        if now_s < self._due_s:
            return
        with self._lock:
            self._due_s = now_s + 1.0
            for key, entry in self._entries.items():
                if entry.waiting and now_s - entry.reported_s >= PERIOD_S:
                    since_s = now_s - entry.reported_s
                    what = f'{entry.waiting:,} more {"message" if entry.waiting == 1 else "messages"} in {since_s:.0f} s'
                    entry.reported_s, entry.waiting = now_s, 0
                    self._report(key, entry.sensor, entry.newest, what)

    def _name(self, topic: str, publisher: str) -> str:
        if not publisher:
            return ''
        name = self._names.get((topic, publisher))
        if name is None:
            if len(self._names) >= MAX_KNOWN:
                self._names.clear()
            name = self._names[topic, publisher] = self._node_of(topic, publisher)
        return name

    @staticmethod
    def _report(key: tuple[str, str, str], sensor: str, rejection: Rejection, what: str) -> None:
        topic, reason, node = key
        remedy = rejection.remedy or REMEDIES.get(reason, _OTHERWISE).format(sensor=sensor)
        log.warning('%s: %s%s cannot be stored: %s (%s)', topic, what, f' of {node}' if node else '', rejection.text, remedy)
