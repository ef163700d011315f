"""The gap journal: when messages were lost, how many and why, in one row of the index per second, topic and cause.

The accounts contain how many were lost, the journal when. Code that counts a loss adds its times (``TopicGaps.add``). At each
commit, ``TopicGaps.settle`` compares the journal with the accounts: losses without times get those of the newest messages at
this commit and the previous one, and counts that the accounts took back are subtracted from the newest rows. So for each topic,
kind and cause, the rows add up to the account at every commit, in the same transaction. Triggers write the rows of evicted and
quarantined objects (schema.sql).

A changed row gets a new version, and a row that is no longer true is kept with the count 0 until it is forgotten, so a copy of
the journal is updated by reading the rows that are newer than its last version.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Final, NamedTuple

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, FUTURE_SLACK_NS, SECOND, Clock
from shadowhound_data_logger.core.stamps import NO_TIMES, Times, clocks_differ

MISSED, REJECTED, DROPPED, EVICTED, QUARANTINED = 'missed', 'rejected', 'dropped', 'evicted', 'quarantined'
"""Kinds."""
EXACT, ESTIMATED = 'exact', 'estimated'
"""Grades."""
UNTIMED: Final = -1
"""``begin_ns`` of a row whose time is unknown."""
FORGOTTEN: Final = -2
"""``begin_ns`` of a row that is the sum of forgotten rows, whose times are in the store."""
HOUR_NS: Final = 3600 * SECOND
MAX_NEW_ROWS: Final = 7200
"""Per sink, topic and hour: two per second. Further gaps of a kind and cause share one row, without publisher and mission."""
MAX_RECENT: Final = 256
OBJECTS, BAGS, EVENTS = 'objects', 'bags', 'events'
"""Sinks."""
_SINKS: Final = {'bag:': BAGS, 'event:': EVENTS}


@dataclass(frozen=True, slots=True)
class Gap:
    """Losses of one sink, topic, kind, cause and publisher (if known) that began within one second."""

    sink: str
    topic: str
    publisher: str | None
    session: int | None
    """A session of the index; None for evicted and quarantined objects."""
    kind: str
    cause: str
    from_ns: int | None
    """UTC stamp of the last message before the gap; for an object, of its first message. None if unknown."""
    to_ns: int | None
    """UTC stamp of the first message after the gap; for an object, of its last message."""
    received_from_ns: int | None
    """When the message of ``from_ns`` arrived; None if unknown."""
    received_to_ns: int | None
    """When the message of ``to_ns`` arrived."""
    count: int | None
    """Messages; 0 for a row that is no longer true, None if unknown."""
    merged: int
    """How many gaps the row contains."""
    grade: str
    mission_id: str | None
    robot: str | None = None
    boot_id: str | None = None
    """If the wall clock was not set: the boot to which the next two times belong."""
    from_boot_ns: int | None = None
    to_boot_ns: int | None = None
    began_ns: int | None = None
    """When its session began: a new index numbers its sessions from 1 again."""
    begin_ns: int = UNTIMED
    """Identifies the row, together with sink, topic, publisher, session, kind, cause, grade and mission."""
    version: int = 0
    """Increases with each change of any row."""

    def as_dict(self) -> dict[str, Any]:
        """The row as ``shadowhound-data ledger --gaps --json`` prints it."""
        return {name: getattr(self, name) for name in _PRINTED}


_PRINTED: Final = tuple(each.name for each in fields(Gap))[:14]


class Watermark(NamedTuple):
    """The interval in which the journal of a topic is complete: every message in it is either lost as listed or in the store."""

    robot: str
    sink: str
    topic: str
    session: int
    since_ns: int
    """UTC stamp of a message, as ``complete_ns``."""
    complete_ns: int
    received_since_ns: int | None
    """The same two by the arrival of the messages; None if unknown."""
    received_complete_ns: int | None
    grade: str
    """``exact`` or ``estimated``: there is no watermark if losses are unknown."""
    received: int
    """Messages of the session so far."""
    skipped: int


class GapKey(NamedTuple):
    """Identifies a row within its session and topic."""

    kind: str
    cause: str
    grade: str
    publisher: str
    mission: str
    begin_ns: int


class GapRow(NamedTuple):
    """A change of a row: the times it covers, and how many messages and gaps are added to it."""

    topic: str
    """The account, with the prefix of its sink."""
    key: GapKey
    from_ns: int | None
    to_ns: int | None
    received_from_ns: int | None
    received_to_ns: int | None
    messages: int
    merged: int


class TakenBack(NamedTuple):
    """Losses to subtract from the newest rows, because the messages were not lost after all."""

    topic: str
    kind: str
    cause: str
    grade: str
    messages: int


LossTotals = Mapping[tuple[str, str, str], int]
"""(kind, cause, grade) -> messages of an account."""


@dataclass(slots=True)
class TopicGaps:
    """The changes of one account's journal since the last commit. Guarded as the account."""

    mission: str = ''
    """The active mission."""
    clock: Clock | None = None
    """Converts stamps from before the clock of this machine was set."""
    newest: Times = NO_TIMES
    """Times of the newest message, initially of an earlier session; zeros before the first message."""
    before: Times = field(init=False)
    """Times of the newest message of earlier sessions; zeros if there is none."""
    count: int = 0
    """Gaps so far, of any kind."""
    _changes: dict[GapKey, GapRow] = field(default_factory=dict)
    _journaled: dict[tuple[str, str, str], int] = field(default_factory=dict)
    _since: Times = NO_TIMES
    """``newest`` at the last commit."""
    _recent: dict[GapKey, None] = field(default_factory=dict)
    """The last changed rows, which do not count as new."""
    _hour: int = 0
    """Since boot."""
    _new_rows: int = 0
    """In this hour."""
    _before_commit: tuple[dict[GapKey, GapRow], dict[tuple[str, str, str], int], Times] | None = None

    def __post_init__(self) -> None:
        self.before = self.newest

    @property
    def has_received(self) -> bool:
        """Whether a message was received in this session."""
        return self.newest != self.before

    def add(self, kind: str, cause: str, messages: int, before: Times, after: Times, publisher: str = '',
            grade: str = EXACT) -> GapKey:  # fmt: skip
        """Add lost messages, which are between these two times or include them. Returns the row's key.

        Stamps of a wall clock that was never set are converted to the boot clock, as in ``stamps.StampRule``. Invalid stamps and
        stamps more than a day ahead of our clock count as unknown; if only one of the two is UTC, it is used for both. Without a
        publisher, the times may be by different publishers' clocks: then both are converted to the clock of ``after``.
        """
        if not publisher and clocks_differ(before, after):
            before = before._replace(stamp_ns=after.stamp_ns - (after.received_ns - before.received_ns))
        from_ns, to_ns = self._time(before.stamp_ns), self._time(after.stamp_ns)
        if (from_ns < EARLIEST_SANE_NS) != (to_ns < EARLIEST_SANE_NS):
            from_ns = to_ns = max(from_ns, to_ns)
        from_ns, to_ns = from_ns or to_ns, to_ns or from_ns
        if not from_ns:
            begin_ns, start_ns, end_ns = UNTIMED, None, None
        else:
            start_ns, end_ns = min(from_ns, to_ns), max(from_ns, to_ns)
            begin_ns = start_ns // SECOND * SECOND if end_ns - start_ns < SECOND else start_ns
        received = [each.received_ns for each in (before, after) if each.received_ns >= EARLIEST_SANE_NS]
        key = self._bounded(GapKey(kind, cause, grade, publisher, self.mission, begin_ns))
        self.count += 1
        self._change(GapRow('', key, start_ns, end_ns, min(received, default=None), max(received, default=None), messages, 1))
        return key

    def fill(self, key: GapKey, messages: int, merged: int) -> None:
        """Subtract messages of a gap that arrived late; ``merged`` is the change of the number of gaps."""
        self.count += merged
        self._change(GapRow('', key, None, None, None, None, -messages, merged))

    def settle(self, topic: str, totals: LossTotals) -> tuple[list[GapRow], list[TakenBack]]:
        """The changes that make the journal add up to these totals; call ``undo`` if their commit fails."""
        added = Counter[tuple[str, str, str]]()
        for key, row in self._changes.items():
            added[key[:3]] += row.messages
        taken_back: list[TakenBack] = []
        for what in totals.keys() | self._journaled.keys() | added.keys():
            rest = totals.get(what, 0) - self._journaled.get(what, 0) - added[what]
            kind, cause, grade = what
            if rest > 0:
                self.add(kind, cause, rest, self._since if any(self._since) else self.newest, self.newest, grade=grade)
            elif rest < 0:
                taken_back.append(TakenBack(topic, kind, cause, grade, -rest))
        self._before_commit = self._changes, self._journaled, self._since
        changes, self._changes = self._changes, {}
        self._journaled, self._since = {what: count for what, count in totals.items() if count}, self.newest
        return [row._replace(topic=topic) for row in changes.values() if row.messages or row.merged], taken_back

    def undo(self) -> None:
        """Restore the changes of the last ``settle``, because its commit did not become durable."""
        if self._before_commit is None:
            return
        newer = self._changes
        self._changes, self._journaled, self._since = self._before_commit
        self._before_commit = None
        for row in newer.values():
            self._change(row)

    def _bounded(self, key: GapKey) -> GapKey:
        """The key, or that of a row for the whole hour if too many rows are new: publishers may send any stamps, and restart."""
        if self.clock is None or key in self._recent:
            return key
        boot_ns = self.clock.boot_ns()
        if boot_ns // HOUR_NS != self._hour:
            self._hour, self._new_rows = boot_ns // HOUR_NS, 0
        self._new_rows += 1
        if self._new_rows > MAX_NEW_ROWS:
            begin_ns = key.begin_ns
            if begin_ns >= EARLIEST_SANE_NS:
                begin_ns = max(self.clock.wall_ns(), EARLIEST_SANE_NS) // HOUR_NS * HOUR_NS
            elif begin_ns != UNTIMED:
                begin_ns = self._hour * HOUR_NS
            return key._replace(publisher='', mission='', begin_ns=begin_ns)
        self._recent[key] = None
        if len(self._recent) > MAX_RECENT:
            del self._recent[next(iter(self._recent))]
        return key

    def _time(self, stamp_ns: int) -> int:
        if stamp_ns <= 0 or stamp_ns - FUTURE_SLACK_NS > latest(self.clock):
            return 0
        if stamp_ns >= EARLIEST_SANE_NS or self.clock is None:
            return stamp_ns
        age_ns, boot_ns = self.clock.wall_ns() - stamp_ns, self.clock.boot_ns()
        return boot_ns - age_ns if 0 <= age_ns < boot_ns else 0

    def _change(self, row: GapRow) -> None:
        known = self._changes.get(row.key)
        if known is not None:
            row = GapRow(
                '', known.key, _first(known.from_ns, row.from_ns), _last(known.to_ns, row.to_ns),
                _first(known.received_from_ns, row.received_from_ns), _last(known.received_to_ns, row.received_to_ns),
                known.messages + row.messages, known.merged + row.merged,
            )  # fmt: skip
        self._changes[row.key] = row


def _first(*times_ns: int | None) -> int | None:
    return min((each for each in times_ns if each is not None), default=None)


def _last(*times_ns: int | None) -> int | None:
    return max((each for each in times_ns if each is not None), default=None)


def latest(clock: Clock | None) -> int:
    """The latest time of a real event: now, if the clock is set. A publisher may send any stamp."""
    now_ns = 0 if clock is None else clock.wall_ns()
    return now_ns if now_ns >= EARLIEST_SANE_NS else _LAST_NS


def latest_stamp(newest: Times, now_ns: int) -> int:
    """The latest stamp that counts now: now, plus how far the stamps of the topic are ahead of their arrival."""
    ahead_ns = newest.stamp_ns - newest.received_ns if newest.received_ns else 0
    return now_ns + ahead_ns if 0 < ahead_ns <= FUTURE_SLACK_NS else now_ns


_LAST_NS: Final = (1 << 63) - 1
LATELY_NS: Final = 60 * SECOND


def split(account: str) -> tuple[str, str]:
    """The sink and the topic of an account."""
    for prefix, sink in _SINKS.items():
        if account.startswith(prefix):
            return sink, account.removeprefix(prefix)
    return OBJECTS, account
