"""A full disk is handled by policy, not by a crash."""

from __future__ import annotations

import errno
import logging
import os
import re
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from spool.conftest import Open
from spool.making import FakeClock, assert_whole, files, make, put, receive, rows, settle

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import Outcome, State
from shadowhound_data_logger.spool.account_table import AccountTable
from shadowhound_data_logger.spool.ballast import unwritable
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.object_table import ObjectStates
from shadowhound_data_logger.spool.spool import Spool

MEBI = 1 << 20
BODY = bytes(200_000)


def states(root: Path) -> dict[str, str]:
    """State by key."""
    return {row['key']: row['state'] for row in rows(root)}


def test_a_full_disk_evicts_the_least_important_and_oldest_first(opened: Open, root: Path) -> None:
    """Over max_bytes the lowest priority is evicted first, and the oldest within a priority; held objects can be evicted, too."""
    spool = opened(max_bytes=MEBI)
    put(spool, make('a5', BODY, priority=5), make('a9', BODY, priority=9, held='clock'), make('b9', BODY, priority=9))
    put(spool, make('a1', BODY, priority=1))
    put(spool, make('c5', BODY, priority=5))
    assert set(states(root).values()) == {'pending', 'held'}
    put(spool, make('d5', BODY, priority=5), make('e5', BODY, priority=5))
    put(spool, make('f5', BODY, priority=5))
    assert states(root) == {
        'a5': 'evicted', 'a9': 'evicted', 'b9': 'evicted', 'a1': 'pending', 'c5': 'pending', 'd5': 'pending',
        'e5': 'pending', 'f5': 'pending',
    }  # fmt: skip
    assert assert_whole(root)['objects']['evicted'] == 3


def test_new_objects_evict_no_more_important_ones(opened: Open, root: Path) -> None:
    """If only more important objects could make room, the new object is evicted; among equals the oldest."""
    spool = opened(max_bytes=MEBI)
    put(spool, *(make(f'a{number}', BODY, priority=3) for number in range(5)))
    assert put(spool, make('cloud', BODY, priority=7), make('pose', b'x', priority=3))[0].key == 'pose'
    assert {key for key, state in states(root).items() if state == 'evicted'} == {'cloud'}
    put(spool, make('b3', BODY, priority=3))
    assert {key for key, state in states(root).items() if state == 'evicted'} == {'cloud', 'a0'}
    assert_whole(root)


