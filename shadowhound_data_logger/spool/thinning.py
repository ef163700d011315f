"""Gives a kept object a content of fewer messages, and a row of its own to those that are gone.

The object keeps its key and place. What went is told by an object beside it (``<key>.thinned``, ``evicted`` because it was
``thinned``), so that ledger, gap journal and catalog know of it as of any other loss.

The new content is synced beside the parts, becomes the object's part inside the transaction, and then takes the place of the
old one: after a death at any moment the row is of the file in its place, or of the part (``recovery.py``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from shadowhound_data_logger.core.durable_files import sync
from shadowhound_data_logger.core.model import FileBody, State
from shadowhound_data_logger.spool.adding import link_or_copy
from shadowhound_data_logger.spool.binding import free_key, renew
from shadowhound_data_logger.spool.files import Tree, content_sha256
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.retention import THINNED


@dataclass(frozen=True, slots=True)
class ThinnableObject:
    """What stays on the robot, and nobody waits for."""

    id: int
    sensor: str
    type: str
    samples: int
    bytes: int
    sha256: str
    content_type: str
    t_start_ns: int
    t_end_ns: int
    """Of the last message that it had at first."""
    step: int
    """One of so many pictures or clouds is left."""
    path: Path

    @classmethod
    def of(cls, row: Mapping[str, Any], tree: Tree) -> ThinnableObject:
        """Of a row of ``Index.thinnable``."""
        path = tree.path(State.KEPT, None, row['bucket'], row['key'])
        names = ('id', 'sensor', 'type', 'samples', 'bytes', 'sha256', 'content_type', 't_start_ns', 't_end_ns')
        return cls(**{name: row[name] for name in names}, step=row['step'] or 1, path=path)


@dataclass(frozen=True, slots=True)
class Thinned:
    """A smaller content of the same time."""

    body: bytes | FileBody
    samples: int
    """Messages that are left, one at least."""
    lost: Mapping[str, int] = field(default_factory=dict)
    """Of a bag's slice: messages that are gone, by topic."""


def thin(index: Index, tree: Tree, session: int, item: ThinnableObject, thinned: Thinned, now_ns: int) -> ThinnableObject | None:
    """The object with the new content; None where it went, or somebody asked for it, meanwhile: then nothing has changed.

    The caller holds recovery lock and spool's lock. Raises OSError or sqlite3.Error, and then nothing has changed.
    """
    size, sha256 = len(thinned.body), content_sha256(thinned.body)
    if size >= item.bytes or not 0 < thinned.samples < item.samples:
        raise ValueError(
            f'{item.path} of {item.samples} messages and {item.bytes} bytes is no larger than what is to be left of it'
        )
    body = tree.new_body(session)
    try:
        if isinstance(thinned.body, bytes):
            tree.write_body(body, thinned.body, {})
            sync(body)
        else:
            link_or_copy(thinned.body.path, body)
        tree.sync_incoming()
        with index.transaction(undo=lambda: _undo(tree, item.id)):
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
    tree.place(tree.part(item.id), tree.path(State.KEPT, None, row['bucket'], row['key']))
    return replace(item, samples=thinned.samples, bytes=size, sha256=sha256, step=2 * item.step)


def _undo(tree: Tree, number: int) -> None:
    tree.remove(tree.part(number))
