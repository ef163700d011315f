"""Faults between a robot and its Tower, one at a time, with real servers wherever the fault is one of a server."""

from __future__ import annotations

import base64
import json
import socket
import sqlite3
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from doctor.scene import Scene, expect
from faults.front import Front
from faults.kinds import Condition, Fault
from open_seaweed import open_seaweed
from shadowhound_tower.embedded import Tower
from shared_tower import BUCKETS
from stores.fake_s3 import FakeS3, hung, refused, served
from tower_scripts import make_secrets

from shadowhound_data_logger.core import mlflow_rest
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.doctor import mlflow, network, s3, s3_put, seaweedfs
from shadowhound_data_logger.doctor.model import Result, Role, Severity
from shadowhound_data_logger.stores.s3_client import S3Client
from shadowhound_data_logger.stores.s3_requests import S3Requests

pytestmark = pytest.mark.seaweedfs

Inject = Callable[[Scene], None]
NETWORK = ('network.s3', 'network.mlflow')
SERVICES = ('s3', 'mlflow', 'seaweedfs')


@pytest.fixture(scope='module')
def servers(tower: Tower) -> Tower:
    """A Tower as it should be: the guide's buckets, a key pair of the least rights for Thor, one that reads for Spark."""
    client = S3Client(tower.store_settings(), UploadSettings())
    client.open()
    for bucket in BUCKETS:
        S3Requests(client).create_bucket(bucket)
    client.close()
    return tower


@pytest.fixture
def robot(scene: Scene, servers: Tower) -> Scene:
    """With Thor's keys. Others load the machine: how fast it is now is not what is asked here."""
    patch = scene.stack.enter_context(pytest.MonkeyPatch.context())
    patch.setattr(s3_put, 'SLOW_MBPS', 0.0)
    patch.setattr(s3, 'SLOW_S', 60.0)
    scene.stack.enter_context(patient(60.0))
    scene.environ |= servers.environment('thor')
    return scene


@contextmanager
def patient(seconds: float) -> Iterator[None]:
    """How long an answer may take."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(s3, 'ANSWER_S', seconds)
        patch.setattr(mlflow_rest, 'TIMEOUT_S', seconds)
        yield


def rest(tower: Tower, path: str, **body: Any) -> Any:
    """One request to MLflow."""
    url = f'{tower.tracking_uri}/api/2.0/mlflow/{path}'
    password = tower.tracking('tower')['MLFLOW_TRACKING_PASSWORD']
    login = 'Basic ' + base64.b64encode(f'tower:{password}'.encode()).decode()
    headers = {'Content-Type': 'application/json', 'Authorization': login}
    request = urllib.request.Request(url, json.dumps(body).encode(), headers)  # noqa: S310 - ours
    with urllib.request.urlopen(request, timeout=60.0) as answer:  # noqa: S310
        return json.loads(answer.read())


def test_a_healthy_tower_gives_no_finding(robot: Scene, servers: Tower) -> None:
    """Not with the robot's few rights, not for Tower's own keys, and not for one who reads."""
    for role in (Role.ROBOT, Role.ROBOT, Role.SERVER, Role.WORKSTATION):
        robot.role = role
        user = {Role.SERVER: 'tower', Role.WORKSTATION: 'spark'}.get(role, 'thor')
        robot.environ |= servers.environment(user) | servers.tracking(user)
        results = robot.ask(*NETWORK, *SERVICES, 'environment', 'secrets')
        assert [result for result in results if result.is_finding] == []
        asked = {result.check for result in results if result.severity is Severity.OK}
        assert ('s3.delete' in asked) is (role is Role.SERVER)
        assert ('s3.condition' in asked) is (role is not Role.WORKSTATION)
        assert {'s3.signature', 's3.clock', 'mlflow.health', 'mlflow.experiment', 'mlflow.artifacts'} <= asked


def test_probe_objects_do_not_pile_up(robot: Scene, servers: Tower) -> None:
    """However often the robot asks, there is one in each bucket; Tower's own is deleted again."""
    for role, user in ((Role.ROBOT, 'thor'), (Role.ROBOT, 'thor'), (Role.SERVER, 'tower')):
        robot.role = role
        robot.environ |= servers.environment(user)
        assert robot.findings('s3') == []
    client = S3Client(servers.store_settings(), UploadSettings())
    client.open()
    assert [item.key for bucket in BUCKETS for item in S3Requests(client).list(bucket, '') if '_doctor/' in item.key] == [
        '_requests/_doctor/inbox.json', *['thor/_doctor/probe'] * 2]  # fmt: skip
    client.close()


