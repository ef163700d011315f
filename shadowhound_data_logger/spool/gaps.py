"""The gap journal: when messages were lost, how many and why, a row of the index for each second, topic and cause.

The accounts say how many; a row says when. Whoever counts a loss adds its times (``TopicGaps.add``). At each commit
``TopicGaps.settle`` compares what was added with the accounts: losses without times get those of the newest messages at this
commit and at the one before, and counts that the accounts took back leave the newest rows. So for each topic, kind and cause
the rows add up to the account at every commit, in the same transaction. Objects that are evicted or quarantined have theirs
by triggers (schema.py).

Changed rows get a new version, and a row that says nothing any more stays with the count 0 until it is forgotten: whoever
copies the journal asks for what is newer than the last version that it saw.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Final, NamedTuple

from shadowhound_data_logger.clock import EARLIEST_SANE_NS, FUTURE_SLACK_NS, SECOND, Clock

MISSED, REJECTED, DROPPED, EVICTED, QUARANTINED = 'missed', 'rejected', 'dropped', 'evicted', 'quarantined'
"""Kinds."""
EXACT, ESTIMATED = 'exact', 'estimated'
"""Grades."""
UNTIMED: Final = -1
"""The beginning of a row whose times nobody knows: of an older home, say."""
FORGOTTEN: Final = -2
"""The beginning of a row that holds the sum of those that were forgotten: when they were, the store knows."""
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
    count: int | None
    """Messages; 0 for a row that was true once, and is not any more. None where nobody knows."""
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
    """When its session began: numbers of sessions begin anew with a new index."""
    begin_ns: int = UNTIMED
    """With sink, topic, publisher, session, kind, cause, grade and mission this names the row."""
    version: int = 0
    """Rises with each change of any row."""

    def as_dict(self) -> dict[str, Any]:
        """As ``shadowhound-data ledger --gaps --json`` prints it."""
        return {name: getattr(self, name) for name in _PRINTED}


_PRINTED: Final = tuple(each.name for each in fields(Gap))[:12]


class Watermark(NamedTuple):
    """From when until when the journal of a topic is complete: what was lost between is in it, the rest is in the store."""

    robot: str
    sink: str
    topic: str
    session: int
    since_ns: int
    """UTC stamp of a message, and so is the next one."""
    complete_ns: int
    grade: str
    """Whether losses are known by numbers or estimated; there is no watermark where only the received is known."""
    received: int
    """Messages of the session so far."""
    skipped: int


class GapKey(NamedTuple):
    """What names a row beside its session and topic."""

    kind: str
    cause: str
    grade: str
    publisher: str
    mission: str
    begin_ns: int


class GapRow(NamedTuple):
    """A change of a row: times that it comprises, and how many messages and gaps more."""

    topic: str
    """The account: with the prefix of its sink."""
    key: GapKey
    from_ns: int | None
    to_ns: int | None
    messages: int
    merged: int


class TakenBack(NamedTuple):
    """Losses that were none, of whatever rows are the newest."""

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
    heard_ns: int = 0
    """Stamp of the newest message, first of an earlier session; 0 before the first."""
    before_ns: int = field(init=False)
    """The same of the earlier session; 0 where there is none."""
    count: int = 0
    """Gaps so far, of whatever kind."""
    _changes: dict[GapKey, GapRow] = field(default_factory=dict)
    _journaled: dict[tuple[str, str, str], int] = field(default_factory=dict)
    _since_ns: int = 0
    """``heard_ns`` at the last commit."""
    _before: tuple[dict[GapKey, GapRow], dict[tuple[str, str, str], int], int] | None = None

    def __post_init__(self) -> None:
        self.before_ns = self.heard_ns

    @property
    def has_heard(self) -> bool:
        """Whether a message came in this session."""
        return self.heard_ns != self.before_ns

    def add(self, kind: str, cause: str, messages: int, from_ns: int, to_ns: int, publisher: str = '',
            grade: str = EXACT) -> GapKey:  # fmt: skip
        """Messages were lost between these stamps, 0 where they are not known. Returns the row's key.

        Stamps of a wall clock that was never set become those of the boot clock, as in ``clock.stamp_of``. What is no time, or
        more than a day ahead of our clock, is not known; of a UTC stamp and one since boot the first counts.
        """
        from_ns, to_ns = self._time(from_ns), self._time(to_ns)
        if (from_ns < EARLIEST_SANE_NS) != (to_ns < EARLIEST_SANE_NS):
            from_ns = to_ns = max(from_ns, to_ns)
        from_ns, to_ns = from_ns or to_ns, to_ns or from_ns
        if not from_ns:
            begin_ns, start_ns, end_ns = UNTIMED, None, None
        else:
            start_ns, end_ns = min(from_ns, to_ns), max(from_ns, to_ns)
            begin_ns = start_ns // SECOND * SECOND if end_ns - start_ns < SECOND else start_ns
        key = GapKey(kind, cause, grade, publisher, self.mission, begin_ns)
        self.count += 1
        self._change(GapRow('', key, start_ns, end_ns, messages, 1))
        return key

    def fill(self, key: GapKey, merged: int) -> None:
        """One message of a gap came after all; ``merged`` is the change of how many gaps there are."""
        self.count += merged
        self._change(GapRow('', key, None, None, -1, merged))

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
                self.add(kind, cause, rest, self._since_ns or self.heard_ns, self.heard_ns, grade=grade)
            elif rest < 0:
                taken_back.append(TakenBack(topic, kind, cause, grade, -rest))
        self._before = self._changes, self._journaled, self._since_ns
        changes, self._changes = self._changes, {}
        self._journaled, self._since_ns = {what: count for what, count in figures.items() if count}, self.heard_ns
        return [row._replace(topic=topic) for row in changes.values() if row.messages or row.merged], taken_back

    def undo(self) -> None:
        """The commit did not become durable."""
        if self._before is None:
            return
        newer = self._changes
        self._changes, self._journaled, self._since_ns = self._before
        self._before = None
        for row in newer.values():
            self._change(row)

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
            starts = [stamp for stamp in (known.from_ns, row.from_ns) if stamp is not None]
            ends = [stamp for stamp in (known.to_ns, row.to_ns) if stamp is not None]
            row = GapRow('', known.key, min(starts, default=None), max(ends, default=None), known.messages + row.messages,
                         known.merged + row.merged)  # fmt: skip
        self._changes[row.key] = row


def latest(clock: Clock | None) -> int:
    """The time until which anything can have happened: now, where the clock is set. A publisher may stamp as it likes."""
    now_ns = 0 if clock is None else clock.wall_ns()
    return now_ns if now_ns >= EARLIEST_SANE_NS else _LAST_NS


_LAST_NS: Final = (1 << 63) - 1
LATELY_NS: Final = 60 * SECOND
MOST_WAITING: Final = 5_000
"""Objects of a bucket that are looked at for the first stamp of each account: some 20 ms."""
_SESSIONS: Final = """
SELECT session, robot, started_ns, received = skipped + stored
    + ifnull((SELECT sum(value) FROM json_each(rejected)), 0) + ifnull((SELECT sum(value) FROM json_each(dropped)), 0)
    AND ifnull(json_extract(dropped, '$.restart'), 0) = 0,
  topic, accounting, received, skipped, first_ns, heard_ns, complete_ns, ended_ns IS NOT NULL
