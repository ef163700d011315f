"""What became of every message, counted in memory: the live half of the ledger.

One lock guards all of it. Every message is received once, and then skipped, rejected, dropped or stored once; whatever
has no outcome yet is open. ``snapshot`` is taken by the spool inside a group commit, so that what is durable balances too.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, MAX_AGE_NS, Clock
from shadowhound_data_logger.core.stamps import NO_TIMES, StampReport, Times
from shadowhound_data_logger.core.status import OtherType, Totals
from shadowhound_data_logger.spool.account_rows import AccountSnapshot, OtherTypeRow, PublisherRow, RhythmRow, TopicRow
from shadowhound_data_logger.spool.estimator import ArrivalContext, Expectation, TopicEstimate
from shadowhound_data_logger.spool.gaps import (
    DROPPED,
    ESTIMATED,
    EXACT,
    LATELY_NS,
    MISSED,
    REJECTED,
    Figures,
    TopicGaps,
    latest,
    latest_stamp,
)
from shadowhound_data_logger.spool.span import NumberRun, Span

PAUSED: Final = 'paused'
"""Why messages are dropped that come during a pause."""
RECEIVED_ONLY: Final = 'received-only'
GRADES: Final = (EXACT, ESTIMATED, RECEIVED_ONLY)
"""How good the accounting of a message is, best first: what was missed beside it is known by numbers, by a rhythm, or not."""
BAG: Final = 'bag:'
"""Before the name of a topic: its account with the bags, a sink of its own. No name of ROS has a colon."""
EVENT: Final = 'event:'
"""The same with the bags of events."""
SINKS: Final = (BAG, EVENT)
"""What is open there is in files, which the next start finds."""
WRONG_TYPE: Final = 'wrong_type'
"""Why messages are rejected that a topic carries besides those that are logged. They have one span, of this name: no gaps."""
MAX_PUBLISHERS: Final = 256
"""Publishers of a topic with accounts of their own. Where there are more, those that were silent for longest are added up."""
MAX_NUMBER: Final = 1 << 62
"""A message with a higher number has none: it comes from the network, and SQLite's end at 63 bits."""
GONE: Final = '(gone)'
"""Whose account that is."""
MAX_GONE: Final = 500
"""Such publishers of a topic whose last numbers are remembered, in case they publish again; so a gap of theirs is none less."""
MAX_OTHER_TYPES: Final = 8
"""Of one topic, by name; all further ones are one: MORE_TYPES."""
MORE_TYPES: Final = '(more)'
MAX_NODES: Final = 3
"""Publishers of such a type, by name."""
Losses = Mapping[str, int] | None
"""What was lost before some messages, by cause, as far as it is estimated; None where it is not known."""


@dataclass(slots=True)
class OtherTypeAccount:
    """A type that a topic is published under besides the one that is logged. Guarded as its topic's account is."""

    publishers: list[str] = field(default_factory=list)
    messages: int | None = 0

    def see(self, nodes: Iterable[str], *, counted: bool) -> bool:
        """Whether that is news."""
        before = len(self.publishers), self.messages
        for node in nodes:
            if node and node not in self.publishers and len(self.publishers) < MAX_NODES:
                self.publishers.append(node)
        if not counted:
            self.messages = None
        return before != (len(self.publishers), self.messages)


