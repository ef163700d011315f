"""The status of the node: one dict, built once a second on the main thread from what the stages report.

``shadowhound-data status`` reads it from ``spool/status-<robot>.json``; ``diagnostics`` makes a message of it.
"""

from __future__ import annotations

import json
import logging
import os
import sqlite3
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Final

from shadowhound_data_logger.bags.recorder import Recorder
from shadowhound_data_logger.core.clock import SECOND, iso
from shadowhound_data_logger.core.clock_watch import ClockWatch
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.durable_files import replacing
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.node.encoding.encode_pool import BatchQueue, EncodePool
from shadowhound_data_logger.node.intake.intake import Intake
from shadowhound_data_logger.node.intake.middleware import Middleware
from shadowhound_data_logger.node.intake.subscriber import SubscriberStatus
from shadowhound_data_logger.node.intake.unheard import Unheard
from shadowhound_data_logger.node.keeping.upload_rules import UploadRules
from shadowhound_data_logger.node.recording.bags import BagConsumer
from shadowhound_data_logger.node.recording.events import EventBuffer
from shadowhound_data_logger.node.recording.mission import MissionWatch
from shadowhound_data_logger.node.reporting.control import ControlSocket
from shadowhound_data_logger.node.reporting.front import Front
from shadowhound_data_logger.node.reporting.watchdog import Watchdog
from shadowhound_data_logger.shipping.requests import RequestServer, RequestStatus
from shadowhound_data_logger.shipping.uploader import Uploader, UploadStatus
from shadowhound_data_logger.spool.account_rows import Totals
from shadowhound_data_logger.spool.accounts import BAG, EVENT
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.status import file
from shadowhound_data_logger.spool.writer import SpoolWriter

log = logging.getLogger(__name__)

PERIOD_S: Final = 1.0
WINDOW_S: Final = 5.0
"""Rates are over so long, and what is new is new for so long."""
SOCKETS_S: Final = 10.0
"""How often the system is asked what became of the middleware's sockets."""
_NOTHING: Final = Totals('', None, 0, 0, 0, 0, 0, 0, None, None, 0)


@dataclass(frozen=True, slots=True)
class Stages:
    """The stages that the status asks."""

    spool: Spool
    intake: Intake
    queue: BatchQueue
    pool: EncodePool
    writer: SpoolWriter
    uploader: Uploader
    mission: MissionWatch
    recorder: Recorder
    bags: BagConsumer
    event_buffer: EventBuffer
    control: ControlSocket
    middleware: Middleware
    front: Front | None = None
    unheard: Unheard | None = None
    """None where the node listens through the RMW of the robot."""
    requests: RequestServer | None = None
    """None where nothing is kept until somebody asks for it."""
    rules: UploadRules | None = None

    @property
    def workers(self) -> Sequence[Worker]:
        """All threads of the node but the main one."""
        own = [self.intake.worker, self.writer.worker, self.mission.worker, self.control.worker]
        own += [self.front.worker] if self.front is not None else []
        own += [self.requests.worker] if self.requests is not None else []
        return *own, *self.pool.workers, *self.uploader.workers, *self.recorder.workers, *self.event_buffer.workers


