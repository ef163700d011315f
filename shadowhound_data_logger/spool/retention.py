"""Makes room in the spool: what a full disk costs, decided object by object and recorded as evicted.

This decides how much is evicted and when; the order is that of ``Index.evictable``. A disk that is full at once (ENOSPC) is
``ballast.py``, an open slice ``bags/recording.py``.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
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
"""Objects looked at for one round of eviction."""
OVERHEAD_BYTES: Final = 8192
"""What an object costs on disk beyond its bytes: a block's rounding and its share of the index."""
NO_ROOM: Final = 'no_room'
KEEP_LIMIT: Final = 'keep_limit'
"""Why a kept object is evicted where there is room on the disk: beyond ``keep.max_bytes`` the oldest go."""
KEEP_DAYS: Final = 'keep_days'
"""The same of one that was kept for long enough."""
THINNED: Final = 'thinned'
"""The same where others of its time stay: room ran short, and rate goes before time."""
TELL_EVERY_NS: Final = 60 * SECOND


@dataclass(frozen=True, slots=True)
class RoomNeeded:
    """What a group of new objects costs."""

    given_up: frozenset[int] = frozenset()
    """Places in the group of those that are not taken in."""
    evicted: int = 0
    unkept: int = 0
    """Of those, how many could not be kept because what may not be evicted takes all of ``keep.max_bytes``."""


def make_room(index: Index, tree: Tree, settings: SpoolSettings, keep: KeepSettings, objects: Sequence[DataObject],
              leaving: int, now_ns: int) -> RoomNeeded:  # fmt: skip
    """Take in as many of the objects as fit, the most important first, and evict what is not more important for them.

    Where the disk is full what is kept goes first. Then, of what is equally important, the oldest goes. Protected objects are
    always taken in, and nothing is evicted in vain. ``leaving`` bytes are about to be freed. The caller holds the spool's lock
    and is in no transaction: the evictions are one of their own for each round.
    """
    kept = [place for place, item in enumerate(objects) if item.is_on_request and not item.held]
    needed = sum(map(_cost, objects))
    there = sum(len(item.body) for item in objects if isinstance(item.body, FileBody))
    if not kept and (needed <= leaving or _over(index, tree, settings, needed - leaving, there) <= 0):
        return RoomNeeded()
    unkept = _make_room_to_keep(index, tree, settings, keep, objects, kept, leaving, now_ns)
    beside = sum(_cost(objects[place]) for place in kept if place not in unkept)
    rest = [place for place in range(len(objects)) if place not in kept]
    needed = sum(_cost(objects[place]) for place in rest)
    there -= sum(len(objects[place].body) for place in unkept if isinstance(objects[place].body, FileBody))
    if not rest or (over := _over(index, tree, settings, needed - leaving, there - beside)) <= 0:
        return RoomNeeded(frozenset(unkept), 0, len(unkept))
    free, evictable = needed - over, index.objects.evictable_bytes()
    taken, given_up = 0, set[int]()
    for place in sorted(rest, key=lambda place: (not objects[place].protected, objects[place].priority, -place)):
        item = objects[place]
        room = free + sum(size for priority, size in evictable.items() if priority >= item.priority)
        if item.protected or taken + _cost(item) <= room:
            taken += _cost(item)
        else:
            given_up.add(place)
    evicted = 0
    if taken and taken - free <= sum(evictable.values()):
        evicted = _evict(index, tree, settings, taken - leaving, there - beside, now_ns)
    return RoomNeeded(frozenset(given_up | unkept), evicted, len(unkept))


def _make_room_to_keep(index: Index, tree: Tree, settings: SpoolSettings, keep: KeepSettings, objects: Sequence[DataObject],  # noqa: PLR0913, PLR0917 - as of make_room
                       kept: Sequence[int], leaving: int, now_ns: int) -> set[int]:  # fmt: skip
    """Evict what is kept, the oldest first, for ``keep.max_bytes`` and for a full disk; returns places of what is not kept."""
    needed = sum(map(_cost, objects))
    there = sum(len(item.body) for item in objects if isinstance(item.body, FileBody))
    asked = sum(len(objects[place].body) for place in kept)

    def over() -> tuple[int, int]:
        """By the disk, and by the limit."""
        short = settings.min_free_bytes + needed - leaving - tree.free_bytes() - there
        return short, index.kept.bytes() + asked - keep.max_bytes if kept else 0

    while max(by := over()) > 0 and (rows := index.kept.evictable(EVICTION_STEP)):
        left, count = max(by), 0
        while count < len(rows) and left > 0:
            left -= rows[count]['bytes']
            count += 1
        _remove(index, tree, rows[:count], NO_ROOM if by[0] > 0 else KEEP_LIMIT, now_ns)
    short, beyond = over()
    left_out = set[int]()
    for place in kept:
        if max(short, beyond) <= 0:
            break
        if not objects[place].protected:
            left_out.add(place)
            short -= _cost(objects[place])
            beyond -= len(objects[place].body)
    return left_out


