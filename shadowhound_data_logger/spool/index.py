"""The spool's index: one SQLite file with the state of every object and the accounts of all messages.

One connection writes, under one lock, in transactions that are durable when they return (WAL, synchronous=FULL); any number of
others read. The transaction is the only commit point of the spool: an object exists once its row does. Each concept has its
tables and statements in one class, which is an attribute of the index; the callers decide what to do.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.clock import EARLIEST_SANE_NS, SECOND
from shadowhound_data_logger.core.durable_files import sync
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.core.status import SpoolStatus
from shadowhound_data_logger.spool.account_table import AccountTable
from shadowhound_data_logger.spool.catalog_table import CatalogTable
from shadowhound_data_logger.spool.gap_table import GapTable
from shadowhound_data_logger.spool.history_table import HistoryTable
from shadowhound_data_logger.spool.kept_table import KeptTable
from shadowhound_data_logger.spool.object_table import IN_SPOOL, STATES_IN_SPOOL, ObjectStates, ObjectTable, in_state
from shadowhound_data_logger.spool.overview_table import OverviewTable
from shadowhound_data_logger.spool.recording_table import RecordingTable
from shadowhound_data_logger.spool.request_table import RequestedTable, RequestTable
from shadowhound_data_logger.spool.schema import definitions, expected, implausible, prepare, version_of

BUSY_TIMEOUT_S: Final = 10.0
_COUNTED: Final = """
SELECT ifnull(topic, '') AS name, state, count(*), sum(bytes), sum(samples) FROM objects WHERE {0} GROUP BY name
UNION ALL SELECT contents.topic, state, 0, 0, sum(contents.samples) FROM contents JOIN objects USING (id)
WHERE {0} GROUP BY contents.topic HAVING sum(contents.samples)"""
_IN_SPOOL_TALLY: Final = f"""
SELECT topic, state, objects, bytes, samples FROM tally
WHERE {IN_SPOOL} AND (objects OR bytes OR samples)"""  # noqa: S608 - own constants only


class Index:
    """The spool's SQLite database.

    Lifecycle: new; open once; close once. Only the owner of the spool's lock may call methods that write.
    """

    def __init__(self, path: Path, *, read_only: bool = False) -> None:
        self._path = path
        self._read_only = read_only
        self._connection: sqlite3.Connection | None = None
        self._file: os.stat_result | None = None

        def db() -> sqlite3.Connection:
            return self._db

        self.gaps = GapTable(db)
        self.requests = RequestTable(db)
        self.requested = RequestedTable(db)
        self.catalog = CatalogTable(db, self.gaps)
        self.history = HistoryTable(db, self.gaps)
        self.objects = ObjectTable(db)
        self.states = ObjectStates(db, self.catalog, self.requested)
        self.kept = KeptTable(db, self.objects, self.states, self.catalog)
        self.overview = OverviewTable(db)
        self.recordings = RecordingTable(db)
        self.accounts = AccountTable(db, self.gaps)

    def open(self) -> None:
        """Raises sqlite3.DatabaseError for a damaged file, SpoolError if it has a newer version or cannot be opened."""
        if not self._read_only:
            # Check the version first: closing a connection that may write changes the file, by merging the log of a killed node.
            with suppress(sqlite3.OperationalError), closing(self._connect('ro')) as view:
                version_of(view, self._path)
        try:
            connection = self._connect('ro' if self._read_only else 'rwc')
        except sqlite3.OperationalError as error:
            raise SpoolError(f'cannot open the spool index {self._path}: {error}',
                             remedy='check the path and its permissions') from error  # fmt: skip
        try:
            prepare(connection, self._path, read_only=self._read_only)
        except BaseException:
            connection.close()
            raise
        self._connection = connection
        self._file = self._stat()

    def _connect(self, mode: str) -> sqlite3.Connection:
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

    def check(self) -> None:
        """Raises sqlite3.DatabaseError if anything in the file is damaged. Takes 10 us per row.

        While a session has not ended, as after a kill, it also compares tables with their indexes, whose damage would otherwise
        only show in a commit.
        """
        self.check_spool()
        pragma = 'integrity_check' if self.accounts.sessions(ended=False) else 'quick_check'
        answer = self._db.execute(f'PRAGMA {pragma}(1)').fetchone()[0]
        if answer != 'ok':
            raise sqlite3.DatabaseError(str(answer))
        self._check_values('objects')

    def suspect(self) -> None:
        """Have the next startup check the whole index before it is used, however long that takes."""
        with suppress(OSError):
            suspicion_of(self._path).touch(mode=0o600)

    def check_spool(self) -> None:
        """Raises sqlite3.DatabaseError for damaged definitions, and values that this program cannot have written.

        Omits the rows of objects that have left the spool, which are nearly all rows.
        """
        if not definitions(self._db) >= expected():
            raise sqlite3.DatabaseError('its tables do not match this version')
        for table in implausible():
            if table != 'objects':
                self._check_values(table)
        for state in STATES_IN_SPOOL:
            self._check_values('objects', f'{in_state(state)} AND ')

    def _check_values(self, table: str, which: str = '') -> None:
        query = f'SELECT * FROM {table} WHERE {which}({implausible()[table]}) LIMIT 1'  # noqa: S608 - own constants only
        found = self._db.execute(query).fetchone()
        if found is not None:
            raise sqlite3.DatabaseError(f'the row {found[0]!r} of {table} has an impossible value')

    def interrupt(self) -> None:
        """End a check that another thread runs: it raises sqlite3.OperationalError. Does nothing while the index is not open."""
        if self._connection is not None:
            self._connection.interrupt()

    def miscounted(self) -> Iterator[str]:
        """A sentence for each total that differs from the objects in the spool."""
        with self.snapshot():  # because other processes may commit in between
            counted = {
                row[:2]: row[2:] for state in STATES_IN_SPOOL for row in self._db.execute(_COUNTED.format(in_state(state)))
            }
            totals = {row[:2]: row[2:] for row in self._db.execute(_IN_SPOOL_TALLY)}
        for what in sorted(counted.keys() | totals.keys()):
            if counted.get(what) != totals.get(what):
                yield f'{what[0] or "bookkeeping"}: {what[1]} {totals.get(what)}, but in the spool {counted.get(what)}'

    def usage(self, now_ns: int) -> SpoolStatus:
        """How much the spool contains, and how long its oldest object has waited. Raises OSError or sqlite3.Error."""
        tally, oldest_ns = self.overview.tally(), self.objects.oldest_pending_ns()
        count = {state: sum(row[2] for row in tally if row[1] == state.value) for state in State}
        is_unknown = oldest_ns is not None and oldest_ns < EARLIEST_SANE_NS <= now_ns  # spooled before the clock was set
        disk = os.statvfs(self._path.parent)
        return SpoolStatus(
            path=str(self._path.parent),
            pending=count[State.PENDING],
            held=count[State.HELD],
            quarantined=count[State.QUARANTINED],
            bytes=self.objects.payload_bytes(),
            free_bytes=disk.f_bavail * disk.f_frsize,
            oldest_age_s=None if oldest_ns is None or is_unknown else max(0.0, round((now_ns - oldest_ns) / SECOND, 1)),
            kept=count[State.KEPT],
            kept_bytes=self.kept.bytes(),
        )

    def is_in_place(self) -> bool:
        """Whether the opened file is still at its path."""
        now = self._stat()
        return now is not None and self._file is not None and os.path.samestat(now, self._file)

    def put_back(self) -> None:
        """Write the open index to a new file, because the old one was deleted. All processes must then open it again.

        The caller holds the recovery lock. Raises OSError, sqlite3.Error.
        """
        self._db.execute('BEGIN IMMEDIATE')  # waits for a process that is committing to the deleted file
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
        """All reads inside see the same instant."""
        self._db.execute('BEGIN')
        try:
            yield
        finally:
            self._db.execute('COMMIT')

    @contextmanager
    def transaction(self, undo: Callable[[], object] = lambda: None) -> Iterator[None]:
        """A transaction, durable on exit; ``undo`` runs before a rollback, while other writers are still locked out.

        Raises sqlite3.DatabaseError if the opened file is no longer at its path, because nothing could read what is written.
        """
        db = self._db
        db.execute('BEGIN IMMEDIATE')
        if not self.is_in_place():  # checked inside: a process that replaces the file waits for earlier transactions
            db.execute('ROLLBACK')
            raise lost(self._path)
        try:
            yield
            db.execute('COMMIT')
        except BaseException as error:
            if isinstance(error, sqlite3.DatabaseError) and not isinstance(error, sqlite3.OperationalError):
                self.suspect()
            if db.in_transaction:  # SQLite has ended it after some errors, such as a full disk
                undo()
                db.execute('ROLLBACK')
            raise


def suspicion_of(path: Path) -> Path:
    """The file that exists while an index may be damaged."""
    return path.with_name(f'{path.name}.suspect')


def lost(path: Path) -> sqlite3.DatabaseError:
    """The error if the opened file is no longer at its path."""
    return sqlite3.DatabaseError(f'{path} was deleted or replaced')
