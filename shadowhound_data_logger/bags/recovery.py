"""Completes bags that an earlier process did not finish, and bags that wait for their date.

A bag is described by the rows of the index or, if the index was lost, by records in its slices. Recovery repairs the open slice,
spools all slices, lists losses in the manifest, and settles the accounts: messages that were received and are in no slice were
lost by the restart. Every step can be interrupted and repeated. Files that are not slices are set aside without being opened.

This module recovers a bag; ``formats/mcap/recovery.py`` repairs the bytes of a slice, ``spool/recovery.py`` repairs a spool.
"""

from __future__ import annotations

import logging
import os
import sqlite3
import stat
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import count, pairwise
from pathlib import Path
from typing import Final

from shadowhound_data_logger.bags.context import BagContext
from shadowhound_data_logger.bags.manifest import Missing
from shadowhound_data_logger.bags.naming import BUCKET, prefix_of, slice_number
from shadowhound_data_logger.bags.objects import finish, ros_distro, slice_object
from shadowhound_data_logger.bags.state import RECORD, BagState
from shadowhound_data_logger.core.errors import BagDamaged
from shadowhound_data_logger.core.keys import MAX_BAG_BYTES, is_name
from shadowhound_data_logger.core.model import RecordingRows
from shadowhound_data_logger.core.stamps import Times
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.formats.mcap.index import read_index, read_metadata
from shadowhound_data_logger.formats.mcap.messages import MessageFilter, read_messages
from shadowhound_data_logger.formats.mcap.ranges import LocalFile
from shadowhound_data_logger.formats.mcap.recovery import read_info, recover
from shadowhound_data_logger.formats.mcap.writer import OPEN_SUFFIX
from shadowhound_data_logger.spool.files import content_sha256
from shadowhound_data_logger.spool.span import MAX_RANGES, NumberRun

log = logging.getLogger(__name__)

RESTART: Final = 'restart'
"""Reason for dropping messages that were in memory when the node was killed."""
IN_MEMORY: Final = 'messages in memory when the recording was interrupted'
FLUSH_S: Final = 30.0
LOOK_S: Final = 1.0
"""Time between attempts to complete a bag that waits for its date or failed."""
DAMAGED: Final = '.damaged'
"""Suffix of the folder, next to the robot's, for files that are not slices."""


