"""What a start finds: damaged indexes, missing, foreign and hostile files. It never fails, and the ledger closes after it."""

from __future__ import annotations

import errno
import json
import os
import random
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from spool.conftest import Open
from spool.making import BUCKET, KEY, NOON_NS, FakeClock, assert_whole, files, make, new_spool, put, receive, rows, settle

from shadowhound_data_logger.errors import SpoolError
from shadowhound_data_logger.model import State
from shadowhound_data_logger.spool import adoption
from shadowhound_data_logger.spool import files as files_module
from shadowhound_data_logger.spool.files import ATTRIBUTE, Tree
from shadowhound_data_logger.spool.spool import Spool

READY = f'ready/{BUCKET}'


@pytest.fixture
def used(opened: Open, root: Path) -> dict[str, bytes]:
    """A closed spool with objects in every state; returns its files."""
    spool = opened()
    items = put(spool, *(make(f'thor/a/{number}.jpg', b'%d' % number, samples=2, priority=number) for number in range(6)))
    put(spool, make('thor/held.jpg', b'held', held='clock'), make('thor/book.json', b'{}', topic=None, protected=True))
    settle(spool, items[0], State.DELIVERED)
    settle(spool, items[1], State.QUARANTINED, 'refused')
    spool.close()
    return files(root)


def reopened(opened: Open, root: Path) -> dict[str, int]:
    """Open, check that all is whole and that a commit and a delivery work, close; returns what recovery did."""
    spool = opened()
    assert_whole(root)
    (item,) = put(spool, make('thor/after.jpg'))
    assert item in spool.pending(99)
    settle(spool, item, State.DELIVERED)
    assert_whole(root)
    spool.close()
    again = opened()
    assert not set(again.recovery.counts) - {'unreadable files left alone'}, 'what was repaired stays repaired'
    again.close()
    return dict(+spool.recovery.counts)


