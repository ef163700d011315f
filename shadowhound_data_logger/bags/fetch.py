"""Fetches a bag from the store into a folder: several files at a time, each verified and named only once it is whole.

What is there already and right is not asked for again; a file that a kill cut off goes on where it ended.
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
    """What a fetch brought."""

    folder: Path
    files: int
    bytes: int
    """Of all files of the bag."""
    downloaded: int
    """Bytes that came over the network."""
    is_complete: bool
    """Whether the manifest was there and all that it promises; else the bag is growing, or foreign."""
    unverified: tuple[str, ...]
    """Files of a foreign writer, of which no checksum is known."""
    missing: tuple[str, ...] = ()
    """Slices that the manifest promises and that are not in the store."""


def fetch(
    store: ObjectStore, bag: RemoteBag, to: Path, *, threads: int = FETCH_THREADS, progress: ProgressListener | None = None
) -> FetchedBag:
    """Raises BagError, BagDamaged for what does not arrive as it was sent, StoreError, OSError; what is whole by then stays."""
    with on_disk(to):
        return _fetch(store, bag, to, threads, progress or ProgressListener())


@contextmanager
def on_disk(folder: Path) -> Iterator[None]:
    """What the disk refuses is a BagError."""
    try:
        yield
    except OSError as error:
        where = error.filename or folder
        raise BagError(f'{where} cannot be used: {error.strerror}', remedy='is there space, and may you write there?') from error


def _fetch(store: ObjectStore, bag: RemoteBag, to: Path, threads: int, progress: ProgressListener) -> FetchedBag:
    folder = to if bag.is_archive else path_below(to, bag.name)
    folder.mkdir(parents=True, exist_ok=True)
    meter = Meter()
    progress.begin(bag.size)
    manifest = None
    if (file := bag.file(MANIFEST)) is not None:
        check_document(file.key, file.size)
        _have(store, file, folder, None, meter, progress)
        manifest = Manifest.from_json(read_whole(LocalFile(folder / MANIFEST)), file.key)
    others = [file for file in bag.files if file.name != MANIFEST]
    promised = {each.file: each.sha256 for each in manifest.slices} if manifest else {}

    def one(file: RemoteFile) -> str:
        return _have(store, file, folder, promised.get(file.name), meter, progress)

    checksums = dict(zip((file.name for file in others), _side_by_side(one, others, threads), strict=True))
    missing = tuple(missing_of(bag, manifest)) if manifest is not None else ()
    if not bag.is_archive and (missing or not bag.file(METADATA)):
        _describe(folder, bag, clock_of(store, bag))
    return FetchedBag(
        folder / bag.files[0].name if bag.is_archive else folder, len(bag.files), bag.size, meter.bytes,
        is_complete=manifest is not None and not missing,
        unverified=tuple(name for name, known in checksums.items() if not known), missing=missing,
    )  # fmt: skip


def _side_by_side(one: Callable[[RemoteFile], str], files: Sequence[RemoteFile], threads: int) -> Iterable[str]:
    """In the order of the files; after a failure no other file is begun."""
    pool = ThreadPoolExecutor(threads, 'bag-fetch')
    try:
        yield from [each.result() for each in [pool.submit(one, file) for file in files]]
    finally:
        pool.shutdown(cancel_futures=True)


def _have(
    store: ObjectStore, file: RemoteFile, folder: Path, promised: str | None, got: Meter, progress: ProgressListener
) -> str:
    """Make it be there; returns the SHA-256 that it was checked against, empty where none is known."""
    path = path_below(folder, file.name)
    sha256 = promised or _recorded(store, file)
    if path.is_file() and path.stat().st_size == file.size and (not sha256 or fingerprint(path)[1] == sha256):
        progress.have(file.size)
        return sha256
    path.parent.mkdir(parents=True, exist_ok=True)

    def tell(count: int) -> None:
        got.add(max(count, 0))
        progress.have(count)

    with _alone(path) as resumed:
        progress.have(resumed)
        info = download(store, ObjectInfo(BUCKET, file.key, file.size, None), path, tell=tell).info
    if promised and info.sha256 != promised and fingerprint(path)[1] != promised:
        path.unlink()
        raise BagDamaged(f'{file.key} is not in the store what was recorded: its SHA-256 is not {promised}',
                         remedy='shadowhound-data bag verify checks all files', path=file.key)  # fmt: skip
    return sha256


def _recorded(store: ObjectStore, file: RemoteFile) -> str:
    held = store.head(BUCKET, file.key)
    return (held.sha256 if held else None) or ''


@contextmanager
def _alone(path: Path) -> Iterator[int]:
    """The bytes that are there already, of which no other process writes more meanwhile. Raises BagError when one does."""
    with path.with_name(path.name + UNFINISHED).open('ab') as part:
        if not lock(part, wait=False):
            raise BagError(f'another process fetches {path} already', path=str(path))
        yield os.fstat(part.fileno()).st_size


def _describe(folder: Path, bag: RemoteBag, clock: Mapping[str, str]) -> None:
    """Of a bag that is not all there, so that players open what is; the real one replaces it with the rest."""
    sources = {file.name: LocalFile(folder / file.name) for file in bag.slices if file.name.endswith(MCAP)}
    try:
        infos = list(BagReader(sources, None).infos().values())
    except BagDamaged:
        return  # none can be read, which verify shows
    if infos:
        with replacing(folder / METADATA) as file:
            file.write(metadata_yaml(infos, ros_distro='', custom_data=clock))
