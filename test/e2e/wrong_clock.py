"""Gives the node another wall clock: copied as sitecustomize.py to where a Python finds it at its start.

While there is a file WRONG_CLOCK the clock is as many nanoseconds behind as it says, and so are the times at which messages
were sent, by a driver on the same machine, and received.
"""

import os
import time
from collections.abc import Iterator
from pathlib import Path

from shadowhound_data_logger.capture.reader import Reader
from shadowhound_data_logger.clock import SystemClock
from shadowhound_data_logger.model import Taken

behind = Path(os.environ['WRONG_CLOCK'])
drain = Reader.drain


def behind_ns() -> int:
    try:
        return int(behind.read_text())
    except FileNotFoundError:
        return 0


def drain_behind(reader: Reader) -> Iterator[Taken]:
    shift_ns = behind_ns()
    for one in drain(reader):
        yield one._replace(source_ns=one.source_ns - shift_ns, received_ns=one.received_ns - shift_ns)


SystemClock.wall_ns = lambda _: time.time_ns() - behind_ns()  # type: ignore[method-assign]
Reader.drain = drain_behind  # type: ignore[method-assign]
