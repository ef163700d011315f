"""Objects that left the spool more than an hour ago: one short row each, until their keys are forgotten."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Sequence
from typing import Final

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND
from shadowhound_data_logger.core.model import ObjectInfo, State
from shadowhound_data_logger.spool.gap_table import GapTable
from shadowhound_data_logger.spool.table import Table, after, split

FORGET_STEP: Final = 5_000
"""Rows that one commit examines at most to forget them: some 20 ms."""
COMPACT_STEP: Final = 500
"""Rows that one commit shortens at most: some 10 ms."""
COMPACT_STATES: Final = (State.DELIVERED, State.DEDUPLICATED, State.EVICTED)
"""The states of short rows, by number."""
CATALOG: Final = '_catalog'
"""The sensor of the catalog's own objects, which are merged into other parts later and can be written again."""
_DELIVERED: Final = f"FROM objects WHERE state = 'delivered' AND sensor <> '{CATALOG}'"
_COMPACT_DELIVERED: Final = f"FROM compact_objects JOIN folders ON folders.id = folder WHERE state = 0 AND sensor <> '{CATALOG}'"
_COMPACT: Final = """
SELECT compact_objects.id, bucket, path || name AS key, bytes, lower(hex(sha256)) AS sha256, '' AS content_type,
  '{}' AS metadata, 0 AS priority, settled_s * 1000000000 AS created_ns,
  CASE state WHEN 0 THEN 'delivered' WHEN 1 THEN 'deduplicated' ELSE 'evicted' END AS state,
  CASE state WHEN 2 THEN 'no_room' END AS reason, sensor, '' AS waits_for
FROM folders JOIN compact_objects ON folder = folders.id"""
"""The remembered columns of an object; ``created_ns`` is when it left the spool, to the second."""
_NOTHING_SWEPT: Final = (0, '')


