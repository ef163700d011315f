"""What the server writes to those who watch."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from e2e.live_frames import Frames

from shadowhound_data_logger.live import server as module
from shadowhound_data_logger.live.kinds import FULL, LiveItem
from shadowhound_data_logger.live.server import LiveServer, LiveSettings


async def watched(server: LiveServer, items: list[LiveItem]) -> list[tuple[str, int, bytes]]:
    """Topic, number and body of what comes to a viewer of ``/small`` and ``/large`` of these items, told at once."""
    origin = f'http://127.0.0.1:{server.port}'
    frames, found = Frames(), list[tuple[str, int, bytes]]()
    async with aiohttp.ClientSession(headers={'Origin': origin}) as session, session.ws_connect(f'{origin}/ws') as ws:
        await ws.send_json({'watch': ['/small', '/large'], 'ping': 1.0})
        async for message in ws:
            assert message.type is aiohttp.WSMsgType.BINARY
            for head, body in frames.take(message.data):
                if head['kind'] == 'pong':  # by now it is known what is watched
                    server._on_items(items)
                elif head['topic']:
                    found.append((head['topic'], head['number'], body))
            if (said := frames.acknowledgement()) is not None:
                await ws.send_bytes(said)
            if len(found) == len(items):
                await ws.close()
    return found


def test_items_of_every_size_arrive_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However RFC 6455 tells their length, small ones first, large ones as the viewer acknowledges them."""
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
    """Not that of the variables with which the page was started: the home of its spool, and its robot."""
    doctor = tmp_path / 'doctor'
    said = """'{"asked": "%s", "home": "%s", "robot": "%s"}' "$*" "$SHADOWHOUND_HOME" "$SHADOWHOUND_ROBOT\""""
    doctor.write_text(f'#!/bin/sh\nprintf {said}\n')
    doctor.chmod(0o700)
    monkeypatch.setattr(sys, 'executable', str(doctor))
    monkeypatch.setattr(module, 'find_spec', lambda _: None)  # no ROS here
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path / 'elsewhere'))
    monkeypatch.setenv('SHADOWHOUND_ROBOT', 'another')

    async def told(spool: Path) -> dict[str, Any]:
        server = LiveServer(LiveSettings(spool=spool, robot='thor', tokens=tmp_path / 'live', port=0))
        await server.open()
        try:
            async with aiohttp.ClientSession() as session, session.get(f'http://127.0.0.1:{server.port}/api/doctor') as answer:
                found: dict[str, Any] = await answer.json()
                return found
        finally:
            await server.close()

    found = asyncio.run(told(tmp_path / 'home' / 'spool'))
    assert found['doctor']['asked'].endswith('doctor --json')
    assert (found['doctor']['home'], found['doctor']['robot']) == (str(tmp_path / 'home'), 'thor')
    assert 'has its spool in SHADOWHOUND_HOME/spool' in asyncio.run(told(tmp_path / 'copy'))['error']
