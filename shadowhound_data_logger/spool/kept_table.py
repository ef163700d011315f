"""Kept objects, which stay on the robot until they are requested, and may be thinned."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Mapping
from typing import Any, Final

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.model import DataObject, FileBody, State
from shadowhound_data_logger.spool.catalog_table import CatalogTable
from shadowhound_data_logger.spool.object_table import ObjectStates, ObjectTable
from shadowhound_data_logger.spool.schema import Table

_FREE: Final = """state = 'kept' AND NOT protected
  AND NOT EXISTS (SELECT 1 FROM requested WHERE requested.id = objects.id AND outcome IN ('kept', 'pending'))"""
"""Kept, not protected, and in no open request."""


class KeptTable(Table):
    """The kept objects among the objects."""

    def __init__(self, connection: Callable[[], sqlite3.Connection], objects: ObjectTable, states: ObjectStates,
                 catalog: CatalogTable) -> None:  # fmt: skip
        super().__init__(connection)
        self._objects = objects
        self._states = states
        self._catalog = catalog

    def bytes(self) -> int:
        """Bytes of all kept objects."""
        return int(self._db.execute("SELECT ifnull(sum(bytes), 0) FROM tally WHERE state = 'kept'").fetchone()[0])

    def evictable(self, limit: int, before_ns: int | None = None) -> list[sqlite3.Row]:
        """Objects in no open request, oldest first; if given, only those spooled before ``before_ns``."""
        before = '' if before_ns is None else 'AND created_ns < ?'
        values = (*(() if before_ns is None else (before_ns,)), limit)
        return self._objects.select(f'{_FREE} {before} ORDER BY id LIMIT ?', values)

    def thinnable(self, last: int, limit: int) -> list[Mapping[str, Any]]:
        """Objects in no open request with an id after ``last``, by id; ``step``: one of so many messages is left."""
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
        """Give a kept object less content; the removed messages become a separate evicted object under ``key``.

        ``row`` is that of ``ObjectTable.full_row``; ``lost`` are the removed messages by topic, if it has several. Together the
        two objects have the totals of the original.
        """
        removed = row['samples'] - samples
        accounts = {account: lost[topic] for account in row['counts'] if (topic := account.partition(':')[2]) in lost}
        was = " AND topic = ? AND state IN ('spooled', 'kept')"
        self._db.execute(f'UPDATE tally SET bytes = bytes - ?, samples = samples - ? WHERE 1{was}',  # noqa: S608 - own constants only
                         (row['bytes'] - len(body), removed, row['topic'] or ''))  # fmt: skip
        for account, count in accounts.items():
            self._db.execute(f'UPDATE tally SET samples = samples - ? WHERE 1{was}', (count, account))  # noqa: S608
            self._db.execute('UPDATE contents SET samples = samples - ? WHERE id = ? AND topic = ?', (count, row['id'], account))
        metadata = json.loads(row['metadata'])
        word = meta.MESSAGES if meta.MESSAGES in metadata else meta.COUNT
        step = 2 * _step(metadata)
        left = {**metadata, meta.SHA256: body.sha256, word: str(samples), meta.THINNED: str(step)}
        values = {'bytes': len(body), 'sha256': body.sha256, 'samples': samples, 'metadata': json.dumps(left)}
        self._states.set_thinned(row['id'], values)
        # A separate state: a catalog part that is being written describes the former content, and removes the former state.
        self._catalog.report(row['id'], f'{reason} {step}')
        removed_body = FileBody(body.path, row['bytes'] - len(body), row['sha256'])
        item = DataObject(
            bucket=row['bucket'], key=key, body=removed_body, sensor=row['sensor'],
            content_type=row['content_type'], topic=row['topic'], type=row['type'], samples=removed, t_start_ns=row['t_start_ns'],
            t_end_ns=row['t_end_ns'], priority=row['priority'], protected=False, counts=accounts,
        )  # fmt: skip
        self._states.insert(item, key, row['sha256'], State.EVICTED, reason, {**metadata, word: str(removed)}, now_ns)


def _step(metadata: Mapping[str, str]) -> int:
    """One of how many images or clouds is left."""
    return int(metadata.get(meta.THINNED, 1))
