"""Uploads a finished bag from a folder to the store, either through the spool, where it is safe until delivered, or directly."""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from shadowhound_data_logger.bags.fetch import disk_errors
from shadowhound_data_logger.bags.naming import BUCKET, MANIFEST
from shadowhound_data_logger.bags.upload_plan import PlannedFile, UploadPlan, archive_of, plan_of, read_finished
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.clock import Clock
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.core.errors import BagError, ForeignObject
from shadowhound_data_logger.core.model import DataObject, FileBody, SpooledObject, State
from shadowhound_data_logger.core.progress import ProgressListener
from shadowhound_data_logger.core.retry import with_retries
from shadowhound_data_logger.shipping.uploader import Uploader, delivering
from shadowhound_data_logger.spool.ballast import unwritable
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.spool import MAX_OBJECTS, Spool
from shadowhound_data_logger.spool.status import limits
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.verify import compare

SENDING: Final = 'sending'
"""Folder for files that are created for an upload, in SHADOWHOUND_HOME."""
PRIORITY: Final = 8
"""The same as for slices that the node records: after smaller objects."""
FACTS_PRIORITY: Final = 4
SMALL_BYTES: Final = 1 << 20
POLL_S: Final = 0.2
CLOSE_S: Final = 5.0
THREADS: Final = 4
CAP_S: Final = 10.0


@dataclass(frozen=True, slots=True)
class Uploaded:
    """The result of an upload."""

    robot: str
    bag: str
    files: int
    bytes: int
    delivered: int
    """Files that the store confirmed; the others wait in the spool."""
    last_error: str
    """Why they wait, if known."""

    @property
    def is_delivered(self) -> bool:
        return self.delivered == self.files


@contextmanager
def plan_upload(folder: Path, robot: str, bag: str, home: Path, *, is_archive: bool) -> Iterator[UploadPlan]:
    """The plan for a bag; its temporary files are deleted afterwards. Raises BagError, BagDamaged, NameRefused."""
    found = read_finished(folder)  # raises before a folder is created
    with disk_errors(home):
        (home / SENDING).mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f'{bag[:64]}-', dir=home / SENDING))
        try:
            with flock(work / 'lock'):
                _sweep(home / SENDING)
                yield (archive_of if is_archive else plan_of)(found, robot, bag, work)
        finally:
            shutil.rmtree(work, ignore_errors=True)


def upload_now(store: ObjectStore, plan: UploadPlan, *, deadline_s: float, progress: ProgressListener | None = None) -> Uploaded:
    """Upload without the spool; returns when the store has confirmed all files. Raises BagError, StoreError."""
    progress = progress or ProgressListener()
    progress.begin(plan.size)
    end_s = time.monotonic() + deadline_s

    def put(place: int) -> None:
        file = plan.files[place]
        item = SpooledObject(place, BUCKET, file.key, file.path, file.size, file.sha256, file.content_type,
                             {**file.metadata, meta.SHA256: file.sha256}, PRIORITY, 0)  # fmt: skip
        try:
            with_retries(lambda: store.put(item), tries=float('inf'), until_s=end_s, cap_s=CAP_S)
        except ForeignObject as error:
            raise _name_taken(plan.bag, str(error.data.get('key'))) from error
        progress.have(file.size)

    with ThreadPoolExecutor(THREADS, 'bag-upload') as pool:
        list(pool.map(put, range(len(plan.files) - 1)))
    put(len(plan.files) - 1)  # the manifest is last, because it states that all other files exist
    return Uploaded(plan.robot, plan.bag, len(plan.files), plan.size, len(plan.files), '')


def spool_upload(plan: UploadPlan, spool: Spool) -> None:
    """Add the files to the spool, except those that it has or had; the bag's own files are not deleted.

    Raises BagError if there is no room or another bag has the name, SpoolError.
    """
    objects: list[DataObject] = []
    placed: list[SpooledObject] = []
    with tempfile.TemporaryDirectory(dir=plan.files[-1].path.parent) as work:
        try:
            _check_names(spool, plan)
            for index, file in enumerate(plan.files):
                if spool.reading.objects.knows(BUCKET, file.key, file.sha256):
                    continue
                link = Path(work) / str(index)
                _link_or_copy(file.path, link)
                objects.append(_object(file, link))
            for begin in range(0, len(objects), MAX_OBJECTS):  # the manifest is the last
                placed += spool.commit(objects[begin : begin + MAX_OBJECTS])
        except sqlite3.Error as error:
            raise unwritable(spool.root, error) from error
    if len(placed) < len(objects):
        remedy = 'raise spool.max_bytes, or use --direct to upload it without the spool'
        raise BagError(f'the spool {spool.root} has no room for {plan.bag}: {plan.size} bytes', remedy=remedy)


