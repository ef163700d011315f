"""The intake thread: it alone creates, drains and destroys subscriptions, on its own clock (docs/decisions/0010).

It passes the messages of a topic to its consumers (``consumers.Consumer``) in order. Nothing here touches disk or network or
parses a message.
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

from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.core.stamps import StampRule
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.intake.consumers import Consumer
from shadowhound_data_logger.node.intake.early import EarlyReaders
from shadowhound_data_logger.node.intake.extra_topics import ExtraTopics
from shadowhound_data_logger.node.intake.found_topics import FoundTopics
from shadowhound_data_logger.node.intake.subscriber import Dependencies, OtherTypes, Subscriber, SubscriberStatus
from shadowhound_data_logger.ros.endpoints import POLL_S, alternatives
from shadowhound_data_logger.ros.reader import PolledGroup
from shadowhound_data_logger.ros.type_descriptions import TypeDescriptions
from shadowhound_data_logger.spool.accounts import Accounts

REFRESH_S: Final = 0.5
"""Interval between checks of the graph, which take some 80 us per topic."""
PATIENCE_S: Final = 5.0
"""A round that lasts longer is stuck: a drain takes milliseconds, a first subscription 0.1 s."""


class Intake:
    """Takes all messages, on one thread, and passes them to the consumers.

    New; open once; close once. The thread handles requests between two drains.

    ``sensors`` are the current settings, shared with consumers and encoders; at run time only this thread replaces entries.
    """

    def __init__(self, node: Node, sensors: dict[str, SensorSettings], accounts: Accounts, types: MessageTypes,  # noqa: PLR0913 - its neighbors
                 stamps: StampRule, consumers: Sequence[Consumer], *, first: Callable[[SensorSettings], bool] = lambda _: False,
                 found: FoundTopics | None = None, early: EarlyReaders | None = None) -> None:  # fmt: skip
        """``consumers`` receive the messages; one that wants topics besides those of the sensors shares those of earlier
        consumers.

        ``first`` selects sensors that are drained before all others; ``found`` finds sensors in the graph; ``early`` are
        subscriptions that exist already.
        """
        self._sensors = sensors
        self.consumers = consumers
        self.found = found
        self._early = early
        group = early.group if early else PolledGroup()
        self._descriptions = TypeDescriptions(node, group)
        self._context = context = Dependencies(node, group, accounts, types, stamps, early, self._descriptions)
        self._others = OtherTypes(node, accounts)
        self._subscribers = tuple(Subscriber(context, sensor, consumers, self._others) for sensor in sensors.values())
        self._is_first = first
        self._by_turn = self._in_turn()
        pairs = [pair for sensor in sensors.values() for pair in zip(sensor.topics, sensor.types, strict=False)]
        named = {node.resolve_topic_name(topic): name for topic, name in pairs if name and len(alternatives(name)) == 1}
        self._extra = [ExtraTopics(context, consumers[index:], named)
                       for index, consumer in enumerate(consumers) if consumer.wanted_topics is not None]  # fmt: skip
        self._listening = [extra for extra in self._extra if extra.consumer.from_start]
        self._requests = _Requests()
        self._next_poll_s = self._next_refresh_s = 0.0
        self.paused = False
        """Whether messages are only counted; set by the thread."""
        self.worker = Worker('intake', self._step, patience_s=PATIENCE_S)

    @property
    def topics(self) -> Sequence[str]:
        """The resolved topics of sensors that it subscribes to, or would."""
        return [subscriber.topic for subscriber in self._subscribers if subscriber.sensor.enabled]

    @property
    def wanted(self) -> Mapping[str, str]:
        """All resolved topics of the enabled sensors, with the type that the settings name for each, or ''."""
        return {topic: name for one in self._subscribers if one.sensor.enabled for topic, name in one.wanted.items()}

    @property
    def _unsampled(self) -> Sequence[Subscriber]:
        """Subscribers to topics that no sensor has."""
        return [subscriber for extra in self._extra for subscriber in extra.own]

    def status(self) -> list[SubscriberStatus]:
        return [subscriber.status() for subscriber in self._subscribers]

    def open(self) -> None:
        for consumer in self.consumers:
            if consumer.from_start:
                consumer.begin()
        self.worker.start()

    def close(self, deadline_s: float) -> bool:
        """Take what waits, flush it to the consumers, close subscriptions and the thread; False if that failed or timed out."""
        if self.worker.stopping:
            return True
        finished = self._requests.call(self._finish, deadline_s)
        self.worker.stop()
        self._requests.post(lambda: None)
        return self.worker.join(deadline_s) and finished

    def flush(self, deadline_s: float, then: Callable[[], None] | None = None) -> bool:
        """Take what waits, and flush the consumers; False if that failed or timed out.

        ``then`` is called by the thread between earlier and later messages.
        """
        return self._requests.call(partial(self._flush, then), deadline_s)

    def pause(self, deadline_s: float, *, paused: bool) -> bool:
        """From now on only count messages, or store them again; False if that failed or timed out."""

        def then() -> None:
            self.paused = paused
            for subscriber in (*self._subscribers, *self._unsampled):
                subscriber.paused = paused

        return self.flush(deadline_s, then)

    def listen(self, consumer: Consumer, on: bool, deadline_s: float) -> bool:
        """Start or stop passing messages to a consumer that selects topics; False if that failed or timed out.

        ``on`` while it is on already starts again: earlier messages are taken first.
        """
        extra = next(extra for extra in self._extra if extra.consumer is consumer)
        return self._requests.call(partial(self._listen, extra, on), deadline_s)

    def update(self, sensors: Iterable[SensorSettings]) -> None:
        """Apply these settings soon; sensors that are not among them stay unchanged."""
        self._requests.post(partial(self._update, tuple(sensors)))

    # -- on the thread ---------------------------------------------------------------------------------------------

    def _step(self) -> None:
        """One round: wait for the next poll, follow the graph, drain every topic, handle requests."""
        self._requests.wait(self._next_poll_s - time.monotonic())
        now_s = time.monotonic()
        self._next_poll_s = now_s + until_poll(time.time())
        todo: list[Callable[[], None]] = []
        if refreshes := now_s >= self._next_refresh_s:
            self._next_refresh_s = now_s + REFRESH_S
            todo += [*(partial(subscriber.refresh, now_s) for subscriber in self._by_turn), partial(self._find, now_s)]
        if refreshes and self._early is not None:  # after the first check of the graph
            todo.append(self._early.close)
            self._early = None
        todo += [partial(subscriber.drain, now_s) for subscriber in (*self._by_turn, *self._unsampled)]
        todo.append(self._others.drain)
        if refreshes and self._listening:
            todo.append(partial(self._follow, now_s))
        todo += [partial(consumer.tick, now_s) for consumer in self.consumers]
        _each([*todo, self._requests.handle])

    def _find(self, now_s: float) -> None:
        """Add sensors for topics that the settings do not name, and remove those of a robot that this is not."""
        if self.found is None:
            return
        for sensor in self.found.poll(self._sensors, now_s):
            self._sensors[sensor.name] = sensor
            subscriber = Subscriber(self._context, sensor, self.consumers, self._others)
            subscriber.paused = self.paused
            self._subscribers = (*self._subscribers, subscriber)
            self._by_turn = self._in_turn()
            subscriber.refresh(now_s)
        unused = [one for one in self._subscribers if one.is_unused and self.found.may_remove(one.sensor)]
        if unused:
            self._subscribers = tuple(one for one in self._subscribers if one not in unused)
            self._by_turn = self._in_turn()
            for one in unused:
                del self._sensors[one.sensor.name]
            self.found.remove([one.sensor for one in unused])
            _each([partial(one.close, now_s) for one in unused])

    def _in_turn(self) -> list[Subscriber]:
        return sorted(self._subscribers, key=lambda subscriber: not self._is_first(subscriber.sensor))

    def _drain(self, now_s: float) -> None:
        _each([partial(subscriber.drain, now_s) for subscriber in (*self._by_turn, *self._unsampled)])

    def _flush(self, then: Callable[[], None] | None = None) -> None:
        steps: list[Callable[[], None]] = [partial(self._drain, time.monotonic())]
        _each([*steps, *(consumer.flush for consumer in self.consumers), *([then] if then is not None else [])])

    def _update(self, sensors: Sequence[SensorSettings]) -> None:
        now_s = time.monotonic()
        if self.found is not None:
            self.found.update(sensors)
        for sensor in sensors:
            present = self._sensors.get(sensor.name)
            if present is not None and present.topics == sensor.topics:  # not one that was found, of the same name
                self._sensors[sensor.name] = sensor
        _each([partial(subscriber.update, self._sensors[subscriber.sensor.name], now_s) for subscriber in self._subscribers])
        self._next_refresh_s = now_s

    def _listen(self, extra: ExtraTopics, on: bool) -> None:
        """Drain first: earlier messages belong to what ended, not to what starts."""
        now_s = time.monotonic()
        self._drain(now_s)
        is_on = extra in self._listening
        self._listening = [each for each in self._extra if (on if each is extra else each in self._listening)]
        if on:
            if is_on:
                extra.renew(now_s)
            extra.consumer.begin()
            self._follow(now_s)
        else:
            extra.end(now_s)

    def _follow(self, now_s: float) -> None:
        sensors = {each.topic: each.has_latched for each in self._subscribers if each.sensor.enabled}
        taken = dict(sensors)
        for extra in self._listening:
            extra.refresh(taken, sensors, now_s, paused=self.paused)
            taken |= {each.topic: each.has_latched for each in extra.own}

    def _finish(self) -> None:
        now_s = time.monotonic()
        ends = [partial(subscriber.close, now_s) for subscriber in self._subscribers]
        ends += [partial(extra.end, now_s) for extra in self._extra]
        _each(
            [
                *ends,
                *(consumer.flush for consumer in self.consumers),
                self._others.close,
                self._descriptions.close,
                self.worker.stop,
            ]
        )


class _Requests:
    """What other threads request of the intake, which handles it between two drains."""

    def __init__(self) -> None:
        self._waiting: deque[Callable[[], None]] = deque()
        self._wake = threading.Event()

    def post(self, request: Callable[[], None]) -> None:
        self._waiting.append(request)
        self._wake.set()

    def call(self, request: Callable[[], None], deadline_s: float) -> bool:
        """Whether the thread did it in time and without a failure; if it takes longer, it still does it."""
        done = threading.Event()
        succeeded: list[bool] = []

        def answer() -> None:
            try:
                request()
                succeeded.append(True)
            finally:
                done.set()

        self.post(answer)
        return done.wait(max(0.0, deadline_s)) and bool(succeeded)

    def wait(self, seconds: float) -> None:
        """On the thread: until a request waits, at most so long."""
        self._wake.wait(max(0.0, seconds))
        self._wake.clear()

    def handle(self) -> None:
        """On the thread."""
        while self._waiting:
            self._waiting.popleft()()


def until_poll(wall_s: float) -> float:
    """Seconds until the next poll, which is halfway between two multiples of ``POLL_S``; at least a quarter of that.

    The once-per-second messages of all sensors then arrive with one poll, 0.1 s after the full second, and are one burst for the
    spool: by then every topic of 10 Hz or more has sent its first message.
    """
    return POLL_S - ((wall_s - POLL_S / 4) % POLL_S - POLL_S / 4)


def _each(steps: Sequence[Callable[[], None]]) -> None:
    """Call all of them in order, even if one raises; its exception is raised at the end."""
    with ExitStack() as stack:
        for step in reversed(steps):
            stack.callback(step)
