"""The context of a run: role, environment and settings, as far as they can be read. Invalid settings do not stop the doctor."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from shadowhound_data_logger.core.config import ENDPOINTS, Settings, home
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.core.ros_arguments import NODE, read_parameters
from shadowhound_data_logger.doctor.machine import listening
from shadowhound_data_logger.doctor.model import Context, Role
from shadowhound_data_logger.spool.local_robot import local_robot, local_robots

S3_PORT: Final = 9000
MLFLOW_PORT: Final = 5001
"""The ports of S3 and MLflow on a server as docs/tower.md makes it."""


def make(
    environ: Mapping[str, str],
    *,
    role: Role | None = None,
    parameters: Mapping[str, Any] | None = None,
    parameter_file: Path | None = None,
    namespace: str = '/',
    rates_hz: Mapping[str, float] | None = None,
    root: Path = Path('/'),
) -> Context:
    """Raises ParametersUnreadable. Settings that are invalid are dropped one by one and listed in ``refused``."""
    node = f'/{namespace.strip("/")}/{NODE}' if namespace.strip('/') else None
    given = dict(parameters if parameters is not None else read_parameters(parameter_file, node) if parameter_file else {})
    known, left, refused = dict(environ), dict(given), []
    is_named = bool(left.get('robot') or namespace.strip('/') or local_robots(environ, home(environ) / 'spool'))
    if not left.get('robot') and not namespace.strip('/'):
        spool = home(environ) / 'spool'
        try:
            robot = local_robot(environ, spool)
        except SettingError as error:  # only the first of several is examined
            refused.append(error)
            robot = local_robots(environ, spool)[0]
        known |= {'SHADOWHOUND_ROBOT': robot} if robot else {}
    while True:
        try:
            settings = Settings.load(left, known, namespace)
            break
        except SettingError as error:
            refused.append(error)
            name = str(error.data['name'])
            if name in known:
                del known[name]
            elif name in left:
                del left[name]
            else:  # the robot's name, or a default that it makes too long; otherwise other parameters
                left, namespace = left if name == 'robot' else {}, '/'
                known.pop('SHADOWHOUND_ROBOT', None)
    return Context(
        role=role or guess(environ, settings.spool_path, root),
        environ=environ,
        settings=settings,
        refused=tuple(refused),
        is_named=is_named,
        parameters=given,
        parameter_file=parameter_file,
        namespace=namespace,
        rates_hz=rates_hz or {},
        root=root,
    )


def guess(environ: Mapping[str, str], spool: Path, root: Path) -> Role:
    """A robot has a spool, a server an open port of S3 or MLflow; otherwise ROS makes it a robot, and all else a workstation."""
    has_ros = bool(environ.get('ROS_DISTRO')) or find_spec('rclpy') is not None
    if has_ros and (spool / 'index.db').exists():
        return Role.ROBOT
    if Path('tower/.env').is_file() or _serves(environ, root):
        return Role.SERVER
    return Role.ROBOT if has_ros else Role.WORKSTATION


def _serves(environ: Mapping[str, str], root: Path) -> bool:
    """Whether the S3 server or MLflow listens on this machine."""
    ports = {S3_PORT, MLFLOW_PORT}
    for variable in (*ENDPOINTS, 'MLFLOW_TRACKING_URI'):
        try:
            url = urlsplit(environ.get(variable, ''))
            if url.hostname in {'localhost', '127.0.0.1', '::1'} and url.port:
                ports.add(url.port)
        except ValueError:
            continue
    return any(port in ports for _, port in listening(root))


def to_child(context: Context) -> bytes:
    """For ``from_child``; variables are passed in the child's environment, so that no secret is stored elsewhere."""
    given = {
        'role': context.role.value,
        'parameters': dict(context.parameters),
        'namespace': context.namespace,
        'rates_hz': dict(context.rates_hz),
        'root': str(context.root),
    }
    return json.dumps(given).encode()


def from_child(sent: bytes) -> Context:
    """The context that ``to_child`` wrote."""
    given = json.loads(sent)
    return make(
        os.environ,
        role=Role(given['role']),
        parameters=given['parameters'],
        namespace=given['namespace'],
        rates_hz=given['rates_hz'],
        root=Path(given['root']),
    )


def home_of(context: Context) -> Path:
    """The user's home, for files such as ``~/.aws/credentials``."""
    return Path(context.environ.get('HOME') or '~').expanduser()
