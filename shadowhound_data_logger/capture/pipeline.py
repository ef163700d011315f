"""The stages of the node, put together: opened from the store back to the robot, closed the other way round."""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Sequence
from typing import Any

from rclpy.node import Node

from shadowhound_data_logger.capture.intake import Intake
from shadowhound_data_logger.clock import SystemClock, utc
from shadowhound_data_logger.config import Settings
from shadowhound_data_logger.errors import SpoolError
from shadowhound_data_logger.encode.pool import EncodePool
from shadowhound_data_logger.encode.queue import BatchQueue
from shadowhound_data_logger.encode.types import MessageTypes
from shadowhound_data_logger.model import DataObject, Outcome
from shadowhound_data_logger.ship.uploader import Uploader
from shadowhound_data_logger.spool import ledger
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
        self._clock = SystemClock.of_this_machine()
        self.spool = Spool(settings.spool_path, settings.spool, self._clock, settings.robot)
        self._node = node
        self._day = self._today()

    def open(self) -> None:
        """Raises SpoolError or SettingError; nothing is left open then."""
        settings = self._settings
        self._store = open_store(settings.store, settings.upload)
        self.spool.open()
        self.uploader = Uploader(self.spool, self._store, settings.upload, self._settle)
        self.writer = SpoolWriter(self.spool, settings.spool.commit_s, spooled=lambda _: self.uploader.wake(),
                                  settled=self.uploader.settled)  # fmt: skip
        types = MessageTypes(os.environ.get('AMENT_PREFIX_PATH', '').split(':'))
        self.queue = BatchQueue(settings.queue)
        sensors = {sensor.name: sensor for sensor in settings.sensors}
        self.pool = EncodePool(self.queue, sensors, settings.robot, types, self.writer.put, self.spool.accounts.reject,
                               settings.encode.threads)  # fmt: skip
        self.intake = Intake(self._node, settings, self.spool.accounts, types, self.queue)
        self.writer.open()
        self.pool.open()
        self.uploader.open()
        self.intake.open()
        log.info('logging %s to %s, spool %s', ' '.join(self.intake.topics), self._store.describe(), self.spool.root)

    def close(self) -> None:
        """Close the open batches, make all durable, deliver for at most ``shutdown.drain_s``, leave the rest in the spool."""
        end_s = time.monotonic() + CLOSE_S
        finished = {
            'intake': self.intake.close(CLOSE_S),
            'encode pool': self.pool.close(end_s - time.monotonic()),
            'spool writer': self.writer.flush(end_s - time.monotonic()),
        }
        for name in (name for name, done in finished.items() if not done):
            log.error('the %s did not finish in %.0f s', name, CLOSE_S)
        if all(finished.values()):
            self.writer.put(self._ledger())
            self.writer.flush(1.0)
        drain_s = self._settings.shutdown.drain_s
        if drain_s and not self.uploader.drain(drain_s):
            log.warning('%d objects stay in the spool %s and are delivered later', self.spool.pending_count(), self.spool.root)
        self.uploader.close(0.5)
        self.writer.close(1.0)
        self.spool.close()
        self._store.close()

    def tick(self) -> None:
        """Called now and then: at the turn of each UTC day the ledger goes to the store.

        Raises SpoolError when the spool cannot be mended while it is in use.
        """
        if self.writer.damaged:
            raise SpoolError(f'the index of the spool {self.spool.root} is damaged', remedy='start the node again: it is rebuilt then')
        day = self._today()
        if day != self._day:
            self._day = day
            self.writer.put(self._ledger())

    def _today(self) -> str:
        return f'{utc(self._clock.wall_ns()):%Y%m%d}'

    def _settle(self, outcomes: Sequence[Outcome]) -> None:
        self.writer.settle(outcomes)

    def _ledger(self) -> DataObject:
        """The ledger as an object of its own, for the store."""
        now_ns = self._clock.wall_ns()
        content: dict[str, Any] = ledger.read(self.spool.root, self._settings.robot)
        robot = self._settings.robot
        return DataObject(
            bucket=LEDGER_BUCKET, key=f'{robot}/_ledger/{utc(now_ns):%Y%m%d/%H%M%S}_ledger.json',
            body=json.dumps(content, indent=1).encode(), content_type='application/json', sensor='_ledger', topic=None,
            type='', samples=0, t_start_ns=now_ns, t_end_ns=now_ns, priority=0, protected=True, metadata={'robot': robot},
        )  # fmt: skip
