"""Gives the node a different wall clock: copied as sitecustomize.py to a folder on Python's path.

While a file WRONG_CLOCK exists the clock is behind by the number of nanoseconds in it, and so are the times at which messages
were sent, by a driver on the same machine, and received.
"""

import os
import time
from pathlib import Path
from typing import Any

from shadowhound_data_logger.core import model
from shadowhound_data_logger.core.clock import SystemClock

behind = Path(os.environ['WRONG_CLOCK'])
Taken = model.Taken


def behind_ns() -> int:
    try:
        return int(behind.read_text())
    except FileNotFoundError:
        return 0


def taken_behind(cdr: bytes, source_ns: int, publisher: str | None, number: int | None, received_ns: int, *dated: Any) -> Taken:
    """The reader's message, or the same one with its date, whose times are shifted already."""
    shift_ns = 0 if dated else behind_ns()
    return Taken(cdr, source_ns - shift_ns, publisher, number, received_ns - shift_ns, *dated)


SystemClock.wall_ns = lambda _: time.time_ns() - behind_ns()  # type: ignore[method-assign]
model.Taken = taken_behind  # type: ignore[misc, assignment]  # the reader, which loads the RMW, is imported later
