"""The views that a query reads: every row exactly once, from one version of the tables and the row files not in this version.

On a shared lake, rows that are not ingested yet are read from their files and added for this query only. Otherwise a query first
ingests what it needs into this user's tables. With ``as_of`` it reads only the tables as of that time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from typing import Any, Final

import pyarrow as pa
from deltalake import QueryBuilder

from shadowhound_data_logger.core.stamps import BY_RECEIVED, BY_STAMP
from shadowhound_data_logger.formats.rows.catalog import FORGOTTEN, OBJECTS, TableSchema
from shadowhound_data_logger.formats.rows.gaps import GAPS
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.ingest import KnownFile, fresh, ingest, known_files, pending, unknown_of
from shadowhound_data_logger.lake.row_files import Scope, row_files
from shadowhound_data_logger.lake.tables import INGESTED, TABLES, Tables, answer, engine, literal

_TABLE, _FRESH = '_table', '_fresh'


@contextmanager
def views(source: Bucket, of: Sequence[TableSchema], findings: Findings, *, robot: str | None = None,  # noqa: PLR0913 - parts of a query
          has_date: Callable[[str], bool] | None = None, as_of: datetime | None = None,
          more: Mapping[str, pa.Table] | None = None, by: str = BY_STAMP) -> Iterator[QueryBuilder]:  # fmt: skip
    """An engine with a view of each of these tables, such as ``all_objects``, and ``more`` tables.

    If ``by`` is ``received``, the times of objects and gaps (``t_start``, ``from_ns``, ...) are arrival times.

    ``robot`` and ``has_date`` restrict which rows must be in the views; others may be, too. ``all_objects`` does not contain
    objects that ``lake prune`` deleted. Raises StoreError, LakeError.
    """
    of = tuple(dict.fromkeys((*of, FORGOTTEN))) if OBJECTS in of else tuple(of)
    scope = Scope(of, robot, has_date)
    tables = current(source, scope, findings) if as_of is None else Tables.of(source)
    ingested = tables.open(INGESTED) if tables.is_shared and as_of is None else None  # before the tables that it describes
    opened = {each: tables.open(TABLES[each.folder], as_of) for each in of}
    found: dict[str, Any] = {f'{TABLES[each.folder].name}{_TABLE}': table for each, table in opened.items()}
    empty = {each for each, table in opened.items() if not table.file_uris()}
    if ingested is not None:
        files = pending(ingested, row_files(source, findings, scope))
        for each in {file.of for file in files}:
            rows = fresh(source, files, opened[each], each, findings)
            if len(rows):
                found[f'{TABLES[each.folder].name}{_FRESH}'] = rows
                empty.discard(each)
    with engine({**found, **(more or {})}) as ready:
        for each in of:
            is_pruned = each is OBJECTS and FORGOTTEN not in empty
            answer(ready, _view(TABLES[each.folder].name, found, _ARRIVAL.get(each.folder, '*') if by == BY_RECEIVED else '*',
                                is_pruned=is_pruned))  # fmt: skip
        yield ready


def rows_of(source: Bucket, of: TableSchema, findings: Findings, *, robot: str | None = None,  # noqa: PLR0913 - parts of a query
            has_date: Callable[[str], bool] | None = None, where: str = 'true',
            columns: Sequence[str] = (), order: str = '', limit: int | None = None,
            by: str = BY_STAMP) -> pa.Table:  # fmt: skip
    """The rows of one table that satisfy a condition, with the columns of its schema. Raises StoreError, LakeError."""
    table = TABLES[of.folder]
    names = ', '.join(f'"{name}"' for name in columns or of.columns)
    of_robot = 'true' if robot is None else f'robot = {literal(robot)}'
    with views(source, [of], findings, robot=robot, has_date=has_date, by=by) as ready:
        query = f'SELECT {names} FROM all_{table.name} WHERE {of_robot} AND ({where})'  # noqa: S608 - our own words
        query += f' ORDER BY {order}' * bool(order) + ('' if limit is None else f' LIMIT {limit}')
        return answer(ready, query)


def dates(source: Bucket, robot: str, of: Sequence[TableSchema], findings: Findings) -> list[str]:
    """The UTC dates with rows of a robot in one of these tables. Raises StoreError, LakeError."""
    scope = Scope(tuple(of), robot)
    tables = current(source, scope, findings)
    ingested = tables.open(INGESTED)
    opened = [tables.open(TABLES[each.folder]) for each in of]
    found = {each['date'] for table in opened for each in table.partitions() if each['robot'] == robot}
    waiting = pending(ingested, row_files(source, findings, scope)) if tables.is_shared else []
    return sorted(found.union(file.date for file in waiting))


def current(source: Bucket, scope: Scope, findings: Findings) -> Tables:
    """The tables of a store; local ones contain all row files of the scope. Reports the rejected rows of these files."""
    tables = Tables.of(source)
    known = (known_files(tables.open(INGESTED), scope, 'rejected > 0') if tables.is_shared
             else _catch_up(source, tables, scope, findings))  # fmt: skip
    for bad in (each for each in known if each.rejected):
        findings.add(bad.part, bad.why or 'rows of it are rejected', bad.rejected)
    return tables


def _catch_up(source: Bucket, tables: Tables, scope: Scope, findings: Findings) -> list[KnownFile]:
    """Ingest the files that local tables lack; returns all files of the scope that are in them.

    If the store lost files that they contain, rebuild them: it is another store.
    """
    tables.create()
    opened = tables.open(INGESTED)  # before the listing: files that another process ingests later must not seem lost
    files, known = row_files(source, findings, scope), known_files(opened, scope)
    if not {(each.part, each.etag) for each in known} <= {(file.entry.key, file.entry.etag) for file in files}:
        tables.delete_local()
        tables.create()
        known = []
    if not (unknown := unknown_of(files, known)):
        return known
    ingest(source, tables, findings, unknown)
    return known_files(tables.open(INGESTED), scope)


def _view(name: str, found: Mapping[str, Any], columns: str, *, is_pruned: bool) -> str:
    parts = [f'SELECT * FROM {each}' for each in (f'{name}{_TABLE}', f'{name}{_FRESH}') if each in found]  # noqa: S608
    rows = ' UNION ALL '.join(parts)
    if is_pruned:
        same = ' AND '.join(f'f.{column} = o.{column}' for column in ('date', 'robot', 'bucket', 'key'))
        known = [f'SELECT 1 FROM {each} f WHERE {same}' for each in found if each.startswith('forgotten')]  # noqa: S608
        rows = f'SELECT * FROM ({rows}) o WHERE ' + ' AND '.join(f'NOT EXISTS ({each})' for each in known)  # noqa: S608
    return f'CREATE VIEW all_{name} AS SELECT {columns} FROM ({rows})'  # noqa: S608


def _utc_of(column: str) -> str:
    return f"""arrow_cast({column} / 1000, 'Timestamp(Microsecond, Some("UTC"))')"""


def _arrival_of(received: str, column: str) -> str:
    return f'CASE WHEN {received} IS NULL THEN {column} ELSE {_utc_of(received)} END AS {column}'


_ARRIVAL: Final = {
    OBJECTS.folder: f"""* REPLACE (
        coalesce(received_start_ns, t_start_ns) AS t_start_ns, coalesce(received_end_ns, t_end_ns) AS t_end_ns,
        {_arrival_of('received_start_ns', 't_start')}, {_arrival_of('received_end_ns', 't_end')},
        CASE WHEN received_start_ns IS NULL THEN clock_offset_ns
          ELSE coalesce(clock_offset_ns, 0) + received_start_ns - t_start_ns END AS clock_offset_ns)""",
    GAPS.folder: f"""* REPLACE (
        received_from_ns AS from_ns, received_to_ns AS to_ns, {_utc_of('received_from_ns')} AS t_from,
        {_utc_of('received_to_ns')} AS t_to)""",
}
"""Columns of a table in which its times are those of arrival; the times in the content of an object, with ``clock_offset_ns``
added, are as well, to within the jitter of the batch. An object whose arrival is unknown was dated by the robot's own clock."""
