"""Untrusted input: spreadsheet files in any encoding, documents of any depth, and keys that escape a folder."""

from __future__ import annotations

import json
import tarfile
from collections.abc import Callable
from contextlib import closing, suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from bags.real_bags import NAME, put_item, stored, write_ours
from lake import bad_parts
from lake.making import NOON_NS as ROW_NOON_NS
from lake.making import add_part, folder_store, row
from stores.memory import MemoryStore

from shadowhound_data_logger import lake
from shadowhound_data_logger.bags.fetch import fetch
from shadowhound_data_logger.bags.manifest import Manifest
from shadowhound_data_logger.bags.remote import RemoteBag, RemoteFile, find_bag
from shadowhound_data_logger.bags.verify import verify_folder
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import (
    BagDamaged,
    DataLoggerError,
    LakeError,
    NameRefused,
    ObjectRefused,
    SettingError,
    StoreError,
)
from shadowhound_data_logger.core.mailbox import RequestRefused, decode_inbox
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.core.untrusted import MAX_JSON_DEPTH, from_json, from_strict_json, path_below
from shadowhound_data_logger.datasets import clocks, imports
from shadowhound_data_logger.datasets.transfer import _digests
from shadowhound_data_logger.formats.rows import catalog, parts
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.decode import members, records
from shadowhound_data_logger.lake.labels import from_csv
from shadowhound_data_logger.lake.prefetch import Place
from shadowhound_data_logger.missions.pictures import read_path
from shadowhound_data_logger.stores import open_store

NOON_NS = 1_793_188_800_000_000_000
READERS: dict[str, tuple[str, Callable[[Path], Any], Any]] = {
    'trajectory': ('timestamp,x,y,yaw\n1,0,0,0\n2,1,0,0\n', read_path, [(1.0, 0.0, 0.0), (2.0, 1.0, 0.0)]),
    '--times': (f'episode,begin_ns\n0,{NOON_NS}\n', imports.read_times, {0: NOON_NS}),
    '--clock': (f'robot_ns,arm_ns\n{NOON_NS},{NOON_NS + 1}\n', lambda path: clocks.read_pairs(path).tolist(),
                [[NOON_NS, NOON_NS + 1]]),
    'labels': ('label,since,until\nTür,2026-11-20T12:30,2026-11-20T12:31\n',
               lambda path: [(one.label, one.until_ns - one.since_ns) for one in from_csv(path.read_bytes(), 'thor', 0)],
               [('Tür', 60_000_000_000)]),
}  # fmt: skip
ENCODINGS = {
    'UTF-8': 'utf-8',
    'CSV UTF-8 of Excel': 'utf-8-sig',
    'UTF-16 with a mark': 'utf-16',
    'UTF-16 of the other order': 'utf-16-be',
}


@pytest.mark.parametrize('encoding', ENCODINGS)
@pytest.mark.parametrize('reader', READERS)
@pytest.mark.parametrize('end', ['\n', '\r\n'])
def test_every_reader_takes_what_a_spreadsheet_saves(tmp_path: Path, reader: str, encoding: str, end: str) -> None:
    """The values equal those of the plain file, for any BOM, byte order and line ends."""
    text, read, expected = READERS[reader]
    mark = '\ufeff' if encoding.endswith('order') else ''
    path = tmp_path / 'a.csv'
    path.write_bytes((mark + text.replace('\n', end)).encode(ENCODINGS[encoding]))
    assert read(path) == expected


@pytest.mark.parametrize(('separator', 'name'), [(';', 'semicolons'), ('\t', 'tabs')])
@pytest.mark.parametrize('reader', ['trajectory', '--times', '--clock', 'labels'])
def test_other_separators_are_named(tmp_path: Path, reader: str, separator: str, name: str) -> None:
    """Excel uses semicolons if the decimal mark is a comma, and tabs in "Unicode text": the error has the remedy."""
    text, read, _ = READERS[reader]
    path = tmp_path / 'a.csv'
    path.write_text(text.replace(',', separator), encoding='utf-8-sig')
    with pytest.raises((SettingError, LakeError, ValueError), match=f'separated by {name}: save it with commas'):
        read(path)


