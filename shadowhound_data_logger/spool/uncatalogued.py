"""Delivered objects that no part of the catalogue has a row of yet: a list in the index, kept by triggers (schema.py).

A part's object takes its rows off the list in the very transaction that spools it, so that a death leaves both or neither.
Until then they are not forgotten.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

from shadowhound_data_logger import metadata_words as words
from shadowhound_data_logger.spool.index import Index


class UncataloguedObject(NamedTuple):
    """An object as the store holds it; of a repeat its own times, and the key that holds its content."""

    id: int
    bucket: str
    key: str
    size: int
    content_type: str
    metadata: Mapping[str, str]


def waiting(spool: Path, limit: int) -> list[UncataloguedObject]:
    """The oldest of the list; waits for no commit. Raises SpoolError or sqlite3.Error."""
    with closing(Index(spool / 'index.db', read_only=True)) as index:
        index.open()
        rows = index.db.execute(
            'SELECT id, bucket, key, bytes, content_type, metadata FROM uncatalogued JOIN objects USING (id)'
            ' ORDER BY id LIMIT ?', (limit,),
        ).fetchall()  # fmt: skip
    said = [json.loads(metadata) for *_, metadata in rows]
    return [UncataloguedObject(number, bucket, metadata.get(words.CONTENT_KEY, key), size, content_type, metadata)
            for (number, bucket, key, size, content_type, _), metadata in zip(rows, said, strict=True)]  # fmt: skip


def clear(spool: Path) -> None:
    """No part will have what is delivered by now. Raises SpoolError or sqlite3.Error."""
    with closing(Index(spool / 'index.db')) as index:
        index.open()
        with index.transaction() as db:
            db.execute('DELETE FROM uncatalogued')


def take(index: Index, ids: Collection[int]) -> bool:
    """Take these off the list, in a transaction; False, and nothing is changed, where one was taken already."""
    if not ids:
        return True
    listed = {number for (number,) in index.db.execute('SELECT id FROM uncatalogued')}
    if not listed.issuperset(ids):
        return False
    index.db.executemany('DELETE FROM uncatalogued WHERE id = ?', ((number,) for number in ids))
    return True
