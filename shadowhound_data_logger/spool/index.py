"""The spool's index: one SQLite file that says what every object is and where it stands, and keeps the accounts.

Written by one connection under one lock, in transactions that are durable when they return (WAL, synchronous=FULL);
read by any number of others. Its transaction is the one commit point of the spool: an object exists once its row does.
Totals are kept by triggers, so that rows of delivered objects may be forgotten without a total changing.

Every statement that the index is asked or changed with is here, but for those of its gap journal (gap_table.py); its tables,
and triggers are in schema.py. What to do is decided elsewhere.
"""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from heapq import merge
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Any, Final, NamedTuple

from shadowhound_data_logger import metadata_words as words
from shadowhound_data_logger.clock import EARLIEST_SANE_NS, SECOND
from shadowhound_data_logger.durable_files import sync
from shadowhound_data_logger.errors import SpoolError
from shadowhound_data_logger.model import (
    EVENTS_WHEN,
    UPLOAD_WHEN,
    Binding,
    DataObject,
    FileBody,
    HeldObject,
    MissingRow,
    ObjectInfo,
    RecordingRows,
    SliceRow,
    SpooledObject,
    State,
    waits_for,
)
from shadowhound_data_logger.spool.account_rows import (
    BY_ARRIVAL,
    CORRECTED,
    AccountSnapshot,
    OtherTypeRow,
    PublisherRow,
    RhythmRow,
    TopicRow,
)
from shadowhound_data_logger.spool.gap_table import GapTable
from shadowhound_data_logger.spool.request_table import RequestTable
from shadowhound_data_logger.spool.schema import (
    CATALOGUE,
    EXEMPT,
    IMPLAUSIBLE,
    WAITS_FOR,
    definitions,
    expected,
    prepare,
    version_of,
)

FORGET_STEP: Final = 5_000
"""Rows that one commit looks at to forget them, at most: some 20 ms."""
COMPACT_STEP: Final = 500
"""Rows that one commit makes short, at most: some 10 ms."""
COMPACT_STATES: Final = (State.DELIVERED, State.DEDUPLICATED, State.EVICTED)
"""Those that a short row can have, by its number."""
BUSY_TIMEOUT_S: Final = 10.0
MISSING: Final = 'missing'
"""Reason of a quarantined object whose file is gone."""
_IN_SPOOL: Final = "state IN ('pending', 'held', 'quarantined', 'kept')"
_MAY_GO: Final = """state = 'kept' AND NOT protected
  AND NOT EXISTS (SELECT 1 FROM requested WHERE requested.id = objects.id AND outcome IN ('kept', 'pending'))"""
"""What is kept, and nobody is waiting for."""
_IN_SPOOL_COUNTED: Final = f"""
SELECT ifnull(topic, '') AS name, state, count(*), sum(bytes), sum(samples) FROM objects WHERE {_IN_SPOOL} GROUP BY name, state
UNION ALL SELECT contents.topic, state, 0, 0, sum(contents.samples) FROM contents JOIN objects USING (id)
WHERE {_IN_SPOOL} GROUP BY contents.topic, state HAVING sum(contents.samples)"""  # noqa: S608 - own constants only
_IN_SPOOL_TALLY: Final = f"""
SELECT topic, state, objects, bytes, samples FROM tally
WHERE {_IN_SPOOL} AND (objects OR bytes OR samples)"""  # noqa: S608 - own constants only
_DELIVERED: Final = f"FROM objects WHERE state = 'delivered' AND sensor <> '{CATALOGUE}'"
_COMPACT_DELIVERED: Final = (
    f"FROM compact_objects JOIN folders ON folders.id = folder WHERE state = 0 AND sensor <> '{CATALOGUE}'"
)
_COMPACT: Final = """
SELECT compact_objects.id, bucket, path || name AS key, bytes, lower(hex(sha256)) AS sha256, '' AS content_type,
  '{}' AS metadata, 0 AS priority, settled_s * 1000000000 AS created_ns,
  CASE state WHEN 0 THEN 'delivered' WHEN 1 THEN 'deduplicated' ELSE 'evicted' END AS state,
  CASE state WHEN 2 THEN 'no_room' END AS reason, sensor, 0 AS protected
FROM folders JOIN compact_objects ON folder = folders.id"""
"""The columns of ``_OBJECT``, as far as they are remembered; ``created_ns`` is when it left the spool, to the second."""
_OF_SENSOR: Final = 'bucket = ? AND sensor = ? AND key >= ? AND key < ?'
_OBJECT: Final = 'id, bucket, key, bytes, sha256, content_type, metadata, priority, created_ns, state, reason, sensor, protected'


_SAID: Final = (words.MISSION_ID, words.MISSION_TYPE, words.POSE, words.BATTERY, words.CONTENT_KEY)
_NOTHING_SWEPT: Final = (0, '')


class UncataloguedObject(NamedTuple):
    """An object as the store holds it; of a repeat its own times, and the key that holds its content."""

    id: int
    bucket: str
    key: str
    size: int
    content_type: str
    metadata: Mapping[str, str]
    statistics: bytes = b''
    """As its encoder packed them; empty where there are none."""


