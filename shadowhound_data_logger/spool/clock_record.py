"""What is known of the clock beyond one process: ``spool/clock-<robot>.json``, with steps and the offsets of the last boots.

It is not a promise: without the file the steps begin at 0 again, and what an earlier boot left goes without a date.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.clock import iso
from shadowhound_data_logger.core.clock_watch import ClockWatch
from shadowhound_data_logger.core.dataclass_json import dumps, parse
from shadowhound_data_logger.core.durable_files import replacing

log = logging.getLogger(__name__)

BOOTS: Final = 8
SLEWED_NS: Final = 100_000_000
"""An offset is noted again once it has moved so far."""


@dataclass(frozen=True, slots=True)
class KnownClock:
    """What is known of the wall clock of a robot."""

    is_set: bool | None = None
    """None if no node has looked yet."""
    steps: int = 0
    last_step_s: float | None = None
    last_step_time: str | None = None
    offsets: Mapping[str, int] = field(default_factory=dict)
    """UTC minus the boot clock, ns, by boot id, of boots whose clock was set."""


def file(spool: Path, robot: str) -> Path:
    """Where the node of a robot keeps it."""
    return spool / f'clock-{robot}.json'


def read(spool: Path, robot: str) -> KnownClock:
    """The content of the file; nothing is known if it is missing or damaged."""
    try:
        return parse(KnownClock, json.loads(file(spool, robot).read_bytes()))
    except (OSError, ValueError, RecursionError):
        return KnownClock()


class ClockRecord:
    """Keeps the clock's steps and offsets in a file.

    New when the spool is open; one thread. A failed write is logged, and has no other effect.
    """

    def __init__(self, spool: Path, robot: str) -> None:
        self._path = file(spool, robot)
        self._known = read(spool, robot)

    @property
    def steps(self) -> int:
        return self._known.steps

    def offsets(self) -> Mapping[str, int]:
        """UTC minus the boot clock by boot id, of the boots whose clock was set; the others are missing."""
        return self._known.offsets

    def knows(self, boot_id: str, offset_ns: int | None) -> bool:
        """Whether there is nothing new in this offset."""
        if offset_ns is None:
            return self._known.is_set is False
        return self._known.is_set is True and abs(offset_ns - self._known.offsets.get(boot_id, 0)) < SLEWED_NS

    def note(self, watch: ClockWatch) -> None:
        """Keep what is known now."""
        state, offset_ns, offsets = watch.state(), watch.offset_ns(), dict(self._known.offsets)
        if offset_ns is not None:
            offsets.pop(watch.boot_id, None)
            offsets[watch.boot_id] = offset_ns
        while len(offsets) > BOOTS:
            del offsets[next(iter(offsets))]
        known = replace(self._known, is_set=state.is_set, steps=state.steps, offsets=offsets)
        if state.steps != self._known.steps:
            known = replace(known, last_step_s=state.last_step_s, last_step_time=iso(watch.wall_ns()))
        self._known = known
        try:
            with replacing(self._path, mode=0o600) as file:
                file.write(dumps(known))
        except OSError as error:
            log.warning('what is known of the clock cannot be kept: %s', error)
