"""The camera as video over WebRTC, encoded once for all viewers. Importing this loads aiortc (the extra ``webrtc``).

The newest JPEG of a topic is decoded and encoded as VP8 on a separate thread; its packets are sent to each peer. RTP timestamps
are the times of arrival, at 90 kHz, from a random start: the viewer is also sent the times of its first frames, finds the start
by comparing both, and then knows the age of each frame. Twice per second it reports what it received: the bitrate follows from
the delay and the loss, and a viewer that cannot decode gets a key frame.

Packets are sent only to the viewer's own address: candidates of an offer contribute ports and no addresses, and no STUN server
is used. aiortc listens on all addresses except loopback, so a viewer on loopback is refused: a page that listens only there must
not open ports on the network.
"""

from __future__ import annotations

import asyncio
import logging
import random
import re
import time
from collections import deque
from collections.abc import Callable, Coroutine, Mapping
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from ipaddress import ip_address
from threading import Condition
from typing import Any, Final

import av
import numpy as np
import simplejpeg
from aiortc import MediaStreamTrack, RTCConfiguration, RTCPeerConnection, RTCRtpSender, RTCSessionDescription
from aiortc.exceptions import InvalidAccessError, InvalidStateError, OperationError

from shadowhound_data_logger.core.untrusted import check_pixels
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.live.kinds import LiveItem

log = logging.getLogger(__name__)

MAX_PEERS: Final = 8
MAX_ENCODED: Final = 2
"""Topics that are encoded at a time."""
MAX_SIDE: Final = 1920
"""Maximum side in pixels; larger frames are reduced."""
CLOCK_HZ: Final = 90_000
"""Of RTP timestamps of video (RFC 7741)."""
MIN_RATE, FIRST_RATE, MAX_RATE = 150_000, 500_000, 1_500_000
"""Bitrate of a topic."""
LOWER, RAISE = 0.7, 1.25
"""Factors of the bitrate."""
RAISE_EVERY_S, RAISE_AFTER_S, LOWER_EVERY_S = 4.0, 20.0, 2.0
"""Intervals of changes, and from a decrease to the next increase: a new rate starts with a key frame."""
MAX_QUEUED_MS: Final = 100.0
"""A viewer whose frames take this much longer than its fastest recent ones has a full link."""
RECENT_REPORTS: Final = 60
MAX_LOST: Final = 0.1
"""Share of packets."""
MAX_WAITING: Final = 10
"""Maximum packets queued for a peer; then it continues with the next key frame."""
CONNECT_S: Final = 10.0
VP8: Final = 'video/VP8'
KEY_EVERY_S: Final = 0.7
"""Minimum interval between key frames that receivers request."""
_TICKS_PER_MS: Final = CLOCK_HZ // 1000
_DITHER: Final = 30
"""Ticks (0.33 ms) of noise in timestamps, so that the times of a few frames match in one way, also with an exact period."""
MAX_NUMBER: Final = 1e12
"""In a report."""
_CANDIDATE: Final = re.compile(r'a=candidate:\S+ 1 udp \d+ \S+ (\d{1,5}) typ host', re.IGNORECASE)
_MAX_CANDIDATES: Final = 8
_BROKEN: Final = (InvalidAccessError, InvalidStateError, OperationError, ValueError, LookupError, TypeError, AttributeError,
                  AssertionError, OSError, RuntimeError)  # fmt: skip
"""Errors of aiortc for an invalid offer."""


ON_LOOPBACK: Final = 'this page was opened on the robot or through a tunnel; for video, open it at an address of its network'


class OfferRefused(Exception):
    """A viewer cannot take video; the text has the reason."""


