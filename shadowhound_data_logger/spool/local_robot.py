"""Which robot this machine is about: one rule for the agent, the doctor and the commands."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import default_robot
from shadowhound_data_logger.core.errors import SettingError
from shadowhound_data_logger.core.keys import is_name

log = logging.getLogger(__name__)


def robots(spool: Path) -> list[str]:
    """The robots whose nodes have written a status here."""
    names = (path.stem.removeprefix('status-') for path in spool.glob('status-*.json'))
    return sorted(name for name in names if is_name(name))


def local_robots(environ: Mapping[str, str], spool: Path) -> list[str]:
    """SHADOWHOUND_ROBOT, otherwise the robots whose nodes run here, otherwise those whose nodes have run here."""
    if named := environ.get('SHADOWHOUND_ROBOT'):
        return [named]
    names = robots(spool)
    if len(names) < 2:
        return names
    from shadowhound_data_logger.spool.status import read  # noqa: PLC0415 - SQLite, which agents load later

    clock = SystemClock.of_this_machine()
    return [name for name in names if read(spool, name, clock).running] or names


def local_robot(environ: Mapping[str, str], spool: Path) -> str | None:
    """The only one of ``local_robots``, or None if there is none. Raises SettingError if there are several."""
    found = local_robots(environ, spool)
    if len(found) > 1:
        raise SettingError('SHADOWHOUND_ROBOT', '', f'one of {", ".join(found)}: their nodes share this machine')
    return found[0] if found else None


def robot_of_recorder(environ: Mapping[str, str], spool: Path) -> str:
    """The robot of what a program here records: ``local_robot``, or with a warning the name that a node here would have.

    Raises SettingError if there are several.
    """
    if found := local_robot(environ, spool):
        return found
    name = default_robot(environ)
    log.warning('no node has run here (%s), and SHADOWHOUND_ROBOT is not set: the robot is called %s', spool, name)
    return name
