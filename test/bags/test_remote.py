"""Bags in the store, the spool and the recording folder, and times in user input."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from bags.real_bags import NAME, T0, put_item, stored, write_ours, write_rosbags
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from stores.memory import MemoryStore

from shadowhound_data_logger.bags.info import info_folder, info_of
from shadowhound_data_logger.bags.naming import BUCKET
from shadowhound_data_logger.bags.overview import BagRow, bag_overview, time_in_name
from shadowhound_data_logger.bags.remote import find_bag, find_bags, natural_key
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import BagError
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.stores.directory import DirectoryStore


def row(store: MemoryStore | DirectoryStore, home: Path, name: str = NAME) -> BagRow:
    return next(each for each in bag_overview(store, 'thor', home) if each.bag == name)


def test_a_complete_bag_is_described_by_its_manifest(tmp_path: Path) -> None:
    store = MemoryStore()
    write_ours(tmp_path / NAME)
    stored(store, tmp_path / NAME)
    found = row(store, tmp_path / 'home')
    assert (found.state, found.slices, found.messages, found.topics, found.where) == ('complete', 3, 1650, 2, {'store': 5})
    assert (found.t_start_ns, found.t_end_ns, found.finding) == (T0, T0 + 14_990_000_000, '')


def test_a_growing_bag_is_described_by_its_slices(tmp_path: Path) -> None:
    """One slice in the store, a closed one and the open one in the recording folder; no file is opened for it."""
    store, recording = MemoryStore(), tmp_path / 'home' / 'bags' / 'thor' / NAME
    write_ours(recording, slices=2, is_ended=False)
    path = recording / f'{NAME}_0.mcap'
    store.put(put_item(path, f'thor/rosbags/{NAME}/{path.name}', NAME, 0))
    writer = SliceWriter(recording / f'{NAME}_2.mcap')
    found = row(store, tmp_path / 'home')
    assert (found.state, found.slices, found.where, found.messages) == ('growing', 3, {'store': 1, 'recording': 2}, 550)
    writer.abort()
    assert info_of(store, 'thor', NAME, tmp_path / 'home').description.messages == 1100


def test_a_manifest_before_its_slices_is_no_complete_bag(tmp_path: Path) -> None:
    """It is small and arrives first: the bag grows until everything in it has arrived."""
    store = MemoryStore()
    write_ours(tmp_path / NAME)
    stored(store, tmp_path / NAME, without='_1.mcap')
    found = row(store, tmp_path / 'home')
    assert (found.state, found.finding) == ('growing', '1 of 3 slices are not available yet')
    assert info_of(store, 'thor', NAME, tmp_path / 'home').missing == [f'{NAME}_1.mcap']


def test_bags_of_other_recorders_are_foreign(tmp_path: Path) -> None:
    """With metadata.yaml, they are described as well; only the size of an archive is known."""
    folder = tmp_path / 'store' / BUCKET / 'thor' / 'rosbags'
    folder.mkdir(parents=True)
    write_rosbags(folder / 'theirs', StoragePlugin.SQLITE3, CompressionMode.NONE)
    (folder / 'patrol_20251018_120000.tar.gz').write_bytes(b'x' * 100)
    store = DirectoryStore(tmp_path / 'store')
    theirs, archive = row(store, tmp_path, 'theirs'), row(store, tmp_path, 'patrol_20251018_120000.tar.gz')
    assert (theirs.state, theirs.messages, theirs.topics, theirs.slices) == ('foreign', 300, 2, 1)
    assert (archive.state, archive.messages, archive.bytes) == ('foreign', None, 100)
    with pytest.raises(BagError, match='archive'):
        info_of(store, 'thor', archive.bag, tmp_path)


def test_only_bags_since_a_time_are_listed(tmp_path: Path) -> None:
    """By start time; an older one is not opened."""
    store = MemoryStore()
    for name in (NAME, 'patrol_20240101_000000'):
        write_ours(tmp_path / name, slices=1, each=10)
        stored(store, tmp_path / name)
    assert [each.bag for each in bag_overview(store, 'thor', tmp_path, since_ns=T0)] == [NAME]
    assert bag_overview(store, 'thor', tmp_path, since_ns=T0 + SECOND) == []
    assert bag_overview(store, 'tachi', tmp_path) == []


def test_an_unknown_name_suggests_similar_ones(tmp_path: Path) -> None:
    """Typos are the most common error."""
    store = MemoryStore()
    write_ours(tmp_path / NAME, slices=1, each=10)
    stored(store, tmp_path / NAME)
    with pytest.raises(BagError, match=NAME):
        find_bag(store, 'thor', 'patrol_20251018_12000')


def test_a_folder_is_described_like_a_store(tmp_path: Path) -> None:
    """The same as for the store; without metadata.yaml from the slices themselves."""
    write_ours(tmp_path / NAME)
    found = info_folder(tmp_path / NAME)
    (tmp_path / NAME / 'metadata.yaml').unlink()
    bare = info_folder(tmp_path / NAME)
    assert bare.description.topics == found.description.topics
    assert [topic.messages for topic in bare.description.topics] == [1500, 150]
    assert (bare.description.t_start_ns, bare.description.t_end_ns) == (T0, T0 + 14_990_000_000)
    assert json.loads((tmp_path / NAME / 'manifest.json').read_text())['state'] == found.state


def test_slices_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    """The eleventh after the tenth, not after the first."""
    assert sorted(['a_10.mcap', 'a_9.mcap', 'a_1.mcap'], key=natural_key) == ['a_1.mcap', 'a_9.mcap', 'a_10.mcap']
    store = MemoryStore()
    write_ours(tmp_path / NAME, slices=11, each=1)
    stored(store, tmp_path / NAME)
    assert [file.name for file in find_bags(store, 'thor')[0].slices][-2:] == [f'{NAME}_9.mcap', f'{NAME}_10.mcap']


def test_the_time_of_a_bag_is_in_its_name() -> None:
    """Only for our recordings, compressed or not."""
    assert time_in_name('patrol_20251018_120000') == time_in_name('patrol_20251018_120000.tar.gz') == T0
    assert time_in_name('rosbag2_2025_10_18-12_00_00') is None
