"""Links to a server with a limited rate or a long delay, in a private network namespace.

The rate is shaped by the kernel (tc-htb(8)): a port that forwards to the server, and a token bucket on the loopback device that
holds all packets to it. The delay is a tun device of this program, because not every kernel has tc-netem(8).
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import os
import shutil
import struct
import subprocess
import sys
import threading
import time
from collections import deque
from types import TracebackType
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from typing_extensions import Self

BURST: Final = '32kb'
QUEUE: Final = 100
"""Maximum packets queued for the link, as in a radio: 0.4 s at 3 Mbit/s."""
MTU: Final = 1500
PIECE_BYTES: Final = 64 << 10
NEAR, FAR = '10.79.0.1', '10.79.0.2'
"""A client that connects to the latter arrives at the former, and appears as the latter there."""
FAR_DEVICE: Final = 'far'
_TUNSETIFF: Final = 0x400454CA
_IFF_TUN, _IFF_NO_PI = 0x0001, 0x1000
_SOURCE, _DESTINATION = slice(12, 16), slice(16, 20)
"""Offsets in the IPv4 header. The two addresses are swapped: the checksum stays the same."""
_INSIDE: Final = 'SHADOWHOUND_BENCH_NETWORK'


def in_own_network() -> None:
    """Restart this program in a private network namespace, unless it is in one; exits without the permission to create one."""
    if not os.environ.get(_INSIDE):
        if not (shutil.which('unshare') and shutil.which('tc')):
            raise SystemExit('unshare(1) and tc(8) are needed')
        os.environ[_INSIDE] = 'yes'
        mapped = [] if os.geteuid() == 0 else ['--user', '--map-root-user']
        os.execvp('unshare', ['unshare', '--net', *mapped, sys.executable, *sys.argv])  # noqa: S606 - this very program
    _run('ip', 'link', 'set', 'lo', 'up', 'mtu', str(MTU), 'multicast', 'on')


class ShapedLinks:
    """Links to one server, each with its own rate. ``with``; owns one thread."""

    def __init__(self, url: str, mbps: list[float]) -> None:
        self._server = urlsplit(url)
        self._mbps = mbps
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name='links', daemon=True)
        self.urls: list[str] = []
        """Of the links, in the order of their rates."""

    def __enter__(self) -> Self:
        self._thread.start()
        _run('tc', 'qdisc', 'add', 'dev', 'lo', 'root', 'handle', '1:', 'htb')  # unclassified packets are not delayed
        for place, mbps in enumerate(self._mbps, 16):
            port = asyncio.run_coroutine_threadsafe(self._listen(), self._loop).result(10)
            rate, own = f'{mbps}mbit', f'1:{place}'
            _run(
                'tc',
                'class',
                'add',
                'dev',
                'lo',
                'parent',
                '1:',
                'classid',
                own,
                'htb',
                'rate',
                rate,
                'ceil',
                rate,
                'burst',
                BURST,
            )
            _run('tc', 'qdisc', 'add', 'dev', 'lo', 'parent', own, 'pfifo', 'limit', str(QUEUE))
            _run('tc', 'filter', 'add', 'dev', 'lo', 'parent', '1:', 'protocol', 'ip', 'u32', 'match', 'ip', 'dport', str(port),
                 '0xffff', 'flowid', own)  # fmt: skip
            self.urls.append(f'http://127.0.0.1:{port}')
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        asyncio.run_coroutine_threadsafe(self._end(), self._loop).result(10)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _end(self) -> None:
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    async def _listen(self) -> int:
        server = await asyncio.start_server(self._pass_on, '127.0.0.1', 0)
        return int(server.sockets[0].getsockname()[1])

    async def _pass_on(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError, asyncio.CancelledError):
            to_server = await asyncio.open_connection(self._server.hostname, self._server.port)
            await asyncio.gather(_copy(reader, to_server[1]), _copy(to_server[0], writer))


class LongWay:
    """A route from FAR to NEAR and back that delays each packet by half of ``round_s`` in each direction; needs root.

    It exists as long as the process.
    """

    def __init__(self, round_s: float) -> None:
        self.round_s = round_s
        self._device = os.open('/dev/net/tun', os.O_RDWR)
        fcntl.ioctl(self._device, _TUNSETIFF, struct.pack('16sH', FAR_DEVICE.encode(), _IFF_TUN | _IFF_NO_PI))
        _run('ip', 'addr', 'add', f'{NEAR}/24', 'dev', FAR_DEVICE)
        _run('ip', 'link', 'set', FAR_DEVICE, 'up', 'mtu', str(MTU), 'txqueuelen', '2000')
        self._packets: deque[tuple[float, bytearray]] = deque()
        self._some = threading.Event()
        for work in (self._take, self._give):
            threading.Thread(target=work, name='long way', daemon=True).start()

    def _take(self) -> None:
        while True:
            packet = bytearray(os.read(self._device, 2 * MTU))
            if packet[0] >> 4 == 4:
                packet[_SOURCE], packet[_DESTINATION] = packet[_DESTINATION], packet[_SOURCE]
                self._packets.append((time.monotonic() + self.round_s / 2, packet))
                self._some.set()

    def _give(self) -> None:
        while True:
            self._some.wait()
            self._some.clear()
            while self._packets:
                at_s, packet = self._packets.popleft()
                time.sleep(max(0.0, at_s - time.monotonic()))
                os.write(self._device, packet)


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError):
        while piece := await reader.read(PIECE_BYTES):
            writer.write(piece)
            await writer.drain()
    with contextlib.suppress(OSError):
        writer.close()


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f'{" ".join(command)} failed: {done.stderr.strip()}')
