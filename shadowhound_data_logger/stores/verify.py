"""Compares objects in a store with their expected size and SHA-256; every verification uses this module.

``compare`` uses an object's metadata; ``check_object`` requests them, and can also read the content.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from shadowhound_data_logger.core.errors import AccessDenied, BucketMissing, ObjectRefused
from shadowhound_data_logger.core.model import ObjectInfo
from shadowhound_data_logger.core.retry import with_retries
from shadowhound_data_logger.stores.base import ObjectStore

MISSING: Final = 'missing'
SIZE: Final = 'size'
CHECKSUM: Final = 'checksum'
FOREIGN: Final = 'foreign'
DENIED: Final = 'denied'
UNREADABLE: Final = 'unreadable'
KINDS: Final = {
    MISSING: 'not in the store',
    SIZE: 'of another size',
    CHECKSUM: 'of other content',
    FOREIGN: 'without a checksum, so written by another program; --deep compares the content',
    DENIED: 'denied by the store, so it may exist or not',
    UNREADABLE: 'refused by the store, such as an object that a client encrypted with its own key (SSE-C)',
}
"""The kinds of findings, in words."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One object that does not match."""

    kind: str
    bucket: str
    key: str
    detail: str


def compare(held: ObjectInfo | None, size: int | None, sha256: str | None) -> str:
    """The kind of finding about an object by its metadata; empty if it matches. None means that a value is unknown."""
    if held is None:
        return MISSING
    if size not in {None, held.size}:
        return SIZE
    if sha256 in {None, held.sha256}:
        return ''
    return FOREIGN if held.sha256 is None else CHECKSUM


def check_object(store: ObjectStore, bucket: str, key: str, size: int | None, sha256: str | None, *, deep: bool = False,
                 pause: Callable[[float], object] = time.sleep) -> Finding | None:  # fmt: skip
    """None if the object in the store matches its delivery; ``deep`` also reads its content.

    Raises StoreError if that cannot be determined.
    """
    try:
        held = with_retries(lambda: store.head(bucket, key), pause=pause)
        kind = compare(held, size, sha256)
        content = ''
        if deep and sha256 is not None and kind not in {MISSING, SIZE}:
            content = with_retries(lambda: _content_sha256(store, bucket, key), pause=pause)
            if content != sha256:
                kind = CHECKSUM
            elif kind == FOREIGN:
                kind = ''
    except (BucketMissing, ObjectRefused) as error:
        is_missing = isinstance(error, BucketMissing) or error.data.get('reason') == 'missing'
        return Finding(MISSING if is_missing else UNREADABLE, bucket, key, str(error))
    except AccessDenied as error:
        return Finding(DENIED, bucket, key, str(error))
    found = {
        MISSING: '' if size is None else f'{size} bytes were delivered',
        SIZE: f'{held and held.size} bytes, {size} were delivered',
        CHECKSUM: f'SHA-256 {content}, {sha256} was delivered',
        FOREIGN: 'no sha256 in its metadata',
    }
    if kind == CHECKSUM and content in {'', sha256}:
        return Finding(kind, bucket, key, f'sha256 {held and held.sha256} in its metadata, {sha256} was delivered')
    return Finding(kind, bucket, key, found[kind]) if kind else None


def _content_sha256(store: ObjectStore, bucket: str, key: str) -> str:
    """The SHA-256 of an object, in bounded memory: a slice may have hundreds of megabytes."""
    digest = hashlib.sha256()
    with store.content(bucket, key) as content:
        for piece in content:
            digest.update(piece)
    return digest.hexdigest()
