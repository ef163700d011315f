"""Makes room in the spool: what a full disk costs, decided object by object and recorded as evicted.

This decides what is evicted; a disk that is full at once (ENOSPC) is ``ballast.py``, an open slice ``bags/recording.py``.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from shadowhound_data_logger.clock import SECOND
from shadowhound_data_logger.config import SpoolSettings
from shadowhound_data_logger.model import DataObject, FileBody, State
from shadowhound_data_logger.spool.ballast import BALLAST_BYTES
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.index import Index

log = logging.getLogger(__name__)

EVICTION_STEP: Final = 64
"""Objects looked at for one round of eviction."""
OVERHEAD_BYTES: Final = 8192
"""What an object costs on disk beyond its bytes: a block's rounding and its share of the index."""
NO_ROOM: Final = 'no_room'
TELL_EVERY_NS: Final = 60 * SECOND


@dataclass(frozen=True, slots=True)
class RoomNeeded:
    """What a group of new objects costs."""

    given_up: frozenset[int] = frozenset()
    """Places in the group of those that are not taken in."""
    evicted: int = 0


def make_room(index: Index, tree: Tree, settings: SpoolSettings, objects: Sequence[DataObject], leaving: int,
              now_ns: int) -> RoomNeeded:  # fmt: skip
    """Take in as many of the objects as fit, the most important first, and evict what is not more important for them.

    Of what is equally important the oldest goes. Protected objects are always taken in, and nothing is evicted in vain.
    ``leaving`` bytes are about to be freed. The caller holds the spool's lock and is in no transaction: the evictions are
    one of their own for each round.
    """
    needed = sum(map(_cost, objects))
    there = sum(len(item.body) for item in objects if isinstance(item.body, FileBody))
    if needed <= leaving or (over := _over(index, tree, settings, needed - leaving, there)) <= 0:
        return RoomNeeded()
    free, evictable = needed - over, index.evictable_bytes()
    taken, given_up = 0, set[int]()
    for place in sorted(range(len(objects)), key=lambda place: (not objects[place].protected, objects[place].priority, -place)):
        item = objects[place]
        room = free + sum(size for priority, size in evictable.items() if priority >= item.priority)
        if item.protected or taken + _cost(item) <= room:
            taken += _cost(item)
        else:
            given_up.add(place)
    evicted = 0
    if taken and taken - free <= sum(evictable.values()):
        evicted = _evict(index, tree, settings, taken - leaving, there, now_ns)
    return RoomNeeded(frozenset(given_up), evicted)


def fits(tree: Tree, objects: Sequence[DataObject]) -> bool:
    """Whether the disk takes these objects as it is, before anything leaves it, and the index's log beside them."""
    return tree.free_bytes() >= sum(map(_cost, objects)) + BALLAST_BYTES


def _evict(index: Index, tree: Tree, settings: SpoolSettings, needed: int, there: int, now_ns: int) -> int:
    """Evict the least important, of these the oldest, until ``needed`` bytes fit; returns how many objects that took."""
    evicted = 0
    while (over := _over(index, tree, settings, needed, there)) > 0 and (rows := index.evictable(EVICTION_STEP)):
        count = 0
        while count < len(rows) and over > 0:
            over -= rows[count]['bytes']
            count += 1
        with index.transaction():
            index.move([row['id'] for row in rows[:count]], State.EVICTED, NO_ROOM, now_ns)
        for row in rows[:count]:
            tree.remove(tree.path(State(row['state']), row['reason'], row['bucket'], row['key']))
            tree.remove(tree.part(row['id']))
        evicted += count
    return evicted


def _cost(item: DataObject) -> int:
    return len(item.body) + OVERHEAD_BYTES


def _over(index: Index, tree: Tree, settings: SpoolSettings, needed: int, there: int) -> int:
    """Bytes too many with ``needed`` more, by quota or file system, whichever is worse; ``there`` lie in it already."""
    free = tree.free_bytes() + there
    return max(index.payload_bytes() + needed - settings.max_bytes, settings.min_free_bytes + needed - free)


class Shortage:
    """Logs that objects were evicted: when that begins, once a minute while it lasts, and when it is over."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._lost = 0
        self._lost_ns = self._told_ns = 0
        self.evicted = 0
        """Objects that were evicted since the spool was opened."""

    def note(self, room: RoomNeeded, now_ns: int) -> None:
        """What one commit cost."""
        lost = room.evicted + len(room.given_up)
        if lost:
            self.evicted += lost
            self._lost += lost
            self._lost_ns = now_ns
            if not 0 <= now_ns - self._told_ns < TELL_EVERY_NS:
                self._told_ns = now_ns
                log.warning('the spool %s is full: evicted %d objects so far, the least important first', self._root, self._lost)
        elif self._lost and not 0 <= now_ns - self._lost_ns < TELL_EVERY_NS:
            log.info('the spool %s has had room for a minute; %d objects were evicted', self._root, self._lost)
            self._lost = self._told_ns = 0
