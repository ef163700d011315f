"""The interface of a store, for the node, the lake and the doctor. Every store passes the same tests (test/stores)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Protocol

from shadowhound_data_logger.core.errors import ObjectRefused
from shadowhound_data_logger.core.model import ObjectInfo, Put, SpooledObject
from shadowhound_data_logger.stores.bandwidth import Pace
from shadowhound_data_logger.stores.content import warn_of

if TYPE_CHECKING:
    from typing_extensions import Self


@dataclass(frozen=True, slots=True)
class Content:
    """An object that is being read: iterate once over its content. Exit the context to stop before its end."""

    info: ObjectInfo
    """Of the whole object, wherever the pieces start."""
    pieces: Iterator[bytes]
    """Up to a few megabytes each. Raises StoreError."""
    release: Callable[[], None] = lambda: None
    """Releases the connection."""

    def __iter__(self) -> Iterator[bytes]:
        return self.pieces

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.release()


class ObjectStore(Protocol):
    """Puts, gets and lists objects in buckets. Lifecycle: new; open once; use from any thread; close once.

    Each request is tried once (``retry.with_retries`` retries). The only exceptions are those of
    ``shadowhound_data_logger.core.errors``: StoreUnavailable (transient), CredentialsRejected, BucketMissing, AccessDenied,
    ObjectRefused, ForeignObject. Methods that read raise ObjectRefused with ``data['reason'] == 'missing'`` if the object does
    not exist, and ``'name'`` for a key that is not a path.
    """

    @property
    def pace(self) -> Pace:
        """Counts the bytes of puts, and limits their rate over a network."""

    def open(self) -> None:
        """Acquire clients and sockets. Sends no request, so an unreachable store is not an error yet."""

    def close(self) -> None:
        """Release everything; idempotent."""

    def describe(self) -> str:
        """The store's URL or folder for a log line, without secrets."""

    def put(self, item: SpooledObject) -> Put:
        """Store the file at ``item.path`` under its key without overwriting, and return once the store has confirmed it.

        The content is verified by the server (checksum) or by reading back. A missing bucket is created where the
        credentials allow it. A key that already holds ``item.sha256`` is ``Put.IDENTICAL``; other content raises
        ForeignObject. A file that no longer matches ``item.size``/``item.sha256`` raises ObjectRefused.
        """

    def head(self, bucket: str, key: str) -> ObjectInfo | None:
        """The object's size and metadata; None if it does not exist."""

    def get(self, bucket: str, key: str, max_bytes: int | None = None) -> bytes:
        """The whole content. Raises ObjectRefused (reason ``size``), without reading it, if it has more than ``max_bytes``."""

    def ranges(self, bucket: str, key: str, spans: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        """Parts of the content, each given as (start, exclusive end); shorter or empty beyond the end of the object."""

    def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
        """The content from ``start`` on.

        ``version`` is the ETag of an earlier answer: raises ObjectRefused (reason ``changed``) if the object has another one.
        """

    def changed(self, bucket: str, key: str, version: str, max_bytes: int) -> tuple[bytes, str] | None:
        """The whole content and its version (an ETag); None if that is still ``version``. Otherwise as ``get``."""

    def replace(self, bucket: str, key: str, body: bytes, version: str) -> bool:
        """Replace the content of an existing object; False if it no longer has this version.

        Only mailboxes are ever overwritten. Raises ObjectRefused (``missing``) if the object does not exist.
        """

    def list(self, bucket: str, prefix: str = '', skipped: Callable[[str, str], None] = warn_of) -> Iterator[ObjectInfo]:
        """The objects whose keys start with the prefix, by key, without ``sha256`` and metadata; none if the bucket is missing.

        An object whose key is not a path is skipped: ``skipped`` is called with its bucket and key.
        """

    def folders(self, bucket: str, prefix: str = '') -> Sequence[str]:
        """The names of the folders directly below a prefix that ends with ``/`` or is empty, sorted; only valid path names."""

    def delete(self, bucket: str, key: str) -> None:
        """Delete an object permanently; a missing one is not an error. The robot never deletes objects."""

    def probe(self) -> None:
        """Send a cheap authenticated request; raises what a put would raise for a fault of the store itself."""


def joined(content: Content, max_bytes: int | None) -> bytes:
    """The whole content. Raises ObjectRefused (reason ``size``), without reading it, if it has more than ``max_bytes``.

    Also refuses a server that sends more than the announced size, to bound the memory.
    """
    with content:
        info, pieces, size = content.info, list[bytes](), 0
        if max_bytes is not None and info.size > max_bytes:
            raise too_large(info.bucket, info.key, max_bytes)
        for piece in content:
            size += len(piece)
            if size > info.size:
                raise too_large(info.bucket, info.key, info.size)
            pieces.append(piece)
        return bytes(pieces[0]) if len(pieces) == 1 else b''.join(pieces)  # json does not accept obstore's type


def has_changed(bucket: str, key: str) -> ObjectRefused:
    """The error for an object that no longer has the requested version."""
    return ObjectRefused(f'{bucket}/{key} has changed', reason='changed', bucket=bucket, key=key)


def too_large(bucket: str, key: str, max_bytes: int) -> ObjectRefused:
    """The error for an object that is larger than the caller accepts."""
    return ObjectRefused(f'{bucket}/{key} has more than {max_bytes:,} bytes', reason='size', bucket=bucket, key=key)
