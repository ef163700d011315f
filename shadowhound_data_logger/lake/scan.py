"""The catalogue as a source of Daft's: which files a query reads, and in which tasks.

Folders are listed when a query runs. Small parts are read some hundred at a time, because a request costs more than its bytes;
of a large one, which was compacted, only what can hold an answer (lake/reading.py).
"""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import AsyncIterator, Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import groupby
from typing import Final, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from shadowhound_data_logger.catalogue.schema import OBJECTS, TableSchema
from shadowhound_data_logger.lake import reading
from shadowhound_data_logger.lake.bucket import THREADS, Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.forgotten import forgotten_entries, forgotten_names, without
from shadowhound_data_logger.lake.live_files import Day, days, robots
from shadowhound_data_logger.lake.reading import PARTS_AT_A_TIME, SMALL_BYTES, arrow_schema
from shadowhound_data_logger.lake.select import Wanted
from shadowhound_data_logger.model import ObjectInfo

os.environ.setdefault('DAFT_ANALYTICS_ENABLED', '0')  # else it tells its makers of each run, over the network
os.environ.setdefault('DAFT_PROGRESS_BAR', '0')

import daft
from daft.io.pushdowns import Pushdowns
from daft.io.source import DataSource, DataSourceTask
from daft.recordbatch import RecordBatch

_Answer = TypeVar('_Answer')
KEY: Final = ('bucket', 'key')
_TIMES: Final = ('robot', *KEY, 't_start_ns', 't_end_ns')
ROW: Final = (*KEY, 't_start_ns')
"""Of a repeat the key is that of another row (spool/repeats.py)."""


class Catalogue(DataSource):
    """Reads the rows of one bucket's catalogue that may match a query.

    Stateless, except for what it leaves out: each run lists anew.
    """

    def __init__(self, source: Bucket, wanted: Wanted, findings: Findings) -> None:
        self._source = source
        self._wanted = wanted
        self._findings = findings
        self._schema = daft.Schema.from_pyarrow_schema(arrow_schema())

    @property
    def name(self) -> str:
        return f'the catalogue in {self._source.describe()}'

    @property
    def schema(self) -> daft.Schema:
        return self._schema

    async def get_tasks(self, pushdowns: Pushdowns) -> AsyncIterator[DataSourceTask]:
        columns = _columns(pushdowns)
        found = await _apart(lambda: folders(self._source, self._wanted, self._findings))
        gone = await _apart(lambda: forgotten_entries(self._source, found, self._findings))
        apart = [day for day in found if day.is_backfilled or (day.robot, day.date) in gone]
        for day in apart:
            yield self._parts(day.entries, columns, once=day.is_backfilled, gone=gone.get((day.robot, day.date), ()))
        for _, whole in groupby((day for day in found if day not in apart), lambda day: day.robot):
            plain = [entry for day in whole for entry in day.entries]
            small = [entry for entry in plain if entry.size <= SMALL_BYTES]
            for start in range(0, len(small), PARTS_AT_A_TIME):
                yield self._parts(small[start : start + PARTS_AT_A_TIME], columns)
            for entry in plain:
                if entry.size > SMALL_BYTES:
                    yield self._parts([entry], columns)

    def _parts(self, entries: Sequence[ObjectInfo], columns: Sequence[str], *, once: bool = False,
               gone: Sequence[ObjectInfo] = ()) -> _Parts:  # fmt: skip
        return _Parts(self._source, entries, columns, self._wanted, self._findings, once=once, gone=gone)


class _Parts(DataSourceTask):
    """Parts that are read together, from the store to batches of the columns that are needed."""

    def __init__(self, source: Bucket, entries: Sequence[ObjectInfo], columns: Sequence[str], wanted: Wanted,
                 findings: Findings, *, once: bool, gone: Sequence[ObjectInfo]) -> None:  # fmt: skip
        """``once``: of rows with the same key and time one is kept. ``gone``: parts that name what was forgotten of them."""
        self._source = source
        self._entries = tuple(entries)
        self._columns = tuple(columns)
        self._wanted = wanted
        self._findings = findings
        self._once = once
        self._gone = tuple(gone)

    @property
    def schema(self) -> daft.Schema:
        return daft.Schema.from_pyarrow_schema(reading.narrow(self._columns))

    async def read(self) -> AsyncIterator[RecordBatch]:
        tables = self._tables()
        try:
            while (table := await _apart(lambda: next(tables, None))) is not None:
                for batch in table.to_batches():
                    yield RecordBatch.from_arrow_record_batches([batch], batch.schema)
        finally:
            tables.close()

    def _tables(self) -> Generator[pa.Table, None, None]:
        wide = (*self._columns, *(name for name in ROW if name not in self._columns)) if self._once else self._columns
        if self._gone:
            wide = (*wide, *(name for name in KEY if name not in wide))
        if self._wanted.chosen:
            wide = (*wide, *(name for name in _TIMES if name not in wide))
        found = (_within(table, self._wanted)
                 for table in reading.tables(self._source, self._entries, wide, self._findings, self._wanted))  # fmt: skip
        if self._gone:
            names = forgotten_names(self._source, self._gone, self._findings)
            found = (without(table, names) for table in found)
        if self._once:
            yield unrepeated(pa.concat_tables([reading.narrow(wide).empty_table(), *found])).select(self._columns)
        else:
            yield from (table.select(self._columns) for table in found)


def _within(table: pa.Table, wanted: Wanted) -> pa.Table:
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


async def _apart(work: Callable[[], _Answer]) -> _Answer:
    """In a thread of its own, which ends with it: Daft's loop serves all tasks."""
    with ThreadPoolExecutor(1) as pool:
        return await asyncio.get_running_loop().run_in_executor(pool, work)


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
    ordered = rows.sort_by([('bucket', 'ascending'), ('key', 'ascending'), ('where', 'ascending')])  # lost before robot
    numbered = ordered.append_column('_row', pa.array(range(len(ordered)), pa.int64()))
    first = numbered.group_by(list(KEY)).aggregate([('_row', 'min')])['_row_min']
    return ordered if len(first) == len(ordered) else ordered.take(first.combine_chunks().sort())


def _columns(pushdowns: Pushdowns) -> tuple[str, ...]:
    """In the order of the schema: those of the answer, and those that a filter looks at."""
    names = arrow_schema().names
    if pushdowns.columns is None:
        return tuple(names)
    needed = {*pushdowns.columns, *pushdowns.filter_required_column_names()}
    return tuple(name for name in names if name in needed)
