"""Files without rows: a lost or damaged index is rebuilt; foreign files are adopted or set aside."""

from __future__ import annotations

import errno
import json
import os
import random
import shutil
import sqlite3
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from profiles import examples
from spool import rotting
from spool.conftest import Open
from spool.making import BUCKET, KEY, READY, FakeClock, assert_whole, files, make, put, reopened, rows, settle

from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import State
from shadowhound_data_logger.spool import adoption
from shadowhound_data_logger.spool import files as files_module
from shadowhound_data_logger.spool.files import ATTRIBUTE, Tree
from shadowhound_data_logger.spool.schema import SCHEMA_VERSION

ROUNDS = examples(40)


@pytest.fixture(scope='module')
def base(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, bytes]]:
    """The spool of a killed process, and the content of each of its objects."""
    root = tmp_path_factory.mktemp('base') / 'spool'
    return root, rotting.new_base(root)


@pytest.mark.sampled
@pytest.mark.parametrize('part', range(4))
def test_after_random_damage_nothing_damaged_is_sent_and_nothing_intact_is_lost(
    base: tuple[Path, dict[str, bytes]], tmp_path: Path, part: int
) -> None:
    """After any damage startup works, damaged objects are not shipped, intact ones are, and the ledger balances or reports it."""
    root, bodies = base
    for seed in range(part, ROUNDS, 4):
        rotten = rotting.rot(root, tmp_path / 'rotten', random.Random(seed))
        try:
            rotting.check(rotten, bodies)
        except Exception as error:
            raise AssertionError(f'seed {seed}: {rotten.done}') from error
        shutil.rmtree(rotten.root)


def test_damage_is_detected_before_the_put(opened: Open, root: Path) -> None:
    """A flipped bit in a file of the correct size is found before it is sent: the object is quarantined as damaged."""
    spool = opened()
    put(spool, make('good', b'good'), make('bad', b'bad'))
    (root / READY / 'bad').write_bytes(b'bae')
    assert rotting.ship(spool) == {'good': b'good'}
    assert {row['key']: (row['state'], row['reason']) for row in rows(root)} == {
        'good': ('delivered', None), 'bad': ('quarantined', 'damaged'),
    }  # fmt: skip
    assert files(root) == {'quarantine/damaged/sensor-data/bad': b'bae'}


@pytest.mark.parametrize('held', [None, 'clock'])
def test_a_committed_part_survives_the_loss_of_the_index(opened: Open, root: Path, held: str | None) -> None:
    """An object that is committed but not yet in its place is restored from its file's description."""
    spool = opened()
    put(spool, make('a/part', b'part', held=held))
    spool.close()
    (path,) = (root / name for name in files(root))
    os.replace(path, root / 'incoming/1.part')
    (root / 'incoming/2.part').write_bytes(b'of no description')
    (root / 'index.db').unlink()
    spool = opened()
    assert dict(spool.recovery.counts) == {'files adopted': 1, 'uncommitted parts removed': 1}
    (row,) = rows(root)
    assert (row['key'], row['state'], row['reason']) == ('a/part', 'held' if held else 'pending', held)
    assert list(files(root).values()) == [b'part']


def test_a_truncated_part_is_not_adopted(opened: Open, root: Path) -> None:
    """A part that differs from its own description was not committed."""
    spool = opened()
    put(spool, make('a/part', b'part'))
    spool.close()
    os.replace(root / READY / 'a/part', root / 'incoming/1.part')
    os.truncate(root / 'incoming/1.part', 2)
    (root / 'index.db').unlink()
    assert dict(opened().recovery.counts) == {'uncommitted parts removed': 1}


def test_a_damaged_row_does_not_stop_delivery(opened: Open, root: Path) -> None:
    """Damage inside a row, which SQLite cannot see, does not stop the delivery of others: the index is rebuilt."""
    spool = opened()
    put(spool, make('a'), make('b'))
    with spool._connections.writing.transaction():
        spool._connections.writing._db.execute("UPDATE objects SET metadata = '{\"sha' WHERE key = 'a'")
    spool.close()
    spool = opened()
    assert spool.recovery.counts['damaged index rebuilt'] == 1
    assert {item.key for item in spool.pending(9)} == {'a', 'b'}


