"""The accounts at one instant: what a group commit writes of them, and what is told of them while they go on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PublisherRow:
    """A durable Span."""

    topic: str
    publisher: str
    first: int | None
    last: int | None
    published: int
    received: int
    missed: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class TopicRow:
    """A durable TopicAccount."""

    topic: str
    type: str
    accounting: str
    received: int
    skipped: int
    stored: int
    rejected: Mapping[str, int]
    dropped: Mapping[str, int]
    last_kept_ns: int

    @property
    def open(self) -> int:
        return self.received - self.skipped - self.stored - sum(self.rejected.values()) - sum(self.dropped.values())


@dataclass(frozen=True, slots=True)
class Totals:
    """A topic of this session at one instant, as sums."""

    type: str
    accounting: str
    received: int
    stored: int
    skipped: int
    rejected: int
    dropped: int
    """Without those of a pause, which somebody asked for."""
    paused: int
    missed: int | None
    open: int


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The accounts at one instant, as a group commit writes them."""

    topics: tuple[TopicRow, ...]
    publishers: tuple[PublisherRow, ...]