class BagRecovery:
    """Completes the bags that an earlier process did not finish, and those that wait for their date.

    Lifecycle: new with an open spool, before recording starts; ``open`` once; ``add`` from any thread; ``close`` once.

    Owns the thread ``bag-recovery``, which ends when all bags are complete. ``_lock`` guards the list of bags and the thread.
    """

    def __init__(self, context: BagContext, priority: int) -> None:
        self._context = context
        self._priority = priority
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._opened = self._closed = False
        self._spooled: set[str] = set()  # keys, so that another attempt does not spool a slice again
        self._own: set[Path] = set()
        """Folders of bags that this process recorded: their messages are in its accounts."""
        self._rows = _rows(context)
        self._unindexed: set[Path] = set()
        """Folders of bags whose state is not in the index."""
        self._states: dict[Path, BagState] = {}
        self._folders = deque(sorted({*_folders(context.root), *(context.root / name for name in self._rows)}))
        for folder in self._folders:
            with suppress(OSError):  # read again later
                self._states[folder] = self._read(folder)
        interrupted = [state.mission for state in self._states.values() if state.event is None]
        self.missions = frozenset(mission.mission_id for mission in interrupted if mission is not None)
        """The ids of the missions with interrupted recordings; events do not continue."""
        self.worker = Worker('bag-recovery', self._step)

    @property
    def is_busy(self) -> bool:
        """Whether the thread is running."""
        return self._opened and not self.worker.stopping

    def open(self) -> None:
        """Start the thread; if there are no bags, only settle the accounts."""
        with self._lock:
            if self._folders:
                self._opened = True
                self.worker.start()
                return
        self._settle()

    def add(self, state: BagState) -> None:
        """Add a bag of this process that has ended and waits for its date."""
        with self._lock:
            self._own.add(state.folder)
            self._states[state.folder] = state
            self._folders.append(state.folder)
            if self._closed or self.is_busy:
                return
            if self.worker.stopping:
                self.worker = Worker('bag-recovery', self._step)
            self._opened = True
            self.worker.start()

    def close(self, deadline_s: float) -> None:
        """Stop the thread; the next start completes the remaining bags."""
        with self._lock:
            self._closed = True
            worker = self.worker
        worker.stop()
        self._wake.set()
        worker.join(deadline_s)

    def _step(self) -> None:
        """Process one bag; a bag that fails or waits is tried again after the others."""
        with self._lock:
            folder = self._folders.popleft() if self._folders else None
            if folder is None:
                self.worker.stop()
        if folder is None:
            self._settle()
            return
        is_complete = False
        try:
            if folder not in self._states:
                self._states[folder] = self._read(folder)
            is_complete = self._complete(self._states[folder])
        finally:
            if not is_complete:
                self._folders.append(folder)
        if is_complete:
            del self._states[folder]
        else:
            self._wake.wait(LOOK_S)

    def _settle(self) -> None:
        lost = self._context.spool.accounts.carried.drop_rest(RESTART)
        if lost:
            log.warning('%d messages of bags were lost: they were in memory when the previous node stopped', lost)

    # -- the state of a bag ----------------------------------------------------------------------------------------

    def _read(self, folder: Path) -> BagState:
        """The state from the index, or from the slices. Raises OSError."""
        robot, rows = self._context.robot, self._rows.get(folder.name)
        if folder.is_symlink():
            self._set_aside(folder, folder, 'it is a link')
        try:
            if rows is not None:
                return BagState.of_rows(folder, robot, rows)
            self._unindexed.add(folder)
            return self._read_slices(folder)
        except BagDamaged as error:
            log.warning('%s', error)
            self._unindexed.add(folder)
            return BagState(folder, folder.name, robot)

    def _read_slices(self, folder: Path) -> BagState:
        """The state from the records in the slices, including those in the spool. Raises OSError or BagDamaged."""
        robot, spool = self._context.robot, self._context.spool
        waiting = spool.root / 'ready' / BUCKET / prefix_of(robot, folder.name)
        files = [path for path in (*waiting.glob('*.mcap'), *folder.glob('*.mcap*')) if stat.S_ISREG(path.lstat().st_mode)]
        found = [(slice_number(folder.name, path.name), path) for path in files]
        paths = [path for number, path in sorted((number, path) for number, path in found if number is not None)]
        newest: dict[str, str] = {}
        for path in paths:
            record = {name: text for each in read_metadata(path, RECORD) for name, text in each.items()}
            if (record.get('recording'), record.get('owner')) == (folder.name, spool.robot):
                newest |= record
        state = BagState.of_record(folder, robot, newest) if newest else BagState(folder, folder.name, robot)
        for path in paths:
            if newest and path.parent != folder and path.name not in state.slices:
                state.add_slice(replace(read_info(path, digest=True), path=folder / path.name))
        return state

    def _index(self, state: BagState) -> None:
        """Add the state of a bag to the index if it is missing there."""
        if state.folder in self._unindexed:
            self._context.writer.put(rows=state.all_rows(), wait=False)
            if not self._context.writer.flush(FLUSH_S):
                raise self._timeout(state)
            self._unindexed.remove(state.folder)

    # -- one bag ---------------------------------------------------------------------------------------------------

    def _complete(self, state: BagState) -> bool:
        """Complete a bag; False if it waits for its date."""
        self._index(state)
        for path in self._slices(state, OPEN_SUFFIX):
            self._recover(state, path)
        if not self._context.settle_name(state):
            return False
        for path in sorted(self._slices(state, '.mcap'), key=lambda path: slice_number(state.folder.name, path.name) or 0):
            self._spool_slice(state, path)
        if not state.ended and not any(missing.what == IN_MEMORY for missing in state.missing):
            last = max(state.slices, key=lambda file: slice_number(state.folder.name, file) or 0, default='')
            self._add_missing(state, Missing(last, IN_MEMORY, None))
        is_own, slices = state.folder in self._own, len(state.slices)
        if not finish(state, self._context.writer, FLUSH_S):
            raise self._timeout(state)
        if is_own:
            log.info('bag %s is uploaded as %s', state.folder.name, state.bag)
        else:
            how = 'not completed' if state.ended else 'interrupted'
            log.warning('bag %s was %s by the previous node; %d slices are complete', state.bag, how, slices)
        return True

    @staticmethod
    def _timeout(state: BagState) -> OSError:
        return OSError(f'the spool did not accept bag {state.bag} within {FLUSH_S:g} s')

    def _add_missing(self, state: BagState, missing: Missing) -> None:
        self._context.writer.put(rows=[state.add_missing(missing)], wait=False)

    def _slices(self, state: BagState, suffix: str) -> Iterator[Path]:
        """The slices in the bag's folder, by their names; other files with this suffix are set aside."""
        for path in sorted(state.folder.glob(f'*{suffix}')):
            if slice_number(state.folder.name, path.name) is not None and stat.S_ISREG(path.lstat().st_mode):
                yield path
            else:
                self._set_aside(state.folder, path, 'it is not a slice of this bag')

    def _recover(self, state: BagState, path: Path) -> None:
        """Repair an open slice; delete it if it has no messages."""
        info = recover(path, ros_distro=ros_distro())
        if info.damage is not None and (info.damage.tail_bytes or info.damage.chunks):
            damage = f'{info.damage.tail_bytes} bytes at its end and {info.damage.chunks} chunks in it were damaged'
            self._add_missing(state, Missing(info.path.name, damage, info.damage.messages))
        if any(info.recorded.values()):
            self._context.writer.put(rows=[state.add_slice(info)], wait=False)
        else:
            info.path.unlink()

    def _spool_slice(self, state: BagState, path: Path) -> None:
        """Spool a complete slice; if the spool has it already, only delete the file."""
        try:
            info = state.slices.get(path.name) or read_info(path, digest=True)
        except BagDamaged as error:
            self._set_aside(state.folder, path, str(error))
            self._add_missing(state, Missing(path.name, str(error), None))
            return
        rows = state.add_slice(info)
        item = slice_object(state, info, self._priority, is_kept=self._context.keeps(state))
        if item.key in self._spooled:
            return
        if self._context.spool.reading.objects.knows(item.bucket, item.key, content_sha256(item.body)):
            self._context.writer.put(rows=[rows], wait=False)
            path.unlink(missing_ok=True)
            return
        if state.folder not in self._own:
            runs, newest = _number_runs(path)
            self._context.spool.accounts.carried.recover(
                item.counts,
                {f'{state.sink}{topic}': found for topic, found in runs.items()},
                {f'{state.sink}{topic}': times for topic, times in newest.items()},
            )
        self._spooled.add(item.key)
        self._context.writer.put(item, rows=[rows], wait=False)

    def _set_aside(self, folder: Path, path: Path, why: str) -> None:
        log.error('%s was set aside: %s', path, why)
        target = self._context.root.with_name(f'{self._context.robot}{DAMAGED}') / folder.name
        target.mkdir(parents=True, exist_ok=True)
        names = (f'{path.name}.{number}' if number else path.name for number in count())
        path.rename(next(target / name for name in names if not os.path.lexists(target / name)))


