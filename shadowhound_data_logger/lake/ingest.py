"""Ingests the row files of robots into the tables of the lake: each row exactly once, despite kills and concurrent ingesters.

A row file is read, checked and committed to its table; then a row in the table ``ingested`` records it. Rows that a table already
has are not added again, so a file may be read twice: after a kill between the two commits, or by two ingesters at the same time.
Commits that add rows carry a Delta application transaction: of two ingesters that start from the same version, one fails, reopens
the table and adds the rows that are still missing.

On a shared lake, row files are deleted after a grace period in the tables. A reader lists the row files before it opens the
tables, so a file that is deleted in between is in its version of the tables.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass, replace
from datetime import datetime, timedelta, timezone
from typing import Final, NamedTuple

import pyarrow as pa
import pyarrow.compute as pc
from deltalake import DeltaTable

from shadowhound_data_logger.core.clock import utc
from shadowhound_data_logger.core.errors import AccessDenied, LakeError
from shadowhound_data_logger.formats.rows.catalog import FORGOTTEN, OBJECTS, UNDATED, Row, TableSchema
from shadowhound_data_logger.lake import summaries
from shadowhound_data_logger.lake.bucket import THREADS, Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.row_files import RowFile, RowsOfFile, Scope, as_table, read, row_files
from shadowhound_data_logger.lake.tables import (
    DATE,
    INGESTED,
    MISSION_ROWS,
    OBJECT_ROWS,
    PART,
    ROBOT,
    SCHEMAS,
    TABLES,
    Conflict,
    Table,
    Tables,
    among,
    answer,
    engine,
    literal,
    missing,
    translated,
    writer,
)

GRACE: Final = timedelta(hours=1)
"""How long row files are kept after their commit: longer than any query runs."""
BATCH_FILES: Final = 2000
BATCH_BYTES: Final = 16 << 20
"""Row files committed together; decompressed they take about ten times as much."""
ROWS_AT_A_TIME: Final = 8192
FEW_FILES: Final = 8
"""In a partition of the current day; more files are merged."""
TRIES: Final = 20
"""Attempts to commit while other ingesters do the same."""
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Ingested:
    """The result of one run."""

    files: int = 0
    rows: int = 0
    """Rows that were added."""
    repeated: int = 0
    """Rows that the tables already had."""
    rejected: int = 0
    unknown: int = 0
    """Rows with columns that this version does not know; the columns were ignored."""

    def __add__(self, other: Ingested) -> Ingested:
        return Ingested(*map(sum, zip(astuple(self), astuple(other), strict=True)))


def ingest(source: Bucket, tables: Tables, findings: Findings, files: Sequence[RowFile] | None = None) -> Ingested:
    """Commit these row files, or all that are not in the tables yet. Raises StoreError, LakeError."""
    if files is None:
        listed = row_files(
            source, findings, Scope()
        )  # before the tables are opened: they have what is ingested during the listing
        files = pending(tables.open(INGESTED), listed)
    done = Ingested()
    for batch in _batched(files):
        done += _commit(source, tables, batch, findings)
    return done


def pending(opened: DeltaTable, files: Sequence[RowFile]) -> list[RowFile]:
    """The row files that are not in this version of ``ingested``. Raises LakeError."""
    dates = {file.date for file in files}
    return unknown_of(files, known_files(opened, Scope(has_date=dates.__contains__)) if files else ())


class KnownFile(NamedTuple):
    """A row file that was ingested."""

    part: str
    """Its key."""
    etag: str
    rejected: int
    """Rows that were rejected; 1 for a file that is not a row file."""
    why: str | None


def unknown_of(files: Sequence[RowFile], known: Iterable[KnownFile]) -> list[RowFile]:
    """The row files that are not among the known ones."""
    names = {(each.part, each.etag) for each in known}
    return [file for file in files if (file.entry.key, file.entry.etag) not in names]


def known_files(opened: DeltaTable, scope: Scope, where: str = 'true') -> list[KnownFile]:
    """The row files of a scope that are in this version of ``ingested``. Raises LakeError."""
    conditions = [where]
    if scope.has_date is not None:
        conditions.append(among(DATE, filter(scope.has_date, {each[DATE] for each in opened.partitions()})))
    if scope.robot is not None:
        conditions.append(f'{ROBOT} = {literal(scope.robot)}')
    columns = ', '.join(KnownFile._fields)
    with engine({'ingested': opened}) as ready:
        found = answer(ready, f'SELECT {columns} FROM ingested WHERE {" AND ".join(conditions)}')  # noqa: S608 - quoted literals
    folders = {each.folder for each in scope.tables}
    files = map(KnownFile._make, zip(*(column.to_pylist() for column in found.columns), strict=True))
    return [each for each in files if not folders.isdisjoint(each.part.split('/', 2)[:2])]


def fresh(source: Bucket, files: Sequence[RowFile], opened: DeltaTable, of: TableSchema, findings: Findings) -> pa.Table:
    """The rows of these files that the opened table does not have yet. Raises StoreError, LakeError."""
    files = [file for file in files if file.of is of]
    return missing(opened, TABLES[of.folder], pa.concat_tables(_tables(of, read(source, files, findings), [])))


def _tables(of: TableSchema, found: Iterable[RowsOfFile], records: list[Row]) -> Iterator[pa.Table]:
    """The rows of files as tables of some thousand rows, which take a tenth of the memory. Appends a record of each file."""
    rows: list[Row] = []
    for file, of_file, rejected, why, unknown in found:
        records.append({
            DATE: file.date, ROBOT: file.robot, PART: file.entry.key, 'etag': file.entry.etag, 'rows': len(of_file),
            'rejected': rejected, 'unknown': unknown, 'why': why,
        })  # fmt: skip
        rows += of_file
        if len(rows) >= ROWS_AT_A_TIME:
            yield as_table(of, rows)
            rows = []
    yield as_table(of, rows)


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


def _commit(source: Bucket, tables: Tables, files: Sequence[RowFile], findings: Findings) -> Ingested:
    """Commit the rows first, then the record that they are in the tables."""
    done, records = Ingested(files=len(files)), list[Row]()
    for of in dict.fromkeys(file.of for file in files):
        found = read(source, [file for file in files if file.of is of], findings)
        rows = pa.concat_tables(_tables(of, found, records))
        added = _add(tables, TABLES[of.folder], rows)
        if of is OBJECTS:
            _add_missions(source, tables, rows)
        done = replace(done, rows=done.rows + added, repeated=done.repeated + len(rows) - added)
    now = datetime.now(timezone.utc)
    _add(tables, INGESTED, pa.Table.from_pylist([{**each, 'ingested': now} for each in records], schema=INGESTED.schema))
    counts = {name: sum(each[name] for each in records) for name in ('rejected', 'unknown')}
    return replace(done, **counts)


def _add_missions(source: Bucket, tables: Tables, rows: pa.Table) -> None:
    """Add how the missions ended whose runs these rows of objects name, if it is known."""
    named = rows.filter(pc.is_valid(rows['run_id'])).group_by([ROBOT, 'run_id']).aggregate([])
    runs = {*zip(named[ROBOT].to_pylist(), named['run_id'].to_pylist(), strict=True)}
    if runs:
        there = summaries.known(runs, tables)
        runs -= {*zip(there[ROBOT].to_pylist(), there['run_id'].to_pylist(), strict=True)}
        _add(tables, MISSION_ROWS, summaries.uploaded(source, runs))


def _add(tables: Tables, table: Table, rows: pa.Table) -> int:
    """Add the rows that the table lacks; returns their number. Raises LakeError."""
    for _ in range(TRIES):
        opened = tables.open(table)
        new = missing(opened, table, rows)
        try:
            tables.append(opened, table, new)
        except Conflict:
            log.debug('another process added rows to %s: trying again', table.name)
        else:
            return len(new)
    raise LakeError(f'other ingesters kept adding rows to {table.name}', remedy='try again')


# -- state ---------------------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class RobotState:
    """What the tables contain about one robot."""

    robot: str
    days: int = 0
    """UTC dates with objects."""
    first: str | None = None
    last: str | None = None
    objects: int = 0
    """Rows of the table ``objects``, including those of deleted objects."""
    rows: int = 0
    """Rows of all tables."""
    waiting: int = 0
    """Row files that are not in the tables yet."""
    rejected: int = 0
    """Rejected rows of files that still exist."""


def states(source: Bucket, findings: Findings, robot: str | None = None) -> list[RobotState]:
    """The state of one robot or of all, by name. Reads only the tables' logs, not their rows. Raises StoreError, LakeError."""
    tables = Tables.of(source)
    listed = row_files(source, findings, Scope(robot=robot))
    found: dict[str, RobotState] = {}

    def of(name: str) -> RobotState:
        return found.setdefault(name, RobotState(name))

    waiting = listed
    if tables.exists(INGESTED):
        waiting = pending(tables.open(INGESTED), listed)
        for name, dates, count, table in _counted(tables):
            state = of(name)
            state.rows += count
            if table is OBJECT_ROWS:
                state.objects, state.days = count, len(dates)
                state.first, state.last = min(dates, default=None), max(dates, default=None)
        there = {file.entry.key: file.robot for file in listed}
        for each in known_files(tables.open(INGESTED), Scope(robot=robot), 'rejected > 0'):
            if each.part in there:
                of(there[each.part]).rejected += each.rejected
    for file in waiting:
        of(file.robot).waiting += 1
    return [state for name, state in sorted(found.items()) if robot in {None, name}]


