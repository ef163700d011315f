"""What files are asked beyond ``pathlib``: that they are on the disk, and what they hold. Everything raises OSError."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Final

READ_BYTES: Final = 1 << 20


def sync(path: Path) -> None:
    """Wait until a file's content, or the names in a folder, have reached the disk.

    A new file that was synced is lost all the same while its folder was not.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def fingerprint(path: Path) -> tuple[int, str]:
    """Bytes and SHA-256 (hex) of a file, read in bounded memory."""
    digest, size = hashlib.sha256(), 0
    with path.open('rb', buffering=0) as file:
        while chunk := file.read(READ_BYTES):
            digest.update(chunk)
            size += len(chunk)
    return size, digest.hexdigest()
