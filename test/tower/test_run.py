"""A Tower of plain processes: everything responds, a key is changed at run time, and nothing is left behind."""

from __future__ import annotations

import base64
import errno
import os
import pwd
import signal
import socket
import stat
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import boto3
import pytest
from botocore.exceptions import ClientError
from open_seaweed import free_offset
from shadowhound_tower.servers import ServerFailed
from tower_scripts import TOWER, make_secrets, processes_of, reload_s3, remove_database, run
from tower_scripts import run as run_module

pytestmark = [
    pytest.mark.seaweedfs,
    pytest.mark.long('half a minute with Towers of its own'),
]
START_S: Final = 120.0
HOST: Final = '127.0.0.2'
"""Stands for the address at which other machines reach this one."""


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory, offset: int) -> Iterator[Path]:
    """The folder of a running Tower."""
    folder = tmp_path_factory.mktemp('plain')
    command = [sys.executable, str(TOWER / 'run.py'), '--folder', str(folder), '--offset', str(offset), '--bind', HOST]
    with (folder / 'log').open('w', encoding='utf-8') as log, subprocess.Popen(command, stdout=log, stderr=log) as tower:
        try:
            _until(lambda: 'credentials' in (folder / 'log').read_text() or tower.poll() is not None, START_S)
            assert tower.poll() is None, (folder / 'log').read_text()
            yield folder
        finally:
            tower.send_signal(signal.SIGTERM)
            assert tower.wait(60) == 0
            remove_database(folder, offset)
    _until(lambda: not processes_of(folder), 10)
    assert list(Path('/tmp').glob(f'seaweedfs-s3-*{9000 + offset}.sock')) == []  # noqa: S108 - that is where they would be


def _until(ready: Callable[[], bool], seconds: float) -> None:
    end = time.monotonic() + seconds
    while not ready():
        assert time.monotonic() < end
        time.sleep(0.05)


def _works(folder: Path, offset: int, key: dict[str, str]) -> bool:
    s3 = boto3.client('s3', endpoint_url=f'http://{HOST}:{9000 + offset}', aws_access_key_id=key['accessKey'],
                      aws_secret_access_key=key['secretKey'], region_name='us-east-1')  # fmt: skip
    try:
        s3.put_object(Bucket='sensor-data', Key='thor/probe', Body=b'1')
    except ClientError:
        return False
    return True


def test_nothing_without_a_key_is_reachable(folder: Path, offset: int) -> None:
    """Neither the filer, which reads and deletes any object, nor the volume server, the master and the database."""
    for port in (9333, 8080, 8888, 19333, 18080, 18888, 5432):
        with socket.socket() as one:
            assert one.connect_ex((HOST, port + offset)) == errno.ECONNREFUSED, port


def test_artifacts_go_through_mlflow_to_the_store(folder: Path, offset: int) -> None:
    """Artifacts put to MLflow's service are in the bucket mlflow; the sender needs a password, and no S3 key."""
    environ = make_secrets.read_env(folder / 'secrets' / 'thor.env')
    login = f'{environ["MLFLOW_TRACKING_USERNAME"]}:{environ["MLFLOW_TRACKING_PASSWORD"]}'
    url = f'http://{HOST}:{5001 + offset}/api/2.0/mlflow-artifacts/artifacts/1/hello.txt'
    request = urllib.request.Request(url, data=b'hello', method='PUT')
    with pytest.raises(urllib.error.HTTPError, match='401'):
        urllib.request.urlopen(request, timeout=60)  # noqa: S310 - http, by us
    request.add_header('Authorization', 'Basic ' + base64.b64encode(login.encode()).decode())
    with urllib.request.urlopen(request, timeout=60) as answer:  # noqa: S310 - http, by us
        assert answer.status == 200
    key = make_secrets.load_users(folder / 'secrets' / 'users.json')['tower'][0]
    s3: Any = boto3.client('s3', endpoint_url=f'http://{HOST}:{9000 + offset}', aws_access_key_id=key['accessKey'],
                           aws_secret_access_key=key['secretKey'], region_name='us-east-1')  # fmt: skip
    assert s3.get_object(Bucket='mlflow', Key='1/hello.txt')['Body'].read() == b'hello'


def _mlflow_processes(offset: int) -> list[Path]:
    port = str(5001 + offset).encode()
    return [entry.parent for entry in Path('/proc').glob('[0-9]*/cmdline')
            if b'--port' in (words := _words(entry)) and port in words and b'_guard.py' not in b' '.join(words)]  # fmt: skip


def test_mlflow_runs_unprivileged(folder: Path, offset: int) -> None:
    """Its processes do not run as root, whichever user runs the Tower, and not as a user of another service."""
    servers = _mlflow_processes(offset)
    assert servers
    owners = {pwd.getpwuid(server.stat().st_uid).pw_name for server in servers}
    assert owners == ({'shadowhound-mlflow'} if os.geteuid() == 0 else {pwd.getpwuid(os.geteuid()).pw_name})


def test_no_environment_and_no_command_line_has_the_key_of_the_store(folder: Path, offset: int) -> None:
    """MLflow's key is in a file for its user alone."""
    secret = make_secrets.read_env(folder / '.env')['MLFLOW_SECRET_ACCESS_KEY'].encode()
    servers = _mlflow_processes(offset)
    assert servers
    reports = [(server / name).read_bytes() for server in servers for name in ('environ', 'cmdline')]
    assert not any(secret in one for one in reports)
    named = {word.partition(b'=')[2].decode() for one in reports for word in one.split(b'\0')
             if word.startswith(b'AWS_SHARED_CREDENTIALS_FILE=')}  # fmt: skip
    (keys,) = (Path(name) for name in named)
    assert secret in keys.read_bytes()
    assert (stat.S_IMODE(keys.stat().st_mode), stat.S_IMODE(keys.parent.stat().st_mode)) == (0o600, 0o700)
    assert keys.stat().st_uid in {server.stat().st_uid for server in servers}


