"""The process that sends missions: which interpreter runs it, in which folder, and what an agent without one sees."""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest
from missions.fakes import journal
from missions.server import end_replayers, until

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.missions import child
from shadowhound_data_logger.missions.child import interpreter
from shadowhound_data_logger.missions.folder import MISSIONS, missions, read_json

REAL: Final = sys.executable


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Path]:
    yield tmp_path / 'home'
    end_replayers(tmp_path / 'home')


@pytest.fixture
def host(tmp_path: Path) -> Path:
    """A program that embeds Python, and records each start."""
    return program(tmp_path / 'bin/my_robot_app', tmp_path / 'started')


def program(path: Path, log: Path) -> Path:
    path.parent.mkdir(exist_ok=True, parents=True)
    path.write_text(f'#!/bin/sh\necho "$*" >> {log}\n')
    path.chmod(0o755)
    return path


def nowhere(patched: pytest.MonkeyPatch, folder: Path) -> None:
    """As in a frozen program: no installation of Python at all."""
    for name in ('prefix', 'exec_prefix', 'base_prefix', 'base_exec_prefix'):
        patched.setattr(sys, name, str(folder))
    patched.setattr(child.sysconfig, 'get_config_var', lambda _: str(folder / 'bin'))
    patched.setattr(sys, '_base_executable', None, raising=False)


@pytest.mark.parametrize('executable', [None, '', 'host', 'python3', '/nowhere/python3', 3, '/', '/etc/passwd'])
def test_an_embedded_python_finds_its_interpreter(host: Path, monkeypatch: pytest.MonkeyPatch, executable: Any) -> None:
    """From the location of Python's installation; the host program is not used instead."""
    monkeypatch.setattr(sys, 'executable', str(host) if executable == 'host' else executable)
    monkeypatch.setattr(sys, '_base_executable', str(host), raising=False)
    found = interpreter()
    assert found is not None
    asked = [found, '-c', 'import sys; print(*sys.version_info[:2])']
    assert subprocess.run(asked, capture_output=True, text=True, check=True).stdout.split() == [*map(str, sys.version_info[:2])]


def test_a_frozen_program_has_no_interpreter(host: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Though it may be called python3, directly or by a link, or have an interpreter of another version next to it."""
    nowhere(monkeypatch, tmp_path)
    monkeypatch.setattr(sys, 'executable', str(host))
    assert interpreter() is None
    (tmp_path / 'bin/python3').symlink_to(host)
    monkeypatch.setattr(sys, 'executable', str(tmp_path / 'bin/python3'))
    assert interpreter() is None
    monkeypatch.setattr(sys, 'executable', str(program(tmp_path / 'bin/python3.9', tmp_path / 'started')))
    assert interpreter() is None
    monkeypatch.setattr(sys, 'executable', REAL)
    assert interpreter() == REAL
    monkeypatch.setattr(sys, 'frozen', True, raising=False)
    assert interpreter() is None


@pytest.mark.parametrize('executable', [None, '', 'host'])
def test_without_an_interpreter_missions_are_journaled(
    host: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, executable: str | None
) -> None:
    """One warning with a remedy, no error, and nothing is started."""
    nowhere(monkeypatch, tmp_path)
    monkeypatch.setattr(sys, 'executable', str(host) if executable else executable)
    logger = MissionDataLogger(home=tmp_path / 'home', robot='thor', start_timeout_s=0.1)
    assert logger._replayer is not None
    assert logger.start_mission('patrol', 'x').startswith('patrol_')
    logger.log_metric('a', 1.0)
    logger.end_mission(True, 1, 1)
    for _ in range(3):
        logger._replayer.supervise()
    report = logger.close()
    assert [record['k'] for record in journal(tmp_path / 'home')] == ['start', 'metrics', 'end']
    warnings = [record.message for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(warnings) == 1
    assert 'missions resume' in warnings[0]
    assert not (tmp_path / 'started').exists()
    assert not report.complete


def test_an_interpreter_that_cannot_import_us_is_not_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """It is logged once, with the path of the log that has the reason."""
    monkeypatch.setattr(child, 'PACKAGE', str(tmp_path))
    monkeypatch.setattr(child, 'interpreter', lambda: REAL)
    monkeypatch.setenv('PYTHONPATH', str(tmp_path))
    monkeypatch.setenv('PYTHONNOUSERSITE', '1')
    (tmp_path / 'shadowhound_data_logger.py').write_text('')
    logger = MissionDataLogger(home=tmp_path / 'home', start_timeout_s=0.0)
    try:
        until(lambda: 'cannot import' in caplog.text, 'it is said')
        assert logger._replayer is not None
        for _ in range(3):
            logger._replayer.supervise()
    finally:
        logger.close()
    assert caplog.text.count('not sent') == 1
    assert 'shadowhound_data_logger' in (tmp_path / 'home' / MISSIONS / 'replay.log').read_text()


def is_holding(pid: int) -> bool:
    """Whether the sender has started and waits: it lowers its priority right before that."""
    state, *fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return state == 'S' and int(fields[15]) == min(os.nice(0) + child.NICE, 19)


@pytest.mark.parametrize('by', ['wake', 'release', 'LOAD_DELAY_S'])
def test_the_sender_loads_nothing_until_it_is_woken(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, by: str) -> None:
    """Or its agent is gone, or a second has passed: the CPU is reserved for the first mission's request for a run."""
    fake, loaded = tmp_path / 'package/shadowhound_data_logger/missions', tmp_path / 'loaded'
    fake.mkdir(parents=True)
    for folder in (fake, fake.parent):
        (folder / '__init__.py').touch()
    (fake / 'replay.py').write_text(f'open({str(loaded)!r}, "w")\ndef main(): pass\n')
    monkeypatch.setattr(child, 'PACKAGE', str(fake.parents[1]))
    monkeypatch.setattr(child, 'LOAD_DELAY_S', 0.0 if by == 'LOAD_DELAY_S' else 3600.0)
    replayer = child.Replayer(home, 'x', {})
    replayer.start()
    assert replayer._process is not None
    if by != 'LOAD_DELAY_S':
        pid = replayer._process.pid
        until(lambda: is_holding(pid), 'it waits')
        assert not loaded.exists()
        getattr(replayer, by)()
    until(loaded.exists, 'it loads the package')
    replayer.release()


@pytest.mark.parametrize('arguments', [
    {'robot': 'a/b'}, {'robot': 3}, {'home': 3}, {'home': 'a\0b'}, {'home': b'a'}, {'home': '~nobody-here/x'},
    {'tracking_uri': 3}, {'tracking_uri': 'a\0b'}, {'experiment': 'a\0b'}, {'experiment': 3}, {'start_timeout_s': 'x'},
    {'start_timeout_s': -1},
    {'frame_artifact_every_s': None}, {'frame_artifact_every_s': float('nan')},
])  # fmt: skip
def test_the_constructor_raises_setting_errors_only(arguments: dict[str, Any]) -> None:
    """For any invalid argument."""
    with pytest.raises(SettingError, match=next(iter(arguments)) if arguments != {'home': '~nobody-here/x'} else 'HOME'):
        MissionDataLogger(**arguments)


@pytest.mark.parametrize('name', ['AWS_ENDPOINT_URL', 'AWS_ENDPOINT_URL_S3', 'MLFLOW_S3_ENDPOINT_URL'])
@pytest.mark.parametrize(
    'value', ['http://tower:9000 ', 'tower:9000', 'http://tower:9000?x=1', 'http://a:b@tower:9000', 'http://t:99999']
)
def test_an_endpoint_that_no_client_can_use_is_an_invalid_setting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, value: str
) -> None:
    """By the same rules for objects and for MLflow's artifacts: the sender, which would fail, is not started."""
    monkeypatch.setattr(child.Replayer, 'start', lambda _: pytest.fail('it is started'))
    monkeypatch.setenv(name, value)
    with pytest.raises(SettingError, match=f'^{name} = '):
        MissionDataLogger(home=tmp_path)
    MissionDataLogger(home=tmp_path, replay=False).close()