def test_a_seaweedfs_without_keys_is_named(robot: Scene, tmp_path: Path) -> None:
    """Each server that answers a stranger, once, with the way to close it; with the signing keys alone, those that still do."""
    with open_seaweed(tmp_path / 'open') as ports:
        robot.environ['AWS_ENDPOINT_URL'] = f'http://127.0.0.1:{ports["s3"]}'
        found = robot.findings('network.s3', 'seaweedfs')
        expect(found, 'seaweedfs.open', 'make tower-secrets', 'docs/tower.md')
        assert set(found[0].data['ports']) >= {ports[name] + 10_000 for name in ('s3', 'filer', 'master', 'volume')}
    (tmp_path / 'security.toml').write_text(make_secrets.signing_keys())
    with open_seaweed(tmp_path / 'signed', tmp_path) as ports:
        robot.environ['AWS_ENDPOINT_URL'] = f'http://127.0.0.1:{ports["s3"]}'
        (found_again,) = robot.findings('network.s3', 'seaweedfs')
        assert ports['s3'] + 10_000 not in found_again.data['ports']
        assert ports['filer'] + 10_000 in found_again.data['ports']


def test_ports_of_other_programs_are_not_a_finding(robot: Scene) -> None:
    """One that hangs, one that speaks plain HTTP and none at all: a robot waits for none of them."""
    began = time.monotonic()
    with hung() as mute, served(FakeS3()) as other, refused() as nothing:
        for url in (mute, other.url, nothing):
            port = int(url.rpartition(':')[2])
            assert not seaweedfs.answers_without_keys('127.0.0.1', port, seaweedfs.S3.method)
    assert time.monotonic() - began < 40 * seaweedfs.ANSWER_S


def keys(**changes: str) -> Inject:
    return lambda scene: scene.environ.update(changes)


def nobody_there(variable: str) -> Inject:
    return lambda scene: scene.environ.update({variable: scene.stack.enter_context(refused())})


def hanging(variable: str) -> Inject:
    def inject(scene: Scene) -> None:
        scene.stack.enter_context(patient(0.5))
        scene.environ[variable] = scene.stack.enter_context(hung())

    return inject


def fronted(fault: Fault = Fault.NONE, condition: Condition = Condition.HONOURED) -> Inject:
    """The real server behind a front that does this to every request."""

    def inject(scene: Scene) -> None:
        front = Front(scene.environ['AWS_ENDPOINT_URL'], lambda: fault, secret=scene.environ['AWS_SECRET_ACCESS_KEY'],
                      condition=condition)  # fmt: skip
        scene.environ['AWS_ENDPOINT_URL'] = scene.stack.enter_context(front).url

    return inject


def imitated(**faults: Any) -> Inject:
    """A server that is none: it verifies no checksum, signature or whatever."""

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
    'name that is none': (keys(AWS_ENDPOINT_URL='http://tower.invalid:9000'), 'network.s3.dns', ('getent hosts', 'TOWER_IP')),
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
def test_a_fault_is_found_and_named(robot: Scene, inject: Inject, name: str, words: tuple[str, ...]) -> None:
    """Once, with the right remedy, and without a sequel of other findings."""
    inject(robot)
    service = 'mlflow' if 'mlflow' in name else 's3'
    found = robot.findings(f'network.{service}', service)
    if name == 's3.condition':
        found = [result for result in {result.check: result for result in found}.values()]  # noqa: C416 - one of each bucket
    if name == 's3.clock':
        found = found[-1:]  # by the Date header, and by the refusal
    expect(found, name, *words)


