"""How much a spool holds, and how long its oldest object has waited."""

from __future__ import annotations

import os
from pathlib import Path

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.core.status import SpoolStatus
from shadowhound_data_logger.spool.index import Index


def usage_of(index: Index, folder: Path, now_ns: int) -> SpoolStatus:
    """Read it from an open index. Raises OSError or sqlite3.Error."""
    tally, oldest_ns = index.overview.tally(), index.objects.oldest_pending_ns()
    count = {state: sum(row[2] for row in tally if row[1] == state.value) for state in State}
    unknown = oldest_ns is not None and oldest_ns < EARLIEST_SANE_NS <= now_ns  # spooled before the clock was set
    age_s = None if oldest_ns is None or unknown else max(0.0, round((now_ns - oldest_ns) / SECOND, 1))
    disk = os.statvfs(folder)
    return SpoolStatus(
        path=str(folder),
        pending=count[State.PENDING],
        held=count[State.HELD],
        quarantined=count[State.QUARANTINED],
        bytes=index.objects.payload_bytes(),
        free_bytes=disk.f_bavail * disk.f_frsize,
        oldest_age_s=age_s,
        kept=count[State.KEPT],
        kept_bytes=sum(row[3] for row in tally if row[1] == State.KEPT.value),
    )
