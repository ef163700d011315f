"""Notices what makes no progress though it should: topics, threads, encoding, commits, delivery. It only reads the status.

Each stall is one sentence that an operator understands: what stands still, for how long, why, what to do. It is logged when
it begins and when it is over.

A topic is missed only where its messages came evenly before: one that is latched, or published when something happens, may be
silent for as long as it likes. One that was never heard is told where there is no connection at all; and where there is one,
unless the topic may be silent.
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
"""Batches wait, and none was finished for so long."""
DELIVERY_S: Final = 30.0
"""Objects wait, and nothing moved for so long on top of what a single request may take."""
_UNWRITTEN: Final = 'nothing more is written to its bag for {s}: does the disk answer?'
_HANGS_ENCODING: Final = 'one batch has taken {s} so far; others continue if there are more encoder threads'
_HANGING: Final[Mapping[str, str]] = {
    'intake': 'it takes no messages for {s} and they are being lost; start the node again if that lasts',
    'spool-writer': 'a commit to the spool has taken {s}: its disk does not answer; look at dmesg and at its cable or card',
    'mission': 'missions are not followed for {s}, neither their begin and end nor their logs; does the disk answer?',
    'bag-writer': _UNWRITTEN,
    'event-writer': _UNWRITTEN,
    'event-watch': 'neither conditions nor what an agent logs is looked at for {s}; does the disk answer?',
}
Stalls = Mapping[str, str]
SILENT_S: Final = 5.0
"""A topic is silent after so long ..."""
SILENT_PERIODS: Final = 10
"""... and after so many of its usual periods."""
ARRIVALS: Final = 10
"""Looks with new messages that it takes to know a topic."""
EVEN: Final = 3.0
"""Most that the longest pause among those may be of the usual one."""
UNMATCHED_S: Final = 10.0
"""Discovery takes a second or two on a WiFi that works."""
UNHEARD_S: Final = 30.0


class Watchdog:
    """Notices what makes no progress though it should.

    New; ``poll`` at each status, in their order. ``request_s`` is what one request to the store may take, seconds.

    The keys of what it returns are topics, names of threads, ``encode`` and ``delivery``.
    """

    def __init__(self, request_s: float) -> None:
        self._delivery_s = DELIVERY_S + request_s
        self._detectors: dict[str, SilenceDetector] = {}
        self._encoding, self._delivering = _Progress(), _Progress()
        self._told: Stalls = {}

    def poll(self, status: NodeStatus, now_s: float) -> Stalls:
        """What stands still; ``now_s`` is monotonic time."""
        stuck = {name: text for name, row in status.workers.items() if (text := _hanging(name, row))}
        writes = 'spool-writer' not in stuck and not _failing(status, 'spool-writer')
        found = {name: text for name, text in stuck.items() if writes or not name.startswith('encode-')}
        found |= self._topics(status, now_s, takes='intake' not in stuck and not _failing(status, 'intake'))
        encoding, delivery = self._encode(status, now_s), self._deliver(status, now_s)
        if writes:  # else what waits for the disk is not a stall of its own
            found |= {name: text for name, text in (('encode', encoding), ('delivery', delivery)) if text}
        self._tell(found)
        return found

    def _tell(self, found: Stalls) -> None:
        for name in found.keys() - self._told.keys():
            log.warning('%s: %s', name, found[name])
        for name in self._told.keys() - found.keys():
            log.info('%s: working again', name)
        self._told = found

    def _topics(self, status: NodeStatus, now_s: float, *, takes: bool) -> dict[str, str]:
        found = {}
        for topic, row in status.topics.items():
            text = self._detectors.setdefault(topic, SilenceDetector(topic)).poll(row, now_s)
            if text and takes:  # else all of them seem to be silent
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
    """Since when a figure stands still while something waits."""

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
    """What it means that this thread is stuck; empty where it is not."""
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
        return f'{store.in_flight} uploads hang without an end; does the disk of the store hang, is the network too slow?'
    if store.deferred:
        return f'{store.deferred} objects fail again and again: {store.last_error}'
    return 'nothing is under way, which is a defect of this program; start the node again'


class SilenceDetector:
    """Silence detection: notices that a topic has fallen silent although its publisher is there. One for each topic."""

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._pauses: deque[tuple[float, int]] = deque(maxlen=ARRIVALS)  # seconds and messages between two looks with news
        self._since_s: float | None = None
        self._heard_s: float | None = None
        self._received = 0

    def poll(self, row: TopicStatus, now_s: float) -> str:
        """Return what is wrong with the topic; empty where nothing is."""
        if not row.enabled or not row.publishers:
            self._since_s = None
            return ''
        received = row.received - row.wrong_type
        if self._since_s is None:  # a new publisher has a period of its own
            self._since_s, self._heard_s, self._received = now_s, None, received
            self._pauses.clear()
        if received > self._received:
            self._hear(row, received, now_s)
        if row.unavailable:
            return f'it cannot be subscribed to here: {row.unavailable}'
        return self._unheard(row, now_s - self._since_s) if self._heard_s is None else self._stopped(row, now_s - self._heard_s)

    def _hear(self, row: TopicStatus, received: int, now_s: float) -> None:
        heard_s = now_s - (row.age_s or 0.0)
        if self._heard_s is not None:
            self._pauses.append((heard_s - self._heard_s, received - self._received))
        self._heard_s, self._received = heard_s, received

    def _unheard(self, row: TopicStatus, waited_s: float) -> str:
        if not row.matched and waited_s > UNMATCHED_S:
            hint = f'compare type and QoS (ros2 topic info -v {self._topic}), and the firewall between the two machines'
            return f'its publisher has been there for {waited_s:.0f} s without a connection to it; {hint}'
        if row.matched and not row.may_be_silent and waited_s > UNHEARD_S:
            hint = f'does it publish (ros2 topic hz {self._topic}), and do large messages get through the network?'
            return f'its publisher has been connected for {waited_s:.0f} s and not one message came; {hint}'
        return ''

    def _stopped(self, row: TopicStatus, silent_s: float) -> str:
        if row.may_be_silent or len(self._pauses) < ARRIVALS:
            return ''
        pauses = [pause for pause, _ in self._pauses]
        period_s = sum(pauses) / sum(count for _, count in self._pauses)
        if max(pauses) > EVEN * median(pauses) or silent_s <= max(SILENT_S, SILENT_PERIODS * period_s):
            return ''
        why = 'look at the program that publishes it' if row.matched else 'the connection to it is gone: look at the network'
        return f'silent for {silent_s:.0f} s after {1 / period_s:.3g} Hz, though its publisher is there; {why}'
