"""The stages of the node, put together: opened from the store back to the robot, closed the other way round."""

from __future__ import annotations

import json
import logging
import os
import sqlite3
import time
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any

from rclpy.node import Node

from shadowhound_data_logger.capture.control import Control
from shadowhound_data_logger.capture.diagnostics import Diagnostics
from shadowhound_data_logger.capture.intake import Intake
from shadowhound_data_logger.capture.mission import MissionWatch
from shadowhound_data_logger.capture.mission_tap import MissionTap
from shadowhound_data_logger.capture.mission_topic import MissionTopic
from shadowhound_data_logger.capture.parameters import live
from shadowhound_data_logger.capture.status import PERIOD_S, Stages, Status
from shadowhound_data_logger.clock import SystemClock, utc
from shadowhound_data_logger.clock_watch import ClockWatch
from shadowhound_data_logger.config import Settings
from shadowhound_data_logger.encode.pool import EncodePool
from shadowhound_data_logger.encode.queue import BatchQueue
from shadowhound_data_logger.encode.types import MessageTypes
from shadowhound_data_logger.errors import DataLoggerError, SpoolError
from shadowhound_data_logger.keys import dated
from shadowhound_data_logger.model import DataObject, Outcome
from shadowhound_data_logger.ship.uploader import Uploader
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.clock_record import ClockRecord
from shadowhound_data_logger.spool.redating import Redating
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.writer import SpoolWriter
from shadowhound_data_logger.stores import open_store

log = logging.getLogger(__name__)

CLOSE_S = 5.0
"""Time for what is in memory to become durable at a stop; it takes a fraction of that unless the disk hangs."""
LEDGER_BUCKET = 'sensor-data'


