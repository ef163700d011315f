"""The data that the server writes to viewers."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import aiohttp
import pytest
from e2e.live_frames import Frames
from live.test_auth import UPGRADE, serving
from spool.making import FakeClock
from spool.test_status import written

from shadowhound_data_logger.core.options import COMPRESSED_IMAGE
from shadowhound_data_logger.live import server as module
from shadowhound_data_logger.live import viewers as viewers_module
from shadowhound_data_logger.live.access import COOKIE
from shadowhound_data_logger.live.figures import SpoolFigures
from shadowhound_data_logger.live.kinds import FULL, HALF, LiveItem
from shadowhound_data_logger.live.server import LiveServer, LiveSettings
from shadowhound_data_logger.live.viewer import Viewer
from shadowhound_data_logger.live.viewers import NARROW_S

CAMERA = '/camera'


def closed_server(folder: Path, **settings: Any) -> LiveServer:
    return LiveServer(LiveSettings(spool=folder / 'spool', robot='thor', tokens=folder / 'live', **settings))


async def watched(server: LiveServer, items: list[LiveItem]) -> list[tuple[str, int, bytes]]:
    """Topic, number and body received by a viewer of ``/small`` and ``/large`` from these items, shown at the same time."""
    origin = f'http://127.0.0.1:{server.port}'
    frames, found = Frames(), list[tuple[str, int, bytes]]()
    async with aiohttp.ClientSession(headers={'Origin': origin}) as session, session.ws_connect(f'{origin}/ws') as ws:
        await ws.send_json({'watch': ['/small', '/large'], 'ping': 1.0})
        async for message in ws:
            assert message.type is aiohttp.WSMsgType.BINARY
            for head, body in frames.take(message.data):
                if head['kind'] == 'pong':  # by now the watched topics are known
                    server.viewers.on_items(items)
                elif head['topic']:
                    found.append((head['topic'], head['number'], body))
            if (report := frames.acknowledgement()) is not None:
                await ws.send_bytes(report)
            if len(found) == len(items):
                await ws.close()
    return found


def test_items_of_every_size_arrive_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However RFC 6455 encodes their length, small ones first, large ones as the viewer acknowledges them."""
    monkeypatch.setattr(module, 'find_spec', lambda _: None)  # no ROS here
    small = [LiveItem('/small', 'imu', FULL, {'number': size}, bytes([size % 251]) * size) for size in (0, 60, 500, 70_000)]
    large = LiveItem('/large', 'camera', FULL, {'number': 7}, b'\xff\xd8' * 300_000)

    async def run() -> list[tuple[str, int, bytes]]:
        server = LiveServer(LiveSettings(spool=tmp_path / 'spool', robot='thor', tokens=tmp_path / 'live', port=0))
        await server.open()
        try:
            return await asyncio.wait_for(watched(server, [large, *small]), 20)
        finally:
            await server.close()

    expected: list[tuple[str, int, Any]] = [(item.topic, (item.head or {})['number'], item.body) for item in (*small, large)]
    assert asyncio.run(run()) == expected


def test_the_doctor_examines_the_node_whose_page_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not that of the page's environment variables: the home of its spool, and its robot."""
    doctor = tmp_path / 'doctor'
    text = """'{"asked": "%s", "home": "%s", "robot": "%s"}' "$*" "$SHADOWHOUND_HOME" "$SHADOWHOUND_ROBOT\""""
    doctor.write_text(f'#!/bin/sh\nprintf {text}\n')
    doctor.chmod(0o700)
    monkeypatch.setattr(sys, 'executable', str(doctor))
    monkeypatch.setattr(module, 'find_spec', lambda _: None)  # no ROS here
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path / 'elsewhere'))
    monkeypatch.setenv('SHADOWHOUND_ROBOT', 'another')

    async def doctor_answer(spool: Path) -> dict[str, Any]:
        server = LiveServer(LiveSettings(spool=spool, robot='thor', tokens=tmp_path / 'live', port=0))
        await server.open()
        try:
            async with aiohttp.ClientSession() as session, session.get(f'http://127.0.0.1:{server.port}/api/doctor') as answer:
                found: dict[str, Any] = await answer.json()
                return found
        finally:
            await server.close()

    found = asyncio.run(doctor_answer(tmp_path / 'home' / 'spool'))
    assert found['doctor']['asked'].endswith('doctor --json')
    assert (found['doctor']['home'], found['doctor']['robot']) == (str(tmp_path / 'home'), 'thor')
    assert 'has its spool in SHADOWHOUND_HOME/spool' in asyncio.run(doctor_answer(tmp_path / 'copy'))['error']