class Status:
    """Gathers the state of all stages, and writes it to the status file.

    New; ``look`` once a second, ``write`` what it found. ``earlier`` is the status of up to ``WINDOW_S`` before the last.
    """

    def __init__(self, stages: Stages, settings: Settings, clock: ClockWatch, target: str,
                 monotonic: Callable[[], float] = time.monotonic) -> None:  # fmt: skip
        self._stages = stages
        self._settings = settings
        self._clock = clock
        self._target = target
        self._monotonic = monotonic
        self._path = file(settings.spool_path, settings.robot)
        self._began_ns = clock.boot_ns()
        self.version = _version()
        self._past: deque[tuple[float, int, dict[str, Any]]] = deque()  # monotonic time, bytes sent, status
        self._complained = ''
        self._sockets: dict[str, Any] = {}
        self._sockets_due_s = float('-inf')
        self._watchdog = Watchdog(settings.upload.connect_timeout_s + settings.upload.read_timeout_s)

    @property
    def latest(self) -> Mapping[str, Any] | None:
        """The last one."""
        return self._past[-1][2] if self._past else None

    @property
    def earlier(self) -> Mapping[str, Any] | None:
        return self._past[0][2] if len(self._past) > 1 else None

    def look(self, *, ended: bool = False) -> dict[str, Any] | None:
        """The status of now; None where the spool cannot be read, which is said once."""
        now_s = self._monotonic()
        try:
            usage = self._stages.spool.usage()
        except (OSError, sqlite3.Error) as error:
            self._complain(f'the status cannot be gathered: {error}')
            return None
        while self._past and self._past[0][0] < now_s - WINDOW_S:
            self._past.popleft()
        boot_ns, upload = self._clock.boot_ns(), self._stages.uploader.status()
        status = {
            'robot': self._settings.robot, 'version': self.version, 'pid': os.getpid(), 'boot_id': self._clock.boot_id,
            'boot_ns': boot_ns, 'time': iso(self._clock.wall_ns()), 'uptime_s': round((boot_ns - self._began_ns) / SECOND, 1),
            'paused': self._stages.intake.paused, 'ended': ended, 'middleware': self._middleware(now_s),
            'not_logged': dict(self._stages.intake.not_logged),
            'mission': self._stages.mission.status(), 'bag': self._bag(), 'events': self._events(), 'topics': self._topics(now_s),
            'queue': _fields(self._stages.queue.status()) | _fields(self._settings.queue),
            'spool': {'path': str(self._stages.spool.root), **_fields(usage), 'evicted': self._stages.spool.evicted,
                      'unkept': self._stages.spool.unkept,
                      **_fields(self._settings.spool)},
            'store': self._store(upload, now_s, usage.bytes),
            'requests': self._requests(), 'clock': _fields(self._clock.state()),
            'consumers': {name: {'failures': count, 'last_error': text}
                          for name, (count, text) in self._stages.intake.consumer_failures().items()},
            'workers': {worker.name: _fields(worker.status()) for worker in self._stages.workers},
        }  # fmt: skip
        status['stalls'] = self._watchdog.look(status, now_s)
        self._past.append((now_s, upload.sent_bytes, status))
        return status

    def write(self, status: Mapping[str, Any]) -> None:
        """For whoever reads the file meanwhile, it is the old status or the new one. A disk that refuses it is said once."""
        try:
            with replacing(self._path, mode=0o600) as file:
                file.write(json.dumps(status).encode())
        except OSError as error:
            self._complain(f'the status cannot be written: {error}')

    def _complain(self, text: str) -> None:
        if text != self._complained:
            self._complained = text
            log.warning('%s', text)

    # -- the parts -------------------------------------------------------------------------------------------------

    def _topics(self, now_s: float) -> dict[str, dict[str, Any]]:
        totals = self._stages.spool.accounts.totals()
        sources = {source.topic: source for source in self._stages.intake.status()}
        topics = dict.fromkeys((*sources, *totals))
        return {topic: self._topic(topic, sources.get(topic), totals.get(topic, _NOTHING), now_s) for topic in topics}

    def _topic(self, topic: str, source: SubscriberStatus | None, totals: Totals, now_s: float) -> dict[str, Any]:
        received_s = source.received_s if source else None
        row = {
            'sensor': source.sensor if source else '', 'enabled': source.enabled if source else False,
            'publishers': source.publishers if source else 0, 'matched': source.matched if source else 0,
            'may_be_silent': source.may_be_silent if source else False, 'unavailable': source.unavailable if source else '',
            'rate_hz': 0.0,
            'age_s': None if received_s is None else round(max(0.0, now_s - received_s), 3),
        }  # fmt: skip
        for then_s, _, status in self._past:
            before = status['topics'].get(topic)
            if before:
                news = totals.received - totals.wrong_type - (before['received'] - before['wrong_type'])
                row['rate_hz'] = round(_slope(news, now_s - then_s), 2)
                break
        return row | _fields(totals)

    def _middleware(self, now_s: float) -> dict[str, Any]:
        """Its sockets are asked for less often: that takes a third of all that the status costs."""
        unheard = self._stages.unheard
        if now_s >= self._sockets_due_s:
            self._sockets_due_s = now_s + SOCKETS_S
            self._sockets = self._stages.middleware.status()
        return {**self._sockets, 'unheard': unheard.rows() if unheard is not None else None}

    def _bag(self) -> dict[str, Any]:
        """What is recorded, with the messages of this session by topic."""
        topics = {topic: _fields(totals) for topic, totals in self._stages.spool.accounts.totals(BAG).items()}
        return {**_fields(self._stages.recorder.status()), 'topics': topics,
                'left_out': self._stages.intake.left_out(self._stages.bags)}  # fmt: skip

    def _events(self) -> dict[str, Any]:
        """Ring and events, with the messages that events asked for in this session by topic."""
        topics = {topic: _fields(totals) for topic, totals in self._stages.spool.accounts.totals(EVENT).items()}
        left_out = sum(self._stages.intake.left_out(each) for each in self._stages.event_buffer.consumers)
        return {**_fields(self._stages.event_buffer.events.status()), 'topics': topics, 'left_out': left_out}

    def _requests(self) -> dict[str, Any]:
        requests = self._stages.requests
        return _fields(RequestStatus() if requests is None else requests.status)

    def _store(self, upload: UploadStatus, now_s: float, waiting: int) -> dict[str, Any]:
        then_s, sent_bytes, _ = self._past[0] if self._past else (now_s, upload.sent_bytes, {})
        mbps = 8e-6 * _slope(upload.sent_bytes - sent_bytes, now_s - then_s)
        figures = _fields(upload)
        del figures['sent_bytes'], figures['worker_failures']
        left_s = round(8e-6 * waiting / mbps) if upload.state == 'shipping' and mbps > 0 else None
        stuck = dict(self._stages.rules.stuck) if self._stages.rules is not None else {}
        return {'target': self._target, **figures, 'mbps': round(mbps, 3), 'left_s': left_s, 'stuck': stuck}


def _fields(of: Any) -> dict[str, Any]:
    """What a dataclass says, by name. ``asdict`` would copy it all, at several times the cost; nobody changes it afterwards."""
    return {name: getattr(of, name) for name in of.__dataclass_fields__}


def _slope(rise: float, run: float) -> float:
    return rise / run if run > 0 else 0.0


def _version() -> str:
    try:
        return version('shadowhound_data_logger')
    except PackageNotFoundError:
        return ''
