"""The messages of one topic and type between take and consumers. Plain Python, owned by the intake thread.

A stream identifies the publisher of each message, skips repeats, and estimates losses between messages without sequence
numbers. The rest is passed to the consumers of the topic (``consumers.py``).
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from math import inf
from typing import Final
from zlib import crc32

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.core.model import Taken
from shadowhound_data_logger.core.stamps import NO_TIMES, StampReport, StampRule, StampTracks
from shadowhound_data_logger.formats.types import CounterField, MessageTypes, header_stamp_ns
from shadowhound_data_logger.node.intake.consumers import Consumer, Drained, count_failure, deliver
from shadowhound_data_logger.spool.accounts import Accounts
from shadowhound_data_logger.spool.estimator import ArrivalContext, Expectation, TopicEstimate
from shadowhound_data_logger.spool.gaps import EXACT

log = logging.getLogger(__name__)

MAX_RECENT: Final = 10_000
"""Remembered messages without a publisher's gid, to detect what a second subscription delivers again."""
DEAD_S: Final = 15.0
"""A publisher that was killed stays in the graph for less: Cyclone DDS drops it after ten seconds."""
NEW_S: Final = 2.0
"""How long the graph may know a publisher before its first message is taken, and its predecessor's last one."""


class Senders:
    """Identifies the publisher of a message if the middleware reports its number but not its gid (Jazzy and older).

    With one publisher in the graph it is that one. Its successor is detected before the graph shows the change: its numbers
    restart while the time of sending advances. If the old numbers continue as well, there are two publishers.
    """

    def __init__(self) -> None:
        self.gids: list[str] = []
        self.changed_s = -inf
        """When the last new publisher appeared, by the monotonic clock; the first ones do not count."""
        self.several_s: float | None = None
        """Since when there are several."""
        self._successors = 0
        self._number = 0
        self._number_before = 0
        self._sent_ns = 0

    def poll(self, gids: list[str], now_s: float = 0.0) -> None:
        """Update the publishers from the graph."""
        self.several_s = None if len(gids) < 2 else now_s if self.several_s is None else self.several_s
        if gids and gids != self.gids:
            if self.gids and not set(gids) <= set(self.gids):
                self.changed_s = now_s
            self.gids = gids
            self._successors = 0

    def name(self, number: int | None, sent_ns: int) -> str | None:
        """The publisher of this message; None if there is more than one, or no number."""
        if number is None or len(self.gids) != 1:
            return None
        if self._successors and self._number < self._number_before < number:
            return None
        if number <= self._number and sent_ns > self._sent_ns:
            self._successors += 1
            self._number_before = self._number
        if sent_ns >= self._sent_ns:
            self._number, self._sent_ns = number, sent_ns
        return f'{self.gids[0]}.{self._successors}'


class RecentMessages:
    """Recent messages without a publisher's gid, to detect what a second subscription delivers again."""

    def __init__(self) -> None:
        self._recent: dict[tuple[int, int], None] = {}

    def has(self, message: Taken) -> bool:
        """Whether it was received before: same time of sending, same number or content.

        Also called while the graph has one publisher, whose gid the middleware does not report: a second one may appear.
        """
        mark = (message.source_ns, crc32(message.cdr) if message.number is None else message.number)
        if mark in self._recent:
            return True
        self._recent[mark] = None
        if len(self._recent) > MAX_RECENT:
            del self._recent[next(iter(self._recent))]
        return False


class Arrivals:
    """Arrival times of messages without numbers, for estimating losses."""

    def __init__(self) -> None:
        self._received_s: float | None = None
        self._polled_s: float | None = None

    def poll(self, now_s: float) -> None:
        """Everything that waited was taken."""
        self._polled_s = now_s

    def arrived(self, senders: Senders, now_s: float) -> ArrivalContext:
        """Messages arrived."""
        polled_s = now_s if self._polled_s is None else self._polled_s
        since_s = now_s if self._received_s is None else self._received_s
        self._received_s = now_s
        is_only = len(senders.gids) == 1
        return ArrivalContext(
            now_s=now_s, silent_s=max(0.0, polled_s - since_s), is_only=is_only,
            gid=senders.gids[0] if is_only else '',
            is_shared=senders.several_s is not None and now_s - senders.several_s > DEAD_S,
            has_new=senders.changed_s > since_s - NEW_S,
        )  # fmt: skip


