"""The spool's index: one SQLite file that says what every object is and where it stands, and keeps the accounts.

Written by one connection under one lock, in transactions that are durable when they return (WAL, synchronous=FULL);
read by any number of others. Its transaction is the one commit point of the spool: an object exists once its row does.
Totals are kept by triggers, so that rows of delivered objects may be forgotten without a total changing.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from heapq import merge
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.clock import EARLIEST_SANE_NS
from shadowhound_data_logger.errors import SpoolError
from shadowhound_data_logger.model import DataObject, SpooledObject, State
from shadowhound_data_logger.spool import gaps
from shadowhound_data_logger.spool.account_rows import AccountSnapshot, OtherTypeRow, PublisherRow, RhythmRow, TopicRow
from shadowhound_data_logger.spool.schema import definitions, expected, prepare

FORGET_STEP: Final = 10_000
"""Rows that one commit forgets at most: some 50 ms."""
BUSY_TIMEOUT_S: Final = 10.0
MISSING: Final = 'missing'
"""Reason of a quarantined object whose file is gone."""
_OBJECT: Final = 'id, bucket, key, bytes, sha256, content_type, metadata, priority, created_ns, state, reason'


class Index:
    """New; open once; close once. Methods that write belong to the owner of the spool's lock."""

    def __init__(self, path: Path, *, read_only: bool = False) -> None:
        self._path = path
        self._read_only = read_only
        self._connection: sqlite3.Connection | None = None

    def open(self) -> None:
        """Raises sqlite3.DatabaseError for a damaged file, SpoolError for one of a newer version or no access."""
        mode = 'ro' if self._read_only else 'rwc'
        try:
            connection = sqlite3.connect(
                f'{self._path.absolute().as_uri()}?mode={mode}', uri=True, timeout=BUSY_TIMEOUT_S,
                isolation_level=None, check_same_thread=False,
            )  # fmt: skip
        except sqlite3.OperationalError as error:
            raise SpoolError(f'cannot open the spool index {self._path}: {error}',
                             remedy='is the path right, and may you read it?') from error  # fmt: skip
        try:
            prepare(connection, self._path, read_only=self._read_only)
        except BaseException:
            connection.close()
            raise
        self._connection = connection

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    @property
    def db(self) -> sqlite3.Connection:
        if self._connection is None:
            raise SpoolError('the spool index is not open')
        return self._connection

    def check(self) -> None:
        """Raises sqlite3.DatabaseError when the file is damaged: 3 us a row, 6 us after a stop that was none.

        The longer check compares tables with their indexes as well, without which damage shows in a commit only.
        """
        if not definitions(self.db) >= expected():
            raise sqlite3.DatabaseError('its tables are not those of this version')
        pragma = 'integrity_check' if self.sessions(ended=False) else 'quick_check'
        answer = self.db.execute(f'PRAGMA {pragma}(1)').fetchone()[0]
        if answer != 'ok':
            raise sqlite3.DatabaseError(str(answer))

    @contextmanager
    def transaction(self, undo: Callable[[], None] = lambda: None) -> Iterator[sqlite3.Connection]:
        """All or nothing, durable on leaving; ``undo`` runs before it is rolled back, with other writers still shut out."""
        self.db.execute('BEGIN IMMEDIATE')
        try:
            yield self.db
            self.db.execute('COMMIT')
        except BaseException:
            if self.db.in_transaction:  # SQLite itself ends it on some errors: a full disk, a failing one
                undo()
                self.db.execute('ROLLBACK')
            raise

    # -- objects ---------------------------------------------------------------------------------------------------

    def has(self, bucket: str, key: str) -> bool:
        return self.db.execute('SELECT 1 FROM objects WHERE bucket = ? AND key = ?', (bucket, key)).fetchone() is not None

    def insert(self, item: DataObject, key: str, sha256: str, state: State, reason: str | None,
               metadata: Mapping[str, str], now_ns: int) -> int:  # fmt: skip
        """Add a row under the final key; returns its id."""
        cursor = self.db.execute(
            'INSERT INTO objects (bucket, key, state, reason, priority, protected, sensor, topic, type, samples, bytes, sha256,'
            ' content_type, metadata, t_start_ns, t_end_ns, created_ns) VALUES (?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?)',
            (item.bucket, key, state.value, reason, item.priority, item.protected, item.sensor, item.topic, item.type,
             item.samples, len(item.body), sha256, item.content_type, json.dumps(dict(metadata)),
             item.t_start_ns, item.t_end_ns, now_ns),
        )  # fmt: skip
        number = int(cursor.lastrowid or 0)
        if item.counts:
            rows = ((number, account, count) for account, count in item.counts.items())
            self.db.executemany('INSERT INTO contents VALUES (?,?,?)', rows)
        return number

    def move(self, ids: Iterable[int], state: State, reason: str | None, now_ns: int) -> None:
        """Give objects another state; the totals follow.

        Only what is still in the spool moves, but for one case: an object that was evicted while it was on its way, and
        that the store confirmed all the same, is delivered.
        """
        movable = (State.PENDING, State.HELD, State.EVICTED if state is State.DELIVERED else State.HELD)
        self.db.executemany(
            'UPDATE objects SET state = ?, reason = ?, settled_ns = ? WHERE id = ? AND state IN (?, ?, ?)',
            ((state.value, reason, now_ns, number, *(each.value for each in movable)) for number in ids),
        )

    def pending(self, limit: int, *, oldest: bool, without: Sequence[str] = ()) -> list[sqlite3.Row]:
        """Objects to ship: most important first or oldest first, none of the buckets ``without``.

        Each bucket is asked by itself, so that what waits for those that are left out costs nothing.
        """
        order = ('id',) if oldest else ('priority', 'id')
        condition = f"state = 'pending' AND bucket = ? ORDER BY {', '.join(order)} LIMIT ?"
        found = [self.rows(condition, (bucket, limit)) for bucket in self._waited_for() if bucket not in without]
        return list(islice(merge(*found, key=itemgetter(*order)), limit))

    def _waited_for(self) -> Iterator[str]:
        """The buckets of all pending objects: one step in the index for each."""
        query = "SELECT bucket FROM objects WHERE state = 'pending' AND bucket > ? ORDER BY bucket LIMIT 1"
        bucket = ''
        while row := self.db.execute(query, (bucket,)).fetchone():
            bucket = row[0]
            yield bucket

    def held_count(self, reason: str) -> int:
        """How many objects have no final name yet for this reason."""
        query = "SELECT count(*) FROM objects WHERE state = 'held' AND reason = ?"
        return int(self.db.execute(query, (reason,)).fetchone()[0])

    def rows(self, where: str, values: Sequence[object] = ()) -> list[sqlite3.Row]:
        """Object rows by a condition of this package's own (never of a user's)."""
        cursor = self.db.execute(f'SELECT {_OBJECT} FROM objects WHERE {where}', tuple(values))  # noqa: S608 - own constants only
        cursor.row_factory = sqlite3.Row
        return cursor.fetchall()

    def protect(self, bucket: str, key: str) -> None:
        """Never evict this object from now on."""
        self.db.execute('UPDATE objects SET protected = 1 WHERE bucket = ? AND key = ?', (bucket, key))

    def evictable(self, limit: int) -> list[sqlite3.Row]:
        """What a full disk costs first: lowest priority, then oldest; never a protected object."""
        return self.rows("state IN ('pending', 'held') AND NOT protected ORDER BY priority DESC, id LIMIT ?", (limit,))

    def evictable_bytes(self) -> dict[int, int]:
        """What evicting everything that may be evicted would free, by priority."""
        where = "state IN ('pending', 'held') AND NOT protected"
        return dict(self.db.execute(f'SELECT priority, sum(bytes) FROM objects WHERE {where} GROUP BY priority'))  # noqa: S608

    def payload_bytes(self) -> int:
        """Bytes of all payload that lies in the spool: files that went missing take no room."""
        present = "SELECT ifnull(sum(bytes), 0) FROM tally WHERE state IN ('pending', 'held', 'quarantined')"
        missing = "SELECT ifnull(sum(bytes), 0) FROM objects WHERE state = 'quarantined' AND reason = 'missing'"
        return int(self.db.execute(f'SELECT ({present}) - ({missing})').fetchone()[0])

    def oldest_pending_ns(self) -> int | None:
        """When the object that has waited for delivery for the longest was spooled; None when none waits."""
        return next((row['created_ns'] for row in self.pending(1, oldest=True)), None)

    def set_missing(self, ids: Iterable[int], now_ns: int) -> int:
        """The files of these objects are gone, whoever took them; returns for how many that is new."""
        cursor = self.db.executemany(
            "UPDATE objects SET state = 'quarantined', reason = 'missing', settled_ns = ? WHERE id = ?"
            " AND state IN ('pending', 'held', 'quarantined')", ((now_ns, number) for number in ids),
        )  # fmt: skip
        return max(cursor.rowcount, 0)

    def set_found(self, number: int) -> None:
        """The file of a quarantined object is back where it waits for delivery."""
        self.db.execute(
            "UPDATE objects SET state = 'pending', reason = NULL, settled_ns = NULL WHERE id = ?"
            " AND state = 'quarantined'", (number,),
        )  # fmt: skip

    def forget(self, before_ns: int) -> bool:
        """Drop rows of objects that left the spool before then, totals stay; False when there may be more of them.

        What the catalogue has no row of yet stays as well.

        Rows of a time before the clock was set stay: the next boot may begin at that time again, and their keys are taken.
        """
        cursor = self.db.execute(
            "DELETE FROM objects WHERE id IN (SELECT id FROM objects WHERE state IN ('delivered', 'deduplicated', 'evicted')"
            ' AND settled_ns BETWEEN ? AND ? AND id NOT IN (SELECT id FROM uncatalogued) LIMIT ?)',
            (EARLIEST_SANE_NS, before_ns, FORGET_STEP),
        )  # fmt: skip
        return gaps.forget(self.db, before_ns, FORGET_STEP) and cursor.rowcount < FORGET_STEP

    # -- accounts --------------------------------------------------------------------------------------------------

    def begin_session(self, robot: str, boot_id: str, pid: int, now_ns: int) -> int:
        query = 'INSERT INTO sessions (robot, boot_id, pid, started_ns) VALUES (?,?,?,?)'
        cursor = self.db.execute(query, (robot, boot_id, pid, now_ns))
        return int(cursor.lastrowid or 0)

    def end_session(self, session: int, now_ns: int) -> None:
        self.db.execute('UPDATE sessions SET ended_ns = ? WHERE id = ?', (now_ns, session))

    def write(self, session: int, snapshot: AccountSnapshot) -> None:
        """Replace the session's accounts by a newer snapshot."""
        self.db.executemany(
            'INSERT OR REPLACE INTO accounts VALUES (?,?,?,?,?,?,?,?,?,?,?,?,?)',
            ((session, row.topic, row.type, row.accounting, row.received, row.skipped, row.stored,
              json.dumps(row.rejected), json.dumps(row.dropped), row.last_kept_ns, row.first_ns,
              row.heard_ns, row.complete_ns) for row in snapshot.topics),
        )  # fmt: skip
        self.db.executemany(
            'DELETE FROM publishers WHERE session = ? AND topic = ? AND publisher = ?', ((session, *row) for row in snapshot.gone)
        )
        self.db.executemany(
            'INSERT OR REPLACE INTO publishers VALUES (?,?,?,?,?,?,?,?,?)',
            ((session, row.topic, row.publisher, row.first, row.last, row.published, row.received, json.dumps(row.missed),
              row.heard_ns) for row in snapshot.publishers),
        )  # fmt: skip
        self.db.executemany(
            'INSERT OR REPLACE INTO estimates VALUES (?,?,?,?,?)',
            ((session, row.topic, row.estimated, row.unknown, json.dumps(row.missed))
             for row in snapshot.topics if row.estimated or row.unknown or row.missed),
        )  # fmt: skip
        self.db.executemany(
            'INSERT OR REPLACE INTO rhythms VALUES (?,?,?,?,?)',
            ((row.topic, row.publisher, row.of, row.period, row.last) for row in snapshot.rhythms),
        )
        self.db.executemany(
            'INSERT OR REPLACE INTO other_types VALUES (?,?,?,?,?)',
            ((session, row.topic, row.type, json.dumps(row.publishers), row.messages) for row in snapshot.other_types),
        )  # fmt: skip
        gaps.write(self.db, session, snapshot.gaps, snapshot.taken_back)

    def sessions(self, *, ended: bool) -> list[int]:
        condition = 'NOT NULL' if ended else 'NULL'
        return [row[0] for row in self.db.execute(f'SELECT id FROM sessions WHERE ended_ns IS {condition} ORDER BY id')]  # noqa: S608

    def topics(self, session: int | None = None) -> list[TopicRow]:
        """Accounts of one session, or of all in the order of the sessions."""
        where, values = ('WHERE session = ?', (session,)) if session is not None else ('', ())
        columns = ('topic, type, accounting, received, skipped, stored, last_kept_ns, rejected, dropped, ifnull(estimated, 0),'
                   " ifnull(unknown, 0), ifnull(missed, '{}'), first_ns, heard_ns, complete_ns")  # fmt: skip
        query = f'SELECT {columns} FROM accounts LEFT JOIN estimates USING (session, topic) {where} ORDER BY session'  # noqa: S608
        return [
            TopicRow(topic, kind, accounting, received, skipped, stored, json.loads(rejected), json.loads(dropped), last_ns,
                     estimated, unknown, json.loads(missed), first_ns, heard_ns, complete_ns)
            for topic, kind, accounting, received, skipped, stored, last_ns, rejected, dropped, estimated, unknown, missed,
            first_ns, heard_ns, complete_ns in self.db.execute(query, values)
        ]  # fmt: skip

    def publishers(self) -> list[PublisherRow]:
        """All spans in the order of the sessions: the last row of a publisher says where its numbers stand."""
        columns = 'topic, publisher, first, last, published, received, missed, heard_ns'
        rows = self.db.execute(f'SELECT {columns} FROM publishers ORDER BY session')  # noqa: S608
        return [
            PublisherRow(topic, publisher, first, last, published, received, json.loads(missed), heard_ns)
            for topic, publisher, first, last, published, received, missed, heard_ns in rows
        ]

    def other_types(self) -> list[OtherTypeRow]:
        """Of all sessions, in their order."""
        if self._read_only and not self._has('other_types'):
            return []
        rows = self.db.execute('SELECT topic, type, publishers, messages FROM other_types ORDER BY session')
        return [OtherTypeRow(topic, kind, tuple(json.loads(nodes)), count) for topic, kind, nodes, count in rows]

    def gap_sums(self) -> dict[tuple[str, str, str, str], int] | None:
        """What the gap journal adds up to (``gaps.sums``); None for an older index, which has none."""
        return None if self._read_only and not self._has('gaps') else gaps.sums(self.db)

    def _has(self, table: str) -> bool:
        """An older index is read as it is: only the node brings it up to date."""
        return self.db.execute('SELECT 1 FROM sqlite_master WHERE name = ?', (table,)).fetchone() is not None

    def rhythms(self) -> list[RhythmRow]:
        """What is known of topics without numbers, one row each."""
        return [RhythmRow(*row) for row in self.db.execute('SELECT topic, publisher, of, period, last FROM rhythms')]

    def tally(self) -> list[tuple[str, str, int, int, int]]:
        """(topic or '', state or 'spooled', objects, bytes, samples)."""
        return self.db.execute('SELECT topic, state, objects, bytes, samples FROM tally').fetchall()


def spooled(row: sqlite3.Row | Mapping[str, Any], path: Path) -> SpooledObject:
    """The object of a row."""
    return SpooledObject(
        id=row['id'], bucket=row['bucket'], key=row['key'], path=path, size=row['bytes'], sha256=row['sha256'],
        content_type=row['content_type'], metadata=json.loads(row['metadata']), priority=row['priority'],
        created_ns=row['created_ns'],
    )  # fmt: skip
