"""A mission's objects for the store: frames, trajectory and summary. Passes them to the spool and, without a node, delivers them.

sensor-data/<robot>/missions/<run id>/camera/frame_NNNNNN.jpg, trajectory.csv, summary.json
trajectories/<robot>/<mission type>_YYYYMMDD_HHMMSS.csv
"""

from __future__ import annotations

import re
import sqlite3
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import Clock
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.errors import SpoolError, StoreUnavailable
from shadowhound_data_logger.core.model import Binding, DataObject
from shadowhound_data_logger.missions.folder import MissionFolder, Run, timestamped_name
from shadowhound_data_logger.missions.state import BUCKET, TRAJECTORIES
from shadowhound_data_logger.shipping.catalog_writer import CatalogWriter
from shadowhound_data_logger.shipping.uploader import delivering
from shadowhound_data_logger.spool.ballast import unwritable
from shadowhound_data_logger.spool.files import content_sha256
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.spool import MAX_OBJECTS, Spool
from shadowhound_data_logger.spool.status import limits

FRAME_PRIORITY: Final = 6
"""The same as that of camera images."""
CONTENT_TYPES: Final = {'jpg': 'image/jpeg', 'csv': 'text/csv', 'json': 'application/json'}
REST_S: Final = 30.0
"""An unused spool is closed after this time."""
SLICE_S: Final = 3.0
"""How long the drain lock is held at a time: a starting node waits that long."""


@dataclass(frozen=True, slots=True)
class MissionObject:
    """An object and the file that it was made from."""

    content: DataObject
    path: Path
    is_disposable: bool
    """Whether the file can be deleted once the object is spooled."""


def held_reason(mission_id: str) -> str:
    """The reason that the spool gives for holding objects until the mission has a run."""
    return f'mission-{mission_id}'


def objects_of(record: Mapping[str, Any], start: Mapping[str, Any], folder: MissionFolder, run: Run | None,
               files: Path | None = None) -> Iterator[MissionObject]:  # fmt: skip
    """The objects of one record of the journal; none if its file was deleted. Raises OSError.

    ``files`` is the folder of the journal's files, by default the mission's ``files/``. Without a run the keys contain the
    mission id, which ``Spooler.bind`` replaces.
    """
    kind, robot, files = record.get('k'), start['robot'], files or folder.files
    home = f'{robot}/missions/{run.run_id if run else folder.mission_id}'
    metadata = {meta.ROBOT: robot, meta.MISSION_ID: folder.mission_id, meta.MISSION_TYPE: start['type']}
    metadata |= {meta.RUN_ID: run.run_id} if run else {}
    time_ns = int(record.get('t', 0))
    if kind == 'frame':
        number, path = int(record['id']), files / record['file']
        key, more = f'{home}/camera/frame_{number:06d}.jpg', {**record.get('marks', {}), **metadata, meta.FRAME_ID: str(number)}
        yield from _item(path, BUCKET, key, time_ns, more, is_disposable=not record.get('artifact'))
    elif kind == 'trajectory':
        yield from _trajectory(files / record['file'], home, start, time_ns, metadata)
    elif kind == 'end':
        yield from _trajectory(folder.trajectory, home, start, time_ns, metadata)
        yield from _item(folder.summary, BUCKET, f'{home}/summary.json', time_ns, metadata)


def _trajectory(
    path: Path, home: str, start: Mapping[str, Any], time_ns: int, metadata: Mapping[str, str]
) -> Iterator[MissionObject]:
    yield from _item(path, BUCKET, f'{home}/trajectory.csv', time_ns, metadata)
    yield from _item(
        path, TRAJECTORIES, f'{start["robot"]}/{timestamped_name(start["type"], int(start["t"]))}.csv', time_ns, metadata
    )


def _item(path: Path, bucket: str, key: str, time_ns: int, metadata: Mapping[str, str], *,
          is_disposable: bool = False) -> Iterator[MissionObject]:  # fmt: skip
    try:
        body = path.read_bytes()
    except FileNotFoundError:
        return
    extension = key.rpartition('.')[2]
    is_frame = extension == 'jpg'
    content = DataObject(
        bucket=bucket, key=key, body=body, content_type=CONTENT_TYPES[extension], sensor='missions', topic=None, type='',
        samples=0, t_start_ns=time_ns, t_end_ns=time_ns, priority=FRAME_PRIORITY if is_frame else 1,
        protected=not is_frame, metadata=metadata,
        held=None if meta.RUN_ID in metadata else held_reason(metadata[meta.MISSION_ID]),
    )  # fmt: skip
    yield MissionObject(content, path, is_disposable)


