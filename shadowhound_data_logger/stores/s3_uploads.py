"""The single requests of a multipart upload but for its parts: begin, list, complete, abort; each one try."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from botocore.exceptions import ClientError

from shadowhound_data_logger.model import SpooledObject
from shadowhound_data_logger.stores.content import object_metadata
from shadowhound_data_logger.stores.s3_errors import code_of, status_of
from shadowhound_data_logger.stores.s3_requests import S3Requests, Sent


@dataclass(frozen=True, slots=True)
class HeldPart:
    """A part that the server has."""

    size: int
    etag: str
    """As it wrote it, in quotes; what is in them is the MD5 in hex, unless the server encrypts."""


class Uploads:
    """Thread-safe, as the S3Requests that it asks with. Raises the same errors."""

    def __init__(self, s3: S3Requests) -> None:
        self._s3 = s3

    def begin(self, item: SpooledObject) -> str:
        """A new upload, with all that is to be known of the object; returns its id."""
        with self._s3.asking(item.bucket, item.key) as client:
            answer = client.create_multipart_upload(
                Bucket=item.bucket, Key=item.key, ContentType=item.content_type, Metadata=object_metadata(item)
            )
        self._s3.confirm({'ETag': answer.get('UploadId')}, item.bucket, item.key)
        return str(answer['UploadId'])

    def of(self, item: SpooledObject) -> list[str]:
        """The ids of the uploads of its key that are under way."""
        with self._s3.asking(item.bucket, item.key) as client:
            answer = client.list_multipart_uploads(Bucket=item.bucket, Prefix=item.key)
        return [upload['UploadId'] for upload in answer.get('Uploads', ()) if upload['Key'] == item.key]

    def parts(self, item: SpooledObject, upload: str) -> dict[int, HeldPart]:
        """Number -> part."""
        return {part['PartNumber']: HeldPart(part['Size'], part['ETag']) for part in self._pages(item, upload)}

    def complete(self, item: SpooledObject, upload: str, etags: Mapping[int, str]) -> Sent:
        """Make it the object, unless there is one by then. Sent.CREATED only when the server confirmed it."""
        parts = {'Parts': [{'PartNumber': number, 'ETag': etag} for number, etag in sorted(etags.items())]}
        sent = self._complete(item, upload, parts, {'IfNoneMatch': '*'})
        return self._complete(item, upload, parts, {}) if sent is Sent.NOT_IMPLEMENTED else sent

    def abort(self, item: SpooledObject, upload: str) -> None:
        """Returns also when there is no such upload."""
        with self._s3.asking(item.bucket, item.key) as client:
            try:
                client.abort_multipart_upload(Bucket=item.bucket, Key=item.key, UploadId=upload)
            except ClientError as error:
                if code_of(error) != 'NoSuchUpload':
                    raise

    def _pages(self, item: SpooledObject, upload: str) -> Iterator[Mapping[str, Any]]:
        after = 0
        while True:
            with self._s3.asking(item.bucket, item.key) as client:
                page = client.list_parts(Bucket=item.bucket, Key=item.key, UploadId=upload, PartNumberMarker=after)
            yield from page.get('Parts', ())
            if not page.get('IsTruncated'):
                return
            after = page['NextPartNumberMarker']

    def _complete(self, item: SpooledObject, upload: str, parts: Mapping[str, object], condition: Mapping[str, str]) -> Sent:
        with self._s3.asking(item.bucket, item.key) as client:
            try:
                answer = client.complete_multipart_upload(
                    Bucket=item.bucket, Key=item.key, UploadId=upload, MultipartUpload=parts, **condition
                )
            except ClientError as error:
                if status_of(error) == 412:
                    return Sent.TAKEN
                if condition and status_of(error) == 501:
                    return Sent.NOT_IMPLEMENTED
                raise
        self._s3.confirm(answer, item.bucket, item.key)
        return Sent.CREATED
