"""The table of the gap journal (gaps.py): all statements that read or write it, except the triggers in schema.sql."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS
from shadowhound_data_logger.spool.gaps import FORGOTTEN, LATELY_NS, OBJECTS, UNTIMED, Gap, GapRow, TakenBack, Watermark, split
from shadowhound_data_logger.spool.schema import Table

MAX_SCANNED: Final = 5_000
"""Objects of a bucket that are read to find the first stamp of each account: some 20 ms."""
_SESSIONS: Final = """
SELECT session, robot, started_ns, received = skipped + stored
    + ifnull((SELECT sum(value) FROM json_each(rejected)), 0) + ifnull((SELECT sum(value) FROM json_each(dropped)), 0)
    AND ifnull(json_extract(dropped, '$.restart'), 0) = 0,
  topic, accounting, received, skipped, first_ns, newest_ns, newest_received_ns, complete_ns,
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
MAX_ROWS: Final = 500_000
"""Rows in the journal, some 100 MB: three days of a topic that loses messages in every second are 259,200."""
_REPORTED: Final = """version <= CASE session WHEN 0 THEN (SELECT ifnull(max(version), 0) FROM gaps_reported) ELSE ifnull((
    SELECT known.version FROM gaps_reported AS known JOIN sessions USING (robot) WHERE sessions.id = gaps.session), 0) END"""
"""Whether a row has been reported to the store; rows of objects have no session."""
_WHOLE_ROW: Final = f"""
SELECT session, topic, kind, cause, grade, publisher, mission, begin_ns, count, merged, to_ns, {_REPORTED} FROM gaps"""  # noqa: S608
_FORGETTABLE: Final = f"""{_WHOLE_ROW} WHERE begin_ns BETWEEN ? AND ? AND ifnull(to_ns, begin_ns) <= ?
  AND kind <> 'quarantined' AND {_REPORTED}"""
_OF_OLD_SESSIONS: Final = f"""{_WHOLE_ROW} WHERE (begin_ns BETWEEN {UNTIMED} AND ? - 1 OR begin_ns > ?)
  AND session BETWEEN 1 AND (SELECT ifnull(max(id), 0) FROM sessions WHERE ended_ns BETWEEN ? AND ?) AND {_REPORTED}"""  # noqa: S608 - own constants only
_LONGEST_UNCHANGED: Final = f"{_WHOLE_ROW} WHERE begin_ns <> {FORGOTTEN} AND kind <> 'quarantined' ORDER BY version"
_SUM_OF_REPORTED, _SUM_OF_UNREPORTED = 1, 0
"""In ``from_ns`` of a sum: whether all of its rows had been reported to the store."""
_FORGOTTEN_UNTIL: Final = f"""
SELECT session, topic, max(ifnull(to_ns, (SELECT max(started_ns) FROM sessions)))
FROM gaps WHERE begin_ns = {FORGOTTEN} AND (ifnull(from_ns, {_SUM_OF_UNREPORTED}) = {_SUM_OF_UNREPORTED}
  OR EXISTS (SELECT 1 FROM gaps_reported WHERE again)) GROUP BY session, topic"""  # noqa: S608
"""The end of the last forgotten gap that the store may not have; if unknown, the start of the newest session."""
_NAMED: Final = 'session = ? AND topic = ? AND kind = ? AND cause = ? AND grade = ?'


