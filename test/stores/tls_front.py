"""TLS before a real S3 server, and a tap that writes down every byte a client sends."""

from __future__ import annotations

import socket
import ssl
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from typing_extensions import Self

CHUNK = 65536
HOST = '127.0.0.1'


class Relay:
    """Passes on what comes, decrypted where there is a ``context``; ``heard`` is what clients sent through it.

    New; enter once, leave once. A thread accepts, each connection has two more.
    """

    def __init__(self, port: int, context: ssl.SSLContext | None = None) -> None:
        self._to = port
        self._context = context
        self._listening = socket.create_server((HOST, 0))
        self._open: list[socket.socket] = []
        self._threads: list[threading.Thread] = []
        self.port: int = self._listening.getsockname()[1]
        self._heard: list[bytearray] = []

    @property
    def heard(self) -> bytes:
        return b''.join(self._heard)

    @property
    def heard_by_connection(self) -> list[bytes]:
        return [bytes(heard) for heard in self._heard if heard]

    @property
    def connections(self) -> int:
        return len(self._heard)

    def __enter__(self) -> Self:
        self._start(self._accept)
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):
            self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        self._threads[0].join()
        for one in self._open:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        for one in self._open:
            one.close()

    def _start(self, target: object, *arguments: object) -> None:
        thread = threading.Thread(target=target, args=arguments, daemon=True)  # type: ignore[arg-type]
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self._listening.accept()
                self._heard.append(bytearray())
                self._start(self._serve, client, self._heard[-1])

    def _serve(self, client: socket.socket, heard: bytearray) -> None:
        self._open.append(client)
        if self._context:
            try:
                client = self._context.wrap_socket(client, server_side=True)
            except OSError:  # the client did not believe it
                return
            self._open.append(client)
        server = socket.create_connection((HOST, self._to))
        self._open.append(server)
        self._start(self._pass, server, client, bytearray())
        self._pass(client, server, heard)

    def _pass(self, source: socket.socket, target: socket.socket, heard: bytearray) -> None:
        with suppress(OSError, ValueError):
            while data := source.recv(CHUNK):
                heard += data
                target.sendall(data)
        with suppress(OSError):
            target.shutdown(socket.SHUT_WR)


@dataclass(frozen=True)
class Secured:
    """An http server that is reached by ``url`` over TLS."""

    url: str
    wire: Relay
    """Heard what an eavesdropper hears."""
    inside: Relay
    """Heard the same decrypted."""
    context: ssl.SSLContext

    def renew(self, certificate: tuple[Path, Path]) -> None:
        """Another certificate, for connections that begin from now on."""
        self.context.load_cert_chain(*certificate)


@contextmanager
def behind_tls(url: str, certificate: tuple[Path, Path]) -> Iterator[Secured]:
    """TLS before the server at ``url``."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*certificate)
    port = urlsplit(url).port
    assert port
    with Relay(port, context) as front, Relay(front.port) as wire:
        yield Secured(f'https://{HOST}:{wire.port}', wire, front, context)
