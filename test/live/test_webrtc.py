"""The camera as video over WebRTC, to a real Chromium and to receivers of aiortc: from a server with generated frames."""

from __future__ import annotations

import asyncio
import shutil
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
from e2e.live_frames import first_shown_ms
from live.test_auth import Page, serving

from shadowhound_data_logger.core.options import COMPRESSED_IMAGE
from shadowhound_data_logger.live import cameras as cameras_module
from shadowhound_data_logger.live.kinds import LiveItem

CHROMIUM = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which('google-chrome')
CAMERA = '/camera'
LEVELS = 12
OFFER = """v=0
o=- 1 2 IN IP4 127.0.0.1
s=-
t=0 0
m=video 9 UDP/TLS/RTP/SAVPF 96
c=IN IP4 0.0.0.0
a=candidate:1 1 udp 2113937151 44704baf-a062-4990-bc94-2b32b99782c0.local 48973 typ host generation 0
a=candidate:2 1 udp 2113937151 203.0.113.9 50000 typ host generation 0
a=candidate:3 1 tcp 1518280447 203.0.113.9 9 typ host tcptype active
a=candidate:4 1 udp 1677729535 203.0.113.9 50001 typ srflx raddr 0.0.0.0 rport 0
a=ice-ufrag:Ovmx
a=ice-pwd:JBXCKCpMvrxWitDC1/BFTuxa
a=fingerprint:sha-256 A3:8B:1D:B0:EA:06:0E:80:F8:28:E1:FA:90:B7:9B:75:92:33:B6:51:CB:69:98:21:16:74:7C:E8:C3:66:76:7C
a=setup:actpass
a=mid:0
a=recvonly
a=rtcp-mux
a=rtpmap:96 VP8/90000
"""


def picture(number: int) -> bytes:
    """320 x 240, with the index as its brightness."""
    return bytes(
        simplejpeg.encode_jpeg(np.full((240, 320, 3), 20 + 18 * (number % LEVELS), np.uint8), 90, colorsubsampling='420')
    )


async def open_page(tab: Any, found: Robot) -> None:
    """As on another machine of the network."""
    tab.set_default_timeout(90_000)
    await tab.goto(f'http://{own_address()}:{found.server.port}')
    await tab.locator('input[name=token]').fill(found.page.token('viewer'))
    await tab.locator('button.primary').click()


async def until(condition: Callable[[], Awaitable[Any]], what: str) -> Any:
    async def looking() -> Any:
        while not (found := await condition()):
            await asyncio.sleep(0.05)
        return found

    try:
        return await asyncio.wait_for(looking(), 90.0)
    except asyncio.TimeoutError:
        raise AssertionError(f'within 90 s: {what}') from None


