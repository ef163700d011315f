"""Faults between a robot and its Tower, one at a time, with real servers for faults of a server."""

from __future__ import annotations

import socket
import time
from typing import Any

import pytest
from doctor.scene import Inject, Scene, assert_finding, hanging, keys, nobody_there
from faults.front import Front
from faults.kinds import Condition, Fault
from shadowhound_tower.embedded import Tower
from stores.fake_s3 import FakeS3, hung, refused, served

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.doctor import network, seaweedfs
from shadowhound_data_logger.doctor.model import Role, Severity
from shadowhound_data_logger.stores.s3_client import S3Client
from shadowhound_data_logger.stores.s3_requests import S3Requests

pytestmark = pytest.mark.seaweedfs
NETWORK = ('network.s3', 'network.mlflow')
SERVICES = ('s3', 'mlflow', 'seaweedfs')


def test_a_healthy_tower_gives_no_finding(with_tower: Scene, servers: Tower) -> None:
    """With the robot's limited permissions, with Tower's keys, and with read-only keys."""
    for role in (Role.ROBOT, Role.ROBOT, Role.SERVER, Role.WORKSTATION):
        with_tower.role = role
        user = {Role.SERVER: 'tower', Role.WORKSTATION: 'spark'}.get(role, 'thor')
        with_tower.environ |= servers.environment(user) | servers.tracking(user)
        results = with_tower.ask(*NETWORK, *SERVICES, 'environment', 'secrets')
        assert [result for result in results if result.is_finding] == []
        asked = {result.check for result in results if result.severity is Severity.OK}
        assert ('s3.delete' in asked) is (role is Role.SERVER)
        assert ('s3.condition' in asked) is (role is not Role.WORKSTATION)
        assert {'s3.signature', 's3.clock', 'mlflow.health', 'mlflow.experiment', 'mlflow.artifacts'} <= asked


def test_ports_of_other_programs_are_not_a_finding(with_tower: Scene) -> None:
    """One that hangs, one with plain HTTP and one that is closed: a robot waits for none of them."""
    began = time.monotonic()
    with hung() as mute, served(FakeS3()) as other, refused() as nothing:
        for url in (mute, other.url, nothing):
            port = int(url.rpartition(':')[2])
            assert not seaweedfs.answers_without_keys('127.0.0.1', port, seaweedfs.S3.method)
    assert time.monotonic() - began < 40 * seaweedfs.ANSWER_S


def fronted(fault: Fault = Fault.NONE, condition: Condition = Condition.HONOURED) -> Inject:
    """The real server behind a proxy that does this to every request."""

    def inject(scene: Scene) -> None:
        front = Front(scene.environ['AWS_ENDPOINT_URL'], lambda: fault, secret=scene.environ['AWS_SECRET_ACCESS_KEY'],
                      condition=condition)  # fmt: skip
        scene.environ['AWS_ENDPOINT_URL'] = scene.stack.enter_context(front).url

    return inject


def imitated(**faults: Any) -> Inject:
    """A fake server: it verifies no checksum, signature or anything else."""

    def inject(scene: Scene) -> None:
        scene.environ['AWS_ENDPOINT_URL'] = scene.stack.enter_context(served(FakeS3(**faults))).url

    return inject


def swapped(scene: Scene) -> None:
    scene.environ['AWS_ENDPOINT_URL'], scene.environ['MLFLOW_TRACKING_URI'] = (
        scene.environ['MLFLOW_TRACKING_URI'], scene.environ['AWS_ENDPOINT_URL'])  # fmt: skip


def bucket_of_another_name(scene: Scene) -> None:
    scene.parameters |= {'sensors': ['imu'], 'imu.bucket': 'imu-data'}


