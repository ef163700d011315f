"""Keys of a profile: found as botocore finds them, read again once they are refused, and never shown."""

from __future__ import annotations

import configparser
import dataclasses
import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from botocore.credentials import InstanceMetadataProvider
from botocore.exceptions import NoCredentialsError, PartialCredentialsError
from shadowhound_tower.embedded import Tower
from stores.asking import SECRET, error_of
from stores.fake_s3 import FakeS3, Handler, error, served
from stores.spooled import Spool

from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.core.errors import CredentialsRejected, ObjectRefused, SettingError
from shadowhound_data_logger.core.model import Put
from shadowhound_data_logger.lake.tables import storage_options
from shadowhound_data_logger.stores.credentials import REREAD_S, Keys
from shadowhound_data_logger.stores.s3 import S3Store
from shadowhound_data_logger.stores.s3_multipart import MULTIPART_BYTES
from shadowhound_data_logger.stores.s3_obstore import ObstoreStore

OWN = StoreSettings(endpoint_url='http://127.0.0.1:1')


class File:
    """A shared-credentials file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def write(self, key: str, secret: str, profile: str = 'default', **more: str) -> None:
        content = configparser.ConfigParser(interpolation=None)
        content[profile] = {'aws_access_key_id': key, 'aws_secret_access_key': secret, **more}
        with self.path.open('w', encoding='utf-8') as file:
            content.write(file)


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> File:
    """The file named by AWS_SHARED_CREDENTIALS_FILE, which does not exist yet; no other source has keys."""
    for name in ('AWS_ACCESS_KEY_ID', 'AWS_SECRET_ACCESS_KEY', 'AWS_SESSION_TOKEN', 'AWS_PROFILE', 'AWS_DEFAULT_PROFILE'):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv('HOME', str(tmp_path))
    monkeypatch.setenv('AWS_CONFIG_FILE', str(tmp_path / 'config'))
    monkeypatch.setenv('AWS_SHARED_CREDENTIALS_FILE', str(tmp_path / 'credentials'))
    return File(tmp_path / 'credentials')


@pytest.fixture
def clock() -> list[float]:
    """The only element is the time."""
    return [100.0]


def test_the_default_profile_is_used(file: File) -> None:
    """From the file in the variable, with its token."""
    file.write('KEY', SECRET, aws_session_token='token')
    assert Keys(OWN).get_frozen_credentials()[:3] == ('KEY', SECRET, 'token')


def test_the_credentials_file_in_the_home_is_used(file: File, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If no variable names another file."""
    monkeypatch.delenv('AWS_SHARED_CREDENTIALS_FILE')
    (tmp_path / '.aws').mkdir()
    File(tmp_path / '.aws' / 'credentials').write('KEY', SECRET)
    assert Keys(OWN).get_frozen_credentials().access_key == 'KEY'


def test_a_named_profile_is_used(file: File, monkeypatch: pytest.MonkeyPatch) -> None:
    """AWS_PROFILE names it; also from the configuration file."""
    file.write('KEY', SECRET, 'robot')
    monkeypatch.setenv('AWS_PROFILE', 'robot')
    assert Keys(OWN).get_frozen_credentials().access_key == 'KEY'
    file.path.rename(file.path.with_name('config'))
    assert '[robot]' in file.path.with_name('config').read_text()
    file.path.with_name('config').write_text(f'[profile robot]\naws_access_key_id=OTHER\naws_secret_access_key={SECRET}\n')
    assert Keys(OWN).get_frozen_credentials().access_key == 'OTHER'


@pytest.mark.parametrize('client', [S3Store, ObstoreStore])
def test_every_client_signs_with_the_same_profile(
    file: File, monkeypatch: pytest.MonkeyPatch, client: type[S3Store | ObstoreStore]
) -> None:
    """A missing profile is reported with the same message."""
    file.write('KEY', SECRET, 'robot')
    signed: list[str] = []
    answer = Handler.do_GET
    monkeypatch.setattr(Handler, 'do_GET', lambda self: (signed.append(self.headers['Authorization']), answer(self)))
    with served(FakeS3()) as server:
        for name in ('robot', 'not-there'):
            monkeypatch.setenv('AWS_PROFILE', name)
            store = client(StoreSettings(endpoint_url=server.url), UploadSettings())
            with pytest.raises((ObjectRefused, SettingError)) as raised:
                (store.open(), store.get('sensor-data', 'a'))
            store.close()
            if name == 'robot':
                assert isinstance(raised.value, ObjectRefused)
                assert len(signed) == 1
                assert 'Credential=KEY/' in signed[0]
            else:
                assert str(raised.value).startswith("AWS_PROFILE = 'not-there' is refused")
    assert len(signed) == 1


def test_the_tables_of_the_lake_are_read_with_the_same_profile(file: File, monkeypatch: pytest.MonkeyPatch) -> None:
    """delta-rs gets the keys directly."""
    file.write('KEY', SECRET, 'robot', aws_session_token='token')
    monkeypatch.setenv('AWS_PROFILE', 'robot')
    found = storage_options(OWN)
    assert [found[f'AWS_{name}'] for name in ('ACCESS_KEY_ID', 'SECRET_ACCESS_KEY', 'SESSION_TOKEN')] == ['KEY', SECRET, 'token']
    monkeypatch.setenv('AWS_PROFILE', 'not-there')
    with pytest.raises(SettingError, match="AWS_PROFILE = 'not-there' is refused"):
        storage_options(OWN)