def test_nothing_to_do_after_a_clean_stop(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """A clean stop leaves nothing to recover and every file where it was."""
    assert reopened(opened, root) == {}
    assert files(root) == used


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


def test_a_lost_write_ahead_log(opened: Open, root: Path) -> None:
    """When the index goes back in time, the files written since are adopted again."""
    spool = opened()
    put(spool, make('old'))
    spool._index.db.execute('PRAGMA wal_checkpoint(TRUNCATE)')
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


def test_flipped_bits_in_the_index(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """With bits flipped anywhere in the index a start works, no file is lost, and objects can be added and delivered."""
    path = root / 'index.db'
    whole = path.read_bytes()
    rng = random.Random(5)
    rebuilt = 0
    used_bytes = [place for place, byte in enumerate(whole) if byte]
    for number in range(120):
        flipped = bytearray(whole)
        for _ in range(rng.choice((1, 1, 3, 30))):
            flipped[rng.choice(used_bytes)] ^= 1 << rng.randrange(8)
        for name in [*files(root), 'index.db-wal', 'index.db-shm']:
            (root / name).unlink(missing_ok=True)
        for name, body in used.items():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_bytes(body)
        path.write_bytes(flipped)
        spool = new_spool(root)
        spool.open()
        try:
            use(spool, number)
        except sqlite3.DatabaseError:  # seen in use only: the process ends, and the next start looks closer
            abandon(spool)
            spool = new_spool(root)
            spool.open()
            assert spool.recovery.counts['damaged index rebuilt']
            use(spool, number)
        spool.close()
        assert set(files(root).values()) >= set(used.values())
        rebuilt += spool.recovery.counts['damaged index rebuilt']
        if spool.recovery.counts['damaged index rebuilt']:
            assert_whole(root)
    assert rebuilt > 20


def use(spool: Spool, number: int) -> None:
    """Add and deliver an object."""
    (item,) = put(spool, make(f'thor/after/{number}.jpg', topic='/other'))
    settle(spool, item, State.DELIVERED)


def abandon(spool: Spool) -> None:
    """Leave a spool as a process that dies does."""
    spool._index.close()
    assert spool._session_lock is not None
    os.close(spool._session_lock)


def test_an_index_of_a_newer_version(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """A newer program's index is refused and left as it is."""
    with sqlite3.connect(root / 'index.db') as connection:
        connection.execute('PRAGMA user_version = 2')
    connection.close()
    with pytest.raises(SpoolError, match=r'version 2.*update shadowhound_data_logger'):
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


@pytest.mark.parametrize('content', [b'', b'x', b'longer than it was'])
def test_a_file_of_another_size(opened: Open, root: Path, used: dict[str, bytes], content: bytes) -> None:
    """A cut file is quarantined as damaged."""
    (root / READY / 'thor/a/2.jpg').write_bytes(content * 3)
    assert reopened(opened, root) == {'files damaged': 1}
    assert (root / f'quarantine/damaged/{BUCKET}/thor/a/2.jpg').read_bytes() == content * 3


def test_a_missing_file(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """An object whose file is gone is quarantined as missing, once."""
    (root / READY / 'thor/a/2.jpg').unlink()
    (root / f'held/clock/{BUCKET}/thor/held.jpg').unlink()
    (root / f'quarantine/refused/{BUCKET}/thor/a/1.jpg').unlink()
    assert reopened(opened, root) == {'files missing': 3}
    assert assert_whole(root)['objects']['quarantined'] == 3


@pytest.mark.parametrize('where', [READY, f'quarantine/missing/{BUCKET}'])
def test_a_missing_file_that_comes_back(opened: Open, root: Path, used: dict[str, bytes], where: str) -> None:
    """A file that was moved away and back is delivered after all; another one in its place is set aside."""
    paths = [root / READY / f'thor/a/{number}.jpg' for number in (2, 3)]
    for path in paths:
        path.unlink()
    opened().close()
    for path, content in zip(paths, (b'2', b'forged'), strict=True):
        back = root / where / path.relative_to(root / READY)
        back.parent.mkdir(parents=True, exist_ok=True)
        back.write_bytes(content)
    assert reopened(opened, root) == {'missing files back': 1, 'foreign files set aside': 1}
    assert [row['key'] for row in rows(root) if row['reason'] == 'missing'] == ['thor/a/3.jpg']
    assert paths[0].read_bytes() == b'2'
    assert b'forged' in files(root).values()


@pytest.mark.parametrize('empty', [True, False])
def test_a_folder_where_a_file_was(opened: Open, root: Path, used: dict[str, bytes], empty: bool) -> None:
    """A folder in an object's place leaves the object missing, and what lies in it is adopted."""
    path = root / READY / 'thor/a/2.jpg'
    path.unlink()
    path.mkdir()
    if not empty:
        (path / 'inner.jpg').write_bytes(b'inner')
    assert reopened(opened, root) == {'files missing': 1} | ({} if empty else {'files adopted': 1})


def test_a_folder_in_the_way_of_a_part(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """A part whose place is taken is shipped from where it is."""
    (row,) = (row for row in rows(root) if row['key'] == 'thor/a/2.jpg')
    path = root / READY / 'thor/a/2.jpg'
    os.replace(path, root / 'incoming' / f'{row["id"]}.part')
    path.mkdir()
    (path / 'inner.jpg').write_bytes(b'inner')
    spool = opened()
    (found,) = (item for item in spool.pending(99) if item.key == row['key'])
    assert found.path.read_bytes() == b'2'
    settle(spool, found, State.DELIVERED)
    assert_whole(root)


def test_links_are_not_followed(opened: Open, root: Path, used: dict[str, bytes], tmp_path: Path) -> None:
    """Links to files and folders are neither adopted nor read, also in an object's place, and are left alone."""
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
def test_names_that_cannot_be_keys(opened: Open, root: Path, used: dict[str, bytes], name: bytes) -> None:
    """A file that cannot be an object is set aside, not deleted, and over nothing."""
    for content in (b'first', b'second'):
        path = Path(os.fsdecode(os.fsencode(root) + b'/' + name))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        assert reopened(opened, root) == {'foreign files set aside': 1}
    assert {b'first', b'second'} <= set(files(root).values())


def test_files_outside_the_buckets_are_left_alone(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """What lies beside the buckets, in incoming under a foreign name or is no file is nobody's object."""
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


def test_parts_of_no_row(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """A part that was never committed is removed."""
    (root / 'incoming/4711.part').write_bytes(b'x')
    assert reopened(opened, root) == {'uncommitted parts removed': 1}


def test_a_file_copied_in_by_hand(opened: Open, root: Path, used: dict[str, bytes]) -> None:
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
def test_a_description_that_makes_no_sense(opened: Open, root: Path, used: dict[str, bytes], attribute: bytes) -> None:
    """Of what a file says of itself only what makes sense is believed."""
    path = root / READY / 'thor/odd.bin'
    path.write_bytes(b'odd')
    try:
        os.setxattr(path, ATTRIBUTE, attribute)
    except OSError:
        os.setxattr(path, ATTRIBUTE, attribute[:3000])
    assert reopened(opened, root) == {'files adopted': 1}
    (row,) = (row for row in rows(root) if row['key'] == 'thor/odd.bin')
    assert (row['samples'], row['topic'], row['protected'], row['priority'] <= 9) == (0, None, 0, True)


def test_a_file_that_is_not_what_it_says(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """Content that differs from its own description is not adopted as if it were whole."""
    path = root / READY / 'thor/odd.bin'
    path.write_bytes(b'changed')
    os.setxattr(path, ATTRIBUTE, json.dumps({'sha256': '0' * 64}).encode())
    assert reopened(opened, root) == {'foreign files set aside': 1}


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


def test_a_file_that_may_not_be_read(opened: Open, root: Path, used: dict[str, bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody else's unreadable file is left where it is."""
    path = root / READY / 'thor/theirs.bin'
    path.write_bytes(b'x')
    read_bytes = Path.read_bytes

    def refuse(file: Path) -> bytes:
        if file == path:
            raise PermissionError(errno.EACCES, 'Permission denied')
        return read_bytes(file)

    with monkeypatch.context() as patch:
        patch.setattr(Path, 'read_bytes', refuse)
        spool = opened()
    assert dict(spool.recovery.counts) == {'unreadable files left alone': 1}
    assert path.exists()


def test_a_rebuilt_key_is_not_given_out_again(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """After a rebuild new objects get other keys than those in the spool."""
    (root / 'index.db').unlink()
    assert put(opened(), make('thor/a/2.jpg', b'new'))[0].key == 'thor/a/2_1.jpg'
    assert_whole(root)


def test_the_same_key_in_two_folders(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """Two files of one key after a lost index: one becomes the object, the other stays where it is."""
    (root / 'index.db').unlink()
    twin = root / f'quarantine/refused/{BUCKET}/thor/a/2.jpg'
    twin.write_bytes(b'twin')
    spool = opened()
    assert spool.recovery.counts['files adopted'] == 7
    assert twin.read_bytes() == b'twin'


def test_open_messages_of_a_dead_session(root: Path, opened: Open) -> None:
    """What a session had received without an outcome when it died is dropped by restart, for each topic."""
    dead = new_spool(root, FakeClock())
    dead.open()
    receive(dead, 5)
    dead.commit([make(samples=2)])
    abandon(dead)
    spool = opened()
    assert spool.recovery.describe() == '3 messages lost with an open batch'
    topic = assert_whole(root)['topics']['/camera']
    assert (topic['dropped'], topic['open']) == ({'restart': 3}, 0)


def test_a_clock_that_went_back(opened: Open, root: Path, clock: FakeClock, used: dict[str, bytes]) -> None:
    """A start with a clock before all that is in the spool changes nothing."""
    clock.now_ns = NOON_NS // 100
    assert reopened(opened, root) == {}


def test_empty_folders_go(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """Folders of past days that are empty are removed, the spool's own are not."""
    (root / READY / 'thor/camera/20200101').mkdir(parents=True)
    opened().close()
    assert not (root / READY / 'thor/camera').exists()
    assert all((root / name).is_dir() for name in ('ready', 'held', 'quarantine', 'incoming'))


def test_a_place_never_overwrites_in_foreign(root: Path) -> None:
    """Setting the same path aside again keeps both files."""
    tree = Tree(root)
    tree.create()
    for content in (b'1', b'2', b'3'):
        path = root / 'ready' / BUCKET / KEY
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        tree.set_aside(path)
    assert set(files(root).values()) == {b'1', b'2', b'3'}


def test_what_is_moved_back_from_quarantine_is_tried_again(opened: Open, root: Path, used: dict[str, bytes]) -> None:
    """An operator who moves a quarantined file to ready, as the README says, has it delivered."""
    source = root / f'quarantine/refused/{BUCKET}/thor/a/1.jpg'
    source.rename(root / f'ready/{BUCKET}/thor/a/1.jpg')
    spool = opened()
    assert spool.recovery.counts['quarantined files to be tried again'] == 1
    assert 'thor/a/1.jpg' in {item.key for item in spool.pending(99)}
    assert_whole(root)
