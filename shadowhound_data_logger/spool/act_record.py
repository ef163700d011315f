"""What operators asked of a node: the newest acts, in ``spool/acts-<robot>.json``, which the ledger shows.

The log has them too; this outlives it, and leaves the robot with the ledger. It is not a promise: a file that is damaged or
missing has none.
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
MOST_BYTES: Final = 1 << 20
"""Of the file; it has a third of that where each answer is as long as it may be."""
MAX_SAID: Final = 300
"""Letters of an answer."""


class Act(TypedDict):
    """What an operator requested."""

    at_ns: int
    """Unix, by the robot's clock."""
    who: str
    do: str
    ok: bool
    said: str
    """The answer of the node."""


def file(spool: Path, robot: str) -> Path:
    """Where the node of a robot keeps them."""
    return spool / f'acts-{robot}.json'


def read(spool: Path, robot: str) -> list[Act]:
    """The oldest first."""
    try:
        with file(spool, robot).open('rb') as stream:
            given = from_json(stream.read(MOST_BYTES + 1), MOST_BYTES)
        return [
            Act(
                at_ns=int(each['at_ns']),
                ok=bool(each['ok']),
                who=str(each['who'])[:MAX_SAID],
                do=str(each['do'])[:MAX_SAID],
                said=str(each['said'])[:MAX_SAID],
            )
            for each in given[-MAX_ACTS:]
        ]
    except (OSError, ValueError, TypeError, KeyError, OverflowError):
        return []


class ActRecord:
    """Keeps them in the file. New when the spool is open; one thread. A failed write is logged, and has no other effect."""

    def __init__(self, spool: Path, robot: str, now_ns: Callable[[], int]) -> None:
        self._path = file(spool, robot)
        self._acts = read(spool, robot)
        self._now_ns = now_ns

    def add(self, who: str, do: str, *, ok: bool, said: str) -> None:
        """``who`` asked for ``do``, and was told ``said``."""
        self._acts.append({'at_ns': self._now_ns(), 'who': who, 'do': do, 'ok': ok, 'said': said[:MAX_SAID]})
        del self._acts[:-MAX_ACTS]
        try:
            with replacing(self._path, is_synced=True, mode=0o600) as file:
                file.write(json.dumps(self._acts).encode())
        except OSError as error:
            log.warning('what %s asked for cannot be kept: %s', who, error)
