"""The control socket (``spool/control.py``): receives requests from other processes of this user for the main thread.

A client that misbehaves only loses its connection: lines, clients and times are bounded.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, Final

from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.spool.control import ANSWER_S, MAX_REQUEST_BYTES, NAME, address, name_of

log = logging.getLogger(__name__)

MAX_CLIENTS: Final = 16
IDLE_S: Final = 60.0
"""Maximum time for a connected client to send a complete line; the front sends one per second."""
READ_S: Final = 5.0
"""Maximum time for it to read an answer."""
BACKLOG: Final = 64
CANCEL_S: Final = 0.2
"""Time for clients to read that the node closes."""
OPEN_S: Final = 2.0
"""How long the node's startup waits for the socket; normally a few milliseconds."""
LOCK: Final = 'control.lock'
_Request = Mapping[str, Any]
Waiting = tuple[_Request, 'Future[dict[str, Any]]']


class ControlSocket:
    """Serves commands to programs without ROS, through a Unix socket in the spool.

    Lifecycle: New; open once, by the robot's only node; ``handle_requests`` by the main thread after each ``wake``; close once.

    Owns the thread ``control``, which reads and writes; requests wait in a queue for the main thread.
    """

    def __init__(self, spool: Path, robot: str, wake: Callable[[], None], *, idle_s: float = IDLE_S,
                 answer_s: float = ANSWER_S, read_s: float = READ_S) -> None:  # fmt: skip
        """``wake`` notifies the main thread, from the other one, of a request."""
        self._spool = spool
        self._robot = robot
        self._wake = wake
        self._idle_s, self._answer_s, self._read_s = idle_s, answer_s, read_s
        self._waiting: deque[Waiting] = deque()
        self._opened = ExitStack()
        self._name = NAME
        self._listening = threading.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._over: asyncio.Event | None = None
        self._clients: set[asyncio.Task[None]] = set()
        self.worker = Worker('control', self._step)

    def open(self) -> None:
        """Choose the name, and listen; if the disk rejects the socket, the thread tries again."""
        is_first = self._opened.enter_context(flock(self._spool / LOCK, wait=False))
        own = name_of(self._robot)
        self._name = NAME if is_first else own
        if is_first:  # a node of the same robot that shared the spool may have been killed
            (self._spool / own).unlink(missing_ok=True)
        self.worker.start()
        if not self._listening.wait(OPEN_S):
            log.warning('the control socket %s is not there yet', self._spool / self._name)

    @property
    def path(self) -> Path:
        """Its path, once it is open."""
        return self._spool / self._name

    def handle_requests(self, do: Callable[[_Request], dict[str, Any]]) -> None:
        """Handle all waiting requests, one after the other; ``do`` returns the answer."""
        while self._waiting:
            request, answer = self._waiting.popleft()
            if answer.set_running_or_notify_cancel():  # otherwise the client already has the answer that it takes too long
                answer.set_result(do(request))

    def close(self) -> None:
        """Pass no more requests to the main thread; waiting clients get an answer."""
        self.worker.stop()
        loop, over = self._loop, self._over
        if loop is not None and over is not None:
            with suppress(RuntimeError):  # it is closed already
                loop.call_soon_threadsafe(over.set)
        if not self.worker.join(OPEN_S):
            log.warning('the control socket does not close')
        (self._spool / self._name).unlink(missing_ok=True)
        self._opened.close()

    # -- the thread ------------------------------------------------------------------------------------------------

    def _step(self) -> None:
        """Listen until it is closed."""
        with _listening(self._spool, self._name) as listener:
            asyncio.run(self._serve(listener))

    async def _serve(self, listener: socket.socket) -> None:
        self._loop, self._over = asyncio.get_running_loop(), asyncio.Event()
        server = await asyncio.start_unix_server(self._begin, sock=listener, limit=MAX_REQUEST_BYTES)
        self._listening.set()
        try:
            if not self.worker.stopping:
                await self._over.wait()
        finally:
            server.close()
            while self._clients:  # until Python 3.12 wait_for loses a cancellation that arrives together with its result
                for client in self._clients:
                    client.cancel()
                await asyncio.wait(set(self._clients), timeout=CANCEL_S)

    async def _begin(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve a client, from its first line to its end."""
        this = asyncio.current_task()
        assert this is not None
        self._clients.add(this)
        writer.transport.set_write_buffer_limits(0)  # so that ``drain`` waits until all is read
        try:
            if len(self._clients) > MAX_CLIENTS:
                await self._tell(writer, self._refused(f'{MAX_CLIENTS} clients are connected, which is the maximum'))
            else:
                await self._converse(reader, writer)
        except (OSError, asyncio.TimeoutError):  # it disconnected, or does not read
            pass
        except asyncio.CancelledError:  # the node closes
            with suppress(OSError, asyncio.TimeoutError):
                await self._tell(writer, self._refused('the node is closing'))
        finally:
            self._clients.discard(this)
            writer.transport.abort() if writer.transport.get_write_buffer_size() else writer.close()

    async def _converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Handle requests one after the other, until the client ends or breaks the rules."""
        while True:
            try:
                line = await asyncio.wait_for(reader.readuntil(b'\n'), self._idle_s)
            except asyncio.IncompleteReadError as error:
                if error.partial:
                    await self._tell(writer, self._refused('a request must end with a newline'))
                return
            except asyncio.LimitOverrunError:
                await self._tell(writer, self._refused(f'a request has at most {MAX_REQUEST_BYTES} bytes'))
                return
            except asyncio.TimeoutError:
                await self._tell(writer, self._refused(f'no complete line was received for {self._idle_s:g} s'))
                return
            try:
                request = _parsed(line)
            except ValueError as error:
                await self._tell(
                    writer, self._refused(f'that is not a request, which is a line such as {{"do": "flush"}}: {error}')
                )
            else:
                await self._tell(writer, await self._have_done(request))

    async def _have_done(self, request: _Request) -> dict[str, Any]:
        answer: Future[dict[str, Any]] = Future()
        self._waiting.append((request, answer))
        self._wake()
        try:
            return await asyncio.wait_for(asyncio.wrap_future(answer), self._answer_s)
        except asyncio.TimeoutError:
            text = f'the node did not finish it within {self._answer_s:g} s; it continues with what it has started'
            return self._refused(text)

    async def _tell(self, writer: asyncio.StreamWriter, answer: Mapping[str, Any]) -> None:
        writer.write(json.dumps(answer).encode() + b'\n')
        await asyncio.wait_for(writer.drain(), self._read_s)

    def _refused(self, why: str) -> dict[str, Any]:
        return {'ok': False, 'robot': self._robot, 'error': why}


def _parsed(line: bytes) -> _Request:
    """Raises ValueError."""
    try:
        request = json.loads(line)
        json.dumps(request, ensure_ascii=False).encode()  # an unpaired surrogate could not be sent
    except RecursionError as error:
        raise ValueError('it is nested too deeply') from error
    if not isinstance(request, dict):
        raise ValueError('it is not an object')  # noqa: TRY004 - one error for whatever is wrong with a line
    return request


@contextmanager
def _listening(spool: Path, name: str) -> Iterator[socket.socket]:
    """A listening socket, which appears under its name only then, and replaces one that a dead node left behind."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC) as listener:
        os.fchmod(listener.fileno(), 0o600)  # before it is bound, so that its file never has another mode
        part = f'{name}.part'
        (spool / part).unlink(missing_ok=True)
        with address(spool, part) as there:
            listener.bind(there)
        listener.listen(BACKLOG)
        listener.setblocking(False)
        os.replace(spool / part, spool / name)
        yield listener
