"""Cameras as H.264: which encoder of GStreamer serves, and the process in which it encodes for viewers of WebRTC.

The properties of the encoders are those of their documentation and sources. Which of them an installed version has differs, so
others are left out, and an encoder is taken only after it has encoded a frame on this machine.
"""

from __future__ import annotations

import asyncio
import logging
import math
import re
import struct
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import simplejpeg

from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.core.untrusted import check_pixels, from_json
from shadowhound_data_logger.live.gstreamer import PYTHON, GstProcess

log = logging.getLogger(__name__)

SCRIPT: Final = Path(__file__).with_name('h264_process.py')
NEVER: Final = 'none'
"""In place of an encoder's name: nothing is encoded as H.264."""
FIND_S: Final = 30.0
"""For all encoders together, and for each where that failed: each is given some seconds, and GStreamer looks for its plug-ins
first."""
NOTHING_S: Final = 6.0
"""An encoder that gives nothing for so long while it is fed has failed."""
H264_AGAIN_S: Final = 300.0
"""After an encoder failed, whoever comes takes its topic as VP8 or JPEG for so long."""
KEY_EVERY_S: Final = 0.7
"""Key frames that receivers ask for come no more often."""
KEY_EVERY: Final = 150
"""Frames from one key frame to the next that nobody asked for."""
BLOCKS_3_1, BLOCKS_4_0 = 3600, 8192
"""Macroblocks (16 x 16 pixels) of a frame in levels 3.1 and 4.0 (ITU-T H.264, table A-1): 1280 x 720 and 1920 x 1080."""
MOST_SIDE: Final = 1920
MOST_HEAD, MOST_UNIT = 2 << 10, 4 << 20
"""Bytes of what comes from the process."""
_ELEMENT: Final = re.compile(r'[A-Za-z0-9_-]{1,100}')
_STARTS: Final = (b'\0\0\1', b'\0\0\0\1')
"""Of a unit (ITU-T H.264, annex B)."""


class H264Unavailable(DataLoggerError):
    """The encoder that was named does not encode here."""

    DEFAULT_REMEDY = 'gst-inspect-1.0 lists what GStreamer has; --h264 none goes on without'


