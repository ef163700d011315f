from __future__ import annotations

import errno
import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from spool.conftest import Moments, Open
from spool.making import BUCKET, FakeClock, abandon, assert_whole, files, make, new_spool, put, rows, settle

from shadowhound_data_logger.core.model import DataObject, FileBody, State
from shadowhound_data_logger.spool.files import Tree
from shadowhound_data_logger.spool.spool import Spool
from shadowhound_data_logger.spool.writer import SpoolWriter

KEY = 'thor/rosbags/patrol/patrol_0.mcap'
CONTENT = b'slice' * 1000
SHA256 = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A finished file next to the spool."""
    path = tmp_path / 'bags' / 'patrol_0.mcap'
    path.parent.mkdir()
    path.write_bytes(CONTENT)
    return path


def sliced(source: Path, **fields: object) -> DataObject:
    """An object with the file as its content."""
    return make(**{'key': KEY, 'body': FileBody(source, len(CONTENT), SHA256), 'topic': None, **fields})


def test_a_file_is_linked_not_copied(spool: Spool, root: Path, source: Path) -> None:
    """The same inode is under its final name, with a description, and its source is removed."""
    inode = source.stat().st_ino
    (item,) = put(spool, sliced(source, metadata={'bag': 'patrol'}))
    assert (item.size, item.sha256, item.key) == (len(CONTENT), SHA256, KEY)
    assert item.path.stat().st_ino == inode
    assert not source.exists()
    assert item.metadata.items() >= {'bag': 'patrol', 'sha256': SHA256}.items()
    assert spool.pending(1) == [item]
    assert_whole(root)
    settle(spool, item, State.DELIVERED)
    assert files(root) == {}


def test_a_file_is_not_read_under_the_lock(opened: Open, root: Path, source: Path) -> None:
    """A file of hundreds of megabytes takes no longer to commit than a small one: its content is not read."""
    spool = opened(max_bytes=1 << 50)
    with source.open('ab') as file:
        file.truncate(8 << 40)  # sparse: reading it would take hours
    (item,) = put(spool, sliced(source, body=FileBody(source, 8 << 40, SHA256)))
    assert item.path.stat().st_size == 8 << 40
    assert rows(root)[0]['bytes'] == 8 << 40


@pytest.mark.parametrize('code', [errno.EXDEV, errno.EPERM])
def test_a_file_that_cannot_be_linked_is_copied(
    spool: Spool, root: Path, source: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    """A file from another file system, or one without hard links, is copied before the spool's lock is taken."""

    def refuse(*_: object) -> None:
        assert not spool._connections.lock.locked()
        raise OSError(code, 'no link')

    monkeypatch.setattr(os, 'link', refuse)
    (item,) = put(spool, sliced(source))
    assert item.path.read_bytes() == CONTENT
    assert not source.exists()
    assert_whole(root)


