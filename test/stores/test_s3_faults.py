"""What stands between us and an S3 store: no answer, a wrong one, damage on the way. Each is told, and passes."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import pytest
from shadowhound_tower.embedded import Tower
from stores import fake_s3
from stores.asking import error_of
from stores.fake_s3 import FakeS3, served
from stores.spooled import QUICK, Spool, with_room

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import StoreError, StoreUnavailable
from shadowhound_data_logger.core.model import Put
from shadowhound_data_logger.stores import s3_puts
from shadowhound_data_logger.stores.s3 import S3Store
from shadowhound_data_logger.stores.s3_client import S3Client
from shadowhound_data_logger.stores.s3_requests import S3Requests, Sent

IMPATIENT = UploadSettings(connect_timeout_s=1.0, read_timeout_s=0.3)


Faulty = Callable[[], AbstractContextManager[str]]
FAULTS: dict[str, tuple[Faulty, str]] = {
    'refused': (fake_s3.refused, 'refused the connection'),
    'hung': (fake_s3.hung, 'gave no answer within 0.3 s'),
    'reset before the answer': (lambda: fake_s3.resetting(b''), 'closed the connection'),
    'reset in the answer': (lambda: fake_s3.resetting(b'HTTP/1.1 200 OK\r\nContent-Le'), 'closed the connection'),
    'reset in the body': (lambda: fake_s3.resetting(b'HTTP/1.1 200 OK\r\nContent-Length: 1\r\nETag: x\r\n\r\n'), 'closed the'),
    'reset in an error': (lambda: fake_s3.resetting(b'HTTP/1.1 500 No\r\nContent-Length: 9\r\n\r\n<Error>'), 'closed the'),
}


@pytest.mark.parametrize('fault', FAULTS)
def test_no_answer(fault: str, opened: Callable[..., S3Store], spool: Spool) -> None:
    """A Tower that is away is StoreUnavailable, and the message tells its kinds apart and names the endpoint."""
    start, words = FAULTS[fault]
    with start() as url:
        store = opened(url, IMPATIENT if fault == 'hung' else QUICK)
        for ask in (lambda: store.put(spool('a', b'x')), store.probe, lambda: store.get('bucket', 'a')):
            said = error_of(StoreUnavailable, ask)
            assert words in said
            assert url in said


def test_an_unknown_name(opened: Callable[..., S3Store], spool: Spool) -> None:
    """A host name that does not resolve is not an outage of the server."""
    said = error_of(StoreUnavailable, opened('http://tower.invalid:9000', IMPATIENT).probe)
    assert 'the name of the S3 server at http://tower.invalid:9000 cannot be resolved' in said


def test_every_wait_ends(opened: Callable[..., S3Store], spool: Spool) -> None:
    """A hung server costs the read timeout, not botocore's minute and its retries."""
    with fake_s3.hung() as url:
        store = opened(url, IMPATIENT)
        begin = time.monotonic()
        error_of(StoreUnavailable, lambda: store.put(spool('a', b'x')))
        assert time.monotonic() - begin < 50.0


ANSWERS: dict[str, tuple[int, bytes, type[StoreError], str]] = {
    'slow down': (503, fake_s3.error('SlowDown'), StoreUnavailable, 'is overloaded (503 SlowDown)'),
    'internal error': (500, fake_s3.error('InternalError'), StoreUnavailable, 'a server error (500 InternalError)'),
    'bad gateway': (502, b'<html>nginx</html>', StoreUnavailable, 'a server error (502'),
    'disk full': (507, fake_s3.error('XMinioStorageFull'), StoreUnavailable, 'the disk of the S3 server'),
    'clock': (403, fake_s3.error('RequestTimeTooSkewed'), StoreUnavailable, 'set the clock'),
    'another web server': (404, b'<html>Not found</html>', StoreUnavailable, 'does not answer like an S3 server'),
    'a login page': (200, b'<html>Welcome to our WiFi</html>', StoreUnavailable, 'does not answer like an S3 server'),
    'a redirect to a login page': (302, b'', StoreUnavailable, 'does not answer like an S3 server'),
    'plain HTTP to a TLS port': (400, b'Client sent an HTTP request to an HTTPS server.', StoreUnavailable, 'like an S3 server'),
}


