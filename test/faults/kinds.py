"""Possible faults between a logger and its store, and bad days generated from a seed."""

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
    """The fault of one request."""

    NONE = 'none'
    REFUSED = 'refused'
    """The connection is refused, and so are all others for a while."""
    RESET = 'reset'
    """The connection is reset in the middle of the request's body."""
    HUNG = 'hung'
    """The connection is accepted, without any response."""
    SLOW = 'slow'
    """1 KB/s: the object may reach the server long after the client gave up."""
    ERROR_500 = '500'
    SLOW_DOWN = '503'
    DENIED = '403'
    SKEWED = 'skewed'
    """The clocks differ by twenty minutes."""
    PORTAL = 'portal'
    """A login page responds with 200 in place of the server."""
    CUT = 'cut'
    """The server handled the request; its response is truncated."""
    ACK_LOST = 'ack lost'
    """The server handled the request; there is no response."""
    NO_CONDITION = '501'
    """The server does not support If-None-Match."""


class Condition(str, Enum):
    """How the server handles If-None-Match while this is set."""

    HONOURED = 'honoured'
    NOT_IMPLEMENTED = 'not implemented'
    OVERWRITES = 'overwrites'
    """It ignores the condition and accepts everything."""


FAULTS: Final = tuple(fault for fault in Fault if fault is not Fault.NONE)
STORING: Final = frozenset({Fault.NONE, Fault.SLOW, Fault.CUT, Fault.ACK_LOST})
"""The object may be in the store anyway."""
LONGEST_RUN: Final = 8


class Script:
    """The faults of a sequence of requests, in order of arrival; then none. Thread-safe.

    Runs of one fault alternate with calm and with rough periods, in which each request may have a different fault.
    """

    def __init__(self, faults: Sequence[Fault] = ()) -> None:
        self.counts: Counter[Fault] = Counter()
        self._faults = iter(faults)
        self._lock = threading.Lock()
        self._over = not faults

    @classmethod
    def of(cls, rng: random.Random, runs: int, kinds: Sequence[Fault] = FAULTS) -> Script:
        """A random one with this many runs."""
        return cls([fault for _ in range(runs) for fault in _run(rng, kinds)])

    def __call__(self) -> Fault:
        """The fault of the next request."""
        with self._lock:
            fault = next(self._faults, None)
            self._over = fault is None
            found = fault or Fault.NONE
            self.counts[found] += 1
            return found

    def end(self) -> None:
        """End all faults."""
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
    """The requested seed, otherwise a new one."""
    return int(os.environ.get(SEED) or secrets.randbelow(1_000_000_000))


def is_long() -> bool:
    return bool(os.environ.get(LONG))
