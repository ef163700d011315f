"""Requests for kept objects: one table has the requests, the other the objects that each of them selected and their outcomes.

An object that an open request waits for is not evicted (``KeptTable.evictable``). Outcomes are written in the transaction that
changes the object (``RequestedTable.follow``). A slice that will be cut counts with the estimated bytes of the cut until the cut
replaces it. A request may be for very many objects, so one transaction changes at most ``PIECE`` rows.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

from shadowhound_data_logger.spool.schema import Table

ACTIVE, DONE, EXPIRED, CANCELLED, REFUSED = 'active', 'done', 'expired', 'cancelled', 'refused'
"""States of a request; all but the first are final."""
_COLUMNS: Final = (
    'id, requester, priority, made_ns, expires_ns, received_ns, selection, state, why, objects, bytes, unavailable, answers,'
    ' answered_state, answered_ns'
)
PIECE: Final = 512
"""Rows changed in one transaction: some 10 ms."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RequestRow:
    """A request in the index; times in Unix nanoseconds."""

    id: str
    requester: str
    priority: int
    made_ns: int
    expires_ns: int
    received_ns: int
    selection: str
    """JSON: what is requested (``mailbox.py``)."""
    state: str = ACTIVE
    why: str = ''
    """Why it was refused."""
    objects: int = 0
    """Selected objects."""
    bytes: int = 0
    unavailable: str = '{}'
    """JSON: matching objects that were lost before the request (``shipping/requests.py``)."""
    answers: int = 0
    """The number of the newest durable answer."""
    answered_state: str = ''
    """The state that the newest answer reports; empty before the first one."""
    answered_ns: int = 0
    """When the newest answer was written."""

    @property
    def is_open(self) -> bool:
        return self.state == ACTIVE


class KeptObject(NamedTuple):
    """An object that a request may select."""

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
    """When it was evicted or quarantined; 0 if it was not."""

    @property
    def is_here(self) -> bool:
        return self.state in {'kept', 'pending'}


class UnreleasedObject(NamedTuple):
    """A kept object that a request waits for and that no request has released."""

    id: int
    bytes: int
    is_cut: bool
    """Whether only a part of it is requested."""


class KeptSlice(NamedTuple):
    """A slice that a request needs only partly."""

    id: int
    key: str
    path: Path
    sha256: str
    metadata: Mapping[str, str]


class Progress(NamedTuple):
    """What became of the objects that a request selected."""

    outcomes: Mapping[str, tuple[int, int]]
    """``kept``, ``pending``, ``delivered``, ... -> objects, bytes."""
    lost: tuple[tuple[str, str, str, int], ...]
    """(key, state, reason, time in Unix nanoseconds) of the first lost objects."""
    manifests: tuple[str, ...]
    """Keys of the manifests of the first bags that were cut for the request."""


class RequestTable(Table):
    """The requests."""

    def rows(self) -> list[RequestRow]:
        """All requests, oldest first."""
        cursor = self._db.execute(f'SELECT {_COLUMNS} FROM requests ORDER BY received_ns, id')  # noqa: S608 - own constants only
        names = [name for name, *_ in cursor.description]
        return [RequestRow(**dict(zip(names, row, strict=True))) for row in cursor]

    def open_count(self) -> int:
        """How many requests are open."""
        return int(self._db.execute('SELECT count(*) FROM requests WHERE state = ?', (ACTIVE,)).fetchone()[0])

    def accept(self, row: RequestRow) -> RequestRow:
        """Write a request, whose selected objects were added before; replaces one with the same id. Returns it as written."""
        query = 'SELECT count(*), ifnull(sum(bytes), 0) FROM requested WHERE request = ?'
        objects, size = self._db.execute(query, (row.id,)).fetchone()
        row = replace(row, objects=objects, bytes=size)
        self._db.execute(
            f'INSERT OR REPLACE INTO requests ({_COLUMNS}) VALUES (?,?,?,?,?,?,?,?,?,?,?,?,?,?,?)',  # noqa: S608 - own constants only
            tuple(getattr(row, name) for name in _COLUMNS.split(', ')),
        )
        return row

    def close(self, request: str, state: str, why: str) -> None:
        """End an open request; ``RequestedTable.let_go`` must follow."""
        self._db.execute('UPDATE requests SET state = ?, why = ? WHERE id = ? AND state = ?', (state, why, request, ACTIVE))

    def take_answer(self, request: str, number: int, state: str, now_ns: int) -> bool:
        """Record an answer that reports this state; False, and nothing changes, if it is not the next one."""
        query = 'UPDATE requests SET answers = ?, answered_state = ?, answered_ns = ? WHERE id = ? AND answers = ?'
        return self._db.execute(query, (number, state, now_ns, request, number - 1)).rowcount > 0

    def answered(self, before_ns: int, limit: int | None = None) -> list[str]:
        """Closed requests whose last answer was written before then, oldest first."""
        query = (
            'SELECT id FROM requests WHERE state <> ? AND answered_state = state AND answered_ns < ? ORDER BY answered_ns LIMIT ?'
        )
        return [request for (request,) in self._db.execute(query, (ACTIVE, before_ns, -1 if limit is None else limit))]

    def forget(self, request: str) -> None:
        """Delete the row of a request whose objects were cleared."""
        self._db.execute('DELETE FROM requests WHERE id = ?', (request,))


