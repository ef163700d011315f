"""Shared by tests of the recorder: messages as the intake passes them on, and a spool with its writer."""

from __future__ import annotations

import json
import threading
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from clocks import Clocks
from mcap.reader import make_reader

from shadowhound_data_logger.bags.context import BagContext
from shadowhound_data_logger.bags.manifest import MissionOf
from shadowhound_data_logger.bags.queue import MAX_BYTES, BagQueue, MessageBatch
from shadowhound_data_logger.bags.recorder import Recorder
from shadowhound_data_logger.bags.recovery import BagRecovery
from shadowhound_data_logger.core.config import SpoolSettings
from shadowhound_data_logger.core.model import Taken
from shadowhound_data_logger.core.options import BagSettings
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.topic_account import BAG
from shadowhound_data_logger.spool.writer import SpoolWriter

NOON_NS = 1_760_788_800 * 10**9
STRING = 'std_msgs/msg/String'
ROBOT = 'thor'
WAIT_S = 60.0
HOLD_S = 600.0


def messages(numbers: range, size: int = 0) -> list[Taken]:
    """Messages of one publisher, 10 ms apart; each arrived 1 ms after it was sent."""
    return [
        Taken(
            b'\0\1\0\0%08d' % number + b'x' * size,
            NOON_NS + number * 10**7,
            'p',
            number,
            NOON_NS + number * 10**7 + 10**6,
            NOON_NS + number * 10**7,
        )
        for number in numbers
    ]


def batch(numbers: range, topic: str = '/talk', size: int = 0, type_name: str = STRING) -> MessageBatch:
    return MessageBatch(topic, type_name, '', messages(numbers, size))


class BoundedSpool(Spool):
    """A spool with a disk that has room for bags while the test says so."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.has_room = [True]
        self.room.has_for_bags = lambda: self.has_room[0]  # type: ignore[method-assign]


@dataclass(slots=True)
class Desk:
    """A recorder with the complete pipeline. Messages passed to ``hear`` count as received, as in the intake."""

    spool: BoundedSpool
    writer: SpoolWriter
    queue: BagQueue
    recorder: Recorder
    home: Path
    listening: list[bool] = field(default_factory=list)

    @property
    def room(self) -> list[bool]:
        return self.spool.has_room

    @property
    def root(self) -> Path:
        return self.home / 'bags' / ROBOT

    def hear(self, numbers: range, topic: str = '/talk', size: int = 0, *, numbered: bool = True, latched: int = 0,
             publisher: str = 'p') -> None:  # fmt: skip
        received = batch(numbers, topic, size)._replace(latched=latched)
        received = received._replace(messages=[message._replace(publisher=publisher) for message in received.messages])
        if not numbered:
            received = received._replace(
                messages=[message._replace(publisher=None, number=None) for message in received.messages]
            )
        with self.spool.accounts.entry(f'{BAG}{topic}') as account:
            for message in received.messages:
                assert account.receive(message.publisher, message.number)
            account.gaps.newest = received.messages[-1].times
        dropped = self.queue.put(received)
        if dropped:
            self.spool.accounts.drop(f'{BAG}{topic}', 'queue_full', dropped)

    def row(self, topic: str = '/talk') -> dict[str, Any]:
        """The row of the ledger, once everything is committed."""
        assert self.writer.flush(WAIT_S)
        self.spool.commit()
        found = ledger.read(self.spool.root, ROBOT)
        assert ledger.imbalances(found) == []
        row: dict[str, Any] = found['bags'][topic]
        return row

    def objects(self) -> dict[str, Path]:
        """Key below the robot's bags -> file, for everything in the spool."""
        assert self.writer.flush(WAIT_S)
        start = f'{ROBOT}/rosbags/'
        return {item.key.removeprefix(start): item.path for item in self.spool.pending(1000)}


@contextmanager
def desk(home: Path, clock: Clocks | None = None, *, offsets: Mapping[str, int] | None = None, **settings: Any) -> Iterator[Desk]:
    """An open desk; closed as the node does it, unless it was before. ``offsets`` are known offsets of other boots' clocks."""
    time = clock or Clocks()
    if clock is None:
        time.set()
    spool = BoundedSpool(home / 'spool', SpoolSettings(min_free_bytes=0, **settings.pop('spool', {})), time, ROBOT)
    queue = BagQueue(settings.pop('queue_bytes', MAX_BYTES))
    bag = BagSettings(**{'compression': 'none', **settings})
    spool.open()
    spool.carry(BAG)
    writer = SpoolWriter(spool, 0.01)
    writer.open()
    root = home / 'bags' / ROBOT
    made: list[Desk] = []

    def listen(on: bool, deadline_s: float) -> bool:
        made[0].listening.append(on)
        return True

    place = BagContext(root, ROBOT, time, writer, HOLD_S, lambda: offsets or {})
    recorder = Recorder(bag, place, queue, BagRecovery(place, bag.priority), listen)
    made.append(Desk(spool, writer, queue, recorder, home))
    try:
        recorder.open()
        yield made[0]
    finally:
        recorder.close(WAIT_S)
        writer.close(WAIT_S)
        spool.close()


def mission(name: str = 'patrol', number: int = 1, run_id: str | None = None) -> MissionOf:
    return MissionOf(name, f'{name}_{number}', run_id)


def numbers(path: Path) -> list[int]:
    """The numbers of a slice's messages, in file order."""
    with path.open('rb') as file:
        return [
            int(message.data[4:12]) for *_, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
        ]


def missing(said: Mapping[str, Any]) -> Counter[tuple[str, str]]:
    """By topic and reason, the messages that a manifest counts as missing."""
    found = Counter[tuple[str, str]]()
    for each in said['missing']:
        if each['messages'] is not None:
            found[each['topic'], each['reason']] += each['messages']
    return found


def journaled(root: Path, sink: str, robot: str = ROBOT) -> Counter[tuple[str, str]]:
    """By topic and cause, the messages that the gap journal of a spool has of a sink; each row has its times."""
    found = Counter[tuple[str, str]]()
    for row in ledger.journal(root, robot):
        if row.sink == sink:
            assert row.from_ns is not None
            assert row.to_ns is not None
            assert row.kind == 'dropped'
            found[row.topic, row.cause] += row.count or 0
    return found


def manifest(found: dict[str, Path], bag: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(found[f'{bag}/manifest.json'].read_bytes())
    return content


def start(recorder: Recorder) -> str:
    done, name = recorder.start()
    assert done, name
    return name


def write_out(it: Desk) -> None:
    """Write as the thread does, twice per second."""
    done = threading.Event()

    def sync() -> None:
        assert it.recorder._writing is not None
        it.recorder._writing.output.count_dropped(it.queue.take_dropped())
        it.recorder._writing.tick()
        done.set()

    it.queue.mark(sync)
    assert done.wait(60)
