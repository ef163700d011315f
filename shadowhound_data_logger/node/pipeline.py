"""Assembles the stages of the node: opened from the store to the robot, closed in reverse order.

The threads of the node, what each owns, and what it may wait for (``top -H -p PID`` shows the names):

- main: the executor (services, parameters, requests of the control socket), status and ``/diagnostics`` once per second; waits
  for a flush, for 5 s, and for the disk, to record an operator's request
- ``control``: the control socket and its clients, which have deadlines
- ``front``: the process of the front; waits for its end, when the node ends
- ``intake``: all subscriptions. It alone creates, takes from and destroys them, and waits for nothing
- ``encode-*`` (two to four): the batch in hand; wait for the spool writer
- ``spool-writer``: commits; waits for the disk
- ``bag-writer``, ``event-writer``: the open slice, the bag of the current event; wait for the disk, and at the end for the spool
  writer, for 5 s
- ``bag-recovery``: interrupted bags, and those that wait for the clock; waits for the disk
- ``event-watch``: conditions, and the end of the active mission's journal; waits for the disk
- ``upload-*`` (``upload.threads``): the object in hand; wait for the network
- ``requests`` (where something is kept): the mailbox, and what is released next; waits for network and disk
- ``upload-lock``: the right to deliver, which one process has at a time; waits for the other process
- ``mission``: the active mission, and the node's journal of it; waits for the disk, and at a mission's end for intake and
  encoders, for 5 s
"""

from __future__ import annotations

import logging
import os
import sqlite3
import time
from collections.abc import Collection
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING

from shadowhound_data_logger.bags.context import BagContext
from shadowhound_data_logger.bags.kept import KeptCut, sweep
from shadowhound_data_logger.bags.manifest import MissionOf
from shadowhound_data_logger.bags.naming import BAGS
from shadowhound_data_logger.bags.queue import BagQueue
from shadowhound_data_logger.bags.recorder import Recorder
from shadowhound_data_logger.bags.recovery import BagRecovery
from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.core.clock_watch import ClockWatch
from shadowhound_data_logger.core.config import DEFAULT_SENSORS, Settings, has_go2_messages
from shadowhound_data_logger.core.dataclass_json import fields_of
from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.options import NAMED, ON_REQUEST
from shadowhound_data_logger.core.stamps import StampRule
from shadowhound_data_logger.core.status import MissionStatus
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.encoding.encode_pool import BatchQueue, EncodePool
from shadowhound_data_logger.node.encoding.halver import Halver
from shadowhound_data_logger.node.encoding.pose_track import RobotTrack
from shadowhound_data_logger.node.encoding.rejections import RejectionLog
from shadowhound_data_logger.node.intake.early import EarlyReaders
from shadowhound_data_logger.node.intake.found_topics import FoundTopics
from shadowhound_data_logger.node.intake.intake import Intake
from shadowhound_data_logger.node.intake.sampling import Sampler
from shadowhound_data_logger.node.intake.undiscovered import UndiscoveredPublishers
from shadowhound_data_logger.node.keeping.keeping import Keeping, keeps_bag
from shadowhound_data_logger.node.keeping.link_track import LinkTrack
from shadowhound_data_logger.node.keeping.upload_rules import KEEP_WHEN, UploadRules
from shadowhound_data_logger.node.parameters import Parameters, live
from shadowhound_data_logger.node.recording.bags import BagConsumer
from shadowhound_data_logger.node.recording.events import EventBuffer
from shadowhound_data_logger.node.recording.mission import MissionWatch
from shadowhound_data_logger.node.recording.mission_observer import MissionObserver
from shadowhound_data_logger.node.reporting.bookkeeping import Bookkeeping
from shadowhound_data_logger.node.reporting.commands import Commands
from shadowhound_data_logger.node.reporting.control import ControlSocket
from shadowhound_data_logger.node.reporting.interface import Interface
from shadowhound_data_logger.node.reporting.status import PERIOD_S, Stages, Status
from shadowhound_data_logger.ros.reader import endpoints, node_of
from shadowhound_data_logger.shipping.catalog_writer import CatalogWriter
from shadowhound_data_logger.shipping.requests import RequestServer
from shadowhound_data_logger.shipping.thinning import Thinner
from shadowhound_data_logger.shipping.uploader import Uploader
from shadowhound_data_logger.spool.clock_record import ClockRecord
from shadowhound_data_logger.spool.index_check import IndexCheck
from shadowhound_data_logger.spool.operator_requests import OperatorRequests
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.topic_account import SINKS
from shadowhound_data_logger.spool.unsynced_objects import UnsyncedObjects
from shadowhound_data_logger.spool.writer import SpoolWriter
from shadowhound_data_logger.stores import open_store

