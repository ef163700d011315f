"""Objects that are sent in parts: what every store does alike, and what an S3 server is asked for."""

from __future__ import annotations

import hashlib
import os
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from shadowhound_tower.embedded import Tower
from stores.spooled import MOTO, QUICK, Spool

from shadowhound_data_logger.core.config import StoreSettings
from shadowhound_data_logger.core.errors import ForeignObject, ObjectRefused
from shadowhound_data_logger.core.model import Put, SpooledObject
from shadowhound_data_logger.stores import content, s3_puts
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.s3 import S3Store

MEBI = 1 << 20
SMALLEST_PART = 5 * MEBI
"""The smallest that S3 allows."""
CONTENT = os.urandom(2 * SMALLEST_PART + 12345)
KEY = "thor/rosbags/patrol's(1)+@=/patrol_0.mcap"


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is large here is a fraction of a slice."""
    monkeypatch.setattr(s3_puts, 'MULTIPART_BYTES', SMALLEST_PART)
    monkeypatch.setattr(content, 'PART_BYTES', SMALLEST_PART)


@pytest.fixture
def item(spool: Spool) -> SpooledObject:
    return spool(KEY, CONTENT, content_type='application/x-mcap', metadata={'bag': 'patrol', 'slice': '0'})


@pytest.fixture(params=[MOTO, pytest.param('seaweed', marks=pytest.mark.seaweedfs)])
def server(request: pytest.FixtureRequest, opened: Callable[..., S3Store]) -> S3Store:
    """A store on an S3 server."""
    found: StoreSettings | Tower = request.getfixturevalue(request.param)
    return opened(found if isinstance(found, StoreSettings) else found.store_settings(), QUICK)


def under_way(store: S3Store, bucket: str) -> list[str]:
    """The keys of the uploads that are neither completed nor aborted."""
    with store._client.requesting(bucket, '') as client:
        return [upload['Key'] for upload in client.list_multipart_uploads(Bucket=bucket).get('Uploads', ())]


def test_a_large_object_is_as_any_other(store: ObjectStore, item: SpooledObject, bucket: str) -> None:
    """Content, type and metadata make the round trip; the same again is a success."""
    assert store.put(item) is Put.CREATED
    assert store.get(bucket, KEY) == CONTENT
    info = store.head(bucket, KEY)
    assert info is not None
    assert (info.size, info.sha256, info.content_type) == (len(CONTENT), item.sha256, 'application/x-mcap')
    assert info.metadata == {'bag': 'patrol', 'slice': '0', 'sha256': item.sha256}
    assert store.put(item) is Put.IDENTICAL
    assert store.pace.sent_bytes == len(CONTENT)


def test_other_large_content_never_overwrites(store: ObjectStore, item: SpooledObject, spool: Spool, bucket: str) -> None:
    """It raises ForeignObject before a byte of it is sent."""
    store.put(item)
    sent = store.pace.sent_bytes
    with pytest.raises(ForeignObject):
        store.put(spool(KEY, CONTENT[::-1]))
    assert store.pace.sent_bytes in {sent, sent + len(CONTENT)}, 'a folder counts what it copied'
    assert store.get(bucket, KEY) == CONTENT


@pytest.mark.parametrize('damage', ['flipped', 'shorter', 'longer'])
def test_a_damaged_large_file_is_never_an_object(
    store: ObjectStore, item: SpooledObject, spool: Spool, bucket: str, damage: str
) -> None:
    """Wherever it differs, it is refused before it is anything in the store."""
    store.put(spool('first', b'makes the bucket'))
    wrong = {'flipped': CONTENT[:-1] + bytes([CONTENT[-1] ^ 1]), 'shorter': CONTENT[:-1], 'longer': CONTENT + b'x'}[damage]
    item.path.write_bytes(wrong)
    with pytest.raises(ObjectRefused) as caught:
        store.put(item)
    assert caught.value.data['reason'] == 'damaged'
    assert store.head(bucket, KEY) is None
    if isinstance(store, S3Store):
        assert under_way(store, bucket) == []


def test_memory_is_bounded(request: pytest.FixtureRequest, store: ObjectStore, item: SpooledObject) -> None:
    """A slice is never in memory as a whole, nor is a part of it."""
    if request.node.callspec.id in {'memory', 'moto'}:
        pytest.skip('the store itself is in this memory')
    store.probe()  # what is imported and opened first is not counted
    tracemalloc.start()
    store.put(item)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 4 * MEBI


def test_what_is_not_large_is_one_request(server: S3Store, spool: Spool, bucket: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Up to the limit an object is put as a whole."""
    monkeypatch.setattr(server._puts, '_multipart', None)
    assert server.put(spool('a', CONTENT[:SMALLEST_PART])) is Put.CREATED
    with pytest.raises(AttributeError):
        server.put(spool('b', CONTENT[: SMALLEST_PART + 1]))


