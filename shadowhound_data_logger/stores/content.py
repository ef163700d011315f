"""What stores need for a put: the verified content of a spooled file, whole or in parts, and the verdict on a taken key.

A large file is never held in memory: each of its parts is read twice, to hash it and to send it.
"""

from __future__ import annotations

import errno
import hashlib
import logging
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Final

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.errors import ForeignObject, NameRefused, ObjectRefused, StoreUnavailable
from shadowhound_data_logger.core.keys import check_key, check_name
from shadowhound_data_logger.core.model import ObjectInfo, Put, SpooledObject
from shadowhound_data_logger.core.untrusted import is_path, visible

_TRANSIENT: Final = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ESTALE, errno.EINTR, errno.EAGAIN})
"""Errors of this process or machine; others, such as EIO from a failing disk, concern the file."""
CHUNK_BYTES: Final = 1 << 20
"""Most objects are smaller, and are read, hashed and sent in one piece."""
PART_BYTES: Final = 8 << 20
"""Sent again after a broken connection, which takes 8 s at 1 MB/s. S3 requires at least 5 MiB."""
MAX_PARTS: Final = 10_000
"""S3's own limit."""

log = logging.getLogger(__name__)


def check_target(bucket: str, key: str) -> None:
    """Raises ObjectRefused (``data['reason'] == 'name'``) for a bucket or key that is invalid for a put."""
    try:
        check_name(bucket, 'the bucket')
        check_key(key)
    except NameRefused as error:
        raise ObjectRefused(str(error), reason='name', bucket=bucket, key=key) from error


def check_read(bucket: str, key: str) -> None:
    """The same for reading: objects of other programs may have any key that is a path."""
    try:
        check_name(bucket, 'the bucket')
    except NameRefused as error:
        raise ObjectRefused(str(error), reason='name', bucket=bucket, key=key) from error
    if not is_path(key):
        raise ObjectRefused(f'the key {key[:200]!r} is not a path below a folder', reason='name', bucket=bucket, key=key)


@lru_cache(maxsize=1024)
def warn_of(bucket: str, key: str) -> None:
    """Log that an object is skipped, once per process."""
    log.warning('%s/%s is skipped: its key is not a path', bucket, visible(key))


def paths(entries: Iterable[ObjectInfo], skipped: Callable[[str, str], None]) -> Iterator[ObjectInfo]:
    """The objects whose keys are paths; ``skipped`` is called with the bucket and key of each other one.

    Other programs create keys such as ``a//b``, ``a/`` or with a control character: no file can have such a name, and some
    clients request a different object than the listed one.
    """
    for entry in entries:
        if is_path(entry.key):
            yield entry
        else:
            skipped(entry.bucket, entry.key)


def chunks(item: SpooledObject) -> Iterator[bytes]:
    """The file's content in pieces. Raises ObjectRefused (``data['reason'] == 'damaged'``) if it is not ``item``'s.

    That is known only after the last piece: do not use the content before the iterator has ended.
    """
    digest, size = hashlib.sha256(), 0
    with opened(item) as file:
        while size <= item.size:
            wanted = min(CHUNK_BYTES, item.size - size + 1)
            if not (chunk := os.read(file, wanted)):
                break
            size += len(chunk)
            digest.update(chunk)
            yield chunk
            if size == item.size and len(chunk) < wanted:
                break
    check_content(item, size, digest.hexdigest())


def check_content(item: SpooledObject, size: int, sha256: str) -> None:
    """Raises ObjectRefused if size or SHA-256 are not the item's."""
    if size != item.size:
        raise _damaged(item, f'its size is not {item.size} bytes')
    if sha256 != item.sha256:
        raise _damaged(item, 'its SHA-256 differs')


@contextmanager
def opened(item: SpooledObject) -> Iterator[int]:
    """A descriptor: a file object makes twice as many system calls, and each one lets other threads run first.

    An OSError inside becomes ObjectRefused (``damaged``), or StoreUnavailable if it is transient.
    """
    try:
        descriptor = os.open(item.path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            yield descriptor
        finally:
            os.close(descriptor)
    except FileNotFoundError as error:
        raise _damaged(item, 'it is missing') from error
    except OSError as error:
        if error.errno in _TRANSIENT:
            raise StoreUnavailable(f'the spooled file {item.path} cannot be read now: {error.strerror}') from error
        raise _damaged(item, f'it cannot be read: {error.strerror}') from error


def object_metadata(item: SpooledObject) -> dict[str, str]:
    """The metadata that a store keeps with the content; always with ``sha256``."""
    return {**item.metadata, meta.SHA256: item.sha256}


def identical_or_foreign(item: SpooledObject, held: ObjectInfo, content_sha256: Callable[[], str]) -> Put:
    """``Put.IDENTICAL`` if a taken key has our content; otherwise raises ForeignObject.

    ``content_sha256`` is called only if the sizes are equal and the metadata have no checksum (another program wrote it).
    """
    found = held.sha256
    if held.size == item.size:
        found = found or content_sha256()
        if found == item.sha256:
            return Put.IDENTICAL
    raise ForeignObject(
        f'{item.bucket}/{item.key} already has other content ({held.size} bytes, ours has {item.size})',
        remedy='it is not overwritten; does another robot use the same name?',
        bucket=item.bucket, key=item.key, held_size=held.size, held_sha256=found, size=item.size, sha256=item.sha256,
    )  # fmt: skip


def _damaged(item: SpooledObject, detail: str) -> ObjectRefused:
    return ObjectRefused(
        f'the spooled file of {item.bucket}/{item.key} is damaged: {detail}',
        remedy=f'check {item.path}', reason='damaged', bucket=item.bucket, key=item.key, path=str(item.path),
    )  # fmt: skip


@dataclass(slots=True)
class Part:
    """Bytes ``start`` to ``start + size`` of an open file, as a body to send."""

    file: int
    """The descriptor, which several parts may share, because they use pread."""
    start: int
    size: int
    md5: bytes
    _place: int = field(default=0, init=False)

    def seek(self, place: int, /) -> int:
        self._place = place
        return place

    def read(self, size: int, /) -> bytes:
        found = os.pread(self.file, min(size, self.size - self._place), self.start + self._place)
        self._place += len(found)
        return found


def parts(file: int, size: int, whole: Any) -> Iterator[Part]:
    """The parts of a file of that size, in order; updates the hash ``whole`` with all bytes. Raises OSError.

    Ends early if the file is shorter.
    """
    step = part_bytes(size)
    for start in range(0, size, step):
        part = _hashed(file, start, min(step, size - start), whole)
        if part.size:
            yield part


def part_bytes(size: int) -> int:
    """The size of each part but the last, for a file of that size."""
    return max(PART_BYTES, -(-size // MAX_PARTS))


def _hashed(file: int, start: int, size: int, whole: Any) -> Part:
    md5, place = hashlib.md5(usedforsecurity=False), 0
    while place < size and (chunk := os.pread(file, min(CHUNK_BYTES, size - place), start + place)):
        md5.update(chunk)
        whole.update(chunk)
        place += len(chunk)
    return Part(file, start, place, md5.digest())