class Index:
    """The spool's SQLite database.

    New; open once; close once. Methods that write belong to the owner of the spool's lock.
    """

    def __init__(self, path: Path, *, read_only: bool = False) -> None:
        self._path = path
        self._read_only = read_only
        self._connection: sqlite3.Connection | None = None
        self._swept: tuple[int, str] = _NOTHING_SWEPT
        """The last short row that ``forget`` looked at."""
        self._file: os.stat_result | None = None

    def open(self) -> None:
        """Raises sqlite3.DatabaseError for a damaged file, SpoolError for one of a newer version or no access."""
        if not self._read_only:
            with suppress(sqlite3.OperationalError), closing(self._connected('ro')) as view:
                version_of(view, self._path)  # closing one that may write changes the file: it takes the log of a killed node in
        try:
            connection = self._connected('ro' if self._read_only else 'rwc')
        except sqlite3.OperationalError as error:
            raise SpoolError(f'cannot open the spool index {self._path}: {error}',
                             remedy='is the path right, and may you read it?') from error  # fmt: skip
        try:
            prepare(connection, self._path, read_only=self._read_only)
        except BaseException:
            connection.close()
            raise
        self._connection = connection
        self._file = self._stat()

    def _connected(self, mode: str) -> sqlite3.Connection:
        return sqlite3.connect(
            f'{self._path.absolute().as_uri()}?mode={mode}', uri=True, timeout=BUSY_TIMEOUT_S,
            isolation_level=None, check_same_thread=False,
        )  # fmt: skip

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    @property
    def _db(self) -> sqlite3.Connection:
        if self._connection is None:
            raise SpoolError('the spool index is not open')
        return self._connection

    @property
    def gaps(self) -> GapTable:
        """The gap journal in it."""
        return GapTable(self._db)

    @property
    def requests(self) -> RequestTable:
        """What was asked for of what is kept."""
        return RequestTable(self._db)

    def check(self) -> None:
        """Raises sqlite3.DatabaseError when the file is damaged: 3 us a row, 6 us after a stop that was none.

        The longer check compares tables with their indexes as well, without which damage shows in a commit only.
        """
        if not definitions(self._db) >= expected():
            raise sqlite3.DatabaseError('its tables are not those of this version')
        pragma = 'integrity_check' if self.sessions(ended=False) else 'quick_check'
        answer = self._db.execute(f'PRAGMA {pragma}(1)').fetchone()[0]
        if answer != 'ok':
            raise sqlite3.DatabaseError(str(answer))

    def check_values(self) -> None:
        """Raises sqlite3.DatabaseError for a value that cannot be ours: asked at each start, before one is used."""
        for table, query in IMPLAUSIBLE.items():
            found = self._db.execute(query).fetchone()
            if found is not None:
                raise sqlite3.DatabaseError(f'a value of {table} {found[0]!r} cannot be')

    def miscounted(self) -> Iterator[str]:
        """A sentence for each total that is not that of the objects in the spool."""
        with self.snapshot():  # other processes commit meanwhile
            counted = {row[:2]: row[2:] for row in self._db.execute(_IN_SPOOL_COUNTED)}
            said = {row[:2]: row[2:] for row in self._db.execute(_IN_SPOOL_TALLY)}
        for what in sorted(counted.keys() | said.keys()):
            if counted.get(what) != said.get(what):
                yield f'{what[0] or "bookkeeping"}: {what[1]} {said.get(what)}, but in the spool {counted.get(what)}'

    def is_in_place(self) -> bool:
        """Whether the file that was opened is where it was."""
        now = self._stat()
        return now is not None and self._file is not None and os.path.samestat(now, self._file)

    def put_back(self) -> None:
        """Write what is open as a new file where nobody has one: it was deleted. To be opened anew then, by all who had it open.

        The caller holds the recovery lock. Raises OSError, sqlite3.Error.
        """
        self._db.execute('BEGIN IMMEDIATE')  # whoever is about to commit to the deleted file has done so then
        self._db.execute('COMMIT')
        copy = self._path.with_name(f'{self._path.name}.copy')
        copy.unlink(missing_ok=True)
        copy.touch(mode=0o600)
        with closing(sqlite3.connect(copy)) as target:
            self._db.backup(target)
        for suffix in ('-wal', '-shm'):
            Path(f'{self._path}{suffix}').unlink(missing_ok=True)
        os.replace(copy, self._path)
        sync(self._path.parent)

    def _stat(self) -> os.stat_result | None:
        try:
            return self._path.stat()
        except FileNotFoundError:
            return None

    @contextmanager
    def snapshot(self) -> Iterator[None]:
        """All that is read inside is of one instant."""
        self._db.execute('BEGIN')
        try:
            yield
        finally:
            self._db.execute('COMMIT')

    @contextmanager
    def transaction(self, undo: Callable[[], None] = lambda: None) -> Iterator[None]:
        """All or nothing, durable on leaving; ``undo`` runs before it is rolled back, with other writers still shut out.

        Raises sqlite3.DatabaseError where the file that was opened is gone from its place: nobody would see what is written.
        """
        self._db.execute('BEGIN IMMEDIATE')
        if not self.is_in_place():  # asked now: whoever put a copy there waited for the transactions before
            self._db.execute('ROLLBACK')
            raise lost(self._path)
        try:
            yield
            self._db.execute('COMMIT')
        except BaseException:
            if self._db.in_transaction:  # SQLite itself ends it on some errors: a full disk, a failing one
                undo()
                self._db.execute('ROLLBACK')
            raise

    # -- objects ---------------------------------------------------------------------------------------------------

    def has(self, bucket: str, key: str) -> bool:
        return self.row(bucket, key) is not None

    def row(self, bucket: str, key: str) -> sqlite3.Row | None:
        """The row of a key: of what left the spool an hour ago without ``content_type``, ``metadata`` and ``priority``."""
        path, name = _split(key)
        found = self._rows('bucket = ? AND key = ?', (bucket, key))
        return next(iter(found or self._compact_rows('bucket = ? AND path = ? AND name = ?', (bucket, path, name))), None)

    def rows(self) -> list[sqlite3.Row]:
        """Of all objects, as they were spooled."""
        return sorted(self._rows('1') + self._compact_rows('1'), key=itemgetter('id'))

    def with_prefix(self, bucket: str, prefix: str, states: Collection[State] = tuple(State)) -> list[sqlite3.Row]:
        """Rows in these states whose keys begin so, as they were spooled."""
        values = (bucket, prefix, _after(prefix), *(state.value for state in states))
        found = self._rows(f'bucket = ? AND key >= ? AND key < ? AND state IN ({_marks(len(values) - 3)})', values)
        found += [row for row in self._compact_with_prefix(bucket, prefix) if State(row['state']) in states]
        return sorted(found, key=itemgetter('id'))

    def with_content(self, bucket: str, prefix: str, sha256: str) -> list[sqlite3.Row]:
        """Rows of this content whose keys begin so."""
        found = self._rows('bucket = ? AND key >= ? AND key < ? AND sha256 = ?', (bucket, prefix, _after(prefix), sha256))
        return found + self._compact_with_prefix(bucket, prefix, 'AND sha256 = ?', (_digest(sha256),))

    def _compact_with_prefix(self, bucket: str, prefix: str, more: str = '', values: Sequence[object] = ()) -> list[sqlite3.Row]:
        """Of the folder that the prefix ends in, and of all folders that begin with it."""
        path, name = _split(prefix)
        found = self._compact_rows(f'bucket = ? AND path = ? AND name >= ? AND name < ? {more}',
                                   (bucket, path, name, _after(name), *values))  # fmt: skip
        below = self._compact_rows(f'bucket = ? AND path > ? AND path >= ? AND path < ? {more}',
                                   (bucket, path, prefix, _after(prefix), *values))  # fmt: skip
        return found + below

    def in_spool(self) -> list[sqlite3.Row]:
        """Rows of what is pending, held, kept or quarantined, as it was spooled."""
        return self._rows(f'{_IN_SPOOL} ORDER BY id')

    def is_in_spool(self, number: int) -> bool:
        """Whether an object is pending, held, kept or quarantined."""
        return bool(self._rows(f'id = ? AND {_IN_SPOOL}', (number,)))

    def is_quarantined(self, number: int) -> bool:
        return bool(self._rows("id = ? AND state = 'quarantined'", (number,)))

    def quarantined(self, reason: str | None = None) -> list[sqlite3.Row]:
        """Rows of what is quarantined, for this reason or any, but that its file is gone."""
        return self._rows("state = 'quarantined' AND reason = ifnull(?, reason) AND reason <> ? ORDER BY id", (reason, MISSING))

    def keys_in_spool(self, bucket: str, prefix: str) -> frozenset[str]:
        """Keys that begin so, of what is pending, held, kept or quarantined and whose file is not known to be gone."""
        rows = self._db.execute(
            f'SELECT key FROM objects WHERE bucket = ? AND key >= ? AND key < ? AND {_IN_SPOOL} AND reason IS NOT ?',  # noqa: S608
            (bucket, prefix, _after(prefix), MISSING),
        )
        return frozenset(key for (key,) in rows)

    def full_row(self, number: int) -> Mapping[str, Any] | None:
        """All columns of an object, with ``counts``: messages by account, where it holds those of several."""
        cursor = self._db.execute('SELECT * FROM objects WHERE id = ?', (number,))
        cursor.row_factory = sqlite3.Row
        row: sqlite3.Row | None = cursor.fetchone()
        if row is None:
            return None
        counts = dict(self._db.execute('SELECT topic, samples FROM contents WHERE id = ?', (number,)).fetchall())
        return {**dict(row), 'counts': counts}

    def listed(self, state: State | None, sensor: str | None, prefix: str) -> Iterator[tuple[Any, ...]]:
        """(bucket, key, sensor, state, reason, bytes, created_ns) of what is in the spool, as it was spooled.

        ``prefix`` is how ``bucket/key`` begins.
        """
        return self._db.execute(
            f'SELECT bucket, key, sensor, state, reason, bytes, created_ns FROM objects WHERE {_IN_SPOOL}'  # noqa: S608
            ' AND state = ifnull(?, state) AND sensor = ifnull(?, sensor)'
            " AND substr(bucket || '/' || key, 1, length(?)) = ? ORDER BY id",
            (state and state.value, sensor, prefix, prefix),
        )

    def recorded(self, robot: str, begin_ns: int, end_ns: int) -> Iterator[tuple[Any, ...]]:
        """Objects of a robot that are not lost and begin in this time, with what the catalogue has of them, by time.

        (bucket, key, state, reason, sensor, topic, type, bytes, t_start_ns, t_end_ns, mission_id, mission_type, pose, battery,
        content_key); what has a short row is not among them.
        """
        said = ', '.join(f"json_extract(metadata, '$.{word}')" for word in _SAID)
        return self._db.execute(
            f'SELECT bucket, key, state, reason, sensor, topic, type, bytes, t_start_ns, t_end_ns, {said} FROM objects'  # noqa: S608
            f" WHERE t_start_ns >= ? AND t_start_ns < ? AND key >= ? AND key < ? AND state <> 'evicted'"
            f" AND sensor <> '{CATALOGUE}' AND json_valid(metadata) ORDER BY t_start_ns",
            (begin_ns, end_ns, f'{robot}/', _after(f'{robot}/')),
        )

    def recorded_compact(self, robot: str, date: str) -> Iterator[tuple[str, str, str, int, int]]:
        """(bucket, key, sensor, bytes, settled_s) of short rows of delivered objects in whose folder's name is a ``YYYYMMDD``."""
        return self._db.execute(
            'SELECT bucket, path || name, sensor, bytes, settled_s FROM folders JOIN compact_objects ON folder = folders.id'  # noqa: S608
            f" WHERE path >= ? AND path < ? AND instr(path, ?) AND state <> 2 AND sensor <> '{CATALOGUE}'",
            (f'{robot}/', _after(f'{robot}/'), date),
        )

    def recorded_days(self, robot: str) -> list[int]:
        """Days since 1970 on which objects begin that have full rows."""
        rows = self._db.execute(
            'SELECT DISTINCT t_start_ns / 86400000000000 FROM objects WHERE key >= ? AND key < ? AND t_start_ns >= ?'  # noqa: S608
            f" AND sensor <> '{CATALOGUE}'",
            (f'{robot}/', _after(f'{robot}/'), EARLIEST_SANE_NS),
        )
        return [day for (day,) in rows]

    def folders(self, robot: str) -> list[str]:
        """Folders of keys that have short rows."""
        rows = self._db.execute(
            f"SELECT DISTINCT path FROM folders WHERE path >= ? AND path < ? AND sensor <> '{CATALOGUE}'",  # noqa: S608
            (f'{robot}/', _after(f'{robot}/')),
        )
        return [path for (path,) in rows]

    def usage_by_sensor(self) -> list[tuple[Any, ...]]:
        """(sensor, state, reason, objects, bytes, oldest created_ns) of the same, the most important first."""
        return self._db.execute(
            f'SELECT sensor, state, reason, count(*), sum(bytes), min(created_ns) FROM objects WHERE {_IN_SPOOL}'  # noqa: S608
            ' GROUP BY sensor, state, reason ORDER BY min(priority), sensor, state, reason'
        ).fetchall()

    def quarantine_reasons(self) -> dict[str, int]:
        """Reason -> quarantined objects."""
        query = "SELECT reason, count(*) FROM objects WHERE state = 'quarantined' GROUP BY reason"
        return {str(reason): count for reason, count in self._db.execute(query)}

    def insert(self, item: DataObject, key: str, sha256: str, state: State, reason: str | None,
               metadata: Mapping[str, str], now_ns: int) -> int:  # fmt: skip
        """Add a row under the final key; returns its id."""
        cursor = self._db.execute(
            'INSERT INTO objects (bucket, key, state, reason, priority, protected, sensor, topic, type, samples, bytes, sha256,'
            ' content_type, metadata, t_start_ns, t_end_ns, created_ns, settled_ns) VALUES (?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?)',
            (item.bucket, key, state.value, reason, item.priority, item.protected, item.sensor, item.topic, item.type,
             item.samples, len(item.body), sha256, item.content_type, json.dumps(dict(metadata)),
             item.t_start_ns, item.t_end_ns, now_ns, now_ns if state is State.EVICTED else None),
        )  # fmt: skip
        number = int(cursor.lastrowid or 0)
        if item.counts:
            rows = ((number, account, count) for account, count in item.counts.items())
            self._db.executemany('INSERT INTO contents VALUES (?,?,?)', rows)
        if item.statistics and state is not State.EVICTED:
            self._db.execute('INSERT INTO statistics VALUES (?,?)', (number, item.statistics))
        return number

    def move(self, ids: Iterable[int], state: State, reason: str | None, now_ns: int) -> None:
        """Give objects another state; the totals follow.

        Only what is still in the spool moves, but for one case: an object that was evicted while it was on its way, and
        that the store confirmed all the same, is delivered.
        """
        movable = (State.PENDING, State.HELD, State.KEPT, State.EVICTED if state is State.DELIVERED else State.HELD)
        self._db.executemany(
            'UPDATE objects SET state = ?, reason = ?, settled_ns = ? WHERE id = ? AND state IN (?, ?, ?, ?)',
            ((state.value, reason, now_ns, number, *(each.value for each in movable)) for number in ids),
        )

    def held(self, reason: str, limit: int) -> list[HeldObject]:
        """What has no final name yet for this reason, the oldest first."""
        rows = self._db.execute(
            "SELECT id, bucket, key, metadata, t_start_ns, t_end_ns, created_ns FROM objects WHERE state = 'held' AND reason = ?"
            ' ORDER BY id LIMIT ?', (reason, limit),
        )  # fmt: skip
        return [HeldObject(number, bucket, key, json.loads(metadata), start_ns, end_ns, created_ns)
                for number, bucket, key, metadata, start_ns, end_ns, created_ns in rows]  # fmt: skip

    def set_bound(self, key: str, binding: Binding, metadata: Mapping[str, str], created_ns: int, state: State) -> None:
        """A held object has its final key: it waits for delivery, or is kept."""
        self._db.execute(
            'UPDATE objects SET state = ?, reason = NULL, key = ?, metadata = ?, t_start_ns = ?, t_end_ns = ?,'
            ' created_ns = ? WHERE id = ?',
            (state.value, key, json.dumps(dict(metadata)), binding.t_start_ns, binding.t_end_ns, created_ns, binding.id),
        )

    def pending(self, limit: int, *, oldest: bool, without: Sequence[str] = (),
                waiting_for: Collection[str] = ()) -> list[sqlite3.Row]:  # fmt: skip
        """Objects to ship: most important first or oldest first, not of buckets ``without``, none that waits for these rules.

        Each bucket is asked by itself, so that what waits for those that are left out costs nothing.
        """
        order = ('id',) if oldest else ('priority', 'id')
        rules = ''.join(f" AND {WAITS_FOR} <> '{setting}'" for setting in (UPLOAD_WHEN, EVENTS_WHEN) if setting in waiting_for)
        condition = f"state = 'pending' AND bucket = ?{rules} ORDER BY {', '.join(order)} LIMIT ?"
        table = 'objects'
        if UPLOAD_WHEN in waiting_for:
            self._db.execute(EXEMPT)
            table = 'objects INDEXED BY exempt'
        found = [self._rows(condition, (bucket, limit), table) for bucket in self._waited_for() if bucket not in without]
        return list(islice(merge(*found, key=itemgetter(*order)), limit))

    def _waited_for(self) -> Iterator[str]:
        """The buckets of all pending objects: one step in the index for each."""
        query = "SELECT bucket FROM objects WHERE state = 'pending' AND bucket > ? ORDER BY bucket LIMIT 1"
        bucket = ''
        while row := self._db.execute(query, (bucket,)).fetchone():
            bucket = row[0]
            yield bucket

    def held_count(self, reason: str) -> int:
        """How many objects have no final name yet for this reason."""
        query = "SELECT count(*) FROM objects WHERE state = 'held' AND reason = ?"
        return int(self._db.execute(query, (reason,)).fetchone()[0])

    def _rows(self, where: str, values: Sequence[object] = (), table: str = 'objects') -> list[sqlite3.Row]:
        cursor = self._db.execute(f'SELECT {_OBJECT} FROM {table} WHERE {where}', tuple(values))  # noqa: S608 - own constants only
        cursor.row_factory = sqlite3.Row
        return cursor.fetchall()

    def _compact_rows(self, where: str, values: Sequence[object] = ()) -> list[sqlite3.Row]:
        cursor = self._db.execute(f'{_COMPACT} WHERE {where}', tuple(values))
        cursor.row_factory = sqlite3.Row
        return cursor.fetchall()

    def protect(self, bucket: str, key: str) -> None:
        """Never evict this object from now on."""
        self._db.execute('UPDATE objects SET protected = 1 WHERE bucket = ? AND key = ?', (bucket, key))

    def evictable(self, limit: int) -> list[sqlite3.Row]:
        """What a full disk costs first: lowest priority, then oldest; never a protected object."""
        return self._rows("state IN ('pending', 'held') AND NOT protected ORDER BY priority DESC, id LIMIT ?", (limit,))

    def evictable_bytes(self) -> dict[int, int]:
        """What evicting everything that may be evicted would free, by priority."""
        where = "state IN ('pending', 'held') AND NOT protected"
        return dict(self._db.execute(f'SELECT priority, sum(bytes) FROM objects WHERE {where} GROUP BY priority'))  # noqa: S608

    def may_go(self, limit: int, before_ns: int | None = None) -> list[sqlite3.Row]:
        """What is kept and nobody asked for, the oldest first; only what was spooled before then, where that is given."""
        before = '' if before_ns is None else 'AND created_ns < ?'
        return self._rows(f'{_MAY_GO} {before} ORDER BY id LIMIT ?', (*(() if before_ns is None else (before_ns,)), limit))

    def thinnable(self, after: int, limit: int) -> list[Mapping[str, Any]]:
        """What is kept and nobody asked for, of a larger number, in their order."""
        step = f"CASE WHEN json_valid(metadata) THEN CAST(json_extract(metadata, '$.{words.THINNED}') AS INTEGER) END AS step"
        columns = f'id, sensor, type, samples, bytes, sha256, content_type, t_start_ns, t_end_ns, {step}, bucket, key'
        query = f'SELECT {columns} FROM objects WHERE {_MAY_GO} AND id > ? ORDER BY id LIMIT ?'  # noqa: S608 - own constants only
        cursor = self._db.execute(query, (after, limit))
        names = [column[0] for column in cursor.description]
        return [dict(zip(names, row, strict=True)) for row in cursor]

    def may_thin(self, number: int, sha256: str) -> Mapping[str, Any] | None:
        """The row of an object that is kept as it was, and that nobody asked for."""
        return self.full_row(number) if self._rows(f'{_MAY_GO} AND id = ? AND sha256 = ?', (number, sha256)) else None

    def thin(self, row: Mapping[str, Any], body: FileBody, samples: int, lost: Mapping[str, int], key: str, reason: str,
             now_ns: int) -> None:  # fmt: skip
        """Give a kept object less content; what is gone is an evicted object of its own, under ``key``.

        ``row`` is that of ``full_row``, ``lost`` by topic where it has several. Together they have the totals that it had.
        """
        gone = row['samples'] - samples
        accounts = {account: lost[topic] for account in row['counts'] if (topic := account.partition(':')[2]) in lost}
        was = " AND topic = ? AND state IN ('spooled', 'kept')"
        self._db.execute(f'UPDATE tally SET bytes = bytes - ?, samples = samples - ? WHERE 1{was}',  # noqa: S608 - own constants only
                         (row['bytes'] - len(body), gone, row['topic'] or ''))  # fmt: skip
        for account, count in accounts.items():
            self._db.execute(f'UPDATE tally SET samples = samples - ? WHERE 1{was}', (count, account))  # noqa: S608
            self._db.execute('UPDATE contents SET samples = samples - ? WHERE id = ? AND topic = ?', (count, row['id'], account))
        metadata = json.loads(row['metadata'])
        word = words.MESSAGES if words.MESSAGES in metadata else words.COUNT
        step = 2 * int(metadata.get(words.THINNED, 1))
        left = {**metadata, words.SHA256: body.sha256, word: str(samples), words.THINNED: str(step)}
        self._db.execute('UPDATE objects SET bytes = ?, sha256 = ?, samples = ?, metadata = ? WHERE id = ?',
                         (len(body), body.sha256, samples, json.dumps(left), row['id']))  # fmt: skip
        # A state of its own: a part that is on its way tells of the object as it was, and takes the row of that.
        self._db.execute('INSERT INTO untold VALUES (?, ?)', (row['id'], f'{reason} {step}'))
        gone_body = FileBody(body.path, row['bytes'] - len(body), row['sha256'])
        item = DataObject(
            bucket=row['bucket'], key=key, body=gone_body, sensor=row['sensor'],
            content_type=row['content_type'], topic=row['topic'], type=row['type'], samples=gone, t_start_ns=row['t_start_ns'],
            t_end_ns=row['t_end_ns'], priority=row['priority'], protected=False, counts=accounts,
        )  # fmt: skip
        self.insert(item, key, row['sha256'], State.EVICTED, reason, {**metadata, word: str(gone)}, now_ns)

    def kept_bytes(self) -> int:
        """Of all that stays here until somebody asks for it."""
        return int(self._db.execute("SELECT ifnull(sum(bytes), 0) FROM tally WHERE state = 'kept'").fetchone()[0])

    def release(self, number: int, priority: int) -> bool:
        """A kept object waits for delivery, with this priority, and is not evicted any more; whether it was kept."""
        query = "UPDATE objects SET state = 'pending', protected = 1, priority = ? WHERE id = ? AND state = 'kept'"
        return self._db.execute(query, (priority, number)).rowcount > 0

    def payload_bytes(self) -> int:
        """Bytes of all payload that lies in the spool, without what is kept: files that went missing take no room."""
        present = "SELECT ifnull(sum(bytes), 0) FROM tally WHERE state IN ('pending', 'held', 'quarantined')"
        missing = "SELECT ifnull(sum(bytes), 0) FROM objects WHERE state = 'quarantined' AND reason = 'missing'"
        return int(self._db.execute(f'SELECT ({present}) - ({missing})').fetchone()[0])

    def oldest_pending_ns(self) -> int | None:
        """When the object that has waited for delivery for the longest was spooled; None when none waits."""
        return next((row['created_ns'] for row in self.pending(1, oldest=True)), None)

    def set_missing(self, ids: Iterable[int], now_ns: int) -> int:
        """The files of these objects are gone, whoever took them; returns for how many that is new."""
        cursor = self._db.executemany(
            "UPDATE objects SET state = 'quarantined', reason = 'missing', settled_ns = ? WHERE id = ?"
            " AND state IN ('pending', 'held', 'quarantined', 'kept')", ((now_ns, number) for number in ids),
        )  # fmt: skip
        return max(cursor.rowcount, 0)

    def set_found(self, number: int) -> None:
        """The file of a quarantined object is back where it waits for delivery."""
        self._db.execute(
            "UPDATE objects SET state = 'pending', reason = NULL, settled_ns = NULL WHERE id = ?"
            " AND state = 'quarantined'", (number,),
        )  # fmt: skip

    def compact(self, before_ns: int) -> bool:
        """Give some of what left the spool before then a short row instead; False when there may be more of it.

        What stays known is the key, size, SHA-256, state, and when it left: not its metadata. What the catalogue has no row of
        yet stays as it is. Totals do not change.
        """
        rows = self._db.execute(
            'SELECT id, bucket, key, sensor, state, bytes, sha256, settled_ns FROM objects INDEXED BY settled'
            " WHERE state IN ('delivered', 'deduplicated', 'evicted') AND settled_ns < ?"
            ' AND NOT EXISTS (SELECT 1 FROM uncatalogued WHERE uncatalogued.id = objects.id)'
            ' AND NOT EXISTS (SELECT 1 FROM untold WHERE untold.id = objects.id) ORDER BY settled_ns LIMIT ?',
            (before_ns, COMPACT_STEP),
        ).fetchall()
        folders: dict[tuple[str, str, str], int] = {}
        short = []
        for number, bucket, key, sensor, state, size, sha256, settled_ns in rows:
            path, name = _split(key)
            place = bucket, path, sensor
            if place not in folders:
                self._db.execute('INSERT OR IGNORE INTO folders (bucket, path, sensor) VALUES (?,?,?)', place)
                query = 'SELECT id FROM folders WHERE bucket = ? AND path = ? AND sensor = ?'
                folders[place] = self._db.execute(query, place).fetchone()[0]
            of = COMPACT_STATES.index(State(state))
            short.append((folders[place], name, number, of, size, _digest(sha256), settled_ns // SECOND))
        self._db.executemany('INSERT OR REPLACE INTO compact_objects VALUES (?,?,?,?,?,?,?)', short)
        self._db.executemany('DELETE FROM objects WHERE id = ?', ((row[0],) for row in rows))
        return len(rows) < COMPACT_STEP

    def forget(self, before_ns: int) -> bool:
        """Drop some of the short rows of what left the spool before then, totals stay; False when there may be more of them.

        Rows of a time before the clock was set stay: the next boot may begin at that time again, and their keys are taken.
        """
        first = self._swept
        end = 'SELECT folder, name FROM compact_objects WHERE (folder, name) > (?, ?) ORDER BY folder, name LIMIT 1 OFFSET ?'
        self._swept = self._db.execute(end, (*first, FORGET_STEP - 1)).fetchone() or _NOTHING_SWEPT
        is_last = self._swept == _NOTHING_SWEPT
        until, last = ('', ()) if is_last else ('AND (folder, name) <= (?, ?)', self._swept)
        self._db.execute(
            f'DELETE FROM compact_objects WHERE (folder, name) > (?, ?) {until} AND settled_s BETWEEN ? AND ?',  # noqa: S608
            (*first, *last, EARLIEST_SANE_NS // SECOND, before_ns // SECOND),
        )
        if is_last:
            self._db.execute('DELETE FROM folders WHERE NOT EXISTS (SELECT 1 FROM compact_objects WHERE folder = folders.id)')
        return self.gaps.forget(before_ns, FORGET_STEP) and is_last

    # -- what the catalogue lacks ------------------------------------------------------------------------------------

    def uncatalogued(self, limit: int) -> list[UncataloguedObject]:
        """Delivered objects that no part of the catalogue has a row of yet, the oldest first: triggers keep the list."""
        rows = self._db.execute(
            'SELECT id, bucket, key, bytes, content_type, said, metadata FROM uncatalogued JOIN objects USING (id)'
            ' LEFT JOIN statistics USING (id) ORDER BY id LIMIT ?', (limit,),
        )  # fmt: skip
        said = [(*row, json.loads(metadata)) for *row, metadata in rows]
        return [UncataloguedObject(number, bucket, metadata.get(words.CONTENT_KEY, key), size, kind, metadata, told or b'')
                for number, bucket, key, size, kind, told, metadata in said]  # fmt: skip

    def take_uncatalogued(self, ids: Collection[int]) -> bool:
        """Take these off the list, in the transaction that spools their part, so that a death leaves both or neither.

        False, and nothing is changed, where one was taken already.
        """
        if not ids:
            return True
        listed = {number for (number,) in self._db.execute('SELECT id FROM uncatalogued')}
        if not listed.issuperset(ids):
            return False
        self._db.executemany('DELETE FROM uncatalogued WHERE id = ?', ((number,) for number in ids))
        return True

    def untold(self, limit: int) -> list[tuple[str, str | None, UncataloguedObject]]:
        """What the table of what is kept lacks: ``kept`` or ``lost``, why, and the object; the oldest first."""
        rows = self._db.execute(
            'SELECT untold.state, reason, id, bucket, key, bytes, content_type, metadata FROM untold JOIN objects USING (id)'
            ' ORDER BY id LIMIT ?', (limit,),
        )  # fmt: skip
        return [(state, reason, UncataloguedObject(number, bucket, key, size, content_type, json.loads(metadata)))
                for state, reason, number, bucket, key, size, content_type, metadata in rows]  # fmt: skip

    def take_untold(self, told: Collection[tuple[int, str]]) -> bool:
        """As ``take_uncatalogued``, of rows of the table of what is kept."""
        if not told:
            return True
        query = 'SELECT count(*) FROM untold WHERE id = ? AND state = ?'
        if not all(self._db.execute(query, each).fetchone()[0] for each in told):
            return False
        self._db.executemany('DELETE FROM untold WHERE id = ? AND state = ?', told)
        return True

    def clear_uncatalogued(self) -> None:
        """No part will have what is delivered or kept by now, nor the gaps."""
        with self.transaction():
            self._db.execute('DELETE FROM uncatalogued')
            self._db.execute('DELETE FROM untold')
            self.gaps.set_all_told()

    def has_waiting(self, bucket: str, prefix: str, *, sensor: str, priority: int) -> bool:
        """Whether one of a sensor's objects whose keys begin so is pending with this priority, or quarantined with its file."""
        place = bucket, sensor, prefix, _after(prefix)
        return bool(
            self._rows(f"state = 'pending' AND priority = ? AND {_OF_SENSOR} LIMIT 1", (priority, *place))
            or self._rows(f"state = 'quarantined' AND reason <> ? AND {_OF_SENSOR} LIMIT 1", (MISSING, *place))
        )

    def missing(self, bucket: str, prefix: str, *, sensor: str) -> frozenset[int]:
        """Of a sensor's objects whose keys begin so, those whose files are gone."""
        values = MISSING, bucket, sensor, prefix, _after(prefix)
        return frozenset(row['id'] for row in self._rows(f"state = 'quarantined' AND reason = ? AND {_OF_SENSOR}", values))

    # -- what was delivered ------------------------------------------------------------------------------------------

    def delivered(self, after: int, limit: int) -> list[tuple[int, ObjectInfo]]:
        """Delivered objects with greater numbers that have full rows, by number and as the store has to describe them.

        Without the catalogue's parts: others stand for them in time, and they go; they can be made again.
        """
        query = f'SELECT id, bucket, key, bytes, sha256 {_DELIVERED} AND id > ? ORDER BY id LIMIT ?'
        return [(number, ObjectInfo(*of_store)) for number, *of_store in self._db.execute(query, (after, limit))]

    def delivered_compact(self, after: tuple[int, str], limit: int) -> tuple[list[tuple[int, ObjectInfo]], tuple[int, str]]:
        """The same of those that have short rows, in their order; and the place of the last one, for the next call."""
        rows = self._db.execute(
            f'SELECT folder, name, compact_objects.id, bucket, path, bytes, lower(hex(sha256)) {_COMPACT_DELIVERED}'
            ' AND (folder, name) > (?, ?) ORDER BY folder, name LIMIT ?', (*after, limit),
        ).fetchall()  # fmt: skip
        found = [(number, ObjectInfo(bucket, path + name, size, sha256)) for _, name, number, bucket, path, size, sha256 in rows]
        return found, rows[-1][:2] if rows else after

    def delivered_count(self) -> int:
        """Of those, how many are remembered."""
        queries = (f'SELECT count(*) {kept}' for kept in (_DELIVERED, _COMPACT_DELIVERED))
        return sum(self._db.execute(query).fetchone()[0] for query in queries)

    def delivered_since_ns(self) -> int | None:
        """When the first of them was delivered; None without any."""
        compact = self._db.execute(f'SELECT min(settled_s) {_COMPACT_DELIVERED}').fetchone()[0]
        full = self._db.execute(f'SELECT min(settled_ns) {_DELIVERED}').fetchone()[0]
        return min((found for found in (compact and compact * SECOND, full) if found is not None), default=None)

    def forgotten_count(self) -> int:
        """Delivered objects that are counted and not remembered, the catalogue's parts among them."""
        ever = self._db.execute("SELECT ifnull(sum(objects), 0) FROM tally WHERE state = 'delivered'").fetchone()[0]
        full = self._db.execute("SELECT count(*) FROM objects WHERE state = 'delivered'").fetchone()[0]
        return int(ever) - int(full) - int(self._db.execute('SELECT count(*) FROM compact_objects WHERE state = 0').fetchone()[0])

    # -- recordings ------------------------------------------------------------------------------------------------

    def record(self, owner: str, rows: RecordingRows) -> None:
        """Add to what is known of a recording, or forget it, in a transaction."""
        place = owner, rows.folder
        if rows.is_whole:
            for table in ('recordings', 'slices', 'missing'):
                self._db.execute(f'DELETE FROM {table} WHERE owner = ? AND folder = ?', place)  # noqa: S608 - own constants only
            return
        self._db.execute('INSERT OR REPLACE INTO recordings VALUES (?,?,?,?)', (*place, rows.said, rows.channels))
        self._db.executemany('INSERT OR REPLACE INTO slices VALUES (?,?,?,?,?,?,?,?,?)', ((*place, *row) for row in rows.slices))
        self._db.executemany('INSERT OR REPLACE INTO missing VALUES (?,?,?,?,?,?,?,?)', ((*place, *row) for row in rows.missing))

    def recordings(self, owner: str) -> list[RecordingRows]:
        """What is known of an owner's recordings that are not whole yet."""
        found = self._db.execute('SELECT folder, said, channels FROM recordings WHERE owner = ?', (owner,)).fetchall()
        return [RecordingRows(
            folder, said, channels,
            tuple(SliceRow(*one) for one in self._db.execute(
                'SELECT number, bytes, sha256, t_start_ns, t_end_ns, messages, counts FROM slices'
                ' WHERE owner = ? AND folder = ? ORDER BY number', (owner, folder))),
            tuple(MissingRow(*one) for one in self._db.execute(
                'SELECT place, file, what, messages, topic, reason FROM missing WHERE owner = ? AND folder = ? ORDER BY place',
                (owner, folder))),
        ) for folder, said, channels in found]  # fmt: skip

    # -- accounts --------------------------------------------------------------------------------------------------

    def begin_session(self, robot: str, boot_id: str, pid: int, now_ns: int) -> int:
        query = 'INSERT INTO sessions (robot, boot_id, pid, started_ns) VALUES (?,?,?,?)'
        cursor = self._db.execute(query, (robot, boot_id, pid, now_ns))
        self._db.execute('INSERT OR IGNORE INTO gaps_told VALUES (?, 0, 0)', (robot,))
        return int(cursor.lastrowid or 0)

    def begin_after(self, session: int, number: int) -> None:
        """Give the next session and the next object greater numbers than these."""
        with self.transaction():
            for table, last in (('sessions', session), ('objects', number)):
                self._db.execute('INSERT INTO sqlite_sequence SELECT ?, 0 WHERE NOT EXISTS'
                                 ' (SELECT 1 FROM sqlite_sequence WHERE name = ?)', (table, table))  # fmt: skip
                self._db.execute('UPDATE sqlite_sequence SET seq = max(seq, ?) WHERE name = ?', (last, table))

    def end_session(self, session: int, now_ns: int) -> None:
        self._db.execute('UPDATE sessions SET ended_ns = ? WHERE id = ?', (now_ns, session))

    def first_session(self) -> tuple[int, str] | None:
        """(started_ns, boot_id): tells one index from another."""
        found = self._db.execute('SELECT started_ns, boot_id FROM sessions ORDER BY id LIMIT 1').fetchone()
        return found and tuple(found)

    def last_session(self, robot: str, pid: int) -> tuple[int, int | None] | None:
        """(started_ns, ended_ns) of a robot's last session, of this process where it has one."""
        query = 'SELECT started_ns, ended_ns FROM sessions WHERE robot = ? ORDER BY pid = ? DESC, id DESC LIMIT 1'
        found = self._db.execute(query, (robot, pid)).fetchone()
        return found and tuple(found)

    def sessions_with_open(self, robot: str, sink: str) -> list[int]:
        """A robot's ended sessions that left messages of a sink open."""
        columns = 'SELECT session, received - skipped - stored, rejected, dropped FROM accounts JOIN sessions ON id = session'
        rows = self._db.execute(f'{columns} WHERE robot = ? AND ended_ns IS NOT NULL AND topic GLOB ?', (robot, f'{sink}*'))
        return sorted({
            number for number, rest, *lost in rows if rest > sum(sum(json.loads(each).values()) for each in lost)
        })  # fmt: skip

    def take_over(self, session: int, topic: str, received: int, estimated: int, unknown: int) -> None:
        """These messages of an ended session are another one's to account for; so many of them estimated, or unknown."""
        query = 'UPDATE accounts SET received = received - ? WHERE session = ? AND topic = ?'
        self._db.execute(query, (received, session, topic))
        query = 'UPDATE estimates SET estimated = estimated - ?, unknown = unknown - ? WHERE session = ? AND topic = ?'
        self._db.execute(query, (estimated, unknown, session, topic))

    def write(self, session: int, snapshot: AccountSnapshot) -> None:
        """Replace the session's accounts by a newer snapshot."""
        self._db.executemany(
            'INSERT OR REPLACE INTO accounts VALUES (?,?,?,?,?,?,?,?,?,?,?,?,?)',
            ((session, row.topic, row.type, row.accounting, row.received, row.skipped, row.stored,
              _counts(row.rejected), _counts(row.dropped), row.last_kept_ns, row.first_ns,
              row.heard_ns, row.complete_ns) for row in snapshot.topics),
        )  # fmt: skip
        self._db.executemany(
            'DELETE FROM publishers WHERE session = ? AND topic = ? AND publisher = ?', ((session, *row) for row in snapshot.gone)
        )
        self._db.executemany(
            'INSERT OR REPLACE INTO publishers VALUES (?,?,?,?,?,?,?,?,?)',
            ((session, row.topic, row.publisher, row.first, row.last, row.published, row.received, _counts(row.missed),
              row.heard_ns) for row in snapshot.publishers),
        )  # fmt: skip
        self._db.executemany(
            'INSERT OR REPLACE INTO estimates VALUES (?,?,?,?,?)',
            ((session, row.topic, row.estimated, row.unknown, _counts(row.missed))
             for row in snapshot.topics if row.estimated or row.unknown or row.missed),
        )  # fmt: skip
        self._db.executemany(
            'INSERT OR REPLACE INTO rhythms VALUES (?,?,?,?,?)',
            ((row.topic, row.publisher, row.of, row.period, row.last) for row in snapshot.rhythms),
        )
        self._db.executemany(
            'INSERT OR REPLACE INTO other_types VALUES (?,?,?,?,?)',
            ((session, row.topic, row.type, json.dumps(row.publishers), row.messages) for row in snapshot.other_types),
        )  # fmt: skip
        self._db.executemany(
            'INSERT OR REPLACE INTO remarks VALUES (?,?,?,?,?)',
            ((session, row.topic, kind, reason, count) for row in snapshot.topics
             for kind, counts in ((BY_ARRIVAL, row.by_arrival), (CORRECTED, row.corrected)) for reason, count in counts.items()),
        )  # fmt: skip
        self.gaps.write(session, snapshot.gaps, snapshot.taken_back)

    def sessions(self, *, ended: bool) -> list[int]:
        condition = 'NOT NULL' if ended else 'NULL'
        return [row[0] for row in self._db.execute(f'SELECT id FROM sessions WHERE ended_ns IS {condition} ORDER BY id')]  # noqa: S608

    def topics(self, session: int | None = None, *, robot: str | None = None) -> list[TopicRow]:
        """Accounts of one session, of those that a robot goes on with, or of all in the order of the sessions."""
        where, values = ('WHERE session = ?', (session,)) if session is not None else _going_on(robot)
        columns = ('topic, type, accounting, received, skipped, stored, last_kept_ns, rejected, dropped, ifnull(estimated, 0),'
                   " ifnull(unknown, 0), ifnull(missed, '{}'), first_ns, heard_ns, complete_ns")  # fmt: skip
        query = f'SELECT {columns} FROM accounts LEFT JOIN estimates USING (session, topic) {where} ORDER BY session'  # noqa: S608
        return [
            TopicRow(topic, kind, accounting, received, skipped, stored, json.loads(rejected), json.loads(dropped), last_ns,
                     estimated, unknown, json.loads(missed), first_ns, heard_ns, complete_ns)
            for topic, kind, accounting, received, skipped, stored, last_ns, rejected, dropped, estimated, unknown, missed,
            first_ns, heard_ns, complete_ns in self._db.execute(query, values)
        ]  # fmt: skip

    def publishers(self, *, robot: str | None = None) -> list[PublisherRow]:
        """All spans, or those that a robot goes on with, in the order of the sessions.

        The last row of a publisher says where its numbers stand.
        """
        where, values = _going_on(robot)
        columns = 'topic, publisher, first, last, published, received, missed, heard_ns'
        rows = self._db.execute(f'SELECT {columns} FROM publishers {where} ORDER BY session', values)  # noqa: S608
        return [
            PublisherRow(topic, publisher, first, last, published, received, json.loads(missed), heard_ns)
            for topic, publisher, first, last, published, received, missed, heard_ns in rows
        ]

    def other_types(self) -> list[OtherTypeRow]:
        """Of all sessions, in their order."""
        rows = self._db.execute('SELECT topic, type, publishers, messages FROM other_types ORDER BY session')
        return [OtherTypeRow(topic, kind, tuple(json.loads(nodes)), count) for topic, kind, nodes, count in rows]

    def remarks(self) -> dict[tuple[str, str], dict[str, int]]:
        """(topic, BY_ARRIVAL or CORRECTED) -> reason -> messages, over all sessions."""
        found: dict[tuple[str, str], dict[str, int]] = {}
        rows = self._db.execute('SELECT topic, kind, reason, sum(messages) FROM remarks GROUP BY topic, kind, reason')
        for topic, kind, reason, count in rows:
            found.setdefault((topic, kind), {})[reason] = count
        return found

    def rhythms(self) -> list[RhythmRow]:
        """What is known of topics without numbers, one row each."""
        return [RhythmRow(*row) for row in self._db.execute('SELECT topic, publisher, of, period, last FROM rhythms')]

    def tally(self) -> list[tuple[str, str, int, int, int]]:
        """(topic or '', state or 'spooled', objects, bytes, samples)."""
        return self._db.execute('SELECT topic, state, objects, bytes, samples FROM tally').fetchall()


def _going_on(robot: str | None) -> tuple[str, tuple[str | int, ...]]:
    """Which accounts a new session goes on with: those of the topics, and of bags and events those of its own robot.

    ``bag record`` is a robot of its own here: beside a node, the same numbers are taken twice, and each loses others.
    """
    if robot is None:
        return '', ()
    return "WHERE topic GLOB '/*' OR session IN (SELECT id FROM sessions WHERE robot = ?)", (robot,)


def _after(prefix: str) -> str:
    """The first text after all those that begin so."""
    return f'{prefix[:-1]}{chr(ord(prefix[-1]) + 1)}' if prefix else '\U0010ffff'


def _split(key: str) -> tuple[str, str]:
    """Its folder, with the slash, and the rest."""
    folder, slash, name = key.rpartition('/')
    return folder + slash, name


def _counts(by_reason: Mapping[str, int]) -> str:
    """As JSON; nearly all are empty."""
    return json.dumps(by_reason) if by_reason else '{}'


def _digest(sha256: str) -> bytes:
    """Of hex; empty for what a flipped bit made of it."""
    try:
        return bytes.fromhex(sha256)
    except ValueError:
        return b''


def _marks(count: int) -> str:
    return ', '.join('?' * count)


def lost(path: Path) -> sqlite3.DatabaseError:
    """The file that was opened is gone from its place."""
    return sqlite3.DatabaseError(f'{path} was lost: it was deleted or replaced')


def spooled(row: sqlite3.Row | Mapping[str, Any], path: Path) -> SpooledObject:
    """The object of a row."""
    metadata = json.loads(row['metadata'])
    return SpooledObject(
        id=row['id'], bucket=row['bucket'], key=row['key'], path=path, size=row['bytes'], sha256=row['sha256'],
        content_type=row['content_type'], metadata=metadata, priority=row['priority'],
        created_ns=row['created_ns'], waits_for=waits_for(row['sensor'], metadata, protected=bool(row['protected'])),
    )  # fmt: skip
