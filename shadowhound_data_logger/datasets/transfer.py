"""Uploads and downloads a dataset: file by file, verified, ``info.json`` last; after a kill, only what is missing."""

from __future__ import annotations

import mimetypes
import re
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeVar

from shadowhound_data_logger.core.durable_files import fingerprint
from shadowhound_data_logger.core.errors import LakeError, SettingError
from shadowhound_data_logger.core.model import ObjectInfo, SpooledObject
from shadowhound_data_logger.core.retry import with_retries
from shadowhound_data_logger.core.untrusted import from_json, path_below
from shadowhound_data_logger.datasets.lerobot import DIGESTS, FILES, Lerobot
from shadowhound_data_logger.lake.training import INFO
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.download import download
from shadowhound_data_logger.stores.verify import compare

SCHEME: Final = 's3://'
BUCKET: Final = 'lerobot'
FOLDER: Final = 'datasets/'
"""The prefix of datasets in a bucket."""
THREADS: Final = 4
TRIES: Final = 6
MAX_DIGEST_BYTES: Final = 1 << 28
_Answer = TypeVar('_Answer')
_URL: Final = re.compile(r's3://([a-z0-9][a-z0-9.-]{1,61}[a-z0-9])/([^/].*?)/*')


@dataclass(frozen=True, slots=True)
class DatasetPlace:
    """The location of a dataset in a store."""

    bucket: str
    prefix: str
    """Ends with a slash."""

    @classmethod
    def of(cls, url: str) -> DatasetPlace:
        """Raises SettingError for a URL other than ``s3://BUCKET/FOLDER``."""
        named = _URL.fullmatch(url)
        if named is None:
            raise SettingError('--to', url, f'a folder, or {SCHEME}{BUCKET}/{FOLDER}go2/NAME')
        return cls(named[1], f'{named[2]}/')

    def __str__(self) -> str:
        return f'{SCHEME}{self.bucket}/{self.prefix[:-1]}'


@dataclass(slots=True)
class Transferred:
    """What was transferred; identical files were skipped."""

    files: int = 0
    bytes: int = 0
    removed: int = 0


def upload(folder: Path, place: DatasetPlace, store: ObjectStore, say: Callable[[str], None] = lambda _: None) -> Transferred:
    """Upload the folder. During the upload the place has no ``info.json``, so that it is recognized as incomplete.

    The digests are uploaded first, so that ``catch_up`` can find out whose upload was interrupted.

    Raises StoreError, LakeError for a folder that is not a dataset.
    """
    made = Lerobot(folder)
    if made.info is None:
        raise LakeError(f'{folder} is not a dataset: it has no {INFO}', remedy='shadowhound-data export lerobot creates one')
    paths = sorted(made.paths())
    local = {path.relative_to(folder).as_posix(): path for path in paths}
    last = {name: folder / name for name in (FILES, INFO)}
    remote = {info.key[len(place.prefix) :] for info in store.list(place.bucket, place.prefix)}
    moved = Transferred()
    if INFO in remote and not _is_there(store, place, INFO, folder / INFO):
        _ask(lambda: store.delete(place.bucket, place.prefix + INFO))
    for name in sorted(remote - {*local, *last}):
        _ask(lambda name=name: store.delete(place.bucket, place.prefix + name))  # type: ignore[misc]
        moved.removed += 1

    def put(name: str, path: Path) -> int:
        if name in remote:
            if _is_there(store, place, name, path):
                return 0
            _ask(lambda: store.delete(place.bucket, place.prefix + name))
        return _put(store, place, name, path)

    size = put(DIGESTS, local.pop(DIGESTS))
    moved.files, moved.bytes = int(bool(size)), size
    with ThreadPoolExecutor(THREADS, 'export-put') as pool:
        for number, size in enumerate(pool.map(lambda each: put(*each), local.items())):
            say(f'{number + 1} of {len(local)} files')
            moved.files += bool(size)
            moved.bytes += size
    for name, path in last.items():
        size = put(name, path)
        moved.files += bool(size)
        moved.bytes += size
    return moved