def _number_runs(path: Path) -> tuple[dict[str, list[NumberRun]], dict[str, Times]]:
    """The sequence numbers of a slice's messages, and the times of the last one, by topic.

    Omits the numbers of topics whose numbers are not increasing, because they have several publishers.
    """
    found: dict[str, list[NumberRun]] = {}
    newest: dict[str, Times] = {}
    try:
        source = LocalFile(path)
        for message in read_messages(source, read_index(source), MessageFilter(0, 1 << 64, lambda channel: not channel.repeated)):
            number, times = message.sequence, Times(message.publish_ns, message.log_ns)
            newest[message.channel.topic] = times
            runs = found.setdefault(message.channel.topic, [])
            if runs and number == runs[-1].stop:
                runs[-1] = runs[-1]._replace(stop=number + 1, last=times)
            elif len(runs) <= MAX_RANGES:
                runs.append(NumberRun(number, number + 1, times, times))
    except (BagDamaged, OSError):
        return {}, {}  # the spool verifies the checksum of the file
    rising = {
        topic: runs for topic, runs in found.items()
        if len(runs) <= MAX_RANGES and all(one.stop < two.start for one, two in pairwise(runs))
    }  # fmt: skip
    return rising, newest


def _rows(context: BagContext) -> dict[str, RecordingRows]:
    """The rows of the recordings in the index, by folder."""
    try:
        found = context.spool.reading.recordings.rows(context.spool.robot)
        return {rows.folder: rows for rows in found if is_name(rows.folder, MAX_BAG_BYTES)}
    except sqlite3.Error as error:
        log.warning('the index cannot be read, so bags are completed from their slices: %s', error)
        return {}


def _folders(root: Path) -> list[Path]:
    """The folders of bags; links are ignored."""
    with suppress(FileNotFoundError), os.scandir(root) as entries:
        return sorted(Path(entry.path) for entry in entries if entry.is_dir(follow_symlinks=False))
    return []