def test_keys_in_the_settings_take_precedence(file: File) -> None:
    """The environment of a process cannot change: nothing is read again."""
    file.write('KEY', SECRET)
    keys = Keys(dataclasses.replace(OWN, access_key_id='FIRST', secret_access_key='first'))
    assert keys.get_frozen_credentials()[:2] == ('FIRST', 'first')
    assert not keys.renew(keys.generation)


def test_half_a_key_pair_aborts_startup() -> None:
    """The missing half is named."""
    with pytest.raises(SettingError, match='AWS_SECRET_ACCESS_KEY'):
        Keys(dataclasses.replace(OWN, access_key_id='FIRST'))


def test_no_metadata_service_is_queried_for_credentials(file: File, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither that of the cloud nor a container's, so a start without keys takes no time."""
    monkeypatch.setenv('AWS_CONTAINER_CREDENTIALS_FULL_URI', 'http://127.0.0.1:1/keys')
    monkeypatch.setattr(InstanceMetadataProvider, 'load', lambda _: pytest.fail('the metadata service is asked'))
    with pytest.raises(NoCredentialsError):
        Keys(OWN).get_frozen_credentials()


def test_refused_keys_are_read_again(file: File, clock: list[float]) -> None:
    """Another pair is a new generation; with the same one, a broken file or none the old one is kept."""
    file.write('OLD', 'old')
    keys = Keys(OWN, lambda: clock[0])
    keys.get_frozen_credentials()
    changes: tuple[Callable[[], object], ...] = (
        lambda: None, lambda: file.path.write_text('[default]\naws_access_key_id = NEW\n'), lambda: file.path.write_text('x['),
        file.path.unlink,
    )  # fmt: skip
    for change in changes:
        change()
        clock[0] += 2 * REREAD_S
        assert not keys.renew(0)
        assert keys.get_frozen_credentials().access_key == 'OLD'
    file.write('NEW', 'new')
    clock[0] += 2 * REREAD_S
    assert keys.renew(0)
    assert keys.generation == 1
    assert keys.get_frozen_credentials()[:2] == ('NEW', 'new')


def test_many_refusals_cause_one_reading(file: File, clock: list[float]) -> None:
    """A caller refused with the old keys gets the new ones without reading; a caller refused with the new ones waits."""
    file.write('OLD', 'old')
    keys = Keys(OWN, lambda: clock[0])
    keys.get_frozen_credentials()
    file.write('NEW', 'new')
    assert not keys.renew(0)
    clock[0] += REREAD_S
    assert keys.renew(0)
    assert keys.renew(0)
    file.write('NEWER', 'newer')
    assert not keys.renew(1)
    assert keys.get_frozen_credentials().access_key == 'NEW'


def test_keys_that_are_added_later_are_used(file: File, clock: list[float]) -> None:
    """A file created while the program runs is found; half a key pair is reported as such."""
    keys = Keys(OWN, lambda: clock[0])
    with pytest.raises(NoCredentialsError):
        keys.get_frozen_credentials()
    file.path.write_text('[default]\naws_access_key_id = KEY\n')
    with pytest.raises(PartialCredentialsError):
        keys.get_frozen_credentials()
    file.write('KEY', SECRET)
    assert keys.get_frozen_credentials().access_key == 'KEY'


def test_a_put_resumes_with_new_keys(
    file: File, opened: Callable[..., S3Store], spool: Spool, seaweed: Tower, monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    """A refusal, of a single put or a multipart upload, is not a failure if the file has other keys by then."""
    caplog.set_level(logging.DEBUG)
    good = seaweed.store_settings()
    store = opened(dataclasses.replace(good, access_key_id=None, secret_access_key=None))
    for item in (spool('small', b'x'), spool('large', bytes(MULTIPART_BYTES + 1))):
        file.write('GONE', SECRET)
        until_read(store, 'GONE')
        error_of(CredentialsRejected, lambda item=item: store.put(item))  # type: ignore[misc]
        file.write(str(good.access_key_id), str(good.secret_access_key))
        time_passes(store)
        assert store.put(item) is Put.CREATED
    assert SECRET not in caplog.text
    assert str(good.secret_access_key) not in caplog.text


def until_read(store: S3Store, key: str) -> None:
    """Continue as after a refusal."""
    time_passes(store)
    keys: Any = store._client._keys
    keys.renew(keys.generation)
    assert keys.get_frozen_credentials().access_key == key


def time_passes(store: S3Store) -> None:
    keys: Any = store._client._keys
    keys._read_s = float('-inf')


@pytest.mark.parametrize('code', ['InvalidAccessKeyId', 'SignatureDoesNotMatch', 'ExpiredToken', 'InvalidToken'])
def test_every_refusal_of_keys_reads_them_again(
    code: str, file: File, opened: Callable[..., S3Store], spool: Spool
) -> None:  # fmt: skip
    """After two tries the reason for refusing the new ones is reported."""
    file.write('OLD', SECRET)
    with served(FakeS3(answer=(403, error(code)))) as server:
        store = opened(StoreSettings(endpoint_url=server.url))
        error_of(CredentialsRejected, store.probe)
        file.write('NEW', SECRET)
        time_passes(store)
        server.requests.clear()
        began_s = time.monotonic()
        error_of(CredentialsRejected, lambda: store.put(spool('a', b'x')))
        assert store._client.generation == 1
        assert len(server.requests) <= 4, 'HEAD and GET for the reason, twice'
        assert time.monotonic() - began_s < 50


def test_nothing_shows_a_secret(file: File) -> None:
    """Neither the keys nor their reader."""
    file.write('KEY', SECRET)
    keys = Keys(OWN)
    keys.get_frozen_credentials()
    assert SECRET not in repr(keys) + str(keys) + repr(keys._found) + repr(OWN)
