"""Downloads objects to files: in bounded memory, verified, resumable, and renamed only when complete."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final, TypeVar

from shadowhound_data_logger.core.errors import ObjectRefused, StoreUnavailable
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.core.retry import with_retries
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.content import CHUNK_BYTES

UNFINISHED: Final = '.part'
TRIES: Final = 6
"""After which a download fails: one that takes an hour may meet more WiFi dropouts than a single request."""

_Found = TypeVar('_Found')


@dataclass(frozen=True, slots=True)
class Downloaded:
    """A complete download."""

    info: ObjectInfo
    sha256: str
    """Of the file."""
    is_verified: bool
    """Whether the expected SHA-256 was known."""


def download(
    store: ObjectStore, wanted: ObjectInfo, path: Path, *, part: Path | None = None, is_synced: bool = True,
    on_progress: Callable[[int], None] = lambda _: None, pause: Callable[[float], object] = time.sleep,
) -> Downloaded:  # fmt: skip
    """Download an object to ``path`` and verify its size and SHA-256, which is that of ``wanted`` or of the object's metadata.

    Received bytes are written to ``part`` (``<path>.part``), which the next call continues. ``on_progress`` is called with the
    number of bytes added, negative if they are discarded; an exception that it raises ends the download. Content that is damaged,
    or that changes during the download, is downloaded once more.
    Raises StoreUnavailable if the connection broke in all tries, ObjectRefused if the object does not exist or does not match
    (``data['reason'] == 'damaged'``, ``data['why']``), OSError for the file.
    """
    part = part or path.with_name(f'{path.name}{UNFINISHED}')
    try:
        with _opened(part) as file:
            transfer = _Transfer(store, wanted, file, on_progress)
            found = retry_damaged(lambda: with_retries(transfer.complete, tries=TRIES, pause=pause))
            if is_synced:
                os.fsync(file.fileno())
    except ObjectRefused as error:
        if error.data.get('reason') == 'damaged':
            part.unlink()
        raise
    try:
        part.replace(path)
    except FileNotFoundError:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.replace(path)
    return found


def _opened(part: Path) -> IO[bytes]:
    try:
        return part.open('ab+', buffering=0)
    except FileNotFoundError:
        part.parent.mkdir(parents=True, exist_ok=True)
        return part.open('ab+', buffering=0)


def retry_damaged(fetch: Callable[[], _Found]) -> _Found:
    """Call ``fetch``, once more if the content was damaged: in transit, or by a power cut before it was synced."""
    try:
        return fetch()
    except ObjectRefused as error:
        if error.data.get('reason') != 'damaged':
            raise
    return fetch()


def damaged(bucket: str, key: str, why: str, **data: Any) -> ObjectRefused:
    """The error for content that does not match its size or checksum."""
    return ObjectRefused(f'the content of {bucket}/{key} does not match its metadata', remedy='was it damaged in the store?',
                         reason='damaged', why=why, bucket=bucket, key=key, **data)  # fmt: skip


class _Transfer:
    """The download of one object, which continues with the bytes that the file already has. One thread."""

    def __init__(self, store: ObjectStore, wanted: ObjectInfo, file: IO[bytes], on_progress: Callable[[int], None]) -> None:
        self._store = store
        self._wanted = wanted
        self._file = file
        self._on_progress = on_progress
        self._version = ''  # the ETag, once it is known
        self._digest = hashlib.sha256()
        self._size = 0
        if file.tell():  # it was opened at its end
            file.seek(0)
            while chunk := file.read(CHUNK_BYTES):
                self._digest.update(chunk)
                self._size += len(chunk)

    def complete(self) -> Downloaded:
        """One try: download the rest and verify the whole; discards damaged content."""
        wanted = self._wanted
        try:
            found = self._store.content(wanted.bucket, wanted.key, self._size, self._version)
        except ObjectRefused as error:
            if error.data.get('reason') != 'changed':
                raise
            raise self._damaged('it changed during the download') from error
        with found as content:
            info = content.info
            self._version = info.etag
            if info.size != wanted.size:  # checked before anything is written
                raise self._damaged(f'it has {info.size} bytes instead of {wanted.size}')
            if self._size < info.size:
                self._add(content.pieces)
        if self._size > info.size:  # the part file is another object's
            raise self._damaged(f'it has {self._size} bytes instead of {info.size}')
        if self._size < info.size:
            text = f'{wanted.bucket}/{wanted.key} ended after {self._size} of {info.size} bytes'
            raise StoreUnavailable(text, bucket=wanted.bucket, key=wanted.key)
        sha256, expected = self._digest.hexdigest(), wanted.sha256 or info.sha256
        if expected is not None and sha256 != expected:
            raise self._damaged(f'its SHA-256 is {sha256[:12]}... instead of {expected[:12]}...', sha256=sha256)
        return Downloaded(info, sha256, expected is not None)

    def _add(self, pieces: Any) -> None:
        size = self._wanted.size
        for piece in pieces:
            if self._size + len(piece) > size:
                raise self._damaged(f'it has more than {size} bytes')
            self._file.write(piece)
            self._digest.update(piece)
            self._size += len(piece)
            self._on_progress(len(piece))

    def _damaged(self, why: str, **data: str) -> ObjectRefused:
        self._on_progress(-self._size)
        self._file.truncate(0)
        self._digest, self._size, self._version = hashlib.sha256(), 0, ''
        return damaged(self._wanted.bucket, self._wanted.key, why, **data)