class MessageTimes:
    """The times of one topic's messages: time of sending, and stamps if they can be trusted (``core/stamps.py``)."""

    def __init__(self, type_name: str, types: MessageTypes, stamps: StampRule) -> None:
        self._has_header = types.has_header(type_name)
        self._sent = stamps.date
        self._tracks = StampTracks(stamps)

    def date(self, message: Taken, publisher: str | None) -> tuple[Taken, Sequence[str]]:
        """The message with its publisher and its times, and the reasons why its arrival replaced one of these."""
        cdr, source_ns, _, number, received_ns, *_ = message
        stamp_ns = header_stamp_ns(cdr) if self._has_header else 0
        track = self._tracks.of(publisher)
        dated = track.date(stamp_ns, source_ns, received_ns)
        clock = publisher or '' if track.is_apart and not dated.refused else None
        untrusted_ns = stamp_ns or source_ns if dated.refused else 0
        sent = self._sent(0, source_ns, received_ns)
        sent_ns = sent.ns if sent.refused else source_ns
        known = Taken(cdr, sent_ns, publisher, number, received_ns, dated.ns, clock, untrusted_ns)  # _replace takes twice as long
        if not (sent.refused or dated.refused):
            return known, ()
        return known, tuple({sent.refused, dated.refused} - {''})

    def report(self) -> StampReport | None:
        """Unusual stamps at present."""
        return self._tracks.report()


class TopicStream:
    """A topic that no sensor has: its consumers count what they want of it. New for each topic and type."""

    def __init__(self, topic: str, type_name: str, types: MessageTypes, stamps: StampRule, consumers: Sequence[Consumer]) -> None:
        """The first of ``consumers`` receives everything, the others only if they want the topic."""
        self._topic = topic
        self._type = type_name
        self._owner, self._others = consumers[0], consumers[1:]
        self._times = MessageTimes(type_name, types, stamps)
        self._recent = RecentMessages()
        self._arrivals = Arrivals()
        self._estimate = TopicEstimate()

    def add(self, taken: Sequence[Taken], senders: Senders, now_s: float, *, paused: bool) -> None:
        """Pass on messages, in order of arrival."""
        fresh: list[Taken] = []
        unnumbered: dict[str, list[int]] = {}
        for message in taken:
            _, source_ns, gid, number, *_ = message
            publisher = gid or senders.name(number, source_ns)
            if (gid is None or number is None) and self._recent.has(message):
                continue
            fresh.append(self._times.date(message, publisher)[0])
            if publisher is None or number is None:
                unnumbered.setdefault(gid or '', []).append(source_ns)
        lost = self._estimate.observe(unnumbered, self._arrivals.arrived(senders, now_s)).lost if unnumbered else None
        if fresh:
            drained = Drained(self._topic, self._type, '', fresh, lost, now_s, paused)
            deliver(drained, [self._owner, *(each for each in self._others if self._topic in each.topics)])

    def poll(self, now_s: float) -> None:
        """Everything that waited was taken."""
        self._arrivals.poll(now_s)

    def close(self) -> None:
        """No more messages arrive."""
        self._owner.leave(self._topic)
        for consumer in self._others:
            if self._topic in consumer.topics:
                consumer.leave(self._topic)


