"""The messages of one topic and type on their way: counted, thinned out, batched. Plain Python, owned by the intake thread."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple, Protocol
from zlib import crc32

from shadowhound_data_logger.capture.batching import Batcher
from shadowhound_data_logger.capture.endpoints import Senders
from shadowhound_data_logger.capture.gate import gate_for
from shadowhound_data_logger.capture.pose_track import RobotTrack
from shadowhound_data_logger.clock import SECOND, Clock, stamp_of
from shadowhound_data_logger.config import SensorSettings
from shadowhound_data_logger.encode.types import CounterField, MessageTypes, header_stamp_ns
from shadowhound_data_logger.errors import Rejected
from shadowhound_data_logger.model import Batch, Sample, Taken
from shadowhound_data_logger.spool.accounts import EXACT, PAUSED, Accounts, Losses
from shadowhound_data_logger.spool.estimator import Expectation, Hearing

log = logging.getLogger(__name__)

MAX_RECENT: Final = 10_000
"""Messages without a sender's gid that are remembered, to know what a second subscription delivers again."""
DEAD_S: Final = 15.0
"""A publisher that was killed stays in the graph for less: Cyclone DDS gives it up after ten seconds."""
NEW_S: Final = 2.0
"""The graph may know a publisher so long before its first message is taken, and its predecessor's last one."""
Offer = Callable[[Batch], None]


class Tap(Protocol):
    """What takes all messages of some topics, whatever is kept of them (``BagTap``)."""

    topics: frozenset[str]

    def add(self, topic: str, type_name: str, taken: Sequence[Taken], lost: Losses, *, paused: bool) -> None: ...


class NoTap:
    """Takes nothing."""

    topics: frozenset[str] = frozenset()

    def add(self, topic: str, type_name: str, taken: Sequence[Taken], lost: Losses, *, paused: bool) -> None:
        """Never called: there are no topics."""


class Shared(NamedTuple):
    """What all streams work with."""

    accounts: Accounts
    types: MessageTypes
    offer: Offer
    clock: Clock
    robot: RobotTrack | None = None
    """Who keeps what some topics publish, at full rate."""
    tap: Tap = NoTap()


class Repeats:
    """What came lately without a sender's gid, to know what a second of our subscriptions delivers again."""

    def __init__(self) -> None:
        self._recent: dict[tuple[int, int], None] = {}

    def has(self, message: Taken) -> bool:
        """Whether it came already: sent at the same time, same number or content.

        Asked also while the graph knows one sender, whose name the middleware does not give: a second one may appear.
        """
        mark = (message.source_ns, crc32(message.cdr) if message.number is None else message.number)
        if mark in self._recent:
            return True
        self._recent[mark] = None
        if len(self._recent) > MAX_RECENT:
            del self._recent[next(iter(self._recent))]
        return False


def is_named(message: Taken) -> bool:
    """Whether the middleware says who sent it and as which."""
    return message.publisher is not None and message.number is not None


class Pace:
    """When messages without numbers came, as an estimate of what is lost between them wants to know it."""

    def __init__(self) -> None:
        self._heard_s: float | None = None
        self._looked_s: float | None = None
        self._sent_s = 0.0

    def look(self, now_s: float) -> None:
        """All that waited was taken."""
        self._looked_s = now_s

    def hear(self, senders: Senders, now_s: float) -> Hearing:
        """Some came."""
        looked_s = now_s if self._looked_s is None else self._looked_s
        since_s, sent_s = (now_s, looked_s) if self._heard_s is None else (self._heard_s, self._sent_s)
        self._heard_s, self._sent_s = now_s, looked_s
        alone = len(senders.gids) == 1
        return Hearing(
            elapsed_s=now_s - sent_s, quiet_s=max(0.0, looked_s - since_s), alone=alone,
            gid=senders.gids[0] if alone else '',
            crowded=senders.several_s is not None and now_s - senders.several_s > DEAD_S,
            new=senders.changed_s > since_s - NEW_S,
        )  # fmt: skip


class AnyStream(Protocol):
    """What becomes of the messages of one topic and type (``Stream``, ``BagStream``)."""

    kept_ns: int

    def update(self, sensor: SensorSettings) -> None: ...

    def add(self, taken: Sequence[Taken], senders: Senders, now_s: float, *, paused: bool, idle: bool = False) -> None: ...

    def close_due(self, now_s: float, grace_s: float) -> None: ...

    def close_batch(self) -> None: ...


