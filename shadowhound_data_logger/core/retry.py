"""When a failed request is repeated: how long to wait, and how often."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from typing import Final, TypeVar

from shadowhound_data_logger.core.errors import DataLoggerError, StoreUnavailable, StoreUntrusted

BASE_S: Final = 0.5
"""The longest pause before the second try; it doubles with each further one."""
TRIES: Final = 4
"""Of a request that somebody waits for: a store that is away for good is told within seconds."""
CAP_S: Final = 5.0

_Answer = TypeVar('_Answer')
_rng: Final = random.Random()


def backoff(attempt: int, cap_s: float, rng: random.Random) -> float:
    """Seconds before the next try after ``attempt`` failures (1, 2, ...): exponential, with full jitter.

    https://aws.amazon.com/blogs/architecture/exponential-backoff-and-jitter/
    """
    return rng.uniform(0.0, min(cap_s, BASE_S * 2.0 ** min(attempt - 1, 32)))


def steadily(ask: Callable[[], _Answer], *, tries: float | None = None, until_s: float = float('inf'), cap_s: float = CAP_S,
             pause: Callable[[float], object] = time.sleep, away: type[DataLoggerError] = StoreUnavailable,
             failed: Callable[[DataLoggerError], object] = lambda _: None) -> _Answer:  # fmt: skip
    """The answer, after some tries (``TRIES``) where the store is away in passing. Raises what the last one raised.

    No try begins after ``until_s`` of the monotonic clock. ``away`` is what another server's absence raises; ``failed`` is called
    before each further try.
    """
    failures, most = 0, TRIES if tries is None else tries
    while True:
        try:
            return ask()
        except StoreUntrusted:  # somebody has to do something first
            raise
        except away as error:
            failures += 1
            pause_s = backoff(failures, cap_s, _rng)
            if failures >= most or time.monotonic() + pause_s >= until_s:
                raise
            failed(error)
            pause(pause_s)
