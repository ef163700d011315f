"""What the catalog does not describe yet: delivered objects, changes of kept objects, and the statistics for their rows."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Final, NamedTuple

from shadowhound_data_logger.core import metadata_words as words
from shadowhound_data_logger.spool.gap_table import GapTable
from shadowhound_data_logger.spool.table import Table, after

_OF_SENSOR: Final = 'bucket = ? AND sensor = ? AND key >= ? AND key < ?'


class UncatalogedObject(NamedTuple):
    """An object as the store holds it; of a repeat its own times, and the key that holds its content."""

    id: int
    bucket: str
    key: str
    size: int
    content_type: str
    metadata: Mapping[str, str]
    statistics: bytes = b''
    """As its encoder packed them; empty if there are none."""


class CatalogTable(Table):
    """Lists of objects for the catalog's next parts; an object leaves a list in the transaction that spools its part."""

    def __init__(self, connection: Callable[[], sqlite3.Connection], gaps: GapTable) -> None:
        super().__init__(connection)
        self._gaps = gaps

    def add_statistics(self, number: int, packed: bytes) -> None:
        """Of a new object; an index that is rebuilt from the files has none."""
        self._db.execute('INSERT INTO statistics VALUES (?,?)', (number, packed))

    def follow(self, ids: Iterable[int]) -> None:
        """These objects are new, or have a new state."""
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
        """Delivered objects without a row in any part of the catalog, the oldest first."""
        rows = self._db.execute(
            'SELECT id, bucket, key, bytes, content_type, packed, metadata FROM uncataloged JOIN objects USING (id)'
            ' LEFT JOIN statistics USING (id) ORDER BY id LIMIT ?', (limit,),
        )  # fmt: skip
        found = [(*row, json.loads(metadata)) for *row, metadata in rows]
        return [UncatalogedObject(number, bucket, metadata.get(words.CONTENT_KEY, key), size, kind, metadata, packed or b'')
                for number, bucket, key, size, kind, packed, metadata in found]  # fmt: skip

    def take_uncataloged(self, ids: Collection[int]) -> bool:
        """Take these off the list. False, and nothing is changed, if one was taken before."""
        if not ids:
            return True
        listed = {number for (number,) in self._db.execute('SELECT id FROM uncataloged')}
        if not listed.issuperset(ids):
            return False
        for table in ('uncataloged', 'statistics'):
            self._db.executemany(f'DELETE FROM {table} WHERE id = ?', ((number,) for number in ids))  # noqa: S608
        return True

    def report(self, number: int, state: str) -> None:
        """The table of kept objects must get this state of an object."""
        self._db.execute('INSERT INTO unreported VALUES (?, ?)', (number, state))

    def unreported(self, limit: int) -> list[tuple[str, str | None, UncatalogedObject]]:
        """What the table of kept objects lacks: the change (``kept``, ``lost``, a step of thinning), its reason, the object."""
        rows = self._db.execute(
            'SELECT unreported.state, reason, id, bucket, key, bytes, content_type, metadata FROM unreported'
            ' JOIN objects USING (id) ORDER BY id LIMIT ?', (limit,),
        )  # fmt: skip
        return [(state, reason, UncatalogedObject(number, bucket, key, size, content_type, json.loads(metadata)))
                for state, reason, number, bucket, key, size, content_type, metadata in rows]  # fmt: skip

    def take_unreported(self, reported: Collection[tuple[int, str]]) -> bool:
        """As ``take_uncataloged``, of rows of the table of kept objects."""
        if not reported:
            return True
        query = 'SELECT count(*) FROM unreported WHERE id = ? AND state = ?'
        if not all(self._db.execute(query, each).fetchone()[0] for each in reported):
            return False
        self._db.executemany('DELETE FROM unreported WHERE id = ? AND state = ?', reported)
        return True

    def clear(self) -> None:
        """No part will describe what is delivered, kept or lost by now."""
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
        """Of the parts with this prefix, those whose files are gone."""
        query = f"SELECT id FROM objects WHERE state = 'quarantined' AND reason = 'missing' AND {_OF_SENSOR}"  # noqa: S608
        return frozenset(number for (number,) in self._db.execute(query, (bucket, sensor, prefix, after(prefix))))
