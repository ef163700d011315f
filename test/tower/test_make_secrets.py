"""The secrets of a Tower and their rotation, also while a robot uses its keys over TLS."""

from __future__ import annotations

import json
import re
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from botocore.configloader import raw_config_parse
from e2e.conftest import running
from e2e.processes import Processes, until
from missions.server import complete
from shadowhound_tower import mlflow_access
from tower_scripts import TOWER, make_secrets, reload_s3, remove_database

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.core.mlflow_rest import login
from shadowhound_data_logger.missions.folder import missions
from shadowhound_data_logger.stores.s3 import S3Store


def _modes(folder: Path) -> set[str]:
    """The modes of the files with secrets: all except the digests."""
    files = {path for path in folder.rglob('*') if path.is_file()} - {folder / 'mlflow' / 'users.json'}
    return {oct(stat.S_IMODE(path.stat().st_mode)) for path in files}


def _key(folder: Path, user: str) -> str:
    return str(make_secrets.read_env(folder / 'secrets' / f'{user}.env')['AWS_SECRET_ACCESS_KEY'])


def test_only_their_owner_can_read_them(tmp_path: Path) -> None:
    """Every file has mode 600 and the folder 700, with any umask; except the digests, which reveal no password."""
    code = 'import os, sys; os.umask(0); sys.path.insert(0, sys.argv[1]); import make_secrets; make_secrets.main(sys.argv[2:])'
    subprocess.run([sys.executable, '-c', code, str(TOWER), '--folder', str(tmp_path)], check=True, capture_output=True)
    digests = tmp_path / 'mlflow' / 'users.json'
    assert (oct(stat.S_IMODE(digests.stat().st_mode)), oct(stat.S_IMODE(digests.parent.stat().st_mode))) == ('0o644', '0o755')
    logins = [key['password'] for keys in make_secrets.load_users(tmp_path / 'secrets/users.json').values() for key in keys]
    assert not [password for password in logins if password in digests.read_text()]
    assert _modes(tmp_path) == {'0o600'}
    assert stat.S_IMODE((tmp_path / 'secrets').stat().st_mode) == 0o700


def test_existing_secrets_are_kept(tmp_path: Path) -> None:
    """A second run changes no key and no password; a new robot and the address are added."""
    make_secrets.make(tmp_path, None, ['thor'])
    before = {path: path.read_text() for path in tmp_path.rglob('*.env')}
    make_secrets.make(tmp_path, None, ['thor'])
    assert {path: path.read_text() for path in tmp_path.rglob('*.env')} == before
    make_secrets.make(tmp_path, '192.168.1.10', ['tachi'])
    settings = make_secrets.read_env(tmp_path / '.env')
    assert settings['TOWER_HOST'] == '192.168.1.10'
    assert settings['POSTGRES_PASSWORD'] in before[tmp_path / '.env']
    tachi = make_secrets.read_env(tmp_path / 'secrets' / 'tachi.env')
    assert tachi['AWS_ENDPOINT_URL'] == 'http://192.168.1.10:9000'
    assert tachi['SHADOWHOUND_ROBOT'] == 'tachi'


def test_the_files_of_users_name_the_ports_of_their_tower(tmp_path: Path) -> None:
    """Also if a key is changed later; a Tower at the default ports gets these back."""
    make_secrets.make(tmp_path, '192.168.1.10', ['thor'], offset=1000)
    make_secrets.make(tmp_path, None, [], rotate=['thor'])
    thor = make_secrets.read_env(tmp_path / 'secrets' / 'thor.env')
    assert thor['AWS_ENDPOINT_URL'] == thor['MLFLOW_S3_ENDPOINT_URL'] == 'http://192.168.1.10:10000'
    assert thor['MLFLOW_TRACKING_URI'] == 'http://192.168.1.10:6001'
    make_secrets.make(tmp_path, None, [], offset=0)
    assert make_secrets.read_env(tmp_path / 'secrets' / 'thor.env')['MLFLOW_TRACKING_URI'] == 'http://192.168.1.10:5001'


def test_missing_secrets_are_added(tmp_path: Path) -> None:
    """The signing keys and the certificate of SeaweedFS are added, once, without changing existing keys and passwords."""
    make_secrets.make(tmp_path, '192.168.1.10', ['thor'])
    for path in (tmp_path / 'secrets').glob('se*.*'):
        path.unlink()
    before = {path: path.read_bytes() for path in tmp_path.rglob('*') if path.is_file()}
    make_secrets.make(tmp_path, None, [])
    added = {path: path.read_bytes() for path in (tmp_path / 'secrets').glob('se*.*')}
    assert {path.name for path in added} == {'security.toml', 'seaweedfs.env', 'seaweedfs.crt', 'seaweedfs.key'}
    make_secrets.make(tmp_path, None, ['thor'])
    assert {path: path.read_bytes() for path in tmp_path.rglob('*') if path.is_file()} == {**before, **added}
    assert _modes(tmp_path) == {'0o600'}
    report = make_secrets.read_env(tmp_path / 'secrets' / 'seaweedfs.env')
    assert len(set(re.findall('key = "([0-9a-f]{64})"', (tmp_path / 'secrets' / 'security.toml').read_text()))) == 4
    assert all((tmp_path / 'secrets' / value).is_file() for value in report.values())


