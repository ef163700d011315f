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
    """An object that is being read: iterate over it once, for its bytes in pieces; leave it where not all of them are wanted."""

    info: ObjectInfo
    """Of the whole object, wherever the pieces begin."""
    pieces: Iterator[bytes]
    """Of a few megabytes at most. Raise StoreError."""
    release: Callable[[], None] = lambda: None
    """Lets go of the connection."""

    def __iter__(self) -> Iterator[bytes]:
        return self.pieces

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.release()


class ObjectStore(Protocol):
    """Puts, gets and lists objects in buckets. Thread-safe after ``open``; life: New; open once; use from any thread; close once.

    Each request is one try (``retry.steadily`` makes it more). Errors are those of ``shadowhound_data_logger.core.errors``:
    StoreUnavailable (transient), CredentialsRejected, BucketMissing, AccessDenied, ObjectRefused, ForeignObject. No other
    exception leaves a store. Whatever reads raises ObjectRefused with ``data['reason'] == 'missing'`` where there is no such
    object, and ``'name'`` for a key that can be no path.
    """

    @property
    def pace(self) -> Pace:
        """What its puts send: counted, and over a network kept to the cap."""

    def open(self) -> None:
        """Acquire clients and sockets. Does not talk to the network: a store that is away is not an error yet."""

    def close(self) -> None:
        """Release everything; idempotent."""

    def describe(self) -> str:
        """Where data goes, for a log line: URL or folder, never a secret."""

    def put(self, item: SpooledObject) -> Put:
        """Store the file at ``item.path`` under its key, never overwriting, and return once the store confirmed it.

        The content is verified by the server (checksum) or by reading back. A missing bucket is created where the
        credentials allow it. A key that already holds ``item.sha256`` is ``Put.IDENTICAL``; other content raises
        ForeignObject. A file that no longer matches ``item.size``/``item.sha256`` raises ObjectRefused.
        """

    def head(self, bucket: str, key: str) -> ObjectInfo | None:
        """The object's size and metadata, None when there is none."""

    def get(self, bucket: str, key: str, most: int | None = None) -> bytes:
        """The whole content. Raises ObjectRefused (reason ``size``) where it has more than ``most`` bytes, which are not read."""

    def ranges(self, bucket: str, key: str, spans: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        """These parts of the content, each from begin to before its end; shorter, or empty, where it ends before."""

    def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
        """The content from ``start`` on.

        ``version`` is the ETag of an earlier answer: raises ObjectRefused (reason ``changed``) where it has another one now.
        """

    def changed(self, bucket: str, key: str, version: str, most: int) -> tuple[bytes, str] | None:
        """The whole content and its version (an ETag); None where it has this version still. As ``get`` otherwise."""

    def replace(self, bucket: str, key: str, body: bytes, version: str) -> bool:
        """Put other content in the place of this version; False where another one is there meanwhile. The key must exist.

        The one thing that is ever overwritten: a mailbox. Raises ObjectRefused (``missing``) where there is no such object.
        """

    def list(self, bucket: str, prefix: str = '', skipped: Callable[[str, str], None] = warn_of) -> Iterator[ObjectInfo]:
        """The objects whose keys start with the prefix, in key order, without ``sha256`` and metadata; none without the bucket.

        An object whose key is not a path is skipped: ``skipped`` is called with its bucket and key.
        """

    def folders(self, bucket: str, prefix: str = '') -> Sequence[str]:
        """The names of the folders directly below a prefix that ends with ``/`` or is empty, sorted; of paths alone."""

    def delete(self, bucket: str, key: str) -> None:
        """For good; one that is gone already is not an error. No stage of the robot deletes."""

    def probe(self) -> None:
        """One cheap authenticated request; raises what a put would raise for the store as a whole."""


def joined(content: Content, most: int | None) -> bytes:
    """All of it. Raises ObjectRefused (reason ``size``), before it is read, where there are more than ``most`` bytes.

    A server that sends more than it said is refused as well: what it sends takes no more memory than that.
    """
    with content:
        info, pieces, size = content.info, list[bytes](), 0
        if most is not None and info.size > most:
            raise too_large(info.bucket, info.key, most)
        for piece in content:
            size += len(piece)
            if size > info.size:
                raise too_large(info.bucket, info.key, info.size)
            pieces.append(piece)
        return bytes(pieces[0]) if len(pieces) == 1 else b''.join(pieces)  # obstore's are no bytes to json


def changed_meanwhile(bucket: str, key: str) -> ObjectRefused:
    """The error for an object that is no longer the one that was asked for."""
    return ObjectRefused(f'{bucket}/{key} has changed meanwhile', reason='changed', bucket=bucket, key=key)


def too_large(bucket: str, key: str, most: int) -> ObjectRefused:
    """The error for an object that is larger than whoever asks for it can take."""
    return ObjectRefused(f'{bucket}/{key} has more than {most:,} bytes', reason='size', bucket=bucket, key=key)
