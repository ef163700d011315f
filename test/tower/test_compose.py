"""compose.yaml, as far as it can be checked without an engine: the services, their arguments, and their reachability."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import boto3
import pytest
import urllib3
import yaml
from missions.server import until
from shadowhound_tower import mlflow_access
from shadowhound_tower.servers import Ports, Server, find_program
from tower_scripts import TOWER, make_secrets, prepare


@pytest.fixture(scope='module')
def services() -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((TOWER / 'compose.yaml').read_text(encoding='utf-8'))['services']
    return found


def test_every_image_is_pinned(services: dict[str, Any]) -> None:
    """An image has an exact version and a digest; those built here install wheels from a lock file with hashes."""
    built = (TOWER / 'Dockerfile.mlflow').read_text(encoding='utf-8')
    (base,) = re.findall(r'^FROM (\S+)$', built, re.MULTILINE)
    images = {base, *(service['image'] for service in services.values())}
    assert {image.partition(':')[0] for image in images} == {
        'python', 'chrislusf/seaweedfs', 'postgres', 'shadowhound-tower-mlflow',
    }  # fmt: skip
    for image in images:
        digest = '' if image.startswith('shadowhound-') else '@sha256:[0-9a-f]{64}'
        assert re.fullmatch(rf'[\w./-]+:(4\.\d+|17\.\d+-[\w-]+|3\.\d+\.\d+[\w-]*){digest}', image), image
    assert 'pip install --no-cache-dir --no-deps --require-hashes --only-binary :all: -r /tmp/mlflow.txt' in built
    assert len(re.findall('pip install', built)) == 1


def test_the_image_of_mlflow_has_what_the_tests_run(services: dict[str, Any]) -> None:
    """Its lock file has a hash for each file, and the version of each package is that of the test environment."""
    locked = re.findall(r'^([\w.-]+)==([^ \\]+)(?: ;[^\\]*)? \\\n((?:    --hash=sha256:[0-9a-f]{64}(?: \\)?\n)+)',
                        (TOWER / 'mlflow.txt').read_text(encoding='utf-8'), re.MULTILINE)  # fmt: skip
    names = {name for name, _, _ in locked}
    lines = [line for line in (TOWER / 'mlflow.txt').read_text(encoding='utf-8').splitlines() if re.match(r'\w', line)]
    assert len(locked) == len(lines)
    assert {'mlflow', 'psycopg2-binary', 'boto3', 'flask-wtf', 'starlette'} <= names
    tested = (TOWER.parent / 'requirements' / 'wheels.txt').read_text(encoding='utf-8')
    assert [name for name, version, _ in locked if f'\n{name}=={version} ' not in tested] == []
    version = dict(one[:2] for one in locked)['mlflow']
    assert services['mlflow']['image'] == services['prepare']['image'] == f'shadowhound-tower-mlflow:{version}'
    ignored = (TOWER / '.dockerignore').read_text(encoding='utf-8').split('\n')
    assert ignored[1:] == ['*', '!mlflow.txt', '']


def test_servers_are_monitored_and_restarted(services: dict[str, Any]) -> None:
    """Each server has a health check and is restarted; the one that prepares the buckets runs to completion."""
    for name, service in services.items():
        if name == 'prepare':
            assert service['restart'].startswith('on-failure')
        else:
            assert service['healthcheck']['test'][0] == 'CMD'
            assert service['restart'] == 'unless-stopped'
    assert services['mlflow']['depends_on']['prepare']['condition'] == 'service_completed_successfully'


def test_servers_listen_on_the_configured_address(services: dict[str, Any], tmp_path: Path) -> None:
    """Ports are bound to TOWER_HOST, which is 127.0.0.1 by default; the database has none."""
    ports = {name: service['ports'] for name, service in services.items() if 'ports' in service}
    assert set(ports) == {'s3', 'mlflow'}
    assert all(port.startswith('${TOWER_HOST:?') for one in ports.values() for port in one)
    assert [port.split('}')[1] for one in ports.values() for port in one] == [':9000:8333', ':5001:5000']
    make_secrets.make(tmp_path, None, ['thor'])
    assert make_secrets.read_env(tmp_path / '.env')['TOWER_HOST'] == '127.0.0.1'


def test_every_variable_is_in_the_file_that_is_made(tmp_path: Path) -> None:
    """make_secrets.py writes every variable and every file that compose.yaml refers to."""
    text = (TOWER / 'compose.yaml').read_text(encoding='utf-8')
    make_secrets.make(tmp_path, None, ['thor'])
    assert set(re.findall(r'\$\{(\w+)', text)) == {'TOWER_HOST'}
    named = re.findall(r'\./(secrets/[\w.]+)', text)
    assert 'secrets/seaweedfs.env' in named
    assert all((tmp_path / name).is_file() for name in named)


def test_no_container_has_a_secret_in_its_environment(services: dict[str, Any], secured: dict[str, Any], tmp_path: Path) -> None:
    """Neither in a variable, nor in an env file, nor in a command; each secret that a container uses is declared."""
    make_secrets.make(tmp_path, None, ['thor'])
    settings = make_secrets.read_env(tmp_path / '.env')
    given = {name for name in settings if not name.startswith(('TOWER_HOST', 'TOWER_OFFSET', 'TOWER_SCHEME'))}
    assert len(given) == 6
    text = (tmp_path / 'secrets' / 'seaweedfs.env').read_text() + json.dumps([services, secured])
    assert [name for name in given if settings[name] in text or f'${{{name}' in text] == []
    signing = re.findall('key = "([0-9a-f]{64})"', (tmp_path / 'secrets' / 'security.toml').read_text())
    assert len(signing) == 4
    assert [key for key in signing if key in text] == []
    declared = yaml.safe_load((TOWER / 'compose.yaml').read_text(encoding='utf-8'))['secrets']
    assert {name for service in services.values() for name in service.get('secrets', ())} == set(declared)
    for name, source in declared.items():
        assert source == {'file': f'./secrets/{name}'}
        assert (tmp_path / 'secrets' / name).stat().st_mode & 0o777 == 0o600
    for service in services.values():
        for value in service.get('environment', {}).values():
            if value.startswith('/run/secrets/'):
                assert value.rpartition('/')[2] in service['secrets']


@pytest.mark.skipif(os.geteuid() != 0, reason='root alone may change the user')
def test_the_servers_user_reads_copies_of_the_secrets(services: dict[str, Any], tmp_path: Path) -> None:
    """The entry point of MLflow's container, with another user and other folders: it runs as that user, which reads each file."""
    make_secrets.make(tmp_path, None, ['thor'])
    tmp_path.chmod(0o755)
    given, home = tmp_path / 'given', Path(tempfile.mkdtemp(prefix='shadowhound-'))
    given.mkdir(mode=0o700)
    for name in services['mlflow']['secrets']:
        shutil.copy(tmp_path / 'secrets' / name, given)
    try:
        shutil.chown(home, 'nobody')
        places = {'/run/secrets': str(given), '/var/lib/mlflow': str(home), '$$': '$', '-g mlflow': '-g nogroup',
                  'regid=mlflow': 'regid=nogroup', '-o mlflow': '-o nobody', 'reuid=mlflow': 'reuid=nobody'}  # fmt: skip
        script = services['mlflow']['entrypoint'][2]
        for theirs, ours in places.items():
            assert theirs in script
            script = script.replace(theirs, ours)
        ask = f'id -un; cd {home}; stat -c "%U %a %n" *; cat *'
        ran = subprocess.run(['sh', '-ec', script, 'sh', 'sh', '-ec', ask], capture_output=True, text=True, check=True)
    finally:
        shutil.rmtree(home)
    user, *files = ran.stdout.splitlines()[:4]
    assert (user, files) == ('nobody', [f'nobody 400 {name}' for name in sorted(services['mlflow']['secrets'])])
    assert make_secrets.read_env(tmp_path / '.env')['MLFLOW_SECRET_ACCESS_KEY'] in ran.stdout


