"""Recordings: bags that are not complete in the spool yet."""

from __future__ import annotations

from shadowhound_data_logger.core.model import MissingRow, RecordingRows, SliceRow
from shadowhound_data_logger.spool.schema import Table


class RecordingTable(Table):
    """Each recording with its closed slices and its missing messages, by owner: the robot, or the name of ``bag record``."""

    def write(self, owner: str, rows: RecordingRows) -> None:
        """Add to a recording, or forget it once it is complete."""
        place = owner, rows.folder
        if rows.is_whole:
            for table in ('recordings', 'slices', 'missing'):
                self._db.execute(f'DELETE FROM {table} WHERE owner = ? AND folder = ?', place)  # noqa: S608 - own constants only
            return
        self._db.execute('INSERT OR REPLACE INTO recordings VALUES (?,?,?,?)', (*place, rows.facts, rows.channels))
        self._db.executemany('INSERT OR REPLACE INTO slices VALUES (?,?,?,?,?,?,?,?,?)', ((*place, *row) for row in rows.slices))
        self._db.executemany('INSERT OR REPLACE INTO missing VALUES (?,?,?,?,?,?,?,?)', ((*place, *row) for row in rows.missing))

    def rows(self, owner: str) -> list[RecordingRows]:
        """The recordings of an owner that are not complete yet."""
        found = self._db.execute('SELECT folder, facts, channels FROM recordings WHERE owner = ?', (owner,)).fetchall()
        return [RecordingRows(
            folder, facts, channels,
            tuple(SliceRow(*one) for one in self._db.execute(
                'SELECT number, bytes, sha256, t_start_ns, t_end_ns, messages, counts FROM slices'
                ' WHERE owner = ? AND folder = ? ORDER BY number', (owner, folder))),
            tuple(MissingRow(*one) for one in self._db.execute(
                'SELECT place, file, what, messages, topic, reason FROM missing WHERE owner = ? AND folder = ? ORDER BY place',
                (owner, folder))),
        ) for folder, facts, channels in found]  # fmt: skip
