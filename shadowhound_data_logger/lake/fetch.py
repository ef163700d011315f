"""Downloads objects into a folder: in parallel, each verified by its SHA-256; a file is complete or absent, and is moved once.

It can be killed at any moment and continues there. The path of a file is its key: ``DIR/thor/camera/20261121/120000_front.jpg``.
"""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from queue import SimpleQueue
from typing import Final

from shadowhound_data_logger.core.durable_files import fingerprint
from shadowhound_data_logger.core.errors import AccessDenied, BucketMissing, LakeError, ObjectRefused, StoreUnavailable
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.core.retry import steadily
from shadowhound_data_logger.core.untrusted import is_path
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.fetched import FOLDER, UNWRITABLE, Fetched, Verified
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.download import download

THREADS: Final = 16
AHEAD: Final = 8
"""Objects queued per thread: enough to keep it busy, few enough to stop promptly on an interrupt."""
NOTE_S: Final = 1.0
"""At most so much is hashed again after a kill."""
_NO_DISK: Final = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO}
AWAY: Final = 8
"""Consecutive objects for which the store does not answer: it is unreachable, and the others are not tried."""


@dataclass(frozen=True, slots=True)
class FetchRequest:
    """An object that must be in the folder."""

    bucket: str
    key: str
    size: int
    sha256: str | None = None
    """From its row; None: that of the object's metadata."""
    etag: str = ''
    """From a listing."""


@dataclass(slots=True)
class FetchResult:
    """The outcome of the requests so far: each is in one of the first three."""

    moved: int = 0
    present: int = 0
    """They were complete already."""
    failed: dict[str, str] = field(default_factory=dict)
    """``bucket/key`` -> why."""
    bytes: int = 0
    """Of the objects that were moved."""
    unverified: int = 0
    """Moved objects whose SHA-256 is unknown: only their sizes were compared."""


@dataclass(frozen=True, slots=True)
class _Done:
    file: Verified
    moved: bool
    proved: bool


def under(source: Bucket, prefix: str) -> list[FetchRequest]:
    """All objects whose keys start with the prefix, also those whose keys are not paths. Raises StoreError."""
    odd: list[FetchRequest] = []
    found = source.list(prefix, lambda bucket, key: odd.append(FetchRequest(bucket, key, 0)))
    return [*(FetchRequest(source.name, entry.key, entry.size, etag=entry.etag) for entry in found), *odd]


def fetch(
    wishes: Sequence[FetchRequest], folder: Path, store: ObjectStore, *, verify: bool = False, threads: int = THREADS,
    tell: Callable[[int, int], None] = lambda _bytes, _objects: None,
) -> FetchResult:  # fmt: skip
    """Download them; ``verify`` also reads the files that are there already. ``tell`` is called with the result, from any thread.

    Raises StoreError if the store rejects all requests or is unreachable, LakeError if the folder cannot be written.
    """
    with Fetched(folder) as fetched, ThreadPoolExecutor(threads, 'fetch') as pool:
        return _Fetch(fetched, store, tell, verify=verify).run(wishes, pool, threads * AHEAD)


