"""Fetching a bag: complete, verified, resumed after a kill, and nothing downloaded twice."""

from __future__ import annotations

import fcntl
import hashlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from bags.real_bags import NAME, by_rosbags, messages_of, put_item, stored, write_ours, write_rosbags
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from stores.memory import MemoryStore

from shadowhound_data_logger.bags.fetch import fetch
from shadowhound_data_logger.bags.naming import BUCKET
from shadowhound_data_logger.bags.remote import find_bag
from shadowhound_data_logger.core import retry
from shadowhound_data_logger.core.errors import BagDamaged, BagError, StoreUnavailable
from shadowhound_data_logger.core.progress import ProgressListener
from shadowhound_data_logger.stores.base import Content
from shadowhound_data_logger.stores.directory import DirectoryStore


class Counting(MemoryStore):
    """Fails after ``limit`` bytes of content."""

    limit = 1 << 62
    sent = 0

    def content(self, bucket: str, key: str, start: int = 0, version: str = '') -> Content:
        found = super().content(bucket, key, start, version)
        return Content(found.info, self._cut_off(found.pieces))

    def _cut_off(self, pieces: Iterator[bytes]) -> Iterator[bytes]:
        for piece in pieces:
            for at in range(0, len(piece), 4096):
                if self.sent >= self.limit:
                    raise StoreUnavailable('gone')
                self.sent += len(piece[at : at + 4096])
                yield piece[at : at + 4096]


@pytest.fixture
def store(tmp_path: Path) -> Counting:
    write_ours(tmp_path / 'robot' / NAME)
    found = Counting()
    stored(found, tmp_path / 'robot' / NAME)
    return found


def files(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}


def test_a_fetched_bag_is_the_uploaded_bag(store: Counting, tmp_path: Path) -> None:
    """Every file is identical to the robot's, there are no others, and the reported progress adds up to all bytes."""

    class Sum(ProgressListener):
        total = 0
        received = 0

        def begin(self, total: int) -> None:
            self.total = total

        def have(self, count: int) -> None:
            self.received += count

    report = Sum()
    found = fetch(store, find_bag(store, 'thor', NAME), tmp_path / 'here', progress=report)
    assert files(found.folder) == files(tmp_path / 'robot' / NAME)
    assert (found.is_complete, found.unverified) == (True, ())
    assert report.received == report.total == found.bytes == found.downloaded


def test_a_second_run_downloads_nothing(store: Counting, tmp_path: Path) -> None:
    """Also after a file was damaged: then it downloads that one."""
    bag = find_bag(store, 'thor', NAME)
    folder = fetch(store, bag, tmp_path / 'here').folder
    assert fetch(store, bag, tmp_path / 'here').downloaded == 0
    damaged = folder / f'{NAME}_1.mcap'
    content = bytearray(damaged.read_bytes())
    content[1000] ^= 1
    damaged.write_bytes(content)
    assert fetch(store, bag, tmp_path / 'here').downloaded == len(content)
    assert files(folder) == files(tmp_path / 'robot' / NAME)


