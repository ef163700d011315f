"""A store in memory, which behaves like the others and fails on request."""

from __future__ import annotations

import dataclasses
import hashlib
import threading
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime, timezone

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.errors import ObjectRefused
from shadowhound_data_logger.core.model import ObjectInfo, Put, SpooledObject
from shadowhound_data_logger.stores.bandwidth import Pace
from shadowhound_data_logger.stores.base import Content, has_changed, joined, too_large
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


class MemoryStore:
    """A store in memory, for tests: a dict under one lock.

    ``fail`` is called before each put (with the item) and each probe, ``changed`` and ``replace`` (with None); an
    exception that it returns is raised.
    """

    def __init__(self, fail: Callable[[SpooledObject | None], Exception | None] | None = None, *, name: str = 'memory') -> None:
        self.fail = fail
        self._name = name
        self.pace = Pace()
        self._lock = threading.Lock()
        self._objects: dict[tuple[str, str], tuple[ObjectInfo, bytes]] = {}

    def __repr__(self) -> str:
        return f'MemoryStore({len(self._objects)} objects)'

    def open(self) -> None:
        """Nothing to acquire."""

    def close(self) -> None:
        """Nothing to release; the objects remain."""

    def describe(self) -> str:
        return self._name

    def put(self, item: SpooledObject) -> Put:
        self._fail(item)
        check_target(item.bucket, item.key)
        ours = (_info(item), b''.join(chunks(item)))
        with self._lock:
            held, body = self._objects.setdefault((item.bucket, item.key), ours)
        if held is ours[0]:
            self.pace.count(item.size)
            return Put.CREATED
        return identical_or_foreign(item, held, lambda: hashlib.sha256(body).hexdigest())

    def head(self, bucket: str, key: str) -> ObjectInfo | None:
        check_read(bucket, key)
        with self._lock:
            found = self._objects.get((bucket, key))
        return found[0] if found else None

    def get(self, bucket: str, key: str, max_bytes: int | None = None) -> bytes:
        return joined(self.content(bucket, key), max_bytes)

    def ranges(self, bucket: str, key: str, spans: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        _, body = self._held(bucket, key)
        return [body[start:end] for start, end in spans]

    def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
        info, body = self._held(bucket, key)
        if version not in {'', info.etag}:
            raise has_changed(bucket, key)
        return Content(info, (body[place : place + CHUNK_BYTES] for place in range(start, len(body), CHUNK_BYTES)))

    def changed(self, bucket: str, key: str, version: str, max_bytes: int) -> tuple[bytes, str] | None:
        self._fail(None)
        info, body = self._held(bucket, key)
        if info.etag == version:
            return None
        if len(body) > max_bytes:
            raise too_large(bucket, key, max_bytes)
        return body, info.etag

    def replace(self, bucket: str, key: str, body: bytes, version: str) -> bool:
        self._fail(None)
        self._held(bucket, key)
        sha256 = hashlib.sha256(body).hexdigest()
        with self._lock:
            held, _ = self._objects[bucket, key]
            if held.etag != version:
                return False
            metadata = {**held.metadata, meta.SHA256: sha256}
            new = dataclasses.replace(held, size=len(body), sha256=sha256, metadata=metadata, etag=sha256)
            self._objects[bucket, key] = new, body
        return True

    def list(self, bucket: str, prefix: str = '', skipped: Callable[[str, str], None] = warn_of) -> Iterator[ObjectInfo]:
        with self._lock:
            held = sorted(where for where in self._objects if where[0] == bucket and where[1].startswith(prefix))
            infos = [self._objects[where][0] for where in held]
        found = (ObjectInfo(info.bucket, info.key, info.size, None, etag=info.etag, modified=info.modified) for info in infos)
        return paths(found, skipped)

    def folders(self, bucket: str, prefix: str = '') -> Sequence[str]:
        below = (info.key[len(prefix) :].partition('/') for info in self.list(bucket, prefix))
        return sorted({name for name, slash, _ in below if slash})

    def delete(self, bucket: str, key: str) -> None:
        check_read(bucket, key)
        with self._lock:
            self._objects.pop((bucket, key), None)

    def probe(self) -> None:
        self._fail(None)

    def _held(self, bucket: str, key: str) -> tuple[ObjectInfo, bytes]:
        check_read(bucket, key)
        with self._lock:
            found = self._objects.get((bucket, key))
        if found is None:
            raise ObjectRefused(f'there is no {bucket}/{key}', reason='missing', bucket=bucket, key=key)
        return found

    def _fail(self, item: SpooledObject | None) -> None:
        error = self.fail(item) if self.fail else None
        if error is not None:
            raise error


def _info(item: SpooledObject) -> ObjectInfo:
    when = datetime.now(timezone.utc)
    return ObjectInfo(item.bucket, item.key, item.size, item.sha256, object_metadata(item), item.content_type, item.sha256, when)
