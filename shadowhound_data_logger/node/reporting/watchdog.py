"""Detects stalls: topics, threads, encoding, commits and delivery without progress. It only reads the status.

Each stall is one sentence for the operator: what is stalled, for how long, why, what to do. It is logged when it starts and when
it ends.

A topic counts as silent only if its messages arrived evenly before: a latched topic, or one published on events, may be silent
for any time. A topic that was never received is reported if it has no matched publisher, or if it has one and is not allowed to
be silent.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Mapping
from statistics import median
from typing import Any, Final

from shadowhound_data_logger.core.status import NodeStatus, TopicStatus, WorkerStatus

log = logging.getLogger(__name__)

ENCODE_S: Final = 10.0
"""Batches wait, and none was finished for this long."""
DELIVERY_S: Final = 30.0
"""Objects wait, and nothing was sent for this long beyond the timeout of a single request."""
_UNWRITTEN: Final = 'nothing more is written to its bag for {s}: does the disk answer?'
_HANGS_ENCODING: Final = 'one batch has taken {s} so far; others continue if there are more encoder threads'
_HANGING: Final[Mapping[str, str]] = {
    'intake': 'it has taken no messages for {s} and they are being lost; restart the node if that lasts',
    'spool-writer': 'a commit to the spool has taken {s}: its disk does not respond; check dmesg and its cable or card',
    'mission': 'missions have not been followed for {s}; does the disk respond?',
    'bag-writer': _UNWRITTEN,
    'event-writer': _UNWRITTEN,
    'event-watch': 'conditions and events of agents have not been checked for {s}; does the disk respond?',
}
Stalls = Mapping[str, str]
SILENT_S: Final = 5.0
"""A topic is silent after this long ..."""
SILENT_PERIODS: Final = 10
"""... and after this many of its usual periods."""
ARRIVALS: Final = 10
"""Polls with new messages needed to learn a topic's period."""
EVEN: Final = 3.0
"""Maximum ratio of the longest to the usual pause for an even topic."""
UNMATCHED_S: Final = 10.0
"""Discovery takes a second or two on a working WiFi."""
UNRECEIVED_S: Final = 30.0


class Watchdog:
    """Detects stalls.

    New; ``poll`` with each status, in order. ``request_s`` is the maximum duration of one request to the store, seconds.

    The keys of its result are topics, names of threads, ``encode`` and ``delivery``.
    """

    def __init__(self, request_s: float) -> None:
        self._delivery_s = DELIVERY_S + request_s
        self._detectors: dict[str, SilenceDetector] = {}
        self._encoding, self._delivering = _Progress(), _Progress()
        self._logged: Stalls = {}

    def poll(self, status: NodeStatus, now_s: float) -> Stalls:
        """The stalls; ``now_s`` is monotonic time."""
        stuck = {name: text for name, row in status.workers.items() if (text := _hanging(name, row))}
        writes = 'spool-writer' not in stuck and not _failing(status, 'spool-writer')
        found = {name: text for name, text in stuck.items() if writes or not name.startswith('encode-')}
        found |= self._topics(status, now_s, takes='intake' not in stuck and not _failing(status, 'intake'))
        encoding, delivery = self._encode(status, now_s), self._deliver(status, now_s)
        if writes:  # otherwise stages that wait for the disk are not separate stalls
            found |= {name: text for name, text in (('encode', encoding), ('delivery', delivery)) if text}
        self._log_changes(found)
        return found

    def _log_changes(self, found: Stalls) -> None:
        for name in found.keys() - self._logged.keys():
            log.warning('%s: %s', name, found[name])
        for name in self._logged.keys() - found.keys():
            log.info('%s: working again', name)
        self._logged = found

    def _topics(self, status: NodeStatus, now_s: float, *, takes: bool) -> dict[str, str]:
        found = {}
        for topic, row in status.topics.items():
            text = self._detectors.setdefault(topic, SilenceDetector(topic)).poll(row, now_s)
            if text and takes:  # otherwise all of them seem to be silent
                found[topic] = text
        return found

    def _encode(self, status: NodeStatus, now_s: float) -> str:
        queue = status.queue
        idle_s = self._encoding.idle_s(queue.finished, now_s, waiting=bool(queue.batches))
        if idle_s <= ENCODE_S:
            return ''
        errors = {row.last_error for name, row in status.workers.items() if name.startswith('encode-') and row.failing}
        why = f'the encoders fail ({"; ".join(sorted(errors))})' if errors else 'the encoders are busy with what they have'
        return f'no batch was encoded for {idle_s:.0f} s and {queue.batches} wait: {why}; has this machine a core to spare?'

    def _deliver(self, status: NodeStatus, now_s: float) -> str:
        store, pending = status.store, status.spool.pending
        waiting = bool(pending) and store.state in {'idle', 'shipping'}
        moved = store.delivered, store.quarantined, now_s if store.mbps else 0.0
        idle_s = self._delivering.idle_s(moved, now_s, waiting=waiting)
        if idle_s <= self._delivery_s:
            return ''
        return f'{pending} objects wait and nothing was sent for {idle_s:.0f} s: {_why_undelivered(status)}'


