"""Puts to an S3 server that never overwrite and are confirmed only when the server has verified the content.

Small and medium objects are one PUT with ``If-None-Match: *`` and a SHA-256; large ones are sent in parts (s3_multipart.py).
Whether the server honors the condition is verified before it is relied on: MinIO before 2024 and some other servers ignore it.
Servers have let two creates of the same instant through (SeaweedFS 4.16): once another writer of our keys was seen, each put
checks afterwards whose content is stored, so that the writer that was overwritten finds out.
"""

from __future__ import annotations

import hashlib
import logging
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum
from typing import IO, Final

from shadowhound_data_logger.core.errors import AccessDenied, BucketMissing, ForeignObject, ObjectRefused, StoreUnavailable
from shadowhound_data_logger.core.model import ObjectInfo, Put, SpooledObject
from shadowhound_data_logger.stores.content import chunks, identical_or_foreign, opened
from shadowhound_data_logger.stores.s3_client import S3Client
from shadowhound_data_logger.stores.s3_multipart import MULTIPART_BYTES, Multipart
from shadowhound_data_logger.stores.s3_requests import S3Requests, Sent

STREAM_BYTES: Final = 4 << 20
"""Larger objects are read twice from the disk (hash, send); smaller ones once, into memory, which each thread may use."""
LOOK_FIRST_BYTES: Final = 256 << 10
"""Before a larger object, the store is asked whether its key is taken: a round trip costs less than a body sent in vain."""
BUCKET_PAUSE_S: Final = 10.0
"""A refused bucket is not requested again sooner, because each of its objects would request it."""

_log = logging.getLogger(__name__)


class _Condition(Enum):
    """Whether this server honors ``If-None-Match: *``."""

    UNKNOWN = 'unknown'
    HONORED = 'honored'
    IGNORED = 'ignored'


