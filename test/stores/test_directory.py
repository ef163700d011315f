"""The directory store: its layout, its durability, and the errors of a file system."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from stores.spooled import QUICK, Spool

from shadowhound_data_logger.core.config import StoreSettings
from shadowhound_data_logger.core.errors import AccessDenied, ForeignObject, ObjectRefused, StoreError, StoreUnavailable
from shadowhound_data_logger.core.model import Put
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.directory import DirectoryStore


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / 'not' / 'yet' / 'store'


@pytest.fixture
def store(folder: Path) -> DirectoryStore:
    return DirectoryStore(folder)


def _failing(number: int) -> Callable[..., Any]:
    def fail(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    return fail


def test_without_an_endpoint_the_store_is_a_folder(folder: Path) -> None:
    """The defaults need no setting, and nothing is written before the first put."""
    store = open_store(StoreSettings(directory=folder), QUICK)
    assert store.describe() == f'the folder {folder}'
    assert not folder.exists()


def test_the_folder_is_laid_out_like_the_bucket(store: DirectoryStore, folder: Path, spool: Spool) -> None:
    """Next to a bucket's objects there is nothing that a sync or a glob would mistake for one, and no unfinished file."""
    store.put(spool('thor/camera/a.jpg', b'x', bucket='sensor-data'))
    files = {str(path.relative_to(folder)) for path in folder.rglob('*') if path.is_file()}
    assert files == {'sensor-data/thor/camera/a.jpg', '.metadata/sensor-data/thor/camera/a.jpg.json'}


def test_objects_interrupted_by_a_power_cut_are_completed(store: DirectoryStore, folder: Path, spool: Spool, bucket: str) -> None:
    """Content without metadata is recognized by its hash, and the next put adds the metadata."""
    item = spool('a', b'content')
    store.put(item)
    (folder / '.metadata' / bucket / 'a.json').unlink()
    held = store.head(bucket, 'a')
    assert held is not None
    assert held.sha256 is None
    assert store.put(item) is Put.IDENTICAL
    held = store.head(bucket, 'a')
    assert held is not None
    assert held.sha256 == item.sha256


def test_a_file_put_there_by_hand_is_never_overwritten(store: DirectoryStore, folder: Path, spool: Spool, bucket: str) -> None:
    """It has no metadata, but it has content."""
    (folder / bucket).mkdir(parents=True)
    (folder / bucket / 'a').write_bytes(b'by hand')
    with pytest.raises(ForeignObject):
        store.put(spool('a', b'by node'))
    assert (folder / bucket / 'a').read_bytes() == b'by hand'


def test_everything_is_synced_before_it_has_its_name(
    store: DirectoryStore, folder: Path, spool: Spool, bucket: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file is synced before the link, the folder after it: after a power cut an object is complete or missing."""
    events: list[str] = []
    sync, link = os.fsync, os.link

    def synced(descriptor: int) -> None:
        events.append('sync ' + Path(f'/proc/self/fd/{descriptor}').readlink().parent.name)
        sync(descriptor)

    def linked(source: Path, target: Path) -> None:
        events.append('link')
        link(source, target)

    store.put(spool('thor/first', b'x'))
    monkeypatch.setattr(os, 'fsync', synced)
    monkeypatch.setattr(os, 'link', linked)
    store.put(spool('thor/second', b'x'))
    assert events[:3] == ['sync .part', 'link', f'sync {bucket}']


@pytest.mark.parametrize(
    ('number', 'kind', 'words'),
    [
        (errno.ENOSPC, StoreUnavailable, 'no space left'),
        (errno.EDQUOT, StoreUnavailable, 'no space left'),
        (errno.EIO, StoreUnavailable, 'is the disk mounted'),
        (errno.EROFS, StoreUnavailable, 'is the disk mounted'),
        (errno.EACCES, AccessDenied, 'no permission'),
        (errno.ENAMETOOLONG, ObjectRefused, 'cannot hold'),
    ],
)
def test_errors_of_the_file_system_are_translated(
    number: int, kind: type[StoreError], words: str,
    store: DirectoryStore, spool: Spool, bucket: str, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """A full or failing disk is retried; no partial file is left, and later the same put succeeds."""
    item = spool('a', b'x')
    with monkeypatch.context() as broken:
        broken.setattr(os, 'fsync', _failing(number))
        with pytest.raises(kind, match=words):
            store.put(item)
        with pytest.raises(kind):
            store.probe()
    assert store.head(bucket, 'a') is None
    assert store.put(item) is Put.CREATED


def test_an_unusable_folder_quarantines_no_object(spool: Spool) -> None:
    """A wrong setting (the folder is a file, or below one) is retried, by put and by probe."""
    item = spool('a', b'x')
    for folder in (item.path, item.path / 'below'):
        store = DirectoryStore(folder)
        with pytest.raises(StoreUnavailable, match=str(folder)):
            store.put(item)
        with pytest.raises(StoreUnavailable, match=str(folder)):
            store.probe()


def test_an_object_is_no_folder_and_a_folder_no_object(store: DirectoryStore, spool: Spool) -> None:
    """A file system cannot hold both ``a`` and ``a/b``: the second is refused permanently."""
    store.put(spool('a/b', b'x'))
    for key in ('a', 'a/b/c'):
        with pytest.raises(ObjectRefused, match='cannot hold'):
            store.put(spool(key, b'y'))


def test_the_store_works_on_a_file_system_without_links(
    store: DirectoryStore, spool: Spool, bucket: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without hard links (exFAT) objects are still complete and never overwritten."""
    monkeypatch.setattr(os, 'link', _failing(errno.EPERM))
    assert store.put(spool('a', b'first')) is Put.CREATED
    with pytest.raises(ForeignObject):
        store.put(spool('a', b'other'))
    assert store.get(bucket, 'a') == b'first'
    assert store.put(spool('a', b'first')) is Put.IDENTICAL


@pytest.mark.parametrize('record', ['[]', '{}', '7', '{"metadata": 7, "content_type": ""}', '{"metadata": {}}', '[' * 100_000])
def test_an_invalid_record_is_ignored(store: DirectoryStore, spool: Spool, bucket: str, tmp_path: Path, record: str) -> None:
    """Whatever wrote it: the object has only its content, and can be listed, read and put again."""
    item = spool('a', b'first')
    store.put(item)
    (beside,) = tmp_path.rglob('a.json')
    beside.write_text(record)
    held = store.head(bucket, 'a')
    assert held is not None
    assert (held.size, held.sha256, dict(held.metadata)) == (5, None, {})
    assert b''.join(store.content(bucket, 'a')) == b'first'
    assert store.put(item) is Put.IDENTICAL


def test_users_share_a_folder_without_links(
    store: DirectoryStore, spool: Spool, bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Any user who may write to the folder may use the lock, according to the umask of its first user."""
    monkeypatch.setattr(os, 'link', _failing(errno.EPERM))
    before = os.umask(0o002)
    try:
        store.put(spool('a', b'first'))
    finally:
        os.umask(before)
    (lock,) = tmp_path.rglob('rename.lock')
    assert lock.stat().st_mode & 0o777 == 0o664
