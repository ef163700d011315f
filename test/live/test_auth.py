"""Authorization: a table of requests to the real server, and the responses to clients without permission."""

from __future__ import annotations

import asyncio
import json
import logging
import re
import stat
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from hashlib import sha256
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import aiohttp
import pytest

from shadowhound_data_logger.live import acts as acts_module
from shadowhound_data_logger.live import answers as answers_module
from shadowhound_data_logger.live import server as module
from shadowhound_data_logger.live import viewers as viewers_module
from shadowhound_data_logger.live.access import LASTS_S, MAX_FAILURES, SIGN_OUTS_FILE, OwnNames, make_tokens
from shadowhound_data_logger.live.auth import MAX_BODY
from shadowhound_data_logger.live.server import LiveServer, LiveSettings
from shadowhound_data_logger.live.viewers import MAX_MESSAGE, MAX_VIEWERS

WHO = ('stranger', 'viewer', 'operator')
UPGRADE = {'Connection': 'Upgrade', 'Upgrade': 'websocket', 'Sec-WebSocket-Version': '13',
           'Sec-WebSocket-Key': 'AAAAAAAAAAAAAAAAAAAAAA=='}  # fmt: skip


class Page:
    """A server, and a client that signs in with a given role."""

    def __init__(self, server: LiveServer, folder: Path) -> None:
        self.server, self.folder = server, folder
        self.origin = f'http://127.0.0.1:{server.port}'
        self.cookies: dict[str, str] = {}
        self.csrf: dict[str, str] = {}

    def token(self, role: str) -> str:
        return (self.folder / f'{role}.token').read_text().strip()

    async def sign_in(self, role: str) -> None:
        async with aiohttp.ClientSession(headers={'Origin': self.origin}) as session:
            answer = await session.post(f'{self.origin}/api/session', json={'token': self.token(role)})
            assert answer.status == 200
            cookie = answer.cookies['shadowhound_live']
            assert cookie['httponly']
            assert cookie['samesite'] == 'Strict'
            self.cookies[role] = cookie.value
            self.csrf[role] = (await answer.json())['csrf']

    async def ask(self, who: str, method: str, path: str, *, csrf: bool = True, headers: dict[str, str] | None = None,
                  body: bytes = b'') -> tuple[int, dict[str, str], bytes]:  # fmt: skip
        """As a raw request: clients would normalize a path with ``..``."""
        reader, writer = await asyncio.open_connection('127.0.0.1', self.server.port)
        given = {'Host': f'127.0.0.1:{self.server.port}', 'Connection': 'close', 'Content-Length': str(len(body))}
        if method == 'POST' or path == '/ws':
            given['Origin'] = self.origin
        if path == '/ws':
            given |= {
                'Connection': 'Upgrade',
                'Upgrade': 'websocket',
                'Sec-WebSocket-Version': '13',
                'Sec-WebSocket-Key': 'AAAAAAAAAAAAAAAAAAAAAA==',
            }
        if who != 'stranger':
            given['Cookie'] = f'shadowhound_live={self.cookies[who]}'
            if csrf and method == 'POST':
                given['X-CSRF-Token'] = self.csrf[who]
        given |= headers or {}
        lines = [f'{method} {path} HTTP/1.1', *(f'{name}: {value}' for name, value in given.items() if value), '', '']
        writer.write('\r\n'.join(lines).encode(errors='surrogateescape') + body)
        await writer.drain()
        head = await asyncio.wait_for(reader.readuntil(b'\r\n\r\n'), 60.0)
        answer = {} if path == '/ws' else await asyncio.wait_for(reader.read(), 60.0)
        writer.close()
        fields = dict(line.split(': ', 1) for line in head.decode().split('\r\n')[1:] if ': ' in line)
        return int(head.split()[1]), fields, answer or b''


async def ended(ws: aiohttp.ClientWebSocketResponse) -> None:
    """Wait until the server has closed it."""
    while not ws.closed:
        await ws.receive(60.0)


async def answers(ws: aiohttp.ClientWebSocketResponse, ping: int) -> None:
    """Wait until a viewer's ping is answered, which happens only while the viewer may watch."""
    await ws.send_json({'ping': ping})
    while f'"ping":{ping},'.encode() not in (await ws.receive_bytes(timeout=60.0)):
        pass


