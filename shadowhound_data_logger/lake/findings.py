"""What an answer lacks: invalid row files, and rows that were rejected."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from shadowhound_data_logger.core.untrusted import visible

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A row file, or a folder of them, that an answer lacks."""

    key: str
    why: str
    rows: int | None = None
    """How many of its rows; None: all of them."""

    def __str__(self) -> str:
        return f'{visible(self.key)} is left out: {visible(self.why)}'


def warn(one: LeftOut) -> None:
    """In the log of this process."""
    log.warning('%s', one)


class Findings:
    """Collects what an answer lacks.

    Each is reported once, in however many queries it occurs. Thread-safe. In another process it starts empty, and warns.
    """

    def __init__(self, tell: Callable[[LeftOut], None] = warn) -> None:
        self._tell = tell
        self._lock = threading.Lock()
        self._found: dict[str, LeftOut] = {}

    def __reduce__(self) -> tuple[type[Findings], tuple[()]]:
        return Findings, ()

    def __len__(self) -> int:
        return len(self._found)

    def __iter__(self) -> Iterator[LeftOut]:
        """By key."""
        with self._lock:
            return iter(sorted(self._found.values(), key=lambda one: one.key))

    def add(self, key: str, why: str, rows: int | None = None) -> None:
        one = LeftOut(key, why, rows)
        with self._lock:
            if key in self._found:
                return
            self._found[key] = one
        self._tell(one)
