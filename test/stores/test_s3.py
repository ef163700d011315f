"""Faults between us and an S3 store, and its refusals: each is reported without a secret, and passes."""

from __future__ import annotations

import dataclasses
import hashlib
import re
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
from shadowhound_tower.embedded import Tower
from stores import fake_s3
from stores.asking import SECRET, error_of, settings_for
from stores.fake_s3 import FakeS3, served
from stores.spooled import QUICK, Spool, with_room

from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.core.errors import (
    AccessDenied,
    BucketMissing,
    CredentialsRejected,
    ObjectRefused,
    SettingError,
    StoreError,
    StoreUnavailable,
)
from shadowhound_data_logger.core.model import Put, SpooledObject
from shadowhound_data_logger.stores import open_store, s3_puts
from shadowhound_data_logger.stores.content import chunks
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
def test_a_server_without_an_answer_is_unavailable(fault: str, opened: Callable[..., S3Store], spool: Spool) -> None:
    """An unreachable Tower is StoreUnavailable, and the message gives the cause and the endpoint."""
    start, words = FAULTS[fault]
    with start() as url:
        store = opened(url, IMPATIENT if fault == 'hung' else QUICK)
        for ask in (lambda: store.put(spool('a', b'x')), store.probe, lambda: store.get('bucket', 'a')):
            report = error_of(StoreUnavailable, ask)
            assert words in report
            assert url in report


def test_an_unknown_host_is_unavailable(opened: Callable[..., S3Store], spool: Spool) -> None:
    """A host name that does not resolve is not an outage of the server."""
    report = error_of(StoreUnavailable, opened('http://tower.invalid:9000', IMPATIENT).probe)
    assert 'the name of the S3 server at http://tower.invalid:9000 cannot be resolved' in report


def test_every_wait_ends(opened: Callable[..., S3Store], spool: Spool) -> None:
    """A hung server costs the read timeout, not botocore's minute with retries."""
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
def test_an_invalid_answer_means_an_unavailable_store(answer: str, opened: Callable[..., S3Store], spool: Spool) -> None:
    """Only a response of an S3 server confirms a put or rejects an object."""
    status, body, kind, words = ANSWERS[answer]
    with served(FakeS3(answer=(status, body))) as server:
        store = opened(server.url)
        report = error_of(kind, lambda: store.put(spool('a', b'x')))
        assert words in report
        assert server.url in report
        error_of(kind, store.probe)


def test_the_store_recovers_automatically(opened: Callable[..., S3Store], spool: Spool) -> None:
    """When the fault ends the same store continues."""
    with served(FakeS3(answer=(503, fake_s3.error('SlowDown')))) as server:
        store = opened(server.url)
        error_of(StoreUnavailable, lambda: store.put(spool('a', b'x')))
        server.answer = None
        assert store.put(spool('a', b'x')) is Put.CREATED


def test_the_client_retries_nothing_itself(opened: Callable[..., S3Store]) -> None:
    """One call is one request, even if it fails."""
    with served(FakeS3(answer=(503, fake_s3.error('SlowDown')))) as server:
        error_of(StoreUnavailable, opened(server.url).probe)
        assert server.requests == ['GET']


