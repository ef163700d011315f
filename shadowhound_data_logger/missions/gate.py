"""One receiver's outage, as the sender of missions waits for its end: when to try it again."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Final

from shadowhound_data_logger.stores.retry import backoff

LONGEST_PAUSE_S: Final = 60.0


class Gate:
    """Open while the receiver is to be tried; each failure closes it for longer (exponential, full jitter, up to a minute)."""

    def __init__(self, monotonic: Callable[[], float], rng: random.Random) -> None:
        self._monotonic = monotonic
        self._rng = rng
        self._failures = 0
        self._next_s = float('-inf')
        self.error: Exception | None = None

    @property
    def is_open(self) -> bool:
        return self._monotonic() >= self._next_s

    def failed(self, error: Exception) -> None:
        self._failures += 1
        self.error = error
        self._next_s = self._monotonic() + backoff(self._failures, LONGEST_PAUSE_S, self._rng)

    def worked(self) -> None:
        self._failures, self.error, self._next_s = 0, None, float('-inf')

    def hurry(self) -> None:
        """Try at once: somebody waits for it."""
        self._next_s = float('-inf')
