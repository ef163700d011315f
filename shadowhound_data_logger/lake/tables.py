"""The lake's Delta tables: their locations and schemas, and the SQL engine that reads them (docs/decisions/0025).

Robots write rows; only the lake writes tables. On an S3 server with a bucket ``lake``, the tables are shared by all readers.
Otherwise they are in ``SHADOWHOUND_HOME/lake/``, in one folder per store, and can be deleted at any time. All tables are
partitioned by date (UTC) and robot. A row, identified by the columns of its table's identity, is never stored twice.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Final, NamedTuple
from urllib.parse import urlsplit

import pyarrow as pa
import pyarrow.compute as pc
from deltalake import CommitProperties, DeltaTable, QueryBuilder, Transaction, WriterProperties, write_deltalake
from deltalake.exceptions import CommitFailedError, DeltaError, TableNotFoundError

from shadowhound_data_logger.core.config import home
from shadowhound_data_logger.core.errors import AccessDenied, BucketMissing, LakeError
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows.catalog import DOUBLE, FORGOTTEN, INT32, INT64, KEPT, OBJECTS, STRING, TIME, TableSchema
from shadowhound_data_logger.formats.rows.gaps import GAPS
from shadowhound_data_logger.formats.rows.labels import LABELS
from shadowhound_data_logger.formats.rows.statistics import STATISTICS
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.stores.s3_obstore import proxy_options

BUCKET: Final = 'lake'
"""The bucket of the shared tables; robots cannot write to it."""
NO_BUCKET: Final = 'NoSuchBucket'
"""S3's error code for a bucket that does not exist."""
_COLORS: Final = re.compile(r'\x1b\[\d*m|\u21b3')
"""Terminal codes in the library's messages."""
LOG: Final = '_delta_log'
"""A folder that contains this folder is a table."""
DATE, ROBOT, PART = 'date', 'robot', 'part'
PARTITIONS: Final = (DATE, ROBOT)
INGEST: Final = 'ingest'
"""The application of the Delta transactions that add rows: of two that start from the same version, one fails."""
VERSIONS_AT_A_TIME: Final = 50
"""Versions of a table whose changes are read together."""
GROUP_ROWS: Final = 16_384
"""Rows per row group, because statistics can exclude whole groups."""
_KEPT: Final = {
    'delta.enableChangeDataFeed': 'true', 'delta.deletedFileRetentionDuration': 'interval 30 days',
    'delta.logRetentionDuration': 'interval 30 days',
}  # fmt: skip
"""How far back a table can be read as of a time; vacuum keeps the files that these versions use."""
_KINDS: Final = {
    STRING: pa.string(), INT32: pa.int32(), INT64: pa.int64(), DOUBLE: pa.float64(), TIME: pa.timestamp('us', tz='UTC'),
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """A table: its name in SQL, its columns, and the identity of its rows."""

    name: str
    schema: pa.Schema
    identity: tuple[str, ...]
    """Rows with equal values in these columns are the same row."""
    time: str
    """The sort column of the files."""
    dated: str
    """The column whose UTC date is the row's partition; a row without a value belongs to 1970-01-01."""
    partitions: tuple[str, ...] = PARTITIONS


def arrow_schema(of: TableSchema = OBJECTS) -> pa.Schema:
    """The columns of a table's rows in row files."""
    return pa.schema([pa.field(name, _KINDS[kind], nullable=name not in of.required) for name, kind in of.columns.items()])


def _table(name: str, of: TableSchema, identity: Sequence[str], time: str, dated: str = 't_start') -> Table:
    fields = [pa.field(DATE, pa.string()), *(field.with_nullable(True) for field in arrow_schema(of))]
    return Table(name, pa.schema(fields), tuple(identity), time, dated)


OBJECT_ROWS: Final = _table('objects', OBJECTS, ('bucket', 'key', 't_start_ns'), 't_start_ns')
INGESTED: Final = Table(
    'ingested',
    pa.schema([
        (DATE, pa.string()), (ROBOT, pa.string()), (PART, pa.string()), ('etag', pa.string()),
        ('ingested', _KINDS[TIME]), ('rows', pa.int64()), ('rejected', pa.int64()), ('unknown', pa.int64()),
        ('why', pa.string()),
    ]),
    (PART, 'etag'), 'ingested', 'ingested', (DATE,),
)  # fmt: skip
"""The row files that the other tables contain; a row is committed here after all rows of its file."""
MISSION_ROWS: Final = Table(
    'missions',
    pa.schema([
        (DATE, pa.string()), (ROBOT, pa.string()), ('mission_id', pa.string()), ('run_id', pa.string()),
        ('mission_type', pa.string()), ('start_ns', pa.int64()), ('end_ns', pa.int64()), ('command', pa.string()),
        ('started', pa.string()), ('ended', pa.string()), ('result', pa.string()), ('success', pa.bool_()),
        ('distance_m', pa.float64()), ('duration_s', pa.float64()), ('battery_consumed_pct', pa.float64()),
        ('policy', pa.string()), ('policies', pa.string()),
    ]),
    ('run_id',), 'start_ns', 'start_ns',
)  # fmt: skip
"""How missions ended (lake/summaries.py). Its rows are not in row files: ingest derives them from the missions' summaries."""
TABLES: Final[Mapping[str, Table]] = {
    OBJECTS.folder: OBJECT_ROWS,
    KEPT.folder: _table('kept', KEPT, ('bucket', 'key', 'where', 'bytes'), 't_start_ns'),
    FORGOTTEN.folder: _table('forgotten', FORGOTTEN, ('bucket', 'key'), 't_start_ns'),
    GAPS.folder: _table('gaps', GAPS, ('id', 'revision', 'what', 'from_ns', 'to_ns'), 'to_ns', 't_to'),
    STATISTICS.folder: _table('statistics', STATISTICS, ('bucket', 'key', 't_start_ns', 'field'), 't_start_ns'),
    MISSION_ROWS.name: MISSION_ROWS,
    LABELS.folder: _table('labels', LABELS, ('id', 'made_ns', 'what'), 'since_ns', 'made'),
}
"""The tables by the folder of their row files in the store; ``missions``, which has no row files, by its name."""
SCHEMAS: Final[Mapping[str, TableSchema]] = {
    each.folder: each for each in (OBJECTS, KEPT, FORGOTTEN, GAPS, STATISTICS, LABELS)
}  # fmt: skip


def narrow(columns: Iterable[str], of: TableSchema = OBJECTS) -> pa.Schema:
    """The schema of a table with only these columns."""
    schema = TABLES[of.folder].schema
    return pa.schema([schema.field(name) for name in columns])


class TableVersion(NamedTuple):
    """A version of a table, up to which a reader has read its changes."""

    table: str
    """The table's id, which changes when the table is recreated."""
    number: int


class Conflict(Exception):
    """Another process added rows since the table was opened: reopen it and determine the missing rows again."""


@dataclass(frozen=True, slots=True)
class Tables:
    """The tables of one store. A value: every call opens the tables that it needs.

    Raises only StoreError, LakeError and Conflict.
    """

    root: str
    """A folder, or a URL such as ``s3://lake``."""
    server: StoreSettings | None = field(default=None, repr=False)
    """The S3 server of shared tables; None for local ones."""

    @property
    def is_shared(self) -> bool:
        return self.server is not None

    @classmethod
    def of(cls, source: Bucket) -> Tables:
        """The tables of a bucket's store: the shared ones if they exist, otherwise local ones. Raises StoreError."""
        if source.settings.endpoint_url:
            shared = cls.shared(source.settings)
            if shared.exists(INGESTED):
                return shared
        return cls.local(source)

    @classmethod
    def for_ingest(cls, source: Bucket) -> Tables:
        """The tables into which the rows of this bucket are ingested, created if missing. Raises StoreError, LakeError."""
        if source.settings.endpoint_url:
            found = cls.shared(source.settings)
            try:
                found.create()
            except LakeError as error:
                if NO_BUCKET not in str(error):
                    raise
            else:
                return found
        found = cls.local(source)
        found.create()
        return found

    @classmethod
    def shared(cls, settings: StoreSettings) -> Tables:
        """The tables in the bucket ``lake`` of an S3 server, which may not exist yet."""
        return cls(f's3://{BUCKET}', settings)

    @classmethod
    def local(cls, source: Bucket) -> Tables:
        """This user's tables for one bucket."""
        place = source.settings.endpoint_url or str(source.settings.directory.absolute())
        name = hashlib.sha256(f'{place}\n{source.name}'.encode()).hexdigest()[:16]
        return cls(str(home(os.environ) / 'lake' / name))

    def exists(self, table: Table) -> bool:
        """Whether a table exists; False also if its bucket does not exist or must not be read. Raises StoreError."""
        if self.server is None:
            return Path(self._uri(table), LOG).is_dir()
        bucket, _, prefix = f'{self.root.removeprefix("s3://")}/'.partition('/')
        try:  # not DeltaTable.is_deltatable(), which holds the GIL while it waits
            return LOG in Bucket(self.server, bucket).folders(f'{prefix}{table.name}/')
        except (AccessDenied, BucketMissing):
            return False

    def create(self) -> None:
        """Create missing tables; ``ingested`` last, because its existence means that all others exist."""
        with translated():
            for table in (*TABLES.values(), INGESTED):
                if not self.exists(table):
                    if not self.is_shared:
                        Path(self._uri(table)).mkdir(parents=True, exist_ok=True)
                    DeltaTable.create(
                        self._uri(table), table.schema, mode='ignore', partition_by=list(table.partitions),
                        storage_options=self._options(), configuration=_KEPT,
                    )  # fmt: skip

    def open(self, table: Table, as_of: datetime | int | None = None) -> DeltaTable:
        """Open a table at its newest version, at the version of a time, or at a version by number."""
        with translated():
            found = DeltaTable(self._uri(table), storage_options=self._options())
            if as_of is not None:
                found.load_as_version(as_of)
            return found

    def append(self, opened: DeltaTable, table: Table, rows: pa.Table) -> None:
        """Add rows that the opened version does not have. Raises Conflict if another process has added rows since then."""
        if not len(rows):
            return
        version = (opened.transaction_version(INGEST) or 0) + 1
        with translated():
            write_deltalake(
                opened, rows, mode='append', partition_by=list(table.partitions), writer_properties=writer(),
                commit_properties=CommitProperties(app_transactions=[Transaction(INGEST, version)]),
            )  # fmt: skip

    def added(self, table: Table, since: TableVersion | None = None) -> Iterator[tuple[pa.RecordBatch | None, TableVersion]]:
        """The rows added after a version, some versions at a time; a batch of None means that all up to its version were yielded.

        Yields all rows of the newest version if ``since`` is the version of another table, or if its files were deleted.
        """
        opened = self.open(table)
        newest = TableVersion(str(opened.metadata().id), opened.version())
        first = since.number + 1 if since is not None and since.table == newest.table else 0
        for start in range(first, newest.number + 1, VERSIONS_AT_A_TIME):
            last = min(start + VERSIONS_AT_A_TIME - 1, newest.number)
            try:
                with translated():
                    changes = opened.load_cdf(starting_version=start, ending_version=last)
                    for batch in pa.RecordBatchReader.from_stream(changes):
                        rows = batch.filter(pc.equal(batch['_change_type'], 'insert')).select(table.schema.names)
                        yield rows.cast(_plain(rows.schema)), newest
            except LakeError:
                with engine({table.name: opened}) as ready:
                    for batch in batches(ready, f'SELECT * FROM {table.name}'):  # noqa: S608 - our own name
                        yield batch, newest
                yield None, newest
                return
            yield None, TableVersion(newest.table, last)

    def delete_local(self) -> None:
        """Delete local tables; they are rebuilt from the store when needed."""
        if not self.is_shared:
            shutil.rmtree(self.root, ignore_errors=True)

    def _uri(self, table: Table) -> str:
        return f'{self.root}/{table.name}'

    def _options(self) -> dict[str, str] | None:
        return None if self.server is None else storage_options(self.server)


def storage_options(settings: StoreSettings) -> dict[str, str]:
    """The options of delta-rs. Commits are conditional puts that fail if the version exists; no other coordination is needed."""
    allow_http = urlsplit(settings.endpoint_url or '').scheme != 'https'  # otherwise a redirect could lead to plain HTTP
    options = {
        'AWS_ENDPOINT_URL': settings.endpoint_url or '', 'AWS_REGION': settings.region, 'AWS_ALLOW_HTTP': str(allow_http).lower(),
        'AWS_VIRTUAL_HOSTED_STYLE_REQUEST': 'false', 'conditional_put': 'etag',
        'connect_timeout': '5s', 'timeout': '60s', 'retry_timeout': '60s', **proxy_options(settings.endpoint_url or ''),
    }  # fmt: skip
    if not settings.access_key_id:
        from shadowhound_data_logger.stores.credentials import with_keys  # noqa: PLC0415 - botocore takes a while

        settings = with_keys(settings)
    if settings.access_key_id and settings.secret_access_key:
        options |= {'AWS_ACCESS_KEY_ID': settings.access_key_id, 'AWS_SECRET_ACCESS_KEY': settings.secret_access_key}
    if settings.session_token:
        options['AWS_SESSION_TOKEN'] = settings.session_token
    return options


def writer() -> WriterProperties:
    """The options for writing all files of the tables."""
    return WriterProperties(compression='ZSTD', max_row_group_size=GROUP_ROWS)


# -- the engine ----------------------------------------------------------------------------------------------------------------


@contextmanager
def engine(views: Mapping[str, DeltaTable | pa.Table]) -> Iterator[QueryBuilder]:
    """An engine with these tables; rows in memory are written to a temporary table, which takes about 4 ms."""
    with tempfile.TemporaryDirectory(prefix='shadowhound-lake-') as folder:
        found = QueryBuilder()
        for name, view in views.items():
            table = view
            if not isinstance(table, DeltaTable):
                write_deltalake(f'{folder}/{name}', table, writer_properties=WriterProperties(compression='UNCOMPRESSED'))
                table = DeltaTable(f'{folder}/{name}')
            found.register(name, table)
        yield found


def batches(opened: QueryBuilder, sql: str) -> Iterator[pa.RecordBatch]:
    """The result, in batches. Raises LakeError for invalid SQL or an unknown column."""
    with translated():
        found = pa.RecordBatchReader.from_stream(opened.execute(sql))
        schema = _plain(found.schema)
        for batch in found:
            yield batch.cast(schema)


def answer(opened: QueryBuilder, sql: str) -> pa.Table:
    """The complete result. Raises LakeError."""
    with translated():
        found = pa.RecordBatchReader.from_stream(opened.execute(sql))
        return found.read_all().cast(_plain(found.schema))


def missing(opened: DeltaTable, table: Table, rows: pa.Table) -> pa.Table:
    """The rows that the opened version of the table does not have, without duplicates."""
    if not len(rows):
        return rows
    names = [*table.partitions, *table.identity]
    where = [among(f'"{name}"', rows[name].unique().to_pylist()) for name in table.partitions]
    first, last = (pc.min_max(rows[table.time])[end].as_py() for end in ('min', 'max'))
    if first is not None and not rows[table.time].null_count and isinstance(first, int):
        where.append(f'"{table.time}" BETWEEN {first} AND {last}')
    columns = ', '.join(map(quoted, names))
    with engine({'known': opened}) as ready:
        known = answer(ready, f'SELECT {columns} FROM known WHERE {" AND ".join(where)}')  # noqa: S608 - names and quoted literals
    new = rows.select(names)
    # Grouping, unlike a join, treats nulls as equal. Known rows have negative numbers, so groups that contain one are dropped.
    every = pa.concat_tables([known.cast(new.schema), new])
    every = every.append_column('_row', pa.array(range(-len(known), len(new)), pa.int64()))
    places = every.group_by(names).aggregate([('_row', 'min')])['_row_min']
    return rows.take(places.filter(pc.greater_equal(places, 0)).combine_chunks().sort())


def among(column: str, values: Iterable[Any]) -> str:
    """A condition in SQL: the column is one of these texts or numbers; None stands for null."""
    found = list(values)
    known = ', '.join(literal(value) for value in found if value is not None)
    either = ([f'{column} IN ({known})'] if known else []) + ([f'{column} IS NULL'] if None in found else [])
    return f'({" OR ".join(either) or "false"})'


def literal(value: str | float) -> str:
    """A text or a number in SQL."""
    if isinstance(value, str):
        return "'" + value.replace("'", "''") + "'"
    return repr(value)


def quoted(name: str) -> str:
    """The name of a column in SQL."""
    return '"' + name.replace('"', '""') + '"'


def _plain(schema: pa.Schema) -> pa.Schema:
    """The schema with plain strings instead of the engine's string views."""
    kinds = {pa.string_view(): pa.string(), pa.binary_view(): pa.binary()}
    return pa.schema([each.with_type(kinds.get(each.type, each.type)) for each in schema])


@contextmanager
def translated() -> Iterator[None]:
    """Translate the library's exceptions: a failed commit to Conflict, others to LakeError."""
    try:
        yield
    except CommitFailedError as error:
        raise Conflict(str(error)) from error
    except TableNotFoundError as error:
        raise LakeError(f'the lake has no such table: {_text(error)}') from error
    except (DeltaError, pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        raise LakeError(f'the query cannot be answered: {_text(error)}') from error
    except OSError as error:
        raise LakeError(f'the tables of the lake cannot be read: {_text(error)}') from error


def _text(error: Exception) -> str:
    return ' '.join(_COLORS.sub('', str(error)).split())[:400]
