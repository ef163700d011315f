"""Room in the spool: what a full disk costs, decided object by object and written down as evicted (D9)."""

from __future__ import annotations

import logging
from typing import Final

from shadowhound_data_logger.config import SpoolSettings
from shadowhound_data_logger.model import State
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.index import Index

log = logging.getLogger(__name__)

EVICTION_STEP: Final = 64
"""Objects looked at for one round of eviction."""
OVERHEAD_BYTES: Final = 8192
"""What an object costs on disk beyond its bytes: a block's rounding and its share of the index."""
NO_ROOM: Final = 'no_room'


def make_room(index: Index, tree: Tree, settings: SpoolSettings, needed: int, now_ns: int) -> bool:
    """Evict the least important until ``needed`` bytes fit; False when they cannot, and then nothing is evicted for them.

    The caller holds the spool's lock and is in no transaction: the evictions are one of their own for each round.
    """
    evicted = 0
    while (over := _over(index, tree, settings, needed)) > 0:
        if not evicted and index.evictable_bytes() < over:
            log.error('the spool %s has no room: %d bytes too many, more than may be evicted', tree.root, over)
            return False
        rows = index.evictable(EVICTION_STEP)
        if not rows:
            log.error('the spool %s has no room: %d bytes too many and nothing left that may be evicted', tree.root, over)
            return False
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
    if evicted:
        log.warning('the spool %s evicted %d objects to make room', tree.root, evicted)
    return True


def _over(index: Index, tree: Tree, settings: SpoolSettings, needed: int) -> int:
    """Bytes too many with ``needed`` more, by the quota or by the file system, whichever is worse."""
    return max(index.payload_bytes() + needed - settings.max_bytes, settings.min_free_bytes + needed - tree.free_bytes())
