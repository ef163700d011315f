"""Supervised threads: a loop that fails is seen, counted and started again; it never ends silently (D14)."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Final

from shadowhound_data_logger.errors import DataLoggerError

log = logging.getLogger(__name__)

FIRST_PAUSE_S: Final = 0.1
LONGEST_PAUSE_S: Final = 5.0


class Worker:
    """One owned daemon thread that calls ``step`` until it is stopped.

    ``step`` does one round and returns; it may block for as long as closing may wait. Life: New; start once; stop once.
    """

    def __init__(self, name: str, step: Callable[[], None]) -> None:
        self.name = name
        self.failures = 0
        self.last_error = ''
        self.failing = False
        """Whether the last round failed."""
        self._step = step
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        self._thread = threading.Thread(target=self._run, name=self.name, daemon=True)
        self._thread.start()

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

    def _run(self) -> None:
        pause_s = FIRST_PAUSE_S
        since = 0
        while not self._stopping.is_set():
            try:
                self._step()
            except Exception as error:  # noqa: BLE001 - the one supervised catch-all (D14); the step accounts for what it holds
                self._fail(error)
                self._stopping.wait(pause_s)
                pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
            else:
                if self.failing:
                    log.info('%s works again after %d failures', self.name, self.failures - since)
                self.failing = False
                pause_s, since = FIRST_PAUSE_S, self.failures

    def _fail(self, error: Exception) -> None:
        """Count it; say it when it begins and when it becomes another one, with a traceback where it is a defect of ours."""
        text = f'{type(error).__name__}: {error}'
        known = self.failing and text == self.last_error
        self.failures += 1
        self.failing, self.last_error = True, text
        if not known:
            defect = None if isinstance(error, DataLoggerError) else error
            log.error('%s failed (%d times so far) and tries again: %s', self.name, self.failures, error, exc_info=defect)
