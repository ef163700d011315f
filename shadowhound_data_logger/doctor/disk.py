"""The disk under the spool: free space, write permission, and duration of a commit. Runs in a child process."""

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
"""The large write is skipped if the small one predicts that it takes longer, and the syncs stop then: a slow disk is a finding.
"""
SYNCS: Final = 8
SLOW_SYNC_S: Final = 0.25
"""A group commit has three syncs; the spool commits every 0.1 s, or less often if it must."""
SLOW_MBYTES: Final = 20.0
"""The full rate of a Go2 is 5 MB/s, and the disk has other work."""
FEW_INODES: Final = 10_000
FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})


def check(context: Context) -> Iterator[Result]:
    """Check free space, permissions, and the speed of syncs and writes."""
    folder = _nearest_existing(context.settings.spool_path)
    room = list(_free_space(folder, context))
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


def _nearest_existing(path: Path) -> Path:
    """The folder, or its nearest existing parent: the doctor creates none."""
    return next(each for each in (path, *path.parents) if each.is_dir())


def _free_space(folder: Path, context: Context) -> Iterator[Result]:
    disk, settings = os.statvfs(folder), context.settings.spool
    free = disk.f_bavail * disk.f_frsize
    seen = f'{free / 1e9:.1f} GB free under {folder}'
    show = f'df -h {folder} ; sudo journalctl --vacuum-size=200M ; docker system df'
    if disk.f_flag & os.ST_RDONLY:
        yield error(
            'disk.readonly',
            f'the file system of {folder} is mounted read-only',
            'the kernel does that after a disk error, or it was mounted read-only',
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
            f'{disk.f_favail:,} files can still be created under {folder}',
            'the spool has one file per object',
            f'df -i {folder}',
            inodes=disk.f_favail,
        )


def _mount_point(folder: Path) -> Path:
    return next(each for each in (folder, *folder.parents) if each.is_mount())


def _speed(probe: Path) -> Iterator[Result]:
    """Small syncs first, then one large write."""
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
        'an SD card, or a failing or busy disk: commits are late, and a power cut loses more',
        'iostat -x 1 5 ; an NVMe disk: export SHADOWHOUND_HOME=/data/shadowhound',
        is_fine=middle_s <= SLOW_SYNC_S,
        sync_s=round(middle_s, 4),
    )
    yield measured(
        'disk.speed',
        f'{mbytes:.0f} MB/s can be written',
        'an SD card, or a disk that other programs keep busy',
        'iostat -x 1 5',
        is_fine=mbytes >= SLOW_MBYTES,
        write_mbytes=round(mbytes, 1),
    )


def _write(file: FileIO, size: int) -> float:
    """Seconds until this many bytes are on the disk."""
    began_s = time.perf_counter()
    left = size
    while left > 0:
        left -= file.write(os.urandom(min(left, 1 << 20)))
    os.fsync(file.fileno())
    return time.perf_counter() - began_s


def _unwritable(folder: Path, problem: OSError) -> Result:
    if problem.errno in FULL:
        return error(
            'disk.space', f'no space left under {folder}', 'the disk is full, or a quota is exhausted', f'df -h {folder}'
        )
    if problem.errno == errno.EROFS:
        return error(
            'disk.readonly',
            f'the file system of {folder} is read-only',
            'a disk error, or it was mounted read-only',
            f'sudo mount -o remount,rw {_mount_point(folder)}',
        )
    return error(
        'disk.permission',
        f'{folder} cannot be written: {problem.strerror}',
        'it belongs to another user',
        f'sudo chown -R $USER {folder} ; or: export SHADOWHOUND_HOME=~/.shadowhound',
    )
