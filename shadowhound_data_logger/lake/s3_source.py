"""A bucket of an S3 server, through obstore: a third of rclone's CPU, a quarter of botocore's (docs/decisions/0013)."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from functools import lru_cache
from typing import Any, Final

import obstore
from obstore import exceptions as refused
from obstore.store import S3Store

from shadowhound_data_logger.errors import (
    AccessDenied,
    BucketMissing,
    CredentialsRejected,
    ObjectRefused,
    StoreError,
    StoreUnavailable,
    StoreUntrusted,
)
from shadowhound_data_logger.lake.source import CHUNK_BYTES, Content, Entry, check_read
from shadowhound_data_logger.lake.trust import authorities
from shadowhound_data_logger.model import ObjectInfo
from shadowhound_data_logger.options import StoreSettings
from shadowhound_data_logger.tls import distrust_told

_CONNECT: Final = timedelta(seconds=10)
_SILENCE: Final = timedelta(seconds=60)
"""Of a server in the middle of an answer."""
_WHOLE: Final = timedelta(days=1)
"""For one answer: a large object over WiFi takes its time."""
_TRIES: Final = 4
_PATIENCE: Final = timedelta(seconds=60)
_CODE: Final = re.compile(r'<Code>(\w+)</Code>')
_KEY_CODES: Final = {
    'InvalidAccessKeyId', 'SignatureDoesNotMatch', 'ExpiredToken', 'InvalidToken', 'AuthorizationHeaderMalformed',
}  # fmt: skip
_HEADERS: Final = {
    'Content-Disposition', 'Content-Encoding', 'Content-Language', 'Content-Type', 'Cache-Control', 'Storage-Class',
}  # fmt: skip
"""What obstore has among the attributes beside the object's own."""


