"""Requests that are forwarded to the real server: unchanged, slower, without their condition, or with another date."""

from __future__ import annotations

import hashlib
import hmac
import http.client
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from typing import Final
from urllib.parse import urlsplit

_AUTHORIZATION: Final = re.compile(r'AWS4-HMAC-SHA256 Credential=([^,]+), ?SignedHeaders=([^,]+), ?Signature=([0-9a-f]+)')


def signed_again(method: str, target: str, headers: Mapping[str, str], secret: str) -> dict[str, str]:
    """The headers (names in lower case) with a valid signature; same key, scope and payload hash."""
    found = _AUTHORIZATION.fullmatch(headers['authorization'])
    assert found, headers['authorization']
    credential, names, _ = found.groups()
    key, *_, region, service, _ = credential.split('/')
    stamp = headers['x-amz-date']
    scope = f'{stamp[:8]}/{region}/{service}/aws4_request'
    signed = [name for name in names.split(';') if name in headers]
    url = urlsplit(target)
    query = '&'.join(sorted(part if '=' in part else f'{part}=' for part in url.query.split('&') if part))
    lines = [f'{name}:{" ".join(headers[name].split())}' for name in signed]
    canonical = '\n'.join([method, url.path, query, *lines, '', ';'.join(signed), headers['x-amz-content-sha256']])
    text = '\n'.join(['AWS4-HMAC-SHA256', stamp, scope, hashlib.sha256(canonical.encode()).hexdigest()])
    signing = f'AWS4{secret}'.encode()
    for part in (*scope.split('/'), text):
        signing = hmac.digest(signing, part.encode(), 'sha256')
    authorization = f'AWS4-HMAC-SHA256 Credential={key}/{scope}, SignedHeaders={";".join(signed)}, Signature={signing.hex()}'
    return {**headers, 'authorization': authorization}


TIMEOUT_S: Final = 30.0
OFF: Final = timedelta(minutes=20)
HOP: Final = frozenset({'connection', 'expect', 'keep-alive', 'transfer-encoding'})
"""Hop-by-hop headers; none of them is signed."""


@dataclass(frozen=True, slots=True)
class Request:
    """One received request; the names of its headers are in lower case."""

    method: str
    target: str
    headers: dict[str, str]
    body: bytes

    def without_condition(self, secret: str) -> Request:
        """As if the server did not support the header."""
        if 'if-none-match' not in self.headers:
            return self
        kept = {name: value for name, value in self.headers.items() if name != 'if-none-match'}
        return replace(self, headers=signed_again(self.method, self.target, kept, secret))

    def of_another_time(self, secret: str) -> Request:
        """As from a machine with a clock that is twenty minutes behind; unsigned requests are unchanged."""
        if 'authorization' not in self.headers:
            return self
        late = f'{datetime.now(timezone.utc) - OFF:%Y%m%dT%H%M%SZ}'
        return replace(self, headers=signed_again(self.method, self.target, {**self.headers, 'x-amz-date': late}, secret))


def ask(server: tuple[str, int], request: Request, pieces: Iterable[bytes]) -> tuple[int, bytes]:
    """Send it with these pieces as its body; returns the status, and the complete response as bytes."""
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
