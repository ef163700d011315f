"""A folder as a store: ``<folder>/<bucket>/<key>``, with every object complete, durable and never overwritten.

Metadata are in ``<folder>/.metadata/<bucket>/<key>.json``: unlike extended attributes, these files survive ``cp``, ``tar`` and
any file system; unlike files next to the objects, ``aws s3 sync`` and globs do not take them for objects.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.durable_files import fingerprint, flock, sync
from shadowhound_data_logger.core.errors import AccessDenied, ObjectRefused, StoreError, StoreUnavailable
from shadowhound_data_logger.core.model import ObjectInfo, Put, SpooledObject
from shadowhound_data_logger.core.untrusted import from_json, is_path
from shadowhound_data_logger.stores.bandwidth import Pace
from shadowhound_data_logger.stores.base import Content, has_changed, too_large
from shadowhound_data_logger.stores.content import (
    CHUNK_BYTES,
    check_read,
    check_target,
    chunks,
    identical_or_foreign,
    object_metadata,
    paths,
    warn_of,
)

METADATA: Final = '.metadata'
PARTS: Final = '.part'
"""The folder of unfinished files, on the file system of the buckets. Neither name is valid for a bucket."""

_REFUSED: Final = {errno.ENAMETOOLONG, errno.ENOTDIR, errno.EISDIR, errno.EINVAL, errno.EFBIG}
_DENIED: Final = {errno.EACCES, errno.EPERM}
_NO_LINKS: Final = {errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS}
_FULL: Final = {errno.ENOSPC, errno.EDQUOT}


class DirectoryStore:
    """Stores objects as files. Several processes may use one folder: ``link(2)`` creates a name only once."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self.pace = Pace()
        """Only counts bytes: a disk needs no cap."""

    def __repr__(self) -> str:
        return f'DirectoryStore({str(self._directory)!r})'

    def open(self) -> None:
        """Nothing to acquire: the first put creates the folder."""

    def close(self) -> None:
        """Nothing to release."""

    def describe(self) -> str:
        return f'the folder {self._directory}'

    def put(self, item: SpooledObject) -> Put:
        check_target(item.bucket, item.key)
        target = self._path(item.bucket, item.key)
        with _translating(self._directory, item.bucket, item.key):
            if not target.exists():
                with _part(self._directory) as part:
                    _write(part, chunks(item))
                    self.pace.count(item.size)
                    if _publish(part, target):
                        self._write_metadata(item)
                        return Put.CREATED
            if target.is_dir():
                raise OSError(errno.EISDIR, 'a folder has this name')
            held = self._info(item.bucket, item.key)
            outcome = identical_or_foreign(item, held, lambda: fingerprint(target)[1])
            if held.sha256 is None:  # a power cut between writing the content and its metadata
                self._write_metadata(item)
            return outcome

    def head(self, bucket: str, key: str) -> ObjectInfo | None:
        with _reading(self._directory, bucket, key):
            return self._info(bucket, key) if self._path(bucket, key).is_file() else None

    def get(self, bucket: str, key: str, max_bytes: int | None = None) -> bytes:
        with _reading(self._directory, bucket, key), self._path(bucket, key).open('rb') as file:
            body = file.read() if max_bytes is None else file.read(max_bytes + 1)
        if max_bytes is not None and len(body) > max_bytes:
            raise too_large(bucket, key, max_bytes)
        return body

    def ranges(self, bucket: str, key: str, spans: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        with _reading(self._directory, bucket, key), self._path(bucket, key).open('rb', buffering=0) as file:
            return [os.pread(file.fileno(), end - start, start) for start, end in spans]

    def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
        with _reading(self._directory, bucket, key):
            info = self._info(bucket, key)
            if version not in {'', info.etag}:
                raise has_changed(bucket, key)
            return Content(info, self._pieces(bucket, key, start))

    def changed(self, bucket: str, key: str, version: str, max_bytes: int) -> tuple[bytes, str] | None:
        body = self.get(bucket, key, max_bytes)
        found = hashlib.sha256(body).hexdigest()
        return None if found == version else (body, found)

    def replace(self, bucket: str, key: str, body: bytes, version: str) -> bool:
        with _reading(self._directory, bucket, key), flock(self._directory / PARTS / 'replace.lock', mode=0o666):
            if hashlib.sha256(self._path(bucket, key).read_bytes()).hexdigest() != version:
                return False
            with _part(self._directory) as part:
                _write(part, iter((body,)))
                metadata_path(self._directory, bucket, key).unlink(missing_ok=True)
                part.replace(self._path(bucket, key))
            sync(self._path(bucket, key).parent)
        return True

    def list(self, bucket: str, prefix: str = '', skipped: Callable[[str, str], None] = warn_of) -> Iterator[ObjectInfo]:
        folder = prefix.rpartition('/')[0]
        with _reading(self._directory, bucket, folder or 'any'):
            found = [(key, seen) for key, seen in _files(self._directory / bucket, folder) if key.startswith(prefix)]
        for key, seen in sorted(found, key=itemgetter(0)):
            modified = datetime.fromtimestamp(seen.st_mtime, timezone.utc)
            yield from paths(
                (ObjectInfo(bucket, key, seen.st_size, None, etag=str(seen.st_mtime_ns), modified=modified),), skipped
            )

    def folders(self, bucket: str, prefix: str = '') -> Sequence[str]:
        below = prefix.rstrip('/')
        with _reading(self._directory, bucket, below or 'any'):
            folder = self._path(bucket, below)
            return (
                sorted(path.name for path in folder.iterdir() if is_path(path.name) and path.is_dir()) if folder.is_dir() else []
            )

    def delete(self, bucket: str, key: str) -> None:
        with _reading(self._directory, bucket, key):
            metadata_path(self._directory, bucket, key).unlink(missing_ok=True)
            self._path(bucket, key).unlink(missing_ok=True)

    def probe(self) -> None:
        """Write and remove a file: raises as a put for a full disk, a missing mount or a read-only one."""
        with _translating(self._directory), _part(self._directory) as part:
            _write(part, iter((b'probe',)))

    def _path(self, bucket: str, key: str) -> Path:
        return self._directory / bucket / key

    def _pieces(self, bucket: str, key: str, start: int) -> Iterator[bytes]:
        with _reading(self._directory, bucket, key), self._path(bucket, key).open('rb', buffering=0) as file:
            file.seek(start)
            while chunk := file.read(CHUNK_BYTES):
                yield chunk

    def _write_metadata(self, item: SpooledObject) -> None:
        record = {'content_type': item.content_type, 'metadata': object_metadata(item)}
        path = metadata_path(self._directory, item.bucket, item.key)
        _make_folders(path.parent)
        with _part(self._directory) as part:
            _write(part, iter((json.dumps(record).encode(),)))
            part.replace(path)
        sync(path.parent)

    def _info(self, bucket: str, key: str) -> ObjectInfo:
        seen = self._path(bucket, key).stat()
        size, etag = seen.st_size, str(seen.st_mtime_ns)
        try:
            record = from_json(metadata_path(self._directory, bucket, key).read_bytes())
            metadata, content_type = dict(record['metadata']), str(record['content_type'])
        except (FileNotFoundError, ValueError, TypeError, LookupError):  # truncated, or written by another program
            return ObjectInfo(bucket, key, size, None, etag=etag)
        return ObjectInfo(bucket, key, size, metadata.get('sha256'), metadata, content_type, etag)


def metadata_path(directory: Path, bucket: str, key: str) -> Path:
    """The file with an object's metadata."""
    return directory / METADATA / bucket / f'{key}.json'


@contextmanager
def _translating(directory: Path, bucket: str = '', key: str = '') -> Iterator[None]:
    """Raise StoreError instead of OSError."""
    try:
        yield
    except OSError as error:
        raise _translated(error, directory, bucket, key) from error


@contextmanager
def _reading(directory: Path, bucket: str, key: str) -> Iterator[None]:
    check_read(bucket, key)
    with _translating(directory, bucket, key):
        try:
            yield
        except FileNotFoundError as error:
            where = f'{bucket}/{key} in {directory}'
            raise ObjectRefused(f'there is no {where}', reason='missing', bucket=bucket, key=key) from error


@contextmanager
def _part(directory: Path) -> Iterator[Path]:
    """The path of an unfinished file, which is removed afterwards."""
    part = directory / PARTS / uuid.uuid4().hex
    part.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield part
    finally:
        part.unlink(missing_ok=True)


def _translated(error: OSError, directory: Path, bucket: str, key: str) -> StoreError:
    """The StoreError for an error of the file system."""
    data: dict[str, Any] = {'bucket': bucket, 'key': key, 'errno': error.errno}
    if error.errno in _FULL:
        return StoreUnavailable(f'no space left in {directory}', remedy='free some space there', **data)
    if error.errno in _DENIED:
        remedy = f'may this user write to {directory}?'
        return AccessDenied(f'no permission for {error.filename or directory}', remedy=remedy, **data)
    if error.errno in _REFUSED and directory.is_dir():
        detail = f'{directory} cannot hold {bucket}/{key}: {error.strerror}'
        return ObjectRefused(detail, reason='name', **data)
    return StoreUnavailable(f'{directory} cannot be used: {error.strerror}', remedy='is the disk mounted and writable?', **data)


def _write(path: Path, content: Iterator[bytes]) -> None:
    """Write a new file and sync it."""
    with path.open('xb') as file:
        for chunk in content:
            file.write(chunk)
        file.flush()
        os.fsync(file.fileno())


def _publish(part: Path, target: Path) -> bool:
    """Durably give a complete file its final name; False if the name is taken, which a rename would overwrite."""
    _make_folders(target.parent)
    try:
        os.link(part, target)
    except FileExistsError:
        return False
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        if not _rename_locked(part, target):
            return False
    sync(target.parent)
    return True


def _rename_locked(part: Path, target: Path) -> bool:
    """The same on file systems without links, such as exFAT: under a lock, check that the name is free, then rename."""
    with flock(part.with_name('rename.lock'), mode=0o666):
        if target.exists():
            return False
        part.rename(target)
        return True


def _make_folders(folder: Path) -> None:
    """Durably create a folder and its parents."""
    missing = [folder]
    while not missing[-1].parent.exists():
        missing.append(missing[-1].parent)
    for path in reversed(missing):
        try:
            path.mkdir()
        except FileExistsError:
            if not path.is_dir():
                raise OSError(errno.ENOTDIR, 'a part of the key is an object') from None
        else:
            sync(path.parent)


def _files(root: Path, below: str) -> Iterator[tuple[str, os.stat_result]]:
    """The key and status of each file below a folder of a bucket, in any order; none if the bucket is missing."""
    if not (root / below).is_dir():
        return
    for folder, _, names in os.walk(root / below, onerror=_raise):
        prefix = Path(folder).relative_to(root)
        for name in names:
            with suppress(FileNotFoundError):  # deleted in the meantime
                yield str(prefix / name), Path(folder, name).stat()


def _raise(error: OSError) -> None:
    raise error
