"""What became of every message of this session, counted in memory: the ledger before it is durable.

Every message is received once, and then skipped, rejected, dropped or stored once; without an outcome it is open. The spool takes
a ``snapshot`` inside each group commit, so that the durable accounts balance, too.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace

from shadowhound_data_logger.core.clock import Clock
from shadowhound_data_logger.core.stamps import NO_TIMES, Times
from shadowhound_data_logger.core.status import OtherType, Totals
from shadowhound_data_logger.spool.account_rows import AccountSnapshot, OtherTypeRow, PublisherRow, RhythmRow, TopicRow
from shadowhound_data_logger.spool.estimator import TopicEstimate
from shadowhound_data_logger.spool.gaps import ESTIMATED, MISSED, TopicGaps, latest
from shadowhound_data_logger.spool.span import NumberRun, Span
from shadowhound_data_logger.spool.topic_account import MAX_PUBLISHERS, PAUSED, SINKS, WRONG_TYPE, TopicAccount


class Accounts:
    """The accounts of all topics of this session.

    Thread-safe: one lock guards all of it. ``entry`` holds the lock; the other methods acquire it.
    """

    def __init__(self, inherited: Iterable[PublisherRow] = (), last_stored: Mapping[str, Times] | None = None,
                 rhythms: Iterable[RhythmRow] = (), grades: Mapping[str, str] | None = None,
                 clock: Clock | None = None, newest: Mapping[str, Times] | None = None) -> None:  # fmt: skip
        """The arguments are those of earlier sessions, by account.

        ``grades`` are those of the newest messages: numbers do not show what was lost after messages without numbers. ``newest``
        and ``last_stored`` are the times of the newest messages, and of the newest durable ones.
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
        """Returns the stamp of the first open message before the writer, by topic; topics without one are missing. Set it."""
        self.carried = CarriedMessages(self)
        self._mission = ''
        self._clock = clock
        self._newest = dict(newest or {})
        self._unwritten: list[TopicGaps] = []
        self._last_stored = dict(last_stored or {})
        for row in inherited:
            spans = self._inherited.setdefault(row.topic, {})
            spans[row.publisher] = Span(row.first, row.last, inherited=True, last_times=row.last_times, name=row.publisher)
            if len(spans) >= MAX_PUBLISHERS:
                del spans[next(iter(spans))]

    @contextmanager
    def entry(self, topic: str) -> Iterator[TopicAccount]:
        """The topic's account, under the lock: keep it short."""
        with self._lock:
            self._dirty = True
            yield self._account(topic)

    def reject(self, topic: str, reasons: Mapping[str, int], first: Times = NO_TIMES, last: Times = NO_TIMES) -> None:
        """Count messages as rejected, by reason; ``first`` and ``last`` are the times of the batch that they were in."""
        with self.entry(topic) as account:
            for reason, count in reasons.items():
                account.reject(reason, count, first, last)

    def correct(self, topic: str, reasons: Mapping[str, int]) -> None:
        """Count messages of an object to be spooled as corrected, by fault."""
        with self.entry(topic) as account:
            account.corrected.update(reasons)

    def add_other_type(self, topic: str, type_name: str, nodes: Iterable[str], *, counted: bool, named: bool,
                       only_known: bool = False) -> None:  # fmt: skip
        """As ``TopicAccount.add_other_type``; with ``only_known``, only if the topic has an account."""
        with self._lock:
            if only_known and topic not in self._topics:
                return
            if self._account(topic).add_other_type(type_name, nodes, counted=counted, named=named):
                self._dirty = True

    def reject_other_type(self, topic: str, type_name: str, count: int, first: Times = NO_TIMES, last: Times = NO_TIMES) -> None:
        """Count received messages whose type is not the topic's; times as for ``drop``."""
        with self.entry(topic) as account:
            account.reject_other_type(type_name, count, first, last)

    def drop(self, topic: str, reason: str, count: int, first: Times = NO_TIMES, last: Times = NO_TIMES) -> None:
        """Count messages as dropped; ``first`` and ``last`` are the times of the first and the last of them."""
        with self.entry(topic) as account:
            account.drop(reason, count, first, last)

    def store(self, stored: Mapping[str, tuple[int, Times]]) -> None:
        """Count samples that a group commit made durable: topic -> (count, times of the newest)."""
        with self._lock:
            for topic, (count, newest) in stored.items():
                account = self._account(topic)
                account.stored += count
                account.last_stored = max(account.last_stored, newest)

    def drop_open(self, reason: str) -> int:
        """At shutdown: drop all messages without an outcome. Returns how many.

        Those of bags and events are in files, in which the next startup finds them.
        """
        with self._lock:
            lost = 0
            for topic, account in self._topics.items():
                if account.open > 0 and not topic.startswith(SINKS):
                    lost += account.open
                    since = account.last_stored if any(account.last_stored) else account.gaps.newest
                    account.drop(reason, account.open, since, account.gaps.newest)
                    self._dirty = True
            return lost

    def last_stored_ns(self, topic: str) -> int:
        """Stamp of the topic's newest durable sample of any session; 0 if there is none."""
        with self._lock:
            account = self._topics.get(topic)
            return max(account.last_stored if account else NO_TIMES, self._last_stored.get(topic, NO_TIMES)).stamp_ns

    def set_mission(self, mission_id: str) -> None:
        """Attribute losses from now on to this mission; '' for none."""
        with self._lock:
            self._mission = mission_id
            for account in self._topics.values():
                account.gaps.mission = mission_id

    def rebase(self, topic: str) -> None:
        """Do not count what is published on the topic until its next message as missed: it is deliberately not subscribed."""
        with self._lock:
            if account := self._topics.get(topic):
                account.rebase()
            for span in self._inherited.get(topic, {}).values():
                span.rebase()
            if row := self._rhythms.get(topic):
                self._rhythms[topic] = replace(row, publisher='')

    def rebase_all(self, sink: str) -> None:
        """``rebase`` every account of a sink."""
        with self._lock:
            topics = {topic for topic in (*self._topics, *self._inherited, *self._rhythms) if topic.startswith(sink)}
        for topic in topics:
            self.rebase(topic)

    def last_numbers(self, sink: str) -> dict[str, dict[str, int]]:
        """Account -> publisher -> the highest sequence number counted, in this session or an earlier one."""
        with self._lock:
            spans = {topic: account.publishers for topic, account in self._topics.items()}
            return {
                topic: {name: span.last for name, span in found.items() if span.last is not None}
                for topic, found in {**self._inherited, **spans}.items() if topic.startswith(sink)
            }  # fmt: skip

    def totals(self, sink: str = '') -> dict[str, Totals]:
        """The totals of every topic of this session; with ``sink`` (BAG, EVENT), those in that sink."""
        with self._lock:
            return {
                topic.removeprefix(sink): _totals(account)
                for topic, account in self._topics.items()
                if (topic.startswith(sink) if sink else not topic.startswith(SINKS))
            }

    def snapshot(self, stored: Mapping[str, tuple[int, Times]]) -> AccountSnapshot | None:
        """The accounts as they will be once ``stored`` is durable; None if nothing changed since the last snapshot."""
        taken = self._snapshot(stored)
        if taken is not None:
            oldest = self.oldest_open()
            with self._lock:
                for row in taken.topics:
                    newest_ns = row.newest.stamp_ns
                    self._topics[row.topic].settled_ns = min(newest_ns, oldest.get(row.topic, newest_ns + 1) - 1)
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
            changes = [account.gaps.settle(topic, account.loss_totals()) for topic, account in self._topics.items()]
            self._removed = {topic: account.removed for topic, account in self._topics.items() if account.removed}
            for topic, removed in self._removed.items():
                self._topics[topic].removed = {}
                spans += [(topic, name, span) for name, span in removed.items()
                          if span is not None and name not in self._topics[topic].publishers]  # fmt: skip
            rhythms = (account.estimate.row(topic) for topic, account in self._topics.items())
            latest_ns = latest(self._clock)
            return AccountSnapshot(
                tuple(
                    account.row(topic, *stored.get(topic, (0, NO_TIMES)), latest_ns) for topic, account in self._topics.items()
                ),
                tuple(
                    PublisherRow(topic, publisher, span.first, span.last, span.published, span.received, dict(+span.missed),
                                 span.last_times)
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
            )  # fmt: skip

    def mark_dirty(self) -> None:
        """Write everything of the last snapshot again, because it did not become durable."""
        with self._lock:
            self._dirty = True
            for span in self._written:
                span.changed = True
            for topic, removed in self._removed.items():
                self._topics[topic].removed = {**removed, **self._topics[topic].removed}
            for gaps in self._unwritten:
                gaps.undo()
            self._unwritten = []
        self.unsettle()

    def unsettle(self) -> None:
        """Let the next commit move no watermark: it may not contain all objects that were encoded before the last one."""
        with self._lock:
            for account in self._topics.values():
                account.settled_ns = 0

    def _account(self, topic: str) -> TopicAccount:
        account = self._topics.get(topic)
        if account is None:
            account = self._topics[topic] = TopicAccount(
                publishers=self._inherited.pop(topic, {}), accounting_before=self._grades.get(topic, ''),
                estimate=TopicEstimate(before=self._rhythms.pop(topic, None)),
                gaps=TopicGaps(self._mission, self._clock, self._newest.get(topic, NO_TIMES)),
            )  # fmt: skip
            for span in account.publishers.values():
                span.gaps = account.gaps
        return account


def _totals(account: TopicAccount) -> Totals:
    """The account as the status shows it."""
    paused = account.dropped[PAUSED]
    missed_by = Counter[str]()
    for (kind, cause, _), count in account.loss_totals().items():
        if kind == MISSED and count:
            missed_by[cause] += count
    return Totals(
        account.type, account.accounting or None, account.received, account.stored, account.skipped, account.rejected.total(),
        account.dropped.total() - paused, paused, account.missed, account.missed_estimated, account.open,
        account.rejected[WRONG_TYPE],
        {name: OtherType(tuple(other.publishers), other.messages) for name, other in account.other_types.items()},
        dict(missed_by), account.gaps.count, dict(account.by_arrival), dict(account.corrected),
        account.stamps,
    )  # fmt: skip


class CarriedMessages:
    """Messages that an earlier session left open in files, which this session now accounts for.

    Lifecycle: ``take_over`` those of each sink; ``recover`` those found in files; ``drop_rest``. Thread-safe (``_lock``).
    """

    def __init__(self, accounts: Accounts) -> None:
        self._accounts = accounts
        self._lock = threading.Lock()
        self._counts = Counter[str]()
        self._times: dict[str, tuple[Times, Times]] = {}
        """By account: the newest message that is known not to be lost, and the newest message."""

    def take_over(self, rows: Iterable[TopicRow]) -> None:
        """Add the open messages of an earlier session, whose rows the caller has moved in the index."""
        with self._lock:
            for row in rows:
                with self._accounts.entry(row.topic) as account:
                    account.type, account.accounting = row.type, row.accounting
                    account.received += row.received
                    account.estimated += row.estimated
                    account.unknown += row.unknown
                self._counts[row.topic] += row.received
                self._times[row.topic] = row.last_stored if any(row.last_stored) else row.newest, row.newest

    def recover(self, counts: Mapping[str, int], runs: Mapping[str, Sequence[NumberRun]],
                newest: Mapping[str, Times] | None = None) -> None:  # fmt: skip
        """Count messages found in a file that is about to be spooled, by account.

        ``runs`` are as for ``TopicAccount.recover``; ``newest`` are the times of the last message of each account in the file:
        what is not found was lost after that.
        """
        with self._lock:
            for topic, times in (newest or {}).items():
                if (carried := self._times.get(topic)) is not None:
                    since, last = carried
                    self._times[topic] = max(since, times, key=lambda each: each.received_ns), last
            for topic, count in counts.items():
                known = min(count, self._counts[topic])
                self._counts[topic] -= known
                if count > known:
                    with self._accounts.entry(topic) as account:
                        account.recover(count - known, runs.get(topic, ()))

    def drop_rest(self, reason: str) -> int:
        """Drop the messages that were not found. Returns how many."""
        with self._lock:
            rest, self._counts = +self._counts, Counter()
            for topic, count in rest.items():
                self._accounts.drop(topic, reason, count, *self._times[topic])
            return rest.total()
