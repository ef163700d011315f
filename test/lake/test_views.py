"""A query of a shared lake sees every row once: from the tables, and from row files that are not in them yet."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import boto3
import pytest
from deltalake.exceptions import DeltaError
from lake.making import DAY_NS, FAILED, NOON_NS, add_part, fill, folder_store, keys, merge, row
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger import lake
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.formats.rows import catalog
from shadowhound_data_logger.lake import prune
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.ingest import ingest, maintain
from shadowhound_data_logger.lake.tables import OBJECT_ROWS, TABLES, Tables, answer, engine
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.base import ObjectStore

pytestmark = pytest.mark.seaweedfs


@pytest.fixture(scope='module')
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tower]:
    """With a reader without write permission."""
    with Tower(tmp_path_factory.mktemp('tower'), users={'spark': ('Read', 'List')}) as started:
        yield started


@pytest.fixture
def server(running: Tower, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Tower]:
    """Without buckets, and with a new home for tables."""
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path / 'home'))
    yield running
    with closing(client_of(running)) as client:
        for bucket in client.list_buckets()['Buckets']:
            for page in client.get_paginator('list_objects_v2').paginate(Bucket=bucket['Name']):
                if objects := [{'Key': each['Key']} for each in page.get('Contents', ())]:
                    client.delete_objects(Bucket=bucket['Name'], Delete={'Objects': objects})
            client.delete_bucket(Bucket=bucket['Name'])


def client_of(server: Tower) -> Any:
    settings = server.store_settings()
    return boto3.client('s3', endpoint_url=settings.endpoint_url, aws_access_key_id=settings.access_key_id,
                        aws_secret_access_key=settings.secret_access_key, region_name=settings.region)  # fmt: skip


def with_bucket(server: Tower) -> None:
    with closing(client_of(server)) as client:
        client.create_bucket(Bucket='lake')


def of(server: Tower, user: str) -> Bucket:
    return Bucket(server.store_settings(user), catalog.BUCKET)


def found(source: Bucket, **flags: object) -> list[str]:
    return sorted(lake.objects(source, **flags)['key'].to_pylist())


def test_before_during_and_after_ingestion_a_reader_sees_each_row_once(server: Tower, tmp_path: Path) -> None:
    """From its tables without the bucket; then from row files; then from both; then from the tables alone."""
    rows = fill(server.store_settings(), tmp_path / 'tmp')
    reader, owner = of(server, 'spark'), of(server, 'tower')
    assert not Tables.for_ingest(owner).is_shared
    assert found(reader) == keys(rows)
    with_bucket(server)
    with pytest.raises(LakeError, match='privileges'):
        Tables.for_ingest(reader)
    tables = Tables.for_ingest(owner)
    assert tables.is_shared
    assert found(reader) == keys(rows)
    assert ingest(owner, tables, Findings()).rows == len(rows)
    late = [row('odom', NOON_NS + 3 * SECOND + number) for number in range(2)]
    with closing(open_store(server.store_settings(), UploadSettings())) as store:
        add_part(store, late, 'late', tmp_path / 'tmp')
    assert found(reader) == keys([*rows, *late])
    ingest(owner, tables, Findings())
    later = datetime.now(timezone.utc) + timedelta(hours=2)
    assert maintain(owner, tables, Findings(), now=later).expired == 49
    assert reader.list('thor/_catalog/') == []
    assert found(reader) == keys([*rows, *late])


def test_a_query_as_of_a_time_sees_what_the_tables_had_then(server: Tower, tmp_path: Path) -> None:
    """Not rows ingested later, and none of row files."""
    rows = fill(server.store_settings(), tmp_path / 'tmp', days=(0,))
    with_bucket(server)
    owner = of(server, 'tower')
    tables = Tables.for_ingest(owner)
    ingest(owner, tables, Findings())
    then = datetime.now(timezone.utc)
    while datetime.now(timezone.utc) < then.replace(microsecond=0) + timedelta(seconds=1):  # the dates of commits in SeaweedFS
        time.sleep(0.05)
    more = [row('odom', NOON_NS + 3 * SECOND + number) for number in range(2)]
    with closing(open_store(server.store_settings(), UploadSettings())) as store:
        add_part(store, more, 'more', tmp_path / 'tmp')
    assert found(owner, as_of=then) == keys(rows)
    ingest(owner, tables, Findings())
    assert found(owner, as_of=then) == keys(rows)
    assert found(owner) == keys([*rows, *more])
    assert lake.sql('SELECT count(*) AS n FROM objects', owner, as_of=then).to_pylist() == [{'n': len(rows)}]
    owner.delete(f'thor/missions/run-{FAILED}/summary.json')
    assert lake.missions(owner, as_of=then, success=False)['mission_id'].to_pylist() == [FAILED]


def test_an_object_is_deleted_after_the_tables_name_it_as_deleted(server: Tower, tmp_path: Path) -> None:
    """A reader of the tables alone, such as DuckDB, expects no missing object; row files about deleted objects are kept."""
    rows = fill(server.store_settings(), tmp_path / 'tmp', days=(0,), hours=(11,))
    with_bucket(server)
    owner = of(server, 'tower')
    tables = Tables.for_ingest(owner)
    ingest(owner, tables, Findings())
    named: list[set[str]] = []

    class Watching:
        def __init__(self, inner: ObjectStore) -> None:
            self.put = inner.put

        def delete(self, _: str, key: str) -> None:
            with engine({'forgotten': tables.open(TABLES['_forgotten'])}) as ready:
                named.append({key, *answer(ready, 'SELECT key FROM forgotten')['key'].to_pylist()})

    rules = prune.keep_rules('camera 1d', NOON_NS + 9 * DAY_NS)
    made = prune.plan(owner, rules, exported={}, findings=Findings())
    with closing(open_store(server.store_settings(), UploadSettings())) as store:
        watching: Any = Watching(store)
        prune.apply(owner, watching, made, now_ns=NOON_NS + 9 * DAY_NS, findings=Findings())
    cameras = {row['key'] for row in rows if row['sensor'] == 'camera'}
    assert named == [cameras] * len(cameras)
    maintain(owner, tables, Findings(), now=datetime.now(timezone.utc) + timedelta(hours=2))
    assert len(owner.list('_forgotten/thor/')) == 2
    assert found(owner) == sorted({row['key'] for row in rows} - cameras)


def test_vacuum_keeps_what_a_query_as_of_a_time_within_the_last_month_needs(tmp_path: Path) -> None:
    """Merged files are not deleted before that."""
    source = Bucket(folder_store(tmp_path), catalog.BUCKET)
    fill(source.settings, tmp_path / 'tmp', days=(0,))
    lake.objects(source)
    merge(source.settings)
    opened = Tables.of(source).open(OBJECT_ROWS)
    with pytest.raises(DeltaError, match='720 hours'):
        opened.vacuum(retention_hours=29 * 24)
    first = Tables.of(source).open(OBJECT_ROWS, 1)
    assert len(first.to_pyarrow_table()) > 0
