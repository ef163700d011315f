"""The durable spool: what ``commit`` returned survives a kill of the process and a power cut (docs/decisions/0001).

A group commit writes and syncs the payloads as ``incoming/<session>-<any>.body``, then commits one index transaction that holds
the new objects, the outcomes of deliveries and the accounts, and renames the files to ``incoming/<id>.part``; then the parts
get their final names. The transaction is the only commit point, so objects and ledger cannot disagree; recovery completes a
rename that did not happen. No file is written or synced inside the transaction: it waits for the disk once, at COMMIT.
"""

from __future__ import annotations

import logging
import sqlite3
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.clock import SECOND, Clock
from shadowhound_data_logger.core.config import KeepSettings, SpoolSettings
from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import Binding, DataObject, Outcome, RecordingRows, SpooledObject, State
from shadowhound_data_logger.core.stamps import NO_TIMES, Times
from shadowhound_data_logger.core.status import SpoolStatus
from shadowhound_data_logger.spool import binding
from shadowhound_data_logger.spool.account_rows import PublisherRow
from shadowhound_data_logger.spool.accounts import Accounts
from shadowhound_data_logger.spool.adoption import Recovery
from shadowhound_data_logger.spool.ballast import Ballast, unwritable
from shadowhound_data_logger.spool.connections import Connections
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.gaps import Gap, Watermark
from shadowhound_data_logger.spool.index import Index
from shadowhound_data_logger.spool.kept_objects import KeptObjects
from shadowhound_data_logger.spool.new_objects import NewObjects, remove_sources, staged
from shadowhound_data_logger.spool.object_table import spooled
from shadowhound_data_logger.spool.recovery import open_recovered
from shadowhound_data_logger.spool.repeats import Repeats
from shadowhound_data_logger.spool.requests import Requests
from shadowhound_data_logger.spool.retention import OVERHEAD_BYTES, Room
from shadowhound_data_logger.spool.session import Session, SessionFiles, carry

log = logging.getLogger(__name__)

CLOSE_S: Final = 10.0
"""How long ``close`` waits for a running commit."""
PUT_BACK_S: Final = 2.5
"""How long a starting process waits for a running one to put back a deleted index: the running one commits once per second."""
DAY_NS: Final = 24 * 3600 * SECOND
MAX_OBJECTS: Final = 32
"""Per commit: their rows take about 5 ms, during which other processes wait."""
KEEP: Final = KeepSettings()
_LEFT: Final = frozenset({State.DELIVERED, State.DEDUPLICATED, State.EVICTED})


