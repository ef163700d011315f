"""Writes a mission to disk: its journal and the copies of its files."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any

from shadowhound_data_logger.core.clock import Clock, now_ns
from shadowhound_data_logger.core.durable_files import sync
from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.missions import copies
from shadowhound_data_logger.missions.folder import MissionFolder
from shadowhound_data_logger.missions.journal import Journal
from shadowhound_data_logger.policies.folder import PolicyFolder

log = logging.getLogger(__name__)


class MissionRecorder:
    """Writes one mission to disk, and counts what cannot be logged.

    Lifecycle: New; append from any thread; sync from one; close once. A record of the kind ``end`` is the last one.

    ``_lock`` guards the journal together with the list of files to sync and the flag that the mission has ended.
    """

    def __init__(self, folder: MissionFolder, journal: Journal, clock: Clock, policy: str | None = None) -> None:
        """``policy`` is the one that the first record of the journal names."""
        self.folder = folder
        self.has_ended = False
        self.lost = 0
        """Calls whose data a full disk did not accept."""
        self._clock = clock
        self._journal = journal
        self._policies = PolicyFolder(folder.path.parents[1])
        self._policy = policy
        self._numbers = count(1)
        self._lock = threading.Lock()
        self._unsynced: list[Path] = []
        self._is_dirty = True
        self._warned: set[str] = set()

    def append(self, kind: str, **fields: Any) -> None:
        """Journal a record with the current time; after the end, only warn. Raises OSError (a full disk)."""
        record = {'k': kind, 't': now_ns(self._clock), **fields}
        with self._lock:
            ended = self.has_ended
            if not ended:
                self.has_ended = kind == 'end'
                self._journal.append(record)
                self._is_dirty = True
                if 'file' in fields:
                    self._unsynced.append(self.folder.files / fields['file'])
        if ended:
            self.is_over()

    def append_frame(self, data: memoryview, **fields: Any) -> None:
        """Store a JPEG and journal it. Raises OSError."""
        name = f'{next(self._numbers):08d}.jpg'
        copies.write(self.folder.files / name, data)
        self.append('frame', file=name, **fields)

    def append_copy(self, kind: str, path: str | os.PathLike[str], **fields: Any) -> None:
        """Copy a file and journal the copy. Raises Rejected for something other than a readable file, OSError."""
        name = f'{next(self._numbers):08d}'
        copies.copy(path, self.folder.files / name)
        self.append(kind, file=name, **fields)

    def is_over(self) -> bool:
        """Whether the mission has ended, with a warning: a call after the end must leave no file behind."""
        if self.has_ended:
            self.warn('ended', 'mission %s has ended: what is logged to it now is ignored', self.folder.mission_id)
        return self.has_ended

    @contextmanager
    def counting_errors(self) -> Iterator[None]:
        """Count data that is invalid (Rejected) or that the disk does not accept (OSError), instead of raising."""
        try:
            yield
        except Rejected as error:
            self.warn(error.reason, 'mission %s skips invalid data: %s', self.folder.mission_id, error)
            with self.counting_errors():
                self.append('refused', reason=error.reason)
        except OSError as error:
            self._count_lost(error)

    def record_policy_change(self) -> None:
        """Journal the active policy if it has changed."""
        active = self._policies.current()
        with self._lock:
            if active != self._policy and not self.has_ended:
                with suppress(OSError):  # the next sync tries again
                    self._journal.append({'k': 'policy', 't': now_ns(self._clock), 'policy': active})
                    self._policy, self._is_dirty = active, True

    def sync(self) -> None:
        """Sync everything that was logged, and journal a change of the policy. Never raises OSError."""
        self.record_policy_change()
        with self._lock:
            files, self._unsynced = self._unsynced, []
            dirty, self._is_dirty = self._is_dirty, False
        if not dirty:
            return
        try:
            for path in (*files, *((self.folder.files,) if files else ())):
                with suppress(FileNotFoundError):  # the sender was faster: the file is in the spool
                    sync(path)
            self._journal.sync()
        except OSError as error:
            self._count_lost(error)

    def close(self) -> None:
        """Sync and close the journal; idempotent."""
        self.sync()
        self._journal.close()

    def forget(self) -> None:
        """In a forked child: only the parent logs."""
        self._lock, self.has_ended = threading.Lock(), True

    def warn(self, reason: str, text: str, *arguments: object) -> None:
        """Log a warning, once per reason."""
        with self._lock:
            known = reason in self._warned
            self._warned.add(reason)
        if not known:
            log.warning(text, *arguments)

    def _count_lost(self, error: OSError) -> None:
        """The mission continues without what a full disk did not accept."""
        with self._lock:
            self.lost += 1
        self.warn('lost', 'mission %s loses data because the disk accepts no writes: %s', self.folder.mission_id, error)
