"""Makes whole the bags that could not leave: those that the node before did not end, and those that wait for their date.

A bag is known by the rows of the index, and where that was lost by what its slices say of it. Its open slice is repaired,
whatever reached the disk is spooled, the manifest says what is missing, and the accounts are settled: what was received and is in
no slice is lost by the restart. Every step can be cut short and done again. What is no slice, whoever put it there, is set aside
unopened.

This decides about a bag; ``formats/mcap/recovery.py`` repairs the bytes of a slice, ``spool/recovery.py`` repairs a spool.
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

from shadowhound_data_logger.bags.manifest import Missing
from shadowhound_data_logger.bags.naming import BUCKET, prefix_of, slice_number
from shadowhound_data_logger.bags.objects import finish, ros_distro, slice_object
from shadowhound_data_logger.bags.place import BagPlace
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
"""Why messages are dropped that were in memory when the node died."""
IN_MEMORY: Final = 'what was in memory when the recording was cut off'
FLUSH_S: Final = 30.0
LOOK_S: Final = 1.0
"""Between two looks at the clock, for a bag that waits for it."""
DAMAGED: Final = '.damaged'
"""Ends the name of the folder, beside the robot's, where lies what is no slice."""


class BagRecovery:
    """Completes the bags that an earlier process did not finish, and those that wait for their date.

    New with an open spool, before anything records; open once; ``add`` from any thread; close once.

    Owns the thread ``bag-recovery``, which ends when nothing is left to do. ``_lock`` guards which bags there are and which
    thread.
    """

    def __init__(self, place: BagPlace, priority: int) -> None:
        self._place = place
        self._priority = priority
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._opened = self._closed = False
        self._handed: set[str] = set()  # keys; a bag that is tried again is not spooled again
        self._own: set[Path] = set()
        """Folders of bags that this process recorded: their messages are in its accounts."""
        self._rows = _rows(place)
        self._unkept: set[Path] = set()
        """Folders of bags of which the index does not know what is known here."""
        self._states: dict[Path, BagState] = {}
        self._folders = deque(sorted({*_folders(place.root), *(place.root / name for name in self._rows)}))
        for folder in self._folders:
            with suppress(OSError):  # it is read again when its turn comes
                self._states[folder] = self._read(folder)
        cut_off = [state.mission for state in self._states.values() if state.event is None]
        self.missions = frozenset(mission.mission_id for mission in cut_off if mission is not None)
        """The ids of those whose bags were cut off; events go on with none."""
        self.worker = Worker('bag-recovery', self._step)

    @property
    def is_busy(self) -> bool:
        """Whether its thread has something to do."""
        return self._opened and not self.worker.stopping

    def open(self) -> None:
        """Begin; without anything to make whole only the accounts are settled."""
        with self._lock:
            if self._folders:
                self._opened = True
                self.worker.start()
                return
        self._settle()

    def add(self, state: BagState) -> None:
        """A bag of this process that has ended, and waits for its date."""
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
        """What is not done is left to the next start."""
        with self._lock:
            self._closed = True
            worker = self.worker
        worker.stop()
        self._wake.set()
        worker.join(deadline_s)

    def _step(self) -> None:
        """One bag; one that fails or waits is tried again after the others."""
        with self._lock:
            folder = self._folders.popleft() if self._folders else None
            if folder is None:
                self.worker.stop()
        if folder is None:
            self._settle()
            return
        is_whole = False
        try:
            if folder not in self._states:
                self._states[folder] = self._read(folder)
            is_whole = self._complete(self._states[folder])
        finally:
            if not is_whole:
                self._folders.append(folder)
        if is_whole:
            del self._states[folder]
        else:
            self._wake.wait(LOOK_S)

    def _settle(self) -> None:
        lost = self._place.spool.accounts.drop_carried(RESTART)
        if lost:
            log.warning('%d messages of bags were in memory when the node before ended', lost)

    # -- what is known of a bag ------------------------------------------------------------------------------------

    def _read(self, folder: Path) -> BagState:
        """From the index, or from the newest slice. Raises OSError."""
        robot, rows = self._place.robot, self._rows.get(folder.name)
        if folder.is_symlink():
            self._set_aside(folder, folder, 'it is a link')
        try:
            if rows is not None:
                return BagState.of_rows(folder, robot, rows)
            self._unkept.add(folder)
            return self._of_slices(folder)
        except BagDamaged as error:
            log.warning('%s', error)
            self._unkept.add(folder)
            return BagState(folder, folder.name, robot)

    def _of_slices(self, folder: Path) -> BagState:
        """As its newest slice tells it, with those that wait in the spool. Raises OSError or BagDamaged."""
        robot, spool = self._place.robot, self._place.spool
        waiting = spool.root / 'ready' / BUCKET / prefix_of(robot, folder.name)
        files = [path for path in (*waiting.glob('*.mcap'), *folder.glob('*.mcap*')) if stat.S_ISREG(path.lstat().st_mode)]
        found = [(slice_number(folder.name, path.name), path) for path in files]
        paths = [path for number, path in sorted((number, path) for number, path in found if number is not None)]
        said: dict[str, str] = {}
        for path in paths:
            told = {name: text for record in read_metadata(path, RECORD) for name, text in record.items()}
            if (told.get('recording'), told.get('owner')) == (folder.name, spool.owner):
                said |= told
        state = BagState.of_record(folder, robot, said) if said else BagState(folder, folder.name, robot)
        for path in paths:
            if said and path.parent != folder and path.name not in state.slices:
                state.add_slice(replace(read_info(path, digest=True), path=folder / path.name))
        return state

    def _keep(self, state: BagState) -> None:
        """Add to the index what it does not have of a bag."""
        if state.folder in self._unkept:
            self._place.writer.put(rows=state.all_rows(), wait=False)
            if not self._place.writer.flush(FLUSH_S):
                raise self._untaken(state)
            self._unkept.remove(state.folder)

    # -- one bag ---------------------------------------------------------------------------------------------------

    def _complete(self, state: BagState) -> bool:
        """False for one that waits for its date."""
        self._keep(state)
        for path in self._slices(state, OPEN_SUFFIX):
            self._recover(state, path)
        if not self._place.settle(state):
            return False
        for path in sorted(self._slices(state, '.mcap'), key=lambda path: slice_number(state.folder.name, path.name) or 0):
            self._hand_over(state, path)
        if not state.ended and not any(missing.what == IN_MEMORY for missing in state.missing):
            last = max(state.slices, key=lambda file: slice_number(state.folder.name, file) or 0, default='')
            self._note(state, Missing(last, IN_MEMORY, None))
        is_own, slices = state.folder in self._own, len(state.slices)
        if not finish(state, self._place.writer, FLUSH_S):
            raise self._untaken(state)
        if is_own:
            log.info('bag %s leaves as %s', state.folder.name, state.bag)
        else:
            log.warning('bag %s was %s; %d slices of it are whole', state.bag, 'left here' if state.ended else 'cut off', slices)
        return True

    @staticmethod
    def _untaken(state: BagState) -> OSError:
        return OSError(f'the spool did not take bag {state.bag} within {FLUSH_S:g} s')

    def _note(self, state: BagState, missing: Missing) -> None:
        self._place.writer.put(rows=[state.add_missing(missing)], wait=False)

    def _slices(self, state: BagState, suffix: str) -> Iterator[Path]:
        """Files of a folder that are its slices by their names; what only seems to be one is set aside."""
        for path in sorted(state.folder.glob(f'*{suffix}')):
            if slice_number(state.folder.name, path.name) is not None and stat.S_ISREG(path.lstat().st_mode):
                yield path
            else:
                self._set_aside(state.folder, path, 'it is no slice of this bag')

    def _recover(self, state: BagState, path: Path) -> None:
        """A slice that was open; one without any message is nothing."""
        info = recover(path, ros_distro=ros_distro())
        if info.damage is not None and (info.damage.tail_bytes or info.damage.chunks):
            damage = f'{info.damage.tail_bytes} bytes at its end and {info.damage.chunks} chunks in it were not whole'
            self._note(state, Missing(info.path.name, damage, info.damage.messages))
        if any(info.recorded.values()):
            self._place.writer.put(rows=[state.add_slice(info)], wait=False)
        else:
            info.path.unlink()

    def _hand_over(self, state: BagState, path: Path) -> None:
        """A whole slice that the spool may know already: then only its file was left."""
        try:
            info = state.slices.get(path.name) or read_info(path, digest=True)
        except BagDamaged as error:
            self._set_aside(state.folder, path, str(error))
            self._note(state, Missing(path.name, str(error), None))
            return
        rows = state.add_slice(info)
        item = slice_object(state, info, self._priority, is_kept=self._place.keeps(state))
        if item.key in self._handed:
            return
        if self._place.spool.knows(item.bucket, item.key, content_sha256(item.body)):
            self._place.writer.put(rows=[rows], wait=False)
            path.unlink(missing_ok=True)
            return
        if state.folder not in self._own:
            runs, newest = _contents(path)
            self._place.spool.accounts.find(
                item.counts,
                {f'{state.sink}{topic}': found for topic, found in runs.items()},
                {f'{state.sink}{topic}': times for topic, times in newest.items()},
            )
        self._handed.add(item.key)
        self._place.writer.put(item, rows=[rows], wait=False)

    def _set_aside(self, folder: Path, path: Path, why: str) -> None:
        log.error('%s is set aside: %s', path, why)
        target = self._place.root.with_name(f'{self._place.robot}{DAMAGED}') / folder.name
        target.mkdir(parents=True, exist_ok=True)
        names = (f'{path.name}.{number}' if number else path.name for number in count())
        path.rename(next(target / name for name in names if not os.path.lexists(target / name)))


def _contents(path: Path) -> tuple[dict[str, list[NumberRun]], dict[str, Times]]:
    """The numbers of a slice's messages and the times of the last one, by topic.

    A topic whose numbers do not rise, because it has several publishers, has none.
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
        return {}, {}  # the spool compares the file with its checksum
    rising = {
        topic: runs for topic, runs in found.items()
        if len(runs) <= MAX_RANGES and all(one.stop < two.start for one, two in pairwise(runs))
    }  # fmt: skip
    return rising, newest


def _rows(place: BagPlace) -> dict[str, RecordingRows]:
    """Of each recording that the index knows, by folder."""
    try:
        return {rows.folder: rows for rows in place.spool.recordings() if is_name(rows.folder, MAX_BAG_BYTES)}
    except sqlite3.Error as error:
        log.warning('the index does not say which bags to complete, their slices do: %s', error)
        return {}


def _folders(root: Path) -> list[Path]:
    """Of bags; a link is none."""
    with suppress(FileNotFoundError), os.scandir(root) as entries:
        return sorted(Path(entry.path) for entry in entries if entry.is_dir(follow_symlinks=False))
    return []