class RequestedTable(Table):
    """The objects that each request selected, and their outcomes."""

    def follow(self, ids: Iterable[int]) -> None:
        """Record the new states of these objects as the outcomes for all requests that selected them."""
        self._db.executemany(
            'UPDATE requested SET (outcome, bytes) = (SELECT state, bytes FROM objects WHERE objects.id = requested.id)'
            ' WHERE id = ?',
            ((number,) for number in ids),
        )

    def selectable(self, robot: str) -> Iterator[KeptObject]:
        """A robot's objects that are kept, released but not delivered, or lost as far as the index remembers."""
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
        for (number, bucket, key, size, sensor, topic, start_ns, end_ns, metadata, state, reason,
             settled_ns) in self._db.execute(query, {'first': f'{robot}/', 'after': f'{robot}0'}):  # fmt: skip
            yield KeptObject(
                number, bucket, key, size, sensor, topic, start_ns, end_ns, json.loads(metadata), state, reason, settled_ns
            )

    def add(self, request: str, chosen: Sequence[tuple[int, int]]) -> None:
        """Add objects (id, bytes) that a request selected; skips those that have left the spool. Its row is written last."""
        self._db.executemany(
            "INSERT OR REPLACE INTO requested SELECT ?, id, CASE state WHEN 'kept' THEN min(bytes, ?) ELSE bytes END, state"
            " FROM objects WHERE id = ? AND state IN ('kept', 'pending')",
            ((request, size, number) for number, size in chosen),
        )

    def clear(self, request: str) -> bool:
        """Delete some of a request's objects; whether there may be more."""
        some = 'SELECT id FROM requested WHERE request = :request LIMIT :limit'
        query = f'DELETE FROM requested WHERE request = :request AND id IN ({some})'  # noqa: S608 - own constants only
        return self._db.execute(query, {'request': request, 'limit': PIECE}).rowcount == PIECE

    def clear_unfinished(self) -> bool:
        """Delete some of the objects of requests that were not accepted completely, or are closed; whether there may be more.

        They remain only if a process was killed.
        """
        some = (
            "SELECT request, id FROM requested WHERE outcome = 'kept'"
            " AND request NOT IN (SELECT id FROM requests WHERE state = 'active') LIMIT ?"
        )
        query = f'DELETE FROM requested WHERE (request, id) IN ({some})'  # noqa: S608 - own constants only
        return self._db.execute(query, (PIECE,)).rowcount == PIECE

    def let_go(self, request: str) -> bool:
        """Let some of the unreleased objects of a closed request be evicted again; whether there may be more."""
        some = "SELECT id FROM requested WHERE request = :request AND outcome = 'kept' LIMIT :limit"
        query = f"UPDATE requested SET outcome = 'unsent' WHERE request = :request AND id IN ({some})"  # noqa: S608 - own constants only
        return self._db.execute(query, {'request': request, 'limit': PIECE}).rowcount == PIECE

    def to_cut(self, request: str) -> list[tuple[int, str, str, str, Mapping[str, str]]]:
        """(id, bucket, key, SHA-256, metadata) of the kept slices that a request needs only partly, oldest first."""
        found = self._db.execute(
            'SELECT id, bucket, key, sha256, metadata FROM requested JOIN objects USING (id) WHERE request = ?'
            " AND outcome = 'kept' AND requested.bytes < objects.bytes ORDER BY id", (request,),
        )  # fmt: skip
        return [(number, bucket, key, sha256, json.loads(metadata)) for number, bucket, key, sha256, metadata in found]

    def set_complete(self, request: str, ids: Iterable[int]) -> None:
        """Send these slices complete instead of cutting them."""
        size = 'SELECT bytes FROM objects WHERE objects.id = requested.id'
        query = f'UPDATE requested SET bytes = ({size}) WHERE request = ? AND id = ?'  # noqa: S608 - own constants only
        self._db.executemany(query, ((request, number) for number in ids))
        self._recount(request)

    def set_cut(self, request: str, ids: Iterable[int], cuts: Iterable[tuple[int, int, str]]) -> None:
        """Replace these slices by the objects cut out of them: (id, bytes, state)."""
        self._db.executemany('DELETE FROM requested WHERE request = ? AND id = ?', ((request, number) for number in ids))
        self._db.executemany('INSERT OR REPLACE INTO requested VALUES (?, ?, ?, ?)', ((request, *each) for each in cuts))
        self._recount(request)

    def _recount(self, request: str) -> None:
        sums = 'SELECT count(*), ifnull(sum(bytes), 0) FROM requested WHERE request = :request'
        self._db.execute(f'UPDATE requests SET (objects, bytes) = ({sums}) WHERE id = :request', {'request': request})  # noqa: S608

    def unreleased(self, request: str, limit: int) -> list[UnreleasedObject]:
        """Kept objects that a request waits for and that no request has released, oldest first."""
        query = (
            'SELECT id, requested.bytes, requested.bytes < objects.bytes FROM requested JOIN objects USING (id)'
            " WHERE request = ? AND outcome = 'kept' ORDER BY id LIMIT ?"
        )
        rows = self._db.execute(query, (request, limit))
        return [UnreleasedObject(number, size, bool(is_cut)) for number, size, is_cut in rows]

    def is_settled(self, request: str) -> bool:
        """Whether a request waits for no object."""
        query = 'SELECT 1 FROM requested WHERE request = ? AND outcome = ? LIMIT 1'
        return not any(self._db.execute(query, (request, outcome)).fetchone() for outcome in ('kept', 'pending'))

    def released(self) -> tuple[int, int]:
        """Requested objects that wait for delivery: how many, and their bytes."""
        query = "SELECT count(*), ifnull(sum(bytes), 0) FROM (SELECT DISTINCT id, bytes FROM requested WHERE outcome = 'pending')"
        count, size = self._db.execute(query).fetchone()
        return count, size

    def unreleased_bytes(self) -> int:
        """Bytes of all objects that requests wait for and that no request has released."""
        each = "SELECT max(requested.bytes) AS size FROM requested WHERE outcome = 'kept' GROUP BY id"
        return int(self._db.execute(f'SELECT ifnull(sum(size), 0) FROM ({each})').fetchone()[0])  # noqa: S608 - own constants only

    def progress(self, request: str, limit: int = 100) -> Progress:
        """What became of a request's objects, with up to ``limit`` lost ones and manifests."""
        sums = self._db.execute(
            'SELECT outcome, count(*), sum(bytes) FROM requested WHERE request = ? GROUP BY outcome', (request,)
        )
        outcomes = {outcome: (count, size) for outcome, count, size in sums}
        lost = self._db.execute(
            "SELECT key, outcome, ifnull(reason, ''), ifnull(settled_ns, 0) FROM requested JOIN objects USING (id)"
            " WHERE request = ? AND outcome IN ('evicted', 'quarantined') ORDER BY id LIMIT ?", (request, limit),
        )  # fmt: skip
        cut = self._db.execute(
            "SELECT key FROM requested JOIN objects USING (id) WHERE request = ? AND key LIKE '%/manifest.json'"
            ' ORDER BY id LIMIT ?', (request, limit),
        )  # fmt: skip
        return Progress(outcomes, tuple(lost.fetchall()), tuple(key for (key,) in cut))
