"""The intake thread: it alone creates, drains and destroys subscriptions, on its own clock (D1, D2).

Nothing here touches disk or network or parses a message. What the bounded queue has no room for is dropped and counted.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Final

from rclpy.node import Node

from shadowhound_data_logger.bags.topics import Choice
from shadowhound_data_logger.capture.bag_sources import BagSources
from shadowhound_data_logger.capture.event_tap import EventTap, Taps
from shadowhound_data_logger.capture.reader import PolledGroup
from shadowhound_data_logger.capture.source import OtherTypes, Source, SourceStatus
from shadowhound_data_logger.capture.stream import Offer, Shared
from shadowhound_data_logger.config import BagSettings, IntakeSettings, SensorSettings
from shadowhound_data_logger.encode.queue import BatchQueue
from shadowhound_data_logger.model import Batch
from shadowhound_data_logger.spool.accounts import Accounts
from shadowhound_data_logger.worker import Worker

REFRESH_S: Final = 0.5
"""How often the graph is looked at: some 80 us a topic."""
PATIENCE_S: Final = 5.0
"""A round that lasts longer is stuck: a drain takes milliseconds, a first subscription a tenth of a second."""


class Intake:
    """New; open once; close once. ``flush``, ``pause`` and ``update`` are done by the thread, between two drains.

    ``sensors`` are the settings in force, shared with the encoders; while it runs, this thread alone replaces its entries.
    """

    def __init__(self, node: Node, sensors: dict[str, SensorSettings], settings: IntakeSettings, shared: Shared,
                 bag: BagSettings, events: EventTap | None = None) -> None:  # fmt: skip
        self._sensors = sensors
        self._settings = settings
        group, of_bag = PolledGroup(), shared
        self._taps = Taps(of_bag.tap, *([events] if events is not None else []))
        if events is not None:
            shared = shared._replace(tap=self._taps)
        self._others = OtherTypes(node, shared.accounts)
        self._sources = tuple(Source(node, sensor, settings, group, shared, others=self._others) for sensor in sensors.values())
        # The odometry comes first, so that what is taken after it finds its pose.
        self._by_turn = sorted(self._sources, key=lambda source: not (shared.robot and shared.robot.is_odometry(source.topic)))
        named = (node.resolve_topic_name(topic) for topic in bag.topics if topic)
        types = {node.resolve_topic_name(topic): type_name for sensor in sensors.values()
                 for topic, type_name in zip(sensor.topics, sensor.types, strict=False) if type_name}  # fmt: skip
        self._bag = BagSources(node, Choice(bag, named), of_bag.tap, settings, group, of_bag, types)
        self._ring = BagSources(node, events.choice, events, settings, group, shared, types) if events is not None else None
        self._records = False
        self._requests: deque[Callable[[], None]] = deque()
        self._wake = threading.Event()
        self._next_poll_s = self._next_refresh_s = 0.0
        self.paused = False
        """Whether messages are counted only; set by the thread."""
        self.worker = Worker('intake', self._step, patience_s=PATIENCE_S)

    @property
    def topics(self) -> Sequence[str]:
        """The resolved topics it listens to, or would."""
        return [source.topic for source in self._sources if source.sensor.enabled]

    @property
    def _unsampled(self) -> Sequence[Source]:
        """Of topics that only a bag or the ring wants."""
        return *self._bag.own, *(self._ring.own if self._ring is not None else ())

    @property
    def left_out(self) -> tuple[int, int]:
        """Topics that a bag, and the ring of the events, would have by an expression, and do not: there are too many."""
        return self._bag.left_out, self._ring.left_out if self._ring is not None else 0

    def status(self) -> list[SourceStatus]:
        return [source.status() for source in self._sources]

    def open(self) -> None:
        self.worker.start()

    def begin_idle(self) -> None:
        """Before ``open``: nobody wants the data yet."""
        self._set_idle(idle=True)

    def close(self, deadline_s: float) -> bool:
        """Take what waits, close the batches and the subscriptions, end the thread; False if that failed or took too long."""
        if self.worker.stopping:
            return True
        finished = self._ask(self._finish, deadline_s)
        self.worker.stop()
        self._wake.set()
        return self.worker.join(deadline_s) and finished

    def flush(self, deadline_s: float) -> bool:
        """Take what waits and close the open batches; False if that failed or took too long."""
        return self._ask(self._flush, deadline_s)

    def pause(self, deadline_s: float, *, paused: bool) -> bool:
        """From now on count and drop what comes, or store it again; False if that failed or took too long."""
        return self._ask(partial(self._pause, paused=paused), deadline_s)

    def idle(self, deadline_s: float, *, idle: bool) -> bool:
        """From now on count and skip what comes, or store it again; False if that failed or took too long."""
        return self._ask(partial(self._set_idle, idle=idle), deadline_s)

    def record(self, deadline_s: float, *, on: bool) -> bool:
        """From now on hand all that comes of the bag's topics to the bag, or no more; False if that failed or took too long.

        ``on`` while it is done already: another bag begins here.
        """
        return self._ask(partial(self._record, on=on), deadline_s)

    def update(self, sensors: Iterable[SensorSettings]) -> None:
        """Go on by these settings soon; sensors that are not among them stay as they are."""
        self._post(partial(self._update, tuple(sensors)))

    # -- what the thread does --------------------------------------------------------------------------------------

    def _step(self) -> None:
        """One round: wait for the next poll, follow the graph, drain every source, do what was asked for."""
        self._wake.wait(max(0.0, self._next_poll_s - time.monotonic()))
        self._wake.clear()
        now_s = time.monotonic()
        self._next_poll_s = now_s + self._settings.poll_s
        todo: list[Callable[[], None]] = [partial(source.drain, now_s) for source in self._by_turn]
        todo += [partial(source.drain, now_s) for source in self._unsampled]
        todo.append(self._others.drain)
        if now_s >= self._next_refresh_s:
            self._next_refresh_s = now_s + REFRESH_S
            todo = [*(partial(source.refresh, now_s) for source in self._by_turn), *todo]
            if self._records or self._ring is not None:
                todo.append(partial(self._follow, now_s))
        _each([*todo, self._obey])

    def _obey(self) -> None:
        while self._requests:
            self._requests.popleft()()

    def _flush(self) -> None:
        now_s = time.monotonic()
        _each([partial(source.flush, now_s) for source in self._sources])

    def _pause(self, *, paused: bool) -> None:
        now_s = time.monotonic()
        self.paused = paused
        _each([partial(source.pause, now_s, paused=paused) for source in (*self._sources, *self._unsampled)])

    def _set_idle(self, *, idle: bool) -> None:
        now_s = time.monotonic()
        _each([partial(source.idle, now_s, idle=idle) for source in self._sources])

    def _update(self, sensors: Sequence[SensorSettings]) -> None:
        now_s = time.monotonic()
        self._sensors.update((sensor.name, sensor) for sensor in sensors)
        _each([partial(source.update, self._sensors[source.sensor.name], now_s) for source in self._sources])
        self._next_refresh_s = now_s

    def _record(self, *, on: bool) -> None:
        """What came before is drained first: it is not of this recording, or the last of it."""
        now_s = time.monotonic()
        _each([partial(source.drain, now_s) for source in (*self._sources, *self._unsampled)])
        if on and self._records:
            self._bag.renew(now_s)
        self._records = on
        if on:
            self._follow(now_s)
        else:
            self._bag.end(now_s)

    def _follow(self, now_s: float) -> None:
        sensors = {source.topic: source.has_latched for source in self._sources if source.sensor.enabled}
        ring: dict[str, bool] = {}
        if self._ring is not None:
            self._ring.refresh(dict.fromkeys(sensors, False), sensors, now_s, paused=self.paused)
            ring = {source.topic: source.has_latched for source in self._ring.own}
        if self._records:
            self._bag.refresh(sensors | ring, sensors, now_s, paused=self.paused)
        self._taps.look()

    def _finish(self) -> None:
        now_s = time.monotonic()
        ends = [partial(source.close, now_s) for source in self._sources]
        ends += [partial(each.end, now_s) for each in (self._bag, self._ring) if each is not None]
        _each([*ends, self._others.close, self.worker.stop])

    # -- between the threads ---------------------------------------------------------------------------------------

    def _post(self, request: Callable[[], None]) -> None:
        self._requests.append(request)
        self._wake.set()

    def _ask(self, request: Callable[[], None], deadline_s: float) -> bool:
        """Whether the thread did it in time and without a failure; it still does it when that takes longer."""
        done = threading.Event()
        succeeded: list[bool] = []

        def answer() -> None:
            try:
                request()
                succeeded.append(True)
            finally:
                done.set()

        self._post(answer)
        return done.wait(max(0.0, deadline_s)) and bool(succeeded)


def offer_to(queue: BatchQueue, sensors: Mapping[str, SensorSettings], accounts: Accounts) -> Offer:
    """The way of a batch to the encoders: what the queue has no room for is dropped and counted."""

    def offer(batch: Batch) -> None:
        for lost in queue.put(batch, sensors[batch.sensor].priority):
            accounts.drop(lost.topic, 'queue_full', len(lost.samples))

    return offer


def _each(steps: Sequence[Callable[[], None]]) -> None:
    """Do all of them in this order, whatever happens to one; what one raised is raised in the end."""
    with ExitStack() as stack:
        for step in reversed(steps):
            stack.callback(step)
