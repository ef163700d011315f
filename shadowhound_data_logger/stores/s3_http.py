"""The requests that carry content, signed and on botocore's HTTP session: PUT of an object or of a part of one, and GET.

Without botocore's client: two thirds of a put's CPU were there, five sixths of a get's. What is sent leaves at the store's pace,
its SHA-256 (of a whole object known since it was spooled) is signed, and the server verifies its CRC32, of a part its MD5.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import socket
from collections.abc import Iterator, Mapping
from contextlib import suppress
from datetime import datetime, timezone
from typing import IO, Any, Final
from urllib.parse import quote, urlsplit

from botocore.awsrequest import (
    AWSConnection,
    AWSHTTPConnection,
    AWSHTTPConnectionPool,
    AWSHTTPSConnection,
    AWSHTTPSConnectionPool,
    AWSPreparedRequest,
)
from botocore.credentials import ReadOnlyCredentials
from botocore.exceptions import ClientError, ParamValidationError
from botocore.httpsession import URLLib3Session
from botocore.parsers import create_parser
from botocore.response import StreamingBody
from botocore.utils import get_environ_proxies

from shadowhound_data_logger.bandwidth import Body, Pace
from shadowhound_data_logger.config import StoreSettings, UploadSettings
from shadowhound_data_logger.model import SpooledObject
from shadowhound_data_logger.stores.content import Part
from shadowhound_data_logger.stores.credentials import Keys
from shadowhound_data_logger.stores.s3_metadata import to_headers

ALGORITHM: Final = 'AWS4-HMAC-SHA256'
AGENT: Final = 'shadowhound-data-logger'
UNASKED_BYTES: Final = 256 << 10
"""A body up to this size leaves without the server's leave (``Expect: 100-continue``, a round trip more).

A server that refuses a request reads so much of an unwanted body to keep the connection (net/http of Go, which MinIO and
SeaweedFS are built on: maxPostHandlerReadBytes); of a larger one nothing is sent in vain.
"""
UNSIGNED: Final = 'UNSIGNED-PAYLOAD'
"""Instead of a part's SHA-256: its MD5 is among the signed headers, and two hashes of each byte are enough."""
EMPTY: Final = hashlib.sha256().hexdigest()
"""Of the body of a GET."""
CS1: Final = 8 << 2
"""DSCP of background traffic (RFC 3662), in the byte where IP has it: what is live goes first, where the network cares."""
_SOCKET: Final = ((socket.IPPROTO_TCP, socket.TCP_NODELAY, 1), (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1))
"""What botocore's client sets for us as well."""

_open_session: Any = URLLib3Session
_prepared: Any = AWSPreparedRequest
_create_parser: Any = create_parser
_Awaiting: Any = AWSConnection
_HTTP: Any = AWSHTTPConnection
_HTTPS: Any = AWSHTTPSConnection
"""Their stubs know less than they take."""


def _background() -> tuple[tuple[int, int, int], ...]:
    """The option that marks a socket's traffic as background, where the system has it."""
    option = socket.IPPROTO_IP, socket.IP_TOS, CS1
    try:
        for family in (socket.AF_INET, socket.AF_INET6):
            with socket.socket(family, socket.SOCK_STREAM) as tried:
                tried.setsockopt(*option)
    except OSError:
        return ()
    return (option,)


