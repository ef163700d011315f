"""From the row files of robots to the tables of the lake: each row once, whatever is killed and whoever else ingests.

A row file is read, checked and committed to its table; then a row in the table ``ingested`` records it. A row that its table
already has is not added again, so a file may be read twice: after a kill between the two commits, or by two ingesters at a time.
Commits that add rows carry a Delta application transaction: of two ingesters that start from the same version one fails, opens
the table again and adds what is still missing.

On a shared lake row files are deleted once they have been in the tables for a grace period. A reader opens the tables first and
lists the row files afterwards, so what it does not find in a file is in its version of the tables.
"""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from typing import Final, NamedTuple

import pyarrow as pa
import pyarrow.compute as pc
from deltalake import DeltaTable

from shadowhound_data_logger.core.clock import utc
from shadowhound_data_logger.core.errors import AccessDenied, LakeError, ObjectRefused
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.formats.rows.schema import SUFFIX, UNDATED, TableSchema
from shadowhound_data_logger.lake import reading
from shadowhound_data_logger.lake.bucket import THREADS, Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.tables import (
    DATE,
    INGESTED,
    PART,
    ROBOT,
    SCHEMAS,
    TABLES,
    Conflict,
    Table,
    Tables,
    answer,
    engine,
    literal,
    missing,
    translated,
    writer,
)

GRACE: Final = timedelta(hours=1)
"""For so long row files stay after their commit: longer than any query runs."""
BATCH_FILES: Final = 2000
BATCH_BYTES: Final = 16 << 20
"""Of row files that are committed together; they unpack to some ten times as much."""
FEW_FILES: Final = 8
"""In a partition of a day that has not ended; with more they are merged."""
TRIES: Final = 20
"""Of a commit that other ingesters get in the way of."""
_FOLDER: Final = re.compile(r'date=(\d{4}-\d\d-\d\d)', re.ASCII)
log = logging.getLogger(__name__)


class RowFile(NamedTuple):
    """One file of rows in the store."""

    of: TableSchema
    robot: str
    date: str
    entry: ObjectInfo


@dataclass(frozen=True, slots=True)
class Scope:
    """Which row files a query needs."""

    tables: Sequence[TableSchema] = tuple(SCHEMAS.values())
    robot: str | None = None
    has_date: Callable[[str], bool] | None = None


@dataclass(frozen=True, slots=True)
class Ingested:
    """What one run did."""

    files: int = 0
    rows: int = 0
    """Rows that the tables did not have."""
    repeated: int = 0
    """Rows that they already had."""
    rejected: int = 0

    def __add__(self, other: Ingested) -> Ingested:
        return Ingested(
            self.files + other.files, self.rows + other.rows, self.repeated + other.repeated, self.rejected + other.rejected
        )


class _Read(NamedTuple):
    file: RowFile
    rows: pa.Table
    rejected: int
    why: str | None


def ingest(source: Bucket, tables: Tables, findings: Findings, files: Sequence[RowFile] | None = None) -> Ingested:
    """Commit these row files, or all that are not in the tables yet. Raises StoreError, LakeError."""
    if files is None:
        listed = row_files(source, findings, Scope())  # first: what is ingested during the listing is found in the tables
        files = pending(tables.open(INGESTED), listed)
    done = Ingested()
    for batch in _batched(files):
        done += _commit(tables, [*_read(source, batch, findings)])
    return done


def pending(opened: DeltaTable, files: Sequence[RowFile]) -> list[RowFile]:
    """Of these row files those that a version of ``ingested`` does not name. Raises LakeError."""
    known = {(each.part, each.etag) for each in known_files(opened, {file.date for file in files})} if files else set()
    return [file for file in files if (file.entry.key, file.entry.etag) not in known]


class KnownFile(NamedTuple):
    """A row file that was ingested."""

    date: str
    part: str
    """Its key."""
    etag: str
    rejected: int
    """Rows that were rejected; 1 for a file that is not one."""
    why: str | None

    def is_in(self, scope: Scope) -> bool:
        """Whether a query with this scope needs it."""
        folders = self.part.split('/', 2)[:2]
        return (
            any(each.folder in folders for each in scope.tables)
            and (scope.robot is None or scope.robot in folders)
            and (scope.has_date is None or scope.has_date(self.date))
        )


