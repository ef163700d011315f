"""Which robot this machine is: the one that a node has a status of in its spool."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.keys import is_name

DEFAULT: Final = 'thor'


def robots(spool: Path) -> list[str]:
    """The robots whose nodes have written a status here."""
    names = (path.stem.removeprefix('status-') for path in spool.glob('status-*.json'))
    return sorted(name for name in names if is_name(name))


def local_robot(environ: Mapping[str, str], home: Path) -> str | None:
    """SHADOWHOUND_ROBOT, else the only robot whose node has run here; None if there is none, or several."""
    if named := environ.get('SHADOWHOUND_ROBOT'):
        return named
    found = robots(home / 'spool')
    return found[0] if len(found) == 1 else None
