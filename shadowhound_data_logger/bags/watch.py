"""Uploads each bag that ``ros2 bag record`` writes into a folder once, when it is finished.

A bag is finished if it has metadata.yaml and all files that it names, and nothing has changed for a while. Uploaded bags are
listed in ``.shadowhound-bags.json`` next to the bags, so that a restart sends nothing twice. A bag is deleted only on request,
and only after the store has confirmed every file.
"""

from __future__ import annotations

import json
import logging
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from stat import S_ISREG
from typing import Final

from shadowhound_data_logger.bags.fetch import disk_errors
from shadowhound_data_logger.bags.naming import METADATA, SLICES, safe_bag
from shadowhound_data_logger.bags.upload import deliver, is_confirmed, open_spool, plan_upload, spool_upload
from shadowhound_data_logger.bags.upload_plan import PlannedFile, UploadPlan, read_finished
from shadowhound_data_logger.core.clock import SECOND, Clock, iso
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.dataclass_json import as_plain, parse
from shadowhound_data_logger.core.durable_files import flock, replacing
from shadowhound_data_logger.core.errors import BagError, DataLoggerError
from shadowhound_data_logger.stores import open_store

MARKS: Final = '.shadowhound-bags.json'
UNFINISHED_S: Final = 600.0
"""A bag without metadata.yaml that has not changed for this time is reported: its recorder may have crashed."""
SPOOLED: Final = 'spooled'
STORED: Final = 'stored'
REMOVED: Final = 'removed'
DELIVER_S: Final = 5.0
"""Maximum time for one bag in one round; the spool has it safe, and a later round continues."""
RETRY_S: Final = 60.0
"""Minimum time between rounds for one bag: opening the spool adds a row to it, and a running node delivers on its own."""
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class FoundFile:
    """A file in a bag's folder."""

    name: str
    size: int
    changed_ns: int


@dataclass(frozen=True, slots=True)
class SentFile:
    """A file of a bag and its object."""

    name: str
    key: str
    size: int
    sha256: str


@dataclass(slots=True)
class BagMark:
    """A bag that was uploaded."""

    state: str
    """SPOOLED, STORED or REMOVED; the fields with these names have the times."""
    listing: tuple[FoundFile, ...]
    files: tuple[SentFile, ...]
    spooled: str
    stored: str | None = None
    removed: str | None = None


@dataclass(frozen=True, slots=True)
class BagMarks:
    """The content of MARKS."""

    bags: dict[str, BagMark] = field(default_factory=dict)
    version: int = 1


@dataclass(frozen=True, slots=True)
class WatchStep:
    """A change of a bag's state: SPOOLED, STORED, REMOVED or, with a reason, ``refused``."""

    bag: str
    what: str
    reason: str = ''


