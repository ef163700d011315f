"""The bounded queue: never blocks, serves the most important first, and drops the least important first."""

from __future__ import annotations

import threading

from hypothesis import given
from hypothesis import strategies as st

from shadowhound_data_logger.core.model import Batch, Sample
from shadowhound_data_logger.core.options import MEBI, QueueSettings
from shadowhound_data_logger.core.status import QueueStatus
from shadowhound_data_logger.node.encoding.encode_pool import BatchQueue


def batch(name: str, size: int = 10, messages: int = 1) -> Batch:
    return Batch(name, f'/{name}', 'type', (Sample(0, b''),) * messages, size)


def names(batches: list[Batch]) -> list[str]:
    return [item.sensor for item in batches]


def taken(queue: BatchQueue) -> list[str]:
    found = []
    while (item := queue.get(0.0)) is not None:
        found.append(item.sensor)
    return found


def test_the_most_important_first_then_the_oldest() -> None:
    """Priority 0 goes before 9; within one the order is that of arrival."""
    queue = BatchQueue(QueueSettings())
    for name, priority in (('c1', 6), ('a1', 1), ('c2', 6), ('a2', 1), ('b', 3)):
        assert queue.put(batch(name), priority) == []
    assert taken(queue) == ['a1', 'a2', 'b', 'c1', 'c2']


def test_too_many_bytes_drop_the_least_important_oldest_first() -> None:
    """What has to go is told to the caller, who counts it."""
    queue = BatchQueue(QueueSettings(max_bytes=MEBI))
    for name, priority in (('lidar1', 7), ('lidar2', 7), ('imu', 4)):
        queue.put(batch(name, MEBI // 4), priority)
    assert names(queue.put(batch('camera', MEBI // 2), 6)) == ['lidar1']
    assert names(queue.put(batch('odom', MEBI // 2), 3)) == ['lidar2', 'camera']
    assert taken(queue) == ['odom', 'imu']


def test_too_many_messages_drop_as_well() -> None:
    """A batch counts with all of its messages."""
    queue = BatchQueue(QueueSettings(), max_messages=10)
    queue.put(batch('old', messages=6), 5)
    assert names(queue.put(batch('new', messages=6), 5)) == ['old']
    assert queue.status() == QueueStatus(1, 6, 10, 0, 10, QueueSettings().max_bytes)


def test_the_newcomer_may_be_the_one_that_is_dropped() -> None:
    """A full queue of more important things keeps them; a batch larger than all of it is dropped at once."""
    queue = BatchQueue(QueueSettings(max_bytes=MEBI))
    queue.put(batch('imu', MEBI), 4)
    assert names(queue.put(batch('lidar', 1), 7)) == ['lidar']
    assert names(queue.put(batch('huge', 2 * MEBI), 9)) == ['huge']
    assert taken(queue) == ['imu']


def test_get_waits_for_a_batch() -> None:
    """An encoder that waits gets what comes, at once."""
    queue, got = BatchQueue(QueueSettings()), []
    thread = threading.Thread(target=lambda: got.append(queue.get(30.0)))
    thread.start()
    queue.put(batch('imu'), 4)
    thread.join(60)
    assert not thread.is_alive()
    assert names(got) == ['imu']


def test_a_closed_queue_is_emptied_and_does_not_wait() -> None:
    """Closing wakes those who wait; what is inside can still be taken."""
    queue = BatchQueue(QueueSettings())
    threads = [threading.Thread(target=queue.get, args=(30.0,)) for _ in range(2)]
    for thread in threads:
        thread.start()
    queue.close()
    for thread in threads:
        thread.join(60)
    assert not any(thread.is_alive() for thread in threads)
    queue.put(batch('late'), 4)
    assert names([queue.get(30.0) or batch('nothing')]) == ['late']
    assert queue.get(30.0) is None


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, MEBI), st.integers(1, 40))))
def test_it_is_always_within_its_bounds_and_loses_nothing_silently(arrivals: list[tuple[int, int, int]]) -> None:
    """Every batch is inside, dropped or taken, and a dropped one was never more important than one that stays."""
    queue = BatchQueue(QueueSettings(max_bytes=MEBI), max_messages=100)
    inside: dict[str, int] = {}
    for number, (priority, size, messages) in enumerate(arrivals):
        inside[str(number)] = priority
        for lost in names(queue.put(batch(str(number), size, messages), priority)):
            assert inside.pop(lost) >= max(inside.values(), default=0)
        status = queue.status()
        assert status.bytes <= MEBI
        assert status.messages <= 100
        assert status.batches == len(inside)
    assert sorted(taken(queue)) == sorted(inside)
    assert queue.status() == QueueStatus(max_messages=100, max_bytes=MEBI)


def test_one_can_wait_for_what_is_in_it_now() -> None:
    """All batches that were put before the call must have left, done or dropped; those that come later do not count."""
    queue = BatchQueue(QueueSettings(), max_messages=2)
    assert queue.finished(0.0), 'an empty queue has nothing to wait for'
    queue.put(batch('lidar'), 7)
    queue.put(batch('imu'), 4)
    imu = queue.get(0.0)
    assert imu
    assert not queue.finished(0.0)
    queue.put(batch('odom', messages=2), 3)  # drops the lidar's
    odom = queue.get(0.0)
    assert odom
    queue.done(odom)
    assert not queue.finished(0.0), 'the oldest one is still in the making'
    queue.done(imu)
    assert queue.finished(0.0)


def test_waiting_ends_with_the_last_of_them() -> None:
    """Whoever waits goes on when the last batch of before is done, though important ones keep coming."""
    queue = BatchQueue(QueueSettings())
    queue.put(batch('lidar'), 7)
    waited: list[bool] = []
    thread = threading.Thread(target=lambda: waited.append(queue.finished(30.0)))
    thread.start()
    for _ in range(20):
        queue.put(batch('imu'), 1)
        item = queue.get(0.0)
        assert item
        queue.done(item)
    while (item := queue.get(0.0)) is not None:
        queue.done(item)
    thread.join(60)
    assert waited == [True]
