"""Parts of the tables in the store: rows to Parquet files that are never changed, one for each robot and date among them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from shadowhound_data_logger.formats.rows.parquet import Column, table
from shadowhound_data_logger.formats.rows.schema import OBJECTS, Row, TableSchema, date_of

CONTENT_TYPE: Final = 'application/vnd.apache.parquet'


def encode(rows: Sequence[Row], of: TableSchema = OBJECTS) -> bytes:
    """The Parquet file of rows, at least one, in their order. It takes some 20 us of CPU a row."""
    columns = (Column(name, kind, optional=name not in of.required) for name, kind in of.columns.items())
    return table({column: [row[column.name] for row in rows] for column in columns}, of.about)


def by_folder(rows: Iterable[tuple[int, Row]]) -> Iterator[tuple[str | None, str, list[tuple[int, Row]]]]:
    """(robot, date, its rows in the order of their times) for each folder that gets a part; each row with its object's id."""
    folders: dict[tuple[str | None, str], list[tuple[int, Row]]] = {}
    for number, row in rows:
        folders.setdefault((row['robot'], date_of(row)), []).append((number, row))
    for (robot, date), found in folders.items():
        yield robot, date, sorted(found, key=lambda pair: (pair[1]['t_start_ns'] or 0, pair[0]))
