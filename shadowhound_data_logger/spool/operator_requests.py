"""The newest requests of operators to a node, in ``spool/operator-requests-<robot>.json``; the ledger shows them.

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

MAX_REQUESTS: Final = 200
MAX_BYTES: Final = 1 << 20
"""Of the file; with the longest answers it has a third of that."""
MAX_TEXT: Final = 300
"""Characters of an answer."""


class OperatorRequest(TypedDict):
    """A request of an operator."""

    at_ns: int
    """Unix time in ns, by the robot's clock."""
    who: str
    do: str
    ok: bool
    answer: str
    """The node's answer."""


def file(spool: Path, robot: str) -> Path:
    """The file of a robot's node."""
    return spool / f'operator-requests-{robot}.json'


def read(spool: Path, robot: str) -> list[OperatorRequest]:
    """The recorded requests, oldest first."""
    try:
        with file(spool, robot).open('rb') as stream:
            given = from_json(stream.read(MAX_BYTES + 1), MAX_BYTES)
        return [
            OperatorRequest(
                at_ns=int(each['at_ns']),
                ok=bool(each['ok']),
                who=str(each['who'])[:MAX_TEXT],
                do=str(each['do'])[:MAX_TEXT],
                answer=str(each['answer'])[:MAX_TEXT],
            )
            for each in given[-MAX_REQUESTS:]
        ]
    except (OSError, ValueError, TypeError, KeyError, OverflowError):
        return []


class OperatorRequests:
    """Records requests in the file.

    Lifecycle: new when the spool is open; used by one thread. A failed write is logged and has no other effect.
    """

    def __init__(self, spool: Path, robot: str, now_ns: Callable[[], int]) -> None:
        self._path = file(spool, robot)
        self._requests = read(spool, robot)
        self._now_ns = now_ns

    def add(self, who: str, do: str, *, ok: bool, answer: str) -> None:
        """Record a request ``do`` of ``who``, and its answer."""
        self._requests.append({'at_ns': self._now_ns(), 'who': who, 'do': do, 'ok': ok, 'answer': answer[:MAX_TEXT]})
        del self._requests[:-MAX_REQUESTS]
        try:
            with replacing(self._path, is_synced=True, mode=0o600) as file:
                file.write(json.dumps(self._requests).encode())
        except OSError as error:
            log.warning('cannot record that %s requested %s: %s', who, do, error)
