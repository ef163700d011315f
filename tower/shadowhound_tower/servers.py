"""Server processes of the embedded Tower: their ports and logs; none keeps running after its owner."""

from __future__ import annotations

import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from shadowhound_data_logger.core.errors import DataLoggerError

GUARD: Final = Path(__file__).with_name('_guard.py')
STOP_S: Final = 15.0
"""More than the guard needs to kill a server."""
POLL_S: Final = 0.02
TAIL_LINES: Final = 15
PORTS: Final = range(11_000, 22_700)
"""Below Linux's ephemeral ports (32768 up), as are the same plus 10,000: outgoing connections never use them."""
GRPC: Final = 10_000
"""SeaweedFS serves gRPC on the HTTP port plus this; some of these ports cannot be configured."""
SOCKETS: Final = Path('/tmp')  # noqa: S108 - where SeaweedFS leaves its sockets is fixed; we only remove them


class ServerFailed(DataLoggerError):
    """A server did not start or is not installed; ``data`` has its log."""


def seaweed_sockets(ports: Mapping[str, int]) -> list[Path]:
    """Files left behind by a SeaweedFS with these ports."""
    names = ((f'{name}-{port}', f'{name}-grpc-{port + GRPC}') for name, port in ports.items())
    return [SOCKETS / f'seaweedfs-{name}.sock' for both in names for name in both]


class Server:
    """One server process under a guard. Lifecycle: New; start and stop any number of times; not thread-safe."""

    def __init__(
        self, name: str, command: Sequence[str], *, log: Path, environ: Mapping[str, str], leftovers: Sequence[Path] = ()
    ) -> None:
        self.name = name
        self._command = tuple(command)
        self._log = log
        self._environ = dict(environ)
        self._leftovers = [f'--remove={path}' for path in leftovers]
        self._guard: subprocess.Popen[bytes] | None = None

    def __repr__(self) -> str:
        return f'Server({self.name!r}, {"running" if self._guard else "stopped"})'

    def start(self) -> None:
        """Returns immediately; use ``wait`` for its readiness."""
        if self._guard is None:
            with self._log.open('ab') as log:
                self._guard = subprocess.Popen(
                    [sys.executable, '-I', '-S', str(GUARD), *self._leftovers, '--', *self._command],
                    stdin=subprocess.PIPE, stdout=log, stderr=log, env=self._environ, start_new_session=True,
                )  # fmt: skip

    def wait(self, ready: Callable[[], bool], timeout_s: float) -> None:
        """Returns when ``ready()``; raises ServerFailed with the end of the log if it exited or took too long."""
        deadline = time.monotonic() + timeout_s
        while not ready():
            if self._guard is None or self._guard.poll() is not None:
                code = self._guard.returncode if self._guard else None
                raise self._failed(f'{self.name} exited with code {code} instead of starting')
            if time.monotonic() > deadline:
                raise self._failed(f'{self.name} did not answer within {timeout_s:g} s')
            time.sleep(POLL_S)

    def stop(self) -> None:
        """Returns when the process and its children have exited."""
        guard, self._guard = self._guard, None
        if guard is None:
            return
        assert guard.stdin is not None
        guard.stdin.close()
        try:
            guard.wait(STOP_S)
        except subprocess.TimeoutExpired:
            os.killpg(guard.pid, signal.SIGKILL)
            guard.wait()

    def _failed(self, what: str) -> ServerFailed:
        lines = self._log.read_text(encoding='utf-8', errors='replace').splitlines()[-TAIL_LINES:]
        return ServerFailed(what + '; the end of its log:\n' + '\n'.join(lines), log=str(self._log))


class Ports:
    """Ports that are reserved until ``release``, whether a server listens on them or not.

    Each is held by a bound socket that does not listen: no other process can take it, connections are refused, and a server
    that sets SO_REUSEADDR, as Go's and Python's do, can listen on it. A server that restarts finds its port free.
    """

    def __init__(self, host: str) -> None:
        self._host = host
        self._sockets: list[socket.socket] = []

    def take(self) -> int:
        """A free port whose companion ``GRPC`` above is free as well."""
        for port in random.sample(PORTS, 200):
            pair: list[socket.socket] = []
            try:
                for number in (port, port + GRPC):
                    pair.append(socket.socket())
                    pair[-1].bind((self._host, number))
            except OSError:
                for half in pair:
                    half.close()
                continue
            for half in pair:
                half.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # only now: reserved first, then open to our server
            self._sockets += pair
            return port
        raise ServerFailed(f'there is no free port on {self._host} between {PORTS.start} and {PORTS.stop}')

    def release(self) -> None:
        while self._sockets:
            self._sockets.pop().close()


def find_program(name: str, remedy: str) -> str:
    """The path of a program next to this interpreter (a wheel's script), otherwise on PATH; raises ServerFailed."""
    script = Path(sys.executable).parent / name
    found = str(script) if os.access(script, os.X_OK) else shutil.which(name)
    if found is None:
        raise ServerFailed(f'the program {name} is not installed', remedy=remedy)
    return found
