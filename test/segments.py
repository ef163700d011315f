"""Shared memory that killed processes leave: Fast DDS keeps 35 MB a participant in /dev/shm, and nobody else frees it."""

from __future__ import annotations

import fcntl
import os
import time
from pathlib import Path

FOLDER = Path('/dev/shm')  # noqa: S108 - where Fast DDS has its segments
STARTING_S = 5.0
"""A process that starts has its file before it has its lock."""


def free_orphans() -> list[str]:
    """Remove the segments whose owner is dead, as ``fastdds shm clean`` does; their names.

    The owner of ``fastdds_X`` (Fast DDS 3) or ``fastrtps_X`` (Fast DDS 2) holds a flock on the file ``..._X_el`` beside it.
    """
    freed = []
    for lock in (*FOLDER.glob('fastdds_*_el'), *FOLDER.glob('fastrtps_*_el')):
        segment = lock.with_name(lock.name.removesuffix('_el'))
        try:
            descriptor = os.open(lock, os.O_RDWR | os.O_CLOEXEC)
        except OSError:  # gone meanwhile, or another user's
            continue
        try:
            if time.time() - os.fstat(descriptor).st_mtime < STARTING_S:
                continue
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            segment.unlink(missing_ok=True)
            lock.unlink(missing_ok=True)
            freed.append(segment.name)
        except BlockingIOError:
            pass
        finally:
            os.close(descriptor)
    return freed
