"""Objects that are kept on the robot until they are requested: released, thinned, and evicted before the others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from shadowhound_data_logger.core.clock import Clock
from shadowhound_data_logger.core.config import KeepSettings, SpoolSettings
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.spool import binding, retention, thinning
from shadowhound_data_logger.spool.ballast import Ballast
from shadowhound_data_logger.spool.connections import Connections
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.thinning import ThinnableObject, Thinned

SHORT_PART, SHORT_BYTES = 32, 64 << 20
"""Room is short when less than this part of it, or less than so many bytes, is left."""
KEEP: Final = KeepSettings()


class KeptObjects:
    """The kept objects of a spool. Thread-safe while the spool is open."""

    def __init__(self, connections: Connections, tree: Tree, ballast: Ballast, spool: SpoolSettings, keep: KeepSettings,
                 clock: Clock) -> None:  # fmt: skip
        self._connections = connections
        self._tree = tree
        self._ballast = ballast
        self._min_free_bytes = spool.min_free_bytes
        self._keep = keep
        self._clock = clock

    def bytes(self) -> int:
        """Of all kept objects; waits for no commit. Raises sqlite3.Error."""
        return self._connections.reading.kept.bytes()

    def release(self, wanted: Sequence[tuple[int, int]]) -> list[SpooledObject]:
        """Let kept objects (id, priority) wait for delivery, all or none; skips those not kept now. Raises as ``Spool.bind``."""
        with self._connections.moving_files() as index:
            return self._ballast.work(lambda: binding.release(index, self._tree, wanted))

    def evict_old(self) -> int:
        """Evict some of the objects older than ``keep.days``; returns how many. Raises OSError, sqlite3.Error."""
        with self._connections.lock:
            return retention.evict_old(self._connections.writing, self._tree, self._keep, self._clock.wall_ns())

    def is_short(self) -> bool:
        """Whether little room is left for kept objects, by ``keep.max_bytes`` or by the disk, so that thinning must begin."""
        kept = self.bytes()
        most = min(self._keep.max_bytes, kept + self._tree.free_bytes() - self._min_free_bytes)
        return kept > 0 and kept > most - min(max(most // SHORT_PART, SHORT_BYTES), most // 4)

    def thinnable(self, after: int, limit: int) -> list[ThinnableObject]:
        """Kept objects in no open request with an id larger than ``after``, by id; waits for no commit. Raises sqlite3.Error."""
        return [ThinnableObject.of(row, self._tree) for row in self._connections.reading.kept.thinnable(after, limit)]

    def thin(self, item: ThinnableObject, thinned: Thinned) -> ThinnableObject | None:
        """Replace a kept object's content by less; None if it was evicted or requested. Raises as ``Spool.commit``."""
        with self._connections.moving_files() as index:
            now_ns = self._clock.wall_ns()
            return self._ballast.work(lambda: thinning.thin(index, self._tree, self._connections.session, item, thinned, now_ns))

    def evict(self, items: Sequence[ThinnableObject]) -> int:
        """Evict some objects while others of the same time stay; returns how many. Raises OSError, sqlite3.Error."""
        with self._connections.lock:
            sha256_of = {item.id: item.sha256 for item in items}
            return retention.thin_out(self._connections.writing, self._tree, sha256_of, self._clock.wall_ns())
