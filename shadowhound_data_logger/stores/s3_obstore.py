"""An S3 server as a store for machines that read many objects: obstore, at a quarter of botocore's CPU (docs/decisions/0013).

obstore is part of the extra ``lake`` and not needed on a robot. It hangs in forked children of a process that has used it; use
``S3Store`` there (docs/decisions/0016).
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import timedelta
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar
from urllib.parse import urlsplit
from urllib.request import getproxies, proxy_bypass

import obstore
from obstore import exceptions as refused
from obstore.store import S3Store as Client

from shadowhound_data_logger.core.config import endpoint_url
from shadowhound_data_logger.core.errors import (
    BucketMissing,
    CredentialsRejected,
    ObjectRefused,
    StoreError,
    StoreUnavailable,
)
from shadowhound_data_logger.core.model import ObjectInfo, Put, SpooledObject
from shadowhound_data_logger.core.options import StoreSettings, UploadSettings
from shadowhound_data_logger.core.retry import with_retries
from shadowhound_data_logger.stores.base import Content, has_changed, joined
from shadowhound_data_logger.stores.content import CHUNK_BYTES, check_read, paths, warn_of
from shadowhound_data_logger.stores.s3_metadata import from_headers

if TYPE_CHECKING:
    from shadowhound_data_logger.stores.bandwidth import Pace
    from shadowhound_data_logger.stores.s3 import S3Store

_CONNECT_TIMEOUT: Final = timedelta(seconds=10)
_READ_TIMEOUT: Final = timedelta(seconds=60)
"""Between two pieces of an answer."""
_TOTAL_TIMEOUT: Final = timedelta(days=1)
"""For one answer: a large object may take long over WiFi."""
_MAX_CLIENTS: Final = 16
"""Buckets whose connections are kept open: a catalog may name any number of buckets."""
_CODE: Final = re.compile(r'<Code>(\w+)</Code>|\(code: (\w+)\)')
_MESSAGE: Final = re.compile(r'<Message>([^<]*)</Message>')
_STATUS: Final = re.compile(r'non-2xx status code: (\d{3})')
REPLACED: Final = '\N{REPLACEMENT CHARACTER}'
RANGE_NOT_SATISFIABLE: Final = 416
"""The object ends before the first requested byte."""
_HEADERS: Final = {
    'Content-Disposition', 'Content-Encoding', 'Content-Language', 'Content-Type', 'Cache-Control', 'Storage-Class',
}  # fmt: skip
"""Attributes in obstore's answers that are not the object's own metadata."""

_Answer = TypeVar('_Answer')


class ObstoreStore:
    """Reads, lists and deletes through obstore; an S3Store does everything else.

    ``_lock`` guards the S3Store, which is opened when it is needed.
    """

    def __init__(self, settings: StoreSettings, upload: UploadSettings) -> None:
        self._settings = settings
        self._upload = upload
        self._endpoint = settings.endpoint_url or ''
        self._lock = threading.Lock()
        self._clients = _Clients(settings)
        self._opened: S3Store | None = None

    @property
    def pace(self) -> Pace:
        return self._s3.pace

    def open(self) -> None:
        """Raises SettingError for an endpoint to which no request can be sent."""
        scheme, _, rest = self._endpoint.rpartition('://')
        endpoint_url(f'{scheme}://{rest.rpartition("@")[2]}')  # a user name is not sent

    def close(self) -> None:
        with self._lock:
            opened, self._opened = self._opened, None
        self._clients.close()
        if opened is not None:
            opened.close()

    def describe(self) -> str:
        return f'the S3 server at {_without_password(self._endpoint)}'

    def put(self, item: SpooledObject) -> Put:
        return self._s3.put(item)

    def probe(self) -> None:
        self._s3.probe()

    def head(self, bucket: str, key: str) -> ObjectInfo | None:
        def head(client: Client) -> ObjectInfo | None:
            try:
                return _info(bucket, key, obstore.get(client, key, options={'head': True}))
            except FileNotFoundError:
                return None
            except refused.PermissionDeniedError:  # HEAD has no body: request the reason
                return _info(bucket, key, obstore.get(client, key, options={'range': (0, 1)}))

        return self._clients.request(bucket, key, head)

    def get(self, bucket: str, key: str, max_bytes: int | None = None) -> bytes:
        return joined(self.content(bucket, key), max_bytes)

    def ranges(self, bucket: str, key: str, spans: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        if not all(begin < end for begin, end in spans):
            return [self.ranges(bucket, key, [span])[0] if span[0] < span[1] else b'' for span in spans]

        def read(client: Client) -> Sequence[bytes]:
            begins, ends = [begin for begin, _ in spans], [end for _, end in spans]
            try:
                return [bytes(each) for each in obstore.get_ranges(client, key, starts=begins, ends=ends)]
            except refused.BaseError as error:
                if _parse(error)[0] != RANGE_NOT_SATISFIABLE:
                    raise
            return [self.ranges(bucket, key, [span])[0] for span in spans] if len(spans) > 1 else [b'']

        return self._clients.request(bucket, key, read)

    def changed(self, bucket: str, key: str, version: str, max_bytes: int) -> tuple[bytes, str] | None:
        return self._s3.changed(bucket, key, version, max_bytes)

    def replace(self, bucket: str, key: str, body: bytes, version: str) -> bool:
        return self._s3.replace(bucket, key, body, version)

    def list(self, bucket: str, prefix: str = '', skipped: Callable[[str, str], None] = warn_of) -> Iterator[ObjectInfo]:
        try:
            found = self._listed(bucket, prefix)
        except ObjectRefused as error:
            if error.data.get('reason') != 'name':
                raise
            found = None  # obstore refuses a whole page if one key is not a path
        if found is None or any(not each.size or REPLACED in each.key for each in found):
            # obstore removes the trailing slash of folder markers, and characters that XML cannot contain arrive replaced
            found = self._s3.list(bucket, prefix, skipped)
        yield from sorted(paths(found, skipped), key=attrgetter('key'))

    def _listed(self, bucket: str, prefix: str) -> Iterable[ObjectInfo]:
        folder, _, begin = prefix.rpartition('/')
        if not begin:
            return self._all(bucket, folder)
        below = self._below(bucket, folder)  # S3 accepts any prefix, obstore only complete names
        found = [_entry(bucket, each) for each in below['objects'] if each['path'].startswith(prefix)]
        for each in below['common_prefixes']:
            if each.startswith(prefix):
                found += self._all(bucket, each)
        return found

    def folders(self, bucket: str, prefix: str = '') -> Sequence[str]:
        try:
            return sorted(folder.rpartition('/')[2] for folder in self._below(bucket, prefix)['common_prefixes'])
        except ObjectRefused as error:
            if error.data.get('reason') != 'name':
                raise
            return self._s3.folders(bucket, prefix)

    def delete(self, bucket: str, key: str) -> None:
        self._clients.request(bucket, key, lambda client: obstore.delete(client, key))

    @property
    def _s3(self) -> S3Store:
        with self._lock:
            if self._opened is None:
                from shadowhound_data_logger.stores.s3 import S3Store  # noqa: PLC0415 - reading needs no botocore

                opened = S3Store(self._settings, self._upload)
                opened.open()
                self._opened = opened
            return self._opened

    def _below(self, bucket: str, prefix: str) -> Any:
        try:
            return self._clients.request(
                bucket, prefix, lambda client: obstore.list_with_delimiter(client, prefix or None), is_listing=True
            )
        except BucketMissing:
            return {'common_prefixes': [], 'objects': []}

    def _all(self, bucket: str, folder: str) -> Sequence[ObjectInfo]:
        """All objects below a folder; after a failure, continues with the page that failed."""
        found: list[ObjectInfo] = []

        def read(client: Client) -> None:
            for page in obstore.list(client, folder or None, offset=found[-1].key if found else None):
                found.extend(_entry(bucket, each) for each in page)

        while True:
            known = len(found)
            try:
                if found:
                    with_retries(lambda: self._clients.request(bucket, folder, read, is_listing=True))
                else:
                    self._clients.request(bucket, folder, read, is_listing=True)
            except BucketMissing:
                return found
            except StoreUnavailable:
                if len(found) == known:
                    raise
            else:
                return found

    def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
        check_read(bucket, key)
        options: Any = {**({'range': {'offset': start}} if start else {}), **({'if_match': version} if version else {})}
        with self._clients.translating(bucket, key):
            try:
                found = obstore.get(self._clients.of(bucket), key, options=options or None)
            except refused.PreconditionError:
                raise has_changed(bucket, key) from None
            except refused.BaseError as error:
                if not start or _parse(error)[0] != RANGE_NOT_SATISFIABLE or (info := self.head(bucket, key)) is None:
                    raise
                return Content(info, iter(()))  # it ends before ``start``
            info = replace(_info(bucket, key, found), etag=found.meta['e_tag'] or '')
            if version not in {'', info.etag}:  # the server ignores the condition
                raise has_changed(bucket, key)
            return Content(info, _pieces(self._clients, bucket, key, found, is_small=not start))


class _Clients:
    """The obstore clients of one server, one per bucket, which keep their connections. Thread-safe."""

    def __init__(self, settings: StoreSettings) -> None:
        self._settings = settings
        self._lock = threading.Lock()
        self._clients: dict[str, Client] = {}

    def __len__(self) -> int:
        return len(self._clients)

    def of(self, bucket: str) -> Client:
        with self._lock:
            client = self._clients.pop(bucket, None) or _client(self._settings, bucket)
            self._clients[bucket] = client  # most recently used last
            if len(self._clients) > _MAX_CLIENTS:
                self._clients.pop(next(iter(self._clients)))
            return client

    def close(self) -> None:
        with self._lock:
            self._clients.clear()

    def request(self, bucket: str, key: str, request: Callable[[Client], _Answer], *, is_listing: bool = False) -> _Answer:
        check_read(bucket, 'any' if is_listing else key)
        with self.translating(bucket, key):
            return request(self.of(bucket))

    @contextmanager
    def translating(self, bucket: str, key: str) -> Iterator[None]:
        """Raise StoreError instead of obstore's errors."""
        try:
            yield
        except (refused.BaseError, FileNotFoundError, ValueError) as error:  # ValueError: a key with an unsafe part
            raise _translated(error, self._settings.endpoint_url or '', bucket, key) from None  # its text contains the key id


