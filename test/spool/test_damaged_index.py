"""An index that is lost, damaged, old or new: it is rebuilt from the files, or refused and left alone."""

from __future__ import annotations

import errno
import os
import random
import sqlite3
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from spool.conftest import Open
from spool.making import BUCKET, FakeClock, assert_whole, files, make, put, reopened, rows, settle

from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.spool import adoption
from shadowhound_data_logger.spool import files as files_module
from shadowhound_data_logger.spool.schema import SCHEMA_VERSION


@pytest.mark.parametrize('damage', ['deleted', 'garbage', 'empty', 'half', 'zeroed pages', 'header', 'version 0'])
def test_an_index_that_is_lost(opened: Open, root: Path, used: dict[str, bytes], damage: str) -> None:
    """The index is rebuilt from the files: every object in the spool is known again, with what it said of itself."""
    before = {row['key']: row for row in rows(root) if row['state'] != 'delivered'}
    path = root / 'index.db'
    content = path.read_bytes()
    if damage == 'deleted':
        path.unlink()
    else:
        path.write_bytes({
            'garbage': random.Random(1).randbytes(50_000),
            'empty': b'',
            'half': content[: len(content) // 2],
            'zeroed pages': content[:4096] + bytes(len(content) - 4096),
            'header': b'SQLite format 4\0' + content[16:],
            'version 0': content[:60] + bytes(4) + content[64:],
        }[damage])  # fmt: skip
    done = reopened(opened, root)
    assert done['files adopted'] == 7
    assert ('damaged index rebuilt' in done) == (damage not in {'deleted', 'empty'}) == (root / 'index.db.damaged-1').exists()
    assert files(root) == used
    same = ('bucket', 'state', 'reason', 'priority', 'protected', 'sensor', 'topic', 'type', 'samples', 'bytes', 'sha256',
            'content_type', 't_start_ns', 't_end_ns')  # fmt: skip
    after = {row['key']: row for row in rows(root) if row['state'] != 'delivered'}
    assert {key: [row[name] for name in same] for key, row in after.items()} == {
        key: [row[name] for name in same] for key, row in before.items()
    }


def test_every_damaged_index_is_kept(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """A second damaged index is set aside beside the first."""
    for number in (1, 2):
        (root / 'index.db').write_bytes(b'garbage' * 1000)
        opened().close()
        assert (root / f'index.db.damaged-{number}').read_bytes() == b'garbage' * 1000


def test_many_files_are_adopted_in_groups(opened: Open, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A rebuild of more files than one group takes all of them."""
    monkeypatch.setattr(adoption, 'GROUP_FILES', 3)
    spool = opened()
    put(spool, *(make(f'{number}') for number in range(10)))
    spool.close()
    (root / 'index.db').unlink()
    assert reopened(opened, root)['files adopted'] == 10
    assert assert_whole(root)['topics']['/camera']['stored'] == 11


def test_rebuilt_indexes_give_out_different_numbers(opened: Open, root: Path, clock: FakeClock) -> None:
    """A process that lives with the index before may be about to name a part by a number of that."""
    spools = [opened()]
    put(spools[0], *(make(f'{number}') for number in range(30)))
    numbers: list[int] = []
    for _ in range(2):
        (root / 'index.db').rename(root / f'index.db.damaged-{len(numbers)}')
        (root / 'index.db').touch()
        clock.now_ns += 10_000_000
        spools.append(opened())
        numbers += [row['id'] for row in rows(root)]
    for lost in spools[:2]:
        with pytest.raises(SpoolError, match='restart'):
            lost.close()
    assert len(set(numbers)) == 60


def test_a_lost_write_ahead_log(opened: Open, root: Path) -> None:
    """When the index goes back in time, the files written since are adopted again."""
    spool = opened()
    put(spool, make('old'))
    spool._connections.writing._db.execute('PRAGMA wal_checkpoint(TRUNCATE)')
    put(spool, make('new', b'new'))
    before = (root / 'index.db').read_bytes()
    assert (root / 'index.db-wal').stat().st_size > 0
    spool.close()
    (root / 'index.db').write_bytes(before)
    for suffix in ('-wal', '-shm'):
        (root / f'index.db{suffix}').unlink(missing_ok=True)
    assert reopened(opened, root)['files adopted'] == 1
    assert {row['key'] for row in rows(root) if row['state'] == 'pending'} == {'old', 'new'}


def test_a_truncated_write_ahead_log(opened: Open, root: Path) -> None:
    """A log cut in its middle, as a power cut leaves it, starts."""
    spool = opened()
    put(spool, make('old'))
    put(spool, make('new', b'new'))
    state = {name: (root / name).read_bytes() for name in ('index.db', 'index.db-wal')}
    spool.close()
    (root / 'index.db').write_bytes(state['index.db'])
    (root / 'index.db-wal').write_bytes(state['index.db-wal'][:-5000])
    reopened(opened, root)
    assert {row['key'] for row in rows(root) if row['state'] == 'pending'} == {'old', 'new'}


def test_an_index_of_a_newer_version(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """A newer program's index is refused and left as it is."""
    with sqlite3.connect(root / 'index.db') as connection:
        connection.executescript(f'CREATE TABLE newer (id); PRAGMA user_version = {SCHEMA_VERSION + 1}')
    connection.close()
    with pytest.raises(SpoolError, match=rf'version {SCHEMA_VERSION + 1}.*update shadowhound_data_logger'):
        opened()
    assert not (root / 'index.db.damaged-1').exists()
    assert files(root) == used


def test_a_locked_index_is_not_damaged(opened: Open, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An index that another program locks is an error to say, not a reason to begin anew."""
    opened().close()
    monkeypatch.setattr('shadowhound_data_logger.spool.index.BUSY_TIMEOUT_S', 0.05)
    connection = sqlite3.connect(root / 'index.db', isolation_level=None)
    connection.execute('BEGIN EXCLUSIVE')
    with pytest.raises(SpoolError, match='locked'):
        opened()
    connection.close()
    assert not (root / 'index.db.damaged-1').exists()


def test_a_rebuilt_key_is_not_given_out_again(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """After a rebuild new objects get other keys than those in the spool."""
    (root / 'index.db').unlink()
    assert put(opened(), make('thor/a/2.jpg', b'new'))[0].key == 'thor/a/2_1.jpg'
    assert_whole(root)


def test_the_same_key_in_two_folders(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """Two files of one key after a lost index: one becomes the object, the other is set aside."""
    (root / 'index.db').unlink()
    twin = root / f'quarantine/refused/{BUCKET}/thor/a/2.jpg'
    twin.write_bytes(b'twin')
    spool = opened()
    assert spool.recovery.counts['files adopted'] == 7
    assert spool.recovery.counts['foreign files set aside'] == 1
    assert (root / 'foreign' / twin.relative_to(root)).read_bytes() == b'twin'


@pytest.mark.parametrize('number', [errno.EACCES, errno.EIO, errno.ENOTSUP, errno.ENODATA])
def test_attributes_that_cannot_be_read(
    opened: Open, root: Path, used: dict[str, bytes], monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """Without readable descriptions a rebuild knows the objects by name and content alone."""

    def fail(*_: Any) -> bytes:
        raise OSError(number, os.strerror(number))

    (root / 'index.db').unlink()
    monkeypatch.setattr(os, 'getxattr', fail)
    assert reopened(opened, root)['files adopted'] == 7
    assert files(root) == used


def test_a_file_system_without_attributes(opened: Open, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where files cannot carry a description the spool works, and only a rebuild knows less."""

    def fail(*_: Any) -> None:
        raise OSError(errno.ENOTSUP, os.strerror(errno.ENOTSUP))

    monkeypatch.setattr(files_module.os, 'setxattr', fail)
    spool = opened()
    put(spool, make())
    spool.close()
    assert reopened(opened, root) == {}
    (root / 'index.db').unlink()
    assert reopened(opened, root) == {'files adopted': 1}


@pytest.mark.parametrize('logs', [(), ('-wal', '-shm')])
def test_an_index_that_is_replaced_in_use(opened: Open, root: Path, logs: tuple[str, ...]) -> None:
    """Who has it open can write no more, and is told to start again; another process goes on beside it, and nothing is lost."""
    first = opened()
    put(first, make('old'))
    (root / 'index.db').rename(root / 'index.db.damaged-1')
    for end in logs:
        (root / f'index.db{end}').unlink()
    (root / 'index.db').touch()
    second = opened()
    with pytest.raises(sqlite3.DatabaseError, match='deleted or replaced'):
        put(first, make('late'))
    (new,) = put(second, make('new'))
    assert first._session is not None
    assert second._session is not None
    assert first._session.number != second._session.number
    assert new.id > 1000
    with pytest.raises(SpoolError, match='restart'):
        first.close()
    first.close()
    put(second, make('newer'))
    second.close()
    spool = opened()
    assert {item.key for item in spool.pending(9)} == {'old', 'new', 'newer'}
    assert not list((root / 'incoming').iterdir())
    assert_whole(root)


@pytest.mark.parametrize('logs', [(), ('-wal',), ('-shm',), ('-wal', '-shm')])
def test_an_index_that_is_deleted_in_use(opened: Open, root: Path, logs: tuple[str, ...]) -> None:
    """The next commit of a process that has it open puts it back with all that it knew; the others go on with the copy."""
    first, second = opened(), opened()
    (old,) = put(first, make('old'))
    put(second, make('beside', topic='/beside'))
    settle(first, old, State.DELIVERED)
    for end in ('', *logs):
        (root / f'index.db{end}').unlink()
    put(first, make('new', b'new'))
    put(second, make('newer', b'newer', topic='/beside'))
    first.close()
    second.close()
    found = assert_whole(root)
    assert {row['key']: row['state'] for row in rows(root)} == {
        'old': 'delivered', 'beside': 'pending', 'new': 'pending', 'newer': 'pending'
    }  # fmt: skip
    assert (found['topics']['/camera']['received'], found['topics']['/beside']['received']) == (2, 2)
    assert not opened().recovery.found_anything


def test_a_start_waits_for_an_index_that_was_deleted(opened: Open, root: Path) -> None:
    """A process that lives puts it back within a second or so, and the one that starts finds the accounts."""
    first = opened()
    put(first, make('old'))
    (root / 'index.db').unlink()
    with ThreadPoolExecutor() as pool:
        second = pool.submit(opened)
        put(first, make('new'))
        assert not second.result().recovery.found_anything
    assert {row['key'] for row in rows(root)} == {'old', 'new'}
