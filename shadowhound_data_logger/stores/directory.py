"""A folder laid out as a bucket store: ``<folder>/<bucket>/<key>``, every object whole, durable and never overwritten.

What S3 keeps as metadata lies beside the buckets in ``<folder>/.metadata/<bucket>/<key>.json``: unlike extended attributes it
survives ``cp``, ``tar`` and any file system, and unlike a file beside the object it is no object to ``aws s3 sync`` or a glob.
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
from shadowhound_data_logger.stores.base import Content, changed_meanwhile, too_large
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
"""Unfinished files, on the same file system as the buckets; both names are impossible for a bucket."""

_REFUSED: Final = {errno.ENAMETOOLONG, errno.ENOTDIR, errno.EISDIR, errno.EINVAL, errno.EFBIG}
_DENIED: Final = {errno.EACCES, errno.EPERM}
_NO_LINKS: Final = {errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS}
_FULL: Final = {errno.ENOSPC, errno.EDQUOT}


class DirectoryStore:
    """Stores objects as files. Several processes may use one folder: ``link(2)`` decides who was first."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self.pace = Pace()
        """It only counts: a disk is not a radio."""

    def __repr__(self) -> str:
        return f'DirectoryStore({str(self._directory)!r})'

    def open(self) -> None:
        """Nothing to acquire: the folder is made by the first put."""

    def close(self) -> None:
        """Nothing to release."""

    def describe(self) -> str:
        return f'the folder {self._directory}'

    def put(self, item: SpooledObject) -> Put:
        check_target(item.bucket, item.key)
        target = self._path(item.bucket, item.key)
        with self._touching(item.bucket, item.key):
            if not target.exists():
                with self._part() as part:
                    _write(part, chunks(item))
                    self.pace.count(item.size)
                    if _appear(part, target):
                        self._write_metadata(item)
                        return Put.CREATED
            if target.is_dir():
                raise OSError(errno.EISDIR, 'a folder has this name')
            held = self._info(item.bucket, item.key)
            end = identical_or_foreign(item, held, lambda: fingerprint(target)[1])
            if held.sha256 is None:  # power was cut between the content and its metadata
                self._write_metadata(item)
            return end

    def head(self, bucket: str, key: str) -> ObjectInfo | None:
        with self._reading(bucket, key):
            return self._info(bucket, key) if self._path(bucket, key).is_file() else None

    def get(self, bucket: str, key: str, most: int | None = None) -> bytes:
        with self._reading(bucket, key), self._path(bucket, key).open('rb') as file:
            body = file.read() if most is None else file.read(most + 1)
        if most is not None and len(body) > most:
            raise too_large(bucket, key, most)
        return body

    def ranges(self, bucket: str, key: str, spans: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        with self._reading(bucket, key), self._path(bucket, key).open('rb', buffering=0) as file:
            return [os.pread(file.fileno(), end - start, start) for start, end in spans]

    def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
        with self._reading(bucket, key):
            info = self._info(bucket, key)
            if version not in {'', info.etag}:
                raise changed_meanwhile(bucket, key)
            return Content(info, self._pieces(bucket, key, start))

    def changed(self, bucket: str, key: str, version: str, most: int) -> tuple[bytes, str] | None:
        body = self.get(bucket, key, most)
        found = hashlib.sha256(body).hexdigest()
        return None if found == version else (body, found)

    def replace(self, bucket: str, key: str, body: bytes, version: str) -> bool:
        with self._reading(bucket, key), flock(self._directory / PARTS / 'replace.lock', mode=0o666):
            if hashlib.sha256(self._path(bucket, key).read_bytes()).hexdigest() != version:
                return False
            with self._part() as part:
                _write(part, iter((body,)))
                self._beside(bucket, key).unlink(missing_ok=True)
                part.replace(self._path(bucket, key))
            sync(self._path(bucket, key).parent)
        return True

    def list(self, bucket: str, prefix: str = '', skipped: Callable[[str, str], None] = warn_of) -> Iterator[ObjectInfo]:
        folder = prefix.rpartition('/')[0]
        with self._reading(bucket, folder or 'any'):
            found = [(key, seen) for key, seen in _files(self._directory / bucket, folder) if key.startswith(prefix)]
        for key, seen in sorted(found, key=itemgetter(0)):
            modified = datetime.fromtimestamp(seen.st_mtime, timezone.utc)
            yield from paths(
                (ObjectInfo(bucket, key, seen.st_size, None, etag=str(seen.st_mtime_ns), modified=modified),), skipped
            )

    def folders(self, bucket: str, prefix: str = '') -> Sequence[str]:
        below = prefix.rstrip('/')
        with self._reading(bucket, below or 'any'):
            folder = self._path(bucket, below)
            return (
                sorted(path.name for path in folder.iterdir() if is_path(path.name) and path.is_dir()) if folder.is_dir() else []
            )

    def delete(self, bucket: str, key: str) -> None:
        with self._reading(bucket, key):
            self._beside(bucket, key).unlink(missing_ok=True)
            self._path(bucket, key).unlink(missing_ok=True)

    def probe(self) -> None:
        """Writes and removes a file: a full disk, a missing mount or a read-only one shows here as it does in a put."""
        with self._touching(), self._part() as part:
            _write(part, iter((b'probe',)))

    def _path(self, bucket: str, key: str) -> Path:
        return self._directory / bucket / key

    @contextmanager
    def _touching(self, bucket: str = '', key: str = '') -> Iterator[None]:
        """Nothing but a StoreError leaves."""
        try:
            yield
        except OSError as error:
            raise _translated(error, self._directory, bucket, key) from error

    @contextmanager
    def _reading(self, bucket: str, key: str) -> Iterator[None]:
        check_read(bucket, key)
        with self._touching(bucket, key):
            try:
                yield
            except FileNotFoundError as error:
                where = f'{bucket}/{key} in {self._directory}'
                raise ObjectRefused(f'there is no {where}', reason='missing', bucket=bucket, key=key) from error

    def _pieces(self, bucket: str, key: str, start: int) -> Iterator[bytes]:
        with self._reading(bucket, key), self._path(bucket, key).open('rb', buffering=0) as file:
            file.seek(start)
            while chunk := file.read(CHUNK_BYTES):
                yield chunk

    @contextmanager
    def _part(self) -> Iterator[Path]:
        """A name for an unfinished file, which is gone afterwards."""
        part = self._directory / PARTS / uuid.uuid4().hex
        part.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield part
        finally:
            part.unlink(missing_ok=True)

    def _write_metadata(self, item: SpooledObject) -> None:
        record = {'content_type': item.content_type, 'metadata': object_metadata(item)}
        beside = self._beside(item.bucket, item.key)
        _make_folders(beside.parent)
        with self._part() as part:
            _write(part, iter((json.dumps(record).encode(),)))
            part.replace(beside)
        sync(beside.parent)

    def _info(self, bucket: str, key: str) -> ObjectInfo:
        seen = self._path(bucket, key).stat()
        size, etag = seen.st_size, str(seen.st_mtime_ns)
        try:
            record = from_json(self._beside(bucket, key).read_bytes())
            metadata, content_type = dict(record['metadata']), str(record['content_type'])
        except (FileNotFoundError, ValueError, TypeError, LookupError):  # cut short, or written by anybody
            return ObjectInfo(bucket, key, size, None, etag=etag)
        return ObjectInfo(bucket, key, size, metadata.get('sha256'), metadata, content_type, etag)

    def _beside(self, bucket: str, key: str) -> Path:
        return self._directory / METADATA / bucket / f'{key}.json'


def _translated(error: OSError, directory: Path, bucket: str, key: str) -> StoreError:
    """What an error of the file system means for delivery."""
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
    """A new file with this content, on the disk before it returns."""
    with path.open('xb') as file:
        for chunk in content:
            file.write(chunk)
        file.flush()
        os.fsync(file.fileno())


def _appear(part: Path, target: Path) -> bool:
    """Give the whole file its final name for good; False when the name is taken (a bare rename would overwrite it)."""
    _make_folders(target.parent)
    try:
        os.link(part, target)
    except FileExistsError:
        return False
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        if not _rename_alone(part, target):
            return False
    sync(target.parent)
    return True


def _rename_alone(part: Path, target: Path) -> bool:
    """``link`` for exFAT and its kind, which have none: one process at a time looks, then renames."""
    with flock(part.with_name('rename.lock'), mode=0o666):
        if target.exists():
            return False
        part.rename(target)
        return True


def _make_folders(folder: Path) -> None:
    """The folder and its parents, each new one's name on the disk."""
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
    """Key and facts of each file of a bucket under a folder, in no order; none when there is no such bucket."""
    if not (root / below).is_dir():
        return
    for folder, _, names in os.walk(root / below, onerror=_raise):
        prefix = Path(folder).relative_to(root)
        for name in names:
            with suppress(FileNotFoundError):  # deleted meanwhile
                yield str(prefix / name), Path(folder, name).stat()


def _raise(error: OSError) -> None:
    raise error
