"""The account of one topic in one session: what became of each of its messages, and what was lost of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, MAX_AGE_NS
from shadowhound_data_logger.core.stamps import NO_TIMES, StampReport, Times
from shadowhound_data_logger.spool.account_rows import TopicRow
from shadowhound_data_logger.spool.estimator import ArrivalContext, TopicEstimate
from shadowhound_data_logger.spool.gaps import (
    DROPPED,
    ESTIMATED,
    EXACT,
    LATELY_NS,
    MISSED,
    REJECTED,
    LossTotals,
    TopicGaps,
    latest_stamp,
)
from shadowhound_data_logger.spool.span import NumberRun, Span

PAUSED: Final = 'paused'
"""Reason of messages dropped because logging was paused."""
RECEIVED_ONLY: Final = 'received-only'
GRADES: Final = (EXACT, ESTIMATED, RECEIVED_ONLY)
"""How well losses are known, best first: by sequence numbers, by a rhythm, or not at all."""
BAG: Final = 'bag:'
"""Prefix of a topic's account with the bags, which are a separate sink. ROS names cannot contain a colon."""
EVENT: Final = 'event:'
"""The same for the bags of events."""
SINKS: Final = (BAG, EVENT)
"""Sinks that write files, in which the next startup finds the messages that were open."""
WRONG_TYPE: Final = 'wrong_type'
"""Reason of messages rejected because their type is not the logged one. They share one span of this name, without gaps."""
MAX_PUBLISHERS: Final = 256
"""Publishers of a topic with separate accounts. Beyond that, those that were silent for longest are added up."""
MAX_NUMBER: Final = 1 << 62
"""A higher sequence number is ignored: it comes from the network, and SQLite's integers have 63 bits."""
FORMER: Final = '(gone)'
"""The name of the account that is the sum of former publishers."""
MAX_FORMER: Final = 500
"""Former publishers of a topic whose last numbers are remembered, so that their gap is counted if they publish again."""
MAX_OTHER_TYPES: Final = 8
"""Types of a topic that are listed by name; further ones are counted together as MORE_TYPES."""
MORE_TYPES: Final = '(more)'
MAX_NODES: Final = 3
"""Publishers of another type that are listed by name."""
Losses = Mapping[str, int] | None
"""Estimated losses before some messages, by cause; None if unknown."""


@dataclass(slots=True)
class OtherTypeAccount:
    """A type under which a topic is published besides the logged one. Guarded as its topic's account."""

    publishers: list[str] = field(default_factory=list)
    messages: int | None = 0

    def add(self, nodes: Iterable[str], *, counted: bool) -> bool:
        """Add publishers; whether that changed anything."""
        before = len(self.publishers), self.messages
        for node in nodes:
            if node and node not in self.publishers and len(self.publishers) < MAX_NODES:
                self.publishers.append(node)
        if not counted:
            self.messages = None
        return before != (len(self.publishers), self.messages)