def test_an_unbalanced_ledger_is_reported(opened: Open, root: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A total damaged in the index is reported at every start, and has no other effect."""
    spool = opened()
    put(spool, make('a'))
    with spool._connections.writing.transaction():
        spool._connections.writing._db.execute("UPDATE tally SET samples = samples + 1 WHERE state = 'pending'")
    spool.close()
    spool = opened()
    assert dict(spool.recovery.counts) == {'sums of the ledger that do not balance': 1}
    assert 'stored 1, but in objects there are 2' in caplog.text
    assert [item.key for item in spool.pending(9)] == ['a']


@pytest.mark.parametrize('kind', ['file', 'folder', 'link'])
def test_anything_at_the_path_of_a_part_is_set_aside(opened: Open, root: Path, tmp_path: Path, kind: str) -> None:
    """Anything at the path of the next part is set aside, not overwritten, and stops no commit."""
    outside = tmp_path / 'outside'
    outside.write_bytes(b'theirs')
    spool = opened()
    part = Tree(root).part(1)
    if kind == 'file':
        part.write_bytes(b'theirs')
    elif kind == 'folder':
        part.mkdir()
        (part / 'inner').write_bytes(b'theirs')
    else:
        part.symlink_to(outside)
    (item,) = put(spool, make('a', b'ours'))
    assert item.path.read_bytes() == b'ours'
    assert outside.read_bytes() == b'theirs'
    aside = root / 'foreign/incoming/1.part'
    assert (aside / 'inner' if kind == 'folder' else aside).read_bytes() == b'theirs'
    assert {row['state'] for row in rows(root)} == {State.PENDING.value}


def test_links_are_not_followed(opened: Open, root: Path, used: dict[str, bytes], tmp_path: Path) -> None:
    """Links to files and folders, also in place of an object, are neither adopted nor read, and are not changed."""
    outside = tmp_path / 'outside'
    outside.mkdir()
    (outside / 'secret').write_bytes(b'2')
    (root / READY / 'thor/a/2.jpg').unlink()
    (root / READY / 'thor/a/2.jpg').symlink_to(outside / 'secret')
    (root / READY / 'thor/link.jpg').symlink_to(outside / 'secret')
    (root / READY / 'thor/folder').symlink_to(outside)
    (root / READY / 'thor/dangling').symlink_to('nowhere')
    (root / 'incoming/77.part').symlink_to(outside / 'secret')
    assert reopened(opened, root) == {'files missing': 1}
    assert (outside / 'secret').read_bytes() == b'2'
    assert (root / READY / 'thor/link.jpg').is_symlink()


@pytest.mark.parametrize('name', [
    f'{READY}/a b.jpg'.encode(), f'{READY}/\xff\xfe.jpg'.encode('latin-1'), f'{READY}/new\nline'.encode(),
    f'{READY}/{"x" * 230}'.encode(), f'{READY}/ü.jpg'.encode(), b'ready/..bucket/a', b'ready/ bucket/a',
    f'held/clock/{BUCKET}/$(rm)'.encode(), f'quarantine/x/{BUCKET}/%00'.encode(),
])  # fmt: skip
def test_files_with_names_that_cannot_be_keys_are_set_aside(
    opened: Open, root: Path, used: dict[str, bytes], name: bytes
) -> None:
    """A file that cannot be an object is set aside without deleting or overwriting anything."""
    for content in (b'first', b'second'):
        path = Path(os.fsdecode(os.fsencode(root) + b'/' + name))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        assert reopened(opened, root) == {'foreign files set aside': 1}
    assert {b'first', b'second'} <= set(files(root).values())


def test_files_outside_the_buckets_are_left_alone(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """Foreign files next to the buckets, with foreign names in incoming, or that are not regular files, are ignored."""
    (root / 'ready/README').write_text('mine')
    (root / 'held/clock.txt').write_text('mine')
    (root / 'incoming/notes.txt').write_text('mine')
    (root / 'incoming' / f'{"9" * 40}.part').write_text('mine')
    (root / 'incoming/5.part').mkdir()
    os.mkfifo(root / READY / 'pipe')
    spool = opened()
    assert not spool.recovery.found_anything
    assert (root / 'incoming/notes.txt').exists()
    assert (root / 'ready/README').exists()


def test_a_file_copied_by_hand_is_adopted(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """A file without a description is adopted as an object of no topic, and shipped."""
    (root / READY / 'thor/copied.bin').write_bytes(b'copied')
    assert reopened(opened, root) == {'files adopted': 1}
    spool = opened()
    (item,) = (item for item in spool.pending(99) if item.key == 'thor/copied.bin')
    assert item.path.read_bytes() == b'copied'


@pytest.mark.parametrize('attribute', [
    b'\xff\xfe', b'[]', b'{', b'[' * 50_000, b'{"topic": ["a"], "samples": "many", "metadata": 5}',
    b'{"sha256": ["a"], "priority": 99999999999999999999, "samples": -1}',
    b'{"t_start_ns": 1e999, "samples": 1e3, "protected": "yes", "sensor": null, "metadata": {"a": {}}}',
    b'{"type": "\\ud800", "topic": "/a\\u0000"}',
])  # fmt: skip
def test_a_file_with_an_implausible_description_is_adopted_without_it(
    opened: Open, root: Path, used: dict[str, bytes], attribute: bytes
) -> None:
    """Implausible values in a file's description are ignored."""
    path = root / READY / 'thor/odd.bin'
    path.write_bytes(b'odd')
    try:
        os.setxattr(path, ATTRIBUTE, attribute)
    except OSError:
        os.setxattr(path, ATTRIBUTE, attribute[:3000])
    assert reopened(opened, root) == {'files adopted': 1}
    (row,) = (row for row in rows(root) if row['key'] == 'thor/odd.bin')
    assert (row['samples'], row['topic'], row['protected'], row['priority'] <= 9) == (0, None, 0, True)


def test_a_file_with_other_content_is_not_adopted(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """Content that differs from its own description is not adopted as intact."""
    path = root / READY / 'thor/odd.bin'
    path.write_bytes(b'changed')
    os.setxattr(path, ATTRIBUTE, json.dumps({'sha256': '0' * 64}).encode())
    assert reopened(opened, root) == {'foreign files set aside': 1}


def test_an_unreadable_file_stops_nothing(
    opened: Open, root: Path, used: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An unreadable file of another user is left in place."""
    path = root / READY / 'thor/theirs.bin'
    path.write_bytes(b'x')
    open_file = Path.open

    def refuse(file: Path, *arguments: object, **more: object) -> object:
        if file == path:
            raise PermissionError(errno.EACCES, 'Permission denied')
        return open_file(file, *arguments, **more)

    with monkeypatch.context() as patch:
        patch.setattr(Path, 'open', refuse)
        spool = opened()
    assert dict(spool.recovery.counts) == {'unreadable files left alone': 1}
    assert path.exists()


def test_files_set_aside_never_overwrite_others(root: Path) -> None:
    """Setting the same path aside again keeps both files."""
    tree = Tree(root)
    tree.create()
    for content in (b'1', b'2', b'3'):
        path = root / 'ready' / BUCKET / KEY
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        tree.set_aside(path)
    assert set(files(root).values()) == {b'1', b'2', b'3'}


@pytest.mark.parametrize('damage', ['deleted', 'garbage', 'empty', 'half', 'zeroed pages', 'header', 'version 0'])
def test_a_lost_index_is_rebuilt_from_the_files(opened: Open, root: Path, used: dict[str, bytes], damage: str) -> None:
    """Every object in the spool is known again, with its description."""
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
    """A second damaged index is set aside next to the first."""
    for number in (1, 2):
        (root / 'index.db').write_bytes(b'garbage' * 1000)
        opened().close()
        assert (root / f'index.db.damaged-{number}').read_bytes() == b'garbage' * 1000


def test_many_files_are_adopted_in_groups(opened: Open, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A rebuild of more files than one group adopts all of them."""
    monkeypatch.setattr(adoption, 'GROUP_FILES', 3)
    spool = opened()
    put(spool, *(make(f'{number}') for number in range(10)))
    spool.close()
    (root / 'index.db').unlink()
    assert reopened(opened, root)['files adopted'] == 10
    assert assert_whole(root)['topics']['/camera']['stored'] == 11


def test_rebuilt_indexes_give_out_different_numbers(opened: Open, root: Path, clock: FakeClock) -> None:
    """A process that still uses the old index may be about to use one of its numbers for a part."""
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


def test_a_lost_write_ahead_log_costs_no_file(opened: Open, root: Path) -> None:
    """If the index reverts to an earlier state, files written since are adopted again."""
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


def test_a_truncated_write_ahead_log_is_accepted(opened: Open, root: Path) -> None:
    """The spool starts with a log that a power cut truncated."""
    spool = opened()
    put(spool, make('old'))
    put(spool, make('new', b'new'))
    state = {name: (root / name).read_bytes() for name in ('index.db', 'index.db-wal')}
    spool.close()
    (root / 'index.db').write_bytes(state['index.db'])
    (root / 'index.db-wal').write_bytes(state['index.db-wal'][:-5000])
    reopened(opened, root)
    assert {row['key'] for row in rows(root) if row['state'] == 'pending'} == {'old', 'new'}


def test_an_index_of_a_newer_version_is_refused(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """The index of a newer program is refused and not changed."""
    with sqlite3.connect(root / 'index.db') as connection:
        connection.executescript(f'CREATE TABLE newer (id); PRAGMA user_version = {SCHEMA_VERSION + 1}')
    connection.close()
    with pytest.raises(SpoolError, match=rf'version {SCHEMA_VERSION + 1}.*update shadowhound_data_logger'):
        opened()
    assert not (root / 'index.db.damaged-1').exists()
    assert files(root) == used


def test_a_locked_index_is_not_damaged(opened: Open, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An index locked by another program raises an error, and is not rebuilt."""
    opened().close()
    monkeypatch.setattr('shadowhound_data_logger.spool.index.BUSY_TIMEOUT_S', 0.05)
    connection = sqlite3.connect(root / 'index.db', isolation_level=None)
    connection.execute('BEGIN EXCLUSIVE')
    with pytest.raises(SpoolError, match='locked'):
        opened()
    connection.close()
    assert not (root / 'index.db.damaged-1').exists()


def test_a_rebuilt_key_is_not_given_out_again(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """After a rebuild new objects get keys different from those in the spool."""
    (root / 'index.db').unlink()
    assert put(opened(), make('thor/a/2.jpg', b'new'))[0].key == 'thor/a/2_1.jpg'
    assert_whole(root)


def test_the_same_key_in_two_folders_is_adopted_once(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """Two files of one key after a lost index: one becomes the object, the other is set aside."""
    (root / 'index.db').unlink()
    twin = root / f'quarantine/refused/{BUCKET}/thor/a/2.jpg'
    twin.write_bytes(b'twin')
    spool = opened()
    assert spool.recovery.counts['files adopted'] == 7
    assert spool.recovery.counts['foreign files set aside'] == 1
    assert (root / 'foreign' / twin.relative_to(root)).read_bytes() == b'twin'


@pytest.mark.parametrize('number', [errno.EACCES, errno.EIO, errno.ENOTSUP, errno.ENODATA])
def test_without_readable_attributes_files_are_adopted_by_name(
    opened: Open, root: Path, used: dict[str, bytes], monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """Without readable descriptions a rebuild has only the names and contents of the objects."""

    def fail(*_: Any) -> bytes:
        raise OSError(number, os.strerror(number))

    (root / 'index.db').unlink()
    monkeypatch.setattr(os, 'getxattr', fail)
    assert reopened(opened, root)['files adopted'] == 7
    assert files(root) == used


def test_the_spool_works_on_a_file_system_without_attributes(opened: Open, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If files cannot carry a description the spool works, and only a rebuild has less information."""

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
def test_an_index_replaced_while_in_use_loses_nothing(opened: Open, root: Path, logs: tuple[str, ...]) -> None:
    """Processes that have it open cannot write and are asked to restart; another process keeps working, and nothing is lost."""
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
def test_an_index_deleted_while_in_use_is_restored(opened: Open, root: Path, logs: tuple[str, ...]) -> None:
    """The next commit of a process that has it open restores it with all its rows; the others continue with the copy."""
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
    """A running process restores it within about a second, and the one that starts finds the accounts."""
    first = opened()
    put(first, make('old'))
    (root / 'index.db').unlink()
    with ThreadPoolExecutor() as pool:
        second = pool.submit(opened)
        put(first, make('new'))
        assert not second.result().recovery.found_anything
    assert {row['key'] for row in rows(root)} == {'old', 'new'}
