"""The node, which also writes one line per second about its memory. For ``backlog_memory.py``.

Its first argument is the file for the lines, one JSON object each, in bytes: what glibc has from the system and how much of it
is in use (mallinfo2(3); nothing with another C library), and the content of the queues between its threads.
"""

from __future__ import annotations

import ctypes
import json
import sys
import threading
import time
from pathlib import Path

from shadowhound_data_logger.node.pipeline import Pipeline
from shadowhound_data_logger.node.sensor_logger_node import main

MALLINFO = ('arena', 'ordblks', 'smblks', 'hblks', 'hblkhd', 'usmblks', 'fsmblks', 'uordblks', 'fordblks', 'keepcost')
HEAPS = {'arena': 'heaps', 'hblkhd': 'mapped', 'uordblks': 'heaps_used', 'fordblks': 'heaps_free'}


class Mallinfo(ctypes.Structure):
    """``struct mallinfo2`` of malloc.h."""

    _fields_ = [(name, ctypes.c_size_t) for name in MALLINFO]


def sample(pipeline: Pipeline, path: Path) -> None:
    ask = getattr(ctypes.CDLL(None), 'mallinfo2', None)
    if ask is not None:
        ask.restype = Mallinfo
    with path.open('w', encoding='utf-8') as file:
        while True:
            found = ask() if ask is not None else None
            heaps = {name: getattr(found, field) for field, name in HEAPS.items()} if found is not None else {}
            stages = pipeline._stages
            waiting = {
                'to_encode': stages.queue.status().bytes, 'to_commit': stages.writer._bytes,
                'to_record': stages.recorder.status().queue_bytes, 'ring': stages.event_buffer.events.status().bytes,
            }  # fmt: skip
            file.write(json.dumps({**heaps, **waiting}) + '\n')
            file.flush()
            time.sleep(1.0)


_open = Pipeline.open


def sampled_open(pipeline: Pipeline) -> None:
    _open(pipeline)
    threading.Thread(target=sample, args=(pipeline, path), daemon=True).start()


if __name__ == '__main__':
    path = Path(sys.argv.pop(1))
    setattr(Pipeline, 'open', sampled_open)  # noqa: B010 - a plain assignment is no method to mypy
    sys.exit(main())