class _Fetch:
    """One run. The calling thread decides and records; the pool downloads."""

    def __init__(self, fetched: Fetched, store: ObjectStore, tell: Callable[[int, int], None], *,
                 verify: bool) -> None:  # fmt: skip
        self._fetched = fetched
        self._store = store
        self._tell = tell
        self._verify = verify
        self._numbers = count()
        self._over = threading.Event()
        self._fresh: list[Verified] = []
        self._noted_s = time.monotonic()
        self._silent = 0
        self.result = FetchResult()

    def run(self, wishes: Sequence[FetchRequest], pool: ThreadPoolExecutor, ahead: int) -> FetchResult:
        done: SimpleQueue[tuple[FetchRequest, Future[_Done]]] = SimpleQueue()
        under_way = 0
        try:
            for wish in self._wanting(wishes):
                pool.submit(self._download, wish).add_done_callback(lambda future, wish=wish: done.put((wish, future)))  # type: ignore[misc]
                under_way += 1
                while under_way >= ahead:
                    self._settle(*done.get())
                    under_way -= 1
            for _ in range(under_way):
                self._settle(*done.get())
        finally:
            self._over.set()
            pool.shutdown(cancel_futures=True)
            self._note()
        return self.result

    def _wanting(self, wishes: Sequence[FetchRequest]) -> Iterator[FetchRequest]:
        """Those that are not known to be in the folder."""
        seen: set[str] = set()
        for wish in dict.fromkeys(wishes):  # the rows of repeats name one object
            if (refusal := _refusal(wish)) or wish.key in seen:
                self._fail(wish, refusal or 'another bucket has the same key: fetch it elsewhere')
                continue
            seen.add(wish.key)
            known = None if self._verify else self._fetched.verified(wish.key)
            if known is not None and _is(known, wish):
                self.result.present += 1
                self._tell(wish.size, 1)
            else:
                yield wish

    def _settle(self, wish: FetchRequest, future: Future[_Done]) -> None:
        """Count one. Raises errors that concern all of them."""
        try:
            self._count(future.result())
        except (ObjectRefused, AccessDenied, BucketMissing) as error:
            self._fail(wish, error.data.get('why') or str(error))
        except StoreUnavailable as error:
            self._silent += 1
            if self._silent >= AWAY:
                raise
            self._fail(wish, str(error))
        except OSError as error:
            if error.errno in _NO_DISK:
                raise LakeError(f'{self._fetched.folder} cannot be written: {error.strerror}', remedy=UNWRITABLE) from error
            self._fail(wish, error.strerror or type(error).__name__)
        if time.monotonic() - self._noted_s > NOTE_S:
            self._note()

    def _fail(self, wish: FetchRequest, why: str) -> None:
        self.result.failed[f'{wish.bucket}/{wish.key}'] = why

    def _count(self, done: _Done) -> None:
        self._silent = 0
        if done.proved:
            self._fresh.append(done.file)
        else:
            self.result.unverified += 1
        if done.moved:
            self.result.moved += 1
            self.result.bytes += done.file.size
        else:
            self.result.present += 1

    def _note(self) -> None:
        self._fetched.note(self._fresh)
        self._fresh = []
        self._noted_s = time.monotonic()

    # -- on the threads of the pool --------------------------------------------------------------------------------

    def _download(self, wish: FetchRequest) -> _Done:
        path = self._fetched.path(wish.key)
        held = self._held(wish, path)
        if held is None:
            return self._move(wish, path)
        self._tell(wish.size, 1)
        return held

    def _held(self, wish: FetchRequest, path: Path) -> _Done | None:
        """The file that is there already, if its content is the object's: from a run that was killed, or from another program."""
        if not path.is_file() or path.stat().st_size != wish.size:
            return None
        info = None if wish.sha256 else steadily(lambda: self._store.head(wish.bucket, wish.key), pause=self._pause)
        expected = wish.sha256 or (info and info.sha256)
        seen = path.stat()
        if expected is None or fingerprint(path)[1] != expected:
            return None
        return _Done(Verified(wish.key, wish.bucket, wish.size, seen.st_mtime_ns, expected, wish.etag), moved=False, proved=True)

    def _move(self, wish: FetchRequest, path: Path) -> _Done:
        part = self._fetched.parts / str(next(self._numbers))
        moved = 0

        def tell(size: int) -> None:
            nonlocal moved
            if self._over.is_set():
                raise LakeError('the fetch was broken off')
            moved += size
            self._tell(size, 0)

        try:
            wanted = ObjectInfo(wish.bucket, wish.key, wish.size, wish.sha256)
            found = download(self._store, wanted, path, part=part, is_synced=False, on_progress=tell, pause=self._pause)
        except BaseException:
            self._tell(-moved, 0)
            part.unlink(missing_ok=True)
            raise
        self._tell(0, 1)
        file = Verified(wish.key, wish.bucket, wish.size, path.stat().st_mtime_ns, found.sha256, wish.etag)
        return _Done(file, moved=True, proved=found.is_verified)

    def _pause(self, seconds: float) -> None:
        """Wait between two tries. Raises LakeError if the run has ended."""
        if self._over.wait(seconds):
            raise LakeError('the fetch was broken off')


def _refusal(wish: FetchRequest) -> str:
    """Why an object cannot be a file below the folder; empty if it can. The bucket may contain hostile keys."""
    if not is_path(wish.key):
        return 'its key is not a path'
    return 'its key is ours' if wish.key.split('/', maxsplit=1)[0] == FOLDER else ''


def _is(known: Verified, wish: FetchRequest) -> bool:
    """Whether a file that matches its record is the requested object."""
    same = (known.bucket, known.size) == (wish.bucket, wish.size)
    if wish.sha256 is not None:
        return same and known.sha256 == wish.sha256
    return same and (not wish.etag or not known.etag or known.etag == wish.etag)
