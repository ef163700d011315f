"""Large objects with a robot's own keys, on a Tower as it is set up: sent in parts, and taken up again after a kill."""

from __future__ import annotations

import hashlib
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from botocore.exceptions import ClientError
from faults.front import Front
from faults.kinds import Fault
from faults.upstream import Request
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.model import Put, SpooledObject
from shadowhound_data_logger.stores import content, s3_puts
from shadowhound_data_logger.stores.s3 import S3Store

pytestmark = pytest.mark.seaweedfs
PART = 5 << 20
CONTENT = random.Random(1).randbytes(4 * PART + 12_345)
KEY = 'thor/rosbags/patrol_20261121_120000/patrol_20261121_120000_0.mcap'
PARTS = [1, 2, 3, 4, 5]
BEFORE = 2
"""Parts that are there when the robot loses its power."""
PROGRAM = """
import sys
from pathlib import Path
from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.stores import content, s3, s3_puts
sys.path.insert(0, sys.argv[1])
from tower.test_parts import KEY, PART, slice_of
content.PART_BYTES = s3_puts.MULTIPART_BYTES = PART
settings = StoreSettings(endpoint_url=sys.argv[3], access_key_id=sys.argv[4], secret_access_key=sys.argv[5])
store = s3.S3Store(settings, UploadSettings())
store.open()
store.put(slice_of(Path(sys.argv[2])))
"""


class Watching(Front):
    """Knows which parts were sent and what else was asked for, and answers nothing more after so many parts."""

    def __init__(self, url: str, most: int) -> None:
        super().__init__(url, lambda: Fault.HUNG if len(self.sent) >= most else Fault.NONE)
        self.sent: list[int] = []
        self.asked: list[str] = []

    def forward(self, request: Request, *, slowly: bool = False) -> bytes:
        answer = super().forward(request, slowly=slowly)
        self.asked.append(f'{request.method} {answer.split()[1].decode()}')
        if number := re.search(r'partNumber=(\d+)', request.target):
            self.sent.append(int(number[1]))
        return answer


def slice_of(path: Path, key: str = KEY) -> SpooledObject:
    """What the file holds, as an object of the spool."""
    body = path.read_bytes()
    sha256 = hashlib.sha256(body).hexdigest()
    return SpooledObject(1, 'sensor-data', key, path, len(body), sha256, 'application/x-mcap', {'sensor': 'rosbags'}, 5, 0)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / 'slice.mcap'
    path.write_bytes(CONTENT)
    return path


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is large here is a fraction of a slice."""
    monkeypatch.setattr(s3_puts, 'MULTIPART_BYTES', PART)
    monkeypatch.setattr(content, 'PART_BYTES', PART)


@pytest.fixture
def through(server: Tower) -> Iterator[Callable[[Front], S3Store]]:
    """A store with the keys of thor, by way of a front."""
    opened: list[S3Store] = []

    def make(front: Front) -> S3Store:
        settings = replace(server.store_settings('thor'), endpoint_url=front.url)
        opened.append(S3Store(settings, UploadSettings()))
        opened[-1].open()
        return opened[-1]

    yield make
    for store in opened:
        store.close()


def under_way(client: Any, prefix: str = '') -> list[str]:
    return [upload['Key'] for upload in client.list_multipart_uploads(Bucket='sensor-data', Prefix=prefix).get('Uploads', ())]


@pytest.mark.long('a kill')
def test_a_slice_that_a_kill_interrupted(
    server: Tower, as_user: Callable[[str], Any], through: Callable[[Front], S3Store], file: Path
) -> None:
    """The parts that are there are not sent again, nothing is denied on the way, and no upload stays behind."""
    given = server.environment('thor')
    with Watching(server.endpoint_url, BEFORE) as front:
        keys = (given['AWS_ACCESS_KEY_ID'], given['AWS_SECRET_ACCESS_KEY'])
        command = [sys.executable, '-c', PROGRAM, str(Path(__file__).parents[1]), str(file), front.url, *keys]
        with subprocess.Popen(command, env={**os.environ, **given}) as process:
            end = time.monotonic() + 60
            while len(front.sent) < BEFORE:
                assert time.monotonic() < end, 'nothing is sent'
                assert process.poll() is None
                time.sleep(0.02)
            process.send_signal(signal.SIGKILL)
        assert front.sent == PARTS[:BEFORE]
    tower = as_user('tower')
    assert under_way(tower, KEY) == [KEY]
    with Watching(server.endpoint_url, sys.maxsize) as front:
        store = through(front)
        assert store.put(slice_of(file)) is Put.CREATED
        assert front.sent == PARTS[BEFORE:]
        assert not [asked for asked in front.asked if asked.endswith('403')]
        assert store.put(slice_of(file)) is Put.IDENTICAL
    found = tower.get_object(Bucket='sensor-data', Key=KEY)
    assert hashlib.sha256(found['Body'].read()).digest() == hashlib.sha256(CONTENT).digest()
    assert found['Metadata']['sha256'] == hashlib.sha256(CONTENT).hexdigest()
    assert under_way(tower, KEY) == []


def test_an_upload_of_other_content_is_aborted(
    as_user: Callable[[str], Any], server: Tower, through: Callable[[Front], S3Store], file: Path
) -> None:
    """The policy against deleting does not keep a robot from ending its own uploads."""
    key = f'{KEY}.other'
    thor = as_user('thor')
    upload = thor.create_multipart_upload(Bucket='sensor-data', Key=key)['UploadId']
    thor.upload_part(Bucket='sensor-data', Key=key, UploadId=upload, PartNumber=1, Body=bytes(PART))
    with Watching(server.endpoint_url, sys.maxsize) as front:
        assert through(front).put(slice_of(file, key)) is Put.CREATED
        assert 'DELETE 204' in front.asked
    assert under_way(as_user('tower'), key) == []


def test_uploads_of_others_are_ignored(as_user: Callable[[str], Any]) -> None:
    """It can neither take part in them nor see their parts nor end them."""
    tachi, thor, key = as_user('tachi'), as_user('thor'), 'tachi/rosbags/a.mcap'
    upload = tachi.create_multipart_upload(Bucket='sensor-data', Key=key)['UploadId']
    what = {'Bucket': 'sensor-data', 'Key': key, 'UploadId': upload}
    tachi.upload_part(**what, PartNumber=1, Body=b'one')
    for ask, more in (
        (thor.upload_part, {'PartNumber': 1, 'Body': b'two'}), (thor.list_parts, {}), (thor.abort_multipart_upload, {}),
        (thor.complete_multipart_upload, {'MultipartUpload': {'Parts': [{'PartNumber': 1, 'ETag': 'x'}]}}),
    ):  # fmt: skip
        with pytest.raises(ClientError) as caught:
            ask(**what, **more)
        assert caught.value.response['ResponseMetadata']['HTTPStatusCode'] == 403
    assert under_way(as_user('tower'), key) == [key]
    tachi.abort_multipart_upload(**what)
