"""Supervised threads: a failing loop is detected, counted and restarted; it never ends silently.

Any exception in a round, SystemExit included, costs that round and a pause. If the thread itself ends anyway (out of memory for
its own bookkeeping, say), its supervisor detects that in ``poll`` and starts another one.
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
"""Where Linux keeps the name of the calling thread (proc(5)), as shown by ``top -H``; CPython sets it only since 3.14."""


class Worker:
    """Calls ``step`` on a separate daemon thread until it is stopped.

    ``step`` does one round and returns; it may block for as long as closing may wait, and must account for what it holds
    however it ends. Lifecycle: New; start once; ``poll`` a few times per second, from one thread; stop once.
    """

    def __init__(self, name: str, step: Callable[[], None], *, patience_s: float | None = None,
                 reported: set[str] | None = None, longest_pause_s: float = LONGEST_PAUSE_S) -> None:  # fmt: skip
        """Workers that share ``reported`` log each failure only once, by its place in the code, and no recovery.

        ``longest_pause_s`` is the maximum pause between two tries.
        """
        self.name = name
        self.failures = 0
        self.deaths = 0
        self.last_error = ''
        self.failing = False
        self._step = step
        self._patience_s = patience_s
        self._reported = reported
        self._longest_pause_s = longest_pause_s
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._started = False
        self._death: BaseException | None = None
        self._end_counted = False  # whether the end of the thread has been counted
        self._restart_at_s = 0.0
        self._pause_s = 0.0
        self._failed_before = 0
        self._round_s = 0.0

    def start(self) -> None:
        self._launch()
        self._started = True  # only now: a concurrent poll would take the thread for one that has ended

    def stop(self) -> None:
        """Stop after the current round; does not wait."""
        self._stopping.set()

    def join(self, timeout_s: float) -> bool:
        """Whether the thread ended before the timeout."""
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

    def poll(self) -> None:
        """Count the end of the thread, if it ended, and start another one after a growing pause."""
        if self.alive or self._stopping.is_set() or not self._started:
            return
        now_s = time.monotonic()
        if not self._end_counted:
            self._end_counted = True
            self._restart_at_s = now_s + self._next_pause()
            self.deaths += 1
            self._fail(self._death or RuntimeError('its thread ended'), DIED)
        if now_s >= self._restart_at_s:
            self._launch()

    def _launch(self) -> None:
        self._death, self._end_counted = None, False
        self._round_s = time.monotonic()
        thread = threading.Thread(target=self._run, name=self.name, daemon=True)
        try:
            thread.start()
        except (RuntimeError, MemoryError) as error:  # the system cannot start a thread now
            self._death = error
        else:
            self._thread = thread

    def _run(self) -> None:
        try:
            with suppress(OSError):  # not Linux, or no /proc
                SYSTEM_NAME.write_text(self.name, encoding='utf-8')  # it keeps 15 bytes
            self._run_rounds()
        except BaseException as error:  # noqa: BLE001 - logged by ``poll``: there may be no memory left here
            self._death = error

    def _run_rounds(self) -> None:
        while not self._stopping.is_set():
            self._round_s = time.monotonic()
            try:
                self._step()
            except BaseException as error:  # noqa: BLE001 - the one supervised catch-all; the step accounts for what it holds
                self._fail(error, 'failed')
                self._stopping.wait(self._next_pause())
            else:
                if self.failing:
                    self._recover()

    def _recover(self) -> None:
        if self._reported is None:
            log.info('%s works again after %d failures', self.name, self.failures - self._failed_before)
        self.failing, self._pause_s, self._failed_before = False, 0.0, self.failures

    def _next_pause(self) -> float:
        self._pause_s = min(2 * self._pause_s or FIRST_PAUSE_S, self._longest_pause_s)
        return self._pause_s

    def _fail(self, error: BaseException, what: str) -> None:
        """Count the failure; log it when it starts and when it changes, with a traceback if it is a bug in this package."""
        self.failures += 1
        was_failing, self.failing = self.failing, True
        text = f'{type(error).__name__}: {error}'
        known = was_failing and text == self.last_error
        self.last_error = text
        if self._reported is not None and what != DIED:
            place = f'{type(error).__name__} {_line(error)}'
            known = place in self._reported
            self._reported.add(place)
        if not known:
            defect = None if isinstance(error, DataLoggerError) else error
            text = '%s %s (%d times so far) and tries again: %s'
            log.error(text, self.name, what, self.failures, error, exc_info=defect)


def _line(error: BaseException) -> int:
    """The line that raised it."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return trace.tb_lineno if trace is not None else 0
