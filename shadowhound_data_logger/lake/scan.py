"""Which files of the catalogue a query reads, and which of their rows count.

Folders are listed when a query runs. Small parts are read some hundred at a time, because a request costs more than its bytes;
of a large one, which was compacted, only what can hold an answer (lake/reading.py).
"""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import groupby
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.formats.rows.schema import OBJECTS, TableSchema
from shadowhound_data_logger.lake import reading
from shadowhound_data_logger.lake.bucket import THREADS, Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.forgotten import forgotten_entries, forgotten_names, without
from shadowhound_data_logger.lake.live_files import Day, days, robots
from shadowhound_data_logger.lake.reading import SMALL_BYTES, Only
from shadowhound_data_logger.lake.select import Wanted

PARTS_AT_A_TIME: Final = 720
"""The most small parts in a group: half a day of a robot."""
GROUP_BYTES: Final = 16 << 20
"""The most bytes of small parts in a group: groups are read in parallel, each as a whole."""
KEY: Final = ('bucket', 'key')
_TIMES: Final = ('robot', *KEY, 't_start_ns', 't_end_ns')
ROW: Final = (*KEY, 't_start_ns')
"""Of a repeat the key is that of another row (spool/repeats.py)."""


class PartGroup(NamedTuple):
    """Parts of one robot that are read together."""

    entries: Sequence[ObjectInfo]
    once: bool = False
    """Of rows with the same key and time one is kept."""
    gone: Sequence[ObjectInfo] = ()
    """Parts that name what was forgotten of them."""


def planned(source: Bucket, wanted: Wanted, findings: Findings) -> Iterator[PartGroup]:
    """The parts whose rows may match, listed at once. Raises StoreError."""
    found = folders(source, wanted, findings)
    gone = forgotten_entries(source, found, findings)
    apart = [day for day in found if day.is_backfilled or (day.robot, day.date) in gone]
    for day in apart:
        yield PartGroup(day.entries, day.is_backfilled, gone.get((day.robot, day.date), ()))
    for _, whole in groupby((day for day in found if day not in apart), lambda day: day.robot):
        plain = [entry for day in whole for entry in day.entries]
        small = [entry for entry in plain if entry.size <= SMALL_BYTES]
        yield from map(PartGroup, _grouped(small))
        for entry in plain:
            if entry.size > SMALL_BYTES:
                yield PartGroup([entry])


def _grouped(entries: Sequence[ObjectInfo]) -> Iterator[list[ObjectInfo]]:
    """Split into groups of limited number and size, in the same order."""
    group: list[ObjectInfo] = []
    size = 0
    for entry in entries:
        if group and (len(group) == PARTS_AT_A_TIME or size + entry.size > GROUP_BYTES):
            yield group
            group, size = [], 0
        group.append(entry)
        size += entry.size
    if group:
        yield group


def catalogue_rows(source: Bucket, parts: PartGroup, columns: Sequence[str], wanted: Wanted, findings: Findings,
                   only: Only | None = None) -> Generator[pa.Table, None, None]:  # fmt: skip
    """The rows of these parts that count, as far as ``wanted`` can tell cheaply and that ``only`` names. Raises StoreError."""
    wide = (*columns, *(name for name in ROW if name not in columns)) if parts.once else tuple(columns)
    if parts.gone:
        wide = (*wide, *(name for name in KEY if name not in wide))
    if wanted.chosen:
        wide = (*wide, *(name for name in _TIMES if name not in wide))
    found = (within_chosen(table, wanted) for table in reading.tables(source, parts.entries, wide, findings, wanted, only=only))
    if parts.gone:
        names = forgotten_names(source, parts.gone, findings)
        found = (without(table, names) for table in found)
    if parts.once:
        yield unrepeated(pa.concat_tables([reading.narrow(wide).empty_table(), *found])).select(columns)
    else:
        yield from (table.select(columns) for table in found)


def within_chosen(table: pa.Table, wanted: Wanted) -> pa.Table:
    """The rows that are in all that was chosen."""
    if not wanted.chosen:
        return table
    first = pc.fill_null(table['t_start_ns'], -1).to_numpy()
    last = np.maximum(first, pc.fill_null(table['t_end_ns'], -1).to_numpy())
    kept = np.ones(len(table), bool)
    for chosen in wanted.chosen:
        found = np.zeros(len(table), bool)
        for robot, each in groupby(chosen.spans, lambda span: span.robot):
            since, until = np.array([span[1:] for span in each], np.int64).T
            place = np.searchsorted(until, first)
            inside = (place < len(until)) & (since[np.minimum(place, len(until) - 1)] <= last)
            is_its = pc.fill_null(pc.equal(table['robot'], robot), fill_value=False).to_numpy() if robot else True
            found |= inside & is_its
        if chosen.keys:
            pairs = zip(table['bucket'].to_pylist(), table['key'].to_pylist(), strict=True)
            found |= np.fromiter((pair in chosen.keys for pair in pairs), bool, len(table))
        kept &= found
    return table.filter(pa.array(kept))


def folders(source: Bucket, wanted: Wanted, findings: Findings, of: TableSchema = OBJECTS) -> list[Day]:
    """The days whose parts can hold what is wanted. Raises StoreError."""
    named = [wanted.robot] if wanted.robot else robots(source)
    with ThreadPoolExecutor(THREADS) as pool:
        return days(source, named, wanted.dates(time.time_ns()), pool, findings, wanted.has_date, of)


def unrepeated(table: pa.Table, of: Sequence[str] = ROW) -> pa.Table:
    """The first row of each key and time, or of what else tells rows apart, in order."""
    numbered = table.append_column('_row', pa.array(range(len(table)), pa.int64()))
    first = numbered.group_by(list(of)).aggregate([('_row', 'min')])['_row_min']
    return table if len(first) == len(table) else table.take(first.combine_chunks().sort())


def superseding(rows: pa.Table, stored: pa.Table | None = None) -> pa.Table:
    """Of the table of what is kept the rows that count: of an object that is lost its ``lost`` row, of one that is stored none.

    ``stored`` are the keys of the catalogue's rows; without them all are kept that the table itself does not supersede. Whatever
    is given again, alone or with others, gives what all at once would have given.
    """
    if stored is not None and len(stored):
        rows = rows.join(stored.select(KEY), keys=list(KEY), join_type='left anti').combine_chunks().select(rows.column_names)
    ordered = rows.sort_by(
        [('bucket', 'ascending'), ('key', 'ascending'), ('where', 'ascending'), ('bytes', 'ascending')]
    )  # lost before robot, thinned before whole
    numbered = ordered.append_column('_row', pa.array(range(len(ordered)), pa.int64()))
    first = numbered.group_by(list(KEY)).aggregate([('_row', 'min')])['_row_min']
    return ordered if len(first) == len(ordered) else ordered.take(first.combine_chunks().sort())
