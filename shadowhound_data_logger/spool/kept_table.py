"""Kept objects: those that stay on the robot until they are requested, may be thinned, and are evicted last."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Mapping
from typing import Any, Final

from shadowhound_data_logger.core import metadata_words as words
from shadowhound_data_logger.core.model import DataObject, FileBody, State
from shadowhound_data_logger.spool.catalog_table import CatalogTable
from shadowhound_data_logger.spool.object_table import ObjectTable
from shadowhound_data_logger.spool.table import Table

_FREE: Final = """state = 'kept' AND NOT protected
  AND NOT EXISTS (SELECT 1 FROM requested WHERE requested.id = objects.id AND outcome IN ('kept', 'pending'))"""
"""Kept, and not part of an open request."""


class KeptTable(Table):
    """The kept objects among the objects."""

    def __init__(self, connection: Callable[[], sqlite3.Connection], objects: ObjectTable, catalog: CatalogTable) -> None:
        super().__init__(connection)
        self._objects = objects
        self._catalog = catalog

    def bytes(self) -> int:
        """Of everything that is kept."""
        return int(self._db.execute("SELECT ifnull(sum(bytes), 0) FROM tally WHERE state = 'kept'").fetchone()[0])

    def evictable(self, limit: int, before_ns: int | None = None) -> list[sqlite3.Row]:
        """What is in no open request, the oldest first; only what was spooled before ``before_ns``, if given."""
        before = '' if before_ns is None else 'AND created_ns < ?'
        values = (*(() if before_ns is None else (before_ns,)), limit)
        return self._objects.select(f'{_FREE} {before} ORDER BY id LIMIT ?', values)

    def thinnable(self, last: int, limit: int) -> list[Mapping[str, Any]]:
        """What is in no open request and has a number after ``last``, in that order; ``step`` as in ``thin``."""
        columns = ('id', 'sensor', 'type', 'samples', 'bytes', 'sha256', 'content_type', 't_start_ns', 't_end_ns', 'bucket',
                   'key', 'metadata')  # fmt: skip
        query = f'SELECT {", ".join(columns)} FROM objects WHERE {_FREE} AND id > ? ORDER BY id LIMIT ?'  # noqa: S608
        rows = [dict(zip(columns, row, strict=True)) for row in self._db.execute(query, (last, limit))]
        return [{**row, 'step': _step(json.loads(row.pop('metadata')))} for row in rows]

    def thinnable_row(self, number: int, sha256: str) -> Mapping[str, Any] | None:
        """The full row of an object that is kept, unchanged and in no open request."""
        found = self._objects.select(f'{_FREE} AND id = ? AND sha256 = ?', (number, sha256))
        return self._objects.full_row(number) if found else None

    def thin(self, row: Mapping[str, Any], body: FileBody, samples: int, lost: Mapping[str, int], key: str, reason: str,
             now_ns: int) -> None:  # fmt: skip
        """Give a kept object less content; what is gone becomes an evicted object of its own, under ``key``.

        ``row`` is that of ``ObjectTable.full_row``, ``lost`` the messages by topic if it has several. Together the two objects
        have the totals of the first.
        """
        gone = row['samples'] - samples
        accounts = {account: lost[topic] for account in row['counts'] if (topic := account.partition(':')[2]) in lost}
        was = " AND topic = ? AND state IN ('spooled', 'kept')"
        self._db.execute(f'UPDATE tally SET bytes = bytes - ?, samples = samples - ? WHERE 1{was}',  # noqa: S608 - own constants only
                         (row['bytes'] - len(body), gone, row['topic'] or ''))  # fmt: skip
        for account, count in accounts.items():
            self._db.execute(f'UPDATE tally SET samples = samples - ? WHERE 1{was}', (count, account))  # noqa: S608
            self._db.execute('UPDATE contents SET samples = samples - ? WHERE id = ? AND topic = ?', (count, row['id'], account))
        metadata = json.loads(row['metadata'])
        word = words.MESSAGES if words.MESSAGES in metadata else words.COUNT
        step = 2 * _step(metadata)
        left = {**metadata, words.SHA256: body.sha256, word: str(samples), words.THINNED: str(step)}
        values = {'bytes': len(body), 'sha256': body.sha256, 'samples': samples, 'metadata': json.dumps(left)}
        self._objects.set_thinned(row['id'], values)
        # A state of its own: a part that is being written describes the object as it was, and takes the row of that state.
        self._catalog.report(row['id'], f'{reason} {step}')
        gone_body = FileBody(body.path, row['bytes'] - len(body), row['sha256'])
        item = DataObject(
            bucket=row['bucket'], key=key, body=gone_body, sensor=row['sensor'],
            content_type=row['content_type'], topic=row['topic'], type=row['type'], samples=gone, t_start_ns=row['t_start_ns'],
            t_end_ns=row['t_end_ns'], priority=row['priority'], protected=False, counts=accounts,
        )  # fmt: skip
        self._objects.insert(item, key, row['sha256'], State.EVICTED, reason, {**metadata, word: str(gone)}, now_ns)


def _step(metadata: Mapping[str, str]) -> int:
    """One of how many pictures or clouds is left."""
    return int(metadata.get(words.THINNED, 1))