def test_keys_without_rights(robot: Scene, servers: Tower) -> None:
    """Each bucket is named, with the policy that it takes."""
    robot.environ |= servers.environment('stranger')
    found = robot.findings('s3')
    assert {result.check for result in found} == {'s3.write'}
    assert all('s3:PutObject' in result.remedy for result in found)


def test_ports_that_are_mixed_up(robot: Scene) -> None:
    """The S3 server's and MLflow's: both are found."""
    swapped(robot)
    found = {result.check: result for result in robot.findings(*NETWORK, *SERVICES)}
    assert set(found) == {'s3.answer', 'mlflow.answer'}
    assert 'MLFLOW_TRACKING_URI' in found['mlflow.answer'].remedy


def test_the_usual_port_is_proposed(robot: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nothing listens on the port that is set, and something on the usual one."""
    nobody_there('AWS_ENDPOINT_URL')(robot)
    monkeypatch.setattr(network, '_answers', lambda _, port: port == 9000)
    expect(robot.findings('network.s3'), 'network.s3.tcp', 'export AWS_ENDPOINT_URL=http://127.0.0.1:9000')


def test_a_name_with_several_addresses(robot: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The server may listen at the second alone, as one of 127.0.0.1 where ``localhost`` is ::1 first: clients get there."""
    told = [
        (socket.AF_INET6, socket.SOCK_STREAM, 6, '', ('::1', 0, 0, 0)),
        (socket.AF_INET, socket.SOCK_STREAM, 6, '', ('127.0.0.1', 0)),
    ]
    asked = socket.getaddrinfo
    monkeypatch.setattr(
        network.socket, 'getaddrinfo', lambda host, *rest, **how: told if host == 'localhost' else asked(host, *rest, **how)
    )
    robot.environ['AWS_ENDPOINT_URL'] = robot.environ['AWS_ENDPOINT_URL'].replace('127.0.0.1', 'localhost')
    assert robot.findings('network.s3') == []
    robot.environ['AWS_ENDPOINT_URL'] = 'http://localhost:1'
    expect(robot.findings('network.s3'), 'network.s3.tcp', 'ss -ltnp')


def test_a_server_that_verifies_nothing(robot: Scene) -> None:
    """Neither checksums nor signatures: both promises that a put relies on are asked for."""
    imitated()(robot)
    assert {result.check for result in robot.findings('s3')} == {'s3.checksum', 's3.open'}


def test_minio_is_mentioned_without_a_finding(robot: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such Towers go on working; what it means that nobody maintains it is said."""
    monkeypatch.setattr('stores.fake_s3.Handler.version_string', lambda _: 'MinIO')
    imitated()(robot)
    told = {result.check: result for result in robot.ask('s3')}
    assert told['s3.server'].severity is Severity.INFO
    assert 'archived' in told['s3.server'].cause
    assert 'SeaweedFS' in told['s3.server'].remedy


def test_what_is_missing_on_tower(robot: Scene, servers: Tower) -> None:
    """Its own keys see all buckets; those of the guide that are not there are named, and can be made."""
    robot.role = Role.SERVER
    robot.environ |= servers.environment('tower')
    admin = S3Client(servers.store_settings(), UploadSettings())
    admin.open()
    admin._client.delete_bucket(Bucket='lerobot')
    try:
        expect(robot.findings('s3'), 's3.bucket', 's3 mb s3://lerobot')
    finally:
        S3Requests(admin).create_bucket('lerobot')
        admin.close()


class _Open(BaseHTTPRequestHandler):
    """As far as an MLflow server without users is asked before anything is written."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b'OK')

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers['Content-Length']))
        self.do_GET()

    def log_message(self, *_: object) -> None:
        pass


