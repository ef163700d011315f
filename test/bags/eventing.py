"""Shared by tests of events: a ring and its writer over a spool, with a clock set by the test."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bags.recording import ROBOT, STRING, WAIT_S, BoundedSpool, manifest, messages, numbers
from clocks import Clocks

from shadowhound_data_logger.bags.context import BagContext
from shadowhound_data_logger.bags.events import NOTICE_S, Events
from shadowhound_data_logger.bags.queue import MessageBatch
from shadowhound_data_logger.bags.recovery import BagRecovery
from shadowhound_data_logger.bags.ring import Ring
from shadowhound_data_logger.core.config import SpoolSettings
from shadowhound_data_logger.core.options import BagSettings, EventSettings
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.topic_account import EVENT, Losses
from shadowhound_data_logger.spool.writer import SpoolWriter

POLL_S = 0.2


def until(condition: Callable[[], Any], what: str) -> None:
    end_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end_s, what
        time.sleep(0.002)


@dataclass(slots=True)
class Buffer:
    """Events with the complete pipeline. ``hear`` acts as the intake does at the present second."""

    spool: BoundedSpool
    writer: SpoolWriter
    ring: Ring
    events: Events
    home: Path
    now_s: list[float]

    @property
    def room(self) -> list[bool]:
        return self.spool.has_room

    @property
    def root(self) -> Path:
        return self.home / 'bags' / ROBOT

    def hear(self, numbers: range, topic: str = '/talk', size: int = 0, lost: Losses = None) -> None:
        gone = self.ring.put(MessageBatch(topic, STRING, '', messages(numbers, size)), lost, self.now_s[0])
        self.events.claims.lose(gone)

    def pass_s(self, seconds: float) -> None:
        self.now_s[0] += seconds

    def taken(self) -> None:
        """Wait until the writer has everything that was in the ring."""
        until(lambda: self.ring.bytes == 0, 'the writer takes what there is')

    def written(self, count: int = 1) -> None:
        until(lambda: self.events.status().written >= count, f'{count} events are written: {self.events.status()}')

    def rows(self) -> dict[str, Any]:
        """The rows of the ledger, once everything is committed."""
        assert self.writer.flush(WAIT_S)
        self.spool.commit()
        found = ledger.read(self.spool.root, ROBOT)
        assert ledger.imbalances(found) == []
        rows: dict[str, Any] = found['events']
        return rows

    def objects(self) -> dict[str, Path]:
        """Key below the robot's bags -> file, for everything in the spool."""
        assert self.writer.flush(WAIT_S)
        start = f'{ROBOT}/rosbags/'
        return {item.key.removeprefix(start): item.path for item in self.spool.pending(1000)}

    def bags(self) -> list[str]:
        return sorted({key.partition('/')[0] for key in self.objects()})


@contextmanager
def buffer(home: Path, clock: Clocks | None = None, **settings: Any) -> Iterator[Buffer]:
    """An open buffer, with five seconds before a trigger and two after it; closed as the node does it."""
    clocks = clock or Clocks()
    if clock is None:
        clocks.set()
    options = EventSettings(**{'topics': ('/talk',), 'pre_s': 5.0, 'post_s': 2.0, 'max_s': 10.0, **settings})
    bag = BagSettings(compression='none')
    spool = BoundedSpool(home / 'spool', SpoolSettings(min_free_bytes=0), clocks, ROBOT)
    spool.open()
    spool.carry(EVENT)
    writer = SpoolWriter(spool, 0.01)
    writer.open()
    now_s, made = [1000.0], list[Buffer]()
    place = BagContext(home / 'bags' / ROBOT, ROBOT, clocks, writer, 600.0)
    ring = Ring(options.max_bytes, options.pre_s + NOTICE_S)
    recovery = BagRecovery(place, 8)
    events = Events(options, bag, place, ring, recovery, POLL_S, lambda: now_s[0])
    made.append(Buffer(spool, writer, ring, events, home, now_s))
    try:
        recovery.open()
        until(lambda: not recovery.is_busy, 'what was cut off is whole')
        events.open()
        yield made[0]
    finally:
        events.close(WAIT_S)
        recovery.close(WAIT_S)
        writer.close(WAIT_S)
        spool.close()


def only_bag(it: Buffer) -> str:
    """The only bag."""
    (bag,) = it.bags()
    return bag


def in_bag(it: Buffer, bag: str) -> list[int]:
    """The numbers of its messages, slice by slice."""
    found = it.objects()
    return [number for file in manifest(found, bag)['slices'] for number in numbers(found[f'{bag}/{file["file"]}'])]


def hear_each_second(it: Buffer, seconds: range) -> None:
    """One message per second, numbered accordingly."""
    for second in seconds:
        it.hear(range(second, second + 1))
        it.pass_s(1.0)
