"""Invalid row files and rejected rows, which query results lack."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from shadowhound_data_logger.core.untrusted import visible

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class SkippedFile:
    """A row file, or a folder of them, that was skipped completely or in part."""

    key: str
    why: str
    rows: int | None = None
    """How many of its rows were skipped; None: all."""

    def __str__(self) -> str:
        return f'{visible(self.key)} is skipped: {visible(self.why)}'


def warn(one: SkippedFile) -> None:
    """Log a warning."""
    log.warning('%s', one)


class Findings:
    """Collects skipped files.

    Each file is reported only once, even if several queries skip it. Thread-safe. A copy in another process starts empty, and
    logs warnings.
    """

    def __init__(self, tell: Callable[[SkippedFile], None] = warn) -> None:
        self._tell = tell
        self._lock = threading.Lock()
        self._found: dict[str, SkippedFile] = {}

    def __reduce__(self) -> tuple[type[Findings], tuple[()]]:
        return Findings, ()

    def __len__(self) -> int:
        return len(self._found)

    def __iter__(self) -> Iterator[SkippedFile]:
        """Ordered by key."""
        with self._lock:
            return iter(sorted(self._found.values(), key=lambda one: one.key))

    def add(self, key: str, why: str, rows: int | None = None) -> None:
        """Report a file that was skipped, or so many of its rows."""
        one = SkippedFile(key, why, rows)
        with self._lock:
            if key in self._found:
                return
            self._found[key] = one
        self._tell(one)