@dataclass(frozen=True, slots=True)
class S3Source:
    """``list`` knows any prefix, as S3 does; obstore itself whole names alone."""

    settings: StoreSettings
    bucket: str

    def describe(self) -> str:
        return f'the bucket {self.bucket} of the S3 server at {self.settings.endpoint_url}'

    def folders(self, prefix: str) -> list[str]:
        return sorted(folder.rpartition('/')[2] for folder in self._below(prefix)['common_prefixes'])

    def list(self, prefix: str) -> Iterator[Entry]:
        folder, _, begin = prefix.rpartition('/')
        if not begin:
            yield from self._all(folder)
            return
        below = self._below(folder)  # S3 knows any prefix, obstore whole names alone
        yield from (_entry(found) for found in below['objects'] if found['path'].startswith(prefix))
        for found in below['common_prefixes']:
            if found.startswith(prefix):
                yield from self._all(found)

    def read(self, key: str, most: int) -> bytes:
        with self._asking(key):
            found = obstore.get(self._store, key)
            check_read(self.bucket, key, found.meta['size'], most)
            return bytes(found.bytes())

    def ranges(self, key: str, spans: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        with self._asking(key):
            return [bytes(each) for each in obstore.get_ranges(self._store, key, starts=[start for start, _ in spans],
                                                               ends=[end for _, end in spans])]  # fmt: skip

    def tail(self, key: str, count: int) -> bytes:
        with self._asking(key):
            return bytes(obstore.get(self._store, key, options={'range': {'suffix': count}}).bytes())

    def get(self, key: str) -> Content:
        with self._asking(key):
            found = obstore.get(self._store, key)
            return Content(found.meta['size'], _metadata(found.attributes), self._pieces(key, found))

    def head(self, key: str) -> ObjectInfo | None:
        with self._asking(key):
            try:
                found = obstore.get(self._store, key, options={'head': True})
            except FileNotFoundError:
                return None
            metadata = _metadata(found.attributes)
            kind = found.attributes.get('Content-Type', '')
            return ObjectInfo(self.bucket, key, found.meta['size'], metadata.get('sha256'), metadata, kind)

    def delete(self, keys: Sequence[str]) -> None:
        for key in keys:  # one by one: SeaweedFS and MinIO answer a bulk delete without rights each in its own way
            with self._asking(key):
                obstore.delete(self._store, key)

    @property
    def _store(self) -> S3Store:
        return _client(self.settings, self.bucket)

    def _below(self, prefix: str) -> Any:
        with self._asking(prefix):
            try:
                return obstore.list_with_delimiter(self._store, prefix or None)
            except (refused.BaseError, FileNotFoundError) as error:
                if _is_no_bucket(error):
                    return {'common_prefixes': [], 'objects': []}
                raise

    def _all(self, folder: str) -> Iterator[Entry]:
        with self._asking(folder):
            pages = obstore.list(self._store, folder or None)
        while True:
            with self._asking(folder):
                try:
                    page = next(pages, None)
                except (refused.BaseError, FileNotFoundError) as error:
                    if _is_no_bucket(error):
                        return
                    raise
            if page is None:
                return
            yield from map(_entry, page)

    def _pieces(self, key: str, found: Any) -> Iterator[bytes]:
        with self._asking(key):
            yield from found.stream(min_chunk_size=CHUNK_BYTES)

    @contextmanager
    def _asking(self, key: str) -> Iterator[None]:
        try:
            yield
        except (refused.BaseError, FileNotFoundError, ValueError) as error:  # ValueError: a key with an unsafe part
            raise _translated(error, self.settings.endpoint_url or '', self.bucket, key) from None  # its text has the key id


@lru_cache(maxsize=16)
def _client(settings: StoreSettings, bucket: str) -> S3Store:
    """One a process: it holds the connections. Without keys in hand it asks what boto3 would ask."""
    given: dict[str, Any] = {'access_key_id': settings.access_key_id, 'secret_access_key': settings.secret_access_key}
    if settings.session_token:
        given['session_token'] = settings.session_token
    if not (settings.access_key_id and settings.secret_access_key):
        given = {'credential_provider': _provider(settings)}
    options: Any = {'allow_http': True, 'connect_timeout': _CONNECT, 'read_timeout': _SILENCE, 'timeout': _WHOLE}
    if (trusted := authorities(settings)) is not None:
        options['root_certificate'] = trusted
    return S3Store(
        bucket, endpoint=settings.endpoint_url, region=settings.region, virtual_hosted_style_request=False, **given,
        client_options=options, retry_config={'max_retries': _TRIES, 'retry_timeout': _PATIENCE},
    )  # fmt: skip


def _provider(settings: StoreSettings) -> Any:
    """What finds the keys of this machine. Raises SettingError for half a pair of keys, CredentialsRejected without any."""
    from obstore.auth.boto3 import Boto3CredentialProvider  # noqa: PLC0415 - half a second that few need

    from shadowhound_data_logger.stores.credentials import has_keys  # noqa: PLC0415

    if not has_keys(settings):
        text = f'there are no credentials for Tower at {settings.endpoint_url}'
        remedy = 'set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_SHARED_CREDENTIALS_FILE to a file with them'
        raise CredentialsRejected(text, remedy=remedy, endpoint=settings.endpoint_url or '')
    return Boto3CredentialProvider()


def _entry(found: Any) -> Entry:
    return Entry(found['path'], found['size'], found['e_tag'] or '', found['last_modified'])


def _metadata(attributes: Mapping[str, str]) -> dict[str, str]:
    """The object's own, as S3 has them: lower-case names."""
    return {name.lower(): value for name, value in attributes.items() if name not in _HEADERS}


def _is_no_bucket(error: Exception) -> bool:
    return 'NoSuchBucket' in str(error) or isinstance(error, FileNotFoundError)


def _translated(error: Exception, endpoint: str, bucket: str, key: str) -> StoreError:
    """What went wrong, in our words: those of the library repeat the request."""
    where = {'endpoint': endpoint, 'bucket': bucket, 'key': key}
    found = _CODE.search(str(error))
    code = found.group(1) if found else type(error).__name__
    if code == 'NoSuchBucket':
        return BucketMissing(f'there is no bucket {bucket} on Tower at {endpoint}', **where)
    if isinstance(error, FileNotFoundError):
        return ObjectRefused(f'there is no {bucket}/{key} on Tower at {endpoint}', reason='missing', **where)
    if code in _KEY_CODES or isinstance(error, refused.UnauthenticatedError):
        remedy = 'check AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY'
        return CredentialsRejected(f'Tower at {endpoint} refuses the credentials ({code})', remedy=remedy, **where)
    if isinstance(error, refused.PermissionDeniedError):
        return AccessDenied(f'Tower at {endpoint} denies these credentials {bucket}/{key} ({code})', **where)
    if isinstance(error, (refused.InvalidPathError, ValueError)):
        return ObjectRefused(f'the key {bucket}/{key:.80} cannot be asked for', reason='name', **where)
    untrusted = distrust_told(str(error), f'Tower at {endpoint}', bundle='AWS_CA_BUNDLE', address='AWS_ENDPOINT_URL')
    if untrusted:
        return StoreUntrusted(untrusted[0], remedy=untrusted[1], **where)
    remedy = 'is Tower on, and the WiFi?'
    return StoreUnavailable(f'Tower at {endpoint} gave no answer for {bucket}/{key} ({code})', remedy=remedy, **where)
