"""``lake compact``: merges the parts of each day that is over into one, sorted in the order in which queries look for rows.

Of the gap journal, only the newest statement about each gap is kept; withdrawals stay, since a part with the gap may come later.

Compaction only adds an object, whose name is derived from its sources. A later run deletes the sources, when nobody reads from an
older listing any more. It may therefore be killed at any moment, and two may run at once (docs/decisions/0014).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from itertools import product
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from shadowhound_data_logger.core.errors import AccessDenied
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.formats.rows.gaps import GAPS
from shadowhound_data_logger.formats.rows.schema import INT32, KEPT, OBJECTS, STRING, TableSchema
from shadowhound_data_logger.formats.rows.statistics import STATISTICS
from shadowhound_data_logger.lake.bucket import THREADS, Bucket, put_part
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.gaps import folded
from shadowhound_data_logger.lake.live_files import (
    SOURCES,
    Day,
    compacted_key,
    dates_of,
    days,
    encode_sources,
    folder_of,
    is_compacted,
    name_of,
    robots,
)
from shadowhound_data_logger.lake.reading import arrow_schema, whole
from shadowhound_data_logger.lake.scan import ROW, superseding, unrepeated
from shadowhound_data_logger.stores.base import ObjectStore

GRACE: Final = timedelta(hours=1)
"""How long superseded parts stay: a reader who listed them before may still read them."""
MOST_S: Final = 1800.0
"""From the listing of a day's parts to the put of its compacted part; half of the grace."""
MOST_DAY_BYTES: Final = 1 << 30
"""A day's rows in memory: those of a robot that stores everything all day take 400 MB."""
GROUP_ROWS: Final = 4096
STATISTICS_ROWS: Final = 16_384
"""A few hours of one field of a batch a second: a day has thirty times as many rows as the catalogue."""
CELL_M: Final = 4.0
"""Rows are sorted by sensor, by squares of this side along a Z-order curve, then by time: rows of one place are read together."""
_CELLS: Final = 1 << 15
_UNIQUE: Final = frozenset({'key', 'sha256', 'id'})
_COUNTS: Final = frozenset({'count', 'nan_count', 'clock_offset_ns', 'merged'})
"""Numbers that repeat. A dictionary of those that do not, such as times, costs a quarter of a file and of the time to read it."""
_BY_FIELD: Final = [(name, 'ascending') for name in ('sensor', 'field', 't_start_ns', 'bucket', 'key')]
_BY_TOPIC: Final = [(name, 'ascending') for name in ('sink', 'topic', 'what', 'from_ns', 'id')]


@dataclass(frozen=True, slots=True)
class Compacted:
    """What compaction did to a day."""

    robot: str
    date: str
    merged: int = 0
    """Parts that became one; 0 where there was nothing to merge."""
    rows: int = 0
    size: int = 0
    deleted: int = 0
    kept: int = 0
    """Superseded parts that have not been deleted yet."""
    denied: bool = False
    """The credentials may not delete: superseded parts take space, with no other effect."""


def compact(  # noqa: PLR0913 - what is handed in
    source: Bucket, store: ObjectStore, *, robot: str | None = None, before: str = '', grace: timedelta | None = GRACE,
    findings: Findings | None = None,
    now: Callable[[], datetime] = lambda: datetime.now(timezone.utc), monotonic: Callable[[], float] = time.monotonic,
) -> Iterator[Compacted]:  # fmt: skip
    """Merge every day before ``before`` (default: today, UTC), and delete parts superseded ``grace`` ago (None: none).

    Yields each day that it changed. A part that cannot be read in full stays as it is; the others are merged.
    Raises StoreError; the days that were done before are complete.
    """
    findings = Findings() if findings is None else findings
    end = before or f'{now():%Y-%m-%d}'
    with ThreadPoolExecutor(THREADS) as pool:
        for name, of in product([robot] if robot else robots(source), (OBJECTS, GAPS, KEPT, STATISTICS)):
            for date in (date for date in dates_of(source, name, findings, of) if date < end):
                deadline_s = monotonic() + MOST_S
                for day in days(source, [name], [date], pool, findings, of=of):
                    done = _merge(source, store, day, of, findings, lambda end_s=deadline_s: monotonic() < end_s)  # type: ignore[misc]
                    done = _tidy(source, day, done, grace, now())
                    if done.merged or done.deleted or done.kept:
                        yield done


