"""Which objects were deleted from the store on purpose (``lake prune``): their rows in the catalogue count no more.

A row of ``catalogue.schema.FORGOTTEN`` supersedes that of the same object in the catalogue, under the same date.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import pyarrow as pa
import pyarrow.compute as pc

from shadowhound_data_logger.core.clock import utc
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.formats.rows.schema import FORGOTTEN
from shadowhound_data_logger.lake.bucket import THREADS, Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.live_files import Day, dates_of, days, robots
from shadowhound_data_logger.lake.reading import narrow, tables

NAME_COLUMNS: Final = ('bucket', 'key')


def object_names(table: pa.Table) -> pa.ChunkedArray:
    """``BUCKET/KEY`` of each row."""
    return pc.binary_join_element_wise(table['bucket'], table['key'], '/')


def forgotten_entries(source: Bucket, found: Sequence[Day],
                      findings: Findings) -> Mapping[tuple[str, str], Sequence[ObjectInfo]]:  # fmt: skip
    """(robot, date) -> the parts that name what was deleted, of those of these days that have some. Raises StoreError."""
    gone: dict[tuple[str, str], Sequence[ObjectInfo]] = {}
    with ThreadPoolExecutor(THREADS) as pool:
        for robot in sorted({day.robot for day in found}):
            dates = {day.date for day in found if day.robot == robot}.intersection(dates_of(source, robot, findings, FORGOTTEN))
            for day in days(source, [robot], sorted(dates), pool, findings, of=FORGOTTEN) if dates else ():
                gone[robot, day.date] = day.entries
    return gone


def forgotten_names(source: Bucket, entries: Sequence[ObjectInfo], findings: Findings) -> pa.ChunkedArray:
    """What these parts name, as ``object_names``. Raises StoreError."""
    named = [object_names(rows) for rows in tables(source, entries, NAME_COLUMNS, findings, of=FORGOTTEN)]
    return pa.chunked_array([chunk for each in named for chunk in each.chunks], pa.string())


def without(table: pa.Table, names: pa.ChunkedArray) -> pa.Table:
    """The rows of other objects; the table has the columns ``bucket`` and ``key``."""
    return table.filter(pc.invert(pc.is_in(object_names(table), value_set=names))) if len(names) else table


def forgotten(source: Bucket, robot: str | None, findings: Findings) -> pa.Table:
    """What was deleted, with the columns of ``catalogue.schema.FORGOTTEN``, by time; no object twice. Raises StoreError."""
    with ThreadPoolExecutor(THREADS) as pool:
        found = days(source, [robot] if robot else robots(source), None, pool, findings, of=FORGOTTEN)
    entries = [entry for day in sorted(found, key=lambda day: day.robot) for entry in day.entries]
    columns = tuple(FORGOTTEN.columns)
    rows = pa.concat_tables([narrow(columns, FORGOTTEN).empty_table(), *tables(source, entries, columns, findings, of=FORGOTTEN)])
    rows = rows.sort_by([('t_start_ns', 'ascending'), ('forgotten_ns', 'ascending')])
    first: dict[str, int] = {}
    for number, name in enumerate(object_names(rows).to_pylist()):
        first.setdefault(name, number)
    return rows.take(pa.array(first.values(), pa.int64()))


def dates_of_deletion(rows: pa.Table) -> dict[tuple[str, str], str]:
    """(bucket, key) -> the UTC date on which it was deleted."""
    names = zip(rows['bucket'].to_pylist(), rows['key'].to_pylist(), strict=True)
    return dict(zip(names, (f'{utc(stamp_ns):%Y-%m-%d}' for stamp_ns in rows['forgotten_ns'].to_pylist()), strict=True))
