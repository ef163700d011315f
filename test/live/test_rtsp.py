"""The cameras over RTSP: read back by GStreamer, with the password and without."""

from __future__ import annotations

import asyncio
import io
import shutil
import stat
import subprocess
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
    (jpeg(481, 640), '481'), (jpeg(8, 2048), '2048'), (b'', 'no JPEG'), (progressive(), 'baseline'),
])  # fmt: skip
def test_what_rfc_2435_cannot_send_is_said(picture: bytes, word: str) -> None:
    """Sizes, sampling and coding of a JPEG decide."""
    assert word in unsuited(picture)
    assert bool(word) is bool(unsuited(picture))


def test_the_password_is_in_a_file_of_its_owner(tmp_path: Path) -> None:
    """It stays the same until new tokens are made."""
    make_tokens(tmp_path)
    first = rtsp_password(tmp_path)
    assert len(first) > 20
    assert rtsp_password(tmp_path) == first
    assert stat.S_IMODE((tmp_path / 'rtsp.password').stat().st_mode) == 0o600
    make_tokens(tmp_path, anew=True)
    assert rtsp_password(tmp_path) != first


def test_a_machine_without_gstreamer_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Whether there is no Python of the system, or one without bindings."""

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
        said = asyncio.run(run())
        assert 'gir1.2-gst-rtsp-server-1.0' in said
        assert 'secret' not in said


@pytest.mark.long("GStreamer's RTSP server and client")
def test_gstreamer_plays_the_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the password, the very JPEGs; without it, nothing. A topic is read while somebody plays it, from where is known."""
    if not has_gstreamer():
        pytest.skip(f'no GStreamer is installed here: {INSTALL}')

    async def play(url: str, password: str, out: Path) -> str:
        """Until four frames are there, or the player has ended."""
        out.mkdir()
        command = f'gst-launch-1.0 -q rtspsrc location={url} protocols=tcp user-id=viewer ! rtpjpegdepay ! multifilesink'.split()
        command[5:5] = [f'user-pw={password}']
        pipe = asyncio.subprocess.PIPE
        command += [f'location={out}/%03d.jpg', 'max-files=5']
        player = await asyncio.create_subprocess_exec(*command, stdout=pipe, stderr=pipe)
        said = asyncio.create_task(player.communicate())

        async def has_enough() -> bool:
            return said.done() or len(list(out.iterdir())) >= 4

        try:
            await until(has_enough, 'frames')
        finally:
            if player.returncode is None:
                player.terminate()
        return b''.join(await said).decode()

    async def run() -> None:
        async with robot(tmp_path, monkeypatch, rtsp=0) as found:
            server, rtsp = found.server, found.server._rtsp
            assert rtsp is not None
            players: list[tuple[str, ...]] = []
            monkeypatch.setattr(rtsp, '_changed', lambda: (players.append(rtsp.players), server._rewatch()))

            async def is_idle() -> bool:
                return server._wanted == {}

            url, password = f'{server.rtsp_url}{CAMERA}', (tmp_path / 'live' / 'rtsp.password').read_text().strip()
            assert 'nauthorized' in await play(url, 'a wrong password', tmp_path / 'none')
            assert list((tmp_path / 'none').iterdir()) == []
            assert await is_idle()
            assert {*players} <= {()}
            said = await play(url, password, tmp_path / 'out')
            pictures = [path.read_bytes() for path in sorted((tmp_path / 'out').iterdir())[:3]]
            assert len(pictures) == 3, said
            for played in pictures:
                level = int(simplejpeg.decode_jpeg(played)[120, 160, 1])
                assert min(abs(level - (20 + 18 * number)) for number in range(LEVELS)) < 4
            assert ('127.0.0.1',) in players

            async def has_left() -> bool:
                return await is_idle() and rtsp.players == ()

            await until(has_left, 'nothing is read, and nobody plays')

    asyncio.run(run())
