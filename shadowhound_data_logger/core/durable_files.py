"""File operations that ``pathlib`` lacks: sync, atomic replacement, locks. All of them raise OSError."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Final

READ_BYTES: Final = 1 << 20


def sync(path: Path) -> None:
    """Wait until a file's content, or the names in a folder, have reached the disk.

    A new file is only safe once its folder has been synced too.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def fingerprint(path: Path) -> tuple[int, str]:
    """Size and SHA-256 (hex) of a file, read in bounded memory."""
    digest, size = hashlib.sha256(), 0
    with path.open('rb', buffering=0) as file:
        while chunk := file.read(READ_BYTES):
            digest.update(chunk)
            size += len(chunk)
    return size, digest.hexdigest()


@contextmanager
def replacing(path: Path, *, is_synced: bool = False, mode: int = 0o666, part: Path | None = None) -> Iterator[IO[bytes]]:
    """A file to write that replaces ``path`` afterwards: a reader sees the old file or the new one, each complete.

    Until then it is ``<path>.part`` (or ``part``) in the same folder, and it stays there if writing fails.
    """
    part = part or path.with_name(f'{path.name}.part')
    with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, mode), 'wb') as file:
        yield file
        if is_synced:
            file.flush()
            os.fsync(file.fileno())
    os.replace(part, path)


def lock(file: int | IO[bytes], *, wait: bool = True, shared: bool = False) -> bool:
    """Take an advisory lock on an open file, held until it is closed or its process exits; return whether it was acquired."""
    how = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    try:
        fcntl.flock(file, how if wait else how | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in {errno.EAGAIN, errno.EACCES}:
            raise
        return False
    return True


@contextmanager
def flock(path: Path, *, wait: bool = True, shared: bool = False, mode: int = 0o600) -> Iterator[bool]:
    """The same on a file that is created for it with this mode; yields whether the lock was acquired."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, mode)
    try:
        yield lock(descriptor, wait=wait, shared=shared)
    finally:
        os.close(descriptor)
