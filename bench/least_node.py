"""Stores what the node stores, and nothing else: it reads, keeps and encodes with the same code.

One thread. The batches of one poll become files that are synced, one SQLite commit, and one put each, in sequence; then the
files are deleted. There is no ledger, status, queue, lock, report, retry or recovery. ``node_least.py`` measures it next to the
node. For each line on standard input it prints the CPU seconds of each of its steps.
"""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
import sys
import threading
import time
from collections import Counter
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import rclpy
from rclpy.node import Node

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import SensorSettings, Settings
from shadowhound_data_logger.core.model import Batch, DataObject, Sample, SpooledObject
from shadowhound_data_logger.core.stamps import StampRule
from shadowhound_data_logger.formats.encoders import encode
from shadowhound_data_logger.formats.types import MessageTypes, header_stamp_ns
from shadowhound_data_logger.node.intake.intake import until_poll
from shadowhound_data_logger.node.intake.sampling import Batcher, SamplingRule, rule_for
from shadowhound_data_logger.ros.endpoints import Plan
from shadowhound_data_logger.ros.reader import PolledGroup, Reader, endpoints
from shadowhound_data_logger.stores import open_store

if TYPE_CHECKING:
    from collections.abc import Iterator

DISCOVERY_S = 3.0
DEPTH = 200
ROBOT = 'least'
TABLE = """
CREATE TABLE objects (id INTEGER PRIMARY KEY, bucket TEXT, key TEXT, state TEXT, bytes INTEGER, sha256 TEXT, metadata TEXT,
  UNIQUE (bucket, key))
"""


class Topic:
    """A topic that is kept."""

    def __init__(self, node: Node, sensor: SensorSettings, topic: str, types: MessageTypes) -> None:
        publisher = endpoints(node, topic)[0]
        plan = Plan(topic, publisher.type, reliable=publisher.reliable, transient_local=False, depth=DEPTH)
        self.sensor, self.reader = sensor, Reader(node, plan, PolledGroup())
        self.has_header = types.has_header(publisher.type)
        self.rule: SamplingRule = rule_for(sensor, has_header=self.has_header, last_stored_ns=0)
        self.batcher = Batcher(sensor, topic, publisher.type)


class LeastNode:
    """The complete program; CPU by step in ``used``."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.used, self.put = folder, Counter[str](), 0
        settings = Settings.load({}, os.environ)
        self._types = MessageTypes(os.environ.get('AMENT_PREFIX_PATH', '').split(':'))
        self._stamps = StampRule(SystemClock.of_this_machine())
        self._store = open_store(settings.store, settings.upload)
        self._index = sqlite3.connect(folder / 'least.db', isolation_level=None)
        self._index.executescript(f'PRAGMA journal_mode = WAL; PRAGMA synchronous = FULL; {TABLE}')
        self._node = Node('least_node', start_parameter_services=False, enable_rosout=False)
        time.sleep(DISCOVERY_S)
        heard = [(sensor, topic) for sensor in settings.sensors if sensor.enabled
                 for topic in [one for one in sensor.topics if endpoints(self._node, one)][:1]]  # fmt: skip
        self._topics = [Topic(self._node, sensor, topic, self._types) for sensor, topic in heard]
        self._delivered: list[tuple[int]] = []
        self._number = 0

    def poll(self) -> None:
        with self._step('read'):
            batches = [(topic.sensor, batch) for topic in self._topics for batch in self._taken(topic)]
        if not batches:
            return
        with self._step('encode'):
            made = [encode(batch, sensor, ROBOT, self._types).object for sensor, batch in batches]
        with self._step('spool'):
            spooled = self._spool([item for item in made if item is not None])
        with self._step('put'):
            for item in spooled:
                self._store.put(item)
                item.path.unlink()
        self._delivered = [(item.id,) for item in spooled]
        self.put += len(spooled)

    def _taken(self, topic: Topic) -> Iterator[Batch]:
        for message in topic.reader.drain():
            header_ns = header_stamp_ns(message.cdr) if topic.has_header else 0
            stamp_ns = self._stamps.date(header_ns, message.source_ns, message.received_ns).ns
            if topic.rule.selects(stamp_ns, message.cdr):
                yield from topic.batcher.add(Sample(stamp_ns, message.cdr), time.monotonic())

    def _spool(self, objects: list[DataObject]) -> list[SpooledObject]:
        found = []
        for item in objects:
            assert isinstance(item.body, bytes)
            self._number += 1
            path, sha256 = self.folder / f'{self._number}.body', hashlib.sha256(item.body).hexdigest()
            with path.open('wb', buffering=0) as file:
                file.write(item.body)
                os.fsync(file)
            metadata = {**item.metadata, meta.SHA256: sha256}
            found.append(SpooledObject(self._number, item.bucket, item.key, path, len(item.body), sha256, item.content_type,
                                       metadata, item.priority, 0))  # fmt: skip
        rows = [(one.id, one.bucket, one.key, 'pending', one.size, one.sha256, json.dumps(one.metadata)) for one in found]
        self._index.execute('BEGIN')
        self._index.executemany("UPDATE objects SET state = 'delivered' WHERE id = ?", self._delivered)
        self._index.executemany('INSERT INTO objects VALUES (?, ?, ?, ?, ?, ?, ?)', rows)
        self._index.execute('COMMIT')
        return found

    @contextmanager
    def _step(self, name: str) -> Iterator[None]:
        before = time.thread_time()
        yield
        self.used[name] += time.thread_time() - before


def main() -> None:
    rclpy.init()
    node = LeastNode(Path(sys.argv[1]))

    def answer() -> None:
        for _ in sys.stdin:
            print(json.dumps({**node.used, 'objects': node.put}), flush=True)

    threading.Thread(target=answer, daemon=True).start()
    print(json.dumps({'topics': len(node._topics)}), flush=True)
    while True:
        time.sleep(until_poll(time.time()))
        node.poll()


if __name__ == '__main__':
    main()