def test_a_commit_that_fails_leaves_the_source(spool: Spool, root: Path, source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing of it stays in the spool, and the same commit works later."""
    item = sliced(source)

    def fail() -> None:
        raise OSError(errno.EIO, 'fails')

    with monkeypatch.context() as broken:
        broken.setattr(spool._tree, 'sync_incoming', fail)
        with pytest.raises(OSError, match='fails'):
            spool.commit([item])
    assert source.read_bytes() == CONTENT
    assert files(root) == {}
    (spooled,) = spool.commit([item])
    assert spooled.path.read_bytes() == CONTENT
    assert_whole(root)


def test_a_file_survives_a_transaction_that_needs_the_ballast(
    spool: Spool, root: Path, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the disk was full after the file was taken, the second try takes the same file."""
    put(spool, make('thor/first.jpg'))
    assert (root / 'ballast').stat().st_size
    take_part, full = Tree.take_part, [OSError(errno.ENOSPC, 'full')]

    def fails_once(tree: Tree, number: int, body: Path, said: Mapping[str, Any] | None) -> None:
        take_part(tree, number, body, said)
        if full:
            raise full.pop()

    monkeypatch.setattr(Tree, 'take_part', fails_once)
    (item,) = put(spool, sliced(source))
    assert item.path.read_bytes() == CONTENT
    assert {row['state'] for row in rows(root)} == {'pending'}
    assert not list((root / 'incoming').iterdir())
    assert_whole(root)


def test_a_removed_source_is_missing(spool: Spool, root: Path, source: Path) -> None:
    """It is quarantined in the ledger, and does not block the objects committed with it."""
    source.unlink()
    (other,) = put(spool, sliced(source), make('thor/other.jpg'))
    assert other.key == 'thor/other.jpg'
    assert {row['key']: (row['state'], row['reason']) for row in rows(root)} == {
        KEY: ('quarantined', 'missing'), 'thor/other.jpg': ('pending', None)}  # fmt: skip
    assert_whole(root)
    assert not spool.reading.objects.knows(BUCKET, KEY, SHA256)


def test_a_file_without_room_is_given_up(opened: Open, root: Path, source: Path) -> None:
    """It is evicted along with its source; a protected one is added anyway."""
    spool = opened(max_bytes=len(CONTENT) - 1)
    assert put(spool, sliced(source)) == []
    assert not source.exists()
    assert [row['state'] for row in rows(root)] == ['evicted']
    source.write_bytes(CONTENT)
    (item,) = put(spool, sliced(source, protected=True))
    assert item.path.read_bytes() == CONTENT
    assert_whole(root)


def test_a_linked_file_needs_no_free_space(opened: Open, root: Path, source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is already on the disk: only the quota counts it, not the minimum of free space."""
    spool = opened(min_free_bytes=1 << 20, max_bytes=1 << 50)
    monkeypatch.setattr(spool._tree, 'free_bytes', lambda: (1 << 20) + 16_384)
    (item,) = put(spool, sliced(source, body=FileBody(source, 1 << 40, SHA256)))
    assert item.size == 1 << 40


def test_content_under_a_key_is_known(spool: Spool, source: Path) -> None:
    """The spool knows the content of each key, also when the key got a number, and after delivery."""
    assert not spool.reading.objects.knows(BUCKET, KEY, SHA256)
    put(spool, make(KEY, b'a foreign writer'))
    assert not spool.reading.objects.knows(BUCKET, KEY, SHA256)
    (item,) = put(spool, sliced(source))
    assert item.key.endswith('_1.mcap')
    assert spool.reading.objects.knows(BUCKET, KEY, SHA256)
    assert not spool.reading.objects.knows('trajectories', KEY, SHA256)
    settle(spool, item, State.DELIVERED)
    assert spool.reading.objects.knows(BUCKET, KEY, SHA256)


def test_a_kill_at_any_moment_of_taking_a_file_loses_nothing(tmp_path: Path, root: Path, moments: Moments) -> None:
    """The source exists or the spool has the object, and no incomplete file exists anywhere."""
    new_spool(root).open()

    def work() -> None:
        source = root / 'bag.mcap'
        source.write_bytes(CONTENT)
        spool = new_spool(root)
        spool.open()
        put(spool, sliced(source))
        spool.close()

    seen = set()
    for copy in moments(work):
        source = copy / 'bag.mcap'
        has_source = source.exists() and source.read_bytes() == CONTENT
        spool = new_spool(copy)
        spool.open()
        assert_whole(copy)
        known = spool.reading.objects.knows(BUCKET, KEY, SHA256)
        assert not (copy / 'incoming').exists() or not list((copy / 'incoming').iterdir())
        seen.add((has_source, known))
        spool.close()
    assert seen - {(False, False)} == {(True, False), (True, True), (False, True)}


def test_the_copy_of_a_killed_process_is_removed(opened: Open, root: Path) -> None:
    """The copy of a running process is kept: it is about to be committed."""
    dead, alive = opened(), opened()
    assert dead._session is not None
    assert alive._session is not None
    for spool in (dead, alive):
        (root / 'incoming' / f'{spool._session.number}-{"a" * 32}.body').write_bytes(b'half')
    abandon(dead)
    dead._session = None
    again = opened()
    assert again.recovery.counts['files not committed'] == 1
    assert [path.name for path in (root / 'incoming').iterdir()] == [f'{alive._session.number}-{"a" * 32}.body']
    next((root / 'incoming').iterdir()).unlink()


def test_large_files_are_adopted_after_the_loss_of_the_index(opened: Open, root: Path, source: Path) -> None:
    """They are hashed in pieces, and match their descriptions."""
    spool = opened()
    put(spool, sliced(source, priority=2, protected=True))
    spool.close()
    for path in root.glob('index.db*'):
        path.unlink()
    again = opened()
    (item,) = again.pending(9)
    assert (item.key, item.sha256, item.priority, item.size) == (KEY, SHA256, 2, len(CONTENT))
    assert_whole(root)


def test_files_take_no_memory_in_the_queue(root: Path, tmp_path: Path) -> None:
    """Encoders do not wait for the disk because of a queue of large files."""
    spool = new_spool(root, FakeClock())
    spool.open()
    writer = SpoolWriter(spool, 0.0)  # not open: the queue is not drained
    for number in range(3):
        path = tmp_path / f'{number}.mcap'
        path.write_bytes(CONTENT)
        writer.put(make(f'{number}', FileBody(path, 1 << 30, SHA256), topic=None))
    writer.put(make('small'))
    writer.open()
    assert writer.close(60)
    assert len(rows(root)) == 4
    spool.close()
