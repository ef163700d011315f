"""When to repeat a failed request: how long to wait, and how often."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from typing import Final, TypeVar

from shadowhound_data_logger.core.errors import DataLoggerError, StoreUnavailable, StoreUntrusted

BASE_S: Final = 0.5
"""Maximum pause before the second try; it doubles with each further one."""
TRIES: Final = 4
"""For a request that a caller waits for: a store that stays unreachable is reported within seconds."""
CAP_S: Final = 5.0

_Answer = TypeVar('_Answer')
_rng: Final = random.Random()


def backoff(attempt: int, cap_s: float, rng: random.Random) -> float:
    """Seconds before the next try after ``attempt`` failures (1, 2, ...): exponential, with full jitter.

    https://aws.amazon.com/blogs/architecture/exponential-backoff-and-jitter/
    """
    return rng.uniform(0.0, min(cap_s, BASE_S * 2.0 ** min(attempt - 1, 32)))


def with_retries(call: Callable[[], _Answer], *, tries: float | None = None, until_s: float = float('inf'), cap_s: float = CAP_S,
             pause: Callable[[float], object] = time.sleep, unavailable: type[DataLoggerError] = StoreUnavailable,
             on_failure: Callable[[DataLoggerError], object] = lambda _: None) -> _Answer:  # fmt: skip
    """Repeat a request while the server is temporarily unavailable, up to ``tries`` (``TRIES``) times. Raises the last error.

    No try starts after ``until_s`` of the monotonic clock. ``unavailable`` is the error that is retried; ``on_failure`` is called
    before each further try.
    """
    failures, max_tries = 0, TRIES if tries is None else tries
    while True:
        try:
            return call()
        except StoreUntrusted:  # retrying does not help until the operator acts
            raise
        except unavailable as error:
            failures += 1
            pause_s = backoff(failures, cap_s, _rng)
            if failures >= max_tries or time.monotonic() + pause_s >= until_s:
                raise
            on_failure(error)
            pause(pause_s)