def test_a_missing_openssl_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """No incomplete file is left: the next run starts again."""
    with monkeypatch.context() as patch:
        patch.setenv('PATH', str(tmp_path))
        assert make_secrets.main(['--folder', str(tmp_path)]) == 2
    assert 'apt install openssl' in capsys.readouterr().err
    assert not list(tmp_path.rglob('seaweedfs.*'))
    assert make_secrets.main(['--folder', str(tmp_path)]) == 0


def test_no_secret_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The script's output contains no key and no password."""
    assert make_secrets.main(['--folder', str(tmp_path)]) == 0
    printed = ''.join(capsys.readouterr())
    settings = make_secrets.read_env(tmp_path / '.env')
    secret = {value for name, value in settings.items() if 'SECRET' in name or 'PASSWORD' in name}
    secret |= set(re.findall('key = "([0-9a-f]{64})"', (tmp_path / 'secrets' / 'security.toml').read_text()))
    assert len(secret) == 8
    assert not [value for value in secret if value in printed]


def test_a_key_is_rotated_without_a_gap(tmp_path: Path) -> None:
    """Rotating adds a key before the old one, which is removed when it is retired; other users keep theirs."""
    make_secrets.make(tmp_path, None, ['thor'])
    old, spark = _key(tmp_path, 'thor'), _key(tmp_path, 'spark')
    make_secrets.make(tmp_path, None, [], rotate=['thor'])
    new = _key(tmp_path, 'thor')
    identities = {one['name']: one for one in json.loads((tmp_path / 'secrets' / 's3.json').read_text())['identities']}
    assert [key['secretKey'] for key in identities['thor']['credentials']] == [new, old]
    make_secrets.make(tmp_path, None, [], retire=['thor'])
    assert [key['secretKey'] for key in make_secrets.load_users(tmp_path / 'secrets' / 'users.json')['thor']] == [new]
    assert _key(tmp_path, 'spark') == spark
    assert old != new


def test_a_password_of_mlflow_is_changed_with_the_keys(tmp_path: Path) -> None:
    """The new one is valid next to the old one until that is retired; the server's S3 user has none."""
    make_secrets.make(tmp_path, None, ['thor'])
    old = make_secrets.read_env(tmp_path / 'secrets' / 'thor.env')['MLFLOW_TRACKING_PASSWORD']
    make_secrets.make(tmp_path, None, [], rotate=['thor'])
    environ = make_secrets.read_env(tmp_path / 'secrets' / 'thor.env')
    new, file = environ['MLFLOW_TRACKING_PASSWORD'], tmp_path / 'mlflow' / 'users.json'
    assert json.loads(file.read_text())['thor'] == [mlflow_access.digest(new), mlflow_access.digest(old)]
    make_secrets.make(tmp_path, None, [], retire=['thor'])
    known = json.loads(file.read_text())
    assert known['thor'] == [mlflow_access.digest(new)]
    assert known.keys() == {'tower', 'spark', 'thor'}
    assert environ['MLFLOW_TRACKING_USERNAME'] == 'thor'
    assert 'MLFLOW_TRACKING_USERNAME' not in make_secrets.read_env(tmp_path / 'secrets' / 'mlflow.env')


def test_missing_passwords_are_added(tmp_path: Path) -> None:
    """The keys are unchanged, and S3 has no passwords."""
    make_secrets.make(tmp_path, None, ['thor'])
    path = tmp_path / 'secrets' / 'users.json'
    before = {user: [{name: key[name] for name in ('accessKey', 'secretKey')} for key in keys]
              for user, keys in make_secrets.load_users(path).items()}  # fmt: skip
    path.write_text(json.dumps(before))
    (tmp_path / 'mlflow' / 'users.json').unlink()
    make_secrets.make(tmp_path, None, [])
    identities = json.loads((tmp_path / 'secrets' / 's3.json').read_text())['identities']
    assert {one['name']: one['credentials'] for one in identities} == before
    environ = make_secrets.read_env(tmp_path / 'secrets' / 'thor.env')
    digests = json.loads((tmp_path / 'mlflow' / 'users.json').read_text())
    assert digests['thor'] == [mlflow_access.digest(environ['MLFLOW_TRACKING_PASSWORD'])]


def test_a_file_of_keys_is_the_environment_of_its_user(tmp_path: Path) -> None:
    """The newest pair, which botocore reads from it; MLflow's clients read its password, as ~/.mlflow/credentials."""
    make_secrets.make(tmp_path, None, ['thor'])
    make_secrets.make(tmp_path, None, [], rotate=['thor'])
    found = raw_config_parse(str(tmp_path / 'secrets' / 'thor.credentials'))['default']
    environ = make_secrets.read_env(tmp_path / 'secrets' / 'thor.env')
    assert found == {
        'aws_access_key_id': environ['AWS_ACCESS_KEY_ID'], 'aws_secret_access_key': environ['AWS_SECRET_ACCESS_KEY'],
    }  # fmt: skip
    (tmp_path / '.mlflow').mkdir()
    (tmp_path / '.mlflow' / 'credentials').symlink_to(tmp_path / 'secrets' / 'thor.credentials')
    assert login({}, tmp_path) == ('thor', environ['MLFLOW_TRACKING_PASSWORD'])


