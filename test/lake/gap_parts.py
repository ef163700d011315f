"""Statements of the gap journal of a robot ``thor``, in seconds after ``NOON_NS``, and files with them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import pyarrow as pa
from lake.making import NOON_NS, add

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows import parts
from shadowhound_data_logger.formats.rows.gaps import GAP, GAPS, Statement, complete, date_of, statement
from shadowhound_data_logger.lake.gaps import _NEWEST
from shadowhound_data_logger.lake.tables import answer, engine, narrow
from shadowhound_data_logger.stores import open_store

IMU = {'sink': 'objects', 'topic': '/imu', 'session': 1, 'grade': 'exact'}


def lost(name: str, first_s: float, last_s: float, revision: int = 1, what: str = GAP, **columns: Any) -> Statement:
    """A gap at this many seconds after noon."""
    columns = {'kind': 'missed', 'cause': 'transport', 'count': 5, 'merged': 1, 'publisher': 'imu', **IMU, **columns}
    times = {'from_ns': NOON_NS + int(first_s * SECOND), 'to_ns': NOON_NS + int(last_s * SECOND)}
    return statement('thor', what, f'j/{name}', revision, **columns, **times)


def mark(last_s: float, revision: int = 1, first_s: float = 0.0, **columns: Any) -> Statement:
    """A watermark that covers from one second after noon to another."""
    columns = {**IMU, 'received': int(last_s * 50), 'skipped': 0, **columns}
    return complete(
        'thor', 'j', revision, from_ns=NOON_NS + int(first_s * SECOND), to_ns=NOON_NS + int(last_s * SECOND), **columns
    )


def tell(store: StoreSettings, folder: Path, *rows: Statement, name: str = 'a') -> None:
    """Parts with these statements, as a robot delivers them."""
    with closing(open_store(store, UploadSettings())) as target:
        for date in sorted({date_of(row) for row in rows}):
            found = [row for row in rows if date_of(row) == date]
            add(target, folder / 'tmp', GAPS.part_key('thor', date, name), parts.encode(found, GAPS), {'robot': 'thor'})


def counting(rows: Sequence[Statement]) -> list[Statement]:
    """The statements that count, as the lake selects them."""
    with engine({'all_gaps': pa.Table.from_pylist(list(rows), schema=narrow(GAPS.columns, GAPS))}) as ready:
        return list(answer(ready, _NEWEST.format('true')).to_pylist())