def _pieces(clients: _Clients, bucket: str, key: str, found: Any, *, is_small: bool) -> Iterator[bytes]:
    with clients.translating(bucket, key):
        if is_small and found.meta['size'] <= CHUNK_BYTES:  # for a range, it would accept any number of bytes
            yield found.bytes()
        else:
            yield from found.stream(min_chunk_size=CHUNK_BYTES)


def _client(settings: StoreSettings, bucket: str) -> Client:
    """A client that finds keys as boto3 does if the settings have none. Raises SettingError for invalid certificates."""
    given: dict[str, Any] = {'access_key_id': settings.access_key_id, 'secret_access_key': settings.secret_access_key}
    if settings.session_token:
        given['session_token'] = settings.session_token
    if not (settings.access_key_id and settings.secret_access_key):
        given = {'credential_provider': _provider(settings)}
    allow_http = urlsplit(settings.endpoint_url or '').scheme != 'https'  # otherwise a redirect could lead to plain HTTP
    options: Any = {'allow_http': allow_http, 'connect_timeout': _CONNECT_TIMEOUT, 'read_timeout': _READ_TIMEOUT,
                    'timeout': _TOTAL_TIMEOUT, **proxy_options(settings.endpoint_url or '')}  # fmt: skip
    if (authorities := _authorities(settings)) is not None:
        options['root_certificate'] = authorities
    return Client(
        bucket, endpoint=settings.endpoint_url, region=settings.region, virtual_hosted_style_request=False, **given,
        client_options=options, retry_config={'max_retries': 0},
    )  # fmt: skip


