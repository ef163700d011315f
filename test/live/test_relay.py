"""The page of a store, with the live view of one robot: one connection to the robot, for any number of viewers."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import pytest
import simplejpeg
from aiohttp import web
from e2e.live_frames import Frames
from live.test_auth import Page, serving
from live.test_kinds import of_too_many_pixels

from shadowhound_data_logger.core.options import COMPRESSED_IMAGE
from shadowhound_data_logger.live import access, relay, server
from shadowhound_data_logger.live.access import make_tokens
from shadowhound_data_logger.live.kinds import KINDS, LiveItem, table_item
from shadowhound_data_logger.live.server import LiveServer, LiveSettings
from shadowhound_data_logger.live.viewer import BEGIN, END, PART

CAMERA, IMU = '/camera', '/imu'
GRAPH = {CAMERA: (COMPRESSED_IMAGE, 1), IMU: ('sensor_msgs/msg/Imu', 1)}
VIEWERS = 10
GIVEN = relay.Relay._given


@asynccontextmanager
async def tower(folder: Path, url: str, token: Path | None) -> AsyncIterator[LiveServer]:
    """The page of a store on this machine."""
    settings = LiveSettings(
        spool=folder / 'none', robot='thor', tokens=folder / 'tower', port=0, is_of_store=True, robot_url=url, robot_token=token
    )
    server = LiveServer(settings)
    await server.open()
    try:
        yield server
    finally:
        await server.close()


@asynccontextmanager
async def answering(*routes: web.RouteDef) -> AsyncIterator[str]:
    """A server at the robot's address that only sends these responses; yields the address."""
    app = web.Application()
    app.add_routes(routes)
    runner = web.AppRunner(app)
    await runner.setup()
    await web.TCPSite(runner, '127.0.0.1', 0).start()
    try:
        yield f'http://127.0.0.1:{runner.addresses[0][1]}'
    finally:
        await runner.cleanup()


class Browser:
    """A viewer that assembles items, and the newest of each topic."""

    def __init__(self) -> None:
        self.newest: dict[str, tuple[dict[str, Any], bytes]] = {}

    async def run(self, server: LiveServer) -> None:
        origin = f'http://127.0.0.1:{server.port}'
        async with aiohttp.ClientSession(headers={'Origin': origin}) as session, session.ws_connect(f'{origin}/ws') as ws:
            await ws.send_json({'watch': [CAMERA, IMU]})
            frames = Frames()
            async for message in ws:
                for head, body in frames.take(message.data):
                    self.newest[head['topic'] or head['kind']] = head, body
                if (report := frames.acknowledgement()) is not None:
                    await ws.send_bytes(report)


async def until(condition: Callable[[], Any]) -> None:
    async def looking() -> None:
        while not condition():
            await asyncio.sleep(0.01)

    await asyncio.wait_for(looking(), 60.0)


JPEG = bytes(simplejpeg.encode_jpeg(np.zeros((8, 8, 3), np.uint8)))


def publish(robot: LiveServer, number: int) -> None:
    """A frame of 40 KB and a row of values."""
    at = asyncio.get_running_loop().time() * 1e3
    frame = LiveItem(CAMERA, 'camera', head={'at': at}, body=JPEG + bytes([number % 256]) * (40_000 - len(JPEG)))
    robot.viewers.on_items([frame, table_item(IMU, KINDS['sensor_msgs/msg/Imu'], [(at, {'x': float(number)})])])


