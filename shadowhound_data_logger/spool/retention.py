"""Makes room in the spool by evicting objects, and decides which new objects are stored.

This module decides how much is evicted and when; ``ObjectTable.evictable`` has the order. ``ballast.py`` handles ENOSPC,
``bags/recording.py`` an open slice.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
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
LOG_EVERY_NS: Final = 60 * SECOND


@dataclass(frozen=True, slots=True)
class RoomMade:
    """What making room for a group of new objects took."""

    not_stored: frozenset[int] = frozenset()
    """Indexes of the objects of the group that are evicted immediately."""
    evicted: int = 0
    """Objects that were in the spool before."""
    unkept: int = 0
    """How many of ``not_stored`` could not be kept, because objects that must not be evicted use all of ``keep.max_bytes``."""


def make_room(index: Index, tree: Tree, settings: SpoolSettings, keep: KeepSettings, objects: Sequence[DataObject],
              leaving: int, now_ns: int) -> RoomMade:  # fmt: skip
    """Decide which of the objects to store, by priority, and evict objects that are not more important.

    On a full disk, kept objects are evicted first; then the others, by priority and age. Protected objects
    are always stored, and nothing is evicted unless that makes enough room. ``leaving`` bytes are about to be freed. The caller
    holds the spool's lock and is not in a transaction: each round of evictions is a separate one.
    """
    kept = [position for position, item in enumerate(objects) if item.is_on_request and not item.held]
    needed = sum(map(_cost, objects))
    on_disk = sum(len(item.body) for item in objects if isinstance(item.body, FileBody))
    if not kept and (needed <= leaving or _excess(index, tree, settings, needed - leaving, on_disk) <= 0):
        return RoomMade()
    unkept = _make_room_to_keep(index, tree, settings, keep, objects, kept, leaving, now_ns)
    kept_bytes = sum(_cost(objects[position]) for position in kept if position not in unkept)
    rest = [position for position in range(len(objects)) if position not in kept]
    needed = sum(_cost(objects[position]) for position in rest)
    on_disk -= sum(len(objects[position].body) for position in unkept if isinstance(objects[position].body, FileBody))
    if not rest or (excess := _excess(index, tree, settings, needed - leaving, on_disk - kept_bytes)) <= 0:
        return RoomMade(frozenset(unkept), 0, len(unkept))
    free, evictable = needed - excess, index.objects.evictable_bytes()
    taken, not_stored = 0, set[int]()
    for position in sorted(rest, key=lambda position: (not objects[position].protected, objects[position].priority, -position)):
        item = objects[position]
        room = free + sum(size for priority, size in evictable.items() if priority >= item.priority)
        if item.protected or taken + _cost(item) <= room:
            taken += _cost(item)
        else:
            not_stored.add(position)
    evicted = 0
    if taken and taken - free <= sum(evictable.values()):
        needed = taken - leaving
        evicted = _evict(index, tree, index.objects.evictable,
                         lambda: (_excess(index, tree, settings, needed, on_disk - kept_bytes), NO_ROOM), now_ns)  # fmt: skip
    return RoomMade(frozenset(not_stored | unkept), evicted, len(unkept))


def _make_room_to_keep(index: Index, tree: Tree, settings: SpoolSettings, keep: KeepSettings, objects: Sequence[DataObject],  # noqa: PLR0913, PLR0917 - as of make_room
                       kept: Sequence[int], leaving: int, now_ns: int) -> set[int]:  # fmt: skip
    """Evict kept objects, oldest first, for ``keep.max_bytes`` and for a full disk; returns the indexes of those not kept."""
    needed = sum(map(_cost, objects))
    on_disk = sum(len(item.body) for item in objects if isinstance(item.body, FileBody))
    new_bytes = sum(len(objects[position].body) for position in kept)

    def excess() -> tuple[int, int]:
        """Bytes too many on the disk, and beyond ``keep.max_bytes``."""
        on_full_disk = settings.min_free_bytes + needed - leaving - tree.free_bytes() - on_disk
        return on_full_disk, index.kept.bytes() + new_bytes - keep.max_bytes if kept else 0

    _evict(index, tree, index.kept.evictable, lambda: (max(by := excess()), NO_ROOM if by[0] > 0 else KEEP_LIMIT), now_ns)
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


def evict_old(index: Index, tree: Tree, keep: KeepSettings, now_ns: int) -> int:
    """Evict some of the objects kept for longer than ``keep.days``; returns how many. Locks as for ``make_room``."""
    rows = index.kept.evictable(EVICTION_STEP, now_ns - round(keep.days * 24 * 3600 * SECOND))
    if rows:
        _remove(index, tree, rows, KEEP_DAYS, now_ns)
    return len(rows)


def thin_out(index: Index, tree: Tree, sha256_of: Mapping[int, str], now_ns: int) -> int:
    """Evict those of these objects that are kept, unchanged and not requested; returns how many. Locks as for ``make_room``."""
    rows = [row for number, sha256 in sha256_of.items() if (row := index.kept.thinnable_row(number, sha256)) is not None]
    _remove(index, tree, rows, THINNED, now_ns)
    return len(rows)


def _remove(index: Index, tree: Tree, rows: Sequence[Row | Mapping[str, Any]], reason: str, now_ns: int) -> None:
    with index.transaction():
        index.states.move([row['id'] for row in rows], State.EVICTED, reason, now_ns)
    for row in rows:
        tree.remove(tree.path(State(row['state']), row['reason'], row['bucket'], row['key']))
        tree.remove(tree.part(row['id']))


def fits(tree: Tree, objects: Sequence[DataObject]) -> bool:
    """Whether the disk has room for these objects and the index's log, without evicting anything."""
    return tree.free_bytes() >= sum(map(_cost, objects)) + BALLAST_BYTES