class ContentRequests:
    """Sends signed requests with content, without botocore's client.

    Thread-safe. New; ask any number of times; close once. Raises what botocore's client would raise.

    In a forked process make a new one: two processes must not share its connections.
    """

    def __init__(self, keys: Keys, trust: str | bool, settings: StoreSettings, upload: UploadSettings, pace: Pace) -> None:
        url = urlsplit(settings.endpoint_url or '')
        self._host = url.netloc.rpartition('@')[2]  # a user name in the URL is not a host's
        self._server = f'{url.scheme}://{self._host}'
        self._root = url.path.rstrip('/')
        self._region = settings.region
        self._pace = pace
        self._keys = keys
        self._parser = _create_parser('rest-xml')
        self._session = _open_session(
            verify=trust, proxies=get_environ_proxies(self._server),
            timeout=(upload.connect_timeout_s, upload.read_timeout_s), max_pool_connections=max(10, upload.threads),
            socket_options=[*_SOCKET, *_background()],
        )  # fmt: skip
        getattr(self._session, '_pool_classes_by_scheme', {}).update(http=_Pool, https=_TLSPool)

    def close(self) -> None:
        self._session.close()

    def put(self, item: SpooledObject, body: bytes | Body, crc32: str, *, conditional: bool) -> Mapping[str, str]:
        """One request; ``crc32`` in base64. Returns the headers of an answer that is not an error."""
        return self._send(item, '', self._headers(item, crc32, conditional), item.sha256, self._pace.pieces(body, item.priority))

    def put_part(self, item: SpooledObject, upload: str, number: int, part: Part) -> Mapping[str, str]:
        """One request for one part of an upload; returns the headers of an answer that is not an error."""
        headers = {
            'host': self._host, 'content-length': str(part.size), 'content-md5': base64.b64encode(part.md5).decode('ascii'),
        }  # fmt: skip
        query = f'partNumber={number}&uploadId={quote(upload, safe="")}'
        return self._send(item, query, headers, UNSIGNED, self._pace.pieces(part, item.priority, stands_back=True))

    def get(
        self, bucket: str, key: str, wanted: str = '', unless: str = '', version: str = ''
    ) -> tuple[Mapping[str, str], StreamingBody]:
        """One request, of all bytes or of a range (``bytes=0-9``): the headers of a successful answer, and a body to close.

        ``unless`` is an ETag: the answer of an object that has it is an error, 304. So is 412, of one that has another ETag than
        ``version``.
        """
        target = f'{self._root}/{bucket}/{quote(key)}'
        headers = self._signed('GET', target, {'host': self._host}, EMPTY)
        sent = {**headers, 'user-agent': AGENT, 'accept-encoding': 'identity', **({'range': wanted} if wanted else {}),
                **({'if-none-match': unless} if unless else {}), **({'if-match': version} if version else {})}  # fmt: skip
        answer = self._session.send(_prepared('GET', f'{self._server}{target}', sent, None, stream_output=True))
        if answer.status_code >= 300:
            raise self._error(answer, 'GetObject')
        return answer.headers, StreamingBody(answer.raw, answer.headers.get('content-length'))

    def _signed(self, method: str, target: str, headers: Mapping[str, str], sha256: str) -> dict[str, str]:
        return signed(method, target, headers, sha256, now=datetime.now(timezone.utc),
                      credentials=self._keys.get_frozen_credentials(), region=self._region)  # fmt: skip

    def _error(self, answer: Any, operation: str) -> ClientError:
        response = {'status_code': answer.status_code, 'headers': answer.headers, 'body': answer.content}
        return ClientError(self._parser.parse(response, None), operation)

    def _send(self, item: SpooledObject, query: str, headers: Mapping[str, str], sha256: str,
              pieces: Iterator[bytes]) -> Mapping[str, str]:  # fmt: skip
        target = f'{self._root}/{item.bucket}/{quote(item.key)}{"?" if query else ""}{query}'
        sent: dict[str, Any] = {**self._signed('PUT', target, headers, sha256), 'user-agent': AGENT}
        if int(headers['content-length']) > UNASKED_BYTES:
            sent['Expect'] = b'100-continue'  # botocore's connection looks for exactly this
        answer = self._session.send(_prepared('PUT', f'{self._server}{target}', sent, pieces, stream_output=False))
        if answer.status_code >= 300:
            raise self._error(answer, 'UploadPart' if query else 'PutObject')
        fields: Mapping[str, str] = answer.headers
        return fields

    def _headers(self, item: SpooledObject, crc32: str, conditional: bool) -> dict[str, str]:
        """Names in lower case."""
        headers = {
            'host': self._host, 'content-length': str(item.size), 'content-type': item.content_type,
            'x-amz-checksum-crc32': crc32,
            **{f'x-amz-meta-{name}': value for name, value in to_headers(item).items()},
        }  # fmt: skip
        if conditional:
            headers['if-none-match'] = '*'
        for name, value in headers.items():
            if not (value.isascii() and value.isprintable()):
                raise ParamValidationError(report=f'{name} is not printable ASCII')
        return headers


