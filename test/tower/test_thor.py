"""A robot with its own keys alone, over TLS, with the commands of the manual: all works, also while its keys are changed."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from e2e.conftest import running
from e2e.processes import Processes, until
from missions.server import complete
from tower_scripts import TOWER, make_secrets, reload_s3, remove_database

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.missions.folder import missions
from shadowhound_data_logger.stores.s3 import S3Store

pytestmark = [
    pytest.mark.seaweedfs,
    pytest.mark.ros,
    pytest.mark.timeout(400),
    pytest.mark.long('a minute with a Tower of its own'),
]
START_S = 120.0
MANUAL = Path(__file__).parents[2] / 'docs' / 'tower.md'
PARAMETERS = {
    'bag.record': 'always', 'bag.slice_s': 2.0, 'catalog.period_s': 2.0, 'lowstate.batch_s': 1.0,
    'mission.frame_every_s': 1.0,
}  # fmt: skip


def certified(folder: Path) -> None:
    """Follow the manual, but for the address and the folder."""
    text = MANUAL.read_text(encoding='utf-8')
    section = text[text.index('\n## TLS') :]
    lines = re.search(r'((?:    .*\n)+)', section)
    assert lines
    script = lines[1].replace('192.168.1.10', '127.0.0.1').replace('mkdir -p tower/tls && cd tower/tls', 'mkdir tls && cd tls')
    subprocess.run(['bash', '-ec', script], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def tower(tmp_path: Path, offset: int) -> Iterator[Path]:
    """The folder of a Tower behind TLS that runs."""
    folder = tmp_path / 'tower'
    folder.mkdir()
    certified(folder)
    command = [sys.executable, str(TOWER / 'run.py'), '--folder', str(folder), '--offset', str(offset)]
    with (folder / 'log').open('w', encoding='utf-8') as log, subprocess.Popen(command, stdout=log, stderr=log) as process:
        try:
            said = folder / 'log'
            until(lambda: 'credentials' in said.read_text() or process.poll() is not None, said.read_text, START_S)
            assert process.poll() is None, said.read_text()
            yield folder
        finally:
            process.terminate()
            process.wait(60)
            remove_database(folder, offset)


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    with running(tmp_path) as started:
        yield started


def environment(folder: Path, user: str, offset: int) -> dict[str, str]:
    """Of the file that the Tower wrote, with the authority where it is here."""
    found: dict[str, str] = make_secrets.read_env(folder / 'secrets' / f'{user}.env')
    assert found['AWS_ENDPOINT_URL'].endswith(f':{9000 + offset}')
    assert found['MLFLOW_TRACKING_URI'].endswith(f':{5001 + offset}')
    return json.loads(json.dumps(found).replace('/etc/shadowhound/ca.pem', str(folder / 'tls' / 'ca.pem')))  # type: ignore[no-any-return]


def rotate(folder: Path, file: Path, secrets: list[str]) -> None:
    """As docs/tower.md says; the old key is refused from here on."""
    make_secrets.make(folder, None, [], rotate=['thor'])
    reload_s3(folder)
    new = folder / 'secrets' / 'thor.credentials'
    part = file.with_name('new')
    part.write_text(new.read_text())
    part.replace(file)
    make_secrets.make(folder, None, [], retire=['thor'])
    reload_s3(folder)
    key = make_secrets.load_users(folder / 'secrets' / 'users.json')['thor'][0]
    secrets += [key['secretKey'], key['password']]


def everything(environ: dict[str, str]) -> list[str]:
    """All keys below the robot's name, by one who may list."""
    settings = StoreSettings(endpoint_url=environ['AWS_ENDPOINT_URL'], access_key_id=environ['AWS_ACCESS_KEY_ID'],
                             secret_access_key=environ['AWS_SECRET_ACCESS_KEY'])  # fmt: skip
    with closing(S3Store(settings, UploadSettings())) as store:
        store.open()
        return [info.key for bucket in ('sensor-data', 'trajectories') for info in store.list(bucket, 'thor/')]


def test_a_robot_lives_with_its_own_keys(
    tower: Path, offset: int, processes: Processes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sensors, a mission, a bag and the catalog arrive; two rotations meanwhile lose and quarantine nothing."""
    environ = environment(tower, 'thor', offset)
    secrets = [environ.pop('AWS_SECRET_ACCESS_KEY'), environ.pop('MLFLOW_TRACKING_PASSWORD')]
    del environ['AWS_ACCESS_KEY_ID'], environ['MLFLOW_TRACKING_USERNAME']
    file = tmp_path / 'credentials'
    file.write_text((tower / 'secrets' / 'thor.credentials').read_text())
    environ |= {'AWS_SHARED_CREDENTIALS_FILE': str(file), 'AWS_CONFIG_FILE': str(tmp_path / 'none')}
    (tmp_path / '.mlflow').mkdir()
    (tmp_path / '.mlflow' / 'credentials').symlink_to(file)
    monkeypatch.setenv('HOME', str(tmp_path))
    for name in ('AWS_ACCESS_KEY_ID', 'AWS_SECRET_ACCESS_KEY', 'MLFLOW_TRACKING_USERNAME', 'MLFLOW_TRACKING_PASSWORD'):
        monkeypatch.delenv(name, raising=False)
    for name, value in environ.items():
        monkeypatch.setenv(name, value)
    processes.robot = 'thor'
    node = processes.node(environ, PARAMETERS)
    processes.sim('duration_s:=240.0')
    until(lambda: node.ledger()['objects']['delivered'] > 20, 'objects are delivered')
    logger = MissionDataLogger(home=node.home, robot='thor', start_timeout_s=60.0)
    run_id = logger.start_mission('patrol', 'go round')
    assert run_id
    (folder,) = missions(node.home)
    until(folder.node.journal.exists, 'the node joins in')
    for number in (1, 2):
        rotate(tower, file, secrets)
        until(lambda number=number: node.log.count('the keys were refused') == number, 'the new keys are taken')  # type: ignore[misc]
        before = node.ledger()['objects']['delivered']
        until(lambda before=before: node.ledger()['objects']['delivered'] > before + 20, 'delivery goes on')  # type: ignore[misc]
    logger.end_mission(True, 0.0, 0.0)
    until(lambda: complete(node.home), lambda: f'all is sent: {logger.flush(0.0)}', 120)
    assert logger.close().complete
    ledger = node.stop()
    assert ledger['balanced']
    assert 'delivery is paused' not in node.log
    objects = ledger['objects']
    assert (objects['quarantined'], objects['evicted']) == (0, 0)
    owner: dict[str, Any] = environment(tower, 'tower', offset)
    keys = everything(owner)
    kinds = {key.split('/')[1] for key in keys if key.count('/') > 1}
    assert kinds >= {'camera', 'imu', 'lidar', 'lowstate', 'odom', 'states', 'missions', 'rosbags', '_catalog', '_ledger'}
    assert any(key.endswith('manifest.json') for key in keys)
    said = node.log + (node.home / 'spool' / 'status-thor.json').read_text()
    said += ''.join(path.read_text(errors='replace') for path in (node.home / 'missions').rglob('*.log'))
    assert not [secret for secret in secrets if secret in said]
