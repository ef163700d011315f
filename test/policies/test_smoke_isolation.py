"""What code inside the smoke run can do to the robot: it runs here as an ordinary user, whose home it attacks."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from policies.models import Scene, Spark

from shadowhound_data_logger.core.errors import PolicyError
from shadowhound_data_logger.policies import smoke, sync
from shadowhound_data_logger.policies.manifest import PolicyManifest
from shadowhound_data_logger.policies.smoke import LIMITS, SANDBOX, SmokeRun, is_enough, open_sandbox, run_smoke

ATTACKS = """
import json, mmap, os, signal, socket, sys
from pathlib import Path
from shadowhound_data_logger.policies import smoke, sync
from shadowhound_data_logger.policies.manifest import PolicyManifest

smoke._confine()
home, parent, victim, port = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])

def connect(family, address, kind=socket.SOCK_STREAM):
    with socket.socket(family, kind) as client:
        client.settimeout(5)
        client.connect(address)
        client.sendall(b'{"do": "pause"}')
        client.sendall(b'')  # a datagram that reached nobody was refused meanwhile

def overwrite(path):
    with open(path, 'r+b') as file, mmap.mmap(file.fileno(), 0) as memory:
        memory[:4] = b'evil'

def swap(link):
    os.unlink(link)
    os.symlink('versions/evil', link)

attacks = {
    'read the S3 keys': lambda: (home / 'logger.env').read_text(),
    'read the environment of the node': lambda: Path(f'/proc/{parent}/environ').read_bytes(),
    'list the spool': lambda: os.listdir(home / 'spool'),
    'say something to the control socket': lambda: connect(socket.AF_UNIX, str(home / 'spool/control.sock')),
    'say something to an abstract socket': lambda: connect(socket.AF_UNIX, f'\\0shadowhound-{parent}'),
    'overwrite state.json through mmap': lambda: overwrite(home / 'policies/state.json'),
    'overwrite its own model through mmap': lambda: overwrite(home / 'policies/incoming/it/model.onnx'),
    'swap policies/current': lambda: swap(home / 'policies/current'),
    'delete a file of the spool': lambda: os.unlink(home / 'spool/object'),
    'change the mode of a file': lambda: os.chmod(home / 'spool/index.db', 0o666),
    'kill another process': lambda: os.kill(victim, signal.SIGKILL),
    'connect to the network': lambda: connect(socket.AF_INET, ('127.0.0.1', port)),
    'send a datagram': lambda: connect(socket.AF_INET, ('127.0.0.1', port), socket.SOCK_DGRAM),
    'make a folder elsewhere': lambda: os.mkdir(home.parent / 'was-here'),
}
done = []
for name, attack in attacks.items():
    try:
        attack()
        done.append(name)
    except OSError:
        pass
print(json.dumps({'done': done, 'tried': list(attacks), 'own': os.listdir(home / 'policies/incoming/it')}))
"""
DRIVER = """
import json, os, socket, subprocess, sys, tempfile
from pathlib import Path
from shadowhound_data_logger.policies import smoke, sync
from shadowhound_data_logger.policies.manifest import PolicyManifest

home, sandboxed, attacks = Path(sys.argv[1]), sys.argv[2] == 'sandbox', sys.argv[3]
for name in ('spool', 'policies/versions/good', 'policies/incoming/it'):
    (home / name).mkdir(parents=True)
for name in ('logger.env', 'policies/state.json', 'policies/incoming/it/model.onnx', 'spool/object', 'spool/index.db'):
    (home / name).write_text('AWS_SECRET_ACCESS_KEY=hunter2')
(home / 'policies/current').symlink_to('versions/good')
servers = [socket.create_server(('127.0.0.1', 0)), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)]
servers[1].bind(servers[0].getsockname())
for address in (str(home / 'spool/control.sock'), f'\\0shadowhound-{os.getpid()}'):
    server = socket.socket(socket.AF_UNIX)
    server.bind(address)
    server.listen()
    servers.append(server)
