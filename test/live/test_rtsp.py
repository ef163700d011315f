"""The cameras over RTSP: played by GStreamer, with and without the password."""

from __future__ import annotations

import asyncio
import contextlib
import io
import re
import shutil
import socket
import stat
import subprocess
from hashlib import new
from pathlib import Path

import numpy as np
import pytest
import simplejpeg
from live.test_webrtc import CAMERA, LEVELS, robot, until
from PIL import Image

from shadowhound_data_logger.live import rtsp as module
from shadowhound_data_logger.live.access import make_tokens, rtsp_password
from shadowhound_data_logger.live.rtsp import PYTHON, RtspServer, RtspUnavailable, unsuited

PROBE = """import gi
for name in ('Gst', 'GstRtspServer'):
    gi.require_version(name, '1.0')
from gi.repository import Gst, GstRtspServer
Gst.init(None)
raise SystemExit(Gst.ElementFactory.find('rtpjpegpay') is None)"""
INSTALL = 'apt install gstreamer1.0-tools gstreamer1.0-plugins-good gir1.2-gst-rtsp-server-1.0 python3-gi'


def has_gstreamer() -> bool:
    if shutil.which('gst-launch-1.0') is None or not PYTHON.exists():
        return False
    return subprocess.run([PYTHON, '-c', PROBE], check=False, capture_output=True).returncode == 0


def jpeg(height: int, width: int, sampling: str = '420') -> bytes:
    return bytes(simplejpeg.encode_jpeg(np.zeros((height, width, 3), np.uint8), 80, colorsubsampling=sampling))


def progressive() -> bytes:
    file = io.BytesIO()
    Image.new('RGB', (64, 64)).save(file, 'JPEG', progressive=True, subsampling='4:2:0')
    return file.getvalue()


@pytest.mark.parametrize(('picture', 'word'), [
    (jpeg(480, 640), ''), (jpeg(480, 640, '422'), ''), (jpeg(8, 2040), ''), (jpeg(480, 640, '444'), '444'),
    (jpeg(481, 640), '481'), (jpeg(8, 2048), '2048'), (b'', 'not a JPEG'), (progressive(), 'baseline'),
])  # fmt: skip
def test_jpegs_unsupported_by_rfc_2435_are_reported(picture: bytes, word: str) -> None:
    """It depends on the size, subsampling and coding of a JPEG."""
    assert word in unsuited(picture)
    assert bool(word) is bool(unsuited(picture))


def test_the_password_is_in_a_file_of_its_owner(tmp_path: Path) -> None:
    """It is unchanged until new tokens are created."""
    make_tokens(tmp_path)
    first = rtsp_password(tmp_path)
    assert len(first) > 20
    assert rtsp_password(tmp_path) == first
    assert stat.S_IMODE((tmp_path / 'rtsp.password').stat().st_mode) == 0o600
    make_tokens(tmp_path, replace=True)
    assert rtsp_password(tmp_path) != first


def test_a_missing_gstreamer_has_a_remedy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """If there is no system Python, or one without bindings."""

    async def run() -> str:
        server = RtspServer('127.0.0.1', 0, 'secret', lambda: None)
        with pytest.raises(RtspUnavailable) as caught:
            await server.open()
        return f'{caught.value} {caught.value.DEFAULT_REMEDY}'

    bare = tmp_path / 'python3'
    bare.write_text('#!/bin/sh\necho \'{"error": "the system has no RTSP server: no gi"}\'\n')
    for python in (tmp_path / 'none', bare):
        monkeypatch.setattr(module, 'PYTHON', python)
        if python is bare:
            bare.chmod(0o755)
        report = asyncio.run(run())
        assert 'gir1.2-gst-rtsp-server-1.0' in report
        assert 'secret' not in report


def hashed(text: str) -> str:
    """As in RFC 2617."""
    return new('md5', text.encode(), usedforsecurity=False).hexdigest()


class Player:
    """Our RTSP client (RFC 2326), for what others do not show: refusals, and the marks of packets."""

    def __init__(self, url: str, password: str | None) -> None:
        self.url, self.password = url, password
        self._socket = socket.create_connection((host := url.split('/')[2]).rsplit(':', 1), 30.0)
        self._host, self._number, self._challenge = host, 0, dict[str, str]()

    def ask(self, method: str, url: str = '', **headers: str) -> tuple[int, str]:
        """Status and text of the response; repeated with the password if required."""
        status, text = self._ask(method, url or self.url, headers)
        if status == 401 and self.password is not None and not self._challenge:
            self._challenge = dict(re.findall(r'(\w+)="([^"]*)"', next(line for line in text.splitlines() if 'Digest' in line)))
            status, text = self._ask(method, url or self.url, headers)
        return status, text

    def _ask(self, method: str, url: str, headers: dict[str, str]) -> tuple[int, str]:
        self._number += 1
        if self._challenge:
            realm, nonce = self._challenge['realm'], self._challenge['nonce']
            secret, asked = (hashed(text) for text in (f'viewer:{realm}:{self.password}', f'{method}:{url}'))
            answer = hashed(f'{secret}:{nonce}:{asked}')
            headers = headers | {'Authorization': f'Digest username="viewer", realm="{realm}", nonce="{nonce}", uri="{url}",'
                                                  f' response="{answer}"'}  # fmt: skip
        lines = [f'{method} {url} RTSP/1.0', f'CSeq: {self._number}', *(f'{name}: {value}' for name, value in headers.items())]
        self._socket.sendall('\r\n'.join([*lines, '', '']).encode())
        text = b''
        while b'\r\n\r\n' not in text or len(text.partition(b'\r\n\r\n')[2]) < int(
            (re.findall(rb'Content-Length: (\d+)', text) or [0])[0]
        ):
            more = self._socket.recv(65536)
            assert more, text
            text += more
        return int(text.split()[1]), text.decode()

    def close(self) -> None:
        self._socket.close()


