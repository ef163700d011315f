"""What an S3 store says when something is wrong, what that means for delivery, and that it never shows a secret."""

from __future__ import annotations

import base64
import dataclasses
import datetime
import hashlib
import ipaddress
import logging
import re
import time
import traceback
import zlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from stores import fake_s3
from stores.fake_s3 import FakeS3, served
from stores.spooled import QUICK, Spool

from shadowhound_data_logger.config import StoreSettings, UploadSettings
from shadowhound_data_logger.errors import (
    AccessDenied,
    BucketMissing,
    CredentialsRejected,
    DataLoggerError,
    ForeignObject,
    ObjectRefused,
    SettingError,
    StoreError,
    StoreUnavailable,
)
from shadowhound_data_logger.model import Put
from shadowhound_data_logger.sim.tower import Tower
from shadowhound_data_logger.stores import open_store, s3
from shadowhound_data_logger.stores.s3 import S3Store
from shadowhound_data_logger.stores.s3_requests import S3Requests, Sent

SECRET = 'a-Secret-that-nobody-may-see'
IMPATIENT = UploadSettings(connect_timeout_s=1.0, read_timeout_s=0.3)


def _settings(url: str) -> StoreSettings:
    return StoreSettings(endpoint_url=url, access_key_id='KEYID', secret_access_key=SECRET)


@pytest.fixture
def opened() -> Iterator[Callable[..., S3Store]]:
    """Opens stores and closes them afterwards."""
    stores: list[S3Store] = []

    def make(settings: StoreSettings | str, upload: UploadSettings = QUICK) -> S3Store:
        stores.append(S3Store(_settings(settings) if isinstance(settings, str) else settings, upload))
        stores[-1].open()
        return stores[-1]

    yield make
    for store in stores:
        store.close()


def _error(kind: type[DataLoggerError], ask: Callable[[], object], secret: str = SECRET) -> str:
    """The error's sentence, once it is certain that nothing of it holds the secret."""
    with pytest.raises(kind) as caught:
        ask()
    assert type(caught.value) is kind
    whole = ''.join(traceback.format_exception(caught.value)) + repr(caught.value) + repr(caught.value.data)
    assert secret not in whole
    assert caught.value.remedy or kind is ObjectRefused
    return str(caught.value)


Faulty = Callable[[], AbstractContextManager[str]]
FAULTS: dict[str, tuple[Faulty, str]] = {
    'refused': (fake_s3.refused, 'refused the connection'),
    'hung': (fake_s3.hung, 'gave no answer within 0.3 s'),
    'reset before the answer': (lambda: fake_s3.resetting(b''), 'broke the connection off'),
    'reset in the answer': (lambda: fake_s3.resetting(b'HTTP/1.1 200 OK\r\nContent-Le'), 'broke the connection off'),
    'reset in the body': (lambda: fake_s3.resetting(b'HTTP/1.1 200 OK\r\nContent-Length: 1\r\nETag: x\r\n\r\n'), 'broke the'),
}


@pytest.mark.parametrize('fault', FAULTS)
def test_no_answer(fault: str, opened: Callable[..., S3Store], spool: Spool) -> None:
    """A Tower that is away is StoreUnavailable, and the message tells its kinds apart and names the endpoint."""
    start, words = FAULTS[fault]
    with start() as url:
        store = opened(url, IMPATIENT)
        for ask in (lambda: store.put(spool('a', b'x')), store.probe, lambda: store.get('bucket', 'a')):
            said = _error(StoreUnavailable, ask)
            assert words in said
            assert url in said


def test_an_unknown_name(opened: Callable[..., S3Store], spool: Spool) -> None:
    """A host name that does not resolve is no outage of the server."""
    said = _error(StoreUnavailable, opened('http://tower.invalid:9000', IMPATIENT).probe)
    assert 'the name of Tower at http://tower.invalid:9000 cannot be resolved' in said


def test_every_wait_ends(opened: Callable[..., S3Store], spool: Spool) -> None:
    """A hung server costs the read timeout, not botocore's minute and its retries."""
    with fake_s3.hung() as url:
        store = opened(url, IMPATIENT)
        begin = time.monotonic()
        _error(StoreUnavailable, lambda: store.put(spool('a', b'x')))
        assert time.monotonic() - begin < 2.0


