"""Decides which messages of the sensors' topics are kept, and which become one object: the first decisions after the take.

Plain Python, owned by the intake thread. A rule keeps messages or skips them, a ``Batcher`` puts together what becomes one
object, the ``Sampler`` does both for each sensor and hands the batches to the encoders.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, Protocol
from zlib import crc32

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND
from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.core.model import Batch, Sample
from shadowhound_data_logger.core.options import ARCHIVES
from shadowhound_data_logger.core.stamps import StampRule
from shadowhound_data_logger.formats.types import MessageTypes, header_stamp_ns
from shadowhound_data_logger.node.encoding.encode_pool import BatchQueue
from shadowhound_data_logger.node.intake.consumers import Consumer, Drained
from shadowhound_data_logger.ros.endpoints import POLL_S
from shadowhound_data_logger.spool.accounts import PAUSED, Accounts, TopicAccount

QUEUE_FULL: Final = 'queue_full'
"""Why samples are dropped that the encoders' queue has no room for."""
SAMPLER_FAILED: Final = 'sampler_failed'
"""Why messages are dropped of which a defect kept the sampler from choosing."""
STEP_BACK_NS: Final = 10 * SECOND
"""Stamps further back than this are a clock that was set or a bag that was started again, not jitter."""
STAMP_END: Final = 12
"""Where a message's content begins after the CDR encapsulation (4) and the stamp of its header (8)."""

MAX_BATCH_BYTES: Final = 4 << 20
"""A batch is closed early at this size, so that memory is bounded whatever a topic sends; as JSON it is four times as large."""
MAX_ARCHIVE_BYTES: Final = 16 << 20
"""The same where messages stay about as large as they are. A second of the Go2's camera or clouds is 2 to 6 MB, of raw images
27 MB. One such batch may be open, as much again be in the making in each encoder, and the queue holds four."""
MAX_BATCH_MESSAGES: Final = 10_000
"""The same for messages so small that their bytes say little; the queue holds five such batches."""
GRACE_S: Final = 2 * POLL_S
"""How late the last message of a window may come."""


class KeepRule(Protocol):
    """Decides which messages are kept, one at a time, in the order of arrival."""

    def keep(self, stamp_ns: int, cdr: bytes) -> bool:
        """Whether this message is stored."""


class EveryMessage:
    """Keeps all."""

    def keep(self, stamp_ns: int, cdr: bytes) -> bool:  # noqa: ARG002 - the Protocol's arguments
        return True