def _provider(settings: StoreSettings) -> Any:
    """The provider of this machine's keys. Raises SettingError for half a pair of keys, CredentialsRejected without keys."""
    from obstore.auth.boto3 import Boto3CredentialProvider  # noqa: PLC0415 - takes half a second, and is rarely needed

    from shadowhound_data_logger.stores.credentials import has_keys  # noqa: PLC0415

    if not has_keys(settings):
        endpoint = _without_password(settings.endpoint_url or '')
        text = f'there are no credentials for the S3 server at {endpoint}'
        remedy = 'set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_SHARED_CREDENTIALS_FILE to a file with them'
        raise CredentialsRejected(text, remedy=remedy, endpoint=endpoint)
    return Boto3CredentialProvider()


def proxy_options(endpoint: str) -> dict[str, str]:
    """Options of obstore and delta-rs for the proxy that botocore would use; their rules for ALL_PROXY and NO_PROXY differ."""
    url, proxies = urlsplit(endpoint), getproxies()
    if not proxies:
        return {}
    if url.scheme in proxies and not proxy_bypass(url.netloc):
        return {'proxy_url': proxies[url.scheme]}
    return {'proxy_url': 'http://localhost', 'proxy_excludes': url.hostname or ''}  # no proxy at all


def _authorities(settings: StoreSettings) -> bytes | None:
    """The certificates (PEM) that uploads trust (``AWS_CA_BUNDLE``), for rustls; None for those of the system."""
    endpoint = settings.endpoint_url or ''
    if not endpoint.lower().startswith('https:'):
        return None
    from shadowhound_data_logger.stores.credentials import Keys, session_with, trusted  # noqa: PLC0415 - botocore takes a while

    path = trusted(session_with(Keys(settings)), endpoint)
    return Path(path).read_bytes() if isinstance(path, str) else None


