"""The life of one process with a spool: a row of the index, and a locked file by which others see that it lives."""

from __future__ import annotations

import fcntl
import os

from shadowhound_data_logger.clock import Clock
from shadowhound_data_logger.spool.account_rows import Snapshot
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.index import Index


class Session:
    """``begin`` makes one; then ``end`` until it worked, and ``leave`` once. What never ends is settled by the next start."""

    def __init__(self, number: int, tree: Tree) -> None:
        self.number = number
        self._tree = tree
        self._lock = os.open(tree.session(number), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        fcntl.flock(self._lock, fcntl.LOCK_EX)

    @classmethod
    def begin(cls, index: Index, tree: Tree, robot: str, clock: Clock) -> Session:
        """The caller holds the recovery lock: between row and file nobody may take it for dead."""
        with index.transaction():
            number = index.begin_session(robot, clock.boot_id, os.getpid(), clock.wall_ns())
        return cls(number, tree)

    def end(self, index: Index, snapshot: Snapshot | None, now_ns: int) -> None:
        """Write the last accounts and close them, in one transaction."""
        with index.transaction():
            if snapshot:
                index.write(self.number, snapshot)
            index.end_session(self.number, now_ns)

    def leave(self) -> None:
        """Let go of the file."""
        self._tree.remove(self._tree.session(self.number))
        os.close(self._lock)
