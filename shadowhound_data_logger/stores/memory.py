"""A store in memory for tests: it behaves like the others, and fails when it is told to."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterator

from shadowhound_data_logger.errors import ObjectRefused
from shadowhound_data_logger.model import ObjectInfo, Put, SpooledObject
from shadowhound_data_logger.stores.content import CHUNK_BYTES, check_target, chunks, identical_or_foreign, object_metadata
from shadowhound_data_logger.stores.pace import Pace


class MemoryStore:
    """Holds objects in a dict under one lock.

    ``fail`` is asked before each put (with the item) and each probe (with None); the exception it returns is raised.
    """

    def __init__(self, fail: Callable[[SpooledObject | None], Exception | None] | None = None) -> None:
        self.fail = fail
        self.pace = Pace()
        self._lock = threading.Lock()
        self._objects: dict[tuple[str, str], tuple[ObjectInfo, bytes]] = {}

    def __repr__(self) -> str:
        return f'MemoryStore({len(self._objects)} objects)'

    def open(self) -> None:
        """Nothing to acquire."""

    def close(self) -> None:
        """Nothing to release; what it holds stays."""

    def describe(self) -> str:
        return 'memory'

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
        check_target(bucket, key)
        with self._lock:
            found = self._objects.get((bucket, key))
        return found[0] if found else None

    def get(self, bucket: str, key: str) -> bytes:
        check_target(bucket, key)
        with self._lock:
            found = self._objects.get((bucket, key))
        if found is None:
            raise ObjectRefused(f'there is no {bucket}/{key}', reason='missing', bucket=bucket, key=key)
        return found[1]

    def get_range(self, bucket: str, key: str, start: int, length: int) -> bytes:
        return self.get(bucket, key)[start : start + length]

    def content(self, bucket: str, key: str, start: int = 0) -> Iterator[bytes]:
        body = self.get(bucket, key)
        yield from (body[place : place + CHUNK_BYTES] for place in range(start, len(body), CHUNK_BYTES))

    def list(self, bucket: str, prefix: str = '') -> Iterator[ObjectInfo]:
        with self._lock:
            held = sorted(where for where in self._objects if where[0] == bucket and where[1].startswith(prefix))
            infos = [self._objects[where][0] for where in held]
        return iter(infos)

    def probe(self) -> None:
        self._fail(None)

    def _fail(self, item: SpooledObject | None) -> None:
        error = self.fail(item) if self.fail else None
        if error is not None:
            raise error


def _info(item: SpooledObject) -> ObjectInfo:
    return ObjectInfo(item.bucket, item.key, item.size, item.sha256, object_metadata(item), item.content_type)
