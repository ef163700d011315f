"""No key, name of a file or bucket that a robot wrote leads out of the folder that is read or written."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path

import pytest
from bags.real_bags import NAME, put_item, stored, write_ours
from hostile import bad_parts
from lake.making import NOON_NS, add_part, folder_store, row
from stores.memory import MemoryStore

from shadowhound_data_logger import lake
from shadowhound_data_logger.bags.fetch import fetch
from shadowhound_data_logger.bags.manifest import Manifest
from shadowhound_data_logger.bags.remote import RemoteBag, RemoteFile, find_bag
from shadowhound_data_logger.bags.verify import verify_folder
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import BagDamaged, LakeError, NameRefused, ObjectRefused, StoreError
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.core.untrusted import path_below
from shadowhound_data_logger.formats.rows import catalog, parts
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.prefetch import Place
from shadowhound_data_logger.stores import open_store

OUT = ['../secret.jpg', '/etc/passwd', 'a/../../secret.jpg', 'a//b', 'a/./b', '', '.', '..', 'a/', '/', 'a\0b', 'a\x1bb', 'a\nb',
       'x' * 256, 'a/' * 600, '\ud800']  # fmt: skip
IN = ['a', 'thor/camera/20261028/120000_front.jpg', 'ä/b c', '...', '.a', 'a..b', '~', '\u202e']


@pytest.mark.parametrize('key', OUT)
def test_what_is_no_path_is_refused(tmp_path: Path, key: str) -> None:
    with pytest.raises(NameRefused):
        path_below(tmp_path, key)


@pytest.mark.parametrize('key', IN)
def test_what_is_one_is_below(tmp_path: Path, key: str) -> None:
    assert path_below(tmp_path, key).resolve().is_relative_to(tmp_path)


@pytest.mark.parametrize('key', ['thor/../../../secret.jpg', 'thor/../../secret.jpg', 'thor//secret.jpg'])
@pytest.mark.parametrize('is_fetched', [True, False])
def test_a_data_set_reads_nothing_outside(tmp_path: Path, key: str, is_fetched: bool) -> None:
    """A row whose key leads to a file of this machine: of a store in a folder, and of a folder of fetched objects."""
    (tmp_path / 'secret.jpg').write_bytes(b'secret')
    root = tmp_path / 'store' / catalog.BUCKET
    (root / 'thor').mkdir(parents=True)
    (root / 'secret.jpg').write_bytes(b'secret')
    told = {**row('camera', NOON_NS), 'key': key, 'sha256': None, 'bytes': 6}
    bad_parts.put(folder_store(tmp_path), parts.encode([told]))
    frames = lake.MissionDataset(root if is_fetched else Bucket(folder_store(tmp_path), catalog.BUCKET))
    assert len(frames) == 1
    with pytest.raises((StoreError, LakeError), match='not a path'):
        frames[0]


def test_contents_are_read_from_no_other_folder(tmp_path: Path) -> None:
    """A bucket is a name; a place reads no more than it is told that there is."""
    (tmp_path / 'secret').write_bytes(b'secret')
    (tmp_path / 'store' / 'b').mkdir(parents=True)
    (tmp_path / 'store' / 'b' / 'k').write_bytes(b'content')
    place = Place(StoreSettings(directory=tmp_path / 'store'))
    assert place.read('b', 'k', 7) == b'content'
    for bucket, key in (('..', 'secret'), ('b', '../../secret'), ('b/..', 'k'), ('', 'k')):
        with pytest.raises(ObjectRefused):
            place.read(bucket, key, 100)
    with pytest.raises(ObjectRefused, match='more than 6 bytes'):
        place.read('b', 'k', 6)


def test_a_source_reads_nothing_outside_its_bucket(tmp_path: Path) -> None:
    """Neither of its objects' contents nor what is said beside them: a run's id is part of a key."""
    settings = folder_store(tmp_path)
    outside = tmp_path / 'secret' / 'summary.json'
    outside.parent.mkdir()
    outside.write_text(json.dumps({'result': 'STOLEN'}), encoding='utf-8')
    run_id = '../../../../secret'
    with closing(open_store(settings, UploadSettings())) as store:
        add_part(store, [{**row('camera', NOON_NS), 'mission_id': 'm', 'run_id': run_id}], 'a', tmp_path / 'tmp')
    (settings.directory / catalog.BUCKET / 'thor' / 'missions').mkdir()
    source = Bucket(settings, catalog.BUCKET)
    assert lake.missions(source).to_pydict()['result'] == [None]
    key = f'thor/missions/{run_id}/summary.json'
    for ask in (lambda: source.get(key, 100), lambda: source.head(key),
                lambda: source.ranges(key, [(0, 5)]), lambda: source.delete(key), lambda: source.folders('../'),
                lambda: list(source.list('../../'))):  # fmt: skip
        with pytest.raises(ObjectRefused):
            ask()
    assert outside.exists()


@pytest.mark.parametrize('name', ['../evil.mcap', '/tmp/evil.mcap', 'a/../../evil.mcap', '..'])  # noqa: S108 - a name to be refused
def test_a_bag_is_fetched_into_its_folder_alone(tmp_path: Path, name: str) -> None:
    """Neither the name of a file nor that of the bag leads elsewhere; what was refused is not written."""
    store, to = MemoryStore(), tmp_path / 'to'
    body = tmp_path / 'body'
    body.write_bytes(b'evil')
    store.put(put_item(body, 'thor/rosbags/bag/file', 'bag', 0))
    before = sorted(tmp_path.rglob('*'))
    for bag in (RemoteBag('thor', 'bag', (RemoteFile(name, 'thor/rosbags/bag/file', 4),)),
                RemoteBag('thor', name, (RemoteFile('f.mcap', 'thor/rosbags/bag/file', 4),))):  # fmt: skip
        with pytest.raises(NameRefused):
            fetch(store, bag, to)
    assert sorted(path for path in tmp_path.rglob('*') if path != to and path != to / 'bag') == before


def test_a_manifest_names_files_of_its_bag_alone(tmp_path: Path) -> None:
    """Another file is never opened to be compared with what the manifest says of it."""
    write_ours(tmp_path / NAME, slices=1)
    path = tmp_path / NAME / 'manifest.json'
    told = json.loads(path.read_bytes())
    told['slices'][0]['file'] = '../secret'
    with pytest.raises(BagDamaged, match='the name of a file'):
        Manifest.from_json(json.dumps(told).encode())
    path.write_text(json.dumps(told), encoding='utf-8')
    found = verify_folder(tmp_path / NAME)
    assert [check.name for check in found.findings] == ['manifest.json']
    store = MemoryStore()
    stored(store, tmp_path / NAME)
    with pytest.raises(BagDamaged):
        fetch(store, find_bag(store, 'thor', NAME), tmp_path / 'to')