if TYPE_CHECKING:
    from shadowhound_data_logger.node.node import Ros

log = logging.getLogger(__name__)

CLOSE_S = 5.0
"""Time for making data in memory durable at shutdown; it takes a fraction of that unless the disk hangs."""
DAMAGED_S = 0.5
"""The same if the spool rejects all writes."""


class Pipeline:
    """Assembles the node's stages, and starts and stops them in order.

    New; open once; close once.
    """

    def __init__(self, ros: Ros, settings: Settings, parameters: Parameters, early: EarlyReaders) -> None:
        self._settings = settings
        self._parameters = parameters
        self._ros = ros
        self._early = early
        self._record = record = ClockRecord(settings.spool_path, settings.robot)
        self._clock = ClockWatch(SystemClock.of_this_machine(), settings.clock.hold_s, record.steps)
        self.spool = Spool(settings.spool_path, settings.spool, self._clock, settings.robot, settings.keep)
        self._unsynced = UnsyncedObjects(self.spool, self._clock, record, settings.robot)
        self._node = ros.node
        self._due_s = 0.0
        self._failures = 0
        self._opened = ExitStack()

    def open(self) -> None:
        """Raises SpoolError or SettingError; nothing is left open then."""
        with ExitStack() as opened:
            self._open_disk(opened)
            self._make_stages()
            self._open_stages(opened)
            self._opened = opened.pop_all()

    def _open_disk(self, opened: ExitStack) -> None:
        """Open the store and the spool, which no other node may use; ``opened`` closes them."""
        settings = self._settings
        self._store = open_store(settings.store, settings.upload)
        opened.callback(self._store.close)
        self.spool.open()
        opened.callback(self.spool.close)
        # A second node would count and store all messages again.
        node_lock = flock(self.spool.root / f'node-{settings.robot}.lock', wait=False)
        if not opened.enter_context(node_lock):
            raise SpoolError(f'another sensor_logger_node already logs {settings.robot} to {self.spool.root}',
                             remedy='stop it, or give this one another robot name or SHADOWHOUND_HOME')  # fmt: skip
        for sink in SINKS:
            self.spool.carry(sink)

    def _make_stages(self) -> None:
        """Create each stage with its downstream stage; none runs yet."""
        settings = self._settings
        queue = BatchQueue(settings.queue)
        self.writer = SpoolWriter(self.spool, expects=queue.is_busy)
        self.uploader = Uploader(self.spool, self._store, settings.upload, self.writer.settle)
        accounts, node, types = self.spool.accounts, self._node, MessageTypes(os.environ.get('AMENT_PREFIX_PATH', '').split(':'))
        bags_context = BagContext(
            settings.home / BAGS / settings.robot, settings.robot, self._clock, self.writer, settings.clock.hold_s,
            self._record.offsets, keeps=partial(keeps_bag, settings.bag, settings.keep),
        )  # fmt: skip
        recovery = BagRecovery(bags_context, settings.bag.priority)
        self.event_buffer = EventBuffer(node, settings, bags_context, recovery, types)
        # Consumers; topics besides those of the sensors are shared with later consumers.
        bag_queue = BagQueue()
        sensors = {sensor.name: sensor for sensor in settings.sensors}
        stamps = StampRule(self._clock, round(settings.clock.max_offset_s * SECOND))
        track = RobotTrack(settings.mission, types, node.resolve_topic_name, node.get_namespace().rpartition('/')[2])
        self._rules = UploadRules(node, settings, types, self._clock, self._active_mission)
        self.uploader.wait_for(self._rules.closed)
        self._make_request_server(track)
        keeps = self._requests is not None
        self._catalog = CatalogWriter(settings.spool_path, settings.catalog, settings.robot, self._clock, keeps=keeps)
        self._bookkeeping = Bookkeeping(settings, self._clock, self.writer, self._unsynced.mark, self._catalog, self._link)
        self.writer.on_commit(spooled=self.uploader.wake, settled=self._settled if keeps else self.uploader.settled)
        sampler = Sampler(sensors, accounts, types, queue)
        accounts.oldest_open = sampler.oldest_open
        bags = BagConsumer(node, settings.bag, accounts, bag_queue)
        consumers = (track, sampler, *self.event_buffer.consumers, *self._rules.consumers, bags)
        found = None
        if settings.capture.topics != NAMED:
            found = FoundTopics(node, settings.capture.topics, settings.sensors, settings.assumed)
        self.intake = Intake(node, sensors, accounts, types, stamps, consumers, first=track.has_pose, found=found,
                             early=self._early)  # fmt: skip
        self.recorder = Recorder(settings.bag, bags_context, bag_queue, recovery, partial(self.intake.listen, bags))
        observer = MissionObserver(settings.mission, sensors, settings.robot, types, node.resolve_topic_name, track.marks,
                                   track.place)  # fmt: skip
        self.mission = MissionWatch(settings, self.intake, sampler, queue, observer, self._on_mission)
        keeping = Keeping(settings.keep, sensors, settings.robot)
        marks = self.mission.mark, track.mark, keeping.mark, self._unsynced.mark
        self.pool = EncodePool(settings.robot, queue, sensors, types, self.writer, marks, self.mission.observe,
                               preview=keeping.preview, reports=RejectionLog(partial(node_of, node)))  # fmt: skip
        self._control = ControlSocket(
            self.spool.root, settings.robot, self._node.create_guard_condition(self._handle_requests).trigger
        )
        self._stages = stages = Stages(self.spool, self.intake, queue, self.pool, self.writer, self.uploader, self.mission,
                                       self.recorder, bags, self.event_buffer, self._control, self._ros.middleware,
                                       self._ros.front, self._make_undiscovered(), self._requests, self._rules)  # fmt: skip
        self._status = Status(stages, settings, self._clock, self._store.describe())
        requests = OperatorRequests(settings.spool_path, settings.robot, self._clock.wall_ns)
        self._commands = Commands(stages, self._parameters, self._status, requests, settings.robot, self._ros.name)
        self._interface = Interface(self._node, self._commands.answer) if not self._ros.middleware.is_foreign else None

    def _open_stages(self, opened: ExitStack) -> None:
        """Start the stages, downstream first; ``opened`` closes them in reverse order in any case."""
        front = self._ros.front
        if front is not None:
            opened.callback(front.close)
        opened.callback(self._publish_status, ended=True)
        self.writer.open()
        opened.callback(self.writer.close, 1.0)
        if not self.spool.recovery.is_checked:
            check = IndexCheck(self.spool.root, self.writer.set_damaged)
            check.open()
            opened.callback(check.close)
        self.pool.open()
        self.uploader.open()
        opened.callback(self.uploader.close, 0.5)
        opened.callback(self.mission.close)
        opened.callback(self._finish)
        if self._requests is not None:
            self._requests.open()
            opened.callback(self._requests.close, 1.0)
        if self._interface is not None:
            self._interface.open()
            opened.callback(self._interface.close)
        self.mission.open()
        opened.callback(self.mission.stop)
        self.intake.open()
        self.recorder.open()
        self.event_buffer.open()
        self._control.open()
        opened.callback(self._control.close)
        if front is not None:
            front.open(self._control.path)
            opened.callback(front.stop)
        log.info(self.describe())

    def describe(self) -> str:
        """The data flow in one line, on a Go2 with the default sensors that are not logged."""
        listed = {sensor.name for sensor in self._settings.sensors}
        others = [name for name, own in DEFAULT_SENSORS.items() if name not in listed and own.get('enabled', True)]
        others = others if has_go2_messages(os.environ) else []
        left_out = f'; not logged, because sensors does not list them: {", ".join(others)}' if others else ''
        topics = ' '.join(self.intake.topics) or ('no topic' if self.intake.found is None else 'topics as they are found')
        return f'logging {topics} to {self._store.describe()}, spool {self.spool.root}{left_out}'

    def close(self) -> None:
        """Close the open batches, make all durable, upload for at most ``shutdown.drain_s``, leave the rest in the spool."""
        self._opened.close()

    def _finish(self) -> None:
        """Move everything in memory to the spool, and upload what is possible before the deadline."""
        close_s = DAMAGED_S if self.writer.damaged else CLOSE_S
        end_s = time.monotonic() + close_s
        finished = {
            'bag recorder': self.recorder.close(close_s),
            'intake': self.intake.close(close_s),
            'event writer': self.event_buffer.close(end_s - time.monotonic()),
            'encode pool': self.pool.close(end_s - time.monotonic()),
            'spool writer': self.writer.flush(end_s - time.monotonic()),
        }
        for name in (name for name, done in finished.items() if not done):
            log.error('the %s did not finish its work in %g s', name, close_s)
        if not all(finished.values()):
            return
        self._bookkeeping.end()
        self.writer.prompt = True
        self.writer.flush(1.0)
        end_s = time.monotonic() + self._settings.shutdown.drain_s
        self.uploader.drain(end_s - time.monotonic())
        self.writer.flush(1.0)
        self._bookkeeping.spool_parts(self._catalog.parts)
        self.writer.flush(1.0)
        if self._settings.shutdown.drain_s and not self.uploader.drain(end_s - time.monotonic()):
            log.warning(
                '%d objects stay in the spool %s and will be delivered later', self.spool.pending_count(), self.spool.root
            )

    def tick(self) -> None:
        """Called several times per second: restarts threads that ended, and reports the status once per second.

        A failure of a thread is reported immediately. At the start of each UTC day the ledger is uploaded. Raises SpoolError if
        the spool cannot be repaired while in use.
        """
        if self.writer.damaged:
            text = f'the index of the spool {self.spool.root} is damaged'
            raise SpoolError(text, remedy='restart the node: it is rebuilt at startup')
        # rmw_fastrtps may clear the condition unseen if it is triggered just as the executor goes to sleep
        self._handle_requests()
        now_s = time.monotonic()
        if not self._supervise() and now_s < self._due_s:
            return
        self._due_s = now_s + PERIOD_S
        self._name_held()
        self.uploader.wait_for(self._rules.poll())
        self.recorder.check_clock()
        self._bookkeeping.tick()
        self._publish_status()

    def _handle_requests(self) -> None:
        """Called by the executor when a request waits at the control socket."""
        self._control.handle_requests(self._commands.answer)

    def _supervise(self) -> bool:
        """Restart threads that ended; return whether any thread failed since the last call."""
        for worker in self._stages.workers:
            worker.poll()
        before, self._failures = self._failures, sum(worker.failures for worker in self._stages.workers)
        return self._failures != before

    def apply(self, settings: Settings) -> None:
        """Apply the live part of other settings."""
        before, self._settings = live(self._settings), settings
        for name, value in live(settings).items():
            if value != before[name]:
                log.info('%s = %s from now on', name, value)
        self.intake.update(settings.sensors)
        self.uploader.set_max_mbps(settings.upload.max_mbps)
        self.event_buffer.update(settings.events)

    def _active_mission(self) -> MissionStatus:
        return self.mission.status()

    def _make_request_server(self, track: RobotTrack) -> None:
        """Created only if data is kept until requested."""
        self._requests: RequestServer | None = None
        self._link: LinkTrack | None = None
        settings = self._settings
        ships = {settings.bag.ship, *(sensor.ship for sensor in settings.sensors)}
        if ON_REQUEST not in ships and not (self.spool.reading.kept.bytes() or self.spool.reading.requests.open_count()):
            return
        sweep(settings.home, settings.robot)
        self._link = link = LinkTrack(self.uploader.status, track.marks, settings.robot, self._clock)
        min_hz = settings.keep.thin_to_hz
        thinner = Thinner(self.spool, min_hz, Halver(settings.home, settings.robot, min_hz))
        self._requests = RequestServer(self.spool, self._store, settings.keep, settings.robot, self._clock,
                                       put=partial(self.writer.put, wait=False), released=self.uploader.wake,
                                       cutter=partial(KeptCut, settings.home), mbps=lambda: link.mbps,
                                       may_send=lambda: KEEP_WHEN not in self._rules.closed,
                                       finished=lambda: self._catalog.expedite(),  # noqa: PLW0108 - created later
                                       thin=thinner.step)  # fmt: skip

    def _settled(self, ids: Collection[int]) -> None:
        self.uploader.settled(ids)
        if self._requests is not None:
            self._requests.wake()

    def _make_undiscovered(self) -> UndiscoveredPublishers | None:
        """None if the node uses the robot's RMW."""
        middleware, node = self._ros.middleware, self._node
        if self._ros.front is None:
            return None
        return UndiscoveredPublishers(middleware.rmw, middleware.robot, lambda: self.intake.wanted,
                       lambda topic: {publisher.gid for publisher in endpoints(node, topic)})  # fmt: skip

    def _on_mission(self, mission: MissionStatus) -> None:
        self.spool.accounts.set_mission(mission.mission_id)
        if self._interface is not None:
            self._interface.publish_mission(fields_of(mission))
        of = MissionOf(mission.type, mission.mission_id, mission.run_id) if mission else None
        self.recorder.on_mission(of)
        self.event_buffer.on_mission(of)
        if not mission:
            self._catalog.expedite()

    def _publish_status(self, *, ended: bool = False) -> None:
        status = self._status.poll(ended=ended)
        if status is not None:
            self._status.write(status)
            if self._interface is not None:
                self._interface.publish_diagnostics()

    def _name_held(self) -> None:
        """Name the objects that waited for the clock, or as soon as the disk allows it."""
        try:
            if named := self._unsynced.step():
                self.uploader.wake(named)
        except (OSError, sqlite3.Error) as error:
            log.warning('objects that wait for the clock have no names yet: %s', error)
