"""TLS before a server, with certificates of an authority that is made for each run, and a tap of every byte that clients send."""

from __future__ import annotations

import datetime
import ipaddress
import socket
import ssl
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

if TYPE_CHECKING:
    from typing_extensions import Self

CHUNK = 65536
HOST = '127.0.0.1'
DAY = datetime.timedelta(days=1)
WRONG: dict[str, tuple[str, dict[str, Any], str, str]] = {
    'unknown': ('stranger', {}, 'is not trusted', '{bundle}'),
    'expired': ('authority', {'begins': -2 * DAY, 'ends': datetime.timedelta(hours=-1)}, 'has expired', 'renew it'),
    'early': ('authority', {'begins': datetime.timedelta(hours=1)}, 'is not valid yet', 'timedatectl'),
    'host': ('authority', {'host': '10.0.0.1'}, 'is for another name', '{address}'),
}
"""What can be wrong with a certificate: who signed it and how, words of the message, and of its remedy."""


class Authority:
    """``path`` is its certificate, for those who are to trust it."""

    def __init__(self, folder: Path, name: str = 'authority') -> None:
        self.path = folder / f'{name}.pem'
        self._folder = folder
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
        signed = (
            _certificate(self._name, self._name, self._key.public_key(), -DAY, DAY)
            .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
            .sign(self._key, hashes.SHA256())
        )
        self.path.write_bytes(signed.public_bytes(serialization.Encoding.PEM))

    def sign(self, name: str, host: str = HOST, *, begins: datetime.timedelta = -DAY,
             ends: datetime.timedelta = DAY) -> tuple[Path, Path]:  # fmt: skip
        """A server's certificate and its key; times are relative to now."""
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
        names = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address(host))])
        signed = (
            _certificate(subject, self._name, key.public_key(), begins, ends)
            .add_extension(names, critical=False)
            .sign(self._key, hashes.SHA256())
        )
        certificate = self._folder / f'{name}.crt'
        certificate.write_bytes(signed.public_bytes(serialization.Encoding.PEM))
        return certificate, self._write(name, key)

    def itself(self) -> tuple[Path, Path]:
        """Its own certificate and key, as if it were a server."""
        return self.path, self._write('itself', self._key)

    def _write(self, name: str, key: ec.EllipticCurvePrivateKey) -> Path:
        private = self._folder / f'{name}.key'
        private.write_bytes(key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        ))  # fmt: skip
        return private


def _certificate(subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, begins: datetime.timedelta,
                 ends: datetime.timedelta) -> x509.CertificateBuilder:  # fmt: skip
    now = datetime.datetime.now(datetime.timezone.utc)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now + begins)
        .not_valid_after(now + ends)
    )


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
        return [bytes(received) for received in self._heard if received]

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
