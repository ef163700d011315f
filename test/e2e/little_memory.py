"""``little_memory.py MODULE ...``: run a module with a /dev/shm of 40 MB, 39 of them left over by a killed process."""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from pathlib import Path

MEMORY = Path('/dev/shm')  # noqa: S108 - where Fast DDS has it
LEFT = MEMORY / 'fastrtps_0123456789abcdef'
INSIDE = 'LITTLE_MEMORY'


def main() -> None:
    """Run in a separate mount namespace."""
    if INSIDE not in os.environ:
        os.environ[INSIDE] = 'yes'
        os.execvp('unshare', ['unshare', '--mount', sys.executable, *sys.argv])  # noqa: S606 - this very program
    subprocess.run(['mount', '-t', 'tmpfs', '-o', 'size=40m', 'tmpfs', str(MEMORY)], check=True)
    LEFT.write_bytes(bytes(39_000_000))
    lock = LEFT.with_name(f'{LEFT.name}_el')
    lock.touch()
    os.utime(lock, (0, 0))
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name='__main__', alter_sys=True)


if __name__ == '__main__':
    main()