victim = subprocess.Popen(['sleep', '600'])
with tempfile.TemporaryDirectory() as empty:
    folder = home / 'policies/incoming/it'
    command, problem = smoke.open_sandbox(folder, empty) if sandboxed else ([], '')
    assert not problem, problem
    arguments = [str(home), str(os.getpid()), str(victim.pid), str(servers[0].getsockname()[1])]
    child = [*command, sys.executable, '-B', '-c', attacks, *arguments]
    told, code = smoke._run_child(child, smoke.environ_of(empty), empty, 60.0)
found = {
    **json.loads(told), 'code': code, 'victim': victim.poll(), 'current': os.readlink(home / 'policies/current'),
    'state': (home / 'policies/state.json').read_text(), 'spool': sorted(os.listdir(home / 'spool')),
}
victim.kill()
victim.wait()
print(json.dumps(found))
"""


@pytest.fixture
def home() -> Iterator[Path]:
    """The home of an ordinary user, whom nothing above it keeps out."""
    with tempfile.TemporaryDirectory(prefix='shadowhound-home-') as folder:
        if os.getuid() == 0:
            os.chown(folder, 65534, 65534)
        yield Path(folder) / 'home'


def attacked(home: Path, isolation: str) -> dict[str, Any]:
    """The results of the attacks, as an unprivileged user if the tests run as root."""
    python, become = sys.executable, []
    if os.getuid() == 0:
        become = ['setpriv', '--reuid=65534', '--regid=65534', '--clear-groups',
                  '--no-new-privs', '--bounding-set=-all']  # fmt: skip  # as shadowhound-policy.service does
        python = f'/usr/bin/python3.{sys.version_info.minor}'  # root's own Python may be in root's home
        if not Path(python).exists():
            pytest.skip(f'needs {python}, which an ordinary user may run')
    paths = os.pathsep.join(path for path in sys.path if path and not Path(path).is_relative_to('/root'))
    environ = {'PATH': os.environ['PATH'], 'HOME': str(home), 'SHADOWHOUND_HOME': str(home), 'PYTHONPATH': paths,
               'PYTHONDONTWRITEBYTECODE': '1'}  # fmt: skip
    command = [*become, python, '-c', DRIVER, str(home), isolation, ATTACKS]
    done = subprocess.run(command, env=environ, cwd='/', check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


needs_bwrap = pytest.mark.skipif(shutil.which('bwrap') is None, reason='apt install bubblewrap')


@needs_bwrap
def test_the_sandbox_stops_each_attack(home: Path) -> None:
    """Code inside the smoke run reads nothing of the user, reaches no process and no network, and changes no file."""
    found = attacked(home, SANDBOX)
    assert (found['done'], len(found['tried'])) == ([], 14)
    assert (found['victim'], found['current'], found['own']) == (None, 'versions/good', ['model.onnx'])
    assert found['state'].startswith('AWS_')
    assert found['spool'] == ['control.sock', 'index.db', 'object']


def test_the_limits_alone_stop_next_to_nothing(home: Path) -> None:
    """Without the sandbox each attack succeeds, except for writing to a new file: this is what ``limits`` permits."""
    found = attacked(home, LIMITS)
    assert found['done'] == found['tried']


def test_without_a_sandbox_nothing_is_run_unless_that_is_allowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If bubblewrap is missing or not permitted, the error contains the reason and the remedy; nothing is run."""
    packed, manifest = Spark(tmp_path).packed(1)
    broken = tmp_path / 'bin' / 'bwrap'
    broken.parent.mkdir()
    broken.write_text('#!/bin/sh\necho "bwrap: setting up uid map: Permission denied" >&2\nexit 1\n')
    broken.chmod(0o755)
    runs: list[list[str]] = []
    monkeypatch.setattr(smoke, '_run_child', lambda command, *_: (runs.append(command), (b'', -9))[1])
    for path, why in ((str(tmp_path), 'bubblewrap is not installed'), (str(broken.parent), 'setting up uid map: Permission')):
        monkeypatch.setenv('PATH', path)
        with pytest.raises(PolicyError, match=why) as raised:
            run_smoke(packed, manifest)
        assert 'apt install bubblewrap' in raised.value.remedy
        assert runs == []
        with pytest.raises(PolicyError, match='signal 9'):
            run_smoke(packed, manifest, isolation=LIMITS)
        assert runs.pop()[0] == sys.executable


