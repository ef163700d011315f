"""A proxy for a real S3 server that applies a script's fault to each request: the faults of a bad day, over real sockets.

It reads complete requests and forwards them, so it knows what the server accepted, also if the client never learns it.
Forwarding continues after the client has given up, as in a slow network.
"""

from __future__ import annotations

import hashlib
import http.client
import random
import select
import socket
import struct
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from email.utils import formatdate
from http.server import BaseHTTPRequestHandler
from typing import TYPE_CHECKING, Final
from urllib.parse import unquote, urlsplit

from faults.kinds import Condition, Fault
from faults.upstream import OFF, Request, ask

if TYPE_CHECKING:
    from typing_extensions import Self

HOST: Final = '127.0.0.1'
SLOW_BYTES_PER_S: Final = 1024.0
SLICE_S: Final = 0.05
POLL_S: Final = 0.02
STATUS_LINE: Final = len('HTTP/1.1 200')
_ABORT: Final = struct.pack('ii', 1, 0)
_CANNED: Final = {
    Fault.ERROR_500: (500, 'InternalError'), Fault.SLOW_DOWN: (503, 'SlowDown'), Fault.DENIED: (403, 'AccessDenied'),
    Fault.NO_CONDITION: (501, 'NotImplemented'),
}  # fmt: skip


class Front:
    """New; enter once, exit once. ``script`` returns the fault of each request; it may be replaced at any time.

    One thread accepts, each connection has another one; ``_lock`` guards the shared counts.
    """

    def __init__(self, url: str, script: Callable[[], Fault] = lambda: Fault.NONE, *, secret: str = '',
                 condition: Condition = Condition.HONOURED, refuse_s: float = 0.2, seed: int = 0) -> None:  # fmt: skip
        parts = urlsplit(url)
        rng = random.Random(seed)
        self.script = script
        self.secret = secret
        self.condition = condition
        self.cut: Callable[[bytes], int] = lambda answer: rng.randrange(STATUS_LINE, len(answer))
        """Where a response is truncated: anywhere after its status."""
        self.server = str(parts.hostname), parts.port or 80
        self.over = threading.Event()
        self.denied: Counter[str] = Counter()
        """Path -> number of denied requests for it."""
        self.stored: dict[str, list[str]] = {}
        """Path -> SHA-256 of each content that the server accepted for it, in order."""
        self._refuse_s = refuse_s
        self._refused_until = 0.0
        self._lock = threading.Lock()
        self._on_their_way = 0
        self._connections: set[socket.socket] = set()
        self._threads: list[threading.Thread] = []
        self._port = socket.socket()  # bound, so that no other process takes it while it does not listen
        self._port.bind((HOST, 0))
        self._port.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.url = f'http://{HOST}:{self._port.getsockname()[1]}'

    def __enter__(self) -> Self:
        self._threads.append(threading.Thread(target=self._accept, args=(self._listen(),), name='front'))
        self._threads[0].start()
        return self

    def __exit__(self, *_: object) -> None:
        self.over.set()
        self._threads[0].join()
        self._cut_all()
        for thread in self._threads:
            thread.join()
        self._port.close()

    @property
    def is_quiet(self) -> bool:
        """Whether no request is being forwarded."""
        return not self._on_their_way

    def refuse(self) -> None:
        """Refuse connections for a while."""
        self._refused_until = time.monotonic() + self._refuse_s

    @property
    def refuses(self) -> bool:
        return time.monotonic() < self._refused_until

    def deny(self, target: str) -> None:
        with self._lock:
            self.denied[unquote(urlsplit(target).path)] += 1

    def forward(self, request: Request, *, slowly: bool = False) -> bytes:
        """Send it to the server; returns its complete response. Raises OSError or HTTPException without one."""
        if self.condition is Condition.OVERWRITES:
            request = request.without_condition(self.secret)
        with self._lock:
            self._on_their_way += 1
        try:
            status, answer = ask(self.server, request, self.pieces(request.body, slowly=slowly))
            if request.method == 'PUT' and status == 200:
                with self._lock:
                    taken = self.stored.setdefault(unquote(request.target), [])
                    taken.append(hashlib.sha256(request.body).hexdigest())
        finally:
            with self._lock:
                self._on_their_way -= 1
        return answer

    def pieces(self, data: bytes, *, slowly: bool) -> Iterator[bytes]:
        """The complete data, at 1 KB/s if set."""
        step = round(SLOW_BYTES_PER_S * SLICE_S) if slowly else max(len(data), 1)
        for start in range(0, len(data), step):
            if slowly:
                self.over.wait(SLICE_S)
            yield data[start : start + step]

    # -- the accepting thread ----------------------------------------------------------------------------------------

    def _listen(self) -> socket.socket:
        listening = socket.socket()
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(self._port.getsockname())
        listening.listen(64)
        return listening

    def _accept(self, listening: socket.socket) -> None:
        while not self.over.is_set():
            if self.refuses:
                listening.close()
                self._cut_all()
                self.over.wait(max(self._refused_until - time.monotonic(), 0.0))
                listening = self._listen()
            if select.select([listening], [], [], POLL_S)[0]:
                connection, address = listening.accept()
                with self._lock:
                    self._connections.add(connection)
                self._threads.append(threading.Thread(target=self._serve, args=(connection, address), name='front-connection'))
                self._threads[-1].start()
        listening.close()

    def _serve(self, connection: socket.socket, address: object) -> None:
        with connection, suppress(OSError):
            _Exchange(connection, address, self)  # type: ignore[arg-type]  # it takes the place of a server
        with self._lock:
            self._connections.discard(connection)

    def _cut_all(self) -> None:
        with self._lock:
            for connection in self._connections:
                with suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)


