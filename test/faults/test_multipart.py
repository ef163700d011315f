"""A slice on a bad day: what ends its upload costs the parts that were under way, never one that the server has."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import uuid
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
from faults.front import Front
from faults.kinds import Fault, Script
from shadowhound_tower.embedded import Tower
from shipping.fakes import until
from stores.spooled import Spool

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import StoreError
from shadowhound_data_logger.core.model import Put, SpooledObject
from shadowhound_data_logger.stores import content, s3_puts
from shadowhound_data_logger.stores.s3 import S3Store

pytestmark = pytest.mark.seaweedfs

BUCKET = 'slices'
PART = 5 << 20
CONTENT = os.urandom(2 * PART + 999)
BEFORE = ('look', 'list', 'begin')
"""The requests before the first part; three parts follow, a look and the end."""
REQUESTS = (*BEFORE, 'part 1', 'part 2', 'part 3', 'look again', 'complete')
TOOK_IT = {Fault.CUT, Fault.ACK_LOST}
TEST = Path(__file__).parents[1]


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(s3_puts, 'MULTIPART_BYTES', PART)
    monkeypatch.setattr(content, 'PART_BYTES', PART)


@pytest.fixture
def front(seaweed: Tower) -> Iterator[Front]:
    with Front(seaweed.endpoint_url, secret=seaweed.store_settings().secret_access_key or '') as standing:
        yield standing


def new_store(seaweed: Tower, front: Front, *, read_timeout_s: float = 20.0) -> S3Store:
    """As a process that begins."""
    store = S3Store(replace(seaweed.store_settings(), endpoint_url=front.url), UploadSettings(read_timeout_s=read_timeout_s))
    store.open()
    return store


@pytest.fixture
def store(seaweed: Tower, front: Front, tmp_path: Path) -> Iterator[S3Store]:
    opened = new_store(seaweed, front)
    opened.put(Spool(tmp_path, BUCKET)('first', b'makes the bucket'))
    yield opened
    opened.close()


@pytest.fixture
def item(tmp_path: Path) -> SpooledObject:
    return Spool(tmp_path, BUCKET)(f'thor/{uuid.uuid4().hex}_0.mcap', CONTENT)


def taken(front: Front, item: SpooledObject) -> list[int]:
    """Numbers of the parts that the server took, in order, repeats among them."""
    found = [(urlsplit(path), len(hashes)) for path, hashes in front.stored.items()]
    numbers = [(parse_qs(url.query).get('partNumber'), count) for url, count in found if url.path == f'/{BUCKET}/{item.key}']
    return sorted(int(number[0]) for number, count in numbers if number for _ in range(count))


def delivered(store: S3Store, item: SpooledObject) -> Put:
    """Put until it works."""
    ends: list[Put] = []

    def works() -> bool:
        with suppress(StoreError):
            ends.append(store.put(item))
        return bool(ends)

    until(works)
    return ends[0]


def left(store: S3Store) -> list[str]:
    with store._client.requesting(BUCKET, '') as client:
        return [upload['Key'] for upload in client.list_multipart_uploads(Bucket=BUCKET).get('Uploads', ())]


MORE = pytest.mark.long('more faults at more requests')


@pytest.mark.parametrize(('fault', 'request_name'), [
    *((Fault.RESET, name) for name in REQUESTS),
    (Fault.ACK_LOST, 'part 2'), (Fault.ACK_LOST, 'complete'), (Fault.SLOW_DOWN, 'part 3'),
    *(pytest.param(*each, marks=MORE) for each in (
        (Fault.ACK_LOST, 'begin'), (Fault.SLOW_DOWN, 'list'), (Fault.SLOW_DOWN, 'complete'),
    )),
])  # fmt: skip
def test_a_fault_at_any_request(
    store: S3Store, front: Front, seaweed: Tower, item: SpooledObject, fault: Fault, request_name: str
) -> None:
    """The next try ends it; of the parts none is taken twice, and no upload is left."""
    before = REQUESTS.index(request_name)
    front.script = Script([*[Fault.NONE] * before, fault])
    with pytest.raises(StoreError):
        store.put(item)
    until(lambda: front.is_quiet)
    done = before - len(BEFORE) + (fault in TOOK_IT)
    assert taken(front, item) == list(range(1, min(max(done, 0), 3) + 1))
    sent = store.pace.sent_bytes
    again = new_store(seaweed, front)  # as after a restart: all that is known is what the server tells
    try:
        end = again.put(item)
        assert end is (Put.IDENTICAL if (request_name, fault) == ('complete', Fault.ACK_LOST) else Put.CREATED)
        assert taken(front, item) == [1, 2, 3]
        assert again.pace.sent_bytes == sum([PART, PART, 999][min(max(done, 0), 3) :])
        assert again.get(BUCKET, item.key) == CONTENT
        assert left(again) == []
    finally:
        again.close()
    assert sent <= len(CONTENT) + len('makes the bucket') * 2 + PART


@pytest.mark.parametrize(
    'fault',
    [Fault.CUT, Fault.NO_CONDITION, *(pytest.param(fault, marks=MORE) for fault in (Fault.REFUSED, Fault.SKEWED, Fault.PORTAL))],
)
def test_a_bad_day(store: S3Store, front: Front, item: SpooledObject, fault: Fault) -> None:
    """With the same fault at every third request it gets there, whole and once."""
    front.script = Script([fault if number % 3 == 2 else Fault.NONE for number in range(14)])
    assert delivered(store, item) in {Put.CREATED, Put.IDENTICAL}
    until(lambda: front.is_quiet)
    front.script = Script()
    assert store.get(BUCKET, item.key) == CONTENT
    assert left(store) == []


def test_a_server_that_hangs_in_a_part(store: S3Store, front: Front, seaweed: Tower, item: SpooledObject) -> None:
    """It is given up after the timeout, and the parts before it stay."""
    front.script = Script([*[Fault.NONE] * (len(BEFORE) + 1), Fault.HUNG])
    impatient = new_store(seaweed, front, read_timeout_s=0.5)
    try:
        with pytest.raises(StoreError, match=r'gave no answer within 0\.5 s'):
            impatient.put(item)
    finally:
        impatient.close()
    assert taken(front, item) == [1]
    assert store.put(item) is Put.CREATED
    assert taken(front, item) == [1, 2, 3]


def test_kill_between_parts(store: S3Store, front: Front, seaweed: Tower, item: SpooledObject) -> None:
    """A process that dies with two of three parts delivered leaves its successor the third."""
    program = f"""
