"""Objects that are kept on the robot until they are requested: released, thinned, and evicted before the others.

Thinning replaces the content of a kept object by fewer messages. The object keeps its key and path. The removed messages become a
separate object (``<key>.thinned``, ``evicted`` with the reason ``thinned``), which makes them visible in the ledger, the gap
journal and the catalog like any other loss.

The new content is synced next to the parts, is renamed to the object's part inside the transaction, and then replaces the old
file: after a crash at any moment, either the file in its place or the part matches the row (``recovery.py``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from shadowhound_data_logger.core.clock import Clock
from shadowhound_data_logger.core.durable_files import sync
from shadowhound_data_logger.core.model import FileBody, SpooledObject, State
from shadowhound_data_logger.spool import binding
from shadowhound_data_logger.spool.ballast import Ballast
from shadowhound_data_logger.spool.connections import Connections
from shadowhound_data_logger.spool.files import Tree, content_sha256
from shadowhound_data_logger.spool.new_objects import link_or_copy
from shadowhound_data_logger.spool.retention import THINNED, Room


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


class KeptObjects:
    """The kept objects of a spool. Thread-safe while the spool is open. Methods that write raise as ``Spool.commit``."""

    def __init__(self, connections: Connections, tree: Tree, ballast: Ballast, room: Room, clock: Clock) -> None:
        self._connections = connections
        self._tree = tree
        self._ballast = ballast
        self._room = room
        self._clock = clock

    def release(self, wanted: Sequence[tuple[int, int]]) -> list[SpooledObject]:
        """Let kept objects (id, priority) wait for delivery, all or none; skips those not kept now. Raises as ``Spool.bind``."""
        with self._connections.moving_files() as index:
            return self._ballast.work(lambda: binding.release(index, self._tree, wanted))

    def evict_old(self) -> int:
        """Evict some of the objects older than ``keep.days``; returns how many."""
        with self._connections.lock:
            return self._room.evict_old(self._connections.writing, self._clock.wall_ns())

    def is_short(self) -> bool:
        """Whether little room is left for kept objects, by ``keep.max_bytes`` or by the disk, so that thinning must begin."""
        return self._room.is_short_to_keep(self._connections.reading.kept.bytes())

    def thinnable(self, after: int, limit: int) -> list[ThinnableObject]:
        """Kept objects in no open request with an id larger than ``after``, by id; waits for no commit. Raises sqlite3.Error."""
        return [ThinnableObject.of(row, self._tree) for row in self._connections.reading.kept.thinnable(after, limit)]

    def thin(self, item: ThinnableObject, thinned: Thinned) -> ThinnableObject | None:
        """Replace a kept object's content by less; None, and nothing changes, if it was evicted or requested."""
        if len(thinned.body) >= item.bytes or not 0 < thinned.samples < item.samples:
            raise ValueError(
                f'{item.path} with {item.samples} messages and {item.bytes} bytes is not larger than its thinned content'
            )
        with self._connections.moving_files():
            return self._ballast.work(lambda: self._thin(item, thinned))

    def evict(self, items: Sequence[ThinnableObject]) -> int:
        """Evict some objects while others of the same time stay; returns how many."""
        with self._connections.lock:
            sha256_of = {item.id: item.sha256 for item in items}
            return self._room.thin_out(self._connections.writing, sha256_of, self._clock.wall_ns())

    def _thin(self, item: ThinnableObject, thinned: Thinned) -> ThinnableObject | None:
        index, tree, sha256 = self._connections.writing, self._tree, content_sha256(thinned.body)
        body = tree.new_body(self._connections.session)
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
                key = index.objects.free_key(row['bucket'], f'{row["key"]}.{THINNED}')
                index.kept.thin(row, FileBody(body, len(thinned.body), sha256), thinned.samples, thinned.lost, key, THINNED,
                                self._clock.wall_ns())  # fmt: skip
                tree.take_part(item.id, body, None)
                binding.renew(index, item.id, tree.part(item.id))
                tree.sync_incoming()
        finally:
            tree.remove(body)
        tree.move(tree.part(item.id), tree.path(State.KEPT, None, row['bucket'], row['key']))
        return replace(item, samples=thinned.samples, bytes=len(thinned.body), sha256=sha256, step=2 * item.step)
