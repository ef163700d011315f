"""A healthy robot for each test, also with a Tower."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from doctor.scene import Scene, patient, scenes
from shadowhound_tower.embedded import Tower
from shared_tower import BUCKETS

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.doctor import s3, s3_put
from shadowhound_data_logger.stores.s3_client import S3Client
from shadowhound_data_logger.stores.s3_requests import S3Requests


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[Scene]:
    yield from scenes(tmp_path)


@pytest.fixture(scope='module')
def servers(tower: Tower) -> Tower:
    """A correct Tower: the guide's buckets, a key pair with minimal permissions for Thor, one that reads for Spark."""
    client = S3Client(tower.store_settings(), UploadSettings())
    client.open()
    for bucket in BUCKETS:
        S3Requests(client).create_bucket(bucket)
    client.close()
    return tower


@pytest.fixture
def with_tower(scene: Scene, servers: Tower) -> Scene:
    """With Thor's keys. Other tests load the machine: its speed is not checked here."""
    patch = scene.stack.enter_context(pytest.MonkeyPatch.context())
    patch.setattr(s3_put, 'SLOW_MBPS', 0.0)
    patch.setattr(s3, 'SLOW_S', 60.0)
    scene.stack.enter_context(patient(60.0))
    scene.environ |= servers.environment('thor')
    return scene
