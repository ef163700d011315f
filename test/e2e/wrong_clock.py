"""Gives the node another wall clock: copied as sitecustomize.py to where a Python finds it at its start.

While there is a file WRONG_CLOCK the clock is as many nanoseconds behind as it says, and so are the publishers' source
timestamps, as those of a driver on the same machine are.
"""

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from shadowhound_data_logger.capture.stream import Stream, Taken
from shadowhound_data_logger.clock import SystemClock

behind = Path(os.environ['WRONG_CLOCK'])
add = Stream.add


def behind_ns() -> int:
    try:
        return int(behind.read_text())
    except FileNotFoundError:
        return 0


def add_behind(stream: Stream, taken: Sequence[Taken], *arguments: Any, **named: Any) -> None:
    shift_ns = behind_ns()
    add(stream, [one._replace(source_ns=one.source_ns - shift_ns) for one in taken], *arguments, **named)


SystemClock.wall_ns = lambda _: time.time_ns() - behind_ns()  # type: ignore[method-assign]
Stream.add = add_behind  # type: ignore[method-assign]