def _merge(source: Bucket, store: ObjectStore, day: Day, of: TableSchema, findings: Findings,
           is_in_time: Callable[[], bool]) -> Compacted:  # fmt: skip
    nothing = Compacted(day.robot, day.date)
    if len(day.entries) < 2:
        return nothing
    try:
        merged, rows = _rows(source, day, of, findings)
        if len(merged) < 2:
            return nothing
        sources = frozenset().union(*(day.sources.get(entry.key, {name_of(entry.key)}) for entry in merged))
        key = compacted_key(day.robot, day.date, sources, is_backfilled=day.is_backfilled, of=of)
        rows = _IN_ORDER[of.folder](rows)
        body = _encoded(rows, of, sources)
    except MemoryError:
        findings.add(folder_of(day.robot, day.date, of), 'there is not enough memory to compact it')
        return nothing
    if not is_in_time():
        return nothing
    put_part(store, key, day.robot, body, len(rows))
    return replace(nothing, merged=len(merged), rows=len(rows), size=len(body))


def _rows(source: Bucket, day: Day, of: TableSchema, findings: Findings) -> tuple[list[ObjectInfo], pa.Table]:
    """The parts that can be merged, and their rows. Raises MemoryError for more than ``MOST_DAY_BYTES``."""
    merged: list[ObjectInfo] = []
    found: list[pa.Table] = [arrow_schema(of).empty_table()]
    size = 0
    for entry, table in whole(source, day.entries, findings, of):
        size += table.nbytes
        if size > MOST_DAY_BYTES:
            raise MemoryError
        merged.append(entry)
        found.append(table)
    return merged, pa.concat_tables(found).combine_chunks()


_IN_ORDER: Final[Mapping[str, Callable[[pa.Table], pa.Table]]] = {
    OBJECTS.folder: lambda rows: in_order(unrepeated(rows)),
    KEPT.folder: lambda rows: in_order(superseding(rows)),
    GAPS.folder: lambda rows: folded(rows).sort_by(_BY_TOPIC),
    STATISTICS.folder: lambda rows: unrepeated(rows, (*ROW, 'field')).sort_by(_BY_FIELD),
}
"""By the table's folder."""


def _encoded(rows: pa.Table, of: TableSchema, sources: frozenset[str]) -> bytes:
    body = pa.BufferOutputStream()
    repeated = [name for name, kind in of.columns.items() if name in _COUNTS or (kind in {STRING, INT32} and name not in _UNIQUE)]
    with pq.ParquetWriter(body, arrow_schema(of), compression='zstd', use_dictionary=repeated, store_schema=False) as file:
        file.write_table(rows.cast(arrow_schema(of)), row_group_size=STATISTICS_ROWS if of is STATISTICS else GROUP_ROWS)
        file.add_key_value_metadata({**of.about, SOURCES: encode_sources(sources)})
    return bytes(body.getvalue().to_pybytes())


def _tidy(source: Bucket, day: Day, done: Compacted, grace: timedelta | None, now: datetime) -> Compacted:
    """Delete parts that have been superseded for long enough; a day that was merged just now is left to a later run."""
    compacted = [entry.modified for entry in day.entries if is_compacted(entry.key)]
    fresh = [modified for modified in compacted if grace is None or modified is None or now - modified < grace]
    if done.merged or fresh or not day.superseded:
        return replace(done, kept=len(day.superseded) + done.merged)
    deleted = 0
    with ThreadPoolExecutor(THREADS) as pool:
        for gone in pool.map(lambda entry: _delete(source, entry), day.superseded):
            deleted += gone
    return replace(done, deleted=deleted, kept=len(day.superseded) - deleted, denied=deleted < len(day.superseded))


def _delete(source: Bucket, entry: ObjectInfo) -> bool:
    try:
        source.delete(entry.key)
    except AccessDenied:
        return False
    return True


def in_order(rows: pa.Table) -> pa.Table:
    """Sort by sensor, place and time; rows without a place come last within their sensor."""
    cells = pa.array(_curve(rows['x']) | _curve(rows['y']) << 1, pa.int64(), mask=~np.asarray(pc.is_valid(rows['x'])))
    keys = [
        ('sensor', 'ascending'),
        ('_cell', 'ascending'),
        ('t_start_ns', 'ascending'),
        ('bucket', 'ascending'),
        ('key', 'ascending'),
    ]
    order = pc.sort_indices(rows.append_column('_cell', cells), sort_keys=keys)
    return rows.take(order)


def _curve(column: pa.ChunkedArray) -> NDArray[np.int64]:
    """The cell numbers along an axis, with a zero bit between any two bits (Morton order)."""
    metres = np.nan_to_num(np.asarray(column.fill_null(0.0).to_numpy()))
    spread = (np.clip(np.floor(metres / CELL_M), -_CELLS, _CELLS - 1) + _CELLS).astype(np.int64)
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        spread = (spread | spread << shift) & mask
    return np.asarray(spread, np.int64)