@pytest.mark.seaweedfs
def test_a_large_object_is_streamed(
    opened: Callable[..., S3Store], spool: Spool, seaweed: Tower, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Above the limit the file is sent from the disk, with checksum, hash and condition as usual."""
    monkeypatch.setattr(s3_puts, 'STREAM_BYTES', 1000)
    store = opened(seaweed.store_settings())
    item = spool('large', b'0123456789' * 500_000)
    assert with_room(lambda: store.put(item)) is Put.CREATED
    assert hashlib.sha256(store.get(item.bucket, 'large')).hexdigest() == item.sha256
    assert store.put(item) is Put.IDENTICAL


@pytest.mark.seaweedfs
def test_the_server_verifies_the_checksum(seaweed: Tower, spool: Spool, bucket: str) -> None:
    """The server refuses a SHA-256 that differs from the content's; the put is retried, and nothing is left there."""
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


def test_https_to_a_plain_port_is_named(opened: Callable[..., S3Store]) -> None:
    """The error explains that the port has no TLS."""
    with served(FakeS3()) as server:
        report = error_of(StoreUnavailable, opened(server.url.replace('http:', 'https:')).probe)
    assert 'no TLS connection' in report


def test_a_name_and_a_password_in_the_url_are_not_sent(
    opened: Callable[..., S3Store], spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are not part of the host name, which is in each request in plain text; a path is part of every URL."""
    with served(FakeS3()) as server:
        asked: list[tuple[str, str]] = []
        handler = server.RequestHandlerClass
        report = handler._told  # type: ignore[attr-defined]

        def on_request(request: Any) -> bool:
            asked.append((request.headers['Host'], request.path.rpartition('/')[0].split('/')[1]))
            return bool(report(request))

        monkeypatch.setattr(handler, '_told', on_request)
        store = opened(f'{server.url.replace("://", "://name:password@")}/base')
        assert store.put(spool('a', b'x')) is Put.CREATED
        assert set(asked) == {(server.url.removeprefix('http://'), 'base')}


@pytest.mark.seaweedfs
def test_a_wrong_secret_rejects_the_credentials(opened: Callable[..., S3Store], seaweed: Tower, spool: Spool) -> None:
    """A wrong secret is distinguished from a wrong key id, by put, probe, head and get, and is not shown."""
    good = seaweed.store_settings()
    bad_secret = opened(dataclasses.replace(good, secret_access_key=SECRET))
    bad_key = opened(dataclasses.replace(good, access_key_id='NOBODY', secret_access_key=SECRET))
    for store, words in ((bad_secret, 'the secret key is wrong'), (bad_key, 'does not know the access key id')):
        assert words in error_of(CredentialsRejected, lambda s=store: s.put(spool('a', b'x')))  # type: ignore[misc]
        assert words in error_of(CredentialsRejected, store.probe)
        assert words in error_of(CredentialsRejected, lambda s=store: s.head('allowed', 'a'))  # type: ignore[misc]
        assert words in error_of(CredentialsRejected, lambda s=store: s.get('allowed', 'a'))  # type: ignore[misc]


def test_a_file_deleted_before_it_is_sent_is_reported(
    opened: Callable[..., S3Store], spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For example evicted at that moment: it is refused as gone, and only the store's errors are raised."""
    item = spool('a', bytes(s3_puts.STREAM_BYTES + 1))

    def gone(given: SpooledObject) -> Iterator[bytes]:
        yield from chunks(given)
        given.path.unlink()

    monkeypatch.setattr(s3_puts, 'chunks', gone)
    with served(FakeS3()) as server:
        store = opened(StoreSettings(endpoint_url=server.url, access_key_id='KEYID', secret_access_key=SECRET))
        assert 'it is missing' in error_of(ObjectRefused, lambda: store.put(item))


def test_without_credentials_the_variables_are_named(
    opened: Callable[..., S3Store], spool: Spool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The error has the names of the variables."""
    for name in ('AWS_ACCESS_KEY_ID', 'AWS_SECRET_ACCESS_KEY', 'AWS_PROFILE'):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv('AWS_SHARED_CREDENTIALS_FILE', str(tmp_path / 'none'))
    monkeypatch.setenv('AWS_CONFIG_FILE', str(tmp_path / 'none'))
    with served(FakeS3()) as server:
        store = opened(StoreSettings(endpoint_url=server.url))
        report = error_of(CredentialsRejected, lambda: store.put(spool('a', b'x')))
    assert 'AWS_ACCESS_KEY_ID' in report


def test_a_profile_of_the_shell_does_not_affect_given_credentials(
    opened: Callable[..., S3Store], spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An AWS_PROFILE that does not exist stops botocore, but not the store."""
    monkeypatch.setenv('AWS_PROFILE', 'not-there')
    with served(FakeS3()) as server:
        assert opened(server.url).put(spool('a', b'x')) is Put.CREATED


@pytest.mark.seaweedfs
def test_a_bucket_that_cannot_be_created_is_missing(
    opened: Callable[..., S3Store], seaweed: Tower, spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bucket, the endpoint and the remedy are named; once an administrator creates it, delivery continues immediately."""
    settings = seaweed.store_settings('limited')
    store = opened(settings)

    def put() -> Put:
        return store.put(spool('a', b'x', bucket='allowed'))

    report = error_of(BucketMissing, put, settings.secret_access_key or '')
    assert f'the bucket allowed does not exist at {seaweed.endpoint_url}' in report
    assert 's3 mb s3://allowed' in report
    opened(seaweed.store_settings()).put(spool('b', b'x', bucket='allowed'))
    assert put() is Put.CREATED


def test_a_rejected_bucket_is_probed_once(opened: Callable[..., S3Store], spool: Spool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Within the pause only the puts themselves are sent; after it the next one tries to create the bucket again."""
    with served(FakeS3(without_buckets=True)) as server:
        store = opened(server.url)
        for _ in range(3):
            report = error_of(BucketMissing, lambda: store.put(spool('a', b'x')))
            assert 'may not create it' in report
        assert server.creations == 1
        monkeypatch.setattr(s3_puts, 'BUCKET_PAUSE_S', 0.0)
        error_of(BucketMissing, lambda: store.put(spool('a', b'x')))
        assert server.creations == 2


@pytest.mark.seaweedfs
def test_denied_is_not_missing(opened: Callable[..., S3Store], seaweed: Tower, spool: Spool, bucket: str) -> None:
    """Valid credentials without the permission for this bucket are AccessDenied; the probe reports no problem with them."""
    opened(seaweed.store_settings()).put(spool('a', b'x'))
    store = opened(seaweed.store_settings('limited'))
    store.probe()
    report = error_of(AccessDenied, lambda: store.put(spool('b', b'x')))
    assert f'denies these credentials {bucket}/b' in report
    error_of(AccessDenied, lambda: store.head(bucket, 'a'))


@pytest.mark.seaweedfs
def test_a_key_that_is_a_folder_is_refused(opened: Callable[..., S3Store], seaweed: Tower, spool: Spool) -> None:
    """If a server cannot hold both ``a`` and ``a/b``, ``a`` is refused instead of being retried indefinitely."""
    store = opened(seaweed.store_settings())
    with_room(lambda: store.put(spool('a/b', b'x')))
    assert 'is a folder' in error_of(ObjectRefused, lambda: store.put(spool('a', b'x')))


@pytest.mark.seaweedfs
def test_an_invalid_bucket_name_is_refused(opened: Callable[..., S3Store], seaweed: Tower, spool: Spool) -> None:
    """Uppercase letters in a bucket's name are explained; its objects wait for a valid setting."""
    store = opened(seaweed.store_settings())
    assert 'lower-case' in error_of(BucketMissing, lambda: store.put(spool('a', b'x', bucket='Sensor-Data')))


@pytest.mark.parametrize(
    ('settings', 'name'),
    [
        (StoreSettings(endpoint_url='http://', access_key_id='k', secret_access_key=SECRET), 'AWS_ENDPOINT_URL'),
        (StoreSettings(endpoint_url='http://me:pw@:x', access_key_id='k', secret_access_key=SECRET), 'AWS_ENDPOINT_URL'),
        (StoreSettings(endpoint_url='http://127.0.0.1:1', access_key_id='k'), 'AWS_SECRET_ACCESS_KEY'),
        (StoreSettings(endpoint_url='http://127.0.0.1:1', secret_access_key=SECRET), 'AWS_ACCESS_KEY_ID'),
    ],
)
def test_settings_that_cannot_work_abort_startup(settings: StoreSettings, name: str) -> None:
    """The variable is named; a secret, even in the URL, is not shown."""
    with pytest.raises(SettingError) as caught:
        open_store(settings, QUICK)
    assert caught.value.data['name'] == name
    assert SECRET not in str(caught.value)
    assert 'pw' not in str(caught.value)


def test_nothing_shows_a_secret(opened: Callable[..., S3Store]) -> None:
    """Neither the description nor a repr contains the secret or credentials in the URL."""
    store = opened(settings_for('http://user:url-password@127.0.0.1:1'))
    text = store.describe() + repr(store) + repr(settings_for('http://127.0.0.1:1')) + error_of(StoreUnavailable, store.probe)
    assert not re.search('Secret|url-password', text)


def test_a_closed_store_raises(opened: Callable[..., S3Store], spool: Spool) -> None:
    """Use after close raises an error of the store, not an AttributeError."""
    store = opened('http://127.0.0.1:1')
    store.close()
    with pytest.raises(StoreUnavailable, match='not open'):
        store.put(spool('a', b'x'))
