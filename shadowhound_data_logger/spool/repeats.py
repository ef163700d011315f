"""Content equal to what was stored just before is kept once: a camera that shows the same picture for minutes.

Equal are the same bytes. A repeat is a row of the index in state
deduplicated, with its own time, and ``content_key`` in its metadata names the object that holds the content; so does its
row in the catalog. No file of it is written and nothing of it is sent. What was sent cannot be changed, so the first
object with another content tells, as metadata, how many repeats there were before it. What has repeats is never evicted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core import metadata_words as words
from shadowhound_data_logger.core.model import DataObject, FileBody, State
from shadowhound_data_logger.spool.files import content_sha256
from shadowhound_data_logger.spool.index import Index

_HOLDS: Final = frozenset({State.PENDING.value, State.DELIVERED.value})


@dataclass(frozen=True, slots=True)
class _Last:
    """What a sensor stored last."""

    key: str
    sha256: str
    repeats: int = 0
    until_ns: int = 0


@dataclass(frozen=True, slots=True)
class Holder:
    """The object that holds the content of a repeat."""

    body: FileBody
    """Size and checksum of the object that holds the content; its path is of no use."""
    said: Mapping[str, str]
    """Metadata of the repeat."""


class Repeats:
    """Finds content that a sensor has just stored, so that it is kept once.

    Guarded by the spool's lock. It knows only what this process stored: the first object after a start is always stored.
    """

    def __init__(self) -> None:
        self._last: dict[tuple[str, str, str | None], _Last] = {}
        self._next: dict[tuple[str, str, str | None], _Last] = {}

    def begin(self) -> None:
        """A commit begins: what is told from here on counts once it is durable."""
        self._next = dict(self._last)

    def keep(self) -> None:
        """It is durable."""
        self._last = self._next

    def expected(self, items: Sequence[DataObject]) -> frozenset[int]:
        """Places of those that look like repeats: their content need not be written."""
        last = {source: each.sha256 for source, each in self._next.items()}
        found = set[int]()
        for place, item in enumerate(items):
            if item.dedup and not item.held:
                sha256 = content_sha256(item.body)
                if last.get(_source(item)) == sha256:
                    found.add(place)
                last[_source(item)] = sha256
        return frozenset(found)

    def holder(self, index: Index, item: DataObject, sha256: str) -> Holder | None:
        """The object that holds this content already, if it is what the sensor stored last and is still on its way or there."""
        last = self._next.get(_source(item))
        if not item.dedup or item.held or last is None or last.sha256 != sha256:
            return None
        row = index.objects.row(item.bucket, last.key)
        if row is None or row['state'] not in _HOLDS or row['sha256'] != last.sha256:
            return None  # evicted, say
        index.objects.protect(item.bucket, last.key)  # else an outage that fills the disk would cost all its repeats as well
        self._next[_source(item)] = replace(last, repeats=last.repeats + 1, until_ns=item.t_end_ns)
        return Holder(FileBody(Path(last.key), row['bytes'], last.sha256), {words.CONTENT_KEY: last.key})

    def stored(self, item: DataObject, key: str, sha256: str) -> Mapping[str, str]:
        """The sensor stored this; returns what is to be said of the repeats before it."""
        if not item.dedup or item.held:
            return {}
        last = self._next.get(_source(item))
        self._next[_source(item)] = _Last(key, sha256)
        if last is None or not last.repeats:
            return {}
        return {words.REPEATS: str(last.repeats), words.REPEATS_OF: last.key, words.REPEATS_UNTIL_NS: str(last.until_ns)}


def _source(item: DataObject) -> tuple[str, str, str | None]:
    return item.bucket, item.sensor, item.topic
