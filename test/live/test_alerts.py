"""Alerts: their conditions, and that each is sent once, to a real HTTP server."""

from __future__ import annotations

import asyncio
import json
import logging
import socket
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from aiohttp import web
from lake.gap_parts import lost, mark, tell
from lake.making import NOON_NS, folder_store
from live.test_auth import serving
from live.test_fleet import store_of

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.live import alerts as module
from shadowhound_data_logger.live.alerts import (
    AGAIN_S,
    MAX_SENT,
    Alerts,
    AlertSettings,
    Condition,
    conditions_of_fleet,
    conditions_of_robot,
)
from shadowhound_data_logger.live.fleet import overview
from shadowhound_data_logger.policies.state import StateFile

TOKEN = 'tk_secret_topic'
NOW_S = 1_800_000_000.0


class Webhook:
    """An HTTP server that records requests, and responds with ``status``."""

    def __init__(self) -> None:
        self.status = 200
        self.got: list[dict[str, Any]] = []
        self.headers: list[dict[str, str]] = []

    async def take(self, request: web.Request) -> web.Response:
        if self.status == 200:
            self.got.append(await request.json())
            self.headers.append(dict(request.headers))
        return web.Response(status=self.status, headers={'Location': '/elsewhere'})

    @property
    def notices(self) -> list[tuple[str, str, str]]:
        return [(each['robot'], each['condition'], each['state']) for each in self.got]


@asynccontextmanager
async def webhook() -> AsyncIterator[tuple[Webhook, str]]:
    """A webhook and its URL."""
    hook, app = Webhook(), web.Application()
    app.router.add_post('/{name:.*}', hook.take)
    runner = web.AppRunner(app, access_log=None)
    await runner.setup()
    site = web.TCPSite(runner, '127.0.0.1', 0)
    await site.start()
    try:
        yield hook, f'http://127.0.0.1:{runner.addresses[0][1]}/{TOKEN}?auth={TOKEN}'
    finally:
        await runner.cleanup()


class Checked:
    """Alerts for conditions and times set by a test."""

    def __init__(self, url: str, folder: Path) -> None:
        self.now_s, self.found = NOW_S, [Condition('thor', 'disk', False, 'the disk is full')]
        self._settings, self._path = AlertSettings(url=url), folder / 'alerts.json'
        self.restart()

    def restart(self) -> None:
        self.alerts = Alerts(self._settings, self._path, self._check, lambda: self.now_s)

    async def _check(self) -> Sequence[Condition]:
        return self.found

    async def look(self, *, is_on: bool | None, after_s: float = 0.0) -> None:
        self.now_s += after_s
        self.found = [Condition(each.robot, each.name, is_on, each.text) for each in self.found]
        await self.alerts.look()


def test_a_condition_is_reported_once_when_it_begins_and_once_when_it_ends(tmp_path: Path) -> None:
    """As JSON, with the headers that let ntfy render it; also after a restart, and not while it is unknown."""

    async def run() -> None:
        async with webhook() as (hook, url):
            checked = Checked(url, tmp_path)
            await checked.look(is_on=False)
            assert hook.notices == []
            for is_on in (True, True, None, True):
                await checked.look(is_on=is_on, after_s=60)
            assert hook.notices == [('thor', 'disk', 'begins')]
            checked.restart()
            await checked.look(is_on=True, after_s=2 * AGAIN_S)
            assert len(hook.got) == 1
            for is_on in (False, False):
                await checked.look(is_on=is_on)
            assert hook.notices == [('thor', 'disk', 'begins'), ('thor', 'disk', 'ended')]
            assert hook.got[0]['title'] == 'thor: disk'
            assert hook.got[0]['text'] == 'the disk is full'
            assert hook.got[1]['text'] == 'No longer: the disk is full.'
            assert {'Template': 'yes', 'Title': '{{.title}}', 'Message': '{{.text}}', 'Priority': 'high'}.items() <= hook.headers[
                0
            ].items()
            assert (tmp_path / 'alerts.json').stat().st_mode & 0o777 == 0o600

    asyncio.run(run())