def test_an_mlflow_without_authentication(robot: Scene) -> None:
    """An open server is named, with what that means."""
    server = ThreadingHTTPServer(('127.0.0.1', 0), _Open)
    serving = threading.Thread(target=server.serve_forever)
    serving.start()
    robot.stack.callback(serving.join)
    robot.stack.callback(server.server_close)
    robot.stack.callback(server.shutdown)
    robot.environ['MLFLOW_TRACKING_URI'] = f'http://127.0.0.1:{server.server_port}'
    found = {result.check: result for result in robot.findings('mlflow')}
    assert found['mlflow.open'].severity is Severity.WARNING
    assert 'make tower-secrets' in found['mlflow.open'].remedy


def test_a_login_from_mlflow_s_own_file(robot: Scene, servers: Tower) -> None:
    """~/.mlflow/credentials counts where the environment has none, as for MLflow's clients; half a login is found."""
    user, password = (robot.environ.pop(name) for name in ('MLFLOW_TRACKING_USERNAME', 'MLFLOW_TRACKING_PASSWORD'))
    file = Path(robot.environ['HOME']) / '.mlflow/credentials'
    file.parent.mkdir()
    file.write_text(f'[mlflow]\nmlflow_tracking_username = {user}\n')
    file.chmod(0o600)
    expect(robot.findings('environment'), 'environment.login', 'MLFLOW_TRACKING_PASSWORD')
    file.write_text(f'[mlflow]\nmlflow_tracking_username = {user}\nmlflow_tracking_password = {password}\n')
    assert robot.findings('environment', 'mlflow') == []


def test_artifacts_that_do_not_reach_their_store(robot: Scene, servers: Tower) -> None:
    """MLflow answers and takes experiments; only the artifact itself shows it."""
    artifacts = servers._folder / 'mlflow/artifacts'
    away = artifacts.with_name('away')
    if artifacts.exists():
        artifacts.rename(away)
    artifacts.write_text('a disk that is not mounted')
    try:
        expect(robot.findings('mlflow'), 'mlflow.artifacts', 'docker logs', 'MLFLOW_S3')
    finally:
        artifacts.unlink()
        if away.exists():
            away.rename(artifacts)


def test_artifacts_that_stay_on_the_robot(robot: Scene, servers: Tower, tmp_path: Path) -> None:
    """The guide's last story: the run succeeds, and its artifacts are in no store."""
    experiment = rest(servers, 'experiments/search', filter="name = 'thor_missions'", max_results=1)['experiments'][0]
    number = experiment['experiment_id']
    with closing(sqlite3.connect(servers._folder / 'mlflow/mlflow.db')) as database:  # as a server of before made it
        move = 'update experiments set artifact_location = ? where experiment_id = ?'
        with database:
            database.execute(move, (f'file://{tmp_path}', number))
        try:
            expect(robot.findings('mlflow'), 'mlflow.artifacts', '--artifacts-destination s3://mlflow')
        finally:
            with database:
                database.execute(move, (experiment['artifact_location'], number))
    rest(servers, 'experiments/delete', experiment_id=number)
    try:
        expect(robot.findings('mlflow'), 'mlflow.missions', f'mlflow experiments restore -x {number}')
    finally:
        rest(servers, 'experiments/restore', experiment_id=number)


def test_artifacts_that_go_to_s3_directly(robot: Scene, servers: Tower) -> None:
    """Then the robot's own keys and MLFLOW_S3_ENDPOINT_URL decide."""
    expect(_direct(robot, 's3://mlflow/9'), 'mlflow.artifacts', 's3:PutObject', 'mlflow')
    robot.environ |= servers.environment('tower')
    assert [result.severity for result in _direct(robot, 's3://mlflow/9')] == [Severity.OK]


def _direct(scene: Scene, location: str) -> list[Result]:
    return list(mlflow._direct(location, scene.context()))