class GapTable(Table):
    """The table of the gap journal."""

    def write(self, session: int, rows: Iterable[GapRow], taken_back: Iterable[TakenBack]) -> None:
        """Apply the changes of one commit, in the transaction that writes the accounts."""
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
        """Delete rows of gaps that ended before then; False if there may be more of them. Call it in a transaction.

        Their sums are kept, with the end of the last of them, for the watermarks.

        A row is kept until an object of the spool reports it. Rows without a time, from before the clock was set or in the future
        are deleted once their session ended before then. Beyond ``MAX_ROWS``, the rows that have been unchanged for longest are
        deleted. Rows of quarantined objects are kept.
        """
        old = self._db.execute(f'{_FORGETTABLE} LIMIT ?', (EARLIEST_SANE_NS, before_ns, before_ns, limit)).fetchall()
        if len(old) < limit:
            times = EARLIEST_SANE_NS, before_ns, EARLIEST_SANE_NS, before_ns
            old += self._db.execute(f'{_OF_OLD_SESSIONS} LIMIT ?', (*times, limit)).fetchall()
        over = self._db.execute('SELECT count(*) FROM gaps').fetchone()[0] - MAX_ROWS - len(old)
        if over > 0:
            old = list(dict.fromkeys(old + self._db.execute(f'{_LONGEST_UNCHANGED} LIMIT ?', (min(over, limit),)).fetchall()))
        sums = Counter[tuple[Any, ...]]()
        merged = Counter[tuple[Any, ...]]()
        ends: dict[tuple[Any, ...], int | None] = {}
        reported: dict[tuple[Any, ...], int] = {}
        for row in old:
            sums[row[:5]] += row[8]
            merged[row[:5]] += row[9]
            end_ns, last_ns = row[10], ends.get(row[:5], 0)
            is_known = end_ns is not None and end_ns >= EARLIEST_SANE_NS and last_ns is not None
            ends[row[:5]] = max(end_ns, last_ns) if is_known else None
            is_reported = _SUM_OF_REPORTED if row[11] else _SUM_OF_UNREPORTED
            reported[row[:5]] = min(reported.get(row[:5], _SUM_OF_REPORTED), is_reported)
        self._db.executemany(
            f"INSERT INTO gaps VALUES (?,?,?,?,?,'','',{FORGOTTEN},?,?,NULL,NULL,?,?,{NEXT_VERSION}) {MERGE}",  # noqa: S608
            ((*what, reported[what], ends[what], count, merged[what]) for what, count in sums.items()),
        )
        self._db.executemany(
            f'DELETE FROM gaps WHERE {_NAMED} AND publisher = ? AND mission = ? AND begin_ns = ?',  # noqa: S608
            (row[:8] for row in old),
        )
        return len(old) < limit

    def reported(self, robot: str) -> tuple[int, int]:
        """The version up to which a robot has reported all rows, and how often an operator requested that it resend them."""
        found = self._db.execute('SELECT version, again FROM gaps_reported WHERE robot = ?', (robot,)).fetchone()
        return (found[0], found[1]) if found else (0, 0)

    def set_reported(self, robot: str, version: int) -> None:
        """Record this, in the transaction that spools the last object that reports the version."""
        query = 'INSERT INTO gaps_reported VALUES (?, ?, 0) ON CONFLICT DO UPDATE SET version = excluded.version'
        self._db.execute(query, (robot, version))

    def set_all_reported(self) -> None:
        """Record all current rows as reported, because the catalog is off."""
        self._db.execute('UPDATE gaps_reported SET version = (SELECT ifnull(max(version), 0) FROM gaps)')

    def resend(self) -> int:
        """Make all robots of this spool report every remembered row again; returns how many rows that is."""
        self._db.execute('UPDATE gaps_reported SET version = 0, again = again + 1')
        return int(self._db.execute('SELECT count(*) FROM gaps WHERE begin_ns <> ?', (FORGOTTEN,)).fetchone()[0])

    def changed(self, after: int, limit: int, offsets: Mapping[str, int]) -> list[Gap]:
        """Rows with versions after this, by version: about ``limit``, with all rows of the last version.

        ``offsets`` are UTC minus the boot clock by boot id (``ClockRecord.offsets``). Sums of forgotten rows are omitted.
        """
        query = 'SELECT version FROM gaps WHERE version > ? ORDER BY version LIMIT 1 OFFSET ?'
        last = self._db.execute(query, (after, limit - 1)).fetchone()
        upto = (1 << 62) if last is None else last[0]
        return list(
            self._gaps('version > ? AND version <= ? AND begin_ns <> ? ORDER BY version', (after, upto, FORGOTTEN), offsets)
        )

    def extent(self, robot: str) -> tuple[int, int, set[str]]:
        """The newest version; when the journal began; and the topics of this spool's other robots that this one does not have."""
        newest = self._db.execute('SELECT ifnull(max(version), 0) FROM gaps').fetchone()[0]
        began_ns = self._db.execute('SELECT ifnull(min(started_ns), 0) FROM sessions').fetchone()[0]
        topics: dict[bool, set[str]] = {True: set(), False: set()}
        for account, is_own in self._db.execute(
            'SELECT DISTINCT topic, robot = ? FROM accounts JOIN sessions ON id = session', (robot,)
        ):
            topics[bool(is_own)].add(split(account)[1])
        return newest, began_ns, topics[False] - topics[True]

    def has_undated(self) -> bool:
        """Whether there are rows from before the clock was set."""
        return (
            self._db.execute('SELECT 1 FROM gaps WHERE begin_ns BETWEEN 0 AND ? LIMIT 1', (EARLIEST_SANE_NS,)).fetchone()
            is not None
        )

    def known(self, offsets: Mapping[str, int]) -> list[Gap]:
        """All losses by time; those without a time come first."""
        return list(self._gaps('count > 0 ORDER BY begin_ns, topic', (), offsets))

    def watermarks(self) -> list[Watermark]:
        """The watermarks of the sinks and topics of the newest sessions that have one.

        A watermark ends before the first message that still waits for delivery, because it may yet be evicted, and at the last
        message of each recent publisher, because later messages may turn out to be missed. It starts after the last forgotten
        gap that was never reported to the store; once an operator has requested that the journal be resent, after the last
        forgotten gap of any kind, because the store may have lost it.
        """
        unsent = self._first_unsent()
        forgotten = {(session, account): stamp for session, account, stamp in self._db.execute(_FORGOTTEN_UNTIL)}
        silent = {
            (session, account): stamp
            for session, account, stamp in self._db.execute(
                'SELECT session, topic, min(publishers.last_ns) FROM publishers JOIN accounts USING (session, topic)'
                ' JOIN sessions ON id = session WHERE ended_ns IS NULL AND publishers.last_ns > accounts.newest_ns - ?'
                ' GROUP BY session, topic', (LATELY_NS,),
            )
        }  # fmt: skip
        found = []
        for (session, robot, started_ns, is_settled, account, grade, received, skipped, first_ns, newest_ns, newest_received_ns,
             complete_ns, has_ended) in self._db.execute(_SESSIONS, (EARLIEST_SANE_NS,)):  # fmt: skip
            sink, topic = split(account)
            if has_ended and sink == OBJECTS and is_settled:
                complete_ns = newest_ns  # noqa: PLW2901 - no message was lost on its way into the spool
            late_ns = newest_received_ns - newest_ns if newest_received_ns else 0
            end_ns = min(complete_ns, silent.get((session, account), complete_ns), unsent.get(account, complete_ns))
            since_ns = max(first_ns, started_ns - late_ns, forgotten.get((session, account), 0), forgotten.get((0, account), 0))
            if since_ns <= end_ns:
                arrived_ns = min(end_ns + late_ns, newest_received_ns) or None
                found.append(Watermark(
                    robot, sink, topic, session, since_ns, end_ns, arrived_ns and since_ns + late_ns, arrived_ns, grade, received,
                    skipped,
                ))  # fmt: skip
        return found

    def _first_unsent(self) -> dict[str, int]:
        """Account -> the first stamp of its objects that are pending, held or kept; 0 if there are too many to look."""
        unsent: dict[str, int] = {}
        is_all = True
        for state, column, order in (('pending', 'bucket', 'waiting'), ('held', 'reason', 'held')):
            for value in self._values(state, column):
                rows = self._db.execute(
                    'SELECT ifnull(contents.topic, one.topic), min(t_start_ns), count(*) FROM (SELECT id, topic, t_start_ns'  # noqa: S608
                    f" FROM objects INDEXED BY {order} WHERE state = '{state}' AND {column} = ? ORDER BY id LIMIT {MAX_SCANNED})"
                    ' AS one LEFT JOIN contents USING (id) GROUP BY 1', (value,),
                ).fetchall()  # fmt: skip
                is_all &= sum(count for _, _, count in rows) < MAX_SCANNED
                for account, stamp, _ in rows:
                    unsent[account] = min(stamp, unsent.get(account, stamp))
        if not is_all:
            query = "SELECT topic FROM tally WHERE state IN ('pending', 'held') AND samples > 0"
            for (account,) in self._db.execute(query):
                unsent.setdefault(account, 0)
        for account, stamp in self._first_kept():
            unsent[account] = min(stamp, unsent.get(account, stamp))
        return unsent

    def _first_kept(self) -> Iterator[tuple[str, int]]:
        """Account -> about the first stamp of its kept objects; 0 if there are too many to look."""
        accounts = [account for (account,) in self._db.execute("SELECT topic FROM tally WHERE state = 'kept' AND samples > 0")]
        if not accounts:
            return
        oldest = dict(self._db.execute(
            'SELECT ifnull(contents.topic, one.topic), min(t_start_ns) FROM (SELECT id, topic, t_start_ns FROM objects'  # noqa: S608
            f" INDEXED BY kept WHERE state = 'kept' ORDER BY id LIMIT {MAX_SCANNED})"
            ' AS one LEFT JOIN contents USING (id) GROUP BY 1').fetchall())  # fmt: skip
        yield from ((account, oldest.get(account, 0)) for account in accounts)

    def _values(self, state: str, column: str) -> Iterator[str]:
        """The distinct values of a column of objects in a state, by one index lookup each."""
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
