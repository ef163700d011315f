"""Stores content once if a sensor repeats it, such as a camera that sends the same image for minutes.

Content is equal if its bytes are. A repeat is a row of the index in state deduplicated, with its own times; ``content_key`` in
its metadata and in its catalog row names the object that holds the content. No file of it is written and nothing is uploaded.
Uploaded objects cannot be changed, so the metadata of the next object with other content contain the number of repeats before it.
An object that has repeats is never evicted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.model import DataObject, FileBody, State
from shadowhound_data_logger.spool.files import content_sha256
from shadowhound_data_logger.spool.index import Index

_HAS_CONTENT: Final = frozenset({State.PENDING.value, State.DELIVERED.value})


@dataclass(frozen=True, slots=True)
class _Last:
    """The last object that a sensor stored."""

    key: str
    sha256: str
    repeats: int = 0
    until_ns: int = 0


@dataclass(frozen=True, slots=True)
class Holder:
    """The object that holds the content of a repeat."""

    body: FileBody
    """With its size and checksum; the path is not used."""
    metadata: Mapping[str, str]
    """Additional metadata of the repeat."""


class Repeats:
    """Recognizes content that a sensor has just stored.

    Guarded by the spool's lock; ``holder`` and ``stored`` are for objects with ``dedup`` that are not held. It remembers only
    what this process stored: the first object after startup is always stored.
    """

    def __init__(self) -> None:
        self._last: dict[tuple[str, str, str | None], _Last] = {}
        self._next: dict[tuple[str, str, str | None], _Last] = {}

    def begin(self) -> None:
        """Begin a commit: later calls take effect with ``keep``."""
        self._next = dict(self._last)

    def keep(self) -> None:
        """The commit is durable."""
        self._last = self._next

    def expected(self, items: Sequence[DataObject]) -> frozenset[int]:
        """Indexes of objects that look like repeats, whose content need not be written."""
        last = {source: each.sha256 for source, each in self._next.items()}
        found = set[int]()
        for index, item in enumerate(items):
            if item.dedup and not item.held:
                sha256 = content_sha256(item.body)
                if last.get(_source(item)) == sha256:
                    found.add(index)
                last[_source(item)] = sha256
        return frozenset(found)

    def holder(self, index: Index, item: DataObject, sha256: str) -> Holder | None:
        """The object with this content, if it is the last one that the sensor stored and is pending or delivered."""
        last = self._next.get(_source(item))
        if last is None or last.sha256 != sha256:
            return None
        row = index.objects.row(item.bucket, last.key)
        if row is None or row['state'] not in _HAS_CONTENT or row['sha256'] != last.sha256:
            return None
        index.states.protect(item.bucket, last.key)  # its eviction would lose all its repeats, too
        self._next[_source(item)] = replace(last, repeats=last.repeats + 1, until_ns=item.t_end_ns)
        return Holder(FileBody(Path(last.key), row['bytes'], last.sha256), {meta.CONTENT_KEY: last.key})

    def stored(self, item: DataObject, key: str, sha256: str) -> Mapping[str, str]:
        """Remember an object that the sensor stored; returns the metadata that describe the repeats before it."""
        last = self._next.get(_source(item))
        self._next[_source(item)] = _Last(key, sha256)
        if last is None or not last.repeats:
            return {}
        return {meta.REPEATS: str(last.repeats), meta.REPEATS_OF: last.key, meta.REPEATS_UNTIL_NS: str(last.until_ns)}


def _source(item: DataObject) -> tuple[str, str, str | None]:
    return item.bucket, item.sensor, item.topic
