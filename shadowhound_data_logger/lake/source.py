"""Where the lake reads: one bucket of an S3 server, or of a folder of the same layout: listed, read, and tidied up.

Nothing but a StoreError leaves, and neither a source nor its errors show a secret. Both kinds can be pickled for another process.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Final, Protocol

from shadowhound_data_logger.errors import ObjectRefused
from shadowhound_data_logger.model import ObjectInfo
from shadowhound_data_logger.options import StoreSettings

CHUNK_BYTES: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class Entry:
    """One object of a listing."""

    key: str
    size: int
    etag: str
    """Changes with the content; empty where the store has none."""
    modified: datetime


@dataclass(frozen=True, slots=True)
class Content:
    """An object that is being read: its metadata are here, its bytes come in pieces."""

    size: int
    metadata: Mapping[str, str]
    pieces: Iterator[bytes]


class Source(Protocol):
    """A bucket to read. Thread-safe."""

    @property
    def settings(self) -> StoreSettings: ...

    @property
    def bucket(self) -> str: ...

    def describe(self) -> str:
        """Where it is, for a sentence; never a secret."""

    def folders(self, prefix: str) -> list[str]:
        """The names of the folders right below a prefix that ends with ``/`` or is empty, sorted."""

    def list(self, prefix: str) -> Iterator[Entry]:
        """The objects whose keys begin so, in no order; none where there is no such bucket."""

    def read(self, key: str, most: int) -> bytes:
        """The whole content. Raises ObjectRefused when there is none, or (reason ``size``) more of it, which is not read then."""

    def ranges(self, key: str, spans: Sequence[tuple[int, int]]) -> Sequence[bytes]:
        """These parts of the content, each from its first byte to before its last one; shorter where it ends before."""

    def tail(self, key: str, count: int) -> bytes:
        """The last bytes, all of them where there are fewer."""

    def get(self, key: str) -> Content:
        """The content in pieces. Raises ObjectRefused when there is none; the pieces raise StoreError."""

    def head(self, key: str) -> ObjectInfo | None: ...

    def delete(self, keys: Sequence[str]) -> None:
        """For good; a key that is gone already is no error. Raises AccessDenied where the credentials do not allow it."""


def open_source(settings: StoreSettings, bucket: str) -> Source:
    """The bucket of the store that the settings name. Asks nobody yet."""
    if settings.endpoint_url:
        from shadowhound_data_logger.lake.s3_source import S3Source  # noqa: PLC0415 - a folder needs no obstore

        return S3Source(settings, bucket)
    from shadowhound_data_logger.lake.folder_source import FolderSource  # noqa: PLC0415

    return FolderSource(settings, bucket)


def check_read(bucket: str, key: str, size: int, most: int) -> None:
    """Raises ObjectRefused for an object that is larger than whoever asks for it can take."""
    if size > most:
        raise ObjectRefused(f'{bucket}/{key} has more than {most:,} bytes', reason='size', bucket=bucket, key=key)
