"""Files that a mission keeps until they are sent: whole or not at all, and never the disk's last bytes."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Final

from shadowhound_data_logger.errors import Rejected

MIN_FREE_BYTES: Final = 64 << 20
"""Below it no file is kept: the journal's few bytes are worth more."""
COPY_BYTES: Final = 1 << 20


def write(target: Path, data: memoryview) -> None:
    """Raises OSError, and then nothing is there."""
    _check_room(target.parent)
    descriptor = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    try:
        written = os.write(descriptor, data)
    except OSError:
        target.unlink()
        raise
    finally:
        os.close(descriptor)
    if written != len(data):
        target.unlink()
        raise OSError(f'only a part of {target} was written')


def copy(source: str | os.PathLike[str], target: Path) -> None:
    """Raises Rejected for what is no file that can be read, OSError when there is no room; then nothing is there."""
    try:
        if not os.path.isfile(source):  # noqa: PTH113 - a text or a Path; a pipe would never end
            raise FileNotFoundError(f'{source!s:.200} is no file')
        opened = open(source, 'rb')  # noqa: PTH123, SIM115 - closed below
    except (OSError, TypeError, ValueError) as error:
        raise Rejected('no_file', str(error)) from error
    with opened:
        _check_room(target.parent)
        try:
            with os.fdopen(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600), 'wb') as file:
                shutil.copyfileobj(opened, file, COPY_BYTES)
        except OSError:
            target.unlink(missing_ok=True)
            raise


def _check_room(folder: Path) -> None:
    status = os.statvfs(folder)
    if status.f_bavail * status.f_frsize < MIN_FREE_BYTES:
        raise OSError(f'the disk of {folder} is full')