class Spooler:
    """Adds the objects of missions to the spool; without a node, also delivers them and their rows of the catalog.

    Lifecycle: New; add and drain any number of times; close once. The first ``add`` opens the spool. One thread.
    """

    def __init__(self, settings: Settings, clock: Clock, *, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._settings = settings
        self._clock = clock
        self._monotonic = monotonic
        self._used_s = 0.0
        self._node_drains = False
        self._is_new = True
        self._catalogue = CatalogWriter(settings.spool_path, settings.catalog, settings.robot, clock, monotonic)
        self._spool: Spool | None = None

    def add(self, objects: Sequence[DataObject]) -> None:
        """Commit objects to the spool; those that are or were in it are skipped. Raises SpoolError."""
        if not objects:
            return
        with self._using(self._opened()) as spool, closing(Index(spool.root / 'index.db', read_only=True)) as known:
            known.open()
            new = [item for item in objects if not _has(known, item)]
            for begin in range(0, len(new), MAX_OBJECTS):
                spool.commit(new[begin : begin + MAX_OBJECTS])

    def bind(self, mission_id: str, run_id: str) -> bool:
        """Give the held objects of a mission their final keys; returns whether there were any. Raises SpoolError."""
        with self._using(self._opened()) as spool:
            found = spool.reading.objects.held(held_reason(mission_id))
            spool.bind([
                Binding(item.id, item.key.replace(f'/missions/{mission_id}/', f'/missions/{run_id}/', 1),
                        {**item.metadata, meta.RUN_ID: run_id}, item.t_start_ns, item.t_end_ns)
                for item in found
            ])  # fmt: skip
        return bool(found)

    def pending(self) -> int:
        """The number of objects that wait for delivery; 0 if this process has not opened the spool. Raises SpoolError."""
        if self._spool is None:
            return 0
        with self._using(self._spool) as spool:
            return spool.pending_count()

    @property
    def has_unsent(self) -> bool:
        """Whether objects or rows of the catalog wait for delivery, and no node delivers them."""
        try:
            return not self._node_drains and self._has_work()
        except SpoolError:
            return True

    def expedite(self) -> None:
        """Write the rows of the catalog soon, because a mission has ended."""
        self._catalogue.expedite()

    def drain(self) -> None:
        """Deliver for up to ``SLICE_S`` unless a node does. Raises StoreError, SettingError or SpoolError."""
        if self._spool is None:
            if self._is_new and (self._settings.spool_path / 'index.db').exists():
                self._opened()  # for the objects of an earlier process
            self._is_new = False
            return
        if not self._has_work():
            if self._monotonic() - self._used_s > REST_S:
                self.close()
            return
        with self._using(self._spool) as spool:
            with spool.drain_lock() as mine:
                self._node_drains = not mine
            if mine:
                self._drain(spool)

    def close(self) -> None:
        if self._spool is not None:
            self._spool.close()
            self._spool = None

    def _has_work(self) -> bool:
        """Raises SpoolError."""
        if self.pending():
            return True
        if self._spool is None or not self._settings.catalog.enabled:
            return False
        with self._using(self._spool) as spool:
            return bool(spool.reading.catalog.uncataloged(1))

    def _drain(self, spool: Spool) -> None:
        with delivering(spool, self._settings, SLICE_S) as (uploader, writer):
            drained = uploader.drain(SLICE_S)
            writer.flush(SLICE_S)
            for part in self._catalogue.due():
                writer.put(part)
            status = uploader.status()
        if writer.damaged:
            raise sqlite3.DatabaseError(f'the index of the spool {spool.root} is damaged')
        if not drained and not status.delivered and status.last_error:
            raise StoreUnavailable(status.last_error)

    @contextmanager
    def _using(self, spool: Spool) -> Iterator[Spool]:
        """Use the spool, and close it if its index is missing or damaged: the next open rebuilds the index."""
        try:
            yield spool
        except (OSError, sqlite3.OperationalError) as error:
            raise unwritable(spool.root, error) from error
        except (SpoolError, sqlite3.DatabaseError) as error:
            self._spool = None
            with suppress(SpoolError):
                spool.close()
            raise unwritable(spool.root, error) if isinstance(error, sqlite3.Error) else error from error

    def _opened(self) -> Spool:
        self._used_s = self._monotonic()
        if self._spool is None:
            path = self._settings.spool_path
            spool = Spool(path, limits(path, self._settings.spool), self._clock, self._settings.robot)
            spool.open()
            self._spool = spool
        return self._spool


def _has(index: Index, item: DataObject) -> bool:
    """Whether the same content was spooled before, under this key or with ``_1``, ``_2``, ... appended (``keys.unique``).

    One query, because an agent that gives all frames the same number creates many such keys.
    """
    folder, slash, name = item.key.rpartition('/')
    stem, dot, extension = name.partition('.')
    first = f'{folder}{slash}{stem}'
    found = index.objects.with_content(item.bucket, first, content_sha256(item.body))
    numbered = re.compile(rf'{re.escape(first)}(_[1-9][0-9]*)?{re.escape(dot + extension)}')
    return any(numbered.fullmatch(row['key']) for row in found)
