#!/usr/bin/env python3
"""Creates the credentials of a Tower, once, in files that only their owner can read; needs the standard library and openssl.

.env                  read by compose.yaml and run.py: passwords, the address to listen on
secrets/users.json    the users, their keys and passwords (the newest first): the only source of these
secrets/s3.json       the same in SeaweedFS's format
secrets/security.toml, seaweedfs.*   authentication between SeaweedFS's own servers: signing keys and a certificate
secrets/postgres.password, mlflow.pgpass, mlflow.password   mounted into containers: the database's password, the same in libpq's
                     format, and the password of MLflow's user `tower`
secrets/NAME.env      the environment of a robot or Spark: copy it there, mode 600
secrets/NAME.credentials   only its keys and password, as S3 clients and MLflow's read them from a file: copy it when they change
mlflow/users.json     digests of MLflow's passwords, which are not secret: the server reads it, as another user

Existing credentials stay: running it again adds what is missing. ``--rotate NAME`` gives a user a new key in addition to the old
one, so that nothing stops; ``--retire NAME`` removes the old one once the new one is in use.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import secrets
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
READ_BUCKETS = ('sensor-data', 'trajectories', 'lerobot', 'mlflow', 'lake')
ROBOT_BUCKETS = ('sensor-data', 'trajectories')
MAILBOXES = 'sensor-data/_requests'
"""Requests to robots: each robot reads its own mailbox."""
POLICIES = 'lerobot/policies'
"""Part of the training bucket that every robot reads: policies, and the signed metadata about which of them may run."""
ADMIN = ('Admin', 'Read', 'Write', 'List', 'Tagging')
NAME = re.compile(r'[a-z0-9][a-z0-9_-]{0,62}')
"""A robot's name is the prefix of its keys, and part of patterns here: it must not contain wildcards."""
OWN_USERS = ('tower', 'mlflow', 'spark', 'prune')
NO_LOGIN = ('mlflow', 'prune')
"""Users of S3 only: MLflow's own server, and the user of `shadowhound-data lake prune`."""
SIGNING_KEYS = ('signing', 'signing.read', 'filer_signing', 'filer_signing.read')
"""For the volume servers, the filer's IAM and the gRPC port next to S3: without them SeaweedFS does not authenticate clients."""
CERTIFICATE, CERTIFICATE_KEY = 'seaweedfs.crt', 'seaweedfs.key'
CERTIFICATE_DAYS = 36500
"""For SeaweedFS's own servers only, which trust this one certificate and no authority: new files replace it."""
CA_FILE = '/etc/shadowhound/ca.pem'
"""Path on Thor and Spark of the certificate of a private authority."""
S3_PORT, MLFLOW_PORT = 9000, 5001


class Refused(Exception):
    """An invalid argument; the text has the reason."""


def actions(user: str) -> list[str]:
    """A user's permissions, in SeaweedFS's terms (https://github.com/seaweedfs/seaweedfs/wiki/Amazon-S3-API)."""
    if user == 'tower':
        return list(ADMIN)
    if user == 'mlflow':
        return [f'{action}:mlflow' for action in ('Read', 'Write', 'List', 'Tagging')]
    if user == 'prune':
        return [
            *(
                f'{action}:{bucket}'
                for bucket in ('sensor-data', 'trajectories', 'lerobot', 'lake')
                for action in ('Read', 'List')
            ),
            *(f'Write:{bucket}' for bucket in (*ROBOT_BUCKETS, 'lake')),
        ]
    if user == 'spark':
        return [
            *(f'{action}:{bucket}' for bucket in READ_BUCKETS for action in ('Read', 'List')),
            'Write:lerobot',
            f'Write:{MAILBOXES}/*',
        ]
    own = [f'{action}:{bucket}/{user}/*' for bucket in ROBOT_BUCKETS for action in ('Read', 'Write')]
    return [*own, f'Read:{MAILBOXES}/{user}/*', f'Read:{POLICIES}/*']