def test_a_running_server_sees_the_keys_that_are_changed(services: dict[str, Any]) -> None:
    """The folder of the files that SIGHUP reloads is mounted, since a mounted file would stay the old one."""
    mounts = [volume.split(':') for volume in services['s3']['volumes'] if volume.startswith('./')]
    assert mounts == [['./secrets', '/secrets', 'ro']]
    assert '-s3.config=/secrets/s3.json' in services['s3']['command']
    assert services['s3']['working_dir'] == '/secrets', 'seaweedfs.env names files there'
    assert services['s3']['entrypoint'] == ['/usr/bin/weed', '-config_dir=/secrets'], 'security.toml is there'


def test_mlflow_asks_for_passwords_and_never_runs_as_root(services: dict[str, Any], secured: dict[str, Any]) -> None:
    """It is started by the access control program, which accepts its arguments and finds its files."""
    for service in (services['mlflow'], {**services['mlflow'], **secured['mlflow']}):
        ours, _, theirs = service['command'].partition(' -- ')
        program, *words = shlex.split(ours)[1:]
        mounts = {place: source for source, place in (volume.split(':')[:2] for volume in services['mlflow']['volumes'])}
        assert (TOWER / mounts[program]).resolve() == Path(mlflow_access.__file__)
        data = mlflow_access.parser().parse_args([*words, '--', *shlex.split(theirs)])
        assert mounts[str(data.users.parent)] == './mlflow'
        assert data.command[:2] == ['mlflow', 'server']
        assert data.command[data.command.index('--port') + 1] == '5000'
        assert (data.password.parent, data.password.name in services['mlflow']['secrets']) == (data.folder, True)
    assert 'USER mlflow' in (TOWER / 'Dockerfile.mlflow').read_text()
    assert f'install -d -o mlflow -g mlflow -m 0700 {data.folder}' in (TOWER / 'Dockerfile.mlflow').read_text()
    assert 'exec setpriv --reuid=mlflow' in services['mlflow']['entrypoint'][2]
    assert not {'user', 'entrypoint'} & set(secured['mlflow'])
    assert secured['mlflow']['secrets'] == ['tower.key']
    assert '--ssl-keyfile=/var/lib/mlflow/tower.key' in secured['mlflow']['command']