class Spool:
    """The durable queue on disk: objects, their states and the accounts, in one transaction.

    Lifecycle: new; open once; commit, pending, ... from any thread; close once. ``requests`` and ``kept`` are the parts of its
    state that concern objects kept on the robot, ``room`` the space for objects; ``reading`` answers everything else.

    ``_connections.lock`` guards the writing connection and makes a commit and its renames one step for ``pending``.
    """

    def __init__(self, root: Path, settings: SpoolSettings, clock: Clock, robot: str, keep: KeepSettings = KEEP) -> None:
        self.root = root
        self.robot = robot
        self.accounts = Accounts()
        self.recovery = Recovery()
        self._settings = settings
        self._clock = clock
        self._tree = Tree(root)
        self.room = Room(self._tree, settings, keep)
        self._connections = Connections(root)
        self._session: Session | None = None
        self._forgot_ns = 0
        self._ballast = Ballast(root / 'ballast')
        self.requests = Requests(self._connections, self._tree, robot)
        self.kept = KeptObjects(self._connections, self._tree, self._ballast, self.room, clock)
        self._repeats = Repeats()

    def open(self) -> None:
        """Create or recover the spool and begin a session. Raises SpoolError naming the folder and what to do."""
        try:
            self._ballast.work(self._open)
        except (OSError, sqlite3.Error) as error:
            reason = getattr(error, 'strerror', None) or error
            remedy = 'set SHADOWHOUND_HOME to a folder that this user may write, with space on it'
            raise SpoolError(f'the spool {self.root} cannot be used: {reason}', remedy=remedy) from error
        if self.recovery.found_anything:
            log.warning('spool %s: %s', self.root, self.recovery.describe())

    def close(self) -> None:
        """Commit the last accounts and end the session; idempotent. Raises SpoolError if they cannot be written.

        If the index is lost or damaged, the accounts cannot be saved: the spool is closed and SpoolError is raised.
        """
        session = self._session
        if session is None:
            return
        with suppress(OSError, sqlite3.Error):
            self._connections.keep_in_place()
        with self._connections.lock_within(CLOSE_S):
            if lost := self.accounts.drop_open('shutdown'):
                log.error('%d messages were still in memory when the spool %s was closed', lost, self.root)
            snapshot = self.accounts.snapshot({})
            try:
                self._ballast.work(lambda: session.end(self._connections.writing, snapshot, self._clock.wall_ns()))
            except (OSError, sqlite3.OperationalError) as error:
                self.accounts.mark_dirty()
                raise unwritable(self.root, error) from error
            except sqlite3.DatabaseError as error:
                self._end(session)
                raise SpoolError(f'the index of the spool {self.root} is damaged: {error}',
                                 remedy='restart: the index is then rebuilt from the files') from error  # fmt: skip
            self._end(session)

    def commit(self, objects: Sequence[DataObject] = (), outcomes: Sequence[Outcome] = (),
               rows: Sequence[RecordingRows] = (), *, leave_files: bool = False) -> list[SpooledObject]:  # fmt: skip
        """One group commit. Returns the objects that may be shipped now, under their final keys.

        Everything is one transaction, for which other processes wait: pass at most ``MAX_OBJECTS`` objects. With ``leave_files``
        the files of delivered and evicted objects remain until ``remove_files``, which may take longer than the commit.
        Raises OSError or sqlite3.OperationalError if none of it became durable; the caller tries again. Objects for which there
        is no room are recorded as evicted, those whose file is missing as quarantined.
        """
        self._connections.keep_in_place()
        with staged(self._tree, self._connections.session, objects) as ready:
            with self._connections.lock:
                placed = self._ballast.work(lambda: self._commit(ready, outcomes, rows))
                self._ballast.keep(self._tree.free_bytes, self._settings.min_free_bytes)
            remove_sources(self._tree, objects, ready)
        if follow := [each for each in outcomes if not leave_files or each.state is State.QUARANTINED]:
            self.remove_files(follow)
        return placed

    @property
    def reading(self) -> Index:
        """The index, for reading: waits for no commit. Do not keep it, because it is replaced if its file is deleted.

        Reads raise sqlite3.Error; SpoolError while the spool is not open.
        """
        return self._connections.reading

    def remove_files(self, outcomes: Iterable[Outcome]) -> None:
        """Move or delete the files of committed outcomes; after a kill, the next startup does it."""
        for outcome in outcomes:
            item = outcome.item
            if outcome.state is State.QUARANTINED:
                self._set_apart(item, outcome.reason)
            elif outcome.state in _LEFT and not self._tree.remove(item.path):
                self._tree.remove(self._tree.place_pending(item.id, item.bucket, item.key))

    def pending(self, limit: int, *, exclude: Collection[int] = (), oldest: bool = False,
                without: Sequence[str] = (), waiting_for: Collection[str] = ()) -> list[SpooledObject]:  # fmt: skip
        """Up to ``limit`` objects to ship, by priority or oldest first.

        Skips the ids ``exclude`` (in progress), the buckets ``without`` (unreachable now), and objects that wait for one of the
        settings ``waiting_for`` (``model.waits_for``).
        """
        with self._connections.lock:
            rows = self._connections.writing.objects.pending(
                limit + len(exclude), oldest=oldest, without=without, waiting_for=waiting_for
            )
        parts = frozenset(self._tree.incoming.iterdir())  # one listing for all objects: it is nearly always empty
        found: list[SpooledObject] = []
        for row in rows:
            if row['id'] not in exclude and len(found) < limit:
                number, bucket, key = row['id'], row['bucket'], row['key']
                placed = self._tree.part(number) not in parts
                path = (self._tree.path(State.PENDING, None, bucket, key) if placed
                        else self._tree.place_pending(number, bucket, key))  # fmt: skip
                found.append(spooled(row, path))
        return found

    def gaps_after(self, version: int, limit: int, offsets: Mapping[str, int]) -> tuple[list[Gap], list[Watermark]]:
        """The changes of the gap journal since this version, and up to when it is complete, both at one instant.

        Returns about ``limit`` rows: the watermarks are valid when no further row is left. ``offsets`` are those of
        ``ClockRecord.offsets``. Waits for no commit; raises SpoolError or sqlite3.Error.
        """
        with self._connections.snapshot() as index:
            return index.gaps.changed(version, limit, offsets), index.gaps.watermarks()

    def carry(self, sink: str) -> None:
        """Take over the messages of a sink that this robot's earlier sessions left open. Call it once, before the sink counts."""
        with self._connections.lock:
            if self._session is not None:
                index = self._connections.writing
                with index.transaction():
                    rows = carry(index, self._session.number, self.robot, sink)
                self.accounts.carried.take_over(rows)

    def bind(self, bindings: Sequence[Binding]) -> list[SpooledObject]:
        """Give held objects their final, unique keys, all or none; returns those that may be shipped now.

        Skips objects that are no longer held. Raises NameRefused, OSError or sqlite3.OperationalError if none was bound.
        """
        with self._connections.moving_files() as index:
            return self._ballast.work(lambda: binding.bind(index, self._tree, bindings, self._clock.wall_ns()))

    def pending_count(self) -> int:
        """How many objects wait for delivery; waits for no commit. Raises sqlite3.Error."""
        return sum(row[2] for row in self._connections.reading.overview.tally() if row[1] == State.PENDING.value)

    def usage(self) -> SpoolStatus:
        """What the spool contains now; waits for no commit. Raises OSError or sqlite3.Error."""
        return self.reading.usage(self._clock.wall_ns())

    @contextmanager
    def drain_lock(self) -> Iterator[bool]:
        """The lock of the one process that ships; yields False if another process has it."""
        with flock(self.root / 'drain.lock', wait=False) as mine:
            yield mine

    def _end(self, session: Session) -> None:
        self._connections.close()
        session.leave()
        self._session = None
        self._connections.session = 0

    # -- under the lock --------------------------------------------------------------------------------------------

    def _open(self) -> None:
        try:
            self._tree.create()
            _wait_for_index(self.root)
            with flock(self.root / 'recovery.lock'):
                self._connections.writing = open_recovered(self._tree, self._clock.wall_ns(), self.recovery)
                self._connections.reading.open()
                self._session = Session.begin(self._connections.writing, self.root, self.robot, self._clock)
                self._connections.session = self._session.number
                self.accounts = _continued(self._connections.writing, self.robot, self._clock)
        except (OSError, sqlite3.Error):
            self._connections.writing.close()
            self._connections.reading.close()
            raise

    def _commit(self, objects: Sequence[DataObject], outcomes: Sequence[Outcome],
                rows: Sequence[RecordingRows]) -> list[SpooledObject]:  # fmt: skip
        now_ns = self._clock.wall_ns()
        leaving = sum(outcome.item.size + OVERHEAD_BYTES for outcome in outcomes if outcome.state is not State.QUARANTINED)
        not_stored = self.room.make(self._connections.writing, objects, leaving, now_ns)
        stored = _count(objects)
        snapshot = self.accounts.snapshot(stored)
        session = self._connections.session
        with closing(NewObjects(self._connections.writing, self._tree, self._repeats, session, now_ns)) as new:
            try:
                staged_objects = new.stage(objects, not_stored)
                with self._connections.writing.transaction(undo=new.discard):
                    for number, item in enumerate(staged_objects):
                        if self._takes(item):
                            new.add(item, fits=number not in not_stored)
                    for outcome in outcomes:
                        self._connections.writing.states.move([outcome.item.id], outcome.state, outcome.reason, now_ns)
                    for each in rows:
                        self._connections.writing.recordings.write(self.robot, each)
                    if snapshot is not None and self._session is not None:
                        self._connections.writing.accounts.write(self._session.number, snapshot)
                    self._tidy(now_ns)
                    new.take()
            except BaseException:
                self.accounts.mark_dirty()
                raise
            self.accounts.store(stored)
            return new.name_files()

    def _takes(self, item: DataObject) -> bool:
        """Whether an object of bookkeeping is still needed: its answer is the next one, its rows are in no other part yet."""
        index = self._connections.writing
        if item.answers is not None and not index.requests.take_answer(*item.answers, self._clock.wall_ns()):
            return False
        return index.catalog.take_uncataloged(item.catalogs) and index.catalog.take_unreported(item.reports)

    def _set_apart(self, item: SpooledObject, reason: str | None) -> None:
        """Move a file to the quarantine, unless the object has become pending again; during a recovery, the next startup does it.

        Uses the writing connection, because the reading one does not see later commits while another thread reads a result.
        """
        try:
            with flock(self.root / 'recovery.lock', wait=False) as mine, self._connections.lock:
                if mine and self._connections.writing.objects.state(item.id) is State.QUARANTINED:
                    source = self._tree.place_pending(item.id, item.bucket, item.key)
                    self._tree.move(source, self._tree.path(State.QUARANTINED, reason, item.bucket, item.key))
        except (OSError, sqlite3.Error) as error:
            log.warning('cannot move %s to the quarantine: %s', item.path, error)

    def _tidy(self, now_ns: int) -> None:
        """Once per hour, forget objects and gaps of long ago; while more remain, each commit forgets some."""
        if not 0 <= now_ns - self._forgot_ns < 3600 * SECOND:
            done = self._connections.writing.history.forget(now_ns - round(self._settings.remember_days * DAY_NS))
            self._forgot_ns = now_ns if done else 0