def new_key() -> dict[str, str]:
    """An access key of 20 characters, its secret and a password for MLflow, of 256 bits each."""
    return {
        'accessKey': secrets.token_hex(10).upper(), 'secretKey': secrets.token_urlsafe(32), 'password': secrets.token_urlsafe(32),
    }  # fmt: skip


def write(path: Path, text: str, mode: int = 0o600) -> None:
    """Written atomically, and by default never readable by others, not even briefly."""
    part = path.with_name(f'{path.name}.part')
    part.unlink(missing_ok=True)
    with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), 'w', encoding='utf-8') as file:
        file.write(text)
        os.fchmod(file.fileno(), mode)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)


def read_env(path: Path) -> dict[str, str]:
    """NAME=value lines; empty without a file."""
    if not path.is_file():
        return {}
    found = (line.partition('=') for line in path.read_text(encoding='utf-8').splitlines() if '=' in line and line[:1] != '#')
    return {name.strip(): value.strip() for name, _, value in found}


def lines(values: Mapping[str, str]) -> str:
    """What ``read_env`` reads."""
    return ''.join(f'{name}={value}\n' for name, value in values.items())


def load_users(path: Path) -> dict[str, list[dict[str, str]]]:
    """User -> keys, the newest first."""
    if not path.is_file():
        return {}
    found: dict[str, list[dict[str, str]]] = json.loads(path.read_text(encoding='utf-8'))
    return found


def seaweed(users: Mapping[str, Sequence[Mapping[str, str]]]) -> str:
    """The identities in the format of ``weed s3 -config``."""
    identities = [
        {'name': user, 'actions': actions(user),
         'credentials': [{name: key[name] for name in ('accessKey', 'secretKey')} for key in keys]}
        for user, keys in users.items()
    ]  # fmt: skip
    return json.dumps({'identities': identities}, indent=1) + '\n'


def logins(users: Mapping[str, Sequence[Mapping[str, str]]]) -> str:
    """MLflow's logins, as its server checks them (tower/shadowhound_tower/mlflow_access.py)."""
    digests = {
        user: [hashlib.sha256(key['password'].encode()).hexdigest() for key in keys]
        for user, keys in users.items() if user not in NO_LOGIN
    }  # fmt: skip
    return json.dumps(digests, indent=1) + '\n'


def environment(user: str, key: Mapping[str, str], settings: Mapping[str, str]) -> str:
    """The variables with which a machine reaches this Tower as this user, for a shell and for systemd's EnvironmentFile."""
    scheme, offset = settings['TOWER_SCHEME'], int(settings['TOWER_OFFSET'])
    server = f'{scheme}://{settings["TOWER_HOST"]}'
    store = f'{server}:{S3_PORT + offset}'
    values = {
        **({'AWS_CA_BUNDLE': CA_FILE, 'MLFLOW_TRACKING_SERVER_CERT_PATH': CA_FILE} if scheme == 'https' else {}),
        'AWS_ENDPOINT_URL': store, 'AWS_ACCESS_KEY_ID': key['accessKey'], 'AWS_SECRET_ACCESS_KEY': key['secretKey'],
        'AWS_DEFAULT_REGION': 'us-east-1', 'MLFLOW_TRACKING_URI': f'{server}:{MLFLOW_PORT + offset}',
        'MLFLOW_S3_ENDPOINT_URL': store,
    }  # fmt: skip
    if user not in NO_LOGIN:
        values |= {'MLFLOW_TRACKING_USERNAME': user, 'MLFLOW_TRACKING_PASSWORD': key['password']}
    if user not in OWN_USERS:
        values['SHADOWHOUND_ROBOT'] = user
    return lines(values)