async def until_served(url: str) -> None:
    """The process learns of a topic a moment after the page."""

    def status() -> int:
        with contextlib.closing(Player(url, None)) as player:
            return player.ask('DESCRIBE')[0]

    async def is_served() -> bool:
        return await asyncio.to_thread(status) != 404

    await until(is_served, 'a topic')


def tos_of_packets(url: str, password: str, count: int) -> tuple[str, set[int]]:
    """The description of the stream, and the marks of this many RTP packets."""
    with contextlib.ExitStack() as stack:
        player = stack.enter_context(contextlib.closing(Player(url, password)))
        rtp, rtcp = (stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2))
        for one in (rtp, rtcp):
            one.bind(('127.0.0.1', 0))
            one.settimeout(30.0)
        rtp.setsockopt(socket.IPPROTO_IP, socket.IP_RECVTOS, 1)
        status, described = player.ask('DESCRIBE')
        assert status == 200, described
        control = re.findall(r'a=control:(\S+)', described)[-1]
        ports = f'{rtp.getsockname()[1]}-{rtcp.getsockname()[1]}'
        status, text = player.ask(
            'SETUP', control if '://' in control else f'{url}/{control}', Transport=f'RTP/AVP;unicast;client_port={ports}'
        )
        assert status == 200, text
        session = re.findall(r'Session: ([^;\s]+)', text)[0]
        assert player.ask('PLAY', Session=session)[0] == 200
        marks = {int(rtp.recvmsg(2048, 64)[1][0][2][0]) for _ in range(count)}
        player.ask('TEARDOWN', Session=session)
        return described, marks


@pytest.mark.long("GStreamer's RTSP server")
def test_rtsp_requires_the_password(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without one or with a wrong one it is 401; packets are marked as interactive video (AF41)."""
    if not has_gstreamer():
        pytest.skip(f'no GStreamer is installed here: {INSTALL}')

    async def run() -> None:
        async with robot(tmp_path, monkeypatch, rtsp=0) as found:
            url, password = f'{found.server.rtsp_url}{CAMERA}', (tmp_path / 'live' / 'rtsp.password').read_text().strip()
            await until_served(url)
            for wrong in (None, '', 'a wrong one'):
                for method in ('DESCRIBE', 'SETUP', 'PLAY'):
                    player = await asyncio.to_thread(Player, url, wrong)
                    status, text = await asyncio.to_thread(player.ask, method)
                    player.close()
                    assert status in ({401} if method == 'DESCRIBE' else {401, 454, 461}), text  # no session, no transport
                    assert 'm=video' not in text
            assert found.server.viewers.wanted == {}
            described, marks = await asyncio.to_thread(tos_of_packets, url, password, 5)
            assert 'm=video 0 RTP/AVP 26' in described
            assert marks == {34 << 2}

    asyncio.run(run())


@pytest.mark.long("GStreamer's RTSP server and client")
def test_gstreamer_plays_the_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the password, the same JPEGs; without it, nothing. A topic is read while a player uses it, with a known address."""
    if not has_gstreamer():
        pytest.skip(f'no GStreamer is installed here: {INSTALL}')

    async def play(url: str, password: str, out: Path) -> str:
        """Until four frames have arrived, or the player has exited."""
        out.mkdir()
        command = f'gst-launch-1.0 -q rtspsrc location={url} protocols=tcp user-id=viewer ! rtpjpegdepay ! multifilesink'.split()
        command[5:5] = [f'user-pw={password}']
        pipe = asyncio.subprocess.PIPE
        command += [f'location={out}/%03d.jpg', 'max-files=5']
        player = await asyncio.create_subprocess_exec(*command, stdout=pipe, stderr=pipe)
        report = asyncio.create_task(player.communicate())

        async def has_enough() -> bool:
            return report.done() or len(list(out.iterdir())) >= 4

        try:
            await until(has_enough, 'frames')
        finally:
            if player.returncode is None:
                player.terminate()
        return b''.join(await report).decode()

    async def run() -> None:
        async with robot(tmp_path, monkeypatch, rtsp=0) as found:
            server, rtsp = found.server, found.server.cameras.rtsp
            assert rtsp is not None
            players: list[tuple[str, ...]] = []
            monkeypatch.setattr(rtsp, '_changed', lambda: (players.append(rtsp.players), server.viewers.rewatch()))

            async def is_idle() -> bool:
                return server.viewers.wanted == {}

            url, password = f'{server.rtsp_url}{CAMERA}', (tmp_path / 'live' / 'rtsp.password').read_text().strip()
            await until_served(url)
            assert 'nauthorized' in await play(url, 'a wrong password', tmp_path / 'none')
            assert list((tmp_path / 'none').iterdir()) == []
            assert await is_idle()
            assert {*players} <= {()}
            report = await play(url, password, tmp_path / 'out')
            pictures = [path.read_bytes() for path in sorted((tmp_path / 'out').iterdir())[:3]]
            assert len(pictures) == 3, report
            for played in pictures:
                level = int(simplejpeg.decode_jpeg(played)[120, 160, 1])
                assert min(abs(level - (20 + 18 * number)) for number in range(LEVELS)) < 4
            assert ('127.0.0.1',) in players

            async def has_left() -> bool:
                return await is_idle() and rtsp.players == ()

            await until(has_left, 'no topic is read, and there are no players')

    asyncio.run(run())
