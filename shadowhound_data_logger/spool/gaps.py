"""The gap journal: when messages were lost, how many and why, a row of the index for each second, topic and cause.

The accounts say how many; a row says when. Whoever counts a loss adds its times (``TopicGaps.add``). At each commit
``TopicGaps.settle`` compares what was added with the accounts: losses without times get those of the newest messages at this
commit and at the one before, and counts that the accounts took back leave the newest rows. So for each topic, kind and cause
the rows add up to the account at every commit, in the same transaction. Objects that are evicted or quarantined have theirs
by triggers (schema.sql).

Changed rows get a new version, and a row that says nothing any more stays with the count 0 until it is forgotten: whoever
copies the journal asks for what is newer than the last version that it saw.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Final, NamedTuple

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, FUTURE_SLACK_NS, SECOND, Clock
from shadowhound_data_logger.core.stamps import NO_TIMES, Times, is_of_two_clocks

MISSED, REJECTED, DROPPED, EVICTED, QUARANTINED = 'missed', 'rejected', 'dropped', 'evicted', 'quarantined'
"""Kinds."""
EXACT, ESTIMATED = 'exact', 'estimated'
"""Grades."""
UNTIMED: Final = -1
"""The beginning of a row without a known time."""
FORGOTTEN: Final = -2
"""The beginning of a row that holds the sum of those that were forgotten: when they were, the store knows."""
HOUR_NS: Final = 3600 * SECOND
MAX_NEW_ROWS: Final = 7200
"""Of a sink and topic in an hour: two a second. Further gaps of a kind and cause are one row, without publisher and mission."""
MAX_RECENT: Final = 256
OBJECTS, BAGS, EVENTS = 'objects', 'bags', 'events'
"""Sinks."""
_SINKS: Final = {'bag:': BAGS, 'event:': EVENTS}


@dataclass(frozen=True, slots=True)
class Gap:
    """Losses of one sink, topic, kind and cause, of one publisher where that is known, that began within one second."""

    sink: str
    topic: str
    publisher: str | None
    session: int | None
    """Of the index; None for objects that were evicted or are quarantined."""
    kind: str
    cause: str
    from_ns: int | None
    """UTC stamp of the last message before; of an object, of its first. None where no clock knows it."""
    to_ns: int | None
    """UTC stamp of the first message after; of an object, of its last."""
    received_from_ns: int | None
    """When the message of ``from_ns`` arrived. None if that is unknown."""
    received_to_ns: int | None
    """When the message of ``to_ns`` arrived."""
    count: int | None
    """Messages; 0 for a row that was true once, and is not any more. None where it is not known."""
    merged: int
    """How many gaps are in it."""
    grade: str
    mission_id: str | None
    robot: str | None = None
    boot_id: str | None = None
    """Where the wall clock was not set: of which boot the next two are."""
    from_boot_ns: int | None = None
    to_boot_ns: int | None = None
    began_ns: int | None = None
    """When its session began: numbers of sessions start again with a new index."""
    begin_ns: int = UNTIMED
    """With sink, topic, publisher, session, kind, cause, grade and mission this names the row."""
    version: int = 0
    """Rises with each change of any row."""

    def as_dict(self) -> dict[str, Any]:
        """As ``shadowhound-data ledger --gaps --json`` prints it."""
        return {name: getattr(self, name) for name in _PRINTED}


_PRINTED: Final = tuple(each.name for each in fields(Gap))[:14]


class Watermark(NamedTuple):
    """From when until when the journal of a topic is complete: what was lost between is in it, the rest is in the store."""

    robot: str
    sink: str
    topic: str
    session: int
    since_ns: int
    """UTC stamp of a message, and so is the next one."""
    complete_ns: int
    received_since_ns: int | None
    """The same two by the arrival of messages; None if that is unknown."""
    received_complete_ns: int | None
    grade: str
    """Whether losses are known by numbers or estimated; there is no watermark where only the received is known."""
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
    """A change of a row: the times that it covers, and how many messages and gaps are added to it."""

    topic: str
    """The account: with the prefix of its sink."""
    key: GapKey
    from_ns: int | None
    to_ns: int | None
    received_from_ns: int | None
    received_to_ns: int | None
    messages: int
    merged: int


class TakenBack(NamedTuple):
    """Losses to take back, because they were none; taken from the newest rows."""

    topic: str
    kind: str
    cause: str
    grade: str
    messages: int


Figures = Mapping[tuple[str, str, str], int]
"""(kind, cause, grade) -> messages, as an account has them."""


@dataclass(slots=True)
class TopicGaps:
    """What the next commit changes in the journal of one account. Guarded as that is."""

    mission: str = ''
    """The one that is active now."""
    clock: Clock | None = None
    """Of this machine: of stamps from before it was set."""
    heard: Times = NO_TIMES
    """Those of the newest message, first of an earlier session; zeros before the first."""
    before: Times = field(init=False)
    """The same of the earlier session; zeros if there is none."""
    count: int = 0
    """Gaps so far, of whatever kind."""
    _changes: dict[GapKey, GapRow] = field(default_factory=dict)
    _journaled: dict[tuple[str, str, str], int] = field(default_factory=dict)
    _since: Times = NO_TIMES
    """``heard`` at the last commit."""
    _recent: dict[GapKey, None] = field(default_factory=dict)
    """Rows that are not new: the last ones that something was added to."""
    _hour: int = 0
    _new_rows: int = 0
    """In this hour since boot."""
    _before_commit: tuple[dict[GapKey, GapRow], dict[tuple[str, str, str], int], Times] | None = None

    def __post_init__(self) -> None:
        self.before = self.heard

    @property
    def has_received(self) -> bool:
        """Whether a message came in this session."""
        return self.heard != self.before

    def add(self, kind: str, cause: str, messages: int, before: Times, after: Times, publisher: str = '',
            grade: str = EXACT) -> GapKey:  # fmt: skip
        """Messages were lost between these two, or are these two and all between them. Returns the row's key.

        Stamps of a wall clock that was never set become those of the boot clock, as in ``stamps.StampRule``. What is not a time,
        or more than a day ahead of our clock, is not known; of a UTC stamp and one since boot the first counts. Without a
        publisher, the two messages may be of publishers with different clocks: then both times are by the clock of ``after``.
        """
        if not publisher and is_of_two_clocks(before, after):
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
        """Messages of a gap came after all; ``merged`` is the change of how many gaps there are."""
        self.count += merged
        self._change(GapRow('', key, None, None, None, None, -messages, merged))

    def settle(self, topic: str, figures: Figures) -> tuple[list[GapRow], list[TakenBack]]:
        """What a commit with these figures has to change in the journal; ``undo`` if it fails."""
        added = Counter[tuple[str, str, str]]()
        for key, row in self._changes.items():
            added[key[:3]] += row.messages
        taken_back: list[TakenBack] = []
        for what in figures.keys() | self._journaled.keys() | added.keys():
            rest = figures.get(what, 0) - self._journaled.get(what, 0) - added[what]
            kind, cause, grade = what
            if rest > 0:
                self.add(kind, cause, rest, self._since if any(self._since) else self.heard, self.heard, grade=grade)
            elif rest < 0:
                taken_back.append(TakenBack(topic, kind, cause, grade, -rest))
        self._before_commit = self._changes, self._journaled, self._since
        changes, self._changes = self._changes, {}
        self._journaled, self._since = {what: count for what, count in figures.items() if count}, self.heard
        return [row._replace(topic=topic) for row in changes.values() if row.messages or row.merged], taken_back

    def undo(self) -> None:
        """The commit did not become durable."""
        if self._before_commit is None:
            return
        newer = self._changes
        self._changes, self._journaled, self._since = self._before_commit
        self._before_commit = None
        for row in newer.values():
            self._change(row)

    def _bounded(self, key: GapKey) -> GapKey:
        """The row; the one of the hour, where too many are new in it: publishers choose their stamps, and come and go."""
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
    """The time until which anything can have happened: now, where the clock is set. A publisher may stamp as it likes."""
    now_ns = 0 if clock is None else clock.wall_ns()
    return now_ns if now_ns >= EARLIEST_SANE_NS else _LAST_NS


def latest_stamp(newest: Times, now_ns: int) -> int:
    """The latest stamp that counts by then: now, or as much later as the stamps of a topic are ahead of their arrival."""
    ahead_ns = newest.stamp_ns - newest.received_ns if newest.received_ns else 0
    return now_ns + ahead_ns if 0 < ahead_ns <= FUTURE_SLACK_NS else now_ns


_LAST_NS: Final = (1 << 63) - 1
LATELY_NS: Final = 60 * SECOND


def split(account: str) -> tuple[str, str]:
    """Sink and topic of an account."""
    for prefix, sink in _SINKS.items():
        if account.startswith(prefix):
            return sink, account.removeprefix(prefix)
    return OBJECTS, account
