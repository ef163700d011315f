"""The durable spool: what ``commit`` returned survives the death of the process and a power cut (docs/decisions/0001).

A group commit writes and syncs the payloads as ``incoming/<session>-<any>.body``, then commits one index transaction that holds
the new objects, the outcomes of deliveries and the accounts, and makes ``incoming/<id>.part`` of the files, then renames the
parts to their final names. The transaction is the only commit point, so objects and ledger cannot disagree; a rename that did
not happen is completed by recovery. It waits for the disk once, when it is committed: no file is written or synced in it.
"""

from __future__ import annotations

import errno
import logging
import os
import sqlite3
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.clock import SECOND, Clock
from shadowhound_data_logger.core.config import KeepSettings, SpoolSettings
from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import Binding, DataObject, HeldObject, Outcome, RecordingRows, SpooledObject, State
from shadowhound_data_logger.core.stamps import NO_TIMES, Times
from shadowhound_data_logger.core.status import SpoolStatus
from shadowhound_data_logger.spool import binding
from shadowhound_data_logger.spool.account_rows import PublisherRow
from shadowhound_data_logger.spool.accounts import Accounts
from shadowhound_data_logger.spool.adding import Adding, remove_sources, staged
from shadowhound_data_logger.spool.adoption import Recovery
from shadowhound_data_logger.spool.ballast import Ballast, is_disk_full
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.gaps import Gap, Watermark
from shadowhound_data_logger.spool.index import Index, lost
from shadowhound_data_logger.spool.object_table import spooled
from shadowhound_data_logger.spool.recovery import any_alive, open_recovered
from shadowhound_data_logger.spool.repeats import Repeats
from shadowhound_data_logger.spool.request_table import (
    PIECE,
    KeptObject,
    KeptSlice,
    Progress,
    RequestRow,
    RequestTable,
    WaitingObject,
)
from shadowhound_data_logger.spool.retention import OVERHEAD_BYTES, Shortage, evict_old, fits, is_short, make_room, thin_out
from shadowhound_data_logger.spool.session import Session, carry
from shadowhound_data_logger.spool.thinning import ThinnableObject, Thinned, thin
from shadowhound_data_logger.spool.usage import usage_of

log = logging.getLogger(__name__)

CLOSE_S: Final = 10.0
"""For a commit that is under way when the spool is closed."""
PUT_BACK_S: Final = 2.5
"""For a process that lives to put back an index that was deleted under it: it commits each second."""
DAY_NS: Final = 24 * 3600 * SECOND
FULL_ROWS_NS: Final = 3600 * SECOND
"""For so long the index keeps all that it knows of an object that left the spool; then its key, size, checksum and state."""
SHORT_PART, SHORT_BYTES = 32, 64 << 20
"""Where less is left than such a part of the room for what is kept, or so many bytes, it runs short."""
MOST_OBJECTS: Final = 32
"""To be committed at a time: their rows take some 5 ms, for which other processes wait."""
KEEP: Final = KeepSettings()
LAST: Final = '\x7f'
"""After everything that a key has."""
_LEFT: Final = frozenset({State.DELIVERED, State.DEDUPLICATED, State.EVICTED})


