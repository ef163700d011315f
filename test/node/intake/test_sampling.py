"""Sampling and batches: which messages are kept, and batches as bounded windows of UTC."""

from __future__ import annotations

import random
import struct
from collections.abc import Iterable
from itertools import accumulate

import pytest
from clocks import NOON_NS
from node.intake.test_stream import Batches

from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.core.config import QueueSettings, SensorSettings
from shadowhound_data_logger.core.model import Batch, Sample, Taken
from shadowhound_data_logger.core.stamps import StampRule
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.encoding.encode_pool import MAX_MESSAGES
from shadowhound_data_logger.node.intake.sampling import (
    MAX_ARCHIVE_BYTES,
    MAX_BATCH_BYTES,
    MAX_BATCH_MESSAGES,
    Batcher,
    EveryMessage,
    FirstOfPeriod,
    OnChange,
    Sampler,
    rule_for,
)
from shadowhound_data_logger.node.intake.stream import Senders, SensorStream
from shadowhound_data_logger.spool.accounts import Accounts

TOPIC, TYPE = '/odom', 'nav_msgs/msg/Odometry'
HZ, SECONDS = 20, 15


def message(publisher: str, number: int, stamp_ns: int, received_ns: int) -> Taken:
    sec, nanosec = divmod(stamp_ns, SECOND)
    cdr = b'\0\1\0\0' + struct.pack('<iI', sec, nanosec) + b'x' * 16
    return Taken(cdr, received_ns, publisher, number, received_ns)