class _Exchange(BaseHTTPRequestHandler):
    """One connection: requests until it fails."""

    protocol_version = 'HTTP/1.1'
    timeout = 60.0
    server: Front  # type: ignore[assignment]

    def _treat(self) -> None:
        if self.server.refuses:
            self._abort()  # the listening socket is about to close
            return
        fault = self.server.script()
        length = int(self.headers.get('Content-Length') or 0)
        if fault is Fault.RESET:
            self.rfile.read(length // 2)
            self._abort()
            return
        if fault is Fault.REFUSED:
            self.server.refuse()
            self._abort()
            return
        headers = {name.lower(): value for name, value in self.headers.items()}
        request = Request(self.command, self.path, headers, self.rfile.read(length))
        if len(request.body) < length:
            self._abort()  # the client gave up
        elif fault is Fault.HUNG:
            self._hang()
        elif fault in _CANNED or (self.server.condition is Condition.NOT_IMPLEMENTED and fault is Fault.NONE):
            self._can(fault, request)
        elif fault is Fault.PORTAL:
            self._answer(200, b'<html>Welcome to our WiFi</html>', 'text/html')
        else:
            self._pass_on(fault, request)

    do_GET = do_HEAD = do_PUT = do_POST = do_DELETE = _treat  # noqa: N815 - as BaseHTTPRequestHandler calls them

    def _can(self, fault: Fault, request: Request) -> None:
        """A response that needs no server; of a server without the condition, if the request has one."""
        if fault in {Fault.NONE, Fault.NO_CONDITION} and 'if-none-match' not in request.headers:
            self._pass_on(Fault.NONE, request)
            return
        status, code = _CANNED[Fault.NO_CONDITION if fault is Fault.NONE else fault]
        if fault is Fault.DENIED:
            self.server.deny(request.target)
        body = f'<?xml version="1.0"?><Error><Code>{code}</Code><Message>by the front</Message></Error>'
        self._answer(status, body.encode(), 'application/xml')

    def _pass_on(self, fault: Fault, request: Request) -> None:
        if fault is Fault.SKEWED:
            request = request.of_another_time(self.server.secret)
        try:
            answer = self.server.forward(request, slowly=fault is Fault.SLOW)
        except (OSError, http.client.HTTPException):
            self._abort()
            return
        if fault is Fault.ACK_LOST:
            self.close_connection = True
            return
        if fault is Fault.CUT:
            answer = answer[: self.server.cut(answer)]
            self.close_connection = True
        if fault is Fault.SKEWED:
            answer = _dated(answer)
        for piece in self.server.pieces(answer, slowly=fault is Fault.SLOW):
            self.wfile.write(piece)

    def _answer(self, status: int, body: bytes, content_type: str) -> None:
        self.send_response(status)
        self.send_header('Content-Type', content_type)
        self.send_header('Content-Length', str(len(body)))
        self.end_headers()
        if self.command != 'HEAD':
            self.wfile.write(body)

    def _hang(self) -> None:
        """Wait until the client gives up."""
        self.close_connection = True
        while not self.server.over.is_set() and not select.select([self.connection], [], [], POLL_S)[0]:
            pass

    def _abort(self) -> None:
        """Reset the client's connection."""
        self.close_connection = True
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _ABORT)

    def log_message(self, *_: object) -> None:
        """Log nothing."""


def _dated(answer: bytes) -> bytes:
    """The response with the server's time."""
    head, _, body = answer.partition(b'\r\n\r\n')
    lines = [line for line in head.split(b'\r\n') if not line.lower().startswith(b'date:')]
    ahead = formatdate(time.time() + OFF.total_seconds(), usegmt=True)
    return b'\r\n'.join([*lines, f'Date: {ahead}'.encode()]) + b'\r\n\r\n' + body
