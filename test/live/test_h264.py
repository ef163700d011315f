"""Which encoder of H.264 serves, and what becomes of an encoder that fails, of pictures of any kind and of their times."""

from __future__ import annotations

import asyncio
import contextlib
import io
import logging
import subprocess
import sys
from collections.abc import AsyncIterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
from PIL import Image

from shadowhound_data_logger.live import gstreamer, h264
from shadowhound_data_logger.live.h264 import (
    BLOCKS_3_1,
    HARDWARE,
    SOFTWARE,
    H264Element,
    H264Encoder,
    H264Unavailable,
    find_h264,
    fitted,
)
from shadowhound_data_logger.live.h264_process import choose

INSTALL = ('apt install python3-gi gir1.2-gst-rtsp-server-1.0 gstreamer1.0-plugins-base gstreamer1.0-plugins-good'
           ' gstreamer1.0-plugins-bad gstreamer1.0-plugins-ugly')  # fmt: skip
PROBE = """import gi
for name in ('Gst', 'GstVideo', 'GstRtspServer'):
    gi.require_version(name, '1.0')
from gi.repository import Gst
Gst.init(None)
print(*(name for name in ('x264enc', 'h264parse', 'jpegdec') if Gst.ElementFactory.find(name)))"""


@lru_cache
def software_encoder() -> str:
    """Its name, if it is installed here; it goes the way that hardware goes. Without it the test is skipped."""
    found = subprocess.run([gstreamer.PYTHON, '-I', '-c', PROBE], check=False, capture_output=True, text=True).stdout.split()
    if found != [SOFTWARE.name, 'h264parse', 'jpegdec']:
        pytest.skip(f'no GStreamer with x264enc is installed here: {INSTALL}')
    return SOFTWARE.name


def jpeg(level: int, height: int = 240, width: int = 320, sampling: str = '420') -> bytes:
    return bytes(simplejpeg.encode_jpeg(np.full((height, width, 3), level, np.uint8), 90, colorsubsampling=sampling))


def grey(level: int) -> bytes:
    return bytes(simplejpeg.encode_jpeg(np.full((240, 320, 1), level, np.uint8), 90, 'GRAY', 'Gray'))


def progressive(level: int) -> bytes:
    file = io.BytesIO()
    Image.new('RGB', (320, 240), (level, level, level)).save(file, 'JPEG', quality=90, progressive=True)
    return file.getvalue()


# -- the choice ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(('there', 'broken', 'found'), [
    ([], [], {'error': 'GStreamer has no c'}),
    (['a', 'b', 'c'], [], {'found': 'a'}),
    (['b', 'c'], [], {'found': 'b'}),
    (['a', 'b'], ['a'], {'found': 'b'}),
    (['c'], ['c'], {'error': 'no device for c'}),
])  # fmt: skip
def test_the_first_encoder_that_is_there_and_encodes_is_taken(there: list[str], broken: list[str], found: dict[str, str]) -> None:
    """One may be registered on a machine that lacks its device; one that is not there is not tried."""
    tried: list[str] = []

    def problem(element: dict[str, Any]) -> str:
        tried.append(element['name'])
        return f'no device for {element["name"]}' if element['name'] in broken else ''

    assert choose([{'name': name} for name in 'abc'], there.__contains__, problem) == found
    assert {*tried} <= {*there}


def test_the_jetsons_own_encoder_comes_first_and_none_in_software_comes_by_itself() -> None:
    """What encodes on the processor is for those who name it."""
    assert HARDWARE[0].name == 'nvv4l2h264enc'
    assert 'video/x-raw(memory:NVMM),format=NV12 ! nvv4l2h264enc' in HARDWARE[0].launch
    assert SOFTWARE not in HARDWARE


@pytest.mark.parametrize('element', [*HARDWARE, SOFTWARE], ids=lambda element: element.name)
def test_an_encoder_is_told_its_rate_in_its_own_unit(element: H264Element) -> None:
    """Bits or kilobits a second, the distance of key frames, and nothing that is left to fill in."""
    settings = element.settings(500_000, 150)
    text = ' '.join(settings.values())
    assert ('500000' in text) is (element.name in {'nvv4l2h264enc', 'mpph264enc', 'v4l2h264enc'})
    assert '500' in text
    assert '150' in text
    assert not {'{', '}'} & {*text}
    assert f'{element.name} name=h264' in element.launch


