"""The cameras over RTSP, for players and recorders: JPEGs (RFC 2435), served by GStreamer in a separate process
(``rtsp_process.py``).

RFC 2435 supports baseline JPEGs in YUV 4:2:0 or 4:2:2 whose sides are multiples of 8 pixels up to 2040; others are not sent,
which is logged. A topic is read while it is played. Debian and Ubuntu build GStreamer's bindings for the system's Python, so a
process of that Python runs the script.
"""

from __future__ import annotations

import asyncio
import json
import logging
import struct
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import simplejpeg

from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.live.kinds import LiveItem

log = logging.getLogger(__name__)

SCRIPT: Final = Path(__file__).with_name('rtsp_process.py')
USER: Final = 'viewer'
START_S: Final = 20.0
AGAIN_S: Final = 5.0
MAX_SIDE: Final = 2040
PYTHON: Final = Path('/usr/bin/python3')
"""The system's Python."""
MAX_WAITING: Final = 4 << 20
"""Bytes queued for a process that does not read; frames beyond it are skipped."""
END_S: Final = 5.0
_BASELINE, _FRAMES = 0xC0, range(0xC0, 0xD0)
_NO_FRAMES: Final = (0xC4, 0xC8, 0xCC)
"""Markers in the range of frames that start tables (ITU T.81, table B.1)."""


class RtspUnavailable(DataLoggerError):
    """This machine cannot serve RTSP."""

    DEFAULT_REMEDY = 'apt install python3-gi gir1.2-gst-rtsp-server-1.0 gstreamer1.0-plugins-base gstreamer1.0-plugins-good'


class RtspServer:
    """The process that serves RTSP. Used by one event loop. New; open once; close once.

    ``changed`` is called when the set of played topics changes.
    """

    def __init__(self, address: str, port: int, password: str, changed: Callable[[], None]) -> None:
        self._given: dict[str, Any] = {'address': address, 'port': port, 'user': USER, 'password': password}
        self._changed = changed
        self._process = _Process(SCRIPT)
        self._task: asyncio.Task[None] | None = None
        self._cameras: list[str] = []
        self._refused: dict[str, str] = {}
        self.topics: frozenset[str] = frozenset()
        """Topics that are played."""
        self.players: tuple[str, ...] = ()
        """Addresses that play them."""
        self.port = 0

    async def open(self) -> None:
        """Raises RtspUnavailable if GStreamer is missing, or the address cannot be listened on."""
        await self._start()
        self._task = asyncio.create_task(self._run())

    async def close(self) -> None:
        if self._task is not None:
            self._task.cancel()
            with suppress(asyncio.CancelledError):
                await self._task
        await self._process.end()

    def serve(self, cameras: Iterable[str]) -> None:
        """Offer these topics."""
        if (wanted := sorted(cameras)) != self._cameras:
            self._cameras = wanted
            self._send_topics()

    def offer(self, item: LiveItem) -> None:
        """A JPEG of one of the topics."""
        if item.topic not in self.topics:
            return
        if why := unsuited(item.body):
            if self._refused.get(item.topic) != why:
                log.warning('%s is not sent over RTSP: %s', item.topic, why)
                self._refused[item.topic] = why
            return
        height, width, *_ = simplejpeg.decode_jpeg_header(item.body)
        self._process.tell({'topic': item.topic, 'width': width, 'height': height}, item.body)

    def _send_topics(self) -> None:
        self._process.tell({'topics': self._cameras})

    async def _start(self) -> None:
        try:
            await self._process.start(self._given)
        except OSError as error:
            raise RtspUnavailable(f'{PYTHON} cannot be run: {error}') from error
        try:
            report = await asyncio.wait_for(self._read_report(), START_S)
        except asyncio.TimeoutError:
            report = {'error': f'no output for {START_S:.0f} s'}
        if 'port' not in report:
            await self._process.end()
            raise RtspUnavailable(
                f'RTSP is not served: {report.get("error", "the process ended")}', remedy=report.get('remedy', '')
            )
        self.port = self._given['port'] = report['port']
        self._send_topics()

    async def _read_report(self) -> dict[str, Any]:
        """The next line of the process; empty when it has exited."""
        line = await self._process.output.readline()
        return dict(json.loads(line)) if line else {}

    async def _run(self) -> None:
        """Read its reports; restart the process when it has exited."""
        while True:
            while report := await self._read_report():
                self.players = tuple(report.get('players', self.players))
                self._watch(report.get('watched', self.topics))
            self.players = ()
            self._watch(())
            log.warning('the process that serves RTSP has exited; it is restarted')
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


class _Process:
    """A child process running a script; it exits at the end of its input. Used by one event loop. Restart it only after ``end``.

    Its input is records: two uint32 (little-endian) with the lengths of a head in JSON and of a body, and these.
    """

    def __init__(self, script: Path) -> None:
        self._script = script
        self._process: asyncio.subprocess.Process | None = None

    @property
    def output(self) -> asyncio.StreamReader:
        """What it prints, from its start until ``end``."""
        assert self._process is not None
        assert self._process.stdout is not None
        return self._process.stdout

    @property
    def pid(self) -> int | None:
        """The pid of the process, while there is one."""
        return None if self._process is None else self._process.pid

    async def start(self, first: Mapping[str, Any]) -> None:
        """``first`` is its first record, because command lines are public. Raises OSError."""
        self._process = await asyncio.create_subprocess_exec(
            str(PYTHON),
            '-I',
            str(self._script),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for the parent
        )
        self.tell(first)

    def tell(self, head: Mapping[str, Any], body: bytes = b'') -> None:
        if self._process is None or (stdin := self._process.stdin) is None or stdin.is_closing():
            return
        if not body or stdin.transport.get_write_buffer_size() < MAX_WAITING:
            text = json.dumps(head).encode()
            stdin.write(struct.pack('<II', len(text), len(body)) + text + body)

    async def end(self) -> None:
        """Also if an earlier call was cancelled."""
        if (process := self._process) is None:
            return
        if process.stdin is not None:
            process.stdin.close()
        try:
            await asyncio.wait_for(_over(process), END_S)
        except asyncio.TimeoutError:
            with suppress(ProcessLookupError):
                process.kill()
            await _over(process)
        if self._process is process:
            self._process = None


async def _over(process: asyncio.subprocess.Process) -> None:
    """Wait until it has exited. Its output is discarded: a process whose pipe is full would not exit."""
    assert process.stdout is not None
    while await process.stdout.read(1 << 16):
        pass
    await process.wait()


def unsuited(jpeg: bytes) -> str:
    """Why RFC 2435 cannot send this JPEG; empty if it can."""
    try:
        height, width, _, sampling = simplejpeg.decode_jpeg_header(jpeg)
    except ValueError as error:
        return f'it is not a JPEG: {error}'
    if width % 8 or height % 8 or max(width, height) > MAX_SIDE:
        return f'{width} x {height} pixels; RFC 2435 supports multiples of 8 up to {MAX_SIDE}'
    if sampling not in ('420', '422'):
        return f'its colors are sampled as {sampling}; RFC 2435 supports 420 and 422'
    return '' if _coding(jpeg) == _BASELINE else 'it is not a baseline JPEG'


def _coding(jpeg: bytes) -> int:
    """The marker of the frame, which identifies its coding; 0 if there is none."""
    at = 2
    while at + 4 <= len(jpeg) and jpeg[at] == 0xFF:
        marker = jpeg[at + 1]
        if marker in _FRAMES and marker not in _NO_FRAMES:
            return marker
        at += 2 + int.from_bytes(jpeg[at + 2 : at + 4], 'big')
    return 0
