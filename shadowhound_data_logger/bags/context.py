"""What recordings share: the folder of bags, the spool, and the rules for names and clocks.

A bag that starts before the clock of this machine is set is named after its boot. It waits in its folder, as objects wait in the
spool (unsynced_objects.py), until the clock is set; then it is renamed after its start time. Its times are not changed, because
the stamps in the messages cannot be changed either; its manifest has the offset to add. If the clock is not set for too long, or
the boot ended before it was set, the bag keeps its name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

from shadowhound_data_logger.bags.manifest import ClockOf
from shadowhound_data_logger.bags.naming import BUCKET, UNSYNCED, bag_name, key_of, slice_file, unsynced_name
from shadowhound_data_logger.bags.queue import MessageBatch
from shadowhound_data_logger.bags.state import BagState
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, Clock
from shadowhound_data_logger.core.clock_watch import UtcOffsets
from shadowhound_data_logger.spool.writer import SpoolWriter

_LATEST: Final = 1 << 63


class BagContext:
    """The folder, robot, clock and spool of the bags of one process.

    Lifecycle: new before the first message is received. Thread-safe.
    """

    def __init__(self, root: Path, robot: str, clock: Clock, writer: SpoolWriter, hold_s: float = 0.0,
                 offsets: Callable[[], Mapping[str, int]] = dict, *,
                 keeps: Callable[[BagState], bool] = lambda _: False) -> None:  # fmt: skip
        """``root`` is the robot's folder of bags; ``writer`` puts them into its spool, under unique names.

        ``hold_s`` and ``offsets`` as in ``UtcOffsets``: how long a bag waits for its date, and the clock offsets of other boots.
        ``keeps`` returns whether the slices of a bag stay on the robot until they are requested.
        """
        self.root = root
        self.keeps = keeps
        self.robot = robot
        self.clock = clock
        self.writer = writer
        self.spool = writer.spool
        self._offsets = UtcOffsets(clock, hold_s, offsets)
        self._first_ns = clock.wall_ns() - clock.boot_ns()

    def unset_clock(self, age_ns: int = 0) -> ClockOf | None:
        """The clock of a bag that started ``age_ns`` ago, if the clock is not set; None if it is."""
        wall_ns, boot_ns = self.clock.wall_ns(), self.clock.boot_ns()
        if wall_ns >= EARLIEST_SANE_NS:
            return None
        return ClockOf(meta.UNSET, self.clock.boot_id, max(0, boot_ns - age_ns), max(0, wall_ns - age_ns), None)

    def name(self, what: str, unset_clock: ClockOf | None, age_ns: int = 0) -> str:
        """A unique name for a bag that starts."""
        if unset_clock is not None:
            return unsynced_name(what, unset_clock.boot_id, unset_clock.boot_ns, self._is_taken)
        return bag_name(what, self.clock.wall_ns() - age_ns, self._is_taken)

    def now_ns(self, unset_clock: ClockOf | None) -> int:
        """The time by the clock of a bag, in ns since 1970."""
        return self.clock.wall_ns() if unset_clock is None else unset_clock.wall_ns + self.clock.boot_ns() - unset_clock.boot_ns

    def can_be_dated(self, state: BagState) -> bool:
        """Whether the date that a bag waits for can be determined now."""
        return not state.is_named and self._offset_ns(state) is not None

    def settle_name(self, state: BagState) -> bool:
        """Give a bag its final name if its date is known; False if it must wait. Nothing is delivered before that."""
        clock = state.clock
        if state.is_named or clock is None:
            return True
        offset_ns = self._offset_ns(state)
        if offset_ns is None:
            return False
        if offset_ns:
            began_ns = clock.boot_ns + offset_ns
            clock = replace(clock, known=meta.SET_LATER, offset_ns=began_ns - clock.wall_ns)
            name = bag_name(state.bag.rpartition(UNSYNCED)[0], began_ns, lambda name: self._is_taken(name, state))
        else:
            name = state.bag
        self.writer.put(rows=[state.set_name(name, clock)], wait=False)
        return True

    def with_bag_times(self, state: BagState, batch: MessageBatch) -> MessageBatch:
        """Messages with their arrival times by the clock of the bag: the clock may have been set just before or since.

        Otherwise a bag that includes that moment would span fifty years.
        """
        clock = state.clock
        low_ns, high_ns = (EARLIEST_SANE_NS, _LATEST) if clock is None else (0, EARLIEST_SANE_NS)
        if all(low_ns <= message.received_ns < high_ns for message in batch.messages):
            return batch
        before_ns = self._first_ns if clock is None else clock.wall_ns - clock.boot_ns
        step_ns = self.clock.wall_ns() - self.clock.boot_ns() - before_ns
        step_ns = step_ns if clock is None else -step_ns
        return batch._replace(messages=[
            each if low_ns <= each.received_ns < high_ns else each._replace(received_ns=each.received_ns + step_ns)
            for each in batch.messages
        ])  # fmt: skip

    def _offset_ns(self, state: BagState) -> int | None:
        assert state.clock is not None
        return self._offsets.of(state.clock.boot_id, state.clock.boot_ns)

    def _is_taken(self, bag: str, by: BagState | None = None) -> bool:
        """Whether a bag other than ``by`` has the name. A restart may find a bag whose slices were delivered already."""
        first = key_of(self.robot, bag, slice_file(bag, 0))
        own = by.slices.get(slice_file(by.folder.name, 0)) if by is not None else None
        if own is not None and self.spool.reading.objects.knows(BUCKET, first, own.sha256):
            return False
        return (self.root / bag).exists() or self.spool.reading.objects.row(BUCKET, first) is not None
