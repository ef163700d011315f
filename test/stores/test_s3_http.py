"""What one request is on the wire."""

from __future__ import annotations

import os
import socket
import struct
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest
from stores.fake_s3 import FakeS3, served
from stores.spooled import Spool

from shadowhound_data_logger.stores.s3 import S3Store
from shadowhound_data_logger.stores.s3_http import CS1, _Connection


class _Socket:
    """Notes what is sent, piece by piece."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []

    def settimeout(self, _: object) -> None:
        """It never waits."""

    def sendall(self, data: bytes) -> None:
        self.sent.append(data)

    def close(self) -> None:
        """It holds nothing."""


@pytest.fixture
def wire() -> tuple[Any, list[bytes]]:
    """A connection that is open, and what it sends."""
    connection: Any = _Connection('tower', 9000)
    connection.sock = held = _Socket()
    return connection, held.sent


def test_the_head_leaves_with_the_first_piece_of_the_body(wire: tuple[Any, list[bytes]]) -> None:
    """One packet, and one wake of the server, less for each object."""
    connection, sent = wire
    headers = {'host': 'tower:9000', 'content-length': '6', 'user-agent': 'me', 'x-amz-meta-sensor': 'imu'}
    connection.request('PUT', '/b/k', body=iter([b'one', b'two']), headers=headers)
    head, _, first = sent[0].partition(b'\r\n\r\n')
    assert head.split(b'\r\n') == [
        b'PUT /b/k HTTP/1.1', b'Accept-Encoding: identity', b'host: tower:9000', b'content-length: 6', b'user-agent: me',
        b'x-amz-meta-sensor: imu',
    ]  # fmt: skip
    assert (first, sent[1:]) == (b'one', [b'two'])


@pytest.mark.parametrize(('method', 'body', 'length'), [('GET', None, None), ('PUT', iter(()), '0')])
def test_a_request_without_a_body_leaves_at_once(
    wire: tuple[Any, list[bytes]], method: str, body: Any, length: str | None
) -> None:
    """Nothing comes that its head could wait for."""
    connection, sent = wire
    connection.request(method, '/b/k', body=body, headers={'host': 'tower', **({'content-length': length} if length else {})})
    assert len(sent) == 1
    assert sent[0].endswith(b'\r\n\r\n')


@pytest.mark.parametrize(('name', 'value'), [('range', 'bytes=0-9\r\nhost: other'), ('x:y', 'z'), ('x\ny', 'z')])
def test_no_header_can_bring_another_one(wire: tuple[Any, list[bytes]], name: str, value: str) -> None:
    """A line break in what a server or a setting said is refused before anything is sent."""
    connection, sent = wire
    with pytest.raises(ValueError, match='Invalid header'):
        connection.request('GET', '/b/k', headers={'host': 'tower', name: value})
    assert not sent


def test_botocore_brings_no_pyopenssl() -> None:
    """Which it loads where the live page's extra has brought it, and does without as well."""
    pytest.importorskip('OpenSSL')
    program = (
        'import sys\n'
        'from shadowhound_data_logger.options import StoreSettings, UploadSettings\n'
        'from shadowhound_data_logger.stores import open_store\n'
        "open_store(StoreSettings(endpoint_url='http://127.0.0.1:9'), UploadSettings()).close()\n"
        "print('botocore.httpsession' in sys.modules, 'cryptography' in sys.modules)\n"
        'import OpenSSL.SSL\n'
    )
    environ = {**os.environ, 'AWS_ACCESS_KEY_ID': 'key', 'AWS_SECRET_ACCESS_KEY': 'secret'}
    done = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, env=environ, check=False)
    assert (done.stdout.split(), done.returncode) == (['True', 'False'], 0), done.stderr


IP_PKTOPTIONS = 9
"""linux/in.h: what was asked about a connection's packets, as it was when the connection opened."""


def test_uploads_are_marked_as_background(bucket: str, spool: Spool, opened: Callable[..., S3Store]) -> None:
    """On the wire, as the server gets them (DSCP CS1), over IPv4."""
    marks: dict[str, int] = {}
    server = FakeS3()

    class Handler(server.RequestHandlerClass):  # type: ignore[misc,name-defined]
        def do_PUT(self) -> None:  # noqa: N802 - as http.server has it
            said = self.connection.getsockopt(socket.IPPROTO_IP, IP_PKTOPTIONS, 100)
            (marks[self.path],) = struct.unpack_from('i', said, socket.CMSG_LEN(0))
            super().do_PUT()

    server.RequestHandlerClass = Handler
    server.socket.setsockopt(socket.IPPROTO_IP, socket.IP_RECVTOS, 1)
    with served(server):
        opened(server.url).put(spool('robot/imu/one.json', b'one'))
    assert marks[f'/{bucket}/robot/imu/one.json'] == CS1


def test_uploads_over_ipv6_are_marked_as_well() -> None:
    """The option is another one there."""
    try:
        listener = socket.create_server(('::1', 0), family=socket.AF_INET6)
    except OSError as error:
        pytest.skip(f'no IPv6 here: {error}')
    with listener:
        connection: Any = _Connection('::1', listener.getsockname()[1])
        connection.connect()
        assert connection.sock.getsockopt(socket.IPPROTO_IPV6, socket.IPV6_TCLASS) == CS1
        connection.close()
