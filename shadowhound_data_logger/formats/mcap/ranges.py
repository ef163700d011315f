"""Reads byte ranges of files on the disk or in a store, and counts requests and bytes."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import Protocol

from shadowhound_data_logger.core.errors import BagDamaged
from shadowhound_data_logger.core.untrusted import MAX_DOCUMENT_BYTES, check_size
from shadowhound_data_logger.stores.base import ObjectStore


class Ranged(Protocol):
    """A file of ``size`` bytes that is read by range."""

    @property
    def name(self) -> str:
        """For messages."""

    @property
    def size(self) -> int: ...

    def read(self, start: int, length: int) -> bytes:
        """Exactly these bytes. Raises BagDamaged if the file does not have them, StoreError if the store cannot be read."""


class Meter:
    """Counts requests and bytes, from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.bytes = 0
        self.requests = 0

    def add(self, count: int) -> None:
        with self._lock:
            self.bytes += count
            self.requests += 1


class LocalFile:
    """A file on the disk. Raises BagDamaged if it cannot be opened."""

    def __init__(self, path: Path, meter: Meter | None = None) -> None:
        self.path = path
        self._meter = meter or Meter()
        try:
            self.size = path.stat().st_size
        except OSError as error:
            raise BagDamaged(f'{path} cannot be read: {error.strerror}', path=str(path)) from error

    @property
    def name(self) -> str:
        return str(self.path)

    def read(self, start: int, length: int) -> bytes:
        try:
            with self.path.open('rb', buffering=0) as file:
                found = os.pread(file.fileno(), length, start)
        except OSError as error:
            raise BagDamaged(f'{self.path} cannot be read: {error.strerror}', path=str(self.path)) from error
        self._meter.add(len(found))
        return check_length(found, length, self.name, start)


class StoredFile:
    """An object in a store, whose size is already known."""

    def __init__(self, store: ObjectStore, bucket: str, key: str, size: int, meter: Meter | None = None) -> None:
        self.size = size
        self._store = store
        self._bucket = bucket
        self._key = key
        self._meter = meter or Meter()

    @property
    def name(self) -> str:
        return f'{self._bucket}/{self._key}'

    def read(self, start: int, length: int) -> bytes:
        if length <= 0:
            return b''
        (found,) = self._store.ranges(self._bucket, self._key, [(start, start + length)])
        self._meter.add(len(found))
        return check_length(found, length, self.name, start)


def read_whole(source: Ranged) -> bytes:
    """The content of a manifest or metadata.yaml. Raises BagDamaged before reading a file that is too large for one."""
    check_document(source.name, source.size)
    return source.read(0, source.size)


def check_document(name: str, size: int) -> None:
    """Raises BagDamaged if a file is too large for a manifest or metadata.yaml."""
    try:
        check_size(size, MAX_DOCUMENT_BYTES)
    except ValueError as error:
        raise BagDamaged(f'{name} is neither a manifest nor metadata: {error}', path=name) from error


def check_length(found: bytes, length: int, name: str, start: int) -> bytes:
    """The bytes, if their number is that requested; otherwise raises BagDamaged."""
    if len(found) != length:
        raise BagDamaged(f'{name} is truncated: it has {len(found)} of {length} bytes at {start}', path=name)
    return found