def known_files(opened: DeltaTable, dates: Collection[str] = (), where: str = 'true') -> Iterator[KnownFile]:
    """The row files that a version of ``ingested`` names. Raises LakeError."""
    among_dates = f'date BETWEEN {literal(min(dates))} AND {literal(max(dates))}' if dates else 'true'
    columns = ', '.join(KnownFile._fields)
    with engine({'ingested': opened}) as ready:
        found = answer(ready, f'SELECT {columns} FROM ingested WHERE {among_dates} AND {where}')  # noqa: S608
    yield from map(KnownFile._make, zip(*(column.to_pylist() for column in found.columns), strict=True))


def fresh(source: Bucket, files: Sequence[RowFile], opened: DeltaTable, of: TableSchema, findings: Findings) -> pa.Table:
    """The rows of these files that an opened table does not have yet. Raises StoreError, LakeError."""
    table = TABLES[of.folder]
    found = [each.rows for each in _read(source, [file for file in files if file.of is of], findings)]
    return missing(opened, table, pa.concat_tables([table.schema.empty_table(), *found]))


def row_files(source: Bucket, findings: Findings, scope: Scope) -> list[RowFile]:
    """All row files in the store, oldest date first. Raises StoreError."""
    robots = [scope.robot] if scope.robot else [name for name in source.folders('') if is_name(name)]
    with ThreadPoolExecutor(THREADS, 'lake-list') as pool:
        pairs = [(of, robot) for of in scope.tables for robot in robots]
        found = pool.map(lambda pair: _listed(source, pair[0], pair[1], scope, findings), pairs)
        return sorted((file for files in found for file in files), key=lambda file: (file.date, file.entry.key))


def _listed(source: Bucket, of: TableSchema, robot: str, scope: Scope, findings: Findings) -> list[RowFile]:
    def skipped(_: str, key: str) -> None:
        findings.add(key, 'its key is not a path')

    prefixes = [of.prefix(robot)]
    try:
        if scope.has_date is not None:
            dates = (_FOLDER.fullmatch(name) for name in source.folders(prefixes[0]))
            prefixes = [f'{prefixes[0]}{date[0]}/' for date in dates if date and scope.has_date(date[1])]
        listed = [entry for prefix in prefixes for entry in source.list(prefix, skipped)]
    except ObjectRefused as error:
        findings.add(of.prefix(robot), f'it cannot be listed: it contains an invalid name: {error}')
        return []
    found = []
    for entry in listed:
        folder = _FOLDER.fullmatch(entry.key.removeprefix(of.prefix(robot)).partition('/')[0])
        if folder and entry.key.endswith(('.parquet', SUFFIX)):
            found.append(RowFile(of, robot, folder[1], entry))
    return found


def _batched(files: Iterable[RowFile]) -> Iterator[list[RowFile]]:
    batch: list[RowFile] = []
    size = 0
    for file in files:
        if batch and (len(batch) == BATCH_FILES or size + file.entry.size > BATCH_BYTES):
            yield batch
            batch, size = [], 0
        batch.append(file)
        size += file.entry.size
    if batch:
        yield batch


def _read(source: Bucket, files: Sequence[RowFile], findings: Findings) -> Iterator[_Read]:
    """Each file with its valid rows. What is rejected is named in the findings. Raises StoreError."""
    with ThreadPoolExecutor(THREADS, 'lake-read') as pool:
        for found, left_out in pool.map(lambda file: _contents(source, file), files):
            for each in left_out:
                findings.add(each.key, each.why, each.rows)
            yield found


def _contents(source: Bucket, file: RowFile) -> tuple[_Read, Findings]:
    table, left_out = TABLES[file.of.folder], Findings(lambda _: None)
    columns = tuple(file.of.columns)
    found = list(reading.tables(source, [file.entry], columns, left_out, of=file.of))
    rows = pa.concat_tables([reading.narrow(columns, file.of).empty_table(), *found])
    robot = pc.fill_null(rows[ROBOT], file.robot)
    rows = rows.set_column(rows.column_names.index(ROBOT), ROBOT, robot)
    dates = pc.fill_null(rows[table.dated].cast(pa.date32()).cast(pa.string()), UNDATED)
    rows = rows.add_column(0, DATE, dates).cast(table.schema)
    rejected = sum(each.rows or 0 for each in left_out) or len(left_out)
    return _Read(file, rows, rejected, next((each.why for each in left_out), None)), left_out