@asynccontextmanager
async def serving(folder: Path, monkeypatch: pytest.MonkeyPatch, bind: str = '0.0.0.0', **settings: Any) -> AsyncIterator[Page]:
    monkeypatch.setattr(module, 'find_spec', lambda _: None)  # no ROS here
    monkeypatch.setenv('SHADOWHOUND_HOME', str(folder))
    monkeypatch.delenv('AWS_ENDPOINT_URL', raising=False)
    server = LiveServer(LiveSettings(spool=folder / 'spool', robot='thor', tokens=folder / 'live', bind=bind, port=0, **settings))
    await server.open()
    try:
        page = Page(server, folder / 'live')
        for role in WHO[1:]:
            await page.sign_in(role)
        yield page
    finally:
        await server.close()


ACT = json.dumps({'do': 'flush'}).encode()
LABEL = b'{"robot": "thor", "label": "x", "from": 5, "to": 5}'
CUT = b'{"robot": "thor", "bag": "bumped", "from": 5, "to": 6}'
PULL = b'{"robot": "thor", "sensor": "x", "from": 5, "to": 6}'
POLICY = {
    'default-src': "'none'", 'script-src': "'self'", 'style-src': "'self'", 'img-src': "'self'", 'connect-src': "'self'",
    'font-src': "'self'", 'manifest-src': "'self'", 'base-uri': "'none'", 'form-action': "'self'", 'frame-ancestors': "'none'",
}  # fmt: skip
"""What the page may load and which sites may frame it: nothing inline, no eval, nothing from other hosts."""
KEEPING_OUT = {
    'X-Content-Type-Options': 'nosniff', 'X-Frame-Options': 'DENY', 'Referrer-Policy': 'no-referrer',
    'Cross-Origin-Opener-Policy': 'same-origin', 'Cross-Origin-Resource-Policy': 'same-origin',
}  # fmt: skip
REBOUND = {'Host': 'evil.example:8765'}
FOREIGN = {'Origin': 'http://evil.example'}
CHUNKED = b'2000\r\n' + b'x' * 0x2000 + b'\r\n0\r\n\r\n'
IN_CHUNKS = {'Content-Length': '', 'Transfer-Encoding': 'chunked'}
TABLE: tuple[tuple[str, str, dict[str, Any], tuple[int, int, int]], ...] = (
    # method, path, options, and the status for a stranger, a viewer and an operator
    ('GET', '/', {}, (200, 200, 200)),
    ('GET', '/app.js', {}, (200, 200, 200)),
    ('GET', '/../server.py', {}, (404, 404, 404)),
    ('GET', '/%2e%2e/server.py', {}, (404, 404, 404)),
    ('GET', '/..%2f..%2fetc/passwd', {}, (404, 404, 404)),
    ('GET', '//etc/passwd', {}, (404, 404, 404)),
    ('GET', '/', {'headers': REBOUND}, (403, 403, 403)),
    ('GET', '/api/session', {}, (401, 200, 200)),
    ('GET', '/api/session', {'headers': REBOUND}, (403, 403, 403)),
    ('GET', '/viewer.token', {}, (404, 404, 404)),
    ('GET', '/api/past/robots', {}, (401, 200, 200)),
    ('GET', '/api/gaps', {}, (401, 503, 503)),  # no spool
    ('GET', '/api/gaps?from=-1', {}, (401, 400, 400)),
    ('GET', '/api/past/days', {}, (401, 503, 503)),  # no spool
    ('GET', '/api/past/days?robot=../x', {}, (401, 400, 400)),
    ('GET', '/api/past/moment?at=1e9', {}, (401, 400, 400)),
    ('GET', '/api/past/moment', {}, (401, 400, 400)),
    ('GET', '/api/past/timeline?from=0&to=99999999999999', {}, (401, 400, 400)),
    ('GET', '/api/past/..%2f..%2fx', {}, (401, 404, 404)),
    ('GET', '/api/past/days', {'headers': REBOUND}, (403, 403, 403)),
    ('GET', '/api/doctor', {'headers': REBOUND}, (403, 403, 403)),
    ('GET', '/ws', {}, (401, 101, 101)),
    ('GET', '/ws', {'headers': FOREIGN}, (403, 403, 403)),
    ('GET', '/ws', {'headers': {'Origin': ''}}, (403, 403, 403)),
    ('POST', '/api/act', {'body': ACT}, (401, 403, 200)),
    ('POST', '/api/act', {'body': ACT, 'csrf': False}, (401, 403, 403)),
    ('POST', '/api/act', {'body': ACT, 'headers': FOREIGN}, (403, 403, 403)),
    ('POST', '/api/act', {'body': ACT, 'headers': {'Origin': ''}}, (403, 403, 403)),
    ('POST', '/api/act', {'body': ACT, 'headers': REBOUND}, (403, 403, 403)),
    ('POST', '/api/act', {'body': b'{"do": "set", "values": {}}'}, (401, 403, 400)),
    ('POST', '/api/act', {'body': b'{"do": "flush", "who": "somebody else"}'}, (401, 403, 400)),
    ('POST', '/api/act', {'body': b'{' * 100}, (401, 403, 400)),
    ('POST', '/api/act', {'body': b' ' * (MAX_BODY + 1)}, (413, 413, 413)),
    ('POST', '/api/session', {'body': b' ' * (MAX_BODY + 1)}, (413, 413, 413)),
    ('POST', '/api/label', {'body': LABEL}, (401, 403, 200)),
    ('POST', '/api/label', {'body': LABEL, 'csrf': False}, (401, 403, 403)),
    ('POST', '/api/label', {'body': LABEL, 'headers': FOREIGN}, (403, 403, 403)),
    ('POST', '/api/label', {'body': LABEL.replace(b'thor', b'../x')}, (401, 403, 400)),
    ('POST', '/api/label', {'body': LABEL.replace(b'"x"', b'["x"]')}, (401, 403, 400)),
    ('POST', '/api/label', {'body': LABEL.replace(b'5', b'true')}, (401, 403, 400)),
    ('POST', '/api/label', {'body': LABEL.replace(b'x', b'x' * MAX_BODY)}, (413, 413, 413)),
    ('GET', '/api/label', {}, (401, 404, 404)),
    ('POST', '/api/pull', {'body': PULL}, (401, 403, 503)),  # no spool
    ('POST', '/api/pull', {'body': PULL, 'csrf': False}, (401, 403, 403)),
    ('POST', '/api/pull', {'body': PULL, 'headers': FOREIGN}, (403, 403, 403)),
    ('POST', '/api/pull', {'body': PULL.replace(b'thor', b'../x')}, (401, 403, 400)),
    ('POST', '/api/pull', {'body': PULL.replace(b'"x"', b'5')}, (401, 403, 400)),
    ('POST', '/api/pull', {'body': PULL.replace(b'6', b'-6')}, (401, 403, 400)),
    ('GET', '/api/past/requests', {}, (401, 503, 503)),  # no spool
    ('GET', '/api/past/recent', {}, (401, 200, 200)),  # empty without a spool
    ('GET', '/api/past/range?from=5&to=6', {}, (401, 503, 503)),
    ('GET', '/api/past/range?from=5', {}, (401, 400, 400)),
    ('GET', '/api/past/fleet', {}, (401, 200, 200)),
    ('POST', '/api/cut', {'body': CUT}, (401, 503, 503)),  # no such bag
    ('POST', '/api/cut', {'body': CUT, 'csrf': False}, (401, 403, 403)),
    ('POST', '/api/cut', {'body': CUT, 'headers': FOREIGN}, (403, 403, 403)),
    ('POST', '/api/cut', {'body': CUT.replace(b'bumped', b'../x')}, (401, 400, 400)),
    ('POST', '/api/cut', {'body': CUT.replace(b'thor', b'$(reboot)')}, (401, 400, 400)),
    ('POST', '/api/cut', {'body': CUT.replace(b'6', b'600006')}, (401, 400, 400)),
    ('GET', '/api/cut', {}, (401, 404, 404)),
    ('GET', '/cut/x.mcap', {}, (404, 404, 404)),
    ('GET', '/cut/..%2f..%2fx.mcap', {}, (404, 404, 404)),
    ('GET', '/cut/x.mcap', {'headers': REBOUND}, (403, 403, 403)),
    ('GET', '/api/past/kept?from=5', {}, (401, 400, 400)),
    ('POST', '/api/sign-out', {'csrf': False}, (401, 403, 403)),
    ('DELETE', '/api/session', {}, (403, 403, 403)),
    ('POST', '/api/act', {'body': CHUNKED, 'headers': IN_CHUNKS}, (401, 403, 413)),
    ('POST', '/api/session', {'body': CHUNKED, 'headers': IN_CHUNKS}, (413, 413, 413)),
    # bytes that are not text
    ('GET', '/', {'headers': {'Host': '\udcff'}}, (403, 403, 403)),
    ('GET', '/api/session', {'headers': {'Cookie': 'shadowhound_live=viewer.9999999999.\udcff.x'}}, (401, 401, 401)),
    ('GET', '/api/session', {'headers': {'Cookie': 'shadowhound_live=viewer.9999999999.x.\udcff'}}, (401, 401, 401)),
    ('POST', '/api/act', {'body': ACT, 'headers': {'X-CSRF-Token': '\udcff'}}, (401, 403, 403)),
    ('POST', '/api/act', {'body': b'\xff'}, (401, 403, 400)),
    ('POST', '/api/act', {'body': b'{"do": "event", "name": "\\ud800"}'}, (401, 403, 200)),
    ('POST', '/api/label', {'body': LABEL.replace(b'x', b'\\ud800')}, (401, 403, 400)),
    ('POST', '/api/session', {'body': b'{"token": "\\ud800"}'}, (401, 401, 401)),
)


