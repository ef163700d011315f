"""The node, which also records how long each round of its intake took, and the content of the ring. For ``event_ring.py``.

A round starts when it is due, so that one whose thread had to wait for the CPU is longer. When it exits it prints
``{"rounds": [[began, seconds], ...], "writing": [[began, ended], ...]}``, monotonic clock.
"""

from __future__ import annotations

import json
import sys
import time

from shadowhound_data_logger.bags.events import Events
from shadowhound_data_logger.node.intake.intake import Intake
from shadowhound_data_logger.node.sensor_logger_node import main

rounds: list[tuple[float, float]] = []
writing: list[tuple[float, float]] = []
_step, _write = Intake._step, Events._write


def timed_step(intake: Intake) -> None:
    due_s = max(time.monotonic(), intake._next_poll_s)
    _step(intake)
    rounds.append((due_s, time.monotonic() - due_s))


def timed_write(events: Events, event: object) -> None:
    began_s = time.monotonic()
    _write(events, event)  # type: ignore[arg-type]
    writing.append((began_s, time.monotonic()))


if __name__ == '__main__':
    setattr(Intake, '_step', timed_step)  # noqa: B010 - a plain assignment is not a method to mypy
    setattr(Events, '_write', timed_write)  # noqa: B010
    code = main()
    print(json.dumps({'rounds': rounds, 'writing': writing}), flush=True)
    sys.exit(code)