def own_address() -> str:
    """Of this machine on its network; nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(('192.0.2.9', 9))
        except OSError:
            pytest.skip('this machine has no address except loopback')
        return str(probe.getsockname()[0])


class Robot:
    """A page with a camera of ten frames per second."""

    def __init__(self, page: Page) -> None:
        self.page, self.server = page, page.server
        self.at: list[float] = []
        """The arrival time of each frame, ms."""

    async def publish(self) -> None:
        while True:
            self.at.append(round(asyncio.get_running_loop().time() * 1e3, 1))
            self.server.viewers.on_items([LiveItem(CAMERA, 'camera', head={'at': self.at[-1]}, body=picture(len(self.at) - 1))])
            await asyncio.sleep(0.1)


@asynccontextmanager
async def robot(folder: Path, monkeypatch: pytest.MonkeyPatch, bind: str = '127.0.0.1', **settings: Any) -> AsyncIterator[Robot]:
    async with serving(folder, monkeypatch, bind, **settings) as page:
        page.server.cameras.no_video = ''
        page.server.viewers.on_graph({CAMERA: (COMPRESSED_IMAGE, 1)})
        found = Robot(page)
        task = asyncio.create_task(found.publish())
        try:
            yield found
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


@pytest.mark.long('a Chromium')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_two_browsers_take_the_camera_as_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is encoded once for both; each frame has its time of arrival at the robot; JPEGs are not sent in addition.

    When a viewer switches back to JPEG it gets those, and without viewers nothing is encoded.
    """
    api = pytest.importorskip('playwright.async_api')
    pytest.importorskip('aiortc')
    # The contents of the canvas and the time that the page shows for it.
    shown = """() => [document.querySelector('.camera canvas').getContext('2d').getImageData(160, 120, 1, 1).data[1],
                      shadowhound.at().camera, shadowhound.video.frames]"""

    async def run() -> None:
        async with robot(tmp_path, monkeypatch, '0.0.0.0') as found, api.async_playwright() as playwright:
            browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=['--no-sandbox', '--disable-gpu'])
            tabs = [await browser.new_page() for _ in range(2)]
            for tab in tabs:
                await open_page(tab, found)
                await tab.select_option('[data-video]', 'video')
            for tab in tabs:
                await until(lambda tab=tab: tab.evaluate('shadowhound.video.frames > 10'), 'frames of video')
            video = found.server.cameras.video
            assert video is not None
            assert len(video._peers) == 2
            assert video.topics == {CAMERA}
            assert video._encoders.keys() == {CAMERA}
            (encoder,) = video._encoders.values()
            assert encoder.encoded <= len(found.at)
            assert all(CAMERA not in one.viewer.watched for one in found.server.viewers.connected)
            for tab in tabs:
                reports = [await tab.evaluate(shown) for _ in range(20)]
                for level, at, _ in reports:
                    number = min(range(len(found.at)), key=lambda place: abs(found.at[place] - at))
                    assert abs(found.at[number] - at) < 1, 'no frame arrived at this time'
                    assert abs(level - (20 + 18 * (number % LEVELS))) < 9, 'the time is that of another frame'
            await tabs[0].select_option('[data-video]', 'jpeg')
            await until(lambda: tabs[0].evaluate("document.querySelector('[data-video]').dataset.video === 'off'"), 'JPEG again')
            before = await tabs[0].evaluate('shadowhound.count.camera')
            await until(lambda: tabs[0].evaluate(f'shadowhound.count.camera > {before} + 5'), 'frames as JPEG')
            await browser.close()

            async def is_idle() -> bool:
                return not video.topics

            await until(is_idle, 'nothing is encoded')

    asyncio.run(run())


@pytest.mark.long('a Chromium')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_a_browser_that_lost_packets_continues_with_a_key_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It asks aiortc for one by RTCP (PLI), and reports that."""
    api = pytest.importorskip('playwright.async_api')
    pytest.importorskip('aiortc')

    async def run() -> None:
        async with robot(tmp_path, monkeypatch, '0.0.0.0') as found, api.async_playwright() as playwright:
            browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=['--no-sandbox', '--disable-gpu'])
            tab = await browser.new_page()
            await open_page(tab, found)
            await tab.select_option('[data-video]', 'video')
            await until(lambda: tab.evaluate('shadowhound.video.frames > 10'), 'frames of video')
            video = found.server.cameras.video
            assert video is not None
            (peer,), (encoder,) = video._peers.values(), video._encoders.values()
            transport, keys = peer.pc.getSenders()[0].transport, encoder.keys

            async def lose(_: bytes) -> None:
                """Also what is sent again."""

            with monkeypatch.context() as broken:
                broken.setattr(transport, '_send_rtp', lose)
                await asyncio.sleep(2.0)
            frames = await tab.evaluate('shadowhound.video.frames')
            await until(lambda: tab.evaluate(f'shadowhound.video.frames > {frames} + 10'), 'frames of video again')
            assert encoder.keys > keys
            await browser.close()

    asyncio.run(run())


@pytest.mark.long('a Chromium')
@pytest.mark.skipif(CHROMIUM is None, reason='no Chromium is installed here: apt install chromium')
def test_without_the_extra_the_page_shows_jpegs_and_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if the extra is installed and the negotiation fails."""
    api = pytest.importorskip('playwright.async_api')

    async def run() -> None:
        async with robot(tmp_path, monkeypatch) as found, api.async_playwright() as playwright:
            browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=['--no-sandbox', '--disable-gpu'])
            tab = await browser.new_page()
            tab.set_default_timeout(90_000)
            found.server.cameras.no_video = cameras_module.NO_WEBRTC
            await tab.goto(found.page.origin)
            assert await tab.locator('[data-video]').get_attribute('title') == cameras_module.NO_WEBRTC
            found.server.cameras.no_video = ''
            await tab.reload()
            await tab.locator('select[data-video]').wait_for()
            found.server.cameras.no_video = cameras_module.NO_WEBRTC
            await tab.select_option('[data-video]', 'video')
            await until(lambda: tab.evaluate('shadowhound.video.problem.value'), 'a problem')
            assert cameras_module.NO_WEBRTC in await tab.locator('[data-video]').get_attribute('title')
            before = await tab.evaluate('shadowhound.count.camera')
            await until(lambda: tab.evaluate(f'shadowhound.count.camera > {before} + 5'), 'frames as JPEG')
            await browser.close()

    asyncio.run(run())


