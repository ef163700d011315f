"""Which objects were deleted from the store on purpose (``lake prune``): their rows are not counted any more.

A row of the table ``forgotten`` supersedes that of the same object in the table ``objects``.
"""

from __future__ import annotations

import pyarrow as pa

from shadowhound_data_logger.core.clock import utc
from shadowhound_data_logger.formats.rows.schema import FORGOTTEN
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.views import rows_of


def forgotten(source: Bucket, robot: str | None, findings: Findings) -> pa.Table:
    """What was deleted, with the columns of ``formats.rows.schema.FORGOTTEN``, by time; no object twice. Raises StoreError."""
    rows = rows_of(source, FORGOTTEN, findings, robot=robot, order='t_start_ns, forgotten_ns')
    first: dict[tuple[str, str], int] = {}
    for number, name in enumerate(zip(rows['bucket'].to_pylist(), rows['key'].to_pylist(), strict=True)):
        first.setdefault(name, number)
    return rows.take(pa.array(first.values(), pa.int64()))


def dates_of_deletion(rows: pa.Table) -> dict[tuple[str, str], str]:
    """(bucket, key) -> the UTC date on which it was deleted."""
    names = zip(rows['bucket'].to_pylist(), rows['key'].to_pylist(), strict=True)
    return dict(zip(names, (f'{utc(stamp_ns):%Y-%m-%d}' for stamp_ns in rows['forgotten_ns'].to_pylist()), strict=True))
