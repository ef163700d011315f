"""Downloads objects of a store to files: in bounded memory, verified, resumed, and named only when whole."""

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
from shadowhound_data_logger.core.retry import steadily
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.content import CHUNK_BYTES

UNFINISHED: Final = '.part'
TRIES: Final = 6
"""Until a download fails: one of an hour may meet more gaps in a WiFi than one request."""

_Found = TypeVar('_Found')


@dataclass(frozen=True, slots=True)
class Downloaded:
    """What is there now."""

    info: ObjectInfo
    sha256: str
    """Of the file."""
    is_proved: bool
    """Whether anybody said which it has to be."""


def download(
    store: ObjectStore, wanted: ObjectInfo, path: Path, *, part: Path | None = None, is_synced: bool = True,
    tell: Callable[[int], None] = lambda _: None, pause: Callable[[float], object] = time.sleep,
) -> Downloaded:  # fmt: skip
    """The object as ``path``, of the wanted size and SHA-256, else of the one that its metadata name.

    What arrives lies in ``part`` (``<path>.part``), which the next call continues. ``tell`` is called with the bytes that each
    piece adds, negative where they are thrown away; what it raises ends the download. What is damaged, or changes on its
    way, is fetched once more.
    Raises StoreUnavailable where it broke off after some tries, ObjectRefused where there is none or it is not what it has to
    be (``data['reason'] == 'damaged'``, ``data['why']`` says how), OSError of the file.
    """
    part = part or path.with_name(f'{path.name}{UNFINISHED}')
    try:
        with _opened(part) as file:
            transfer = _Transfer(store, wanted, file, tell)
            found = twice(lambda: steadily(transfer.complete, tries=TRIES, pause=pause))
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


def twice(fetch: Callable[[], _Found]) -> _Found:
    """What was fetched, the second time where it was damaged: on its way, or by a power cut before it was synced."""
    try:
        return fetch()
    except ObjectRefused as error:
        if error.data.get('reason') != 'damaged':
            raise
    return fetch()


def damaged(bucket: str, key: str, why: str, **data: Any) -> ObjectRefused:
    """The error for content that is not what was stored."""
    return ObjectRefused(f'the content of {bucket}/{key} does not match its metadata', remedy='was it damaged in the store?',
                         reason='damaged', why=why, bucket=bucket, key=key, **data)  # fmt: skip


class _Transfer:
    """What is there of one object already, and the rest of it on its way. One thread."""

    def __init__(self, store: ObjectStore, wanted: ObjectInfo, file: IO[bytes], tell: Callable[[int], None]) -> None:
        self._store = store
        self._wanted = wanted
        self._file = file
        self._tell = tell
        self._version = ''  # an ETag, once the store told one
        self._digest = hashlib.sha256()
        self._size = 0
        if file.tell():  # which was opened at its end
            file.seek(0)
            while chunk := file.read(CHUNK_BYTES):
                self._digest.update(chunk)
                self._size += len(chunk)

    def complete(self) -> Downloaded:
        """One try: add what is missing, and judge the whole. What is damaged is thrown away."""
        wanted = self._wanted
        try:
            found = self._store.content(wanted.bucket, wanted.key, self._size, self._version)
        except ObjectRefused as error:
            if error.data.get('reason') != 'changed':
                raise
            raise self._damaged('it changed while it was fetched') from error
        with found as content:
            info = content.info
            self._version = info.etag
            if info.size != wanted.size:  # before a byte of it takes room
                raise self._damaged(f'it has {info.size} bytes instead of {wanted.size}')
            if self._size < info.size:
                self._add(content.pieces)
        if self._size > info.size:  # of another object, or of none of ours
            raise self._damaged(f'it has {self._size} bytes instead of {info.size}')
        if self._size < info.size:
            text = f'{wanted.bucket}/{wanted.key} ended after {self._size} of {info.size} bytes'
            raise StoreUnavailable(text, bucket=wanted.bucket, key=wanted.key)
        sha256, expected = self._digest.hexdigest(), wanted.sha256 or info.sha256
        if expected is not None and sha256 != expected:
            raise self._damaged(f'its SHA-256 is {sha256[:12]}... instead of {expected[:12]}...', sha256=sha256)
        return Downloaded(info, sha256, expected is not None)

    def _add(self, pieces: Any) -> None:
        most = self._wanted.size
        for piece in pieces:
            if self._size + len(piece) > most:
                raise self._damaged(f'it has more than {most} bytes')
            self._file.write(piece)
            self._digest.update(piece)
            self._size += len(piece)
            self._tell(len(piece))

    def _damaged(self, why: str, **data: str) -> ObjectRefused:
        self._tell(-self._size)
        self._file.truncate(0)
        self._digest, self._size, self._version = hashlib.sha256(), 0, ''
        return damaged(self._wanted.bucket, self._wanted.key, why, **data)
