"""Missions and every kind of tracking server that is promised, each the real thing: PostgreSQL behind it, and MLflow 2.x.

``SHADOWHOUND_MLFLOW2`` names a virtual environment with ``mlflow<3``, ``boto3`` and ``rosbags``.
"""

from __future__ import annotations

import json
import os
import pwd
import shutil
import subprocess
import sys
import tempfile
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import pytest
from missions.server import FOREIGN
from missions.voyage import POINTS
from shadowhound_tower.servers import Ports, Server

TWO: Final = os.environ.get('SHADOWHOUND_MLFLOW2', '')
POSTGRES: Final = shutil.which('postgres')
READY_S: Final = 120.0
HERE: Final = Path(sys.executable).parent
pytestmark = [
    pytest.mark.slow,
    pytest.mark.long('half a minute each, with servers of its own'),
]
needs_two = pytest.mark.skipif(not TWO, reason='SHADOWHOUND_MLFLOW2 names no environment with MLflow 2')
needs_postgres = pytest.mark.skipif(not POSTGRES, reason='PostgreSQL is not installed: apt install postgresql')


@pytest.fixture
def running() -> Iterator[ExitStack]:
    """Ends what a test starts."""
    with ExitStack() as stack:
        yield stack


def clean() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if not name.startswith((*FOREIGN, 'PG'))}


def database(running: ExitStack) -> str:
    """The URI of an empty PostgreSQL, which does not run as root and so may need another user's folder."""
    assert POSTGRES
    folder = Path(running.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True)))
    programs, as_user = Path(POSTGRES).resolve().parent, ()
    if not os.geteuid():
        user = pwd.getpwnam('postgres')
        shutil.chown(folder, user.pw_uid, user.pw_gid)
        as_user = ('setpriv', f'--reuid={user.pw_uid}', f'--regid={user.pw_gid}', '--clear-groups', '--')  # type: ignore[assignment]
    data = folder / 'data'
    made = [*as_user, programs / 'initdb', '-D', data, '-U', 'mlflow', '--auth=trust', '--encoding=UTF8', '--no-sync']
    subprocess.run(made, check=True, cwd='/', env={**clean(), 'LC_ALL': 'C.UTF-8'}, stdout=subprocess.DEVNULL)
    command = [*as_user, str(programs / 'postgres'), '-D', str(data), '-c', 'listen_addresses=', '-k', str(folder)]
    server = Server('PostgreSQL', command, log=folder / 'log', environ=clean())
    running.callback(server.stop)
    server.start()
    ask = [str(programs / 'pg_isready'), '-q', '-h', str(folder)]
    server.wait(lambda: not subprocess.run(ask, check=False).returncode, READY_S)
    return f'postgresql+psycopg2://mlflow@/postgres?host={folder}'


def served(running: ExitStack, folder: Path, programs: Path, backend: str) -> str:
    """The address of an MLflow server."""
    ports = Ports('127.0.0.1')
    running.callback(ports.release)
    url = f'http://127.0.0.1:{ports.take()}'
    command = [
        str(programs / 'mlflow'), 'server', '--host', '127.0.0.1', '--port', url.rpartition(':')[2], '--workers', '1',
        '--backend-store-uri', backend, '--artifacts-destination', str(folder / 'artifacts'),
    ]  # fmt: skip
    environ = clean() | {'MLFLOW_SERVER_ENABLE_JOB_EXECUTION': 'false', 'MLFLOW_DISABLE_TELEMETRY': 'true'}
    server = Server('MLflow', command, log=folder / 'mlflow.log', environ=environ)
    running.callback(server.stop)
    server.start()

    def answers() -> bool:
        try:
            with urllib.request.urlopen(f'{url}/health', timeout=30.0) as answer:  # noqa: S310 - http, by us
                return bool(answer.status == 200)
        except OSError:
            return False

    server.wait(answers, READY_S)
    return url


def voyage(folder: Path, programs: Path, uri: str) -> dict[str, Any]:
    """What the server has of a mission that was sent twice by this environment's MLflow."""
    tests = str(Path(__file__).parents[1])
    path = os.pathsep.join((tests, str(Path(tests).parent), os.environ.get('PYTHONPATH', '')))
    environ = clean() | {
        'MLFLOW_TRACKING_URI': uri, 'MLFLOW_HTTP_REQUEST_TIMEOUT': '120',
        'PYTHONPATH': path if programs == HERE else path.rpartition(os.pathsep)[0],
    }  # fmt: skip
    (folder / 'home').mkdir()
    command = [str(programs / 'python'), '-m', 'missions.voyage', str(folder / 'home')]
    done = subprocess.run(command, env=environ, capture_output=True, text=True, timeout=300, check=False)
    assert not done.returncode, done.stderr
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def check(found: dict[str, Any]) -> None:
    """One run, each point once, texts whole but for what no database takes."""
    assert found['status'] == 'FINISHED'
    assert found['steps'] == list(range(POINTS))
    assert found['params'] == {
        'mission_type': 'patrol', 'robot': 'thor', 'duration_s': '60.000',
        'mission_command': ('Küche\N{REPLACEMENT CHARACTER} \N{DOG FACE} ' + 'x' * 7000)[:6000],
    }  # fmt: skip
    assert (found['metrics']['success'], found['metrics']['big/one'], found['metrics']['distance_m']) == (1.0, 1.5e300, 12.5)
    assert found['artifacts'] == ['camera', 'camera/frame_000000.jpg', 'mission_command.txt', 'summary.json']


@needs_postgres
def test_a_server_with_postgresql(running: ExitStack, tmp_path: Path) -> None:
    """As a Tower has it."""
    check(voyage(tmp_path, HERE, served(running, tmp_path, HERE, database(running))))


@needs_two
def test_a_server_of_version_2(running: ExitStack, tmp_path: Path) -> None:
    """Our client, and an older server."""
    check(voyage(tmp_path, HERE, served(running, tmp_path, Path(TWO) / 'bin', f'sqlite:///{tmp_path}/mlflow.db')))


@needs_two
def test_a_client_of_version_2(running: ExitStack, tmp_path: Path) -> None:
    """A robot with an older client, and our server."""
    check(voyage(tmp_path, Path(TWO) / 'bin', served(running, tmp_path, HERE, f'sqlite:///{tmp_path}/mlflow.db')))


@needs_two
@needs_postgres
def test_version_2_on_both_sides(running: ExitStack, tmp_path: Path) -> None:
    """An old Tower with an old robot."""
    check(voyage(tmp_path, Path(TWO) / 'bin', served(running, tmp_path, Path(TWO) / 'bin', database(running))))


@needs_two
def test_no_server_of_version_2(tmp_path: Path) -> None:
    """A SQLite file."""
    check(voyage(tmp_path, Path(TWO) / 'bin', f'sqlite:///{tmp_path}/mlflow.db'))
