"""The packet marks of the live page, as captured: interactive video (DSCP AF41)."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator
from pathlib import Path

import aiohttp
import pytest
from live.test_auth import serving

AF41 = 34 << 2
DSCP = 0xFC
"""The bits of a mark that are not for ECN."""
EVERY_PROTOCOL, IPV4 = 3, 0x0800
"""linux/if_ether.h"""


def needs_ipv6() -> None:
    try:
        with socket.socket(socket.AF_INET6) as tried:
            tried.bind(('::1', 0))
    except OSError:
        pytest.skip('this machine has no IPv6')


@pytest.fixture
def wire() -> Iterator[socket.socket]:
    """All packets on the loopback, starting with the IP header."""
    try:
        packets = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(EVERY_PROTOCOL))
    except PermissionError:
        pytest.skip('only root may read packets')
    with packets:
        packets.bind(('lo', EVERY_PROTOCOL))
        packets.setblocking(False)
        yield packets


def marks(wire: socket.socket, port: int, content: bytes) -> set[int]:
    """The marks of the packets so far that come from that port and contain this."""
    found = set()
    while True:
        try:
            packet, (_, protocol, *_) = wire.recvfrom(1 << 16)
        except BlockingIOError:
            return found
        is_ipv4 = protocol == IPV4
        begin = 4 * (packet[0] & 0x0F) if is_ipv4 else 40
        if int.from_bytes(packet[begin : begin + 2], 'big') == port and content in packet[begin:]:
            found.add(DSCP & (packet[1] if is_ipv4 else (packet[0] & 0x0F) << 4 | packet[1] >> 4))


@pytest.mark.parametrize(('bind', 'host'), [('127.0.0.1', '127.0.0.1'), ('::', '127.0.0.1'), ('::', '[::1]')])
def test_packets_to_a_viewer_are_marked_as_video(
    bind: str, host: str, wire: socket.socket, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With IPv4, IPv6, and IPv4 on an IPv6 socket, which has a separate mark for each."""
    if ':' in bind:
        needs_ipv6()

    async def run() -> set[int]:
        async with serving(tmp_path, monkeypatch, bind) as page:
            origin = f'http://{host}:{page.server.port}'
            headers = {'Origin': origin, 'Cookie': f'shadowhound_live={page.cookies["viewer"]}'}
            async with aiohttp.ClientSession(headers=headers) as session, session.ws_connect(f'{origin}/ws') as ws:
                found: set[int] = set()
                while not found:
                    await ws.send_json({'ping': 1})
                    await ws.receive_bytes(timeout=60)
                    found = marks(wire, page.server.port, b'"pong"')
        return found

    assert asyncio.run(run()) == {AF41}
