"""Single requests to an S3 server, through botocore: one try each, with a deadline, and with errors translated to ours.

Stays inside the subset that MinIO, SeaweedFS and AWS share. An answer that did not come from an S3 server confirms nothing.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager
from enum import Enum
from typing import Any, Final, TypeVar

import botocore
from botocore.config import Config
from botocore.exceptions import BotoCoreError, ClientError, ProfileNotFound
from botocore.handlers import add_expect_header
from botocore.session import Session

from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.core.errors import AccessDenied, CredentialsRejected, SettingError, StoreUnavailable
from shadowhound_data_logger.core.model import ObjectInfo, SpooledObject
from shadowhound_data_logger.stores.bandwidth import Body, Pace
from shadowhound_data_logger.stores.base import Content, changed_meanwhile, joined
from shadowhound_data_logger.stores.content import CHUNK_BYTES, Part
from shadowhound_data_logger.stores.credentials import Keys, no_profile, session_with, trusted
from shadowhound_data_logger.stores.s3_errors import REQUEST_ERRORS, Request, classify, code_of, public_url, status_of
from shadowhound_data_logger.stores.s3_metadata import from_headers, to_headers

OLDEST_BOTOCORE: Final = (1, 36)
"""The first with If-None-Match on PUT and the checksum settings; Debian's of Humble and Jazzy are older."""
FORBIDDEN: Final = 403
NOT_MODIFIED: Final = 304
CHANGED: Final = 412
"""It has another ETag than that which was asked for."""
RANGE_NOT_SATISFIABLE: Final = 416
"""Nothing is behind the first byte that was asked for."""
AGENT: Final = 'shadowhound-data-logger'

_Asked = TypeVar('_Asked')


class Sent(Enum):
    """How a PUT was answered, where that is not an error yet."""

    CREATED = 'created'
    TAKEN = 'taken'
    """412: the key holds something."""
    NOT_IMPLEMENTED = 'not implemented'
    """501: the server does not know the condition."""