def test_a_deleted_working_directory_does_not_stop_the_sender(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An absolute home still works; a relative one is an invalid setting."""
    gone = tmp_path / 'gone'
    gone.mkdir()
    monkeypatch.chdir(gone)
    monkeypatch.setenv('PYTHONPATH', 'lib')
    shutil.rmtree(gone)
    try:
        logger = MissionDataLogger(home=tmp_path / 'home', start_timeout_s=0.0)
        logger.close()
        with pytest.raises(SettingError):
            MissionDataLogger(home='relative')
    finally:
        os.chdir(tmp_path)
        end_replayers(tmp_path / 'home')


def test_a_mission_is_journaled_when_no_thread_can_be_started(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The mission is still logged, and synced when the logger is closed."""

    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, 'start', refuse)
    monkeypatch.setattr(child.Replayer, 'start', lambda _: None)
    logger = MissionDataLogger(home=home, start_timeout_s=0.1, tracking_uri='http://127.0.0.1:9')
    assert logger.start_mission('patrol', '').startswith('patrol_')
    logger.end_mission(True, 1, 1)
    logger.close()
    assert [record['k'] for record in journal(home)] == ['start', 'end']


AGENT: Final = """
import sys
from shadowhound_data_logger import MissionDataLogger
logger = MissionDataLogger(start_timeout_s=60)
run_id = logger.start_mission('patrol', 'relative')
logger.log_artifact(__file__)
logger.end_mission(True, 1, 1)
report = logger.close(60)
assert report.complete, report
print(run_id)
"""


@pytest.mark.long('a sender that loads MLflow')
@pytest.mark.parametrize(('uri', 'made'), [
    ('sqlite:///mlflow.db', 'mlflow.db'), ('file:mlruns', 'mlruns'), ('./mlruns', 'mlruns'), ('mlruns', 'mlruns'),
])  # fmt: skip
def test_relative_paths_are_relative_to_the_agents_folder(tmp_path: Path, home: Path, uri: str, made: str) -> None:
    """A store for MLflow, a home, and PYTHONPATH; modules in the agent's folder do not replace Python's own."""
    work = tmp_path / 'work'
    (work / 'agent').mkdir(parents=True)
    (work / 'agent/go.py').write_text(AGENT)
    for name in ('queue', 'select', 'mlflow', 'journal', 'yaml'):
        (work / f'{name}.py').write_text('raise SystemExit("not this one")\n')
    lib = work / 'lib'
    lib.mkdir()
    (lib / 'shadowhound_data_logger').symlink_to(Path(child.PACKAGE) / 'shadowhound_data_logger')
    environ = {name: value for name, value in os.environ.items() if not name.startswith(('MLFLOW_', 'AWS_', 'SHADOWHOUND_'))}
    environ |= {'MLFLOW_TRACKING_URI': uri, 'SHADOWHOUND_HOME': '../home', 'PYTHONPATH': 'lib'}
    done = subprocess.run([REAL, 'agent/go.py'], cwd=work, env=environ, capture_output=True, text=True, timeout=120, check=False)
    assert not done.returncode, done.stdout + done.stderr
    (folder,) = missions(home)
    assert read_json(folder.path / 'run.json')['run_id'] == done.stdout.split()[-1]
    assert (work / made).exists()
    assert not list((home / MISSIONS).glob('ml*'))
