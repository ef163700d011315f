"""SeaweedFS's own servers beside S3, which serve everybody unless they have keys: whether one answers us without keys.

Each is asked one question that changes nothing. Only an answer carries data: gRPC refuses with headers alone
(https://github.com/grpc/grpc/blob/master/doc/PROTOCOL-HTTP2.md), so nothing of what comes back has to be decoded.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Final, NamedTuple

from shadowhound_data_logger.doctor import services
from shadowhound_data_logger.doctor.model import Context, Result, Role, ok, skipped, warning

NAME: Final = 'seaweedfs'
GRPC: Final = 10_000
"""A server of SeaweedFS has its gRPC port this far above that of HTTP."""
S3_PORT: Final = 9000
"""Of a Tower; ``make tower --offset`` moves all ports by the same."""
ANSWER_S: Final = 1.5
"""For a connection, and for all of the answer: a firewall gives neither."""
LOOPBACK: Final = '127.0.0.1'
PREFACE: Final = b'PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n'
DATA, HEADERS, RST_STREAM, SETTINGS, GOAWAY = 0, 1, 3, 4, 7
END_STREAM, END_HEADERS = 1, 4
"""Types and flags of frames: RFC 9113, section 6."""
MOST_BYTES: Final = 1 << 14
"""The largest frame that a server may send unasked (RFC 9113, 4.2)."""


class Question(NamedTuple):
    """A gRPC question to one of SeaweedFS's servers, without keys."""

    server: str
    port: int
    method: str


S3: Final = Question('S3', S3_PORT + GRPC, '/messaging_pb.SeaweedS3IamCache/ListPolicies')
OTHERS: Final = (
    Question('filer', 18888, '/filer_pb.SeaweedFiler/GetFilerConfiguration'),
    Question('master', 19333, '/master_pb.Seaweed/GetMasterConfiguration'),
    Question('volume server', 18080, '/volume_server_pb.VolumeServer/VolumeServerStatus'),
)


def check(context: Context) -> Iterator[Result]:
    """See the module."""
    service = services.s3(context)
    if service is None:
        return
    if failed := context.failed('network.s3'):
        yield skipped(NAME, failed)
        return
    hosts = [service.host, *([LOOPBACK] if context.role is Role.TOWER and not service.is_local else [])]
    asked = [(host, question) for host in hosts for question in questions(service.port)]
    with ThreadPoolExecutor(len(asked)) as pool:
        answered = pool.map(lambda one: answers_anybody(one[0], one[1].port, one[1].method), asked)
        found = [one for one, is_open in zip(asked, answered, strict=True) if is_open]
    if found:
        where = ', '.join(f'{host}:{question.port} ({question.server})' for host, question in found)
        yield warning(
            'seaweedfs.open',
            f'SeaweedFS serves everybody at {where}',
            'it was started without the keys and the certificate of its own servers: anyone who can reach one of these can '
            'become an administrator, and read or delete what is stored',
            'on Tower: make tower-secrets, and start the servers again (docs/tower.md)',
            ports=[question.port for _, question in found],
        )
    else:
        yield ok(NAME, 'except S3, no port of SeaweedFS answers without a key')


def questions(s3_port: int) -> list[Question]:
    """For the servers behind an S3 port: at SeaweedFS's own ports, and where ``make tower --offset`` puts them."""
    offsets = {0, max(0, s3_port - S3_PORT)}
    return [S3._replace(port=s3_port + GRPC)] + [
        question._replace(port=question.port + offset) for offset in sorted(offsets) for question in OTHERS
    ]


def answers_anybody(host: str, port: int, method: str) -> bool:
    """Whether a gRPC server answers a call without encryption, certificate and token. False where nothing listens."""
    if port > 0xFFFF:
        return False
    text = b'\x83\x86' + b''.join((  # POST and http of the static table of RFC 7541; then literals, none longer than 127
        _literal(b'\x04', method), _literal(b'\x01', 'seaweedfs'),
        _literal(b'\x00\x0ccontent-type', 'application/grpc'), _literal(b'\x00\x02te', 'trailers'),
    ))  # fmt: skip
    call = _frame(SETTINGS, 0, 0, b'') + _frame(HEADERS, END_HEADERS, 1, text) + _frame(DATA, END_STREAM, 1, bytes(5))
    end = time.monotonic() + ANSWER_S
    try:
        with socket.create_connection((host, port), timeout=ANSWER_S) as connection, connection.makefile('rb') as answer:
            connection.sendall(PREFACE + call)
            while time.monotonic() < end and len(head := answer.read(9)) == 9:
                size, kind, flags = int.from_bytes(head[:3], 'big'), head[3], head[4]
                is_over = kind in {RST_STREAM, GOAWAY} or (kind == HEADERS and flags & END_STREAM)
                if is_over or size > MOST_BYTES:  # refused, or no HTTP/2
                    return False
                if kind == DATA:
                    return size > 0
                answer.read(size)
    except OSError:
        pass
    return False


def _literal(name: bytes, value: str) -> bytes:
    return name + bytes([len(value)]) + value.encode()


def _frame(kind: int, flags: int, stream: int, content: bytes) -> bytes:
    return len(content).to_bytes(3, 'big') + bytes([kind, flags]) + stream.to_bytes(4, 'big') + content
