"""A small imitation of S3 over HTTP with faults set by the test, and sockets that misbehave."""

from __future__ import annotations

import hashlib
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit


class FakeS3(ThreadingHTTPServer):
    """Stores objects; ``condition`` selects its behavior for If-None-Match; an ``answer`` is the response to every request."""

    daemon_threads = True

    def __init__(
        self, *, condition: str = 'honoured', answer: tuple[int, bytes] | None = None, without_buckets: bool = False
    ) -> None:
        super().__init__(('127.0.0.1', 0), Handler)
        self.condition = condition
        self.answer = answer
        self.without_buckets = without_buckets
        self.creations = 0
        """The number of attempts to create a bucket, which is denied if it may have none."""
        self.lock = threading.Lock()
        """Makes the check and the put atomic, unless a race is intended."""
        self.forbid_head = False
        self.races: dict[str, threading.Barrier] = {}
        """Key -> this many creates of it find no object before any of them writes, and all write before any responds."""
        self.objects: dict[str, tuple[bytes, dict[str, str]]] = {}
        self.requests: list[str] = []
        """Methods, in order."""

    @property
    def url(self) -> str:
        return f'http://127.0.0.1:{self.server_port}'


class Handler(BaseHTTPRequestHandler):
    """Responds as S3 does."""

    """Answers as S3 does."""

    protocol_version = 'HTTP/1.1'
    server: FakeS3

    def do_PUT(self) -> None:
        body = self.rfile.read(int(self.headers.get('Content-Length') or 0))
        if self._told():
            return
        key = unquote(urlsplit(self.path).path)
        if self.server.without_buckets:
            creation = key.count('/') == 1
            self.server.creations += creation
            self._answer(*((403, error('AccessDenied')) if creation else (404, error('NoSuchBucket'))))
            return
        if self.headers.get('If-None-Match') and self.server.condition == 'not implemented':
            self._answer(501, error('NotImplemented', 'A header you provided implies functionality'))
            return
        kept = {name: value for name, value in self.headers.items() if name.lower().startswith(('x-amz-meta-', 'content-type'))}
        race = self.server.races.get(key) if key not in self.server.objects else None
        if race is not None:
            race.wait(60.0)
        with self.server.lock:
            is_refused = bool(self.headers.get('If-None-Match')) and self.server.condition == 'honoured'
            if is_refused and key in self.server.objects and race is None:
                self._answer(412, error('PreconditionFailed'))
                return
            self.server.objects[key] = (body, kept)
        if race is not None:
            race.wait(60.0)
        self._answer(200, b'', etag(body))

    def do_DELETE(self) -> None:
        self.server.objects.pop(unquote(urlsplit(self.path).path), None)
        self._answer(204, b'')

    def do_HEAD(self) -> None:
        if self.server.forbid_head:
            self._answer(403, b'')
            return
        self._content(b'')

    def do_GET(self) -> None:
        if self.path == '/' and not self.server.answer:
            self._answer(200, b'<?xml version="1.0"?><ListAllMyBucketsResult><Buckets/></ListAllMyBucketsResult>')
            return
        if self.server.forbid_head:
            self.server.requests.append('GET')
            self._answer(403, error('AccessDenied'))
            return
        self._content(None)

    def _content(self, instead: bytes | None) -> None:
        if self._told():
            return
        held = self.server.objects.get(unquote(urlsplit(self.path).path))
        if held is None:
            self._answer(404, error('NoSuchKey') if instead is None else b'')
            return
        body = held[0] if instead is None else instead
        self._answer(200, body, {**held[1], **etag(held[0])}, len(held[0]))

    def _told(self) -> bool:
        self.server.requests.append(self.command)
        if self.server.answer is None:
            return False
        self._answer(*self.server.answer)
        return True

    def _answer(self, status: int, body: bytes, headers: dict[str, str] | None = None, length: int | None = None) -> None:
        self.send_response(status)
        for name, value in (headers or {}).items():
            self.send_header(name, value)
        self.send_header('Content-Length', str(len(body) if length is None else length))
        self.end_headers()
        if self.command != 'HEAD':
            self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Quiet."""


def error(code: str, message: str = 'no') -> bytes:
    """The body of an S3 error."""
    return f'<?xml version="1.0"?><Error><Code>{code}</Code><Message>{message}</Message></Error>'.encode()


def etag(body: bytes) -> dict[str, str]:
    return {'ETag': f'"{hashlib.md5(body, usedforsecurity=False).hexdigest()}"'}


@contextmanager
def served(server: FakeS3) -> Iterator[FakeS3]:
    thread = threading.Thread(target=server.serve_forever, kwargs={'poll_interval': 0.01})
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@contextmanager
def hung() -> Iterator[str]:
    """A server that accepts connections and never responds."""
    with socket.create_server(('127.0.0.1', 0)) as listening:
        yield f'http://127.0.0.1:{listening.getsockname()[1]}'


@contextmanager
def refused() -> Iterator[str]:
    """A port without a listener that no other process can bind."""
    with socket.socket() as bound:
        bound.bind(('127.0.0.1', 0))
        yield f'http://127.0.0.1:{bound.getsockname()[1]}'


@contextmanager
def resetting(answer: bytes, *, reset: bool = True) -> Iterator[str]:
    """A server that resets, or just closes, every connection after the first bytes of a response."""
    listening = socket.create_server(('127.0.0.1', 0))

    def serve() -> None:
        while True:
            try:
                connection, _ = listening.accept()
            except OSError:
                return
            with connection, suppress(ConnectionError):  # the client may have given up
                connection.recv(65536)
                connection.sendall(answer)
                if reset:
                    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack('ii', 1, 0))

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield f'http://127.0.0.1:{listening.getsockname()[1]}'
    finally:
        listening.shutdown(socket.SHUT_RDWR)
        listening.close()
        thread.join()