@pytest.mark.parametrize('answer', ANSWERS)
def test_bad_answers(answer: str, opened: Callable[..., S3Store], spool: Spool) -> None:
    """No answer but an S3 server's own confirms a put or condemns an object."""
    status, body, kind, words = ANSWERS[answer]
    with served(FakeS3(answer=(status, body))) as server:
        store = opened(server.url)
        said = error_of(kind, lambda: store.put(spool('a', b'x')))
        assert words in said
        assert server.url in said
        error_of(kind, store.probe)


def test_the_store_recovers_automatically(opened: Callable[..., S3Store], spool: Spool) -> None:
    """When the cause is gone the same store goes on."""
    with served(FakeS3(answer=(503, fake_s3.error('SlowDown')))) as server:
        store = opened(server.url)
        error_of(StoreUnavailable, lambda: store.put(spool('a', b'x')))
        server.answer = None
        assert store.put(spool('a', b'x')) is Put.CREATED


def test_nothing_is_retried_behind_the_back_of_delivery(opened: Callable[..., S3Store]) -> None:
    """One request is one request, also when it fails."""
    with served(FakeS3(answer=(503, fake_s3.error('SlowDown')))) as server:
        error_of(StoreUnavailable, opened(server.url).probe)
        assert server.requests == ['GET']


@pytest.mark.seaweedfs
def test_a_large_object_is_streamed(
    opened: Callable[..., S3Store], spool: Spool, seaweed: Tower, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beyond the limit the file is sent from the disk, with checksum, hash and condition as ever."""
    monkeypatch.setattr(s3_puts, 'STREAM_BYTES', 1000)
    store = opened(seaweed.store_settings())
    item = spool('large', b'0123456789' * 500_000)
    assert with_room(lambda: store.put(item)) is Put.CREATED
    assert hashlib.sha256(store.get(item.bucket, 'large')).hexdigest() == item.sha256
    assert store.put(item) is Put.IDENTICAL


@pytest.mark.seaweedfs
def test_the_server_verifies_the_checksum(seaweed: Tower, spool: Spool, bucket: str) -> None:
    """A SHA-256 that is not the content's is refused by the server, is a reason to send again, and leaves nothing there."""
    client = S3Client(seaweed.store_settings(), QUICK)
    client.open()
    requests = S3Requests(client)
    requests.create_bucket(bucket)
    with_room(lambda: requests.put(spool('first', b'first'), b'first', conditional=True))
    item = spool('a', b'content')
    message = error_of(StoreUnavailable, lambda: requests.put(item, b'CONTENT', conditional=True))
    assert 'damaged in transit' in message
    assert requests.head(bucket, 'a') is None
    assert requests.put(item, b'content', conditional=True) is Sent.CREATED
    client.close()


def test_https_to_a_plain_port(opened: Callable[..., S3Store]) -> None:
    """TLS where there is none is explained."""
    with served(FakeS3()) as server:
        said = error_of(StoreUnavailable, opened(server.url.replace('http:', 'https:')).probe)
    assert 'no TLS connection' in said


def test_a_name_and_a_password_in_the_url_are_not_sent(
    opened: Callable[..., S3Store], spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are none of the host's name, which stands in each request for all to read; a path is part of every one."""
    with served(FakeS3()) as server:
        asked: list[tuple[str, str]] = []
        handler = server.RequestHandlerClass
        told = handler._told  # type: ignore[attr-defined]

        def tells(request: Any) -> bool:
            asked.append((request.headers['Host'], request.path.rpartition('/')[0].split('/')[1]))
            return bool(told(request))

        monkeypatch.setattr(handler, '_told', tells)
        store = opened(f'{server.url.replace("://", "://name:password@")}/base')
        assert store.put(spool('a', b'x')) is Put.CREATED
        assert set(asked) == {(server.url.removeprefix('http://'), 'base')}