def test_a_certificate_makes_the_addresses_https(tmp_path: Path) -> None:
    """And the file has the CA for both clients; without a certificate there is neither."""
    make_secrets.make(tmp_path, None, ['thor'])
    plain = make_secrets.read_env(tmp_path / 'secrets' / 'thor.env')
    (tmp_path / 'tls').mkdir()
    (tmp_path / 'tls' / 'tower.crt').touch()
    make_secrets.make(tmp_path, None, ['thor'])
    secured = make_secrets.read_env(tmp_path / 'secrets' / 'thor.env')
    assert {name: value.replace('http:', 'https:') for name, value in plain.items()}.items() <= secured.items()
    assert secured.keys() - plain.keys() == {'AWS_CA_BUNDLE', 'MLFLOW_TRACKING_SERVER_CERT_PATH'}


@pytest.mark.parametrize('name', ['../thor', 'thor*', 'Thor', '', 'a b', '-x'])
def test_a_name_that_is_a_pattern_is_refused(tmp_path: Path, name: str) -> None:
    """A robot's name becomes part of its permissions: no wildcard and no path is accepted."""
    with pytest.raises(make_secrets.Refused):
        make_secrets.make(tmp_path, None, [name])
    assert make_secrets.main(['--folder', str(tmp_path), '--rotate', 'nobody']) == 2


START_S = 120.0
MANUAL = Path(__file__).parents[2] / 'docs' / 'tower.md'
PARAMETERS = {
    'bag.record': 'always', 'bag.slice_s': 2.0, 'catalog.period_s': 2.0, 'lowstate.batch_s': 1.0,
    'mission.frame_every_s': 1.0,
}  # fmt: skip


def certified(folder: Path) -> None:
    """Follow the manual, except for the address and the folder."""
    text = MANUAL.read_text(encoding='utf-8')
    section = text[text.index('\n## TLS') :]
    lines = re.search(r'((?:    .*\n)+)', section)
    assert lines
    script = lines[1].replace('192.168.1.10', '127.0.0.1').replace('mkdir -p tower/tls && cd tower/tls', 'mkdir tls && cd tls')
    subprocess.run(['bash', '-ec', script], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def tower(tmp_path: Path, offset: int) -> Iterator[Path]:
    """The folder of a running Tower with TLS."""
    folder = tmp_path / 'tower'
    folder.mkdir()
    certified(folder)
    command = [sys.executable, str(TOWER / 'run.py'), '--folder', str(folder), '--offset', str(offset)]
    with (folder / 'log').open('w', encoding='utf-8') as log, subprocess.Popen(command, stdout=log, stderr=log) as process:
        try:
            report = folder / 'log'
            until(lambda: 'credentials' in report.read_text() or process.poll() is not None, report.read_text, START_S)
            assert process.poll() is None, report.read_text()
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
    """The variables in the file that the Tower wrote, with the CA's location here."""
    found: dict[str, str] = make_secrets.read_env(folder / 'secrets' / f'{user}.env')
    assert found['AWS_ENDPOINT_URL'].endswith(f':{9000 + offset}')
    assert found['MLFLOW_TRACKING_URI'].endswith(f':{5001 + offset}')
    return json.loads(json.dumps(found).replace('/etc/shadowhound/ca.pem', str(folder / 'tls' / 'ca.pem')))  # type: ignore[no-any-return]


def rotate(folder: Path, file: Path, secrets: list[str]) -> None:
    """As in docs/tower.md; the old key is refused from here on."""
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
    """All keys below the robot's name, listed by a user with permission."""
    settings = StoreSettings(endpoint_url=environ['AWS_ENDPOINT_URL'], access_key_id=environ['AWS_ACCESS_KEY_ID'],
                             secret_access_key=environ['AWS_SECRET_ACCESS_KEY'])  # fmt: skip
    with closing(S3Store(settings, UploadSettings())) as store:
        store.open()
        return [info.key for bucket in ('sensor-data', 'trajectories') for info in store.list(bucket, 'thor/')]


@pytest.mark.seaweedfs
@pytest.mark.ros
@pytest.mark.timeout(400)
@pytest.mark.long('a minute with a Tower of its own')
def test_a_robot_works_with_its_own_keys_during_rotations(
    tower: Path, offset: int, processes: Processes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sensors, a mission, a bag and the catalog arrive; two rotations in between lose and quarantine nothing."""
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
    text = node.log + (node.home / 'spool' / 'status-thor.json').read_text()
    text += ''.join(path.read_text(errors='replace') for path in (node.home / 'missions').rglob('*.log'))
    assert not [secret for secret in secrets if secret in text]
