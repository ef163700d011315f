"""The room for objects in the spool: makes it by evicting objects, and decides which new objects are stored.

This module decides how much is evicted and when; ``ObjectTable.evictable`` has the order. ``ballast.py`` handles ENOSPC,
``bags/recording.py`` an open slice.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from sqlite3 import Row
from typing import Any, Final

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import KeepSettings, SpoolSettings
from shadowhound_data_logger.core.model import DataObject, FileBody, State
from shadowhound_data_logger.spool.ballast import BALLAST_BYTES
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.index import Index

log = logging.getLogger(__name__)

EVICTION_STEP: Final = 64
"""Objects read for one round of eviction."""
OVERHEAD_BYTES: Final = 8192
"""Disk space of an object besides its bytes: rounding to blocks, and its share of the index."""
NO_ROOM: Final = 'no_room'
KEEP_LIMIT: Final = 'keep_limit'
"""Reason of a kept object evicted although the disk has room, because kept objects exceed ``keep.max_bytes``."""
KEEP_DAYS: Final = 'keep_days'
"""Reason of a kept object evicted because it is older than ``keep.days``."""
THINNED: Final = 'thinned'
"""Reason of a kept object evicted while others of the same time remain: the rate is reduced before the duration."""
SHORT_PART, SHORT_BYTES = 32, 64 << 20
"""Room for kept objects is short when less than this part of it, or less than so many bytes, is left."""
LOG_EVERY_NS: Final = 60 * SECOND


class Room:
    """The room for objects, by the settings and by the file system; counts evictions.

    Methods with an ``index`` must be called under the spool's lock and outside a transaction: each round of evictions is a
    separate one. It logs evictions when they start, once per minute, and when there is room again.
    """

    def __init__(self, tree: Tree, settings: SpoolSettings, keep: KeepSettings) -> None:
        self._tree = tree
        self._settings = settings
        self._keep = keep
        self._lost = 0
        self._lost_ns = self._logged_ns = self._unkept_ns = 0
        self.evicted = 0
        """Objects evicted since the spool was opened."""
        self.unkept = 0
        """How many of them could not be kept, because objects that must not be evicted use all of ``keep.max_bytes``."""

    def fits(self, objects: Sequence[DataObject]) -> bool:
        """Whether the disk has room for these objects and the index's log, without evicting anything. Raises OSError."""
        return self._tree.free_bytes() >= sum(map(_cost, objects)) + BALLAST_BYTES

    def is_short(self, objects: Sequence[DataObject]) -> bool:
        """Whether something must be removed to make room for these objects. Raises OSError."""
        return self._tree.free_bytes() < sum(map(_cost, objects)) + max(BALLAST_BYTES, self._settings.min_free_bytes)

    def is_short_to_keep(self, kept_bytes: int) -> bool:
        """Whether little room is left for kept objects, by ``keep.max_bytes`` or by the disk. Raises OSError."""
        limit = min(self._keep.max_bytes, kept_bytes + self._tree.free_bytes() - self._settings.min_free_bytes)
        return kept_bytes > 0 and kept_bytes > limit - min(max(limit // SHORT_PART, SHORT_BYTES), limit // 4)

    def has_for_bags(self) -> bool:
        """Whether a bag may continue: enough space must be left to spool what it has already written. Raises OSError."""
        return self._tree.free_bytes() >= self._settings.min_free_bytes // 2

    def make(self, index: Index, objects: Sequence[DataObject], leaving: int, now_ns: int) -> frozenset[int]:
        """Evict objects that are not more important than these new ones; returns the positions of those not stored.

        On a full disk, kept objects are evicted first; then the others, by priority and age. Protected objects are always stored,
        and nothing is evicted unless that makes enough room. ``leaving`` bytes are about to be freed.
        """
        kept = [position for position, item in enumerate(objects) if item.is_on_request and not item.held]
        needed = sum(map(_cost, objects)) - leaving
        on_disk = sum(len(item.body) for item in objects if isinstance(item.body, FileBody))
        if not kept and (needed <= 0 or self._excess(index, needed, on_disk) <= 0):
            self._count(0, 0, now_ns)
            return frozenset()
        unkept = self._make_to_keep(index, objects, kept, needed, on_disk, now_ns)
        rest = [position for position in range(len(objects)) if position not in kept]
        on_disk -= sum(len(objects[position].body) for position in unkept if isinstance(objects[position].body, FileBody))
        on_disk -= sum(_cost(objects[position]) for position in kept if position not in unkept)
        needed = sum(_cost(objects[position]) for position in rest)
        evicted, not_stored = 0, set[int]()
        if rest and (excess := self._excess(index, needed - leaving, on_disk)) > 0:
            free, evictable = needed - excess, index.objects.evictable_bytes()
            taken = 0
            for position in sorted(rest, key=lambda each: (not objects[each].protected, objects[each].priority, -each)):
                item = objects[position]
                room = free + sum(size for priority, size in evictable.items() if priority >= item.priority)
                if item.protected or taken + _cost(item) <= room:
                    taken += _cost(item)
                else:
                    not_stored.add(position)
            if taken and taken - free <= sum(evictable.values()):
                evicted = self._evict(
                    index, index.objects.evictable, lambda: (self._excess(index, taken - leaving, on_disk), NO_ROOM), now_ns
                )
        self._count(evicted + len(not_stored), len(unkept), now_ns)
        return frozenset(not_stored | unkept)

    def _make_to_keep(self, index: Index, objects: Sequence[DataObject], kept: Sequence[int], needed: int, on_disk: int,
                      now_ns: int) -> set[int]:  # fmt: skip
        """Evict kept objects, oldest first, for ``keep.max_bytes`` and for a full disk; returns positions of those not kept."""
        new_bytes = sum(len(objects[position].body) for position in kept)

        def excess() -> tuple[int, int]:
            """Bytes too many on the disk, and beyond ``keep.max_bytes``."""
            on_full_disk = self._settings.min_free_bytes + needed - self._tree.free_bytes() - on_disk
            return on_full_disk, index.kept.bytes() + new_bytes - self._keep.max_bytes if kept else 0

        self._evict(index, index.kept.evictable, lambda: (max(by := excess()), NO_ROOM if by[0] > 0 else KEEP_LIMIT), now_ns)
        by_disk, by_limit = excess()
        unkept = set[int]()
        for position in kept:
            if max(by_disk, by_limit) <= 0:
                break
            if not objects[position].protected:
                unkept.add(position)
                by_disk -= _cost(objects[position])
                by_limit -= len(objects[position].body)
        return unkept

    def evict_old(self, index: Index, now_ns: int) -> int:
        """Evict some of the objects kept for longer than ``keep.days``; returns how many."""
        rows = index.kept.evictable(EVICTION_STEP, now_ns - round(self._keep.days * 24 * 3600 * SECOND))
        if rows:
            self._remove(index, rows, KEEP_DAYS, now_ns)
        return len(rows)

    def thin_out(self, index: Index, sha256_of: Mapping[int, str], now_ns: int) -> int:
        """Evict those of these objects that are kept, unchanged and not requested; returns how many."""
        rows = [row for number, sha256 in sha256_of.items() if (row := index.kept.thinnable_row(number, sha256)) is not None]
        self._remove(index, rows, THINNED, now_ns)
        return len(rows)

    def _evict(self, index: Index, next_rows: Callable[[int], Sequence[Row]], excess: Callable[[], tuple[int, str]],
               now_ns: int) -> int:  # fmt: skip
        """Evict the next objects until ``excess`` (bytes too many, and the reason) is gone; returns how many objects."""
        evicted = 0
        while (bytes_and_reason := excess())[0] > 0 and (rows := next_rows(EVICTION_STEP)):
            left, reason = bytes_and_reason
            count = 0
            while count < len(rows) and left > 0:
                left -= rows[count]['bytes']
                count += 1
            self._remove(index, rows[:count], reason, now_ns)
            evicted += count
        return evicted

    def _remove(self, index: Index, rows: Sequence[Row | Mapping[str, Any]], reason: str, now_ns: int) -> None:
        with index.transaction():
            index.states.move([row['id'] for row in rows], State.EVICTED, reason, now_ns)
        for row in rows:
            self._tree.remove(self._tree.path(State(row['state']), row['reason'], row['bucket'], row['key']))
            self._tree.remove(self._tree.part(row['id']))

    def _excess(self, index: Index, needed: int, on_disk: int) -> int:
        """Bytes too many with ``needed`` more, by quota or file system, whichever is worse; ``on_disk`` of them exist already."""
        free = self._tree.free_bytes() + on_disk
        return max(
            index.objects.payload_bytes() + needed - self._settings.max_bytes, self._settings.min_free_bytes + needed - free
        )

    def _count(self, lost: int, unkept: int, now_ns: int) -> None:
        """Count and log the evictions of one commit."""
        self.evicted += lost + unkept
        if unkept:
            self.unkept += unkept
            if not 0 <= now_ns - self._unkept_ns < LOG_EVERY_NS:
                self._unkept_ns = now_ns
                log.error('the spool %s cannot keep more objects, because all kept ones are protected or requested: %d are lost '
                          'so far; raise keep.max_bytes or free some space', self._tree.root, self.unkept)  # fmt: skip
        if lost:
            self._lost += lost
            self._lost_ns = now_ns
            if not 0 <= now_ns - self._logged_ns < LOG_EVERY_NS:
                self._logged_ns = now_ns
                log.warning(
                    'the spool %s is full: evicted %d objects so far, the least important first', self._tree.root, self._lost
                )
        elif self._lost and not 0 <= now_ns - self._lost_ns < LOG_EVERY_NS:
            log.info('the spool %s has had room for a minute; %d objects were evicted', self._tree.root, self._lost)
            self._lost = self._logged_ns = 0


def _cost(item: DataObject) -> int:
    return len(item.body) + OVERHEAD_BYTES
