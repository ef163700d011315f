"""The encode pool: every sample that goes in comes out as stored or as rejected."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import pytest

from shadowhound_data_logger.core.config import QueueSettings, SensorSettings
from shadowhound_data_logger.core.model import Batch, DataObject, Sample
from shadowhound_data_logger.core.stamps import Times, by_arrival
from shadowhound_data_logger.formats.encoders import Encoding, encode
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.encoding import encode_pool as pool_module
from shadowhound_data_logger.node.encoding.encode_pool import BatchQueue, EncodePool

TEXT = b'\x00\x01\x00\x00\x03\x00\x00\x00hi\x00'
STAMP_NS = 1_760_788_800 * 10**9
ARRIVAL_NS = STAMP_NS + 10**9


class Outcome:
    """What the pool handed on: it stands for the spool's writer, its spool and the accounts. Thread-safe enough."""

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
    """The good ones of a batch are in its object, the bad ones are counted by reason."""
    outcome = Outcome()
    outcome.pool.open()
    outcome.queue.put(talk(TEXT, b'bad', TEXT), 5)
    outcome.queue.put(talk(b'bad'), 5)
    assert outcome.pool.close(60)
    assert (outcome.samples, outcome.rejected) == (2, {'malformed': 2})
    assert [item.key.split('/')[:2] for item in outcome.objects] == [['thor', 'talk']]


def test_an_encoder_error_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    """The first rejected message of a topic and reason is told to the operator in words, the others are only counted."""
    outcome = Outcome(threads=1)
    outcome.queue.put(talk(b'bad', b'bad'), 5)
    outcome.queue.put(talk(b'bad'), 5)
    outcome.pool.open()
    assert outcome.pool.close(60)
    assert outcome.rejected == {'malformed': 3}
    (record,) = caplog.records
    assert record.getMessage().startswith('/talk: a message cannot be stored: malformed: ')


def test_corrected_messages_are_stored_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """What had to be corrected is counted once its object is on its way, among the stored messages."""

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


def test_an_observer_with_a_fault_costs_nothing() -> None:
    """Each batch is shown to it after its object is on its way; what it raises is counted as the thread's failure."""
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
    """Nothing that was queued before the close is lost, and closing again is allowed."""
    outcome = Outcome(threads=1)
    for _ in range(200):
        outcome.queue.put(talk(TEXT), 5)
    outcome.pool.open()
    assert outcome.pool.close(60)
    assert outcome.pool.close(1)
    assert outcome.samples == 200


def test_an_encoder_with_a_bug(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its samples are rejected as encoder_failed, the failure is counted, and the others are encoded all the same."""
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
def test_a_thread_that_dies(monkeypatch: pytest.MonkeyPatch, death: BaseException, place: str) -> None:
    """Whatever ends the encoder or the hand-over, its samples are rejected, the next batch is encoded by the same pool."""
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
    """A writer that blocks is not waited for longer than told."""
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
