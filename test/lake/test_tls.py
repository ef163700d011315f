"""The lake of a Tower behind TLS with a private authority: queried, fetched, trained on, or not trusted, with the reason."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result
from lake.training import Drive
from shadowhound_tower.embedded import Tower
from stores.certificates import WRONG, Authority
from stores.tls_front import Secured, behind_tls

from shadowhound_data_logger import lake
from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.core.errors import SettingError, StoreUntrusted
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.lake.bucket import Bucket

pytestmark = pytest.mark.seaweedfs
ROBOT = 'secured'
SECONDS = 3
OBJECTS = 6 * SECONDS
HANDSHAKE = 22
"""Content type of the TLS record that begins a connection (RFC 8446, 5.1)."""


@pytest.fixture(scope='module')
def filled(seaweed: Tower, tmp_path_factory: pytest.TempPathFactory) -> Tower:
    """What a robot stored in some seconds."""
    Drive(seaweed.store_settings(), tmp_path_factory.mktemp('drive'), ROBOT).record(SECONDS)
    return seaweed


@pytest.fixture
def towards(filled: Tower, monkeypatch: pytest.MonkeyPatch, authorities: dict[str, Authority]) -> Callable[[str], StoreSettings]:
    """The store at another address, which the environment then names; its authority is trusted."""

    def use(url: str) -> StoreSettings:
        for name, value in {**filled.environment(), 'AWS_ENDPOINT_URL': url}.items():
            monkeypatch.setenv(name, value)
        monkeypatch.delenv('REQUESTS_CA_BUNDLE', raising=False)
        monkeypatch.setenv('AWS_CA_BUNDLE', str(authorities['authority'].path))
        return replace(filled.store_settings(), endpoint_url=url)

    return use


@contextmanager
def secured(filled: Tower, authority: Authority, name: str, **how: Any) -> Iterator[Secured]:
    """TLS in front of the store; a connection without TLS fails the test."""
    with behind_tls(filled.endpoint_url, authority.sign(name, **how)) as front:
        yield front
    assert front.wire.heard_by_connection
    assert all(heard[0] == HANDSHAKE for heard in front.wire.heard_by_connection)
    assert ROBOT.encode() not in front.wire.heard


def run(*arguments: str) -> Result:
    return CliRunner().invoke(cli, arguments, standalone_mode=False)


@pytest.mark.long('a second of CPU or more')
def test_a_private_authority_is_trusted(
    filled: Tower, authorities: dict[str, Authority], towards: Callable[[str], StoreSettings], tmp_path: Path,
) -> None:  # fmt: skip
    """Questions, fetches, the verification and data sets all go through TLS."""
    with secured(filled, authorities['authority'], 'good') as front:
        source = Bucket(towards(front.url), 'sensor-data')
        assert len(lake.objects(source, robot=ROBOT)['key'].to_pylist()) == OBJECTS
        told = run('fetch', '--robot', ROBOT, '--to', str(tmp_path / 'data'), '--json')
        assert json.loads(told.stdout)['moved'] == OBJECTS
        verified = run('lake', 'verify', '--robot', ROBOT, '--deep', '--json')
        assert (verified.return_value, json.loads(verified.stdout)['sound']) == (0, OBJECTS)
        with closing(lake.MissionDataset(source, robot=ROBOT, align={'odom': 0.5})) as frames:
            assert [bool(frame['odom_ok']) for frame in frames.stream()] == [True] * SECONDS
    assert b'GET /sensor-data' in front.inside.heard


@pytest.mark.parametrize('kind', WRONG)
def test_a_certificate_that_is_not_believed(
    filled: Tower, authorities: dict[str, Authority], towards: Callable[[str], StoreSettings], tmp_path: Path, kind: str
) -> None:
    """Each kind has the words and the remedy that the robot has for it; no request leaves."""
    signer, how, words, remedy = WRONG[kind]
    with secured(filled, authorities[signer], kind, **how) as front:
        source = Bucket(towards(front.url), 'sensor-data')
        for ask in (lambda: source.get('x', 9), lambda: lake.objects(source).to_pydict()):
            with pytest.raises(StoreUntrusted) as caught:
                ask()
            assert words in str(caught.value)
            assert remedy in str(caught.value)
            assert front.url in str(caught.value)
        for arguments in (['fetch', f'{ROBOT}/'], ['fetch', '--robot', ROBOT]):
            assert isinstance(run(*arguments, '--to', str(tmp_path)).exception, StoreUntrusted)
    assert front.inside.heard == b''


def test_without_a_bundle_the_system_decides(
    filled: Tower, authorities: dict[str, Authority], towards: Callable[[str], StoreSettings], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It does not know this authority, and the message names the variable."""
    with secured(filled, authorities['authority'], 'plain') as front:
        source = Bucket(towards(front.url), 'sensor-data')
        monkeypatch.delenv('AWS_CA_BUNDLE')
        with pytest.raises(StoreUntrusted, match='AWS_CA_BUNDLE'):
            source.folders('')
    assert front.inside.heard == b''


def test_an_authority_is_no_server(
    filled: Tower, authorities: dict[str, Authority], towards: Callable[[str], StoreSettings]
) -> None:
    """Its own certificate is not taken of a server, though it is the one that is trusted."""
    with behind_tls(filled.endpoint_url, authorities['authority'].itself()) as front:
        source = Bucket(towards(front.url), 'sensor-data')
        with pytest.raises(StoreUntrusted, match='is a CA certificate, which'):
            source.folders('')
    assert front.inside.heard == b''


def test_an_invalid_ca_bundle_is_a_usage_error(
    towards: Callable[[str], StoreSettings], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """It is reported before any request."""
    settings = towards('https://127.0.0.1:1')
    (tmp_path / 'ca.pem').write_text('no certificate')
    monkeypatch.setenv('AWS_CA_BUNDLE', str(tmp_path / 'ca.pem'))
    with pytest.raises(SettingError, match='AWS_CA_BUNDLE'):
        Bucket(settings, 'sensor-data').folders('')
    found = run('query', '--robot', ROBOT)
    assert isinstance(found.exception, click.UsageError)
    assert 'AWS_CA_BUNDLE' in str(found.exception)
