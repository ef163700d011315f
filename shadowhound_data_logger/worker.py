"""Supervised threads: a loop that fails is seen, counted and started again; it never ends silently (D14)."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Final

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
        while not self._stopping.is_set():
            try:
                self._step()
            except Exception as error:  # the one supervised catch-all: what is in hand is accounted for by the step
                self.failures += 1
                self.failing = True
                self.last_error = f'{type(error).__name__}: {error}'
                log.exception('%s failed (%d times so far), again in %.1f s', self.name, self.failures, pause_s)
                self._stopping.wait(pause_s)
                pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
            else:
                if self.failing:
                    log.info('%s works again', self.name)
                self.failing = False
                pause_s = FIRST_PAUSE_S