def test_an_interrupted_fetch_resumes(store: Counting, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over all runs each byte is downloaded once."""
    monkeypatch.setattr(retry, 'BASE_S', 0.0)
    bag = find_bag(store, 'thor', NAME)
    store.limit = bag.size // 2
    with pytest.raises(StoreUnavailable):
        fetch(store, bag, tmp_path / 'here', threads=1)
    store.limit = 1 << 62
    found = fetch(store, bag, tmp_path / 'here')
    assert store.sent == bag.size
    assert 0 < found.downloaded < bag.size
    assert files(found.folder) == files(tmp_path / 'robot' / NAME)


def test_a_part_that_lost_its_content_is_downloaded_again(store: Counting, tmp_path: Path) -> None:
    """After a power cut a part may have the correct length and contain zeros."""
    part = tmp_path / 'here' / NAME / f'{NAME}_0.mcap.part'
    part.parent.mkdir(parents=True)
    part.write_bytes(bytes(5000))
    folder = fetch(store, find_bag(store, 'thor', NAME), tmp_path / 'here').folder
    assert files(folder) == files(tmp_path / 'robot' / NAME)


def test_files_lost_in_the_store_are_reported(store: Counting, tmp_path: Path) -> None:
    """A slice that differs from the manifest never gets its name."""
    other = tmp_path / 'other.bin'
    other.write_bytes(b'x' * 1000)
    key = f'thor/rosbags/{NAME}/{NAME}_1.mcap'
    store._objects.pop((BUCKET, key))
    store.put(put_item(other, key, NAME, 1))
    with pytest.raises(BagDamaged, match='in the store is not the recorded file'):
        fetch(store, find_bag(store, 'thor', NAME), tmp_path / 'here')
    assert not (tmp_path / 'here' / NAME / f'{NAME}_1.mcap').exists()


def test_a_growing_bag_can_be_opened_and_completed(tmp_path: Path) -> None:
    """Players get a metadata.yaml for the available files; when the bag has ended, its real one replaces that."""
    origin = tmp_path / 'robot' / NAME
    write_ours(origin)
    store = MemoryStore()
    for number in (0, 1):
        path = origin / f'{NAME}_{number}.mcap'
        store.put(put_item(path, f'thor/rosbags/{NAME}/{path.name}', NAME, number))
    found = fetch(store, find_bag(store, 'thor', NAME), tmp_path / 'here')
    assert not found.is_complete
    wanted = messages_of([origin / f'{NAME}_0.mcap', origin / f'{NAME}_1.mcap'])
    assert by_rosbags(found.folder) == [(one.channel.topic, one.log_ns, one.cdr) for one in wanted]
    stored(store, origin, without='_0.mcap')
    assert fetch(store, find_bag(store, 'thor', NAME), tmp_path / 'here').is_complete
    assert files(found.folder) == files(origin)


def test_a_bag_of_which_a_slice_is_missing_can_be_opened_and_completed(tmp_path: Path) -> None:
    """Even if its metadata.yaml arrived first and names missing files: these are reported, and fetched once they exist."""
    folder = tmp_path / 'robot' / NAME
    write_ours(folder)
    store = MemoryStore()
    stored(store, folder, without='_1.mcap')
    for _ in range(2):
        found = fetch(store, find_bag(store, 'thor', NAME), tmp_path)
        assert (found.is_complete, found.missing) == (False, (f'{NAME}_1.mcap',))
        assert len(by_rosbags(tmp_path / NAME)) == 2 * 550
    path = folder / f'{NAME}_1.mcap'
    store.put(put_item(path, f'thor/rosbags/{NAME}/{path.name}', NAME, 1))
    found = fetch(store, find_bag(store, 'thor', NAME), tmp_path)
    assert (found.is_complete, found.missing) == (True, ())
    assert files(tmp_path / NAME) == files(folder)


def test_a_foreign_bag_is_fetched_unchanged(tmp_path: Path) -> None:
    """Files that another program uploaded without a checksum are reported as such."""
    write_rosbags(tmp_path / 'store' / BUCKET / 'thor' / 'rosbags' / 'theirs', StoragePlugin.SQLITE3, CompressionMode.NONE)
    store = DirectoryStore(tmp_path / 'store')
    found = fetch(store, find_bag(store, 'thor', 'theirs'), tmp_path / 'here')
    assert set(found.unverified) == {'metadata.yaml', 'theirs.db3'}
    assert len(by_rosbags(found.folder)) == 300


def test_two_concurrent_fetches_do_not_mix(store: Counting, tmp_path: Path) -> None:
    """A second process in the same folder gets an error that names the first."""
    folder = tmp_path / 'here' / NAME
    folder.mkdir(parents=True)
    with (folder / f'{NAME}_0.mcap.part').open('ab') as part:
        fcntl.flock(part, fcntl.LOCK_EX)
        with pytest.raises(BagError, match='another process is already fetching'):
            fetch(store, find_bag(store, 'thor', NAME), tmp_path / 'here')


def test_a_kill_costs_nothing(tmp_path: Path) -> None:
    """After kill -9 during a fetch the next run keeps the existing files, and the bag is complete."""
    origin = tmp_path / 'home' / 'store' / BUCKET / 'thor' / 'rosbags' / NAME
    write_ours(origin, slices=2, each=3000)
    program = (
        'import sys, time, pathlib\n'
        'from shadowhound_data_logger.stores.directory import DirectoryStore\n'
        'from shadowhound_data_logger.bags.fetch import fetch\n'
        'from shadowhound_data_logger.core.progress import ProgressListener\n'
        'from shadowhound_data_logger.bags.remote import find_bag\n'
        'class Slow(ProgressListener):\n'
        '    def have(self, count):\n'
        '        if count:\n'
        '            time.sleep(0.3)\n'
        'store = DirectoryStore(pathlib.Path(sys.argv[1]))\n'
        'fetch(store, find_bag(store, "thor", sys.argv[2]), pathlib.Path(sys.argv[3]), threads=1, progress=Slow())\n'
    )
    here = tmp_path / 'here'
    child = subprocess.Popen([sys.executable, '-c', program, str(tmp_path / 'home' / 'store'), NAME, str(here)])
    end = time.monotonic() + 60
    while not any(path.stat().st_size > 1 << 20 for path in here.rglob(f'{NAME}_*.part')):
        assert time.monotonic() < end
        assert child.poll() is None
        time.sleep(0.01)
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    kept = sum(path.stat().st_size for path in here.rglob('*') if path.is_file())
    store = DirectoryStore(tmp_path / 'home' / 'store')
    found = fetch(store, find_bag(store, 'thor', NAME), here)
    assert found.downloaded == found.bytes - kept
    assert files(found.folder) == files(origin)