class Spool:
    """The durable queue on disk: objects, their states and the accounts, in one transaction.

    Life: New; open once; commit, pending, ... from any thread; close once.

    ``_lock`` guards the writing connection and makes a commit and its renames one step for ``pending``.
    """

    def __init__(self, root: Path, settings: SpoolSettings, clock: Clock, robot: str, keep: KeepSettings = KEEP) -> None:
        self.root = root
        self.accounts = Accounts()
        self.recovery = Recovery()
        self._settings = settings
        self._keep = keep
        self._clock = clock
        self._robot = robot
        self._tree = Tree(root)
        self._lock = threading.Lock()
        self._index = Index(root / 'index.db')
        self._view = Index(root / 'index.db', read_only=True)
        self._lost: list[Index] = []
        """Views of indexes that were deleted."""
        self._session: Session | None = None
        self._compacted_ns = self._forgot_ns = 0
        self._shortage = Shortage(root)
        self._ballast = Ballast(root / 'ballast')
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
        """Commit the last accounts and end the session; idempotent. Raises SpoolError when the disk does not take them.

        Where the index is lost or damaged the accounts cannot be kept: it is closed, and raises SpoolError.
        """
        session = self._session
        if session is None:
            return
        with suppress(OSError, sqlite3.Error):
            self._keep_index()
        with self._lock_within(CLOSE_S):
            lost = self.accounts.drop_open('shutdown')
            if lost:
                log.error('%d messages were still in memory when the spool %s was closed', lost, self.root)
            snapshot = self.accounts.snapshot({})
            try:
                self._ballast.work(lambda: session.end(self._index, snapshot, self._clock.wall_ns()))
            except (OSError, sqlite3.OperationalError) as error:
                self.accounts.mark_dirty()
                raise self.unwritable(error) from error
            except sqlite3.DatabaseError as error:
                self._leave(session)
                raise SpoolError(f'the index of the spool {self.root} is damaged: {error}',
                                 remedy='start again: it is rebuilt from the files then') from error  # fmt: skip
            self._leave(session)

    def commit(self, objects: Sequence[DataObject] = (), outcomes: Sequence[Outcome] = (),
               rows: Sequence[RecordingRows] = (), *, leave_files: bool = False) -> list[SpooledObject]:  # fmt: skip
        """One group commit. Returns the objects that may be shipped now, under their final keys.

        It does not cut what it is given: all is one transaction, for which other processes wait (``MOST_OBJECTS``).
        ``leave_files``: files of what is delivered or evicted wait for ``remove_files``, which may take longer than the commit.
        Raises OSError or sqlite3.OperationalError when nothing of it became durable; the caller tries again. Objects
        for which there is no room at all are recorded as evicted, those whose file is gone as quarantined.
        """
        self._keep_index()
        with staged(self._tree, self._session.number if self._session else 0, objects) as ready:
            with self._lock:
                placed = self._ballast.work(lambda: self._commit(ready, outcomes, rows))
                self._ballast.keep(self._tree.free_bytes, self._settings.min_free_bytes)
            remove_sources(self._tree, objects, ready)
        if follow := [each for each in outcomes if not leave_files or each.state is State.QUARANTINED]:
            self.remove_files(follow)
        return placed

    def remove_files(self, outcomes: Iterable[Outcome]) -> None:
        """Let the files of committed outcomes follow their rows; after a kill the next start does it."""
        for outcome in outcomes:
            item = outcome.item
            if outcome.state is State.QUARANTINED:
                self._set_apart(item, outcome.reason)
            elif outcome.state in _LEFT and not self._tree.remove(item.path):
                self._tree.remove(self._tree.waiting(item.id, item.bucket, item.key))

    def fits(self, objects: Sequence[DataObject]) -> bool:
        """Whether there is room for all of them before anything leaves the disk. Raises OSError."""
        return fits(self._tree, objects)

    def is_short(self, objects: Sequence[DataObject]) -> bool:
        """Whether something would have to leave the disk for them. Raises OSError."""
        return is_short(self._tree, self._settings, objects)

    def knows(self, bucket: str, key: str, sha256: str) -> bool:
        """Whether this content was spooled under this (wanted) key, whatever became of it: a source of it is not needed any more.

        Waits for no commit; what left the spool ``remember_days`` ago is forgotten. Raises sqlite3.Error.
        """
        return binding.knows(self._view, bucket, key, sha256)

    def unwritable(self, error: OSError | sqlite3.Error) -> SpoolError:
        """What a failed commit means to an operator."""
        full = os.strerror(errno.ENOSPC)  # in one word, whoever found it: it is told once
        reason = full if is_disk_full(error, self.root) else getattr(error, 'strerror', None) or error
        return SpoolError(f'the spool {self.root} cannot be written: {reason}', remedy='is its disk full, read-only or broken?')

    def pending(self, limit: int, *, exclude: Collection[int] = (), oldest: bool = False,
                without: Sequence[str] = (), waiting_for: Collection[str] = ()) -> list[SpooledObject]:  # fmt: skip
        """Up to ``limit`` objects to ship: the most important first, or the oldest first.

        ``exclude`` are ids already in somebody's hands, ``without`` buckets that cannot take anything now, ``waiting_for``
        settings that do not hold (``model.waits_for``).
        """
        with self._lock:
            rows = self._index.objects.pending(limit + len(exclude), oldest=oldest, without=without, waiting_for=waiting_for)
        parts = frozenset(self._tree.incoming.iterdir())  # one question for all, because nearly none is there
        found: list[SpooledObject] = []
        for row in rows:
            if row['id'] not in exclude and len(found) < limit:
                number, bucket, key = row['id'], row['bucket'], row['key']
                placed = self._tree.part(number) not in parts
                path = self._tree.path(State.PENDING, None, bucket, key) if placed else self._tree.waiting(number, bucket, key)
                found.append(spooled(row, path))
        return found

    def has(self, bucket: str, key: str) -> bool:
        """Whether the name is taken. Waits for no commit; raises sqlite3.Error."""
        return self._view.objects.has(bucket, key)

    @property
    def evicted(self) -> int:
        """Objects that this process evicted because the disk or the spool was full."""
        return self._shortage.evicted

    def states(self, bucket: str, prefix: str) -> dict[str, State]:
        """What became of every object whose key begins so, by key. Waits for no commit; raises sqlite3.Error."""
        return {row['key']: State(row['state']) for row in self._view.objects.with_prefix(bucket, prefix)}

    def gaps_after(self, version: int, limit: int, offsets: Mapping[str, int]) -> tuple[list[Gap], list[Watermark]]:
        """What changed in the gap journal since this version, and up to when that is complete, both of one instant.

        About ``limit`` rows: the watermarks hold once no further row is left. ``offsets`` as of ``ClockRecord.offsets``. Waits
        for no commit; raises SpoolError or sqlite3.Error.
        """
        with closing(Index(self.root / 'index.db', read_only=True)) as index:
            index.open()
            with index.snapshot():
                return index.gaps.changed(version, limit, offsets), index.gaps.watermarks()

    @property
    def owner(self) -> str:
        """Whose sessions and recordings are its own."""
        return self._robot

    def recordings(self) -> list[RecordingRows]:
        """Bags of this owner that are not whole yet. Waits for no commit; raises sqlite3.Error."""
        return self._view.recordings.rows(self._robot)

    def free_bytes(self) -> int:
        """What this user may still write to the spool's file system. Raises OSError."""
        return self._tree.free_bytes()

    def has_room(self) -> bool:
        """Whether a bag may go on: it leaves so much free that what it has written still gets into the spool."""
        return self.free_bytes() >= self._settings.min_free_bytes // 2

    def carry(self, sink: str) -> None:
        """Carry over what this robot's ended sessions left open in a sink. Call it once, before anything is counted there."""
        with self._lock:
            if self._session is not None:
                with self._index.transaction():
                    rows = carry(self._index, self._session.number, self._robot, sink)
                self.accounts.carry(rows)

    def held(self, reason: str, limit: int = 256) -> list[HeldObject]:
        """What has no final name yet for this reason, the oldest first; waits for no commit. Raises sqlite3.Error."""
        return self._view.objects.held(reason, limit)

    def bind(self, bindings: Sequence[Binding]) -> list[SpooledObject]:
        """Give held objects their final (made unique) keys, all or none; returns those that may be shipped now.

        What is not held any more is left out. Raises NameRefused, OSError or sqlite3.OperationalError when nothing was bound.
        Waits for a recovery, another process's start: that would take the files of what is not committed for its own.
        """
        with flock(self.root / 'recovery.lock'), self._lock:
            return self._ballast.work(lambda: binding.bind(self._index, self._tree, bindings, self._clock.wall_ns()))

    # -- what is kept until somebody asks for it -------------------------------------------------------------------

    @property
    def unkept(self) -> int:
        """Objects that this process could not keep, because nothing that is kept may be evicted."""
        return self._shortage.unkept

    def has_kept(self) -> bool:
        """Whether anything is kept, or anybody waits for an answer; waits for no commit. Raises sqlite3.Error."""
        return self._view.kept.bytes() > 0 or bool(self._view.requests.open_ids())

    def requests(self) -> list[RequestRow]:
        """All that is known of what was asked for; waits for no commit. Raises sqlite3.Error."""
        return self._view.requests.rows()

    def progress(self, request: str) -> Progress:
        """What became of what a request found; waits for no commit. Raises sqlite3.Error."""
        return self._view.requests.progress(request)

    def is_over(self, request: str) -> bool:
        """Whether a request waits for nothing; waits for no commit. Raises sqlite3.Error."""
        return self._view.requests.is_over(request)

    def next_requested(self, request: str, limit: int) -> list[WaitingObject]:
        """What a request still waits for and nobody has released, the oldest first. Raises sqlite3.Error."""
        return self._view.requests.waiting(request, limit)

    def to_cut(self, request: str) -> list[KeptSlice]:
        """Kept slices of which a request wants a part, the oldest first. Raises sqlite3.Error."""
        return [KeptSlice(number, key, self._tree.path(State.KEPT, None, bucket, key), sha256, metadata)
                for number, bucket, key, sha256, metadata in self._view.requests.to_cut(request)]  # fmt: skip

    def released(self) -> tuple[int, int]:
        """Requested objects that wait for delivery, and their bytes. Raises sqlite3.Error."""
        return self._view.requests.released()

    def awaited(self) -> tuple[int, int]:
        """Open requests, and the bytes that they wait for and nobody has released. Raises sqlite3.Error."""
        return self._view.requests.awaited()

    def kept(self) -> Iterator[KeptObject]:
        """What is kept of this robot, was released and is on its way, or is lost since an hour. Waits for no commit.

        Raises sqlite3.Error.
        """
        with closing(Index(self.root / 'index.db', read_only=True)) as index:
            index.open()
            yield from index.requests.known(self._robot)

    def accept(self, row: RequestRow, chosen: Sequence[tuple[int, int]]) -> RequestRow:
        """Make a request a row, with the (id, bytes) that it chose of what is kept; returns the row as it is then.

        Fewer bytes than an object has are of a slice that is cut. Raises as ``commit``; before the row nothing of it counts.
        """
        self._in_pieces(lambda table: table.clear(row.id))
        for begin in range(0, len(chosen), PIECE):
            with self._lock, self._index.transaction():
                self._index.requests.add(row.id, chosen[begin : begin + PIECE])
        with self._lock, self._index.transaction():
            return self._index.requests.accept(row)

    def close_request(self, request: str, state: str, why: str = '') -> None:
        """End a request; what it has not released is free to go. Raises as ``commit``."""
        with self._lock, self._index.transaction():
            self._index.requests.close(request, state, why)
        self.let_go(request)

    def let_go(self, request: str) -> None:
        """Of a request that is over: what it has not released is free to go. Raises as ``commit``."""
        self._in_pieces(lambda table: table.let_go(request))

    def set_complete(self, request: str, ids: Collection[int]) -> None:
        """These slices cannot be cut: the request wants all of them. Raises as ``commit``."""
        with self._lock, self._index.transaction():
            self._index.requests.set_complete(request, ids)

    def set_cut(self, request: str, ids: Collection[int], places: Iterable[tuple[str, str]]) -> int:
        """A request waits for these (bucket, key) in place of the slices that they were cut out of; returns their bytes.

        Raises as ``commit``.
        """
        with self._lock, self._index.transaction():
            rows = [row for bucket, key in places if (row := self._index.objects.row(bucket, key)) is not None]
            self._index.requests.set_cut(request, ids, [(row['id'], row['bytes'], row['state']) for row in rows])
        return sum(row['bytes'] for row in rows)

    def forget_requests(self, before_ns: int, most: int | None = None) -> None:
        """Drop those that were answered before then, the first ones first, ``most`` at most. Raises as ``commit``."""
        for request in self._view.requests.answered(before_ns, most):
            self._in_pieces(lambda table: table.clear(request))  # noqa: B023 - called at once
            with self._lock, self._index.transaction():
                self._index.requests.forget(request)

    def clear_requests(self) -> None:
        """Drop what a process left that died while it accepted a request. Raises as ``commit``."""
        self._in_pieces(RequestTable.clear_unfinished)

    def _in_pieces(self, step: Callable[[RequestTable], bool]) -> None:
        """Until it says that there is no more to do; others have their turn between two."""
        more = True
        while more:
            with self._lock, self._index.transaction():
                more = step(self._index.requests)

    def release(self, wanted: Sequence[tuple[int, int]]) -> list[SpooledObject]:
        """Let kept objects (id, priority) wait for delivery, all or none. As ``bind``, what is not kept any more is left out."""
        with flock(self.root / 'recovery.lock'), self._lock:
            return self._ballast.work(lambda: binding.release(self._index, self._tree, wanted))

    def evict_old(self) -> int:
        """Evict what was kept for long enough, some of it at a time; returns how many objects. Raises OSError, sqlite3.Error."""
        with self._lock:
            return evict_old(self._index, self._tree, self._keep, self._clock.wall_ns())

    def is_short_to_keep(self) -> bool:
        """Whether little room is left for what is kept, by its limit or by the disk: so much as to thin what is there in time."""
        kept = self._view.kept.bytes()
        most = min(self._keep.max_bytes, kept + self._tree.free_bytes() - self._settings.min_free_bytes)
        return kept > 0 and kept > most - min(max(most // SHORT_PART, SHORT_BYTES), most // 4)

    def thinnable(self, after: int, limit: int) -> list[ThinnableObject]:
        """What is kept and nobody asked for, with a larger number than ``after``, in their order; waits for no commit."""
        return [ThinnableObject.of(row, self._tree) for row in self._view.kept.thinnable(after, limit)]

    def thin(self, item: ThinnableObject, thinned: Thinned) -> ThinnableObject | None:
        """Give a kept object less content; it, or None where it went or was asked for meanwhile. Raises as ``commit``."""
        with flock(self.root / 'recovery.lock'), self._lock:
            session = self._session.number if self._session else 0
            return self._ballast.work(lambda: thin(self._index, self._tree, session, item, thinned, self._clock.wall_ns()))

    def thin_out(self, items: Sequence[ThinnableObject]) -> int:
        """Evict some of what is kept since others of its time stay; returns how many went. Raises OSError, sqlite3.Error."""
        with self._lock:
            return thin_out(self._index, self._tree, {item.id: item.sha256 for item in items}, self._clock.wall_ns())

    def pending_count(self) -> int:
        """Waits for no commit."""
        return sum(row[2] for row in self._view.overview.tally() if row[1] == State.PENDING.value)

    def has_uncataloged(self) -> bool:
        """Whether a delivered object is in no part of the catalog yet. Waits for no commit."""
        return bool(self._view.catalog.uncataloged(1))

    def usage(self) -> SpoolStatus:
        """What lies here now; waits for no commit. Raises OSError or sqlite3.Error."""
        return usage_of(self._view, self.root, self._clock.wall_ns())

    @contextmanager
    def drain_lock(self) -> Iterator[bool]:
        """Held by the one process that ships; yields False when another one has it."""
        with flock(self.root / 'drain.lock', wait=False) as mine:
            yield mine

    @contextmanager
    def node_lock(self) -> Iterator[bool]:
        """Held by the one node that takes this robot's messages: a second one would count and store them again."""
        with flock(self.root / f'node-{self._robot}.lock', wait=False) as mine:
            yield mine

    def _keep_index(self) -> None:
        """Put the index back where somebody deleted it, or go over to the copy that another process has put there.

        Raises sqlite3.DatabaseError where another index is in its place, OSError.
        """
        session = self._session
        if session is None or self._index.is_in_place():
            return
        with flock(self.root / 'recovery.lock'), self._lock:
            if self._index.is_in_place():
                return
            path = self.root / 'index.db'
            copy, view = Index(path), Index(path, read_only=True)
            try:
                first = self._index.accounts.first_session()
                if not path.exists():
                    self._index.put_back()
                    log.error('the spool index %s was deleted: it is put back', path)
                copy.open()
                is_copy = copy.accounts.first_session() == first and session.number in copy.accounts.sessions(ended=False)
                view.open()
            except sqlite3.Error as error:
                copy.close()
                raise lost(path) from error
            if not is_copy:
                copy.close()
                view.close()
                raise lost(path)
            self._index.close()
            self._index = copy
            self._lost.append(self._view)  # other threads may be in the middle of a question
            self._view = view

    def _leave(self, session: Session) -> None:
        for view in self._lost:
            view.close()
        self._lost.clear()
        self._view.close()
        self._index.close()
        session.leave()
        self._session = None

    @contextmanager
    def _lock_within(self, seconds: float) -> Iterator[None]:
        """The lock, unless a commit hangs in the disk: the next start then ends the session."""
        if not self._lock.acquire(timeout=seconds):
            raise SpoolError(f'the spool {self.root} cannot be closed: its disk does not answer', remedy='is it broken?')
        try:
            yield
        finally:
            self._lock.release()

    # -- under the lock --------------------------------------------------------------------------------------------

    def _open(self) -> None:
        try:
            self._tree.create()
            self._wait_for_index()
            with flock(self.root / 'recovery.lock'):
                self._index = open_recovered(self._tree, self._clock.wall_ns(), self.recovery)
                self._view.open()
                self._session = Session.begin(self._index, self._tree, self._robot, self._clock)
                self.accounts = _continued(self._index, self._robot, self._clock)
        except (OSError, sqlite3.Error):
            self._index.close()
            self._view.close()
            raise

    def _wait_for_index(self) -> None:
        """Where it was deleted under a process that lives, that one puts it back with its next commit."""
        end_s = time.monotonic() + PUT_BACK_S
        while not (self.root / 'index.db').exists() and any_alive(self._tree) and time.monotonic() < end_s:
            time.sleep(PUT_BACK_S / 50)

    def _commit(self, objects: Sequence[DataObject], outcomes: Sequence[Outcome],
                rows: Sequence[RecordingRows]) -> list[SpooledObject]:  # fmt: skip
        now_ns = self._clock.wall_ns()
        leaving = sum(outcome.item.size + OVERHEAD_BYTES for outcome in outcomes if outcome.state is not State.QUARANTINED)
        room = make_room(self._index, self._tree, self._settings, self._keep, objects, leaving, now_ns)
        self._shortage.note(room, now_ns)
        stored = _count(objects)
        snapshot = self.accounts.snapshot(stored)
        session = self._session.number if self._session else 0
        with closing(Adding(self._index, self._tree, self._repeats, session, now_ns)) as adding:
            try:
                staged_objects = adding.stage(objects, room.given_up)
                with self._index.transaction(undo=adding.discard):
                    for place, item in enumerate(staged_objects):
                        if self._takes(item):
                            adding.add(item, fits=place not in room.given_up)
                    for outcome in outcomes:
                        self._index.objects.move([outcome.item.id], outcome.state, outcome.reason, now_ns)
                    for each in rows:
                        self._index.recordings.write(self._robot, each)
                    if snapshot is not None and self._session is not None:
                        self._index.accounts.write(self._session.number, snapshot)
                    self._tidy(now_ns)
                    adding.take()
            except BaseException:
                self.accounts.mark_dirty()
                raise
            self.accounts.store(stored)
            return adding.place()

    def _takes(self, item: DataObject) -> bool:
        """Whether nothing else says what an object of bookkeeping says; in the transaction with its row."""
        index = self._index
        if item.answers is not None and not index.requests.take_answer(*item.answers, self._clock.wall_ns()):
            return False
        return index.catalog.take_uncataloged(item.catalogs) and index.catalog.take_unreported(item.tells)

    def _set_apart(self, item: SpooledObject, reason: str | None) -> None:
        """Unless a retry, or another process's start, lets it wait again by now; where one is at it, the next start does it.

        The writing connection is asked: the reading one tells of no later commit while another thread is half through its answer.
        """
        try:
            with flock(self.root / 'recovery.lock', wait=False) as mine, self._lock:
                if mine and self._index.objects.state(item.id) is State.QUARANTINED:
                    source = self._tree.waiting(item.id, item.bucket, item.key)
                    self._tree.place(source, self._tree.path(State.QUARANTINED, reason, item.bucket, item.key))
        except (OSError, sqlite3.Error) as error:
            log.warning('cannot move %s to the quarantine: %s', item.path, error)

    def _tidy(self, now_ns: int) -> None:
        """Once a minute, give what left the spool an hour ago short rows; once an hour, drop what nobody will ask for any more.

        While there is more to do, each commit does a step of it.
        """
        if not 0 <= now_ns - self._compacted_ns < 60 * SECOND:
            self._compacted_ns = now_ns if self._index.history.compact(now_ns - FULL_ROWS_NS) else 0
        if not 0 <= now_ns - self._forgot_ns < 3600 * SECOND:
            done = self._index.history.forget(now_ns - round(self._settings.remember_days * DAY_NS))
            self._forgot_ns = now_ns if done else 0


def _continued(index: Index, robot: str, clock: Clock) -> Accounts:
    """Accounts of a session that goes on where the earlier ones ended."""
    last: dict[tuple[str, str], PublisherRow] = {}
    for row in index.accounts.publishers(robot=robot):
        last.pop((row.topic, row.publisher), None)  # so that the newest are the last
        last[row.topic, row.publisher] = row
    kept: dict[str, Times] = {}
    grades: dict[str, str] = {}
    heard: dict[str, Times] = {}
    for account in index.accounts.topics(robot=robot):
        kept[account.topic] = max(kept.get(account.topic, NO_TIMES), account.last_kept)
        known = (account.heard, account.last_kept, heard.get(account.topic, NO_TIMES))
        heard[account.topic] = next((each for each in known if any(each)), NO_TIMES)
        if account.received:
            grades[account.topic] = account.accounting
    return Accounts(last.values(), kept, index.accounts.rhythms(), grades, clock, heard)


def _count(objects: Iterable[DataObject]) -> dict[str, tuple[int, Times]]:
    """By account: (samples, times of the newest)."""
    counts: dict[str, tuple[int, Times]] = {}
    for item in objects:
        for account, samples in {item.topic: item.samples}.items() if item.topic is not None else item.counts.items():
            count, newest = counts.get(account, (0, NO_TIMES))
            counts[account] = (count + samples, max(newest, item.last_times))
    return counts
