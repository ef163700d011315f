"""One run of the simulated Go2 with sensors, bags and a catalog that are checked in several files of tests."""

from __future__ import annotations

import signal
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bags.slices import Recorded
from e2e.bag_reading import Bag, bags, by_topic
from e2e.processes import LONG, WAIT_S, Node, Processes, is_accounted, published
from e2e.reading import TYPES, Objects, decode, stamp_ns
from e2e.witness import Heard, recorded
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.stores.base import ObjectStore

DURATION_S = 60.0 if LONG else 7.0
SLICE_S = 2.0
CATALOGUE_S = 2.0
BEST_EFFORT = {'/point_cloud2', '/camera/camera_info'}


@dataclass(frozen=True, slots=True)
class Session:
    """Robot, witness and a node with the default settings that records from its start on; all of them have stopped."""

    node: Node
    folder: Path
    robot: str
    said: dict[str, int]
    """Topic -> messages, as counted by the robot; without BEST_EFFORT messages sent before it was discovered."""
    ledger: dict[str, Any]
    ended_ns: int
    """When the node stopped."""
    heard: dict[str, list[Heard]]
    """Recorded by the witness, in order."""
    by_stamp: dict[str, dict[int, Heard]]
    """The same by stamp, from the header or otherwise from the publisher."""
    objects: Objects
    """Of the sensors."""
    bag: Bag
    messages: dict[str, list[Recorded]]
    """Of the bag."""

    @classmethod
    def of(cls, processes: Processes, seaweed: Tower, store: ObjectStore) -> Session:
        parameters = {'bag.record': 'always', 'bag.slice_s': SLICE_S, 'catalog.period_s': CATALOGUE_S}
        node = processes.node(seaweed.environment(), parameters)
        recording = processes.folder / 'witness'
        witness = processes.witness(TYPES, recording, best_effort=BEST_EFFORT)
        report = published(processes.sim(f'duration_s:={DURATION_S}'), DURATION_S + WAIT_S)
        ledger = node.stop()
        ended_ns = time.time_ns()
        for topic in BEST_EFFORT:
            counted = ledger['topics'][topic]['published']
            if counted is not None and is_accounted(counted, report[topic]):
                report[topic] = counted
        witness.signal(signal.SIGTERM)
        assert witness.wait() == 0
        received = by_topic(recorded(recording))
        (bag,) = bags(store, processes.robot, processes.folder / 'bags')
        objects = Objects.of(store, 'sensor-data', processes.robot).without(f'{processes.robot}/rosbags/')
        return cls(
            node,
            processes.folder,
            processes.robot,
            report,
            ledger,
            ended_ns,
            received,
            _by_stamp(received),
            objects,
            bag,
            by_topic(bag.messages()),
        )

    def decoded(self, topic: str, stamp: int) -> Any:
        return decode(TYPES[topic], self.by_stamp[topic][stamp].cdr)


def _by_stamp(heard: dict[str, list[Heard]]) -> dict[str, dict[int, Heard]]:
    found: dict[str, dict[int, Heard]] = defaultdict(dict)
    for topic, messages in heard.items():
        for message in messages:
            decoded = decode(TYPES[topic], message.cdr)
            found[topic][stamp_ns(decoded) if hasattr(decoded, 'header') else message.source_ns] = message
    return found
