"""Makes whole the bags that could not leave: those that the node before did not end, and those that wait for their date.

Whatever reached the disk is recovered and spooled, the manifest says what is missing, and the accounts are settled: what was
received and is in no slice is lost by the restart. Every step can be cut short and done again. What is no slice, whoever put it
there, is set aside unopened.

This decides about a bag; ``mcap/recovery.py`` repairs the bytes of a slice, ``spool/recovery.py`` mends a spool.
"""

from __future__ import annotations

import logging
import os
import stat
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Final

from shadowhound_data_logger.bags.manifest import Missing
from shadowhound_data_logger.bags.naming import BUCKET, prefix_of, slice_number
from shadowhound_data_logger.bags.notes import FILE, Notes
from shadowhound_data_logger.bags.objects import ending_objects, note_evicted, ros_distro, slice_object
from shadowhound_data_logger.bags.place import BagPlace
from shadowhound_data_logger.errors import BagDamaged
from shadowhound_data_logger.mcap.recovery import read_info, recover
from shadowhound_data_logger.mcap.writer import OPEN
from shadowhound_data_logger.model import DataObject
from shadowhound_data_logger.spool.files import content_sha256
from shadowhound_data_logger.worker import Worker

log = logging.getLogger(__name__)

RESTART: Final = 'restart'
"""Why messages are dropped that were in memory when the node died."""
IN_MEMORY: Final = 'what was in memory when the recording was cut off'
FLUSH_S: Final = 30.0
LOOK_S: Final = 1.0
"""Between two looks at the clock, for a bag that waits for it."""
DAMAGED: Final = '.damaged'
"""Ends the name of the folder, beside the robot's, where lies what is no slice."""


class Salvage:
    """New, before anything records; open once; ``add`` from any thread; close once.

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
        self._waiting: dict[Path, Notes] = {}
        self._folders = deque(_folders(place.root))
        found = [_read(folder, place.robot) for folder in self._folders]
        cut_off = [notes.mission for notes in found if notes.event is None]
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

    def add(self, folder: Path) -> None:
        """A bag of this process that has ended, and waits for its date."""
        with self._lock:
            self._own.add(folder)
            self._folders.append(folder)
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
            is_whole = self._make_whole(self._waiting.pop(folder) if folder in self._waiting else self._notes(folder))
        finally:
            if not is_whole:
                self._folders.append(folder)
        if not is_whole:
            self._wake.wait(LOOK_S)

    def _notes(self, folder: Path) -> Notes:
        path = folder / FILE
        if os.path.lexists(path) and not stat.S_ISREG(path.lstat().st_mode):
            self._set_aside(folder, path, 'it is no file')
        return Notes.read(folder, self._place.robot)

    def _settle(self) -> None:
        lost = self._place.spool.accounts.drop_carried(RESTART)
        if lost:
            log.warning('%d messages of bags were in memory when the node before ended', lost)

    def _make_whole(self, notes: Notes) -> bool:
        """False for one that waits for its date."""
        for path in self._slices(notes, OPEN):
            self._recover(notes, path)
        if not self._place.settle(notes):
            self._waiting[notes.folder] = notes
            return False
        for path in sorted(self._slices(notes, '.mcap'), key=lambda path: slice_number(notes.folder.name, path.name) or 0):
            self._hand_over(notes, path)
        if not notes.ended and not any(missing.what == IN_MEMORY for missing in notes.missing):
            last = max(notes.slices, key=lambda file: slice_number(notes.folder.name, file) or 0, default='')
            notes.add_missing(Missing(last, IN_MEMORY, None))
        if notes.slices or (notes.ended and notes.missing):
            self._flush(notes)
            note_evicted(notes, self._place.spool.states(BUCKET, prefix_of(self._place.robot, notes.bag)))
            for item in ending_objects(notes):
                self._put(item, notes)
        self._flush(notes)
        try:
            notes.remove()
        except OSError as error:
            log.warning('the folder of bag %s stays: %s', notes.bag, error)
        if notes.folder in self._own:
            log.info('bag %s leaves as %s', notes.folder.name, notes.bag)
        else:
            log.warning('bag %s was %s; %d slices of it are whole', notes.bag, 'left here' if notes.ended else 'cut off',
                        len(notes.slices))  # fmt: skip
        return True

    def _flush(self, notes: Notes) -> None:
        if not self._place.writer.flush(FLUSH_S):
            raise OSError(f'the spool did not take bag {notes.bag} within {FLUSH_S:g} s')

    def _slices(self, notes: Notes, suffix: str) -> Iterator[Path]:
        """Files of a folder that are its slices by their names; what only seems to be one is set aside."""
        for path in sorted(notes.folder.glob(f'*{suffix}')):
            if slice_number(notes.folder.name, path.name) is not None and stat.S_ISREG(path.lstat().st_mode):
                yield path
            else:
                self._set_aside(notes.folder, path, 'it is no slice of this bag')

    def _recover(self, notes: Notes, path: Path) -> None:
        """A slice that was open; one without any message is nothing."""
        info = recover(path, ros_distro=ros_distro())
        if info.damage is not None and (info.damage.tail_bytes or info.damage.chunks):
            damage = f'{info.damage.tail_bytes} bytes at its end and {info.damage.chunks} chunks in it were not whole'
            notes.add_missing(Missing(info.path.name, damage, info.damage.messages))
        if info.messages:
            notes.add_slice(info)
        else:
            info.path.unlink()

    def _hand_over(self, notes: Notes, path: Path) -> None:
        """A whole slice that the spool may know already: then only its file was left."""
        try:
            info = notes.slices.get(path.name) or read_info(path, digest=True)
        except BagDamaged as error:
            self._set_aside(notes.folder, path, str(error))
            notes.add_missing(Missing(path.name, str(error), None))
            return
        if path.name not in notes.slices:
            notes.add_slice(info)
        if not self._put(slice_object(notes, info, self._priority), notes):
            path.unlink(missing_ok=True)

    def _set_aside(self, folder: Path, path: Path, why: str) -> None:
        log.error('%s is set aside: %s', path, why)
        target = self._place.root.with_name(f'{self._place.robot}{DAMAGED}') / folder.name
        target.mkdir(parents=True, exist_ok=True)
        names = (f'{path.name}.{number}' if number else path.name for number in count())
        path.rename(next(target / name for name in names if not os.path.lexists(target / name)))

    def _put(self, item: DataObject, notes: Notes) -> bool:
        """Into the spool; False where that was given it before."""
        if item.key in self._handed:
            return True
        if self._place.spool.knows(item.bucket, item.key, content_sha256(item.body)):
            return False
        if notes.folder not in self._own:
            self._place.spool.accounts.find(item.counts)
        self._handed.add(item.key)
        self._place.writer.put(item, wait=False)
        return True


def _folders(root: Path) -> list[Path]:
    """Of bags; a link is none."""
    with suppress(FileNotFoundError), os.scandir(root) as entries:
        return sorted(Path(entry.path) for entry in entries if entry.is_dir(follow_symlinks=False))
    return []


def _read(folder: Path, robot: str) -> Notes:
    """As far as that is possible now: it is read again when its turn comes."""
    try:
        return Notes.read(folder, robot)
    except OSError as error:
        log.warning('what is known of bag %s cannot be read: %s', folder.name, error)
        return Notes(folder, folder.name, robot, None)
