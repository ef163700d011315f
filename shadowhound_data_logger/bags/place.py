"""Where bags begin and leave, what they are named by, and by which clock their times are.

A bag that begins while the clock of this machine is not set has the name of its boot. It waits in its folder, as the spool holds
objects (spool/redating.py), until the clock is set; then it is named after the time at which it began. Its times stay as
they are, for so do the stamps within the messages, and its manifest says what is to be added. Where the clock is not set for too
long, or the boot ended before it was, the bag keeps the name that it has.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

from shadowhound_data_logger.bags.manifest import ClockOf
from shadowhound_data_logger.bags.naming import BUCKET, UNSYNCED, bag_name, key_of, slice_file, unsynced_name
from shadowhound_data_logger.bags.queue import Lot
from shadowhound_data_logger.bags.state import BagState
from shadowhound_data_logger.core import metadata_words as words
from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, Clock
from shadowhound_data_logger.core.dating import Dating
from shadowhound_data_logger.spool.writer import SpoolWriter

_LATEST: Final = 1 << 63


class BagPlace:
    """The folder, the robot, the clock and the spool that bags are recorded with.

    New before anything is received; from any thread.
    """

    def __init__(self, root: Path, robot: str, clock: Clock, writer: SpoolWriter, hold_s: float = 0.0,
                 offsets: Callable[[], Mapping[str, int]] = dict, *,
                 keeps: Callable[[BagState], bool] = lambda _: False) -> None:  # fmt: skip
        """``root`` is the robot's folder of bags; bags go through ``writer`` into its spool, under names that none has there.

        ``hold_s`` and ``offsets`` as in ``Dating``: how long a bag waits for its date, and what is known of other boots.
        ``keeps`` says whether the slices of a bag stay on the robot until somebody asks for them.
        """
        self.root = root
        self.keeps = keeps
        self.robot = robot
        self.clock = clock
        self.writer = writer
        self.spool = writer.spool
        self._dating = Dating(clock, hold_s, offsets)
        self._first_ns = clock.wall_ns() - clock.boot_ns()

    def unset(self, age_ns: int = 0) -> ClockOf | None:
        """The clock of a bag that began so long ago, where it is not set; None where it is."""
        wall_ns, boot_ns = self.clock.wall_ns(), self.clock.boot_ns()
        if wall_ns >= EARLIEST_SANE_NS:
            return None
        return ClockOf(words.UNSET, self.clock.boot_id, max(0, boot_ns - age_ns), max(0, wall_ns - age_ns), None)

    def name(self, what: str, unset: ClockOf | None, age_ns: int = 0) -> str:
        """A name for a bag that begins, which no other has."""
        if unset is not None:
            return unsynced_name(what, unset.boot_id, unset.boot_ns, self._is_taken)
        return bag_name(what, self.clock.wall_ns() - age_ns, self._is_taken)

    def now_ns(self, unset: ClockOf | None) -> int:
        """What the clock of a bag shows, in ns since 1970."""
        return self.clock.wall_ns() if unset is None else unset.wall_ns + self.clock.boot_ns() - unset.boot_ns

    def is_due(self, state: BagState) -> bool:
        """Whether more of what a bag waits for is known than when it began."""
        return not state.is_named and self._offset_ns(state) is not None

    def settle(self, state: BagState) -> bool:
        """Whether a bag has its name for good; it gets it as soon as that is known, before anything of it leaves."""
        clock = state.clock
        if state.is_named or clock is None:
            return True
        offset_ns = self._offset_ns(state)
        if offset_ns is None:
            return False
        if offset_ns:
            began_ns = clock.boot_ns + offset_ns
            clock = replace(clock, known=words.SET_LATER, offset_ns=began_ns - clock.wall_ns)
            name = bag_name(state.bag.rpartition(UNSYNCED)[0], began_ns, lambda name: self._is_taken(name, state))
        else:
            name = state.bag
        self.writer.put(rows=[state.set_name(name, clock)], wait=False)
        return True

    def by_clock_of(self, state: BagState, lot: Lot) -> Lot:
        """Messages with the time at which they came by the clock of the bag: it may have been set meanwhile, or just before.

        Else a bag with that moment in it would last for fifty years.
        """
        clock = state.clock
        low_ns, high_ns = (EARLIEST_SANE_NS, _LATEST) if clock is None else (0, EARLIEST_SANE_NS)
        if all(low_ns <= message.received_ns < high_ns for message in lot.messages):
            return lot
        before_ns = self._first_ns if clock is None else clock.wall_ns - clock.boot_ns
        step_ns = self.clock.wall_ns() - self.clock.boot_ns() - before_ns
        step_ns = step_ns if clock is None else -step_ns
        return lot._replace(messages=[
            each if low_ns <= each.received_ns < high_ns else each._replace(received_ns=each.received_ns + step_ns)
            for each in lot.messages
        ])  # fmt: skip

    def _offset_ns(self, state: BagState) -> int | None:
        assert state.clock is not None
        return self._dating.offset_ns(state.clock.boot_id, state.clock.boot_ns)

    def _is_taken(self, bag: str, by: BagState | None = None) -> bool:
        """Whether another bag than ``by`` has the name: a start may find one again that had left already."""
        first = key_of(self.robot, bag, slice_file(bag, 0))
        own = by.slices.get(slice_file(by.folder.name, 0)) if by is not None else None
        if own is not None and self.spool.knows(BUCKET, first, own.sha256):
            return False
        return (self.root / bag).exists() or self.spool.has(BUCKET, first)
