"""The next objects to ship, looked up some at a time, so that a claim costs the same whatever the backlog.

While there are live objects (spooled just now) and a backlog, they take turns. A turn goes to the most important object; but
every fourth turn of the backlog goes to its oldest object, and every second turn of live objects to the priority that was served
longest ago. So nothing starves, and a store that is twice as fast as the robot keeps up with all live objects.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from itertools import chain
from typing import Final

from shadowhound_data_logger.core.model import SpooledObject

IMPORTANT: Final = 128
"""Objects looked up by importance at a time."""
FEW: Final = 32
"""With fewer, more are looked up: a lookup may wait for the disk during a commit, and the other threads use these until then."""
OLDEST: Final = 43
"""Objects looked up by age at a time: as many as are shipped between two lookups by importance, so that neither waits."""
LIVE: Final = 64
"""Objects remembered that have just been spooled, ten seconds of the default profile; older ones are backlog."""
OLDEST_OF_BACKLOG: Final = 4
"""Of so many turns of the backlog one is that of the oldest."""
LOOK_EVERY_S: Final = 1.0
"""Other processes spool too, without waking this one: an idle drain looks this often."""


class Ahead:
    """Looks up objects before they are needed: the backlog in two orders, what is live, and when to ask for more.

    Guarded by the lock of the Schedule it belongs to.
    """

    def __init__(self) -> None:
        self._important: dict[int, SpooledObject] = {}
        self._oldest: dict[int, SpooledObject] = {}
        self._live: dict[int, SpooledObject] = {}
        self._backlog_turns = 0
        self._live_turns = 0
        self._served: dict[int, int] = {}  # priority -> the last turn of what is live that went to it
        self._live_is_next = False
        self._stale = True
        self._more = False
        self._looking = False
        self._settled_meanwhile: set[int] = set()
        self._looked_at = float('-inf')

    def __len__(self) -> int:
        return len(self._important)

    @property
    def is_known(self) -> bool:
        """Whether what is here is all that the spool has."""
        return not (self._stale or self._more or self._looking)

    # -- looking ---------------------------------------------------------------------------------------------------

    def outdate(self) -> None:
        """The spool may hold others by now."""
        self._stale = True

    def add(self, new: Collection[SpooledObject]) -> None:
        """These have just been spooled. Where all that waits is here, and little, no look is needed to know them."""
        self._live.update((item.id, item) for item in new)
        while len(self._live) > LIVE:
            del self._live[next(iter(self._live))]
        if not self.is_known or len(self) + len(new) >= FEW:
            self.outdate()
            return
        both = sorted((*self._important.values(), *new), key=lambda item: (item.priority, item.id))
        self._important = {item.id: item for item in both}
        self._oldest.update((item.id, item) for item in new)

    def wants_look(self, now: float, since: Iterable[float]) -> bool:
        """Whether to look now: something changed, few are left, or not yet looked since one of those times."""
        if self._looking:
            return False
        if self._stale or any(self._looked_at < moment <= now for moment in since):
            return True
        return len(self) < FEW and (self._more or now - self._looked_at >= LOOK_EVERY_S)

    def has_looked_since(self, moment: float) -> bool:
        return self._looked_at >= moment and not self._looking

    def begin_look(self, now: float) -> None:
        self._looking, self._stale, self._looked_at = True, False, now

    def end_look(self, important: Sequence[SpooledObject], oldest: Sequence[SpooledObject], *,
                 taken: Collection[int], without: Collection[str]) -> None:  # fmt: skip
        """Replace both queues; skip ids in ``taken``, buckets in ``without``, and what was settled during the lookup."""
        late, self._settled_meanwhile, self._looking = self._settled_meanwhile, set(), False
        self._more = len(important) >= IMPORTANT
        gone = late.union(taken)
        self._important, self._oldest = (
            {item.id: item for item in items if item.id not in gone and item.bucket not in without}
            for items in (important, oldest)
        )

    def fail_look(self) -> None:
        self._looking, self._stale = False, True

    def settled(self, ids: Collection[int]) -> None:
        """A look that is under way may have read these before they were settled."""
        if self._looking:
            self._settled_meanwhile.update(ids)

    # -- claiming --------------------------------------------------------------------------------------------------

    def take(self, allowed: Callable[[SpooledObject], bool]) -> SpooledObject | None:
        """Remove and return the first one that is allowed now."""
        turns = (self._take_live, self._take_backlog) if self._live_is_next else (self._take_backlog, self._take_live)
        item = turns[0](allowed) or turns[1](allowed)
        if item is not None:
            self._live_is_next = item.id not in self._live
            for known in self._all():
                known.pop(item.id, None)
        return item

    def _take_live(self, allowed: Callable[[SpooledObject], bool]) -> SpooledObject | None:
        queue = list(self._live.values())
        if self._live_turns % 2:
            queue.sort(key=lambda item: self._served.get(item.priority, -1))
        else:
            queue.sort(key=lambda item: item.priority)
        item = next(filter(allowed, queue), None)
        if item is not None:
            self._served[item.priority] = self._live_turns
            self._live_turns += 1
        return item

    def _take_backlog(self, allowed: Callable[[SpooledObject], bool]) -> SpooledObject | None:
        important, oldest = self._important.values(), self._oldest.values()
        queues = (important, oldest) if (self._backlog_turns + 1) % OLDEST_OF_BACKLOG else (oldest, important)
        item = next((item for item in chain(*queues) if item.id not in self._live and allowed(item)), None)
        self._backlog_turns += item is not None
        return item

    def holds(self, bucket: str) -> bool:
        return any(item.bucket == bucket for queue in self._all() for item in queue.values())

    def drop(self, unwanted: Callable[[SpooledObject], bool]) -> None:
        """Forget these objects; a later look finds them again."""
        for queue in self._all():
            for number in [item.id for item in queue.values() if unwanted(item)]:
                del queue[number]

    def _all(self) -> tuple[dict[int, SpooledObject], ...]:
        return self._important, self._oldest, self._live