def policy(headers: dict[str, str]) -> dict[str, str]:
    """Directive -> sources, from a response's Content-Security-Policy."""
    parts = (part.strip().partition(' ') for part in headers['Content-Security-Policy'].split(';'))
    return {directive: sources for directive, _, sources in parts}


def test_each_request_is_allowed_for_its_roles_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each as a stranger, as a viewer and as an operator; every response has the security headers, and no token."""

    async def run() -> None:
        async with serving(tmp_path, monkeypatch) as page:
            found, expected = [], []
            for method, path, special, statuses in TABLE:
                for who, status in zip(WHO, statuses, strict=True):
                    given, headers, body = await page.ask(who, method, path, **special)
                    case = f'{who}: {method} {path} {special}'
                    found.append((case, given))
                    expected.append((case, status))
                    if given != 101:
                        assert policy(headers) == POLICY, case
                        assert KEEPING_OUT.items() <= headers.items(), case
                    assert not any(page.token(role) in f'{headers} {body!r}' for role in WHO[1:]), case
            assert found == expected

    asyncio.run(run())


def test_each_act_names_its_operator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The operator and the address, for its log and for the manifest of an event; the page cannot send another name."""
    asked: list[tuple[str, dict[str, str]]] = []

    def ask(do: str, **given: str) -> dict[str, Any]:
        asked.append((do, given))
        return {'ok': True}

    monkeypatch.setattr(acts_module, 'connect', lambda *_: SimpleNamespace(ask=ask, close=lambda: None))

    async def run() -> None:
        async with serving(tmp_path, monkeypatch) as page:
            for do in ('flush', 'pause', 'resume', 'bag start', 'bag stop', 'bag split', 'event'):
                assert (await page.ask('operator', 'POST', '/api/act', body=json.dumps({'do': do}).encode()))[0] == 200
                by = {'by': 'page'} if do == 'event' else {}
                assert asked.pop() == (do, {'who': 'operator at 127.0.0.1', **by})

    asyncio.run(run())


