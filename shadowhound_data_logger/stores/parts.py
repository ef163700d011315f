"""The parts that a large file is sent in: each read twice (to know it, to send it), never held in memory."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, Protocol

from shadowhound_data_logger.stores.content import CHUNK_BYTES

PART_BYTES: Final = 8 << 20
"""What a broken connection costs at most: eight seconds of a link of 1 MB/s. S3 allows no smaller one than 5 MiB."""
MOST_PARTS: Final = 10_000
"""S3's own limit."""


class _Digest(Protocol):
    def update(self, data: bytes, /) -> None: ...


@dataclass(slots=True)
class Part:
    """Bytes ``start`` ... ``start + size`` of an open file, as a body to send."""

    file: int
    """The descriptor; only read at places of its own, so several may share it."""
    start: int
    size: int
    md5: bytes
    _place: int = field(default=0, init=False)

    def seek(self, place: int, /) -> int:
        self._place = place
        return place

    def read(self, size: int, /) -> bytes:
        found = os.pread(self.file, min(size, self.size - self._place), self.start + self._place)
        self._place += len(found)
        return found


def parts(file: int, size: int, whole: _Digest) -> Iterator[Part]:
    """The parts of a file of that size, in order; ``whole`` is told all of its bytes. Raises OSError.

    A file that is shorter ends them early.
    """
    step = part_bytes(size)
    for start in range(0, size, step):
        part = _known(file, start, min(step, size - start), whole)
        if part.size:
            yield part


def part_bytes(size: int) -> int:
    """Of each part but the last, for a file of that size."""
    return max(PART_BYTES, -(-size // MOST_PARTS))


def _known(file: int, start: int, size: int, whole: _Digest) -> Part:
    md5, place = hashlib.md5(usedforsecurity=False), 0
    while place < size and (chunk := os.pread(file, min(CHUNK_BYTES, size - place), start + place)):
        md5.update(chunk)
        whole.update(chunk)
        place += len(chunk)
    return Part(file, start, place, md5.digest())
