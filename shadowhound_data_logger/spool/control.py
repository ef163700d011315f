"""The client of a running node's control socket.

It is a Unix stream socket in the spool, accessible only to its owner (mode 0600). A request is a line of JSON, such as ``{"do":
"flush"}``, and so is its answer: ``{"ok": true, "robot": "thor", ...}``, or ``{"ok": false, "robot": "thor", "error": "..."}``.
A connection may send any number of requests, one after the other. The node that starts first has ``control.sock``; another one
that shares the spool has ``control-ROBOT.sock``. docs/architecture.md lists the requests.
"""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.errors import NodeUnavailable

NAME: Final = 'control.sock'
MAX_REQUEST_BYTES: Final = 1 << 16
"""Per request line; the longest one that the command line sends has a few hundred."""
MAX_ANSWER_BYTES: Final = 1 << 24
"""Per answer line; the answer with all parameters and their descriptions has some 60 KB."""
ANSWER_S: Final = 30.0
"""Time limit for an answer: a flush takes up to 5 s, and earlier requests as long again."""
PATIENCE_S: Final = ANSWER_S + 5.0
"""How long a client waits."""
_START: Final = 'start one: ros2 run shadowhound_data_logger sensor_logger_node'


def name_of(robot: str) -> str:
    """The name of the socket of a node that shares the spool with one that started first."""
    return f'control-{robot}.sock'


@contextmanager
def address(spool: Path, name: str) -> Iterator[str]:
    """A short path to bind or connect the socket: unix(7) allows 107 bytes, and the path of a spool may be longer."""
    folder = os.open(spool, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f'/proc/self/fd/{folder}/{name}'
    finally:
        os.close(folder)


class Connection:
    """A connection to a node's control socket.

    Lifecycle: open when new; ``ask`` any number of times, from one thread; close once.
    """

    def __init__(self, spool: Path, name: str, deadline_s: float = PATIENCE_S) -> None:
        """Raises OSError if no node listens there, or this user may not connect."""
        self._path = spool / name
        self._deadline_s = deadline_s
        self._rest = b''
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        try:
            self._socket.settimeout(deadline_s)
            with address(spool, name) as path:
                self._socket.connect(path)
        except BaseException:
            self._socket.close()
            raise

    def close(self) -> None:
        self._socket.close()

    def ask(self, do: str, **arguments: Any) -> dict[str, Any]:
        """The answer; ``ok`` is whether it was done. Raises NodeUnavailable without an answer; close the connection then."""
        try:
            self._socket.settimeout(self._deadline_s)
            self._socket.sendall(json.dumps({'do': do, **arguments}).encode() + b'\n')
        except (BrokenPipeError, ConnectionResetError):
            pass  # the node has refused the connection; its answer has the reason
        except OSError as error:
            raise self._lost(error) from error
        try:
            answer = json.loads(self._line())
        except (OSError, ValueError) as error:
            raise self._lost(error) from error
        if not isinstance(answer, dict) or 'ok' not in answer:
            raise self._lost(ValueError('its answer is invalid'))
        return answer

    def _line(self) -> bytes:
        """The next line. Raises OSError or ValueError."""
        end_s = time.monotonic() + self._deadline_s
        while b'\n' not in self._rest:
            self._socket.settimeout(max(0.001, end_s - time.monotonic()))
            more = self._socket.recv(1 << 16)
            if not more:
                raise ConnectionResetError('it closed the connection')
            self._rest += more
            if len(self._rest) > MAX_ANSWER_BYTES:
                raise ValueError(f'its answer has more than {MAX_ANSWER_BYTES} bytes')
        line, _, self._rest = self._rest.partition(b'\n')
        return line

    def _lost(self, error: Exception) -> NodeUnavailable:
        if isinstance(error, TimeoutError):
            text = f'the node behind {self._path} did not answer within {self._deadline_s:g} s'
            return NodeUnavailable(text, remedy='check what it is doing: shadowhound-data status')
        return NodeUnavailable(f'the node behind {self._path} no longer answers: {error}')


def connect(spool: Path, robot: str | None = None, deadline_s: float = PATIENCE_S) -> Connection:
    """Connect to a robot's node; without a name, to the only running one. Raises NodeUnavailable with the running ones."""
    with ExitStack() as others:
        found = {}
        for connection in _running(spool, deadline_s):
            others.callback(connection.close)
            found[str(connection.ask('describe')['robot'])] = connection
        chosen = found.get(robot) if robot else next(iter(found.values())) if len(found) == 1 else None
        if chosen is None:
            raise _none_chosen(spool, robot, sorted(found))
        others.pop_all()
    for connection in found.values():
        if connection is not chosen:
            connection.close()
    return chosen


def _running(spool: Path, deadline_s: float) -> Iterator[Connection]:
    """A connection to each running node of the spool."""
    for path in sorted(spool.glob('control*.sock')):
        try:
            connection = Connection(spool, path.name, deadline_s)
        except PermissionError as error:
            raise NodeUnavailable(f'this user may not use {path}', remedy='run this as the user of the node') from error
        except OSError:  # left behind by a node that was killed
            continue
        yield connection


def _none_chosen(spool: Path, robot: str | None, running: list[str]) -> NodeUnavailable:
    if robot and running:
        return NodeUnavailable(
            f'no node of {robot} is running here, only those of {", ".join(running)}', remedy='name one: --robot NAME'
        )
    if running:
        return NodeUnavailable(f'several nodes are running here: {", ".join(running)}', remedy='name one: --robot NAME')
    if not os.access(spool, os.R_OK | os.X_OK) and spool.exists():
        return NodeUnavailable(f'this user may not use the spool {spool}', remedy='run this as the user of the node')
    whose = f' of {robot}' if robot else ''
    return NodeUnavailable(
        f'no node{whose} is running with the spool {spool}',
        remedy=f'{_START}; or set SHADOWHOUND_HOME to the folder of its spool',
    )