def test_clients_with_wrong_tokens_must_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a few, an address is refused for a while, even with a valid token; existing sign-ins continue."""

    async def run() -> None:
        async with serving(tmp_path, monkeypatch) as page:
            statuses = [
                (await page.ask('stranger', 'POST', '/api/session', body=b'{"token": "guess"}'))[0]
                for _ in range(MAX_FAILURES + 2)
            ]
            assert statuses == [401] * MAX_FAILURES + [429] * 2
            right = json.dumps({'token': page.token('operator')}).encode()
            status, headers, _ = await page.ask('stranger', 'POST', '/api/session', body=right)
            assert (status, 0 < int(headers['Retry-After']) <= 60) == (429, True)
            assert (await page.ask('viewer', 'GET', '/api/session'))[0] == 200

    asyncio.run(run())


def test_a_sign_in_ends_with_a_sign_out_and_with_a_new_token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The cookie is invalid then, including copies."""

    async def run() -> None:
        async with serving(tmp_path, monkeypatch) as page:
            assert (await page.ask('viewer', 'POST', '/api/sign-out'))[0] == 200
            assert (await page.ask('viewer', 'GET', '/api/session'))[0] == 401
            assert (await page.ask('operator', 'GET', '/api/session'))[0] == 200
            make_tokens(page.folder, replace=True)
            assert (await page.ask('operator', 'GET', '/api/session'))[0] == 401

    asyncio.run(run())


