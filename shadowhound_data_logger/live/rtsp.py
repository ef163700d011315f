"""The cameras over RTSP, for players and recorders: served by GStreamer in a process of its own (``rtsp_process.py``).

With an encoder of H.264 they are sent so, else as the JPEGs that came (RFC 2435). RFC 2435 knows baseline JPEGs in YUV 4:2:0 or
4:2:2 whose sides are multiples of 8 pixels up to 2040; others are not sent, and the log says so. A topic is read while somebody
plays it.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import simplejpeg

from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.live.gstreamer import PYTHON, GstProcess
from shadowhound_data_logger.live.h264 import BLOCKS_4_0, H264_AGAIN_S, H264Element, fitted, of_size
from shadowhound_data_logger.live.kinds import LiveItem

log = logging.getLogger(__name__)

SCRIPT: Final = Path(__file__).with_name('rtsp_process.py')
USER: Final = 'viewer'
START_S: Final = 20.0
AGAIN_S: Final = 5.0
MOST_SIDE: Final = 2040
H264_RATE, H264_KEY_EVERY = 4_000_000, 30
"""Bits a second; frames from one key frame to the next, for which a player that comes later waits."""
_BASELINE, _FRAMES = 0xC0, range(0xC0, 0xD0)
_NO_FRAMES: Final = (0xC4, 0xC8, 0xCC)
"""Markers among those of frames that begin tables (ITU T.81, table B.1)."""


class RtspUnavailable(DataLoggerError):
    """This machine serves no RTSP."""

    DEFAULT_REMEDY = 'apt install python3-gi gir1.2-gst-rtsp-server-1.0 gstreamer1.0-plugins-base gstreamer1.0-plugins-good'


class RtspServer:
    """The process that serves, as long as this one. Used by one event loop. New; open once; close once.

    ``changed`` is called when other topics are played than before. ``h264`` encodes; without it JPEGs are sent.
    """

    def __init__(self, address: str, port: int, password: str, changed: Callable[[], None],
                 h264: H264Element | None = None) -> None:  # fmt: skip
        encoder = None if h264 is None else h264.told(H264_RATE, H264_KEY_EVERY)
        self._given: dict[str, Any] = {
            'address': address, 'port': port, 'user': USER, 'password': password, 'h264': encoder
        }  # fmt: skip
        self._changed = changed
        self._process = GstProcess(SCRIPT)
        self._task: asyncio.Task[None] | None = None
        self._cameras: list[str] = []
        self._refused: dict[str, str] = {}
        self._h264_from_s: dict[str, float] = {}
        """By topic: when H.264 is tried again after its encoder failed."""
        self._sizes: dict[str, tuple[int, int]] = {}
        self._jpegs: frozenset[str] = frozenset()
        """Those that are played as JPEG."""
        self.topics: frozenset[str] = frozenset()
        """Those that somebody plays."""
        self.players: tuple[str, ...] = ()
        """The addresses from which they are played."""
        self.port = 0

    async def open(self) -> None:
        """Raises RtspUnavailable where GStreamer is missing, or nobody can listen there."""
        await self._start()
        self._task = asyncio.create_task(self._run())

    async def close(self) -> None:
        if self._task is not None:
            self._task.cancel()
            with suppress(asyncio.CancelledError):
                await self._task
        await self._process.end()

    def serve(self, cameras: Iterable[str]) -> None:
        """Let these topics be played."""
        if (wanted := sorted(cameras)) != self._cameras:
            self._cameras = wanted
            self._tell_topics()

    def offer(self, item: LiveItem) -> None:
        """A JPEG of one of the topics."""
        if item.topic not in self.topics:
            return
        try:
            head = self._head(item.topic, item.body)
        except ValueError as error:
            if self._refused.get(item.topic) != str(error):
                log.warning('%s is not sent over RTSP: %s', item.topic, error)
                self._refused[item.topic] = str(error)
        else:
            self._process.tell(head, item.body)

    def _head(self, topic: str, jpeg: bytes) -> dict[str, Any]:
        """What the process is told of a frame. Raises ValueError with why it cannot be sent."""
        is_jpeg = self._given['h264'] is None or topic in self._jpegs
        if is_jpeg and (why := unsuited(jpeg)):
            raise ValueError(why)
        height, width, *_ = simplejpeg.decode_jpeg_header(jpeg)
        head: dict[str, Any] = {'topic': topic, 'width': width, 'height': height}
        if not is_jpeg:
            head['size'] = self._sizes[topic] = fitted(width, height, BLOCKS_4_0)
        return head

    def _tell_topics(self) -> None:
        now_s = time.monotonic()
        jpegs = [topic for topic, from_s in self._h264_from_s.items() if from_s > now_s]
        self._process.tell({'topics': self._cameras, 'jpegs': jpegs})

    def _fail(self, topics: Iterable[str], why: str) -> None:
        """The encoder of these: players that come are sent JPEG for a while, so that none is refused again and again."""
        now_s = time.monotonic()
        new = [topic for topic in sorted(topics) if self._h264_from_s.get(topic, 0.0) <= now_s]
        if not new:
            return
        for topic in new:
            log.warning('%s is not encoded as H.264 over RTSP: %s%s; for %.0f s players that come are sent JPEG',
                        topic, why[:300], of_size(self._sizes.get(topic)), H264_AGAIN_S)  # fmt: skip
            self._h264_from_s[topic] = now_s + H264_AGAIN_S
        self._tell_topics()
        asyncio.get_running_loop().call_later(H264_AGAIN_S + 1.0, self._tell_topics)

    async def _start(self) -> None:
        try:
            await self._process.start(self._given)
        except OSError as error:
            raise RtspUnavailable(f'{PYTHON} cannot be run: {error}') from error
        try:
            said = await asyncio.wait_for(self._said(), START_S)
        except asyncio.TimeoutError:
            said = {'error': f'it says nothing for {START_S:.0f} s'}
        if 'port' not in said:
            await self._process.end()
            raise RtspUnavailable(f'RTSP is not served: {said.get("error", "the process ended")}', remedy=said.get('remedy', ''))
        self.port = self._given['port'] = said['port']
        self._tell_topics()

    async def _said(self) -> dict[str, Any]:
        """The next line of the process; empty when it has ended."""
        line = await self._process.output.readline()
        return dict(json.loads(line)) if line else {}

    async def _run(self) -> None:
        """What is played; and the process again after it ended."""
        while True:
            while said := await self._said():
                self.players = tuple(said.get('players', self.players))
                self._jpegs = frozenset(said.get('jpegs', self._jpegs))
                self._watch(said.get('watched', self.topics))
                if 'failed' in said:
                    self._fail([said['failed']], said['why'])
            if self._given['h264'] is not None:  # whose encoder it was is not known
                self._fail(self.topics - self._jpegs, 'the process has ended')
            self.players = ()
            self._watch(())
            log.warning('the process that serves RTSP has ended; it is started again')
            while True:
                await asyncio.sleep(AGAIN_S)
                try:
                    await self._process.end()
                    await self._start()
                    break
                except RtspUnavailable as error:
                    log.warning('%s', error)

    def _watch(self, topics: Iterable[str]) -> None:
        self.topics = frozenset(topics)
        self._changed()


def unsuited(jpeg: bytes) -> str:
    """Why RFC 2435 has no way to send this JPEG; empty where it has."""
    try:
        height, width, _, sampling = simplejpeg.decode_jpeg_header(jpeg)
    except ValueError as error:
        return f'it is no JPEG: {error}'
    if width % 8 or height % 8 or max(width, height) > MOST_SIDE:
        return f'{width} x {height} pixels; RFC 2435 has multiples of 8 up to {MOST_SIDE}'
    if sampling not in ('420', '422'):
        return f'its colours are sampled as {sampling}; RFC 2435 has 420 and 422'
    return '' if _coding(jpeg) == _BASELINE else 'it is no baseline JPEG'


def _coding(jpeg: bytes) -> int:
    """The marker of the frame, which tells how it is coded; 0 where there is none."""
    at = 2
    while at + 4 <= len(jpeg) and jpeg[at] == 0xFF:
        marker = jpeg[at + 1]
        if marker in _FRAMES and marker not in _NO_FRAMES:
            return marker
        at += 2 + int.from_bytes(jpeg[at + 2 : at + 4], 'big')
    return 0
