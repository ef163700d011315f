"""Builds the status of the node (``core.status``) once per second on the main thread, and writes its file.

``shadowhound-data status`` reads it from ``spool/status-<robot>.json``; ``diagnostics`` converts it to a message.
"""

from __future__ import annotations

import logging
import os
import sqlite3
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from importlib.metadata import PackageNotFoundError, version
from typing import Final

from shadowhound_data_logger.bags.recorder import Recorder
from shadowhound_data_logger.core.clock import SECOND, iso
from shadowhound_data_logger.core.clock_watch import ClockWatch
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.dataclass_json import dumps, fields_of
from shadowhound_data_logger.core.durable_files import replacing
from shadowhound_data_logger.core.status import (
    BagStatus,
    ConsumerStatus,
    DeliveryStatus,
    EventStatus,
    MiddlewareStatus,
    NodeStatus,
    RequestStatus,
    StoreStatus,
    TopicStatus,
    Totals,
)
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.node.encoding.encode_pool import BatchQueue, EncodePool
from shadowhound_data_logger.node.intake.intake import Intake
from shadowhound_data_logger.node.intake.middleware import Middleware
from shadowhound_data_logger.node.intake.subscriber import SubscriberStatus
from shadowhound_data_logger.node.intake.undiscovered import UndiscoveredPublishers
from shadowhound_data_logger.node.keeping.upload_rules import UploadRules
from shadowhound_data_logger.node.recording.bags import BagConsumer
from shadowhound_data_logger.node.recording.events import EventBuffer
from shadowhound_data_logger.node.recording.mission import MissionWatch
from shadowhound_data_logger.node.reporting.control import ControlSocket
from shadowhound_data_logger.node.reporting.front import Front
from shadowhound_data_logger.node.reporting.watchdog import Watchdog
from shadowhound_data_logger.shipping.requests import RequestServer
from shadowhound_data_logger.shipping.uploader import Uploader, UploadStatus
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.status import file
from shadowhound_data_logger.spool.topic_account import BAG, EVENT
from shadowhound_data_logger.spool.writer import SpoolWriter

log = logging.getLogger(__name__)

PERIOD_S: Final = 1.0
WINDOW_S: Final = 5.0
"""The window of rates, and of what counts as recent."""
SOCKETS_S: Final = 10.0
"""Interval between queries of the middleware's sockets."""
_NOTHING: Final = Totals()


@dataclass(frozen=True, slots=True)
class Stages:
    """The stages that the status reads."""

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
    undiscovered: UndiscoveredPublishers | None = None
    """None if the node uses the robot's RMW."""
    requests: RequestServer | None = None
    """None if no data is kept until requested."""
    rules: UploadRules | None = None

    @property
    def workers(self) -> Sequence[Worker]:
        """All threads of the node except the main one."""
        own = [self.intake.worker, self.writer.worker, self.mission.worker, self.control.worker]
        own += [self.front.worker] if self.front is not None else []
        own += [self.requests.worker] if self.requests is not None else []
        return *own, *self.pool.workers, *self.uploader.workers, *self.recorder.workers, *self.event_buffer.workers