class SensorStream:
    """A topic of a sensor: each message is counted once, in the topic's account. New for each topic and type."""

    def __init__(self, sensor: SensorSettings, topic: str, type_name: str, accounts: Accounts, types: MessageTypes,
                 stamps: StampRule, consumers: Sequence[Consumer]) -> None:  # fmt: skip
        self._times = MessageTimes(type_name, types, stamps)
        self._sensor = sensor.name
        self._topic = topic
        self._type = type_name
        self._accounts = accounts
        self._consumers = consumers
        self._sensor_consumers = [consumer for consumer in consumers if consumer.wanted_topics is None]
        self._topic_consumers = [consumer for consumer in consumers if consumer.wanted_topics is not None]
        self._recent = RecentMessages()
        self._arrivals = Arrivals()
        self._counter: CounterField | None = None
        self._is_refuted = False
        self._expectation = self._expected(sensor, types)
        self._is_begun = False
        for consumer in self._sensor_consumers:
            consumer.enter(topic, type_name, sensor.name)

    def begin(self) -> None:
        """Open the account of the topic, which has a publisher; idempotent."""
        if self._is_begun:
            return
        self._is_begun = True
        with self._accounts.entry(self._topic) as account:
            account.type = self._type
            account.estimate.expect(self._expectation)

    def _expected(self, sensor: SensorSettings, types: MessageTypes) -> Expectation:
        """The expected messages of the sensor: a counter in them, otherwise their rate."""
        if sensor.counter:
            try:
                self._counter = types.counter(self._type, sensor.counter)
                return Expectation(f'counter:{sensor.counter}', wrap=self._counter.wrap)
            except Rejected as error:
                log.warning('%s.counter cannot be used, using stamps instead: %s', sensor.name, error)
        return Expectation(period=SECOND / sensor.expected_hz if sensor.expected_hz else 0.0)

    def add(self, taken: Sequence[Taken], senders: Senders, now_s: float, *, paused: bool) -> None:
        """Count messages, in order of arrival, and pass on those that are not repeats."""
        fresh: list[Taken] = []
        unnumbered: dict[str, list[int]] = {}
        counter, date = self._counter, self._times.date
        failed: dict[Consumer, Exception] = {}
        self.begin()
        with self._accounts.entry(self._topic) as account:
            for message in taken:
                cdr, source_ns, gid, number, *_ = message
                publisher = gid or senders.name(number, source_ns)
                if (gid is None or number is None or account.accounting != EXACT) and self._recent.has(message):
                    continue
                known, refused = date(message, publisher)
                if not account.receive(publisher, number, known.times):
                    continue
                if refused:
                    account.by_arrival.update(refused)
                fresh.append(known)
                if publisher is None or number is None:
                    unnumbered.setdefault(gid or '', []).append(source_ns if counter is None else counter.read(cdr))
            newest = fresh[-1].times if fresh else NO_TIMES
            lost = account.observe(unnumbered, self._arrivals.arrived(senders, now_s), newest) if unnumbered else None
            is_refuted = bool(unnumbered) and account.estimate.refuted
            if fresh:
                drained = Drained(self._topic, self._type, self._sensor, fresh, lost, now_s, paused)
                for consumer in self._sensor_consumers:
                    try:
                        consumer.choose(drained, account)
                    except Exception as error:  # noqa: BLE001 - a bug in one must not affect the others
                        failed[consumer] = error
                account.gaps.newest = newest
                account.stamps = self._times.report()
        if is_refuted and not self._is_refuted:
            self._is_refuted = True
            text = '%s: messages arrive more often than expected_hz: their rate is learned instead'
            log.warning(text, self._topic)
        for consumer, defect in failed.items():
            count_failure(consumer, self._topic, defect)
        if fresh:
            deliver(
                drained, [each for each in self._sensor_consumers if each not in failed] if failed else self._sensor_consumers
            )
            deliver(drained, [each for each in self._topic_consumers if self._topic in each.topics])

    def poll(self, now_s: float) -> None:
        """Everything that waited was taken."""
        self._arrivals.poll(now_s)

    def close(self) -> None:
        """No more messages arrive."""
        for consumer in self._consumers:
            if consumer.wanted_topics is None or self._topic in consumer.topics:
                consumer.leave(self._topic)
