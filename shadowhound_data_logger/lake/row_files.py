"""Lists and reads the row files in the store (formats/rows/parts.py).

They are ``<robot>/<folder of the table>/date=YYYY-MM-DD/<name>.jsonl.zst``, written by a robot, or by a workstation for it.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final, NamedTuple

import pyarrow as pa
import pyarrow.compute as pc

from shadowhound_data_logger.core.errors import ObjectRefused
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.core.untrusted import check_size, is_path
from shadowhound_data_logger.formats.rows.catalog import OBJECTS, SUFFIX, UNDATED, Row, TableSchema
from shadowhound_data_logger.formats.rows.parts import MAX_FILE_BYTES, read_rows, rows_are
from shadowhound_data_logger.lake.bucket import THREADS, Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.tables import DATE, ROBOT, SCHEMAS, TABLES, arrow_schema

_FOLDER: Final = re.compile(r'date=(\d{4}-\d\d-\d\d)', re.ASCII)


class RowFile(NamedTuple):
    """One file of rows in the store."""

    of: TableSchema
    robot: str
    date: str
    entry: ObjectInfo


@dataclass(frozen=True, slots=True)
class Scope:
    """The row files that a query needs."""

    tables: Sequence[TableSchema] = tuple(SCHEMAS.values())
    robot: str | None = None
    has_date: Callable[[str], bool] | None = None


class RowsOfFile(NamedTuple):
    """The content of a row file."""

    file: RowFile
    rows: list[Row]
    """The valid rows; each names its robot."""
    rejected: int = 0
    """Rows that were rejected; 1 for a file that is not a row file."""
    why: str | None = None
    """Why rows were rejected."""
    unknown: int = 0
    """Rows with columns that this version does not know; the columns were ignored."""


def robots(source: Bucket) -> list[str]:
    """Robots that have a folder. Raises StoreError."""
    return [name for name in source.folders('') if is_name(name)]


def folder_of(robot: str, date: str, of: TableSchema = OBJECTS) -> str:
    """The prefix of the keys of a robot's row files of a date."""
    return f'{of.prefix(robot)}date={date}/'


def backfilled_key(robot: str, date: str, keys: Iterable[str], of: TableSchema = OBJECTS) -> str:
    """The key of a file with rows that were missing (``reindex``); the same rows get the same key."""
    digest = hashlib.sha256('\n'.join(sorted(keys)).encode()).hexdigest()[:16]
    return of.part_key(robot, date, f'{date.replace("-", "")}_backfilled_{digest}')


def row_files(source: Bucket, findings: Findings, scope: Scope) -> list[RowFile]:
    """All row files of a scope in the store, the oldest date first. Raises StoreError."""
    named = [scope.robot] if scope.robot else robots(source)
    with ThreadPoolExecutor(THREADS, 'lake-list') as pool:
        pairs = [(of, robot) for of in scope.tables for robot in named]
        found = pool.map(lambda pair: _listed(source, pair[0], pair[1], scope, findings), pairs)
        return sorted((file for files in found for file in files), key=lambda file: (file.date, file.entry.key))


def read(source: Bucket, files: Sequence[RowFile], findings: Findings) -> Iterator[RowsOfFile]:
    """Each file with its valid rows; rejected rows are reported in the findings. Raises StoreError."""
    with ThreadPoolExecutor(THREADS, 'lake-read') as pool:  # only for requests: threads that parse would block each other
        for file, body in zip(files, pool.map(lambda file: _body(source, file), files), strict=True):
            found = RowsOfFile(file, [], 1, body) if isinstance(body, str) else _contents(file, body)
            if found.rejected:
                findings.add(file.entry.key, found.why or '', found.rejected)
            yield found


def as_table(of: TableSchema, rows: Sequence[Row]) -> pa.Table:
    """Rows with the columns of their Delta table."""
    table, schema = TABLES[of.folder], arrow_schema(of)
    found = pa.table({name: [row[name] for row in rows] for name in schema.names}, schema=schema)
    dates = pc.fill_null(found[table.dated].cast(pa.date32()).cast(pa.string()), UNDATED)
    return found.add_column(0, DATE, dates).cast(table.schema)


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
        if folder and entry.key.endswith(SUFFIX):
            found.append(RowFile(of, robot, folder[1], entry))
    return found


def _body(source: Bucket, file: RowFile) -> bytes | str:
    """The content of a file, or why it is not a row file."""
    if not is_path(file.entry.key):
        return 'its name is not a path'
    try:
        check_size(file.entry.size, MAX_FILE_BYTES)
        return source.get(file.entry.key, MAX_FILE_BYTES)
    except (ValueError, MemoryError, ObjectRefused) as error:
        if isinstance(error, ObjectRefused) and error.data.get('reason') == 'missing':
            raise
        return 'there is not enough memory for it' if isinstance(error, MemoryError) else f'it is not a row file ({error})'


def _contents(file: RowFile, body: bytes) -> RowsOfFile:
    try:
        found = read_rows(body, file.robot)
    except MemoryError:
        return RowsOfFile(file, [], 1, 'there is not enough memory for it')
    rows = found.rows.get(file.of.folder, [])
    for row in rows:
        row[ROBOT] = file.robot  # what they name themselves, if anything
    rejected = sum(each.lines for each in found.rejected) + (found.ended is not None)
    reasons = [found.findings] if found.findings else []
    if others := sum(map(len, found.rows.values())) - len(rows):
        rejected += others
        reasons.append(f'{rows_are(others)} rejected: of another table')
    return RowsOfFile(file, rows, rejected, '; '.join(reasons) or None, found.unknown)
