"""Proxies: each S3 client uses the one that the environment names, by the same rules."""

from __future__ import annotations

import os
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

import pytest
from deltalake import DeltaTable
from deltalake.exceptions import DeltaError
from stores.fake_s3 import FakeS3, served

from shadowhound_data_logger.core.errors import ObjectRefused, StoreUnavailable
from shadowhound_data_logger.core.options import StoreSettings, UploadSettings
from shadowhound_data_logger.lake.tables import storage_options
from shadowhound_data_logger.stores.s3 import S3Store
from shadowhound_data_logger.stores.s3_obstore import ObstoreStore

CLIENTS = (S3Store, ObstoreStore)


class Gateway(BaseHTTPRequestHandler):
    """A proxy that forwards nothing."""

    def do_GET(self) -> None:
        self.send_response(502)
        self.send_header('Content-Length', '0')
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Log nothing."""


@pytest.fixture(scope='module')
def proxy() -> Iterator[str]:
    """Its host and port."""
    with ThreadingHTTPServer(('127.0.0.1', 0), Gateway) as server:
        thread = Thread(target=server.serve_forever, kwargs={'poll_interval': 0.01})
        thread.start()
        yield f'127.0.0.1:{server.server_port}'
        server.shutdown()
        thread.join()


@pytest.fixture(scope='module')
def tower() -> Iterator[FakeS3]:
    with served(FakeS3()) as server:
        yield server


@pytest.fixture
def environ(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """An environment without any proxy."""
    for name in [name for name in os.environ if name.lower().endswith('_proxy')]:
        monkeypatch.delenv(name)
    return monkeypatch


def get(client: type[S3Store | ObstoreStore], endpoint: str) -> None:
    settings = StoreSettings(endpoint_url=endpoint, access_key_id='KEY', secret_access_key='secret')
    store = client(settings, UploadSettings(connect_timeout_s=5.0, read_timeout_s=5.0))
    store.open()
    try:
        store.get('sensor-data', 'a')
    finally:
        store.close()


@pytest.mark.parametrize('client', CLIENTS)
@pytest.mark.parametrize(('host', 'variables', 'is_proxied'), [
    ('127.0.0.1', {}, False), ('127.0.0.1', {'HTTP_PROXY': 'http://PROXY'}, True), ('127.0.0.1', {'http_proxy': 'PROXY'}, True),
    ('127.0.0.1', {'HTTPS_PROXY': 'http://PROXY'}, False), ('127.0.0.1', {'ALL_PROXY': 'http://PROXY'}, False),
    *(('127.0.0.1', {'HTTP_PROXY': 'http://PROXY', 'NO_PROXY': text}, is_proxied) for text, is_proxied in (
        ('127.0.0.1', False), ('127.0.0.1:PORT', False), ('127.0.0.1:1', True), ('*', False), ('x, 127.0.0.1', False),
        ('127.0.0.0/8', True), ('tower', True), ('localhost', True))),
    *(('localhost', {'HTTP_PROXY': 'http://PROXY', 'no_proxy': text}, is_proxied) for text, is_proxied in (
        ('localhost', False), ('.localhost', False), ('LOCALHOST', False), ('localhost:PORT', False), ('ocalhost', True),
        ('127.0.0.1', True))),
    ('127.0.0.1', {'HTTP_PROXY': 'http://PROXY', 'NO_PROXY': '127.0.0.1', 'no_proxy': 'x'}, True),
])  # fmt: skip
def test_all_clients_use_the_same_proxy(
    client: type[S3Store | ObstoreStore], host: str, variables: dict[str, str], proxy: str, tower: FakeS3,
    environ: pytest.MonkeyPatch, *, is_proxied: bool,
) -> None:  # fmt: skip
    """By Python's rules: NO_PROXY has names, suffixes and ports, but no networks, and ALL_PROXY is ignored."""
    for name, text in variables.items():
        environ.setenv(name, text.replace('PROXY', proxy).replace('PORT', str(tower.server_port)))
    with pytest.raises(StoreUnavailable if is_proxied else ObjectRefused, match='502' if is_proxied else 'there is no'):
        get(client, f'http://{host}:{tower.server_port}')


@pytest.mark.parametrize('client', CLIENTS)
def test_an_unreachable_proxy_is_named(client: type[S3Store | ObstoreStore], tower: FakeS3, environ: pytest.MonkeyPatch) -> None:
    """The error is not about Tower."""
    environ.setenv('HTTP_PROXY', 'http://127.0.0.1:9')
    with pytest.raises(StoreUnavailable, match=f'the proxy to {tower.url} cannot be reached') as raised:
        get(client, tower.url)
    assert 'NO_PROXY' in raised.value.remedy


class Recorder(ThreadingHTTPServer):
    """A server without any object, or a proxy for one; it counts requests."""

    def __init__(self) -> None:
        super().__init__(('127.0.0.1', 0), Nothing)
        self.requests = 0

    @property
    def url(self) -> str:
        return f'http://127.0.0.1:{self.server_port}'


class Nothing(BaseHTTPRequestHandler):
    """Responds with 404."""

    server: Recorder

    def do_GET(self) -> None:
        self.server.requests += 1
        self.send_response(404)
        self.send_header('Content-Length', '0')
        self.end_headers()

    def do_HEAD(self) -> None:
        self.do_GET()

    def log_message(self, *_: object) -> None:
        """Quiet."""


@pytest.fixture
def recorders() -> Iterator[tuple[Recorder, Recorder]]:
    """A proxy and a server."""
    made = Recorder(), Recorder()
    threads = [Thread(target=each.serve_forever, kwargs={'poll_interval': 0.01}) for each in made]
    for thread in threads:
        thread.start()
    yield made
    for server, thread in zip(made, threads, strict=True):
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.mark.parametrize(('variables', 'is_proxied'), [
    ({'HTTP_PROXY': 'PROXY'}, True), ({'ALL_PROXY': 'PROXY'}, False),
    ({'HTTP_PROXY': 'PROXY', 'NO_PROXY': '127.0.0.1:PORT'}, False),
    ({'HTTP_PROXY': 'PROXY', 'NO_PROXY': '127.0.0.0/8'}, True), ({'HTTP_PROXY': 'PROXY', 'NO_PROXY': '*'}, False),
])  # fmt: skip
def test_the_tables_of_the_lake_use_the_same_proxy(
    recorders: tuple[Recorder, Recorder], environ: pytest.MonkeyPatch, variables: dict[str, str], *, is_proxied: bool
) -> None:
    """delta-rs reads them, which has a separate S3 client."""
    proxy, server = recorders
    for name, text in variables.items():
        environ.setenv(name, text.replace('PROXY', proxy.url).replace('PORT', str(server.server_port)))
    settings = StoreSettings(endpoint_url=server.url, access_key_id='KEY', secret_access_key='secret')
    with pytest.raises((OSError, DeltaError)):
        DeltaTable('s3://lake/objects', storage_options=storage_options(settings))
    assert (proxy.requests > 0, server.requests > 0) == (is_proxied, not is_proxied)
