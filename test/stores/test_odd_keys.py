"""Keys that other programs made and that are no paths: a store with them is listed and read like one without."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import boto3
import pytest
from botocore.config import Config
from botocore.exceptions import ClientError
from shadowhound_tower.embedded import Tower
from stores.spooled import MOTO, QUICK

from shadowhound_data_logger.core.config import StoreSettings
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.fetch import fetch, under
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.reindex import reindex
from shadowhound_data_logger.stores import open_reader, open_store
from shadowhound_data_logger.stores.base import ObjectStore

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


def client_of(settings: StoreSettings) -> Any:
    return boto3.client(
        's3',
        endpoint_url=settings.endpoint_url,
        region_name='us-east-1',
        config=Config(s3={'addressing_style': 'path'}),
        aws_access_key_id=settings.access_key_id,
        aws_secret_access_key=settings.secret_access_key,
    )


@pytest.fixture(params=[MOTO, SEAWEED])
def settings(request: pytest.FixtureRequest) -> StoreSettings:
    """A server, over real HTTP."""
    if request.param == 'seaweed':
        tower: Tower = request.getfixturevalue('seaweed')
        return tower.store_settings()
    found: StoreSettings = request.getfixturevalue('moto')
    return found


@pytest.fixture
def emptied(settings: StoreSettings, bucket: str) -> Iterator[Callable[..., list[str]]]:
    """Fills the bucket and says which keys the server has then; deletes it afterwards."""
    client = client_of(settings)
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
@pytest.mark.parametrize('opened', [open_reader, lambda settings: open_store(settings, QUICK)], ids=['obstore', 'botocore'])
def test_a_listing_skips_and_names_them(
    settings: StoreSettings, emptied: Callable[..., list[str]], bucket: str, odd: str, opened: Callable[..., ObjectStore]
) -> None:
    """The others are listed, and below a prefix of theirs; what the server made another name of is no odd key."""
    there = emptied(*GOOD, ODD[odd])
    skipped: list[tuple[str, str]] = []
    with closing(opened(settings)) as store:
        for prefix in ('', 'thor/', 'thor/camera/'):
            skipped.clear()
            found = [info.key for info in store.list(bucket, prefix, lambda *where: skipped.append(where))]
            assert set(GOOD) <= set(found)
            assert sorted([*found, *(key for _, key in skipped)]) == sorted(key for key in there if key.startswith(prefix))
            assert {where for where, _ in skipped} <= {bucket}
            assert all(key == ODD[odd] for _, key in skipped)
        assert 'camera' in store.folders(bucket, 'thor/')
        assert not {'', '.', '..'} & {*store.folders(bucket, 'thor/'), *store.folders(bucket, 'thor/camera/')}


def test_fetch_serves_the_rest(settings: StoreSettings, emptied: Callable[..., list[str]], bucket: str, tmp_path: Path) -> None:
    """Every object with a path is fetched; each of the others is counted as failed, under its own name."""
    there = emptied(*GOOD, *ODD.values())
    odd = {key for key in there if key in ODD.values()}
    with closing(open_reader(settings)) as store:
        result = fetch(under(Bucket(settings, bucket), 'thor/'), tmp_path, store)
    assert result.failed == {f'{bucket}/{key}': 'its key is not a path' for key in odd}
    assert result.moved == len(there) - len(odd)
    assert all((tmp_path / key).read_bytes() == key.encode() for key in GOOD)


def test_reindex_names_them(settings: StoreSettings, emptied: Callable[..., list[str]], bucket: str) -> None:
    """The rows of the others are added, and what is left out is in the findings."""
    there = emptied(*GOOD, *ODD.values())
    odd = {f'{bucket}/{key}' for key in there if key in ODD.values()}
    findings = Findings(lambda _: None)
    source = Bucket(settings, bucket)
    with closing(open_store(settings, QUICK)) as store:
        found = reindex(source, store, 'thor', buckets=(bucket,), findings=findings)
    assert {one.key for one in findings} == odd
    assert found.listed == len(there) - len(odd)


def test_a_folder_with_them(tmp_path: Path, bucket: str) -> None:
    """Of a store that is a folder: files with control characters in their names, and with bytes that are not UTF-8."""
    for key in GOOD:
        (tmp_path / bucket / key).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / bucket / key).write_bytes(key.encode())
    odd = ['thor/camera/a\nb.jpg', 'thor/camera/\udcff.jpg', 'thor/odd\x07/a.jpg']
    (tmp_path / bucket / 'thor/odd\x07').mkdir()
    for key in odd:
        (tmp_path / bucket / key).write_bytes(b'x')
    settings = StoreSettings(directory=tmp_path)
    with closing(open_reader(settings)) as store:
        assert store.folders(bucket, 'thor/') == ['camera']
        result = fetch(under(Bucket(settings, bucket), 'thor/'), tmp_path / 'to', store)
    assert result.moved == len(GOOD)
    assert set(result.failed) == {f'{bucket}/{key}' for key in odd}


def test_each_is_logged_once(tmp_path: Path, bucket: str, caplog: pytest.LogCaptureFixture) -> None:
    """Without anybody who counts them they are in the log, with their control characters escaped."""
    (tmp_path / bucket).mkdir()
    (tmp_path / bucket / 'a\nb').write_bytes(b'x')
    with closing(open_reader(StoreSettings(directory=tmp_path))) as store:
        assert [*store.list(bucket), *store.list(bucket)] == []
    assert [record.getMessage() for record in caplog.records] == [f'{bucket}/a\\nb is skipped: its key is not a path']