def test_ten_viewers_cost_the_robot_one_stream(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It signs in with the viewer token; frames arrive unchanged, with their times; without viewers it is closed."""

    async def run(robot: Page, page: LiveServer) -> None:
        robot.server.viewers.on_graph(GRAPH)
        browsers = [Browser() for _ in range(VIEWERS)]
        tasks = [asyncio.create_task(browser.run(page)) for browser in browsers]
        await until(lambda: [one.viewer.watched for one in robot.server.viewers.connected] == [{CAMERA, IMU}])
        await until(lambda: all('topics' in browser.newest for browser in browsers))
        number = 0
        while not all({CAMERA, IMU} <= browser.newest.keys() for browser in browsers):
            publish(robot.server, number := number + 1)
            await asyncio.sleep(0.02)
        for browser in browsers:
            head, body = browser.newest[CAMERA]
            assert (len(body), len(set(body[len(JPEG) :]))) == (40_000, 1)
            assert -100 < asyncio.get_running_loop().time() * 1e3 - head['at'] < 20_000
            figures, rows = browser.newest[IMU]
            assert figures['names'] == ['x']
            assert abs(np.frombuffer(rows, '<f8', 1)[0] - figures['at']) < 1
        assert len(robot.server.viewers.connected) == 1
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await until(lambda: not robot.server.viewers.connected)

    async def both() -> None:
        async with AsyncExitStack() as stack:
            robot = await stack.enter_async_context(serving(tmp_path / 'robot', monkeypatch))
            token = robot.folder / 'viewer.token'
            await run(robot, await stack.enter_async_context(tower(tmp_path, robot.origin, token)))

    asyncio.run(both())


def test_a_token_that_the_robot_replaced_is_not_tried_again_and_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The robot would lock this address out. Viewers get the reason; the new token is used as soon as the file has it."""
    monkeypatch.setattr(server, 'CHECK_S', 0.05)
    monkeypatch.setattr(relay, 'AGAIN_S', 0.01)
    monkeypatch.setattr(relay, 'REFUSED_S', 3600.0)
    monkeypatch.setattr(relay, 'LOOK_S', 0.01)
    looks: list[str] = []

    def read_token(path: Path) -> str:
        looks.append(path.read_text())
        return access.read_token(path)

    monkeypatch.setattr(relay, 'read_token', read_token)

    async def run() -> None:
        async with serving(tmp_path / 'robot', monkeypatch) as robot:
            robot.server.viewers.ros_problem = ''
            robot.server.viewers.on_graph(GRAPH)
            token = tmp_path / 'thor.token'
            token.write_text(robot.token('viewer'))
            token.chmod(0o600)
            async with tower(tmp_path, robot.origin, token) as page:
                browser = Browser()
                task = asyncio.create_task(browser.run(page))

                def problem() -> str | None:
                    report: str | None = browser.newest.get('topics', ({'problem': None},))[0]['problem']
                    return report

                await until(lambda: problem() == '' and robot.server.viewers.connected)
                make_tokens(robot.folder, replace=True)
                await until(lambda: 'rejects the token' in (problem() or ''))
                looks.clear()
                await until(lambda: len(looks) > 50)
                assert len(robot.server.auth.access._failures['127.0.0.1']) == 1
                token.write_text('')  # it is being replaced
                await until(lambda: 'contains no token' in (problem() or ''))
                token.write_text(robot.token('viewer'))
                await until(lambda: problem() == '' and robot.server.viewers.connected)
                assert len(robot.server.auth.access._failures.get('127.0.0.1', ())) == 0
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)
        assert sum('rejects the token' in text for text in caplog.messages) == 1

    asyncio.run(run())


