"""Verifying a bag: intact bags pass, and every kind of damage is found, in a store and in a folder."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from bags.real_bags import NAME, put_item, stored, write_ours, write_rosbags
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from stores.memory import MemoryStore

from shadowhound_data_logger.bags.naming import BUCKET
from shadowhound_data_logger.bags.remote import find_bag
from shadowhound_data_logger.bags.verify import VerifiedBag, verify_folder, verify_remote
from shadowhound_data_logger.core import metadata_keys as meta
from shadowhound_data_logger.core.errors import BagError
from shadowhound_data_logger.stores.directory import DirectoryStore

FIRST = f'{NAME}_0.mcap'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A bag in a folder that is also a store's, from a writer without checksums."""
    found = tmp_path / 'store' / BUCKET / 'thor' / 'rosbags' / NAME
    write_ours(found)
    return found


def remotely(folder: Path, *, deep: bool) -> VerifiedBag:
    store = DirectoryStore(folder.parents[3])
    return verify_remote(store, find_bag(store, 'thor', folder.name), deep=deep)


@pytest.mark.parametrize('deep', [False, True])
def test_an_intact_bag_passes(folder: Path, deep: bool) -> None:
    """In a folder, and in a store."""
    for found in (verify_folder(folder, deep=deep), remotely(folder, deep=deep)):
        assert (found.state, found.findings) == ('complete', ())
        assert len(found.checks) == 3


def test_a_store_is_asked_for_little(folder: Path) -> None:
    """Without --deep no slice is downloaded: its summary is enough; with it every byte is read once, and the summaries."""
    store = MemoryStore()
    stored(store, folder)
    bag = find_bag(store, 'thor', NAME)
    size = sum(file.size for file in bag.slices)
    assert verify_remote(store, bag).read_bytes <= 3 * (64 << 10)
    assert size <= verify_remote(store, bag, deep=True).read_bytes <= 1.01 * size + 3 * (64 << 10)


def flip(folder: Path) -> None:
    content = bytearray((folder / FIRST).read_bytes())
    content[20_000] ^= 1
    (folder / FIRST).write_bytes(content)


def cut_off(folder: Path) -> None:
    (folder / FIRST).write_bytes((folder / FIRST).read_bytes()[:-500])


def exchange(folder: Path) -> None:
    shutil.copy(folder / f'{NAME}_1.mcap', folder / FIRST)


def lose(folder: Path) -> None:
    (folder / FIRST).unlink()


@pytest.mark.parametrize('damage', [flip, cut_off, exchange, lose])
def test_damage_is_reported(folder: Path, damage: Callable[[Path], None]) -> None:
    """With the name of the slice, by --deep from the store, and always in a folder."""
    damage(folder)
    for found in (verify_folder(folder), verify_folder(folder, deep=True), remotely(folder, deep=True)):
        assert [check.name for check in found.findings] == [FIRST]


def test_a_bag_without_a_manifest_is_compared_with_its_metadata(folder: Path) -> None:
    """With --deep a flipped bit is found by the CRC of its chunk."""
    (folder / 'manifest.json').unlink()
    assert verify_folder(folder).state == 'foreign'
    flip(folder)
    assert verify_folder(folder).is_intact
    assert [check.name for check in verify_folder(folder, deep=True).findings] == [FIRST]
    exchange(folder)
    assert verify_folder(folder, deep=True).is_intact  # the same number of intact messages: their original contents are unknown
    lose(folder)
    assert [check.finding for check in verify_folder(folder).findings] == ['is missing']


def test_a_growing_bag_is_reported(folder: Path) -> None:
    """Its slices are intact, and it is not complete."""
    store = MemoryStore()
    for name in (FIRST, f'{NAME}_1.mcap'):
        stored(store, only(folder, name))
    found = verify_remote(store, find_bag(store, 'thor', NAME))
    assert (found.state, found.is_intact, len(found.checks)) == ('growing', True, 2)


def only(folder: Path, name: str) -> Path:
    """A folder with the same name and one of the files."""
    part = folder.parents[4] / name / NAME
    part.mkdir(parents=True)
    shutil.copy(folder / name, part / name)
    return part


@pytest.mark.parametrize(('plugin', 'name'), [(StoragePlugin.SQLITE3, 'theirs.db3'), (StoragePlugin.MCAP, 'theirs.mcap')])
def test_bags_of_other_recorders_are_verified(tmp_path: Path, plugin: StoragePlugin, name: str) -> None:
    """Messages are counted; a lost one is found."""
    folder = tmp_path / 'theirs'
    write_rosbags(folder, plugin, CompressionMode.NONE)
    assert verify_folder(folder, deep=True).is_intact
    if plugin is StoragePlugin.SQLITE3:
        database = sqlite3.connect(folder / name)
        database.execute('DELETE FROM messages WHERE id = 5')
        database.commit()
        database.close()
    else:
        text = (folder / 'metadata.yaml').read_text().replace('message_count: 300', 'message_count: 301')
        (folder / 'metadata.yaml').write_text(text)
    assert [check.name for check in verify_folder(folder, deep=True).findings] == [name]


def test_a_broken_manifest_is_a_finding(folder: Path) -> None:
    """The slices are then compared with the metadata."""
    (folder / 'manifest.json').write_text('{}')
    found = verify_folder(folder)
    assert [check.name for check in found.findings] == ['manifest.json']
    assert len(found.checks) == 4


def test_a_folder_that_is_not_a_bag_is_reported(tmp_path: Path) -> None:
    """An empty folder, or one with other files."""
    with pytest.raises(BagError, match='is not a bag'):
        verify_folder(tmp_path)
    (tmp_path / 'notes.txt').write_text('x')
    with pytest.raises(BagError, match='is not a bag'):
        verify_folder(tmp_path)


def test_a_slice_that_was_thinned_is_no_damage(folder: Path) -> None:
    """The manifest has what was recorded; the object records that the robot ran out of room, and matches its description."""
    (folder / FIRST).unlink()
    (folder / f'{NAME}_1.mcap').rename(folder / FIRST)
    store = MemoryStore()
    stored(store, folder)
    bag = find_bag(store, 'thor', NAME)
    assert [check.name for check in verify_remote(store, bag).findings][:1] == [FIRST]
    thinned = put_item(folder / FIRST, bag.slices[0].key, NAME, 9)
    store.delete(BUCKET, bag.slices[0].key)
    store.put(replace(thinned, metadata={**thinned.metadata, meta.THINNED: '2'}))
    for deep in (False, True):
        found = verify_remote(store, find_bag(store, 'thor', NAME), deep=deep)
        assert FIRST not in {check.name for check in found.findings}
