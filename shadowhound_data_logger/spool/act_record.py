"""The newest acts that operators requested of a node, in ``spool/acts-<robot>.json``; the ledger shows them.

The log has them too, but this file is kept longer and is uploaded with the ledger. It is best effort: a damaged or missing file
counts as empty.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypedDict

from shadowhound_data_logger.core.durable_files import replacing
from shadowhound_data_logger.core.untrusted import from_json

log = logging.getLogger(__name__)

MAX_ACTS: Final = 200
MAX_BYTES: Final = 1 << 20
"""Of the file; with the longest answers it has a third of that."""
MAX_TEXT: Final = 300
"""Characters of an answer."""


class Act(TypedDict):
    """What an operator requested."""

    at_ns: int
    """Unix time in ns, by the robot's clock."""
    who: str
    do: str
    ok: bool
    said: str
    """The node's answer."""


def file(spool: Path, robot: str) -> Path:
    """The file of a robot's node."""
    return spool / f'acts-{robot}.json'


def read(spool: Path, robot: str) -> list[Act]:
    """The recorded acts, oldest first."""
    try:
        with file(spool, robot).open('rb') as stream:
            given = from_json(stream.read(MAX_BYTES + 1), MAX_BYTES)
        return [
            Act(
                at_ns=int(each['at_ns']),
                ok=bool(each['ok']),
                who=str(each['who'])[:MAX_TEXT],
                do=str(each['do'])[:MAX_TEXT],
                said=str(each['said'])[:MAX_TEXT],
            )
            for each in given[-MAX_ACTS:]
        ]
    except (OSError, ValueError, TypeError, KeyError, OverflowError):
        return []


class ActRecord:
    """Records acts in the file.

    Lifecycle: new when the spool is open; used by one thread. A failed write is logged and has no other effect.
    """

    def __init__(self, spool: Path, robot: str, now_ns: Callable[[], int]) -> None:
        self._path = file(spool, robot)
        self._acts = read(spool, robot)
        self._now_ns = now_ns

    def add(self, who: str, do: str, *, ok: bool, said: str) -> None:
        """Record a request ``do`` of ``who``, and its answer."""
        self._acts.append({'at_ns': self._now_ns(), 'who': who, 'do': do, 'ok': ok, 'said': said[:MAX_TEXT]})
        del self._acts[:-MAX_ACTS]
        try:
            with replacing(self._path, is_synced=True, mode=0o600) as file:
                file.write(json.dumps(self._acts).encode())
        except OSError as error:
            log.warning('cannot record that %s requested %s: %s', who, do, error)
