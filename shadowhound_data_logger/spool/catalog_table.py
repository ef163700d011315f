"""Objects that the catalog does not describe yet: delivered ones, changes of kept ones, and the statistics for their rows."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Final, NamedTuple

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.spool.gap_table import GapTable
from shadowhound_data_logger.spool.schema import Table, after

_OF_SENSOR: Final = 'bucket = ? AND sensor = ? AND key >= ? AND key < ?'


class UncatalogedObject(NamedTuple):
    """An object as it is in the store; a repeat has its own times, and the key of the object that holds its content."""

    id: int
    bucket: str
    key: str
    size: int
    content_type: str
    metadata: Mapping[str, str]
    statistics: bytes = b''
    """As packed by its encoder; empty if there are none."""


class CatalogTable(Table):
    """Lists of objects for the catalog's next parts. An object is removed from a list in the transaction that spools its part."""

    def __init__(self, connection: Callable[[], sqlite3.Connection], gaps: GapTable) -> None:
        super().__init__(connection)
        self._gaps = gaps

    def add_statistics(self, number: int, packed: bytes) -> None:
        """Add the statistics of a new object; an index that was rebuilt from the files has none."""
        self._db.execute('INSERT INTO statistics VALUES (?,?)', (number, packed))

    def follow(self, ids: Iterable[int]) -> None:
        """Update the lists for objects that are new or have a new state."""
        rows = [(number,) for number in ids]
        self._db.executemany(
            "INSERT OR IGNORE INTO uncataloged SELECT id FROM objects WHERE id = ? AND state IN ('delivered', 'deduplicated')"
            " AND sensor <> '_catalog'", rows,
        )  # fmt: skip
        self._db.executemany(
            "INSERT OR IGNORE INTO unreported SELECT id, CASE state WHEN 'kept' THEN 'kept' ELSE 'lost' END FROM objects"
            " WHERE id = ? AND (state = 'kept' OR (on_request AND state IN ('evicted', 'quarantined')))", rows,
        )  # fmt: skip
        self._db.executemany(
            "DELETE FROM statistics WHERE id = ? AND id IN (SELECT id FROM objects WHERE state = 'evicted')", rows
        )

    def uncataloged(self, limit: int) -> list[UncatalogedObject]:
        """Delivered objects without a row in any part of the catalog, oldest first."""
        rows = self._db.execute(
            'SELECT id, bucket, key, bytes, content_type, packed, metadata FROM uncataloged JOIN objects USING (id)'
            ' LEFT JOIN statistics USING (id) ORDER BY id LIMIT ?', (limit,),
        )  # fmt: skip
        found = [(*row, json.loads(metadata)) for *row, metadata in rows]
        return [UncatalogedObject(number, bucket, metadata.get(meta.CONTENT_KEY, key), size, kind, metadata, packed or b'')
                for number, bucket, key, size, kind, packed, metadata in found]  # fmt: skip

    def take_uncataloged(self, ids: Collection[int]) -> bool:
        """Remove objects from the list; False, and nothing changes, if one is not on it."""
        if not ids:
            return True
        listed = {number for (number,) in self._db.execute('SELECT id FROM uncataloged')}
        if not listed.issuperset(ids):
            return False
        for table in ('uncataloged', 'statistics'):
            self._db.executemany(f'DELETE FROM {table} WHERE id = ?', ((number,) for number in ids))  # noqa: S608
        return True

    def report(self, number: int, state: str) -> None:
        """List a state of an object for the table of kept objects."""
        self._db.execute('INSERT INTO unreported VALUES (?, ?)', (number, state))

    def unreported(self, limit: int) -> list[tuple[str, str | None, UncatalogedObject]]:
        """Changes for the table of kept objects: (``kept``, ``lost`` or a step of thinning; reason; object)."""
        rows = self._db.execute(
            'SELECT unreported.state, reason, id, bucket, key, bytes, content_type, metadata FROM unreported'
            ' JOIN objects USING (id) ORDER BY id LIMIT ?', (limit,),
        )  # fmt: skip
        return [(state, reason, UncatalogedObject(number, bucket, key, size, content_type, json.loads(metadata)))
                for state, reason, number, bucket, key, size, content_type, metadata in rows]  # fmt: skip

    def take_unreported(self, reported: Collection[tuple[int, str]]) -> bool:
        """As ``take_uncataloged``, for the changes of kept objects."""
        if not reported:
            return True
        query = 'SELECT count(*) FROM unreported WHERE id = ? AND state = ?'
        if not all(self._db.execute(query, each).fetchone()[0] for each in reported):
            return False
        self._db.executemany('DELETE FROM unreported WHERE id = ? AND state = ?', reported)
        return True

    def clear(self) -> None:
        """Empty all lists, because the catalog is off."""
        for table in ('uncataloged', 'statistics', 'unreported'):
            self._db.execute(f'DELETE FROM {table}')  # noqa: S608 - own constants only
        self._gaps.set_all_reported()

    def has_waiting(self, bucket: str, prefix: str, *, sensor: str, priority: int) -> bool:
        """Whether a part with this prefix is pending with this priority, or quarantined with its file."""
        query = (
            f'SELECT 1 FROM objects WHERE {_OF_SENSOR} AND ((state = ? AND priority = ?) OR (state = ? AND reason <> ?)) LIMIT 1'  # noqa: S608
        )
        values = (bucket, sensor, prefix, after(prefix), 'pending', priority, 'quarantined', 'missing')
        return self._db.execute(query, values).fetchone() is not None

    def missing(self, bucket: str, prefix: str, *, sensor: str) -> frozenset[int]:
        """Ids of the parts with this prefix whose files are missing."""
        query = f"SELECT id FROM objects WHERE state = 'quarantined' AND reason = 'missing' AND {_OF_SENSOR}"  # noqa: S608
        return frozenset(number for (number,) in self._db.execute(query, (bucket, sensor, prefix, after(prefix))))