def _counted(tables: Tables) -> Iterator[tuple[str, set[str], int, Table]]:
    """(robot, dates without that of undated rows, rows, table), from the statistics of the tables' files."""
    for table in TABLES.values():
        files = pa.table(tables.open(table).get_add_actions(flatten=True))
        robots: dict[str, tuple[set[str], int]] = {}
        if len(files):
            for date, name, count in zip(*(files[f].to_pylist() for f in ('partition.date', 'partition.robot', 'num_records')),
                                         strict=True):  # fmt: skip
                dates, so_far = robots.get(name, (set(), 0))
                robots[name] = dates | ({date} - {UNDATED}), so_far + count
        yield from ((name, dates, count, table) for name, (dates, count) in robots.items())


# -- upkeep --------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Upkeep:
    """The result of one round of upkeep."""

    merged: int = 0
    """Files of tables that were merged into larger ones."""
    expired: int = 0
    """Row files deleted."""
    denied: int = 0
    """Row files that the credentials must not delete."""
    vacuumed: int = 0
    """Deleted files of tables that no kept version uses."""


def maintain(
    source: Bucket, tables: Tables, findings: Findings, *, grace: timedelta | None = GRACE, now: datetime | None = None
) -> Upkeep:
    """Merge and sort the files of tables, expire row files, and delete files of old versions. Raises StoreError, LakeError."""
    now = now or datetime.now(timezone.utc)
    merged = sum(_merge(tables, table, f'{utc(time.time_ns()):%Y-%m-%d}') for table in (*TABLES.values(), INGESTED))
    expired, denied = (0, 0)
    if tables.is_shared and grace is not None:
        expired, denied = _expire(source, tables, findings, now - grace)
    vacuumed = sum(len(tables.open(table).vacuum(dry_run=False)) for table in (*TABLES.values(), INGESTED))
    return Upkeep(merged, expired, denied, vacuumed)


def _merge(tables: Tables, table: Table, today: str) -> int:
    """Merge all files of a partition into one, ordered by time, if its day has ended; otherwise only if there are many."""
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
        except Conflict:  # prune deleted rows of this partition; the next round merges it
            continue
        merged += each['path_count']
    return merged


def _expire(source: Bucket, tables: Tables, findings: Findings, before: datetime) -> tuple[int, int]:
    """Delete row files that were completely ingested before this time; returns how many were and could not be deleted.

    Keeps the row files about deleted objects: from them, ``lake prune`` continues an unfinished deletion.
    """
    listed = row_files(source, findings, Scope(tuple(of for of in SCHEMAS.values() if of is not FORGOTTEN)))
    stamp = literal(before.strftime('%Y-%m-%dT%H:%M:%S.%fZ'))
    known = known_files(tables.open(INGESTED), Scope(), f'rejected = 0 AND "unknown" = 0 AND ingested < {stamp}')
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
