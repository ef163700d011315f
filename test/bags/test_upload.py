"""Uploading finished bags: unchanged, verified, through the spool or directly, and watching a folder for them."""

from __future__ import annotations

import io
import os
import shutil
import tarfile
import time
from contextlib import closing
from pathlib import Path

import pytest
from bags.real_bags import NAME, by_rosbags, write_ours, write_rosbags
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.bags.naming import BUCKET, MANIFEST
from shadowhound_data_logger.bags.remote import find_bag, find_bags
from shadowhound_data_logger.bags.upload import Uploaded, deliver, open_spool, plan_upload, spool_upload, upload_now
from shadowhound_data_logger.bags.verify import verify_remote
from shadowhound_data_logger.bags.watch import MARKS, Watch
from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.errors import BagDamaged, BagError, NameRefused
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.directory import DirectoryStore

CLOCK = SystemClock.of_this_machine()
DEADLINE_S = 60.0
KINDS = [
    (StoragePlugin.MCAP, CompressionMode.NONE), (StoragePlugin.MCAP, CompressionMode.FILE),
    (StoragePlugin.SQLITE3, CompressionMode.NONE), (StoragePlugin.SQLITE3, CompressionMode.FILE),
    (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
]  # fmt: skip


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings.load({'robot': 'thor', 'spool.min_free_bytes': 0}, {'SHADOWHOUND_HOME': str(tmp_path / 'home')})


@pytest.fixture
def store(settings: Settings) -> DirectoryStore:
    return DirectoryStore(settings.store.directory)


def send(settings: Settings, folder: Path, *, is_archive: bool = False, deadline_s: float = DEADLINE_S) -> Uploaded:
    """Through the spool."""
    with (
        plan_upload(folder, 'thor', folder.name, settings.home, is_archive=is_archive) as sent,
        open_spool(settings, CLOCK) as spool,
    ):
        spool_upload(sent, spool)
        return deliver(settings, spool, sent, deadline_s=deadline_s)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(('plugin', 'mode'), KINDS, ids=lambda value: value.name)
def test_finished_bags_are_uploaded_unchanged(
    settings: Settings, store: DirectoryStore, tmp_path: Path, plugin: StoragePlugin, mode: CompressionMode
) -> None:
    """With a manifest that has its checksums; the folder is unchanged."""
    write_rosbags(tmp_path / 'theirs', plugin, mode)
    before = contents(tmp_path / 'theirs')
    assert send(settings, tmp_path / 'theirs').is_delivered
    assert contents(tmp_path / 'theirs') == before
    arrived = contents(settings.store.directory / BUCKET / 'thor' / 'rosbags' / 'theirs')
    assert {name: body for name, body in arrived.items() if name != MANIFEST} == before
    found = verify_remote(store, find_bag(store, 'thor', 'theirs'), deep=True)
    assert (found.state, found.findings) == ('complete', ())
    assert len(by_rosbags(settings.store.directory / BUCKET / 'thor' / 'rosbags' / 'theirs')) == 300
    assert list((settings.home / 'sending').iterdir()) == []


def test_uploading_twice_uploads_once(settings: Settings, tmp_path: Path) -> None:
    """The second time nothing is spooled, and the result is the same."""
    write_ours(tmp_path / NAME)
    assert send(settings, tmp_path / NAME) == send(settings, tmp_path / NAME)
    with closing(open_store(settings.store, settings.upload)) as store:
        assert [bag.name for bag in find_bags(store, 'thor')] == [NAME]
        assert len(find_bag(store, 'thor', NAME).files) == 5


@pytest.mark.parametrize('is_now', [False, True])
def test_another_bag_of_that_name_is_refused(settings: Settings, store: DirectoryStore, tmp_path: Path, is_now: bool) -> None:
    """Nothing is overwritten, nothing is renamed; the remedy is another name."""
    write_ours(tmp_path / NAME, slices=1)
    send(settings, tmp_path / NAME)
    write_ours(tmp_path / 'other' / NAME, slices=1, each=10)
    if is_now:
        with (
            plan_upload(tmp_path / 'other' / NAME, 'thor', NAME, settings.home, is_archive=False) as sent,
            pytest.raises(BagError, match='--bag-name'),
        ):
            upload_now(store, sent, deadline_s=DEADLINE_S)
    else:
        with pytest.raises(BagError, match='--bag-name'):
            send(settings, tmp_path / 'other' / NAME)
    assert len(find_bag(store, 'thor', NAME).files) == 3


def test_an_archive_has_the_layout_of_the_guide(settings: Settings, store: DirectoryStore, tmp_path: Path) -> None:
    """thor/rosbags/<name>.tar.gz with the bag's folder in it; creating it twice gives the same bytes."""
    write_ours(tmp_path / NAME)
    assert send(settings, tmp_path / NAME, is_archive=True).is_delivered
    body = store.get(BUCKET, f'thor/rosbags/{NAME}.tar.gz')
    with tarfile.open(fileobj=io.BytesIO(body)) as archive:
        archive.extractall(tmp_path / 'unpacked', filter='data')
    assert contents(tmp_path / 'unpacked' / NAME) == contents(tmp_path / NAME)
    assert send(settings, tmp_path / NAME, is_archive=True).is_delivered


@pytest.mark.long('an outage of some seconds')
def test_an_unreachable_tower_is_not_a_failure(tmp_path: Path, seaweed: Tower) -> None:
    """The bag waits in the spool, whatever happens to its folder, and the next process delivers it."""
    settings = Settings.load({'robot': 'thor', 'spool.min_free_bytes': 0},
                             {'SHADOWHOUND_HOME': str(tmp_path / 'home'), 'AWS_ENDPOINT_URL': 'http://127.0.0.1:9'})  # fmt: skip
    write_ours(tmp_path / NAME)
    found = send(settings, tmp_path / NAME, deadline_s=1.0)
    assert (found.delivered, found.is_delivered) == (0, False)
    assert '127.0.0.1:9' in found.last_error
    back = Settings.load({'robot': 'thor', 'spool.min_free_bytes': 0},
                         {'SHADOWHOUND_HOME': str(tmp_path / 'home'), **seaweed.environment()})  # fmt: skip
    with plan_upload(tmp_path / NAME, 'thor', NAME, back.home, is_archive=False) as sent, open_spool(back, CLOCK) as spool:
        shutil.rmtree(tmp_path / NAME)
        assert deliver(back, spool, sent, deadline_s=DEADLINE_S).is_delivered
    with closing(open_store(back.store, back.upload)) as store:
        assert verify_remote(store, find_bag(store, 'thor', NAME), deep=True).state == 'complete'


def test_a_full_spool_is_reported(tmp_path: Path) -> None:
    """The remedy is to bypass it."""
    settings = Settings.load(
        {'spool.max_bytes': 1 << 20, 'spool.min_free_bytes': 0}, {'SHADOWHOUND_HOME': str(tmp_path / 'home')}
    )
    write_ours(tmp_path / NAME, each=1500)
    with pytest.raises(BagError, match='--direct'):
        send(settings, tmp_path / NAME)


@pytest.mark.parametrize('what', ['no metadata', 'wal', 'slice gone', 'slices cut'])
def test_an_unfinished_bag_is_refused(settings: Settings, tmp_path: Path, what: str) -> None:
    """With the reason, before anything is spooled."""
    folder = tmp_path / NAME
    write_ours(folder)
    path = folder / f'{NAME}_2.mcap'
    if what == 'no metadata':
        (folder / 'metadata.yaml').unlink()
    elif what == 'wal':
        (folder / 'theirs.db3-wal').write_bytes(b'x')
    elif what == 'slice gone':
        path.unlink()
    else:
        for each in folder.glob('*.mcap'):
            each.write_bytes(each.read_bytes()[:-9])
    with pytest.raises((BagError, BagDamaged), match=r'finished|not complete|end of an MCAP'):
        send(settings, folder)
    assert not settings.home.exists()


def test_a_bag_that_changes_after_it_was_spooled_is_reported(settings: Settings, store: DirectoryStore, tmp_path: Path) -> None:
    """Small files are sent unchanged; a changed slice is refused and never sent under its name."""
    write_ours(tmp_path / NAME, slices=2, each=1500)
    before = contents(tmp_path / NAME)
    with (
        plan_upload(tmp_path / NAME, 'thor', NAME, settings.home, is_archive=False) as sent,
        open_spool(settings, CLOCK) as spool,
    ):
        spool_upload(sent, spool)
        for name in ('metadata.yaml', f'{NAME}_0.mcap'):
            with (tmp_path / NAME / name).open('ab') as file:
                file.write(b'# more')
        with pytest.raises(BagError, match=f'{NAME}_0.mcap is quarantined .damaged'):
            deliver(settings, spool, sent, deadline_s=DEADLINE_S)
    there = {file.name: store.get(BUCKET, file.key) for file in find_bag(store, 'thor', NAME).files}
    assert f'{NAME}_0.mcap' not in there
    assert {name: there[name] for name in before if name in there and name != MANIFEST} == {
        name: before[name] for name in there if name != MANIFEST
    }  # fmt: skip


@pytest.mark.parametrize('is_archive', [False, True])
def test_a_link_out_of_the_bag_is_refused(settings: Settings, tmp_path: Path, is_archive: bool) -> None:
    """Neither its target is sent, nor an archive with a changed target."""
    write_ours(tmp_path / NAME, slices=1)
    (tmp_path / 'secret').write_text('secret')
    (tmp_path / NAME / 'notes.txt').symlink_to(tmp_path / 'secret')
    with pytest.raises(BagError, match='is a link to a file outside'):
        send(settings, tmp_path / NAME, is_archive=is_archive)


def test_a_name_that_is_no_key_is_refused(settings: Settings, tmp_path: Path) -> None:
    """Before anything is spooled."""
    write_ours(tmp_path / NAME, slices=1, each=5)
    shutil.move(tmp_path / NAME, tmp_path / 'my bag')
    with pytest.raises(NameRefused, match='my bag'):
        send(settings, tmp_path / 'my bag')


class Hand:
    """A clock that the test moves."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def watch(settings: Settings, folder: Path, hand: Hand, *, is_removing: bool = False) -> Watch:
    return Watch(folder, settings, CLOCK, settle_s=10.0, is_removing=is_removing, monotonic=hand)


def steps(watching: Watch) -> list[tuple[str, str]]:
    return [(step.bag, step.what) for step in watching.round()]


def test_a_watched_bag_is_shipped_once_it_is_finished(settings: Settings, store: DirectoryStore, tmp_path: Path) -> None:
    """Not while its files change, not without metadata.yaml, and never twice, also after a restart."""
    hand, folder = Hand(), tmp_path / 'recordings'
    write_ours(folder / NAME)
    (folder / NAME / 'metadata.yaml').rename(folder / 'aside')
    watching = watch(settings, folder, hand)
    hand.now = 20.0
    assert steps(watching) == []
    (folder / 'aside').rename(folder / NAME / 'metadata.yaml')
    assert steps(watching) == []
    hand.now = 29.0
    (folder / NAME / 'notes.txt').write_text('still at it')
    assert steps(watching) == []
    hand.now = 38.0
    assert steps(watching) == []
    hand.now = 39.0
    assert steps(watching) == [(NAME, 'spooled'), (NAME, 'stored')]
    assert steps(watching) == []
    again = watch(settings, folder, hand)
    assert steps(again) == []
    hand.now = 60.0
    assert steps(again) == []
    assert (folder / NAME / 'notes.txt').exists()
    assert len(find_bag(store, 'thor', NAME).files) == 6


def test_an_unfinished_bag_is_reported_once(settings: Settings, tmp_path: Path) -> None:
    """After ten minutes without a change it is reported, not sent; it becomes normal again once its recorder continues."""
    folder = tmp_path / 'recordings'
    write_ours(folder / NAME, is_ended=False)
    (folder / 'empty').mkdir()
    watching = watch(settings, folder, Hand())
    assert steps(watching) == []
    assert not watching.has_undelivered()
    long_ago = time.time() - 700
    for path in (folder / NAME).iterdir():
        os.utime(path, (long_ago, long_ago))
    (step,) = watching.round()
    assert (step.bag, step.what) == (NAME, 'refused')
    assert 'no metadata.yaml, and nothing in it has changed for 10 min' in step.reason
    assert steps(watching) == []
    assert watching.has_undelivered()
    (folder / NAME / f'{NAME}_3.mcap').write_bytes(b'more')
    assert steps(watching) == []
    assert not watching.has_undelivered()
    assert not settings.home.exists()


def test_a_bag_is_removed_only_when_the_store_has_it(settings: Settings, store: DirectoryStore, tmp_path: Path) -> None:
    """Not if one of its files is missing in the store, nor if the bag has changed since."""
    hand, folder = Hand(), tmp_path / 'recordings'
    for name in ('gone', 'kept', 'changed'):
        write_ours(folder / name, slices=1, each=10)
    keeping = watch(settings, folder, hand)
    keeping.round()
    hand.now = 10.0
    assert len(keeping.round()) == 6
    (settings.store.directory / BUCKET / 'thor' / 'rosbags' / 'kept' / 'kept_0.mcap').unlink()
    (folder / 'changed' / 'changed_0.mcap').touch()
    removing = watch(settings, folder, hand, is_removing=True)
    assert steps(removing) == [('gone', 'removed')]
    assert sorted(path.name for path in folder.iterdir() if path.is_dir()) == ['changed', 'kept']


def test_one_bad_bag_does_not_stop_the_others(settings: Settings, store: DirectoryStore, tmp_path: Path) -> None:
    """It is reported once, and the others are uploaded."""
    hand, folder = Hand(), tmp_path / 'recordings'
    write_ours(folder / 'bad', slices=2, each=10)
    write_ours(folder / 'good', slices=1, each=10)
    (folder / 'bad' / 'bad_1.mcap').unlink()
    watching = watch(settings, folder, hand)
    watching.round()
    hand.now = 10.0
    assert steps(watching) == [('bad', 'refused'), ('good', 'spooled'), ('good', 'stored')]
    assert steps(watching) == []
    assert watching.has_undelivered()


@pytest.mark.parametrize(
    'content', ['{', '[]', '{"bags": []}', '{"bags": {"a": {"state": "spooled"}}}', '{"bags": {"a": {"files": [[1]]}}}']
)
def test_a_damaged_list_of_sent_bags_is_an_error(settings: Settings, tmp_path: Path, content: str) -> None:
    """It names the file, and nothing is sent."""
    (tmp_path / MARKS).write_text(content)
    with pytest.raises(BagError, match=f'{MARKS} cannot be read'):
        watch(settings, tmp_path, Hand()).round()


def test_only_one_process_watches_a_folder(settings: Settings, tmp_path: Path) -> None:
    """The second one gets an error."""
    watching = watch(settings, tmp_path, Hand())
    with (
        watching.exclusive(),
        pytest.raises(BagError, match='another process watches'),
        watch(settings, tmp_path, Hand()).exclusive(),
    ):
        pass
