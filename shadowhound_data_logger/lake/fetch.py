"""Downloads objects into a folder in parallel, each verified by its SHA-256. A file is complete or absent.

It can be killed at any moment; the next run continues. The path of a file is its key:
``DIR/thor/camera/20261121/120000_front.jpg``.
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
from shadowhound_data_logger.core.retry import with_retries
from shadowhound_data_logger.core.untrusted import is_path
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.fetched import FOLDER, UNWRITABLE, Fetched, Verified
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.download import download

THREADS: Final = 16
AHEAD: Final = 8
"""Objects queued per thread: enough to keep it busy, few enough to stop promptly on an interrupt."""
RECORD_INTERVAL_S: Final = 1.0
"""After a kill, only the downloads of this time are hashed again."""
_NO_DISK: Final = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO}
MAX_UNANSWERED: Final = 8
"""After this many consecutive failures the store counts as unreachable, and the other objects are not tried."""


@dataclass(frozen=True, slots=True)
class FetchRequest:
    """An object that must be in the folder."""

    bucket: str
    key: str
    size: int
    sha256: str | None = None
    """From the object's row; None: use that of the object's metadata."""
    etag: str = ''
    """From a listing."""


@dataclass(slots=True)
class FetchResult:
    """The result of the requests so far: each counts in one of the first three."""

    moved: int = 0
    present: int = 0
    """Objects that were already complete in the folder."""
    failed: dict[str, str] = field(default_factory=dict)
    """``bucket/key`` -> why."""
    bytes: int = 0
    """Bytes of the downloaded objects."""
    unverified: int = 0
    """Downloaded objects whose SHA-256 is unknown: only their sizes were compared."""


@dataclass(frozen=True, slots=True)
class _Done:
    file: Verified
    moved: bool
    verified: bool


def under(source: Bucket, prefix: str) -> list[FetchRequest]:
    """All objects whose keys start with the prefix, including those whose keys are not paths. Raises StoreError."""
    odd: list[FetchRequest] = []
    found = source.list(prefix, lambda bucket, key: odd.append(FetchRequest(bucket, key, 0)))
    return [*(FetchRequest(source.name, entry.key, entry.size, etag=entry.etag) for entry in found), *odd]


def fetch(
    requests: Sequence[FetchRequest], folder: Path, store: ObjectStore, *, verify: bool = False, threads: int = THREADS,
    tell: Callable[[int, int], None] = lambda _bytes, _objects: None,
) -> FetchResult:  # fmt: skip
    """Download objects; ``verify`` also reads the files that are already in the folder.

    The callback receives the progress since its last call, in bytes and objects, from any thread. Raises StoreError if the store
    rejects all requests or is unreachable, LakeError if the folder cannot be written.
    """
    with Fetched(folder) as fetched, ThreadPoolExecutor(threads, 'fetch') as pool:
        return _Fetch(fetched, store, tell, verify=verify).run(requests, pool, threads * AHEAD)


class _Fetch:
    """One run. The calling thread decides and records; the threads of the pool download."""

    def __init__(self, fetched: Fetched, store: ObjectStore, tell: Callable[[int, int], None], *,
                 verify: bool) -> None:  # fmt: skip
        self._fetched = fetched
        self._store = store
        self._tell = tell
        self._verify = verify
        self._numbers = count()
        self._over = threading.Event()
        self._unrecorded: list[Verified] = []
        self._recorded_s = time.monotonic()
        self._unanswered = 0
        self.result = FetchResult()

    def run(self, requests: Sequence[FetchRequest], pool: ThreadPoolExecutor, ahead: int) -> FetchResult:
        done: SimpleQueue[tuple[FetchRequest, Future[_Done]]] = SimpleQueue()
        under_way = 0
        try:
            for request in self._missing(requests):
                pending = pool.submit(self._download, request)
                pending.add_done_callback(lambda future, request=request: done.put((request, future)))  # type: ignore[misc]
                under_way += 1
                while under_way >= ahead:
                    self._settle(*done.get())
                    under_way -= 1
            for _ in range(under_way):
                self._settle(*done.get())
        finally:
            self._over.set()
            pool.shutdown(cancel_futures=True)
            self._record()
        return self.result

    def _missing(self, requests: Sequence[FetchRequest]) -> Iterator[FetchRequest]:
        """The requests whose objects are not known to be in the folder."""
        seen: set[str] = set()
        for request in dict.fromkeys(requests):  # the rows of repeats name one object
            if (refusal := _refusal(request)) or request.key in seen:
                self._fail(request, refusal or 'another bucket has the same key: fetch it into another folder')
                continue
            seen.add(request.key)
            known = None if self._verify else self._fetched.verified(request.key)
            if known is not None and _is(known, request):
                self.result.present += 1
                self._tell(request.size, 1)
            else:
                yield request

    def _settle(self, request: FetchRequest, future: Future[_Done]) -> None:
        """Count one result. Raises errors that affect all requests."""
        try:
            self._count(future.result())
        except (ObjectRefused, AccessDenied, BucketMissing) as error:
            self._fail(request, error.data.get('why') or str(error))
        except StoreUnavailable as error:
            self._unanswered += 1
            if self._unanswered >= MAX_UNANSWERED:
                raise
            self._fail(request, str(error))
        except OSError as error:
            if error.errno in _NO_DISK:
                raise LakeError(f'{self._fetched.folder} cannot be written: {error.strerror}', remedy=UNWRITABLE) from error
            self._fail(request, error.strerror or type(error).__name__)
        if time.monotonic() - self._recorded_s > RECORD_INTERVAL_S:
            self._record()

    def _fail(self, request: FetchRequest, why: str) -> None:
        self.result.failed[f'{request.bucket}/{request.key}'] = why

    def _count(self, done: _Done) -> None:
        self._unanswered = 0
        if done.verified:
            self._unrecorded.append(done.file)
        else:
            self.result.unverified += 1
        if done.moved:
            self.result.moved += 1
            self.result.bytes += done.file.size
        else:
            self.result.present += 1

    def _record(self) -> None:
        self._fetched.record(self._unrecorded)
        self._unrecorded = []
        self._recorded_s = time.monotonic()

    # -- on the threads of the pool --------------------------------------------------------------------------------

    def _download(self, request: FetchRequest) -> _Done:
        path = self._fetched.path(request.key)
        held = self._held(request, path)
        if held is None:
            return self._move(request, path)
        self._tell(request.size, 1)
        return held

    def _held(self, request: FetchRequest, path: Path) -> _Done | None:
        """An existing file with the object's content, left by a run that was killed or by another program."""
        if not path.is_file() or path.stat().st_size != request.size:
            return None
        info = None if request.sha256 else with_retries(lambda: self._store.head(request.bucket, request.key), pause=self._pause)
        expected = request.sha256 or (info and info.sha256)
        seen = path.stat()
        if expected is None or fingerprint(path)[1] != expected:
            return None
        return _Done(
            Verified(request.key, request.bucket, request.size, seen.st_mtime_ns, expected, request.etag),
            moved=False,
            verified=True,
        )

    def _move(self, request: FetchRequest, path: Path) -> _Done:
        part = self._fetched.parts / str(next(self._numbers))
        moved = 0  # bytes so far

        def tell(size: int) -> None:
            nonlocal moved
            if self._over.is_set():
                raise LakeError('the fetch was interrupted')
            moved += size
            self._tell(size, 0)

        try:
            wanted = ObjectInfo(request.bucket, request.key, request.size, request.sha256)
            found = download(self._store, wanted, path, part=part, is_synced=False, on_progress=tell, pause=self._pause)
        except BaseException:
            self._tell(-moved, 0)
            part.unlink(missing_ok=True)
            raise
        self._tell(0, 1)
        file = Verified(request.key, request.bucket, request.size, path.stat().st_mtime_ns, found.sha256, request.etag)
        return _Done(file, moved=True, verified=found.is_verified)

    def _pause(self, seconds: float) -> None:
        """Wait between two attempts. Raises LakeError if the run has ended."""
        if self._over.wait(seconds):
            raise LakeError('the fetch was interrupted')


def _refusal(request: FetchRequest) -> str:
    """Why an object must not become a file below the folder; empty if it can. The bucket may contain hostile keys."""
    if not is_path(request.key):
        return 'its key is not a path'
    return f'its key is in {FOLDER}/, which is reserved' if request.key.split('/', maxsplit=1)[0] == FOLDER else ''


def _is(known: Verified, request: FetchRequest) -> bool:
    """Whether the recorded file is the requested object."""
    same = (known.bucket, known.size) == (request.bucket, request.size)
    if request.sha256 is not None:
        return same and known.sha256 == request.sha256
    return same and (not request.etag or not known.etag or known.etag == request.etag)
