"""An S3 server as a store.

Guarantees: a put is one PUT with ``If-None-Match: *`` and a SHA-256, which the server verifies and which is metadata as well.
Whether the server honors the condition is verified before it is relied on: MinIO before 2024 and some others ignore it.
Servers have let two creates of one instant through (SeaweedFS 4.16): where another writer of the same keys was seen, each put
looks afterwards whose content is there, so that the one that was overwritten knows.
Of a large object it is a multipart upload (s3_multipart.py), which looks twice and sends the condition as well.
"""

from __future__ import annotations

import hashlib
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from enum import Enum
from operator import attrgetter
from typing import IO, Final, TypeVar

from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.core.errors import (
    AccessDenied,
    BucketMissing,
    CredentialsRejected,
    ForeignObject,
    ObjectRefused,
    StoreUnavailable,
)
from shadowhound_data_logger.core.model import ObjectInfo, Put, SpooledObject
from shadowhound_data_logger.core.untrusted import is_path
from shadowhound_data_logger.stores.bandwidth import Pace
from shadowhound_data_logger.stores.base import Content, joined
from shadowhound_data_logger.stores.content import check_read, check_target, chunks, identical_or_foreign, opened, paths, warn_of
from shadowhound_data_logger.stores.s3_multipart import MULTIPART_BYTES, Multipart
from shadowhound_data_logger.stores.s3_requests import S3Requests, Sent

STREAM_BYTES: Final = 4 << 20
"""Larger objects are read twice from the disk (hash, send) instead of once into memory, of which each thread takes so much."""
LOOK_FIRST_BYTES: Final = 256 << 10
"""Of a larger object it is asked first whether its key is taken: a round trip costs less than a body that is sent in vain."""
BUCKET_PAUSE_S: Final = 10.0
"""A bucket that could not be created is not asked for again sooner: each of its objects would ask."""

_log = logging.getLogger(__name__)
_Answer = TypeVar('_Answer')


class _Condition(Enum):
    """What is known of this server and ``If-None-Match: *``."""

    UNPROVED = 'unproved'
    HONOURED = 'honoured'
    IGNORED = 'ignored'


