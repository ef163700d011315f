"""Requests that go on to the real server: as they came, slower, without their condition, or of another time."""

from __future__ import annotations

import http.client
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from typing import Final

from faults.signing import signed_again

TIMEOUT_S: Final = 30.0
OFF: Final = timedelta(minutes=20)
HOP: Final = frozenset({'connection', 'expect', 'keep-alive', 'transfer-encoding'})
"""Headers that concern two neighbors only; none of them is signed."""


@dataclass(frozen=True, slots=True)
class Request:
    """One request as it came; the names of its headers are in lower case."""

    method: str
    target: str
    headers: dict[str, str]
    body: bytes

    def without_condition(self, secret: str) -> Request:
        """As if the server did not know the header."""
        if 'if-none-match' not in self.headers:
            return self
        kept = {name: value for name, value in self.headers.items() if name != 'if-none-match'}
        return replace(self, headers=signed_again(self.method, self.target, kept, secret))

    def of_another_time(self, secret: str) -> Request:
        """As a machine sends it whose clock is twenty minutes late; what nobody signed is as it was."""
        if 'authorization' not in self.headers:
            return self
        late = f'{datetime.now(timezone.utc) - OFF:%Y%m%dT%H%M%SZ}'
        return replace(self, headers=signed_again(self.method, self.target, {**self.headers, 'x-amz-date': late}, secret))


def ask(server: tuple[str, int], request: Request, pieces: Iterable[bytes]) -> tuple[int, bytes]:
    """Send it, its body in these pieces; returns the status, and the whole answer as it goes over a wire."""
    connection = http.client.HTTPConnection(*server, timeout=TIMEOUT_S)
    try:
        connection.putrequest(request.method, request.target, skip_host=True, skip_accept_encoding=True)
        for name, value in request.headers.items():
            if name not in HOP:
                connection.putheader(name, value)
        connection.endheaders()
        for piece in pieces:
            connection.send(piece)
        answer = connection.getresponse()
        return answer.status, b''.join(_lines(answer))
    finally:
        connection.close()


def _lines(answer: http.client.HTTPResponse) -> Iterator[bytes]:
    content = answer.read()
    yield f'HTTP/1.1 {answer.status} {answer.reason}\r\n'.encode()
    names = set()
    for name, value in answer.getheaders():
        if name.lower() not in HOP:
            names.add(name.lower())
            yield f'{name}: {value}\r\n'.encode('latin-1')
    if 'content-length' not in names:
        yield f'Content-Length: {len(content)}\r\n'.encode()
    yield b'\r\n' + content
