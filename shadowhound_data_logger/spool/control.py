"""The client of a running node's control socket: where the socket is, and how to ask.

It is a Unix stream socket in the spool, for its owner alone (mode 0600). A request is a line of JSON, ``{"do": "flush"}``, and so
is its answer: ``{"ok": true, "robot": "thor", ...}``, or ``{"ok": false, "robot": "thor", "error": "..."}``. One connection takes
any number of them, one after the other. The node that starts first has ``control.sock``; another one that shares the spool with
it has ``control-ROBOT.sock``. docs/architecture.md lists what can be asked.
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
"""Of a line that asks; the longest that the command line sends has some hundred."""
MAX_ANSWER_BYTES: Final = 1 << 24
"""Of a line that answers; that with all parameters and their texts has some 60 KB."""
ANSWER_S: Final = 30.0
"""Within which the node answers: a flush takes 5 s at most, and what was asked before it as long again."""
PATIENCE_S: Final = ANSWER_S + 5.0
"""For how long a client waits."""
_START: Final = 'start one: ros2 run shadowhound_data_logger sensor_logger_node'


def name_of(robot: str) -> str:
    """Of the socket of a node that shares the spool with one that came first."""
    return f'control-{robot}.sock'


@contextmanager
def address(spool: Path, name: str) -> Iterator[str]:
    """What a socket there can be bound and connected to by: unix(7) allows 107 bytes, and the path of a spool may be longer."""
    folder = os.open(spool, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f'/proc/self/fd/{folder}/{name}'
    finally:
        os.close(folder)


class Connection:
    """A connection to a node's control socket.

    Open from the start; ``ask`` any number of times, from one thread; close once.
    """

    def __init__(self, spool: Path, name: str, deadline_s: float = PATIENCE_S) -> None:
        """Raises OSError where nobody listens there, or where it is not for us."""
        self._path = spool / name
        self._deadline_s = deadline_s
        self._rest = b''
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        try:
            self._socket.settimeout(deadline_s)
            with address(spool, name) as there:
                self._socket.connect(there)
        except BaseException:
            self._socket.close()
            raise

    def close(self) -> None:
        self._socket.close()

    def ask(self, do: str, **arguments: Any) -> dict[str, Any]:
        """The answer; ``ok`` says whether it was done. Raises NodeUnavailable when there is none, and is of no use after that."""
        try:
            self._socket.settimeout(self._deadline_s)
            self._socket.sendall(json.dumps({'do': do, **arguments}).encode() + b'\n')
        except (BrokenPipeError, ConnectionResetError):
            pass  # refused, and why is there to be read
        except OSError as error:
            raise self._lost(error) from error
        try:
            answer = json.loads(self._line())
        except (OSError, ValueError) as error:
            raise self._lost(error) from error
        if not isinstance(answer, dict) or 'ok' not in answer:
            raise self._lost(ValueError('what it says is not an answer'))
        return answer

    def _line(self) -> bytes:
        """The next one; raises OSError or ValueError."""
        end_s = time.monotonic() + self._deadline_s
        while b'\n' not in self._rest:
            self._socket.settimeout(max(0.001, end_s - time.monotonic()))
            more = self._socket.recv(1 << 16)
            if not more:
                raise ConnectionResetError('it ended')
            self._rest += more
            if len(self._rest) > MAX_ANSWER_BYTES:
                raise ValueError(f'its answer has more than {MAX_ANSWER_BYTES} bytes')
        line, _, self._rest = self._rest.partition(b'\n')
        return line

    def _lost(self, error: Exception) -> NodeUnavailable:
        if isinstance(error, TimeoutError):
            text = f'the node behind {self._path} did not answer within {self._deadline_s:g} s'
            return NodeUnavailable(text, remedy='see what it does: shadowhound-data status')
        return NodeUnavailable(f'the node behind {self._path} no longer answers: {error}')


def connect(spool: Path, robot: str | None = None, deadline_s: float = PATIENCE_S) -> Connection:
    """To the node of a robot; without a name to the only one that runs. Raises NodeUnavailable, which says which ones run."""
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
    """A connection to each node of the spool that runs."""
    for path in sorted(spool.glob('control*.sock')):
        try:
            connection = Connection(spool, path.name, deadline_s)
        except PermissionError as error:
            raise NodeUnavailable(f'{path} is not for this user', remedy='ask as the user of the node') from error
        except OSError:  # left behind by a node that was killed
            continue
        yield connection


def _none_chosen(spool: Path, robot: str | None, running: list[str]) -> NodeUnavailable:
    if robot and running:
        return NodeUnavailable(f'no node of {robot} runs here; those that run: {", ".join(running)}', remedy='--robot NAME')
    if running:
        return NodeUnavailable(f'several nodes run here: {", ".join(running)}', remedy='name one: --robot NAME')
    if not os.access(spool, os.R_OK | os.X_OK) and spool.exists():
        return NodeUnavailable(f'the spool {spool} is not for this user', remedy='ask as the user of the node')
    whose = f' of {robot}' if robot else ''
    return NodeUnavailable(f'no node{whose} runs with the spool {spool}', remedy=f'{_START}; SHADOWHOUND_HOME names its folder')
