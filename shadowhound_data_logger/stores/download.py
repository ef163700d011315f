"""An object of a store as a file: in bounded memory, taken up where it broke off, and under its name only when it is whole."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Final, Protocol

from shadowhound_data_logger.errors import ObjectRefused, StoreUnavailable
from shadowhound_data_logger.model import ObjectInfo
from shadowhound_data_logger.stores.content import CHUNK_BYTES

UNFINISHED: Final = '.part'


class Source(Protocol):
    """What a download asks of a store (stores/base.py)."""

    def head(self, bucket: str, key: str) -> ObjectInfo | None: ...

    def content(self, bucket: str, key: str, start: int = 0) -> Iterator[bytes]: ...


def download(store: Source, bucket: str, key: str, path: Path, *, tell: Callable[[int], None] = lambda _: None) -> ObjectInfo:
    """The object as ``path``, verified against its size and the ``sha256`` of its metadata, and synced; returns its description.

    What arrives lies in ``<path>.part``, which the next try continues. ``tell`` is called with the bytes that each piece adds.
    Raises StoreUnavailable where it broke off, ObjectRefused where there is none or it is not what its metadata say
    (``data['reason'] == 'damaged'``), OSError of the file.
    """
    info = store.head(bucket, key)
    if info is None:
        raise ObjectRefused(f'there is no {bucket}/{key}', reason='missing', bucket=bucket, key=key)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f'{path.name}{UNFINISHED}')
    with part.open('ab+', buffering=0) as file:
        sha256 = _complete(store, info, file, tell)
        os.fsync(file.fileno())
    if info.sha256 not in {None, sha256}:
        part.unlink()
        raise ObjectRefused(f'{bucket}/{key} has not the content that its metadata name', remedy='was it damaged in the store?',
                            reason='damaged', bucket=bucket, key=key, sha256=sha256)  # fmt: skip
    part.replace(path)
    return info


def _complete(store: Source, info: ObjectInfo, file: IO[bytes], tell: Callable[[int], None]) -> str:
    """Add what is missing; returns the SHA-256 of the whole."""
    if file.seek(0, os.SEEK_END) > info.size:  # of another object, or of none of ours
        file.truncate(0)
    file.seek(0)
    digest, size = hashlib.sha256(), 0
    while chunk := file.read(CHUNK_BYTES):
        digest.update(chunk)
        size += len(chunk)
    if size < info.size:
        for chunk in store.content(info.bucket, info.key, size):
            file.write(chunk)
            digest.update(chunk)
            size += len(chunk)
            tell(len(chunk))
    if size != info.size:
        raise StoreUnavailable(
            f'{info.bucket}/{info.key} ended after {size} of {info.size} bytes', bucket=info.bucket, key=info.key
        )
    return digest.hexdigest()
