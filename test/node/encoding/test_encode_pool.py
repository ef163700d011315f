"""The encode pool and its bounded queue: every sample is stored, rejected or dropped by priority, and counted."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shadowhound_data_logger.core.config import QueueSettings, SensorSettings
from shadowhound_data_logger.core.model import Batch, DataObject, Sample
from shadowhound_data_logger.core.options import MEBI
from shadowhound_data_logger.core.stamps import Times, by_arrival
from shadowhound_data_logger.core.status import QueueStatus
from shadowhound_data_logger.formats.encoders import Encoding, encode
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.encoding import encode_pool as pool_module
from shadowhound_data_logger.node.encoding.encode_pool import BatchQueue, EncodePool

TEXT = b'\x00\x01\x00\x00\x03\x00\x00\x00hi\x00'
STAMP_NS = 1_760_788_800 * 10**9
ARRIVAL_NS = STAMP_NS + 10**9


class Outcome:
    """Collects the results of the pool in place of the spool's writer, its spool and the accounts. Sufficiently thread-safe."""

    def __init__(self, threads: int = 2, observe: Callable[[Batch, DataObject | None], None] = lambda *_: None) -> None:
        self.queue = BatchQueue(QueueSettings())
        self.objects: list[DataObject] = []
        self.rejected: Counter[str] = Counter()
        self.corrected: Counter[str] = Counter()
        self.lock = threading.Lock()
        self.accounts = self.spool = self
        sensors = {'talk': SensorSettings(name='talk', batch_s=1.0)}
        writer: Any = self
        self.pool = EncodePool('thor', self.queue, sensors, MessageTypes(), writer, [self.mark], observe, threads=threads)

    @staticmethod
    def mark(item: DataObject) -> DataObject:
        return replace(item, metadata={**item.metadata, 'marked': 'yes'})

    def put(self, item: DataObject) -> None:
        assert item.metadata['marked'] == 'yes'
        with self.lock:
            self.objects.append(item)

    def reject(self, topic: str, reasons: Mapping[str, int], first: Times, last: Times) -> None:
        assert topic == '/talk'
        assert first == last == by_arrival(ARRIVAL_NS)
        with self.lock:
            self.rejected.update(reasons)

    def correct(self, topic: str, reasons: Mapping[str, int]) -> None:
        assert topic == '/talk'
        with self.lock:
            self.corrected.update(reasons)

    @property
    def samples(self) -> int:
        return sum(item.samples for item in self.objects)


def talk(*cdrs: bytes, sensor: str = 'talk') -> Batch:
    return Batch(
        sensor, '/talk', 'std_msgs/msg/String', tuple(Sample(STAMP_NS, cdr, ARRIVAL_NS) for cdr in cdrs), sum(map(len, cdrs))
    )


def test_valid_samples_are_stored_and_invalid_ones_rejected() -> None:
    """The valid samples of a batch are in its object, the invalid ones are counted by reason."""
    outcome = Outcome()
    outcome.pool.open()
    outcome.queue.put(talk(TEXT, b'bad', TEXT), 5)
    outcome.queue.put(talk(b'bad'), 5)
    assert outcome.pool.close(60)
    assert (outcome.samples, outcome.rejected) == (2, {'malformed': 2})
    assert [item.key.split('/')[:2] for item in outcome.objects] == [['thor', 'talk']]


def test_an_encoder_error_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    """The first rejected message of a topic and reason is logged with an explanation, the others are only counted."""
    outcome = Outcome(threads=1)
    outcome.queue.put(talk(b'bad', b'bad'), 5)
    outcome.queue.put(talk(b'bad'), 5)
    outcome.pool.open()
    assert outcome.pool.close(60)
    assert outcome.rejected == {'malformed': 3}
    (record,) = caplog.records
    assert record.getMessage().startswith('/talk: a message cannot be stored: malformed: ')