def is_short(tree: Tree, settings: SpoolSettings, objects: Sequence[DataObject]) -> bool:
    """Whether something must be removed to make room for these objects."""
    return tree.free_bytes() < sum(map(_cost, objects)) + max(BALLAST_BYTES, settings.min_free_bytes)


def _evict(index: Index, tree: Tree, next_rows: Callable[[int], Sequence[Row]], excess: Callable[[], tuple[int, str]],
           now_ns: int) -> int:  # fmt: skip
    """Evict the next objects until ``excess`` (bytes too many, and the reason) is gone; returns how many objects."""
    evicted = 0
    while (bytes_and_reason := excess())[0] > 0 and (rows := next_rows(EVICTION_STEP)):
        left, reason = bytes_and_reason
        count = 0
        while count < len(rows) and left > 0:
            left -= rows[count]['bytes']
            count += 1
        _remove(index, tree, rows[:count], reason, now_ns)
        evicted += count
    return evicted


def _cost(item: DataObject) -> int:
    return len(item.body) + OVERHEAD_BYTES


def _excess(index: Index, tree: Tree, settings: SpoolSettings, needed: int, on_disk: int) -> int:
    """Bytes too many with ``needed`` more, by quota or file system, whichever is worse; ``on_disk`` of them exist already."""
    free = tree.free_bytes() + on_disk
    return max(index.objects.payload_bytes() + needed - settings.max_bytes, settings.min_free_bytes + needed - free)


class Shortage:
    """Counts evictions and logs them: when they start, once per minute, and when there is room again."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._lost = 0
        self._lost_ns = self._logged_ns = self._unkept_ns = 0
        self.evicted = 0
        """Objects evicted since the spool was opened."""
        self.unkept = 0
        """How many of them could not be kept, because no kept object may be evicted."""

    def note(self, room: RoomMade, now_ns: int) -> None:
        """Count the evictions of one commit."""
        lost = room.evicted + len(room.not_stored) - room.unkept
        self.evicted += room.unkept
        if room.unkept:
            self.unkept += room.unkept
            if not 0 <= now_ns - self._unkept_ns < LOG_EVERY_NS:
                self._unkept_ns = now_ns
                log.error('the spool %s cannot keep more objects, because all kept ones are protected or requested: %d are lost '
                          'so far; raise keep.max_bytes or free some space', self._root, self.unkept)  # fmt: skip
        if lost:
            self.evicted += lost
            self._lost += lost
            self._lost_ns = now_ns
            if not 0 <= now_ns - self._logged_ns < LOG_EVERY_NS:
                self._logged_ns = now_ns
                log.warning('the spool %s is full: evicted %d objects so far, the least important first', self._root, self._lost)
        elif self._lost and not 0 <= now_ns - self._lost_ns < LOG_EVERY_NS:
            log.info('the spool %s has had room for a minute; %d objects were evicted', self._root, self._lost)
            self._lost = self._logged_ns = 0
