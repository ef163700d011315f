"""Every store behind one fixture, and objects to put into it."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path

import pytest
from botocore.exceptions import ClientError
from shadowhound_tower.embedded import Tower
from stores.asking import settings_for
from stores.memory import MemoryStore
from stores.spooled import MOTO, QUICK, Spool

from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.stores import open_reader, open_store
from shadowhound_data_logger.stores.base import ObjectStore
from shadowhound_data_logger.stores.s3 import S3Store

STORES = ('memory', 'directory', MOTO, pytest.param('seaweed', marks=pytest.mark.seaweedfs),
          pytest.param('obstore', marks=pytest.mark.seaweedfs))  # fmt: skip


@pytest.fixture
def bucket() -> str:
    """A bucket that does not exist yet."""
    return f'bucket-{uuid.uuid4().hex[:12]}'


@pytest.fixture
def spool(tmp_path: Path, bucket: str) -> Spool:
    """Makes spooled objects, for ``bucket`` by default."""
    return Spool(tmp_path, bucket)


@pytest.fixture(scope='session')
def moto() -> Iterator[StoreSettings]:
    """A moto server, over real HTTP."""
    from moto.server import ThreadedMotoServer  # takes half a second, not needed to collect tests

    server = ThreadedMotoServer(ip_address='127.0.0.1', port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield StoreSettings(endpoint_url=f'http://{host}:{port}', access_key_id='any', secret_access_key='any')
    server.stop()


@pytest.fixture(scope='module')
def owner(seaweed: Tower) -> Iterator[S3Store]:
    """A client that may delete buckets."""
    with closing(S3Store(seaweed.store_settings(), QUICK)) as opened:
        opened.open()
        yield opened


@pytest.fixture(params=STORES)
def store(request: pytest.FixtureRequest, tmp_path: Path, bucket: str) -> Iterator[ObjectStore]:
    """An open store of each kind."""
    if request.param in {'seaweed', 'obstore'}:
        owner: S3Store = request.getfixturevalue('owner')
    opened: ObjectStore = MemoryStore()
    if request.param == 'directory':
        opened = open_store(StoreSettings(directory=tmp_path / 'store'), QUICK)
    elif request.param == 'moto':
        opened = open_store(request.getfixturevalue('moto'), QUICK)
    elif request.param == 'seaweed':
        tower: Tower = request.getfixturevalue('seaweed')
        opened = open_store(tower.store_settings(), QUICK)
    elif request.param == 'obstore':
        tower = request.getfixturevalue('seaweed')
        opened = open_reader(tower.store_settings())
    yield opened
    opened.close()
    if request.param in {'seaweed', 'obstore'}:  # a server has room for a limited number of buckets
        with suppress(ClientError):
            owner._client._client.delete_bucket(Bucket=bucket)


@pytest.fixture
def opened() -> Iterator[Callable[..., S3Store]]:
    """Opens stores and closes them afterwards."""
    stores: list[S3Store] = []

    def make(settings: StoreSettings | str, upload: UploadSettings = QUICK) -> S3Store:
        stores.append(S3Store(settings_for(settings) if isinstance(settings, str) else settings, upload))
        stores[-1].open()
        return stores[-1]

    yield make
    for store in stores:
        store.close()
