"""A client of a Tower without credentials: connects to ports and calls gRPC methods, in a separate process.

Reads its tasks from standard input, as JSON, and writes the results: ``{"connect": [[host, port]], "call": [[host, port,
method, request in hex]]}``. gRPC's threads and its handling of forks stay out of the tests' process that way.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

PATIENCE_S: Final = 5.0
REFLECTION: Final = '/grpc.reflection.v1.ServerReflection/ServerReflectionInfo'
"""Lists the services of a server: https://github.com/grpc/grpc/blob/master/doc/server-reflection.md."""
Call = tuple[str, int, str, bytes]
"""Host, port, method and request."""
Answer = tuple[str, bytes]
"""Status by name, and the first message."""


def ask(calls: Sequence[Call], namespace: str = '') -> list[Answer]:
    """The responses, in order; from another network namespace if given."""
    report = _run({'call': [[host, port, method, body.hex()] for host, port, method, body in calls]}, namespace)['call']
    return [(str(status), bytes.fromhex(message)) for status, message in report]


def reach(host: str, ports: Sequence[int], namespace: str = '') -> set[int]:
    """The ports that accept a connection."""
    report = _run({'connect': [[host, port] for port in ports]}, namespace)['connect']
    return {port for port, taken in zip(ports, report, strict=True) if taken}


def methods(host: str, port: int) -> list[str]:
    """All methods that a server offers, by reflection: ``/package.Service/Method``."""
    ((status, listed),) = ask([(host, port, REFLECTION, field(7, b''))])
    assert status == 'OK', status
    services = [dict(fields(service))[1] for _, service in fields(dict(fields(listed))[6])]
    described = ask([(host, port, REFLECTION, field(4, service)) for service in services])
    found = []
    for service, (_, answer) in zip(services, described, strict=True):
        for _, file in fields(dict(fields(answer))[4]):  # FileDescriptorProto of google/protobuf/descriptor.proto
            parts = list(fields(file))
            package = dict(parts).get(2, b'')
            for declared in (list(fields(part)) for number, part in parts if number == 6):
                if b'.'.join(filter(None, (package, dict(declared)[1]))) == service:
                    names = [dict(fields(part))[1] for number, part in declared if number == 2]
                    found += [f'/{service.decode()}/{name.decode()}' for name in names]
    return found


def field(number: int, content: bytes | int) -> bytes:
    """One field of a message in protobuf's encoding (https://protobuf.dev/programming-guides/encoding/)."""
    if isinstance(content, int):
        return _varint(number << 3) + _varint(content)
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def fields(message: bytes) -> Iterator[tuple[int, bytes]]:
    """Number and content of the fields that have a length."""
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            value |= (message[at] & 0x7F) << shift
            at, shift = at + 1, shift + 7
            if not message[at - 1] & 0x80:
                return value

    while at < len(message):
        key = varint()
        size = varint()
        if key & 7 == 2:
            at += size
            yield key >> 3, message[at - size : at]


def _varint(value: int) -> bytes:
    found = b''
    while value > 0x7F:
        found += bytes([value & 0x7F | 0x80])
        value >>= 7
    return found + bytes([value])


def _run(job: dict[str, object], namespace: str) -> dict[str, list[list[str]]]:
    command = [*(['ip', 'netns', 'exec', namespace] if namespace else []), sys.executable, str(Path(__file__).resolve())]
    done = subprocess.run(command, input=json.dumps(job), capture_output=True, text=True, check=False, timeout=240)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)  # type: ignore[no-any-return]


def _connects(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), PATIENCE_S).close()
    except OSError:
        return False
    return True


def _call(host: str, port: int, method: str, body: bytes) -> tuple[str, str]:
    import grpc

    with grpc.insecure_channel(f'{host}:{port}', [('grpc.enable_http_proxy', 0)]) as channel:
        answers = channel.stream_stream(method)(iter([body]), timeout=PATIENCE_S)  # on the wire a unary call is a stream of one
        try:
            return 'OK', next(iter(answers), b'').hex()
        except grpc.RpcError as error:
            return error.code().name, ''


def main() -> None:
    job = json.load(sys.stdin)
    sys.stdout.write(json.dumps({
        'connect': [_connects(*one) for one in job.get('connect', [])],
        'call': [_call(host, port, method, bytes.fromhex(body)) for host, port, method, body in job.get('call', [])],
    }))  # fmt: skip


if __name__ == '__main__':
    main()