def test_a_group_larger_than_the_spool_is_refused(opened: Open, root: Path) -> None:
    """From a group that does not fit the important ones are taken, and among equals the newest."""
    spool = opened(max_bytes=MEBI)
    put(
        spool,
        *(make(f'{number}', BODY, priority=number // 4) for number in range(8)),
        make('p', BODY, priority=9, protected=True),
    )
    assert {key for key, state in states(root).items() if state == 'pending'} == {'p', '0', '1', '2', '3'}
    assert assert_whole(root)['objects']['evicted'] == 4


def test_a_shortage_is_logged_at_start_and_end(opened: Open, clock: FakeClock, caplog: pytest.LogCaptureFixture) -> None:
    """A spool that is full for an hour logs it once per minute, and when it ends, not with every commit."""
    caplog.set_level(logging.INFO)
    spool = opened(max_bytes=MEBI)
    for number in range(100):
        clock.now_ns += SECOND
        put(spool, make(f'{number}', BODY))
    clock.now_ns += 61 * SECOND
    settle(spool, spool.pending(1)[0], State.DELIVERED)
    settle(spool, spool.pending(1)[0], State.DELIVERED)
    reports = [re.split('[:;] ', record.getMessage())[-1] for record in caplog.records]
    assert reports == [f'evicted {count} objects so far, the least important first' for count in (1, 61)] + [
        '95 objects were evicted'
    ]


def test_protected_objects_are_never_evicted(opened: Open, root: Path) -> None:
    """A protected object is never evicted, and is added even if there is no room."""
    spool = opened(max_bytes=MEBI)
    put(spool, *(make(f'p{number}', BODY, protected=True, priority=9) for number in range(5)))
    put(spool, make('late', BODY, priority=0), make('p5', BODY, protected=True))
    assert {key: state for key, state in states(root).items() if state != 'pending'} == {'late': 'evicted'}
    found = assert_whole(root)
    assert found['topics']['/camera']['stored_in']['evicted'] == 1


def test_an_object_that_can_never_fit_evicts_nothing(opened: Open, root: Path) -> None:
    """An object larger than the spool is recorded as evicted, and nothing is evicted in vain."""
    spool = opened(max_bytes=MEBI)
    put(spool, make('small', b'x', priority=9))
    assert put(spool, make('huge', bytes(2 * MEBI), priority=0)) == []
    assert states(root) == {'small': 'pending', 'huge': 'evicted'}
    assert_whole(root)


def test_free_space_is_left(opened: Open, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Below min_free_bytes objects are evicted until enough is free, and no more."""
    spool = opened(min_free_bytes=10 * MEBI)
    put(spool, *(make(f'a{number}', BODY) for number in range(5)))
    total = 10 * MEBI + 5 * len(BODY)
    monkeypatch.setattr(Tree, 'free_bytes', lambda tree: total - sum(map(len, files(tree.root).values())))
    put(spool, make('b', BODY))
    # Room for one object and its overhead: the second oldest is evicted for the overhead alone.
    assert [key for key, state in states(root).items() if state == 'evicted'] == ['a0', 'a1']
    assert_whole(root)


def test_removed_files_use_no_space(opened: Open, root: Path) -> None:
    """Space of files deleted by hand is available again."""
    spool = opened(max_bytes=MEBI)
    put(spool, *(make(f'a{number}', BODY) for number in range(4)))
    spool.close()
    for name in files(root):
        (root / name).unlink()
    spool = opened(max_bytes=MEBI)
    assert len(put(spool, *(make(f'b{number}', BODY) for number in range(4)))) == 4
    assert spool.recovery.counts['files missing'] == 4
    assert assert_whole(root)['objects']['quarantined'] == 4


def test_an_object_evicted_during_its_upload_is_no_error(opened: Open, root: Path) -> None:
    """The ledger balances after its outcome."""
    spool = opened(max_bytes=MEBI)
    items = put(spool, *(make(f'a{number}', BODY) for number in range(5)))
    put(spool, make('b', BODY))
    settle(spool, items[0], State.DELIVERED)
    assert_whole(root)


def full(*_: Any, **__: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_no_space_for_a_payload_leaves_nothing_behind(spool: Spool, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A commit that runs out of space in its third payload leaves no files, and the next one balances."""
    write_body, written = Tree.write_body, list[Path]()

    def third_fails(path: Path, *rest: Any) -> None:
        write_body(path, *rest)
        written.append(path)
        if len(written) == 3:
            full()

    objects = [make(str(number)) for number in range(4)]
    with monkeypatch.context() as patch:
        patch.setattr(Tree, 'write_body', staticmethod(third_fails))
        with pytest.raises(OSError, match='No space left'):
            put(spool, *objects)
        assert files(root) == {}
        assert rows(root) == []
    assert len(spool.commit(objects)) == 4
    found = assert_whole(root)['topics']['/camera']
    assert (found['received'], found['stored'], found['open']) == (4, 4, 0)


@pytest.mark.parametrize('failing', ['write', 'fsync', 'open'])
def test_a_payload_that_cannot_be_written_fails_the_commit(
    spool: Spool, root: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    """A part with a failed creation, write or sync is removed."""
    with monkeypatch.context() as patch:
        if failing == 'write':
            patch.setattr('shadowhound_data_logger.spool.files.describe', full)
        else:
            patch.setattr(os, failing, full)
        with pytest.raises(OSError, match='No space left'):
            put(spool, make())
    assert files(root) == {}
    assert len(spool.commit([make()])) == 1
    assert_whole(root)


def test_every_kind_of_full_disk_is_the_same_error(spool: Spool) -> None:
    """Whether the index or a file detected it: a log that reports each new error once reports one."""
    errors = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), sqlite3.OperationalError('database or disk is full')
    (report,) = {str(unwritable(spool.root, error)) for error in errors}
    assert 'No space left on device' in report


def test_a_part_that_cannot_be_removed_stops_nothing(spool: Spool, root: Path, monkeypatch: pytest.MonkeyPatch,
                                       caplog: pytest.LogCaptureFixture) -> None:  # fmt: skip
    """A disk that becomes read-only during a part reports it each time, and nothing more; later the commit succeeds."""

    def read_only(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    receive(spool)
    with monkeypatch.context() as patch:
        patch.setattr('shadowhound_data_logger.spool.files.describe', read_only)
        patch.setattr(Path, 'unlink', read_only)
        patch.setattr(os, 'replace', read_only)
        for _ in range(3):
            with pytest.raises(OSError, match='Read-only'):
                spool.commit([make()])
    assert not caplog.records
    assert len(spool.commit([make()])) == 1
    assert_whole(root)


@pytest.mark.parametrize(('table', 'step'), [(ObjectStates, 'insert'), (AccountTable, 'write'), (ObjectStates, 'move')])
def test_no_space_for_the_index_keeps_deliveries_pending(
    spool: Spool, root: Path, monkeypatch: pytest.MonkeyPatch, table: type, step: str
) -> None:
    """A failed transaction removes its payloads, keeps the deliveries pending, and can be retried."""
    (delivered,) = put(spool, make('old'))
    outcome = [Outcome(delivered, State.DELIVERED)]
    with monkeypatch.context() as patch:

        def fail(*_: Any) -> None:
            raise sqlite3.OperationalError('database or disk is full')

        patch.setattr(table, step, fail)
        with pytest.raises(sqlite3.OperationalError, match='disk is full'):
            spool.commit([make('new')], outcome)
    assert list(files(root)) == ['ready/sensor-data/old']
    assert_whole(root)
    with spool.accounts.entry('/camera') as account:
        account.receive('p', 2)
    spool.commit([make('new')], outcome)
    assert states(root) == {'old': 'delivered', 'new': 'pending'}
    assert_whole(root)


def test_an_index_that_cannot_grow_is_a_full_disk(spool: Spool, root: Path) -> None:
    """When SQLite itself finds the disk full, the spool continues once there is space."""
    index = spool._connections.writing
    pages = index._db.execute('PRAGMA page_count').fetchone()[0]
    index._db.execute(f'PRAGMA max_page_count = {pages}')
    objects = [make(f'{number}', metadata={'padding': 'x' * 1500}) for number in range(40)]
    with pytest.raises(sqlite3.OperationalError, match='full'):
        put(spool, *objects)
    assert rows(root) == []
    index._db.execute('PRAGMA max_page_count = 1000000')
    assert len(spool.commit(objects)) == 40
    assert_whole(root)


def test_a_commit_that_fails_at_its_end_can_be_repeated(spool: Spool, root: Path) -> None:
    """A COMMIT that SQLite refuses is rolled back, and does not keep the writer in a transaction permanently."""

    class Refusing:
        """A connection with a first COMMIT that fails."""

        def __init__(self, connection: sqlite3.Connection) -> None:
            self.connection, self.refused = connection, False

        def execute(self, query: str, *rest: Any) -> Any:
            if query == 'COMMIT' and not self.refused:
                self.refused = True
                raise sqlite3.OperationalError('database is locked')
            return self.connection.execute(query, *rest)

        def __getattr__(self, name: str) -> Any:
            return getattr(self.connection, name)

    connection = spool._connections.writing._connection
    spool._connections.writing._connection = Refusing(connection)  # type: ignore[assignment, arg-type]
    with pytest.raises(sqlite3.OperationalError, match='locked'):
        put(spool, make())
    assert files(root) == {}
    assert len(spool.commit([make()])) == 1
    assert_whole(root)


def test_no_space_for_a_folder_does_not_fail_the_commit(spool: Spool, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A rename that fails after the transaction does not fail the commit: otherwise the object would be written twice."""
    with monkeypatch.context() as patch:
        patch.setattr(Path, 'mkdir', full)
        (item,) = put(spool, make())
        assert item.path.parent.name == 'incoming'
        assert spool.pending(1) == [item]
    (found,) = spool.pending(1)
    assert found.path.parent.name == '20251018'
    settle(spool, item, State.DELIVERED)
    assert files(root) == {}
    assert_whole(root)


def test_an_object_is_committed_without_a_description_that_does_not_fit(spool: Spool, root: Path) -> None:
    """Only the description is lost if an attribute is larger than the file system allows (ext4 reports a full disk)."""
    assert len(put(spool, make(metadata={'note': 'x' * 100_000}))) == 1
    assert_whole(root)


def test_a_failed_close_can_be_repeated(opened: Open, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The last accounts are not lost if their commit fails the first time."""
    spool = opened()
    with spool.accounts.entry('/camera') as account:
        account.receive('p', 1)
        account.skipped += 1
    with monkeypatch.context() as patch:
        patch.setattr(AccountTable, 'end_session', full)
        with pytest.raises(SpoolError, match='cannot be written: No space'):
            spool.close()
    spool.close()
    assert assert_whole(root)['topics']['/camera']['skipped'] == 1
