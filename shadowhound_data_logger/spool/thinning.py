"""Replaces the content of a kept object by fewer messages; the removed messages become a separate evicted object.

The object keeps its key and path. The separate object (``<key>.thinned``, ``evicted`` with the reason ``thinned``) makes the
removed messages visible in the ledger, the gap journal and the catalog like any other loss.

The new content is synced next to the parts, is renamed to the object's part inside the transaction, and then replaces the old
file: after a crash at any moment, either the file in its place or the part matches the row (``recovery.py``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from shadowhound_data_logger.core.durable_files import sync
from shadowhound_data_logger.core.model import FileBody, State
from shadowhound_data_logger.spool.binding import free_key, renew
from shadowhound_data_logger.spool.files import Tree, content_sha256
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.new_objects import link_or_copy
from shadowhound_data_logger.spool.retention import THINNED


@dataclass(frozen=True, slots=True)
class ThinnableObject:
    """A kept object that no open request waits for."""

    id: int
    sensor: str
    type: str
    samples: int
    bytes: int
    sha256: str
    content_type: str
    t_start_ns: int
    t_end_ns: int
    """Of the last message before any thinning."""
    step: int
    """One of so many images or clouds is left."""
    path: Path

    @classmethod
    def of(cls, row: Mapping[str, Any], tree: Tree) -> ThinnableObject:
        """The object of a row of ``KeptTable.thinnable``."""
        path = tree.path(State.KEPT, None, row['bucket'], row['key'])
        names = ('id', 'sensor', 'type', 'samples', 'bytes', 'sha256', 'content_type', 't_start_ns', 't_end_ns')
        return cls(**{name: row[name] for name in names}, step=row['step'] or 1, path=path)


@dataclass(frozen=True, slots=True)
class Thinned:
    """Smaller content for the same time."""

    body: bytes | FileBody
    samples: int
    """Remaining messages, at least one."""
    lost: Mapping[str, int] = field(default_factory=dict)
    """Removed messages of a bag's slice, by topic."""


def thin(index: Index, tree: Tree, session: int, item: ThinnableObject, thinned: Thinned, now_ns: int) -> ThinnableObject | None:
    """The object with the new content; None, and nothing changes, if it has been evicted or requested in the meantime.

    The caller holds the recovery lock and the spool's lock. Raises OSError or sqlite3.Error, and then nothing changes.
    """
    size, sha256 = len(thinned.body), content_sha256(thinned.body)
    if size >= item.bytes or not 0 < thinned.samples < item.samples:
        raise ValueError(
            f'{item.path} with {item.samples} messages and {item.bytes} bytes is not larger than its thinned content'
        )
    body = tree.new_body(session)
    try:
        if isinstance(thinned.body, bytes):
            tree.write_body(body, thinned.body, {})
            sync(body)
        else:
            link_or_copy(thinned.body.path, body)
        tree.sync_incoming()
        with index.transaction(undo=lambda: tree.remove(tree.part(item.id))):
            row = index.kept.thinnable_row(item.id, item.sha256)
            if row is None:
                return None
            key = free_key(index, row['bucket'], f'{row["key"]}.{THINNED}')
            index.kept.thin(row, FileBody(body, size, sha256), thinned.samples, thinned.lost, key, THINNED, now_ns)
            tree.take_part(item.id, body, None)
            renew(index, item.id, tree.part(item.id))
            tree.sync_incoming()
    finally:
        tree.remove(body)
    tree.move(tree.part(item.id), tree.path(State.KEPT, None, row['bucket'], row['key']))
    return replace(item, samples=thinned.samples, bytes=size, sha256=sha256, step=2 * item.step)