@pytest.mark.slow
@pytest.mark.long('an MLflow server of its own')
def test_mlflow_starts_from_one_file(services: dict[str, Any], tmp_path: Path) -> None:
    """As in its container, without the rest of the package: it has users and experiments, and stops on a signal."""
    make_secrets.make(tmp_path, None, ['thor', 'tachi'])
    shutil.copy(mlflow_access.__file__, tmp_path)
    with ExitStack() as stack:
        ports = Ports('127.0.0.1')
        stack.callback(ports.release)
        port = str(ports.take())
        places = {'/tower/': f'{tmp_path}/', '/users/': f'{tmp_path}/mlflow/',
                  '/var/lib/mlflow/mlflow.password': f'{tmp_path}/secrets/mlflow.password', '/var/lib/mlflow': f'{tmp_path}',
                  '0.0.0.0': '127.0.0.1', 's3://mlflow': f'{tmp_path}/artifacts',
                  '${TOWER_HOST:?run make tower-secrets first}': '127.0.0.1',
                  '--port 5000': f'--port {port}', '--workers 2': '--workers 1'}  # fmt: skip
        command = services['mlflow']['command']
        for theirs, ours in places.items():
            assert theirs in command
            command = command.replace(theirs, ours)
        environ = {name: value for name, value in os.environ.items() if not name.startswith(('MLFLOW_', 'PYTHONPATH', 'AWS_'))}
        environ['MLFLOW_BACKEND_STORE_URI'] = f'sqlite:///{tmp_path}/mlflow.db'
        program, *words = shlex.split(command)
        assert program == 'python'
        server = stack.enter_context(subprocess.Popen([sys.executable, *words], env=environ, cwd='/'))
        stack.callback(server.kill)
        http = stack.enter_context(urllib3.PoolManager())

        def status(user: str) -> int:
            password = make_secrets.read_env(tmp_path / 'secrets' / f'{user}.env')['MLFLOW_TRACKING_PASSWORD']
            url = f'http://127.0.0.1:{port}/api/2.0/mlflow/experiments/get-by-name?experiment_name=tachi_missions'
            try:
                return http.request(
                    'GET', url, headers=urllib3.make_headers(basic_auth=f'{user}:{password}'), retries=False
                ).status
            except urllib3.exceptions.HTTPError:
                return 0

        until(lambda: [status(user) for user in ('tachi', 'spark', 'thor')] == [200, 200, 403], 'they are told', 150)
        server.terminate()
        assert server.wait(60) in {0, -signal.SIGTERM}


