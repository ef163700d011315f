"""One connection to a robot's own live page, whose items are shown to all viewers of this one.

The link carries each topic once, for any number of viewers. Data from the robot is not trusted: sizes are bounded, and anything
invalid ends the connection, which is then opened again. Times are converted to this machine's clock, as the page's script does.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import math
import random
import struct
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

import aiohttp
import numpy as np
import orjson

from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.live.access import TokenRefused, read_token
from shadowhound_data_logger.live.kinds import FULL, KINDS, MAX_NAMES, LiveItem, check_jpeg
from shadowhound_data_logger.live.panels import BULK
from shadowhound_data_logger.live.viewer import ACKNOWLEDGED, BEGIN, END, PART

log = logging.getLogger(__name__)

PING_S: Final = 1.0
SILENT_S: Final = 3.0
"""The robot sends something each second."""
AGAIN_S: Final = 0.7
"""Pause after a connection ended, up to half as long again."""
REFUSED_S: Final = 30.0
"""The same if the robot rejected us, unless the token changes: each wrong one counts against this address there."""
LOOK_S: Final = 1.0
"""Interval of checking the token file in that time."""
TRY_S: Final = 1.0, 1.0, 1.0, 4.0
"""Timeouts of consecutive attempts to connect: a packet lost at the start is resent later and later."""
PINGS: Final = 12
MAX_MESSAGE: Final = 1 << 20
MAX_ITEM: Final = 32 << 20
MAX_SMALL: Final = 1 << 20
"""Maximum bytes of an item that is neither an image nor a cloud."""
MAX_HEAD: Final = 1 << 20
MAX_LANES: Final = 64
MAX_TOPICS: Final = 2000
_SERIES: Final = {'field', *(kind.name for kind in KINDS.values() if not kind.is_bulk)}
_SHOWN: Final = {'topics', 'figures', 'sample', 'pong', 'message', 'problem', *_SERIES, *BULK, *(
    kind.name for kind in KINDS.values()
)}  # fmt: skip
_BROKEN: Final = (asyncio.TimeoutError, OSError, ValueError, LookupError, DataLoggerError, TypeError, AttributeError,
                  RecursionError, struct.error)  # fmt: skip
_NOT_SIGNED_IN: Final = {
    401: 'it rejects the token: copy its viewer.token again', 429: 'too many wrong tokens came from this address',
}  # fmt: skip
_NOT_WATCHING: Final = {401: 'it requires a token: see --robot-token', 429: 'it accepts no more viewers'}
"""Why it rejects us, by HTTP status."""
_BULK: Final = {kind.name for kind in KINDS.values() if kind.is_bulk} | BULK


class _Rejected(ValueError):
    """The robot answers, and rejects us."""


class Relay:
    """Watches a robot while there are viewers here. Used by one event loop. New; open once; close once.

    ``wanted`` returns the watched topics, None without viewers; ``on_item`` is called with each item.
    """

    def __init__(self, url: str, token: Path | None, wanted: Callable[[], Iterable[str] | None],
                 on_item: Callable[[LiveItem], None]) -> None:  # fmt: skip
        self._url, self._token, self._wanted, self._on_item = url.rstrip('/'), token, wanted, on_item
        parts = urlsplit(self._url)
        self._origin = f'{parts.scheme}://{parts.netloc}'
        self._patience = itertools.cycle(TRY_S)
        self._wake = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self._tried = ''
        self.problem = ''
        """Why no data arrives; empty while connected, or without viewers."""

    def open(self) -> None:
        self._task = asyncio.create_task(self._run())

    def wake(self) -> None:
        """The wanted topics have changed."""
        self._wake.set()

    async def close(self) -> None:
        if self._task is not None:
            self._task.cancel()
            with suppress(asyncio.CancelledError):
                await self._task

    async def _run(self) -> None:
        while True:
            while self._wanted() is None:
                self._wake.clear()
                await self._wake.wait()
            try:
                await self._watch()
            except (aiohttp.ClientError, *_BROKEN) as error:
                problem = f'the page of the robot cannot be read: {str(error)[:200] or type(error).__name__}'
                if not self.problem or (isinstance(error, _Rejected) and problem != self.problem):
                    log.warning('%s', problem)
                self.problem = problem
                self._on_item(_catalog([], problem))
                if isinstance(error, _Rejected):
                    await self._wait_for_token()
                await asyncio.sleep(AGAIN_S * random.uniform(1.0, 1.5))

    async def _wait_for_token(self) -> None:
        """Wait until the token changes, or some time has passed."""
        until_s = time.monotonic() + REFUSED_S
        while time.monotonic() < until_s and self._given() == self._tried:
            await asyncio.sleep(LOOK_S)

    def _given(self) -> str:
        """The current token; empty if there is none that can be used."""
        with suppress(TokenRefused):
            return '' if self._token is None else read_token(self._token)
        return ''

    async def _watch(self) -> None:
        """Watch until there are no more viewers. Raises if the connection failed or was ended, or an answer is invalid."""
        timeout = aiohttp.ClientTimeout(total=None, connect=10.0, sock_connect=next(self._patience), sock_read=10.0)
        jar = aiohttp.CookieJar(unsafe=True)  # an address is as good as a name
        async with aiohttp.ClientSession(headers={'Origin': self._origin}, timeout=timeout, cookie_jar=jar) as session:
            if self._token is not None:
                self._tried = read_token(self._token)
                given = {'token': self._tried}
                async with session.post(f'{self._url}/api/session', json=given, allow_redirects=False) as answer:
                    if answer.status in _NOT_SIGNED_IN:
                        raise _Rejected(_NOT_SIGNED_IN[answer.status])
                    if answer.status != 200:
                        raise ValueError(f'it rejects the connection ({answer.status})')
            try:
                ws = await session.ws_connect(f'{self._url}/ws', max_msg_size=MAX_MESSAGE)
            except aiohttp.WSServerHandshakeError as error:
                if error.status in _NOT_WATCHING:
                    raise _Rejected(_NOT_WATCHING[error.status]) from error
                raise
            async with ws:
                self.problem = ''
                log.info('watching at %s', self._origin)
                connection = _Connection(ws, self._on_item)
                teller = asyncio.create_task(self._send_topics(connection))
                try:
                    await connection.read()
                finally:
                    while not teller.done():
                        teller.cancel()  # again: until Python 3.12 wait_for loses a cancellation that arrives just as it ends
                        await asyncio.wait([teller], timeout=0.1)
                    if not teller.cancelled():
                        teller.exception()  # the connection has ended, whatever the reason
        if self._wanted() is not None and not connection.is_closing:
            raise ConnectionError('it has ended the connection')

    async def _send_topics(self, connection: _Connection) -> None:
        """Send the watched topics when they change, and a ping each second."""
        sent: list[str] | None = None
        while True:
            wanted = self._wanted()
            if wanted is None:
                connection.is_closing = True
                await connection.ws.close()
                return
            if (topics := sorted(wanted)) != sent:
                sent = topics
                await connection.ws.send_json({'watch': topics})
            await connection.ws.send_json({'ping': time.monotonic() * 1e3})
            self._wake.clear()
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._wake.wait(), PING_S)


class _Connection:
    """A WebSocket to the robot's page: converts frames to items, by this machine's clock."""

    def __init__(self, ws: Any, on_item: Callable[[LiveItem], None]) -> None:
        self.ws, self._on_item = ws, on_item
        self.is_closing = False
        """Whether we close it, because there are no viewers."""
        self._parts: dict[int, bytearray] = {}
        self._received = self._acknowledged = 0
        self._acknowledging: asyncio.Task[None] | None = None
        self._pings: deque[tuple[float, float]] = deque(maxlen=PINGS)

    async def read(self) -> None:
        while True:
            message = await self.ws.receive(SILENT_S)
            if message.type is not aiohttp.WSMsgType.BINARY:
                if message.type in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.ERROR):
                    raise ValueError(f'it sent {message.type.name}')
                return
            frame = message.data
            self._received += len(frame)
            if self._received - self._acknowledged >= ACKNOWLEDGED and (
                self._acknowledging is None or self._acknowledging.done()
            ):
                self._acknowledging = asyncio.create_task(self._acknowledge())  # runs once the received frames are read
            place = 0
            while place < len(frame):
                lane, flags, length = PART.unpack_from(frame, place)
                place += PART.size + length
                if place > len(frame):
                    raise ValueError('it sends less than announced')
                if flags & BEGIN:
                    self._parts[lane] = bytearray()
                part = self._parts[lane]
                part += frame[place - length : place]
                if len(part) > MAX_ITEM or len(self._parts) > MAX_LANES:
                    raise ValueError('it sends more than a robot can')
                if flags & END:
                    self._take(bytes(self._parts.pop(lane)))

    async def _acknowledge(self) -> None:
        self._acknowledged = self._received
        with suppress(ConnectionError, RuntimeError):  # it has ended, as ``read`` reports
            await self.ws.send_bytes((self._received & 0xFFFF_FFFF).to_bytes(4, 'little'))

    def _take(self, whole: bytes) -> None:
        size = int.from_bytes(whole[:4], 'little')
        if size > MAX_HEAD:
            raise ValueError('it sends invalid data')
        head, body = orjson.loads(whole[4 : 4 + size]), whole[4 + size :]  # which rejects NaN, as browsers do
        kind = head.pop('kind')
        topic = head.pop('topic')
        if kind not in _SHOWN or not isinstance(topic, str) or (kind not in _BULK and len(whole) > MAX_SMALL):
            raise ValueError('it sends invalid data')
        if kind == 'pong':
            here = time.monotonic() * 1e3
            self._pings.append((here - float(head['ping']), float(head['now']) - (here + float(head['ping'])) / 2))
            return
        if kind == 'topics':
            topics = [
                [*(str(text)[:256] for text in row[:3]), int(row[3])] for row in head['topics'][:MAX_TOPICS] if len(row) == 4
            ]
            self._on_item(_catalog(topics, str(head.get('problem', ''))[:300], int(head.get('total', 0))))
            return
        if not self._pings:
            return  # its age would be unknown
        ahead = min(self._pings)[1]  # the round trip with the smallest delay is the most accurate
        at = float(head['at']) - ahead
        if not math.isfinite(at):
            raise ValueError('it sends no time')
        head['at'] = round(at, 1)
        if kind == 'figures' and not _is_figures(head['figures']):
            raise ValueError('its values are invalid')
        if kind == 'sample' and not _is_sample(head):
            raise ValueError('its sample is invalid')
        _check(kind, head, body)
        if kind in _SERIES:
            rows = int(head['rows'])
            body = (np.frombuffer(body, '<f8', rows) - ahead).astype('<f8').tobytes() + body[8 * rows :]
        self._on_item(LiveItem(topic, kind, FULL, head, body))


def _check(kind: str, head: Mapping[str, Any], body: bytes) -> None:
    """Raises Rejected or ValueError for content that would harm a viewer."""
    if kind == 'camera':
        check_jpeg(body)
    elif kind == 'cloud':
        box = [float(value) for name in ('low', 'step') for value in head[name]]
        if (
            len(box) != 6
            or not all(map(math.isfinite, box))
            or head['points'] * 6 != len(body)
            or not isinstance(head['frame'], str)
        ):
            raise ValueError('its cloud is invalid')
    elif kind in _SERIES:
        names = head['names']
        if not (isinstance(names, list) and len(names) <= MAX_NAMES and all(isinstance(name, str) for name in names)):
            raise ValueError('its values have no names')
        if int(head['rows']) * (8 + 4 * len(names)) != len(body):
            raise ValueError('the number of its values is wrong')


def _is_figures(figures: Any) -> bool:
    """Whether a page can draw these values."""
    rows = figures['topics']
    return isinstance(rows, list) and all(isinstance(row['topic'], str) and isinstance(row['type'], str) for row in rows)


def _is_sample(head: Mapping[str, Any]) -> bool:
    """Whether a page can show the rate, size and age of a topic."""
    numbers = (head.get(name) for name in ('hz', 'bytes', 'age_s', 'seconds', 'messages'))
    return isinstance(head['of'], str) and all(each is None or isinstance(each, (int, float)) for each in numbers)


def _catalog(topics: list[list[Any]], problem: str, total: int = 0) -> LiveItem:
    return LiveItem('', 'topics', head={'topics': topics, 'total': max(total, len(topics)), 'problem': problem})
