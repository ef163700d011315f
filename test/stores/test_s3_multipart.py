"""Large objects are sent in parts; an interruption costs only the parts in flight."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import tracemalloc
import uuid
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
from faults.front import Front
from faults.kinds import Fault, Script
from shadowhound_tower.embedded import Tower
from shipping.fakes import until
from stores.spooled import MOTO, QUICK, Spool

from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.core.errors import ForeignObject, ObjectRefused, StoreError
from shadowhound_data_logger.core.model import Put, SpooledObject
from shadowhound_data_logger.stores import content, s3_puts
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.s3 import S3Store

MEBI = 1 << 20
SMALLEST_PART = 5 * MEBI
"""The minimum that S3 allows."""
CONTENT = os.urandom(2 * SMALLEST_PART + 12345)
KEY = "thor/rosbags/patrol's(1)+@=/patrol_0.mcap"


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a fraction of a slice count as large."""
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
    """The keys of uploads that are neither completed nor aborted."""
    with store._client.requesting(bucket, '') as client:
        return [upload['Key'] for upload in client.list_multipart_uploads(Bucket=bucket).get('Uploads', ())]


def test_a_large_object_is_stored_like_any_other(store: ObjectStore, item: SpooledObject, bucket: str) -> None:
    """Content, type and metadata are returned unchanged; putting the same again succeeds."""
    assert store.put(item) is Put.CREATED
    assert store.get(bucket, KEY) == CONTENT
    info = store.head(bucket, KEY)
    assert info is not None
    assert (info.size, info.sha256, info.content_type) == (len(CONTENT), item.sha256, 'application/x-mcap')
    assert info.metadata == {'bag': 'patrol', 'slice': '0', 'sha256': item.sha256}
    assert store.put(item) is Put.IDENTICAL
    assert store.pace.sent_bytes == len(CONTENT)


def test_other_large_content_never_overwrites(store: ObjectStore, item: SpooledObject, spool: Spool, bucket: str) -> None:
    """It raises ForeignObject before a byte is sent."""
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
    """Wherever it differs, it is refused before it becomes an object."""
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
    """Neither a complete slice nor a complete part is ever in memory."""
    if request.node.callspec.id in {'memory', 'moto'}:
        pytest.skip('the store itself is in this memory')
    store.probe()  # memory of imports and opening is not counted
    tracemalloc.start()
    store.put(item)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 4 * MEBI


