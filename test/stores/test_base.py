"""The behavior that all stores share, also for keys of other programs that are not valid paths."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import boto3
import pytest
from botocore.config import Config
from botocore.exceptions import ClientError
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from profiles import examples
from shadowhound_tower.embedded import Tower
from stores.spooled import MOTO, QUICK, Spool

from shadowhound_data_logger.core.config import StoreSettings
from shadowhound_data_logger.core.errors import ForeignObject, ObjectRefused
from shadowhound_data_logger.core.model import Put, SpooledObject
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.fetch import fetch, under
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.reindex import reindex
from shadowhound_data_logger.stores import open_reader, open_store
from shadowhound_data_logger.stores.base import ObjectStore

ALL_CHARACTERS = "thor/AZaz09!_.*'()=+@-/AZaz09!_.*'()=+@-.jpg"
UNUSUAL = ('ä', 'a b')
HOSTILE = ('../escape', 'a/../../b', '/absolute', 'a//b', 'a/./b', 'a/b/', 'nul\0', 'new\nline', *UNUSUAL, '', 'k' * 1025)


def test_an_object_is_read_as_it_was_put(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """The content is returned byte for byte."""
    content = os.urandom(50_000)
    assert store.put(spool('thor/camera/20251018/120000_front.jpg', content)) is Put.CREATED
    read = store.get(bucket, 'thor/camera/20251018/120000_front.jpg')
    assert (type(read), read) == (bytes, content)


def test_head_returns_size_type_and_metadata(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """Metadata is returned unchanged, including the SHA-256 of the content."""
    item = spool('a.pcd', b'points', content_type='application/vnd.pcd', metadata={'topic': '/point_cloud2', 'samples': '7'})
    store.put(item)
    info = store.head(bucket, 'a.pcd')
    assert info is not None
    assert (info.bucket, info.key, info.size, info.sha256) == (bucket, 'a.pcd', 6, item.sha256)
    assert info.content_type == 'application/vnd.pcd'
    assert info.metadata == {'topic': '/point_cloud2', 'samples': '7', 'sha256': item.sha256}


@pytest.mark.parametrize('value', [
    '巡逻', 'Küche', 'e\u0301', '\N{DOG FACE}', 'a\nb', ' edges ', 'two  blanks', '=?UTF-8?B?QQ==?=', '=?', 'a=?b', 'a:b%20#"*',
    '巡' * 128,
])  # fmt: skip
def test_any_text_is_metadata(store: ObjectStore, spool: Spool, bucket: str, value: str) -> None:
    """A mission's type reads as the agent wrote it, in ``head`` and next to the content."""
    store.put(spool('a', b'x', metadata={'mission_type': value, 'topic': '/odom'}))
    info = store.head(bucket, 'a')
    assert info is not None
    assert (info.metadata['mission_type'], info.metadata['topic']) == (value, '/odom')
    with store.content(bucket, 'a') as content:
        assert content.info.metadata['mission_type'] == value


