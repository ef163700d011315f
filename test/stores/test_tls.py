"""A Tower behind TLS with an authority of its own: believed, or not believed for one of four reasons, and nothing in clear."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from shadowhound_tower.embedded import Tower
from stores.asking import error_of
from stores.certificates import DAY, WRONG, Authority
from stores.fake_s3 import FakeS3, served
from stores.spooled import QUICK, Spool, with_room
from stores.tls_front import Secured, behind_tls

from shadowhound_data_logger.core.config import StoreSettings, UploadSettings
from shadowhound_data_logger.core.errors import SettingError, StoreUnavailable, StoreUntrusted
from shadowhound_data_logger.core.model import Put, SpooledObject
from shadowhound_data_logger.shipping.failures import Verdict, decide
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.s3 import S3Store
from shadowhound_data_logger.stores.s3_multipart import MULTIPART_BYTES

BODY = b'what the robot saw, which is nobody else to read; ' * 100
RECORDS = {20, 21, 22, 23}
"""Content types of TLS records: change_cipher_spec, alert, handshake, application_data (RFC 8446, 5.1)."""


@pytest.fixture(params=['AWS_CA_BUNDLE', 'REQUESTS_CA_BUNDLE'])
def trusting(request: pytest.FixtureRequest, authorities: dict[str, Authority], monkeypatch: pytest.MonkeyPatch) -> None:
    """The authority is trusted by one variable."""
    for name in ('AWS_CA_BUNDLE', 'REQUESTS_CA_BUNDLE'):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(request.param, str(authorities['authority'].path))


@pytest.fixture
def through(seaweed: Tower, opened: Callable[..., S3Store]) -> Callable[[str], S3Store]:
    """A store over another way to the server; handshakes may take long on a busy machine."""

    def make(url: str) -> S3Store:
        patient = dataclasses.replace(QUICK, connect_timeout_s=QUICK.read_timeout_s)
        return opened(dataclasses.replace(seaweed.store_settings(), endpoint_url=url), patient)

    return make


def is_closed(tower: Secured, item: SpooledObject) -> bool:
    """Whether the wire saw TLS alone, and nothing of the object could be read there."""
    words = (BODY[:40], item.key.encode(), b'PUT /', b'AWS4-HMAC', b'authorization')
    first = [heard[:2] for heard in tower.wire.heard_by_connection]
    return all(heard[0] in RECORDS and heard[1] == 3 for heard in first) and not any(word in tower.wire.heard for word in words)


@pytest.mark.seaweedfs
@pytest.mark.usefixtures('trusting')
def test_a_private_authority_that_is_trusted(
    authorities: dict[str, Authority], seaweed: Tower, through: Callable[[str], S3Store], spool: Spool
) -> None:
    """Puts, parts, looks, reads and lists go through TLS, and the wire shows none of it."""
    with behind_tls(seaweed.endpoint_url, authorities['authority'].sign('good')) as tower:
        store = through(tower.url)
        item, large = spool('thor/secret-name', BODY), spool('thor/large', bytes(MULTIPART_BYTES + 1))
        assert store.put(item) is Put.CREATED
        assert store.put(large) is Put.CREATED
        assert store.get(item.bucket, item.key) == BODY
        assert [info.key for info in store.list(item.bucket)] == [large.key, item.key]
        store.probe()
        store.close()
    assert BODY in tower.inside.heard
    assert is_closed(tower, item)


@pytest.mark.seaweedfs
@pytest.mark.usefixtures('trusting')
@pytest.mark.parametrize('kind', WRONG)
def test_a_certificate_that_is_not_believed(
    kind: str, authorities: dict[str, Authority], seaweed: Tower, through: Callable[[str], S3Store], spool: Spool
) -> None:
    """Each kind has words and a remedy of its own and pauses all; no request leaves, in clear or otherwise."""
    signer, how, words, remedy = WRONG[kind]
    item = spool('thor/secret-name', BODY)
    with behind_tls(seaweed.endpoint_url, authorities[signer].sign(kind, **how)) as tower:
        store = through(tower.url)
        for ask in (lambda: store.put(item), store.probe, lambda: store.get(item.bucket, item.key)):
            said = error_of(StoreUntrusted, ask)
            assert words in said
            assert remedy in said
            assert tower.url in said
        store.close()
    assert tower.wire.connections == 3
    assert tower.inside.heard == b''
    assert is_closed(tower, item)
    assert decide(StoreUntrusted('x')) is Verdict.PAUSE


@pytest.mark.seaweedfs
def test_delivery_resumes_after_the_certificate_was_renewed(
    authorities: dict[str, Authority], seaweed: Tower, through: Callable[[str], S3Store], spool: Spool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """The same store, with nothing started again."""
    monkeypatch.setenv('AWS_CA_BUNDLE', str(authorities['authority'].path))
    ended = authorities['authority'].sign('ended', begins=-2 * DAY, ends=-DAY)
    with behind_tls(seaweed.endpoint_url, ended) as tower:
        store = through(tower.url)
        error_of(StoreUntrusted, lambda: store.put(spool('a', BODY)))
        tower.renew(authorities['authority'].sign('renewed'))
        assert with_room(lambda: store.put(spool('a', BODY))) is Put.CREATED
        store.close()


def test_a_redirect_is_not_followed(
    authorities: dict[str, Authority], opened: Callable[..., S3Store], spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not to http, by nothing that is asked: what the robot sends in clear is asked for by its operator alone."""
    monkeypatch.setenv('AWS_CA_BUNDLE', str(authorities['authority'].path))
    with served(FakeS3()) as plain, served(FakeS3(answer=(307, b''))) as server:
        handler: Any = server.RequestHandlerClass
        end = handler.end_headers

        def elsewhere(request: Any) -> None:
            if request.server is server:
                request.send_header('Location', f'{plain.url}{request.path}')
            end(request)

        monkeypatch.setattr(handler, 'end_headers', elsewhere)
        with behind_tls(server.url, authorities['authority'].sign('redirects')) as tower:
            store = opened(tower.url)
            item = spool('a', BODY)
            for ask in (lambda: store.put(item), store.probe, lambda: store.get(item.bucket, item.key)):
                assert 'does not answer like an S3 server' in error_of(StoreUnavailable, ask)
            store.close()
        assert server.requests
        assert plain.requests == []


@pytest.mark.parametrize('content', [None, 'no certificate'])
def test_an_invalid_ca_bundle_aborts_startup(content: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is named: with it nothing could be sent. Without https it does not matter."""
    path = tmp_path / 'ca.pem'
    if content:
        path.write_text(content)
    monkeypatch.setenv('AWS_CA_BUNDLE', str(path))
    given = {'access_key_id': 'k', 'secret_access_key': 's'}
    with pytest.raises(SettingError) as caught:
        open_store(StoreSettings(endpoint_url='https://127.0.0.1:1', **given), UploadSettings())  # type: ignore[arg-type]
    assert caught.value.data['name'] == 'AWS_CA_BUNDLE'
    assert str(path) in str(caught.value)
    open_store(StoreSettings(endpoint_url='http://127.0.0.1:1', **given), UploadSettings()).close()  # type: ignore[arg-type]