def test_viewers_on_other_machines_are_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Viewers and RTSP players; the page of a store reports none."""
    robot, store = closed_server(tmp_path), closed_server(tmp_path, is_of_store=True)
    assert not robot.viewers.is_watched_remotely
    near, far = ('127.0.0.1', '::1', '::ffff:127.0.0.1'), ('10.77.0.2', '::ffff:10.77.0.2', 'fe80::2%eth0')
    for address in near + far:
        watching = [SimpleNamespace(address='127.0.0.1'), SimpleNamespace(address=address)]
        players = SimpleNamespace(players=('127.0.0.1', address))
        for part, name, here in (('viewers', 'connected', watching), ('cameras', 'rtsp', players)):
            with monkeypatch.context() as patch:
                for server in (robot, store):
                    patch.setattr(getattr(server, part), name, here)
                assert robot.viewers.is_watched_remotely is (address in far), (name, address)
                assert not store.viewers.is_watched_remotely


def test_video_is_suggested_on_a_link_that_stays_narrow(tmp_path: Path) -> None:
    """Each time that it was narrow for ten seconds without a break; not without a camera, and not without video support."""
    reports: list[LiveItem] = []
    viewer = Viewer()
    one: Any = SimpleNamespace(viewer=viewer, narrow_s=None, tell=reports.append)
    server = closed_server(tmp_path)
    server.cameras.no_video, server.viewers.graph = (
        '',
        {CAMERA: (COMPRESSED_IMAGE, 1), '/cloud': ('sensor_msgs/msg/PointCloud2', 1)},
    )
    clock = iter(range(10_000))

    def suggested(seconds: float, *, narrow: bool) -> int:
        """How often within this time."""
        reports.clear()
        viewer._sizes = dict.fromkeys((CAMERA, '/cloud'), HALF if narrow else FULL)
        for _ in range(round(seconds)):
            server.viewers.suggest_video(one, float(next(clock)))
        assert all(item.kind == 'video' and item.head == {'narrow': True} for item in reports)
        return len(reports)

    viewer.watch([CAMERA, '/cloud'])
    assert suggested(3 * NARROW_S, narrow=False) == 0
    assert suggested(NARROW_S, narrow=True) == 0
    assert suggested(1, narrow=True) == 1
    assert suggested(NARROW_S - 1, narrow=True) == 0
    assert suggested(2 * NARROW_S, narrow=True) == 2
    assert suggested(1, narrow=False) == 0
    assert suggested(NARROW_S, narrow=True) == 0
    viewer.watch(['/cloud'])
    assert suggested(3 * NARROW_S, narrow=True) == 0
    viewer.watch([CAMERA])
    server.cameras.no_video = 'there is none'
    assert suggested(3 * NARROW_S, narrow=True) == 0


def test_a_page_on_a_narrow_link_is_notified(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It gets frames that exceed the link, and after a while the suggestion."""
    monkeypatch.setattr(module, 'TICK_S', 0.05)
    monkeypatch.setattr(viewers_module, 'NARROW_S', 0.3)

    async def run() -> dict[str, Any]:
        async with serving(tmp_path, monkeypatch, '127.0.0.1') as page:
            page.server.cameras.no_video = ''
            page.server.viewers.on_graph({CAMERA: (COMPRESSED_IMAGE, 1)})
            frames = Frames()
            async with (
                aiohttp.ClientSession(headers={'Origin': page.origin}) as session,
                session.ws_connect(f'{page.origin}/ws') as ws,
            ):
                await ws.send_json({'watch': [CAMERA], 'ping': 1.0})
                while True:
                    for head, _ in frames.take((await ws.receive(60)).data):
                        if head['kind'] == 'pong':  # by now the watched topics are known
                            page.server.viewers.on_items([LiveItem(CAMERA, 'camera', FULL, {'at': 1.0}, bytes(500_000))])
                        if head['kind'] == 'video':
                            return head

    assert asyncio.run(run()) == {'topic': '', 'kind': 'video', 'narrow': True}


