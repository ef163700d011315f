"""The table of the gap journal (gaps.py): every statement that reads or writes it, except the triggers in schema.sql."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS
from shadowhound_data_logger.spool.gaps import FORGOTTEN, LATELY_NS, OBJECTS, UNTIMED, Gap, GapRow, TakenBack, Watermark, split
from shadowhound_data_logger.spool.table import Table

MOST_WAITING: Final = 5_000
"""Objects of a bucket that are looked at for the first stamp of each account: some 20 ms."""
_SESSIONS: Final = """
SELECT session, robot, started_ns, received = skipped + stored
    + ifnull((SELECT sum(value) FROM json_each(rejected)), 0) + ifnull((SELECT sum(value) FROM json_each(dropped)), 0)
    AND ifnull(json_extract(dropped, '$.restart'), 0) = 0,
  topic, accounting, received, skipped, first_ns, heard_ns, heard_received_ns, complete_ns,
  ended_ns IS NOT NULL
FROM accounts JOIN sessions ON id = session
WHERE session > (SELECT max(id) FROM sessions) - 20 AND first_ns >= ? AND accounting IN ('exact', 'estimated')
ORDER BY robot, topic, session"""
NEXT_VERSION: Final = '(SELECT ifnull(max(version), 0) + 1 FROM gaps)'
MERGE: Final = """
  ON CONFLICT DO UPDATE SET version = excluded.version, count = count + excluded.count, merged = merged + excluded.merged,
    from_ns = CASE WHEN count > 0 THEN min(from_ns, excluded.from_ns) ELSE excluded.from_ns END,
    to_ns = CASE WHEN count > 0 THEN max(to_ns, excluded.to_ns) ELSE excluded.to_ns END,
    received_from_ns = CASE WHEN count > 0 THEN min(received_from_ns, excluded.received_from_ns)
      ELSE excluded.received_from_ns END,
    received_to_ns = CASE WHEN count > 0 THEN max(received_to_ns, excluded.received_to_ns) ELSE excluded.received_to_ns END"""
"""What an INSERT does if the row exists; the triggers of schema.sql do the same."""
MOST_ROWS: Final = 500_000
"""Of the journal, some 100 MB: three days of a topic that loses messages in every second are 259,200."""
_TOLD: Final = """version <= CASE session WHEN 0 THEN (SELECT ifnull(max(version), 0) FROM gaps_reported) ELSE ifnull((
    SELECT told.version FROM gaps_reported AS told JOIN sessions USING (robot) WHERE sessions.id = gaps.session), 0) END"""
"""Whether the store is told of a row; those of objects have no session."""
_WHOLE_ROW: Final = f"""
SELECT session, topic, kind, cause, grade, publisher, mission, begin_ns, count, merged, to_ns, {_TOLD} FROM gaps"""  # noqa: S608
_FORGETTABLE: Final = f"""{_WHOLE_ROW} WHERE begin_ns BETWEEN ? AND ? AND ifnull(to_ns, begin_ns) <= ?
  AND kind <> 'quarantined' AND {_TOLD}"""
_OF_OLD_SESSIONS: Final = f"""{_WHOLE_ROW} WHERE (begin_ns BETWEEN {UNTIMED} AND ? - 1 OR begin_ns > ?)
  AND session BETWEEN 1 AND (SELECT ifnull(max(id), 0) FROM sessions WHERE ended_ns BETWEEN ? AND ?) AND {_TOLD}"""  # noqa: S608 - own constants only
_LONGEST_UNCHANGED: Final = f"{_WHOLE_ROW} WHERE begin_ns <> {FORGOTTEN} AND kind <> 'quarantined' ORDER BY version"
_SUM_OF_TOLD, _SUM_OF_UNTOLD = 1, 0
"""In ``from_ns`` of a sum: whether all rows in it have been reported to the store."""
_FORGOTTEN_UNTIL: Final = f"""
SELECT session, topic, max(ifnull(to_ns, (SELECT max(started_ns) FROM sessions)))
FROM gaps WHERE begin_ns = {FORGOTTEN} AND (ifnull(from_ns, {_SUM_OF_UNTOLD}) = {_SUM_OF_UNTOLD}
  OR EXISTS (SELECT 1 FROM gaps_reported WHERE again)) GROUP BY session, topic"""  # noqa: S608
"""When the last forgotten gap ended that may be missing in the store; if that is unknown, when the newest session began."""
_NAMED: Final = 'session = ? AND topic = ? AND kind = ? AND cause = ? AND grade = ?'


class GapTable(Table):
    """The table of the gap journal."""

    def write(self, session: int, rows: Iterable[GapRow], taken_back: Iterable[TakenBack]) -> None:
        """Change the journal, in the transaction that writes the accounts."""
        less: list[TakenBack] = []
        for row in rows:
            key = row.key
            if row.messages <= 0:
                changed = self._db.execute(
                    f'UPDATE gaps SET version = {NEXT_VERSION}, count = count + ?, merged = max(0, merged + ?) WHERE {_NAMED}'  # noqa: S608
                    ' AND publisher = ? AND mission = ? AND begin_ns = ? AND count + ? >= 0',
                    (row.messages, row.merged, session, row.topic, *key, row.messages),
                ).rowcount  # fmt: skip
                if not changed and row.messages:
                    less.append(TakenBack(row.topic, *key[:3], -row.messages))
                continue
            self._db.execute(
                f'INSERT INTO gaps VALUES (?,?,?,?,?,?,?,?,?,?,?,?,?,?,{NEXT_VERSION}) {MERGE}',  # noqa: S608 - own constants only
                (session, row.topic, *key, *row[2:]),
            )
        for each in (*less, *taken_back):
            self._take_back(session, each)

    def _take_back(self, session: int, given: TakenBack) -> None:
        named = (session, given.topic, given.kind, given.cause, given.grade)
        rest = given.messages
        newest = (
            f'SELECT publisher, mission, begin_ns, count FROM gaps WHERE {_NAMED} AND count > 0 ORDER BY begin_ns DESC LIMIT 1'  # noqa: S608
        )
        while rest and (row := self._db.execute(newest, named).fetchone()) is not None:
            publisher, mission, begin_ns, count = row
            part = min(rest, count)
            self._db.execute(
                f'UPDATE gaps SET version = {NEXT_VERSION}, count = count - ?,'  # noqa: S608
                ' merged = CASE WHEN count > ? THEN merged ELSE 0 END'
                ' WHERE session = ? AND topic = ? AND kind = ? AND cause = ? AND grade = ? AND publisher = ? AND mission = ?'
                ' AND begin_ns = ?',
                (part, part, *named, publisher, mission, begin_ns),
            )
            rest -= part

    def forget(self, before_ns: int, limit: int) -> bool:
        """Drop rows of what was over before then; False when there may be more of them. In a transaction.

        Their sums stay, with the end of the last of them, for what is told again (``watermarks``).

        A row stays until a part of the spool tells it. Rows without a time, of before the clock was set or of a time to come go
        when their session has ended so long ago. Beyond ``MOST_ROWS`` those go that did not change for the longest. Rows of
        quarantined objects stay.
        """
        old = self._db.execute(f'{_FORGETTABLE} LIMIT ?', (EARLIEST_SANE_NS, before_ns, before_ns, limit)).fetchall()
        if len(old) < limit:
            times = EARLIEST_SANE_NS, before_ns, EARLIEST_SANE_NS, before_ns
            old += self._db.execute(f'{_OF_OLD_SESSIONS} LIMIT ?', (*times, limit)).fetchall()
        over = self._db.execute('SELECT count(*) FROM gaps').fetchone()[0] - MOST_ROWS - len(old)
        if over > 0:
            old = list(dict.fromkeys(old + self._db.execute(f'{_LONGEST_UNCHANGED} LIMIT ?', (min(over, limit),)).fetchall()))
        sums = Counter[tuple[Any, ...]]()
        merged = Counter[tuple[Any, ...]]()
        ends: dict[tuple[Any, ...], int | None] = {}
        told: dict[tuple[Any, ...], int] = {}
        for row in old:
            sums[row[:5]] += row[8]
            merged[row[:5]] += row[9]
            end_ns, last_ns = row[10], ends.get(row[:5], 0)
            is_known = end_ns is not None and end_ns >= EARLIEST_SANE_NS and last_ns is not None
            ends[row[:5]] = max(end_ns, last_ns) if is_known else None
            told[row[:5]] = min(told.get(row[:5], _SUM_OF_TOLD), _SUM_OF_TOLD if row[11] else _SUM_OF_UNTOLD)
        self._db.executemany(
            f"INSERT INTO gaps VALUES (?,?,?,?,?,'','',{FORGOTTEN},?,?,NULL,NULL,?,?,{NEXT_VERSION}) {MERGE}",  # noqa: S608
            ((*what, told[what], ends[what], count, merged[what]) for what, count in sums.items()),
        )
        self._db.executemany(
            f'DELETE FROM gaps WHERE {_NAMED} AND publisher = ? AND mission = ? AND begin_ns = ?',  # noqa: S608
            (row[:8] for row in old),
        )
        return len(old) < limit

    def told(self, robot: str) -> tuple[int, int]:
        """Up to which version the parts of a robot tell all, and how often it was asked to tell all of it again."""
        found = self._db.execute('SELECT version, again FROM gaps_reported WHERE robot = ?', (robot,)).fetchone()
        return (found[0], found[1]) if found else (0, 0)

    def set_reported(self, robot: str, version: int) -> None:
        """In the transaction that spools the last part of those that tell it."""
        query = 'INSERT INTO gaps_reported VALUES (?, ?, 0) ON CONFLICT DO UPDATE SET version = excluded.version'
        self._db.execute(query, (robot, version))

    def set_all_reported(self) -> None:
        """Nobody will tell what is there by now."""
        self._db.execute('UPDATE gaps_reported SET version = (SELECT ifnull(max(version), 0) FROM gaps)')

    def resend(self) -> int:
        """Have all robots of this spool tell the store all that is remembered; returns how many rows that is."""
        self._db.execute('UPDATE gaps_reported SET version = 0, again = again + 1')
        return int(self._db.execute('SELECT count(*) FROM gaps WHERE begin_ns <> ?', (FORGOTTEN,)).fetchone()[0])

    def changed(self, after: int, limit: int, offsets: Mapping[str, int]) -> list[Gap]:
        """The rows whose versions are greater, by version: about ``limit``, and all of the last version.

        ``offsets`` are UTC less boot clock by boot (``ClockRecord.offsets``). Sums of what was forgotten are left out.
        """
        query = 'SELECT version FROM gaps WHERE version > ? ORDER BY version LIMIT 1 OFFSET ?'
        last = self._db.execute(query, (after, limit - 1)).fetchone()
        upto = (1 << 62) if last is None else last[0]
        return list(
            self._gaps('version > ? AND version <= ? AND begin_ns <> ? ORDER BY version', (after, upto, FORGOTTEN), offsets)
        )

    def extent(self, robot: str) -> tuple[int, int, set[str]]:
        """The newest version; when the journal began; and topics that other robots of this spool have, and this one has not."""
        newest = self._db.execute('SELECT ifnull(max(version), 0) FROM gaps').fetchone()[0]
        began_ns = self._db.execute('SELECT ifnull(min(started_ns), 0) FROM sessions').fetchone()[0]
        topics: dict[bool, set[str]] = {True: set(), False: set()}
        for account, is_own in self._db.execute(
            'SELECT DISTINCT topic, robot = ? FROM accounts JOIN sessions ON id = session', (robot,)
        ):
            topics[bool(is_own)].add(split(account)[1])
        return newest, began_ns, topics[False] - topics[True]

    def has_undated(self) -> bool:
        """Whether there are rows of a time before the clock was set."""
        return (
            self._db.execute('SELECT 1 FROM gaps WHERE begin_ns BETWEEN 0 AND ? LIMIT 1', (EARLIEST_SANE_NS,)).fetchone()
            is not None
        )

    def known(self, offsets: Mapping[str, int]) -> list[Gap]:
        """All that is lost, in the order of time; what has no time comes first."""
        return list(self._gaps('count > 0 ORDER BY begin_ns, topic', (), offsets))

    def watermarks(self) -> list[Watermark]:
        """Of each sink and topic of the newest sessions that has one.

        Before the first message that still waits for delivery, since that may yet be evicted; and before the last message of each
        publisher that was heard lately, since what it sent after that may be found to be missed. None begins before the end of
        what was forgotten and the store was never told; nor, once a robot of the spool was asked to tell all again, before
        the end of anything that was forgotten: the store may have lost that.
        """
        waiting = self._waiting()
        forgotten = {(session, account): stamp for session, account, stamp in self._db.execute(_FORGOTTEN_UNTIL)}
        silent = {
            (session, account): stamp
            for session, account, stamp in self._db.execute(
                'SELECT session, topic, min(publishers.heard_ns) FROM publishers JOIN accounts USING (session, topic)'
                ' JOIN sessions ON id = session WHERE ended_ns IS NULL AND publishers.heard_ns > accounts.heard_ns - ?'
                ' GROUP BY session, topic', (LATELY_NS,),
            )
        }  # fmt: skip
        found = []
        for (session, robot, started_ns, is_over, account, grade, received, skipped, first_ns, heard_ns, heard_received_ns,
             complete_ns, has_ended) in self._db.execute(_SESSIONS, (EARLIEST_SANE_NS,)):  # fmt: skip
            sink, topic = split(account)
            if has_ended and sink == OBJECTS and is_over:
                complete_ns = heard_ns  # noqa: PLW2901 - nothing was lost on its way after all
            late_ns = heard_received_ns - heard_ns if heard_received_ns else 0
            end_ns = min(complete_ns, silent.get((session, account), complete_ns), waiting.get(account, complete_ns))
            since_ns = max(first_ns, started_ns - late_ns, forgotten.get((session, account), 0), forgotten.get((0, account), 0))
            if since_ns <= end_ns:
                arrived_ns = min(end_ns + late_ns, heard_received_ns) or None
                found.append(Watermark(
                    robot, sink, topic, session, since_ns, end_ns, arrived_ns and since_ns + late_ns, arrived_ns, grade, received,
                    skipped,
                ))  # fmt: skip
        return found

    def _waiting(self) -> dict[str, int]:
        """Account -> the first stamp of what waits for delivery or a name; 0 where so much waits that nobody looks for it."""
        waiting: dict[str, int] = {}
        is_all = True
        for state, column, order in (('pending', 'bucket', 'waiting'), ('held', 'reason', 'held')):
            for value in self._values(state, column):
                rows = self._db.execute(
                    'SELECT ifnull(contents.topic, one.topic), min(t_start_ns), count(*) FROM (SELECT id, topic, t_start_ns'  # noqa: S608
                    f" FROM objects INDEXED BY {order} WHERE state = '{state}' AND {column} = ? ORDER BY id LIMIT {MOST_WAITING})"
                    ' AS one LEFT JOIN contents USING (id) GROUP BY 1', (value,),
                ).fetchall()  # fmt: skip
                is_all &= sum(count for _, _, count in rows) < MOST_WAITING
                for account, stamp, _ in rows:
                    waiting[account] = min(stamp, waiting.get(account, stamp))
        if not is_all:
            query = "SELECT topic FROM tally WHERE state IN ('pending', 'held') AND samples > 0"
            for (account,) in self._db.execute(query):
                waiting.setdefault(account, 0)
        for account, stamp in self._kept():
            waiting[account] = min(stamp, waiting.get(account, stamp))
        return waiting

    def _kept(self) -> Iterator[tuple[str, int]]:
        """Account -> about the first stamp of what is kept here: of that, nothing is in the store."""
        there = [account for (account,) in self._db.execute("SELECT topic FROM tally WHERE state = 'kept' AND samples > 0")]
        if not there:
            return
        oldest = dict(self._db.execute(
            'SELECT ifnull(contents.topic, one.topic), min(t_start_ns) FROM (SELECT id, topic, t_start_ns FROM objects'  # noqa: S608
            f" INDEXED BY kept WHERE state = 'kept' ORDER BY id LIMIT {MOST_WAITING})"
            ' AS one LEFT JOIN contents USING (id) GROUP BY 1').fetchall())  # fmt: skip
        yield from ((account, oldest.get(account, 0)) for account in there)

    def _values(self, state: str, column: str) -> Iterator[str]:
        """Those that a column of objects in a state has, by one step in the index for each."""
        query = f"SELECT {column} FROM objects WHERE state = '{state}' AND {column} > ? ORDER BY {column} LIMIT 1"  # noqa: S608
        value = ''
        while row := self._db.execute(query, (value,)).fetchone():
            value = row[0]
            yield value

    def sums(self) -> dict[tuple[str, str, str, str], int]:
        """(account, kind, cause, grade) -> messages, over all rows."""
        query = 'SELECT topic, kind, cause, grade, sum(count) FROM gaps GROUP BY topic, kind, cause, grade HAVING sum(count) <> 0'
        return {(*what,): count for *what, count in self._db.execute(query)}

    def _gaps(self, where: str, values: tuple[object, ...], offsets: Mapping[str, int]) -> Iterator[Gap]:
        columns = ('session, topic, kind, cause, grade, publisher, mission, begin_ns, from_ns, to_ns,'
                   ' received_from_ns, received_to_ns, count, merged, version, robot, boot_id, started_ns')  # fmt: skip
        query = f'SELECT {columns} FROM gaps LEFT JOIN sessions ON sessions.id = session WHERE {where}'  # noqa: S608 - own conditions
        for (session, account, kind, cause, grade, publisher, mission, begin_ns, from_ns, to_ns, received_from_ns,
             received_to_ns, count, merged, version, robot, boot_id, started_ns) in self._db.execute(query, values):  # fmt: skip
            sink, topic = split(account)
            if begin_ns == FORGOTTEN:
                from_ns = to_ns = None  # noqa: PLW2901 - a sum has no time
            is_boot = from_ns is not None and from_ns < EARLIEST_SANE_NS
            offset_ns = offsets.get(boot_id) if is_boot else 0
            yield Gap(
                sink, topic, publisher or None, session or None, kind, cause, _plus(from_ns, offset_ns), _plus(to_ns, offset_ns),
                received_from_ns, received_to_ns, count, merged, grade, mission or None, robot, boot_id if is_boot else None,
                from_ns if is_boot else None, to_ns if is_boot else None, started_ns, begin_ns, version,
            )  # fmt: skip


def _plus(stamp_ns: int | None, offset_ns: int | None) -> int | None:
    return None if stamp_ns is None or offset_ns is None else stamp_ns + offset_ns
