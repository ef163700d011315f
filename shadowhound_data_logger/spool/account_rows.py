"""The accounts at one instant: what a group commit writes of them, and what the status shows of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from shadowhound_data_logger.core.stamps import NO_TIMES, StampReport, Times
from shadowhound_data_logger.spool.gaps import GapRow, TakenBack


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
    heard: Times = NO_TIMES
    """Those of the message ``last``; zeros if they are unknown."""


@dataclass(frozen=True, slots=True)
class OtherTypeRow:
    """A type that a topic was published under, and that was not logged."""

    topic: str
    type: str
    publishers: tuple[str, ...]
    """Nodes, some of them where there were many."""
    messages: int | None
    """Counted among the topic's ``rejected``; None where nobody listened to all of them."""


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
    last_kept: Times
    """Those of the newest durable sample; zeros if there is none."""
    estimated: int = 0
    """Of ``received``, those without numbers whose losses are estimated."""
    unknown: int = 0
    """Of ``received``, those of which only that is known."""
    missed: Mapping[str, int] = field(default_factory=dict)
    """Estimated losses by cause; those that numbers tell are in the rows of the publishers."""
    first_ns: int = 0
    """Stamp of a message from which on all are counted, the first by a clock that was set; 0 where it is not known."""
    heard: Times = NO_TIMES
    """Those of the newest message; zeros if they are unknown."""
    complete_ns: int = 0
    """No message up to this stamp can still be lost on its way into the spool."""
    by_arrival: Mapping[str, int] = field(default_factory=dict)
    """Messages that were dated by their arrival, by the reason why their own time was not trusted."""
    corrected: Mapping[str, int] = field(default_factory=dict)
    """Stored messages that had to be corrected, by what was wrong with them."""
    stamps: StampReport | None = None
    """What was unusual about the stamps of its publishers in the end."""

    @property
    def open(self) -> int:
        return self.received - self.skipped - self.stored - sum(self.rejected.values()) - sum(self.dropped.values())


@dataclass(frozen=True, slots=True)
class RhythmRow:
    """What is known of the rhythm of a topic without numbers (``estimator``), for the next session."""

    topic: str
    publisher: str
    """The gid of its only one; '' where there are several, or where that is not known."""
    of: str
    """What has the rhythm: ``stamps``, or ``counter:FIELD``."""
    period: float
    """ns, or counts; 0 where it is not known."""
    last: int
    """The newest stamp or count."""


@dataclass(frozen=True, slots=True)
class AccountSnapshot:
    """The accounts at one instant, as a group commit writes them."""

    topics: tuple[TopicRow, ...]
    publishers: tuple[PublisherRow, ...]
    other_types: tuple[OtherTypeRow, ...] = ()
    rhythms: tuple[RhythmRow, ...] = ()
    gone: tuple[tuple[str, str], ...] = ()
    """(account, publisher) whose rows of this session are in the sums of a row of their own now."""
    gaps: tuple[GapRow, ...] = ()
    taken_back: tuple[TakenBack, ...] = ()
