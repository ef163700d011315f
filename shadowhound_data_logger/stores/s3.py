"""An S3 server as a store: single requests (s3_requests.py) and puts that never overwrite (s3_puts.py)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from operator import attrgetter
from typing import TypeVar

from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.core.errors import CredentialsRejected
from shadowhound_data_logger.core.model import ObjectInfo, Put, SpooledObject
from shadowhound_data_logger.core.untrusted import is_path
from shadowhound_data_logger.stores.bandwidth import Pace
from shadowhound_data_logger.stores.base import Content, joined
from shadowhound_data_logger.stores.content import check_read, check_target, paths, warn_of
from shadowhound_data_logger.stores.s3_client import S3Client
from shadowhound_data_logger.stores.s3_puts import ConditionalPuts
from shadowhound_data_logger.stores.s3_requests import S3Requests

_Answer = TypeVar('_Answer')


class S3Store:
    """A store on an S3 server: a put never overwrites, and is confirmed only when its content has been verified."""

    def __init__(self, settings: StoreSettings, upload: UploadSettings) -> None:
        self._client = S3Client(settings, upload)
        self._s3 = S3Requests(self._client)
        self._puts = ConditionalPuts(self._client, self._s3)

    def __repr__(self) -> str:
        return f'S3Store({self._client.endpoint!r})'

    @property
    def pace(self) -> Pace:
        return self._client.pace

    def open(self) -> None:
        """Raises SettingError for an endpoint to which no request can be sent, or if botocore is too old."""
        self._client.open()

    def close(self) -> None:
        self._client.close()

    def describe(self) -> str:
        return f'the S3 server at {self._client.endpoint}'

    def put(self, item: SpooledObject) -> Put:
        check_target(item.bucket, item.key)
        return self._with_new_keys(lambda: self._puts.put(item))

    def head(self, bucket: str, key: str) -> ObjectInfo | None:
        check_read(bucket, key)
        return self._with_new_keys(lambda: self._s3.head(bucket, key))

    def get(self, bucket: str, key: str, max_bytes: int | None = None) -> bytes:
        return joined(self.content(bucket, key), max_bytes)

    def ranges(self, bucket: str, key: str, spans: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        check_read(bucket, key)
        return [self._with_new_keys(lambda: self._s3.range(bucket, key, *span)) if span[0] < span[1] else b'' for span in spans]  # noqa: B023 - called immediately

    def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
        check_read(bucket, key)
        return self._with_new_keys(lambda: self._s3.content(bucket, key, start, version))

    def changed(self, bucket: str, key: str, version: str, max_bytes: int) -> tuple[bytes, str] | None:
        check_read(bucket, key)
        return self._with_new_keys(lambda: self._s3.changed(bucket, key, version, max_bytes))

    def replace(self, bucket: str, key: str, body: bytes, version: str) -> bool:
        check_target(bucket, key)
        return self._with_new_keys(lambda: self._s3.replace(bucket, key, body, version))

    def list(self, bucket: str, prefix: str = '', skipped: Callable[[str, str], None] = warn_of) -> Iterator[ObjectInfo]:
        check_read(bucket, 'any')
        yield from sorted(paths(self._s3.list(bucket, prefix), skipped), key=attrgetter('key'))

    def folders(self, bucket: str, prefix: str = '') -> Sequence[str]:
        check_read(bucket, 'any')
        return sorted(filter(is_path, self._s3.folders(bucket, prefix)))

    def delete(self, bucket: str, key: str) -> None:
        check_read(bucket, key)
        self._s3.delete(bucket, key)

    def probe(self) -> None:
        self._s3.probe()

    def _with_new_keys(self, request: Callable[[], _Answer]) -> _Answer:
        """Send a request; once more if the keys were refused and newer ones have been read since."""
        generation = self._client.generation
        try:
            return request()
        except CredentialsRejected:
            if self._client.generation == generation:
                raise
            return request()