@pytest.mark.parametrize(('path', 'status', 'why'), [
    ('/api/session', 429, 'too many wrong tokens'), ('/ws', 401, 'requires a token'), ('/ws', 429, 'no more viewers'),
])  # fmt: skip
def test_a_rejecting_robot_is_retried_later(
    path: str, status: int, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After too many attempts, without a required token, or when it has its maximum number of viewers."""
    monkeypatch.setattr(relay, 'AGAIN_S', 0.01)
    monkeypatch.setattr(relay, 'REFUSED_S', 3600.0)
    monkeypatch.setattr(relay, 'LOOK_S', 0.01)
    asked: list[str] = []
    looks: list[int] = []
    monkeypatch.setattr(relay.Relay, '_given', lambda self: looks.append(1) or GIVEN(self))

    async def refuse(request: web.Request) -> web.StreamResponse:
        asked.append(request.path)
        return web.json_response({}, status=status)

    async def run() -> None:
        app = web.Application()
        app.add_routes([web.route('*', path, refuse)])
        runner = web.AppRunner(app)
        await runner.setup()
        await web.TCPSite(runner, '127.0.0.1', 0).start()
        (token := tmp_path / 'token').write_text('x' * 30)
        token.chmod(0o600)
        given = token if path == '/api/session' else None
        try:
            async with tower(tmp_path, f'http://127.0.0.1:{runner.addresses[0][1]}', given) as page:
                browser = Browser()
                task = asyncio.create_task(browser.run(page))
                await until(lambda: why in browser.newest.get('topics', ({'problem': ''},))[0]['problem'])
                await until(lambda: len(looks) > 50)
                assert asked == [path]
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)
        finally:
            await runner.cleanup()

    asyncio.run(run())


def test_a_robot_that_ends_each_connection_is_asked_again_after_a_pause(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And viewers see the reason."""
    monkeypatch.setattr(relay, 'AGAIN_S', 3600.0)
    asked: list[str] = []

    async def end(request: web.Request) -> web.StreamResponse:
        asked.append(request.path)
        ws = web.WebSocketResponse()
        await ws.prepare(request)
        return ws

    async def run() -> None:
        async with answering(web.get('/ws', end)) as address, tower(tmp_path, address, None) as page:
            browser = Browser()
            task = asyncio.create_task(browser.run(page))
            await until(lambda: len(asked) > 20 or 'ended the connection' in str(browser.newest.get('topics')))
            assert asked == ['/ws']
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    asyncio.run(run())


def test_a_viewer_during_disconnect_sees_the_robot_immediately() -> None:
    """As after a reload of Tower's page: the robot's reply to closing an unused connection is not an error."""
    came: list[float] = []
    reports: list[Any] = []

    async def watch(request: web.Request) -> web.StreamResponse:
        came.append(asyncio.get_running_loop().time())
        ws = web.WebSocketResponse(autoclose=False)
        await ws.prepare(request)
        async for _ in ws:
            pass
        await asyncio.sleep(0.2)  # the return path
        await ws.close()
        return ws

    async def run() -> None:
        async with answering(web.get('/ws', watch)) as address:
            wanted: list[list[str] | None] = [[]]
            one = relay.Relay(address, None, lambda: wanted[0], lambda item: reports.append((item.head or {}).get('problem')))
            one.open()
            try:
                await until(lambda: came)
                await asyncio.sleep(0)
                wanted[0] = None
                one.wake()
                await asyncio.sleep(0.05)
                wanted[0] = []
                one.wake()
                await until(lambda: len(came) > 1)
                assert [problem for problem in reports if problem] == []
            finally:
                await one.close()

    asyncio.run(run())


def whole(content: bytes) -> bytes:
    """A complete large item."""
    return PART.pack(1, BEGIN | END, len(content)) + content


CLOUD = {'at': 1.0, 'points': 0, 'low': [0.0] * 3, 'step': [1.0] * 3, 'frame': 'odom'}
NAN = b'{"topic":"","kind":"figures","at":1.0,"figures":{"topics":[],"rate":NaN}}'
PONG = whole(LiveItem('', 'pong', head={'ping': 1.0, 'now': 1.0}).packed)


@pytest.mark.parametrize('said', [
    b'\x00\x03', PART.pack(1, END, 2) + b'ab', PONG[:-1], PONG + PART.pack(0, BEGIN | END, 0x7FFF_FFFF), whole(b''),
    *map(whole, (
        b'\xff' * 99, b'\x02\x00\x00\x00[]', b'\xff\xff\xff\x7f{}', b'\xff\xff\x00\x00' + b'[' * 0xFFFF,
        len(NAN).to_bytes(4, 'little') + NAN,
        *(item.packed for item in (
            LiveItem('', 'pong', head={'ping': 'x', 'now': {}}), LiveItem('', 'topics', head={'topics': 7}),
            LiveItem('/a', 'script', head={'at': 1}),
            *(LiveItem('', 'figures', head={'at': 1.0, 'figures': figures})
              for figures in (None, 7, {}, {'topics': 7}, {'topics': [7]}, {'topics': [{'topic': {}, 'type': ''}]})),
            *(LiveItem('', 'sample', head={'at': 1.0, **head}) for head in ({}, {'of': 7}, {'of': '/a', 'hz': {}})),
            *(LiveItem('/a', 'cloud', head={**CLOUD, **changed})
              for changed in ({'points': 10**9}, {'low': [math.nan] * 3}, {'low': []}, {'step': [1.0, 1.0, math.inf]},
                              {'frame': 7})),
            *(LiveItem('/a', 'imu', head={'at': 1.0, 'rows': rows, 'names': names})
              for rows, names in ((1, ['x']), (0, ['x'] * 999), (0, [7]), (0, 'x'))),
            LiveItem('/a', 'camera', head={'at': 1.0}, body=b'no jpeg'),
            LiveItem('/a', 'camera', head={'at': 1.0}, body=of_too_many_pixels()),
        )),
    )),
])  # fmt: skip
def test_an_invalid_robot_page_is_reported(tmp_path: Path, said: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page of the store continues, and shows why there is no live view."""
    monkeypatch.setattr('shadowhound_data_logger.live.relay.AGAIN_S', 0.01)

    async def nonsense(request: web.Request) -> web.StreamResponse:
        ws = web.WebSocketResponse()
        await ws.prepare(request)
        await ws.send_bytes(PONG)
        await ws.send_bytes(said)
        async for _ in ws:
            pass
        return ws

    async def run() -> None:
        async with answering(web.get('/ws', nonsense)) as address, tower(tmp_path, address, None) as page:
            browser = Browser()
            task = asyncio.create_task(browser.run(page))

            def says_why() -> bool:
                problem = browser.newest.get('topics', ({'problem': ''},))[0]['problem']
                return 'cannot be read' in problem and 'Timeout' not in problem

            await until(says_why)
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    asyncio.run(run())
