"""Writes the files that a mission keeps until they are sent: completely or not at all, and never to an almost full disk."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.errors import Rejected

MIN_FREE_BYTES: Final = 64 << 20
"""With less free space no file is written: the journal needs the rest."""
COPY_BYTES: Final = 1 << 20


def write(target: Path, data: memoryview) -> None:
    """Write a new file. Raises OSError, and then leaves no file behind."""
    _check_free_space(target.parent)
    descriptor = _create(target)
    try:
        written = os.write(descriptor, data)
    except OSError:
        target.unlink()
        raise
    finally:
        os.close(descriptor)
    if written != len(data):
        target.unlink()
        raise OSError(f'{target} was only partly written')


def _create(target: Path) -> int:
    return os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)


def copy(source: str | os.PathLike[str], target: Path) -> None:
    """Copy a file. Raises Rejected if ``source`` is not a readable file, OSError if the disk is full; then leaves no copy."""
    try:
        if not os.path.isfile(source):  # noqa: PTH113 - a text or a Path; reading a pipe would not end
            raise FileNotFoundError(f'{source!s:.200} is not a file')
        opened = open(source, 'rb')  # noqa: PTH123, SIM115 - closed below
    except (OSError, TypeError, ValueError) as error:
        raise Rejected('no_file', str(error)) from error
    with opened:
        _check_free_space(target.parent)
        try:
            with os.fdopen(_create(target), 'wb') as file:
                shutil.copyfileobj(opened, file, COPY_BYTES)
        except OSError:
            target.unlink(missing_ok=True)
            raise


def _check_free_space(folder: Path) -> None:
    status = os.statvfs(folder)
    if status.f_bavail * status.f_frsize < MIN_FREE_BYTES:
        raise OSError(f'the disk of {folder} has less than {MIN_FREE_BYTES >> 20} MiB free')