ANSWERS: dict[str, tuple[int, bytes, type[StoreError], str]] = {
    'slow down': (503, fake_s3.error('SlowDown'), StoreUnavailable, 'is overloaded (503 SlowDown)'),
    'internal error': (500, fake_s3.error('InternalError'), StoreUnavailable, 'a server error (500 InternalError)'),
    'bad gateway': (502, b'<html>nginx</html>', StoreUnavailable, 'a server error (502'),
    'disk full': (507, fake_s3.error('XMinioStorageFull'), StoreUnavailable, 'the disk of Tower'),
    'clock': (403, fake_s3.error('RequestTimeTooSkewed'), CredentialsRejected, 'set the clock'),
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
        said = _error(kind, lambda: store.put(spool('a', b'x')))
        assert words in said
        assert server.url in said
        _error(kind, store.probe)


def test_the_store_recovers_by_itself(opened: Callable[..., S3Store], spool: Spool) -> None:
    """When the cause is gone the same store goes on."""
    with served(FakeS3(answer=(503, fake_s3.error('SlowDown')))) as server:
        store = opened(server.url)
        _error(StoreUnavailable, lambda: store.put(spool('a', b'x')))
        server.answer = None
        assert store.put(spool('a', b'x')) is Put.CREATED


def test_nothing_is_retried_behind_the_back_of_delivery(opened: Callable[..., S3Store]) -> None:
    """One request is one request, also when it fails."""
    with served(FakeS3(answer=(503, fake_s3.error('SlowDown')))) as server:
        _error(StoreUnavailable, opened(server.url).probe)
        assert server.requests == ['GET']


@pytest.mark.parametrize(('condition', 'words'), [('not implemented', 'does not know'), ('ignored', 'ignores')])
def test_a_server_without_conditional_puts(
    condition: str, words: str, opened: Callable[..., S3Store], spool: Spool, bucket: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Where If-None-Match does not work, be it admitted or not, each put looks first, and one warning says so."""
    with served(FakeS3(condition=condition)) as server, caplog.at_level(logging.WARNING):
        store = opened(server.url)
        assert store.put(spool('a', b'first')) is Put.CREATED
        assert store.put(spool('a', b'first')) is Put.IDENTICAL
        assert store.put(spool('b', b'first')) is Put.CREATED
        for key in ('a', 'b'):
            _error(ForeignObject, lambda key=key: store.put(spool(key, b'other')))  # type: ignore[misc]
        assert store.get(bucket, 'a') == b'first'
    assert len(caplog.messages) == 1
    assert f'{words} If-None-Match' in caplog.text


def test_the_first_put_of_all_never_overwrites_either(opened: Callable[..., S3Store], spool: Spool, bucket: str) -> None:
    """A server that ignores If-None-Match is found out without a loss."""
    with served(FakeS3(condition='ignored')) as server:
        server.objects[f'/{bucket}/a'] = (b'theirs', {})
        _error(ForeignObject, lambda: opened(server.url).put(spool('a', b'ours..')))
        assert server.objects[f'/{bucket}/a'][0] == b'theirs'


def test_a_proved_server_costs_one_request_a_put(opened: Callable[..., S3Store], spool: Spool) -> None:
    """The proof costs two requests once."""
    with served(FakeS3()) as server:
        store = opened(server.url)
        for key in ('a', 'b', 'c'):
            store.put(spool(key, key.encode()))
        assert server.requests == ['HEAD', 'PUT', 'PUT', 'PUT', 'PUT']


def test_credentials_that_may_only_write(opened: Callable[..., S3Store], spool: Spool) -> None:
    """They can write to a server that honours the condition, and to no other."""
    with served(FakeS3()) as server:
        server.forbid_head = True
        store = opened(server.url)
        assert store.put(spool('a', b'x')) is Put.CREATED
        _error(AccessDenied, lambda: store.put(spool('a', b'y')))
    with served(FakeS3(condition='not implemented')) as server:
        server.forbid_head = True
        store = opened(server.url)
        store.put(spool('a', b'x'))
        _error(AccessDenied, lambda: store.put(spool('b', b'x')))


@pytest.mark.parametrize(('content', 'kind'), [(b'the same', None), (b'not same', ForeignObject)])
def test_an_object_without_our_metadata_is_compared_by_content(
    content: bytes, kind: type[StoreError] | None, opened: Callable[..., S3Store], spool: Spool, bucket: str
) -> None:
    """What somebody copied there by hand is recognized, and what is foreign stays."""
    with served(FakeS3()) as server:
        server.objects[f'/{bucket}/a'] = (content, {})
        store = opened(server.url)
        if kind is None:
            assert store.put(spool('a', b'the same')) is Put.IDENTICAL
        else:
            _error(kind, lambda: store.put(spool('a', b'the same')))


@pytest.mark.seaweedfs
def test_a_large_object_is_streamed(
    opened: Callable[..., S3Store], spool: Spool, seaweed: Tower, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beyond the limit the file is sent from the disk, with checksum, hash and condition as ever."""
    monkeypatch.setattr(s3, 'STREAM_BYTES', 1000)
    store = opened(seaweed.store_settings())
    item = spool('large', b'0123456789' * 500_000)
    assert store.put(item) is Put.CREATED
    assert hashlib.sha256(store.get(item.bucket, 'large')).hexdigest() == item.sha256
    assert store.put(item) is Put.IDENTICAL


@pytest.mark.seaweedfs
def test_a_wrong_secret(opened: Callable[..., S3Store], seaweed: Tower, spool: Spool) -> None:
    """A wrong secret is told from a wrong key id, by put, probe, head and get, and shown by none."""
    good = seaweed.store_settings()
    bad_secret = opened(dataclasses.replace(good, secret_access_key=SECRET))
    bad_key = opened(dataclasses.replace(good, access_key_id='NOBODY', secret_access_key=SECRET))
    for store, words in ((bad_secret, 'the secret key is wrong'), (bad_key, 'does not know the access key id')):
        assert words in _error(CredentialsRejected, lambda s=store: s.put(spool('a', b'x')))  # type: ignore[misc]
        assert words in _error(CredentialsRejected, store.probe)
        assert words in _error(CredentialsRejected, lambda s=store: s.head('allowed', 'a'))  # type: ignore[misc]
        assert words in _error(CredentialsRejected, lambda s=store: s.get('allowed', 'a'))  # type: ignore[misc]


def test_no_credentials_at_all(
    opened: Callable[..., S3Store], spool: Spool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Without credentials the names of the variables are in the message."""
    for name in ('AWS_ACCESS_KEY_ID', 'AWS_SECRET_ACCESS_KEY', 'AWS_PROFILE'):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv('AWS_SHARED_CREDENTIALS_FILE', str(tmp_path / 'none'))
    monkeypatch.setenv('AWS_CONFIG_FILE', str(tmp_path / 'none'))
    with served(FakeS3()) as server:
        store = opened(StoreSettings(endpoint_url=server.url))
        said = _error(CredentialsRejected, lambda: store.put(spool('a', b'x')))
    assert 'AWS_ACCESS_KEY_ID' in said


def test_a_profile_of_the_shell_does_not_matter_to_credentials_in_hand(
    opened: Callable[..., S3Store], spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """AWS_PROFILE naming a profile that does not exist stops botocore, not us."""
    monkeypatch.setenv('AWS_PROFILE', 'not-there')
    with served(FakeS3()) as server:
        assert opened(server.url).put(spool('a', b'x')) is Put.CREATED


@pytest.mark.seaweedfs
def test_a_bucket_that_cannot_be_created(
    opened: Callable[..., S3Store], seaweed: Tower, spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bucket, the endpoint and the remedy are named; when somebody made the bucket, delivery goes on at once."""
    settings = seaweed.store_settings('limited')
    store = opened(settings)

    def put() -> Put:
        return store.put(spool('a', b'x', bucket='allowed'))

    said = _error(BucketMissing, put, settings.secret_access_key or '')
    assert f'there is no bucket allowed on Tower at {seaweed.endpoint_url}' in said
    assert 's3 mb s3://allowed' in said
    opened(seaweed.store_settings()).put(spool('b', b'x', bucket='allowed'))
    assert put() is Put.CREATED


def test_a_refused_bucket_is_not_asked_for_by_each_object(
    opened: Callable[..., S3Store], spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Within the pause only the puts themselves ask; after it the next one tries to create it again."""
    with served(FakeS3(without_buckets=True)) as server:
        store = opened(server.url)
        for _ in range(3):
            said = _error(BucketMissing, lambda: store.put(spool('a', b'x')))
            assert 'may not create it' in said
        assert server.creations == 1
        monkeypatch.setattr(s3, 'BUCKET_PAUSE_S', 0.0)
        _error(BucketMissing, lambda: store.put(spool('a', b'x')))
        assert server.creations == 2


@pytest.mark.seaweedfs
def test_denied_is_not_missing(opened: Callable[..., S3Store], seaweed: Tower, spool: Spool, bucket: str) -> None:
    """Valid credentials without the right to this bucket are AccessDenied; the probe finds nothing wrong with them."""
    opened(seaweed.store_settings()).put(spool('a', b'x'))
    store = opened(seaweed.store_settings('limited'))
    store.probe()
    said = _error(AccessDenied, lambda: store.put(spool('b', b'x')))
    assert f'denies these credentials {bucket}/b' in said
    _error(AccessDenied, lambda: store.head(bucket, 'a'))


@pytest.mark.seaweedfs
def test_the_server_verifies_the_checksum(seaweed: Tower, spool: Spool, bucket: str) -> None:
    """A CRC32 that is not the content's is refused by the server, is a reason to send again, and leaves nothing there."""
    requests = S3Requests(seaweed.store_settings(), QUICK)
    requests.open()
    requests.create_bucket(bucket)
    wrong = base64.b64encode((zlib.crc32(b'content') ^ 1).to_bytes(4, 'big')).decode()
    said = _error(StoreUnavailable, lambda: requests.put(spool('a', b'content'), b'content', wrong, conditional=True))
    assert 'damaged on its way' in said
    assert requests.head(bucket, 'a') is None
    right = base64.b64encode(zlib.crc32(b'content').to_bytes(4, 'big')).decode()
    assert requests.put(spool('a', b'content'), b'content', right, conditional=True) is Sent.CREATED
    requests.close()


@pytest.mark.seaweedfs
def test_a_key_that_is_a_folder(opened: Callable[..., S3Store], seaweed: Tower, spool: Spool) -> None:
    """Where a server cannot hold both ``a`` and ``a/b``, ``a`` is refused instead of waiting for ever."""
    store = opened(seaweed.store_settings())
    store.put(spool('a/b', b'x'))
    assert 'is a folder' in _error(ObjectRefused, lambda: store.put(spool('a', b'x')))


@pytest.mark.seaweedfs
def test_a_bucket_name_no_server_allows(opened: Callable[..., S3Store], seaweed: Tower, spool: Spool) -> None:
    """Upper case in a bucket's name is explained; its objects wait for a better setting."""
    store = opened(seaweed.store_settings())
    assert 'lower-case' in _error(BucketMissing, lambda: store.put(spool('a', b'x', bucket='Sensor-Data')))


@pytest.mark.parametrize(
    ('settings', 'name'),
    [
        (StoreSettings(endpoint_url='http://', access_key_id='k', secret_access_key=SECRET), 'AWS_ENDPOINT_URL'),
        (StoreSettings(endpoint_url='http://me:pw@:x', access_key_id='k', secret_access_key=SECRET), 'AWS_ENDPOINT_URL'),
        (StoreSettings(endpoint_url='http://127.0.0.1:1', access_key_id='k'), 'AWS_SECRET_ACCESS_KEY'),
        (StoreSettings(endpoint_url='http://127.0.0.1:1', secret_access_key=SECRET), 'AWS_ACCESS_KEY_ID'),
    ],
)
def test_settings_that_cannot_work_stop_the_start(settings: StoreSettings, name: str) -> None:
    """The variable is named; a secret, even in the URL, is not shown."""
    with pytest.raises(SettingError) as caught:
        open_store(settings, QUICK)
    assert caught.value.data['name'] == name
    assert SECRET not in str(caught.value)
    assert 'pw' not in str(caught.value)


def test_nothing_shows_a_secret(opened: Callable[..., S3Store]) -> None:
    """Neither the description nor a repr holds the secret or what somebody wrote into the URL."""
    store = opened(_settings('http://user:url-password@127.0.0.1:1'))
    text = store.describe() + repr(store) + repr(_settings('http://127.0.0.1:1')) + _error(StoreUnavailable, store.probe)
    assert not re.search('Secret|url-password', text)


def test_a_closed_store_says_so(opened: Callable[..., S3Store], spool: Spool) -> None:
    """Use after close is an error of the tree, not an AttributeError."""
    store = opened('http://127.0.0.1:1')
    store.close()
    with pytest.raises(StoreUnavailable, match='not open'):
        store.put(spool('a', b'x'))


@pytest.fixture(scope='session')
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """A certificate for 127.0.0.1 that nobody but itself signed, and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, 'tower')])
    now = datetime.datetime.now(datetime.timezone.utc)
    signed = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address('127.0.0.1'))]), critical=False)
        .sign(key, hashes.SHA256())
    )
    folder = tmp_path_factory.mktemp('tls')
    pem = serialization.Encoding.PEM
    (folder / 'crt').write_bytes(signed.public_bytes(pem))
    (folder / 'key').write_bytes(key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()))
    return str(folder / 'crt'), str(folder / 'key')


def test_a_certificate_nobody_trusts(opened: Callable[..., S3Store], certificate: tuple[str, str]) -> None:
    """A private authority is told from a missing server, with the variable that makes it trusted."""
    with fake_s3.with_tls(*certificate) as url:
        said = _error(StoreUnavailable, opened(url).probe)
    assert 'is not trusted' in said
    assert 'AWS_CA_BUNDLE' in said


def test_aws_ca_bundle_is_honoured(
    opened: Callable[..., S3Store], certificate: tuple[str, str], spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With AWS_CA_BUNDLE the private authority is trusted."""
    monkeypatch.setenv('AWS_CA_BUNDLE', certificate[0])
    with fake_s3.with_tls(*certificate) as url:
        assert opened(url).put(spool('a', b'x')) is Put.CREATED


def test_https_to_a_plain_port(opened: Callable[..., S3Store]) -> None:
    """TLS where there is none is explained."""
    with served(FakeS3()) as server:
        said = _error(StoreUnavailable, opened(server.url.replace('http:', 'https:')).probe)
    assert 'no TLS connection' in said