class _Sending(_Awaiting):  # type: ignore[misc]
    """Sends a request whose headers were made here in as few steps as that takes."""

    _head = b''
    """Of a request that has a body: it leaves with the first piece of that."""
    _is_head_kept = False

    def _new_conn(self) -> socket.socket:
        """Only now it is known whether it is one of IPv6, which has the mark elsewhere."""
        connection: socket.socket = super()._new_conn()
        if connection.family == socket.AF_INET6:
            with suppress(OSError):
                connection.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_TCLASS, CS1)
        return connection

    def request(self, method: str, url: str, body: Any = None, headers: Any = None, *args: Any, **kwargs: Any) -> None:
        sent = headers or {}
        self._is_head_kept = body is not None and 'Expect' not in sent and sent.get('content-length', '0') != '0'
        self._head = b''
        super().request(method, url, body, headers, *args, **kwargs)

    def putheader(self, name: str, *values: str | bytes) -> None:
        """Printable ASCII ends no line: it needs none of the looks that urllib3 and http.client take at each header."""
        value = values[0]
        if len(values) == 1 and isinstance(value, str) and ':' not in name:
            line = f'{name}: {value}'
            if line.isascii() and line.isprintable():
                self._buffer.append(line.encode('ascii'))
                return
        super().putheader(name, *values)

    def _consume_headers(self, fp: IO[bytes]) -> None:
        """What may follow ``100 Continue``; botocore's own reads forever where the connection ends there."""
        while fp.readline().strip():
            pass

    def _send_output(self, message_body: Any = None, *args: Any, **kwargs: Any) -> None:
        """Once refused, botocore sends nothing of the body, but asks for each piece, which waits for its time under the cap.

        urllib3 takes this error for what it says, and reads the answer.
        """
        if self._is_head_kept and message_body is None:
            self._head = b'\r\n'.join((*self._buffer, b'', b''))
            self._buffer.clear()
            return
        super()._send_output(message_body, *args, **kwargs)
        if self._response_received:
            raise BrokenPipeError

    def send(self, data: bytes) -> None:
        head, self._head = self._head, b''
        super().send(head + data)


class _Connection(_Sending, _HTTP):  # type: ignore[misc]
    pass


class _TLSConnection(_Sending, _HTTPS):  # type: ignore[misc]
    pass


class _Pool(AWSHTTPConnectionPool):
    ConnectionCls = _Connection


class _TLSPool(AWSHTTPSConnectionPool):
    ConnectionCls = _TLSConnection


def signed(method: str, target: str, headers: Mapping[str, str], sha256: str, *, credentials: ReadOnlyCredentials, region: str,
           now: datetime) -> dict[str, str]:  # fmt: skip
    """The headers with a signature over all of them (AWS Signature Version 4); ``host`` has to be among them.

    https://docs.aws.amazon.com/AmazonS3/latest/API/sig-v4-header-based-auth.html. botocore's own signer gives the same (a test
    holds the two against each other) and takes several times the CPU: the robot signs each object that leaves it.

    ``target`` is percent-encoded, as it stands in the request line, its query (if any) by the names in order; ``headers`` have
    lower-case names; ``sha256`` is the body's, in hex; ``now`` is UTC.
    """
    stamp = now.strftime('%Y%m%dT%H%M%SZ')
    full = {**headers, 'x-amz-date': stamp, 'x-amz-content-sha256': sha256}
    if credentials.token:
        full['x-amz-security-token'] = credentials.token
    names = sorted(full)
    lines = [f'{name}:{" ".join(full[name].split())}' for name in names]
    which = ';'.join(names)
    path, _, query = target.partition('?')
    canonical = '\n'.join([method, path, query, *lines, '', which, sha256])
    scope = f'{stamp[:8]}/{region}/s3/aws4_request'
    text = '\n'.join([ALGORITHM, stamp, scope, hashlib.sha256(canonical.encode()).hexdigest()])
    key = f'AWS4{credentials.secret_key}'.encode()
    for part in (*scope.split('/'), text):
        key = hmac.digest(key, part.encode(), 'sha256')
    credential = f'{credentials.access_key}/{scope}'
    return {**full, 'authorization': f'{ALGORITHM} Credential={credential}, SignedHeaders={which}, Signature={key.hex()}'}
