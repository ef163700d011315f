"""The rows of what was asked for: each request with what it found among the kept objects, and what became of that.

An object that an open request waits for is not evicted (``KeptTable.evictable``). What became of each is written in the
transaction that changes the object (``follow``). Of a slice that is cut a request counts fewer bytes than it has: an estimate,
until the cut takes its place. Requests may be of very many objects, so nothing here changes more than ``PIECE`` rows at a time.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

from shadowhound_data_logger.spool.table import Table

ACTIVE, DONE, EXPIRED, CANCELLED, REFUSED = 'active', 'done', 'expired', 'cancelled', 'refused'
"""States of a request; all but the first are final."""
_COLUMNS: Final = (
    'id, requester, priority, made_ns, expires_ns, received_ns, wanted, state, why, objects, bytes, gone, answers, told, told_ns'
)
_HERE: Final = "('kept', 'pending')"
PIECE: Final = 512
"""Rows that are changed in one transaction: some 10 ms."""
_OPEN: Final = "SELECT id FROM requests WHERE state = 'active'"


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
    """JSON: what it would have found, had that not left before (``shipping/requests.py``)."""
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


class WaitingObject(NamedTuple):
    """What a request waits for and nobody has released."""

    id: int
    bytes: int
    is_cut: bool
    """Only a part of it is wanted."""


class KeptSlice(NamedTuple):
    """A slice of which a request wants a part; times in Unix nanoseconds."""

    id: int
    key: str
    path: Path
    sha256: str
    metadata: Mapping[str, str]


class Progress(NamedTuple):
    """What became of what a request found."""

    outcomes: Mapping[str, tuple[int, int]]
    """``kept``, ``pending``, ``delivered``, ... -> objects, bytes."""
    lost: tuple[tuple[str, str, str, int], ...]
    """(key, state, reason, when in Unix nanoseconds) of the first of those that are lost."""
    manifests: tuple[str, ...]
    """Keys of the manifests of the first bags that were cut for it."""


class RequestTable(Table):
    """The requests, and the objects that each of them found."""

    def follow(self, ids: Iterable[int]) -> None:
        """These objects have a new state: what became of them is the outcome for each request that found them."""
        self._db.executemany(
            'UPDATE requested SET (outcome, bytes) = (SELECT state, bytes FROM objects WHERE objects.id = requested.id)'
            ' WHERE id = ?',
            ((number,) for number in ids),
        )

    def rows(self) -> list[RequestRow]:
        """The oldest first."""
        cursor = self._db.execute(f'SELECT {_COLUMNS} FROM requests ORDER BY received_ns, id')  # noqa: S608 - own constants only
        names = [name for name, *_ in cursor.description]
        return [RequestRow(**dict(zip(names, row, strict=True))) for row in cursor]

    def open_ids(self) -> list[str]:
        """Of those that are not over."""
        return [name for (name,) in self._db.execute('SELECT id FROM requests WHERE state = ?', (ACTIVE,))]

    def add(self, request: str, chosen: Sequence[tuple[int, int]]) -> None:
        """Some (id, bytes) of what a request chose, as far as they are here still; its row comes after all of them."""
        self._db.executemany(
            "INSERT OR REPLACE INTO requested SELECT ?, id, CASE state WHEN 'kept' THEN min(bytes, ?) ELSE bytes END, state"  # noqa: S608 - own constants only
            f' FROM objects WHERE id = ? AND state IN {_HERE}',
            ((request, size, number) for number, size in chosen),
        )

    def accept(self, row: RequestRow) -> RequestRow:
        """Write the request, which has what was added to it; one of the same id is replaced."""
        row = self._counted(row)
        self._db.execute(
            f'INSERT OR REPLACE INTO requests ({_COLUMNS}) VALUES (?,?,?,?,?,?,?,?,?,?,?,?,?,?,?)',  # noqa: S608 - own constants only
            tuple(getattr(row, name) for name in _COLUMNS.split(', ')),
        )
        return row

    def _counted(self, row: RequestRow) -> RequestRow:
        count = 'SELECT count(*), ifnull(sum(bytes), 0) FROM requested WHERE request = ?'
        objects, size = self._db.execute(count, (row.id,)).fetchone()
        return replace(row, objects=objects, bytes=size)

    def known(self, robot: str) -> Iterator[KeptObject]:
        """What is kept of a robot, what was asked for and is on its way, and what left for good within the last hour."""
        columns = (
            'id, bucket, key, bytes, sensor, topic, t_start_ns, t_end_ns, metadata, state, ifnull(reason, state),'
            ' ifnull(settled_ns, 0)'
        )
        of_robot = 'key >= :first AND key < :after'
        query = (
            f"SELECT {columns} FROM objects WHERE state = 'kept' AND {of_robot} UNION SELECT {columns} FROM objects"  # noqa: S608
            f" WHERE state = 'pending' AND id IN (SELECT id FROM requested WHERE outcome = 'pending') AND {of_robot}"
            f" UNION SELECT {columns} FROM objects WHERE state IN ('evicted', 'quarantined') AND on_request"
            f' AND {of_robot} ORDER BY id'
        )
        for (number, bucket, key, size, sensor, topic, start_ns, end_ns, said, state, reason,
             settled_ns) in self._db.execute(query, {'first': f'{robot}/', 'after': f'{robot}0'}):  # fmt: skip
            metadata = json.loads(said)
            yield KeptObject(
                number, bucket, key, size, sensor, topic, start_ns, end_ns, metadata, state, reason, settled_ns
            )  # fmt: skip

    def close(self, request: str, state: str, why: str) -> None:
        """End it; ``let_go`` follows."""
        self._db.execute('UPDATE requests SET state = ?, why = ? WHERE id = ? AND state = ?', (state, why, request, ACTIVE))

    def let_go(self, request: str) -> bool:
        """Of a request that is over: some of what it has not released is nobody's any more; whether there may be more."""
        some = "SELECT id FROM requested WHERE request = :request AND outcome = 'kept' LIMIT :most"
        query = f"UPDATE requested SET outcome = 'unsent' WHERE request = :request AND id IN ({some})"  # noqa: S608 - own constants only
        return self._db.execute(query, {'request': request, 'most': PIECE}).rowcount == PIECE

    def clear(self, request: str) -> bool:
        """Drop some of what a request chose when it was made before; whether there may be more."""
        some = 'SELECT id FROM requested WHERE request = :request LIMIT :most'
        query = f'DELETE FROM requested WHERE request = :request AND id IN ({some})'  # noqa: S608 - own constants only
        return self._db.execute(query, {'request': request, 'most': PIECE}).rowcount == PIECE

    def clear_unfinished(self) -> bool:
        """Drop some of what was added to a request that has no row, or was added again to one that is over; as ``clear``.

        Only the death of a process leaves such.
        """
        some = f"SELECT request, id FROM requested WHERE outcome = 'kept' AND request NOT IN ({_OPEN}) LIMIT ?"  # noqa: S608 - own constants only
        query = f'DELETE FROM requested WHERE (request, id) IN ({some})'  # noqa: S608 - own constants only
        return self._db.execute(query, (PIECE,)).rowcount == PIECE

    def to_cut(self, request: str) -> list[tuple[int, str, str, str, Mapping[str, str]]]:
        """(id, bucket, key, SHA-256, metadata) of the kept slices of which it wants a part, the oldest first."""
        found = self._db.execute(
            'SELECT id, bucket, key, sha256, metadata FROM requested JOIN objects USING (id) WHERE request = ?'
            " AND outcome = 'kept' AND requested.bytes < objects.bytes ORDER BY id", (request,),
        )  # fmt: skip
        return [(number, bucket, key, sha256, json.loads(metadata)) for number, bucket, key, sha256, metadata in found]

    def set_complete(self, request: str, ids: Iterable[int]) -> None:
        """These are sent whole."""
        size = 'SELECT bytes FROM objects WHERE objects.id = requested.id'
        query = f'UPDATE requested SET bytes = ({size}) WHERE request = ? AND id = ?'  # noqa: S608 - own constants only
        self._db.executemany(query, ((request, number) for number in ids))
        self._recount(request)

    def set_cut(self, request: str, ids: Iterable[int], made: Iterable[tuple[int, int, str]]) -> None:
        """In place of these slices it waits for what was cut out of them: (id, bytes, state)."""
        self._db.executemany('DELETE FROM requested WHERE request = ? AND id = ?', ((request, number) for number in ids))
        self._db.executemany('INSERT OR REPLACE INTO requested VALUES (?, ?, ?, ?)', ((request, *each) for each in made))
        self._recount(request)

    def _recount(self, request: str) -> None:
        sums = 'SELECT count(*), ifnull(sum(bytes), 0) FROM requested WHERE request = :request'
        self._db.execute(f'UPDATE requests SET (objects, bytes) = ({sums}) WHERE id = :request', {'request': request})  # noqa: S608

    def take_answer(self, request: str, number: int, told: str, now_ns: int) -> bool:
        """Whether this answer is the next one; it is given then, and tells this state."""
        query = 'UPDATE requests SET answers = ?, told = ?, told_ns = ? WHERE id = ? AND answers = ?'
        return self._db.execute(query, (number, told, now_ns, request, number - 1)).rowcount > 0

    def waiting(self, request: str, limit: int) -> list[WaitingObject]:
        """What it waits for and nobody has released, the oldest first."""
        query = (
            'SELECT id, requested.bytes, requested.bytes < objects.bytes FROM requested JOIN objects USING (id)'
            " WHERE request = ? AND outcome = 'kept' ORDER BY id LIMIT ?"
        )
        return [WaitingObject(number, size, bool(is_cut)) for number, size, is_cut in self._db.execute(query, (request, limit))]

    def is_over(self, request: str) -> bool:
        """Whether nothing of it is waited for."""
        query = 'SELECT 1 FROM requested WHERE request = ? AND outcome = ? LIMIT 1'
        return not any(self._db.execute(query, (request, outcome)).fetchone() for outcome in ('kept', 'pending'))

    def released(self) -> tuple[int, int]:
        """Requested objects that wait for delivery, and their bytes."""
        query = "SELECT count(*), ifnull(sum(bytes), 0) FROM (SELECT DISTINCT id, bytes FROM requested WHERE outcome = 'pending')"
        count, size = self._db.execute(query).fetchone()
        return count, size

    def awaited(self) -> tuple[int, int]:
        """Open requests, and the bytes that they wait for and nobody has released."""
        (count,) = self._db.execute("SELECT count(*) FROM requests WHERE state = 'active'").fetchone()
        each = "SELECT max(requested.bytes) AS most FROM requested WHERE outcome = 'kept' GROUP BY id"
        (size,) = self._db.execute(f'SELECT ifnull(sum(most), 0) FROM ({each})').fetchone()  # noqa: S608 - own constants only
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
        cut = self._db.execute(
            "SELECT key FROM requested JOIN objects USING (id) WHERE request = ? AND key LIKE '%/manifest.json'"
            ' ORDER BY id LIMIT ?', (request, most_lost),
        )  # fmt: skip
        return Progress(outcomes, tuple(lost.fetchall()), tuple(key for (key,) in cut))

    def answered(self, before_ns: int, most: int | None = None) -> list[str]:
        """Those that are over, and of which the last answer was given before then; the first ones, as many as are asked for."""
        query = 'SELECT id FROM requests WHERE state <> ? AND told = state AND told_ns < ? ORDER BY told_ns LIMIT ?'
        return [request for (request,) in self._db.execute(query, (ACTIVE, before_ns, -1 if most is None else most))]

    def forget(self, request: str) -> None:
        """Drop the row of a request that was cleared."""
        self._db.execute('DELETE FROM requests WHERE id = ?', (request,))
