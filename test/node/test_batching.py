"""Batches are whole windows of UTC, bounded in time, number and size."""

from __future__ import annotations

import pytest

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import QueueSettings, SensorSettings
from shadowhound_data_logger.core.model import Batch, Sample
from shadowhound_data_logger.node.encoding.encode_pool import MAX_MESSAGES
from shadowhound_data_logger.node.intake.sampling import (
    MAX_ARCHIVE_BYTES,
    MAX_BATCH_BYTES,
    MAX_BATCH_MESSAGES,
    Batcher,
)


def batcher(batch_s: float = 1.0, format_name: str = 'json') -> Batcher:
    sensor = SensorSettings(name='imu', batch_s=batch_s, format=format_name)
    return Batcher(sensor, '/imu', 'sensor_msgs/msg/Imu')


def stamps(batch: Batch) -> list[int]:
    return [sample.stamp_ns for sample in batch.samples]


def test_a_batch_is_a_window_of_utc() -> None:
    """A message of the next whole second closes the batch of this one."""
    open_batch = batcher()
    closed = [batch for stamp in (0, 1, SECOND - 1, SECOND, 3 * SECOND) for batch in open_batch.add(Sample(stamp, b'x'), 0.0)]
    assert [stamps(batch) for batch in closed] == [[0, 1, SECOND - 1], [SECOND]]
    assert stamps(open_batch.close()) == [3 * SECOND]
    assert not len(open_batch)


def test_a_batch_has_sensor_topic_and_type() -> None:
    """Sensor, topic, type and the bytes of CDR stand on it."""
    open_batch = batcher()
    open_batch.add(Sample(1, b'12345'), 0.0)
    open_batch.add(Sample(2, b'123'), 0.0)
    assert len(open_batch) == 2
    assert open_batch.close() == Batch('imu', '/imu', 'sensor_msgs/msg/Imu', (Sample(1, b'12345'), Sample(2, b'123')), 8)


def test_without_a_window_each_message_is_a_batch() -> None:
    """With 0 nothing is ever open."""
    open_batch = batcher(batch_s=0.0)
    assert [stamps(batch) for batch in open_batch.add(Sample(7, b''), 0.0)] == [[7]]
    assert not len(open_batch)


@pytest.mark.parametrize(('format_name', 'most'), [('json', MAX_BATCH_BYTES), ('tar', MAX_ARCHIVE_BYTES)])
def test_a_large_batch_is_closed_early(format_name: str, most: int) -> None:
    """Memory is bounded whatever a topic sends, to what a format makes of it; a message that ends two batches closes both."""
    open_batch = batcher(format_name=format_name)
    assert open_batch.add(Sample(0, bytes(most - 1)), 0.0) == []
    large = Sample(SECOND, bytes(most))
    assert [stamps(batch) for batch in open_batch.add(large, 0.0)] == [[0], [SECOND]]
    assert not len(open_batch)


def test_many_small_messages_are_closed_early() -> None:
    """However small its messages, a batch always fits into the queue that it has to pass."""
    open_batch = batcher(batch_s=3600.0)
    closed = [batch for stamp in range(MAX_BATCH_MESSAGES) for batch in open_batch.add(Sample(stamp, b''), 0.0)]
    assert [len(batch.samples) for batch in closed] == [MAX_BATCH_MESSAGES]
    assert MAX_MESSAGES >= 4 * MAX_BATCH_MESSAGES
    assert QueueSettings().max_bytes >= 4 * MAX_ARCHIVE_BYTES


def test_a_batch_is_due_when_its_time_is_over() -> None:
    """A topic that falls silent does not keep its batch open; an empty one is never due."""
    open_batch = batcher()
    assert not open_batch.is_due(100.0, 0.1)
    open_batch.add(Sample(0, b''), 10.0)
    assert not open_batch.is_due(11.05, 0.1)
    assert open_batch.is_due(11.15, 0.1)


def test_a_clock_that_steps_back_ends_the_batch() -> None:
    """Samples from before the clock was set do not share an object with those from after it."""
    open_batch = batcher()
    open_batch.add(Sample(50 * SECOND, b''), 0.0)
    assert [stamps(batch) for batch in open_batch.add(Sample(20 * SECOND, b''), 0.0)] == [[50 * SECOND]]


def test_a_late_sample_joins_the_open_batch() -> None:
    """Two publishers whose clocks differ by a second and a half do not make an object of each message."""
    open_batch = batcher()
    open_batch.add(Sample(5 * SECOND, b''), 0.0)
    assert open_batch.add(Sample(3 * SECOND + SECOND // 2, b''), 0.0) == []
    assert stamps(open_batch.close()) == [5 * SECOND, 3 * SECOND + SECOND // 2]


@pytest.mark.parametrize('batch_s', [1.0, 3600.0])
@pytest.mark.parametrize('first', ['boot clock', 'UTC'])
def test_a_batch_ends_where_the_clock_is_set(batch_s: float, first: str) -> None:
    """No object holds times of the boot clock and of UTC, in whichever direction the clock is set."""
    noon_ns = 1_760_788_800 * SECOND
    order = [60 * SECOND, noon_ns] if first == 'boot clock' else [noon_ns, 60 * SECOND]
    open_batch = batcher(batch_s)
    closed = [batch for stamp in order for batch in open_batch.add(Sample(stamp, b'x'), 0.0)]
    assert [stamps(batch) for batch in (*closed, open_batch.close())] == [[stamp] for stamp in order]
