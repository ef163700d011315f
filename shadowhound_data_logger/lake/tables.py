"""The lake's Delta tables: where they are, their schemas, and the SQL engine that reads them (docs/decisions/0025).

Robots write rows; only the lake writes tables. On an S3 server with a bucket ``lake`` the tables are shared: every reader opens
the same ones. Otherwise they are below ``SHADOWHOUND_HOME/lake/``, one folder for each store, and can be deleted at any time.
All tables are partitioned by date (UTC) and robot, and a row is never stored twice: its identity tells it from all others.
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

import pyarrow as pa
import pyarrow.compute as pc
from deltalake import CommitProperties, DeltaTable, QueryBuilder, Transaction, WriterProperties, write_deltalake
from deltalake.exceptions import CommitFailedError, DeltaError, TableNotFoundError

from shadowhound_data_logger.core.config import home
from shadowhound_data_logger.core.errors import AccessDenied, BucketMissing, LakeError
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows.gaps import GAPS
from shadowhound_data_logger.formats.rows.labels import LABELS
from shadowhound_data_logger.formats.rows.schema import DOUBLE, FORGOTTEN, INT32, INT64, KEPT, OBJECTS, STRING, TIME, TableSchema
from shadowhound_data_logger.formats.rows.statistics import STATISTICS
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.stores.s3_obstore import proxy_options

BUCKET: Final = 'lake'
"""Of the shared tables; robots cannot write it."""
NO_BUCKET: Final = 'NoSuchBucket'
"""S3's own word, in what a put to a bucket that does not exist is answered with."""
_COLORS: Final = re.compile(r'\x1b\[\d*m|\u21b3')
"""In the library's messages, which are made for terminals."""
LOG: Final = '_delta_log'
"""The folder that makes a folder a table."""
DATE, ROBOT, PART = 'date', 'robot', 'part'
PARTITIONS: Final = (DATE, ROBOT)
INGEST: Final = 'ingest'
"""The application of the Delta transactions that add rows: of two that start from the same version, one fails."""
VERSIONS_AT_A_TIME: Final = 50
"""Of a table's changes that are read together."""
GROUP_ROWS: Final = 16_384
"""Of a row group: statistics can rule out whole groups."""
_KEPT: Final = {
    'delta.enableChangeDataFeed': 'true', 'delta.deletedFileRetentionDuration': 'interval 30 days',
    'delta.logRetentionDuration': 'interval 30 days',
}  # fmt: skip
"""For so long a table can be read as of a time in the past; vacuum deletes no file that a newer version needs."""
_KINDS: Final = {
    STRING: pa.string(), INT32: pa.int32(), INT64: pa.int64(), DOUBLE: pa.float64(), TIME: pa.timestamp('us', tz='UTC'),
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """One table: its name in SQL, its columns and what tells its rows apart."""

    name: str
    schema: pa.Schema
    identity: tuple[str, ...]
    """Columns; a row in which all of them are equal is the same row."""
    time: str
    """The column by which its files are ordered."""
    dated: str
    """The time whose UTC date is the row's partition; a row without it belongs to 1970-01-01."""
    partitions: tuple[str, ...] = PARTITIONS


def arrow_schema(of: TableSchema = OBJECTS) -> pa.Schema:
    """The columns of rows of a table, as they are in row files."""
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
"""Which row files the other tables contain: a row here is committed after all rows of its file."""
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
"""How missions ended (lake/summaries.py). No row file has its rows: ingest makes them of the missions' summaries."""
TABLES: Final[Mapping[str, Table]] = {
    OBJECTS.folder: OBJECT_ROWS,
    KEPT.folder: _table('kept', KEPT, ('bucket', 'key', 'where', 'bytes'), 't_start_ns'),
    FORGOTTEN.folder: _table('forgotten', FORGOTTEN, ('bucket', 'key'), 't_start_ns'),
    GAPS.folder: _table('gaps', GAPS, ('id', 'revision', 'what', 'from_ns', 'to_ns'), 'to_ns', 't_to'),
    STATISTICS.folder: _table('statistics', STATISTICS, ('bucket', 'key', 't_start_ns', 'field'), 't_start_ns'),
    MISSION_ROWS.name: MISSION_ROWS,
    LABELS.folder: _table('labels', LABELS, ('id', 'made_ns', 'what'), 'since_ns', 'made'),
}
"""By the folder of the row files in the store; that of missions, which have none, by its name."""
SCHEMAS: Final[Mapping[str, TableSchema]] = {
    each.folder: each for each in (OBJECTS, KEPT, FORGOTTEN, GAPS, STATISTICS, LABELS)
}  # fmt: skip


def narrow(columns: Iterable[str], of: TableSchema = OBJECTS) -> pa.Schema:
    """The schema of these columns of a table."""
    schema = TABLES[of.folder].schema
    return pa.schema([schema.field(name) for name in columns])


class TableVersion(NamedTuple):
    """How far a reader of a table's changes has come."""

    table: str
    """The table's own id."""
    number: int


class Conflict(Exception):
    """Another process added rows since the table was opened: open it again and look which rows are still missing."""


@dataclass(frozen=True, slots=True)
class Tables:
    """The tables of one store. A value: every call opens what it needs.

    Nothing but a StoreError, LakeError or Conflict leaves it.
    """

    root: str
    """A folder, or a URL such as ``s3://lake``."""
    server: StoreSettings | None = field(default=None, repr=False)
    """The S3 server of tables that are shared with other machines."""

    @property
    def is_shared(self) -> bool:
        return self.server is not None

    @classmethod
    def of(cls, source: Bucket) -> Tables:
        """Those of the store of this bucket: the shared ones if the server has them. Raises StoreError."""
        if source.settings.endpoint_url:
            shared = cls.shared(source.settings)
            if shared.exists(INGESTED):
                return shared
        return cls.local(source)

    @classmethod
    def for_ingest(cls, source: Bucket) -> Tables:
        """Those that rows of this bucket are ingested into, created where they do not exist yet. Raises StoreError, LakeError."""
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
        """Those in the bucket ``lake`` of an S3 server, whether or not they exist yet."""
        return cls(f's3://{BUCKET}', settings)

    @classmethod
    def local(cls, source: Bucket) -> Tables:
        """Those of this user for one bucket."""
        place = source.settings.endpoint_url or str(source.settings.directory.absolute())
        name = hashlib.sha256(f'{place}\n{source.name}'.encode()).hexdigest()[:16]
        return cls(str(home(os.environ) / 'lake' / name))

    def exists(self, table: Table) -> bool:
        """False as well for a bucket that does not exist or may not be read. Raises StoreError."""
        if self.server is None:
            return Path(self._uri(table), LOG).is_dir()
        bucket, _, prefix = f'{self.root.removeprefix("s3://")}/'.partition('/')
        try:  # DeltaTable.is_deltatable() holds the interpreter's lock while it waits
            return LOG in Bucket(self.server, bucket).folders(f'{prefix}{table.name}/')
        except (AccessDenied, BucketMissing):
            return False

    def create(self) -> None:
        """The tables that do not exist yet; the one that says that all others do comes last."""
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
        """A table at its newest version, at that of a time, or at a version by number."""
        with translated():
            found = DeltaTable(self._uri(table), storage_options=self._options())
            if as_of is not None:
                found.load_as_version(as_of)
            return found

    def append(self, opened: DeltaTable, table: Table, rows: pa.Table) -> None:
        """Add rows that the opened version lacks. Raises Conflict if another process added rows since it was opened."""
        if not len(rows):
            return
        version = (opened.transaction_version(INGEST) or 0) + 1
        with translated():
            write_deltalake(
                opened, rows, mode='append', partition_by=list(table.partitions), writer_properties=writer(),
                commit_properties=CommitProperties(app_transactions=[Transaction(INGEST, version)]),
            )  # fmt: skip

    def added(self, table: Table, since: TableVersion | None = None) -> Iterator[tuple[pa.RecordBatch | None, TableVersion]]:
        """The rows added after a version, some versions at a time; a batch of None says that all up to a version were yielded.

        All rows of the newest version for another table than the version is of, or if its files were deleted meanwhile.
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
        """Local tables are derived from the store: they are made again when they are needed."""
        if not self.is_shared:
            shutil.rmtree(self.root, ignore_errors=True)

    def _uri(self, table: Table) -> str:
        return f'{self.root}/{table.name}'

    def _options(self) -> dict[str, str] | None:
        return None if self.server is None else storage_options(self.server)


def storage_options(settings: StoreSettings) -> dict[str, str]:
    """As delta-rs has them. Commits are puts that fail if the version exists, so they need no other coordination."""
    options = {
        'AWS_ENDPOINT_URL': settings.endpoint_url or '', 'AWS_REGION': settings.region, 'AWS_ALLOW_HTTP': 'true',
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
    """How all files of the tables are written."""
    return WriterProperties(compression='ZSTD', max_row_group_size=GROUP_ROWS)


# -- the engine ----------------------------------------------------------------------------------------------------------------


@contextmanager
def engine(views: Mapping[str, DeltaTable | pa.Table]) -> Iterator[QueryBuilder]:
    """An engine that knows these tables; rows in memory are written to a temporary table, which takes some 4 ms."""
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
    """The answer piece by piece, as it is computed. Raises LakeError for what is not SQL or names no column."""
    with translated():
        found = pa.RecordBatchReader.from_stream(opened.execute(sql))
        schema = _plain(found.schema)
        for batch in found:
            yield batch.cast(schema)


def answer(opened: QueryBuilder, sql: str) -> pa.Table:
    """The whole answer. Raises LakeError."""
    with translated():
        found = pa.RecordBatchReader.from_stream(opened.execute(sql))
        return found.read_all().cast(_plain(found.schema))


def missing(opened: DeltaTable, table: Table, rows: pa.Table) -> pa.Table:
    """The first of each of these rows that the table does not have at the opened version."""
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
    # A group, unlike a join, has nulls that are equal: known rows come first, so that the groups they are in begin below zero.
    every = pa.concat_tables([known.cast(new.schema), new])
    every = every.append_column('_row', pa.array(range(-len(known), len(new)), pa.int64()))
    places = every.group_by(names).aggregate([('_row', 'min')])['_row_min']
    return rows.take(places.filter(pc.greater_equal(places, 0)).combine_chunks().sort())


def among(column: str, values: Iterable[Any]) -> str:
    """A condition in SQL: one of these texts or numbers, None among them."""
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
    """The engine's views of texts as texts."""
    kinds = {pa.string_view(): pa.string(), pa.binary_view(): pa.binary()}
    return pa.schema([each.with_type(kinds.get(each.type, each.type)) for each in schema])


@contextmanager
def translated() -> Iterator[None]:
    """Errors of the library as ours: Conflict for a commit that another one prevented, else LakeError."""
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