def credentials(user: str, key: Mapping[str, str]) -> str:
    """A shared-credentials file, which S3 and MLflow clients read again while they run; an environment cannot change."""
    keys = f'[default]\naws_access_key_id = {key["accessKey"]}\naws_secret_access_key = {key["secretKey"]}\n'
    login = f'[mlflow]\nmlflow_tracking_username = {user}\nmlflow_tracking_password = {key["password"]}\n'
    return keys + (login if user not in NO_LOGIN else '')


def has_certificate(folder: Path) -> bool:
    """Whether the servers use TLS: docs/tower.md describes how to create the files."""
    return (folder / 'tls' / 'tower.crt').is_file()


def own_settings(
    folder: Path, host: str | None, offset: int | None, users: Mapping[str, Sequence[Mapping[str, str]]]
) -> dict[str, str]:
    """The settings of the servers themselves; existing passwords stay."""
    before = read_env(folder / '.env')
    tower, mlflow = users['tower'][0], users['mlflow'][0]
    return {
        'TOWER_OFFSET': str(int(before.get('TOWER_OFFSET') or 0) if offset is None else offset),
        'TOWER_HOST': host or before.get('TOWER_HOST') or '127.0.0.1',
        'TOWER_SCHEME': 'https' if has_certificate(folder) else 'http',
        'POSTGRES_PASSWORD': before.get('POSTGRES_PASSWORD') or secrets.token_hex(24),
        'TOWER_ACCESS_KEY_ID': tower['accessKey'], 'TOWER_SECRET_ACCESS_KEY': tower['secretKey'],
        'MLFLOW_ACCESS_KEY_ID': mlflow['accessKey'], 'MLFLOW_SECRET_ACCESS_KEY': mlflow['secretKey'],
        'TOWER_MLFLOW_PASSWORD': tower['password'],
    }  # fmt: skip


def make_certificate(folder: Path) -> None:
    """A key and a self-signed certificate. Raises Refused without openssl."""
    key, certificate = (folder / f'{name}.part' for name in (CERTIFICATE_KEY, CERTIFICATE))
    command = ['openssl', 'req', '-x509', '-newkey', 'ec', '-pkeyopt', 'ec_paramgen_curve:P-256', '-nodes',
               '-days', str(CERTIFICATE_DAYS), '-subj', '/CN=tower', '-keyout', str(key), '-out', str(certificate)]  # fmt: skip
    try:
        subprocess.run(command, check=True, capture_output=True, text=True, umask=0o077)
    except FileNotFoundError as error:
        raise Refused('openssl is not installed, and is needed for the certificate of SeaweedFS: apt install openssl') from error
    except subprocess.CalledProcessError as error:
        raise Refused(f'openssl failed to create a certificate: {error.stderr.strip()}') from error
    for part in (key, certificate):
        part.replace(part.with_suffix(''))


def signing_keys() -> str:
    """``security.toml`` with new keys, in the format of ``weed scaffold -config=security``."""
    return ''.join(f'[jwt.{name}]\nkey = "{secrets.token_hex(32)}"\n' for name in SIGNING_KEYS)


def seaweed_environment() -> dict[str, str]:
    """The environment of each SeaweedFS server, with secrets/ as its working directory: names of files, no secret.

    Source: ``weed scaffold -config=security``. A client without the certificate gets no gRPC connection at all.
    """
    pairs = {
        f'WEED_GRPC_{part}_{what}': name
        for part in ('MASTER', 'VOLUME', 'FILER', 'S3', 'CLIENT')
        for what, name in (('CERT', CERTIFICATE), ('KEY', CERTIFICATE_KEY))
    }
    return {'WEED_GRPC_CA': CERTIFICATE, **pairs}


def write_for_servers(hidden: Path, settings: Mapping[str, str]) -> None:
    """The secrets that servers read from files. Existing signing keys stay."""
    if not (hidden / 'security.toml').is_file():
        write(hidden / 'security.toml', signing_keys())
    write(hidden / 'seaweedfs.env', lines(seaweed_environment()))
    write(hidden / 'postgres.password', settings['POSTGRES_PASSWORD'])
    write(hidden / 'mlflow.pgpass', f'postgres:5432:mlflow:mlflow:{settings["POSTGRES_PASSWORD"]}\n')
    write(hidden / 'mlflow.password', settings['TOWER_MLFLOW_PASSWORD'])


