"""The contents of objects for one process that reads a dataset: prefetched by a few threads, verified, in bounded memory."""

from __future__ import annotations

import hashlib
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final

from shadowhound_data_logger.core.errors import LakeError, NameRefused, ObjectRefused
from shadowhound_data_logger.core.options import StoreSettings, UploadSettings
from shadowhound_data_logger.core.retry import with_retries
from shadowhound_data_logger.core.untrusted import MAX_OBJECT_BYTES, path_below
from shadowhound_data_logger.lake.track import Object
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.download import damaged, retry_damaged

if TYPE_CHECKING:
    from pathlib import Path

    from typing_extensions import Self

_PATIENT: Final = UploadSettings(threads=32, connect_timeout_s=10.0, read_timeout_s=60.0)
"""The timeouts of all other readers (stores/s3_obstore.py), and connections for several datasets in one process."""
_locks: Final[dict[int, threading.Lock]] = {}
"""Process id -> lock."""
Read = Callable[[str, str, int], bytes]
"""Bucket, key and size -> content."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where contents are read from: a store, or a folder of fetched objects. A value that can be sent to another process."""

    settings: StoreSettings
    folder: Path | None = None
    """Fetched objects, as ``DIR/KEY``; if set, the store is not used."""

    def read(self, bucket: str, key: str, limit: int) -> bytes:
        """Return an object's content. Raises StoreError, and ObjectRefused for more than ``limit`` bytes."""
        if self.folder is None:
            store = _of_this_process(self.settings)
            return with_retries(lambda: store.get(bucket, key, limit))
        where: dict[str, Any] = {'bucket': bucket, 'key': key}
        try:
            path = path_below(self.folder, key)
            with path.open('rb') as file:
                body = file.read(limit + 1)
        except NameRefused as error:
            raise ObjectRefused(str(error), reason='name', **where) from error
        except OSError as error:
            raise ObjectRefused(f'{path} cannot be read: {error.strerror}', reason='missing', **where) from error
        if len(body) > limit:
            raise ObjectRefused(f'{path} has more than {limit:,} bytes', reason='size', **where)
        return body


class Prefetch:
    """Fetches contents in advance, in a few threads, and caches up to ``keep_bytes`` of those that it returned.

    Lifecycle: New; ``ahead`` and ``get`` on one thread; close. The first ``ahead`` starts the threads, which only read.
    Everything else runs on the caller's thread, so no lock is needed.
    """

    def __init__(self, read: Read, keep_bytes: int, threads: int) -> None:
        self._read = read
        self._keep_bytes = keep_bytes
        self._threads = threads
        self._pool: ThreadPoolExecutor | None = None
        self._waiting: dict[tuple[str, str], Future[bytes]] = {}
        self._kept: OrderedDict[tuple[str, str], bytes] = OrderedDict()
        self._held_bytes = 0
        self.waiting_bytes = 0
        """Bytes of objects that were prefetched and not returned yet."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Wait for running requests; idempotent."""
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown(cancel_futures=True)
        self._waiting.clear()

    def ahead(self, objects: Iterable[Object]) -> None:
        """Start fetching these; call ``discard`` when they are no longer needed."""
        for each in objects:
            name = (each.bucket, each.key)
            if name not in self._kept and name not in self._waiting:
                if self._pool is None:
                    self._pool = ThreadPoolExecutor(self._threads, 'dataset')
                self._waiting[name] = self._pool.submit(self._verified, each)
                self.waiting_bytes += each.size

    def get(self, wanted: Object) -> bytes:
        """Return the content. Raises StoreError, and LakeError for damaged content."""
        name = (wanted.bucket, wanted.key)
        if (body := self._kept.get(name)) is not None:
            self._kept.move_to_end(name)
            return body
        body = self._awaited(wanted) if name in self._waiting else self._verified(wanted)
        self._keep(name, body)
        return body

    def discard(self, objects: Iterable[Object]) -> None:
        """Discard those of these that were fetched but not used."""
        for each in objects:
            waiting = self._waiting.pop((each.bucket, each.key), None)
            if waiting is not None:
                waiting.cancel()
                self.waiting_bytes -= each.size

    def _awaited(self, wanted: Object) -> bytes:
        waiting = self._waiting.pop((wanted.bucket, wanted.key))
        self.waiting_bytes -= wanted.size
        return waiting.result()

    def _keep(self, name: tuple[str, str], body: bytes) -> None:
        self._kept[name] = body
        self._held_bytes += len(body)
        while self._held_bytes > self._keep_bytes and len(self._kept) > 1:
            self._held_bytes -= len(self._kept.popitem(last=False)[1])

    def _verified(self, wanted: Object) -> bytes:
        if not 0 < wanted.size <= MAX_OBJECT_BYTES:
            text = f'{wanted.bucket}/{wanted.key} has {wanted.size:,} bytes, allowed are up to {MAX_OBJECT_BYTES:,}'
            raise LakeError(text, bucket=wanted.bucket, key=wanted.key)

        def once() -> bytes:
            body = self._read(wanted.bucket, wanted.key, wanted.size)
            if not wanted.sha256 or hashlib.sha256(body).hexdigest() == wanted.sha256:
                return body
            raise damaged(wanted.bucket, wanted.key, 'its SHA-256 differs')

        try:
            return retry_damaged(once)
        except ObjectRefused as error:
            if error.data.get('reason') != 'damaged':
                raise
            text = f'the content of {wanted.bucket}/{wanted.key} is damaged: its SHA-256 differs'
            raise LakeError(text, bucket=wanted.bucket, key=wanted.key) from error


def _of_this_process(settings: StoreSettings) -> ObjectStore:
    """The store of this process: a forked process must not use its parent's threads, connections and locks."""
    process = os.getpid()
    with _locks.setdefault(process, threading.Lock()):  # otherwise each thread would open a store (half a second, megabytes)
        return _opened(settings, process)


@lru_cache(maxsize=4)
def _opened(settings: StoreSettings, _process: int) -> ObjectStore:
    return open_store(settings, _PATIENT)