class Receiver:
    """A viewer without a browser, with one codec. aiortc returns a frame when the next one starts to arrive."""

    def __init__(self, video: Any, *codecs: str) -> None:
        import aiortc

        self.video, self.codecs = video, codecs
        self.told: list[dict[str, Any]] = []
        self.shown: list[tuple[int, int]] = []
        """Time of frames, from the first, in ticks of 90 kHz, and their brightness."""
        self.pc = aiortc.RTCPeerConnection(aiortc.RTCConfiguration(iceServers=[]))
        self._task: asyncio.Task[None] | None = None

    async def ask(self) -> dict[str, Any]:
        """Request the camera; returns the immediate response."""
        import aiortc

        transceiver = self.pc.addTransceiver('video', direction='recvonly')
        known = aiortc.RTCRtpReceiver.getCapabilities('video').codecs
        transceiver.setCodecPreferences([one for name in (*self.codecs, 'video/rtx') for one in known if one.mimeType == name])

        @self.pc.on('track')  # type: ignore[misc]
        def on_track(track: Any) -> None:
            self._task = asyncio.create_task(self._read(track))

        await self.pc.setLocalDescription(await self.pc.createOffer())
        fields = {'topic': CAMERA, 'offer': self.pc.localDescription.sdp}
        await self.video.take(self, fields, (own_address(), own_address()), lambda what: self.told.append(dict(what)))
        if answer := self.told[0].get('answer'):
            await self.pc.setRemoteDescription(aiortc.RTCSessionDescription(answer, 'answer'))
        return self.told[0]

    async def _read(self, track: Any) -> None:
        while True:
            frame = await track.recv()  # its pts begin with 0
            self.shown.append((frame.pts, int(frame.to_ndarray(format='rgb24')[120, 160, 1])))

    @property
    def seen(self) -> list[tuple[float, int]]:
        """When frames arrived at the robot, ms, and their brightness; empty while it is unknown."""
        first_ms = first_shown_ms([what['at'] for what in self.told if 'at' in what], [pts for pts, _ in self.shown])
        return [(first_ms + pts / 90, level) for pts, level in self.shown] if first_ms is not None else []

    async def has_seen(self) -> bool:
        return len(self.seen) >= 10

    async def close(self) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        await self.pc.close()