class _Progress:
    """Measures how long a value has not changed while something waits."""

    def __init__(self) -> None:
        self._figure: Any = None
        self._since_s = 0.0

    def idle_s(self, figure: Any, now_s: float, *, waiting: bool) -> float:
        if figure != self._figure or not waiting:
            self._figure, self._since_s = figure, now_s
        return now_s - self._since_s


def _failing(status: NodeStatus, name: str) -> bool:
    worker = status.workers.get(name)
    return worker is not None and worker.failing


def _hanging(name: str, row: WorkerStatus) -> str:
    """The consequence of this thread being stuck; empty if it has none."""
    busy_s = row.busy_s
    if row.patience_s is None or busy_s <= row.patience_s:
        return ''
    return _HANGING.get(name, _HANGS_ENCODING).format(s=f'{busy_s:.0f} s')


def _why_undelivered(status: NodeStatus) -> str:
    store = status.store
    errors = {row.last_error for name, row in status.workers.items() if name.startswith('upload-') and row.failing}
    if errors:
        return f'the upload threads fail ({"; ".join(sorted(errors))})'
    if store.in_flight:
        return f'{store.in_flight} uploads hang; does the disk of the store hang, is the network too slow?'
    if store.deferred:
        return f'{store.deferred} objects fail repeatedly: {store.last_error}'
    return 'no upload is in progress, which is a bug in this program; restart the node'


class SilenceDetector:
    """Detects that a topic has fallen silent although its publisher exists. One for each topic."""

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._pauses: deque[tuple[float, int]] = deque(maxlen=ARRIVALS)  # (seconds, messages) between polls
        self._since_s: float | None = None
        self._received_s: float | None = None
        self._received = 0

    def poll(self, row: TopicStatus, now_s: float) -> str:
        """What is wrong with the topic; empty if nothing is."""
        if not row.enabled or not row.publishers:
            self._since_s = None
            return ''
        received = row.received - row.wrong_type
        if self._since_s is None:  # a new publisher has a new period
            self._since_s, self._received_s, self._received = now_s, None, received
            self._pauses.clear()
        if received > self._received:
            self._update(row, received, now_s)
        if row.unavailable:
            return f'it cannot be subscribed to here: {row.unavailable}'
        return (
            self._unreceived(row, now_s - self._since_s)
            if self._received_s is None
            else self._stopped(row, now_s - self._received_s)
        )

    def _update(self, row: TopicStatus, received: int, now_s: float) -> None:
        received_s = now_s - (row.age_s or 0.0)
        if self._received_s is not None:
            self._pauses.append((received_s - self._received_s, received - self._received))
        self._received_s, self._received = received_s, received

    def _unreceived(self, row: TopicStatus, waited_s: float) -> str:
        if not row.matched and waited_s > UNMATCHED_S:
            hint = f'compare type and QoS (ros2 topic info -v {self._topic}), and the firewall between the two machines'
            return f'its publisher has been there for {waited_s:.0f} s without a connection to it; {hint}'
        if row.matched and not row.may_be_silent and waited_s > UNRECEIVED_S:
            hint = f'does it publish (ros2 topic hz {self._topic}), and do large messages pass the network?'
            return f'its publisher has been connected for {waited_s:.0f} s but no message was received; {hint}'
        return ''

    def _stopped(self, row: TopicStatus, silent_s: float) -> str:
        if row.may_be_silent or len(self._pauses) < ARRIVALS:
            return ''
        pauses = [pause for pause, _ in self._pauses]
        period_s = sum(pauses) / sum(count for _, count in self._pauses)
        if max(pauses) > EVEN * median(pauses) or silent_s <= max(SILENT_S, SILENT_PERIODS * period_s):
            return ''
        why = 'check the program that publishes it' if row.matched else 'it is disconnected: check the network'
        return f'silent for {silent_s:.0f} s after {1 / period_s:.3g} Hz, though its publisher is there; {why}'
