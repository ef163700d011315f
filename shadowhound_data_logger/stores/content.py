"""What stores need for a put: a spooled file's content, whole or in parts, verified; and whether a taken key has the same.

Nothing of a large file is held in memory: each of its parts is read twice, to know it and to send it.
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

from shadowhound_data_logger.core import metadata_words as words
from shadowhound_data_logger.core.errors import ForeignObject, NameRefused, ObjectRefused, StoreUnavailable
from shadowhound_data_logger.core.keys import check_key, check_name
from shadowhound_data_logger.core.model import ObjectInfo, Put, SpooledObject
from shadowhound_data_logger.core.untrusted import is_path, visible

_PASSING: Final = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ESTALE, errno.EINTR, errno.EAGAIN})
"""Troubles of this process or machine that say nothing of the file; EIO does: its disk is rotten."""
CHUNK_BYTES: Final = 1 << 20
"""Most objects are smaller: they are read, hashed and sent as one piece."""
PART_BYTES: Final = 8 << 20
"""What a broken connection costs at most: eight seconds of a link of 1 MB/s. S3 allows no smaller one than 5 MiB."""
MAX_PARTS: Final = 10_000
"""S3's own limit."""

log = logging.getLogger(__name__)


def check_target(bucket: str, key: str) -> None:
    """Raises ObjectRefused (``data['reason'] == 'name'``) for a bucket or key that no store may be asked for."""
    try:
        check_name(bucket, 'the bucket')
        check_key(key)
    except NameRefused as error:
        raise ObjectRefused(str(error), reason='name', bucket=bucket, key=key) from error


def check_read(bucket: str, key: str) -> None:
    """The same for reading: what other programs wrote may be read by any key that is a path."""
    try:
        check_name(bucket, 'the bucket')
    except NameRefused as error:
        raise ObjectRefused(str(error), reason='name', bucket=bucket, key=key) from error
    if not is_path(key):
        raise ObjectRefused(f'the key {key[:200]!r} is not a path below a folder', reason='name', bucket=bucket, key=key)


@lru_cache(maxsize=1024)
def warn_of(bucket: str, key: str) -> None:
    """Once per process and object."""
    log.warning('%s/%s is skipped: its key is not a path', bucket, visible(key))


def paths(entries: Iterable[ObjectInfo], skipped: Callable[[str, str], None]) -> Iterator[ObjectInfo]:
    """The objects whose keys are paths; ``skipped`` is called with bucket and key of each of the others.

    Such keys (``a//b``, ``a/``, with a control character) are made by other programs: no file can have such a name, and some
    clients ask for another object than the one that was listed.
    """
    for entry in entries:
        if is_path(entry.key):
            yield entry
        else:
            skipped(entry.bucket, entry.key)


def chunks(item: SpooledObject) -> Iterator[bytes]:
    """The file's content in pieces; raises ObjectRefused (``data['reason'] == 'damaged'``) where it is not ``item``'s.

    The verdict comes after the last piece: nothing of it is final before the iterator ended.
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
    """Raises ObjectRefused where what was read is not the item's content."""
    if size != item.size:
        raise _damaged(item, f'its size is not {item.size} bytes')
    if sha256 != item.sha256:
        raise _damaged(item, 'its SHA-256 differs')


@contextmanager
def opened(item: SpooledObject) -> Iterator[int]:
    """A descriptor, not a file object: that asks the system twice as often, and each time other threads may go first.

    An OSError within is the file's: it is ObjectRefused (``damaged``), or StoreUnavailable where it may pass.
    """
    try:
        descriptor = os.open(item.path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            yield descriptor
        finally:
            os.close(descriptor)
    except FileNotFoundError as error:
        raise _damaged(item, 'it is gone') from error
    except OSError as error:
        if error.errno in _PASSING:
            raise StoreUnavailable(f'the spooled file {item.path} cannot be read now: {error.strerror}') from error
        raise _damaged(item, f'it cannot be read: {error.strerror}') from error


def object_metadata(item: SpooledObject) -> dict[str, str]:
    """What a store keeps beside the content: the object's own metadata, ``sha256`` always among it."""
    return {**item.metadata, words.SHA256: item.sha256}


def identical_or_foreign(item: SpooledObject, held: ObjectInfo, content_sha256: Callable[[], str]) -> Put:
    """Judge a key that is taken: ``Put.IDENTICAL``, or ForeignObject.

    ``content_sha256`` is asked only when the sizes agree and no metadata tells (another program wrote it).
    """
    found = held.sha256
    if held.size == item.size:
        found = found or content_sha256()
        if found == item.sha256:
            return Put.IDENTICAL
    raise ForeignObject(
        f'{item.bucket}/{item.key} holds other content already ({held.size} bytes, ours has {item.size})',
        remedy='it is never overwritten; does a second writer use the same robot name?',
        bucket=item.bucket, key=item.key, held_size=held.size, held_sha256=found, size=item.size, sha256=item.sha256,
    )  # fmt: skip


def _damaged(item: SpooledObject, detail: str) -> ObjectRefused:
    return ObjectRefused(
        f'the spooled file of {item.bucket}/{item.key} is not what was spooled: {detail}',
        remedy=f'look at {item.path}', reason='damaged', bucket=item.bucket, key=item.key, path=str(item.path),
    )  # fmt: skip


@dataclass(slots=True)
class Part:
    """Bytes ``start`` ... ``start + size`` of an open file, as a body to send."""

    file: int
    """The descriptor; only read at places of its own, so several may share it."""
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
    """The parts of a file of that size, in order; ``whole`` is told all of its bytes. Raises OSError.

    A file that is shorter ends them early.
    """
    step = part_bytes(size)
    for start in range(0, size, step):
        part = _known(file, start, min(step, size - start), whole)
        if part.size:
            yield part


def part_bytes(size: int) -> int:
    """Of each part but the last, for a file of that size."""
    return max(PART_BYTES, -(-size // MAX_PARTS))


def _known(file: int, start: int, size: int, whole: Any) -> Part:
    md5, place = hashlib.md5(usedforsecurity=False), 0
    while place < size and (chunk := os.pread(file, min(CHUNK_BYTES, size - place), start + place)):
        md5.update(chunk)
        whole.update(chunk)
        place += len(chunk)
    return Part(file, start, place, md5.digest())