@asynccontextmanager
async def encoded() -> AsyncIterator[tuple[Any, list[float]]]:
    """The video of a camera of ten frames per second, and when each arrived, ms."""
    webrtc = pytest.importorskip('shadowhound_data_logger.live.webrtc')
    video = webrtc.CameraVideo(lambda: None)
    at: list[float] = []

    async def publish() -> None:
        while True:
            at.append(round(asyncio.get_running_loop().time() * 1e3, 1))
            video.offer(LiveItem(CAMERA, 'camera', head={'at': at[-1]}, body=picture(len(at) - 1)))
            await asyncio.sleep(0.1)

    task = asyncio.create_task(publish())
    try:
        yield video, at
    finally:
        await video.close()
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def assert_is_of_its_time(seen: list[tuple[float, int]], at: list[float]) -> None:
    for at_ms, level in seen:
        number = min(range(len(at)), key=lambda place: abs(at[place] - at_ms))
        assert abs(at[number] - at_ms) < 0.5, 'no frame arrived at this time'
        assert abs(level - (20 + 18 * (number % LEVELS))) < 9, 'the time is that of another frame'


def test_viewers_share_an_encoder_and_one_without_its_codec_is_refused() -> None:
    """Each frame has the time at which it arrived at the robot; when the last viewer leaves the encoder stops."""

    async def run() -> None:
        async with encoded() as (video, at):
            receivers = [Receiver(video, 'video/VP8', 'video/H264'), Receiver(video, 'video/VP8')]
            for receiver in receivers:
                assert 'answer' in await receiver.ask()
            assert video._encoders.keys() == {CAMERA}
            other = Receiver(video, 'video/H264')
            assert 'problem' in await other.ask()
            for receiver in receivers:
                await until(receiver.has_seen, 'frames of video')
                assert_is_of_its_time(receiver.seen, at)
            assert video._encoders[CAMERA].encoded <= len(at)
            for receiver in receivers:
                video.end(receiver)
            for receiver in (*receivers, other):
                await receiver.close()
            assert not video._encoders

    asyncio.run(run())


@pytest.mark.parametrize('end', ['\n', '\r\n', '\r', '\x0b', '\x0c', '\x85', '\u2028'])
def test_an_offer_gives_ports_and_no_addresses(end: str) -> None:
    """Whatever an offer contains, packets are only sent to the viewer's address; aiortc ends lines in many ways."""
    webrtc = pytest.importorskip('shadowhound_data_logger.live.webrtc')
    offer = OFFER.replace('\na=candidate', f'{end}a=candidate')
    found = [line for line in webrtc._with_address(offer, '192.0.2.7').splitlines() if 'candidate:' in line]
    assert [line.split()[4:6] for line in found] == [['192.0.2.7', '48973'], ['192.0.2.7', '50000']]


@pytest.mark.parametrize('offer', [
    '', 'v=0', OFFER + OFFER, OFFER.replace('m=video', 'm=application'), OFFER.replace('VP8', 'XYZ'), 'm=video 9\n' + 'a=' * 5000,
    OFFER.replace('a=ice-pwd:', 'a=nothing:'), OFFER.replace('a=fingerprint:', 'a=none:'), OFFER.replace('SAVPF 96', 'SAVPF x'),
    'm=video \ud800', OFFER.replace('a=setup:actpass', 'a=setup:nobody'), 7, None, ['m=video 9'],
])  # fmt: skip
def test_an_invalid_offer_is_answered_with_the_problem(offer: Any) -> None:
    """And has no lasting effect."""
    webrtc = pytest.importorskip('shadowhound_data_logger.live.webrtc')

    async def run() -> None:
        video = webrtc.CameraVideo(lambda: None)
        reports: list[dict[str, Any]] = []
        await video.take('viewer', {'topic': CAMERA, 'offer': offer}, ('192.0.2.1', '192.0.2.7'), reports.append)
        if reports[0].get('answer') is None:
            assert reports[0]['problem']
            assert not video.topics
        await video.close()
        assert not video.topics

    asyncio.run(run())


