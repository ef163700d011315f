"""What can go wrong between a logger and its store, and bad days made of it by a seed."""

from __future__ import annotations

import os
import random
import secrets
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from enum import Enum
from typing import Final

SEED: Final = 'SHADOWHOUND_SEED'
LONG: Final = 'SHADOWHOUND_TEST_LONG'


class Fault(str, Enum):
    """What becomes of one request."""

    NONE = 'none'
    REFUSED = 'refused'
    """The connection is refused, and so is everything for a while."""
    RESET = 'reset'
    """The connection is reset in the middle of the request's body."""
    HUNG = 'hung'
    """The connection is accepted, and nothing is ever answered."""
    SLOW = 'slow'
    """1 KB/s: the object may reach the server long after the client gave up."""
    ERROR_500 = '500'
    SLOW_DOWN = '503'
    DENIED = '403'
    SKEWED = 'skewed'
    """The clocks differ by twenty minutes."""
    PORTAL = 'portal'
    """A login page answers 200 in the server's place."""
    CUT = 'cut'
    """The server did what it was asked; its answer breaks off."""
    ACK_LOST = 'ack lost'
    """The server did what it was asked; there is no answer."""
    NO_CONDITION = '501'
    """The server does not know If-None-Match."""


class Condition(str, Enum):
    """What the server does with If-None-Match for as long as it stands."""

    HONOURED = 'honoured'
    NOT_IMPLEMENTED = 'not implemented'
    OVERWRITES = 'overwrites'
    """It ignores the condition and takes everything."""


FAULTS: Final = tuple(fault for fault in Fault if fault is not Fault.NONE)
STORING: Final = frozenset({Fault.NONE, Fault.SLOW, Fault.CUT, Fault.ACK_LOST})
"""The object may be in the store all the same."""
LONGEST_RUN: Final = 8


class Script:
    """The faults of a run of requests, in the order in which they arrive; then none. Thread-safe.

    Runs of one fault alternate with calm and with rough weather, in which each request may meet another fault.
    """

    def __init__(self, faults: Sequence[Fault] = ()) -> None:
        self.counts: Counter[Fault] = Counter()
        self._faults = iter(faults)
        self._lock = threading.Lock()
        self._over = not faults

    @classmethod
    def of(cls, rng: random.Random, runs: int, kinds: Sequence[Fault] = FAULTS) -> Script:
        """A random one of so many runs."""
        return cls([fault for _ in range(runs) for fault in _run(rng, kinds)])

    def __call__(self) -> Fault:
        """What becomes of the next request."""
        with self._lock:
            fault = next(self._faults, None)
            self._over = fault is None
            found = fault or Fault.NONE
            self.counts[found] += 1
            return found

    def end(self) -> None:
        """No fault any more."""
        with self._lock:
            self._faults = iter(())
            self._over = True

    @property
    def is_over(self) -> bool:
        return self._over


def _run(rng: random.Random, kinds: Sequence[Fault]) -> Iterator[Fault]:
    length, weather = rng.randint(1, LONGEST_RUN), rng.random()
    if weather < 0.25:
        yield from (Fault.NONE,) * length
    elif weather < 0.65:
        yield from (rng.choice(kinds),) * length
    else:
        yield from rng.choices((Fault.NONE, *kinds), k=length)


def given_seed() -> int:
    """The seed that was asked for, else a new one."""
    return int(os.environ.get(SEED) or secrets.randbelow(1_000_000_000))


def is_long() -> bool:
    return bool(os.environ.get(LONG))
