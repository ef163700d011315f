"""The session of one process with a spool: a row of the index, and a file that the process keeps locked while it runs.

Messages that earlier sessions left open in files become the next session's to account for. A message is open until its file is
spooled or known to be lost. Both sessions' rows change in one transaction, so the sums do not change.
"""

from __future__ import annotations

import os
import re
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.clock import Clock
from shadowhound_data_logger.core.durable_files import lock
from shadowhound_data_logger.core.stamps import NO_TIMES
from shadowhound_data_logger.spool.account_rows import AccountSnapshot, TopicRow
from shadowhound_data_logger.spool.index import Index

_NUMBER: Final = re.compile(r'[1-9][0-9]{0,17}')


class SessionFiles:
    """The files of sessions in a spool folder; stateless. A session without a locked file is dead."""

    def __init__(self, root: Path) -> None:
        self._folder = root / 'sessions'

    def path(self, number: int) -> Path:
        """The file that a running session keeps locked."""
        return self._folder / str(number)

    def numbers(self) -> frozenset[int]:
        """The sessions that are running, and those that did not end."""
        return frozenset(int(path.name) for path in self._folder.iterdir() if _NUMBER.fullmatch(path.name))

    def is_dead(self, number: int) -> bool:
        """Whether the process of a session has exited: its file can be locked, or does not exist."""
        try:
            descriptor = os.open(self.path(number), os.O_RDWR | os.O_CLOEXEC)
        except FileNotFoundError:
            return True
        try:
            return lock(descriptor, wait=False)
        finally:
            os.close(descriptor)

    def is_any_running(self) -> bool:
        """Whether a process has the spool open."""
        return not all(self.is_dead(number) for number in self.numbers())


class Session:
    """The session of one process with a spool.

    Lifecycle: ``begin``; ``end`` until it succeeds; ``leave`` once. The next startup settles a session that did not end.
    """

    def __init__(self, number: int, root: Path) -> None:
        self.number = number
        self._path = SessionFiles(root).path(number)
        self._lock = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        lock(self._lock)

    @classmethod
    def begin(cls, index: Index, root: Path, robot: str, clock: Clock) -> Session:
        """Begin a session. The caller holds the recovery lock, so that no process settles it before its file is locked."""
        with index.transaction():
            number = index.accounts.begin_session(robot, clock.boot_id, os.getpid(), clock.wall_ns())
        return cls(number, root)

    def end(self, index: Index, snapshot: AccountSnapshot | None, now_ns: int) -> None:
        """Write the last accounts and end the session, in one transaction."""
        with index.transaction():
            if snapshot:
                index.accounts.write(self.number, snapshot)
            index.accounts.end_session(self.number, now_ns)

    def leave(self) -> None:
        """Remove and unlock the file."""
        with suppress(OSError):  # recovery removes it
            self._path.unlink()
        os.close(self._lock)


def carry(index: Index, session: int, robot: str, sink: str) -> list[TopicRow]:
    """Move the open messages of a robot's ended sessions to this one; returns its new rows.

    Call it in a transaction, before this session has accounts of the sink.
    """
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
                    last_stored=max(before.last_stored, row.last_stored), newest=max(before.newest, row.newest),
                )  # fmt: skip
                index.accounts.take_over(number, row.topic, row.open, estimated, unknown)
    index.accounts.write(session, AccountSnapshot(tuple(moved.values()), ()))
    return list(moved.values())