@dataclass(frozen=True, slots=True)
class _Report:
    """What a viewer received since its previous report."""

    bitrate: float
    lost: float
    """Share of packets."""
    delay_ms: float | None
    """From the arrival of frames at the robot until they were shown, plus a constant; None while unknown."""
    needs_key: bool

    @classmethod
    def parsed(cls, fields: Any) -> _Report | None:
        """None if it is invalid."""
        match fields:
            case {
                'bitrate': int() | float() as bitrate,
                'lost': int() | float() as lost,
                'delay': int() | float() | None as delay_ms,
            }:
                is_valid = all(abs(number) < MAX_NUMBER for number in (bitrate, lost, delay_ms or 0.0))
                return cls(bitrate, lost, delay_ms, bool(fields.get('key'))) if is_valid else None
        return None


@dataclass(frozen=True, slots=True)
class _Encoded:
    packet: Any
    """av.Packet."""
    is_key: bool
    """Whether it is independent of other frames."""


class _Vp8Encoder:
    """Encodes the newest JPEG of a topic as VP8, on the thread ``video``. The condition guards the waiting frame and requests."""

    def __init__(self, on_encoded_frame: Callable[[_Encoded], None]) -> None:
        self._on_encoded_frame = on_encoded_frame
        self._changed = Condition()
        self._waiting: tuple[float, bytes] | None = None
        self._wants_key = True
        self._key_s = -KEY_EVERY_S
        self.rate = FIRST_RATE
        """Bits per second."""
        self._codec: Any = None
        self._last_pts = -1
        self.encoded = self.keys = 0
        """Frames so far, and the key frames among them."""
        self.worker = Worker('video', self._step)

    def open(self) -> None:
        self.worker.start()

    def offer(self, at_ms: float, jpeg: bytes) -> None:
        with self._changed:
            self._waiting = at_ms, jpeg
            self._changed.notify()

    def ask_key(self) -> None:
        with self._changed:
            self._wants_key = True

    def set_rate(self, rate: int) -> None:
        with self._changed:
            self.rate = rate

    async def close(self) -> None:
        self.worker.stop()
        with self._changed:
            self._changed.notify()
        if not await asyncio.to_thread(self.worker.join, 5.0):
            log.warning('the thread that encodes video does not stop')

    def _step(self) -> None:
        with self._changed:
            if self._waiting is None:
                self._changed.wait(0.5)
            if self._waiting is None:
                return
            (at_ms, jpeg), self._waiting = self._waiting, None
            rate = self.rate
            is_key = self._wants_key and time.monotonic() - self._key_s >= KEY_EVERY_S
            if is_key:
                self._wants_key, self._key_s = False, time.monotonic()
        try:
            frame = _frame(jpeg)
        except ValueError:
            return  # the page shows the age of the last valid one
        pts = round(at_ms * _TICKS_PER_MS) + random.randint(-_DITHER, _DITHER)
        if pts <= self._last_pts:
            return
        self._last_pts = frame.pts = pts
        frame.time_base = Fraction(1, CLOCK_HZ)
        codec = self._codec_for(frame, rate)
        if is_key:
            frame.pict_type = av.video.frame.PictureType.I
        for packet in codec.encode(frame):
            packet.pts, packet.time_base = pts, frame.time_base
            self.encoded += 1
            self.keys += bool(packet.is_keyframe)
            self._on_encoded_frame(_Encoded(packet, bool(packet.is_keyframe)))

    def _codec_for(self, frame: Any, rate: int) -> Any:
        codec = self._codec
        if codec is None or (codec.width, codec.height, codec.bit_rate) != (frame.width, frame.height, rate):
            codec = av.CodecContext.create('libvpx', 'w')
            codec.width, codec.height, codec.pix_fmt = frame.width, frame.height, 'yuv420p'
            codec.time_base, codec.framerate = Fraction(1, CLOCK_HZ), Fraction(30)
            codec.bit_rate, codec.gop_size, codec.qmin, codec.qmax, codec.thread_count = rate, 3000, 4, 56, 1
            codec.options = {
                'deadline': 'realtime', 'cpu-used': '-6', 'lag-in-frames': '0', 'minrate': str(rate), 'maxrate': str(rate),
                'bufsize': str(rate // 2), 'max-intra-rate': '400', 'undershoot-pct': '100', 'overshoot-pct': '15',
                'static-thresh': '1', 'noise-sensitivity': '0',
            }  # fmt: skip
            self._codec = codec
        return codec


def _frame(jpeg: bytes) -> Any:
    """A frame (av.VideoFrame, yuv420p) with even sides of at most MAX_SIDE pixels. Raises ValueError."""
    height, width, *_ = simplejpeg.decode_jpeg_header(jpeg)
    check_pixels(width, height)
    min_side = -(-max(height, width) // MAX_SIDE)
    pixels = simplejpeg.decode_jpeg(jpeg, 'RGB', fastdct=True, fastupsample=True,
                                    min_height=height // min_side, min_width=width // min_side)  # fmt: skip
    every = -(-max(pixels.shape[:2]) // MAX_SIDE)
    pixels = pixels[::every, ::every]
    height, width = (side - side % 2 for side in pixels.shape[:2])
    if not height or not width:
        raise ValueError('a frame without pixels')
    return av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels[:height, :width]), 'rgb24').reformat(format='yuv420p')


class _PacketTrack(MediaStreamTrack):  # type: ignore[misc]
    """The track of one peer: packets that all peers of a topic share."""

    kind = 'video'

    def __init__(self, ask_key: Callable[[], None], on_packet: Callable[[Any], None]) -> None:
        super().__init__()
        self._ask_key, self._on_packet = ask_key, on_packet
        self._waiting: asyncio.Queue[_Encoded] = asyncio.Queue()
        self._needs_key = True
        self._key_requested = False

    async def recv(self) -> Any:
        """Called by the sender, once it is connected, for each packet after the previous one was sent."""
        if not self._key_requested:
            self._key_requested = True
            self._ask_key()
        packet = (await self._waiting.get()).packet
        self._on_packet(packet)
        return packet

    def offer(self, encoded: _Encoded) -> None:
        if not self._key_requested:
            return
        if self._waiting.qsize() >= MAX_WAITING:
            while not self._waiting.empty():
                self._waiting.get_nowait()
            self._needs_key = True
            self._ask_key()
        if self._needs_key and not encoded.is_key:
            return
        self._needs_key = False
        self._waiting.put_nowait(encoded)


class _Peer:
    """A viewer that takes the video of a topic."""

    def __init__(self, topic: str, video: CameraVideo, tell: Callable[[Mapping[str, Any]], None]) -> None:
        self.topic, self._video, self._tell = topic, video, tell
        self.pc = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        self.track = _PacketTrack(lambda: video.ask_key(self), self._on_packet)
        self.rate: float = FIRST_RATE
        """What its link carries, bits per second."""
        self.is_answered = False
        self._knows_ages = False
        self._delays_ms: deque[float] = deque(maxlen=RECENT_REPORTS)
        self._lower_s, self._raise_s = 0.0, time.monotonic() + RAISE_EVERY_S
        """When the rate may be decreased or increased again."""
        self.pc.addTrack(self.track)

    async def answer(self, offer: str, remote: str) -> str:
        """Raises OfferRefused."""
        (transceiver,) = self.pc.getTransceivers()
        known = RTCRtpSender.getCapabilities('video').codecs
        transceiver.setCodecPreferences([codec for name in (VP8, 'video/rtx') for codec in known if codec.mimeType == name])
        await self.pc.setRemoteDescription(RTCSessionDescription(_with_address(offer, remote), 'offer'))
        self.pc.on('connectionstatechange', self._on_state)
        await self.pc.setLocalDescription(await self.pc.createAnswer())
        self.is_answered = True
        return str(self.pc.localDescription.sdp)

    def _on_state(self) -> None:
        if self.pc.connectionState in ('failed', 'closed'):
            self._video.lost(self, 'the connection for video (UDP) was lost')

    def _on_packet(self, packet: Any) -> None:
        if not self._knows_ages:
            self._tell({'at': packet.pts / _TICKS_PER_MS, 'topic': self.topic})

    def on_report(self, report: _Report, rate: float) -> None:
        """``rate``: what the topic is encoded with."""
        if report.needs_key:
            self._video.ask_key(self)
        queued_ms = 0.0
        if report.delay_ms is not None:
            self._knows_ages = True
            self._delays_ms.append(report.delay_ms)
            queued_ms = report.delay_ms - min(self._delays_ms)
        now_s = time.monotonic()
        if queued_ms > MAX_QUEUED_MS or report.lost > MAX_LOST:
            if now_s >= self._lower_s:
                self.rate = max(LOWER * min(rate, max(report.bitrate, rate / 2)), MIN_RATE)
                self._lower_s, self._raise_s = now_s + LOWER_EVERY_S, now_s + RAISE_AFTER_S
        elif now_s >= self._raise_s:
            self.rate = min(RAISE * rate, MAX_RATE)
            self._raise_s = now_s + RAISE_EVERY_S


class CameraVideo:
    """Encodes the topics that peers take, and sends them. Used by one event loop. New; close once.

    ``changed`` is called when the set of topics to read changes.
    """

    def __init__(self, changed: Callable[[], None]) -> None:
        self._changed = changed
        self._loop = asyncio.get_running_loop()
        self._encoders: dict[str, _Vp8Encoder] = {}
        """By topic."""
        self._peers: dict[object, _Peer] = {}
        self._ending: set[asyncio.Task[None]] = set()
        for name in ('aioice', 'aiortc'):
            logging.getLogger(name).setLevel(logging.WARNING)

    @property
    def topics(self) -> frozenset[str]:
        """The topics in use."""
        return frozenset(peer.topic for peer in self._peers.values())

    def offer(self, item: LiveItem) -> None:
        """A JPEG of one of the topics."""
        if (encoder := self._encoders.get(item.topic)) is not None and item.head is not None:
            encoder.offer(float(item.head['at']), item.body)

    def ask_key(self, peer: _Peer) -> None:
        if (encoder := self._encoders.get(peer.topic)) is not None:
            encoder.ask_key()

    async def take(self, who: object, request: Mapping[str, Any], addresses: tuple[str, str],
                   tell: Callable[[Mapping[str, Any]], None]) -> None:  # fmt: skip
        """A viewer requests a topic: ``request`` has ``topic`` and ``offer`` (SDP). ``tell`` is called with the answer, or the
        problem. Or it has a ``report`` on the topic that it takes.

        ``addresses``: our address that it connected to, and its own.
        """
        if 'report' in request:
            self._on_report(who, _Report.parsed(request['report']))
            return
        self.end(who)
        try:
            peer = self._new_peer(who, request.get('topic'), tell)
            answer = await self._answered(who, peer, request.get('offer'), addresses)
        except OfferRefused as error:
            tell({'problem': str(error)})
        else:
            tell({'answer': answer})
            self._loop.call_later(CONNECT_S, self._check_connection, peer)

    def _on_report(self, who: object, report: _Report | None) -> None:
        """The rate of a topic is what the slowest of its links carries."""
        peer = self._peers.get(who)
        encoder = self._encoders.get(peer.topic) if peer is not None else None
        if report is not None and peer is not None and encoder is not None:
            peer.on_report(report, encoder.rate)
            encoder.set_rate(int(min(each.rate for each in self._peers.values() if each.topic == peer.topic)))

    def _new_peer(self, who: object, topic: Any, tell: Callable[[Mapping[str, Any]], None]) -> _Peer:
        if not isinstance(topic, str):
            raise OfferRefused('topic is missing in the request')
        if len(self._peers) >= MAX_PEERS:
            raise OfferRefused(f'{MAX_PEERS} viewers take video, which is the maximum')
        if topic not in self.topics and len(self.topics) >= MAX_ENCODED:
            raise OfferRefused(f'{MAX_ENCODED} cameras are encoded, which is the maximum')
        peer = self._peers[who] = _Peer(topic, self, tell)
        return peer

    async def _answered(self, who: object, peer: _Peer, offer: Any, addresses: tuple[str, str]) -> str:
        """On any failure the peer is closed. Raises OfferRefused."""
        answer = None
        try:
            own, remote = map(_plain, addresses)
            if ip_address(own.partition('%')[0]).is_loopback:
                raise OfferRefused(ON_LOOPBACK)
            answer = await peer.answer(offer, remote)
        except _BROKEN as error:
            raise OfferRefused(f'the offer cannot be answered: {type(error).__name__}') from error
        finally:
            if answer is None and self._peers.get(who) is peer:
                self.end(who)
        self._follow()
        return answer

    def end(self, who: object) -> None:
        """The viewer stops its video."""
        if (peer := self._peers.pop(who, None)) is not None:
            self._follow()
            self._end(peer.pc.close())

    def _end(self, closing: Coroutine[Any, Any, None]) -> None:
        task = self._loop.create_task(closing)
        self._ending.add(task)
        task.add_done_callback(self._ending.discard)

    def lost(self, peer: _Peer, problem: str) -> None:
        for who, one in list(self._peers.items()):
            if one is peer:
                peer._tell({'problem': problem})
                self.end(who)

    def has(self, who: object) -> bool:
        """Whether the viewer takes video, and is connected."""
        return (peer := self._peers.get(who)) is not None and peer.pc.connectionState == 'connected'

    async def close(self) -> None:
        for who in list(self._peers):
            self.end(who)
        if self._ending:
            await asyncio.wait(self._ending, timeout=5.0)

    def _check_connection(self, peer: _Peer) -> None:
        if peer.pc.connectionState != 'connected':
            self.lost(peer, f'no connection for video (UDP) within {CONNECT_S:.0f} s')

    def _follow(self) -> None:
        """Keep encoders exactly for the topics in use."""
        wanted = {peer.topic for peer in self._peers.values() if peer.is_answered}
        for topic in self._encoders.keys() - wanted:
            self._end(self._encoders.pop(topic).close())
        for topic in wanted - self._encoders.keys():
            encoder = self._encoders[topic] = _Vp8Encoder(partial(self._on_encoded, topic))
            encoder.open()
        self._changed()

    def _on_encoded(self, topic: str, encoded: _Encoded) -> None:
        """On the thread of the encoder."""
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._share, topic, encoded)

    def _share(self, topic: str, encoded: _Encoded) -> None:
        for peer in self._peers.values():
            if peer.topic == topic:
                peer.track.offer(encoded)


def _plain(address: str) -> str:
    """An address, with IPv4-mapped IPv6 as IPv4."""
    mapped = getattr(ip_address(address.partition('%')[0]), 'ipv4_mapped', None)
    return address if mapped is None else str(mapped)


def _with_address(offer: str, remote: str) -> str:
    """The offer with candidates only at the viewer's own address; browsers replace addresses by names that few can resolve."""
    lines = offer.splitlines()  # split as in aiortc
    if [line[:8] for line in lines if line.startswith('m=')] != ['m=video ']:
        raise OfferRefused('an offer must have one part, which is video')
    ports = [int(found[1]) for line in lines if (found := _CANDIDATE.match(line)) and 0 < int(found[1]) < 65_536]
    lines = [line for line in lines if not line.startswith(('a=candidate', 'a=end-of-candidates', 'a=remote-candidates'))]
    ports = ports[:_MAX_CANDIDATES] or [9]  # without any, the answering side would not wait for the other
    lines += [f'a=candidate:{index} 1 udp 2122260223 {remote} {port} typ host' for index, port in enumerate(ports)]
    return '\r\n'.join([*lines, 'a=end-of-candidates', ''])