FAULTS: dict[str, tuple[Inject, str, tuple[str, ...]]] = {
    'wrong secret': (keys(AWS_SECRET_ACCESS_KEY='mistyped'), 's3.signature', ('AWS_SECRET_ACCESS_KEY',)),
    'wrong access key': (keys(AWS_ACCESS_KEY_ID='NOBODY'), 's3.signature', ('AWS_ACCESS_KEY_ID',)),
    'wrong port': (nobody_there('AWS_ENDPOINT_URL'), 'network.s3.tcp', ('ss -ltnp', 'docker compose ps')),
    'hung server': (hanging('AWS_ENDPOINT_URL'), 's3.answer', ('docker compose logs',)),
    'no S3 server on this port': (imitated(answer=(200, b'<html>Welcome</html>')), 's3.answer', ('curl -i',)),
    'name that is none': (keys(AWS_ENDPOINT_URL='http://tower.invalid:9000'), 'network.s3.dns', ('getent hosts', '//SERVER')),
    'missing bucket': (bucket_of_another_name, 's3.bucket', ('s3 mb s3://imu-data', '--fix')),
    'skewed clock': (fronted(Fault.SKEWED), 's3.clock', ('timedatectl',)),
    'server that ignores If-None-Match': (fronted(condition=Condition.OVERWRITES), 's3.condition', ('update the S3 server',)),
    'server without If-None-Match': (fronted(condition=Condition.NOT_IMPLEMENTED), 's3.condition', ('update the S3 server',)),
    'server error': (fronted(Fault.ERROR_500), 's3.answer', ('log',)),
    'login page of a network': (fronted(Fault.PORTAL), 's3.answer', ('login page',)),
    'MLflow down': (nobody_there('MLFLOW_TRACKING_URI'), 'network.mlflow.tcp', ('ss -ltnp', 'docker compose ps')),
    'MLflow hangs': (hanging('MLFLOW_TRACKING_URI'), 'mlflow.answer', ('docker logs',)),
    'MLflow without a login': (lambda scene: scene.environ.pop('MLFLOW_TRACKING_USERNAME'), 'mlflow.login',
                               ('MLFLOW_TRACKING_USERNAME', 'MLFLOW_TRACKING_PASSWORD', '~/.mlflow/credentials')),
    'wrong password of MLflow': (keys(MLFLOW_TRACKING_PASSWORD='mistyped'), 'mlflow.login', ('MLFLOW_TRACKING_PASSWORD',)),
    'robot that Tower does not know': (keys(SHADOWHOUND_ROBOT='rex'), 'mlflow.login', ('--robot rex',)),
    'MLflow without a name': (keys(MLFLOW_TRACKING_URI='http://tower.invalid:5001'), 'network.mlflow.dns', ('getent hosts',)),
}  # fmt: skip


@pytest.mark.parametrize(('inject', 'name', 'words'), FAULTS.values(), ids=FAULTS)
def test_a_fault_is_found_and_named(with_tower: Scene, inject: Inject, name: str, words: tuple[str, ...]) -> None:
    """Once, with the correct remedy, and without other findings."""
    inject(with_tower)
    service = 'mlflow' if 'mlflow' in name else 's3'
    found = with_tower.findings(f'network.{service}', service)
    if name == 's3.condition':
        found = [result for result in {result.check: result for result in found}.values()]  # noqa: C416 - one of each bucket
    if name == 's3.clock':
        found = found[-1:]  # by the Date header, and by the refusal
    assert_finding(found, name, *words)


def test_swapped_ports_are_named(with_tower: Scene) -> None:
    """Those of the S3 server and MLflow: both are found."""
    swapped(with_tower)
    found = {result.check: result for result in with_tower.findings(*NETWORK, *SERVICES)}
    assert set(found) == {'s3.answer', 'mlflow.answer'}
    assert 'MLFLOW_TRACKING_URI' in found['mlflow.answer'].remedy


def test_the_usual_port_is_proposed(with_tower: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """If nothing listens on the configured port, and a server on the usual one."""
    nobody_there('AWS_ENDPOINT_URL')(with_tower)
    monkeypatch.setattr(network, '_answers', lambda _, port: port == 9000)
    assert_finding(with_tower.findings('network.s3'), 'network.s3.tcp', 'export AWS_ENDPOINT_URL=http://127.0.0.1:9000')


def test_every_address_of_a_name_is_tried(with_tower: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The server may listen on the second only, as on 127.0.0.1 if ``localhost`` is ::1 first: clients reach it."""
    reports = [
        (socket.AF_INET6, socket.SOCK_STREAM, 6, '', ('::1', 0, 0, 0)),
        (socket.AF_INET, socket.SOCK_STREAM, 6, '', ('127.0.0.1', 0)),
    ]
    asked = socket.getaddrinfo
    monkeypatch.setattr(
        network.socket, 'getaddrinfo', lambda host, *rest, **how: reports if host == 'localhost' else asked(host, *rest, **how)
    )
    with_tower.environ['AWS_ENDPOINT_URL'] = with_tower.environ['AWS_ENDPOINT_URL'].replace('127.0.0.1', 'localhost')
    assert with_tower.findings('network.s3') == []
    with_tower.environ['AWS_ENDPOINT_URL'] = 'http://localhost:1'
    assert_finding(with_tower.findings('network.s3'), 'network.s3.tcp', 'ss -ltnp')


def test_missing_parts_of_a_tower_are_named(with_tower: Scene, servers: Tower) -> None:
    """Its keys list all buckets; missing ones of the guide are named, and can be created."""
    with_tower.role = Role.SERVER
    with_tower.environ |= servers.environment('tower')
    admin = S3Client(servers.store_settings(), UploadSettings())
    admin.open()
    admin._client.delete_bucket(Bucket='lerobot')
    try:
        assert_finding(with_tower.findings('s3'), 's3.bucket', 's3 mb s3://lerobot')
    finally:
        S3Requests(admin).create_bucket('lerobot')
        admin.close()
