"""Findings about an S3 server, with that of a Tower, and about a server on which clients create one object concurrently."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import pytest
from doctor.scene import Scene, assert_finding
from doctor.test_network import imitated
from e2e.processes import until
from open_seaweed import open_seaweed
from shadowhound_tower.embedded import Tower
from shared_tower import BUCKETS
from stores.fake_s3 import FakeS3, served
from tower_scripts import make_secrets

from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.doctor import s3
from shadowhound_data_logger.doctor.model import Result, Role, Severity
from shadowhound_data_logger.doctor.s3_put import single_requests
from shadowhound_data_logger.stores.s3_client import S3Client
from shadowhound_data_logger.stores.s3_requests import S3Requests


@pytest.mark.seaweedfs
def test_probe_objects_do_not_pile_up(with_tower: Scene, servers: Tower) -> None:
    """However often the robot checks, there is one in each bucket; Tower's own is deleted again."""
    for role, user in ((Role.ROBOT, 'thor'), (Role.ROBOT, 'thor'), (Role.SERVER, 'tower')):
        with_tower.role = role
        with_tower.environ |= servers.environment(user)
        assert with_tower.findings('s3') == []
    client = S3Client(servers.store_settings(), UploadSettings())
    client.open()
    expected = ['_requests/_doctor/inbox.json', *['thor/_doctor/probe'] * 2]

    def probes() -> list[str]:
        found = [item.key for bucket in BUCKETS for item in S3Requests(client).list(bucket, '') if '_doctor/' in item.key]
        return [key for key in found if not key.endswith('/_doctor/probe.txt')]  # an artifact, of the check of MLflow

    until(lambda: probes() == expected, lambda: f'no other objects of the doctor: {probes()}')  # other tests share the server
    client.close()


@pytest.mark.seaweedfs
def test_a_seaweedfs_without_keys_is_named(with_tower: Scene, tmp_path: Path) -> None:
    """Each server that responds without keys, once, with the remedy; with the signing keys alone, those that still do."""
    with open_seaweed(tmp_path / 'open') as ports:
        with_tower.environ['AWS_ENDPOINT_URL'] = f'http://127.0.0.1:{ports["s3"]}'
        found = with_tower.findings('network.s3', 'seaweedfs')
        assert_finding(found, 'seaweedfs.open', 'make tower-secrets', 'docs/tower.md')
        assert set(found[0].data['ports']) >= {ports[name] + 10_000 for name in ('s3', 'filer', 'master', 'volume')}
    (tmp_path / 'security.toml').write_text(make_secrets.signing_keys())
    with open_seaweed(tmp_path / 'signed', tmp_path) as ports:
        with_tower.environ['AWS_ENDPOINT_URL'] = f'http://127.0.0.1:{ports["s3"]}'
        (found_again,) = with_tower.findings('network.s3', 'seaweedfs')
        assert ports['s3'] + 10_000 not in found_again.data['ports']
        assert ports['filer'] + 10_000 in found_again.data['ports']


@pytest.mark.seaweedfs
def test_keys_without_rights_are_named_for_each_bucket(with_tower: Scene, servers: Tower) -> None:
    """Each bucket is named, with the policy that it needs."""
    with_tower.environ |= servers.environment('stranger')
    found = with_tower.findings('s3')
    assert {result.check for result in found} == {'s3.write'}
    assert all('s3:PutObject' in result.remedy for result in found)


@pytest.mark.seaweedfs
def test_a_server_that_verifies_nothing_is_a_finding(with_tower: Scene) -> None:
    """Neither checksums nor signatures: both guarantees that a put relies on are tested."""
    imitated()(with_tower)
    assert {result.check for result in with_tower.findings('s3')} == {'s3.checksum', 's3.open'}


@pytest.mark.seaweedfs
def test_minio_is_mentioned_without_a_finding(with_tower: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such Towers keep working; the result explains that it is no longer maintained."""
    monkeypatch.setattr('stores.fake_s3.Handler.version_string', lambda _: 'MinIO')
    imitated()(with_tower)
    fields = {result.check: result for result in with_tower.ask('s3')}
    assert fields['s3.server'].severity is Severity.INFO
    assert 'archived' in fields['s3.server'].cause
    assert 'SeaweedFS' in fields['s3.server'].remedy


NAMES = [f'{number:032x}' for number in range(s3.RACES)]


def raced(server: FakeS3) -> Iterator[Result]:
    settings = StoreSettings(endpoint_url=server.url, access_key_id='key', secret_access_key='secret')
    ids = [mock.Mock(hex=name) for name in NAMES]
    with (
        served(server),
        single_requests(settings) as requests,
        mock.patch.object(s3, 'uuid', mock.Mock(uuid4=mock.Mock(side_effect=ids))),
    ):
        yield from s3.race_creates(requests, 'sensor-data', 'thor')


@pytest.mark.parametrize(('winners', 'severity'), [(1, Severity.OK), (2, Severity.WARNING)])
def test_a_server_with_two_winners_is_reported(winners: int, severity: Severity) -> None:
    """The number of winners is in it, and nothing is left in the store."""
    server = FakeS3()
    if winners > 1:
        server.races = {f'/sensor-data/thor/_doctor/{name}': threading.Barrier(s3.RACERS) for name in NAMES}
    (found,) = raced(server)
    assert (found.check, found.severity) == ('s3.race', severity)
    assert winners == 1 or f'[{", ".join(["4"] * s3.RACES)}] succeeded' in found.seen
    assert not server.objects
