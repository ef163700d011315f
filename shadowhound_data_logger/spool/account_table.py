"""Sessions, and what each of them counted by topic and publisher."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Mapping
from typing import Any

from shadowhound_data_logger.core.dataclass_json import fields_of
from shadowhound_data_logger.core.stamps import StampReport, Times
from shadowhound_data_logger.spool.account_rows import AccountSnapshot, OtherTypeRow, PublisherRow, RhythmRow, TopicRow
from shadowhound_data_logger.spool.gap_table import GapTable
from shadowhound_data_logger.spool.schema import Table


class AccountTable(Table):
    """The accounts of all sessions; the gap journal is written with them."""

    def __init__(self, connection: Callable[[], sqlite3.Connection], gaps: GapTable) -> None:
        super().__init__(connection)
        self._gaps = gaps

    def begin_session(self, robot: str, boot_id: str, pid: int, now_ns: int) -> int:
        query = 'INSERT INTO sessions (robot, boot_id, pid, started_ns) VALUES (?,?,?,?)'
        cursor = self._db.execute(query, (robot, boot_id, pid, now_ns))
        self._db.execute('INSERT OR IGNORE INTO gaps_reported VALUES (?, 0, 0)', (robot,))
        return int(cursor.lastrowid or 0)

    def begin_after(self, session: int, number: int) -> None:
        """Make the numbers of the next session and the next object larger than these."""
        for table, last in (('sessions', session), ('objects', number)):
            self._db.execute('INSERT INTO sqlite_sequence SELECT ?, 0 WHERE NOT EXISTS'
                             ' (SELECT 1 FROM sqlite_sequence WHERE name = ?)', (table, table))  # fmt: skip
            self._db.execute('UPDATE sqlite_sequence SET seq = max(seq, ?) WHERE name = ?', (last, table))

    def end_session(self, session: int, now_ns: int) -> None:
        self._db.execute('UPDATE sessions SET ended_ns = ? WHERE id = ?', (now_ns, session))

    def first_session(self) -> tuple[int, str] | None:
        """(started_ns, boot_id), which identifies an index."""
        found = self._db.execute('SELECT started_ns, boot_id FROM sessions ORDER BY id LIMIT 1').fetchone()
        return found and tuple(found)

    def last_session(self, robot: str, pid: int) -> tuple[int, int | None] | None:
        """(started_ns, ended_ns) of a robot's last session, preferably of the process ``pid``."""
        query = 'SELECT started_ns, ended_ns FROM sessions WHERE robot = ? ORDER BY pid = ? DESC, id DESC LIMIT 1'
        found = self._db.execute(query, (robot, pid)).fetchone()
        return found and tuple(found)

    def sessions_with_open(self, robot: str, sink: str) -> list[int]:
        """A robot's ended sessions with open messages of a sink."""
        columns = 'SELECT session, received - skipped - stored, rejected, dropped FROM accounts JOIN sessions ON id = session'
        rows = self._db.execute(f'{columns} WHERE robot = ? AND ended_ns IS NOT NULL AND topic GLOB ?', (robot, f'{sink}*'))
        return sorted({
            number for number, rest, *lost in rows if rest > sum(sum(json.loads(each).values()) for each in lost)
        })  # fmt: skip

    def take_over(self, session: int, topic: str, received: int, estimated: int, unknown: int) -> None:
        """Subtract messages from an ended session, because another session accounts for them now."""
        query = 'UPDATE accounts SET received = received - ? WHERE session = ? AND topic = ?'
        self._db.execute(query, (received, session, topic))
        query = 'UPDATE estimates SET estimated = estimated - ?, unknown = unknown - ? WHERE session = ? AND topic = ?'
        self._db.execute(query, (estimated, unknown, session, topic))

    def write(self, session: int, snapshot: AccountSnapshot) -> None:
        """Replace the session's accounts by a newer snapshot."""
        self._db.executemany(
            'INSERT OR REPLACE INTO accounts VALUES (?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?)',
            ((session, row.topic, row.type, row.accounting, row.received, row.skipped, row.stored,
              _json(row.rejected), _json(row.dropped), _json(row.by_arrival), _json(row.corrected),
              _json(fields_of(row.stamps)), *row.last_stored,
              row.first_ns, *row.newest, row.complete_ns) for row in snapshot.topics),
        )  # fmt: skip
        query = 'DELETE FROM publishers WHERE session = ? AND topic = ? AND publisher = ?'
        self._db.executemany(query, ((session, *row) for row in snapshot.removed))
        self._db.executemany(
            'INSERT OR REPLACE INTO publishers VALUES (?,?,?,?,?,?,?,?,?,?)',
            ((session, row.topic, row.publisher, row.first, row.last, row.published, row.received, _json(row.missed),
              *row.last_times) for row in snapshot.publishers),
        )  # fmt: skip
        self._db.executemany(
            'INSERT OR REPLACE INTO estimates VALUES (?,?,?,?,?)',
            ((session, row.topic, row.estimated, row.unknown, _json(row.missed))
             for row in snapshot.topics if row.estimated or row.unknown or row.missed),
        )  # fmt: skip
        self._db.executemany(
            'INSERT OR REPLACE INTO rhythms VALUES (?,?,?,?,?)',
            ((row.topic, row.publisher, row.source, row.period, row.last) for row in snapshot.rhythms),
        )
        self._db.executemany(
            'INSERT OR REPLACE INTO other_types VALUES (?,?,?,?,?)',
            ((session, row.topic, row.type, json.dumps(row.publishers), row.messages) for row in snapshot.other_types),
        )  # fmt: skip
        self._gaps.write(session, snapshot.gaps, snapshot.taken_back)

    def sessions(self, *, ended: bool) -> list[int]:
        condition = 'NOT NULL' if ended else 'NULL'
        return [row[0] for row in self._db.execute(f'SELECT id FROM sessions WHERE ended_ns IS {condition} ORDER BY id')]  # noqa: S608

    def topics(self, session: int | None = None, *, robot: str | None = None) -> list[TopicRow]:
        """The accounts of one session, those that a robot's next session continues, or all; in the order of the sessions."""
        where, values = ('WHERE session = ?', (session,)) if session is not None else _continued_by(robot)
        columns = ('topic, type, accounting, received, skipped, stored, last_stored_ns, last_stored_received_ns, rejected,'
                   ' dropped, ifnull(estimated, 0),'
                   " ifnull(unknown, 0), ifnull(missed, '{}'), first_ns, newest_ns, newest_received_ns, complete_ns, by_arrival,"
                   ' corrected, stamps')  # fmt: skip
        query = f'SELECT {columns} FROM accounts LEFT JOIN estimates USING (session, topic) {where} ORDER BY session'  # noqa: S608
        return [
            TopicRow(topic, kind, accounting, received, skipped, stored, json.loads(rejected), json.loads(dropped), Times(*kept),
                     estimated, unknown, json.loads(missed), first_ns, Times(newest_ns, newest_received_ns), complete_ns,
                     json.loads(by_arrival), json.loads(corrected), _stamps(stamps))
            for topic, kind, accounting, received, skipped, stored, *kept, rejected, dropped, estimated, unknown, missed,
            first_ns, newest_ns, newest_received_ns, complete_ns, by_arrival, corrected, stamps
            in self._db.execute(query, values)
        ]  # fmt: skip

    def publishers(self, *, robot: str | None = None) -> list[PublisherRow]:
        """All publishers' rows, or those that a robot's next session continues; in the order of the sessions.

        The last row of a publisher has its newest sequence number.
        """
        where, values = _continued_by(robot)
        columns = 'topic, publisher, first, last, published, received, missed, last_ns, last_received_ns'
        rows = self._db.execute(f'SELECT {columns} FROM publishers {where} ORDER BY session', values)  # noqa: S608
        return [
            PublisherRow(topic, publisher, first, last, published, received, json.loads(missed), Times(*times))
            for topic, publisher, first, last, published, received, missed, *times in rows
        ]

    def other_types(self) -> list[OtherTypeRow]:
        """The rows of all sessions, in the order of the sessions."""
        rows = self._db.execute('SELECT topic, type, publishers, messages FROM other_types ORDER BY session')
        return [OtherTypeRow(topic, kind, tuple(json.loads(nodes)), count) for topic, kind, nodes, count in rows]

    def rhythms(self) -> list[RhythmRow]:
        """The rhythms of topics without sequence numbers, one row per topic."""
        return [RhythmRow(*row) for row in self._db.execute('SELECT topic, publisher, source, period, last FROM rhythms')]


def _continued_by(robot: str | None) -> tuple[str, tuple[str | int, ...]]:
    """The condition for accounts that a robot's new session continues: those of all topics, and its own of bags and events.

    ``bag record`` counts as a separate robot: it takes the same numbers as a node that runs, and loses other messages.
    """
    if robot is None:
        return '', ()
    return "WHERE topic GLOB '/*' OR session IN (SELECT id FROM sessions WHERE robot = ?)", (robot,)


def _stamps(text: str) -> StampReport | None:
    """None for a report with other fields: it is informative, so it must not make an account unreadable."""
    found = json.loads(text)
    return StampReport(**found) if found.keys() == StampReport.__dataclass_fields__.keys() else None


def _json(by_reason: Mapping[str, Any]) -> str:
    """The JSON of counts by reason; nearly all are empty."""
    return json.dumps(by_reason) if by_reason else '{}'