class Watch:
    """Uploads the finished bags of a folder.

    Lifecycle: new; ``round`` any number of times, by one thread. An error in one bag does not affect the others.
    """

    def __init__(self, folder: Path, settings: Settings, clock: Clock, *, settle_s: float, is_removing: bool = False,
                 monotonic: Callable[[], float] = time.monotonic) -> None:  # fmt: skip
        self._folder = folder
        self._settings = settings
        self._clock = clock
        self._settle_s = settle_s
        self._is_removing = is_removing
        self._monotonic = monotonic
        self._seen: dict[str, tuple[tuple[FoundFile, ...], float]] = {}
        self._reported: dict[str, str] = {}
        self._retry_at_s: dict[str, float] = {}
        self._unfinished_bags: set[str] = set()
        """Bags that no recorder seems to finish."""

    @contextmanager
    def exclusive(self) -> Iterator[None]:
        """Hold the folder's lock during all rounds. Raises BagError if another process watches this folder."""
        with disk_errors(self._folder), flock(self._folder / f'{MARKS}.lock', wait=False) as is_mine:
            if not is_mine:
                raise BagError(f'another process watches {self._folder}', path=str(self._folder))
            yield

    def round(self) -> list[WatchStep]:
        """Upload finished bags and confirm uploaded ones. Raises BagError if the folder itself cannot be used."""
        with disk_errors(self._folder):
            marks = self._marks()
            folders = [path for path in sorted(self._folder.iterdir()) if path.is_dir()]
            bags = [path for path in folders if (path / METADATA).exists()]
            steps = [step for path in bags for step in self._step(path, marks)]
            return [*steps, *(step for path in folders if path not in bags for step in self._unfinished(path))]

    def has_undelivered(self) -> bool:
        """Whether a bag of this folder is not in the store yet, for any reason."""
        return bool(self._seen or self._unfinished_bags) or any(mark.state == SPOOLED for mark in self._marks().values())

    def _step(self, path: Path, marks: dict[str, BagMark]) -> Iterator[WatchStep]:
        mark = marks.get(path.name)
        try:
            if mark is None:
                if not self._is_settled(path):
                    return
                read_finished(path)
                mark = marks[path.name] = self._ship(path)
                self._write(marks)
                yield WatchStep(path.name, SPOOLED)
            if mark.state == SPOOLED and self._monotonic() >= self._retry_at_s.get(path.name, 0.0) and self._confirm(path, mark):
                self._write(marks)
                yield WatchStep(path.name, STORED)
            if self._is_removing and mark.state == STORED and self._remove(path, mark):
                self._write(marks)
                yield WatchStep(path.name, REMOVED)
        except DataLoggerError as error:
            if self._reported.get(path.name) != str(error):
                self._reported[path.name] = str(error)
                yield WatchStep(path.name, 'refused', str(error))

    def _unfinished(self, path: Path) -> Iterator[WatchStep]:
        """Report an unfinished bag that has not changed for a while, once."""
        times = [file.changed_ns for file in _list_files(path) if file.name.endswith(SLICES)]
        if not times or self._clock.wall_ns() - max(times) < UNFINISHED_S * SECOND:
            self._unfinished_bags.discard(path.name)
        elif path.name not in self._unfinished_bags:
            self._unfinished_bags.add(path.name)
            reason = f'it has no {METADATA}, and nothing in it has changed for {UNFINISHED_S / 60:.0f} min'
            remedy = f'if no recorder is writing to it, rebuild it with `shadowhound-data bag repair {path} --in-place`'
            yield WatchStep(path.name, 'refused', f'{reason} ({remedy})')

    def _is_settled(self, path: Path) -> bool:
        listing = _list_files(path)
        before, since_s = self._seen.get(path.name, (None, 0.0))
        if listing != before:
            self._seen[path.name] = (listing, self._monotonic())
            return self._settle_s <= 0
        return self._monotonic() - since_s >= self._settle_s

    def _ship(self, path: Path) -> BagMark:
        settings = self._settings
        listing = _list_files(path)
        with plan_upload(path, settings.robot, safe_bag(path.name), settings.home, is_archive=False) as sent:
            with open_spool(settings, self._clock) as spool:
                spool_upload(sent, spool)
            files = tuple(SentFile(file.name, file.key, file.size, file.sha256) for file in sent.files)
        self._seen.pop(path.name, None)
        return BagMark(SPOOLED, listing, files, spooled=iso(self._clock.wall_ns()))

    def _confirm(self, path: Path, mark: BagMark) -> bool:
        """Whether the store has the bag; if not, deliver for up to ``DELIVER_S``, unless the node does."""
        self._retry_at_s[path.name] = self._monotonic() + RETRY_S
        if not self._is_stored(mark):
            settings = self._settings
            with open_spool(settings, self._clock) as spool:
                files = (PlannedFile(file.name, file.key, path, file.size, file.sha256) for file in mark.files)
                deliver(
                    settings, spool, UploadPlan(settings.robot, safe_bag(path.name), path, tuple(files)), deadline_s=DELIVER_S
                )
            if not self._is_stored(mark):
                return False
        mark.state, mark.stored = STORED, iso(self._clock.wall_ns())
        return True

    def _is_stored(self, mark: BagMark) -> bool:
        store = open_store(self._settings.store, self._settings.upload)
        with closing(store):
            return is_confirmed(store, [(file.key, file.size, file.sha256) for file in mark.files])

    def _remove(self, path: Path, mark: BagMark) -> bool:
        """Delete a bag if the store confirms it now and it has not changed since it was uploaded."""
        if _list_files(path) != mark.listing or not self._is_stored(mark):
            return False
        shutil.rmtree(path)
        mark.state, mark.removed = REMOVED, iso(self._clock.wall_ns())
        return True

    def _marks(self) -> dict[str, BagMark]:
        try:
            return parse(BagMarks, json.loads((self._folder / MARKS).read_bytes())).bags
        except FileNotFoundError:
            return {}
        except ValueError as error:
            remedy = 'delete it: nothing is uploaded twice, but every bag is read again'
            raise BagError(f'{self._folder / MARKS} cannot be read: {error}', remedy=remedy) from error

    def _write(self, marks: dict[str, BagMark]) -> None:
        with replacing(self._folder / MARKS, is_synced=True) as file:
            file.write(json.dumps(as_plain(BagMarks(marks)), indent=1).encode())


def _list_files(folder: Path) -> tuple[FoundFile, ...]:
    """The files of a bag; equal listings mean that nothing was written in between."""
    found = []
    for path in sorted(folder.rglob('*')):
        with suppress(FileNotFoundError):  # its recorder may delete files
            stat = path.stat()
            if S_ISREG(stat.st_mode):
                found.append(FoundFile(str(path.relative_to(folder)), stat.st_size, stat.st_mtime_ns))
    return tuple(found)