def received(publisher: str, offsets_ns: Iterable[int]) -> list[Taken]:
    """Messages at 20 Hz with stamps this long before their arrival."""
    times = ((number, NOON_NS + number * SECOND // HZ, offset_ns) for number, offset_ns in enumerate(offsets_ns, 1))
    return [message(publisher, number, at_ns - offset_ns, at_ns) for number, at_ns, offset_ns in times]


def batches(messages: Iterable[Taken], rate_hz: float = 0.0, batch_s: float = 0.0) -> list[Batch]:
    """The batches that the sampler makes from messages drained five times per second."""
    sensor = SensorSettings(name='odom', topics=(TOPIC,), types=(TYPE,), rate_hz=rate_hz, batch_s=batch_s)
    types, accounts, queue = MessageTypes(), Accounts(clock=SystemClock.of_this_machine()), Batches()
    sampler = Sampler({'odom': sensor}, accounts, types, queue)  # type: ignore[arg-type]
    stream = SensorStream(sensor, TOPIC, TYPE, accounts, types, StampRule(SystemClock.of_this_machine(), 10**18), [sampler])
    waiting = sorted(messages, key=lambda each: each.received_ns)
    now_s = 0.0
    while waiting:
        now_s += 0.2
        came = [each for each in waiting if each.received_ns <= NOON_NS + now_s * SECOND]
        stream.add(came, Senders(), now_s, paused=False)
        sampler.tick(now_s)
        waiting = waiting[len(came) :]
    sampler.flush()
    return list(queue)


def test_two_clocks_on_a_topic_are_sampled_apart() -> None:
    """One message per second from each, though the stamps of one are five minutes behind."""
    found = batches([*received('a', [0] * HZ * SECONDS), *received('b', [300 * SECOND] * HZ * SECONDS)], rate_hz=1.0)
    assert 2 * SECONDS <= len(found) <= 2 * SECONDS + 2
    assert all(len(batch.samples) == 1 for batch in found)


def test_a_publisher_that_is_late_at_times_is_sampled_once_per_period() -> None:
    """More than a second late it seems to follow another clock, and its own when it is on time: it is one publisher."""
    stamps_ns = [NOON_NS + number * SECOND // HZ for number in range(HZ * SECONDS)]
    late_ns = [1_500_000_000 if number % (4 * HZ) >= 2 * HZ else 0 for number in range(HZ * SECONDS)]
    arrivals_ns = accumulate((stamp + late for stamp, late in zip(stamps_ns, late_ns, strict=True)), max)
    messages = [message('a', *each) for each in zip(range(1, HZ * SECONDS + 1), stamps_ns, arrivals_ns, strict=True)]
    found = [batch.samples[0].stamp_ns // SECOND for batch in batches(messages, rate_hz=1.0)]
    assert found == sorted(set(found))
    assert len(found) == SECONDS


def test_two_clocks_on_a_topic_are_batched_apart() -> None:
    """A batch has messages of one clock, and there is one per second and clock."""
    found = batches([*received('a', [0] * HZ * SECONDS), *received('b', [300 * SECOND] * HZ * SECONDS)], batch_s=1.0)
    assert 2 * SECONDS <= len(found) <= 2 * SECONDS + 2
    assert {frozenset(sample.publisher for sample in batch.samples) for batch in found} == {frozenset('a'), frozenset('b')}
    assert sum(len(batch.samples) for batch in found) == 2 * HZ * SECONDS


def test_publishers_on_the_same_clock_share_their_batches() -> None:
    """For example on /tf: more publishers do not make more objects."""
    found = batches([*received('a', [0] * HZ * SECONDS), *received('b', [SECOND // 10] * HZ * SECONDS)], batch_s=1.0)
    assert len(found) in (SECONDS, SECONDS + 1)


def test_a_stray_stamp_does_not_end_a_batch() -> None:
    """Every tenth is 67 s old; it is dated by its arrival and joins the batch of the messages around it."""
    found = batches(received('a', [67 * SECOND if number % 10 == 9 else 0 for number in range(HZ * SECONDS)]), batch_s=1.0)
    assert len(found) in (SECONDS, SECONDS + 1)


def test_erratic_stamps_do_not_end_batches() -> None:
    """Meaningless stamps after the first second are dated by arrival: one batch per second."""
    wild = random.Random(3)
    found = batches(received('a', [wild.randrange(-100, 100) * SECOND for _ in range(HZ * SECONDS)]), batch_s=1.0)
    assert len(found) <= SECONDS + 6


def test_setting_the_clock_starts_one_batch() -> None:
    """Instead of one for each message after it."""
    half = HZ * SECONDS // 2
    for step in (-40, 40):
        found = batches(received('a', [0] * half + [step * SECOND] * half), batch_s=1.0)
        assert len(found) <= SECONDS + 4
        assert sum(len(batch.samples) for batch in found) == 2 * half


def batcher(batch_s: float = 1.0, format_name: str = 'json') -> Batcher:
    sensor = SensorSettings(name='imu', batch_s=batch_s, format=format_name)
    return Batcher(sensor, '/imu', 'sensor_msgs/msg/Imu')


def stamps(batch: Batch) -> list[int]:
    return [sample.stamp_ns for sample in batch.samples]


def test_a_batch_is_a_window_of_utc() -> None:
    """A message of the next full second closes the batch of this one."""
    open_batch = batcher()
    closed = [batch for stamp in (0, 1, SECOND - 1, SECOND, 3 * SECOND) for batch in open_batch.add(Sample(stamp, b'x'), 0.0)]
    assert [stamps(batch) for batch in closed] == [[0, 1, SECOND - 1], [SECOND]]
    assert stamps(open_batch.close()) == [3 * SECOND]
    assert not len(open_batch)


def test_a_batch_has_sensor_topic_and_type() -> None:
    """Sensor, topic, type and CDR size are recorded with it."""
    open_batch = batcher()
    open_batch.add(Sample(1, b'12345'), 0.0)
    open_batch.add(Sample(2, b'123'), 0.0)
    assert len(open_batch) == 2
    assert open_batch.close() == Batch('imu', '/imu', 'sensor_msgs/msg/Imu', (Sample(1, b'12345'), Sample(2, b'123')), 8)


def test_without_a_window_each_message_is_a_batch() -> None:
    """With 0 no batch stays open."""
    open_batch = batcher(batch_s=0.0)
    assert [stamps(batch) for batch in open_batch.add(Sample(7, b''), 0.0)] == [[7]]
    assert not len(open_batch)


@pytest.mark.parametrize(('format_name', 'most'), [('json', MAX_BATCH_BYTES), ('tar', MAX_ARCHIVE_BYTES)])
def test_a_large_batch_is_closed_early(format_name: str, most: int) -> None:
    """Memory is bounded for any topic, including the formats' output; a message that ends two batches closes both."""
    open_batch = batcher(format_name=format_name)
    assert open_batch.add(Sample(0, bytes(most - 1)), 0.0) == []
    large = Sample(SECOND, bytes(most))
    assert [stamps(batch) for batch in open_batch.add(large, 0.0)] == [[0], [SECOND]]
    assert not len(open_batch)


def test_many_small_messages_are_closed_early() -> None:
    """However small its messages, a batch always fits into the queue."""
    open_batch = batcher(batch_s=3600.0)
    closed = [batch for stamp in range(MAX_BATCH_MESSAGES) for batch in open_batch.add(Sample(stamp, b''), 0.0)]
    assert [len(batch.samples) for batch in closed] == [MAX_BATCH_MESSAGES]
    assert MAX_MESSAGES >= 4 * MAX_BATCH_MESSAGES
    assert QueueSettings().max_bytes >= 4 * MAX_ARCHIVE_BYTES


def test_a_batch_is_due_when_its_time_is_over() -> None:
    """A topic that stops does not keep its batch open; an empty one is never due."""
    open_batch = batcher()
    assert not open_batch.is_due(100.0, 0.1)
    open_batch.add(Sample(0, b''), 10.0)
    assert not open_batch.is_due(11.05, 0.1)
    assert open_batch.is_due(11.15, 0.1)


def test_a_clock_that_steps_back_ends_the_batch() -> None:
    """Samples from before and after the clock was set do not share an object."""
    open_batch = batcher()
    open_batch.add(Sample(50 * SECOND, b''), 0.0)
    assert [stamps(batch) for batch in open_batch.add(Sample(20 * SECOND, b''), 0.0)] == [[50 * SECOND]]


def test_a_late_sample_joins_the_open_batch() -> None:
    """Two publishers with clocks that differ by 1.5 s do not create one object per message."""
    open_batch = batcher()
    open_batch.add(Sample(5 * SECOND, b''), 0.0)
    assert open_batch.add(Sample(3 * SECOND + SECOND // 2, b''), 0.0) == []
    assert stamps(open_batch.close()) == [5 * SECOND, 3 * SECOND + SECOND // 2]


@pytest.mark.parametrize('batch_s', [1.0, 3600.0])
@pytest.mark.parametrize('first', ['boot clock', 'UTC'])
def test_a_batch_ends_where_the_clock_is_set(batch_s: float, first: str) -> None:
    """No object has times of both the boot clock and UTC, in whichever direction the clock is set."""
    noon_ns = 1_760_788_800 * SECOND
    order = [60 * SECOND, noon_ns] if first == 'boot clock' else [noon_ns, 60 * SECOND]
    open_batch = batcher(batch_s)
    closed = [batch for stamp in order for batch in open_batch.add(Sample(stamp, b'x'), 0.0)]
    assert [stamps(batch) for batch in (*closed, open_batch.close())] == [[stamp] for stamp in order]


def kept(gate: FirstOfPeriod, *stamps_ns: int) -> list[int]:
    return [stamp for stamp in stamps_ns if gate.selects(stamp, b'')]


def test_the_first_message_of_each_second_is_kept() -> None:
    """Periods are in UTC, independent of the first message."""
    stamps = [NOON_NS + round(number * SECOND / 30) for number in range(-5, 91)]
    firsts = {stamp // SECOND: stamp for stamp in reversed(stamps)}
    assert kept(FirstOfPeriod(SECOND), *stamps) == sorted(firsts.values())


def test_a_restart_keeps_nothing_of_a_period_twice() -> None:
    """The stamp of the newest durable sample shows what was kept before."""
    gate = FirstOfPeriod(SECOND, NOON_NS + 100)
    assert kept(gate, NOON_NS + 200, NOON_NS + SECOND - 1, NOON_NS + SECOND) == [NOON_NS + SECOND]


def test_messages_out_of_order_are_not_kept_twice() -> None:
    """A late message of a period that already has one is skipped."""
    assert kept(FirstOfPeriod(SECOND), NOON_NS, NOON_NS + SECOND, NOON_NS + 5, NOON_NS + SECOND + 1) == [
        NOON_NS,
        NOON_NS + SECOND,
    ]


def test_setting_the_clock_back_does_not_stop_the_sampling() -> None:
    """Stamps an hour back mean that the clock was set: sampling continues from there."""
    hour = 3600 * SECOND
    assert kept(FirstOfPeriod(SECOND), NOON_NS, NOON_NS - hour, NOON_NS - hour + SECOND) == [
        NOON_NS,
        NOON_NS - hour,
        NOON_NS - hour + SECOND,
    ]


@pytest.mark.parametrize('has_header', [True, False])
def test_a_message_is_kept_when_its_content_changes(*, has_header: bool) -> None:
    """The stamp of a header is not content; without a header those bytes are."""
    gate = OnChange(has_header=has_header)
    cdr = b'\x00\x01\x00\x00' + b'STAMPSTA' + b'content'
    assert gate.selects(0, cdr)
    assert not gate.selects(0, cdr)
    assert gate.selects(0, cdr.replace(b'STAMP', b'stamp')) is not has_header
    assert gate.selects(0, cdr.replace(b'content', b'changed'))
    assert gate.selects(0, cdr), 'what comes back is a change as well'


def test_a_latched_message_is_kept_once() -> None:
    """A message sent again to a restarted node has the stamp of the newest durable sample; different content is new."""
    gate = OnChange(has_header=False, last_stored_ns=7 * SECOND)
    assert [gate.selects(stamp * SECOND, content) for stamp, content in ((7, b'0000a'), (8, b'0000a'), (9, b'0000b'))] == [
        False, False, True,
    ]  # fmt: skip
    assert OnChange(has_header=False, last_stored_ns=7 * SECOND).selects(8 * SECOND, b'0000a')


def test_the_settings_choose_the_rule() -> None:
    """0 Hz keeps every message, on_change takes precedence over the rate."""

    def gate(**settings: object) -> object:
        return rule_for(SensorSettings(name='x', **settings), has_header=True, last_stored_ns=0)  # type: ignore[arg-type]

    assert isinstance(gate(rate_hz=0.0), EveryMessage)
    assert isinstance(gate(rate_hz=2.0), FirstOfPeriod)
    assert isinstance(gate(rate_hz=2.0, on_change=True), OnChange)
    assert EveryMessage().selects(0, b'')


def test_the_rate_is_the_period() -> None:
    """At 4 Hz four messages per second are kept."""
    gate = rule_for(SensorSettings(name='x', rate_hz=4.0), has_header=True, last_stored_ns=0)
    assert sum(gate.selects(NOON_NS + number * SECOND // 100, b'') for number in range(300)) == 12


def test_setting_the_clock_does_not_stop_the_sampling() -> None:
    """From seconds since boot to UTC and back, each period has exactly one message."""
    up = 60 * SECOND
    stamps = [up, up + 1, up + SECOND, NOON_NS, NOON_NS + 1, NOON_NS + SECOND, up + 5 * SECOND, up + 6 * SECOND]
    assert kept(FirstOfPeriod(SECOND, NOON_NS - 3600 * SECOND), *stamps) == [up, up + SECOND, *stamps[3:4], *stamps[5:]]
