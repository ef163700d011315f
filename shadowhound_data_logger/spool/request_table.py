"""The rows of what was asked for: each request with what it found among the kept objects, and what became of that.

An object that an open request waits for is not evicted (``Index.may_go``). What became of each is written by a trigger, in the
transaction that changes the object (schema.py).
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from shadowhound_data_logger import metadata_words as words

ACTIVE, DONE, EXPIRED, CANCELLED, REFUSED = 'active', 'done', 'expired', 'cancelled', 'refused'
"""States of a request; all but the first are final."""
_COLUMNS: Final = (
    'id, requester, priority, made_ns, expires_ns, received_ns, wanted, state, why, objects, bytes, gone, answers, told, told_ns'
)
_HERE: Final = "('kept', 'pending')"


@dataclass(frozen=True, slots=True, kw_only=True)
class RequestRow:
    """A request as the index knows it; times in Unix nanoseconds."""

    id: str
    requester: str
    priority: int
    made_ns: int
    expires_ns: int
    received_ns: int
    wanted: str
    """JSON: what is asked for (``mailbox.py``)."""
    state: str = ACTIVE
    why: str = ''
    """Of a request that was refused."""
    objects: int = 0
    """That it found."""
    bytes: int = 0
    gone: str = '{}'
    """JSON: what it would have found, had that not left before (``ship/requests.py``)."""
    answers: int = 0
    """The number of the newest answer that is durable."""
    told: str = ''
    """The state that it told; empty before the first one."""
    told_ns: int = 0
    """When that was."""

    @property
    def is_open(self) -> bool:
        return self.state == ACTIVE


class KeptObject(NamedTuple):
    """What a request may choose from."""

    id: int
    bucket: str
    key: str
    bytes: int
    sensor: str
    topic: str | None
    t_start_ns: int
    t_end_ns: int
    metadata: Mapping[str, str]
    state: str
    reason: str
    settled_ns: int
    """When it was evicted, say; 0 of what is here."""

    @property
    def is_here(self) -> bool:
        return self.state in {'kept', 'pending'}


class Progress(NamedTuple):
    """What became of what a request found."""

    outcomes: Mapping[str, tuple[int, int]]
    """``kept``, ``pending``, ``delivered``, ... -> objects, bytes."""
    lost: tuple[tuple[str, str, str, int], ...]
    """(key, state, reason, when in Unix nanoseconds) of the first of those that are lost."""

    @property
    def is_over(self) -> bool:
        """Whether nothing of it is waited for."""
        return not any(self.outcomes.get(state, (0, 0))[0] for state in ('kept', 'pending'))


class RequestTable:
    """The requests in the index; the connection is the index's."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db

    def rows(self) -> list[RequestRow]:
        """The oldest first."""
        cursor = self._db.execute(f'SELECT {_COLUMNS} FROM requests ORDER BY received_ns, id')  # noqa: S608 - own constants only
        names = [name for name, *_ in cursor.description]
        return [RequestRow(**dict(zip(names, row, strict=True))) for row in cursor]

    def open_ids(self) -> list[str]:
        """Of those that are not over."""
        return [name for (name,) in self._db.execute('SELECT id FROM requests WHERE state = ?', (ACTIVE,))]

    def accept(self, row: RequestRow, chosen: Iterable[int]) -> RequestRow:
        """Write the request with what it chose, as far as that is here still; one of the same id is replaced."""
        self._db.execute('DELETE FROM requested WHERE request = ?', (row.id,))
        self._db.executemany(
            f'INSERT OR IGNORE INTO requested SELECT ?, id, bytes, state FROM objects WHERE id = ? AND state IN {_HERE}',  # noqa: S608
            ((row.id, number) for number in chosen),
        )
        count = 'SELECT count(*), ifnull(sum(bytes), 0) FROM requested WHERE request = ?'
        objects, size = self._db.execute(count, (row.id,)).fetchone()
        row = replace(row, objects=objects, bytes=size)
        self._db.execute(
            f'INSERT OR REPLACE INTO requests ({_COLUMNS}) VALUES (?,?,?,?,?,?,?,?,?,?,?,?,?,?,?)',  # noqa: S608 - own constants only
            tuple(getattr(row, name) for name in _COLUMNS.split(', ')),
        )
        return row

    def known(self, robot: str) -> Iterator[KeptObject]:
        """What is kept of a robot, what was asked for and is on its way, and what left for good within the last hour."""
        columns = (
            'id, bucket, key, bytes, sensor, topic, t_start_ns, t_end_ns, metadata, state, ifnull(reason, state),'
            ' ifnull(settled_ns, 0)'
        )
        is_on_request = f"CASE WHEN json_valid(metadata) THEN json_extract(metadata, '$.{words.SHIP}') = '{words.ON_REQUEST}' END"
        query = (
            f"SELECT {columns} FROM objects WHERE state = 'kept' AND key >= ?1 AND key < ?2 UNION SELECT {columns} FROM objects"  # noqa: S608
            " WHERE state = 'pending' AND id IN (SELECT id FROM requested WHERE outcome = 'pending') AND key >= ?1 AND key < ?2"
            f" UNION SELECT {columns} FROM objects WHERE state IN ('evicted', 'quarantined') AND {is_on_request}"
            ' AND key >= ?1 AND key < ?2 ORDER BY id'
        )
        for (number, bucket, key, size, sensor, topic, start_ns, end_ns, said, state, reason,
             settled_ns) in self._db.execute(query, (f'{robot}/', f'{robot}0')):  # fmt: skip
            metadata = json.loads(said)
            yield KeptObject(
                number, bucket, key, size, sensor, topic, start_ns, end_ns, metadata, state, reason, settled_ns
            )  # fmt: skip

    def close(self, request: str, state: str, why: str) -> None:
        """What it has not released is nobody's any more, as far as this request goes."""
        self._db.execute('UPDATE requests SET state = ?, why = ? WHERE id = ? AND state = ?', (state, why, request, ACTIVE))
        self._db.execute("UPDATE requested SET outcome = 'unsent' WHERE request = ? AND outcome = 'kept'", (request,))

    def take_answer(self, request: str, number: int, told: str, now_ns: int) -> bool:
        """Whether this answer is the next one; it is given then, and tells this state."""
        query = 'UPDATE requests SET answers = ?, told = ?, told_ns = ? WHERE id = ? AND answers = ?'
        return self._db.execute(query, (number, told, now_ns, request, number - 1)).rowcount > 0

    def waiting(self, request: str, limit: int) -> list[tuple[int, int]]:
        """(id, bytes) of what it waits for and nobody has released."""
        query = "SELECT id, bytes FROM requested WHERE request = ? AND outcome = 'kept' ORDER BY id LIMIT ?"
        return self._db.execute(query, (request, limit)).fetchall()

    def released(self) -> tuple[int, int]:
        """Requested objects that wait for delivery, and their bytes."""
        query = "SELECT count(*), ifnull(sum(bytes), 0) FROM (SELECT DISTINCT id, bytes FROM requested WHERE outcome = 'pending')"
        count, size = self._db.execute(query).fetchone()
        return count, size

    def progress(self, request: str, most_lost: int = 100) -> Progress:
        """What became of what it found."""
        sums = self._db.execute(
            'SELECT outcome, count(*), sum(bytes) FROM requested WHERE request = ? GROUP BY outcome', (request,)
        )
        outcomes = {outcome: (count, size) for outcome, count, size in sums}
        lost = self._db.execute(
            "SELECT key, outcome, ifnull(reason, ''), ifnull(settled_ns, 0) FROM requested JOIN objects USING (id)"
            " WHERE request = ? AND outcome IN ('evicted', 'quarantined') ORDER BY id LIMIT ?", (request, most_lost),
        )  # fmt: skip
        return Progress(outcomes, tuple(lost.fetchall()))

    def forget(self, before_ns: int) -> None:
        """Those that are over, and of which the last answer was given before then."""
        old = 'SELECT id FROM requests WHERE state <> ? AND told = state AND told_ns < ?'
        self._db.execute(f'DELETE FROM requested WHERE request IN ({old})', (ACTIVE, before_ns))  # noqa: S608 - own constants only
        self._db.execute(f'DELETE FROM requests WHERE id IN ({old})', (ACTIVE, before_ns))  # noqa: S608 - own constants only
