"""The disk under the spool: free space, permission to write, and how long a commit takes. In a child process."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Iterator
from io import FileIO
from pathlib import Path
from typing import Final

from shadowhound_data_logger.doctor.model import Context, Result, error, info, measured, ok, warning

NAME: Final = 'disk'
SMALL_BYTES, LARGE_BYTES = 1 << 20, 8 << 20
WITHIN_S: Final = 2.0
"""The large one is written where the small one says that it takes no longer, and the syncs end then: a slow disk is a finding."""
SYNCS: Final = 8
SLOW_SYNC_S: Final = 0.25
"""A group commit has three; the spool wants one in 0.1 s, and can do with less often."""
SLOW_MBYTES: Final = 20.0
"""The full rate of a Go2 is 5 MB/s, and the disk has more to do."""
FEW_INODES: Final = 10_000
FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})


def check(context: Context) -> Iterator[Result]:
    """See the module."""
    folder = _existing(context.settings.spool_path)
    room = list(_room(folder, context))
    yield from room
    probe = folder / f'.doctor-{os.getpid()}'
    try:
        yield from _speed(probe)
    except OSError as problem:
        if not any(result.is_finding for result in room):
            yield _unwritable(folder, problem)
    finally:
        if probe.exists():
            probe.unlink()


def _existing(path: Path) -> Path:
    """The folder, or the nearest above it that is there: the doctor makes none."""
    return next(each for each in (path, *path.parents) if each.is_dir())


def _room(folder: Path, context: Context) -> Iterator[Result]:
    disk, settings = os.statvfs(folder), context.settings.spool
    free = disk.f_bavail * disk.f_frsize
    seen = f'{free / 1e9:.1f} GB free under {folder}'
    show = f'df -h {folder} ; sudo journalctl --vacuum-size=200M ; docker system df'
    if disk.f_flag & os.ST_RDONLY:
        yield error(
            'disk.readonly',
            f'the file system of {folder} is mounted read-only',
            'the kernel does that after an error of the disk, or it was mounted so',
            f'sudo dmesg | tail -30 ; sudo mount -o remount,rw {_mount_point(folder)}',
        )
    elif free < settings.min_free_bytes:
        yield error(
            'disk.space',
            seen,
            f'below spool.min_free_bytes ({settings.min_free_bytes / 1e9:.1f} GB) the node evicts what it logs',
            f'{show} ; or another disk: export SHADOWHOUND_HOME=/data/shadowhound',
            free_bytes=free,
        )
    elif free < settings.min_free_bytes + settings.max_bytes:
        cause = (
            f'spool.max_bytes ({settings.max_bytes / 1e9:.1f} GB) will not be reached: an outage is bridged for a shorter time'
        )
        yield info('disk.space', seen, cause, show, free_bytes=free)
    else:
        yield ok('disk.space', seen, free_bytes=free)
    if disk.f_files > 0 and disk.f_favail < FEW_INODES:
        yield warning(
            'disk.inodes',
            f'{disk.f_favail:,} files can still be made under {folder}',
            'the spool has a file an object',
            f'df -i {folder}',
            inodes=disk.f_favail,
        )


def _mount_point(folder: Path) -> Path:
    return next(each for each in (folder, *folder.parents) if each.is_mount())


def _speed(probe: Path) -> Iterator[Result]:
    """Small syncs first, then a large write."""
    with open(probe, 'xb', buffering=0) as file:  # noqa: PTH123 - as the spool does it
        took: list[float] = []
        while len(took) < SYNCS and sum(took) < WITHIN_S:
            began_s = time.perf_counter()
            file.write(bytes(4096))
            os.fsync(file.fileno())
            took.append(time.perf_counter() - began_s)
        middle_s = sorted(took)[len(took) // 2]
        size, took_s = SMALL_BYTES, _write(file, SMALL_BYTES)
        if took_s * LARGE_BYTES / SMALL_BYTES < WITHIN_S:
            size, took_s = LARGE_BYTES, _write(file, LARGE_BYTES)
        mbytes = size / 1e6 / took_s
    yield measured(
        'disk.sync',
        f'a sync takes {1000 * middle_s:.1f} ms',
        'an SD card, a dying or a busy disk: commits come late, and more is lost in a power cut',
        'iostat -x 1 5 ; an NVMe disk: export SHADOWHOUND_HOME=/data/shadowhound',
        is_fine=middle_s <= SLOW_SYNC_S,
        sync_s=round(middle_s, 4),
    )
    yield measured(
        'disk.speed',
        f'{mbytes:.0f} MB/s can be written',
        'an SD card, or a disk that others keep busy',
        'iostat -x 1 5',
        is_fine=mbytes >= SLOW_MBYTES,
        write_mbytes=round(mbytes, 1),
    )


def _write(file: FileIO, size: int) -> float:
    """Seconds until so many bytes are on the disk."""
    began_s = time.perf_counter()
    left = size
    while left > 0:
        left -= file.write(os.urandom(min(left, 1 << 20)))
    os.fsync(file.fileno())
    return time.perf_counter() - began_s


def _unwritable(folder: Path, problem: OSError) -> Result:
    if problem.errno in FULL:
        return error('disk.space', f'no space left under {folder}', 'the disk is full, or a quota is used up', f'df -h {folder}')
    if problem.errno == errno.EROFS:
        return error(
            'disk.readonly',
            f'the file system of {folder} is read-only',
            'an error of the disk, or it was mounted so',
            f'sudo mount -o remount,rw {_mount_point(folder)}',
        )
    return error(
        'disk.permission',
        f'{folder} cannot be written: {problem.strerror}',
        'it belongs to another user',
        f'sudo chown -R $USER {folder} ; or: export SHADOWHOUND_HOME=~/.shadowhound',
    )