FROM accounts JOIN sessions ON id = session
WHERE session > (SELECT max(id) FROM sessions) - 20 AND first_ns >= ? AND accounting IN ('exact', 'estimated')
ORDER BY robot, topic, session"""
NEXT_VERSION: Final = '(SELECT ifnull(max(version), 0) + 1 FROM gaps)'
_NAMED: Final = 'session = ? AND topic = ? AND kind = ? AND cause = ? AND grade = ?'
MERGE: Final = """
  ON CONFLICT DO UPDATE SET version = excluded.version, count = count + excluded.count, merged = merged + excluded.merged,
    from_ns = CASE WHEN count > 0 THEN min(from_ns, excluded.from_ns) ELSE excluded.from_ns END,
    to_ns = CASE WHEN count > 0 THEN max(to_ns, excluded.to_ns) ELSE excluded.to_ns END"""
"""What an INSERT does where the row is there."""


def write(db: sqlite3.Connection, session: int, rows: Iterable[GapRow], taken_back: Iterable[TakenBack]) -> None:
    """Change the journal, in the transaction that writes the accounts."""
    less: list[TakenBack] = []
    for row in rows:
        key = row.key
        if row.messages <= 0:
            changed = db.execute(
                f'UPDATE gaps SET version = {NEXT_VERSION}, count = count + ?, merged = max(0, merged + ?) WHERE {_NAMED}'  # noqa: S608
                ' AND publisher = ? AND mission = ? AND begin_ns = ? AND count + ? >= 0',
                (row.messages, row.merged, session, row.topic, *key, row.messages),
            ).rowcount  # fmt: skip
            if not changed and row.messages:
                less.append(TakenBack(row.topic, *key[:3], -row.messages))
            continue
        db.execute(
            f'INSERT INTO gaps VALUES (?,?,?,?,?,?,?,?,?,?,?,?,{NEXT_VERSION}) {MERGE}',  # noqa: S608 - own constants only
            (session, row.topic, *key, row.from_ns, row.to_ns, row.messages, row.merged),
        )
    for each in (*less, *taken_back):
        _take_back(db, session, each)


def _take_back(db: sqlite3.Connection, session: int, given: TakenBack) -> None:
    named = (session, given.topic, given.kind, given.cause, given.grade)
    rest = given.messages
    newest = f'SELECT publisher, mission, begin_ns, count FROM gaps WHERE {_NAMED} AND count > 0 ORDER BY begin_ns DESC LIMIT 1'  # noqa: S608
    while rest and (row := db.execute(newest, named).fetchone()) is not None:
        publisher, mission, begin_ns, count = row
        part = min(rest, count)
        db.execute(
            f'UPDATE gaps SET version = {NEXT_VERSION}, count = count - ?1, merged = CASE WHEN count > ?1 THEN merged ELSE 0 END'  # noqa: S608
            ' WHERE session = ? AND topic = ? AND kind = ? AND cause = ? AND grade = ? AND publisher = ? AND mission = ?'
            ' AND begin_ns = ?',
            (part, *named, publisher, mission, begin_ns),
        )
        rest -= part


def forget(db: sqlite3.Connection, before_ns: int, limit: int) -> bool:
    """Drop rows of before then, their sums stay; False when there may be more of them. In a transaction."""
    old = db.execute(
        'SELECT session, topic, kind, cause, grade, publisher, mission, begin_ns, count, merged FROM gaps'
        " WHERE begin_ns BETWEEN ? AND ? AND kind <> 'quarantined' LIMIT ?", (EARLIEST_SANE_NS, before_ns, limit),
    ).fetchall()  # fmt: skip
    sums = Counter[tuple[Any, ...]]()
    merged = Counter[tuple[Any, ...]]()
    for row in old:
        sums[row[:5]] += row[8]
        merged[row[:5]] += row[9]
    db.executemany(
        f"INSERT INTO gaps VALUES (?,?,?,?,?,'','',{FORGOTTEN},NULL,NULL,?,?,{NEXT_VERSION}) {MERGE}",  # noqa: S608
        ((*what, count, merged[what]) for what, count in sums.items()),
    )
    db.executemany(
        f'DELETE FROM gaps WHERE {_NAMED} AND publisher = ? AND mission = ? AND begin_ns = ?',  # noqa: S608
        (row[:8] for row in old),
    )
    return len(old) < limit


def changed(db: sqlite3.Connection, after: int, limit: int, offsets: Mapping[str, int]) -> list[Gap]:
    """The rows whose versions are greater, by version: about ``limit``, and all of the last version.

    ``offsets`` are UTC less boot clock by boot (``ClockRecord.offsets``). Sums of what was forgotten are left out.
    """
    query = 'SELECT version FROM gaps WHERE version > ? ORDER BY version LIMIT 1 OFFSET ?'
    last = db.execute(query, (after, limit - 1)).fetchone()
    upto = (1 << 62) if last is None else last[0]
    return list(_gaps(db, 'version > ? AND version <= ? AND begin_ns <> ? ORDER BY version', (after, upto, FORGOTTEN), offsets))


def extent(db: sqlite3.Connection, robot: str) -> tuple[int, int, set[str]]:
    """The newest version; when the journal began; and topics that other robots of this spool have, and this one has not."""
    newest = db.execute('SELECT ifnull(max(version), 0) FROM gaps').fetchone()[0]
    began_ns = db.execute('SELECT ifnull(min(started_ns), 0) FROM sessions').fetchone()[0]
    topics: dict[bool, set[str]] = {True: set(), False: set()}
    for account, is_own in db.execute('SELECT DISTINCT topic, robot = ? FROM accounts JOIN sessions ON id = session', (robot,)):
        topics[bool(is_own)].add(split(account)[1])
    return newest, began_ns, topics[False] - topics[True]


def has_undated(db: sqlite3.Connection) -> bool:
    """Whether there are rows of a time before the clock was set."""
    return db.execute('SELECT 1 FROM gaps WHERE begin_ns BETWEEN 0 AND ? LIMIT 1', (EARLIEST_SANE_NS,)).fetchone() is not None


def known(db: sqlite3.Connection, offsets: Mapping[str, int]) -> list[Gap]:
    """All that is lost, in the order of time; what has no time comes first."""
    return list(_gaps(db, 'count > 0 ORDER BY begin_ns, topic', (), offsets))


def watermarks(db: sqlite3.Connection) -> list[Watermark]:
    """Of each sink and topic of the newest sessions that has one.

    Before the first message that still waits for delivery, since that may yet be evicted; and before the last message of each
    publisher that was heard lately, since what it sent after that may be found to be missed.
    """
    waiting = _waiting(db)
    silent = {
        (session, account): stamp
        for session, account, stamp in db.execute(
            'SELECT session, topic, min(publishers.heard_ns) FROM publishers JOIN accounts USING (session, topic)'
            ' JOIN sessions ON id = session WHERE ended_ns IS NULL AND publishers.heard_ns > accounts.heard_ns - ?'
            ' GROUP BY session, topic', (LATELY_NS,),
        )
    }  # fmt: skip
    found = []
    for (session, robot, started_ns, is_over, account, grade, received, skipped, first_ns, heard_ns, complete_ns,
         has_ended) in db.execute(_SESSIONS, (EARLIEST_SANE_NS,)):  # fmt: skip
        sink, topic = split(account)
        if has_ended and sink == OBJECTS and is_over:
            complete_ns = heard_ns  # noqa: PLW2901 - nothing was lost on its way after all
        end_ns = min(complete_ns, silent.get((session, account), complete_ns), waiting.get(account, complete_ns))
        since_ns = max(first_ns, started_ns)
        if since_ns <= end_ns:
            found.append(Watermark(robot, sink, topic, session, since_ns, end_ns, grade, received, skipped))
    return found


def _waiting(db: sqlite3.Connection) -> dict[str, int]:
    """Account -> the first stamp of what waits for delivery or a name; 0 where so much waits that nobody looks for it."""
    waiting: dict[str, int] = {}
    is_all = True
    for state, column, order in (('pending', 'bucket', 'waiting'), ('held', 'reason', 'held')):
        for value in _values(db, state, column):
            rows = db.execute(
                'SELECT ifnull(contents.topic, one.topic), min(t_start_ns), count(*) FROM (SELECT id, topic, t_start_ns'  # noqa: S608
                f" FROM objects INDEXED BY {order} WHERE state = '{state}' AND {column} = ? ORDER BY id LIMIT {MOST_WAITING})"
                ' AS one LEFT JOIN contents USING (id) GROUP BY 1', (value,),
            ).fetchall()  # fmt: skip
            is_all &= sum(count for _, _, count in rows) < MOST_WAITING
            for account, stamp, _ in rows:
                waiting[account] = min(stamp, waiting.get(account, stamp))
    if not is_all:
        query = "SELECT topic FROM tally WHERE state IN ('pending', 'held') AND samples > 0"
        for (account,) in db.execute(query):
            waiting.setdefault(account, 0)
    return waiting


def _values(db: sqlite3.Connection, state: str, column: str) -> Iterator[str]:
    """Those that a column of objects in a state has, by one step in the index for each."""
    query = f"SELECT {column} FROM objects WHERE state = '{state}' AND {column} > ? ORDER BY {column} LIMIT 1"  # noqa: S608
    value = ''
    while row := db.execute(query, (value,)).fetchone():
        value = row[0]
        yield value


def sums(db: sqlite3.Connection) -> dict[tuple[str, str, str, str], int]:
    """(account, kind, cause, grade) -> messages, over all rows."""
    query = 'SELECT topic, kind, cause, grade, sum(count) FROM gaps GROUP BY topic, kind, cause, grade HAVING sum(count) <> 0'
    return {(*what,): count for *what, count in db.execute(query)}


def split(account: str) -> tuple[str, str]:
    """Sink and topic of an account."""
    for prefix, sink in _SINKS.items():
        if account.startswith(prefix):
            return sink, account.removeprefix(prefix)
    return OBJECTS, account


def _gaps(db: sqlite3.Connection, where: str, values: tuple[object, ...], offsets: Mapping[str, int]) -> Iterator[Gap]:
    columns = ('session, topic, kind, cause, grade, publisher, mission, begin_ns, from_ns, to_ns, count, merged, version, robot,'
               ' boot_id, started_ns')  # fmt: skip
    query = f'SELECT {columns} FROM gaps LEFT JOIN sessions ON sessions.id = session WHERE {where}'  # noqa: S608 - own conditions
    for (session, account, kind, cause, grade, publisher, mission, begin_ns, from_ns, to_ns, count, merged, version,
         robot, boot_id, started_ns) in db.execute(query, values):  # fmt: skip
        sink, topic = split(account)
        is_boot = from_ns is not None and from_ns < EARLIEST_SANE_NS
        offset_ns = offsets.get(boot_id) if is_boot else 0
        yield Gap(
            sink, topic, publisher or None, session or None, kind, cause, _plus(from_ns, offset_ns), _plus(to_ns, offset_ns),
            count, merged, grade, mission or None, robot, boot_id if is_boot else None, from_ns if is_boot else None,
            to_ns if is_boot else None, started_ns, begin_ns, version,
        )  # fmt: skip


def _plus(stamp_ns: int | None, offset_ns: int | None) -> int | None:
    return None if stamp_ns is None or offset_ns is None else stamp_ns + offset_ns
