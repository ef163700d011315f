"""Single requests to an S3 server, through botocore's client: each one try, each with an end, each error one of ours.

Stays inside the subset that MinIO, SeaweedFS and AWS share. An answer that did not come from an S3 server confirms nothing.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from enum import Enum
from typing import IO, Any, Final

import botocore
from botocore.awsrequest import AWSPreparedRequest
from botocore.config import Config
from botocore.exceptions import BotoCoreError, ClientError
from botocore.session import Session

from shadowhound_data_logger.config import StoreSettings, UploadSettings
from shadowhound_data_logger.errors import SettingError, StoreUnavailable
from shadowhound_data_logger.model import ObjectInfo, SpooledObject
from shadowhound_data_logger.stores.content import CHUNK_BYTES, object_metadata
from shadowhound_data_logger.stores.pace import Pace
from shadowhound_data_logger.stores.s3_errors import REQUEST_ERRORS, Request, classify, code_of, public_url, status_of

OLDEST_BOTOCORE: Final = (1, 36)
"""The first with If-None-Match on PUT and the checksum settings; Debian's of Humble and Jazzy are older."""

UNASKED_BYTES: Final = 256 << 10
"""A body up to this size leaves without the server's leave (``Expect: 100-continue``, a round trip more).

A server that refuses a request reads so much of an unwanted body to keep the connection (net/http of Go, which MinIO and
SeaweedFS are built on: maxPostHandlerReadBytes); of a larger one nothing is sent in vain.
"""


class Sent(Enum):
    """How a PUT was answered, where that is no error yet."""

    CREATED = 'created'
    TAKEN = 'taken'
    """412: the key holds something."""
    NOT_IMPLEMENTED = 'not implemented'
    """501: the server does not know the condition."""


class S3Requests:
    """Thread-safe after ``open``. Raises the errors of ``classify``."""

    def __init__(self, settings: StoreSettings, upload: UploadSettings) -> None:
        self.endpoint = public_url(settings.endpoint_url or '')
        """Without credentials."""
        self._settings = settings
        self._upload = upload
        self.pace = Pace(upload.max_mbps)
        self._here = threading.local()  # this thread's put: ``pieces`` and ``size``
        self._client: Any = None

    def open(self) -> None:
        """Raises SettingError for an endpoint no request can be sent to, or a botocore that is too old."""
        if self._client is None:
            self._client = _client(self._settings, self._upload)
            self._client.meta.events.register_last('before-send.s3.PutObject', self._pace_body)

    def close(self) -> None:
        client, self._client = self._client, None
        self.pace.abandon()
        if client is not None:
            client.close()

    def put(self, item: SpooledObject, body: bytes | IO[bytes], crc32: str, *, conditional: bool) -> Sent:
        """One PUT; ``crc32`` in base64. Returns Sent.CREATED only when the server confirmed it."""
        condition = {'IfNoneMatch': '*'} if conditional else {}
        if not isinstance(body, bytes):
            body.seek(0)
        with self._sending(item, body), self._asking(item.bucket, item.key) as client:
            try:
                answer = client.put_object(
                    Bucket=item.bucket, Key=item.key, Body=body, ContentLength=item.size, ChecksumCRC32=crc32,
                    ContentType=item.content_type, Metadata=object_metadata(item), **condition,
                )  # fmt: skip
            except ClientError as error:
                if status_of(error) == 412:
                    return Sent.TAKEN
                if conditional and status_of(error) == 501:
                    return Sent.NOT_IMPLEMENTED
                raise
        self._confirm(answer, item.bucket, item.key)
        return Sent.CREATED

    def head(self, bucket: str, key: str) -> ObjectInfo | None:
        with self._asking(bucket, key) as client:
            try:
                answer = client.head_object(Bucket=bucket, Key=key)
            except ClientError as error:
                if status_of(error) == 404:
                    return None
                try:  # its answer has a body: the reason
                    client.get_object(Bucket=bucket, Key=key, Range='bytes=0-0')['Body'].close()
                except ClientError as reason:
                    if status_of(reason) == status_of(error):  # else it is another trouble, or over: there is no such key, say
                        raise
                raise
        self._confirm(answer, bucket, key)
        if 'ContentLength' not in answer:
            raise self._not_s3(bucket, key)
        metadata = answer.get('Metadata', {})
        return ObjectInfo(bucket, key, answer['ContentLength'], metadata.get('sha256'), metadata, answer.get('ContentType', ''))

    def content(self, bucket: str, key: str) -> Iterator[bytes]:
        """The object in pieces. Raises ObjectRefused when there is none."""
        with self._asking(bucket, key) as client:
            answer = client.get_object(Bucket=bucket, Key=key)
            self._confirm(answer, bucket, key)
            yield from answer['Body'].iter_chunks(CHUNK_BYTES)

    def list(self, bucket: str, prefix: str) -> Iterator[ObjectInfo]:
        """The objects under a prefix, page by page; none when there is no such bucket.

        In the server's order: AWS and MinIO compare whole keys, SeaweedFS name by name (``a/1`` before ``a-1``).
        """
        token: dict[str, str] = {}
        while True:
            with self._asking(bucket, prefix) as client:
                try:
                    page = client.list_objects_v2(Bucket=bucket, Prefix=prefix, **token)
                except ClientError as error:
                    if code_of(error) == 'NoSuchBucket':
                        return
                    raise
            if 'Name' not in page:
                raise self._not_s3(bucket, prefix)
            for entry in page.get('Contents', ()):
                yield ObjectInfo(bucket, entry['Key'], entry['Size'], None)
            if not page.get('IsTruncated'):
                return
            token = {'ContinuationToken': page['NextContinuationToken']}

    def create_bucket(self, bucket: str) -> None:
        """Returns when the bucket is there, whoever made it."""
        region = self._settings.region
        place = {} if region == 'us-east-1' else {'CreateBucketConfiguration': {'LocationConstraint': region}}
        with self._asking(bucket) as client:
            try:
                client.create_bucket(Bucket=bucket, **place)
            except ClientError as error:
                if code_of(error) not in {'BucketAlreadyOwnedByYou', 'BucketAlreadyExists'}:
                    raise

    def probe(self) -> None:
        """Lists the buckets; credentials that may not do that are valid all the same."""
        with self._asking() as client:
            try:
                answer = client.list_buckets()
            except ClientError as error:
                if code_of(error) == 'AccessDenied':
                    return
                raise
        if 'Buckets' not in answer:
            raise self._not_s3('', '')

    @contextmanager
    def _sending(self, item: SpooledObject, body: bytes | IO[bytes]) -> Iterator[None]:
        """Tell ``_pace_body`` what this thread sends."""
        self._here.pieces, self._here.size = self.pace.pieces(body, item.priority), item.size
        try:
            yield
        finally:
            self._here.pieces = None  # it may hold the body

    def _pace_body(self, request: AWSPreparedRequest, **_: Any) -> None:
        """Called by botocore with a PUT that is signed: what it read of the body until now, it did not send."""
        request.body = self._here.pieces
        if self._here.size <= UNASKED_BYTES and 'Expect' in request.headers:
            del request.headers['Expect']

    def _confirm(self, answer: Mapping[str, Any], bucket: str, key: str) -> None:
        """A captive portal answers 200 to anything, too; only an S3 server sends the ETag of an object."""
        if not answer.get('ETag'):
            raise self._not_s3(bucket, key)

    def _not_s3(self, bucket: str, key: str) -> StoreUnavailable:
        return StoreUnavailable(
            f'{self.endpoint} does not answer like an S3 server',
            remedy=f'is this the port of the S3 server, and no login page in between? `curl -i {self.endpoint}`',
            endpoint=self.endpoint, bucket=bucket, key=key,
        )  # fmt: skip

    @contextmanager
    def _asking(self, bucket: str = '', key: str = '') -> Iterator[Any]:
        """The client; nothing but a StoreError leaves."""
        client = self._client
        if client is None:
            raise StoreUnavailable('the store is not open', endpoint=self.endpoint, bucket=bucket, key=key)
        try:
            yield client
        except REQUEST_ERRORS as error:
            timeouts = (self._upload.connect_timeout_s, self._upload.read_timeout_s)
            raise classify(error, Request(self.endpoint, bucket, key, *timeouts)) from error