def make(folder: Path, host: str | None, robots: Sequence[str], rotate: Sequence[str] = (), retire: Sequence[str] = (), *,
         offset: int | None = None) -> list[str]:  # fmt: skip
    """Write all files from the existing state and the arguments; returns the users. Raises Refused for an invalid name.

    ``offset`` is added to all ports of the servers; None keeps the previous one.
    """
    hidden = folder / 'secrets'
    hidden.mkdir(mode=0o700, parents=True, exist_ok=True)
    hidden.chmod(0o700)
    users = load_users(hidden / 'users.json')
    for name in robots:
        if not NAME.fullmatch(name):
            raise Refused(f'{name!r} is not a valid name for a robot: lower-case letters, digits, "-" and "_"')
        if name in OWN_USERS:
            raise Refused(f'{name!r} is not a valid name for a robot: it is a user of the Tower')
    for name in dict.fromkeys((*OWN_USERS, *robots)):
        users.setdefault(name, [new_key()])
    for key in (key for keys in users.values() for key in keys):  # keys from before MLflow had passwords
        key.setdefault('password', secrets.token_urlsafe(32))
    for name in (*rotate, *retire):
        if name not in users:
            raise Refused(f'there is no user {name}; known are {", ".join(users)}')
    for name in rotate:
        users[name].insert(0, new_key())
    for name in retire:
        del users[name][1:]
    settings = own_settings(folder, host, offset, users)
    write(hidden / 'users.json', json.dumps(users, indent=1) + '\n')
    write(hidden / 's3.json', seaweed(users))
    if not all((hidden / name).is_file() for name in (CERTIFICATE, CERTIFICATE_KEY)):
        make_certificate(hidden)
    write_for_servers(hidden, settings)
    (folder / 'mlflow').mkdir(mode=0o755, exist_ok=True)
    (folder / 'mlflow').chmod(0o755)
    write(folder / 'mlflow' / 'users.json', logins(users), 0o644)
    write(folder / '.env', lines(settings))
    for name, keys in users.items():
        write(hidden / f'{name}.credentials', credentials(name, keys[0]))
        write(hidden / f'{name}.env', environment(name, keys[0], settings))
    return list(users)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description='Create the credentials of a Tower. Existing ones stay.')
    parser.add_argument('--folder', type=Path, default=HERE, help='folder of .env and secrets/ (default: that of this script)')
    parser.add_argument(
        '--host', help='the address at which Thor and Spark reach this Tower; without one it listens on 127.0.0.1'
    )
    parser.add_argument('--offset', type=int, metavar='N', help='added to all ports (run.py --offset)')
    parser.add_argument('--robot', action='append', default=[], metavar='NAME', help='a robot (default: thor); may be repeated')
    parser.add_argument('--rotate', action='append', default=[], metavar='USER', help='a new key in addition to the old one')
    parser.add_argument('--retire', action='append', default=[], metavar='USER', help='keep only the newest key')
    options: Any = parser.parse_args(arguments)
    try:
        users = make(
            options.folder, options.host, options.robot or ['thor'], options.rotate, options.retire, offset=options.offset
        )
    except (Refused, OSError, ValueError) as error:
        print(f'make_secrets: {error}', file=sys.stderr)
        return 2
    print(f'users {", ".join(users)}: {options.folder / "secrets"}/NAME.env is the environment of each (mode 600)')
    if options.rotate or options.retire:
        print('MLflow knows it; the S3 server reads it on SIGHUP: docker compose -f tower/compose.yaml kill -s HUP s3')
    return 0


if __name__ == '__main__':
    sys.exit(main())
