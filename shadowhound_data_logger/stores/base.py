"""What delivery asks of a place to keep objects. Every store passes the same conformance tests (test/stores)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from shadowhound_data_logger.model import ObjectInfo, Put, SpooledObject
from shadowhound_data_logger.stores.pace import Pace


class ObjectStore(Protocol):
    """A bucketed object store. Thread-safe after ``open``; life: New; open once; use from any thread; close once.

    Errors are those of ``shadowhound_data_logger.errors``: StoreUnavailable (transient), CredentialsRejected,
    BucketMissing, AccessDenied, ObjectRefused, ForeignObject. No other exception leaves a store.
    """

    @property
    def pace(self) -> Pace:
        """What its puts send: counted, and over a network kept to the cap."""

    def open(self) -> None:
        """Acquire clients and sockets. Does not talk to the network: a store that is away is no error yet."""

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

    def get(self, bucket: str, key: str) -> bytes:
        """The whole content. Raises ObjectRefused when there is none."""

    def get_range(self, bucket: str, key: str, start: int, length: int) -> bytes:
        """So many bytes from ``start`` on: fewer where the object ends before, none at its end or behind it.

        Raises ObjectRefused when there is no such object.
        """

    def content(self, bucket: str, key: str, start: int = 0) -> Iterator[bytes]:
        """The content from ``start`` on, in pieces of at most a megabyte. Raises as ``get_range``, at any piece."""

    def list(self, bucket: str, prefix: str = '') -> Iterator[ObjectInfo]:
        """The objects under a prefix, in key order (``sha256`` and metadata may be left out)."""

    def probe(self) -> None:
        """One cheap authenticated request; raises what a put would raise for the store as a whole."""
