"""Batches are whole windows of UTC, bounded in time and size."""

from __future__ import annotations

from shadowhound_data_logger.capture.batching import MAX_BATCH_BYTES, Batcher
from shadowhound_data_logger.clock import SECOND
from shadowhound_data_logger.model import Batch, Sample


def batcher(batch_ns: int = SECOND) -> Batcher:
    return Batcher('imu', '/imu', 'sensor_msgs/msg/Imu', batch_ns)


def stamps(batch: Batch) -> list[int]:
    return [sample.stamp_ns for sample in batch.samples]


def test_a_batch_is_a_window_of_utc() -> None:
    """A message of the next whole second closes the batch of this one."""
    open_batch = batcher()
    closed = [batch for stamp in (0, 1, SECOND - 1, SECOND, 3 * SECOND) for batch in open_batch.add(Sample(stamp, b'x'), 0.0)]
    assert [stamps(batch) for batch in closed] == [[0, 1, SECOND - 1], [SECOND]]
    assert stamps(open_batch.close()) == [3 * SECOND]
    assert not len(open_batch)


def test_a_batch_says_what_it_is() -> None:
    """Sensor, topic, type and the bytes of CDR stand on it."""
    open_batch = batcher()
    open_batch.add(Sample(1, b'12345'), 0.0)
    open_batch.add(Sample(2, b'123'), 0.0)
    assert len(open_batch) == 2
    assert open_batch.close() == Batch('imu', '/imu', 'sensor_msgs/msg/Imu', (Sample(1, b'12345'), Sample(2, b'123')), 8)


def test_without_a_window_each_message_is_a_batch() -> None:
    """With 0 nothing is ever open."""
    open_batch = batcher(0)
    assert [stamps(batch) for batch in open_batch.add(Sample(7, b''), 0.0)] == [[7]]
    assert not len(open_batch)


def test_a_large_batch_is_closed_early() -> None:
    """Memory is bounded whatever a topic sends; a message that ends two batches closes both."""
    open_batch = batcher()
    assert open_batch.add(Sample(0, b''), 0.0) == []
    large = Sample(SECOND, bytes(MAX_BATCH_BYTES))
    assert [stamps(batch) for batch in open_batch.add(large, 0.0)] == [[0], [SECOND]]
    assert not len(open_batch)


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
