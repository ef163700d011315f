"""Selects messages of the sensors' topics and groups them into batches: the first decision after the take.

Plain Python, owned by the intake thread. A rule selects or skips messages, a ``Batcher`` collects those of one object, and the
``Sampler`` does both for each sensor and passes the batches to the encoders.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol
from zlib import crc32

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND
from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.core.model import Batch, Sample
from shadowhound_data_logger.core.options import ARCHIVES
from shadowhound_data_logger.core.stamps import MAX_PUBLISHERS
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.encoding.encode_pool import BatchQueue
from shadowhound_data_logger.node.intake.consumers import Consumer, Drained
from shadowhound_data_logger.ros.endpoints import POLL_S
from shadowhound_data_logger.spool.accounts import Accounts
from shadowhound_data_logger.spool.topic_account import PAUSED, TopicAccount

QUEUE_FULL: Final = 'queue_full'
"""The reason for samples dropped because the encoders' queue is full."""
SAMPLER_FAILED: Final = 'sampler_failed'
"""The reason for messages dropped because of a bug in the sampler."""
STEP_BACK_NS: Final = 10 * SECOND
"""Stamps further back than this mean a clock that was set or a bag that was restarted, not jitter."""
STAMP_END: Final = 12
"""Offset of a message's content after the CDR encapsulation (4) and the stamp of its header (8)."""

MAX_BATCH_BYTES: Final = 4 << 20
"""A batch is closed early at this size, so that memory is bounded for any topic; as JSON it is four times as large."""
MAX_ARCHIVE_BYTES: Final = 16 << 20
"""The same for formats that stay about as large as the messages. A second of the Go2's camera or clouds is 2 to 6 MB, of raw
images 27 MB. One such batch may be open, one more in each encoder, and the queue holds four.
"""
MAX_BATCH_MESSAGES: Final = 10_000
"""The same for messages so small that their size says little; the queue holds five such batches."""
MAX_CLOCKS: Final = 8
"""Maximum clocks on one topic with separate rules and batches; further ones share those of the first."""
GRACE_S: Final = 2 * POLL_S
"""How late the last message of a window may arrive."""


class SamplingRule(Protocol):
    """Decides which messages are stored, one at a time, in order of arrival."""

    def selects(self, stamp_ns: int, cdr: bytes) -> bool:
        """Whether this message is stored."""


class EveryMessage:
    """Selects every message."""

    def selects(self, stamp_ns: int, cdr: bytes) -> bool:  # noqa: ARG002 - the Protocol's arguments
        return True


