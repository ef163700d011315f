"""Ships bags that ``ros2 bag record`` writes into a folder, once each, when they are finished.

Finished is a bag with its metadata.yaml and all that it names, of which nothing has changed for a while. What was shipped
stands in ``.shadowhound-bags.json`` beside the bags, so that a restart sends nothing twice. A bag is removed only when asked for,
and after the store itself said that it holds every file of it.
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

from shadowhound_data_logger.bags.fetch import on_disk
from shadowhound_data_logger.bags.naming import METADATA, SLICES, safe_bag
from shadowhound_data_logger.bags.upload import deliver, is_confirmed, opened_spool, planned, spool_upload
from shadowhound_data_logger.bags.upload_plan import Outgoing, UploadPlan, finished
from shadowhound_data_logger.core.clock import SECOND, Clock, iso
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.dataclass_json import as_plain, parse
from shadowhound_data_logger.core.durable_files import flock, replacing
from shadowhound_data_logger.core.errors import BagError, DataLoggerError
from shadowhound_data_logger.stores import open_store

MARKS: Final = '.shadowhound-bags.json'
UNFINISHED_S: Final = 600.0
"""A bag without metadata.yaml that has not changed for so long is reported: its recorder may have died."""
SPOOLED: Final = 'spooled'
STORED: Final = 'stored'
REMOVED: Final = 'removed'
DELIVER_S: Final = 5.0
"""For one bag in one round; the spool has it safe, and a later round goes on."""
RETRY_S: Final = 60.0
"""Before that: to open the spool costs it a row, and the node that runs here delivers by itself."""
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class FoundFile:
    """A file of a bag, as its recorder left it."""

    name: str
    size: int
    changed_ns: int


@dataclass(frozen=True, slots=True)
class SentFile:
    """A file of a bag, as it is sent."""

    name: str
    key: str
    size: int
    sha256: str


@dataclass(slots=True)
class BagMark:
    """A bag that was shipped."""

    state: str
    """SPOOLED, STORED or REMOVED; when it became so is in the fields of these names."""
    look: tuple[FoundFile, ...]
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
    """Something that happened to a bag: SPOOLED, STORED, REMOVED or, with a reason, ``refused``."""

    bag: str
    what: str
    reason: str = ''


class Watch:
    """Ships the finished bags of a folder.

    New; ``round`` any number of times, by one thread. Errors of one bag cost that bag alone.
    """

    def __init__(self, folder: Path, settings: Settings, clock: Clock, *, settle_s: float, is_removing: bool = False,
                 monotonic: Callable[[], float] = time.monotonic) -> None:  # fmt: skip
        self._folder = folder
        self._settings = settings
        self._clock = clock
        self._settle_s = settle_s
        self._is_removing = is_removing
        self._monotonic = monotonic
        self._looks: dict[str, tuple[tuple[FoundFile, ...], float]] = {}
        self._told: dict[str, str] = {}
        self._again_s: dict[str, float] = {}
        self._left: set[str] = set()
        """Bags that nobody seems to finish."""

    @contextmanager
    def alone(self) -> Iterator[None]:
        """For its whole life. Raises BagError when another process watches this folder."""
        with on_disk(self._folder), flock(self._folder / f'{MARKS}.lock', wait=False) as is_mine:
            if not is_mine:
                raise BagError(f'another process watches {self._folder} already', path=str(self._folder))
            yield

    def round(self) -> list[WatchStep]:
        """Ship what is finished, confirm what was shipped. Raises BagError where the folder itself cannot be used."""
        with on_disk(self._folder):
            marks = self._marks()
            folders = [path for path in sorted(self._folder.iterdir()) if path.is_dir()]
            bags = [path for path in folders if (path / METADATA).exists()]
            steps = [step for path in bags for step in self._step(path, marks)]
            return [*steps, *(step for path in folders if path not in bags for step in self._unfinished(path))]

    def is_owing(self) -> bool:
        """Whether the store does not have a bag of this folder yet, for whatever reason."""
        return bool(self._looks or self._left) or any(mark.state == SPOOLED for mark in self._marks().values())

    def _step(self, path: Path, marks: dict[str, BagMark]) -> Iterator[WatchStep]:
        mark = marks.get(path.name)
        try:
            if mark is None:
                if not self._is_settled(path):
                    return
                finished(path)
                mark = marks[path.name] = self._ship(path)
                self._write(marks)
                yield WatchStep(path.name, SPOOLED)
            if mark.state == SPOOLED and self._monotonic() >= self._again_s.get(path.name, 0.0) and self._confirm(path, mark):
                self._write(marks)
                yield WatchStep(path.name, STORED)
            if self._is_removing and mark.state == STORED and self._remove(path, mark):
                self._write(marks)
                yield WatchStep(path.name, REMOVED)
        except DataLoggerError as error:
            if self._told.get(path.name) != str(error):
                self._told[path.name] = str(error)
                yield WatchStep(path.name, 'refused', str(error))

    def _unfinished(self, path: Path) -> Iterator[WatchStep]:
        """A bag that nobody seems to write any more, once."""
        times = [file.changed_ns for file in _look(path) if file.name.endswith(SLICES)]
        if not times or self._clock.wall_ns() - max(times) < UNFINISHED_S * SECOND:
            self._left.discard(path.name)
        elif path.name not in self._left:
            self._left.add(path.name)
            reason = f'it has no {METADATA}, and nothing in it has changed for {UNFINISHED_S / 60:.0f} min'
            remedy = f'if no recorder is writing to it: `shadowhound-data bag repair {path} --in-place` makes it'
            yield WatchStep(path.name, 'refused', f'{reason} ({remedy})')

    def _is_settled(self, path: Path) -> bool:
        look = _look(path)
        before, since_s = self._looks.get(path.name, (None, 0.0))
        if look != before:
            self._looks[path.name] = (look, self._monotonic())
            return self._settle_s <= 0
        return self._monotonic() - since_s >= self._settle_s

    def _ship(self, path: Path) -> BagMark:
        settings = self._settings
        look = _look(path)
        with planned(path, settings.robot, safe_bag(path.name), settings.home, is_archive=False) as sent:
            with opened_spool(settings, self._clock) as spool:
                spool_upload(sent, spool)
            files = tuple(SentFile(file.name, file.key, file.size, file.sha256) for file in sent.files)
        self._looks.pop(path.name, None)
        return BagMark(SPOOLED, look, files, spooled=iso(self._clock.wall_ns()))

    def _confirm(self, path: Path, mark: BagMark) -> bool:
        """Ask the store; where it does not have everything yet, deliver for a moment, unless the node does."""
        self._again_s[path.name] = self._monotonic() + RETRY_S
        if not self._is_stored(mark):
            settings = self._settings
            with opened_spool(settings, self._clock) as spool:
                files = (Outgoing(file.name, file.key, path, file.size, file.sha256) for file in mark.files)
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
        """Only what the store holds this very moment, and what is still what was sent."""
        if _look(path) != mark.look or not self._is_stored(mark):
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
            remedy = 'remove it: nothing is sent twice all the same, but everything is read once more'
            raise BagError(f'{self._folder / MARKS} cannot be read: {error}', remedy=remedy) from error

    def _write(self, marks: dict[str, BagMark]) -> None:
        with replacing(self._folder / MARKS, is_synced=True) as file:
            file.write(json.dumps(as_plain(BagMarks(marks)), indent=1).encode())


def _look(folder: Path) -> tuple[FoundFile, ...]:
    """Every file of a bag; nothing changes unless a program writes it."""
    found = []
    for path in sorted(folder.rglob('*')):
        with suppress(FileNotFoundError):  # its recorder is at work
            stat = path.stat()
            if S_ISREG(stat.st_mode):
                found.append(FoundFile(str(path.relative_to(folder)), stat.st_size, stat.st_mtime_ns))
    return tuple(found)