@pytest.mark.parametrize(
    'name', ['x264enc ! filesink location=/tmp/x', 'x264enc name=h264', '', ' ', 'a!b', 'ä', 'a\n', '../x', 'a' * 101]
)
def test_a_name_that_is_no_elements_is_refused_unseen(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would become part of a pipeline."""

    async def found(_: Any) -> dict[str, Any]:
        raise AssertionError('GStreamer is told of it')

    monkeypatch.setattr(h264, '_found', found)
    if not name:
        with pytest.raises(AssertionError):  # the hardware is looked for
            asyncio.run(find_h264(name))
    else:
        with pytest.raises(H264Unavailable, match='is not the name of an element'):
            asyncio.run(find_h264(name))


def test_a_machine_without_gstreamer_has_no_encoder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Unless one is named, that is no error; ``none`` does not even ask."""
    monkeypatch.setattr(gstreamer, 'PYTHON', tmp_path / 'no python')
    assert asyncio.run(find_h264()) is None
    assert asyncio.run(find_h264('none')) is None
    with pytest.raises(H264Unavailable, match='x264enc does not encode here'):
        asyncio.run(find_h264('x264enc'))


TRIES = """import json, os, struct, sys
def read():
    head, body = struct.unpack('<II', sys.stdin.buffer.read(8))
    return json.loads(sys.stdin.buffer.read(head)), sys.stdin.buffer.read(body)
tried, _ = read()
read()
for name in [each['name'] for each in tried['find']]:
    if name == 'nvh264enc':
        {breaks}
text = json.dumps({'found': 'v4l2h264enc'} if name == 'v4l2h264enc' else {'error': 'no device'}).encode()
sys.stdout.buffer.write(struct.pack('<II', len(text), 0) + text)
"""


@pytest.mark.parametrize(('breaks', 'why'), [('os.abort()', 'its process has ended'), ('sys.stdin.read()', 'says nothing')])
def test_an_encoder_that_crashes_or_hangs_keeps_no_other_from_being_tried(
    breaks: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The log says which one it was."""
    caplog.set_level(logging.INFO)
    (tmp_path / 'script.py').write_text(TRIES.replace('{breaks}', breaks))
    monkeypatch.setattr(h264, 'SCRIPT', tmp_path / 'script.py')
    monkeypatch.setattr(h264, 'FIND_S', 30.0 if 'ended' in why else 1.0)
    monkeypatch.setattr(gstreamer, 'PYTHON', Path(sys.executable))
    found = asyncio.run(find_h264())
    assert found is not None
    assert found.name == 'v4l2h264enc'
    assert [text.split(':')[0] for text in caplog.messages if why in text][1:] == ['nvh264enc']
    with pytest.raises(H264Unavailable, match=why):
        asyncio.run(find_h264('nvh264enc'))


@pytest.mark.parametrize(('width', 'height', 'encoded'), [
    (640, 480, (640, 480)), (321, 241, (320, 240)), (1280, 720, (1280, 720)), (1920, 1080, (1264, 704)), (2, 3, (2, 2)),
    (1278, 721, (1264, 704)), (30_000, 1000, (1920, 64)), (65_535, 2, (1920, 16)), (4000, 3000, (1104, 816)),
])  # fmt: skip
def test_frames_are_made_to_fit_the_level_that_viewers_decode(width: int, height: int, encoded: tuple[int, int]) -> None:
    """Even sides, at most as many macroblocks as level 3.1 has."""
    assert fitted(width, height, BLOCKS_3_1) == encoded
    assert -(-encoded[0] // 16) * -(-encoded[1] // 16) <= BLOCKS_3_1


@pytest.mark.parametrize(('width', 'height'), [(1, 100), (100, 1), (0, 0), (65_535, 65_535)])
def test_frames_without_pixels_or_with_too_many_are_refused(width: int, height: int) -> None:
    """Before anything is made of them."""
    with pytest.raises(ValueError):
        fitted(width, height, BLOCKS_3_1)


# -- a process that fails ------------------------------------------------------------------------------------------------------

SAYS = """import json, struct, sys
def say(head, body=b'', text=None, size=None):
    text = json.dumps(head).encode() if text is None else text
    sys.stdout.buffer.write(struct.pack('<II', len(text), len(body) if size is None else size) + text + body)
    sys.stdout.buffer.flush()
def wait():
    sys.stdin.buffer.read()
"""


@pytest.mark.parametrize(('script', 'why'), [
    ('', 'has ended'),
    ('say({"error": "no memory on the device"}); wait()', 'no memory on the device'),
    ('say({"at": 0.0, "key": True}, size=1 << 30); wait()', '1,073,741,824 bytes'),
    ('say({}, text=b"[" * 5000); wait()', '5,000'),
    ('say({}, text=b"nonsense"); wait()', 'Expecting value'),
    ('say([1, 2]); wait()', ''),
    ('say({"at": 0.0}, b"\\0\\0\\0\\1e"); wait()', 'key'),
    ('say({"at": 0.0, "key": True}, b"GIF89a"); wait()', 'no H.264'),
    ('say({"at": 1e9, "key": True}, b"\\0\\0\\0\\1e"); wait()', 'no H.264'),
    ('say({"at": float("nan"), "key": True}, b"\\0\\0\\0\\1e"); wait()', 'no H.264'),
    ('say({"at": -1e300, "key": True}, b"\\0\\0\\0\\1e"); wait()', 'no H.264'),
    ('say({}, text=b"[" * 2000); wait()', 'deeper than 64'),
    ('wait()', 'nothing for 0.3 s'),
    ('while True: sys.stdout.buffer.write(b"noise" * 99_999)', 'bytes at once'),
])  # fmt: skip
def test_a_process_that_fails_is_told_of_once(script: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether it ends, says that it cannot, says nothing, or says what is no H.264 of the camera; nothing of it is passed on."""
    (tmp_path / 'script.py').write_text(SAYS + script)
    monkeypatch.setattr(h264, 'SCRIPT', tmp_path / 'script.py')
    monkeypatch.setattr(gstreamer, 'PYTHON', Path(sys.executable))
    monkeypatch.setattr(h264, 'NOTHING_S', 0.3 if 'nothing for' in why else 30.0)
    made: list[Any] = []
    failed: list[str] = []

    async def run() -> None:
        over = asyncio.Event()

        def on_failed(text: str) -> None:
            failed.append(text)
            over.set()

        encoder = H264Encoder(HARDWARE[0], 500_000, lambda *what: made.append(what), on_failed)
        encoder.open()
        for number in range(600):
            encoder.offer(float(number), jpeg(0))
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(over.wait(), 0.05)
                break
        encoder.offer(1e6, jpeg(0))
        await encoder.close()
        assert encoder.pid is None

    asyncio.run(run())
    assert made == []
    (text,) = failed
    assert text.startswith('nvv4l2h264enc: ')
    assert why in text
    assert text.endswith(', with pictures of 320 x 240')


# -- a software encoder in the place of hardware -------------------------------------------------------------------------------


class Decoded:
    """What an encoder makes, and what a decoder sees in it."""

    def __init__(self, encoder: H264Encoder, units: list[tuple[float, bool, bytes]], failed: list[str]) -> None:
        self.encoder, self.units, self.failed = encoder, units, failed
        self._at_ms = 0.0

    async def encode(self, picture: bytes, *, waits: bool = True) -> float:
        """When it came; ``waits`` until it is encoded."""
        self._at_ms += 33.4
        at_ms = round(self._at_ms, 1)
        self.encoder.offer(at_ms, picture)

        async def coming() -> None:
            while not self.failed and (not self.units or self.units[-1][0] < at_ms - 0.01):
                await asyncio.sleep(0.01)

        if waits:
            await asyncio.wait_for(coming(), 20.0)
        assert not self.failed
        return at_ms

    def seen(self) -> dict[float, tuple[int, int, int]]:
        """Width, height and brightness by time."""
        av = pytest.importorskip('av')
        codec = av.CodecContext.create('h264', 'r')
        codec.flags |= 0x80000  # AV_CODEC_FLAG_LOW_DELAY
        found: dict[float, tuple[int, int, int]] = {}
        for at_ms, _, unit in [*self.units, (0.0, False, b'')]:
            packet = av.Packet(unit) if unit else None
            if packet is not None:
                packet.pts = round(at_ms * 10)
            for frame in codec.decode(packet):
                pixels = frame.to_ndarray(format='rgb24')
                found[frame.pts / 10] = frame.width, frame.height, int(pixels[pixels.shape[0] // 2, pixels.shape[1] // 2, 1])
        return found


@contextlib.asynccontextmanager
async def decoded() -> AsyncIterator[Decoded]:
    element = await find_h264(software_encoder())
    assert element is not None
    units: list[tuple[float, bool, bytes]] = []
    failed: list[str] = []
    encoder = H264Encoder(element, 500_000, lambda *what: units.append(what), failed.append)
    encoder.open()
    while encoder.pid is None:  # frames before are nobody's
        await asyncio.sleep(0.01)
    try:
        yield Decoded(encoder, units, failed)
    finally:
        await encoder.close()


@pytest.mark.long("GStreamer's encoder of H.264")
def test_each_picture_is_encoded_with_the_time_at_which_it_came() -> None:
    """Also progressive ones, of any sampling and size, in the middle of others; one that is broken costs itself alone."""
    kinds = {
        'plain': jpeg(50), '444': jpeg(100, sampling='444'), '422': jpeg(150, sampling='422'), 'progressive': progressive(200),
        'odd': jpeg(80, 121, 161), 'grey': grey(120), 'large': jpeg(170, 1080, 1920), 'again': jpeg(60),
    }  # fmt: skip
    shapes = {'odd': (160, 120), 'large': (1264, 704)}
    levels = {'plain': 50, '444': 100, '422': 150, 'progressive': 200, 'odd': 80, 'grey': 120, 'large': 170, 'again': 60}

    async def run() -> None:
        async with decoded() as found:
            at = {name: await found.encode(picture) for name, picture in kinds.items()}
            whole = jpeg(30)
            await found.encode(whole[: len(whole) // 2], waits=False)
            await found.encode(b'no picture', waits=False)
            levels['after'], at['after'] = 220, await found.encode(jpeg(220))
            seen = found.seen()
            for name, at_ms in at.items():
                width, height, level = seen[at_ms]
                assert (width, height) == shapes.get(name, (320, 240)), name
                assert abs(level - levels[name]) < 9, name

    asyncio.run(run())


@pytest.mark.long("GStreamer's encoder of H.264")
def test_key_frames_come_when_asked_for_and_rates_change_without_one() -> None:
    """A key frame brings its parameters along, so that a viewer can begin with it."""

    async def run() -> None:
        async with decoded() as found:
            for number in range(20):
                await found.encode(jpeg(50 + number))
            assert [is_key for _, is_key, _ in found.units] == [True, *[False] * 19]
            found.encoder.set_rate(150_000)
            for number in range(5):
                await found.encode(jpeg(70 + number))
            assert found.encoder.keys == 1
            found.encoder.ask_key()
            for number in range(5):
                await found.encode(jpeg(80 + number))
            keys = [unit for _, is_key, unit in found.units if is_key]
            assert len(keys) == found.encoder.keys == 2
            for unit in keys:
                parts = {part[0] & 31: part for part in unit.split(b'\0\0\1')[1:]}
                assert {5, 7, 8} <= parts.keys()  # a picture, and its parameters (ITU-T H.264, table 7-1)
                assert parts[7][1] == 66  # baseline, which viewers of WebRTC agree to

    asyncio.run(run())


@pytest.mark.long("GStreamer's encoder of H.264")
def test_the_rate_is_kept() -> None:
    """Noise at 30 frames a second takes about the bits that it may, and fewer after a lower rate was set."""
    random = np.random.default_rng(1)
    pictures = [bytes(simplejpeg.encode_jpeg(random.integers(0, 255, (240, 320, 3), np.uint8), 80)) for _ in range(60)]

    async def run() -> None:
        async with decoded() as found:
            for picture in pictures:
                await found.encode(picture)
            first = sum(len(unit) for *_, unit in found.units[30:]) * 8
            found.encoder.set_rate(1_500_000)
            for picture in pictures:
                await found.encode(picture)
            second = sum(len(unit) for *_, unit in found.units[90:]) * 8
            assert first < 1_000_000
            assert 1.5 * first < second < 2_500_000

    asyncio.run(run())


@pytest.mark.long("GStreamer's encoder of H.264")
def test_what_a_driver_prints_is_not_taken_for_what_the_process_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """NVIDIA's print to standard output."""
    monkeypatch.setattr(h264, 'SOFTWARE', replace(SOFTWARE, launch=f'identity dump=true ! {SOFTWARE.launch}'))

    async def run() -> None:
        async with decoded() as found:
            for number in range(3):
                await found.encode(jpeg(50 + number))

    asyncio.run(run())


@pytest.mark.long("GStreamer's encoder of H.264")
def test_only_an_encoder_that_encodes_here_is_found() -> None:
    """By its name; an element that is none, or does something else, is refused with the reason."""
    named = software_encoder()

    async def run() -> None:
        found = await find_h264(named)
        assert found is not None
        assert found.name == named
        for name, why in (('nosuchenc', 'GStreamer has no nosuchenc'), ('fakesink', 'fakesink does not encode here')):
            with pytest.raises(H264Unavailable, match=why):
                await find_h264(name)

    asyncio.run(run())
