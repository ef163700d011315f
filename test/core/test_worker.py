"""Supervised threads: a loop that fails is detected, counted and restarted."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from shadowhound_data_logger.core import worker as worker_module
from shadowhound_data_logger.core.worker import Worker


def until(condition: Callable[[], object]) -> None:
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.001)


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_module, 'FIRST_PAUSE_S', 0.001)


def test_a_worker_repeats_until_it_is_stopped() -> None:
    """The current round is the last one after stop."""
    rounds = threading.Semaphore(0)
    worker = Worker('rounds', rounds.release)
    worker.start()
    for _ in range(3):
        assert rounds.acquire(timeout=60)
    assert not worker.stopping
    worker.stop()
    assert worker.join(60)
    assert worker.stopping
    assert (worker.failures, worker.failing) == (0, False)


def test_the_operating_system_has_the_name_of_a_thread() -> None:
    """As ``top -H`` shows it, truncated to Linux's maximum."""
    names: list[str] = []
    worker = Worker('a-thread-with-a-long-name', lambda: names.append(worker_module.SYSTEM_NAME.read_text(encoding='utf-8')))
    worker.start()
    until(lambda: names)
    worker.stop()
    assert worker.join(60)
    assert names[0] == 'a-thread-with-a\n'


def test_a_worker_runs_where_threads_cannot_be_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """That is not an error."""
    monkeypatch.setattr(worker_module, 'SYSTEM_NAME', tmp_path / 'none' / 'comm')
    rounds = threading.Semaphore(0)
    worker = Worker('rounds', rounds.release)
    worker.start()
    assert rounds.acquire(timeout=60)
    worker.stop()
    assert worker.join(60)
    assert worker.failures == 0


def test_a_failure_is_counted_and_logged(caplog: pytest.LogCaptureFixture) -> None:
    """An exception in a round is in the log and in the status, and the next one starts after a pause."""
    caplog.set_level(logging.INFO)
    rounds: list[int] = []
    well = threading.Event()

    def step() -> None:
        rounds.append(len(rounds))
        if len(rounds) <= 2:
            raise ZeroDivisionError('by nothing')
        if len(rounds) > 3:  # the third round has ended, and is evaluated
            well.set()

    worker = Worker('faulty', step)
    worker.start()
    assert well.wait(60)
    worker.stop()
    assert worker.join(60)
    assert (worker.failures, worker.failing, worker.last_error) == (2, False, 'ZeroDivisionError: by nothing')
    assert caplog.text.count('faulty failed (1 times so far) and tries again: by nothing') == 1
    assert 'faulty failed (2' not in caplog.text, 'the same failure is said once'
    assert 'faulty works again after 2 failures' in caplog.text


