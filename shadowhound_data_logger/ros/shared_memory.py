"""Shared memory that killed processes leave in /dev/shm: Fast DDS keeps there 35 MB (with our profile) for each of them.

The owner of a segment ``fastdds_X`` (Fast DDS 3) or ``fastrtps_X`` (Fast DDS 2), where X is 16 random hex digits, holds a flock
on the file ``..._X_el`` beside it for as long as it lives, in whatever container; a segment whose lock can be had has no owner.
Source: RobustExclusiveLock.hpp and SharedMemManager.hpp of Fast DDS 2.6, 2.14 and 3.6. Not freed are ``..._portN``, which are
small and taken over by the next process of the same domain, and ``fast_datasharing_...``, of which nothing tells whether
somebody lives.
"""

from __future__ import annotations

import os
import re
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from shadowhound_data_logger.disk import lock

FOLDER: Final = Path('/dev/shm')  # noqa: S108 - where Fast DDS has its segments
STARTING_S: Final = 5.0
"""A process that starts has its file before it has its lock."""
_LOCK: Final = re.compile(r'(?:fastdds|fastrtps)_[0-9a-f]{16}_el')


@dataclass(frozen=True, slots=True)
class Orphan:
    """A segment of this user whose owner is dead."""

    name: str
    bytes: int


def orphans(folder: Path = FOLDER, *, is_freed: bool = False) -> list[Orphan]:
    """Those that there are; with ``is_freed`` they are removed. Segments of other users are never touched."""
    found = []
    for path in _locks(folder):
        with _owned(path) as has_no_owner:
            if has_no_owner:
                segment = path.with_name(path.name.removesuffix('_el'))
                size = _size(segment)
                if is_freed:
                    for each in (segment, path):
                        with suppress(OSError):
                            each.unlink()
                if size is not None:
                    found.append(Orphan(segment.name, size))
    return found


def _locks(folder: Path) -> Iterator[Path]:
    try:
        paths = sorted(folder.iterdir())
    except OSError:
        return
    yield from (path for path in paths if _LOCK.fullmatch(path.name))


@contextmanager
def _owned(path: Path) -> Iterator[bool]:
    """Hold the lock of a segment that has no other owner; whether that is so."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:  # gone meanwhile, or not for us
        yield False
        return
    try:
        found = os.fstat(descriptor)
        is_ours = stat.S_ISREG(found.st_mode) and found.st_uid == os.geteuid()
        is_old = time.time() - found.st_mtime >= STARTING_S
        yield is_ours and is_old and lock(descriptor, wait=False)
    finally:
        os.close(descriptor)


def _size(segment: Path) -> int | None:
    """Of its memory; None where there is none of this user's."""
    try:
        found = segment.lstat()
    except OSError:
        return None
    return found.st_blocks * 512 if stat.S_ISREG(found.st_mode) and found.st_uid == os.geteuid() else None