def _without_password(endpoint: str) -> str:
    scheme, _, rest = endpoint.rpartition('://')
    return f'{scheme}://{rest.rpartition("@")[2]}' if '@' in rest else endpoint


def _info(bucket: str, key: str, found: Any) -> ObjectInfo:
    """The names of metadata are lower-case, as in S3."""
    attributes: Mapping[str, str] = found.attributes
    metadata = from_headers({name.lower(): value for name, value in attributes.items() if name not in _HEADERS})
    return ObjectInfo(bucket, key, found.meta['size'], metadata.get('sha256'), metadata, attributes.get('Content-Type', ''))


def _entry(bucket: str, found: Any) -> ObjectInfo:
    return ObjectInfo(bucket, found['path'], found['size'], None, etag=found['e_tag'] or '', modified=found['last_modified'])


def _parse(error: BaseException) -> tuple[int, str, str]:
    """HTTP status (0: no answer), S3 error code and message, from the text of obstore's error."""
    text = str(error)
    status, code, message = _STATUS.search(text), _CODE.search(text), _MESSAGE.search(text)
    denied = 403 if code and not status else 0
    return int(status[1]) if status else denied, (code[1] or code[2]) if code else '', message[1] if message else ''


def _translated(error: BaseException, endpoint: str, bucket: str, key: str) -> StoreError:
    """The error from the common table (s3_errors.py): obstore's messages quote the request."""
    from shadowhound_data_logger.stores import s3_errors  # noqa: PLC0415 - botocore takes a while

    status, code, message = _parse(error)
    request = s3_errors.Request(s3_errors.public_url(endpoint), bucket, key)
    if status:
        return s3_errors.refused(code or str(status), status, message, request)
    if isinstance(error, refused.UnauthenticatedError):
        return s3_errors.refused('InvalidAccessKeyId', 401, message, request)
    if isinstance(error, (refused.InvalidPathError, ValueError)):
        return ObjectRefused(f'the key {bucket}/{key:.80} is not a path', reason='name', bucket=bucket, key=key)
    return s3_errors.unreachable(str(error), request, is_proxied=proxy_options(endpoint).keys() == {'proxy_url'})