from pathlib import Path, PosixPath
from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.core.model import SpooledObject
from shadowhound_data_logger.stores import content, s3, s3_puts
content.PART_BYTES = s3_puts.MULTIPART_BYTES = {PART}
store = s3.S3Store(StoreSettings(endpoint_url={front.url!r}), UploadSettings())
store.open()
store.put({item!r})
"""
    front.script = script = Script([*[Fault.NONE] * (len(BEFORE) + 2), Fault.HUNG])
    path = os.pathsep.join((str(TEST.parent), os.environ.get('PYTHONPATH', '')))
    environment = {**os.environ, **seaweed.environment(), 'PYTHONPATH': path}
    with subprocess.Popen([sys.executable, '-c', program], env=environment) as process:
        until(lambda: script.counts[Fault.HUNG] or process.poll() is not None)  # the third part has come, and goes no further
        process.send_signal(signal.SIGKILL)
    assert taken(front, item) == [1, 2]
    front.script = Script()
    sent = store.pace.sent_bytes
    assert store.put(item) is Put.CREATED
    assert taken(front, item) == [1, 2, 3]
    assert store.pace.sent_bytes - sent == 999
    assert store.get(BUCKET, item.key) == CONTENT
    assert hashlib.sha256(CONTENT).hexdigest() == item.sha256