@pytest.mark.parametrize('body', [b'\xff\xfe\x00', b'\xff\xff\xff', b'a,b\n"', b'\xef\xbb\xbf', b''])
@pytest.mark.parametrize('reader', ['--times', '--clock', 'labels'])
def test_files_that_are_not_text_are_refused_or_empty(tmp_path: Path, reader: str, body: bytes) -> None:
    """Only the reader's documented error is raised."""
    path = tmp_path / 'a.csv'
    path.write_bytes(body)
    found: Any = []
    with suppress(SettingError, LakeError):
        found = READERS[reader][1](path)
    assert len(found) == 0


DEPTHS = (MAX_JSON_DEPTH + 1, 500, 990, 1000, 5000, 200_000)


def lists(depth: int) -> bytes:
    return b'[' * depth + b']' * depth


def objects(depth: int) -> bytes:
    return b'{"a":' * depth + b'1' + b'}' * depth


@pytest.mark.parametrize('depth', DEPTHS)
@pytest.mark.parametrize('made', [lists, objects])
@pytest.mark.parametrize('read', [from_json, lambda body: from_strict_json(body, 1 << 24)])
def test_a_document_that_is_too_deep_is_refused(read: Callable[[bytes], Any], made: Callable[[int], bytes], depth: int) -> None:
    """With a message, at any depth: no reader recurses into it."""
    with pytest.raises(ValueError, match='nested deeper than 64'):
        read(made(depth))


def test_reasonably_nested_documents_are_read() -> None:
    """A document with the maximum nesting, and a wide one."""
    for body in (
        lists(MAX_JSON_DEPTH),
        objects(MAX_JSON_DEPTH),
        json.dumps([{'a': [n]} for n in range(10_000)]).encode(),
        b'1',
    ):
        assert from_json(body) == from_strict_json(body, 1 << 24) == json.loads(body)


@pytest.mark.parametrize('depth', [500, 1000, 200_000])
def test_samples_that_are_too_deep_are_no_samples(depth: int) -> None:
    """In a robot's batch, in single documents, and next to the messages of an archive; the error is that of invalid content."""
    sample = b'{"stamp_ns":1,"a":%b}' % objects(depth)
    for body in (sample, b'{"type":"x/msg/Y","samples":[%b]}' % sample):
        with pytest.raises(LakeError, match="not a sensor's JSON"):
            records(body)
    with pytest.raises(LakeError, match='the tar cannot be read'):
        members(tar_of(a_json=sample, a_bin=b'1'), 'tar')


@pytest.mark.parametrize('depth', [500, 200_000])
def test_deep_documents_are_refused_like_other_invalid_ones(depth: int) -> None:
    """The digests of a dataset, and a robot's mailbox."""
    for read in (_digests, decode_inbox):
        with pytest.raises((DataLoggerError, RequestRefused)):
            read(b'{"format":1,"entries":%b}' % lists(depth))


def tar_of(**files: bytes) -> bytes:
    packed = BytesIO()
    with tarfile.open(fileobj=packed, mode='w') as archive:
        for name, body in files.items():
            member = tarfile.TarInfo(name.replace('_', '.'))
            member.size = len(body)
            archive.addfile(member, BytesIO(body))
    return packed.getvalue()


@pytest.mark.parametrize('kind', [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, tarfile.CHRTYPE, tarfile.DIRTYPE])
def test_links_and_devices_in_an_archive_are_ignored(tmp_path: Path, kind: bytes) -> None:
    """Nothing outside an archive is opened, whatever it refers to; its messages are read."""
    secret = tmp_path / 'secret.jpg'
    secret.write_bytes(b'the key')
    packed = BytesIO()
    with tarfile.open(fileobj=packed, mode='w') as archive:
        for name, target in (('b.jpg', str(secret)), ('../c.jpg', '../secret.jpg'), ('d.jpg', 'a.jpg')):
            member = tarfile.TarInfo(name)
            member.type, member.linkname = kind, target
            archive.addfile(member)
        for name, body in (('a.jpg', b'picture'), ('a.json', b'{"stamp_ns":1}')):
            member = tarfile.TarInfo(name)
            member.size = len(body)
            archive.addfile(member, BytesIO(body))
    found = members(packed.getvalue(), 'tar')
    assert [each.body for each in found] == [b'picture']