def _client(settings: StoreSettings, upload: UploadSettings) -> Any:
    """A botocore client without retries of its own: delivery decides when to try again.

    Its own user agent and validation would cost a seventh of a put's CPU.
    """
    if tuple(int(part) for part in botocore.__version__.split('.')[:2]) < OLDEST_BOTOCORE:
        raise SettingError('botocore', botocore.__version__, 'version 1.36 or later (`pip install --upgrade boto3`)')
    if bool(settings.access_key_id) != bool(settings.secret_access_key):
        name = 'AWS_SECRET_ACCESS_KEY' if settings.access_key_id else 'AWS_ACCESS_KEY_ID'
        raise SettingError(name, '', 'both of AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or neither')
    config = Config(
        signature_version='s3v4', s3={'addressing_style': 'path'}, retries={'mode': 'standard', 'total_max_attempts': 1},
        connect_timeout=upload.connect_timeout_s, read_timeout=upload.read_timeout_s, tcp_keepalive=True,
        max_pool_connections=max(10, upload.threads), user_agent='shadowhound-data-logger', parameter_validation=False,
        request_checksum_calculation='when_required', response_checksum_validation='when_required',
    )  # fmt: skip
    try:
        client = _session(settings).create_client(
            's3', endpoint_url=settings.endpoint_url, region_name=settings.region, config=config,
            aws_access_key_id=settings.access_key_id, aws_secret_access_key=settings.secret_access_key,
            aws_session_token=settings.session_token,
        )  # fmt: skip
    except ValueError as error:
        endpoint = public_url(settings.endpoint_url or '')
        raise SettingError('AWS_ENDPOINT_URL', endpoint, 'a URL such as http://TOWER_IP:9000') from error
    except BotoCoreError as error:
        raise SettingError('the AWS configuration', type(error).__name__, f'one that botocore can read: {error}') from error
    client.meta.events.register_last('before-parameter-build.s3', _follow_no_redirect)
    return client


def _follow_no_redirect(context: dict[str, Any], **_: Any) -> None:
    """Tell botocore that it was redirected before: it asks each redirect's target for a region, which redirects again.

    With a login page that redirects everything it goes on until Python's recursion limit.
    """
    context.setdefault('s3_redirect', {})['redirected'] = True


def _session(settings: StoreSettings) -> Session:
    """Credentials in hand need no profile; a server of one's own is not asked for through the cloud's metadata service."""
    if settings.access_key_id:
        return Session(session_vars={'profile': (None, None, None, None)})
    session = Session()
    if '.amazonaws.com' not in (settings.endpoint_url or ''):
        session.get_component('credential_provider').remove('iam-role')
    return session
