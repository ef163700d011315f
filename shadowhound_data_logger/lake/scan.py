"""The catalogue as a source of Daft's: which files a query reads, and how.

Folders are listed when a query runs. Small parts are read whole, some hundred at a time, because a request costs more than its
bytes; compacted ones by Daft's own reader, which leaves out what their statistics rule out.
"""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import AsyncIterator, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final, TypeVar

import pyarrow as pa
import pyarrow.parquet as pq

from shadowhound_data_logger.lake.schema import arrow_schema
from shadowhound_data_logger.lake.select import Wanted
from shadowhound_data_logger.lake.source import Source
from shadowhound_data_logger.lake.standing import Day, days
from shadowhound_data_logger.lake.trust import authorities

os.environ.setdefault('DAFT_ANALYTICS_ENABLED', '0')  # else it tells its makers of each run, over the network
os.environ.setdefault('DAFT_PROGRESS_BAR', '0')

import daft
from daft.daft import StorageConfig
from daft.io import IOConfig, S3Config
from daft.io.pushdowns import Pushdowns
from daft.io.source import DataSource, DataSourceTask
from daft.recordbatch import RecordBatch

THREADS: Final = 16
"""Requests on their way at a time; each waits, most of its time, for the server."""
SMALL_BYTES: Final = 256 << 10
"""Up to here a file is read whole: of one-minute parts there are thousands, and a compacted day of a robot is larger."""
PARTS_A_TASK: Final = 180
_Answer = TypeVar('_Answer')
KEY: Final = ('bucket', 'key')
_ROW: Final = (*KEY, 't_start_ns')
"""Of a repeat the key is that of another row (spool/repeats.py)."""


class Catalogue(DataSource):
    """The rows of one bucket's catalogue that can be wanted. Stateless: each run lists anew."""

    def __init__(self, source: Source, wanted: Wanted) -> None:
        self._source = source
        self._wanted = wanted
        self._schema = daft.Schema.from_pyarrow_schema(arrow_schema())

    @property
    def name(self) -> str:
        return f'the catalogue in {self._source.describe()}'

    @property
    def schema(self) -> daft.Schema:
        return self._schema

    async def get_tasks(self, pushdowns: Pushdowns) -> AsyncIterator[DataSourceTask]:
        columns = _columns(pushdowns)
        found = await _apart(lambda: folders(self._source, self._wanted))
        for day in found:
            if day.is_mended:
                yield _Parts(self._source, [entry.key for entry in day.entries], columns, once=True)
        plain = [entry for day in found if not day.is_mended for entry in day.entries]
        small = [entry.key for entry in plain if entry.size <= SMALL_BYTES]
        for start in range(0, len(small), PARTS_A_TASK):
            yield _Parts(self._source, small[start : start + PARTS_A_TASK], columns)
        storage = StorageConfig(True, _io(self._source))
        private = authorities(self._source.settings) is not None  # of which Daft's reader knows nothing
        for entry in plain:
            if entry.size > SMALL_BYTES and private:
                yield _Parts(self._source, [entry.key], columns)
            elif entry.size > SMALL_BYTES:
                yield DataSourceTask.parquet(
                    _path(self._source, entry.key),
                    self._schema,
                    pushdowns=pushdowns,
                    size_bytes=entry.size,
                    storage_config=storage,
                )


class _Parts(DataSourceTask):
    """Parts that are read together, from the store to one batch of the columns that are needed."""

    def __init__(self, source: Source, keys: Sequence[str], columns: Sequence[str], *, once: bool = False) -> None:
        """``once``: of rows with the same key and time one is kept."""
        self._source = source
        self._keys = tuple(keys)
        self._columns = tuple(columns)
        self._once = once

    @property
    def schema(self) -> daft.Schema:
        return daft.Schema.from_pyarrow_schema(_narrow(self._columns))

    async def read(self) -> AsyncIterator[RecordBatch]:
        table = await _apart(self._table)
        for batch in table.to_batches():
            yield RecordBatch.from_arrow_record_batches([batch], batch.schema)

    def _table(self) -> pa.Table:
        wide = (*self._columns, *(name for name in _ROW if name not in self._columns)) if self._once else self._columns
        table = read(self._source, self._keys, wide)
        return (unrepeated(table) if self._once else table).select(self._columns)


async def _apart(work: Callable[[], _Answer]) -> _Answer:
    """In a thread of its own, which ends with it: Daft's loop serves all tasks."""
    with ThreadPoolExecutor(1) as pool:
        return await asyncio.get_running_loop().run_in_executor(pool, work)


def folders(source: Source, wanted: Wanted) -> list[Day]:
    """The days whose parts can hold what is wanted. Raises StoreError, LakeError."""
    robots = [wanted.robot] if wanted.robot else source.folders('')
    with ThreadPoolExecutor(THREADS) as pool:
        return days(source, robots, wanted.dates(time.time_ns()), pool, wanted.has_date)


def read(source: Source, keys: Sequence[str], columns: Sequence[str]) -> pa.Table:
    """The rows of these parts, in one piece; a column that a part does not have yet is null. Raises StoreError."""
    schema = _narrow(columns)

    def part(body: bytes) -> pa.Table:
        file = pq.ParquetFile(pa.BufferReader(body))
        return _fit(file.read([name for name in columns if name in file.schema_arrow.names], use_threads=False), schema)

    with ThreadPoolExecutor(THREADS) as pool:  # threads wait for the server; several that parse get in each other's way
        tables = [part(body) for body in pool.map(source.read, keys)]
    return pa.concat_tables(tables).combine_chunks() if tables else schema.empty_table()


def unrepeated(table: pa.Table) -> pa.Table:
    """The first row of each key and time, in order."""
    numbered = table.append_column('_row', pa.array(range(len(table)), pa.int64()))
    first = numbered.group_by(list(_ROW)).aggregate([('_row', 'min')])['_row_min']
    return table if len(first) == len(table) else table.take(first.combine_chunks().sort())


def _fit(table: pa.Table, schema: pa.Schema) -> pa.Table:
    if table.schema.names == schema.names and table.schema.types == schema.types:
        return pa.Table.from_arrays(table.columns, schema=schema)  # no cast: only what may be null differs
    columns = [
        table[field.name].cast(field.type) if field.name in table.column_names else pa.nulls(len(table), field.type)
        for field in schema
    ]
    return pa.table(columns, schema=schema)


def _columns(pushdowns: Pushdowns) -> tuple[str, ...]:
    """In the order of the schema: those of the answer, and those that a filter looks at."""
    names = arrow_schema().names
    if pushdowns.columns is None:
        return tuple(names)
    needed = {*pushdowns.columns, *pushdowns.filter_required_column_names()}
    return tuple(name for name in names if name in needed)


def _narrow(columns: Sequence[str]) -> pa.Schema:
    """All may be null: what a file does not have is."""
    schema = arrow_schema()
    return pa.schema([schema.field(name).with_nullable(True) for name in columns])


def _path(source: Source, key: str) -> str:
    if source.settings.endpoint_url:
        return f's3://{source.bucket}/{key}'
    return str(source.settings.directory / source.bucket / key)


def _io(source: Source) -> IOConfig:
    settings = source.settings
    if not settings.endpoint_url:
        return IOConfig()
    given: dict[str, Any] = {'key_id': settings.access_key_id, 'access_key': settings.secret_access_key}
    return IOConfig(s3=S3Config(
        endpoint_url=settings.endpoint_url, region_name=settings.region, session_token=settings.session_token,
        use_ssl=settings.endpoint_url.startswith('https:'), max_connections=THREADS, num_tries=4, **given,
    ))  # fmt: skip