class HistoryTable(Table):
    """The short rows, and the deliveries that the store confirmed."""

    def __init__(self, connection: Callable[[], sqlite3.Connection], gaps: GapTable) -> None:
        super().__init__(connection)
        self._gaps = gaps
        self._swept: tuple[int, str] = _NOTHING_SWEPT
        """The last short row that ``forget`` examined."""

    def select(self, where: str, values: Sequence[object] = ()) -> list[sqlite3.Row]:
        """Short rows, with the columns of ``ObjectTable.select``."""
        cursor = self._db.execute(f'{_COMPACT} WHERE {where}', tuple(values))
        cursor.row_factory = sqlite3.Row
        return cursor.fetchall()

    def with_prefix(self, bucket: str, prefix: str, sha256: str | None = None) -> list[sqlite3.Row]:
        """Short rows whose keys start with ``prefix``, with this content or any."""
        path, name = split(prefix)
        more, values = ('', ()) if sha256 is None else ('AND sha256 = ?', (_digest(sha256),))
        found = self.select(
            f'bucket = ? AND path = ? AND name >= ? AND name < ? {more}', (bucket, path, name, after(name), *values)
        )
        below = self.select(f'bucket = ? AND path > ? AND path >= ? AND path < ? {more}',
                            (bucket, path, prefix, after(prefix), *values))  # fmt: skip
        return found + below

    def compact(self, before_ns: int) -> bool:
        """Replace some rows of objects that left the spool before then by short ones; False if there may be more of them.

        A short row has the key, size, SHA-256, state and time of leaving, but no metadata. Objects that the catalog does not
        describe yet are skipped. Totals do not change.
        """
        rows = self._db.execute(
            'SELECT id, bucket, key, sensor, state, bytes, sha256, settled_ns, ifnull(CASE WHEN json_valid(metadata) THEN'  # noqa: S608
            f" CAST(json_extract(metadata, '$.{meta.RECEIVED_START_NS}') AS INTEGER) - t_start_ns END, 0)"
            ' FROM objects INDEXED BY settled'
            " WHERE state IN ('delivered', 'deduplicated', 'evicted') AND settled_ns < ?"
            ' AND NOT EXISTS (SELECT 1 FROM uncataloged WHERE uncataloged.id = objects.id)'
            ' AND NOT EXISTS (SELECT 1 FROM unreported WHERE unreported.id = objects.id) ORDER BY settled_ns LIMIT ?',
            (before_ns, COMPACT_STEP),
        ).fetchall()
        folders: dict[tuple[str, str, str], int] = {}
        short = []
        for number, bucket, key, sensor, state, size, sha256, settled_ns, late_ns in rows:
            path, name = split(key)
            place = bucket, path, sensor
            if place not in folders:
                self._db.execute('INSERT OR IGNORE INTO folders (bucket, path, sensor) VALUES (?,?,?)', place)
                query = 'SELECT id FROM folders WHERE bucket = ? AND path = ? AND sensor = ?'
                folders[place] = self._db.execute(query, place).fetchone()[0]
            of = COMPACT_STATES.index(State(state))
            short.append((folders[place], name, number, of, size, _digest(sha256), settled_ns // SECOND, late_ns // 1_000_000))
        self._db.executemany('INSERT OR REPLACE INTO compact_objects VALUES (?,?,?,?,?,?,?,?)', short)
        for table in ('contents', 'statistics', 'objects'):
            self._db.executemany(f'DELETE FROM {table} WHERE id = ?', ((row[0],) for row in rows))  # noqa: S608
        return len(rows) < COMPACT_STEP

    def forget(self, before_ns: int) -> bool:
        """Delete some short rows of objects that left the spool before then; False if there may be more of them.

        Rows from before the clock was set are kept: the next boot may start at the same time, and must not reuse their keys.
        Totals do not change.
        """
        first = self._swept
        end = 'SELECT folder, name FROM compact_objects WHERE (folder, name) > (?, ?) ORDER BY folder, name LIMIT 1 OFFSET ?'
        self._swept = self._db.execute(end, (*first, FORGET_STEP - 1)).fetchone() or _NOTHING_SWEPT
        is_last = self._swept == _NOTHING_SWEPT
        until, last = ('', ()) if is_last else ('AND (folder, name) <= (?, ?)', self._swept)
        self._db.execute(
            f'DELETE FROM compact_objects WHERE (folder, name) > (?, ?) {until} AND settled_s BETWEEN ? AND ?',  # noqa: S608
            (*first, *last, EARLIEST_SANE_NS // SECOND, before_ns // SECOND),
        )
        if is_last:
            self._db.execute('DELETE FROM folders WHERE NOT EXISTS (SELECT 1 FROM compact_objects WHERE folder = folders.id)')
        return self._gaps.forget(before_ns, FORGET_STEP) and is_last

    # -- what the store confirmed ----------------------------------------------------------------------------------

    def delivered(self, last: int, limit: int) -> list[tuple[int, ObjectInfo]]:
        """Delivered objects with full rows and ids after ``last``, by id, as the store must describe them; no catalog parts."""
        query = f'SELECT id, bucket, key, bytes, sha256 {_DELIVERED} AND id > ? ORDER BY id LIMIT ?'
        return [(number, ObjectInfo(*of_store)) for number, *of_store in self._db.execute(query, (last, limit))]

    def delivered_compact(self, last: tuple[int, str], limit: int) -> tuple[list[tuple[int, ObjectInfo]], tuple[int, str]]:
        """The same for short rows, in their order, and the position of the last one for the next call."""
        rows = self._db.execute(
            f'SELECT folder, name, compact_objects.id, bucket, path, bytes, lower(hex(sha256)) {_COMPACT_DELIVERED}'
            ' AND (folder, name) > (?, ?) ORDER BY folder, name LIMIT ?', (*last, limit),
        ).fetchall()  # fmt: skip
        found = [(number, ObjectInfo(bucket, path + name, size, sha256)) for _, name, number, bucket, path, size, sha256 in rows]
        return found, rows[-1][:2] if rows else last

    def delivered_count(self) -> int:
        """How many delivered objects are remembered."""
        queries = (f'SELECT count(*) {kept}' for kept in (_DELIVERED, _COMPACT_DELIVERED))
        return sum(self._db.execute(query).fetchone()[0] for query in queries)

    def delivered_since_ns(self) -> int | None:
        """When the first remembered object was delivered; None if there is none."""
        compact = self._db.execute(f'SELECT min(settled_s) {_COMPACT_DELIVERED}').fetchone()[0]
        full = self._db.execute(f'SELECT min(settled_ns) {_DELIVERED}').fetchone()[0]
        return min((found for found in (compact and compact * SECOND, full) if found is not None), default=None)

    def forgotten_count(self) -> int:
        """Delivered objects that are counted but no longer remembered, including parts of the catalog."""
        ever = self._db.execute("SELECT ifnull(sum(objects), 0) FROM tally WHERE state = 'delivered'").fetchone()[0]
        full = self._db.execute("SELECT count(*) FROM objects WHERE state = 'delivered'").fetchone()[0]
        return int(ever) - int(full) - int(self._db.execute('SELECT count(*) FROM compact_objects WHERE state = 0').fetchone()[0])


def _digest(sha256: str) -> bytes:
    """Bytes of a hex string; empty if it is damaged."""
    try:
        return bytes.fromhex(sha256)
    except ValueError:
        return b''
