"""Downloads a bag from the store into a folder: several files at a time; each gets its name when it is complete and verified.

Files that exist and are correct are not downloaded again; an interrupted download is resumed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from shadowhound_data_logger.bags.contents import BagReader
from shadowhound_data_logger.bags.manifest import Manifest
from shadowhound_data_logger.bags.naming import BUCKET, MANIFEST, MCAP, METADATA
from shadowhound_data_logger.bags.remote import RemoteBag, RemoteFile, clock_of, missing_of
from shadowhound_data_logger.core.durable_files import fingerprint, lock, replacing
from shadowhound_data_logger.core.errors import BagDamaged, BagError
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.core.progress import ProgressListener
from shadowhound_data_logger.core.untrusted import path_below
from shadowhound_data_logger.formats.mcap.ranges import LocalFile, Meter, check_document, read_whole
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import metadata_yaml
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.download import UNFINISHED, download

FETCH_THREADS: Final = 4


@dataclass(frozen=True, slots=True)
class FetchedBag:
    """The result of a fetch."""

    folder: Path
    files: int
    bytes: int
    """Total size of the bag's files."""
    downloaded: int
    """Bytes that were downloaded."""
    is_complete: bool
    """Whether the store has the manifest and all files in it; otherwise the bag is growing, or foreign."""
    unverified: tuple[str, ...]
    """Files of a foreign writer, whose checksums are unknown."""
    missing: tuple[str, ...] = ()
    """Slices in the manifest that are not in the store."""


def fetch(
    store: ObjectStore, bag: RemoteBag, to: Path, *, threads: int = FETCH_THREADS, progress: ProgressListener | None = None
) -> FetchedBag:
    """Raises BagError, BagDamaged for files that differ from the recorded ones, StoreError, OSError; keeps complete files."""
    with disk_errors(to):
        return _fetch(store, bag, to, threads, progress or ProgressListener())


@contextmanager
def disk_errors(folder: Path) -> Iterator[None]:
    """Converts OSError to BagError."""
    try:
        yield
    except OSError as error:
        where = error.filename or folder
        remedy = 'check the free space and the permissions'
        raise BagError(f'{where} cannot be used: {error.strerror}', remedy=remedy) from error


def _fetch(store: ObjectStore, bag: RemoteBag, to: Path, threads: int, progress: ProgressListener) -> FetchedBag:
    folder = to if bag.is_archive else path_below(to, bag.name)
    folder.mkdir(parents=True, exist_ok=True)
    meter = Meter()
    progress.begin(bag.size)
    manifest = None
    if (file := bag.file(MANIFEST)) is not None:
        check_document(file.key, file.size)
        _ensure_file(store, file, folder, None, meter, progress)
        manifest = Manifest.from_json(read_whole(LocalFile(folder / MANIFEST)), file.key)
    others = [file for file in bag.files if file.name != MANIFEST]
    promised = {each.file: each.sha256 for each in manifest.slices} if manifest else {}

    def one(file: RemoteFile) -> str:
        return _ensure_file(store, file, folder, promised.get(file.name), meter, progress)

    checksums = dict(zip((file.name for file in others), _in_parallel(one, others, threads), strict=True))
    missing = tuple(missing_of(bag, manifest)) if manifest is not None else ()
    if not bag.is_archive and (missing or not bag.file(METADATA)):
        _describe(folder, bag, clock_of(store, bag))
    return FetchedBag(
        folder / bag.files[0].name if bag.is_archive else folder, len(bag.files), bag.size, meter.bytes,
        is_complete=manifest is not None and not missing,
        unverified=tuple(name for name, known in checksums.items() if not known), missing=missing,
    )  # fmt: skip


def _in_parallel(one: Callable[[RemoteFile], str], files: Sequence[RemoteFile], threads: int) -> Iterable[str]:
    """The results in the order of the files; no further file is started after a failure."""
    pool = ThreadPoolExecutor(threads, 'bag-fetch')
    try:
        yield from [each.result() for each in [pool.submit(one, file) for file in files]]
    finally:
        pool.shutdown(cancel_futures=True)


def _ensure_file(
    store: ObjectStore, file: RemoteFile, folder: Path, promised: str | None, got: Meter, progress: ProgressListener
) -> str:
    """Download a file unless it exists; returns the SHA-256 that it was verified with, '' if unknown."""
    path = path_below(folder, file.name)
    sha256 = promised or _recorded(store, file)
    if path.is_file() and path.stat().st_size == file.size and (not sha256 or fingerprint(path)[1] == sha256):
        progress.have(file.size)
        return sha256
    path.parent.mkdir(parents=True, exist_ok=True)

    def tell(count: int) -> None:
        got.add(max(count, 0))
        progress.have(count)

    with _exclusive(path) as resumed:
        progress.have(resumed)
        info = download(store, ObjectInfo(BUCKET, file.key, file.size, None), path, on_progress=tell).info
    if promised and info.sha256 != promised and fingerprint(path)[1] != promised:
        path.unlink()
        raise BagDamaged(f'{file.key} in the store is not the recorded file: its SHA-256 is not {promised}',
                         remedy='shadowhound-data bag verify checks all files', path=file.key)  # fmt: skip
    return sha256


def _recorded(store: ObjectStore, file: RemoteFile) -> str:
    held = store.head(BUCKET, file.key)
    return (held.sha256 if held else None) or ''


@contextmanager
def _exclusive(path: Path) -> Iterator[int]:
    """Lock an unfinished download; yields its size. Raises BagError if another process has the lock."""
    with path.with_name(path.name + UNFINISHED).open('ab') as part:
        if not lock(part, wait=False):
            raise BagError(f'another process is already fetching {path}', path=str(path))
        yield os.fstat(part.fileno()).st_size


def _describe(folder: Path, bag: RemoteBag, clock: Mapping[str, str]) -> None:
    """Write metadata.yaml for an incomplete bag, so that players can open it; a later fetch replaces it with the original."""
    sources = {file.name: LocalFile(folder / file.name) for file in bag.slices if file.name.endswith(MCAP)}
    try:
        infos = list(BagReader(sources, None).infos().values())
    except BagDamaged:
        return  # no file is readable, which verify reports
    if infos:
        with replacing(folder / METADATA) as file:
            file.write(metadata_yaml(infos, ros_distro='', custom_data=clock))
