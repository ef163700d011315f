"""Exposed secrets: modes of files with keys, keys in URLs and parameter files, and well-known keys."""

from __future__ import annotations

import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.config import ENDPOINTS
from shadowhound_data_logger.doctor import services
from shadowhound_data_logger.doctor.context import home_of
from shadowhound_data_logger.doctor.model import Context, Result, info, ok, warning

NAME: Final = 'secrets'
OTHERS: Final = stat.S_IRGRP | stat.S_IROTH | stat.S_IWGRP | stat.S_IWOTH
WELL_KNOWN: Final = frozenset({'minioadmin', 'minio', 'minio123', 'password', 'admin', 'any', 'some_secret_key'})
"""Default keys of servers and their manuals."""
URLS: Final = (*ENDPOINTS, 'MLFLOW_TRACKING_URI', 'MLFLOW_S3_ENDPOINT_URL')
MAX_BYTES: Final = 1 << 20
_SECRET: Final = re.compile(
    r'(?im)^[^#\n]*(aws_secret_access_key|mlflow_tracking_password|secret_?key|postgres_password|weed_jwt_\w+)\b"?\s*[:=]\s*\S'
    r'|^-----BEGIN [A-Z ]*PRIVATE KEY'
)


def check(context: Context) -> Iterator[Result]:
    """Check for secrets that other users can read."""
    before = [*_urls(context), *_known(context), *_files(context)]
    yield from before
    if not any(result.is_finding for result in before):
        yield ok(NAME, 'no other user can read the keys')


def _urls(context: Context) -> Iterator[Result]:
    for name in URLS:
        if services.without_login(url := context.environ.get(name, '')) != url:
            yield warning(
                'secrets.url',
                f'{name} contains a user and a password',
                'URLs are logged, and shown by ps and /proc',
                f'export {name}=http://...  # without them; use AWS_ACCESS_KEY_ID, MLFLOW_TRACKING_USERNAME '
                'and _PASSWORD instead',
            )


def _known(context: Context) -> Iterator[Result]:
    secret = context.environ.get('AWS_SECRET_ACCESS_KEY', '')
    if secret.lower() in WELL_KNOWN:
        yield warning(
            'secrets.default',
            'AWS_SECRET_ACCESS_KEY is a well-known default',
            'it is the default of a server',
            'on the server: make tower-secrets, and copy the new keys to robots and workstations',
        )


def _files(context: Context) -> Iterator[Result]:
    for path in _candidates(context):
        try:
            status = path.stat()
            mode = stat.S_IMODE(status.st_mode)
            if not mode & OTHERS or not stat.S_ISREG(status.st_mode) or status.st_size > MAX_BYTES:
                continue
            if not _SECRET.search(path.read_text(encoding='utf-8', errors='replace')):
                continue
        except OSError:  # missing, or not readable
            continue
        if mode & stat.S_IROTH or mode & stat.S_IWOTH:
            yield warning(
                'secrets.mode',
                f'{path} contains a key, and every user of this machine can read it (mode {mode:04o})',
                'it was created with the default mode',
                f'chmod 600 {path}',
                fix=('mode', str(path), '600'),
            )
        else:
            yield info(
                'secrets.mode', f'{path} contains a key, and its group can read it (mode {mode:04o})', '', f'chmod 600 {path}'
            )
    if context.parameter_file and any('secret' in name.lower() for name in context.parameters):
        yield warning(
            'secrets.parameters',
            f'{context.parameter_file} contains a secret',
            'ROS parameters can be read by every machine in the network',
            'remove it; AWS_SECRET_ACCESS_KEY belongs in the environment',
        )


def _candidates(context: Context) -> list[Path]:
    """Files that usually contain keys."""
    home, environ = home_of(context), context.environ
    paths = [
        Path(environ.get('AWS_SHARED_CREDENTIALS_FILE') or home / '.aws/credentials').expanduser(),
        Path(environ.get('AWS_CONFIG_FILE') or home / '.aws/config').expanduser(),
        *(context.root / 'etc/shadowhound' / name for name in ('logger.env', 'credentials')),
        *(Path(name) for name in ('tower/.env', '.env', 'thor.env', 'spark.env', 'thor.credentials')),
        *sorted(Path('tower/secrets').glob('*.*')),
        home / '.mlflow/credentials',
        *(home / name for name in ('.bashrc', '.profile', '.bash_profile', '.zshrc', '.bash_history', '.shadowhound.env')),
        *([context.parameter_file] if context.parameter_file else []),
    ]
    return list(dict.fromkeys(paths))