class S3Store:
    """A store on an S3 server: a put never overwrites, and is confirmed only when its content has been verified.

    ``_lock`` guards what was learnt of the server: ``_condition``, and which buckets it refused to create. ``_has_rival`` is set
    once, when somebody else's object was found under a key of ours.
    """

    def __init__(self, settings: StoreSettings, upload: UploadSettings) -> None:
        self._s3 = S3Requests(settings, upload)
        self._multipart = Multipart(self._s3)
        self._lock = threading.Lock()
        self._condition = _Condition.UNPROVED
        self._has_rival = False
        self._refused: dict[str, tuple[float, BucketMissing]] = {}
        self._created: dict[str, float] = {}
        self._creating = threading.Lock()  # held while a bucket is created, so that one thread does it

    def __repr__(self) -> str:
        return f'S3Store({self._s3.endpoint!r})'

    @property
    def pace(self) -> Pace:
        return self._s3.pace

    def open(self) -> None:
        """Raises SettingError for an endpoint no request can be sent to, or a botocore that is too old."""
        self._s3.open()

    def close(self) -> None:
        self._s3.close()

    def describe(self) -> str:
        return f'the S3 server at {self._s3.endpoint}'

    def put(self, item: SpooledObject) -> Put:
        check_target(item.bucket, item.key)
        return self._asking(lambda: self._put_somehow(item))

    def head(self, bucket: str, key: str) -> ObjectInfo | None:
        check_read(bucket, key)
        return self._asking(lambda: self._s3.head(bucket, key))

    def get(self, bucket: str, key: str, most: int | None = None) -> bytes:
        return joined(self.content(bucket, key), most)

    def ranges(self, bucket: str, key: str, spans: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        check_read(bucket, key)
        return [self._asking(lambda: self._s3.range(bucket, key, *span)) if span[0] < span[1] else b'' for span in spans]  # noqa: B023 - called at once

    def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
        check_read(bucket, key)
        return self._asking(lambda: self._s3.content(bucket, key, start, version))

    def changed(self, bucket: str, key: str, version: str, most: int) -> tuple[bytes, str] | None:
        check_read(bucket, key)
        return self._asking(lambda: self._s3.changed(bucket, key, version, most))

    def replace(self, bucket: str, key: str, body: bytes, version: str) -> bool:
        check_target(bucket, key)
        return self._asking(lambda: self._s3.replace(bucket, key, body, version))

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

    def _asking(self, ask: Callable[[], _Answer]) -> _Answer:
        """Once more where the keys were refused that somebody had changed: the new ones were read meanwhile."""
        generation = self._s3.generation
        try:
            return ask()
        except CredentialsRejected:
            if self._s3.generation == generation:
                raise
            return ask()

    def _put_somehow(self, item: SpooledObject) -> Put:
        put = self._put_in_parts if item.size > MULTIPART_BYTES else self._put_whole
        try:
            return put(item)
        except BucketMissing as error:
            self._create_bucket(item.bucket, error)
            return put(item)

    def _put_in_parts(self, item: SpooledObject) -> Put:
        """It looks first: an answer that was lost, or a key that is taken, is known before megabytes are sent in vain."""
        held = self._look(item)
        if held is not None:
            return self._judge(item, held)
        if self._multipart.put(item, lambda: self._look(item) is not None):
            self._look_again(item)
            return Put.CREATED
        return self._judge(item, self._s3.head(item.bucket, item.key))

    def _put_whole(self, item: SpooledObject) -> Put:
        with _verified(item) as body:
            return self._put(item, body)

    def _put(self, item: SpooledObject, body: bytes | IO[bytes]) -> Put:
        """One confirmed put; it looks before it leaps as long as the server's word on the condition is not proved."""
        if self._condition is not _Condition.HONOURED or item.size > LOOK_FIRST_BYTES:
            held = self._look(item)
            if held is not None:
                return self._judge(item, held)
        conditional = self._condition is not _Condition.IGNORED
        sent = self._s3.put(item, body, conditional=conditional)
        if sent is Sent.NOT_IMPLEMENTED:
            self._learn(_Condition.IGNORED, 'does not know')
            return self._put(item, body)  # which looks first now: it may have honoured the condition until this one
        if sent is Sent.TAKEN:
            self._learn(_Condition.HONOURED)
            return self._judge(item, self._s3.head(item.bucket, item.key))
        if self._condition is _Condition.UNPROVED:
            self._prove(item, body)
        self._look_again(item)
        return Put.CREATED

    def _look(self, item: SpooledObject) -> ObjectInfo | None:
        try:
            return self._s3.head(item.bucket, item.key)
        except AccessDenied:
            if self._condition is _Condition.IGNORED:  # without a look it could overwrite
                raise
            return None  # credentials that may write only: the server has to judge

    def _look_again(self, item: SpooledObject) -> None:
        """Whether it is still ours, where another put of the same instant may have replaced it. Raises ForeignObject if not."""
        if self._condition is not _Condition.IGNORED and not self._has_rival:
            return
        try:
            held = self._s3.head(item.bucket, item.key)
        except AccessDenied:  # credentials that may write only
            return
        if held is None or held.sha256 != item.sha256:
            self._judge(item, held)

    def _prove(self, item: SpooledObject, body: bytes | IO[bytes]) -> None:
        """Put the very same content once more: a server that takes it would have taken other content as well."""
        try:
            sent = self._s3.put(item, body, conditional=True)
        except StoreUnavailable as error:  # the put itself is confirmed; the next one will prove it
            _log.debug('the condition is not proved yet: %s', error)
            return
        if sent is Sent.TAKEN:
            self._learn(_Condition.HONOURED)
        else:
            self._learn(_Condition.IGNORED, 'ignores')

    def _learn(self, condition: _Condition, how: str = '') -> None:
        with self._lock:
            known = self._condition
            self._condition = condition
        if condition is _Condition.IGNORED and known is not condition:
            _log.warning(
                'Tower at %s %s If-None-Match: each put looks before and afterwards now, which is slower, and a second writer in '
                'the same instant overwrites (update the S3 server: MinIO of 2024 or later, SeaweedFS)', self._s3.endpoint, how,
            )  # fmt: skip

    def _judge(self, item: SpooledObject, held: ObjectInfo | None) -> Put:
        what = f'{item.bucket}/{item.key} on {self._s3.endpoint}'
        where = {'endpoint': self._s3.endpoint, 'bucket': item.bucket, 'key': item.key}
        if held is not None:
            if held.sha256 is None:  # nobody of ours wrote it: be sure that it is an S3 server that says so
                self._s3.probe()
            try:
                return identical_or_foreign(item, held, lambda: self._sha256(item))
            except ForeignObject:
                self._has_rival = True
                if self._s3.head(item.bucket, item.key) == held:
                    raise
            raise StoreUnavailable(f'{what} is not described twice the same: an answer broke off', **where)
        if self._is_folder(item):  # SeaweedFS answers 412 to the name of one
            raise ObjectRefused(f'{what} is a folder', **where, reason='name')
        raise StoreUnavailable(f'{what} was there and is gone again', **where)

    def _is_folder(self, item: SpooledObject) -> bool:
        """Credentials that may not list cannot tell: the object then waits instead of being refused."""
        try:
            return next(self._s3.list(item.bucket, f'{item.key}/'), None) is not None
        except AccessDenied:
            return False

    def _sha256(self, item: SpooledObject) -> str:
        digest = hashlib.sha256()
        for chunk in self._s3.content(item.bucket, item.key):
            digest.update(chunk)
        return digest.hexdigest()

    def _create_bucket(self, bucket: str, missing: BucketMissing) -> None:
        """Returns when the bucket is there; raises BucketMissing, without asking again for some seconds."""
        with self._creating:
            self._create_bucket_once(bucket, missing)

    def _create_bucket_once(self, bucket: str, missing: BucketMissing) -> None:
        with self._lock:
            since, refusal = self._refused.get(bucket, (float('-inf'), missing))
            created_s = self._created.get(bucket, float('-inf'))
        if time.monotonic() - created_s < BUCKET_PAUSE_S:
            return  # by another thread, while this one waited for it
        if time.monotonic() - since < BUCKET_PAUSE_S:
            raise refusal
        try:
            self._s3.create_bucket(bucket)
        except (AccessDenied, ObjectRefused) as error:
            refusal = BucketMissing(
                f'there is no bucket {bucket} on Tower at {self._s3.endpoint}, and these credentials may not create it',
                remedy=missing.remedy, **missing.data,
            )  # fmt: skip
            with self._lock:
                self._refused[bucket] = (time.monotonic(), refusal)
            raise refusal from error
        with self._lock:
            self._created[bucket] = time.monotonic()
        _log.info('created the bucket %s on %s', bucket, self._s3.endpoint)


@contextmanager
def _verified(item: SpooledObject) -> Iterator[bytes | IO[bytes]]:
    """The content, checked against ``item``."""
    if item.size <= STREAM_BYTES:
        yield b''.join(chunks(item))
        return
    for _ in chunks(item):
        pass
    with opened(item) as descriptor, os.fdopen(descriptor, 'rb', closefd=False) as file:
        yield file