def test_peers_and_cameras_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    """A viewer above the limit gets an error; one that leaves makes room."""
    webrtc = pytest.importorskip('shadowhound_data_logger.live.webrtc')
    monkeypatch.setattr(webrtc, 'MAX_PEERS', 3)
    address = own_address()
    addresses = address, f'::ffff:{address}'

    async def run() -> None:
        video = webrtc.CameraVideo(lambda: None)
        fields: dict[str, dict[str, Any]] = {}

        async def ask(who: str, topic: str) -> bool:
            await video.take(who, {'topic': topic, 'offer': OFFER}, addresses, lambda what: fields.__setitem__(who, dict(what)))
            return 'answer' in fields[who]

        assert [await ask('a', '/1'), await ask('b', '/2'), await ask('c', '/3')] == [True, True, False]
        assert 'cameras are encoded' in fields['c']['problem']
        assert await ask('c', '/2')
        assert not await ask('d', '/1')
        assert 'viewers take video' in fields['d']['problem']
        assert address in fields['a']['answer']
        video.end('a')
        assert await ask('d', '/2')
        await video.close()

    asyncio.run(run())


@pytest.mark.parametrize('own', ['127.0.0.1', '127.1.2.3', '::1', '::ffff:127.0.0.1'])
def test_a_page_on_loopback_opens_no_port_on_the_network(own: str) -> None:
    """The library listens on the addresses of the network, which a page that is only open on loopback must not do."""
    webrtc = pytest.importorskip('shadowhound_data_logger.live.webrtc')

    async def run() -> None:
        video = webrtc.CameraVideo(lambda: None)
        reports: list[dict[str, Any]] = []
        await video.take('viewer', {'topic': CAMERA, 'offer': OFFER}, (own, '127.0.0.1'), reports.append)
        assert reports == [{'problem': webrtc.ON_LOOPBACK}]
        assert not video.topics
        await video.close()

    asyncio.run(run())


def received(**fields: Any) -> dict[str, Any]:
    """A report of a viewer."""
    return {'report': {'bitrate': 400_000, 'lost': 0, 'delay': 1000.0, 'key': False, **fields}}