class Stream:
    """New for each topic and type; ``add`` what was taken, ``close_batch`` at the end."""

    def __init__(self, sensor: SensorSettings, topic: str, type_name: str, last_kept_ns: int, shared: Shared) -> None:
        self._clock = shared.clock
        self.kept_ns = last_kept_ns
        """Stamp of the newest message that was kept: no period is stored twice."""
        self._topic = topic
        self._accounts = shared.accounts
        self._offer = shared.offer
        self._sensor = sensor
        self._has_header = shared.types.has_header(type_name)
        self._gate = gate_for(sensor, has_header=self._has_header, last_kept_ns=last_kept_ns)
        self._batcher = Batcher(sensor, topic, type_name)
        self._repeats = Repeats()
        self._tap = shared.tap
        self._type = type_name
        self._pace = Pace()
        self._counter: CounterField | None = None
        self._is_refuted = False
        self._track = shared.robot.of(topic, type_name) if shared.robot is not None else None
        with shared.accounts.entry(topic) as account:
            account.type = type_name
            account.expect(self._expected(sensor, shared.types))

    def _expected(self, sensor: SensorSettings, types: MessageTypes) -> Expectation:
        """What is declared of the sensor's messages: a counter in them, else how often they come."""
        if sensor.counter:
            try:
                self._counter = types.counter(self._type, sensor.counter)
                return Expectation(f'counter:{sensor.counter}', sensor.counter_step, self._counter.wrap)
            except Rejected as error:
                log.warning('%s.counter is not used, stamps are instead: %s', sensor.name, error)
        return Expectation(period=SECOND / sensor.expected_hz if sensor.expected_hz else 0.0)

    def update(self, sensor: SensorSettings) -> None:
        """Go on by other settings; the open batch stays."""
        if sensor.rate_hz != self._sensor.rate_hz and not sensor.on_change:
            self._gate = gate_for(sensor, has_header=self._has_header, last_kept_ns=self.kept_ns)
        self._sensor = sensor

    def add(self, taken: Sequence[Taken], senders: Senders, now_s: float, *, paused: bool, idle: bool = False) -> None:
        """Take messages in the order in which they came.

        While ``paused`` they are counted as dropped, while ``idle`` (nobody asked for them) as skipped.
        """
        heard: list[Taken] | None = [] if self._topic in self._tap.topics else None
        kept, lost = self._keep(taken, senders, now_s, heard, paused=paused, idle=idle)
        for sample in kept:
            for batch in self._batcher.add(sample, now_s):
                self._offer(batch)
        if heard:
            self._tap.add(self._topic, self._type, heard, lost, paused=paused)

    def close_due(self, now_s: float, grace_s: float) -> None:
        """End the batch whose time is over, though no message of the next one came."""
        self._pace.look(now_s)
        if self._batcher.is_due(now_s, grace_s):
            self._offer(self._batcher.close())

    def close_batch(self) -> None:
        """End the open batch, if there is one."""
        if len(self._batcher):
            self._offer(self._batcher.close())

    def _keep(self, taken: Sequence[Taken], senders: Senders, now_s: float, heard: list[Taken] | None, *, paused: bool,
              idle: bool) -> tuple[list[Sample], Losses]:  # fmt: skip
        """Count the messages, drop repeats and choose those to store; ``heard`` gets all that are no repeats.

        Returns what to store, and what is estimated to have been lost before messages without numbers.
        """
        kept: list[Sample] = []
        sent: dict[str, list[int]] = {}
        keep, track, counter = self._gate.keep, self._track, self._counter
        with self._accounts.entry(self._topic) as account:
            for message in taken:
                cdr, source_ns, gid, number, _ = message
                publisher = gid or senders.name(number, source_ns)
                if not (is_named(message) and account.accounting == EXACT) and self._repeats.has(message):
                    continue
                if not account.receive(publisher, number):
                    continue
                if publisher is None or number is None:
                    sent.setdefault(gid or '', []).append(source_ns if counter is None else counter.read(cdr))
                if heard is not None:
                    heard.append(message if gid else message._replace(publisher=publisher))
                if track is not None:
                    track.add(self._time(cdr, source_ns), cdr)
                if paused:
                    account.dropped[PAUSED] += 1
                    continue
                if idle:
                    account.skipped += 1
                    continue
                stamp_ns = self._time(cdr, source_ns)
                if keep(stamp_ns, cdr):
                    self.kept_ns = stamp_ns
                    kept.append(Sample(stamp_ns, cdr))
                else:
                    account.skipped += 1
            lost = account.observe(sent, self._pace.hear(senders, now_s)) if sent else None
            is_refuted = bool(sent) and account.estimate.refuted
        if is_refuted and not self._is_refuted:
            self._is_refuted = True
            text = '%s: messages come more often than %s says: how often they are published is learned instead'
            log.warning(text, self._topic, 'counter_step' if self._counter else 'expected_hz')
        return kept, lost

    def _time(self, cdr: bytes, source_ns: int) -> int:
        return stamp_of(header_stamp_ns(cdr) if self._has_header else 0, source_ns, self._clock)
