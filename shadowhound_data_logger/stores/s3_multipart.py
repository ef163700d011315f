"""Puts large objects to an S3 server in parts: after an interruption, the next try sends only the missing parts.

It keeps no state: it lists the unfinished uploads and their parts on the server, so it makes no difference whether a connection
broke, the process was killed or the power failed. Each part is sent with its MD5, which the server verifies and returns as the
part's ETag (MinIO only if the MD5 was sent). The SHA-256 of all parts together is verified before the upload is completed.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final

from botocore.exceptions import ClientError

from shadowhound_data_logger.core.errors import AccessDenied, ObjectRefused, StoreError, StoreUnavailable
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.stores.content import Part, check_content, opened, parts
from shadowhound_data_logger.stores.s3_client import S3Client
from shadowhound_data_logger.stores.s3_errors import code_of, status_of
from shadowhound_data_logger.stores.s3_metadata import to_headers
from shadowhound_data_logger.stores.s3_requests import S3Requests, Sent

MULTIPART_BYTES: Final = 16 << 20
"""Larger objects are sent in parts; smaller ones are sent again completely after a broken connection."""
_LOST_PARTS: Final = frozenset({'InvalidPart', 'InvalidPartOrder', 'EntityTooSmall'})
"""The server has lost parts that it confirmed: the upload must start again."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class HeldPart:
    """A part that the server has."""

    size: int
    etag: str
    """As the server returned it, in quotes; the MD5 in hex, unless the server encrypts."""


class Multipart:
    """Puts large objects in parts, and continues interrupted uploads.

    Thread-safe. Two clients that send the same object continue or abort each other's upload, which is harmless.
    """

    def __init__(self, client: S3Client, s3: S3Requests) -> None:
        self._s3 = s3
        self._uploads = _Uploads(client)

    def put(self, item: SpooledObject, is_taken: Callable[[], bool]) -> bool:
        """One try; True once the server has confirmed the object, False if its key is taken.

        ``is_taken`` is also called immediately before the upload is completed, for servers that ignore the condition there.
        """
        with opened(item) as file:
            check_content(item, os.fstat(file).st_size, item.sha256)  # the size is known now, the content only at the end
            upload, held = self._resumed(item, file)
            try:
                etags = self._send(item, file, upload, held)
            except ObjectRefused:
                self._abort(item, upload)
                raise
            return self._complete(item, upload, etags, is_taken)

    def _resumed(self, item: SpooledObject, file: int) -> tuple[str, Mapping[int, HeldPart]]:
        """An upload of the same content with its parts, or a new one; aborts other uploads of the key."""
        found: tuple[str, Mapping[int, HeldPart]] | None = None
        for upload in self._unfinished(item):
            held = {} if found else self._held(item, upload)
            if held and _is_of(held, file, item.size):
                _log.debug('continuing the upload of %s/%s, which has %d parts', item.bucket, item.key, len(held))
                found = upload, held
            else:
                self._abort(item, upload)
        return found or (self._uploads.begin(item), {})

    def _unfinished(self, item: SpooledObject) -> list[str]:
        try:
            return self._uploads.unfinished(item)
        except AccessDenied:
            return []  # write-only credentials: the server's lifecycle rules must remove unfinished uploads

    def _held(self, item: SpooledObject, upload: str) -> Mapping[int, HeldPart]:
        try:
            return self._uploads.parts(item, upload)
        except (AccessDenied, StoreUnavailable) as error:
            if isinstance(error, StoreUnavailable) and error.data.get('reason') != 'NoSuchUpload':
                raise
            return {}

    def _send(self, item: SpooledObject, file: int, upload: str, held: Mapping[int, HeldPart]) -> dict[int, str]:
        """Send the missing parts; returns the ETags of all parts. Raises ObjectRefused if the file is not the object's."""
        whole, size, etags = hashlib.sha256(), 0, dict[int, str]()
        for number, part in enumerate(parts(file, item.size, whole), 1):
            sent = held.get(number)
            etags[number] = sent.etag if sent and _is_same(sent, part) else self._s3.put_part(item, upload, number, part)
            size += part.size
        check_content(item, size, whole.hexdigest())
        return etags

    def _complete(self, item: SpooledObject, upload: str, etags: Mapping[int, str], is_taken: Callable[[], bool]) -> bool:
        try:
            if not is_taken() and self._uploads.complete(item, upload, etags) is Sent.CREATED:
                return True
        except StoreError as error:
            if error.data.get('reason') in _LOST_PARTS:
                self._abort(item, upload)
            raise
        self._abort(item, upload)
        return False

    def _abort(self, item: SpooledObject, upload: str) -> None:
        """Abort an upload, whose parts take space on the server; if that fails, the server's lifecycle rules must do it."""
        with suppress(StoreError):
            self._uploads.abort(item, upload)