def test_a_condition_that_comes_and_goes_is_reported_once_an_hour(tmp_path: Path) -> None:
    """And then if it still holds; other conditions of the robot are reported during that time."""

    async def run() -> None:
        async with webhook() as (hook, url):
            checked = Checked(url, tmp_path)
            for _ in range(3):
                await checked.look(is_on=True, after_s=300)
                await checked.look(is_on=False, after_s=300)
            assert [state for _, _, state in hook.notices] == ['begins', 'ended']
            checked.restart()
            await checked.look(is_on=True, after_s=60)
            assert len(hook.got) == 2
            await checked.look(is_on=True, after_s=AGAIN_S)
            assert [state for _, _, state in hook.notices] == ['begins', 'ended', 'begins']
            checked.found.append(Condition('thor', 'silent', True, 'it is silent'))
            await checked.look(is_on=True)
            assert hook.notices[-1] == ('thor', 'silent', 'begins')

    asyncio.run(run())


@pytest.mark.parametrize('status', [302, 403, 429, 500])
def test_what_could_not_be_sent_is_sent_after_the_next_check(
    status: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """No redirect is followed. The log has the reason once, and no part of the URL after the host."""

    async def run() -> None:
        async with webhook() as (hook, url):
            checked = Checked(url, tmp_path)
            hook.status = status
            for _ in range(3):
                await checked.look(is_on=True, after_s=120)
            hook.status = 200
            await checked.look(is_on=True, after_s=120)
            assert hook.notices == [('thor', 'disk', 'begins')]

    with caplog.at_level(logging.DEBUG, logger=module.__name__):
        asyncio.run(run())
    assert [f'status {status}' in record.getMessage() for record in caplog.records] == [True]
    assert TOKEN not in caplog.text


def test_a_server_that_does_not_answer_delays_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An attempt ends after a time limit; so does one to a port without a listener."""
    monkeypatch.setattr(module, 'TIMEOUT_S', 0.2)

    async def run() -> None:
        with socket.create_server(('127.0.0.1', 0)) as server:
            checked = Checked(f'http://user:{TOKEN}@127.0.0.1:{server.getsockname()[1]}/{TOKEN}', tmp_path)
            await asyncio.wait_for(checked.look(is_on=True), 10.0)
        await checked.look(is_on=True)

    asyncio.run(run())
    assert [word in record.getMessage() for record, word in zip(caplog.records, ('Timeout', 'Connect'), strict=True)] == [
        True,
        True,
    ]
    assert TOKEN not in caplog.text
    assert TOKEN not in repr(AlertSettings(url=f'http://x/{TOKEN}'))


def test_messages_per_check_are_limited(tmp_path: Path) -> None:
    """The others follow with the next check; hostile text is one line of bounded length."""

    async def run() -> None:
        async with webhook() as (hook, url):
            checked = Checked(url, tmp_path)
            checked.found = [Condition(f'r{number}', 'disk', True, '\x1b[2J\n' + 'x' * 10_000) for number in range(MAX_SENT + 5)]
            await checked.look(is_on=True)
            assert len(hook.got) == MAX_SENT
            await checked.look(is_on=True)
            assert len(hook.got) == MAX_SENT + 5
            assert all(each['text'].isprintable() and len(each['text']) <= 300 for each in hook.got)

    asyncio.run(run())


def test_a_damaged_state_file_sends_again(tmp_path: Path) -> None:
    """It does not stop the page."""

    async def run() -> None:
        for content in (b'\xff', b'{"a": 1}', b'[[1]]', b'[["thor", "disk", "x", true]]'):
            (tmp_path / 'alerts.json').write_bytes(content)
            async with webhook() as (hook, url):
                await Checked(url, tmp_path).look(is_on=True)
                assert len(hook.got) == 1, content

    asyncio.run(run())


def test_the_page_of_a_store_detects_the_conditions_of_its_robots(tmp_path: Path) -> None:
    """Silence, losses above a limit, deleted or quarantined objects; for a retired robot silence is not a condition."""
    store_of(tmp_path, NOON_NS)
    tell(
        folder_store(tmp_path), tmp_path, lost('1', 3, 4, cause='transport', topic='/imu', count=7),
        lost('2', 5, 6, kind='quarantined', cause='access_denied', topic='/imu', count=1),
        lost('3', 5, 6, kind='evicted', cause='no_room', topic='/imu', count=2), mark(8, topic='/imu'),
    )  # fmt: skip
    rows = [
        row.to_json(NOON_NS + 60 * SECOND)
        for row in overview(Bucket(folder_store(tmp_path), 'sensor-data'), Findings(lambda _: None), NOON_NS + 60 * SECOND)
    ]

    def conditions(lost_: int, later_s: float) -> dict[tuple[str, str], bool | None]:
        settings = AlertSettings(url='http://x', lost=lost_)
        found = conditions_of_fleet(json.loads(json.dumps(rows)), settings, NOON_NS / SECOND + later_s)
        return {(each.robot, each.name): each.is_on for each in found}

    found = conditions(9, 60)
    assert {name: found['thor', name] for name in ('silent', 'losses', 'disk', 'quarantine')} == {
        'silent': False, 'losses': True, 'disk': True, 'quarantine': True,
    }  # fmt: skip
    assert [found['loki', name] for name in ('silent', 'losses', 'disk', 'quarantine')] == [False, False, False, False]
    assert (found['odin', 'silent'], found['freya', 'silent']) == (True, None)
    assert conditions(10, 60)['thor', 'losses'] is False
    assert conditions(10, 3700)['thor', 'silent'] is True


def test_the_page_of_a_robot_detects_its_conditions(tmp_path: Path) -> None:
    """Its node, its disk, its quarantine, and each policy that was rolled back."""
    settings = AlertSettings(url='http://x')
    figures: dict[str, Any] = {'robot': 'thor', 'state': 'running', 'spool': {
        'free_bytes': 5, 'min_free_bytes': 2, 'bytes': 8, 'max_bytes': 10, 'quarantined': 0}}  # fmt: skip

    def is_on(**spool: Any) -> dict[str, bool | None]:
        fields = {**figures, 'spool': {**figures['spool'], **spool}}
        return {each.name: each.is_on for each in conditions_of_robot(fields, 0, tmp_path / 'policies', settings)}

    fine = dict.fromkeys(('silent', 'losses', 'disk', 'quarantine'), False)
    assert is_on() == fine
    assert is_on(free_bytes=1)['disk'] is True
    assert is_on(bytes=10)['disk'] is True
    assert is_on(free_bytes=None)['disk'] is None
    assert is_on(quarantined=3)['quarantine'] is True
    assert [each.is_on for each in conditions_of_robot({'robot': 'thor', 'spool': None}, 1001, tmp_path, settings)][:2] == [
        True,
        True,
    ]
    (tmp_path / 'policies').mkdir()
    with StateFile(tmp_path / 'policies').changing() as state:
        state.bad['nav@3'] = '5 failures'
    assert is_on() == {**fine, 'policy nav@3': True}


def test_the_page_of_a_store_sends_alerts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """About silent robots, without a viewer."""
    store_of(tmp_path, time.time_ns() - 7200 * SECOND)

    async def run() -> None:
        async with webhook() as (hook, url), serving(
            tmp_path, monkeypatch, is_of_store=True, alerts=AlertSettings(url=url)
        ) as page:  # fmt: skip
            del page
            while not hook.got:
                await asyncio.sleep(0.05)
            assert set(hook.notices) <= {(name, 'silent', 'begins') for name in ('thor', 'loki', 'odin')}

    asyncio.run(asyncio.wait_for(run(), 100))


def test_the_page_of_a_robot_sends_alerts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its node is not running."""

    async def run() -> None:
        async with webhook() as (hook, url), serving(tmp_path, monkeypatch, alerts=AlertSettings(url=url)):
            while not hook.got:
                await asyncio.sleep(0.05)
            assert hook.notices == [('thor', 'silent', 'begins')]

    asyncio.run(asyncio.wait_for(run(), 100))
