"""The bucket with the data of robots: a value that reads it and can be passed to other processes. Also uploads row files."""

from __future__ import annotations

import hashlib
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Final, TypeVar

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.config import home, store_settings
from shadowhound_data_logger.core.errors import ForeignObject
from shadowhound_data_logger.core.model import ObjectInfo, SpooledObject
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.core.retry import with_retries
from shadowhound_data_logger.formats.rows.catalog import BUCKET, SENSOR
from shadowhound_data_logger.formats.rows.parts import CONTENT_TYPE
from shadowhound_data_logger.stores import open_reader
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.content import warn_of

THREADS: Final = 16
"""Concurrent requests; each spends most of its time waiting for the server."""
_Answer = TypeVar('_Answer')


@dataclass(frozen=True, slots=True)
class Bucket:
    """Reads and lists one bucket with the calls of ``stores/base.py``, each with retries.

    Thread-safe; its repr shows no secret. Raises only StoreError, or SettingError for unusable settings.
    """

    settings: StoreSettings = field(repr=False)
    name: str

    def describe(self) -> str:
        """The location of the bucket, for messages; contains no secret."""
        return f'the bucket {self.name} {"of" if self.settings.endpoint_url else "in"} {_reader(self.settings).describe()}'

    def folders(self, prefix: str) -> Sequence[str]:
        return self._ask(lambda store: store.folders(self.name, prefix))

    def list(self, prefix: str, skipped: Callable[[str, str], None] = warn_of) -> Sequence[ObjectInfo]:
        return self._ask(lambda store: [*store.list(self.name, prefix, skipped)])

    def get(self, key: str, most: int) -> bytes:
        return self._ask(lambda store: store.get(self.name, key, most))

    def ranges(self, key: str, spans: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        return self._ask(lambda store: store.ranges(self.name, key, spans))

    def head(self, key: str) -> ObjectInfo | None:
        return self._ask(lambda store: store.head(self.name, key))

    def delete(self, key: str) -> None:
        self._ask(lambda store: store.delete(self.name, key))

    def _ask(self, ask: Callable[[ObjectStore], _Answer]) -> _Answer:
        return with_retries(lambda: ask(_reader(self.settings)))


def default_source(settings: StoreSettings | None = None) -> Bucket:
    """The bucket with the row files of robots, in the store that the environment names."""
    return Bucket(settings or store_settings(os.environ, home(os.environ)), BUCKET)


def put_part(store: ObjectStore, key: str, robot: str, body: bytes, rows: int) -> None:
    """Upload a row file; returns when it is stored. Raises StoreError.

    The key is derived from the rows: a file that already exists has the same rows, and is not overwritten.
    """
    with tempfile.TemporaryDirectory(prefix='shadowhound-lake-') as folder:
        path = Path(folder, 'part')
        path.write_bytes(body)
        metadata = {meta.ROBOT: robot, meta.SENSOR: SENSOR, meta.COUNT: str(rows)}
        item = SpooledObject(
            id=0, bucket=BUCKET, key=key, path=path, size=len(body), sha256=hashlib.sha256(body).hexdigest(),
            content_type=CONTENT_TYPE, metadata=metadata, priority=5, created_ns=time.time_ns(),
        )  # fmt: skip
        with suppress(ForeignObject):  # the same rows, written by another version of the library or in another order
            store.put(item)


@lru_cache(maxsize=16)
def _reader(settings: StoreSettings) -> ObjectStore:
    """One reader per process, because it owns the connections."""
    return open_reader(settings)
