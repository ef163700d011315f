"""``lake compact``: the many parts of a day that is over become one, in the order in which a question looks for rows.

It only ever adds an object, under a name made of what it is made of. What that covers is deleted later, when nobody reads a list
from before it any more; so it may die, or run twice at a time, at any moment (docs/decisions/0014).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from shadowhound_data_logger.errors import AccessDenied
from shadowhound_data_logger.lake.parts import ABOUT
from shadowhound_data_logger.lake.putting import put_part
from shadowhound_data_logger.lake.scan import THREADS, read, unrepeated
from shadowhound_data_logger.lake.schema import arrow_schema, prefix
from shadowhound_data_logger.lake.source import Entry, Source
from shadowhound_data_logger.lake.standing import LEAVES, Day, compacted_key, days, encode_leaves, is_compacted, name_of
from shadowhound_data_logger.stores.base import ObjectStore

GRACE: Final = timedelta(hours=1)
"""How long parts stay that a compacted one stands for: who listed them before that may still read them."""
MOST_S: Final = 1800.0
"""From the list of a day's parts to its compacted part; half of the grace."""
GROUP_ROWS: Final = 4096
CELL_M: Final = 4.0
"""Rows are ordered by sensor, by squares of this side along a Z-order curve, then by time: what lies together is read at once."""
_CELLS: Final = 1 << 15


@dataclass(frozen=True, slots=True)
class Compacted:
    """What became of a day."""

    robot: str
    date: str
    merged: int = 0
    """Parts that one now stands for; 0 where there was nothing to merge."""
    rows: int = 0
    size: int = 0
    deleted: int = 0
    kept: int = 0
    """Parts that are stood for and not deleted yet."""
    denied: bool = False
    """The credentials may not delete: that costs room and nothing else."""


def compact(
    source: Source, store: ObjectStore, *, robot: str | None = None, before: str = '', grace: timedelta | None = GRACE,
    now: Callable[[], datetime] = lambda: datetime.now(timezone.utc), monotonic: Callable[[], float] = time.monotonic,
) -> Iterator[Compacted]:  # fmt: skip
    """Merge every day earlier than ``before`` (default: today, UTC), and delete what was merged ``grace`` ago (None: nothing).

    Yields each day that it had to do with. Raises StoreError, LakeError; what was done until then is whole.
    """
    end = before or f'{now():%Y-%m-%d}'
    with ThreadPoolExecutor(THREADS) as pool:
        for name in [robot] if robot else source.folders(''):
            for date in _dates(source, name, end):
                deadline_s = monotonic() + MOST_S
                for day in days(source, [name], [date], pool):
                    done = _merge(source, store, day, lambda end_s=deadline_s: monotonic() < end_s)  # type: ignore[misc]
                    done = _tidy(source, day, done, grace, now())
                    if done.merged or done.deleted or done.kept:
                        yield done


def _dates(source: Source, robot: str, end: str) -> list[str]:
    folders = source.folders(prefix(robot))
    return [name[5:] for name in folders if name.startswith('date=') and name[5:] < end]


def _merge(source: Source, store: ObjectStore, day: Day, is_in_time: Callable[[], bool]) -> Compacted:
    nothing = Compacted(day.robot, day.date)
    if len(day.entries) < 2:
        return nothing
    leaves = day.leaves | {name_of(entry.key) for entry in day.entries if not is_compacted(entry.key)}
    key = compacted_key(day.robot, day.date, leaves, is_mended=day.is_mended)
    rows = in_order(unrepeated(read(source, [entry.key for entry in day.entries], arrow_schema().names)))
    body = pa.BufferOutputStream()
    with pq.ParquetWriter(body, arrow_schema(), compression='zstd', store_schema=False) as file:
        file.write_table(rows.cast(arrow_schema()), row_group_size=GROUP_ROWS)
        file.add_key_value_metadata({**ABOUT, LEAVES: encode_leaves(leaves)})
    whole = body.getvalue().to_pybytes()
    if not is_in_time():
        return nothing
    put_part(store, key, day.robot, whole, len(rows))
    return replace(nothing, merged=len(day.entries), rows=len(rows), size=len(whole))


def _tidy(source: Source, day: Day, done: Compacted, grace: timedelta | None, now: datetime) -> Compacted:
    """Delete what is stood for since long enough; of a day that was merged just now, that is for a later run."""
    fresh = [entry for entry in day.entries if is_compacted(entry.key) and (grace is None or now - entry.modified < grace)]
    if done.merged or fresh or not day.covered:
        return replace(done, kept=len(day.covered) + done.merged)
    deleted = 0
    with ThreadPoolExecutor(THREADS) as pool:
        for gone in pool.map(lambda entry: _delete(source, entry), day.covered):
            deleted += gone
    return replace(done, deleted=deleted, kept=len(day.covered) - deleted, denied=deleted < len(day.covered))


def _delete(source: Source, entry: Entry) -> bool:
    try:
        source.delete([entry.key])
    except AccessDenied:
        return False
    return True


def in_order(rows: pa.Table) -> pa.Table:
    """Sorted by sensor, place and time; rows without a place come last among their sensor's."""
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
    """The cell's number along an axis with a zero bit between its bits (Morton order)."""
    metres = np.nan_to_num(np.asarray(column.fill_null(0.0).to_numpy()))
    spread = (np.clip(np.floor(metres / CELL_M), -_CELLS, _CELLS - 1) + _CELLS).astype(np.int64)
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        spread = (spread | spread << shift) & mask
    return np.asarray(spread, np.int64)
