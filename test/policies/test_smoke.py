"""The smoke run: which versions it refuses, and what code inside it can do to the robot."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper
from policies.models import ACTION, STATE, Scene, Spark, linear

from shadowhound_data_logger.core.errors import PolicyError, PolicyRefused
from shadowhound_data_logger.policies import smoke, sync
from shadowhound_data_logger.policies.manifest import MANIFEST, PolicyManifest, parse_manifest
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
        client.sendall(b'')  # fails if the first datagram was refused

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
    'write to the control socket': lambda: connect(socket.AF_UNIX, str(home / 'spool/control.sock')),
    'write to an abstract socket': lambda: connect(socket.AF_UNIX, f'\\0shadowhound-{parent}'),
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
    output, code = smoke._run_child(child, smoke.environ_of(empty), empty, 60.0)
found = {
    **json.loads(output), 'code': code, 'victim': victim.poll(), 'current': os.readlink(home / 'policies/current'),
    'state': (home / 'policies/state.json').read_text(), 'spool': sorted(os.listdir(home / 'spool')),
}
victim.kill()
victim.wait()
print(json.dumps(found))
"""


@pytest.fixture
def home() -> Iterator[Path]:
    """The home of an unprivileged user, in folders that this user can enter."""
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


def test_limits_alone_stop_almost_no_attack(home: Path) -> None:
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


def test_the_sandbox_shows_no_folder_that_contains_the_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
def test_a_version_tried_with_less_isolation_is_tried_again_before_activation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, by: str
) -> None:
    """If more isolation is required than in the version's last smoke run, it is not activated before another smoke run."""
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
        scene.registry.set_alias('champion', 1)
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
def test_an_isolation_is_compared_with_the_required_one(isolation: str | None, enough_for: list[str]) -> None:
    """More isolation than required is enough, less is not; an unknown or missing value counts as no isolation."""
    assert [required for required in smoke.ISOLATIONS if is_enough(isolation, required)] == enough_for


# -- smoke runs ----------------------------------------------------------------------------------------------------------------


def greedy() -> onnx.ModelProto:
    """A model that allocates 32 GiB."""
    model = linear()
    model.graph.initializer.append(numpy_helper.from_array(np.array([1 << 33]), 'size'))
    model.graph.node[0].output[0] = 'half'
    model.graph.node.extend([
        helper.make_node('ConstantOfShape', ['size'], ['zeros']), helper.make_node('ReduceMax', ['zeros'], ['zero'], keepdims=0),
        helper.make_node('Add', ['half', 'zero'], [ACTION]),
    ])  # fmt: skip
    return model


@pytest.mark.long('a process for each run')
@pytest.mark.parametrize(('reason', 'change'), [
    ('', {}), ('output', {'outputs': np.array([[1.0, 2.0]], 'f4')}), ('pickle', {'inputs': np.array([{}], object)}),
    ('inputs', {'inputs': np.zeros((1, 4), 'f4')}), ('nan', {'model': linear(float('nan'))}),
    ('nan', {'model': linear(float('inf'))}), ('memory', {'model': greedy()}), ('smoke', {'model': linear(operator='Nonsense')}),
    ('slow', {'p99_ms': 1e-6}),
])  # fmt: skip
def test_the_smoke_run_refuses_each_kind_of_bad_model(tmp_path: Path, reason: str, change: dict[str, Any]) -> None:
    """Wrong outputs, invalid values, too slow, too much memory, or not executable: each in a process that runs the model."""
    packed, _ = Spark(tmp_path).packed(1)
    content = json.loads((packed / MANIFEST).read_bytes())
    for kind, name in (('inputs', STATE), ('outputs', ACTION)):
        if kind in change:
            np.save(packed / content['smoke'][kind][name], change[kind], allow_pickle=True)
    if 'model' in change:
        (packed / 'model.onnx').write_bytes(change['model'].SerializeToString())
    content['limits']['p99_ms'] = change.get('p99_ms', 5000.0)
    (packed / MANIFEST).write_text(json.dumps(content))
    manifest = parse_manifest((packed / MANIFEST).read_bytes())
    if not reason:
        assert run_smoke(packed, manifest, LIMITS).p99_ms > 0.0
        return
    with pytest.raises(PolicyRefused) as raised:
        run_smoke(packed, manifest, LIMITS)
    assert raised.value.reason == reason


