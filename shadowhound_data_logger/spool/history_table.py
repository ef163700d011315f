"""Objects that left the spool: their keys are remembered, and what the store confirmed can be verified."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from typing import Final

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.spool.gap_table import GapTable
from shadowhound_data_logger.spool.schema import Table

FORGET_STEP: Final = 500
"""Rows of objects that one commit deletes at most: some 10 ms."""
FORGET_GAPS_STEP: Final = 5_000
"""Rows of gaps that one commit examines at most to forget them: some 20 ms."""
CATALOG: Final = '_catalog'
"""The sensor of the catalog's own objects, which are merged into other parts later and can be written again."""
_DELIVERED: Final = f"FROM objects WHERE state = 'delivered' AND sensor <> '{CATALOG}'"


class HistoryTable(Table):
    """The rows of objects that left the spool."""

    def __init__(self, connection: Callable[[], sqlite3.Connection], gaps: GapTable) -> None:
        super().__init__(connection)
        self._gaps = gaps

    def forget(self, before_ns: int) -> bool:
        """Delete some rows of objects that left the spool before then, the oldest first; False if there may be more of them.

        Rows that the catalog does not describe yet are kept. So are rows from before the clock was set: the next boot may start
        at the same time, and must not reuse their keys. Totals do not change.
        """
        rows = self._db.execute(
            'SELECT id FROM objects INDEXED BY settled'
            " WHERE state IN ('delivered', 'deduplicated', 'evicted') AND settled_ns BETWEEN ? AND ?"
            ' AND NOT EXISTS (SELECT 1 FROM uncataloged WHERE uncataloged.id = objects.id)'
            ' AND NOT EXISTS (SELECT 1 FROM unreported WHERE unreported.id = objects.id) ORDER BY settled_ns LIMIT ?',
            (EARLIEST_SANE_NS, before_ns, FORGET_STEP),
        ).fetchall()
        for table in ('contents', 'statistics', 'objects'):
            self._db.executemany(f'DELETE FROM {table} WHERE id = ?', rows)  # noqa: S608
        return self._gaps.forget(before_ns, FORGET_GAPS_STEP) and len(rows) < FORGET_STEP

    # -- what the store confirmed ----------------------------------------------------------------------------------

    def delivered(self, last: int, limit: int) -> list[tuple[int, ObjectInfo]]:
        """Delivered objects with ids after ``last``, by id, as the store must describe them; no catalog parts."""
        query = f'SELECT id, bucket, key, bytes, sha256 {_DELIVERED} AND id > ? ORDER BY id LIMIT ?'
        return [(number, ObjectInfo(*of_store)) for number, *of_store in self._db.execute(query, (last, limit))]

    def delivered_count(self) -> int:
        """How many delivered objects are remembered."""
        return int(self._db.execute(f'SELECT count(*) {_DELIVERED}').fetchone()[0])

    def delivered_since_ns(self) -> int | None:
        """When the first remembered object was delivered; None if there is none."""
        found: int | None = self._db.execute(f'SELECT min(settled_ns) {_DELIVERED}').fetchone()[0]
        return found

    def forgotten_count(self) -> int:
        """Delivered objects that are counted but no longer remembered, including parts of the catalog."""
        ever = self._db.execute("SELECT ifnull(sum(objects), 0) FROM tally WHERE state = 'delivered'").fetchone()[0]
        return int(ever) - int(self._db.execute("SELECT count(*) FROM objects WHERE state = 'delivered'").fetchone()[0])