class FirstOfPeriod:
    """Keeps the first message of each whole period of UTC, so that a key by the period is unique.

    ``last_kept_ns`` is the stamp of the newest durable sample: a restart inside a period keeps nothing of it twice.
    """

    def __init__(self, period_ns: int, last_kept_ns: int = 0) -> None:
        self._period_ns = period_ns
        self._steps_back = max(2, STEP_BACK_NS // period_ns)
        self._last = last_kept_ns // period_ns if last_kept_ns else -1

    def keep(self, stamp_ns: int, cdr: bytes) -> bool:  # noqa: ARG002 - the Protocol's arguments
        period = stamp_ns // self._period_ns
        if self._last - self._steps_back <= period <= self._last:
            return False
        self._last = period
        return True


class OnChange:
    """Keeps a message whose content, but for the stamp of its header, differs from the last one kept."""

    def __init__(self, *, has_header: bool) -> None:
        self._start = STAMP_END if has_header else 4
        self._last: int | None = None

    def keep(self, stamp_ns: int, cdr: bytes) -> bool:  # noqa: ARG002 - the Protocol's arguments
        content = crc32(memoryview(cdr)[self._start :])
        changed = content != self._last
        self._last = content
        return changed


def rule_for(sensor: SensorSettings, *, has_header: bool, last_kept_ns: int) -> KeepRule:
    """The rule of a sensor's settings."""
    if sensor.on_change:
        return OnChange(has_header=has_header)
    if sensor.rate_hz:
        return FirstOfPeriod(round(SECOND / sensor.rate_hz), last_kept_ns)
    return EveryMessage()


class Batcher:
    """Collects the open batch of one topic: one message each, or whole windows of ``batch_s`` in UTC.

    A late sample (of a second publisher with another clock, say) joins the open batch; a clock that was set begins a new one.
    """

    def __init__(self, sensor: SensorSettings, topic: str, type_name: str) -> None:
        self._sensor = sensor.name
        self._topic = topic
        self._type = type_name
        self._window_ns = round(sensor.batch_s * 1e9)
        self._longest_s = sensor.batch_s
        self._most = MAX_BATCH_MESSAGES if sensor.batch_s else 1
        self._most_bytes = MAX_ARCHIVE_BYTES if sensor.format in ARCHIVES else MAX_BATCH_BYTES
        self._samples: list[Sample] = []
        self._size = 0
        self._window = 0
        self._opened_s = 0.0

    def add(self, sample: Sample, now_s: float) -> list[Batch]:
        """Take a sample; returns the batches that are closed by it, in order (mostly none, at most two)."""
        closed: list[Batch] = []
        window = sample.stamp_ns // self._window_ns if self._window_ns else 0
        if self._samples and (window > self._window or _is_elsewhere(sample.stamp_ns, self._samples[0].stamp_ns)):
            closed.append(self.close())
        if not self._samples:
            self._window = window
            self._opened_s = now_s
        self._samples.append(sample)
        self._size += len(sample.cdr)
        if len(self._samples) == self._most or self._size >= self._most_bytes:
            closed.append(self.close())
        return closed

    def is_due(self, now_s: float, grace_s: float) -> bool:
        """Whether the window is over by the monotonic clock, though no message of the next one came."""
        return bool(self._samples) and now_s - self._opened_s >= self._longest_s + grace_s

    def __len__(self) -> int:
        return len(self._samples)

    @property
    def first_ns(self) -> int:
        """Stamp of the first open sample; 0 without any."""
        return self._samples[0].stamp_ns if self._samples else 0

    def close(self) -> Batch:
        """The open samples as a batch; there must be some."""
        batch = Batch(self._sensor, self._topic, self._type, tuple(self._samples), self._size)
        self._samples = []
        self._size = 0
        return batch


class Sampler(Consumer):
    """Chooses which messages of the sensors' topics are logged, and batches them. New; ``take`` what the intake drained."""

    def __init__(self, sensors: Mapping[str, SensorSettings], accounts: Accounts, types: MessageTypes, stamps: StampRule,
                 queue: BatchQueue) -> None:  # fmt: skip
        """``sensors`` are the settings in force, by name; ``queue`` gets the batches."""
        self._sensors = sensors
        self._accounts = accounts
        self._types = types
        self._stamps = stamps
        self._queue = queue
        self._sampled: dict[str, _Sampled] = {}
        self._kept_ns: dict[str, int] = {}
        self.idle = False
        """Whether nobody wants the data now: messages are counted and skipped."""

    def set_idle(self, *, idle: bool) -> None:
        """Before the intake is open, or by its thread."""
        self.idle = idle

    def enter(self, topic: str, type_name: str, sensor: str) -> None:
        kept_ns = self._kept_ns.get(topic) or self._accounts.last_kept_ns(topic)
        self._sampled[topic] = _Sampled(self._sensors[sensor], topic, type_name, self._types.has_header(type_name), kept_ns)

    def choose(self, drained: Drained, account: TopicAccount) -> None:
        messages = drained.messages
        sampled = self._sampled[drained.topic]
        try:
            kept = self._kept(sampled, drained, account)
        except Exception:
            account.drop(SAMPLER_FAILED, len(messages), messages[0].source_ns, messages[-1].source_ns)
            raise
        sampled.chosen = kept
        if kept:
            sampled.kept_ns = kept[-1].stamp_ns
            sampled.open_ns = sampled.open_ns or kept[0].stamp_ns
        if drained.paused:
            account.drop(PAUSED, len(messages), account.gaps.heard_ns or messages[0].source_ns, messages[-1].source_ns)
        else:
            account.skipped += len(messages) - len(kept)

    def _kept(self, sampled: _Sampled, drained: Drained, account: TopicAccount) -> list[Sample]:
        sampled.follow(self._sensors[drained.sensor])
        kept: list[Sample] = []
        if not (drained.paused or self.idle):
            keep, has_header, date = sampled.rule.keep, sampled.has_header, self._stamps.date
            for cdr, source_ns, publisher, _, received_ns in drained.messages:
                stamp_ns, refused = date(header_stamp_ns(cdr) if has_header else 0, source_ns, received_ns)
                if refused:
                    account.by_arrival[refused] += 1
                if keep(stamp_ns, cdr):
                    kept.append(Sample(stamp_ns, cdr, received_ns, publisher))
        return kept

    def take(self, drained: Drained) -> None:
        sampled = self._sampled[drained.topic]
        add, now_s = sampled.batcher.add, drained.now_s
        chosen, sampled.chosen = sampled.chosen, ()
        for sample in chosen:
            for batch in add(sample, now_s):
                self._offer(batch)
        sampled.open_ns = sampled.batcher.first_ns

    def leave(self, topic: str) -> None:
        sampled = self._sampled.pop(topic, None)
        if sampled is not None:
            self._kept_ns[topic] = sampled.kept_ns
            self._close(sampled)

    def tick(self, now_s: float) -> None:
        """Close the batches whose time is over, though no message of the next one came."""
        for sampled in self._sampled.values():
            if sampled.batcher.is_due(now_s, GRACE_S):
                self._close(sampled)

    def flush(self) -> None:
        """Close the open batches."""
        for sampled in self._sampled.values():
            self._close(sampled)

    def _close(self, sampled: _Sampled) -> None:
        if len(sampled.batcher):
            self._offer(sampled.batcher.close())
            sampled.open_ns = 0

    def oldest_open(self) -> dict[str, int]:
        """Topic -> the first stamp of what was kept of it and is not encoded yet; from any thread."""
        # A batch goes from here to the queue, so this order sees each of them.
        found = {topic: sampled.open_ns for topic, sampled in list(self._sampled.items()) if sampled.open_ns}
        for topic, first_ns in self._queue.oldest().items():
            found[topic] = min(first_ns, found.get(topic, first_ns))
        return found

    def _offer(self, batch: Batch) -> None:
        """To the encoders; what their queue has no room for is dropped."""
        for lost in self._queue.put(batch, self._sensors[batch.sensor].priority):
            samples = lost.samples
            self._accounts.drop(lost.topic, QUEUE_FULL, len(samples), samples[0].stamp_ns, samples[-1].stamp_ns)


class _Sampled:
    """One topic and type of a sensor."""

    def __init__(self, sensor: SensorSettings, topic: str, type_name: str, has_header: bool, kept_ns: int) -> None:
        self.kept_ns = kept_ns
        """Stamp of the newest message that was kept: no period is stored twice."""
        self.has_header = has_header
        self.rule = rule_for(sensor, has_header=has_header, last_kept_ns=kept_ns)
        self.open_ns = 0
        """Stamp of the first message that was kept and is not in the queue yet; 0 where there is none."""
        self.chosen: Sequence[Sample] = ()
        """Of the drain under way, what is kept."""
        self.batcher = Batcher(sensor, topic, type_name)
        self._sensor = sensor

    def follow(self, sensor: SensorSettings) -> None:
        """Go on by other settings; the open batch stays."""
        if sensor.rate_hz != self._sensor.rate_hz and not sensor.on_change:
            self.rule = rule_for(sensor, has_header=self.has_header, last_kept_ns=self.kept_ns)
        self._sensor = sensor


def _is_elsewhere(stamp_ns: int, first_ns: int) -> bool:
    """Whether the clock was set in between: backwards by more than jitter, or from the boot clock's time to UTC."""
    return stamp_ns < first_ns - STEP_BACK_NS or (stamp_ns < EARLIEST_SANE_NS) != (first_ns < EARLIEST_SANE_NS)
