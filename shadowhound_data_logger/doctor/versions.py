"""Installed versions: Python and libraries that are too old, and whether the running node has this version."""

from __future__ import annotations

import platform
import re
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from typing import Final

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.doctor.model import Context, Result, Role, error, info, ok, warning
from shadowhound_data_logger.spool import status

NAME: Final = 'versions'
PACKAGE: Final = 'shadowhound_data_logger'
OLDEST_PYTHON: Final = (3, 10)
DISTROS: Final = frozenset({'humble', 'jazzy', 'kilted'})
NOT_TESTED: Final = frozenset({'lyrical'})
"""Other distributions that the package supports."""
_NEED: Final = re.compile(r'([A-Za-z0-9_.-]+)\s*>=\s*([0-9.]+)\s*$')


def check(context: Context) -> Iterator[Result]:
    """Check Python, ROS, libraries and the running node."""
    python = platform.python_version()
    if sys.version_info[:2] < OLDEST_PYTHON:
        yield error(
            'versions.python', f'Python {python}', 'the package needs 3.10 or later', 'use the python3 of Ubuntu 22.04 or later'
        )
    distro = context.environ.get('ROS_DISTRO', '')
    if distro and distro not in DISTROS:
        known = 'the package is made for it too, but ' if distro in NOT_TESTED else ''
        yield info('versions.ros', f'ROS 2 {distro}', f'{known}tested are {", ".join(sorted(DISTROS))}')
    yield from _packages(python, distro)
    if context.role is Role.ROBOT:
        yield from _node(context)


def _packages(python: str, distro: str) -> Iterator[Result]:
    """Check lower bounds that pip or colcon did not enforce: PYTHONPATH may put Debian's boto3 before a newer one."""
    try:
        ours, needs = version(PACKAGE), requires(PACKAGE) or []
    except PackageNotFoundError:
        yield info('versions.package', 'it runs from a folder and is not installed')
        return
    old = []
    for need in needs:
        if not (found := _NEED.match(need)):  # an extra, or another kind of bound
            continue
        name, minimum = found.groups()
        try:
            have = version(name)
        except PackageNotFoundError:
            have = ''
        if _numbers(have) < _numbers(minimum):
            old.append(f'{name}>={minimum}')
            yield error(
                'versions.library',
                f'{name} is {have or "not installed"}',
                f'version {minimum} or later is needed',
                f'python3 -m pip install --user "{name}>={minimum}"',
            )
    if not old:
        yield ok(
            'versions.library', f'{PACKAGE} {ours}, Python {python}, ROS 2 {distro or "without a ROS_DISTRO"}: all that is needed'
        )


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r'\d+', text)[:3])


def _node(context: Context) -> Iterator[Result]:
    found = status.read(context.settings.spool_path, context.settings.robot, SystemClock.of_this_machine())
    try:
        ours = version(PACKAGE)
    except PackageNotFoundError:
        return
    if found.running and found.node.version and found.node.version != ours:
        yield warning(
            'versions.node',
            f'the running node is version {found.node.version}, installed is {ours}',
            'it was not restarted after an update',
            'sudo systemctl restart shadowhound-data-logger',
        )