class ConditionalPuts:
    """Creates objects on one S3 server. Thread-safe.

    ``_lock`` guards ``_condition``. ``_has_rival`` is set once, when another writer's object was found under a key of ours.
    """

    def __init__(self, client: S3Client, s3: S3Requests) -> None:
        self._s3 = s3
        self._multipart = Multipart(client, s3)
        self._buckets = BucketCreation(s3)
        self._lock = threading.Lock()
        self._condition = _Condition.UNKNOWN
        self._has_rival = False

    def put(self, item: SpooledObject) -> Put:
        """One try, as ``ObjectStore.put``; creates a missing bucket."""
        put = self._put_in_parts if item.size > MULTIPART_BYTES else self._put_whole
        try:
            return put(item)
        except BucketMissing as error:
            self._buckets.create(item.bucket, error)
            return put(item)

    def _put_in_parts(self, item: SpooledObject) -> Put:
        """Checks first whether the key is taken, by a put whose answer was lost or another writer: parts are expensive."""
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
        """One confirmed put; checks the key first until the server is known to honor the condition."""
        if self._condition is not _Condition.HONORED or item.size > LOOK_FIRST_BYTES:
            held = self._look(item)
            if held is not None:
                return self._judge(item, held)
        conditional = self._condition is not _Condition.IGNORED
        sent = self._s3.put(item, body, conditional=conditional)
        if sent is Sent.NOT_IMPLEMENTED:
            self._learn(_Condition.IGNORED, 'does not implement')
            return self._put(item, body)  # which checks first now: the server may have honored the condition until this put
        if sent is Sent.TAKEN:
            self._learn(_Condition.HONORED)
            return self._judge(item, self._s3.head(item.bucket, item.key))
        if self._condition is _Condition.UNKNOWN:
            self._verify_condition(item, body)
        self._look_again(item)
        return Put.CREATED

    def _look(self, item: SpooledObject) -> ObjectInfo | None:
        try:
            return self._s3.head(item.bucket, item.key)
        except AccessDenied:
            if self._condition is _Condition.IGNORED:  # without this check the put could overwrite
                raise
            return None  # credentials that may only write: the server has to judge

    def _look_again(self, item: SpooledObject) -> None:
        """Raises ForeignObject if another put of the same instant has replaced the content."""
        if self._condition is not _Condition.IGNORED and not self._has_rival:
            return
        try:
            held = self._s3.head(item.bucket, item.key)
        except AccessDenied:  # credentials that may only write
            return
        if held is None or held.sha256 != item.sha256:
            self._judge(item, held)

    def _verify_condition(self, item: SpooledObject, body: bytes | IO[bytes]) -> None:
        """Put the same content again: a server that accepts it would have accepted other content as well."""
        try:
            sent = self._s3.put(item, body, conditional=True)
        except StoreUnavailable as error:  # the put itself is confirmed; the next one will verify the condition
            _log.debug('the condition is not verified yet: %s', error)
            return
        if sent is Sent.TAKEN:
            self._learn(_Condition.HONORED)
        else:
            self._learn(_Condition.IGNORED, 'ignores')

    def _learn(self, condition: _Condition, how: str = '') -> None:
        with self._lock:
            known = self._condition
            self._condition = condition
        if condition is _Condition.IGNORED and known is not condition:
            _log.warning(
                'the S3 server at %s %s If-None-Match: each put now checks before and afterwards, which is slower, and a second '
                'writer in the same instant overwrites (update the S3 server: MinIO of 2024 or later, SeaweedFS)',
                self._s3.endpoint, how,
            )  # fmt: skip

    def _judge(self, item: SpooledObject, held: ObjectInfo | None) -> Put:
        """What a taken key means: IDENTICAL if it has our content. Raises ForeignObject, ObjectRefused or StoreUnavailable."""
        what = f'{item.bucket}/{item.key} on {self._s3.endpoint}'
        where = {'endpoint': self._s3.endpoint, 'bucket': item.bucket, 'key': item.key}
        if held is not None:
            if held.sha256 is None:  # not written by this package: make sure that an S3 server answered
                self._s3.probe()
            try:
                return identical_or_foreign(item, held, lambda: self._sha256(item))
            except ForeignObject:
                self._has_rival = True
                if self._s3.head(item.bucket, item.key) == held:
                    raise
            raise StoreUnavailable(f'{what} was described differently twice: an answer was cut off', **where)
        if self._is_folder(item):  # SeaweedFS answers 412 to the name of a folder
            raise ObjectRefused(f'{what} is a folder', **where, reason='name')
        raise StoreUnavailable(f'{what} existed and is missing again', **where)

    def _is_folder(self, item: SpooledObject) -> bool:
        """False for credentials that may not list: the object then waits instead of being refused."""
        try:
            return next(self._s3.list(item.bucket, f'{item.key}/'), None) is not None
        except AccessDenied:
            return False

    def _sha256(self, item: SpooledObject) -> str:
        digest = hashlib.sha256()
        for chunk in self._s3.content(item.bucket, item.key):
            digest.update(chunk)
        return digest.hexdigest()


class BucketCreation:
    """Creates missing buckets, one thread at a time. ``_creating`` guards all of it."""

    def __init__(self, s3: S3Requests) -> None:
        self._s3 = s3
        self._creating = threading.Lock()
        self._refused: dict[str, tuple[float, BucketMissing]] = {}
        self._created: dict[str, float] = {}

    def create(self, bucket: str, missing: BucketMissing) -> None:
        """Returns when the bucket exists; raises BucketMissing, at once for some seconds after a refusal."""
        with self._creating:
            if time.monotonic() - self._created.get(bucket, float('-inf')) < BUCKET_PAUSE_S:
                return  # by another thread, while this one waited for it
            since, refusal = self._refused.get(bucket, (float('-inf'), missing))
            if time.monotonic() - since < BUCKET_PAUSE_S:
                raise refusal
            try:
                self._s3.create_bucket(bucket)
            except (AccessDenied, ObjectRefused) as error:
                refusal = BucketMissing(
                    f'the bucket {bucket} does not exist at {self._s3.endpoint}, and these credentials may not create it',
                    remedy=missing.remedy, **missing.data,
                )  # fmt: skip
                self._refused[bucket] = (time.monotonic(), refusal)
                raise refusal from error
            self._created[bucket] = time.monotonic()
        _log.info('created the bucket %s on %s', bucket, self._s3.endpoint)


@contextmanager
def _verified(item: SpooledObject) -> Iterator[bytes | IO[bytes]]:
    """The content of an object, after it was compared with its size and SHA-256."""
    if item.size <= STREAM_BYTES:
        yield b''.join(chunks(item))
        return
    for _ in chunks(item):
        pass
    with opened(item) as descriptor, os.fdopen(descriptor, 'rb', closefd=False) as file:
        yield file