def test_status_shows_what_uploads_wait_for(tmp_path: Path) -> None:
    """The rule and why it does not hold, and how long it takes until everything has arrived, as in the node's status."""
    fields = {'waits_for': {'upload.when': 'wifi.ssid == "lab": it is "cafe"'}, 'left_s': 754}
    written(tmp_path, store={'state': 'waiting', **fields})
    store = SpoolFigures(tmp_path, 'thor', FakeClock()).now(with_ledger=False)['store']
    assert {name: store[name] for name in fields} == fields


def test_a_failed_task_is_logged_immediately(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Otherwise connections would silently stop ending with their sign-in."""

    async def fails(_: LiveServer) -> None:
        raise ValueError('it cannot be asked')

    monkeypatch.setattr(LiveServer, '_end_unknown', fails)

    async def run() -> None:
        async with serving(tmp_path, monkeypatch, '127.0.0.1'):
            await asyncio.sleep(0)
            assert 'has failed: start the page again' in caplog.text
            assert 'it cannot be asked' in caplog.text

    asyncio.run(run())


@pytest.mark.parametrize('is_of_store', [False, True])
def test_the_round_trip_to_each_viewer_is_known(is_of_store: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """To this machine it is short; it is measured again, since that of the first packets may have been long."""

    async def run() -> None:
        async with serving(tmp_path, monkeypatch, is_of_store=is_of_store) as page:
            cookie = f'{COOKIE}={page.cookies["viewer"]}'
            async with (
                aiohttp.ClientSession(headers={'Origin': page.origin, 'Cookie': cookie}) as session,
                session.ws_connect(f'{page.origin}/ws'),
            ):
                while not page.server.viewers.connected:
                    await asyncio.sleep(0.01)
                (one,) = page.server.viewers.connected
                while not one.viewer.round_s:
                    await asyncio.sleep(0.01)
                assert one.viewer.round_s < 0.05
                one.viewer.round_s = 7.0
                while one.viewer.round_s == 7.0:
                    await asyncio.sleep(0.01)
                assert 0 < one.viewer.round_s < 0.05

    asyncio.run(asyncio.wait_for(run(), 30.0))


def test_false_acknowledgments_gain_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The data waiting for that viewer in this process is bounded."""

    async def run() -> None:
        async with serving(tmp_path, monkeypatch) as page:
            reader, writer = await asyncio.open_connection('127.0.0.1', page.server.port, limit=1024)
            given = {
                'Host': f'127.0.0.1:{page.server.port}',
                'Origin': page.origin,
                'Cookie': f'{COOKIE}={page.cookies["viewer"]}',
            }
            lines = [f'{name}: {value}' for name, value in {**given, **UPGRADE}.items()]
            writer.write('\r\n'.join(['GET /ws HTTP/1.1', *lines, '', '']).encode())
            assert b'101' in await reader.readline()
            while not page.server.viewers.connected or next(iter(page.server.viewers.connected)).transport is None:
                await asyncio.sleep(0.01)
            (one,) = page.server.viewers.connected
            writer.transport.pause_reading()  # type: ignore[attr-defined]
            one.viewer.watch(['/camera'])
            most = 0
            for _ in range(300):
                one.tell(LiveItem('/camera', 'camera', FULL, {'at': 1.0}, bytes(60_000)))
                await asyncio.sleep(0)
                one.viewer.acknowledge(one.viewer._sent & 0xFFFF_FFFF)
                assert one.transport is not None
                most = max(most, one.transport.get_write_buffer_size())
            assert 0 < most < 500_000
            writer.close()

    asyncio.run(asyncio.wait_for(run(), 30.0))


def test_memory_is_trimmed_without_viewers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not while there are viewers, and not repeatedly while there are none."""
    trimmed: list[int] = []

    async def run() -> None:
        async with serving(tmp_path, monkeypatch) as page:
            monkeypatch.setattr(viewers_module.heap, 'trim', lambda: trimmed.append(len(page.server.viewers.connected)))
            cookie = f'{COOKIE}={page.cookies["viewer"]}'
            async with aiohttp.ClientSession(headers={'Origin': page.origin, 'Cookie': cookie}) as session:
                first, second = [await session.ws_connect(f'{page.origin}/ws') for _ in range(2)]
                await first.close()
                while len(page.server.viewers.connected) > 1:
                    await asyncio.sleep(0.01)
                assert trimmed == []
                await second.close()
                while not trimmed:
                    await asyncio.sleep(0.01)
                page.server.viewers.rewatch()
        assert trimmed == [0]

    asyncio.run(asyncio.wait_for(run(), 30.0))