@needs_bwrap
@pytest.mark.long('a process that runs a model')
def test_the_isolation_in_use_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A model runs in the sandbox, even if less is required; without one, ``limits`` is reported."""
    packed, manifest = Spark(tmp_path).packed(1)
    assert [run_smoke(packed, manifest, isolation=each).isolation for each in (SANDBOX, LIMITS)] == [SANDBOX, SANDBOX]
    monkeypatch.setattr(smoke.shutil, 'which', lambda _: None)
    assert run_smoke(packed, manifest, isolation=LIMITS).isolation == LIMITS


def test_no_folder_with_the_home_in_it_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A path of Python's packages that has the home of the user, or of the data logger, in it stays out of the sandbox."""
    home, packages = tmp_path / 'go2' / '.shadowhound', tmp_path / 'go2' / 'packages'
    packages.mkdir(parents=True)
    monkeypatch.setenv('HOME', str(home.parent))
    monkeypatch.setenv('SHADOWHOUND_HOME', '~/.shadowhound')
    monkeypatch.setattr(sys, 'path', ['/', str(tmp_path), str(tmp_path / 'go2'), str(packages)])
    shown = list(smoke._packages())
    assert str(packages) in shown
    assert not {'/', str(tmp_path), str(tmp_path / 'go2')} & set(shown)
    command, _ = open_sandbox(packages, str(tmp_path))
    assert str(home) not in command


@pytest.mark.parametrize('by', ['the registry', 'a pin'])
def test_a_version_that_was_tried_in_less_is_tried_again_before_it_is_activated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, by: str
) -> None:
    """Once more isolation is required than a version here was tried in, it waits for a smoke run that has that."""
    runs: list[str] = []
    possible = LIMITS

    def tried(folder: Path, manifest: PolicyManifest, isolation: str) -> SmokeRun:
        runs.append(folder.parent.name)
        if not is_enough(possible, isolation):
            raise PolicyError(f'{manifest.id} was not run')
        return SmokeRun(1.0, possible)

    monkeypatch.setattr(sync, 'run_smoke', tried)
    scene = Scene(tmp_path)
    first = scene.publish(1)
    with pytest.raises(PolicyError, match='was not run'):
        scene.robot.run()
    assert scene.folder.current() is None
    scene.robot.settings = replace(scene.robot.settings, isolation=LIMITS)
    assert scene.robot.run().active == first
    second = scene.publish(2)
    result = scene.robot.run()
    assert (result.active, result.isolation) == (second, LIMITS)
    assert scene.folder.state.read().verified == {first: LIMITS, second: LIMITS}

    scene.robot.settings = replace(scene.robot.settings, isolation=SANDBOX)
    if by == 'a pin':
        with scene.folder.state.changing() as state:
            state.pin = first
    else:
        scene.registry.say('champion', 1)
    with pytest.raises(PolicyError, match='was not run'):
        scene.robot.run()
    assert scene.folder.current() == second
    possible = SANDBOX
    result = scene.robot.run()
    assert (result.active, result.isolation) == (first, SANDBOX)
    assert scene.folder.state.read().verified == {second: LIMITS, first: SANDBOX}
    assert runs == ['incoming', 'incoming', 'incoming', 'versions', 'versions']


@pytest.mark.parametrize(('isolation', 'enough_for'), [
    (SANDBOX, [SANDBOX, LIMITS]), (LIMITS, [LIMITS]), (None, []), ('', []), ('magic', []),
])  # fmt: skip
def test_what_is_enough(isolation: str | None, enough_for: list[str]) -> None:
    """More isolation than required is enough, less is not; an unknown or missing value counts as no isolation."""
    assert [required for required in smoke.ISOLATIONS if is_enough(isolation, required)] == enough_for
