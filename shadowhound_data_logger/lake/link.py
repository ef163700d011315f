"""A robot's upload speed and position over time, from the samples that it stores while it keeps data (``_wifi``)."""

from __future__ import annotations

import math
import time
from statistics import median
from typing import Any, Final, NamedTuple

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import ObjectRefused
from shadowhound_data_logger.core.untrusted import from_json
from shadowhound_data_logger.formats.rows.catalog import OBJECTS
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.select import Wanted
from shadowhound_data_logger.lake.tables import literal
from shadowhound_data_logger.lake.views import rows_of

LINK: Final = '_wifi'
MAX_LINK_BYTES: Final = 1 << 20
RECENT_NS: Final = 7 * 24 * 3600 * SECOND
RECENT_OBJECTS: Final = 3
MAX_MBPS: Final = 1e6


class LinkSample(NamedTuple):
    """Five seconds of uploading."""

    stamp_ns: int
    x: float | None
    y: float | None
    """Meters in the odometry frame."""
    mbps: float
    """Megabits per second; 0 if the store was unreachable."""


def samples(source: Bucket, robot: str, since_ns: int, until_ns: int, findings: Findings,
            newest: int | None = None) -> list[LinkSample]:  # fmt: skip
    """The samples of a robot from ``since_ns`` until before ``until_ns``; with ``newest``, only of so many newest objects.

    Raises StoreError.
    """
    wanted = Wanted(since_ns=since_ns, until_ns=until_ns)
    where = f'sensor = {literal(LINK)} AND t_start_ns >= {since_ns} AND t_start_ns < {until_ns}'
    rows = rows_of(source, OBJECTS, findings, robot=robot, has_date=wanted.has_date, where=where, columns=('key',),
                   order='t_start_ns').to_pylist()  # fmt: skip
    found: list[LinkSample] = []
    for row in rows if newest is None else rows[-newest:]:
        try:
            document = from_json(source.get(row['key'], MAX_LINK_BYTES), MAX_LINK_BYTES)
            found += [sample for one in document['samples'] if (sample := _sample(one)) is not None]
        except (ObjectRefused, ValueError, TypeError, LookupError) as error:
            findings.add(row['key'], f'it has no valid samples of the link ({error})')
    return found


def pace_mbps(source: Bucket, robot: str, findings: Findings) -> float | None:
    """The median of a robot's recent upload speed in megabits per second; None if it is unknown for a week. Raises StoreError."""
    now_ns = time.time_ns()
    found = [one.mbps for one in samples(source, robot, now_ns - RECENT_NS, now_ns, findings, RECENT_OBJECTS) if one.mbps > 0]
    return median(found) if found else None


def _sample(one: Any) -> LinkSample | None:
    """None for an invalid sample."""
    if not isinstance(one, dict) or type(one.get('stamp_ns')) is not int:
        return None
    x, y, mbps = (_number(one.get(name)) for name in ('x', 'y', 'mbps'))
    if mbps is None or not 0 <= mbps < MAX_MBPS:
        return None
    return LinkSample(one['stamp_ns'], x, y, mbps)


def _number(value: Any) -> float | None:
    return float(value) if type(value) in {int, float} and abs(value) < 1e12 and math.isfinite(value) else None
