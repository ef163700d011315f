"""TLS: each client of a server, and each of our servers, by the same rules.

A client trusts a server with a certificate signed by its operator's CA. Any other certificate is an error that names the
problem and the setting; until it is replaced nothing is sent, in clear text or otherwise.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import ssl
import subprocess
import sys
import uuid
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import aiohttp
import click
import pytest
from click.testing import CliRunner, Result
from doctor.scene import Scene, assert_finding, scenes
from lake.training import Drive
from live.test_relay import GRAPH, Browser, publish, until
from live.test_relay import tower as relaying
from shadowhound_tower.embedded import Tower
from stores.asking import SECRET, error_of, settings_for
from stores.fake_s3 import FakeS3, served
from stores.spooled import QUICK, Spool, with_room
from tls_front import DAY, WRONG, Authority, Secured, behind_tls

from shadowhound_data_logger import lake
from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import (
    DataLoggerError,
    SettingError,
    StoreUnavailable,
    StoreUntrusted,
    TrackingUnavailable,
)
from shadowhound_data_logger.core.model import Put
from shadowhound_data_logger.doctor.model import Severity
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.live import server as live_server
from shadowhound_data_logger.live.access import make_tokens
from shadowhound_data_logger.live.server import LiveServer, LiveSettings
from shadowhound_data_logger.missions.tracking import ENVIRONMENT, MlflowTracking
from shadowhound_data_logger.shipping.failures import Verdict, decide
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.s3 import S3Store
from shadowhound_data_logger.stores.s3_multipart import MULTIPART_BYTES

BODY = b'what the robot saw, which is nobody else to read; ' * 100
RECORDS = {20, 21, 22, 23}
"""Content types of TLS records: change_cipher_spec, alert, handshake, application_data (RFC 8446, 5.1)."""
PATIENT = replace(QUICK, connect_timeout_s=QUICK.read_timeout_s)
"""Handshakes may take long on a busy machine."""
BUNDLES = ('AWS_CA_BUNDLE', 'REQUESTS_CA_BUNDLE', 'MLFLOW_TRACKING_SERVER_CERT_PATH')
MANUAL = Path(__file__).parents[2] / 'docs' / 'tower.md'
CAMERA, IMU = GRAPH
ROBOT, SECONDS = 'secured', 3
OBJECTS = 6 * SECONDS
Ask = Callable[[], object]


def assert_only_tls(server: Secured, *words: bytes) -> None:
    """Nothing but TLS was on the wire, and neither these texts nor a request could be read there."""
    assert server.wire.heard_by_connection
    assert all(received[0] in RECORDS and received[1] == 3 for received in server.wire.heard_by_connection)
    assert not [word for word in (b'PUT /', b'AWS4-HMAC', b'authorization', *words) if word in server.wire.heard]


# -- clients -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Client:
    """A client of a server: its requests, and the variables set by its operator."""

    asks: Callable[[str, Path, ExitStack], Sequence[Ask]]
    """The requests to the server at a URL."""
    untrusted: type[DataLoggerError]
    unavailable: type[DataLoggerError]
    bundle: str = 'AWS_CA_BUNDLE'
    address: str = 'AWS_ENDPOINT_URL'


def delivery(url: str, folder: Path, opened: ExitStack) -> Sequence[Ask]:
    store = opened.enter_context(closing(S3Store(settings_for(url), PATIENT)))
    store.open()
    item = Spool(folder, 'bucket')('thor/secret-name', BODY)
    return (lambda: store.put(item), store.probe, lambda: store.get(item.bucket, item.key))


def reader(url: str, folder: Path, _: ExitStack) -> Sequence[Ask]:
    source = Bucket(settings_for(url), 'sensor-data')

    def fetch(*what: str) -> Ask:
        def ask() -> None:
            error = run('fetch', *what, '--to', str(folder)).exception
            assert error is not None
            raise error

        return ask

    return (lambda: source.get('x', 9), lambda: lake.objects(source).to_pydict(), fetch('thor/'), fetch('--robot', 'thor'))


def tracking(url: str, _folder: Path, _: ExitStack) -> Sequence[Ask]:
    return (lambda: MlflowTracking(url, 'missions').run_of('id', 'name', 0, {}),)


CLIENTS = {
    'delivery': Client(delivery, StoreUntrusted, StoreUnavailable),
    'lake': Client(reader, StoreUntrusted, StoreUnavailable),
    'MLflow': Client(
        tracking, TrackingUnavailable, TrackingUnavailable, 'MLFLOW_TRACKING_SERVER_CERT_PATH', 'MLFLOW_TRACKING_URI'
    ),
}


def run(*arguments: str) -> Result:
    return CliRunner().invoke(cli, arguments, standalone_mode=False)


@pytest.fixture(params=CLIENTS)
def client(request: pytest.FixtureRequest) -> Client:
    return CLIENTS[request.param]


@pytest.fixture
def trusting(authorities: dict[str, Authority], monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], None]:
    """The environment of a client that trusts the CA by this variable alone, with the server at this URL."""

    def trust(variable: str, url: str) -> None:
        for name in BUNDLES:
            monkeypatch.delenv(name, raising=False)
        values = {variable: str(authorities['authority'].path), 'AWS_ENDPOINT_URL': url, 'AWS_ACCESS_KEY_ID': 'KEYID'}
        for name, value in {**ENVIRONMENT, **values, 'AWS_SECRET_ACCESS_KEY': SECRET}.items():
            monkeypatch.setenv(name, value)

    return trust


@pytest.fixture
def opened() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.mark.parametrize('kind', WRONG)
def test_a_wrong_certificate_is_named_and_nothing_is_sent(
    client: Client, kind: str, authorities: dict[str, Authority], trusting: Callable[[str, str], None],
    opened: ExitStack, tmp_path: Path,
) -> None:  # fmt: skip
    """Each kind has a separate message and remedy."""
    signer, how, words, remedy = WRONG[kind]
    server = opened.enter_context(served(FakeS3()))
    front = opened.enter_context(behind_tls(server.url, authorities[signer].sign(kind, **how)))
    trusting(client.bundle, front.url)
    for ask in client.asks(front.url, tmp_path, opened):
        found = error_of(client.untrusted, ask)
        assert words in found
        assert remedy.format(bundle=client.bundle, address=client.address) in found
        assert front.url in found
    assert front.inside.heard == b''
    assert_only_tls(front, BODY[:40], b'thor')


def test_a_wrong_certificate_pauses_delivery() -> None:
    assert decide(StoreUntrusted('x')) is Verdict.PAUSE


class Redirect(BaseHTTPRequestHandler):
    """Redirects every client to another server."""

    target = ''
    asked = 0

    def answer(self) -> None:
        type(self).asked += 1
        self.send_response(307)
        self.send_header('Location', self.target + self.path)
        self.send_header('Content-Length', '0')
        self.end_headers()

    def do_GET(self) -> None:
        self.answer()

    def do_HEAD(self) -> None:
        self.answer()

    def do_POST(self) -> None:
        self.answer()

    def do_PUT(self) -> None:
        self.answer()

    def log_message(self, *_: object) -> None:
        """Log nothing."""


@contextmanager
def redirecting(target: str) -> Iterator[tuple[str, type[Redirect]]]:
    """The URL of such a server, and the class that counts its requests."""
    handler = type('Redirecting', (Redirect,), {'target': target})
    server = ThreadingHTTPServer(('127.0.0.1', 0), handler)
    thread = Thread(target=server.serve_forever, kwargs={'poll_interval': 0.01})
    thread.start()
    try:
        yield f'http://127.0.0.1:{server.server_port}', handler
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_a_redirect_to_plain_http_is_not_followed(
    client: Client, authorities: dict[str, Authority], trusting: Callable[[str, str], None], opened: ExitStack, tmp_path: Path
) -> None:
    """A trusted server cannot make a client send in clear text: only the operator decides that."""
    elsewhere, there = opened.enter_context(redirecting('http://127.0.0.1:1'))
    url, here = opened.enter_context(redirecting(elsewhere))
    front = opened.enter_context(behind_tls(url, authorities['authority'].sign('redirects')))
    trusting(client.bundle, front.url)
    for ask in client.asks(front.url, tmp_path, opened):
        with pytest.raises(client.unavailable):
            ask()
    assert here.asked > 0
    assert there.asked == 0


@pytest.mark.seaweedfs
@pytest.mark.parametrize('variable', ['AWS_CA_BUNDLE', 'REQUESTS_CA_BUNDLE'])
def test_delivery_trusts_a_private_authority(
    variable: str, authorities: dict[str, Authority], seaweed: Tower, trusting: Callable[[str, str], None], spool: Spool
) -> None:
    """Puts, parts, checks, reads and lists use TLS, and the wire shows none of it."""
    with behind_tls(seaweed.endpoint_url, authorities['authority'].sign('good')) as front:
        trusting(variable, front.url)
        with store_at(seaweed, front.url) as store:
            item, large = spool('thor/secret-name', BODY), spool('thor/large', bytes(MULTIPART_BYTES + 1))
            assert with_room(lambda: store.put(item)) is Put.CREATED
            assert store.put(large) is Put.CREATED
            assert store.get(item.bucket, item.key) == BODY
            assert [info.key for info in store.list(item.bucket)] == [large.key, item.key]
            store.probe()
    assert BODY in front.inside.heard
    assert_only_tls(front, BODY[:40], item.key.encode())


@pytest.mark.seaweedfs
def test_delivery_resumes_when_the_certificate_is_renewed(
    authorities: dict[str, Authority], seaweed: Tower, trusting: Callable[[str, str], None], spool: Spool
) -> None:
    """In the same store, without a restart."""
    expired = authorities['authority'].sign('expired', begins=-2 * DAY, ends=-DAY)
    with behind_tls(seaweed.endpoint_url, expired) as front:
        trusting('AWS_CA_BUNDLE', front.url)
        with store_at(seaweed, front.url) as store:
            error_of(StoreUntrusted, lambda: store.put(spool('a', BODY)))
            front.renew(authorities['authority'].sign('renewed'))
            assert with_room(lambda: store.put(spool('a', BODY))) is Put.CREATED


@pytest.fixture
def spool(tmp_path: Path) -> Spool:
    return Spool(tmp_path, f'bucket-{uuid.uuid4().hex[:12]}')


@contextmanager
def store_at(seaweed: Tower, url: str) -> Iterator[S3Store]:
    """The store with another address."""
    with closing(S3Store(replace(seaweed.store_settings(), endpoint_url=url), PATIENT)) as store:
        store.open()
        yield store


@pytest.mark.seaweedfs
@pytest.mark.long('a second of CPU or more')
def test_the_lake_trusts_a_private_authority(
    authorities: dict[str, Authority], seaweed: Tower, trusting: Callable[[str, str], None], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Queries, fetches, the verification and datasets all use TLS."""
    Drive(seaweed.store_settings(), tmp_path / 'drive', ROBOT).record(SECONDS)
    with behind_tls(seaweed.endpoint_url, authorities['authority'].sign('good')) as front:
        trusting('AWS_CA_BUNDLE', front.url)
        for name, value in {**seaweed.environment(), 'AWS_ENDPOINT_URL': front.url}.items():
            monkeypatch.setenv(name, value)
        source = Bucket(replace(seaweed.store_settings(), endpoint_url=front.url), 'sensor-data')
        assert len(lake.objects(source, robot=ROBOT)['key'].to_pylist()) == OBJECTS
        fetched = run('fetch', '--robot', ROBOT, '--to', str(tmp_path / 'data'), '--json')
        assert json.loads(fetched.stdout)['moved'] == OBJECTS
        verified = run('lake', 'verify', '--robot', ROBOT, '--deep', '--json')
        assert (verified.return_value, json.loads(verified.stdout)['sound']) == (0, OBJECTS)
        with closing(lake.MissionDataset(source, robot=ROBOT, align={'odom': 0.5})) as frames:
            assert [bool(frame['odom_ok']) for frame in frames.stream()] == [True] * SECONDS
    assert b'GET /sensor-data' in front.inside.heard
    assert_only_tls(front, ROBOT.encode())


