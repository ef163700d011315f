"""The page over https, with certificates such as docs/tower.md tells how to make, and a store's page that relays it."""

from __future__ import annotations

import asyncio
import json
import os
import re
import ssl
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import aiohttp
import pytest
from live.test_relay import GRAPH, Browser, publish, tower, until

from shadowhound_data_logger.live import server as module
from shadowhound_data_logger.live.access import make_tokens
from shadowhound_data_logger.live.server import LiveServer, LiveSettings

if TYPE_CHECKING:
    from stores.certificates import Authority

MANUAL = Path(__file__).parents[2] / 'docs' / 'tower.md'
CAMERA, IMU = GRAPH


@asynccontextmanager
async def secured(folder: Path, certificate: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[LiveServer]:
    """A robot's page behind https, for whoever has a token."""
    monkeypatch.setattr(module, 'find_spec', lambda _: None)  # no ROS here
    settings = LiveSettings(
        spool=folder / 'spool', robot='thor', tokens=folder / 'live', bind='0.0.0.0', port=0, certificate=certificate
    )
    server = LiveServer(settings)
    await server.open()
    try:
        yield server
    finally:
        await server.close()


def trusting(authority: Path) -> ssl.SSLContext:
    return ssl.create_default_context(cafile=str(authority))


async def looks_at(server: LiveServer, token: str, authority: Path) -> None:
    """Sign in and watch, over https alone."""
    origin = f'https://127.0.0.1:{server.port}'
    connector = aiohttp.TCPConnector(ssl=trusting(authority))
    jar = aiohttp.CookieJar(unsafe=True)  # an address is as good as a name
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
            assert answer.status == 403  # a page that came over http is another one


def test_the_page_and_its_stream_come_over_https(
    tmp_path: Path, authorities: dict[str, Authority], monkeypatch: pytest.MonkeyPatch
) -> None:
    """For whoever trusts the authority; the cookie never leaves the browser over http."""

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
    """Neither the page nor the form for a token, nor where they are."""

    async def run() -> None:
        async with secured(tmp_path, authorities['authority'].sign('page'), monkeypatch) as server:
            for path in ('/', '/api/session', '/ws'):
                reader, writer = await asyncio.open_connection('127.0.0.1', server.port)
                writer.write(f'GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n\r\n'.encode())
                said = b''
                with suppress(ConnectionError):
                    said = await asyncio.wait_for(reader.read(), 60)
                assert b'HTTP' not in said
                writer.close()

    asyncio.run(run())


def test_a_relay_sends_its_token_only_to_a_trusted_server(
    tmp_path: Path, authorities: dict[str, Authority], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page of the store says that it is the certificate, and goes on."""
    tokens = make_tokens(tmp_path / 'live')

    async def run() -> None:
        async with AsyncExitStack() as stack:
            robot = await stack.enter_async_context(secured(tmp_path, authorities['stranger'].sign('page'), monkeypatch))
            asked: list[str] = []
            monkeypatch.setattr(robot.auth.access, 'sign_in', lambda token, _: asked.append(token))
            page = await stack.enter_async_context(tower(tmp_path, f'https://127.0.0.1:{robot.port}', tokens['viewer']))
            browser = Browser()
            task = asyncio.create_task(browser.run(page))
            await until(lambda: 'certificate' in browser.newest.get('topics', ({'problem': ''},))[0]['problem'])
            assert asked == []
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    asyncio.run(run())


def made_by_the_manual(folder: Path) -> tuple[Path, tuple[Path, Path]]:
    """The authority, and certificate and key, of the commands in docs/tower.md, for this machine's address."""
    text = MANUAL.read_text(encoding='utf-8')
    lines = re.search(r'((?:    .*\n)+)', text[text.index('\n## TLS') :])
    assert lines
    subprocess.run(['bash', '-ec', lines[1].replace('192.168.1.10', '127.0.0.1')], cwd=folder, check=True, capture_output=True)
    made = folder / 'tower' / 'tls'
    return made / 'ca.pem', (made / 'tower.crt', made / 'tower.key')


@asynccontextmanager
async def store_page(folder: Path, robot: LiveServer, token: Path, trusted: Path) -> AsyncIterator[Any]:
    """``shadowhound-data live --robot-url https://...`` in a process of its own, with SSL_CERT_FILE; what has its port."""
    environ = {**os.environ, 'SHADOWHOUND_HOME': str(folder / 'tower_home'), 'SSL_CERT_FILE': str(trusted)}
    environ.pop('AWS_ENDPOINT_URL', None)
    process = await asyncio.create_subprocess_exec(
        sys.executable, '-m', 'shadowhound_data_logger.cli.main', 'live', '--json', '--port', '0', '--robot', 'thor',
        '--robot-url', f'https://127.0.0.1:{robot.port}', '--robot-token', str(token), env=environ,
        stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.DEVNULL,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        said = b''
        while not said.endswith(b'\n}\n'):
            line = await asyncio.wait_for(process.stdout.readline(), 60)
            assert line, said
            said += line
        yield SimpleNamespace(port=urlsplit(json.loads(said)['url']).port)
    finally:
        process.terminate()
        await asyncio.wait_for(process.communicate(), 60)


@pytest.mark.long('a process for each')
@pytest.mark.parametrize('what', ['by the manual', 'of a stranger', 'for another address', 'expired'])
def test_a_store_page_relays_a_robot_that_it_trusts(
    tmp_path: Path, what: str, authorities: dict[str, Authority], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the authority that SSL_CERT_FILE names; else it says why there is no live view."""
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
