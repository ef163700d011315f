"""Small file systems to fill up or to break: ext4 in a file if the machine allows it, otherwise memory."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

MEBI: Final = 1 << 20
ERRORS: Final = Path('/sys/fs/ext4')
INSIDE: Final = 'SHADOWHOUND_TORTURE_INSIDE'
"""Set in a process that already runs in a separate namespace."""


@dataclass(frozen=True, slots=True)
class Disk:
    """A separate mounted file system."""

    path: Path
    kind: str
    """``ext4`` or ``tmpfs``."""
    image: Path

    def free(self) -> int:
        """Bytes that are left for a writer."""
        status = os.statvfs(self.path)
        return status.f_bavail * status.f_frsize

    def break_down(self) -> None:
        """Make the kernel find an error: ext4 is then read-only until it is unmounted and checked."""
        answer = subprocess.run(['findmnt', '-no', 'SOURCE', str(self.path)], check=True, capture_output=True, text=True)
        (ERRORS / Path(answer.stdout.strip()).name / 'trigger_fs_error').write_text('1')

    def repair(self) -> None:
        """Unmount, check and mount again; it must not be in use."""
        _run('umount', str(self.path))
        subprocess.run(['e2fsck', '-fy', str(self.image)], check=False, capture_output=True)  # 1: errors were fixed
        _mount_image(self.image, self.path)


class NotAllowed(Exception):
    """This process may not mount file systems."""


@contextmanager
def small_disk(folder: Path, mebibytes: int) -> Iterator[Disk]:
    """Raises NotAllowed. Unmounted at the end, even if it is in use."""
    disk = Disk(folder / 'disk', 'ext4', folder / 'disk.img')
    disk.path.mkdir(parents=True)
    try:
        with disk.image.open('wb') as file:
            file.truncate(mebibytes * MEBI)
        _run('mkfs.ext4', '-qF', '-m', '0', str(disk.image))
        _mount_image(disk.image, disk.path)
    except (OSError, subprocess.CalledProcessError):
        disk = Disk(disk.path, 'tmpfs', disk.image)
        try:
            _run('mount', '-t', 'tmpfs', '-o', f'size={mebibytes}m', 'none', str(disk.path))
        except (OSError, subprocess.CalledProcessError) as error:
            raise NotAllowed from error
    try:
        yield disk
    finally:
        _run('umount', '--lazy', str(disk.path))
        disk.image.unlink(missing_ok=True)


def inside(module: str, arguments: list[str]) -> None:
    """Restart the program in a namespace where an ordinary user may mount; returns if that is useless or already done."""
    if INSIDE not in os.environ:
        command = ['unshare', '--user', '--map-root-user', '--mount', sys.executable, '-m', module, *arguments]
        os.execvpe(command[0], command, {**os.environ, INSIDE: '1'})  # noqa: S606 - its own program and arguments


def _mount_image(image: Path, path: Path) -> None:
    _run('mount', '-o', 'loop,errors=remount-ro', str(image), str(path))


def _run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True)