class FirstOfPeriod:
    """Selects the first message of each whole period of UTC, so that a key with the period is unique.

    ``last_stored_ns`` is the stamp of the newest durable sample: after a restart within a period nothing is kept twice.
    """

    def __init__(self, period_ns: int, last_stored_ns: int = 0) -> None:
        self._period_ns = period_ns
        self._steps_back = max(2, STEP_BACK_NS // period_ns)
        self._last = last_stored_ns // period_ns if last_stored_ns else -1

    def selects(self, stamp_ns: int, cdr: bytes) -> bool:  # noqa: ARG002 - the Protocol's arguments
        period = stamp_ns // self._period_ns
        if self._last - self._steps_back <= period <= self._last:
            return False
        self._last = period
        return True


class OnChange:
    """Selects a message whose content, except for its header's stamp, differs from the last one selected.

    ``last_stored_ns`` is the stamp of the newest durable sample: a first message with this stamp is the same one, delivered
    again, as latched messages are.
    """

    def __init__(self, *, has_header: bool, last_stored_ns: int = 0) -> None:
        self._start = STAMP_END if has_header else 4
        self._last: int | None = None
        self._last_stored_ns = last_stored_ns

    def selects(self, stamp_ns: int, cdr: bytes) -> bool:
        content = crc32(memoryview(cdr)[self._start :])
        changed = content != self._last and not (self._last is None and 0 < stamp_ns == self._last_stored_ns)
        self._last = content
        return changed


def rule_for(sensor: SensorSettings, *, has_header: bool, last_stored_ns: int) -> SamplingRule:
    """The rule of a sensor's settings."""
    if sensor.on_change:
        return OnChange(has_header=has_header, last_stored_ns=last_stored_ns)
    if sensor.rate_hz:
        return FirstOfPeriod(round(SECOND / sensor.rate_hz), last_stored_ns)
    return EveryMessage()


class Batcher:
    """Collects the open batch of one topic: one message each, or whole windows of ``batch_s`` in UTC.

    A late sample joins the open batch; after the clock was set, a new batch starts.
    """

    def __init__(self, sensor: SensorSettings, topic: str, type_name: str) -> None:
        self._sensor = sensor.name
        self._topic = topic
        self._type = type_name
        self._window_ns = round(sensor.batch_s * 1e9)
        self._batch_s = sensor.batch_s
        self._max_messages = MAX_BATCH_MESSAGES if sensor.batch_s else 1
        self.max_bytes = MAX_ARCHIVE_BYTES if sensor.format in ARCHIVES else MAX_BATCH_BYTES
        self._samples: list[Sample] = []
        self.size = 0
        """Bytes of CDR in the open batch."""
        self._window = 0
        self._opened_s = 0.0

    def add(self, sample: Sample, now_s: float) -> list[Batch]:
        """Add a sample; returns the batches that it closes, in order (usually none, at most two)."""
        closed: list[Batch] = []
        window = sample.stamp_ns // self._window_ns if self._window_ns else 0
        if self._samples and (window > self._window or _is_elsewhere(sample.stamp_ns, self._samples[0].stamp_ns)):
            closed.append(self.close())
        if not self._samples:
            self._window = window
            self._opened_s = now_s
        self._samples.append(sample)
        self.size += len(sample.cdr)
        if len(self._samples) == self._max_messages or self.size >= self.max_bytes:
            closed.append(self.close())
        return closed

    def is_due(self, now_s: float, grace_s: float) -> bool:
        """Whether the window has ended by the monotonic clock, although no message of the next one arrived."""
        return bool(self._samples) and now_s - self._opened_s >= self._batch_s + grace_s

    def __len__(self) -> int:
        return len(self._samples)

    @property
    def first_ns(self) -> int:
        """Stamp of the first open sample; 0 if there is none."""
        return self._samples[0].stamp_ns if self._samples else 0

    def close(self) -> Batch:
        """The open samples as a batch; there must be at least one."""
        batch = Batch(self._sensor, self._topic, self._type, tuple(self._samples), self.size)
        self._samples = []
        self.size = 0
        return batch


class Sampler(Consumer):
    """Selects the messages of the sensors' topics to log, and batches them. New; ``take`` what the intake drained."""

    def __init__(self, sensors: Mapping[str, SensorSettings], accounts: Accounts, types: MessageTypes, queue: BatchQueue) -> None:
        """``sensors`` are the current settings, by name; batches are put into ``queue``."""
        self._sensors = sensors
        self._accounts = accounts
        self._types = types
        self._queue = queue
        self._sampled: dict[str, _Sampled] = {}
        self._chosen_ns: dict[str, int] = {}
        self.idle = False
        """Whether the data is not needed at present: messages are counted and skipped."""

    def set_idle(self, *, idle: bool) -> None:
        """Call it before the intake is open, or on its thread."""
        self.idle = idle

    def enter(self, topic: str, type_name: str, sensor: str) -> None:
        chosen_ns = self._chosen_ns.get(topic) or self._accounts.last_stored_ns(topic)
        self._sampled[topic] = _Sampled(self._sensors[sensor], topic, type_name, self._types.has_header(type_name), chosen_ns)

    def choose(self, drained: Drained, account: TopicAccount) -> None:
        messages = drained.messages
        sampled = self._sampled[drained.topic]
        try:
            chosen = self._select(sampled, drained)
        except Exception:
            account.drop(SAMPLER_FAILED, len(messages), messages[0].times, messages[-1].times)
            raise
        sampled.chosen = chosen
        if chosen:
            sampled.chosen_ns = chosen[-1][1].stamp_ns
            sampled.open_ns = sampled.open_ns or chosen[0][1].stamp_ns
        if drained.paused:
            received = account.gaps.newest
            account.drop(PAUSED, len(messages), received if any(received) else messages[0].times, messages[-1].times)
        else:
            account.skipped += len(messages) - len(chosen)

    def _select(self, sampled: _Sampled, drained: Drained) -> list[_Chosen]:
        sampled.follow(self._sensors[drained.sensor])
        chosen: list[_Chosen] = []
        if not (drained.paused or self.idle):
            for cdr, _, publisher, _, received_ns, stamp_ns, clock, untrusted_ns in drained.messages:
                if sampled.of(clock, publisher).rule.selects(stamp_ns, cdr):
                    chosen.append((clock, Sample(stamp_ns, cdr, received_ns, publisher, untrusted_ns)))
        return chosen

    def take(self, drained: Drained) -> None:
        sampled = self._sampled[drained.topic]
        chosen, sampled.chosen = sampled.chosen, ()
        for clock, sample in chosen:
            for batch in sampled.add(clock, sample, drained.now_s):
                self._offer(batch)
        sampled.open_ns = sampled.first_open_ns()

    def leave(self, topic: str) -> None:
        sampled = self._sampled.pop(topic, None)
        if sampled is not None:
            self._chosen_ns[topic] = sampled.chosen_ns
            self._close(sampled)

    def tick(self, now_s: float) -> None:
        """Close the batches whose window has ended, although no message of the next one arrived."""
        for sampled in self._sampled.values():
            self._close(sampled, now_s)

    def flush(self) -> None:
        """Close the open batches."""
        for sampled in self._sampled.values():
            self._close(sampled)

    def _close(self, sampled: _Sampled, due_s: float | None = None) -> None:
        """Close the open batches; with ``due_s`` only those due at that time."""
        closed = sampled.close(due_s)
        for batch in closed:
            self._offer(batch)
        if closed:
            sampled.open_ns = sampled.first_open_ns()

    def oldest_open(self) -> dict[str, int]:
        """Topic -> the first stamp of its selected messages that are not encoded yet; from any thread."""
        # A batch moves from here to the queue, so this order misses none.
        found = {topic: sampled.open_ns for topic, sampled in list(self._sampled.items()) if sampled.open_ns}
        for topic, first_ns in self._queue.oldest().items():
            found[topic] = min(first_ns, found.get(topic, first_ns))
        return found

    def _offer(self, batch: Batch) -> None:
        """Put the batch into the encoders' queue; what does not fit is dropped."""
        for lost in self._queue.put(batch, self._sensors[batch.sensor].priority):
            samples = lost.samples
            self._accounts.drop(lost.topic, QUEUE_FULL, len(samples), samples[0].times, samples[-1].times)


_Chosen = tuple[str | None, Sample]
"""A selected message, and the clock that it follows (``Taken.clock``)."""


class _Sampled:
    """One topic and type of a sensor. Each clock that its publishers follow has a separate rule and batch."""

    def __init__(self, sensor: SensorSettings, topic: str, type_name: str, has_header: bool, chosen_ns: int) -> None:
        self.chosen_ns = chosen_ns
        """Stamp of the newest selected message: no period is stored twice."""
        self.open_ns = 0
        """Stamp of the first selected message that is not in the queue yet; 0 if there is none."""
        self.chosen: Sequence[_Chosen] = ()
        """Messages selected from the current drain."""
        self._topic, self._type, self._has_header = topic, type_name, has_header
        self._clocks: dict[str | None, _Sampling] = {}
        self._followed: dict[str | None, str | None] = {}  # publisher -> clock
        self._sensor = sensor

    def of(self, clock: str | None, publisher: str | None) -> _Sampling:
        """The rule and batcher for a clock that a publisher follows now; it keeps its rule when its clock changes."""
        found, before = self._clocks.get(clock), self._followed.get(publisher, clock)
        if before != clock or publisher not in self._followed:
            while len(self._followed) >= MAX_PUBLISHERS:
                del self._followed[next(iter(self._followed))]
            self._followed[publisher] = clock
        if found is None:
            for name, each in list(self._clocks.items()):
                if len(self._clocks) >= MAX_CLOCKS and not len(each.batcher):
                    del self._clocks[name]
            if len(self._clocks) >= MAX_CLOCKS:
                return next(iter(self._clocks.values()))
            batcher = Batcher(self._sensor, self._topic, self._type)
            rule = self._clocks[before].rule if before in self._clocks else self._rule(self._sensor)
            found = self._clocks[clock] = _Sampling(rule, batcher)
        return found

    def add(self, clock: str | None, sample: Sample, now_s: float) -> list[Batch]:
        """Add a selected sample; returns the batches that it closes."""
        batcher = self.of(clock, sample.publisher).batcher
        closed = batcher.add(sample, now_s)
        if len(self._clocks) > 1 and sum(each.batcher.size for each in self._clocks.values()) >= batcher.max_bytes:
            closed += self.close()
        return closed

    def close(self, due_s: float | None = None) -> list[Batch]:
        """The open batches; with ``due_s`` those due at that time."""
        batchers = [each.batcher for each in self._clocks.values() if len(each.batcher)]
        return [batcher.close() for batcher in batchers if due_s is None or batcher.is_due(due_s, GRACE_S)]

    def first_open_ns(self) -> int:
        """The first stamp of the open batches; 0 if there are none."""
        return min((each.batcher.first_ns for each in self._clocks.values() if len(each.batcher)), default=0)

    def follow(self, sensor: SensorSettings) -> None:
        """Apply other settings; the open batches stay."""
        if sensor.rate_hz != self._sensor.rate_hz and not sensor.on_change:
            rules = {each.rule: self._rule(sensor) for each in self._clocks.values()}
            for each in self._clocks.values():
                each.rule = rules[each.rule]
        self._sensor = sensor

    def _rule(self, sensor: SensorSettings) -> SamplingRule:
        return rule_for(sensor, has_header=self._has_header, last_stored_ns=self.chosen_ns)


@dataclass(slots=True)
class _Sampling:
    """The rule and batcher for one clock."""

    rule: SamplingRule
    batcher: Batcher


def _is_elsewhere(stamp_ns: int, first_ns: int) -> bool:
    """Whether the clock was set in between: backwards by more than jitter, or from the boot clock's time to UTC."""
    return stamp_ns < first_ns - STEP_BACK_NS or (stamp_ns < EARLIEST_SANE_NS) != (first_ns < EARLIEST_SANE_NS)