def test_the_bitrate_follows_the_reports_of_the_slowest_viewer(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is decreased when frames are delayed or packets are lost, at most every two seconds, and increased slowly.

    Invalid reports change nothing.
    """
    webrtc = pytest.importorskip('shadowhound_data_logger.live.webrtc')
    address, now_s = own_address(), [1000.0]
    monkeypatch.setattr(webrtc.time, 'monotonic', lambda: now_s[0])

    async def run() -> None:
        video = webrtc.CameraVideo(lambda: None)
        for who in ('near', 'far'):
            await video.take(who, {'topic': CAMERA, 'offer': OFFER}, (address, address), lambda _: None)

        async def rate_after(seconds: float, who: str, request: dict[str, Any]) -> int:
            now_s[0] += seconds
            await video.take(who, request, (address, address), lambda _: None)
            return int(video._encoders[CAMERA].rate)

        assert await rate_after(1, 'far', received()) == webrtc.FIRST_RATE
        assert await rate_after(4, 'near', received()) == webrtc.FIRST_RATE, 'the other one has not reported'
        assert await rate_after(0, 'far', received()) == 625_000
        assert await rate_after(0.5, 'far', received(delay=1080.0)) == 625_000, 'noise'
        assert await rate_after(0.5, 'far', received(delay=1110.0)) == 280_000, 'of what it received'
        assert await rate_after(1.5, 'far', received(delay=1110.0)) == 280_000, 'too early'
        assert await rate_after(1.0, 'far', received(lost=0.2)) == 196_000
        for invalid in ({'lost': float('nan')}, {'lost': 1e300}, {'bitrate': '1'}, {'delay': [1]}):
            assert await rate_after(30, 'far', received(**invalid)) == 196_000
        assert await rate_after(30, 'far', {'report': 7}) == 196_000
        assert await rate_after(0, 'stranger', received()) == 196_000
        assert await rate_after(0, 'far', received()) == 245_000
        for _ in range(20):
            await rate_after(2.5, 'far', received(bitrate=0, delay=None, lost=1))
        assert video._encoders[CAMERA].rate == webrtc.MIN_RATE
        video.end('far')
        for _ in range(20):
            await rate_after(5, 'near', received(delay=None))
        assert video._encoders[CAMERA].rate == webrtc.MAX_RATE
        await video.close()

    asyncio.run(run())


def test_a_viewer_that_cannot_decode_gets_a_key_frame() -> None:
    """Which it reports; without it there is none after the first."""

    async def run() -> None:
        async with encoded() as (video, _):
            receiver = Receiver(video, 'video/VP8')
            assert 'answer' in await receiver.ask()
            await until(receiver.has_seen, 'frames of video')
            encoder = video._encoders[CAMERA]
            before = encoder.keys
            await video.take(receiver, received(key=True), ('', ''), lambda _: None)

            async def has_more() -> bool:
                return bool(encoder.keys == before + 1)

            await until(has_more, 'a key frame')
            video.end(receiver)
            await receiver.close()

    asyncio.run(run())


def test_times_are_sent_until_the_viewer_knows_the_age_of_frames() -> None:
    """Its reports contain a delay from then on."""

    async def run() -> None:
        async with encoded() as (video, _):
            receiver = Receiver(video, 'video/VP8')
            assert 'answer' in await receiver.ask()
            await until(receiver.has_seen, 'frames of video')
            await video.take(receiver, received(), ('', ''), lambda _: None)
            told, shown = len(receiver.told), len(receiver.shown)

            async def has_seen_more() -> bool:
                return len(receiver.shown) > shown + 5

            await until(has_seen_more, 'more frames')
            assert len(receiver.told) == told
            video.end(receiver)
            await receiver.close()

    asyncio.run(run())


def test_an_exact_period_does_not_make_the_age_of_a_frame_ambiguous() -> None:
    """A receiver that missed the first frames finds their times, or none."""
    webrtc = pytest.importorskip('shadowhound_data_logger.live.webrtc')
    packets: list[Any] = []
    encoder = webrtc._Vp8Encoder(packets.append)
    for number in range(20):
        encoder.offer(1000.0 + 100 * number, picture(number))
        encoder._step()
    pts = [encoded.packet.pts for encoded in packets]
    sent = [each / 90 for each in pts]
    assert first_shown_ms(sent, [each - pts[7] for each in pts[7:15]]) == pytest.approx(sent[7])
    assert first_shown_ms(sent, [each - pts[7] for each in pts[7:10]]) is None, 'too few'
    assert first_shown_ms(sent, [number * 9000 for number in range(15)]) is None


def test_frames_of_any_size_become_video() -> None:
    """Odd sides, large ones, gray ones; invalid images are skipped."""
    webrtc = pytest.importorskip('shadowhound_data_logger.live.webrtc')
    for height, width, shown in ((3, 5, (2, 4)), (240, 321, (240, 320)), (500, 4001, (188, 1500))):
        frame = webrtc._frame(simplejpeg.encode_jpeg(np.zeros((height, width, 3), np.uint8)))
        assert (frame.height, frame.width) == shown
    gray = simplejpeg.encode_jpeg(np.zeros((8, 8, 1), np.uint8), colorspace='GRAY', colorsubsampling='Gray')
    assert webrtc._frame(gray).width == 8
    for broken in (b'', b'\xff\xd8\xff', simplejpeg.encode_jpeg(np.zeros((1, 1, 3), np.uint8))):
        with pytest.raises(ValueError):
            webrtc._frame(broken)
    bomb = bytearray(simplejpeg.encode_jpeg(np.zeros((8, 8, 3), np.uint8)))
    at = bomb.index(b'\xff\xc0') + 5  # height and width of its frame (ITU T.81, B.2.2)
    bomb[at : at + 4] = b'\x80\x00\x80\x00'
    with pytest.raises(ValueError, match='32,768 x 32,768 pixels'):
        webrtc._frame(bytes(bomb))
