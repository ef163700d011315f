"""The spool writer: objects become durable in few commits, and a failing disk delays them but loses nothing."""

from __future__ import annotations

import errno
import hashlib
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from shipping.fakes import until
from spool.making import assert_whole, files, make, new_spool, receive, rows

from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core import worker
from shadowhound_data_logger.core.errors import NameRefused
from shadowhound_data_logger.core.model import DataObject, FileBody, SpooledObject, State
from shadowhound_data_logger.spool import writer as writer_module
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.retention import OVERHEAD_BYTES
from shadowhound_data_logger.spool.spool import MAX_OBJECTS, Outcome, Spool
from shadowhound_data_logger.spool.writer import MANY_OUTCOMES, MAX_BYTES, SpoolWriter


@pytest.fixture
def commits(spool: Spool, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The number of objects in each commit that had any."""
    counts: list[int] = []
    commit = spool.commit

    def counted(objects: list[DataObject], *more: Any, **named: Callable[..., None]) -> list[SpooledObject]:
        if objects:
            counts.append(len(objects))
        return commit(objects, *more, **named)

    monkeypatch.setattr(spool, 'commit', counted)
    return counts


@pytest.fixture
def opened(spool: Spool) -> Iterator[Callable[..., SpoolWriter]]:
    """Opens writers and closes them afterwards."""
    made: list[SpoolWriter] = []

    def make_writer(
        commit_s: float = 0.01, expects: Callable[[], bool] = lambda: False, **callbacks: Callable[..., None]
    ) -> SpoolWriter:
        made.append(SpoolWriter(spool, commit_s, expects))
        made[-1].on_commit(**callbacks)
        made[-1].open()
        return made[-1]

    yield make_writer
    for item in made:
        item.close(5)


def test_objects_are_durable_after_a_flush(opened: Callable[..., SpoolWriter], spool: Spool, root: Path) -> None:
    """A flush returns when all objects put before it are in the spool, and notifies the uploader of them."""
    reports: list[SpooledObject] = []
    writing = opened(60.0, spooled=reports.extend)
    for number in range(20):
        receive(spool)
        writing.put(make(f'{number}'))
    assert writing.flush(60)
    assert assert_whole(root)['objects']['pending'] == 20
    assert writing.written() == (20, 20)
    assert sorted(item.key for item in reports) == sorted(str(number) for number in range(20))


def test_a_burst_is_one_commit(opened: Callable[..., SpoolWriter], commits: list[int]) -> None:
    """The first object after a quiet time waits for those being created, and no longer."""
    in_the_making = [True]
    writing = opened(600.0, expects=lambda: bool(in_the_making))
    for number in range(5):
        writing.put(make(f'{number}', topic=None))
    assert not commits
    in_the_making.clear()
    until(lambda: bool(commits))
    assert commits == [5]


def test_a_burst_without_end_is_committed_anyway(opened: Callable[..., SpoolWriter], commits: list[int]) -> None:
    """Even if there are always more objects being created."""
    writing = opened(0.1, expects=lambda: True)
    writing.put(make('first', topic=None))
    until(lambda: bool(commits))
    assert commits == [1]


def test_objects_share_commits(opened: Callable[..., SpoolWriter], spool: Spool, commits: list[int]) -> None:
    """After the first commit the others wait for the next one, which includes all of them."""
    writing = opened(60.0)
    writing.put(make('first', topic=None))
    assert writing.flush(60)
    for number in range(50):
        writing.put(make(f'{number}', topic=None))
    assert commits == [1]
    assert writing.flush(60)
    assert sum(commits) == 51
    assert len(commits) <= 4


def test_kept_objects_wait_for_others_to_commit(opened: Callable[..., SpoolWriter], root: Path, commits: list[int]) -> None:
    """It is committed with the next object that may not wait, or after a heartbeat, or once there are many bytes."""
    kept: dict[str, Any] = {'topic': None, 'metadata': {meta.SHIP: meta.ON_REQUEST}}
    writing = opened(0.0)
    for number in range(5):
        writing.put(make(f'kept_{number}', **kept))
    writing.put(make('sent', topic=None))
    assert writing.flush(60)
    assert sum(commits) == 6
    assert len(commits) <= 2  # the heartbeat may be in between
    writing.put(make('alone', **kept))
    until(lambda: sum(commits) == 7)
    writing.put(make('large', bytes(MAX_BYTES), **kept))
    until(lambda: sum(commits) == 8)
    assert writing.flush(60)
    found = assert_whole(root)['objects']
    assert (found['kept'] + found['evicted'], found['pending']) == (7, 1)  # the limit for waiting objects is small


@pytest.mark.parametrize(('count', 'size'), [(200, 10), (20, 1 << 20)])
def test_a_burst_does_not_lock_the_index(
    opened: Callable[..., SpoolWriter], spool: Spool, root: Path, commits: list[int], count: int, size: int
) -> None:
    """Objects that arrive together are committed in several parts, in order; other processes run in between."""
    writing = opened(60.0)
    writing.put(make('first', topic=None))
    assert writing.flush(60)
    for number in range(count):
        receive(spool)
        writing.put(make(f'{number:03}', bytes([number]) * size))
    assert writing.flush(60)
    assert sum(commits) == count + 1
    assert max(commits) * size <= MAX_BYTES
    assert max(commits) <= MAX_OBJECTS
    assert [row['key'] for row in rows(root)] == ['first', *(f'{number:03}' for number in range(count))]
    assert_whole(root)


@pytest.mark.parametrize(('prompt', 'count', 'commits_alone'), [(False, 1, False), (True, 1, True), (False, MANY_OUTCOMES, True)])
def test_outcomes_wait_for_an_object(
    opened: Callable[..., SpoolWriter],
    spool: Spool,
    monkeypatch: pytest.MonkeyPatch,
    prompt: bool,
    count: int,
    commits_alone: bool,
) -> None:
    """A few outcomes share the next object's commit, unless a caller waits for them; many get a separate one."""
    monkeypatch.setattr(writer_module, 'HEARTBEAT_S', 60.0)
    items = spool.commit([make(f'{number}', topic=None) for number in range(count)])
    settled = threading.Event()
    writing = opened(settled=lambda _: settled.set())
    writing.prompt = prompt
    writing.settle([Outcome(item, State.DELIVERED) for item in items])
    assert settled.wait(10.0 if commits_alone else 0.1) is commits_alone
    writing.put(make('next', topic=None))
    assert settled.wait(60)


def test_a_thread_that_fails_in_a_commit_loses_nothing(opened: Callable[..., SpoolWriter], spool: Spool, root: Path,
                                        monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    """Everything pending is committed by the next round, once."""
    monkeypatch.setattr(worker, 'FIRST_PAUSE_S', 0.001)
    deaths, commit = [SystemExit(1), MemoryError()], spool.commit

    def dying(*given: Any, **named: Any) -> list[SpooledObject]:
        if deaths:
            raise deaths.pop()
        return commit(*given, **named)

    monkeypatch.setattr(spool, 'commit', dying)
    writing = opened()
    receive(spool)
    writing.put(make())
    assert writing.flush(60)
    assert writing.worker.failures == 2
    assert assert_whole(root)['objects']['pending'] == 1


def test_outcomes_are_durable_before_they_are_reported(opened: Callable[..., SpoolWriter], spool: Spool, root: Path) -> None:
    """The uploader is notified of a settled object only when its outcome is in the index."""
    settled: list[int] = []
    states: list[str] = []

    def on_settled(ids: set[int]) -> None:
        settled.extend(ids)
        states.append(rows(root)[0]['state'])

    writing = opened(settled=on_settled)
    (item,) = spool.commit([make(topic=None)])
    writing.settle([Outcome(item, State.DELIVERED)])
    assert writing.close(60)
    assert (settled, states) == ([item.id], ['delivered'])
    assert_whole(root)


def test_a_failing_disk_loses_nothing(opened: Callable[..., SpoolWriter], spool: Spool, root: Path,
                                      monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    """A failed commit is retried with all its objects until the disk works."""
    monkeypatch.setattr(worker, 'FIRST_PAUSE_S', 0.001)
    commit, failures = spool.commit, threading.Semaphore(3)

    def failing(*arguments: object, **named: object) -> list[SpooledObject]:
        if failures.acquire(blocking=False):
            raise OSError(28, 'No space left on device')
        return commit(*arguments, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(spool, 'commit', failing)
    writing = opened()
    for number in range(5):
        receive(spool)
        writing.put(make(f'{number}'))
    assert writing.flush(60)
    assert writing.worker.failures == 3
    assert assert_whole(root)['topics']['/camera']['stored'] == 5


DiskOf = Callable[[int], Path]


@pytest.fixture
def disk_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> DiskOf:
    """Limits the spool's disk to this many bytes; next to the spool it has a folder for files to add."""
    beside, write_body = tmp_path / 'beside', Tree.write_body
    beside.mkdir()

    def of(size: int) -> Path:
        def free(tree: Tree) -> int:
            found = [*(tree.root / name for name in files(tree.root)), *beside.iterdir()]
            return size - sum({status.st_ino: status.st_size for status in map(Path.stat, found)}.values())

        def writes_if_it_fits(path: Path, content: bytes, said: Mapping[str, Any]) -> None:
            if len(content) > free(Tree(path.parents[1])):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            write_body(path, content, said)

        monkeypatch.setattr(Tree, 'free_bytes', free)
        monkeypatch.setattr(Tree, 'write_body', staticmethod(writes_if_it_fits))
        return beside

    return of


def test_removing_files_does_not_delay_a_commit(
    opened: Callable[..., SpoolWriter], spool: Spool, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Objects that arrive during the removal are durable before all files are removed; at the end they are."""
    items = spool.commit([make(f'{number}', topic=None) for number in range(20)])
    remove, pending_then = spool.remove_files, list[int]()

    def removing(outcomes: Sequence[Outcome]) -> None:
        if not pending_then:
            writing.put(make('new', topic=None))
        pending_then.append(spool.pending_count())
        remove(outcomes)

    monkeypatch.setattr(spool, 'remove_files', removing)
    writing = opened(0.0)
    writing.settle([Outcome(item, State.DELIVERED) for item in items])
    assert writing.flush(60)
    until(lambda: len(pending_then) == 20)
    assert writing.close(60)
    assert (pending_then[0], pending_then[-1]) == (0, 1)
    assert not any(item.path.exists() for item in items)
    assert_whole(root)


def test_files_are_removed_while_outcomes_are_settled(
    opened: Callable[..., SpoolWriter], spool: Spool, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those settled earlier, so that the writer's thread can commit."""
    items = spool.commit([make(f'{number}', topic=None) for number in range(5)])
    commit, remove = spool.commit, spool.remove_files
    may_commit, is_committing, removed_by = threading.Event(), threading.Event(), list[int]()

    def committing(objects: list[DataObject], *more: Any, **named: Any) -> list[SpooledObject]:
        if objects:
            is_committing.set()
            assert may_commit.wait(60)
        return commit(objects, *more, **named)

    def removing(outcomes: Sequence[Outcome]) -> None:
        if not removed_by:
            writing.put(make('new', topic=None))
        removed_by.append(threading.get_ident())
        remove(outcomes)

    monkeypatch.setattr(spool, 'commit', committing)
    monkeypatch.setattr(spool, 'remove_files', removing)
    writing = opened(0.0)
    settling = threading.Thread(target=writing.settle, args=[[Outcome(item, State.DELIVERED) for item in items[:4]]])
    writing.prompt = True
    settling.start()
    settling.join()
    assert is_committing.wait(60)
    writing.settle([Outcome(items[4], State.DELIVERED)])
    assert [ident == threading.get_ident() for ident in removed_by] == [False, True, True]
    may_commit.set()
    assert writing.close(60)
    assert not any(item.path.exists() for item in items)
    assert_whole(root)


def test_delivered_files_are_removed_before_anything_is_evicted(
    root: Path, disk_of: DiskOf, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if the disk is short by ``spool.min_free_bytes`` alone, and the deliveries had a separate commit."""
    body = bytes(200_000)
    cost = len(body) + OVERHEAD_BYTES
    disk_of(100 * cost)
    spool = new_spool(root, min_free_bytes=95 * cost)
    spool.open()
    writing = SpoolWriter(spool, 0.0)
    remove, removed = spool.remove_files, list[Outcome]()

    def removing(outcomes: Sequence[Outcome]) -> None:
        if not removed:
            for number in range(4):
                receive(spool)
                writing.put(make(f'new{number}', body))
        removed.extend(outcomes)
        remove(outcomes)

    monkeypatch.setattr(spool, 'remove_files', removing)
    for number in range(4):
        receive(spool)
        spool.commit([make(f'old{number}', body)])
    writing.open()
    writing.settle([Outcome(item, State.DELIVERED) for item in spool.pending(4)])
    assert writing.flush(60)
    until(lambda: writing.written()[0] == 4)
    assert writing.close(60)
    found = assert_whole(root)['objects']
    assert (len(removed), found['delivered'], found['pending'], found['evicted']) == (4, 4, 4, 0)
    spool.close()


def test_delivered_files_are_removed_first_on_a_full_disk(opened: Callable[..., SpoolWriter], spool: Spool, root: Path,
                                                     disk_of: DiskOf) -> None:  # fmt: skip
    """A disk full of delivered files has room for the same amount again: the spool does not wait for it indefinitely."""
    body = bytes(200_000)
    disk_of(5 * (len(body) + OVERHEAD_BYTES))
    writing = opened(60.0)
    for number in range(5):
        receive(spool)
        writing.put(make(f'old{number}', body))
    assert writing.flush(60)
    writing.settle([Outcome(item, State.DELIVERED) for item in spool.pending(5)])
    for number in range(4):
        receive(spool)
        writing.put(make(f'new{number}', body))
    assert writing.flush(60)
    found = assert_whole(root)['objects']
    assert (found['delivered'], found['pending'], found['evicted']) == (5, 4, 0)
    assert not writing.worker.failures


def test_files_of_a_full_disk_make_room_for_the_rest(opened: Callable[..., SpoolWriter], spool: Spool, root: Path,
                                                     disk_of: DiskOf) -> None:  # fmt: skip
    """Slices waiting for the same commit are given up, or linked, before anything is written in their place."""
    body = bytes(200_000)
    disk = disk_of(7 * (len(body) + OVERHEAD_BYTES))
    writing = opened(60.0)
    writing.put(make('first', topic=None))
    assert writing.flush(10)
    for number in range(6):
        path = disk / f'slice{number}'
        path.write_bytes(body)
        sha256 = hashlib.sha256(body).hexdigest()
        writing.put(make(f'slice{number}', FileBody(path, len(body), sha256), topic=None, priority=8), wait=False)
    for number in range(4):
        receive(spool)
        writing.put(make(f'new{number}', body))
    assert writing.flush(10)
    assert not writing.worker.failures
    states = {row['key']: row['state'] for row in rows(root)}
    assert [states[f'new{number}'] for number in range(4)] == ['pending'] * 4
    assert not list(disk.iterdir())
    assert assert_whole(root)['objects']['evicted'] == 3


def test_encoders_wait_while_the_queue_is_full(opened: Callable[..., SpoolWriter], spool: Spool,
                                            monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    """With the disk hung, put blocks once there are too many bytes, and continues when the disk does."""
    monkeypatch.setattr(writer_module, 'MAX_WAITING_BYTES', 10)
    commit, hung = spool.commit, threading.Event()

    def hanging(*arguments: object, **named: object) -> list[SpooledObject]:
        assert hung.wait(60)
        return commit(*arguments, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(spool, 'commit', hanging)
    writing = opened()
    writing.put(make('one', b'x' * 10, topic=None))
    second = threading.Thread(target=writing.put, args=(make('two', b'y', topic=None),))
    second.start()
    second.join(0.1)
    assert second.is_alive()
    assert not writing.flush(0.01)
    hung.set()
    second.join(60)
    assert not second.is_alive()
    assert writing.flush(60)
    assert spool.pending_count() == 2


def test_an_invalid_key_is_refused_immediately(opened: Callable[..., SpoolWriter]) -> None:
    """It is an error of the caller, and does not stop the commits of others."""
    writing = opened()
    with pytest.raises(NameRefused):
        writing.put(make('../etc/passwd', topic=None))
    writing.put(make('good', topic=None))
    assert writing.close(60)


def test_the_accounts_become_durable_without_objects(opened: Callable[..., SpoolWriter], spool: Spool, root: Path,
                                                     monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    """A topic with only skipped messages is in the ledger within a heartbeat."""
    monkeypatch.setattr(writer_module, 'HEARTBEAT_S', 0.01)
    with spool.accounts.entry('/camera') as account:
        account.receive('p', 1)
        account.skipped += 1
    written, commit = threading.Event(), spool.commit

    def noticed(*arguments: object, **named: object) -> list[SpooledObject]:
        found = commit(*arguments)  # type: ignore[arg-type]
        written.set()
        return found

    monkeypatch.setattr(spool, 'commit', noticed)
    opened()
    assert written.wait(60)
    assert assert_whole(root)['topics']['/camera']['skipped'] == 1
