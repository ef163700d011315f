"""Puts large objects to an S3 server in parts: after an interruption the next try sends the parts that the server does not have.

It keeps no state: which upload to take up, and what of it is there, is asked of the server. So it makes no difference
whether a connection broke, the process was killed or the robot was without power. Each part is sent with its MD5, which the
server verifies and tells again as the part's ETag (MinIO only where it was sent). That all parts together are the spooled
content, by its SHA-256, is certain before the server is asked to make them the object.
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
from shadowhound_data_logger.stores.s3_errors import code_of, status_of
from shadowhound_data_logger.stores.s3_metadata import to_headers
from shadowhound_data_logger.stores.s3_requests import S3Requests, Sent

MULTIPART_BYTES: Final = 16 << 20
"""Larger objects are sent in parts: what is smaller is sent again as a whole after a broken connection."""
_LOST: Final = frozenset({'InvalidPart', 'InvalidPartOrder', 'EntityTooSmall'})
"""The server denies having parts that it confirmed: only a new upload helps."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class HeldPart:
    """A part that the server has."""

    size: int
    etag: str
    """As it wrote it, in quotes; what is in them is the MD5 in hex, unless the server encrypts."""


class Multipart:
    """Puts large objects in parts, and continues interrupted uploads.

    Thread-safe. Two that send one object at a time continue or abort each other's upload: neither does harm.
    """

    def __init__(self, s3: S3Requests) -> None:
        self._s3 = s3
        self._uploads = _Uploads(s3)

    def put(self, item: SpooledObject, is_taken: Callable[[], bool]) -> bool:
        """One try; True once the server confirmed the object, False where its key is taken by then.

        ``is_taken`` is asked right before the end as well, for a server that knows no condition there.
        """
        with opened(item) as file:
            check_content(item, os.fstat(file).st_size, item.sha256)  # its content is known at the end, but this at once
            upload, held = self._taken_up(item, file)
            try:
                etags = self._send(item, file, upload, held)
            except ObjectRefused:
                self._give_up(item, upload)
                raise
            return self._complete(item, upload, etags, is_taken)

    def _taken_up(self, item: SpooledObject, file: int) -> tuple[str, Mapping[int, HeldPart]]:
        """An upload of this very content with the parts that it has, or a new one. Others of the same key are aborted."""
        found: tuple[str, Mapping[int, HeldPart]] | None = None
        for upload in self._under_way(item):
            held = {} if found else self._held(item, upload)
            if held and _is_of(held, file, item.size):
                _log.debug('continuing the upload of %s/%s: %d parts are there', item.bucket, item.key, len(held))
                found = upload, held
            else:
                self._give_up(item, upload)
        return found or (self._uploads.begin(item), {})

    def _under_way(self, item: SpooledObject) -> list[str]:
        try:
            return self._uploads.of(item)
        except AccessDenied:
            return []  # credentials that may write only: a try that ended is left to the server's own clean-up

    def _held(self, item: SpooledObject, upload: str) -> Mapping[int, HeldPart]:
        try:
            return self._uploads.parts(item, upload)
        except (AccessDenied, StoreUnavailable) as error:
            if isinstance(error, StoreUnavailable) and error.data.get('reason') != 'NoSuchUpload':
                raise
            return {}

    def _send(self, item: SpooledObject, file: int, upload: str, held: Mapping[int, HeldPart]) -> dict[int, str]:
        """Every part that is not there yet; returns the ETags of all. Raises ObjectRefused for a file that is another one."""
        whole, size, etags = hashlib.sha256(), 0, dict[int, str]()
        for number, part in enumerate(parts(file, item.size, whole), 1):
            there = held.get(number)
            etags[number] = there.etag if there and _is_same(there, part) else self._s3.put_part(item, upload, number, part)
            size += part.size
        check_content(item, size, whole.hexdigest())
        return etags

    def _complete(self, item: SpooledObject, upload: str, etags: Mapping[int, str], is_taken: Callable[[], bool]) -> bool:
        try:
            if not is_taken() and self._uploads.complete(item, upload, etags) is Sent.CREATED:
                return True
        except StoreError as error:
            if error.data.get('reason') in _LOST:
                self._give_up(item, upload)
            raise
        self._give_up(item, upload)
        return False

    def _give_up(self, item: SpooledObject, upload: str) -> None:
        """Its parts take room on the server until then. Where that fails the server's own clean-up has to."""
        with suppress(StoreError):
            self._uploads.abort(item, upload)


def _is_of(held: Mapping[int, HeldPart], file: int, size: int) -> bool:
    """Whether the first part that is there is the file's: another content under the same key has another one."""
    first = min(held)
    for number, part in enumerate(parts(file, size, hashlib.sha256()), 1):
        if number == first:
            return _is_same(held[first], part)
    return False


def _is_same(held: HeldPart, part: Part) -> bool:
    return held.size == part.size and held.etag.strip('"') == part.md5.hex()


class _Uploads:
    """The single requests of an upload but for its parts: begin, list, complete, abort. Thread-safe; raises as S3Requests."""

    def __init__(self, s3: S3Requests) -> None:
        self._s3 = s3

    def begin(self, item: SpooledObject) -> str:
        """A new upload, with all that is to be known of the object; returns its id."""
        with self._s3.asking(item.bucket, item.key) as client:
            answer = client.create_multipart_upload(
                Bucket=item.bucket, Key=item.key, ContentType=item.content_type, Metadata=to_headers(item)
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
