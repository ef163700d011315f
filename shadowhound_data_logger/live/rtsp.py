"""The cameras over RTSP, for players and recorders: JPEGs (RFC 2435), served by GStreamer in a separate process
(``rtsp_process.py``).

RFC 2435 supports baseline JPEGs in YUV 4:2:0 or 4:2:2 whose sides are multiples of 8 pixels up to 2040; others are not sent, and
the log reports them. A topic is read while somebody plays it. Debian and Ubuntu build GStreamer's bindings for the system's
Python, so a process of that runs the script.
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
"""Of the system."""
MAX_WAITING: Final = 4 << 20
"""Bytes for a process that does not read; frames beyond it are skipped."""
END_S: Final = 5.0
_BASELINE, _FRAMES = 0xC0, range(0xC0, 0xD0)
_NO_FRAMES: Final = (0xC4, 0xC8, 0xCC)
"""Markers among those of frames that begin tables (ITU T.81, table B.1)."""


class RtspUnavailable(DataLoggerError):
    """This machine serves no RTSP."""

    DEFAULT_REMEDY = 'apt install python3-gi gir1.2-gst-rtsp-server-1.0 gstreamer1.0-plugins-base gstreamer1.0-plugins-good'


class RtspServer:
    """The process that serves, as long as this one. Used by one event loop. New; open once; close once.

    ``changed`` is called when other topics are played than before.
    """

    def __init__(self, address: str, port: int, password: str, changed: Callable[[], None]) -> None:
        self._given: dict[str, Any] = {'address': address, 'port': port, 'user': USER, 'password': password}
        self._changed = changed
        self._process = _Process(SCRIPT)
        self._task: asyncio.Task[None] | None = None
        self._cameras: list[str] = []
        self._refused: dict[str, str] = {}
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
        if why := unsuited(item.body):
            if self._refused.get(item.topic) != why:
                log.warning('%s is not sent over RTSP: %s', item.topic, why)
                self._refused[item.topic] = why
            return
        height, width, *_ = simplejpeg.decode_jpeg_header(item.body)
        self._process.tell({'topic': item.topic, 'width': width, 'height': height}, item.body)

    def _tell_topics(self) -> None:
        self._process.tell({'topics': self._cameras})

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
                self._watch(said.get('watched', self.topics))
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


class _Process:
    """The process of a script, which ends with its input. Used by one event loop. Start it again only after ``end``; end it.

    It is fed with records: two uint32 (little-endian) with the lengths of a head in JSON and of a body, and these.
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
        """Of the process, while there is one."""
        return None if self._process is None else self._process.pid

    async def start(self, first: Mapping[str, Any]) -> None:
        """``first`` is its first record: everybody can read a command line. Raises OSError."""
        self._process = await asyncio.create_subprocess_exec(
            str(PYTHON),
            '-I',
            str(self._script),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for who feeds it
        )
        self.tell(first)

    def tell(self, head: Mapping[str, Any], body: bytes = b'') -> None:
        if self._process is None or (stdin := self._process.stdin) is None or stdin.is_closing():
            return
        if not body or stdin.transport.get_write_buffer_size() < MAX_WAITING:
            text = json.dumps(head).encode()
            stdin.write(struct.pack('<II', len(text), len(body)) + text + body)

    async def end(self) -> None:
        """Also where an earlier one was cancelled."""
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
    """Wait until it has ended. What it still prints is discarded: the end of one whose pipe is full is not seen."""
    assert process.stdout is not None
    while await process.stdout.read(1 << 16):
        pass
    await process.wait()


def unsuited(jpeg: bytes) -> str:
    """Why RFC 2435 has no way to send this JPEG; empty where it has."""
    try:
        height, width, _, sampling = simplejpeg.decode_jpeg_header(jpeg)
    except ValueError as error:
        return f'it is no JPEG: {error}'
    if width % 8 or height % 8 or max(width, height) > MAX_SIDE:
        return f'{width} x {height} pixels; RFC 2435 has multiples of 8 up to {MAX_SIDE}'
    if sampling not in ('420', '422'):
        return f'its colors are sampled as {sampling}; RFC 2435 has 420 and 422'
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
