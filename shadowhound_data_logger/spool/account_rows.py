"""The rows of the accounts, as a group commit writes them and the index returns them."""

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
    last_times: Times = NO_TIMES
    """Those of the message with the number ``last``; zeros if unknown."""


@dataclass(frozen=True, slots=True)
class OtherTypeRow:
    """A type under which a topic was published but not logged."""

    topic: str
    type: str
    publishers: tuple[str, ...]
    """Node names; only the first few if there were many."""
    messages: int | None
    """Included in the topic's ``rejected``; None if they were not all received."""


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
    last_stored: Times
    """Times of the newest durable sample; zeros if there is none."""
    estimated: int = 0
    """Messages in ``received`` without sequence numbers whose losses are estimated."""
    unknown: int = 0
    """Messages in ``received`` whose losses are unknown."""
    missed: Mapping[str, int] = field(default_factory=dict)
    """Estimated losses by cause; those known from sequence numbers are in the publishers' rows."""
    first_ns: int = 0
    """Stamp of the first message after which every message is counted, by a clock that was set; 0 if unknown."""
    newest: Times = NO_TIMES
    """Times of the newest message; zeros if unknown."""
    complete_ns: int = 0
    """No message up to this stamp can still be lost on its way into the spool."""
    by_arrival: Mapping[str, int] = field(default_factory=dict)
    """Messages dated by their arrival, by the reason why their own time was not trusted."""
    corrected: Mapping[str, int] = field(default_factory=dict)
    """Messages stored after a correction, by fault."""
    stamps: StampReport | None = None
    """What was last unusual about the stamps of its publishers."""

    @property
    def open(self) -> int:
        return self.received - self.skipped - self.stored - sum(self.rejected.values()) - sum(self.dropped.values())


@dataclass(frozen=True, slots=True)
class RhythmRow:
    """The rhythm of a topic without sequence numbers (``estimator``), for the next session."""

    topic: str
    publisher: str
    """The gid of its only publisher; '' if there are several or it is unknown."""
    source: str
    """What is regular: ``stamps``, or ``counter:FIELD``."""
    period: float
    """In ns, or in counts; 0 if unknown."""
    last: int
    """The newest stamp or count."""


@dataclass(frozen=True, slots=True)
class AccountSnapshot:
    """The accounts at one instant, as a group commit writes them."""

    topics: tuple[TopicRow, ...]
    publishers: tuple[PublisherRow, ...]
    other_types: tuple[OtherTypeRow, ...] = ()
    rhythms: tuple[RhythmRow, ...] = ()
    removed: tuple[tuple[str, str], ...] = ()
    """(account, publisher) pairs whose rows of this session have been added to the sum of former publishers."""
    gaps: tuple[GapRow, ...] = ()
    taken_back: tuple[TakenBack, ...] = ()
