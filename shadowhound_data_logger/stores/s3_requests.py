"""Single requests to an S3 server, through botocore: one try each, with a deadline and with our own errors.

They use only the subset of S3 that MinIO, SeaweedFS and AWS share. An answer that is not from an S3 server confirms nothing.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterator, Mapping
from contextlib import closing
from enum import Enum
from typing import Any, Final

from botocore.exceptions import ClientError

from shadowhound_data_logger.core.errors import AccessDenied, StoreUnavailable
from shadowhound_data_logger.core.model import ObjectInfo, SpooledObject
from shadowhound_data_logger.stores.bandwidth import Body
from shadowhound_data_logger.stores.base import Content, has_changed, joined
from shadowhound_data_logger.stores.content import CHUNK_BYTES, Part
from shadowhound_data_logger.stores.s3_client import S3Client
from shadowhound_data_logger.stores.s3_errors import code_of, status_of
from shadowhound_data_logger.stores.s3_metadata import from_headers, to_headers

FORBIDDEN: Final = 403
NOT_MODIFIED: Final = 304
CHANGED: Final = 412
"""The object does not have the requested ETag."""
RANGE_NOT_SATISFIABLE: Final = 416
"""The object ends before the first requested byte."""


class Sent(Enum):
    """The answer to a PUT that is not an error."""

    CREATED = 'created'
    TAKEN = 'taken'
    """412: the key is taken."""
    NOT_IMPLEMENTED = 'not implemented'
    """501: the server does not support the condition."""


class S3Requests:
    """Single S3 requests, tried once. Thread-safe while the client is open; raises the errors of ``s3_errors.classify``."""

    def __init__(self, client: S3Client) -> None:
        self._client = client
        self.endpoint = client.endpoint

    def put(self, item: SpooledObject, body: bytes | Body, *, conditional: bool) -> Sent:
        """One PUT, whose SHA-256 the server verifies. Returns Sent.CREATED only if the server confirmed it."""
        checksum = b64encode(bytes.fromhex(item.sha256)).decode('ascii')
        condition = {'IfNoneMatch': '*'} if conditional else {}
        with self._client.requesting(item.bucket, item.key) as client:
            try:
                answer = client.put_object(
                    Bucket=item.bucket, Key=item.key, Body=self._client.pace.body(body, item.priority), ContentLength=item.size,
                    ContentType=item.content_type, Metadata=to_headers(item), ChecksumSHA256=checksum, **condition,
                )  # fmt: skip
            except ClientError as error:
                if status_of(error) == 412:
                    return Sent.TAKEN
                if conditional and status_of(error) == 501:
                    return Sent.NOT_IMPLEMENTED
                raise
        self._client.confirm(answer, item.bucket, item.key)
        return Sent.CREATED

    def put_part(self, item: SpooledObject, upload: str, number: int, part: Part) -> str:
        """One part of a multipart upload, verified by the server; returns its ETag."""
        with self._client.requesting(item.bucket, item.key) as client:
            answer = client.upload_part(
                Bucket=item.bucket, Key=item.key, UploadId=upload, PartNumber=number, ContentLength=part.size,
                ContentMD5=b64encode(part.md5).decode('ascii'),
                Body=self._client.pace.body(part, item.priority, is_background=True),
            )  # fmt: skip
        self._client.confirm(answer, item.bucket, item.key)
        etag: str = answer['ETag']
        return etag

    def head(self, bucket: str, key: str) -> ObjectInfo | None:
        with self._client.requesting(bucket, key) as client:
            try:
                answer = client.head_object(Bucket=bucket, Key=key)
            except ClientError as error:
                if status_of(error) == 404:
                    return None
                try:  # the answer to GET has a body, with the reason
                    client.get_object(Bucket=bucket, Key=key, Range='bytes=0-0')['Body'].close()
                except ClientError as reason:
                    if status_of(reason) == status_of(error):
                        raise
                if status_of(error) != FORBIDDEN:
                    raise
                # The reason is no longer AccessDenied, which would allow a put without this check.
                raise StoreUnavailable(
                    f'{self.endpoint} refused to describe {bucket}/{key}, and gave another answer to the second request',
                    endpoint=self.endpoint, bucket=bucket, key=key,
                ) from error  # fmt: skip
        self._client.confirm(answer, bucket, key)
        if 'ContentLength' not in answer:
            raise self._client.not_s3(bucket, key)
        metadata = from_headers(answer.get('Metadata', {}))
        return ObjectInfo(bucket, key, answer['ContentLength'], metadata.get('sha256'), metadata, answer.get('ContentType', ''))

    def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
        """The object from ``start`` on. Raises ObjectRefused if it does not exist or has another version."""
        options = {**({'Range': f'bytes={start}-'} if start else {}), **({'IfMatch': version} if version else {})}
        with self._client.requesting(bucket, key) as client:
            try:
                answer = client.get_object(Bucket=bucket, Key=key, **options)
            except ClientError as error:
                if version and status_of(error) == CHANGED:
                    raise has_changed(bucket, key) from error
                if not start or status_of(error) != RANGE_NOT_SATISFIABLE:
                    raise
                info = self.head(bucket, key)  # it ends before ``start``
                if info is None:
                    raise
                return Content(info, iter(()))
            body = answer['Body']
            try:
                size = self._full_size(answer, bucket, key, start or None)
            except BaseException:
                body.close()
                raise
            if version not in {'', answer['ETag']}:  # the server ignores the condition
                body.close()
                raise has_changed(bucket, key)
        metadata = from_headers(answer.get('Metadata', {}))
        kind = answer.get('ContentType', '')
        info = ObjectInfo(bucket, key, size, metadata.get('sha256'), metadata, kind, answer['ETag'])
        return Content(info, self._pieces(bucket, key, body), body.close)

    def changed(self, bucket: str, key: str, version: str, max_bytes: int) -> tuple[bytes, str] | None:
        """The whole object and its ETag; None if that is ``version``."""
        with self._client.requesting(bucket, key) as client:
            try:
                answer = client.get_object(Bucket=bucket, Key=key, **({'IfNoneMatch': version} if version else {}))
            except ClientError as error:
                if status_of(error) == NOT_MODIFIED:
                    return None
                raise
            with closing(answer['Body']) as body:
                size = self._full_size(answer, bucket, key, None)
                found = Content(ObjectInfo(bucket, key, size, None), self._pieces(bucket, key, body))
                return joined(found, max_bytes), answer['ETag']

    def replace(self, bucket: str, key: str, body: bytes, version: str) -> bool:
        """One PUT with ``If-Match``; False if the object has another version, or another put is in progress."""
        with self._client.requesting(bucket, key) as client:
            try:
                answer = client.put_object(Bucket=bucket, Key=key, Body=body, IfMatch=version, ContentType='application/json')
            except ClientError as error:
                if status_of(error) in {409, 412}:
                    return False
                raise
        self._client.confirm(answer, bucket, key)
        return True

    def range(self, bucket: str, key: str, begin: int, end: int) -> bytes:
        """The bytes from ``begin`` to ``end`` (exclusive); fewer if the object ends before."""
        with self._client.requesting(bucket, key) as client:
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
        """The objects under a prefix, page by page; none if the bucket is missing.

        In the server's order: AWS and MinIO compare complete keys, SeaweedFS name by name (``a/1`` before ``a-1``).
        """
        for page in self._pages(bucket, prefix):
            for entry in page.get('Contents', ()):
                yield ObjectInfo(bucket, entry['Key'], entry['Size'], None, etag=entry.get('ETag', ''),
                                 modified=entry.get('LastModified'))  # fmt: skip

    def folders(self, bucket: str, prefix: str) -> Iterator[str]:
        """The names of the folders directly below a prefix."""
        for page in self._pages(bucket, prefix, Delimiter='/'):
            yield from (entry['Prefix'][len(prefix) : -1] for entry in page.get('CommonPrefixes', ()))

    def _pages(self, bucket: str, prefix: str, **options: str) -> Iterator[Mapping[str, Any]]:
        token: dict[str, str] = {}
        while True:
            with self._client.requesting(bucket, prefix) as client:
                try:
                    page = client.list_objects_v2(Bucket=bucket, Prefix=prefix, **options, **token)
                except ClientError as error:
                    if code_of(error) == 'NoSuchBucket':
                        return
                    raise
            if 'Name' not in page:
                raise self._client.not_s3(bucket, prefix)
            yield page
            if not page.get('IsTruncated'):
                return
            token = {'ContinuationToken': page['NextContinuationToken']}

    def create_bucket(self, bucket: str) -> None:
        """Create a bucket; an existing one is not an error."""
        region = self._client.region
        place = {} if region == 'us-east-1' else {'CreateBucketConfiguration': {'LocationConstraint': region}}
        with self._client.requesting(bucket, '') as client:
            try:
                client.create_bucket(Bucket=bucket, **place)
            except ClientError as error:
                if code_of(error) not in {'BucketAlreadyOwnedByYou', 'BucketAlreadyExists'}:
                    raise

    def delete(self, bucket: str, key: str) -> None:
        """Delete an object; a missing one is not an error."""
        with self._client.requesting(bucket, key) as client:
            client.delete_object(Bucket=bucket, Key=key)

    def buckets(self) -> tuple[str, ...]:
        """The names of all buckets."""
        with self._client.requesting('', '') as client:
            answer = client.list_buckets()
        if 'Buckets' not in answer:
            raise self._client.not_s3('', '')
        return tuple(entry['Name'] for entry in answer['Buckets'] or ())

    def probe(self) -> None:
        """List the buckets; credentials that may not do that are accepted, too."""
        try:
            self.buckets()
        except AccessDenied as error:
            if error.data['code'] != 'AccessDenied':
                raise

    def _pieces(self, bucket: str, key: str, body: Any) -> Iterator[bytes]:
        with self._client.translating(bucket, key), closing(body):
            yield from body.iter_chunks(CHUNK_BYTES)

    def _full_size(self, answer: Mapping[str, Any], bucket: str, key: str, first: int | None) -> int:
        """The size of the whole object. Raises StoreUnavailable for an answer that is not from an S3 server."""
        self._client.confirm(answer, bucket, key)
        content_range = answer.get('ContentRange', '')
        if first is not None and not content_range.startswith(f'bytes {first}-'):
            raise self._client.not_s3(bucket, key)
        size = content_range.rpartition('/')[2] if content_range else str(answer.get('ContentLength', ''))
        if not (size.isascii() and size.isdigit()):
            raise self._client.not_s3(bucket, key)
        return int(size)