def test_a_smoke_run_that_crashes_or_hangs_refuses_the_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    packed, manifest = Spark(tmp_path).packed(1)
    with pytest.raises(PolicyRefused) as raised:
        run_smoke(packed, manifest, LIMITS, limit_s=0.0)
    assert raised.value.reason == 'time'
    for output in ((b'', -11), (b'[' * 100_000, 0), (b'{"reason": ""}', 1), (b'\xff' * 70_000, -9)):
        monkeypatch.setattr(smoke, '_run_child', lambda *_, output=output: output)
        with pytest.raises(PolicyRefused) as raised:
            run_smoke(packed, manifest, LIMITS)
        assert raised.value.reason == 'smoke'


CONFINED = """
import os, sys
from shadowhound_data_logger.policies import smoke
if os.getuid() == 0:  # the limit of processes does not apply to root
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
smoke._confine()
said = []
for what in (os.fork, lambda: os.write(os.open('file', os.O_WRONLY | os.O_CREAT, 0o600), b'x' * 100)):
    try:
        what()
        said.append('done')
    except OSError as error:
        said.append(error.strerror)
print(said)
"""


def test_the_smoke_run_starts_nothing_and_writes_nothing() -> None:
    """It can start no process, and write no byte to any file."""
    environ = {'PYTHONPATH': os.pathsep.join(path for path in sys.path if path), 'PYTHONDONTWRITEBYTECODE': '1'}
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o777)
        command = [sys.executable, '-c', CONFINED]
        done = subprocess.run(command, cwd=folder, env=environ, check=True, capture_output=True, text=True)
    assert done.stdout == "['Resource temporarily unavailable', 'File too large']\n"


@pytest.mark.long('a process of its own')
@pytest.mark.skipif(os.getuid() != 0, reason='the other tests of smoke runs are those of an ordinary user')
def test_the_smoke_run_works_for_an_ordinary_user(tmp_path: Path) -> None:
    """The runtime needs no additional process or thread: a user other than root can have none there."""
    packed, _ = Spark(tmp_path).packed(1)
    rights = '=-all,+dac_override,+dac_read_search'  # to read Python's own files, wherever they are
    program = 'from shadowhound_data_logger.policies import smoke; smoke.main()'
    command = ['setpriv', '--reuid=65534', '--clear-groups', f'--inh-caps{rights}', f'--ambient-caps{rights}',
               f'--bounding-set{rights}', sys.executable, '-B', '-c', program, str(packed)]  # fmt: skip
    environ = smoke.environ_of(str(tmp_path))
    done = subprocess.run(command, cwd=tmp_path, env=environ, check=True, capture_output=True)
    assert json.loads(done.stdout)['reason'] == ''


STARTS = """
import os, sys, time
inside, outside = os.pipe()
if os.fork():
    os.read(inside, 1)
    while True:
        os.write(1, b'x' * 9999)
open(sys.argv[1], 'w').write(str(os.getpid()))
os.write(outside, b'x')
time.sleep(600)
"""


def test_processes_started_by_the_smoke_run_end_with_it(tmp_path: Path) -> None:
    """The output that is read from it is bounded, and so is its time."""

    def run(program: str, limit_s: float = 600.0) -> tuple[bytes, int | None]:
        return smoke._run_child([sys.executable, '-c', program, str(tmp_path / 'pid')], os.environ, str(tmp_path), limit_s)

    output, _ = run(STARTS)
    assert len(output) <= 2 * smoke.MAX_ANSWER_BYTES
    assert gone(int((tmp_path / 'pid').read_text()))
    assert run('print(1)') == (b'1\n', 0)
    assert run('import os; os.abort()') == (b'', -6)
    assert run('import time; time.sleep(600)', 0.1) == (b'', None)


def gone(pid: int) -> bool:
    """Whether the process has ended within a minute."""
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        with suppress(OSError):
            if Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] != 'Z':
                time.sleep(0.01)
                continue
        return True
    return False


@pytest.mark.long('a process of its own')
def test_the_smoke_run_takes_no_package_from_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise users who can write there could run code."""
    packed, manifest = Spark(tmp_path).packed(1)
    (tmp_path / 'here').mkdir()
    (tmp_path / 'here' / 'onnxruntime.py').write_text("raise RuntimeError('from here')")
    monkeypatch.chdir(tmp_path / 'here')
    monkeypatch.setattr(sys, 'path', ['', *sys.path])
    assert run_smoke(packed, manifest, LIMITS).p99_ms > 0.0