def test_a_stop_ends_the_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker that waits after a failure stops immediately."""
    monkeypatch.setattr(worker_module, 'FIRST_PAUSE_S', 60.0)
    failed = threading.Event()

    def step() -> None:
        failed.set()
        raise OSError('broken')

    worker = Worker('waiting', step)
    worker.start()
    assert failed.wait(60)
    worker.stop()
    assert worker.join(60)
    assert worker.failing


def test_a_hanging_round_is_reported() -> None:
    """Join reports that it did not end before the deadline; for one that never started it returns immediately."""
    began, released = threading.Event(), threading.Event()

    def step() -> None:
        began.set()
        released.wait(30)

    worker = Worker('hanging', step)
    assert worker.join(0.0)
    worker.start()
    assert began.wait(60)
    worker.stop()
    assert not worker.join(0.01)
    released.set()
    assert worker.join(60)


@pytest.mark.parametrize('death', [SystemExit(1), KeyboardInterrupt(), GeneratorExit(), MemoryError('no room')])
def test_no_exception_ends_the_thread(death: BaseException) -> None:
    """Not even one that should end a program: it is counted as any failure, and the next round starts."""
    deaths, well = [death], threading.Event()

    def step() -> None:
        if deaths:
            raise deaths.pop()
        well.set()

    worker = Worker('tough', step)
    worker.start()
    assert well.wait(60)
    assert (worker.failures, worker.deaths, worker.alive) == (1, 0, True)
    assert worker.last_error.startswith(type(death).__name__)
    worker.stop()
    assert worker.join(60)


def test_a_thread_that_ends_is_started_again(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    """One that crashes in its bookkeeping is detected, counted once, reported, and restarted after its pause."""
    deaths = [ZeroDivisionError('in a round')]
    well = threading.Event()
    worker = Worker('mortal', lambda: _raise(deaths.pop()) if deaths else well.set())

    def no_memory(*_: object) -> None:
        monkeypatch.undo()
        raise MemoryError('for the log')

    monkeypatch.setattr(worker, '_fail', no_memory)
    worker.start()
    until(lambda: not worker.alive)
    assert worker.failures == 0
    monkeypatch.setattr(worker_module, 'FIRST_PAUSE_S', 0.2)
    for _ in range(3):
        worker.poll()
    assert (worker.failures, worker.deaths, worker.failing, worker.alive) == (1, 1, True, False)
    assert worker.status().last_error == 'MemoryError: for the log'
    assert not well.is_set()
    until(lambda: worker.poll() or worker.alive)  # type: ignore[func-returns-value]
    assert well.wait(60)
    until(lambda: not worker.failing)
    assert (worker.failures, worker.deaths) == (1, 1)
    assert 'mortal died (1 times so far) and tries again: for the log' in caplog.text
    worker.stop()
    assert worker.join(60)


def test_a_thread_that_cannot_be_started_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """At startup, or later: that is a crash like any other, and ends once a thread starts."""
    well = threading.Event()
    worker = Worker('starved', well.set)
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, 'start', lambda _: _raise(RuntimeError("can't start new thread")))
        worker.start()
        worker.poll()
        assert (worker.deaths, worker.last_error) == (1, "RuntimeError: can't start new thread")
        until(lambda: worker.poll() or worker.deaths > 2)  # type: ignore[func-returns-value]
    until(lambda: worker.poll() or well.is_set())  # type: ignore[func-returns-value]
    worker.stop()
    assert worker.join(60)


def test_checking_a_stopped_worker_starts_nothing() -> None:
    """Neither before its start nor after its stop."""
    worker = Worker('idle', lambda: None)
    worker.poll()
    assert not worker.alive
    worker.start()
    worker.stop()
    assert worker.join(60)
    worker.poll()
    assert (worker.alive, worker.failures) == (False, 0)


def test_the_duration_of_a_round_is_reported() -> None:
    """The duration of a hung round grows in the status; that of a finished one does not."""
    released = threading.Event()

    def step() -> None:
        assert released.wait(60)
        worker.stop()

    worker = Worker('slow', step, patience_s=3.0)
    worker.start()
    until(lambda: worker.status().busy_s >= 0.1)
    assert worker.status().patience_s == 3.0
    released.set()
    assert worker.join(60)
    assert worker.status().busy_s == 0.0


def test_workers_share_reported_failures(caplog: pytest.LogCaptureFixture) -> None:
    """A defect that many of them meet repeatedly is one entry in the log, with its traceback."""
    reported: set[str] = set()
    workers = [Worker(f'w-{number}', lambda: _raise(ValueError('x')), reported=reported) for number in range(3)]
    for worker in workers:
        worker.start()
    until(lambda: all(worker.failures > 2 for worker in workers))
    for worker in workers:
        worker.stop()
        assert worker.join(60)
    (record,) = caplog.records
    assert record.exc_info


def _raise(error: BaseException) -> None:
    raise error


def test_a_worker_that_keeps_failing_is_tried_less_often() -> None:
    """The pause doubles up to the worker's maximum."""
    worker = Worker('rare', lambda: None, longest_pause_s=0.003)
    assert [worker._next_pause() for _ in range(4)] == [0.001, 0.002, 0.003, 0.003]


def test_a_starting_worker_is_not_reported_as_dead(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its starting thread is not the one that supervises it."""
    start = threading.Thread.start
    worker = Worker('worker', lambda: time.sleep(0.01))

    def looked_at(thread: threading.Thread) -> None:
        start(thread)
        worker.poll()

    monkeypatch.setattr(threading.Thread, 'start', looked_at)
    worker.start()
    worker.poll()
    worker.stop()
    assert worker.join(10.0)
    assert (worker.deaths, worker.failures, worker.last_error) == (0, 0, '')
