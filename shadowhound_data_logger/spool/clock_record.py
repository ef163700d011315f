"""What is known of the clock beyond one process: ``spool/clock-<robot>.json``, with steps and the offsets of the last boots.

It is not a promise: without the file the steps begin at 0 again, and what an earlier boot left goes without a date.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.clock import iso
from shadowhound_data_logger.core.clock_watch import ClockWatch
from shadowhound_data_logger.core.durable_files import replacing

log = logging.getLogger(__name__)

BOOTS: Final = 8
SLEWED_NS: Final = 100_000_000
"""An offset is noted again once it has moved so far."""


def file(spool: Path, robot: str) -> Path:
    """Where the node of a robot keeps it."""
    return spool / f'clock-{robot}.json'


def read(spool: Path, robot: str) -> dict[str, Any]:
    """``is_set`` (None: no node has looked yet), ``steps``, ``last_step_s``, ``last_step_time``, ``offsets`` by boot id."""
    try:
        given = json.loads(file(spool, robot).read_bytes())
        offsets = {str(boot): int(offset) for boot, offset in given['offsets'].items()}
        return {'is_set': bool(given['is_set']), 'steps': int(given['steps']), 'last_step_s': given['last_step_s'],
                'last_step_time': given['last_step_time'], 'offsets': offsets}  # fmt: skip
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return {'is_set': None, 'steps': 0, 'last_step_s': None, 'last_step_time': None, 'offsets': {}}


class ClockRecord:
    """Keeps the clock's steps and offsets in a file.

    New when the spool is open; one thread. A failed write is logged, and has no other effect.
    """

    def __init__(self, spool: Path, robot: str) -> None:
        self._path = file(spool, robot)
        self._said = read(spool, robot)
        self._offsets: dict[str, int] = self._said['offsets']

    @property
    def steps(self) -> int:
        return int(self._said['steps'])

    def offsets(self) -> Mapping[str, int]:
        """UTC less boot clock by boot id, of the boots whose clock was set; the others are missing."""
        return dict(self._offsets)

    def knows(self, boot_id: str, offset_ns: int | None) -> bool:
        """Whether there is nothing new in this offset."""
        if offset_ns is None:
            return self._said['is_set'] is False
        return self._said['is_set'] is True and abs(offset_ns - self._offsets.get(boot_id, 0)) < SLEWED_NS

    def note(self, watch: ClockWatch) -> None:
        """Keep what is known now."""
        state, offset_ns = watch.state(), watch.offset_ns()
        if offset_ns is not None:
            self._offsets.pop(watch.boot_id, None)
            self._offsets[watch.boot_id] = offset_ns
        while len(self._offsets) > BOOTS:
            del self._offsets[next(iter(self._offsets))]
        if state.steps != self._said['steps']:
            self._said |= {'last_step_s': state.last_step_s, 'last_step_time': iso(watch.wall_ns())}
        self._said |= {'is_set': state.is_set, 'steps': state.steps, 'offsets': self._offsets}
        try:
            with replacing(self._path, mode=0o600) as file:
                file.write(json.dumps(self._said).encode())
        except OSError as error:
            log.warning('what is known of the clock cannot be kept: %s', error)
