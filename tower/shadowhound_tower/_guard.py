"""Runs a server, and stops it within seconds after its owner exits: ``python _guard.py [--remove=PATH ...] -- COMMAND ...``.

A separate program without imports from the package. It ends the server's process group when its standard input is closed or its
parent exits (so a ``kill -9`` of the owner leaves nothing behind), and exits with the server's exit code. A parent death signal
to the server would not be enough: it is tied to the thread that started it, and does not reach grandchildren.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import signal
import subprocess
import sys
from pathlib import Path

GRACE_S = 5.0
"""Time for the server to stop before it is killed."""
LOOK_S = 0.2
PR_SET_PDEATHSIG = 1
"""linux/prctl.h"""


def main(arguments: list[str]) -> int:
    owner = os.getppid()
    split = arguments.index('--')
    leftovers = [Path(argument.removeprefix('--remove=')) for argument in arguments[:split]]
    signal.pthread_sigmask(signal.SIG_SETMASK, ())  # an owner that blocks SIGTERM must not pass that to the server
    libc = ctypes.CDLL(None)
    server = subprocess.Popen(
        arguments[split + 1 :],
        stdin=subprocess.DEVNULL,
        start_new_session=True,
        # Safe here: this process has one thread, which lives as long as the server. It covers a killed guard.
        preexec_fn=lambda: libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL),  # noqa: PLW1509
    )
    try:
        while server.poll() is None and os.getppid() == owner:
            if select.select([0], [], [], LOOK_S)[0] and not os.read(0, 1):
                break
    finally:
        _end(server)
        for path in leftovers:
            path.unlink(missing_ok=True)
    return server.returncode


def _end(server: subprocess.Popen[bytes]) -> None:
    for number in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(server.pid, number)
        except ProcessLookupError:
            break
        try:
            server.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            continue
    with contextlib.suppress(ProcessLookupError):  # remaining processes of the server's group
        os.killpg(server.pid, signal.SIGKILL)


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