def test_sha256_is_kept_where_the_item_has_no_metadata(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """An object can be verified even if its spooled metadata does not contain the hash."""
    item = dataclasses.replace(spool('a', b'x'), metadata={})
    store.put(item)
    info = store.head(bucket, 'a')
    assert info is not None
    assert info.sha256 == item.sha256


def test_head_of_a_missing_object_is_none(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """Neither a missing bucket, a missing key nor a folder is an object."""
    assert store.head(bucket, 'a') is None
    store.put(spool('a/b', b'x'))
    assert store.head(bucket, 'c') is None
    assert store.head(bucket, 'a') is None


def test_get_of_a_missing_object_is_refused(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """A missing key is named in the error."""
    store.put(spool('a', b'x'))
    with pytest.raises(ObjectRefused, match=f'there is no {bucket}/b'):
        store.get(bucket, 'b')


def test_list_is_in_key_order_and_under_the_prefix(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """A prefix is a string, not a folder; sizes are included."""
    for key in ('thor/b', 'thor/a/2', 'thor/a/1', 'thor/a-1', 'tachi/a'):
        store.put(spool(key, key.encode()))
    assert [(info.key, info.size) for info in store.list(bucket, 'thor/a')] == [('thor/a-1', 8), ('thor/a/1', 8), ('thor/a/2', 8)]
    assert [info.key for info in store.list(bucket)] == ['tachi/a', 'thor/a-1', 'thor/a/1', 'thor/a/2', 'thor/b']


def test_list_below_an_object_is_empty(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """An object is not a folder."""
    store.put(spool('thor/a', b'x'))
    assert list(store.list(bucket, 'thor/a/')) == []


def test_a_listing_of_a_missing_bucket_is_empty(store: ObjectStore, bucket: str) -> None:
    """It is not an error."""
    assert list(store.list(bucket)) == []


def test_a_listing_detects_changes(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """Each object has a tag of its content and its storage time."""
    store.put(spool('a', b'x'))
    (info,) = store.list(bucket)
    assert info.etag
    assert info.modified is not None
    assert abs((datetime.now(timezone.utc) - info.modified).total_seconds()) < 300


def test_folders_are_the_names_directly_below(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """Neither objects nor deeper folders; none if the bucket or folder does not exist."""
    assert list(store.folders(bucket, '')) == []
    for key in ('thor/b', 'thor/a/2', 'thor/a/deep/1', 'thor/c/1', 'tachi/a', 'top'):
        store.put(spool(key, b'x'))
    assert list(store.folders(bucket, '')) == ['tachi', 'thor']
    assert list(store.folders(bucket, 'thor/')) == ['a', 'c']
    assert list(store.folders(bucket, 'thor/none/')) == []


def test_a_deleted_object_is_missing(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """Along with its metadata; deleting it twice is not an error, and the key is free again."""
    store.put(spool('a/b', b'x'))
    for _ in range(2):
        store.delete(bucket, 'a/b')
        assert store.head(bucket, 'a/b') is None
    assert list(store.list(bucket)) == []
    assert store.put(spool('a/b', b'another')) is Put.CREATED


def test_no_more_than_the_requested_bytes_are_read(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """The caller sets the maximum size."""
    store.put(spool('a', b'12345'))
    assert store.get(bucket, 'a', 5) == b'12345'
    with pytest.raises(ObjectRefused, match='more than 4 bytes') as caught:
        store.get(bucket, 'a', 4)
    assert caught.value.data['reason'] == 'size'


def test_the_same_again_is_a_success(store: ObjectStore, spool: Spool) -> None:
    """A put with a lost response can be repeated, whatever its size."""
    for key, content in (('zero', b''), ('one', b'1'), ('many', os.urandom(10_000))):
        assert store.put(spool(key, content)) is Put.CREATED
        assert store.put(spool(key, content)) is Put.IDENTICAL


@pytest.mark.parametrize('other', [b'the second', b'another length'])
def test_other_content_never_overwrites(store: ObjectStore, spool: Spool, bucket: str, other: bytes) -> None:
    """A taken key raises ForeignObject, whether or not the length is equal, and keeps its content and metadata."""
    first = spool('a', b'the first!', metadata={'writer': 'first'})
    store.put(first)
    with pytest.raises(ForeignObject, match='has other content') as caught:
        store.put(spool('a', other, metadata={'writer': 'second'}))
    assert caught.value.data['held_size'] == first.size
    assert store.get(bucket, 'a') == b'the first!'
    info = store.head(bucket, 'a')
    assert info is not None
    assert (info.metadata['writer'], info.sha256) == ('first', first.sha256)


def test_of_concurrent_writers_one_wins(request: pytest.FixtureRequest, store: ObjectStore, spool: Spool, bucket: str) -> None:
    """Eight threads put different content under one key: one is stored completely, and the others get an error."""
    if 'moto' in request.node.callspec.id:
        pytest.skip('moto looks and writes without a lock: its race is not ours')
    items = [spool('a', bytes([number]) * 5000) for number in range(8)]

    def put(item: SpooledObject) -> Put | None:
        try:
            return store.put(item)
        except ForeignObject:
            return None

    with ThreadPoolExecutor(len(items)) as pool:
        ends = list(pool.map(put, items))
    assert sorted(end.value for end in ends if end) == ['created']
    winner = items[ends.index(Put.CREATED)]
    assert store.get(bucket, 'a') == winner.path.read_bytes()
    info = store.head(bucket, 'a')
    assert info is not None
    assert info.sha256 == winner.sha256


def test_concurrent_puts_into_a_new_bucket_all_succeed(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """A missing bucket is created once, however many objects need it."""
    items = [spool(f'{number:02d}', os.urandom(1000)) for number in range(16)]
    with ThreadPoolExecutor(8) as pool:
        assert set(pool.map(store.put, items)) == {Put.CREATED}
    assert [info.key for info in store.list(bucket)] == [item.key for item in items]


def test_an_empty_object_is_an_object(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """Zero bytes are stored, listed and read."""
    store.put(spool('empty', b''))
    assert store.get(bucket, 'empty') == b''
    assert [(info.key, info.size) for info in store.list(bucket)] == [('empty', 0)]


def test_every_character_of_a_key_survives(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """A key with all allowed characters works in put, get, head and list."""
    store.put(spool(ALL_CHARACTERS, b'x'))
    assert store.get(bucket, ALL_CHARACTERS) == b'x'
    assert store.head(bucket, ALL_CHARACTERS) is not None
    assert [info.key for info in store.list(bucket)] == [ALL_CHARACTERS]


@pytest.mark.parametrize('key', HOSTILE)
def test_a_hostile_key_is_refused_everywhere(store: ObjectStore, spool: Spool, bucket: str, key: str) -> None:
    """No key escapes its bucket; unsafe keys are never written, but those written by others can be read."""
    with pytest.raises(ObjectRefused):
        store.put(spool(key, b'x'))
    if key in UNUSUAL:
        assert store.head(bucket, key) is None
        return
    for ask in (lambda: store.head(bucket, key), lambda: store.get(bucket, key), lambda: store.content(bucket, key),
                lambda: store.ranges(bucket, key, [(0, 1)]), lambda: store.delete(bucket, key)):  # fmt: skip
        with pytest.raises(ObjectRefused):
            ask()
    with pytest.raises(ObjectRefused):
        store.put(spool('a', b'x', bucket='../other'))


@pytest.mark.parametrize('damage', ['content', 'shorter', 'longer', 'gone', 'unreadable'])
def test_a_damaged_file_is_refused(store: ObjectStore, spool: Spool, bucket: str, damage: str) -> None:
    """A file that differs from the spooled content is not stored."""
    item = spool('a', b'as it was')
    if damage in {'gone', 'unreadable'}:
        item.path.unlink()
    if damage == 'unreadable':
        item.path.mkdir()
    if damage in {'content', 'shorter', 'longer'}:
        item.path.write_bytes({'content': b'as it WAS', 'shorter': b'as it', 'longer': b'as it was, and more'}[damage])
    with pytest.raises(ObjectRefused, match='is damaged') as caught:
        store.put(item)
    assert caught.value.data['reason'] == 'damaged'
    assert store.head(bucket, 'a') is None


def test_a_probe_of_a_reachable_store_succeeds(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """It needs no bucket or object, and leaves none behind, with or without other objects there."""
    store.probe()
    assert list(store.list(bucket)) == []
    store.put(spool('a', b'x'))
    store.probe()
    assert [info.key for info in store.list(bucket)] == ['a']


def test_open_and_close_may_be_repeated(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """Opening twice is the same as once, closing twice is not an error, and stored objects are there when it opens again."""
    store.open()
    store.put(spool('a', b'x'))
    store.close()
    store.close()
    store.open()
    assert store.get(bucket, 'a') == b'x'


@settings(max_examples=examples(20), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.binary(max_size=4096))
def test_any_content_survives(store: ObjectStore, spool: Spool, bucket: str, content: bytes) -> None:
    """All bytes are preserved."""
    item = spool(f'any/{hashlib.sha256(content).hexdigest()}', content)
    assert store.put(item) in set(Put)
    assert store.get(bucket, item.key) == content


def test_a_mailbox_is_replaced_by_one_at_a_time(store: ObjectStore, spool: Spool, bucket: str) -> None:
    """A writer that read an older version replaces nothing, and one with the newest version learns whether anything changed."""
    store.put(spool('other', b'x'))
    with pytest.raises(ObjectRefused) as missing:
        store.changed(bucket, 'inbox.json', '', 100)
    assert missing.value.data['reason'] == 'missing'
    store.put(spool('inbox.json', b'one'))
    found = store.changed(bucket, 'inbox.json', '', 100)
    assert found
    body, version = found
    assert body == b'one'
    assert store.changed(bucket, 'inbox.json', version, 100) is None
    assert store.replace(bucket, 'inbox.json', b'three', version)
    assert not store.replace(bucket, 'inbox.json', b'four', version)
    found = store.changed(bucket, 'inbox.json', version, 100)
    assert found
    assert found[0] == b'three'
    assert store.get(bucket, 'inbox.json') == b'three'
    with pytest.raises(ObjectRefused) as large:
        store.changed(bucket, 'inbox.json', version, 4)
    assert large.value.data['reason'] == 'size'


def test_no_write_is_lost_in_a_race(request: pytest.FixtureRequest, store: ObjectStore, spool: Spool, bucket: str) -> None:
    """Each of many concurrent writers appends a line to the content it read."""
    if 'moto' in request.node.callspec.id:
        pytest.skip('moto reads and replaces without a lock: its race is not ours')
    store.put(spool('inbox.json', b'0'))

    def add(number: int) -> None:
        while True:
            found = store.changed(bucket, 'inbox.json', '', 1000)
            assert found
            if store.replace(bucket, 'inbox.json', found[0] + b',%d' % number, found[1]):
                return

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(add, range(1, 13)))
    assert sorted(map(int, bytes(store.get(bucket, 'inbox.json')).split(b','))) == list(range(13))


GOOD = [f'thor/camera/20251018/12000{number}_front.jpg' for number in range(3)]
ODD = {
    'two slashes': 'thor/camera//20251018/130000_front.jpg',
    "a folder's marker": 'thor/camera/',
    'a marker below': 'thor/camera/20251018/',
    'up': 'thor/camera/../lidar/a.pcd',
    'here': 'thor/./camera/a.jpg',
    'a control character': 'thor/camera/a\x07b.jpg',
    'a line break': 'thor/camera/a\nb.jpg',
}
SEAWEED = pytest.param('seaweed', marks=pytest.mark.seaweedfs)


def client_of(server: StoreSettings) -> Any:
    return boto3.client(
        's3',
        endpoint_url=server.endpoint_url,
        region_name='us-east-1',
        config=Config(s3={'addressing_style': 'path'}),
        aws_access_key_id=server.access_key_id,
        aws_secret_access_key=server.secret_access_key,
    )


@pytest.fixture(params=[MOTO, SEAWEED])
def server(request: pytest.FixtureRequest) -> StoreSettings:
    """A server, over real HTTP."""
    if request.param == 'seaweed':
        tower: Tower = request.getfixturevalue('seaweed')
        return tower.store_settings()
    found: StoreSettings = request.getfixturevalue('moto')
    return found


@pytest.fixture
def emptied(server: StoreSettings, bucket: str) -> Iterator[Callable[..., list[str]]]:
    """Fills the bucket and returns the keys that the server then has; deletes it afterwards."""
    client = client_of(server)
    client.create_bucket(Bucket=bucket)

    def keys() -> list[str]:
        pages = client.get_paginator('list_objects_v2').paginate(Bucket=bucket)
        return [entry['Key'] for page in pages for entry in page.get('Contents', ())]

    def fill(*keys_: str) -> list[str]:
        for key in keys_:
            with suppress(ClientError):  # SeaweedFS refuses dots
                client.put_object(Bucket=bucket, Key=key, Body=b'' if key.endswith('/') else key.encode())
        return keys()

    yield fill
    for key in keys():
        client.delete_object(Bucket=bucket, Key=key)
    client.delete_bucket(Bucket=bucket)


@pytest.mark.parametrize('odd', ODD)
@pytest.mark.parametrize('opened', [open_reader, lambda server: open_store(server, QUICK)], ids=['obstore', 'botocore'])
def test_a_listing_skips_and_names_invalid_keys(
    server: StoreSettings, emptied: Callable[..., list[str]], bucket: str, odd: str, opened: Callable[..., ObjectStore]
) -> None:
    """The others are listed, also under their prefix; a key that the server renamed is not invalid."""
    there = emptied(*GOOD, ODD[odd])
    skipped: list[tuple[str, str]] = []
    with closing(opened(server)) as store:
        for prefix in ('', 'thor/', 'thor/camera/'):
            skipped.clear()
            found = [info.key for info in store.list(bucket, prefix, lambda *where: skipped.append(where))]
            assert set(GOOD) <= set(found)
            assert sorted([*found, *(key for _, key in skipped)]) == sorted(key for key in there if key.startswith(prefix))
            assert {where for where, _ in skipped} <= {bucket}
            assert all(key == ODD[odd] for _, key in skipped)
        assert 'camera' in store.folders(bucket, 'thor/')
        assert not {'', '.', '..'} & {*store.folders(bucket, 'thor/'), *store.folders(bucket, 'thor/camera/')}


def test_fetch_gets_the_objects_with_valid_keys(
    server: StoreSettings, emptied: Callable[..., list[str]], bucket: str, tmp_path: Path
) -> None:
    """Every object with a valid path is fetched; each of the others is counted as failed, under its name."""
    there = emptied(*GOOD, *ODD.values())
    odd = {key for key in there if key in ODD.values()}
    with closing(open_reader(server)) as store:
        result = fetch(under(Bucket(server, bucket), 'thor/'), tmp_path, store)
    assert result.failed == {f'{bucket}/{key}': 'its key is not a path' for key in odd}
    assert result.moved == len(there) - len(odd)
    assert all((tmp_path / key).read_bytes() == key.encode() for key in GOOD)


def test_reindex_names_invalid_keys(server: StoreSettings, emptied: Callable[..., list[str]], bucket: str) -> None:
    """The rows of the others are added, and skipped keys are in the findings."""
    there = emptied(*GOOD, *ODD.values())
    odd = {f'{bucket}/{key}' for key in there if key in ODD.values()}
    findings = Findings(lambda _: None)
    source = Bucket(server, bucket)
    with closing(open_store(server, QUICK)) as store:
        found = reindex(source, store, 'thor', buckets=(bucket,), findings=findings)
    assert {one.key for one in findings} == odd
    assert found.listed == len(there) - len(odd)


def test_a_folder_with_invalid_keys_is_listed(tmp_path: Path, bucket: str) -> None:
    """In a directory store: files with control characters in their names, and with bytes that are not UTF-8."""
    for key in GOOD:
        (tmp_path / bucket / key).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / bucket / key).write_bytes(key.encode())
    odd = ['thor/camera/a\nb.jpg', 'thor/camera/\udcff.jpg', 'thor/odd\x07/a.jpg']
    (tmp_path / bucket / 'thor/odd\x07').mkdir()
    for key in odd:
        (tmp_path / bucket / key).write_bytes(b'x')
    server = StoreSettings(directory=tmp_path)
    with closing(open_reader(server)) as store:
        assert store.folders(bucket, 'thor/') == ['camera']
        result = fetch(under(Bucket(server, bucket), 'thor/'), tmp_path / 'to', store)
    assert result.moved == len(GOOD)
    assert set(result.failed) == {f'{bucket}/{key}' for key in odd}


def test_each_invalid_key_is_logged_once(tmp_path: Path, bucket: str, caplog: pytest.LogCaptureFixture) -> None:
    """If the caller does not collect them they are logged, with control characters escaped."""
    (tmp_path / bucket).mkdir()
    (tmp_path / bucket / 'a\nb').write_bytes(b'x')
    with closing(open_reader(StoreSettings(directory=tmp_path))) as store:
        assert [*store.list(bucket), *store.list(bucket)] == []
    assert [record.getMessage() for record in caplog.records] == [f'{bucket}/a\\nb is skipped: its key is not a path']
