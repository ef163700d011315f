"""What an S3 store refuses (credentials, a bucket, a key), what that means for delivery, and that it never shows a secret."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from shadowhound_tower.embedded import Tower
from stores.asking import SECRET, error_of, settings_for
from stores.fake_s3 import FakeS3, served
from stores.spooled import QUICK, Spool, with_room

from shadowhound_data_logger.core.config import StoreSettings
from shadowhound_data_logger.core.errors import (
    AccessDenied,
    BucketMissing,
    CredentialsRejected,
    ObjectRefused,
    SettingError,
    StoreUnavailable,
)
from shadowhound_data_logger.core.model import Put, SpooledObject
from shadowhound_data_logger.stores import open_store, s3_puts
from shadowhound_data_logger.stores.content import chunks
from shadowhound_data_logger.stores.s3 import S3Store


@pytest.mark.seaweedfs
def test_a_wrong_secret(opened: Callable[..., S3Store], seaweed: Tower, spool: Spool) -> None:
    """A wrong secret is told from a wrong key id, by put, probe, head and get, and shown by none."""
    good = seaweed.store_settings()
    bad_secret = opened(dataclasses.replace(good, secret_access_key=SECRET))
    bad_key = opened(dataclasses.replace(good, access_key_id='NOBODY', secret_access_key=SECRET))
    for store, words in ((bad_secret, 'the secret key is wrong'), (bad_key, 'does not know the access key id')):
        assert words in error_of(CredentialsRejected, lambda s=store: s.put(spool('a', b'x')))  # type: ignore[misc]
        assert words in error_of(CredentialsRejected, store.probe)
        assert words in error_of(CredentialsRejected, lambda s=store: s.head('allowed', 'a'))  # type: ignore[misc]
        assert words in error_of(CredentialsRejected, lambda s=store: s.get('allowed', 'a'))  # type: ignore[misc]


def test_a_file_that_goes_between_its_check_and_its_sending(
    opened: Callable[..., S3Store], spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Evicted in that instant, say: it is refused as gone, and nothing but a store's error leaves the store."""
    item = spool('a', bytes(s3_puts.STREAM_BYTES + 1))

    def gone(given: SpooledObject) -> Iterator[bytes]:
        yield from chunks(given)
        given.path.unlink()

    monkeypatch.setattr(s3_puts, 'chunks', gone)
    with served(FakeS3()) as server:
        store = opened(StoreSettings(endpoint_url=server.url, access_key_id='KEYID', secret_access_key=SECRET))
        assert 'it is missing' in error_of(ObjectRefused, lambda: store.put(item))


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
        said = error_of(CredentialsRejected, lambda: store.put(spool('a', b'x')))
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

    said = error_of(BucketMissing, put, settings.secret_access_key or '')
    assert f'the bucket allowed does not exist at {seaweed.endpoint_url}' in said
    assert 's3 mb s3://allowed' in said
    opened(seaweed.store_settings()).put(spool('b', b'x', bucket='allowed'))
    assert put() is Put.CREATED


def test_a_rejected_bucket_is_probed_once(opened: Callable[..., S3Store], spool: Spool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Within the pause only the puts themselves ask; after it the next one tries to create it again."""
    with served(FakeS3(without_buckets=True)) as server:
        store = opened(server.url)
        for _ in range(3):
            said = error_of(BucketMissing, lambda: store.put(spool('a', b'x')))
            assert 'may not create it' in said
        assert server.creations == 1
        monkeypatch.setattr(s3_puts, 'BUCKET_PAUSE_S', 0.0)
        error_of(BucketMissing, lambda: store.put(spool('a', b'x')))
        assert server.creations == 2


@pytest.mark.seaweedfs
def test_denied_is_not_missing(opened: Callable[..., S3Store], seaweed: Tower, spool: Spool, bucket: str) -> None:
    """Valid credentials without the right to this bucket are AccessDenied; the probe finds nothing wrong with them."""
    opened(seaweed.store_settings()).put(spool('a', b'x'))
    store = opened(seaweed.store_settings('limited'))
    store.probe()
    said = error_of(AccessDenied, lambda: store.put(spool('b', b'x')))
    assert f'denies these credentials {bucket}/b' in said
    error_of(AccessDenied, lambda: store.head(bucket, 'a'))


@pytest.mark.seaweedfs
def test_a_key_that_is_a_folder(opened: Callable[..., S3Store], seaweed: Tower, spool: Spool) -> None:
    """Where a server cannot hold both ``a`` and ``a/b``, ``a`` is refused instead of waiting for ever."""
    store = opened(seaweed.store_settings())
    with_room(lambda: store.put(spool('a/b', b'x')))
    assert 'is a folder' in error_of(ObjectRefused, lambda: store.put(spool('a', b'x')))


@pytest.mark.seaweedfs
def test_a_bucket_name_no_server_allows(opened: Callable[..., S3Store], seaweed: Tower, spool: Spool) -> None:
    """Upper case in a bucket's name is explained; its objects wait for a better setting."""
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
def test_settings_that_cannot_work_stop_the_start(settings: StoreSettings, name: str) -> None:
    """The variable is named; a secret, even in the URL, is not shown."""
    with pytest.raises(SettingError) as caught:
        open_store(settings, QUICK)
    assert caught.value.data['name'] == name
    assert SECRET not in str(caught.value)
    assert 'pw' not in str(caught.value)


def test_nothing_shows_a_secret(opened: Callable[..., S3Store]) -> None:
    """Neither the description nor a repr holds the secret or what somebody wrote into the URL."""
    store = opened(settings_for('http://user:url-password@127.0.0.1:1'))
    text = store.describe() + repr(store) + repr(settings_for('http://127.0.0.1:1')) + error_of(StoreUnavailable, store.probe)
    assert not re.search('Secret|url-password', text)


def test_a_closed_store_raises(opened: Callable[..., S3Store], spool: Spool) -> None:
    """Use after close is an error of the tree, not an AttributeError."""
    store = opened('http://127.0.0.1:1')
    store.close()
    with pytest.raises(StoreUnavailable, match='not open'):
        store.put(spool('a', b'x'))