class S3Requests:
    """Single S3 requests, with errors translated to ours.

    Thread-safe after ``open``. Raises the errors of ``classify``.
    """

    def __init__(self, settings: StoreSettings, upload: UploadSettings) -> None:
        self.endpoint = public_url(settings.endpoint_url or '')
        """Without credentials."""
        self._settings = settings
        self._upload = upload
        self.pace = Pace(upload.max_mbps)
        self._keys: Keys | None = None
        self._client: Any = None

    @property
    def generation(self) -> int:
        """Of the keys: another one once refused keys were replaced by newer ones, with which the same request may work."""
        return self._keys.generation if self._keys else 0

    def open(self) -> None:
        """Raises SettingError for an endpoint no request can be sent to, or a botocore that is too old."""
        if self._client is None:
            self._keys = Keys(self._settings)
            self._client = _client(session_with(self._keys), self._settings, self._upload)

    def close(self) -> None:
        client, self._client = self._client, None
        self.pace.abandon()
        if client is not None:
            client.close()

    def put(self, item: SpooledObject, body: bytes | Body, *, conditional: bool) -> Sent:
        """One PUT, of which the server verifies the SHA-256. Returns Sent.CREATED only when the server confirmed it."""
        checksum = b64encode(bytes.fromhex(item.sha256)).decode('ascii')
        condition = {'IfNoneMatch': '*'} if conditional else {}
        with self._asking(item.bucket, item.key, self._client) as client:
            try:
                answer = client.put_object(
                    Bucket=item.bucket, Key=item.key, Body=self.pace.body(body, item.priority), ContentLength=item.size,
                    ContentType=item.content_type, Metadata=to_headers(item), ChecksumSHA256=checksum, **condition,
                )  # fmt: skip
            except ClientError as error:
                if status_of(error) == 412:
                    return Sent.TAKEN
                if conditional and status_of(error) == 501:
                    return Sent.NOT_IMPLEMENTED
                raise
        self.confirm(answer, item.bucket, item.key)
        return Sent.CREATED

    def put_part(self, item: SpooledObject, upload: str, number: int, part: Part) -> str:
        """One part of a multipart upload, verified by the server; returns its ETag."""
        with self._asking(item.bucket, item.key, self._client) as client:
            answer = client.upload_part(
                Bucket=item.bucket, Key=item.key, UploadId=upload, PartNumber=number, ContentLength=part.size,
                ContentMD5=b64encode(part.md5).decode('ascii'), Body=self.pace.body(part, item.priority, stands_back=True),
            )  # fmt: skip
        self.confirm(answer, item.bucket, item.key)
        etag: str = answer['ETag']
        return etag

    def head(self, bucket: str, key: str) -> ObjectInfo | None:
        with self._asking(bucket, key, self._client) as client:
            try:
                answer = client.head_object(Bucket=bucket, Key=key)
            except ClientError as error:
                if status_of(error) == 404:
                    return None
                try:  # its answer has a body: the reason
                    client.get_object(Bucket=bucket, Key=key, Range='bytes=0-0')['Body'].close()
                except ClientError as reason:
                    if status_of(reason) == status_of(error):
                        raise
                if status_of(error) != FORBIDDEN:
                    raise
                # Another trouble, or over: no word on rights, which would let a put go on without this look.
                raise StoreUnavailable(
                    f'{self.endpoint} refused to describe {bucket}/{key} and gave another answer when asked why',
                    endpoint=self.endpoint, bucket=bucket, key=key,
                ) from error  # fmt: skip
        self.confirm(answer, bucket, key)
        if 'ContentLength' not in answer:
            raise self._not_s3(bucket, key)
        metadata = from_headers(answer.get('Metadata', {}))
        return ObjectInfo(bucket, key, answer['ContentLength'], metadata.get('sha256'), metadata, answer.get('ContentType', ''))

    def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
        """The object, or what of it is behind ``start``, in pieces. Raises ObjectRefused when there is none of that version."""
        how = {**({'Range': f'bytes={start}-'} if start else {}), **({'IfMatch': version} if version else {})}
        with self._asking(bucket, key, self._client) as client:
            try:
                answer = client.get_object(Bucket=bucket, Key=key, **how)
            except ClientError as error:
                if version and status_of(error) == CHANGED:
                    raise changed_meanwhile(bucket, key) from error
                if not start or status_of(error) != RANGE_NOT_SATISFIABLE:
                    raise
                info = self.head(bucket, key)  # it ends before
                if info is None:
                    raise
                return Content(info, iter(()))
            body = answer['Body']
            try:
                size = self._full_size(answer, bucket, key, start or None)
            except BaseException:
                body.close()
                raise
            if version not in {'', answer['ETag']}:  # of a server that does not know the condition
                body.close()
                raise changed_meanwhile(bucket, key)
        metadata = from_headers(answer.get('Metadata', {}))
        kind = answer.get('ContentType', '')
        info = ObjectInfo(bucket, key, size, metadata.get('sha256'), metadata, kind, answer['ETag'])
        return Content(info, self._pieces(bucket, key, body), body.close)

    def changed(self, bucket: str, key: str, version: str, most: int) -> tuple[bytes, str] | None:
        """The whole object and its ETag; None if that is ``version``."""
        with self._asking(bucket, key, self._client) as client:
            try:
                answer = client.get_object(Bucket=bucket, Key=key, **({'IfNoneMatch': version} if version else {}))
            except ClientError as error:
                if status_of(error) == NOT_MODIFIED:
                    return None
                raise
            with closing(answer['Body']) as body:
                size = self._full_size(answer, bucket, key, None)
                found = Content(ObjectInfo(bucket, key, size, None), self._pieces(bucket, key, body))
                return joined(found, most), answer['ETag']

    def replace(self, bucket: str, key: str, body: bytes, version: str) -> bool:
        """One PUT with ``If-Match``; False where another version is there, or another put under way."""
        with self._asking(bucket, key, self._client) as client:
            try:
                answer = client.put_object(Bucket=bucket, Key=key, Body=body, IfMatch=version, ContentType='application/json')
            except ClientError as error:
                if status_of(error) in {409, 412}:
                    return False
                raise
        self.confirm(answer, bucket, key)
        return True

    def range(self, bucket: str, key: str, begin: int, end: int) -> bytes:
        """From the first byte to before the last one; fewer where it ends before."""
        with self._asking(bucket, key, self._client) as client:
            try:
                answer = client.get_object(Bucket=bucket, Key=key, Range=f'bytes={begin}-{end - 1}')
            except ClientError as error:
                if status_of(error) == RANGE_NOT_SATISFIABLE:
                    return b''
                raise
            with closing(answer['Body']) as body:
                self._full_size(answer, bucket, key, begin)
                return joined(Content(ObjectInfo(bucket, key, end - begin, None), self._pieces(bucket, key, body)), None)

    def list(self, bucket: str, prefix: str) -> Iterator[ObjectInfo]:
        """The objects under a prefix, page by page; none when there is no such bucket.

        In the server's order: AWS and MinIO compare whole keys, SeaweedFS name by name (``a/1`` before ``a-1``).
        """
        for page in self._pages(bucket, prefix):
            for entry in page.get('Contents', ()):
                yield ObjectInfo(bucket, entry['Key'], entry['Size'], None, etag=entry.get('ETag', ''),
                                 modified=entry.get('LastModified'))  # fmt: skip

    def folders(self, bucket: str, prefix: str) -> Iterator[str]:
        """The names right below a prefix that have something below them."""
        for page in self._pages(bucket, prefix, Delimiter='/'):
            yield from (entry['Prefix'][len(prefix) : -1] for entry in page.get('CommonPrefixes', ()))

    def _pages(self, bucket: str, prefix: str, **how: str) -> Iterator[Mapping[str, Any]]:
        token: dict[str, str] = {}
        while True:
            with self._asking(bucket, prefix, self._client) as client:
                try:
                    page = client.list_objects_v2(Bucket=bucket, Prefix=prefix, **how, **token)
                except ClientError as error:
                    if code_of(error) == 'NoSuchBucket':
                        return
                    raise
            if 'Name' not in page:
                raise self._not_s3(bucket, prefix)
            yield page
            if not page.get('IsTruncated'):
                return
            token = {'ContinuationToken': page['NextContinuationToken']}

    def create_bucket(self, bucket: str) -> None:
        """Returns when the bucket is there, whoever made it."""
        region = self._settings.region
        place = {} if region == 'us-east-1' else {'CreateBucketConfiguration': {'LocationConstraint': region}}
        with self._asking(bucket, '', self._client) as client:
            try:
                client.create_bucket(Bucket=bucket, **place)
            except ClientError as error:
                if code_of(error) not in {'BucketAlreadyOwnedByYou', 'BucketAlreadyExists'}:
                    raise

    def delete(self, bucket: str, key: str) -> None:
        """Returns also where there is no such object."""
        with self._asking(bucket, key, self._client) as client:
            client.delete_object(Bucket=bucket, Key=key)

    def buckets(self) -> tuple[str, ...]:
        """The names of all buckets."""
        with self._asking('', '', self._client) as client:
            answer = client.list_buckets()
        if 'Buckets' not in answer:
            raise self._not_s3('', '')
        return tuple(entry['Name'] for entry in answer['Buckets'] or ())

    def probe(self) -> None:
        """Lists the buckets; credentials that may not do that are valid all the same."""
        try:
            self.buckets()
        except AccessDenied as error:
            if error.data['code'] != 'AccessDenied':
                raise

    def asking(self, bucket: str, key: str) -> AbstractContextManager[Any]:
        """The client of botocore; nothing but a StoreError leaves."""
        return self._asking(bucket, key, self._client)

    def confirm(self, answer: Mapping[str, Any], bucket: str, key: str) -> None:
        """A captive portal answers 200 to anything, too; only an S3 server sends the ETag of an object."""
        if not answer.get('ETag'):
            raise self._not_s3(bucket, key)

    def _pieces(self, bucket: str, key: str, body: Any) -> Iterator[bytes]:
        with self._asking(bucket, key, body), closing(body):
            yield from body.iter_chunks(CHUNK_BYTES)

    def _full_size(self, answer: Mapping[str, Any], bucket: str, key: str, first: int | None) -> int:
        """Of the object that an answer is about. Raises StoreUnavailable for an answer that no S3 server gave."""
        self.confirm(answer, bucket, key)
        content_range = answer.get('ContentRange', '')
        if first is not None and not content_range.startswith(f'bytes {first}-'):
            raise self._not_s3(bucket, key)
        size = content_range.rpartition('/')[2] if content_range else str(answer.get('ContentLength', ''))
        if not (size.isascii() and size.isdigit()):
            raise self._not_s3(bucket, key)
        return int(size)

    def _not_s3(self, bucket: str, key: str) -> StoreUnavailable:
        return StoreUnavailable(
            f'{self.endpoint} does not answer like an S3 server',
            remedy=f'is this the port of the S3 server, and no login page in between? `curl -i {self.endpoint}`',
            endpoint=self.endpoint, bucket=bucket, key=key,
        )  # fmt: skip

    @contextmanager
    def _asking(self, bucket: str, key: str, asked: _Asked | None) -> Iterator[_Asked]:
        """Nothing but a StoreError leaves, also when what is asked was closed. Keys that are refused are read again."""
        if asked is None:
            raise StoreUnavailable('the store is not open', endpoint=self.endpoint, bucket=bucket, key=key)
        generation = self.generation
        try:
            yield asked
        except REQUEST_ERRORS as error:
            timeouts = (self._upload.connect_timeout_s, self._upload.read_timeout_s)
            problem = classify(error, Request(self.endpoint, bucket, key, *timeouts))
            if isinstance(problem, CredentialsRejected) and self._keys:
                self._keys.renew(generation)
            raise problem from error