def _wait_for_index(root: Path) -> None:
    """Wait until a running process, under which the index was deleted, restores it with its next commit."""
    end_s, sessions = time.monotonic() + PUT_BACK_S, SessionFiles(root)
    while not (root / 'index.db').exists() and sessions.is_any_running() and time.monotonic() < end_s:
        time.sleep(PUT_BACK_S / 50)


def _continued(index: Index, robot: str, clock: Clock) -> Accounts:
    """The accounts of a session, which continue those of earlier sessions."""
    last: dict[tuple[str, str], PublisherRow] = {}
    for row in index.accounts.publishers(robot=robot):
        last.pop((row.topic, row.publisher), None)  # keeps the newest last
        last[row.topic, row.publisher] = row
    kept: dict[str, Times] = {}
    grades: dict[str, str] = {}
    newest: dict[str, Times] = {}
    for account in index.accounts.topics(robot=robot):
        kept[account.topic] = max(kept.get(account.topic, NO_TIMES), account.last_stored)
        known = (account.newest, account.last_stored, newest.get(account.topic, NO_TIMES))
        newest[account.topic] = next((each for each in known if any(each)), NO_TIMES)
        if account.received:
            grades[account.topic] = account.accounting
    return Accounts(last.values(), kept, index.accounts.rhythms(), grades, clock, newest)


def _count(objects: Iterable[DataObject]) -> dict[str, tuple[int, Times]]:
    """Account -> (samples, times of the newest)."""
    counts: dict[str, tuple[int, Times]] = {}
    for item in objects:
        for account, samples in {item.topic: item.samples}.items() if item.topic is not None else item.counts.items():
            count, newest = counts.get(account, (0, NO_TIMES))
            counts[account] = (count + samples, max(newest, item.last_times))
    return counts