class Status:
    """Gathers the state of all stages, and writes it to the status file.

    New; ``poll`` once per second, ``write`` its result. ``earlier`` is the status of up to ``WINDOW_S`` before the last.
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
        self._past: deque[tuple[float, int, NodeStatus]] = deque()  # monotonic time, bytes sent, status
        self._complained = ''
        self._sockets = MiddlewareStatus()
        self._sockets_due_s = float('-inf')
        self._watchdog = Watchdog(settings.upload.connect_timeout_s + settings.upload.read_timeout_s)

    @property
    def latest(self) -> NodeStatus | None:
        """The newest status."""
        return self._past[-1][2] if self._past else None

    @property
    def earlier(self) -> NodeStatus | None:
        return self._past[0][2] if len(self._past) > 1 else None

    def poll(self, *, ended: bool = False) -> NodeStatus | None:
        """The current status; None if the spool cannot be read, which is logged once."""
        now_s, stages = self._monotonic(), self._stages
        try:
            spool = stages.spool.usage()
        except (OSError, sqlite3.Error) as error:
            self._complain(f'the status cannot be gathered: {error}')
            return None
        while self._past and self._past[0][0] < now_s - WINDOW_S:
            self._past.popleft()
        boot_ns, upload, limits = self._clock.boot_ns(), stages.uploader.status(), self._settings.spool
        not_logged = {} if stages.intake.found is None else dict(stages.intake.found.not_logged)
        status = NodeStatus(
            robot=self._settings.robot, version=self.version, pid=os.getpid(), boot_id=self._clock.boot_id, boot_ns=boot_ns,
            time=iso(self._clock.wall_ns()), uptime_s=round((boot_ns - self._began_ns) / SECOND, 1),
            paused=stages.intake.paused, ended=ended, not_logged=not_logged,
            middleware=self._middleware(now_s), mission=stages.mission.status(), bag=self._bag(), events=self._events(),
            topics=self._topics(now_s), queue=stages.queue.status(),
            spool=replace(spool, evicted=stages.spool.room.evicted, unkept=stages.spool.room.unkept,
                          max_bytes=limits.max_bytes,
                          min_free_bytes=limits.min_free_bytes, remember_days=limits.remember_days),
            store=self._store(upload, now_s, spool.bytes),
            requests=stages.requests.status if stages.requests is not None else RequestStatus(),
            clock=self._clock.state(),
            consumers={type(each).__name__: ConsumerStatus(each.failures, each.last_error)
                       for each in stages.intake.consumers if each.failures},
            workers={worker.name: worker.status() for worker in stages.workers},
        )  # fmt: skip
        status = replace(status, stalls=self._watchdog.poll(status, now_s))
        self._past.append((now_s, upload.sent_bytes, status))
        return status

    def write(self, status: NodeStatus) -> None:
        """Replace the status file atomically. A failure is logged once."""
        try:
            with replacing(self._path, mode=0o600) as file:
                file.write(dumps(status))
        except OSError as error:
            self._complain(f'the status cannot be written: {error}')

    def _complain(self, text: str) -> None:
        if text != self._complained:
            self._complained = text
            log.warning('%s', text)

    # -- the parts -------------------------------------------------------------------------------------------------

    def _topics(self, now_s: float) -> dict[str, TopicStatus]:
        totals = self._stages.spool.accounts.totals()
        sources = {source.topic: source for source in self._stages.intake.status()}
        topics = dict.fromkeys((*sources, *totals))
        return {topic: self._topic(topic, sources.get(topic), totals.get(topic, _NOTHING), now_s) for topic in topics}

    def _topic(self, topic: str, source: SubscriberStatus | None, totals: Totals, now_s: float) -> TopicStatus:
        rate_hz = 0.0
        for then_s, _, status in self._past:
            before = status.topics.get(topic)
            if before is not None:
                news = totals.received - totals.wrong_type - (before.received - before.wrong_type)
                rate_hz = round(_slope(news, now_s - then_s), 2)
                break
        if source is None:
            return TopicStatus(**fields_of(totals), enabled=False, rate_hz=rate_hz)
        age_s = None if source.received_s is None else round(max(0.0, now_s - source.received_s), 3)
        return TopicStatus(**fields_of(totals), sensor=source.sensor, enabled=source.enabled, publishers=source.publishers,
                           matched=source.matched, may_be_silent=source.may_be_silent, unavailable=source.unavailable,
                           rate_hz=rate_hz, age_s=age_s, size=source.size)  # fmt: skip

    def _middleware(self, now_s: float) -> MiddlewareStatus:
        """Its sockets are queried less often: that takes a third of the time of the complete status."""
        undiscovered = self._stages.undiscovered
        if now_s >= self._sockets_due_s:
            self._sockets_due_s = now_s + SOCKETS_S
            self._sockets = self._stages.middleware.status()
        return replace(self._sockets, undiscovered=undiscovered.rows() if undiscovered is not None else None)

    def _bag(self) -> BagStatus:
        """The recording, with this session's messages by topic."""
        return replace(self._stages.recorder.status(), topics=self._stages.spool.accounts.totals(BAG),
                       left_out=self._stages.bags.left_out)  # fmt: skip

    def _events(self) -> EventStatus:
        """Ring and events, with this session's event messages by topic."""
        left_out = sum(each.left_out for each in self._stages.event_buffer.consumers)
        return replace(self._stages.event_buffer.events.status(), topics=self._stages.spool.accounts.totals(EVENT),
                       left_out=left_out)  # fmt: skip

    def _store(self, upload: UploadStatus, now_s: float, waiting: int) -> StoreStatus:
        then_s, sent_bytes = self._past[0][:2] if self._past else (now_s, upload.sent_bytes)
        mbps = 8e-6 * _slope(upload.sent_bytes - sent_bytes, now_s - then_s)
        left_s = round(8e-6 * waiting / mbps) if upload.state == 'shipping' and mbps > 0 else None
        stuck = self._stages.rules.stuck if self._stages.rules is not None else {}
        delivery = {field.name: getattr(upload, field.name) for field in fields(DeliveryStatus)}
        return StoreStatus(**delivery, target=self._target, mbps=round(mbps, 3), left_s=left_s, stuck=stuck)


def _slope(rise: float, run: float) -> float:
    return rise / run if run > 0 else 0.0


def _version() -> str:
    try:
        return version('shadowhound_data_logger')
    except PackageNotFoundError:
        return ''