def _client(session: Session, settings: StoreSettings, upload: UploadSettings) -> Any:
    """A botocore client without retries, since delivery decides when to try again.

    Bodies are not part of the signature: each has a checksum in the signed headers instead, which the server verifies, so that a
    body is read once, at its pace. They are sent without ``Expect: 100-continue``: botocore loops forever if the connection ends
    within the server's ``100 Continue``.
    """
    if tuple(int(part) for part in botocore.__version__.split('.')[:2]) < OLDEST_BOTOCORE:
        raise SettingError('botocore', botocore.__version__, 'version 1.36 or later (`pip install --upgrade boto3`)')
    config = Config(
        signature_version='s3v4', s3={'addressing_style': 'path', 'payload_signing_enabled': False},
        retries={'mode': 'standard', 'total_max_attempts': 1},
        connect_timeout=upload.connect_timeout_s, read_timeout=upload.read_timeout_s, tcp_keepalive=True,
        max_pool_connections=max(10, upload.threads), user_agent=AGENT, parameter_validation=False,
        request_checksum_calculation='when_required', response_checksum_validation='when_required',
    )  # fmt: skip
    try:
        trust = trusted(session, settings.endpoint_url or '')
        client = session.create_client('s3', endpoint_url=settings.endpoint_url, region_name=settings.region, config=config,
                                       verify=trust)  # fmt: skip
    except ValueError as error:
        endpoint = public_url(settings.endpoint_url or '')
        raise SettingError('AWS_ENDPOINT_URL', endpoint, 'a URL such as http://TOWER_IP:9000') from error
    except ProfileNotFound as error:
        raise no_profile(error) from error
    except BotoCoreError as error:
        raise SettingError('the AWS configuration', type(error).__name__, f'one that botocore can read: {error}') from error
    client.meta.events.register_last('before-parameter-build.s3', _follow_no_redirect)
    client.meta.events.unregister('before-call.s3', add_expect_header)
    return client


def _follow_no_redirect(context: dict[str, Any], **_: Any) -> None:
    """Tell botocore that it was redirected before: it asks each redirect's target for a region, which redirects again.

    With a login page that redirects everything it goes on until Python's recursion limit.
    """
    context.setdefault('s3_redirect', {})['redirected'] = True
