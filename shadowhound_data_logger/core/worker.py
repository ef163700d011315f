"""Supervised threads: a loop that fails is noticed, counted and restarted; it never ends silently.

Whatever a round raises, SystemExit included, costs that round and a pause. Should the thread itself end all the same (no
memory for its own bookkeeping, say), whoever supervises it finds out in ``look`` and starts another one.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.core.status import WorkerStatus

log = logging.getLogger(__name__)

FIRST_PAUSE_S: Final = 0.1
LONGEST_PAUSE_S: Final = 5.0
DIED: Final = 'died'
SYSTEM_NAME: Final = Path('/proc/thread-self/comm')
"""Where Linux keeps the name of the thread that asks (proc(5)), as ``top -H`` shows it; CPython tells it since 3.14 only."""


class Worker:
    """Calls ``step`` on a daemon thread of its own until it is stopped.

    ``step`` does one round and returns; it may block for as long as closing may wait, and accounts for what it holds
    whatever ends it. Life: New; start once; ``look`` a few times a second, from one thread; stop once.
    """

    def __init__(self, name: str, step: Callable[[], None], *, patience_s: float | None = None,
                 told: set[str] | None = None, longest_pause_s: float = LONGEST_PAUSE_S) -> None:  # fmt: skip
        """Workers that share ``told`` say each failure once among them, by its place in the code, and no recovery.

        ``longest_pause_s`` is between two tries of one that fails again and again.
        """
        self.name = name
        self.failures = 0
        self.deaths = 0
        self.last_error = ''
        self.failing = False
        self._step = step
        self._patience_s = patience_s
        self._told = told
        self._longest_pause_s = longest_pause_s
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._started = False
        self._death: BaseException | None = None
        self._buried = False  # whether the death of the thread has been counted
        self._again_s = 0.0
        self._pause_s = 0.0
        self._failed_before = 0
        self._round_s = 0.0

    def start(self) -> None:
        self._launch()
        self._started = True  # only now: who looks meanwhile, on another thread, would take it for one that has ended

    def stop(self) -> None:
        """Let the current round be the last one; does not wait."""
        self._stopping.set()

    def join(self, timeout_s: float) -> bool:
        """Whether the thread ended in time."""
        if self._thread is None:
            return True
        self._thread.join(max(0.0, timeout_s))
        return not self._thread.is_alive()

    @property
    def stopping(self) -> bool:
        return self._stopping.is_set()

    @property
    def alive(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def status(self) -> WorkerStatus:
        """From any thread."""
        busy_s = time.monotonic() - self._round_s if self.alive and not self.failing else 0.0
        return WorkerStatus(self.alive, self.failing, self.failures, self.deaths, self.last_error, round(max(0.0, busy_s), 1),
                            self._patience_s)  # fmt: skip

    def look(self) -> None:
        """Count the death of the thread, if it died, and start another one after a pause that grows."""
        if self.alive or self._stopping.is_set() or not self._started:
            return
        now_s = time.monotonic()
        if not self._buried:
            self._buried = True
            self._again_s = now_s + self._longer_pause()
            self.deaths += 1
            self._fail(self._death or RuntimeError('its thread ended'), DIED)
        if now_s >= self._again_s:
            self._launch()

    def _launch(self) -> None:
        self._death, self._buried = None, False
        self._round_s = time.monotonic()
        thread = threading.Thread(target=self._run, name=self.name, daemon=True)
        try:
            thread.start()
        except (RuntimeError, MemoryError) as error:  # the system gives no thread now
            self._death = error
        else:
            self._thread = thread

    def _run(self) -> None:
        try:
            with suppress(OSError):  # another system than Linux, or no /proc
                SYSTEM_NAME.write_text(self.name, encoding='utf-8')  # of which it takes 15 bytes
            self._go_round()
        except BaseException as error:  # noqa: BLE001 - told by ``look``: here there may be no memory left to say anything
            self._death = error

    def _go_round(self) -> None:
        while not self._stopping.is_set():
            self._round_s = time.monotonic()
            try:
                self._step()
            except BaseException as error:  # noqa: BLE001 - the one supervised catch-all; the step accounts for what it holds
                self._fail(error, 'failed')
                self._stopping.wait(self._longer_pause())
            else:
                if self.failing:
                    self._recover()

    def _recover(self) -> None:
        if self._told is None:
            log.info('%s works again after %d failures', self.name, self.failures - self._failed_before)
        self.failing, self._pause_s, self._failed_before = False, 0.0, self.failures

    def _longer_pause(self) -> float:
        self._pause_s = min(2 * self._pause_s or FIRST_PAUSE_S, self._longest_pause_s)
        return self._pause_s

    def _fail(self, error: BaseException, what: str) -> None:
        """Count it; say it when it begins and when it becomes another one, with a traceback where it is a defect of ours."""
        self.failures += 1
        was_failing, self.failing = self.failing, True
        text = f'{type(error).__name__}: {error}'
        known = was_failing and text == self.last_error
        self.last_error = text
        if self._told is not None and what != DIED:
            place = f'{type(error).__name__} {_line(error)}'
            known = place in self._told
            self._told.add(place)
        if not known:
            defect = None if isinstance(error, DataLoggerError) else error
            text = '%s %s (%d times so far) and tries again: %s'
            log.error(text, self.name, what, self.failures, error, exc_info=defect)


def _line(error: BaseException) -> int:
    """Where it was raised."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return trace.tb_lineno if trace is not None else 0