def test_corrected_messages_are_stored_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Corrections are counted once the object is put, among the stored messages."""

    def correcting(batch: Batch, *rest: Any) -> Encoding:
        made = encode(batch, *rest)
        return replace(made, corrected={'row_step': len(batch.samples)}) if made.object else made

    monkeypatch.setattr(pool_module, 'encode', correcting)
    outcome = Outcome()
    outcome.pool.open()
    outcome.queue.put(talk(TEXT, TEXT), 5)
    outcome.queue.put(talk(b'bad'), 5)
    assert outcome.pool.close(60)
    assert (outcome.samples, outcome.corrected, outcome.rejected) == (2, {'row_step': 2}, {'malformed': 1})


def test_a_failing_observer_costs_nothing() -> None:
    """It receives each batch after the object is put; an exception is counted as a failure of the thread."""
    seen = []

    def observe(batch: Batch, item: DataObject | None) -> None:
        assert item is not None
        assert item.body == outcome.objects[-1].body
        seen.append((batch, outcome.samples))
        raise ZeroDivisionError('a fault')

    outcome = Outcome(1, observe)
    outcome.queue.put(talk(TEXT, TEXT), 5)
    outcome.pool.open()
    assert outcome.queue.finished(10)
    assert outcome.pool.close(60)
    assert [(len(batch.samples), stored) for batch, stored in seen] == [(2, 2)]
    assert (outcome.samples, outcome.rejected, outcome.pool.workers[0].failures) == (2, {}, 1)


def test_close_encodes_what_is_queued() -> None:
    """Nothing queued before the close is lost, and closing again is allowed."""
    outcome = Outcome(threads=1)
    for _ in range(200):
        outcome.queue.put(talk(TEXT), 5)
    outcome.pool.open()
    assert outcome.pool.close(60)
    assert outcome.pool.close(1)
    assert outcome.samples == 200


def test_a_bug_in_an_encoder_costs_its_batch_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its samples are rejected as encoder_failed, the failure is counted, and the others are encoded anyway."""
    outcome, encode = Outcome(threads=1), pool_module.encode

    def faulty(batch: Batch, *rest: object) -> object:
        if len(batch.samples) == 3:
            raise ZeroDivisionError('a fault')
        return encode(batch, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(pool_module, 'encode', faulty)
    outcome.queue.put(talk(TEXT, TEXT, TEXT), 1)
    outcome.queue.put(talk(TEXT), 5)
    outcome.pool.open()
    done = threading.Event()
    while not outcome.samples:
        done.wait(0.01)
    assert outcome.pool.close(60)
    assert (outcome.samples, outcome.rejected) == (1, {'encoder_failed': 3})
    assert [worker.failures for worker in outcome.pool.workers] == [1]


@pytest.mark.parametrize('death', [SystemExit(1), MemoryError('no room'), KeyboardInterrupt()])
@pytest.mark.parametrize('place', ['encode', 'put'])
def test_a_failed_thread_is_restarted(monkeypatch: pytest.MonkeyPatch, death: BaseException, place: str) -> None:
    """Whether encoding or the put fails, the samples are rejected, and the same pool encodes the next batch."""
    outcome, deaths = Outcome(threads=1), [death]
    real = {'encode': pool_module.encode, 'put': outcome.put}[place]

    def dying(*given: object) -> object:
        if deaths:
            raise deaths.pop()
        return real(*given)  # type: ignore[operator]

    monkeypatch.setattr(*((pool_module, 'encode') if place == 'encode' else (outcome, 'put')), dying)
    outcome.queue.put(talk(TEXT, TEXT, TEXT), 1)
    outcome.queue.put(talk(TEXT), 5)
    outcome.pool.open()
    assert outcome.queue.finished(10)
    assert outcome.pool.close(60)
    assert (outcome.samples, outcome.rejected) == (1, {'encoder_failed': 3})
    assert [worker.failures for worker in outcome.pool.workers] == [1]
    assert outcome.queue.status().finished == 2


def test_a_slow_close_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """A blocked writer is waited for only until the timeout."""
    outcome, entered, blocked = Outcome(threads=1), threading.Event(), threading.Event()

    def put(_: DataObject) -> None:
        entered.set()
        assert blocked.wait(60)

    monkeypatch.setattr(outcome, 'put', put)
    outcome.queue.put(talk(TEXT), 5)
    outcome.pool.open()
    assert entered.wait(60)
    assert not outcome.pool.close(0.05)
    blocked.set()
    assert outcome.pool.close(60)


def batch(name: str, size: int = 10, messages: int = 1) -> Batch:
    return Batch(name, f'/{name}', 'type', (Sample(0, b''),) * messages, size)


def names(batches: list[Batch]) -> list[str]:
    return [item.sensor for item in batches]


def taken(queue: BatchQueue) -> list[str]:
    found = []
    while (item := queue.get(0.0)) is not None:
        found.append(item.sensor)
    return found


def test_the_queue_gives_the_most_important_then_the_oldest() -> None:
    """Priority 0 precedes 9; within a priority batches keep the order of arrival."""
    queue = BatchQueue(QueueSettings())
    for name, priority in (('c1', 6), ('a1', 1), ('c2', 6), ('a2', 1), ('b', 3)):
        assert queue.put(batch(name), priority) == []
    assert taken(queue) == ['a1', 'a2', 'b', 'c1', 'c2']


def test_too_many_bytes_drop_the_least_important_oldest_first() -> None:
    """Dropped batches are returned to the caller, which counts them."""
    queue = BatchQueue(QueueSettings(max_bytes=MEBI))
    for name, priority in (('lidar1', 7), ('lidar2', 7), ('imu', 4)):
        queue.put(batch(name, MEBI // 4), priority)
    assert names(queue.put(batch('camera', MEBI // 2), 6)) == ['lidar1']
    assert names(queue.put(batch('odom', MEBI // 2), 3)) == ['lidar2', 'camera']
    assert taken(queue) == ['odom', 'imu']


def test_too_many_messages_are_dropped_as_well() -> None:
    """A batch counts all of its messages."""
    queue = BatchQueue(QueueSettings(), max_messages=10)
    queue.put(batch('old', messages=6), 5)
    assert names(queue.put(batch('new', messages=6), 5)) == ['old']
    assert queue.status() == QueueStatus(1, 6, 10, 0, 10, QueueSettings().max_bytes)


def test_the_new_batch_may_be_the_one_that_is_dropped() -> None:
    """A queue full of more important batches keeps them; a batch larger than the queue is dropped immediately."""
    queue = BatchQueue(QueueSettings(max_bytes=MEBI))
    queue.put(batch('imu', MEBI), 4)
    assert names(queue.put(batch('lidar', 1), 7)) == ['lidar']
    assert names(queue.put(batch('huge', 2 * MEBI), 9)) == ['huge']
    assert taken(queue) == ['imu']


def test_get_waits_for_a_batch() -> None:
    """A waiting encoder gets the next batch immediately."""
    queue, got = BatchQueue(QueueSettings()), []
    thread = threading.Thread(target=lambda: got.append(queue.get(30.0)))
    thread.start()
    queue.put(batch('imu'), 4)
    thread.join(60)
    assert not thread.is_alive()
    assert names(got) == ['imu']


def test_a_closed_queue_is_emptied_and_does_not_wait() -> None:
    """Closing wakes all waiting threads; queued batches can still be taken."""
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
def test_the_queue_keeps_its_bounds_and_loses_nothing_silently(arrivals: list[tuple[int, int, int]]) -> None:
    """Every batch is queued, dropped or taken, and a dropped one was never more important than one that was kept."""
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


def test_a_caller_can_wait_for_the_current_batches() -> None:
    """It waits until all batches put before the call are encoded or dropped; later ones do not count."""
    queue = BatchQueue(QueueSettings(), max_messages=2)
    assert queue.finished(0.0), 'an empty queue has nothing to wait for'
    queue.put(batch('lidar'), 7)
    queue.put(batch('imu'), 4)
    imu = queue.get(0.0)
    assert imu
    assert not queue.finished(0.0)
    queue.put(batch('odom', messages=2), 3)  # drops the batch of the lidar
    odom = queue.get(0.0)
    assert odom
    queue.done(odom)
    assert not queue.finished(0.0), 'the oldest one is still in the making'
    queue.done(imu)
    assert queue.finished(0.0)


def test_waiting_ends_with_the_last_batch() -> None:
    """The wait ends when the last of these batches is done, even if important ones keep arriving."""
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