def _commit(tables: Tables, found: Sequence[_Read]) -> Ingested:
    """The rows first, then that they are there."""
    done = Ingested(files=len(found), rejected=sum(each.rejected for each in found))
    for folder, table in TABLES.items():
        rows = [each.rows for each in found if each.file.of.folder == folder and len(each.rows)]
        if rows:
            every = pa.concat_tables(rows)
            added = _add(tables, table, every)
            done = replace(done, rows=done.rows + added, repeated=done.repeated + len(every) - added)
    now = datetime.now(timezone.utc)
    columns = {
        DATE: [each.file.date for each in found], ROBOT: [each.file.robot for each in found],
        PART: [each.file.entry.key for each in found],
        'etag': [each.file.entry.etag for each in found], 'ingested': [now] * len(found),
        'rows': [len(each.rows) for each in found], 'rejected': [each.rejected for each in found],
        'why': [each.why for each in found],
    }  # fmt: skip
    _add(tables, INGESTED, pa.table(columns, schema=INGESTED.schema))
    return done


def _add(tables: Tables, table: Table, rows: pa.Table) -> int:
    """Add what the table lacks; how many rows that were. Raises LakeError."""
    for _ in range(TRIES):
        opened = tables.open(table)
        new = missing(opened, table, rows)
        try:
            tables.append(opened, table, new)
        except Conflict:
            log.debug('another process added rows to %s: looking again', table.name)
        else:
            return len(new)
    raise LakeError(f'other ingesters kept adding rows to {table.name}', remedy='try again')


# -- upkeep --------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Tended:
    """What one round of upkeep did."""

    merged: int = 0
    """Files of tables that became parts of larger ones."""
    expired: int = 0
    """Row files deleted."""
    denied: int = 0
    """Row files that the credentials may not delete."""
    vacuumed: int = 0
    """Files of tables deleted that no version still kept has."""


def tend(
    source: Bucket, tables: Tables, findings: Findings, *, grace: timedelta | None = GRACE, now: datetime | None = None
) -> Tended:
    """Merge and order the files of tables, expire row files, delete files of old versions. Raises StoreError, LakeError."""
    now = now or datetime.now(timezone.utc)
    merged = sum(_merge(tables, table, f'{utc(time.time_ns()):%Y-%m-%d}') for table in (*TABLES.values(), INGESTED))
    expired, denied = (0, 0)
    if tables.is_shared and grace is not None:
        expired, denied = _expire(source, tables, findings, now - grace)
    vacuumed = sum(len(tables.open(table).vacuum(dry_run=False)) for table in (*TABLES.values(), INGESTED))
    return Tended(merged, expired, denied, vacuumed)


def _merge(tables: Tables, table: Table, today: str) -> int:
    """Of a day that has ended, all files of a partition become one, in the order of time; of today's only when there are many."""
    opened = tables.open(table)
    files = pa.table(opened.get_add_actions(flatten=True))
    names = [f'partition.{name}' for name in table.partitions]
    if not len(files):
        return 0
    counts = files.group_by(names).aggregate([('path', 'count')]).to_pylist()
    merged = 0
    for each in counts:
        filters = [(name, '=', each[f'partition.{name}']) for name in table.partitions]
        is_over = each['partition.date'] < today
        if each['path_count'] <= (1 if is_over else FEW_FILES):
            continue
        try:
            fresh_table = tables.open(table)
            with translated():
                if is_over:
                    fresh_table.optimize.z_order([table.time], partition_filters=filters, writer_properties=writer())
                else:
                    fresh_table.optimize.compact(partition_filters=filters, writer_properties=writer())
        except Conflict:  # prune deleted rows of it; the next round merges it
            continue
        merged += each['path_count']
    return merged


def _expire(source: Bucket, tables: Tables, findings: Findings, before: datetime) -> tuple[int, int]:
    """Delete row files without rejected rows that were ingested before then: how many were, and how many could not be."""
    listed = row_files(source, findings, Scope())
    stamp = literal(before.strftime('%Y-%m-%dT%H:%M:%S.%fZ'))
    known = known_files(tables.open(INGESTED), where=f'rejected = 0 AND ingested < {stamp}')
    parts = {each.part for each in known}
    old = [file for file in listed if file.entry.key in parts]

    def delete(file: RowFile) -> bool:
        try:
            source.delete(file.entry.key)
        except AccessDenied:
            return False
        return True

    with ThreadPoolExecutor(THREADS, 'lake-expire') as pool:
        deleted = sum(pool.map(delete, old))
    return deleted, len(old) - deleted
