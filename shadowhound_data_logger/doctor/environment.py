"""The variables of the shell: servers, keys, invalid settings, and whether the running node has the same."""

from __future__ import annotations

import configparser
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import ENDPOINTS, endpoint_url
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.core.mlflow_rest import LOGIN, login
from shadowhound_data_logger.doctor import services
from shadowhound_data_logger.doctor.context import home_of
from shadowhound_data_logger.doctor.machine import variables
from shadowhound_data_logger.doctor.model import Context, Result, Role, error, from_error, info, ok, warning
from shadowhound_data_logger.doctor.ros_environment import DEFAULTS
from shadowhound_data_logger.spool import status

KEYS: Final = ('AWS_ACCESS_KEY_ID', 'AWS_SECRET_ACCESS_KEY')
SHARED: Final = (*ENDPOINTS, *KEYS, 'MLFLOW_TRACKING_URI', 'MLFLOW_S3_ENDPOINT_URL', 'ROS_DOMAIN_ID')
"""Variables that should be the same for the node and this shell; AWS keys among them are compared, never shown."""
PLACEHOLDERS: Final = ('<', '//SERVER', 'TOWER_IP', 'from the server', '...')
"""Placeholders of the documentation, left in a variable by copying a command."""
OF_THE_NODE: Final = 'set -a; . /etc/shadowhound/logger.env; set +a'
"""Loads the variables of the node's service into a shell."""
_BARE: Final = re.compile(r'[\w.-]+:\d{2,5}/?')
"""A host and a port without a scheme."""


def check(context: Context) -> Iterator[Result]:
    """Check variables, key pair, MLflow, proxies and the running node."""
    for problem in context.refused:
        yield from_error('environment.settings', problem, 'the node does not start with it')
    if context.parameter_file and not context.parameters:
        yield warning(
            'environment.parameters',
            f'{context.parameter_file} sets nothing for the node',
            'its section is for another node, or misspelt: ROS uses the defaults without a warning',
            "begin the section with '/**:'  # launch_configs/go2.yaml shows how",
        )
    yield from _store(context)
    yield from _tracking(context)
    yield from _proxies(context)
    if context.role is Role.ROBOT:
        yield from _node(context)


def _store(context: Context) -> Iterator[Result]:
    environ, endpoint = context.environ, context.settings.store.endpoint_url
    pasted = [name for name in SHARED if any(mark in environ.get(name, '') for mark in PLACEHOLDERS)]
    if pasted:
        yield error(
            'environment.placeholder',
            f'{" and ".join(pasted)} still has a placeholder from the manual',
            'the command was pasted and not completed',
            f'export {pasted[0]}=...  # with the values from the server',
        )
    if not endpoint:
        if any(problem.data['name'] in ENDPOINTS for problem in context.refused):
            return
        yield _no_endpoint(context)
        return
    yield ok('environment.endpoint', f'AWS_ENDPOINT_URL is {endpoint}')
    yield _credentials(context)


def _no_endpoint(context: Context) -> Result:
    """It may be set for the node only; the node's status file then shows the target, and network checks are skipped."""
    servers = [target for target in status.targets(context.settings.spool_path) if '://' in target]
    if servers:
        return warning(
            'environment.endpoint',
            f'AWS_ENDPOINT_URL is not set in this shell; the node delivers to {servers[0]}',
            'without the variables of the node, the network and the store are not checked',
            f'{OF_THE_NODE}  # or wherever the node has AWS_ENDPOINT_URL and its keys from',
        )
    return warning(
        'environment.endpoint',
        'AWS_ENDPOINT_URL is not set',
        f'without it nothing is uploaded: data is stored in {context.settings.store.directory}',
        'export AWS_ENDPOINT_URL=http://SERVER:9000',
    )


def _credentials(context: Context) -> Result:
    """Where the key pair comes from, in botocore's order; the key itself is not shown."""
    environ, name = context.environ, 'environment.credentials'
    missing = [each for each in KEYS if not environ.get(each)]
    if len(missing) == 1:
        return error(
            name, f'{missing[0]} is not set, and the other half of the pair is', 'both or neither', f'export {missing[0]}=...'
        )
    if not missing:
        spaced = [each for each in KEYS if environ[each] != environ[each].strip()]
        if spaced:
            return error(
                name,
                f'{spaced[0]} has a space or line break at its end',
                'it was pasted with extra characters',
                f'export {spaced[0]}=...',
            )
        return ok(name, 'the key pair is in the environment (restart the node after a change)')
    file = Path(environ.get('AWS_SHARED_CREDENTIALS_FILE') or home_of(context) / '.aws/credentials').expanduser()
    profile = environ.get('AWS_PROFILE') or 'default'
    if profile in _profiles(file):
        return ok(name, f'the key pair is in {file}, profile {profile}')
    return error(
        name,
        f'AWS_ACCESS_KEY_ID is not set, and {file} has no profile {profile}',
        'no request can be signed',
        'export AWS_ACCESS_KEY_ID=... AWS_SECRET_ACCESS_KEY=...  # or: aws configure',
    )