@dataclass(slots=True)
class TopicAccount:
    """One topic of one session. Mutated only under the lock of the Accounts it belongs to."""

    type: str = ''
    accounting: str = ''
    """The grade of the newest message; '' before the first."""
    before: str = ''
    """The same of the sessions before."""
    received: int = 0
    skipped: int = 0
    stored: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    by_arrival: Counter[str] = field(default_factory=Counter)
    """Messages whose stamp or time of sending was replaced by their arrival, by reason (``stamps``)."""
    stamps: StampReport | None = None
    """What is unusual about the stamps of its publishers now; None if they are all near the arrival."""
    corrected: Counter[str] = field(default_factory=Counter)
    """Messages in objects that had to be corrected, by what was wrong with them (``encode/payload``)."""
    publishers: dict[str, Span] = field(default_factory=dict)
    estimated: int = 0
    """Of ``received``, those without numbers that a rhythm counts."""
    unknown: int = 0
    """Of ``received``, those without numbers of which nothing else is known."""
    missed_estimated: Counter[str] = field(default_factory=Counter)
    """Beside those that were estimated, by cause."""
    estimate: TopicEstimate = field(default_factory=TopicEstimate)
    last_kept: Times = NO_TIMES
    """Those of the newest sample that is durable: a restarted node continues to sample after it."""
    other_types: dict[str, OtherTypeAccount] = field(default_factory=dict)
    gone: dict[str, tuple[int, int]] = field(default_factory=dict)
    """First and last number of publishers whose accounts were added up."""
    removed: dict[str, Span | None] = field(default_factory=dict)
    """Those among them that the last commit has by name still; with a span without counts where earlier sessions knew it."""
    gaps: TopicGaps = field(default_factory=TopicGaps)
    """When its losses were."""
    doubted: Times = NO_TIMES
    """Since when its messages are counted by no rhythm; zeros where they are: one that is found counts back to then."""
    settled_ns: int = 0
    """No message up to this stamp was open at the last commit: the next one makes what became of them durable."""
    first_ns: int = 0
    """Stamp of a message from which on all are counted, the first by a clock that was set."""
    complete_ns: int = 0
    """No message up to this stamp can still be lost on its way into the spool."""
    is_doubtful: bool = False
    """Whether nobody knows which of its messages are the topic's own: their numbers tell nothing then."""

    @property
    def open(self) -> int:
        """Messages without an outcome yet: in an open batch, the queue, an encoder or before their commit."""
        return self.received - self.skipped - self.stored - self.rejected.total() - self.dropped.total()

    @property
    def missed(self) -> int | None:
        """Messages that were published and never taken; None where that is not known exactly."""
        if self.accounting != EXACT or self.estimated or self.unknown:
            return None
        return sum(span.missed.total() for span in self.publishers.values())

    @property
    def about_missed(self) -> int | None:
        """The same where a part of it is estimated; None where all is known exactly, or a part not at all."""
        if not self.estimated or self.unknown or self.is_doubtful:
            return None
        return self.missed_estimated.total() + sum(span.missed.total() for span in self.publishers.values())

    def receive(self, publisher: str | None, number: int | None, times: Times = NO_TIMES) -> bool:
        """Count one taken message; False for a repeat. One without publisher or number is unknown until ``appraise``."""
        if number is not None and number > MAX_NUMBER:
            number = None
        if publisher is not None and number is not None and (self.accounting == EXACT or self._begin_numbers()):
            span = self._span(publisher)
            if not span.observe(number, times):
                return False
            span.used = self.received
        else:
            if self.accounting != ESTIMATED:
                self.accounting = RECEIVED_ONLY
            self.unknown += 1
        self.received += 1
        return True

    def drop(self, reason: str, count: int, first: Times = NO_TIMES, last: Times = NO_TIMES) -> None:
        """Count messages that were received and dropped; the times as of ``Accounts.drop``."""
        self.dropped[reason] += count
        if count and any(first):
            self.gaps.add(DROPPED, reason, count, first, last)

    def receive_again(self, publisher: str | None, number: int | None) -> None:
        """Count a message that was counted before, and that is wanted once more; arguments as above."""
        if publisher is None or number is None or not (self.accounting == EXACT or self._begin_numbers()):
            self.receive(None, None)
            return
        self._span(publisher).count()
        self.received += 1

    def expect(self, expected: Expectation) -> None:
        """What is known of the stamps of messages without numbers."""
        self.estimate.expect(expected)

    def observe(self, stamps: Mapping[str, Sequence[int]], hearing: ArrivalContext, newest: Times = NO_TIMES) -> Losses:
        """Estimate what was lost before messages without numbers, just received: publisher ('' where not known) -> stamps.

        ``newest`` are the times of the last of them, whatever the stamps are.
        """
        found = self.estimate.observe(stamps, hearing)
        self.unknown -= found.covered
        self.estimated += found.covered
        before = next((each for each in (self.doubted, self.gaps.heard) if any(each)), newest)
        self._estimate_lost(found.missed, before, newest)
        self.doubted = NO_TIMES if found.covered >= found.messages else before
        self.accounting = ESTIMATED if self.estimate.known else RECEIVED_ONLY
        return found.lost

    def _estimate_lost(self, lost: Mapping[str, int], before: Times, after: Times) -> None:
        """Count an estimate, or the correction of an earlier one, whose rows are the newest ones of the journal."""
        for cause, change in lost.items():
            self.missed_estimated[cause] += change
            if change > 0 and any(before) and any(after):
                self.gaps.add(MISSED, cause, change, before, after, grade=ESTIMATED)

    def appraise(self, count: int, lost: Losses, newest: Times = NO_TIMES) -> None:
        """Somebody else estimated what was lost before ``count`` messages without numbers, just received, the last then."""
        if count:
            self.accounting = RECEIVED_ONLY if lost is None else ESTIMATED
            if lost is not None:
                self.unknown -= count
                self.estimated += count
                self._estimate_lost(lost, self.gaps.heard, newest)
                self.missed_estimated = +self.missed_estimated

    def find(self, count: int, runs: Sequence[NumberRun] = ()) -> None:
        """Messages of the session before, of which its accounts did not know yet, turned up in a file of it.

        ``runs`` are the numbers of all that the file has of the topic, empty where they are not known.
        """
        self.received += count
        spans = list(self.publishers.values())
        if not spans or (self.accounting or self.before) in {ESTIMATED, RECEIVED_ONLY}:
            self.unknown += count
            return
        if len(spans) == 1 and spans[0].recall(runs, count):
            return
        for span in spans:
            count -= span.find(count)
        spans[-1].late(count)

    def rebase(self) -> None:
        """What is published until the next message was not listened to on purpose: it is not missed."""
        for span in self.publishers.values():
            span.rebase()
        self.estimate.rebase()

    def _begin_numbers(self) -> bool:
        """From now on messages have numbers, and those that had none are in no gap of them; False where they tell nothing."""
        if self.is_doubtful:
            return False
        if (self.accounting or self.before) in {ESTIMATED, RECEIVED_ONLY}:
            for span in self.publishers.values():
                span.rebase()
        self.accounting = EXACT
        return True

    def see_other(self, type_name: str, nodes: Iterable[str], *, counted: bool, named: bool) -> bool:
        """Another type is published there; whether that is news.

        ``counted``: its messages are received in order to be counted (``refuse``). Where they are not, and no setting has
        ``named`` the type that is logged, nobody knows which are the topic's own, or what of them was missed.
        """
        if type_name not in self.other_types and len(self.other_types) >= MAX_OTHER_TYPES:
            type_name, counted = MORE_TYPES, False
        other = self.other_types.get(type_name)
        is_new = other is None
        if other is None:
            other = self.other_types[type_name] = OtherTypeAccount()
        if not (counted or named or self.is_doubtful):
            self.accounting, self.is_doubtful, is_new = RECEIVED_ONLY, True, True
        return other.see(nodes, counted=counted) or is_new

    def refuse(self, type_name: str, count: int, first: Times = NO_TIMES, last: Times = NO_TIMES) -> None:
        """Messages of another type were received and discarded; the times as of ``Accounts.drop``."""
        self.received += count
        self.rejected[WRONG_TYPE] += count
        if count and any(first):
            self.gaps.add(REJECTED, WRONG_TYPE, count, first, last)
        self._span(WRONG_TYPE).late(count)
        other = self.other_types.get(type_name)
        if other is not None and other.messages is not None:
            other.messages += count

    def is_awaiting(self, heard_ns: int) -> bool:
        """Whether some publishers of the session before are heard again, and others, which may have sent more, not yet."""
        if heard_ns - self.first_ns > LATELY_NS:
            return False
        older = [span for span in self.publishers.values() if span.older]
        since_ns = self.gaps.before.stamp_ns - LATELY_NS
        return not all(span.inherited for span in older) and any(
            span.inherited and span.heard.stamp_ns > since_ns for span in older
        )

    def figures(self) -> Figures:
        """What was lost so far, as the gap journal has it."""
        found = Counter[tuple[str, str, str]]()
        for span in self.publishers.values():
            for cause, count in span.missed.items():
                found[MISSED, cause, EXACT] += max(0, count)
        for cause, count in self.missed_estimated.items():
            found[MISSED, cause, ESTIMATED] = max(0, count)
        for reason, count in self.rejected.items():
            found[REJECTED, reason, EXACT] = count
        for reason, count in self.dropped.items():
            found[DROPPED, reason, EXACT] = count
        return found

    def _span(self, publisher: str) -> Span:
        span = self.publishers.get(publisher)
        if span is None:
            if len(self.publishers) >= MAX_PUBLISHERS:
                self._add_up()
            first, last = self.gone.pop(publisher, (None, None))
            span = self.publishers[publisher] = Span(first, last, name=publisher, gaps=self.gaps)
        return span

    def _add_up(self) -> None:
        """Of the publishers that have been silent for longest, half of all, only the sums are kept, and their last numbers."""
        own = [name for name in self.publishers if name not in {GONE, WRONG_TYPE}]
        for name in sorted(own, key=lambda name: self.publishers[name].used)[: len(own) // 2]:
            span = self.publishers.pop(name)
            self.publishers.setdefault(GONE, Span(gaps=self.gaps)).absorb(span)
            self.removed[name] = Span(span.first, span.last) if span.older else None
            if span.first is not None and span.last is not None:
                self.gone[name] = span.first, span.last
        for name in list(self.gone)[:-MAX_GONE]:
            del self.gone[name]


class _Entry:
    """``Accounts.entry``: a generator would cost five times as much, for every drain of every topic."""

    __slots__ = ('_changed', '_lock', '_topic')

    def __init__(self, lock: threading.Lock, changed: Callable[[str], TopicAccount], topic: str) -> None:
        self._lock, self._changed, self._topic = lock, changed, topic

    def __enter__(self) -> TopicAccount:
        self._lock.acquire()
        try:
            return self._changed(self._topic)
        except BaseException:
            self._lock.release()
            raise

    def __exit__(self, *_: object) -> None:
        self._lock.release()


class Accounts:
    """The accounts of all topics of this session.

    Thread-safe: ``entry`` holds the lock, the other methods take it.
    """

    def __init__(self, inherited: Iterable[PublisherRow] = (), last_kept: Mapping[str, Times] | None = None,
                 rhythms: Iterable[RhythmRow] = (), grades: Mapping[str, str] | None = None,
                 clock: Clock | None = None, heard: Mapping[str, Times] | None = None) -> None:  # fmt: skip
        """``grades`` are those of the newest messages, by account: a gap after others is no loss that these numbers tell.

        ``heard`` and ``last_kept`` are the times of the newest messages, and of the newest durable ones, of earlier sessions.
        """
        self._lock = threading.Lock()
        self._topics: dict[str, TopicAccount] = {}
        self._dirty = False
        self._written: list[Span] = []
        self._removed: dict[str, dict[str, Span | None]] = {}
        self._inherited: dict[str, dict[str, Span]] = {}
        self._grades = dict(grades or {})
        self._rhythms = {
            row.topic: row if self._grades.get(row.topic) == ESTIMATED else replace(row, publisher='') for row in rhythms
        }
        self.oldest_open: Callable[[], Mapping[str, int]] = lambda: dict.fromkeys(self._topics, 1)
        """Says of which topics messages have no outcome yet that are not in the writer, and the stamp of the first: set it."""
        self._carried = Counter[str]()
        self._carried_times: dict[str, tuple[Times, Times]] = {}
        self._mission = ''
        self._clock = clock
        self._heard = dict(heard or {})
        self._unwritten: list[TopicGaps] = []
        self._last_kept = dict(last_kept or {})
        for row in inherited:
            spans = self._inherited.setdefault(row.topic, {})
            spans[row.publisher] = Span(row.first, row.last, inherited=True, heard=row.heard, name=row.publisher)
            if len(spans) >= MAX_PUBLISHERS:
                del spans[next(iter(spans))]

    def entry(self, topic: str) -> _Entry:
        """The topic's account, under the lock: keep it short. What this returns may be entered again and again."""
        return _Entry(self._lock, self._changed, topic)

    def _changed(self, topic: str) -> TopicAccount:
        self._dirty = True
        return self._account(topic)

    def reject(self, topic: str, reasons: Mapping[str, int], first: Times = NO_TIMES, last: Times = NO_TIMES) -> None:
        """Messages were rejected; the times as of ``drop``, of those that they came with."""
        with self.entry(topic) as account:
            for reason, count in reasons.items():
                account.rejected[reason] += count
                if count and any(first):
                    account.gaps.add(REJECTED, reason, count, first, last)

    def correct(self, topic: str, reasons: Mapping[str, int]) -> None:
        """Messages are in an object that goes to the spool, but were corrected on the way: reason -> number."""
        with self.entry(topic) as account:
            account.corrected.update(reasons)

    def see_other(self, topic: str, type_name: str, nodes: Iterable[str], *, counted: bool, named: bool,
                  only_known: bool = False) -> None:  # fmt: skip
        """As of the topic's account; with ``only_known`` where there is one already."""
        with self._lock:
            if only_known and topic not in self._topics:
                return
            if self._account(topic).see_other(type_name, nodes, counted=counted, named=named):
                self._dirty = True

    def refuse(self, topic: str, type_name: str, count: int, first: Times = NO_TIMES, last: Times = NO_TIMES) -> None:
        """Messages came that are of another type than the topic's; the times as of ``drop``."""
        with self.entry(topic) as account:
            account.refuse(type_name, count, first, last)

    def drop(self, topic: str, reason: str, count: int, first: Times = NO_TIMES, last: Times = NO_TIMES) -> None:
        """Messages were dropped; ``first`` and ``last`` are the times of the first and the last of them."""
        with self.entry(topic) as account:
            account.drop(reason, count, first, last)

    def store(self, stored: Mapping[str, tuple[int, Times]]) -> None:
        """Samples that a group commit made durable: topic -> (count, times of the newest)."""
        with self._lock:
            for topic, (count, newest) in stored.items():
                account = self._account(topic)
                account.stored += count
                account.last_kept = max(account.last_kept, newest)

    def carry(self, rows: Iterable[TopicRow]) -> None:
        """Take over what an earlier session left open (the commit that says so is the caller's): it may turn up in files."""
        with self._lock:
            for row in rows:
                account = self._account(row.topic)
                account.type, account.accounting = row.type, row.accounting
                account.received += row.received
                account.estimated += row.estimated
                account.unknown += row.unknown
                self._carried[row.topic] += row.received
                self._carried_times[row.topic] = row.last_kept if any(row.last_kept) else row.heard, row.heard

    def find(self, counts: Mapping[str, int], runs: Mapping[str, Sequence[NumberRun]],
             newest: Mapping[str, Times] | None = None) -> None:  # fmt: skip
        """Messages of an earlier session turned up in a file that is about to be spooled.

        ``runs`` are as in ``TopicAccount``, ``newest`` the times of the last message of each topic in it: what did not turn up
        was lost after that.
        """
        with self._lock:
            for topic, times in (newest or {}).items():
                if (carried := self._carried_times.get(topic)) is not None:
                    since, heard = carried
                    self._carried_times[topic] = max(since, times, key=lambda each: each.received_ns), heard
            for topic, count in counts.items():
                known = min(count, self._carried[topic])
                self._carried[topic] -= known
                if count > known:
                    self._account(topic).find(count - known, runs.get(topic, ()))
                    self._dirty = True

    def drop_carried(self, reason: str) -> int:
        """What did not turn up is lost. Returns how many messages that are."""
        with self._lock:
            carried, self._carried = +self._carried, Counter()
            for topic, count in carried.items():
                self._account(topic).drop(reason, count, *self._carried_times[topic])
                self._dirty = True
            return carried.total()

    def drop_open(self, reason: str) -> int:
        """At the end: whatever has no outcome yet will never have one. Returns how many messages that were.

        Those of bags are in files, which the next start finds.
        """
        with self._lock:
            lost = 0
            for topic, account in self._topics.items():
                if account.open > 0 and not topic.startswith(SINKS):
                    lost += account.open
                    since = account.last_kept if any(account.last_kept) else account.gaps.heard
                    account.drop(reason, account.open, since, account.gaps.heard)
                    self._dirty = True
            return lost

    def last_kept_ns(self, topic: str) -> int:
        """Stamp of the topic's newest durable sample of any session, 0 for none."""
        with self._lock:
            account = self._topics.get(topic)
            return max(account.last_kept if account else NO_TIMES, self._last_kept.get(topic, NO_TIMES)).stamp_ns

    def set_mission(self, mission_id: str) -> None:
        """What is lost from now on is lost in this mission; '' for none."""
        with self._lock:
            self._mission = mission_id
            for account in self._topics.values():
                account.gaps.mission = mission_id

    def rebase(self, topic: str) -> None:
        """What is published on the topic until its next message was not listened to on purpose: it is not missed."""
        with self._lock:
            self._rebase(topic)

    def last_numbers(self, sink: str) -> dict[str, dict[str, int]]:
        """Account -> publisher -> the highest number that it counted, in this session or an earlier one."""
        with self._lock:
            spans = {topic: account.publishers for topic, account in self._topics.items()}
            return {
                topic: {name: span.last for name, span in found.items() if span.last is not None}
                for topic, found in {**self._inherited, **spans}.items() if topic.startswith(sink)
            }  # fmt: skip

    def rebase_all(self, sink: str) -> None:
        """As ``rebase``, of every account whose name begins so."""
        with self._lock:
            for topic in {*self._topics, *self._inherited, *self._rhythms}:
                if topic.startswith(sink):
                    self._rebase(topic)

    def totals(self, sink: str = '') -> dict[str, Totals]:
        """Every topic of this session as it stands now; with ``sink`` (BAG, EVENT) what became of it there."""
        with self._lock:
            return {
                topic.removeprefix(sink): _totals(account)
                for topic, account in self._topics.items()
                if (topic.startswith(sink) if sink else not topic.startswith(SINKS))
            }

    def snapshot(self, stored: Mapping[str, tuple[int, Times]]) -> AccountSnapshot | None:
        """The state as it will be once ``stored`` is durable; None when nothing changed since the last one."""
        taken = self._snapshot(stored)
        if taken is not None:
            oldest = self.oldest_open()
            with self._lock:
                for row in taken.topics:
                    account = self._topics[row.topic]
                    heard_ns = row.heard.stamp_ns
                    account.settled_ns = min(heard_ns, oldest.get(row.topic, heard_ns + 1) - 1)
        return taken

    def _snapshot(self, stored: Mapping[str, tuple[int, Times]]) -> AccountSnapshot | None:
        with self._lock:
            self._unwritten = []
            if not self._dirty and not stored:
                return None
            self._dirty = False
            for topic in stored:
                self._account(topic)
            spans = [
                (topic, publisher, span)
                for topic, account in self._topics.items()
                for publisher, span in account.publishers.items()
                if span.changed
            ]
            self._written = [span for _, _, span in spans]
            for span in self._written:
                span.changed = False
            self._unwritten = [account.gaps for account in self._topics.values()]
            changes = [account.gaps.settle(topic, account.figures()) for topic, account in self._topics.items()]
            self._removed = {topic: account.removed for topic, account in self._topics.items() if account.removed}
            for topic, removed in self._removed.items():
                self._topics[topic].removed = {}
                spans += [(topic, name, span) for name, span in removed.items()
                          if span is not None and name not in self._topics[topic].publishers]  # fmt: skip
            rhythms = (account.estimate.row(topic) for topic, account in self._topics.items())
            latest_ns = latest(self._clock)
            return AccountSnapshot(
                tuple(
                    self._row(topic, account, *stored.get(topic, (0, NO_TIMES)), latest_ns)
                    for topic, account in self._topics.items()
                ),
                tuple(
                    PublisherRow(
                        topic, publisher, span.first, span.last, span.published, span.received, dict(+span.missed), span.heard
                    )
                    for topic, publisher, span in spans
                ),
                tuple(
                    OtherTypeRow(topic, name, tuple(other.publishers), other.messages)
                    for topic, account in self._topics.items()
                    for name, other in account.other_types.items()
                ),
                tuple(row for row in rhythms if row is not None),
                tuple((topic, name) for topic, removed in self._removed.items() for name in removed),
                tuple(row for rows, _ in changes for row in rows),
                tuple(each for _, taken_back in changes for each in taken_back),
            )

    def mark_dirty(self) -> None:
        """The last snapshot did not become durable: write it again."""
        with self._lock:
            self._dirty = True
            for span in self._written:
                span.changed = True
            for topic, removed in self._removed.items():
                self._topics[topic].removed = {**removed, **self._topics[topic].removed}
            for gaps in self._unwritten:
                gaps.undo()
            self._unwritten = []
            self._unsettle()

    def unsettle(self) -> None:
        """The next commit may not have all objects that were made until the last one: it says of none that it is settled."""
        with self._lock:
            self._unsettle()

    def _unsettle(self) -> None:
        for account in self._topics.values():
            account.settled_ns = 0

    def _rebase(self, topic: str) -> None:
        if account := self._topics.get(topic):
            account.rebase()
        for span in self._inherited.get(topic, {}).values():
            span.rebase()
        if row := self._rhythms.get(topic):
            self._rhythms[topic] = replace(row, publisher='')

    def _account(self, topic: str) -> TopicAccount:
        account = self._topics.get(topic)
        if account is None:
            account = self._topics[topic] = TopicAccount(
                publishers=self._inherited.pop(topic, {}), before=self._grades.get(topic, ''),
                estimate=TopicEstimate(before=self._rhythms.pop(topic, None)),
                gaps=TopicGaps(self._mission, self._clock, self._heard.get(topic, NO_TIMES)),
            )  # fmt: skip
            for span in account.publishers.values():
                span.gaps = account.gaps
        return account

    @staticmethod
    def _row(topic: str, account: TopicAccount, count: int, newest: Times, latest_ns: int) -> TopicRow:
        heard = account.gaps.heard
        latest_ns = latest_stamp(heard, latest_ns)
        heard_ns = min(heard.stamp_ns, latest_ns)
        if not EARLIEST_SANE_NS <= account.first_ns <= latest_ns and account.gaps.has_received:
            account.first_ns = heard_ns
        if account.accounting not in {'', RECEIVED_ONLY} and not account.is_awaiting(heard_ns):
            settled_ns = account.settled_ns
            if account.open <= count:
                settled_ns = heard_ns
            elif topic.startswith(SINKS):  # written in the order of arrival
                settled_ns = newest.stamp_ns - MAX_AGE_NS
            account.complete_ns = min(max(account.complete_ns, settled_ns), latest_ns)
        return TopicRow(
            topic, account.type, account.accounting, account.received, account.skipped, account.stored + count,
            dict(account.rejected), dict(account.dropped), max(account.last_kept, newest),
            account.estimated, account.unknown, dict(+account.missed_estimated), account.first_ns,
            heard._replace(stamp_ns=heard_ns), account.complete_ns, dict(account.by_arrival),
            dict(account.corrected), account.stamps,
        )  # fmt: skip


def _totals(account: TopicAccount) -> Totals:
    paused = account.dropped[PAUSED]
    missed_by = Counter[str]()
    for (kind, cause, _), count in account.figures().items():
        if kind == MISSED and count:
            missed_by[cause] += count
    return Totals(
        account.type, account.accounting or None, account.received, account.stored, account.skipped, account.rejected.total(),
        account.dropped.total() - paused, paused, account.missed, account.about_missed, account.open,
        account.rejected[WRONG_TYPE],
        {name: OtherType(tuple(other.publishers), other.messages) for name, other in account.other_types.items()},
        dict(missed_by), account.gaps.count, dict(account.by_arrival), dict(account.corrected),
        account.stamps,
    )  # fmt: skip
