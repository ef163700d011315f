"""What is sampled and batched when the clocks of a topic's publishers differ, or their stamps cannot be trusted."""

from __future__ import annotations

import random
import struct
from collections.abc import Iterable
from itertools import accumulate

from clocks import NOON_NS
from node.intake.test_stream import Batches

from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.core.model import Batch, Taken
from shadowhound_data_logger.core.stamps import StampRule
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.intake.sampling import Sampler
from shadowhound_data_logger.node.intake.stream import Senders, SensorStream
from shadowhound_data_logger.spool.accounts import Accounts

TOPIC, TYPE = '/odom', 'nav_msgs/msg/Odometry'
HZ, SECONDS = 20, 15


def message(publisher: str, number: int, stamp_ns: int, received_ns: int) -> Taken:
    sec, nanosec = divmod(stamp_ns, SECOND)
    cdr = b'\0\1\0\0' + struct.pack('<iI', sec, nanosec) + b'x' * 16
    return Taken(cdr, received_ns, publisher, number, received_ns)


def received(publisher: str, offsets_ns: Iterable[int]) -> list[Taken]:
    """Messages at 20 Hz whose stamps are this much before their arrival."""
    times = ((number, NOON_NS + number * SECOND // HZ, offset_ns) for number, offset_ns in enumerate(offsets_ns, 1))
    return [message(publisher, number, at_ns - offset_ns, at_ns) for number, at_ns, offset_ns in times]


def batches(messages: Iterable[Taken], rate_hz: float = 0.0, batch_s: float = 0.0) -> list[Batch]:
    """What the sampler makes of messages that are drained five times a second."""
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
    """A message per second of each, though the stamps of one are five minutes behind."""
    found = batches([*received('a', [0] * HZ * SECONDS), *received('b', [300 * SECOND] * HZ * SECONDS)], rate_hz=1.0)
    assert 2 * SECONDS <= len(found) <= 2 * SECONDS + 2
    assert all(len(batch.samples) == 1 for batch in found)


def test_a_publisher_that_is_late_at_times_is_sampled_once_per_period() -> None:
    """More than a second late it seems to follow another clock, and back on time its own again: it is one publisher."""
    stamps_ns = [NOON_NS + number * SECOND // HZ for number in range(HZ * SECONDS)]
    late_ns = [1_500_000_000 if number % (4 * HZ) >= 2 * HZ else 0 for number in range(HZ * SECONDS)]
    arrivals_ns = accumulate((stamp + late for stamp, late in zip(stamps_ns, late_ns, strict=True)), max)
    messages = [message('a', *each) for each in zip(range(1, HZ * SECONDS + 1), stamps_ns, arrivals_ns, strict=True)]
    found = [batch.samples[0].stamp_ns // SECOND for batch in batches(messages, rate_hz=1.0)]
    assert found == sorted(set(found))
    assert len(found) == SECONDS


def test_two_clocks_on_a_topic_are_batched_apart() -> None:
    """A batch has the messages of one of them, and there is one per second and clock."""
    found = batches([*received('a', [0] * HZ * SECONDS), *received('b', [300 * SECOND] * HZ * SECONDS)], batch_s=1.0)
    assert 2 * SECONDS <= len(found) <= 2 * SECONDS + 2
    assert {frozenset(sample.publisher for sample in batch.samples) for batch in found} == {frozenset('a'), frozenset('b')}
    assert sum(len(batch.samples) for batch in found) == 2 * HZ * SECONDS


def test_publishers_on_the_same_clock_share_their_batches() -> None:
    """As those of a topic such as /tf do: more publishers are not more objects."""
    found = batches([*received('a', [0] * HZ * SECONDS), *received('b', [SECOND // 10] * HZ * SECONDS)], batch_s=1.0)
    assert len(found) in (SECONDS, SECONDS + 1)


def test_a_stray_stamp_does_not_end_a_batch() -> None:
    """Every tenth is 67 s old; it is dated by its arrival and joins the messages that it came with."""
    found = batches(received('a', [67 * SECOND if number % 10 == 9 else 0 for number in range(HZ * SECONDS)]), batch_s=1.0)
    assert len(found) in (SECONDS, SECONDS + 1)


def test_erratic_stamps_do_not_end_batches() -> None:
    """Of stamps that mean nothing, those after the first second are dated by arrival: a batch per second."""
    wild = random.Random(3)
    found = batches(received('a', [wild.randrange(-100, 100) * SECOND for _ in range(HZ * SECONDS)]), batch_s=1.0)
    assert len(found) <= SECONDS + 6


def test_a_clock_that_is_set_starts_one_batch() -> None:
    """Not one for each message that follows."""
    half = HZ * SECONDS // 2
    for step in (-40, 40):
        found = batches(received('a', [0] * half + [step * SECOND] * half), batch_s=1.0)
        assert len(found) <= SECONDS + 4
        assert sum(len(batch.samples) for batch in found) == 2 * half