def test_no_server_leaves_its_memory_on_the_disk(folder: Path) -> None:
    """However a server exits, there is no core dump with its keys and passwords."""
    numbers = list(processes_of(folder))
    limits = [line for number in numbers for line in Path(f'/proc/{number}/limits').read_text().splitlines()
              if line.startswith('Max core file size')]  # fmt: skip
    assert len(limits) == len(numbers) > 2
    assert {tuple(line.split()[4:6]) for line in limits} == {('0', '0')}


@pytest.mark.skipif(os.geteuid() != 0, reason='another user is needed')
@pytest.mark.parametrize('user', ['nobody', 'postgres'])
def test_another_service_of_the_machine_reads_nothing_of_mlflow(folder: Path, offset: int, user: str) -> None:
    """Neither its environment nor its files, as a user shared by services; nor, as the user ``nobody``, the database."""
    mlflow, sockets = (run_module.unprivileged_folders(folder, offset)[name] for name in ('mlflow', 'sockets'))
    wanted = [str(server / 'environ') for server in _mlflow_processes(offset)]
    wanted += [str(mlflow / name) for name in ('s3.keys', 'auth.ini')]
    if user == 'nobody' and sockets.exists():
        wanted.append(str(next(sockets.glob('.s.PGSQL.*[0-9]'))))
    try:
        pwd.getpwnam(user)
    except KeyError:
        pytest.skip(f'there is no user {user} here')
    ask = 'import socket, sys\nfor path in sys.argv[1:]:\n try:\n'
    ask += '  socket.socket(socket.AF_UNIX).connect(path) if "PGSQL" in path else open(path).read()\n  print("read", path)\n'
    ask += ' except PermissionError:\n  print("denied")\n'
    command = ['setpriv', f'--reuid={user}', '--clear-groups', '/usr/bin/python3', '-c', ask, *wanted]
    done = subprocess.run(command, check=True, capture_output=True, text=True, cwd='/').stdout.splitlines()
    assert len(wanted) >= 3
    assert done == ['denied'] * len(wanted)


def test_a_password_of_mlflow_is_changed_while_it_runs(folder: Path, offset: int) -> None:
    """The new one is valid next to the old one, and the retired one no more; no signal is needed."""

    def works(password: str) -> bool:
        request = urllib.request.Request(f'http://{HOST}:{5001 + offset}/version')
        request.add_header('Authorization', 'Basic ' + base64.b64encode(f'spark:{password}'.encode()).decode())
        try:
            urllib.request.urlopen(request, timeout=60).close()  # noqa: S310 - http, by us
        except urllib.error.HTTPError:
            return False
        return True

    def newest() -> str:
        return str(make_secrets.load_users(folder / 'secrets' / 'users.json')['spark'][0]['password'])

    old = newest()
    assert works(old)
    make_secrets.make(folder, None, [], rotate=['spark'])
    _until(lambda: works(newest()), 20)
    assert works(old)
    make_secrets.make(folder, None, [], retire=['spark'])
    _until(lambda: not works(old), 20)
    assert works(newest())


def _words(cmdline: Path) -> list[bytes]:
    try:
        return cmdline.read_bytes().split(b'\0')
    except OSError:
        return []


def test_a_key_is_changed_while_it_runs(folder: Path, offset: int) -> None:
    """After SIGHUP the new key is valid next to the old one, and once that is retired it is invalid."""
    users = folder / 'secrets' / 'users.json'
    old = make_secrets.load_users(users)['thor'][0]
    assert _works(folder, offset, old)
    make_secrets.make(folder, None, [], rotate=['thor'])
    new = make_secrets.load_users(users)['thor'][0]
    assert not _works(folder, offset, new)
    reload_s3(folder)
    _until(lambda: _works(folder, offset, new), 20)
    assert _works(folder, offset, old)
    make_secrets.make(folder, None, [], retire=['thor'])
    reload_s3(folder)
    _until(lambda: not _works(folder, offset, old), 20)
    assert _works(folder, offset, new)


def test_a_seaweedfs_without_keys_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that does not require the certificate is detected and stopped, before robots send to it."""
    make_secrets.make(tmp_path, '127.0.0.1', ['thor'])
    monkeypatch.setattr(run.Runner, '_seaweed_environ', run.Runner._environ)
    tower = run.Runner(tmp_path, '127.0.0.1', free_offset())
    with pytest.raises(ServerFailed, match='serves everybody at 127'):
        tower.start(['thor'])
    _until(lambda: not processes_of(tmp_path), 10)


@pytest.mark.parametrize(('port', 'name'), [(9000, 'S3'), (5001, 'MLflow'), (9333, 'master')])
def test_a_port_in_use_is_named(tmp_path: Path, port: int, name: str) -> None:
    """A leftover server is not mistaken for the one being started: nothing is started next to it."""
    make_secrets.make(tmp_path, HOST, ['thor'])
    offset = free_offset()
    with socket.create_server((HOST, port + offset)), pytest.raises(ServerFailed, match=f'{port + offset}, the port of .*{name}'):
        run.Runner(tmp_path, HOST, offset).start(['thor'])
    assert not processes_of(tmp_path)