def test_without_a_bundle_the_authorities_of_the_system_decide(
    authorities: dict[str, Authority], trusting: Callable[[str, str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """They do not include this CA, and the message names the variable."""
    with served(FakeS3()) as server, behind_tls(server.url, authorities['authority'].sign('plain')) as front:
        trusting('AWS_CA_BUNDLE', front.url)
        monkeypatch.delenv('AWS_CA_BUNDLE')
        with pytest.raises(StoreUntrusted, match='AWS_CA_BUNDLE'):
            Bucket(settings_for(front.url), 'sensor-data').folders('')
    assert front.inside.heard == b''


def test_the_certificate_of_an_authority_is_not_one_of_a_server(
    authorities: dict[str, Authority], trusting: Callable[[str, str], None]
) -> None:
    """Not even that of the trusted authority."""
    with served(FakeS3()) as server, behind_tls(server.url, authorities['authority'].itself()) as front:
        trusting('AWS_CA_BUNDLE', front.url)
        with pytest.raises(StoreUntrusted, match='is a CA certificate, which'):
            Bucket(settings_for(front.url), 'sensor-data').folders('')
    assert front.inside.heard == b''


@pytest.mark.parametrize('content', [None, 'no certificate'])
def test_an_invalid_ca_bundle_aborts_startup(
    content: str | None, trusting: Callable[[str, str], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is named before any request, as wrong usage on the command line. Without https it does not matter."""
    path, url = tmp_path / 'ca.pem', 'https://127.0.0.1:1'
    if content:
        path.write_text(content)
    trusting('AWS_CA_BUNDLE', url)
    monkeypatch.setenv('AWS_CA_BUNDLE', str(path))
    for ask in (lambda: open_store(settings_for(url), UploadSettings()), lambda: Bucket(settings_for(url), 'x').folders('')):
        with pytest.raises(SettingError) as caught:
            ask()
        assert caught.value.data['name'] == 'AWS_CA_BUNDLE'
        assert str(path) in str(caught.value)
    found = run('query', '--robot', 'thor')
    assert isinstance(found.exception, click.UsageError)
    assert 'AWS_CA_BUNDLE' in str(found.exception)
    open_store(settings_for(url.replace('https', 'http')), UploadSettings()).close()


# -- the doctor --------------------------------------------------------------------------------------------------------


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[Scene]:
    yield from scenes(tmp_path)


@pytest.fixture(params=['s3', 'mlflow'])
def service(request: pytest.FixtureRequest) -> tuple[str, Client]:
    """Its name in the doctor's checks, and its client."""
    return request.param, CLIENTS['MLflow' if request.param == 'mlflow' else 'delivery']


FINDINGS = {
    'unknown': ('/etc/shadowhound/ca.pem',), 'expired': ('-dates', 'renew it'), 'early': ('-dates', 'timedatectl'),
    'host': ('subjectAltName',),
}  # fmt: skip


@pytest.mark.parametrize('kind', FINDINGS)
def test_the_doctor_names_a_wrong_certificate(
    scene: Scene, authorities: dict[str, Authority], service: tuple[str, Client], kind: str
) -> None:
    """The checks that would send something to this server are skipped."""
    name, client = service
    signer, how, *_ = WRONG[kind]
    with served(FakeS3()) as server, behind_tls(server.url, authorities[signer].sign(kind, **how)) as front:
        scene.environ |= {client.bundle: str(authorities['authority'].path), client.address: front.url}
        results = scene.ask(f'network.{name}', name)
    assert_finding([result for result in results if result.is_finding], f'network.{name}.tls.{kind}', *FINDINGS[kind])
    assert results[-1].severity is Severity.SKIPPED
    assert front.inside.heard == b''


def test_the_doctor_accepts_a_certificate_of_the_trusted_authority(
    scene: Scene, authorities: dict[str, Authority], service: tuple[str, Client]
) -> None:
    """Each client by its variable; behind TLS the server is identified as well as without."""
    name, client = service
    scene.environ |= {client.bundle: str(authorities['authority'].path), 'AWS_ACCESS_KEY_ID': 'a', 'AWS_SECRET_ACCESS_KEY': 'b'}
    with served(FakeS3()) as server, behind_tls(server.url, authorities['authority'].sign('good')) as front:
        scene.environ[client.address] = front.url
        assert scene.findings(f'network.{name}') == []
        if name == 's3':
            found = {result.check: result.severity for result in scene.ask('s3')}
            assert found['s3.server'] == found['s3.clock'] == Severity.OK


def test_the_doctor_proposes_plain_http_where_the_port_has_no_tls(scene: Scene) -> None:
    """With the working URL."""
    with served(FakeS3()) as server:
        scene.environ['AWS_ENDPOINT_URL'] = server.url.replace('http:', 'https:')
        assert_finding(scene.findings('network.s3'), 'network.s3.tls', f'export AWS_ENDPOINT_URL={server.url}')


def test_the_doctor_names_a_bundle_that_is_missing(scene: Scene, authorities: dict[str, Authority]) -> None:
    """The server is not reported."""
    with served(FakeS3()) as server, behind_tls(server.url, authorities['authority'].sign('good')) as front:
        scene.environ |= {'AWS_ENDPOINT_URL': front.url, 'AWS_CA_BUNDLE': '/nowhere/ca.pem'}
        assert_finding(scene.findings('network.s3'), 'network.s3.tls', 'ls -l /nowhere/ca.pem')


# -- the live page -----------------------------------------------------------------------------------------------------


@asynccontextmanager
async def secured(folder: Path, certificate: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[LiveServer]:
    """A robot's page with https, for users with a token."""
    monkeypatch.setattr(live_server, 'find_spec', lambda _: None)  # no ROS here
    settings = LiveSettings(
        spool=folder / 'spool', robot='thor', tokens=folder / 'live', bind='0.0.0.0', port=0, certificate=certificate
    )
    server = LiveServer(settings)
    await server.open()
    try:
        yield server
    finally:
        await server.close()


def context_of(authority: Path) -> ssl.SSLContext:
    return ssl.create_default_context(cafile=str(authority))


async def looks_at(server: LiveServer, token: str, authority: Path) -> None:
    """Sign in and watch, over https alone."""
    origin = f'https://127.0.0.1:{server.port}'
    connector = aiohttp.TCPConnector(ssl=context_of(authority))
    jar = aiohttp.CookieJar(unsafe=True)  # an address works as well as a name
    async with aiohttp.ClientSession(headers={'Origin': origin}, connector=connector, cookie_jar=jar) as session:
        async with session.get(f'{origin}/') as answer:
            assert answer.status == 200
            assert 'Strict-Transport-Security' not in answer.headers  # other ports of this name need not have https
        async with session.post(f'{origin}/api/session', json={'token': token}) as answer:
            assert answer.status == 200
            cookie = answer.cookies['shadowhound_live']
            assert (cookie['secure'], cookie['httponly'], cookie['samesite']) == (True, True, 'Strict')
        async with session.ws_connect(f'wss://127.0.0.1:{server.port}/ws') as ws:
            await ws.send_json({'ping': 7})
            while b'"ping":7,' not in await ws.receive_bytes(timeout=60):
                pass
        plain = {'Origin': origin.replace('https', 'http')}
        async with session.post(f'{origin}/api/session', json={'token': token}, headers=plain) as answer:
            assert answer.status == 403  # a page over http is a different origin


def test_the_page_and_its_stream_come_over_https(
    tmp_path: Path, authorities: dict[str, Authority], monkeypatch: pytest.MonkeyPatch
) -> None:
    """For clients that trust the CA; the browser never sends the cookie over http."""

    async def run() -> None:
        authority = authorities['authority']
        async with secured(tmp_path, authority.sign('page'), monkeypatch) as server:
            assert server.url.startswith('https://')
            await looks_at(server, (tmp_path / 'live' / 'viewer.token').read_text().strip(), authority.path)
            with pytest.raises(aiohttp.ClientConnectorCertificateError):
                await looks_at(server, 'x', authorities['stranger'].path)

    asyncio.run(run())


def test_plain_http_gets_nothing_from_that_port(
    tmp_path: Path, authorities: dict[str, Authority], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither the page nor the token form, nor their address."""

    async def run() -> None:
        async with secured(tmp_path, authorities['authority'].sign('page'), monkeypatch) as server:
            for path in ('/', '/api/session', '/ws'):
                reader, writer = await asyncio.open_connection('127.0.0.1', server.port)
                writer.write(f'GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n\r\n'.encode())
                report = b''
                with suppress(ConnectionError):
                    report = await asyncio.wait_for(reader.read(), 60)
                assert b'HTTP' not in report
                writer.close()

    asyncio.run(run())


def test_a_relay_sends_its_token_only_to_a_trusted_server(
    tmp_path: Path, authorities: dict[str, Authority], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page of the store names the certificate as the reason, and continues."""
    tokens = make_tokens(tmp_path / 'live')

    async def run() -> None:
        async with AsyncExitStack() as stack:
            robot = await stack.enter_async_context(secured(tmp_path, authorities['stranger'].sign('page'), monkeypatch))
            asked: list[str] = []
            monkeypatch.setattr(robot.auth.access, 'sign_in', lambda token, _: asked.append(token))
            page = await stack.enter_async_context(relaying(tmp_path, f'https://127.0.0.1:{robot.port}', tokens['viewer']))
            browser = Browser()
            task = asyncio.create_task(browser.run(page))
            await until(lambda: 'certificate' in browser.newest.get('topics', ({'problem': ''},))[0]['problem'])
            assert asked == []
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    asyncio.run(run())


def made_by_the_manual(folder: Path) -> tuple[Path, tuple[Path, Path]]:
    """The CA, and certificate and key, from the commands in docs/tower.md, for this machine's address."""
    text = MANUAL.read_text(encoding='utf-8')
    lines = re.search(r'((?:    .*\n)+)', text[text.index('\n## TLS') :])
    assert lines
    subprocess.run(['bash', '-ec', lines[1].replace('192.168.1.10', '127.0.0.1')], cwd=folder, check=True, capture_output=True)
    made = folder / 'tower' / 'tls'
    return made / 'ca.pem', (made / 'tower.crt', made / 'tower.key')


@asynccontextmanager
async def store_page(folder: Path, robot: LiveServer, token: Path, trusted: Path) -> AsyncIterator[Any]:
    """``shadowhound-data live --robot-url https://...`` in a separate process, with SSL_CERT_FILE; yields its port."""
    environ = {**os.environ, 'SHADOWHOUND_HOME': str(folder / 'tower_home'), 'SSL_CERT_FILE': str(trusted)}
    environ.pop('AWS_ENDPOINT_URL', None)
    process = await asyncio.create_subprocess_exec(
        sys.executable, '-m', 'shadowhound_data_logger.cli.main', 'live', '--json', '--port', '0', '--robot', 'thor',
        '--robot-url', f'https://127.0.0.1:{robot.port}', '--robot-token', str(token), env=environ,
        stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.DEVNULL,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        report = b''
        while not report.endswith(b'\n}\n'):
            line = await asyncio.wait_for(process.stdout.readline(), 60)
            assert line, report
            report += line
        yield SimpleNamespace(port=urlsplit(json.loads(report)['url']).port)
    finally:
        process.terminate()
        await asyncio.wait_for(process.communicate(), 60)


@pytest.mark.long('a process for each')
@pytest.mark.parametrize('what', ['by the manual', 'of a stranger', 'for another address', 'expired'])
def test_a_store_page_relays_a_robot_that_it_trusts(
    tmp_path: Path, what: str, authorities: dict[str, Authority], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the CA in SSL_CERT_FILE; otherwise it shows why there is no live view."""
    authority = authorities['authority']
    trusted = authority.path
    if what == 'by the manual':
        trusted, certificate = made_by_the_manual(tmp_path)
    elif what == 'of a stranger':
        certificate = authorities['stranger'].sign('page')
    elif what == 'for another address':
        certificate = authority.sign('page', '10.0.0.1')
    else:
        certificate = authority.sign('page', begins=timedelta(days=-2), ends=timedelta(hours=-1))

    async def run() -> None:
        async with AsyncExitStack() as stack:
            robot = await stack.enter_async_context(secured(tmp_path, certificate, monkeypatch))
            robot.viewers.on_graph(GRAPH)
            token = tmp_path / 'live' / 'viewer.token'
            page = await stack.enter_async_context(store_page(tmp_path, robot, token, trusted))
            browser = Browser()
            task = asyncio.create_task(browser.run(page))
            if what == 'by the manual':
                number = 0
                while not {CAMERA, IMU} <= browser.newest.keys():
                    publish(robot, number := number + 1)
                    await asyncio.sleep(0.02)
                assert [one.who.role for one in robot.viewers.connected] == ['viewer']
            else:
                await until(lambda: 'certificate' in browser.newest.get('topics', ({'problem': ''},))[0]['problem'])
                assert not robot.viewers.connected
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    asyncio.run(run())
