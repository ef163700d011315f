"""The life of one process with a spool: a row of the index, a locked file that shows that it lives, and what it carries over.

What earlier sessions left open in files of their own becomes the next session's to account for. A message is open until its file
is spooled, or known to be lost. The two rows change in one transaction, so that the sums stay.
"""

from __future__ import annotations

import os
from dataclasses import replace

from shadowhound_data_logger.core.clock import Clock
from shadowhound_data_logger.core.durable_files import lock
from shadowhound_data_logger.core.stamps import NO_TIMES
from shadowhound_data_logger.spool.account_rows import AccountSnapshot, TopicRow
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.index import Index


class Session:
    """The life of one process with a spool.

    ``begin`` makes one; then ``end`` until it worked, and ``leave`` once. A session that never ends is settled by the next start.
    """

    def __init__(self, number: int, tree: Tree) -> None:
        self.number = number
        self._tree = tree
        self._lock = os.open(tree.session(number), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        lock(self._lock)

    @classmethod
    def begin(cls, index: Index, tree: Tree, robot: str, clock: Clock) -> Session:
        """The caller holds the recovery lock: between row and file nobody may take it for dead."""
        with index.transaction():
            number = index.accounts.begin_session(robot, clock.boot_id, os.getpid(), clock.wall_ns())
        return cls(number, tree)

    def end(self, index: Index, snapshot: AccountSnapshot | None, now_ns: int) -> None:
        """Write the last accounts and close them, in one transaction."""
        with index.transaction():
            if snapshot:
                index.accounts.write(self.number, snapshot)
            index.accounts.end_session(self.number, now_ns)

    def leave(self) -> None:
        """Let go of the file."""
        self._tree.remove(self._tree.session(self.number))
        os.close(self._lock)


def carry(index: Index, session: int, robot: str, sink: str) -> list[TopicRow]:
    """Move what a robot's ended sessions left open to this one; its new rows. In a transaction, before it has any of the sink."""
    moved: dict[str, TopicRow] = {}
    for number in index.accounts.sessions_with_open(robot, sink):
        for row in index.accounts.topics(number):
            if row.topic.startswith(sink) and row.open > 0:
                before = moved.get(row.topic) or TopicRow(row.topic, '', '', 0, 0, 0, {}, {}, NO_TIMES)
                unknown = min(row.unknown, row.open)
                estimated = min(row.estimated, row.open - unknown)
                moved[row.topic] = replace(
                    before, type=row.type, accounting=row.accounting, received=before.received + row.open,
                    estimated=before.estimated + estimated, unknown=before.unknown + unknown,
                    last_kept=max(before.last_kept, row.last_kept), heard=max(before.heard, row.heard),
                )  # fmt: skip
                index.accounts.take_over(number, row.topic, row.open, estimated, unknown)
    index.accounts.write(session, AccountSnapshot(tuple(moved.values()), ()))
    return list(moved.values())