def evict_old(index: Index, tree: Tree, keep: KeepSettings, now_ns: int) -> int:
    """Evict what has been kept for ``keep.days``, some of it at a time; returns how many objects. As of ``make_room``."""
    rows = index.kept.evictable(EVICTION_STEP, now_ns - round(keep.days * 24 * 3600 * SECOND))
    if rows:
        _remove(index, tree, rows, KEEP_DAYS, now_ns)
    return len(rows)


def thin_out(index: Index, tree: Tree, sha256_of: Mapping[int, str], now_ns: int) -> int:
    """Evict these where they are kept as they were and nobody asked for them; returns how many. As of ``make_room``."""
    rows = [row for number, sha256 in sha256_of.items() if (row := index.kept.thinnable_row(number, sha256)) is not None]
    _remove(index, tree, rows, THINNED, now_ns)
    return len(rows)


def _remove(index: Index, tree: Tree, rows: Sequence[Row | Mapping[str, Any]], reason: str, now_ns: int) -> None:
    with index.transaction():
        index.objects.move([row['id'] for row in rows], State.EVICTED, reason, now_ns)
    for row in rows:
        tree.remove(tree.path(State(row['state']), row['reason'], row['bucket'], row['key']))
        tree.remove(tree.part(row['id']))


def fits(tree: Tree, objects: Sequence[DataObject]) -> bool:
    """Whether the disk takes these objects as it is, before anything leaves it, and the index's log beside them."""
    return tree.free_bytes() >= sum(map(_cost, objects)) + BALLAST_BYTES


def is_short(tree: Tree, settings: SpoolSettings, objects: Sequence[DataObject]) -> bool:
    """Whether something would have to leave the disk for these objects."""
    return tree.free_bytes() < sum(map(_cost, objects)) + max(BALLAST_BYTES, settings.min_free_bytes)


def _evict(index: Index, tree: Tree, settings: SpoolSettings, needed: int, there: int, now_ns: int) -> int:
    """Evict the least important, of these the oldest, until ``needed`` bytes fit; returns how many objects that took."""
    evicted = 0
    while (over := _over(index, tree, settings, needed, there)) > 0 and (rows := index.objects.evictable(EVICTION_STEP)):
        count = 0
        while count < len(rows) and over > 0:
            over -= rows[count]['bytes']
            count += 1
        _remove(index, tree, rows[:count], NO_ROOM, now_ns)
        evicted += count
    return evicted


def _cost(item: DataObject) -> int:
    return len(item.body) + OVERHEAD_BYTES


def _over(index: Index, tree: Tree, settings: SpoolSettings, needed: int, there: int) -> int:
    """Bytes too many with ``needed`` more, by quota or file system, whichever is worse; ``there`` lie in it already."""
    free = tree.free_bytes() + there
    return max(index.objects.payload_bytes() + needed - settings.max_bytes, settings.min_free_bytes + needed - free)


class Shortage:
    """Logs that objects were evicted: when that begins, once a minute while it lasts, and when it is over."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._lost = 0
        self._lost_ns = self._told_ns = self._unkept_ns = 0
        self.evicted = 0
        """Objects that were evicted since the spool was opened."""
        self.unkept = 0
        """Of those, how many could not be kept because nothing that is kept may be evicted."""

    def note(self, room: RoomNeeded, now_ns: int) -> None:
        """What one commit cost."""
        lost = room.evicted + len(room.given_up) - room.unkept
        self.evicted += room.unkept
        if room.unkept:
            self.unkept += room.unkept
            if not 0 <= now_ns - self._unkept_ns < TELL_EVERY_NS:
                self._unkept_ns = now_ns
                log.error('the spool %s keeps nothing more: all in it is protected or asked for; %d objects are lost so far',
                          self._root, self.unkept)  # fmt: skip
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