@pytest.mark.long('a Tower of its own')
@pytest.mark.seaweedfs
def test_a_small_disk_has_room_for_all_buckets(services: dict[str, Any], tmp_path: Path) -> None:
    """The server with its arguments from there, on a disk of 2 GB: each bucket accepts an object."""
    disk = tmp_path / 'disk'
    disk.mkdir()
    if subprocess.run(['mount', '-t', 'tmpfs', '-o', 'size=2g', 'none', str(disk)], capture_output=True, check=False).returncode:
        pytest.skip('this user may not mount a file system')
    with ExitStack() as stack:
        stack.callback(subprocess.run, ['umount', '--lazy', str(disk)], check=True)
        (tmp_path / 's3.json').write_text(make_secrets.seaweed({'tower': [{'accessKey': 'a', 'secretKey': 'b'}]}))
        ports = Ports('127.0.0.1')
        stack.callback(ports.release)
        numbers = {name: ports.take() for name in ('s3', 'master', 'volume', 'filer')}
        ours = {'-dir': str(disk), '-ip': '127.0.0.1', '-ip.bind': '127.0.0.1', '-s3.config': str(tmp_path / 's3.json')}
        ours |= {f'-{name}.port': str(number) for name, number in numbers.items()}
        command = [word for word in shlex.split(services['s3']['command']) if word.partition('=')[0] not in ours]
        command += [f'{name}={value}' for name, value in ours.items()] + ['-volume.preStopSeconds=0']
        server = Server('s3', [find_program('weed', ''), *command], log=tmp_path / 'log', environ=os.environ)
        stack.callback(server.stop)
        server.start()
        s3 = boto3.client('s3', endpoint_url=f'http://127.0.0.1:{numbers["s3"]}', aws_access_key_id='a',
                          aws_secret_access_key='b', region_name='us-east-1')  # fmt: skip
        prepare.wait(s3, 60.0)
        prepare.prepare(s3, ['thor'])
        for bucket in prepare.BUCKETS:
            s3.put_object(Bucket=bucket, Key='thor/probe', Body=b'1')


class _Override(yaml.SafeLoader):
    """Implements Compose's ``!override``: the list itself, in place of the other file's."""


_Override.add_constructor('!override', lambda loader, node: loader.construct_sequence(node))  # type: ignore[no-untyped-call]


@pytest.fixture(scope='module')
def secured() -> dict[str, Any]:
    """The changes in compose.tls.yaml."""
    text = (TOWER / 'compose.tls.yaml').read_text(encoding='utf-8')
    found: dict[str, Any] = yaml.load(text, _Override)['services']  # noqa: S506 - a safe loader
    return found


def test_with_tls_only_the_scheme_changes(services: dict[str, Any], secured: dict[str, Any]) -> None:
    """Commands only get more arguments, the published port of the S3 server is that of https, and MLflow's port is the same."""
    assert set(secured) == {'s3', 'mlflow'}
    for name, service in secured.items():
        assert service['command'].startswith(services[name]['command'].rstrip())
    assert '-s3.port.https=8334' in secured['s3']['command']
    assert [port.split('}')[1] for port in secured['s3']['ports']] == [':9000:8334']
    assert 'ports' not in secured['mlflow']
    assert "https://127.0.0.1:5000/health'" in secured['mlflow']['healthcheck']['test'][-1]


@pytest.mark.seaweedfs
def test_the_server_accepts_its_options(services: dict[str, Any], secured: dict[str, Any]) -> None:
    """Every option of the S3 server exists in `weed server`, in the version of the image."""
    weed = find_program('weed', '')
    command = shlex.split(secured['s3']['command'])
    done = subprocess.run([weed, command[0], '-h'], capture_output=True, text=True, check=False)
    known = set(re.findall(r'^  -([\w.]+)', done.stderr + done.stdout, re.MULTILINE))
    assert {option.lstrip('-').partition('=')[0] for option in command[1:]} <= known
    version = subprocess.run([weed, 'version'], capture_output=True, text=True, check=True).stdout
    assert f' {services["s3"]["image"].partition(":")[2].partition("@")[0]} ' in version


@pytest.mark.long('a Tower of its own')
def test_mlflow_accepts_its_options(services: dict[str, Any]) -> None:
    """Every option of the MLflow server exists in `mlflow server`."""
    done = subprocess.run([find_program('mlflow', ''), 'server', '--help'], capture_output=True, text=True, check=True)
    words = services['mlflow']['command'].partition(' -- ')[2].split()
    assert {word for word in words if word.startswith('--')} <= set(re.findall(r'--[\w-]+', done.stdout))