OUT = ['../secret.jpg', '/etc/passwd', 'a/../../secret.jpg', 'a//b', 'a/./b', '', '.', '..', 'a/', '/', 'a\0b', 'a\x1bb', 'a\nb',
       'x' * 256, 'a/' * 600, '\ud800']  # fmt: skip
IN = ['a', 'thor/camera/20261028/120000_front.jpg', 'ä/b c', '...', '.a', 'a..b', '~', '\u202e']


@pytest.mark.parametrize('key', OUT)
def test_a_key_that_is_not_a_path_is_refused(tmp_path: Path, key: str) -> None:
    with pytest.raises(NameRefused):
        path_below(tmp_path, key)


@pytest.mark.parametrize('key', IN)
def test_a_path_is_below_its_folder(tmp_path: Path, key: str) -> None:
    assert path_below(tmp_path, key).resolve().is_relative_to(tmp_path)


@pytest.mark.parametrize('key', ['thor/../../../secret.jpg', 'thor/../../secret.jpg', 'thor//secret.jpg'])
@pytest.mark.parametrize('is_fetched', [True, False])
def test_a_dataset_reads_nothing_outside_its_folder(tmp_path: Path, key: str, is_fetched: bool) -> None:
    """A row with a key that leads to a file of this machine: in a directory store, and in a folder of fetched objects."""
    (tmp_path / 'secret.jpg').write_bytes(b'secret')
    root = tmp_path / 'store' / catalog.BUCKET
    (root / 'thor').mkdir(parents=True)
    (root / 'secret.jpg').write_bytes(b'secret')
    fields = {**row('camera', ROW_NOON_NS), 'key': key, 'sha256': None, 'bytes': 6}
    bad_parts.put(folder_store(tmp_path), parts.encode([fields]))
    frames = lake.MissionDataset(root if is_fetched else Bucket(folder_store(tmp_path), catalog.BUCKET))
    assert len(frames) == 1
    with pytest.raises((StoreError, LakeError), match='not a path'):
        frames[0]


def test_contents_are_read_from_no_other_folder(tmp_path: Path) -> None:
    """A bucket is a name; a reader opens only listed files."""
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
    """Neither contents nor files next to them: a run's id is part of a key."""
    settings = folder_store(tmp_path)
    outside = tmp_path / 'secret' / 'summary.json'
    outside.parent.mkdir()
    outside.write_text(json.dumps({'result': 'STOLEN'}), encoding='utf-8')
    run_id = '../../../../secret'
    with closing(open_store(settings, UploadSettings())) as store:
        add_part(store, [{**row('camera', ROW_NOON_NS), 'mission_id': 'm', 'run_id': run_id}], 'a', tmp_path / 'tmp')
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
    """Neither the name of a file nor that of the bag escapes it; refused files are not written."""
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
    """No other file is opened to compare it with the manifest."""
    write_ours(tmp_path / NAME, slices=1)
    path = tmp_path / NAME / 'manifest.json'
    data = json.loads(path.read_bytes())
    data['slices'][0]['file'] = '../secret'
    with pytest.raises(BagDamaged, match='the name of a file'):
        Manifest.from_json(json.dumps(data).encode())
    path.write_text(json.dumps(data), encoding='utf-8')
    found = verify_folder(tmp_path / NAME)
    assert [check.name for check in found.findings] == ['manifest.json']
    store = MemoryStore()
    stored(store, tmp_path / NAME)
    with pytest.raises(BagDamaged):
        fetch(store, find_bag(store, 'thor', NAME), tmp_path / 'to')
