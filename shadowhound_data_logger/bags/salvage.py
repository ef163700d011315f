"""Makes whole, at a start, the bags that the node before could not end: it died, or its disk took nothing.

Whatever reached the disk is recovered and spooled, the manifest says what is missing, and the accounts are settled: what was
received and is in no slice is lost by the restart. Every step can be cut short and done again.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Final

from shadowhound_data_logger.bags.manifest import Missing
from shadowhound_data_logger.bags.naming import slice_number
from shadowhound_data_logger.bags.notes import Notes
from shadowhound_data_logger.bags.objects import ending_objects, ros_distro, slice_object
from shadowhound_data_logger.bags.recording import Outlet
from shadowhound_data_logger.bags.recovery import read_info, recover
from shadowhound_data_logger.bags.slice_writer import OPEN
from shadowhound_data_logger.errors import BagDamaged
from shadowhound_data_logger.model import DataObject
from shadowhound_data_logger.spool.files import content_sha256
from shadowhound_data_logger.worker import Worker

log = logging.getLogger(__name__)

RESTART: Final = 'restart'
"""Why messages are dropped that were in memory when the node died."""
IN_MEMORY: Final = 'what was in memory when the recording was cut off'
FLUSH_S: Final = 30.0
DAMAGED: Final = '.damaged'
"""Ends the name of the folder, beside the robot's, where lies what is no slice."""
Knows = Callable[[str, str, str], bool]
"""Whether the spool was given a content by (bucket, key, sha256) already."""


class Salvage:
    """New, before anything records; open once; close once. Owns the thread ``bag-recovery``, which ends when it is done."""

    def __init__(self, root: Path, robot: str, priority: int, outlet: Outlet, knows: Knows) -> None:
        self._robot = robot
        self._priority = priority
        self._outlet = outlet
        self._knows = knows
        self._opened = False
        self._handed: set[str] = set()  # keys; a bag that is tried again is not spooled again
        self._folders = sorted(path for path in root.glob('*') if path.is_dir()) if root.is_dir() else []
        found = [Notes.read(folder, robot) for folder in self._folders]
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
        if self._folders:
            self._opened = True
            self.worker.start()
        else:
            self._settle()

    def close(self, deadline_s: float) -> None:
        """What is not done is left to the next start."""
        self.worker.stop()
        self.worker.join(deadline_s)

    def _step(self) -> None:
        """One bag; one that fails is tried again after the others."""
        if not self._folders:
            self._settle()
            self.worker.stop()
            return
        folder = self._folders.pop(0)
        try:
            self._make_whole(Notes.read(folder, self._robot))
        except BaseException:
            self._folders.append(folder)
            raise

    def _settle(self) -> None:
        lost = self._outlet.accounts.drop_carried(RESTART)
        if lost:
            log.warning('%d messages of bags were in memory when the node before ended', lost)

    def _make_whole(self, notes: Notes) -> None:
        for path in sorted(notes.folder.glob(f'*{OPEN}')):
            self._recover(notes, path)
        for path in sorted(notes.folder.glob('*.mcap'), key=lambda path: slice_number(notes.bag, path.name) or 0):
            self._hand_over(notes, path)
        if not notes.ended and not any(missing.what == IN_MEMORY for missing in notes.missing):
            last = max(notes.slices, key=lambda file: slice_number(notes.bag, file) or 0, default='')
            notes.add_missing(Missing(last, IN_MEMORY, None))
        if notes.slices:
            for item in ending_objects(notes):
                self._put(item)
        if not self._outlet.flush(FLUSH_S):
            raise OSError(f'the spool did not take bag {notes.bag} within {FLUSH_S:g} s')
        try:
            notes.remove()
        except OSError as error:
            log.warning('the folder of bag %s stays: %s', notes.bag, error)
        log.warning('bag %s was cut off; %d slices of it are whole', notes.bag, len(notes.slices))

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
            log.error('%s is set aside: %s', path, error)  # noqa: TRY400 - an operator's matter
            target = notes.folder.parent.with_name(f'{self._robot}{DAMAGED}') / notes.bag
            target.mkdir(parents=True, exist_ok=True)
            path.rename(target / path.name)
            notes.add_missing(Missing(path.name, str(error), None))
            return
        if path.name not in notes.slices:
            notes.add_slice(info)
        if not self._put(slice_object(notes, info, self._priority)):
            path.unlink(missing_ok=True)

    def _put(self, item: DataObject) -> bool:
        """Into the spool; False where that was given it before."""
        if item.key in self._handed:
            return True
        if self._knows(item.bucket, item.key, content_sha256(item.body)):
            return False
        self._outlet.accounts.find(item.counts)
        self._handed.add(item.key)
        self._outlet.put(item)
        return True