def _is_of(held: Mapping[int, HeldPart], file: int, size: int) -> bool:
    """Whether the first part on the server is the file's: uploads of other content under the same key differ."""
    first = min(held)
    for number, part in enumerate(parts(file, size, hashlib.sha256()), 1):
        if number == first:
            return _is_same(held[first], part)
    return False


def _is_same(held: HeldPart, part: Part) -> bool:
    return held.size == part.size and held.etag.strip('"') == part.md5.hex()


class _Uploads:
    """The requests of multipart uploads, except for parts: begin, list, complete, abort. Thread-safe; raises as S3Requests."""

    def __init__(self, client: S3Client) -> None:
        self._client = client

    def begin(self, item: SpooledObject) -> str:
        """Begin an upload with the object's metadata; returns its id."""
        with self._client.requesting(item.bucket, item.key) as client:
            answer = client.create_multipart_upload(
                Bucket=item.bucket, Key=item.key, ContentType=item.content_type, Metadata=to_headers(item)
            )
        self._client.confirm({'ETag': answer.get('UploadId')}, item.bucket, item.key)
        return str(answer['UploadId'])

    def unfinished(self, item: SpooledObject) -> list[str]:
        """The ids of the unfinished uploads of the object's key."""
        with self._client.requesting(item.bucket, item.key) as client:
            answer = client.list_multipart_uploads(Bucket=item.bucket, Prefix=item.key)
        return [upload['UploadId'] for upload in answer.get('Uploads', ()) if upload['Key'] == item.key]

    def parts(self, item: SpooledObject, upload: str) -> dict[int, HeldPart]:
        """The parts of an upload, by number."""
        return {part['PartNumber']: HeldPart(part['Size'], part['ETag']) for part in self._pages(item, upload)}

    def complete(self, item: SpooledObject, upload: str, etags: Mapping[int, str]) -> Sent:
        """Complete the upload unless the key is taken. Returns Sent.CREATED only if the server confirmed it."""
        parts = {'Parts': [{'PartNumber': number, 'ETag': etag} for number, etag in sorted(etags.items())]}
        sent = self._complete(item, upload, parts, {'IfNoneMatch': '*'})
        return self._complete(item, upload, parts, {}) if sent is Sent.NOT_IMPLEMENTED else sent

    def abort(self, item: SpooledObject, upload: str) -> None:
        """Abort an upload; a missing one is not an error."""
        with self._client.requesting(item.bucket, item.key) as client:
            try:
                client.abort_multipart_upload(Bucket=item.bucket, Key=item.key, UploadId=upload)
            except ClientError as error:
                if code_of(error) != 'NoSuchUpload':
                    raise

    def _pages(self, item: SpooledObject, upload: str) -> Iterator[Mapping[str, Any]]:
        after = 0
        while True:
            with self._client.requesting(item.bucket, item.key) as client:
                page = client.list_parts(Bucket=item.bucket, Key=item.key, UploadId=upload, PartNumberMarker=after)
            yield from page.get('Parts', ())
            if not page.get('IsTruncated'):
                return
            after = page['NextPartNumberMarker']

    def _complete(self, item: SpooledObject, upload: str, parts: Mapping[str, object], condition: Mapping[str, str]) -> Sent:
        with self._client.requesting(item.bucket, item.key) as client:
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
        self._client.confirm(answer, item.bucket, item.key)
        return Sent.CREATED