@contextmanager
def open_spool(settings: Settings, clock: Clock) -> Iterator[Spool]:
    """The open spool of this robot. Raises SpoolError."""
    spool = Spool(settings.spool_path, limits(settings.spool_path, settings.spool), clock, settings.robot)
    spool.open()
    with closing(spool):
        yield spool


def deliver(
    settings: Settings, spool: Spool, plan: UploadPlan, *, deadline_s: float, progress: ProgressListener | None = None
) -> Uploaded:
    """Wait until the store has all files; deliver them if no node does. Raises BagError for rejected files, SettingError."""
    progress = progress or ProgressListener()
    progress.begin(plan.size)
    with delivering(spool, settings, CLOSE_S) as (uploader, _):
        return _wait(spool, plan, uploader, time.monotonic() + deadline_s, progress)


def is_confirmed(store: ObjectStore, files: Sequence[tuple[str, int, str]]) -> bool:
    """Whether the store has every (key, size, SHA-256). Raises StoreError."""
    return not any(compare(store.head(BUCKET, key), size, sha256) for key, size, sha256 in files)


def _wait(spool: Spool, plan: UploadPlan, uploader: Uploader, end_s: float, progress: ProgressListener) -> Uploaded:
    done: set[str] = set()
    while True:
        rows = _rows(spool, plan)
        for file in plan.files:
            if file.key not in done and _is_done(rows.get(file.key), plan.bag):
                done.add(file.key)
                progress.have(file.size)
        if len(done) == len(plan.files) or time.monotonic() >= end_s:
            return Uploaded(plan.robot, plan.bag, len(plan.files), plan.size, len(done), uploader.status().last_error)
        time.sleep(POLL_S)


def _is_done(row: sqlite3.Row | None, bag: str) -> bool:
    """Whether an object was delivered; the index forgets old delivered ones. Raises BagError if it never will be."""
    if row is None or row['state'] in {State.DELIVERED.value, State.DEDUPLICATED.value}:
        return True
    if row['reason'] == 'foreign':
        raise _name_taken(bag, row['key'])
    if row['state'] in {State.EVICTED.value, State.QUARANTINED.value}:
        text = f'{row["key"]} is {row["state"]} ({row["reason"]}), so the spool does not deliver it'
        raise BagError(text, remedy='use --direct to upload it without the spool', key=row['key'])
    return False


def _rows(spool: Spool, plan: UploadPlan) -> dict[str, sqlite3.Row]:
    """The rows of the plan's keys in the spool's index."""
    index = Index(spool.root / 'index.db', read_only=True)
    index.open()
    with closing(index):
        return {file.key: row for file in plan.files if (row := index.objects.row(BUCKET, file.key)) is not None}


def _check_names(spool: Spool, plan: UploadPlan) -> None:
    rows = _rows(spool, plan)
    for file in plan.files:
        if file.key in rows and rows[file.key]['sha256'] != file.sha256:
            raise _name_taken(plan.bag, file.key)


def _object(file: PlannedFile, path: Path) -> DataObject:
    is_slice = file.name != MANIFEST and meta.MESSAGES in file.metadata
    return DataObject(
        bucket=BUCKET, key=file.key, body=FileBody(path, file.size, file.sha256), content_type=file.content_type,
        sensor='rosbags', topic=None, type='', samples=0, t_start_ns=file.t_start_ns, t_end_ns=file.t_end_ns,
        priority=PRIORITY if is_slice else FACTS_PRIORITY, metadata=file.metadata,
    )  # fmt: skip


def _link_or_copy(source: Path, target: Path) -> None:
    """Hard-link a large file if possible, so that the spool takes it over without reading it.

    Small files are copied, because programs such as `ros2 bag reindex` overwrite metadata.yaml in place.
    """
    if source.stat().st_size > SMALL_BYTES:
        with suppress(OSError):
            os.link(source, target)
            return
    shutil.copyfile(source, target)


def _name_taken(bag: str, key: str) -> BagError:
    remedy = f'if it is another bag, upload it under another name: --bag-name {bag}_b'
    return BagError(f'{key} already exists with other content', remedy=remedy, key=key)


def _sweep(sending: Path) -> None:
    """Delete temporary files of processes that were killed: their locks are free."""
    for path in sending.glob('*/lock'):
        with flock(path, wait=False) as is_mine:
            if is_mine:
                shutil.rmtree(path.parent, ignore_errors=True)
