"""The missions' sender as the agent sees it: a child process that is started, woken, restarted when it dies, and released."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

from shadowhound_data_logger.missions.folder import MISSIONS

log = logging.getLogger(__name__)

AGAIN_S: Final = 5.0
LONGEST_S: Final = 60.0
"""Between two starts of one that dies."""
MOST_LOG_BYTES: Final = 1 << 20
_let_go: list[subprocess.Popen[bytes]] = []
"""Those that go on without their logger; looked at now and then, so that none stays a zombie."""
PACKAGE: Final = str(Path(__file__).resolve().parents[2])


class Replayer:
    """Starts and wakes the process that sends missions.

    Life: New; start once; wake and look any number; let_go once. Not thread-safe but for ``wake``.
    """

    def __init__(self, home: Path, experiment: str, environ: Mapping[str, str]) -> None:
        self._home = home
        self._experiment = experiment
        self._environ = dict(environ)
        self._process: subprocess.Popen[bytes] | None = None
        self._pause_s = AGAIN_S
        self._next_s = 0.0

    def start(self) -> None:
        """Returns at once. A machine that cannot start it now has another chance at ``look``."""
        _let_go[:] = [process for process in _let_go if process.poll() is None]
        folder = self._home / MISSIONS
        command = [sys.executable, '-m', 'shadowhound_data_logger.missions.replay',
                   '--home', str(self._home), '--experiment', self._experiment]  # fmt: skip
        path = os.pathsep.join(filter(None, (self._environ.get('PYTHONPATH'), PACKAGE)))
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with os.fdopen(os.open(folder / 'replay.log', os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600), 'ab') as output:
                if output.tell() > MOST_LOG_BYTES:
                    output.truncate(0)
                self._process = subprocess.Popen(
                    command, stdin=subprocess.PIPE, stdout=output, stderr=output, env={**self._environ, 'PYTHONPATH': path},
                    cwd=folder, start_new_session=True,
                )  # fmt: skip
        except OSError as error:
            log.warning('missions are not sent: the sender cannot be started: %s', error)
        else:
            assert self._process.stdin is not None
            os.set_blocking(self._process.stdin.fileno(), False)

    def wake(self) -> None:
        """Let it look at the journals now."""
        process = self._process
        if process is not None and process.stdin is not None:
            with suppress(OSError, ValueError):  # it has died, was let go, or has enough to read
                os.write(process.stdin.fileno(), b'\n')

    def look(self) -> None:
        """Start it again when it ended by itself, with a pause that doubles."""
        if self._process is None or self._process.poll() is not None:
            if self._process is not None and self._next_s == 0.0:
                log.warning("the missions' sender ended with %s; restarting it", self._process.returncode)
            if self._next_s == 0.0:
                self._next_s = time.monotonic() + self._pause_s
            elif time.monotonic() >= self._next_s:
                self._pause_s, self._next_s = min(2 * self._pause_s, LONGEST_S), 0.0
                self._close_pipe()
                self.start()

    def let_go(self) -> None:
        """It goes on without us, and ends when it has sent everything."""
        self._close_pipe()
        process, self._process = self._process, None
        if process is not None:
            _let_go.append(process)

    def forget(self) -> None:
        """In a forked child: it is the parent's."""
        self._close_pipe()
        if self._process is not None:
            self._process.returncode, self._process = 0, None

    def _close_pipe(self) -> None:
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()
