"""How much a spool holds, and how long its oldest object has waited."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.spool.index import Index


@dataclass(frozen=True, slots=True)
class SpoolUsage:
    """What lies in a spool at one instant."""

    pending: int
    held: int
    quarantined: int
    bytes: int
    """Payload on disk, without what is kept."""
    free_bytes: int
    """Left on the file system."""
    oldest_age_s: float | None
    """How long the oldest pending object has waited; None when none waits, or it was spooled before the clock was set."""
    kept: int = 0
    """Objects that stay here until somebody asks for them."""
    kept_bytes: int = 0


def usage_of(index: Index, folder: Path, now_ns: int) -> SpoolUsage:
    """Read it from an open index. Raises OSError or sqlite3.Error."""
    tally, oldest_ns = index.overview.tally(), index.objects.oldest_pending_ns()
    count = {state: sum(row[2] for row in tally if row[1] == state.value) for state in State}
    unknown = oldest_ns is not None and oldest_ns < EARLIEST_SANE_NS <= now_ns  # spooled before the clock was set
    age_s = None if oldest_ns is None or unknown else max(0.0, round((now_ns - oldest_ns) / SECOND, 1))
    disk = os.statvfs(folder)
    return SpoolUsage(count[State.PENDING], count[State.HELD], count[State.QUARANTINED], index.objects.payload_bytes(),
                 disk.f_bavail * disk.f_frsize, age_s, count[State.KEPT],
                 sum(row[3] for row in tally if row[1] == State.KEPT.value))  # fmt: skip
