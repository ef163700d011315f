"""Records one bag on request and uploads it, in a separate process.

    python -m shadowhound_data_logger.node.recording.bag_process NAME --duration 60 [--topic /imu ...] [--regex ...]

Its last line on standard output is JSON: the result. ``bags.record`` starts it, for the command line and for agents. It records
as the node does, slice by slice into the spool, with separate subscriptions; SIGINT ends it early with a complete bag.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import os
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import get_default_context

from shadowhound_data_logger.bags.context import BagContext
from shadowhound_data_logger.bags.local import RECORDS, local_files
from shadowhound_data_logger.bags.manifest import Manifest, MissionOf
from shadowhound_data_logger.bags.naming import MANIFEST, unsynced_mark
from shadowhound_data_logger.bags.queue import BagQueue
from shadowhound_data_logger.bags.recorder import Recorder
from shadowhound_data_logger.bags.recovery import BagRecovery
from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.core.errors import BagError, DataLoggerError, SpoolError
from shadowhound_data_logger.core.keys import check_name
from shadowhound_data_logger.core.model import DataObject, RecordingRows
from shadowhound_data_logger.core.stamps import StampRule
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.intake.found_topics import is_unitree
from shadowhound_data_logger.node.intake.intake import Intake
from shadowhound_data_logger.node.node import StopSignals
from shadowhound_data_logger.node.recording.bags import BagConsumer
from shadowhound_data_logger.ros.shared_memory import PortGuard, dead_ports_avoided
from shadowhound_data_logger.shipping.uploader import Uploader
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.writer import SpoolWriter
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.base import ObjectStore

NODE: Final = 'shadowhound_bag_record'
DISCOVERY_S: Final = 3.0
"""Maximum wait for the first publisher of a wanted topic, and for the first message: the duration starts there."""
MORE_S: Final = 0.5
"""Wait for the others, once one is known."""
STEP_S: Final = 0.1
CLOSE_S: Final = 5.0
DAMAGED_S: Final = 0.5
"""The same if the spool rejects all writes."""
RECOVERY_S: Final = 30.0

log = logging.getLogger(__name__)


class _IndexLostError(SpoolError):
    """The spool's index was deleted, replaced or damaged while a bag was recorded."""

    def __init__(self, bag: str, end_s: float) -> None:
        super().__init__('the index of the spool was lost', remedy='it is rebuilt from the files when the spool is opened')
        self.bag = bag
        self.end_s = end_s


@dataclass(frozen=True, slots=True)
class _Wanted:
    """The bag to record."""

    name: str
    duration_s: float
    deadline_s: float
    cut_off: str = ''
    """The bag that was being recorded when the index was lost; empty for the first."""
    end_s: float = math.inf
    """End of the recording, once a message arrived."""


class ManifestWriter(SpoolWriter):
    """A spool writer that remembers the manifests of bags that ended: ours, and older ones that are completed."""

    def __init__(self, spool: Spool) -> None:
        super().__init__(spool)
        self._manifests: list[Manifest] = []

    def put(self, *items: DataObject, rows: Sequence[RecordingRows] = (), wait: bool = True) -> None:
        for item in items:
            if item.key.endswith(f'/{MANIFEST}') and isinstance(item.body, bytes):
                self._manifests.append(Manifest.from_json(item.body))
        super().put(*items, rows=rows, wait=wait)

    def manifest_of(self, began_as: str) -> Manifest | None:
        """The manifest of the bag that started with this name, which may have been renamed when the clock was set."""
        for manifest in self._manifests:
            clock = manifest.clock
            if manifest.bag == began_as or (clock is not None and unsynced_mark(clock.boot_id, clock.boot_ns) in began_as):
                return manifest
        return None


def main() -> int:
    """The program; 0: the store has the bag, 1: the spool has it or nothing was recorded, 2: invalid settings."""
    given = _arguments(sys.argv[1:])
    logging.basicConfig(level=logging.WARNING, format='%(message)s')
    stop = StopSignals()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    with dead_ports_avoided(get_default_context().get_domain_id()):
        node = Node(NODE)
    guard = PortGuard()
    try:
        result = _record(node, given, stop)
    except DataLoggerError as error:
        result = {'error': str(error)}
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
        guard.close()
    print(json.dumps(result), flush=True)  # noqa: T201
    return 0 if result.get('delivered') else 1


