"""A bucket of a machine without a server: a folder, and beside the buckets what S3 keeps as metadata (stores/directory.py)."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from shadowhound_data_logger.errors import AccessDenied, NameRefused, ObjectRefused, StoreUnavailable
from shadowhound_data_logger.keys import check_name
from shadowhound_data_logger.lake.source import CHUNK_BYTES, Content, Entry, check_read
from shadowhound_data_logger.model import ObjectInfo
from shadowhound_data_logger.options import StoreSettings
from shadowhound_data_logger.stores.directory import METADATA
from shadowhound_data_logger.untrusted import path_below


@dataclass(frozen=True, slots=True)
class FolderSource:
    """Keys are paths below it."""

    settings: StoreSettings
    bucket: str

    def describe(self) -> str:
        return f'the bucket {self.bucket} in the folder {self.settings.directory}'

    def folders(self, prefix: str) -> list[str]:
        with self._touching(prefix):
            folder = self._folder(prefix)
            return sorted(path.name for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []

    def list(self, prefix: str) -> Iterator[Entry]:
        with self._touching(prefix):
            root = self._folder('')
            for folder, _, names in os.walk(self._folder(prefix.rpartition('/')[0])):
                for name in names:
                    path = Path(folder, name)
                    key = str(path.relative_to(root))
                    if key.startswith(prefix):
                        try:
                            seen = path.stat()
                        except FileNotFoundError:  # deleted meanwhile
                            continue
                        modified = datetime.fromtimestamp(seen.st_mtime, timezone.utc)
                        yield Entry(key, seen.st_size, str(seen.st_mtime_ns), modified)

    def read(self, key: str, most: int) -> bytes:
        with self._touching(key), self.path(key).open('rb') as file:
            body = file.read(most + 1)
        check_read(self.bucket, key, len(body), most)
        return body

    def ranges(self, key: str, spans: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        with self._touching(key), self.path(key).open('rb') as file:
            return [os.pread(file.fileno(), end - start, start) for start, end in spans]

    def tail(self, key: str, count: int) -> bytes:
        with self._touching(key), self.path(key).open('rb') as file:
            file.seek(max(0, self.path(key).stat().st_size - count))
            return file.read()

    def get(self, key: str) -> Content:
        with self._touching(key):
            return Content(self.path(key).stat().st_size, self._record(key)['metadata'], self._pieces(key))

    def head(self, key: str) -> ObjectInfo | None:
        with self._touching(key):
            if not self.path(key).is_file():
                return None
            record = self._record(key)
            metadata = record['metadata']
            size = self.path(key).stat().st_size
            return ObjectInfo(self.bucket, key, size, metadata.get('sha256'), metadata, record['content_type'])

    def delete(self, keys: Sequence[str]) -> None:
        for key in keys:
            with self._touching(key):
                self._beside(key).unlink(missing_ok=True)
                self.path(key).unlink(missing_ok=True)

    def path(self, key: str) -> Path:
        """Raises NameRefused for a bucket or key that is none: rows of a catalogue name them, whoever wrote those."""
        return path_below(self._folder(''), key)

    def _folder(self, prefix: str) -> Path:
        bucket = self.settings.directory / check_name(self.bucket, 'the bucket')
        return path_below(bucket, prefix.rstrip('/')) if prefix.rstrip('/') else bucket

    def _beside(self, key: str) -> Path:
        return path_below(self.settings.directory / METADATA / self.bucket, f'{key}.json')

    def _record(self, key: str) -> dict[str, Any]:
        try:
            record: dict[str, Any] = json.loads(self._beside(key).read_bytes())
        except (FileNotFoundError, ValueError):
            return {'metadata': {}, 'content_type': ''}
        return record

    def _pieces(self, key: str) -> Iterator[bytes]:
        with self._touching(key), self.path(key).open('rb') as file:
            while piece := file.read(CHUNK_BYTES):
                yield piece

    @contextmanager
    def _touching(self, key: str) -> Iterator[None]:
        where = {'bucket': self.bucket, 'key': key}
        try:
            yield
        except NameRefused as error:
            raise ObjectRefused(str(error), reason='name', **where) from error
        except FileNotFoundError as error:
            raise ObjectRefused(
                f'there is no {self.bucket}/{key} in {self.settings.directory}', reason='missing', **where
            ) from error
        except PermissionError as error:
            raise AccessDenied(f'no permission for {error.filename}', **where) from error
        except OSError as error:
            raise StoreUnavailable(f'{self.settings.directory} cannot be read: {error.strerror}', **where) from error