def _profiles(file: Path) -> list[str]:
    parser = configparser.RawConfigParser()
    try:
        parser.read_string(file.read_text(encoding='utf-8'))
    except (OSError, ValueError, configparser.Error):
        return []
    return [section for section in parser.sections() if parser.has_option(section, 'aws_access_key_id')]


def _tracking(context: Context) -> Iterator[Result]:
    environ = context.environ
    uri, s3 = environ.get('MLFLOW_TRACKING_URI', ''), environ.get('MLFLOW_S3_ENDPOINT_URL', '')
    if not uri and context.settings.store.endpoint_url:
        yield warning(
            'environment.tracking',
            'MLFLOW_TRACKING_URI is not set, though there is a server',
            f'missions are logged to {context.settings.home / "mlflow.db"}, where the server cannot see them',
            'export MLFLOW_TRACKING_URI=http://SERVER:5001',
        )
    elif uri.startswith('http') and services.mlflow(context) is None:
        yield error(
            'environment.tracking',
            f'MLFLOW_TRACKING_URI is {services.without_login(uri)}, which is not an address',
            'its host or port is invalid',
            'export MLFLOW_TRACKING_URI=http://SERVER:5001',
        )
    elif _BARE.fullmatch(uri):
        yield error(
            'environment.tracking',
            f'MLFLOW_TRACKING_URI is {uri}, without http://',
            'MLflow takes it for a folder on this machine',
            f'export MLFLOW_TRACKING_URI=http://{uri}',
        )
    elif uri:
        yield ok('environment.tracking', f'MLFLOW_TRACKING_URI is {services.without_login(uri)}')
    missing = [name for name, value in zip(LOGIN, login(environ, home_of(context)), strict=True) if not value]
    if uri.startswith('http') and len(missing) == 1:
        yield error(
            'environment.login',
            f'{missing[0]} is not set, and the other half of the pair is',
            'MLflow sends neither without both',
            f'export {missing[0]}=...  # or both in ~/.mlflow/credentials',
        )
    endpoint = context.settings.store.endpoint_url
    if s3:
        try:
            endpoint_url(s3, 'MLFLOW_S3_ENDPOINT_URL')
        except SettingError as problem:
            yield from_error('environment.artifacts', problem, 'no artifact can be uploaded to it')
            return
    if uri.startswith('http') and endpoint and not s3:
        yield info(
            'environment.artifacts',
            'MLFLOW_S3_ENDPOINT_URL is not set',
            'this package uses AWS_ENDPOINT_URL instead; older MLflow clients use Amazon',
            'export MLFLOW_S3_ENDPOINT_URL=$AWS_ENDPOINT_URL',
        )
    elif s3 and endpoint and s3.rstrip('/') != endpoint.rstrip('/'):
        yield warning(
            'environment.artifacts',
            f'MLFLOW_S3_ENDPOINT_URL is {services.without_login(s3)}, AWS_ENDPOINT_URL {endpoint}',
            'artifacts are uploaded to another server than the data',
            'export MLFLOW_S3_ENDPOINT_URL=$AWS_ENDPOINT_URL',
        )


def _proxies(context: Context) -> Iterator[Result]:
    """Report proxies that Tower's requests would use."""
    environ = context.environ
    spared = {host.strip().lstrip('.') for name in ('NO_PROXY', 'no_proxy') for host in environ.get(name, '').split(',')}
    for service in filter(None, (services.s3(context), services.mlflow(context))):
        scheme, host = 'https' if service.tls else 'http', service.host
        names = [name for name in (f'{scheme.upper()}_PROXY', f'{scheme}_proxy') if environ.get(name)]
        if names and '*' not in spared and not any(host == each or host.endswith(f'.{each}') for each in spared if each):
            yield warning(
                'environment.proxy',
                f'{names[0]} is set, and {host} is not in NO_PROXY',
                'requests to the server are sent to the proxy',
                f'export NO_PROXY=$NO_PROXY,{host}',
            )
            return


def _node(context: Context) -> Iterator[Result]:
    """Compare the running node: it may have been started with other variables, or with keys that were changed since."""
    found = status.read(context.settings.spool_path, context.settings.robot, SystemClock.of_this_machine())
    if not found.running:
        return
    theirs = variables(context.root, found.node.pid)
    # Without an endpoint, 'environment.endpoint' has already reported that, including the keys.
    compared = [name for name in SHARED if context.settings.store.endpoint_url or not name.startswith('AWS_')]
    other = [name for name in compared if theirs and _value(theirs, name) != _value(context.environ, name)]
    if other:
        yield warning(
            'environment.node',
            f'the node (process {found.node.pid}) has another {" and ".join(other)} than this shell',
            'it was started elsewhere, or before a change: what works here may not work there',
            f'{OF_THE_NODE}  # if this shell is right instead: sudo systemctl restart shadowhound-data-logger',
        )
    elif theirs:
        yield ok('environment.node', 'the node was started with the same addresses and keys')


def _value(environ: Mapping[str, str], name: str) -> str:
    """The effective value of a variable: one that is not set has a meaning too."""
    return environ.get(name) or DEFAULTS.get(name, '')
