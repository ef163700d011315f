"""Objects: ``ObjectTable`` reads their rows, ``ObjectStates`` writes them and changes their states."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from heapq import merge
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.keys import unique
from shadowhound_data_logger.core.model import (
    EVENTS_WHEN,
    UPLOAD_WHEN,
    Binding,
    DataObject,
    HeldObject,
    SpooledObject,
    State,
    waits_for,
)
from shadowhound_data_logger.spool.catalog_table import CatalogTable
from shadowhound_data_logger.spool.request_table import RequestedTable
from shadowhound_data_logger.spool.schema import Table, after, marks

MISSING: Final = 'missing'
"""Reason of a quarantined object whose file is missing."""
STATES_IN_SPOOL: Final = (State.PENDING, State.HELD, State.QUARANTINED, State.KEPT)
IN_SPOOL: Final = "state IN ('pending', 'held', 'quarantined', 'kept')"
_COLUMNS: Final = 'id, bucket, key, bytes, sha256, content_type, metadata, priority, created_ns, state, reason, sensor, waits_for'
_PROTECTED: Final = "protected = 1, waits_for = CASE WHEN waits_for <> '' AND event THEN 'events.when' ELSE '' END"
"""SET clause for an object that must not be evicted from now on (``model.waits_for``)."""


def in_state(state: State) -> str:
    """The condition for objects in this state, worded so that SQLite uses the partial index of the state."""
    return f"state = '{state.value}'"


class ObjectTable(Table):
    """Reads the rows of objects, those that have left the spool among them."""

    # -- by key or number ------------------------------------------------------------------------------------------

    def row(self, bucket: str, key: str) -> sqlite3.Row | None:
        """The row of a key."""
        return next(iter(self.select('bucket = ? AND key = ?', (bucket, key))), None)

    def free_key(self, bucket: str, wanted: str, own: str | None = None) -> str:
        """The wanted key, or the first of its variants ``_1``, ``_2``, ... that was never used or is the object's ``own``.

        Variants are used in order, so a binary search finds the first free one: many objects with the same wanted key must not
        block other writers.
        """

        def is_free(attempt: int) -> bool:
            return (key := unique(wanted, attempt)) == own or self.row(bucket, key) is None

        if is_free(0):
            return wanted
        taken, free = 0, 1
        while not is_free(free):
            taken, free = free, 2 * free
        while free - taken > 1:
            middle = (taken + free) // 2
            taken, free = (taken, middle) if is_free(middle) else (middle, free)
        return unique(wanted, free)

    def knows(self, bucket: str, wanted: str, sha256: str) -> bool:
        """Whether this content was spooled under this (wanted) key, whatever became of it: its source is no longer needed.

        Objects that left the spool ``spool.remember_days`` ago are forgotten, and those whose file is missing do not count.
        """
        attempt = 0
        while (row := self.row(bucket, unique(wanted, attempt))) is not None:
            if row['sha256'] == sha256 and row['reason'] != MISSING:
                return True
            attempt += 1
        return False

    def full_row(self, number: int) -> Mapping[str, Any] | None:
        """All columns of an object, and ``counts``: messages by account if it has several."""
        cursor = self._db.execute('SELECT * FROM objects WHERE id = ?', (number,))
        cursor.row_factory = sqlite3.Row
        row: sqlite3.Row | None = cursor.fetchone()
        if row is None:
            return None
        counts = dict(self._db.execute('SELECT topic, samples FROM contents WHERE id = ?', (number,)).fetchall())
        return {**dict(row), 'counts': counts}

    def state(self, number: int) -> State | None:
        """The state of an object; None if it is forgotten or never existed."""
        found = self._db.execute('SELECT state FROM objects WHERE id = ?', (number,)).fetchone()
        return State(found[0]) if found else None

    def rows(self) -> list[sqlite3.Row]:
        """The rows of all objects, in the order in which they were spooled."""
        return self.select('1 ORDER BY id')

    def with_prefix(self, bucket: str, prefix: str, states: Collection[State] = tuple(State)) -> list[sqlite3.Row]:
        """Rows in these states whose keys start with ``prefix``, in the order in which they were spooled."""
        values = (bucket, prefix, after(prefix), *(state.value for state in states))
        return self.select(f'bucket = ? AND key >= ? AND key < ? AND state IN ({marks(len(states))}) ORDER BY id', values)

    def with_content(self, bucket: str, prefix: str, sha256: str) -> list[sqlite3.Row]:
        """Rows with this content whose keys start with ``prefix``."""
        return self.select('bucket = ? AND key >= ? AND key < ? AND sha256 = ?', (bucket, prefix, after(prefix), sha256))

    def in_spool(self) -> list[sqlite3.Row]:
        """Rows of pending, held, kept and quarantined objects, in the order in which they were spooled."""
        rows = [row for state in STATES_IN_SPOOL for row in self.select(in_state(state))]
        return sorted(rows, key=itemgetter('id'))

    def keys_in_spool(self) -> frozenset[tuple[str, str]]:
        """(bucket, key) of pending, held, kept and quarantined objects, except those recorded as missing."""
        query = 'SELECT bucket, key FROM objects WHERE {} AND reason IS NOT ?'
        return frozenset(row for state in STATES_IN_SPOOL for row in self._db.execute(query.format(in_state(state)), (MISSING,)))

    def quarantined(self, reason: str | None = None) -> list[sqlite3.Row]:
        """Rows of quarantined objects with files, for this reason or any."""
        return self.select("state = 'quarantined' AND reason = ifnull(?, reason) AND reason <> ? ORDER BY id", (reason, MISSING))

    def held(self, reason: str, limit: int = 256) -> list[HeldObject]:
        """Objects without a final name for this reason, oldest first."""
        rows = self._db.execute(
            "SELECT id, bucket, key, metadata, t_start_ns, t_end_ns, created_ns FROM objects WHERE state = 'held' AND reason = ?"
            ' ORDER BY id LIMIT ?', (reason, limit),
        )  # fmt: skip
        return [HeldObject(number, bucket, key, json.loads(metadata), start_ns, end_ns, created_ns)
                for number, bucket, key, metadata, start_ns, end_ns, created_ns in rows]  # fmt: skip

    def held_count(self, reason: str) -> int:
        """How many objects have no final name for this reason."""
        query = "SELECT count(*) FROM objects WHERE state = 'held' AND reason = ?"
        return int(self._db.execute(query, (reason,)).fetchone()[0])

    # -- what to upload, what to evict -----------------------------------------------------------------------------

    def pending(self, limit: int, *, oldest: bool, without: Sequence[str] = (),
                waiting_for: Collection[str] = ()) -> list[sqlite3.Row]:  # fmt: skip
        """Objects to upload, by priority or oldest first; skips the buckets ``without`` and objects delayed by ``waiting_for``.

        Each bucket has its own query, so that the backlog of skipped buckets takes no time.
        """
        order = ('id',) if oldest else ('priority', 'id')
        rules = ''.join(f" AND waits_for <> '{setting}'" for setting in (UPLOAD_WHEN, EVENTS_WHEN) if setting in waiting_for)
        condition = f"state = 'pending' AND bucket = ?{rules} ORDER BY {', '.join(order)} LIMIT ?"
        table = 'objects INDEXED BY exempt' if UPLOAD_WHEN in waiting_for else 'objects'
        found = [self.select(condition, (bucket, limit), table) for bucket in self._pending_buckets() if bucket not in without]
        return list(islice(merge(*found, key=itemgetter(*order)), limit))

    def _pending_buckets(self) -> Iterator[str]:
        """The buckets of all pending objects, by one index lookup each."""
        query = "SELECT bucket FROM objects WHERE state = 'pending' AND bucket > ? ORDER BY bucket LIMIT 1"
        bucket = ''
        while row := self._db.execute(query, (bucket,)).fetchone():
            bucket = row[0]
            yield bucket

    def oldest_pending_ns(self) -> int | None:
        """When the oldest pending object was spooled; None if there is none."""
        return next((row['created_ns'] for row in self.pending(1, oldest=True)), None)

    def evictable(self, limit: int) -> list[sqlite3.Row]:
        """The objects to evict first on a full disk: lowest priority, then oldest; never protected ones."""
        return self.select("state IN ('pending', 'held') AND NOT protected ORDER BY priority DESC, id LIMIT ?", (limit,))

    def evictable_bytes(self) -> dict[int, int]:
        """Bytes of all evictable objects, by priority."""
        where = "state IN ('pending', 'held') AND NOT protected"
        return dict(self._db.execute(f'SELECT priority, sum(bytes) FROM objects WHERE {where} GROUP BY priority'))  # noqa: S608

    def payload_bytes(self) -> int:
        """Bytes of all files in the spool, except those of kept objects."""
        present = "SELECT ifnull(sum(bytes), 0) FROM tally WHERE state IN ('pending', 'held', 'quarantined')"
        missing = "SELECT ifnull(sum(bytes), 0) FROM objects WHERE state = 'quarantined' AND reason = 'missing'"
        return int(self._db.execute(f'SELECT ({present}) - ({missing})').fetchone()[0])

    def select(self, where: str, values: Sequence[object] = (), table: str = 'objects') -> list[sqlite3.Row]:
        """Rows that meet an SQL condition."""
        cursor = self._db.execute(f'SELECT {_COLUMNS} FROM {table} WHERE {where}', tuple(values))  # noqa: S608
        cursor.row_factory = sqlite3.Row
        return cursor.fetchall()


class ObjectStates(Table):
    """Writes the rows of objects. A new state, and everything that follows from it, is one step here.

    Triggers (schema.sql) update the totals and the rows of lost messages; ``CatalogTable`` and ``RequestedTable`` are called.
    """

    def __init__(self, connection: Callable[[], sqlite3.Connection], catalog: CatalogTable, requested: RequestedTable) -> None:
        super().__init__(connection)
        self._catalog = catalog
        self._requested = requested

    def insert(self, item: DataObject, key: str, sha256: str, state: State, reason: str | None,
               metadata: Mapping[str, str], now_ns: int) -> int:  # fmt: skip
        """Insert a row under the final key, with the columns that decide what happens to the object later. Returns its id."""
        row = {
            'bucket': item.bucket, 'key': key, 'state': state.value, 'reason': reason, 'priority': item.priority,
            'protected': item.protected, **_fate(item.sensor, metadata, protected=item.protected), 'sensor': item.sensor,
            'topic': item.topic, 'type': item.type, 'samples': item.samples, 'bytes': len(item.body), 'sha256': sha256,
            'content_type': item.content_type, 'metadata': json.dumps(dict(metadata)), 't_start_ns': item.t_start_ns,
            't_end_ns': item.t_end_ns, 'created_ns': now_ns, 'settled_ns': now_ns if state is State.EVICTED else None,
        }  # fmt: skip
        query = f'INSERT INTO objects ({", ".join(row)}) VALUES ({marks(len(row))})'  # noqa: S608 - own constants only
        number = int(self._db.execute(query, tuple(row.values())).lastrowid or 0)
        if item.counts:
            rows = ((number, account, count) for account, count in item.counts.items())
            self._db.executemany('INSERT INTO contents VALUES (?,?,?)', rows)
        if item.statistics and state is not State.EVICTED:
            self._catalog.add_statistics(number, item.statistics)
        if state not in {State.PENDING, State.HELD}:
            self._catalog.follow([number])
        return number

    def move(self, ids: Iterable[int], state: State, reason: str | None, now_ns: int) -> None:
        """Change the state of objects that are still in the spool.

        An exception: an object that was evicted while it was being uploaded becomes delivered if the store confirmed it.
        """
        movable = (State.PENDING, State.HELD, State.KEPT, *((State.EVICTED,) if state is State.DELIVERED else ()))
        self._change(ids, movable, 'state = ?, reason = ?, settled_ns = ?', (state.value, reason, now_ns))

    def set_bound(self, row: Mapping[str, Any], key: str, binding: Binding, metadata: Mapping[str, str], created_ns: int,
                  state: State) -> None:  # fmt: skip
        """Give a held object, with this full row, its final key: it becomes pending or kept."""
        values = {
            'state': state.value, 'reason': None, 'key': key, 'metadata': json.dumps(dict(metadata)),
            **_fate(row['sensor'], metadata, protected=bool(row['protected'])), 't_start_ns': binding.t_start_ns,
            't_end_ns': binding.t_end_ns, 'created_ns': created_ns,
        }  # fmt: skip
        self._change([binding.id], tuple(State), ', '.join(f'{column} = ?' for column in values), tuple(values.values()))

    def protect(self, bucket: str, key: str) -> None:
        """Never evict this object from now on."""
        self._db.execute(f'UPDATE objects SET {_PROTECTED} WHERE bucket = ? AND key = ?', (bucket, key))  # noqa: S608

    def release(self, number: int, priority: int) -> bool:
        """Make a kept object pending with this priority, never to be evicted; False if it was not kept."""
        return self._change([number], (State.KEPT,), f"state = 'pending', priority = ?, {_PROTECTED}", (priority,)) > 0

    def set_missing(self, ids: Iterable[int], now_ns: int) -> int:
        """Quarantine objects whose files are missing; returns how many of them were in the spool."""
        ids = list(ids)
        change = "state = 'quarantined', reason = 'missing', settled_ns = ?"
        again = self._change(ids, (State.QUARANTINED,), change, (now_ns,), follow=False)
        return again + self._change(ids, (State.PENDING, State.HELD, State.KEPT), change, (now_ns,))

    def set_found(self, number: int) -> None:
        """Make a quarantined object pending again, whose file has been moved to where pending objects are."""
        self._change([number], (State.QUARANTINED,), "state = 'pending', reason = NULL, settled_ns = NULL", ())

    def set_thinned(self, number: int, values: Mapping[str, object]) -> None:
        """Write the row of a kept object with less content (``KeptTable.thin``)."""
        columns = ', '.join(f'{column} = ?' for column in values)
        self._db.execute(f'UPDATE objects SET {columns} WHERE id = ?', (*values.values(), number))  # noqa: S608

    def _change(
        self, ids: Iterable[int], of: Sequence[State], change: str, values: Sequence[object], *, follow: bool = True
    ) -> int:
        """Update the rows that are in one of the states ``of``, and what follows from their state; returns how many."""
        query = f'UPDATE objects SET {change} WHERE id = ? AND state IN ({marks(len(of))})'  # noqa: S608 - own constants only
        states = [state.value for state in of]
        changed = [number for number in ids if self._db.execute(query, (*values, number, *states)).rowcount]
        if changed and follow:
            self._catalog.follow(changed)
            self._requested.follow(changed)
        return len(changed)


def _fate(sensor: str, metadata: Mapping[str, str], *, protected: bool) -> dict[str, object]:
    """The columns that decide when an object is uploaded, and to what its loss is attributed."""
    return {
        'waits_for': waits_for(sensor, metadata, protected=protected),
        'on_request': metadata.get(meta.SHIP) == meta.ON_REQUEST,
        'event': meta.EVENT in metadata,
        'mission': metadata.get(meta.MISSION_ID, ''),
    }


def spooled(row: sqlite3.Row | Mapping[str, Any], path: Path) -> SpooledObject:
    """The object of a row."""
    return SpooledObject(
        id=row['id'], bucket=row['bucket'], key=row['key'], path=path, size=row['bytes'], sha256=row['sha256'],
        content_type=row['content_type'], metadata=json.loads(row['metadata']), priority=row['priority'],
        created_ns=row['created_ns'], waits_for=row['waits_for'],
    )  # fmt: skip
