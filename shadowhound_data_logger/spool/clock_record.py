"""What a robot's nodes recorded about its clock, in ``spool/clock-<robot>.json``: its steps, and the offsets of the last boots.

It is best effort: without the file the steps start at 0 again, and objects that an earlier boot left are shipped without a date.
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
"""An offset is recorded again once it has changed by this much."""


@dataclass(frozen=True, slots=True)
class KnownClock:
    """What is known about a robot's wall clock."""

    is_set: bool | None = None
    """None if no node has checked yet."""
    steps: int = 0
    last_step_s: float | None = None
    last_step_time: str | None = None
    offsets: Mapping[str, int] = field(default_factory=dict)
    """UTC minus the boot clock in ns, by boot id, for boots whose clock was set."""


def file(spool: Path, robot: str) -> Path:
    """The file of a robot's node."""
    return spool / f'clock-{robot}.json'


def read(spool: Path, robot: str) -> KnownClock:
    """The content of the file; all defaults if it is missing or damaged."""
    try:
        return parse(KnownClock, json.loads(file(spool, robot).read_bytes()))
    except (OSError, ValueError, RecursionError):
        return KnownClock()


class ClockRecord:
    """Records the clock's steps and offsets in a file.

    Lifecycle: new when the spool is open; used by one thread. A failed write is logged and has no other effect.
    """

    def __init__(self, spool: Path, robot: str) -> None:
        self._path = file(spool, robot)
        self._known = read(spool, robot)

    @property
    def steps(self) -> int:
        return self._known.steps

    def offsets(self) -> Mapping[str, int]:
        """UTC minus the boot clock in ns, by boot id; boots whose clock was never set are missing."""
        return self._known.offsets

    def knows(self, boot_id: str, offset_ns: int | None) -> bool:
        """Whether the offset is recorded, within ``SLEWED_NS``."""
        if offset_ns is None:
            return self._known.is_set is False
        return self._known.is_set is True and abs(offset_ns - self._known.offsets.get(boot_id, 0)) < SLEWED_NS

    def note(self, watch: ClockWatch) -> None:
        """Record the current state of the clock."""
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
            log.warning('cannot record the state of the clock: %s', error)