def fetch_dataset(
    place: DatasetPlace, folder: Path, store: ObjectStore, say: Callable[[str], None] = lambda _: None
) -> Transferred:
    """Download the dataset, ``info.json`` last; files that the place no longer has are removed.

    Raises StoreError, LakeError if there is no dataset.
    """
    remote = {info.key[len(place.prefix) :]: info for info in store.list(place.bucket, place.prefix)}
    if INFO not in remote:
        raise LakeError(f'there is no dataset at {place}', remedy='is it being uploaded? It has no meta/info.json')
    moved = Transferred()
    info = store.head(place.bucket, place.prefix + INFO)
    here = folder / INFO
    if here.is_file() and (info is None or fingerprint(here)[1] != info.sha256):
        here.unlink()

    def get(name: str) -> int:
        path = path_below(folder, name)
        held = _ask(lambda: store.head(place.bucket, place.prefix + name))
        if held is None:
            raise LakeError(f'{place}/{name} was deleted', remedy='the dataset changed during the download: fetch it again')
        if path.is_file() and path.stat().st_size == held.size and held.sha256 and fingerprint(path)[1] == held.sha256:
            return 0
        path.parent.mkdir(parents=True, exist_ok=True)
        download(store, ObjectInfo(place.bucket, place.prefix + name, held.size, held.sha256), path)
        return max(1, held.size)

    with ThreadPoolExecutor(THREADS, 'export-get') as pool:
        names = sorted(set(remote) - {INFO})
        for number, size in enumerate(pool.map(get, names)):
            say(f'{number + 1} of {len(names)} files')
            moved.files += bool(size)
            moved.bytes += size
    for path in _stray(folder, remote):
        path.unlink()
        moved.removed += 1
    size = get(INFO)
    moved.files += bool(size)
    moved.bytes += size
    return moved


def catch_up(place: DatasetPlace, folder: Path, store: ObjectStore, say: Callable[[str], None] = lambda _: None) -> bool:
    """Update the copy in a folder from the place, unless the copy is newer; returns whether the place has a dataset.

    Raises StoreError, and LakeError if another machine's upload to it is unfinished.
    """
    there = {info.key[len(place.prefix) :] for info in store.list(place.bucket, place.prefix)}
    if not there:
        return False
    last = ''
    if DIGESTS in there:
        last = _digests(_ask(lambda: store.get(place.bucket, place.prefix + DIGESTS, MAX_DIGEST_BYTES)))[-1]
    if (folder / INFO).is_file() and last in {'', *_digests((folder / DIGESTS).read_bytes())}:
        return True
    if INFO not in there:
        raise LakeError(f'another machine started to upload {place} and has not finished',
                        remedy='wait for it, or run its command there again')  # fmt: skip
    fetch_dataset(place, folder, store, say)
    return True


def _digests(body: bytes) -> list[str]:
    """Raises LakeError."""
    try:
        return [str(each['digest']) for each in from_json(body)['digests']]
    except (ValueError, LookupError, TypeError) as error:
        raise LakeError(f'{DIGESTS} of a dataset cannot be read: {error}') from error


def datasets_in(store: ObjectStore, bucket: str = BUCKET) -> Iterator[DatasetPlace]:
    """The complete datasets in a bucket. Raises StoreError."""
    for info in store.list(bucket, FOLDER):
        if info.key.endswith(f'/{INFO}'):
            yield DatasetPlace(bucket, info.key.removesuffix(INFO))


def _stray(folder: Path, remote: dict[str, ObjectInfo]) -> Iterator[Path]:
    for part in ('data', 'videos', 'meta'):
        for path in sorted((folder / part).rglob('*')):
            if path.is_file() and path.relative_to(folder).as_posix() not in remote:
                yield path


def _is_there(store: ObjectStore, place: DatasetPlace, name: str, path: Path) -> bool:
    held = _ask(lambda: store.head(place.bucket, place.prefix + name))
    return held is not None and not compare(held, *fingerprint(path))


def _put(store: ObjectStore, place: DatasetPlace, name: str, path: Path) -> int:
    size, sha256 = fingerprint(path)
    kind = mimetypes.guess_type(name)[0] or 'application/octet-stream'
    item = SpooledObject(
        id=0, bucket=place.bucket, key=place.prefix + name, path=path, size=size, sha256=sha256, content_type=kind,
        metadata={'sha256': sha256}, priority=5, created_ns=time.time_ns(),
    )  # fmt: skip
    _ask(lambda: store.put(item))
    return size


def _ask(ask: Callable[[], _Answer]) -> _Answer:
    return with_retries(ask, tries=TRIES)