@dataclass(slots=True)
class TopicAccount:
    """One topic in one session. Guarded by the lock of its ``Accounts``."""

    type: str = ''
    accounting: str = ''
    """The grade of the newest message; '' before the first."""
    accounting_before: str = ''
    """The same of the earlier sessions."""
    received: int = 0
    skipped: int = 0
    stored: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    by_arrival: Counter[str] = field(default_factory=Counter)
    """Messages dated by their arrival because their own time was not trusted, by reason (``stamps``)."""
    stamps: StampReport | None = None
    """What is unusual about the stamps of its publishers now; None if all are close to the arrival."""
    corrected: Counter[str] = field(default_factory=Counter)
    """Messages stored after a correction, by fault (``formats/payload.py``)."""
    publishers: dict[str, Span] = field(default_factory=dict)
    estimated: int = 0
    """Messages in ``received`` without sequence numbers that are covered by a rhythm."""
    unknown: int = 0
    """Messages in ``received`` without sequence numbers and without a rhythm."""
    estimated_missed: Counter[str] = field(default_factory=Counter)
    """Estimated losses by cause."""
    estimate: TopicEstimate = field(default_factory=TopicEstimate)
    last_stored: Times = NO_TIMES
    """Times of the newest durable sample: after a restart, sampling continues after it."""
    other_types: dict[str, OtherTypeAccount] = field(default_factory=dict)
    former: dict[str, tuple[int, int]] = field(default_factory=dict)
    """First and last sequence number of former publishers, whose accounts were added up."""
    removed: dict[str, Span | None] = field(default_factory=dict)
    """Former publishers whose rows are still in the index; with a span without counts if earlier sessions have rows, too."""
    gaps: TopicGaps = field(default_factory=TopicGaps)
    """When messages were lost."""
    unestimated_since: Times = NO_TIMES
    """Since when messages are not covered by a rhythm; zeros if they are. A rhythm found later counts back to then."""
    settled_ns: int = 0
    """No message up to this stamp was open at the last commit; the next commit makes their outcomes durable."""
    first_ns: int = 0
    """Stamp of the first message after which every message is counted, by a clock that was set."""
    complete_ns: int = 0
    """No message up to this stamp can still be lost on its way into the spool."""
    is_ambiguous: bool = False
    """Whether messages of several types cannot be distinguished, so that sequence numbers are useless."""

    @property
    def open(self) -> int:
        """Messages without an outcome yet: in an open batch, the queue, an encoder, or waiting for their commit."""
        return self.received - self.skipped - self.stored - self.rejected.total() - self.dropped.total()

    @property
    def missed(self) -> int | None:
        """Messages that were published and never taken; None if that is not known exactly."""
        if self.accounting != EXACT or self.estimated or self.unknown:
            return None
        return sum(span.missed.total() for span in self.publishers.values())

    @property
    def missed_estimated(self) -> int | None:
        """The same if a part of it is estimated; None if all is known exactly or a part is unknown."""
        if not self.estimated or self.unknown or self.is_ambiguous:
            return None
        return self.estimated_missed.total() + sum(span.missed.total() for span in self.publishers.values())

    def receive(self, publisher: str | None, number: int | None, times: Times = NO_TIMES) -> bool:
        """Count one taken message; False for a repeat. One without publisher or number is unknown until it is estimated."""
        if number is not None and number > MAX_NUMBER:
            number = None
        if publisher is not None and number is not None and (self.accounting == EXACT or self._begin_numbers()):
            span = self._span(publisher)
            if not span.observe(number, times):
                return False
            span.last_used = self.received
        else:
            if self.accounting != ESTIMATED:
                self.accounting = RECEIVED_ONLY
            self.unknown += 1
        self.received += 1
        return True

    def receive_again(self, publisher: str | None, number: int | None) -> None:
        """Count a message that was counted before and is stored once more; arguments as for ``receive``."""
        if publisher is None or number is None or not (self.accounting == EXACT or self._begin_numbers()):
            self.receive(None, None)
            return
        self._span(publisher).count()
        self.received += 1

    def drop(self, reason: str, count: int, first: Times = NO_TIMES, last: Times = NO_TIMES) -> None:
        """Count received messages as dropped; ``first`` and ``last`` are the times of the first and the last of them."""
        self.dropped[reason] += count
        if count and any(first):
            self.gaps.add(DROPPED, reason, count, first, last)

    def reject(self, reason: str, count: int, first: Times = NO_TIMES, last: Times = NO_TIMES) -> None:
        """Count received messages as rejected; times as for ``drop``."""
        self.rejected[reason] += count
        if count and any(first):
            self.gaps.add(REJECTED, reason, count, first, last)

    def reject_other_type(self, type_name: str, count: int, first: Times = NO_TIMES, last: Times = NO_TIMES) -> None:
        """Count messages of another type, which were received and discarded; times as for ``drop``."""
        self.received += count
        self.reject(WRONG_TYPE, count, first, last)
        self._span(WRONG_TYPE).add_unnumbered(count)
        other = self.other_types.get(type_name)
        if other is not None and other.messages is not None:
            other.messages += count

    def add_other_type(self, type_name: str, nodes: Iterable[str], *, counted: bool, named: bool) -> bool:
        """Record that nodes publish the topic under another type; whether that is new.

        ``counted``: its messages are received and counted (``reject_other_type``). If they are not, and no setting ``named`` the
        logged type, losses are unknown from then on: sequence numbers do not show which type a missing message had.
        """
        if type_name not in self.other_types and len(self.other_types) >= MAX_OTHER_TYPES:
            type_name, counted = MORE_TYPES, False
        other = self.other_types.get(type_name)
        is_new = other is None
        if other is None:
            other = self.other_types[type_name] = OtherTypeAccount()
        if not (counted or named or self.is_ambiguous):
            self.accounting, self.is_ambiguous, is_new = RECEIVED_ONLY, True, True
        return other.add(nodes, counted=counted) or is_new

    def observe(self, stamps: Mapping[str, Sequence[int]], context: ArrivalContext, newest: Times = NO_TIMES) -> Losses:
        """Estimate the losses before messages without numbers, just received: publisher ('' if unknown) -> stamps.

        ``newest`` are the times of the last of them, whatever the stamps are.
        """
        found = self.estimate.observe(stamps, context)
        self.unknown -= found.covered
        self.estimated += found.covered
        since = next((each for each in (self.unestimated_since, self.gaps.newest) if any(each)), newest)
        self._add_estimated(found.missed, since, newest)
        self.unestimated_since = NO_TIMES if found.covered >= found.messages else since
        self.accounting = ESTIMATED if self.estimate.known else RECEIVED_ONLY
        return found.lost

    def add_estimate(self, count: int, lost: Losses, newest: Times = NO_TIMES) -> None:
        """Use another account's estimate for the last ``count`` messages without numbers, the newest with these times."""
        if count:
            self.accounting = RECEIVED_ONLY if lost is None else ESTIMATED
            if lost is not None:
                self.unknown -= count
                self.estimated += count
                self._add_estimated(lost, self.gaps.newest, newest)
                self.estimated_missed = +self.estimated_missed

    def _add_estimated(self, lost: Mapping[str, int], before: Times, after: Times) -> None:
        """Count an estimate, or the correction of an earlier one; a correction changes the newest rows of the journal."""
        for cause, change in lost.items():
            self.estimated_missed[cause] += change
            if change > 0 and any(before) and any(after):
                self.gaps.add(MISSED, cause, change, before, after, grade=ESTIMATED)

    def recover(self, count: int, runs: Sequence[NumberRun] = ()) -> None:
        """Count messages of the previous session that its accounts did not have, found in a file.

        ``runs`` are the sequence numbers of all messages of the topic in the file; empty if unknown.
        """
        self.received += count
        spans = list(self.publishers.values())
        if not spans or (self.accounting or self.accounting_before) in {ESTIMATED, RECEIVED_ONLY}:
            self.unknown += count
            return
        if len(spans) == 1 and spans[0].recover(runs, count):
            return
        for span in spans:
            count -= span.recover_count(count)
        spans[-1].add_unnumbered(count)

    def rebase(self) -> None:
        """Do not count what is published until the next message as missed: the topic is deliberately not subscribed."""
        for span in self.publishers.values():
            span.rebase()
        self.estimate.rebase()

    def is_awaiting_publishers(self, newest_ns: int) -> bool:
        """Whether some publishers of the previous session have been received again, but others, which may have sent more, not."""
        if newest_ns - self.first_ns > LATELY_NS:
            return False
        older = [span for span in self.publishers.values() if span.has_older_rows]
        since_ns = self.gaps.before.stamp_ns - LATELY_NS
        return not all(span.inherited for span in older) and any(
            span.inherited and span.last_times.stamp_ns > since_ns for span in older
        )

    def loss_totals(self) -> LossTotals:
        """All losses so far, as the gap journal must have them."""
        found = Counter[tuple[str, str, str]]()
        for span in self.publishers.values():
            for cause, count in span.missed.items():
                found[MISSED, cause, EXACT] += max(0, count)
        for cause, count in self.estimated_missed.items():
            found[MISSED, cause, ESTIMATED] = max(0, count)
        for reason, count in self.rejected.items():
            found[REJECTED, reason, EXACT] = count
        for reason, count in self.dropped.items():
            found[DROPPED, reason, EXACT] = count
        return found

    def row(self, topic: str, count: int, newest: Times, latest_ns: int) -> TopicRow:
        """The account as it will be once ``count`` more samples, the newest with these times, are durable."""
        last = self.gaps.newest
        latest_ns = latest_stamp(last, latest_ns)
        newest_ns = min(last.stamp_ns, latest_ns)
        if not EARLIEST_SANE_NS <= self.first_ns <= latest_ns and self.gaps.has_received:
            self.first_ns = newest_ns
        if self.accounting not in {'', RECEIVED_ONLY} and not self.is_awaiting_publishers(newest_ns):
            settled_ns = self.settled_ns
            if self.open <= count:
                settled_ns = newest_ns
            elif topic.startswith(SINKS):  # written in the order of arrival
                settled_ns = newest.stamp_ns - MAX_AGE_NS
            self.complete_ns = min(max(self.complete_ns, settled_ns), latest_ns)
        return TopicRow(
            topic, self.type, self.accounting, self.received, self.skipped, self.stored + count,
            dict(self.rejected), dict(self.dropped), max(self.last_stored, newest),
            self.estimated, self.unknown, dict(+self.estimated_missed), self.first_ns,
            last._replace(stamp_ns=newest_ns), self.complete_ns, dict(self.by_arrival),
            dict(self.corrected), self.stamps,
        )  # fmt: skip

    def _begin_numbers(self) -> bool:
        """Switch to sequence numbers, without a gap for earlier messages that had none; False if numbers are useless here."""
        if self.is_ambiguous:
            return False
        if (self.accounting or self.accounting_before) in {ESTIMATED, RECEIVED_ONLY}:
            for span in self.publishers.values():
                span.rebase()
        self.accounting = EXACT
        return True

    def _span(self, publisher: str) -> Span:
        span = self.publishers.get(publisher)
        if span is None:
            if len(self.publishers) >= MAX_PUBLISHERS:
                self._add_up_silent()
            first, last = self.former.pop(publisher, (None, None))
            span = self.publishers[publisher] = Span(first, last, name=publisher, gaps=self.gaps)
        return span

    def _add_up_silent(self) -> None:
        """Replace half of the publishers, those that were silent for longest, by their sum and their last numbers."""
        own = [name for name in self.publishers if name not in {FORMER, WRONG_TYPE}]
        for name in sorted(own, key=lambda name: self.publishers[name].last_used)[: len(own) // 2]:
            span = self.publishers.pop(name)
            self.publishers.setdefault(FORMER, Span(gaps=self.gaps)).absorb(span)
            self.removed[name] = Span(span.first, span.last) if span.has_older_rows else None
            if span.first is not None and span.last is not None:
                self.former[name] = span.first, span.last
        for name in list(self.former)[:-MAX_FORMER]:
            del self.former[name]
