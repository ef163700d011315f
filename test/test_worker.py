"""Supervised threads: a loop that fails is seen, counted and started again."""

from __future__ import annotations

import logging
import threading

import pytest

from shadowhound_data_logger import worker as worker_module
from shadowhound_data_logger.worker import Worker


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_module, 'FIRST_PAUSE_S', 0.001)


def test_it_goes_round_until_it_is_stopped() -> None:
    """The current round is the last one after stop."""
    rounds = threading.Semaphore(0)
    worker = Worker('rounds', rounds.release)
    worker.start()
    for _ in range(3):
        assert rounds.acquire(timeout=10)
    assert not worker.stopping
    worker.stop()
    assert worker.join(10)
    assert worker.stopping
    assert (worker.failures, worker.failing) == (0, False)


def test_a_failure_is_counted_said_and_survived(caplog: pytest.LogCaptureFixture) -> None:
    """A round that raises shows in the log and in the status, and the next one begins after a pause."""
    caplog.set_level(logging.INFO)
    rounds: list[int] = []
    well = threading.Event()

    def step() -> None:
        rounds.append(len(rounds))
        if len(rounds) <= 2:
            raise ZeroDivisionError('by nothing')
        if len(rounds) > 3:  # the third round is over, and judged
            well.set()

    worker = Worker('faulty', step)
    worker.start()
    assert well.wait(10)
    worker.stop()
    assert worker.join(10)
    assert (worker.failures, worker.failing, worker.last_error) == (2, False, 'ZeroDivisionError: by nothing')
    assert caplog.text.count('faulty failed (1 times so far) and tries again: by nothing') == 1
    assert 'faulty failed (2' not in caplog.text, 'the same failure is said once'
    assert 'faulty works again after 2 failures' in caplog.text


def test_a_stop_ends_the_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker that waits after a failure stops at once."""
    monkeypatch.setattr(worker_module, 'FIRST_PAUSE_S', 60.0)
    failed = threading.Event()

    def step() -> None:
        failed.set()
        raise OSError('broken')

    worker = Worker('waiting', step)
    worker.start()
    assert failed.wait(10)
    worker.stop()
    assert worker.join(10)
    assert worker.failing


def test_a_round_that_hangs_is_told() -> None:
    """Join says that it did not end in time; one that never started has nothing to wait for."""
    released = threading.Event()
    worker = Worker('hanging', lambda: bool(released.wait(30)) and None)
    assert worker.join(0.0)
    worker.start()
    worker.stop()
    assert not worker.join(0.01)
    released.set()
    assert worker.join(10)