def test_parts_that_are_there_are_not_sent_again(server: S3Store, item: SpooledObject, bucket: str) -> None:
    """A try that ended after two parts is taken up by another store, which sends the third alone."""
    server.put(replace(item, key='other'))
    uploads = server._puts._multipart._uploads
    upload = uploads.begin(item)
    with item.path.open('rb') as file:
        for number, part in enumerate(content.parts(file.fileno(), 2 * SMALLEST_PART, hashlib.sha256()), 1):
            server._s3.put_part(item, upload, number, part)
    sent = server.pace.sent_bytes
    assert server.put(item) is Put.CREATED
    assert server.pace.sent_bytes - sent == len(CONTENT) - 2 * SMALLEST_PART
    assert server.get(bucket, KEY) == CONTENT
    assert under_way(server, bucket) == []


def test_an_upload_of_other_content_is_aborted(server: S3Store, item: SpooledObject, spool: Spool, bucket: str) -> None:
    """So is one without a part: neither may lend its metadata to ours, and both would take room for ever."""
    server.put(replace(item, key='other'))
    uploads = server._puts._multipart._uploads
    other = spool(KEY, CONTENT[::-1])
    upload = uploads.begin(other)
    with other.path.open('rb') as file:
        part = next(content.parts(file.fileno(), other.size, hashlib.sha256()))
        server._s3.put_part(other, upload, 1, part)
    uploads.begin(item)
    uploads.begin(replace(item, key=f'{KEY}2'))
    assert server.put(item) is Put.CREATED
    assert server.get(bucket, KEY) == CONTENT
    assert under_way(server, bucket) == [f'{KEY}2'], 'another key is another matter'


def test_a_key_that_another_writer_took(server: S3Store, item: SpooledObject, spool: Spool, bucket: str) -> None:
    """Whoever wrote it while the parts were sent was first; ours leaves nothing behind."""
    theirs = spool(KEY, b'theirs')
    looks = []

    def poll() -> bool:
        looks.append(server.put(theirs))
        return False  # and the server has the last word

    server.put(spool('a', b'x'))
    assert not server._puts._multipart.put(item, poll)
    assert looks == [Put.CREATED]
    assert server.get(bucket, KEY) == b'theirs'
    assert under_way(server, bucket) == []
    with pytest.raises(ForeignObject):
        server.put(item)


def test_no_file_has_more_parts_than_s3_allows() -> None:
    """From 80 GB on the parts grow."""
    for size in (1, 100 * MEBI, content.MAX_PARTS * content.PART_BYTES, 1 << 40, (1 << 40) + 1):
        step = content.part_bytes(size)
        assert step >= content.PART_BYTES
        assert -(-size // step) <= content.MAX_PARTS


def test_a_part_can_be_read_twice(tmp_path: Path) -> None:
    """Whoever sends it again begins anew; it never reads beyond its end."""
    path = tmp_path / 'file'
    path.write_bytes(bytes(range(100)))
    with path.open('rb') as file:
        part = content.Part(file.fileno(), 10, 20, b'')
        for _ in range(2):
            part.seek(0)
            assert b''.join(iter(lambda: part.read(7), b'')) == bytes(range(10, 30))