def test_a_small_object_is_one_request(server: S3Store, spool: Spool, bucket: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Up to the limit an object is a single put."""
    monkeypatch.setattr(server._puts, '_multipart', None)
    assert server.put(spool('a', CONTENT[:SMALLEST_PART])) is Put.CREATED
    with pytest.raises(AttributeError):
        server.put(spool('b', CONTENT[: SMALLEST_PART + 1]))


def test_parts_that_are_there_are_not_sent_again(server: S3Store, item: SpooledObject, bucket: str) -> None:
    """After a try that ended with two parts another store continues, and sends only the third."""
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
    """So is one without a part: neither may provide the metadata of ours, and both would use space permanently."""
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


def test_a_key_of_another_writer_is_not_overwritten(server: S3Store, item: SpooledObject, spool: Spool, bucket: str) -> None:
    """An object written while the parts were sent was first; ours leaves nothing behind."""
    theirs = spool(KEY, b'theirs')
    looks = []

    def poll() -> bool:
        looks.append(server.put(theirs))
        return False  # and the server decides

    server.put(spool('a', b'x'))
    assert not server._puts._multipart.put(item, poll)
    assert looks == [Put.CREATED]
    assert server.get(bucket, KEY) == b'theirs'
    assert under_way(server, bucket) == []
    with pytest.raises(ForeignObject):
        server.put(item)


def test_no_file_has_more_parts_than_s3_allows() -> None:
    """Above 80 GB the parts grow."""
    for size in (1, 100 * MEBI, content.MAX_PARTS * content.PART_BYTES, 1 << 40, (1 << 40) + 1):
        step = content.part_bytes(size)
        assert step >= content.PART_BYTES
        assert -(-size // step) <= content.MAX_PARTS


def test_a_part_can_be_read_twice(tmp_path: Path) -> None:
    """A second read starts at the beginning again; it never reads beyond its end."""
    path = tmp_path / 'file'
    path.write_bytes(bytes(range(100)))
    with path.open('rb') as file:
        part = content.Part(file.fileno(), 10, 20, b'')
        for _ in range(2):
            part.seek(0)
            assert b''.join(iter(lambda: part.read(7), b'')) == bytes(range(10, 30))


BUCKET = 'slices'
PART = 5 << 20
SLICE_BYTES = os.urandom(2 * PART + 999)
BEFORE = ('look', 'list', 'begin')
"""The requests before the first part; then three parts, a check and the completion."""
REQUESTS = (*BEFORE, 'part 1', 'part 2', 'part 3', 'look again', 'complete')
TOOK_IT = {Fault.CUT, Fault.ACK_LOST}
TEST = Path(__file__).parents[1]


@pytest.fixture
def front(seaweed: Tower) -> Iterator[Front]:
    with Front(seaweed.endpoint_url, secret=seaweed.store_settings().secret_access_key or '') as standing:
        yield standing


def new_store(seaweed: Tower, front: Front, *, read_timeout_s: float = 20.0) -> S3Store:
    """As a new process."""
    store = S3Store(replace(seaweed.store_settings(), endpoint_url=front.url), UploadSettings(read_timeout_s=read_timeout_s))
    store.open()
    return store


@pytest.fixture
def behind_front(seaweed: Tower, front: Front, tmp_path: Path) -> Iterator[S3Store]:
    opened = new_store(seaweed, front)
    opened.put(Spool(tmp_path, BUCKET)('first', b'makes the bucket'))
    yield opened
    opened.close()


@pytest.fixture
def slice_item(tmp_path: Path) -> SpooledObject:
    return Spool(tmp_path, BUCKET)(f'thor/{uuid.uuid4().hex}_0.mcap', SLICE_BYTES)


def taken(front: Front, slice_item: SpooledObject) -> list[int]:
    """Numbers of the parts that the server accepted, in order, including repeats."""
    found = [(urlsplit(path), len(hashes)) for path, hashes in front.stored.items()]
    path = f'/{BUCKET}/{slice_item.key}'
    numbers = [(parse_qs(url.query).get('partNumber'), count) for url, count in found if url.path == path]
    return sorted(int(number[0]) for number, count in numbers if number for _ in range(count))


def delivered(behind_front: S3Store, slice_item: SpooledObject) -> Put:
    """Put until it succeeds."""
    ends: list[Put] = []

    def works() -> bool:
        with suppress(StoreError):
            ends.append(behind_front.put(slice_item))
        return bool(ends)

    until(works)
    return ends[0]


def left(behind_front: S3Store) -> list[str]:
    with behind_front._client.requesting(BUCKET, '') as client:
        return [upload['Key'] for upload in client.list_multipart_uploads(Bucket=BUCKET).get('Uploads', ())]


MORE = pytest.mark.long('more faults at more requests')


@pytest.mark.seaweedfs
@pytest.mark.parametrize(('fault', 'request_name'), [
    *((Fault.RESET, name) for name in REQUESTS),
    (Fault.ACK_LOST, 'part 2'), (Fault.ACK_LOST, 'complete'), (Fault.SLOW_DOWN, 'part 3'),
    *(pytest.param(*each, marks=MORE) for each in (
        (Fault.ACK_LOST, 'begin'), (Fault.SLOW_DOWN, 'list'), (Fault.SLOW_DOWN, 'complete'),
    )),
])  # fmt: skip
def test_a_fault_at_any_request_costs_only_parts_in_flight(
    behind_front: S3Store, front: Front, seaweed: Tower, slice_item: SpooledObject, fault: Fault, request_name: str
) -> None:
    """The next try completes it; no part is accepted twice, and no upload is left."""
    before = REQUESTS.index(request_name)
    front.script = Script([*[Fault.NONE] * before, fault])
    with pytest.raises(StoreError):
        behind_front.put(slice_item)
    until(lambda: front.is_quiet)
    done = before - len(BEFORE) + (fault in TOOK_IT)
    assert taken(front, slice_item) == list(range(1, min(max(done, 0), 3) + 1))
    sent = behind_front.pace.sent_bytes
    again = new_store(seaweed, front)  # as after a restart: only the server's state is known
    try:
        end = again.put(slice_item)
        assert end is (Put.IDENTICAL if (request_name, fault) == ('complete', Fault.ACK_LOST) else Put.CREATED)
        assert taken(front, slice_item) == [1, 2, 3]
        assert again.pace.sent_bytes == sum([PART, PART, 999][min(max(done, 0), 3) :])
        assert again.get(BUCKET, slice_item.key) == SLICE_BYTES
        assert left(again) == []
    finally:
        again.close()
    assert sent <= len(SLICE_BYTES) + len('makes the bucket') * 2 + PART


@pytest.mark.seaweedfs
@pytest.mark.parametrize(
    'fault',
    [Fault.CUT, Fault.NO_CONDITION, *(pytest.param(fault, marks=MORE) for fault in (Fault.REFUSED, Fault.SKEWED, Fault.PORTAL))],
)
def test_a_permanent_fault_costs_only_parts_in_flight(
    behind_front: S3Store, front: Front, slice_item: SpooledObject, fault: Fault
) -> None:
    """With the same fault at every third request it completes, correctly and once."""
    front.script = Script([fault if number % 3 == 2 else Fault.NONE for number in range(14)])
    assert delivered(behind_front, slice_item) in {Put.CREATED, Put.IDENTICAL}
    until(lambda: front.is_quiet)
    front.script = Script()
    assert behind_front.get(BUCKET, slice_item.key) == SLICE_BYTES
    assert left(behind_front) == []


@pytest.mark.seaweedfs
def test_a_server_that_hangs_in_a_part_costs_that_part(
    behind_front: S3Store, front: Front, seaweed: Tower, slice_item: SpooledObject
) -> None:
    """The part is abandoned after the timeout, and the earlier ones stay."""
    front.script = Script([*[Fault.NONE] * (len(BEFORE) + 1), Fault.HUNG])
    impatient = new_store(seaweed, front, read_timeout_s=0.5)
    try:
        with pytest.raises(StoreError, match=r'gave no answer within 0\.5 s'):
            impatient.put(slice_item)
    finally:
        impatient.close()
    assert taken(front, slice_item) == [1]
    assert behind_front.put(slice_item) is Put.CREATED
    assert taken(front, slice_item) == [1, 2, 3]


@pytest.mark.seaweedfs
def test_a_kill_between_parts_resumes_the_upload(
    behind_front: S3Store, front: Front, seaweed: Tower, slice_item: SpooledObject
) -> None:
    """After a process was killed with two of three parts delivered, its successor only sends the third."""
    program = f"""
from pathlib import Path, PosixPath
from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.stores import content, s3, s3_puts
content.PART_BYTES = s3_puts.MULTIPART_BYTES = {PART}
store = s3.S3Store(StoreSettings(endpoint_url={front.url!r}), UploadSettings())
store.open()
store.put({slice_item!r})
"""
    front.script = script = Script([*[Fault.NONE] * (len(BEFORE) + 2), Fault.HUNG])
    path = os.pathsep.join((str(TEST.parent), os.environ.get('PYTHONPATH', '')))
    environment = {**os.environ, **seaweed.environment(), 'PYTHONPATH': path}
    with subprocess.Popen([sys.executable, '-c', program], env=environment) as process:
        until(lambda: script.counts[Fault.HUNG] or process.poll() is not None)  # the third part has arrived, but is not forwarded
        process.send_signal(signal.SIGKILL)
    assert taken(front, slice_item) == [1, 2]
    front.script = Script()
    sent = behind_front.pace.sent_bytes
    assert behind_front.put(slice_item) is Put.CREATED
    assert taken(front, slice_item) == [1, 2, 3]
    assert behind_front.pace.sent_bytes - sent == 999
    assert behind_front.get(BUCKET, slice_item.key) == SLICE_BYTES
    assert hashlib.sha256(SLICE_BYTES).hexdigest() == slice_item.sha256