@dataclass(frozen=True, slots=True)
class H264Element:
    """An encoder of GStreamer."""

    name: str
    launch: str
    """The part of a pipeline from raw video to H.264, in which the encoder is called ``h264``."""
    properties: Mapping[str, str] = field(default_factory=dict)
    """With ``{bits}`` and ``{kbits}`` a second, and ``{every}``: frames from one key frame to the next."""

    def settings(self, bits: int, every: int) -> dict[str, str]:
        """Properties as text."""
        return {name: text.format(bits=bits, kbits=bits // 1000, every=every) for name, text in self.properties.items()}

    def told(self, bits: int, every: int) -> dict[str, Any]:
        """As the scripts are told of it: its part of a pipeline begins with JPEG."""
        launch = f'{_DECODED} ! {self.launch} ! h264parse config-interval=-1'
        return {'name': self.name, 'launch': launch, 'set': self.settings(bits, every)}


# JPEG's colours use the whole range of numbers, which not every encoder tells: they become those of video, by way of RGB, because
# from one YUV to another videoconvert leaves the range as it is.
_DECODED: Final = (
    'jpegdec ! videoscale add-borders=false ! capsfilter name=size ! videoconvert ! video/x-raw,format=BGRx'
    ' ! videoconvert ! video/x-raw,colorimetry=(string)bt601'
)
_BASELINE: Final = ' name=h264 ! video/x-h264,profile=(string){constrained-baseline,baseline}'
HARDWARE: Final = (
    H264Element('nvv4l2h264enc', 'nvvidconv ! video/x-raw(memory:NVMM),format=NV12 ! nvv4l2h264enc name=h264', {
        'bitrate': '{bits}', 'control-rate': 'constant_bitrate', 'iframeinterval': '{every}', 'idrinterval': '{every}',
        'num-B-Frames': '0', 'profile': 'Baseline', 'insert-sps-pps': 'true', 'maxperf-enable': 'true',
    }),
    H264Element('nvh264enc', 'nvh264enc' + _BASELINE, {
        'bitrate': '{kbits}', 'rc-mode': 'cbr', 'gop-size': '{every}', 'bframes': '0', 'zerolatency': 'true',
    }),
    H264Element('vah264enc', 'vah264enc' + _BASELINE, {
        'rate-control': 'cbr', 'bitrate': '{kbits}', 'key-int-max': '{every}', 'b-frames': '0',
    }),
    H264Element('qsvh264enc', 'qsvh264enc' + _BASELINE, {
        'rate-control': 'cbr', 'bitrate': '{kbits}', 'gop-size': '{every}', 'b-frames': '0', 'low-latency': 'true',
    }),
    H264Element('mpph264enc', 'mpph264enc name=h264', {
        'rc-mode': 'cbr', 'bps': '{bits}', 'gop': '{every}', 'profile': 'baseline', 'header-mode': 'each-idr',
    }),
    # The Raspberry Pi's driver wants to be told a level.
    H264Element('v4l2h264enc', 'v4l2h264enc' + _BASELINE + ',level=(string)4', {
        'extra-controls': 'controls,video_bitrate={bits},video_gop_size={every},h264_i_frame_period={every}'
                          ',video_b_frames=0,repeat_sequence_header=1',
    }),
)  # fmt: skip
"""Taken by themselves, the first that works; on a Jetson the first is its own."""
SOFTWARE: Final = H264Element('x264enc', 'x264enc' + _BASELINE, {
    'bitrate': '{kbits}', 'key-int-max': '{every}', 'bframes': '0', 'tune': 'zerolatency', 'speed-preset': 'ultrafast',
})  # fmt: skip
"""Taken only where it is named."""


async def find_h264(named: str = '') -> H264Element | None:
    """The encoder with this name, or the first of the hardware's that encodes here; None where none does.

    Another one than those above keeps its own settings. Raises H264Unavailable where the one that is named does not
    encode.
    """
    if named == NEVER:
        return None
    if named and not _ELEMENT.fullmatch(named):
        raise H264Unavailable(f'{named[:100]!r} is not the name of an element of GStreamer')
    known = {element.name: element for element in (*HARDWARE, SOFTWARE)}
    tried = (known.get(named, H264Element(named, f'{named} name=h264')),) if named else HARDWARE
    said = await _found(tried)
    for element in tried:
        if element.name == said.get('found'):
            return element
    if named:
        raise H264Unavailable(f'{named} does not encode here: {said.get("error", "it does not say why")}')
    log.debug('no encoder of H.264: %s', said)
    return None


async def _found(tried: tuple[H264Element, ...]) -> dict[str, Any]:
    """What is said of these: ``found``, or ``error``. A driver may crash the process that tries it, or never return."""
    said = await _said_of(tried)
    if 'broken' not in said:
        return said
    if len(tried) == 1:
        return {'error': said['broken']}
    log.warning('no encoder of H.264 is known yet: %s; each is tried by itself', said['broken'])
    for element in tried:
        said = await _found((element,))
        log.info('%s: %s', element.name, said.get('error', 'it encodes'))
        if 'found' in said:
            break
    return said


async def _said_of(tried: tuple[H264Element, ...]) -> dict[str, Any]:
    """What one process says of these; or ``broken``: why it says nothing."""
    picture = bytes(simplejpeg.encode_jpeg(np.full((240, 320, 3), 128, np.uint8), colorsubsampling='420'))
    process = GstProcess(SCRIPT)
    try:
        await process.start({'find': [element.told(1_000_000, KEY_EVERY) for element in tried]})
        process.tell({'at': 0.0, 'width': 320, 'height': 240, 'size': (320, 240)}, picture)
        head, _ = await asyncio.wait_for(_record(process.output), FIND_S)
    except asyncio.TimeoutError:
        return {'broken': f'its process says nothing for {FIND_S:.0f} s'}
    except EOFError:
        return {'broken': 'its process has ended'}
    except (OSError, ValueError, TypeError) as error:
        return {'error': f'{PYTHON}: {error}'}
    else:
        return head
    finally:
        await process.end()


def fitted(width: int, height: int, most_blocks: int) -> tuple[int, int]:
    """Even sides of at most so many macroblocks: the frame's own, or smaller ones, of its shape where no side becomes tiny.

    Raises ValueError.
    """
    check_pixels(width, height)
    blocks = math.ceil(width / 16) * math.ceil(height / 16)
    if not blocks or min(width, height) < 2:
        raise ValueError('a frame without pixels')
    share = min(math.sqrt(most_blocks / blocks), MOST_SIDE / max(width, height))
    if share >= 1:
        return width - width % 2, height - height % 2
    return max(16, int(width * share) // 16 * 16), max(16, int(height * share) // 16 * 16)


def of_size(size: tuple[int, int] | None) -> str:
    """To be said with why an encoder failed: hardware takes no pictures that are smaller than it likes."""
    return '' if size is None else f', with pictures of {size[0]} x {size[1]}'


class H264Encoder:
    """Makes H.264 of the newest JPEG of a topic in a process of its own. Used by one event loop. New; open once; close once.

    ``made`` is given the time of a frame, whether it needs no other, and its access unit (annex B); ``failed``, once, why no more
    will come.
    """

    def __init__(self, element: H264Element, rate: int, made: Callable[[float, bool, bytes], None],
                 failed: Callable[[str], None]) -> None:  # fmt: skip
        self._element, self._rate, self._made, self._failed = element, rate, made, failed
        self._process = GstProcess(SCRIPT)
        self._task: asyncio.Task[None] | None = None
        self._is_over = False
        self._size: tuple[int, int] | None = None
        self._wants_key = False
        self._key_s = -KEY_EVERY_S
        self._fed_s: float | None = None
        """Since when nothing came for what was offered."""
        self._first_ms = math.inf
        self._offered_ms = self._made_ms = -math.inf
        self.encoded = self.keys = 0
        """Frames so far, and those of them that need no other."""

    @property
    def pid(self) -> int | None:
        return self._process.pid

    def open(self) -> None:
        self._task = asyncio.create_task(self._run())

    async def close(self) -> None:
        self._is_over = True
        try:
            if self._task is not None:
                self._task.cancel()
                with suppress(asyncio.CancelledError):
                    await self._task
        finally:
            await self._process.end()

    def offer(self, at_ms: float, jpeg: bytes) -> None:
        try:
            height, width, *_ = simplejpeg.decode_jpeg_header(jpeg)
            size = self._size = fitted(width, height, BLOCKS_3_1)
        except ValueError:
            return  # the age of the last one that was good is on the page
        if at_ms <= self._offered_ms:
            return
        now_s = time.monotonic()
        if self._fed_s is None:
            self._fed_s = now_s
        elif now_s - self._fed_s > NOTHING_S:
            self._fail(f'it gives nothing for {NOTHING_S:g} s')
            return
        if self._wants_key and now_s - self._key_s >= KEY_EVERY_S:
            self._wants_key, self._key_s = False, now_s
            self._process.tell({'key': True})
        self._first_ms, self._offered_ms = min(self._first_ms, at_ms), at_ms
        self._process.tell({'at': at_ms, 'width': width, 'height': height, 'size': size}, jpeg)

    def ask_key(self) -> None:
        self._wants_key = True

    def set_rate(self, rate: int) -> None:
        self._rate = rate
        self._process.tell({'set': self._element.settings(rate, KEY_EVERY)})

    async def _run(self) -> None:
        try:
            await self._process.start({'encode': self._element.told(self._rate, KEY_EVERY)})
            while True:
                self._take(*await _record(self._process.output))
        except EOFError:
            self._fail('its process has ended')
        except (OSError, ValueError, LookupError, TypeError) as error:
            self._fail(str(error))

    def _take(self, head: Mapping[str, Any], unit: bytes) -> None:
        """Raises ValueError for what is no access unit, or of no time at which frames were offered."""
        if 'error' in head:
            raise ValueError(str(head['error'])[:300])
        at_ms = float(head['at'])
        if not self._first_ms - 1 < at_ms < self._offered_ms + 1 or not unit.startswith(_STARTS):
            raise ValueError('what comes is no H.264 of the camera')
        if at_ms <= self._made_ms:
            return
        self._fed_s, self._made_ms = None, at_ms
        self.encoded += 1
        self.keys += bool(head['key'])
        self._made(at_ms, bool(head['key']), unit)

    def _fail(self, why: str) -> None:
        if not self._is_over:
            self._is_over = True
            self._failed(f'{self._element.name}: {why}{of_size(self._size)}')


async def _record(output: asyncio.StreamReader) -> tuple[dict[str, Any], bytes]:
    """The next one that a process says. Raises ValueError for what is none, EOFError at the end."""
    head, body = struct.unpack('<II', await output.readexactly(8))
    if head > MOST_HEAD or body > MOST_UNIT:
        raise ValueError(f'it says {head:,} and {body:,} bytes at once')
    return dict(from_json(await output.readexactly(head), MOST_HEAD)), await output.readexactly(body)