class Pipeline:
    """New; open once; close once."""

    def __init__(self, node: Node, settings: Settings) -> None:
        self._settings = settings
        system_clock, record = SystemClock.of_this_machine(), ClockRecord(settings.spool_path, settings.robot)
        self._clock = ClockWatch(system_clock, settings.clock.hold_s, record.steps)
        self.spool = Spool(settings.spool_path, settings.spool, self._clock, settings.robot)
        self._redating = Redating(self.spool, self._clock, record, settings.robot)
        self._node = node
        self._day = self._today()
        self._due_s = 0.0
        self._failures = 0
        self._opened = ExitStack()

    def open(self) -> None:
        """Raises SpoolError or SettingError; nothing is left open then."""
        with ExitStack() as opened:
            self._open(opened)
            self._opened = opened.pop_all()

    def _open(self, opened: ExitStack) -> None:
        """Open the stages; ``opened`` closes them in the opposite order, each whatever happens to the others."""
        settings = self._settings
        self._store = open_store(settings.store, settings.upload)
        opened.callback(self._store.close)
        self.spool.open()
        opened.callback(self.spool.close)
        if not opened.enter_context(self.spool.node_lock()):
            raise SpoolError(f'another sensor_logger_node logs {settings.robot} to {self.spool.root} already',
                             remedy='stop it, or give this one a robot name or SHADOWHOUND_HOME of its own')  # fmt: skip
        self.uploader = Uploader(self.spool, self._store, settings.upload, self._settle)
        self.writer = SpoolWriter(self.spool, settings.spool.commit_s, spooled=self.uploader.wake,
                                  settled=self.uploader.settled)  # fmt: skip
        types = MessageTypes(os.environ.get('AMENT_PREFIX_PATH', '').split(':'))
        queue = BatchQueue(settings.queue)
        sensors = {sensor.name: sensor for sensor in settings.sensors}
        self.pool = EncodePool(queue, sensors, settings.robot, types, self._spool_later, self.spool.accounts.reject,
                               settings.encode.threads)  # fmt: skip
        self.intake = Intake(self._node, sensors, settings.intake, self.spool.accounts, types, queue, self._clock)
        tap = MissionTap(settings.mission, sensors, settings.robot, types, self._clock, self._node.resolve_topic_name)
        topic = MissionTopic(self._node)
        self.mission = MissionWatch(settings, self.intake, queue, tap, topic.tell)
        self.pool.observe = self.mission.observe
        self._stages = stages = Stages(self.spool, self.intake, queue, self.pool, self.writer, self.uploader, self.mission)
        self._status = Status(stages, settings, self._clock, self._store.describe())
        self._diagnostics = Diagnostics(self._node)
        self.control = Control(self._node, self.intake, queue, self.writer)
        opened.callback(self._tell, ended=True)
        self.writer.open()
        opened.callback(self.writer.close, 1.0)
        self.pool.open()
        self.uploader.open()
        opened.callback(self.uploader.close, 0.5)
        opened.callback(self.mission.close)
        opened.callback(self._finish)
        topic.open()
        opened.callback(topic.close)
        self.mission.open()
        opened.callback(self.mission.stop)
        self.intake.open()
        self._diagnostics.open()
        opened.callback(self._diagnostics.close)
        self.control.open()
        opened.callback(self.control.close)
        log.info(self.describe())

    def describe(self) -> str:
        """What goes where, in one line."""
        return f'logging {" ".join(self.intake.topics)} to {self._store.describe()}, spool {self.spool.root}'

    def close(self) -> None:
        """Close the open batches, make all durable, deliver for at most ``shutdown.drain_s``, leave the rest in the spool."""
        self._opened.close()

    def _finish(self) -> None:
        """Everything that is in memory to the spool, and from there what can be delivered in time."""
        end_s = time.monotonic() + CLOSE_S
        finished = {
            'intake': self.intake.close(CLOSE_S),
            'encode pool': self.pool.close(end_s - time.monotonic()),
            'spool writer': self.writer.flush(end_s - time.monotonic()),
        }
        for name in (name for name, done in finished.items() if not done):
            log.error('the %s did not finish its work in %.0f s', name, CLOSE_S)
        if not all(finished.values()):
            return
        self._ship_ledger()
        self.writer.prompt = True
        self.writer.flush(1.0)
        drain_s = self._settings.shutdown.drain_s
        if drain_s and not self.uploader.drain(drain_s):
            log.warning('%d objects stay in the spool %s and are delivered later', self.spool.pending_count(), self.spool.root)

    def tick(self) -> None:
        """Called several times a second: starts threads again that died, and once a second tells what goes on.

        A failure of a thread is told at once. At the turn of each UTC day the ledger is shipped. Raises SpoolError when the
        spool cannot be mended while it is in use.
        """
        if self.writer.damaged:
            text = f'the index of the spool {self.spool.root} is damaged'
            raise SpoolError(text, remedy='start the node again: it is rebuilt then')
        now_s = time.monotonic()
        if not self._supervise() and now_s < self._due_s:
            return
        self._due_s = now_s + PERIOD_S
        self._name_held()
        self._tell()
        day = self._today()
        if day != self._day:
            self._day = day
            self._ship_ledger()

    def _supervise(self) -> bool:
        """Start threads again that died; whether any thread failed since the last time."""
        for worker in self._stages.workers:
            worker.look()
        before, self._failures = self._failures, sum(worker.failures for worker in self._stages.workers)
        return self._failures != before

    def apply(self, settings: Settings) -> None:
        """Go on by other settings, as far as they are live."""
        before, self._settings = live(self._settings), settings
        for name, value in live(settings).items():
            if value != before[name]:
                log.info('%s = %s from now on', name, value)
        self.intake.update(settings.sensors)
        self.uploader.set_max_mbps(settings.upload.max_mbps)

    def _tell(self, *, ended: bool = False) -> None:
        status = self._status.look(ended=ended)
        if status is not None:
            self._status.write(status)
            self._diagnostics.publish(status, self._status.earlier)

    def _today(self) -> str:
        return f'{utc(self._clock.wall_ns()):%Y%m%d}'

    def _ship_ledger(self) -> None:
        """A ledger that cannot be read now is not worth the node: the next one holds all that this one would."""
        try:
            self.writer.put(self._redating.date(self._ledger()), wait=False)
        except DataLoggerError as error:
            log.warning('the ledger was not shipped: %s', error)

    def _spool_later(self, item: DataObject) -> None:
        self.writer.put(self._redating.date(self.mission.mark(item)))

    def _name_held(self) -> None:
        """What waited for the clock to be set may go now, or as soon as the disk lets it."""
        try:
            if named := self._redating.step():
                self.uploader.wake(named)
        except (OSError, sqlite3.Error) as error:
            log.warning('objects that wait for the clock are not named yet: %s', error)

    def _settle(self, outcomes: Sequence[Outcome]) -> None:
        self.writer.settle(outcomes)

    def _ledger(self) -> DataObject:
        """The ledger as an object of its own, for the store."""
        now_ns = self._clock.wall_ns() if self._clock.is_set else self._clock.boot_ns()
        content: dict[str, Any] = ledger.read(self.spool.root, self._settings.robot)
        robot = self._settings.robot
        pattern = f'{robot}/_ledger/{{date}}/{{time}}_ledger.json'
        return DataObject(
            bucket=LEDGER_BUCKET, key=dated(pattern, now_ns), key_pattern=pattern,
            body=json.dumps(content, indent=1).encode(), content_type='application/json', sensor='_ledger', topic=None,
            type='', samples=0, t_start_ns=now_ns, t_end_ns=now_ns, priority=0, protected=True, metadata={'robot': robot},
        )  # fmt: skip