@pytest.mark.parametrize('bind', ['0.0.0.0', '127.0.0.1'])
def test_a_sign_in_replaces_the_previous_cookie(bind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Including copies of that cookie, also after the page restarts; a wrong token or a forged cookie ends nothing."""
    monkeypatch.setattr(module, 'CHECK_S', 0.05)
    right, wrong = (json.dumps({'token': token}).encode() for token in ('{}', 'x' * 30))

    async def role(page: Page, who: str) -> str:
        status, _, body = await page.ask(who, 'GET', '/api/session')
        data = json.loads(body)
        return data['role'] if status == 200 and data['signed_in'] else ''

    async def run() -> None:
        async with (
            serving(tmp_path, monkeypatch, bind) as page,
            aiohttp.ClientSession(headers={'Origin': page.origin}) as session,
        ):
            others = dict(page.cookies)
            await page.sign_in('viewer')
            copied = await session.ws_connect(
                f'{page.origin}/ws', headers={'Cookie': f'shadowhound_live={page.cookies["viewer"]}'}
            )
            token = right.replace(b'{}', page.token('operator').encode())
            forged = others['operator'][:-1] + ('0' if others['operator'][-1] != '0' else '1')
            for cookie, body, status in (
                (page.cookies['viewer'], wrong, 401),
                (forged, token, 200),
                ('', token, 200),
                (page.cookies['viewer'], token, 200),
            ):
                assert [await role(page, who) for who in ('viewer', 'operator')] == ['viewer', 'operator']
                headers = {'Cookie': f'shadowhound_live={cookie}'}
                found, answer, _ = await page.ask('stranger', 'POST', '/api/session', body=body, headers=headers)
                assert found == status
            await ended(copied)
            page.cookies['new'] = answer['Set-Cookie'].partition('=')[2].partition(';')[0]
            assert [await role(page, who) for who in ('viewer', 'operator', 'new')] == ['', 'operator', 'operator']
            others |= {'gone': page.cookies['viewer'], 'new': page.cookies['new']}
        async with serving(tmp_path, monkeypatch, bind) as page:
            page.cookies = others
            data = [await role(page, who) for who in ('viewer', 'operator', 'new', 'gone')]
            assert data == ['viewer', 'operator', 'operator', '']

    asyncio.run(run())


def test_a_sign_in_is_not_refused_where_the_disk_does_not_keep_the_end_of_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def run() -> None:
        async with serving(tmp_path, monkeypatch) as page:
            (page.folder / f'viewer.{SIGN_OUTS_FILE}.part').mkdir()
            body = json.dumps({'token': page.token('operator')}).encode()
            assert (await page.ask('viewer', 'POST', '/api/session', body=body))[0] == 200
            assert (await page.ask('viewer', 'GET', '/api/session'))[0] == 401
            assert 'a sign-out is forgotten' in caplog.text

    asyncio.run(run())


def test_a_sign_out_ends_its_connections(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All tabs of that browser, immediately; those of another sign-in with the same token continue."""
    monkeypatch.setattr(module, 'CHECK_S', 3600.0)  # no periodic check interferes

    async def run() -> None:
        async with serving(tmp_path, monkeypatch) as page, aiohttp.ClientSession(headers={'Origin': page.origin}) as session:
            gone = {'Cookie': f'shadowhound_live={page.cookies["viewer"]}'}
            tabs = [await session.ws_connect(f'{page.origin}/ws', headers=gone) for _ in range(2)]
            assert (await page.ask('viewer', 'GET', '/api/session'))[0] == 200
            signed_out = page.cookies['viewer'], page.csrf['viewer']
            await page.sign_in('viewer')
            stays = {'Cookie': f'shadowhound_live={page.cookies["viewer"]}'}
            other = await session.ws_connect(f'{page.origin}/ws', headers=stays)
            page.cookies['viewer'], page.csrf['viewer'] = signed_out
            assert (await page.ask('viewer', 'POST', '/api/sign-out'))[0] == 200
            for each in tabs:
                await ended(each)
            await answers(other, 5)
            with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                await session.ws_connect(f'{page.origin}/ws', headers=gone)
            assert refused.value.status == 401
            await other.close()

    asyncio.run(run())


def test_a_sign_out_outlasts_a_restart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a restart of the page the cookie stays invalid, and no other client must sign in again."""

    async def run() -> None:
        async with serving(tmp_path, monkeypatch) as page:
            assert (await page.ask('viewer', 'POST', '/api/sign-out'))[0] == 200
            assert stat.S_IMODE((page.folder / f'viewer.{SIGN_OUTS_FILE}').stat().st_mode) == 0o600
            cookies = dict(page.cookies)
        async with serving(tmp_path, monkeypatch) as page:
            page.cookies = cookies
            assert (await page.ask('viewer', 'GET', '/api/session'))[0] == 401
            assert (await page.ask('operator', 'GET', '/api/session'))[0] == 200

    asyncio.run(run())


def test_a_sign_out_that_cannot_be_stored_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """It is valid until the page restarts; the user and the log get the warning that it is valid no longer than that."""

    async def run() -> None:
        async with serving(tmp_path, monkeypatch) as page:
            (page.folder / f'viewer.{SIGN_OUTS_FILE}.part').mkdir()
            status, _, body = await page.ask('viewer', 'POST', '/api/sign-out')
            assert (status, b'until this page restarts' in body) == (503, True)
            assert (await page.ask('viewer', 'GET', '/api/session'))[0] == 401
            assert 'a sign-out is forgotten' in caplog.text

    asyncio.run(run())


@pytest.mark.parametrize('how', ['new tokens', 'others may read it', 'it is gone', 'twelve hours'])
def test_connections_end_with_the_sign_in_that_they_came_by(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    """Within some rounds; a viewer cannot reconnect with it. The other role continues if its token is valid."""
    monkeypatch.setattr(module, 'CHECK_S', 0.05)

    async def run() -> None:
        async with serving(tmp_path, monkeypatch) as page, aiohttp.ClientSession(headers={'Origin': page.origin}) as session:
            cookies = {who: {'Cookie': f'shadowhound_live={page.cookies[who]}'} for who in ('viewer', 'operator')}
            viewer = await session.ws_connect(f'{page.origin}/ws', headers=cookies['viewer'])
            operator = await session.ws_connect(f'{page.origin}/ws', headers=cookies['operator'])
            await answers(viewer, 1)
            await answers(operator, 1)
            token = page.folder / 'viewer.token'
            if how == 'new tokens':
                make_tokens(page.folder, replace=True)
            elif how == 'others may read it':
                token.chmod(0o644)
            elif how == 'it is gone':
                token.unlink()
            else:
                monkeypatch.setattr(page.server.auth.access, '_now', lambda: time.time() + LASTS_S)
            await ended(viewer)
            is_of_all = how in ('new tokens', 'twelve hours')
            await (ended(operator) if is_of_all else answers(operator, 2))
            for who, status in (('viewer', 401), ('operator', 401 if is_of_all else 200)):
                assert (await page.ask(who, 'GET', '/api/session'))[0] == status
            await operator.close()

    asyncio.run(run())


def test_viewers_without_tokens_keep_watching_when_tokens_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the loopback; an operator's connection there is closed and may reconnect as a viewer."""
    monkeypatch.setattr(module, 'CHECK_S', 0.05)

    async def run() -> None:
        async with (
            serving(tmp_path, monkeypatch, '127.0.0.1') as page,
            aiohttp.ClientSession(headers={'Origin': page.origin}) as session,
        ):
            signed_in = {'Cookie': f'shadowhound_live={page.cookies["operator"]}'}
            operator = await session.ws_connect(f'{page.origin}/ws', headers=signed_in)
            viewer = await session.ws_connect(f'{page.origin}/ws')
            for path in make_tokens(page.folder).values():
                path.unlink()
            await ended(operator)
            await answers(viewer, 3)
            again = await session.ws_connect(f'{page.origin}/ws', headers=signed_in)
            await answers(again, 4)
            assert (await page.ask('operator', 'POST', '/api/act', body=ACT))[0] == 403
            await viewer.close()
            await again.close()

    asyncio.run(run())


def test_on_loopback_viewers_need_no_token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Actions need the operator's token everywhere."""

    async def run() -> None:
        async with serving(tmp_path, monkeypatch, '127.0.0.1') as page:
            assert (await page.ask('stranger', 'GET', '/ws'))[0] == 101
            assert (await page.ask('stranger', 'POST', '/api/act', body=ACT))[0] == 403

    asyncio.run(run())


def test_the_viewers_and_their_messages_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One too many gets an error; a message that is too large only ends its connection."""

    async def run() -> None:
        async with (
            serving(tmp_path, monkeypatch, '127.0.0.1') as page,
            aiohttp.ClientSession(headers={'Origin': page.origin}) as session,
        ):
            there = [await session.ws_connect(f'{page.origin}/ws') for _ in range(MAX_VIEWERS)]
            with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                await session.ws_connect(f'{page.origin}/ws')
            assert refused.value.status == 429
            first, second = there[:2]
            await first.send_str('x' * (MAX_MESSAGE + 1))
            while (message := await first.receive(60.0)).type is aiohttp.WSMsgType.BINARY:
                pass
            assert first.close_code == 1009 or message.type in (aiohttp.WSMsgType.CLOSED, aiohttp.WSMsgType.ERROR)
            for nonsense in ('{' * 5000, '[]', '{"ping": "x", "watch": 7}', '\x00'):
                await second.send_str(nonsense)
            await second.send_bytes(b'\xff' * 9)
            await second.send_str('{"ping": 5}')
            while (message := await second.receive(60.0)).type is aiohttp.WSMsgType.BINARY and b'"pong"' not in message.data:
                pass
            assert b'"ping":5' in message.data
            for each in there:
                await each.close()

    asyncio.run(run())


def test_invalid_http_does_not_fill_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """It gets a response, and no log entry."""

    async def run() -> None:
        async with serving(tmp_path, monkeypatch) as page:
            for nonsense in (
                b'GET /\xff HTTP/1.1\r\n\r\n',
                b'\x16\x03\x01\x02\x00\r\n\r\n',
                b'GET / HTTP/1.1\r\nX: ' + b'x' * 70_000,
            ):
                reader, writer = await asyncio.open_connection('127.0.0.1', page.server.port)
                writer.write(nonsense)
                assert (await asyncio.wait_for(reader.read(), 60)).startswith(b'HTTP/1.0 400')
                writer.close()
        assert [record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR] == []

    asyncio.run(run())


def test_a_frame_of_a_gigabyte_is_refused_by_its_header(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The server does not wait for the announced data."""

    async def run() -> None:
        async with serving(tmp_path, monkeypatch, '127.0.0.1') as page:
            reader, writer = await asyncio.open_connection('127.0.0.1', page.server.port)
            asked = {'Host': f'127.0.0.1:{page.server.port}', 'Origin': page.origin, **UPGRADE}
            writer.write(
                '\r\n'.join(['GET /ws HTTP/1.1', *(f'{name}: {value}' for name, value in asked.items()), '', '']).encode()
            )
            await asyncio.wait_for(reader.readuntil(b'\r\n\r\n'), 60)
            writer.write(b'\x82\xff' + (1 << 30).to_bytes(8, 'big') + bytes(4))
            while await asyncio.wait_for(reader.read(1 << 16), 60):
                pass  # until it has closed the connection
            writer.close()

    asyncio.run(run())


def test_frequent_changes_of_a_viewer_rarely_change_subscriptions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each change creates and removes subscriptions, which is discovered by the whole network of the robot."""
    monkeypatch.setattr(module, 'TICK_S', 3600.0)

    async def run() -> None:
        async with (
            serving(tmp_path, monkeypatch, '127.0.0.1') as page,
            aiohttp.ClientSession(headers={'Origin': page.origin}) as session,
        ):
            viewer = await session.ws_connect(f'{page.origin}/ws')
            monkeypatch.setattr(viewers_module, 'REWATCH_S', 3600.0)
            seen = []
            for number in range(50):
                await viewer.send_json({'watch': [f'/topic_{number}'], 'ping': number})
                while f'"ping":{number},'.encode() not in (await viewer.receive_bytes(timeout=60)):
                    pass
                if not seen or page.server.viewers.wanted != seen[-1]:
                    seen.append(page.server.viewers.wanted)
            assert len(seen) <= 3  # the periodic check runs as well
            await viewer.close()

    asyncio.run(run())


def test_idle_connections_block_no_client(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Connections that never complete a request are closed; a viewer stays, and other clients get responses."""
    monkeypatch.setattr(module, 'MAX_CONNECTIONS', 8)

    async def run() -> None:
        async with (
            serving(tmp_path, monkeypatch, '127.0.0.1') as page,
            aiohttp.ClientSession(headers={'Origin': page.origin}) as session,
        ):
            viewer = await session.ws_connect(f'{page.origin}/ws')
            slow = []
            for number in range(40):
                reader, writer = await asyncio.open_connection('127.0.0.1', page.server.port)
                writer.write(b'GET / HTTP/1.1\r\nX-Slow: ' if number % 2 else b'')
                slow.append((reader, writer))
            assert (await page.ask('stranger', 'GET', '/'))[0] == 200
            for each in (module, answers_module):
                monkeypatch.setattr(each, 'REQUEST_S', 0.2)
            for reader, writer in slow:
                with suppress(ConnectionError):
                    assert await asyncio.wait_for(reader.read(), 60) == b''
                writer.close()
            late = {'Content-Length': '5'}
            assert (await page.ask('operator', 'POST', '/api/act', headers=late, body=b'{'))[0] == 408
            await viewer.send_str('{"ping": 5}')
            while b'"pong"' not in (await viewer.receive_bytes(timeout=60)):
                pass
            await viewer.close()

    asyncio.run(run())


@pytest.mark.parametrize(('host', 'own'), [
    ('127.0.0.1:8765', True), ('localhost:8765', True), ('10.1.2.3', True), ('thor.lan:8765', True), ('10.1.2.4', False),
    ('evil.example', False), ('', False), ('[::1', False), ('127.0.0.1.evil.example', False), ('127.0.0.1@evil.example', False),
])  # fmt: skip
def test_the_page_has_its_names_and_the_address_that_was_asked(host: str, own: bool) -> None:
    """Another host name that resolves to it is an attack."""
    names = OwnNames('127.0.0.1', ['thor.lan'])
    for address in ('10.1.2.3', '::ffff:10.1.2.3'):  # the same as an IPv6 socket shows it
        assert names.has(host, address) is own


def test_the_page_is_small_and_loads_nothing_from_elsewhere() -> None:
    """At most 270 KB compressed, bundles included, 110 KB before 3D is visible; each is built from the pinned versions."""
    files = {name: (body, packed) for name, (body, packed, _, _) in module._static(module.PAGE)}
    served = {name: each for name, each in files.items() if not name.endswith(('.txt', 'SUMS'))}
    assert sum(len(packed) for _, packed in served.values()) < 270_000
    assert sum(len(packed) for name, (_, packed) in served.items() if name not in {'vendor/three.js', 'scene.js'}) < 110_000
    ours = b''.join(body for name, (body, _) in served.items() if not name.startswith('vendor/'))
    assert re.findall(rb'https?://(?!www\.w3\.org/2000/svg|app\.foxglove\.dev/~/view)', ours) == []
    sums = dict(line.split()[::-1] for line in files['vendor/SHA256SUMS'][0].decode().splitlines())
    assert sums == {name.partition('/')[2]: sha256(body).hexdigest() for name, (body, _) in served.items() if 'vendor/' in name}
    pinned = json.loads((Path(__file__).parents[2] / 'requirements' / 'page' / 'package.json').read_text())['dependencies']
    licences = files['vendor/LICENSES.txt'][0].decode()
    assert all(f'{name} {version} (' in licences for name, version in pinned.items())