def _arguments(given: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    parser.add_argument('name')
    parser.add_argument('--robot', required=True)
    parser.add_argument('--duration', type=float, required=True)
    parser.add_argument('--deadline', type=float, default=60.0)
    parser.add_argument('--topic', action='append', default=[])
    parser.add_argument('--regex', default='')
    return parser.parse_args(given)


def _record(node: Node, given: argparse.Namespace, stop: StopSignals) -> dict[str, Any]:
    name = check_name(given.name, 'the mission')
    is_chosen = given.topic or given.regex
    topics = given.topic if is_chosen else _published_topics(node, given.robot, stop)
    parameters = {'robot': given.robot, 'bag.topics': topics or [''], 'bag.regex': given.regex if is_chosen or topics else '.*'}
    settings = Settings.load(parameters, os.environ)
    wanted = _Wanted(name, given.duration, given.deadline)
    with _exclusive(settings), closing(open_store(settings.store, settings.upload)) as store:
        while True:
            try:
                return _record_bag(node, settings, store, wanted, stop)
            except _IndexLostError as lost:
                wanted = replace(wanted, cut_off=lost.bag, end_s=lost.end_s)
                log.warning('%s: %s is completed, and another bag follows it', lost, lost.bag)


def _record_bag(node: Node, settings: Settings, store: ObjectStore, wanted: _Wanted, stop: StopSignals) -> dict[str, Any]:
    """Raises _IndexLostError if the spool must be opened again."""
    with ExitStack() as opened:
        # A separate owner: what a killed process left open is completed by the next one, not by the node.
        owner = f'{settings.robot} {RECORDS}'
        spool = Spool(settings.spool_path, settings.spool, SystemClock.of_this_machine(), owner)
        spool.open()
        writer = ManifestWriter(spool)
        opened.callback(_close, spool, writer)
        uploader = Uploader(spool, store, settings.upload, writer.settle)
        writer.on_commit(spooled=uploader.wake, settled=uploader.settled)
        recorder = _open_recorder(opened, node, settings, writer)
        uploader.open()
        opened.callback(uploader.close, CLOSE_S)
        workers = *uploader.workers, writer.worker
        if wanted.cut_off and (stop.received or time.monotonic() > wanted.end_s):
            bag, dropped = wanted.cut_off, 0
            _wait_for_recovery(recorder, writer, workers, bag)
        else:
            bag, dropped = _until_over(recorder, writer, workers, wanted, stop)
        manifest = writer.manifest_of(bag)
        if manifest is None:
            topics = [topic for topic in settings.bag.topics if topic]
            raise BagError('nothing was published on the topics that were to be recorded', topics=topics,
                           remedy=f'`ros2 topic list`; requested was {" ".join(topics) or settings.bag.regex}')  # fmt: skip
        waiting = _wait_for_delivery(settings, writer, workers, manifest.bag, wanted.deadline_s)
        return _result(manifest, dropped, waiting=waiting, last_error=uploader.status().last_error)


def _close(spool: Spool, writer: SpoolWriter) -> None:
    """Accounts of a spool whose index is lost are lost as well, which was reported."""
    try:
        spool.close()
    except SpoolError:
        if not writer.damaged:
            raise


def _open_recorder(opened: ExitStack, node: Node, settings: Settings, writer: SpoolWriter) -> Recorder:
    """Open writer, intake and recorder; they are closed in reverse order."""
    clock, accounts = SystemClock.of_this_machine(), writer.spool.accounts
    queue = BagQueue()
    bags = BagConsumer(node, settings.bag, accounts, queue)
    stamps = StampRule(clock, round(settings.clock.max_offset_s * SECOND))
    intake = Intake(node, {}, accounts, MessageTypes(), stamps, [bags])
    context = BagContext(settings.home / RECORDS / settings.robot, settings.robot, clock, writer)
    recovery = BagRecovery(context, settings.bag.priority)
    recorder = Recorder(settings.bag, context, queue, recovery, partial(intake.listen, bags))
    writer.open()
    opened.callback(writer.close, CLOSE_S)
    intake.open()
    opened.callback(intake.close, CLOSE_S)
    recorder.open()
    opened.callback(lambda: recorder.close(DAMAGED_S if writer.damaged else CLOSE_S))
    return recorder


def _published_topics(node: Node, robot: str, stop: StopSignals) -> list[str]:
    """For each sensor of a Unitree its first published topic, otherwise its first; empty for another robot."""
    sensors = [sensor.topics for sensor in Settings.load({'robot': robot}, {}).sensors if sensor.enabled]
    end_s = time.monotonic() + DISCOVERY_S
    while time.monotonic() < end_s and not stop.received:
        if any(node.count_publishers(topic) for topics in sensors for topic in topics):
            time.sleep(MORE_S)
            break
        time.sleep(STEP_S)
    if not is_unitree(node, dict(node.get_topic_names_and_types())):
        return []
    return [next((topic for topic in topics if node.count_publishers(topic)), topics[0]) for topics in sensors]


def _until_over(recorder: Recorder, writer: SpoolWriter, workers: Sequence[Worker], wanted: _Wanted,
                stop: StopSignals) -> tuple[str, int]:  # fmt: skip
    """Record; returns the bag's initial name, and how many messages were dropped."""
    recorder.on_mission(MissionOf(wanted.name, None, None))
    done, bag = recorder.start()
    if not done:
        raise BagError(f'no bag was recorded: {bag}')
    end_s, discovered_s = wanted.end_s, time.monotonic() + DISCOVERY_S
    while time.monotonic() < end_s and not stop.received:
        time.sleep(min(STEP_S, max(0.0, end_s - time.monotonic())))
        if end_s == math.inf and (recorder.status().messages or time.monotonic() > discovered_s):
            end_s = time.monotonic() + wanted.duration_s
        _supervise((*recorder.workers, *workers))
        if writer.damaged:
            raise _IndexLostError(bag, end_s)
    dropped = recorder.status().dropped
    done, text = recorder.stop()
    if not done and writer.damaged:
        raise _IndexLostError(bag, end_s)
    if not done:
        raise BagError(f'{bag} could not be closed: {text}', remedy='the next `shadowhound-data bag record` completes it')
    return bag, dropped


def _wait_for_recovery(recorder: Recorder, writer: ManifestWriter, workers: Sequence[Worker], bag: str) -> None:
    end_s = time.monotonic() + RECOVERY_S
    while writer.manifest_of(bag) is None and time.monotonic() < end_s:
        time.sleep(STEP_S)
        _supervise((*recorder.workers, *workers))


def _wait_for_delivery(settings: Settings, writer: SpoolWriter, workers: Sequence[Worker], bag: str,
                       deadline_s: float) -> bool:  # fmt: skip
    """Wait until nothing of the bag is left in the spool; return whether something still is."""
    end_s = time.monotonic() + deadline_s
    writer.prompt = True
    writer.flush(CLOSE_S)
    while (waiting := _waits(settings, bag)) and time.monotonic() < end_s:  # a second signal exits the process: the bag is safe
        time.sleep(STEP_S)
        _supervise(workers)
    return waiting


def _result(manifest: Manifest, dropped: int, *, waiting: bool, last_error: str) -> dict[str, Any]:
    """The result as JSON."""
    return {
        'robot': manifest.robot, 'bag': manifest.bag,
        'messages': sum(sum(each.recorded.values()) for each in manifest.slices),
        'slices': len(manifest.slices), 'bytes': sum(each.bytes for each in manifest.slices),
        'topics': {each.topic: each.messages for each in manifest.topics}, 'delivered': not waiting,
        'last_error': last_error if waiting else '', 'dropped': dropped,
    }  # fmt: skip


def _waits(settings: Settings, bag: str) -> bool:
    return any(file.bag == bag for file in local_files(settings.home, settings.robot).values())


def _supervise(workers: Iterable[Worker]) -> None:
    for worker in workers:
        worker.poll()


@contextmanager
def _exclusive(settings: Settings) -> Iterator[None]:
    """Only one at a time: the open slice of another one would look like that of a dead process."""
    folder = settings.home / RECORDS
    folder.mkdir(parents=True, exist_ok=True)
    with flock(folder / f'{settings.robot}.lock', wait=False) as is_mine:
        if not is_mine:
            raise BagError(f'another `bag record` is already recording {settings.robot}', remedy='wait until it ends')
        yield


if __name__ == '__main__':
    sys.exit(main())
