"""The server of the live page: HTTP, WebSocket, who may what, and what each viewer is sent."""

from __future__ import annotations

import asyncio
import gzip
import json
import logging
import mimetypes
import os
import secrets
import socket
import ssl
import struct
import sys
import time
from collections.abc import Awaitable, Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import dataclass, field
from functools import partial
from hashlib import sha256
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from aiohttp import WSCloseCode, WSMsgType, web
from aiohttp.http_exceptions import HttpProcessingError

from shadowhound_data_logger.core import heap
from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.core.errors import DataLoggerError, NodeUnavailable
from shadowhound_data_logger.core.keys import is_name
from shadowhound_data_logger.formats.definitions import describe
from shadowhound_data_logger.live.access import (
    COOKIE,
    LASTS_S,
    Access,
    OwnNames,
    SignIn,
    TokenRefused,
    is_loopback,
    is_same_origin,
    make_tokens,
    rtsp_password,
)
from shadowhound_data_logger.live.figures import DAY_NS, SpoolFigures
from shadowhound_data_logger.live.foxglove import PROTOCOLS, FoxgloveClient, refusal
from shadowhound_data_logger.live.h264 import H264Element, find_h264
from shadowhound_data_logger.live.history_process import HistoryProcess, PastUnavailable
from shadowhound_data_logger.live.kinds import FULL, KINDS, RAW, LiveItem
from shadowhound_data_logger.live.relay import Relay
from shadowhound_data_logger.live.rtsp import RtspServer
from shadowhound_data_logger.live.viewer import Viewer
from shadowhound_data_logger.spool.control import connect

if TYPE_CHECKING:
    from shadowhound_data_logger.live.topics import Topics
    from shadowhound_data_logger.live.webrtc import CameraVideo

log = logging.getLogger(__name__)

PAGE: Final = Path(__file__).parent / 'page'
MOST_VIEWERS: Final = 16
MOST_FOXGLOVES: Final = 8
"""Clients that speak Foxglove's protocol."""
MOST_CONNECTIONS: Final = 200
"""Of viewers and of everybody else."""
REQUEST_S: Final = 10.0
"""A connection's first request comes whole within this, and the body of each."""
IDLE_S: Final = 15.0
"""Between requests."""
MOST_BODY: Final = 4096
"""Bytes of a request."""
MOST_MESSAGE: Final = 16 << 10
"""Bytes of a message of a viewer."""
MOST_WATCHED: Final = 16
"""Topics that one viewer watches."""
FIGURES_S: Final = 1.0
LEDGER_EVERY: Final = 2
"""The ledger is read with each second status."""
ASK_AGAIN_S: Final = 5.0
"""How often it is asked whether those who watch still may."""
FOXGLOVE_BUFFER: Final = 32 << 10
_MIN_RTT: Final = struct.Struct('=148xI')
"""tcp_info.tcpi_min_rtt of linux/tcp.h, in microseconds."""
LEASE_EVERY_S: Final = 2.0
DOCTOR_S: Final = 60.0
"""What the doctor found is told again for so long, however many ask."""
AF41: Final = 34 << 2
"""DSCP of interactive video (RFC 4594), in the byte where IP has it."""
NO_WEBRTC: Final = 'the robot has no WebRTC: install the extra webrtc of shadowhound_data_logger'
REWATCH_S: Final = 0.1
"""Between two changes of what is read, when viewers choose."""
NARROW_S: Final = 10.0
"""A link that carried no full frames for so long is told to take video."""
SILENT_S: Final = 8.0
"""A viewer that says nothing for so long is gone: the page says something each second."""
ACTS: Final[Mapping[str, tuple[str, ...]]] = {
    'flush': (), 'pause': (), 'resume': (), 'bag start': (), 'bag stop': (), 'bag split': (), 'event': ('name', 'note'),
}  # fmt: skip
"""What an operator may ask of the node, and with what."""
SECURITY: Final[Mapping[str, str]] = {
    'Content-Security-Policy': "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self';"
                               " connect-src 'self'; font-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'self';"
                               " frame-ancestors 'none'",
    'X-Content-Type-Options': 'nosniff', 'X-Frame-Options': 'DENY', 'Referrer-Policy': 'no-referrer',
    'Cross-Origin-Opener-Policy': 'same-origin', 'Cross-Origin-Resource-Policy': 'same-origin',
}  # fmt: skip
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveSettings:
    """How the page is served."""

    spool: Path
    robot: str
    tokens: Path
    """The folder of the tokens."""
    bind: str = '127.0.0.1'
    port: int = 8765
    names: tuple[str, ...] = ()
    """Further names under which the page may be asked for."""
    certificate: tuple[Path, Path] | None = None
    """Certificate and key, for https."""
    is_of_store: bool = False
    """Whether the page is that of a store, with the past of all its robots, and not a robot's own."""
    robot_url: str = ''
    """Of a store's page: where the robot's own page is, from which the live view is relayed; empty: there is none."""
    robot_token: Path | None = None
    """The file with the token of a viewer there."""
    rtsp: int | None = None
    """The port of RTSP; None: there is none."""
    h264: str = ''
    """The encoder of GStreamer for H.264; empty: one in hardware, if there is one; ``none``: no encoder."""
    uploads_mbps: float = 4.0
    """What uploads are left while somebody watches over the network; 0: all they want."""


@dataclass(eq=False)
class _Connected:
    """A viewer, and who it is."""

    ws: web.WebSocketResponse
    viewer: Viewer
    cookie: str | None
    who: SignIn
    address: str
    at: str
    """The address of ours that it reached."""
    protocol: asyncio.BaseProtocol
    tasks: list[asyncio.Task[None]] = field(default_factory=list)
    heard_s: float = field(default_factory=time.monotonic)
    """When it last said something."""
    narrow_s: float | None = None
    """Since when its link carries no full frames."""
    asks: asyncio.Task[None] | None = None
    """For video."""
    transport: asyncio.Transport | None = None
    """Its connection, as soon as it is a WebSocket."""
    flushing: asyncio.Handle | None = None

    def tell(self, item: LiveItem) -> None:
        """Send it with all else that is told before the event loop's next round."""
        self.viewer.offer(item)
        if self.flushing is None:
            self.flushing = asyncio.get_running_loop().call_soon(self.flush)

    def flush(self) -> None:
        """Write all that may be sent now, at once: each write costs as much as a frame does.

        ``ws.send_bytes`` would write each frame by itself, and a large one in two parts. It would also wait for a full buffer;
        here the window of the viewer limits what is in it, and where he acknowledges what he has not read, what is in it already.
        """
        self.flushing = None
        if self.transport is None or self.transport.is_closing() or self.ws.closed:
            return
        if self.transport.get_write_buffer_size() > 2 * self.viewer.window:
            return
        parts: list[bytes] = []
        while (frame := self.viewer.next_frame()) is not None:
            parts += (_message_header(len(frame)), frame)
        if parts:
            self.transport.write(b''.join(parts))


@dataclass(eq=False)
class _Foxglove:
    """A client that speaks Foxglove's protocol, by which ticket and whose sign-in it is here, and from where."""

    client: FoxgloveClient
    ticket: str
    nonce: str
    address: str
    protocol: asyncio.BaseProtocol
    tasks: list[asyncio.Task[None]] = field(default_factory=list)


class LiveServer:
    """Serves the page until it is closed. New; open once; close once; all on one event loop."""

    def __init__(self, settings: LiveSettings) -> None:
        self._settings = settings
        self._access = Access(make_tokens(settings.tokens), is_open=is_loopback(settings.bind))
        self._names = OwnNames(settings.bind, settings.names)
        self._figures = SpoolFigures(settings.spool, settings.robot, SystemClock.of_this_machine())
        self._files = dict(_static(PAGE))
        self._viewers: set[_Connected] = set()
        self._foxgloves: set[_Foxglove] = set()
        self._session_id = secrets.token_hex(8)
        self._wanted: dict[str, frozenset[int]] | None = None
        self._rewatching: asyncio.TimerHandle | None = None
        self._rewatched_s = 0.0
        self._graph: Mapping[str, str] = {}
        self._topics: Topics | None = None
        self._relay: Relay | None = None
        self._told_topics: LiveItem | None = None
        self._video: CameraVideo | None = None
        self._rtsp: RtspServer | None = None
        self._h264: H264Element | None = None
        self.no_video = '' if find_spec('aiortc') and find_spec('av') else NO_WEBRTC
        """Why cameras are sent as JPEG alone; empty where WebRTC is to be had."""
        self._pool = ThreadPoolExecutor(2, 'spool')
        self._reading = asyncio.Lock()
        self._asking = asyncio.Lock()
        self._doctor: tuple[float, dict[str, Any]] | None = None
        self._examining = asyncio.Lock()
        self._history = HistoryProcess([] if settings.is_of_store else [str(settings.spool), settings.robot])
        self._runner: web.AppRunner | None = None
        self._listening: asyncio.Server | None = None
        self._silent: dict[asyncio.BaseProtocol, float] = {}  # connections that asked for nothing yet, and since when
        self._tickers: list[asyncio.Task[None]] = []
        self.port = settings.port
        self.ros_problem = ''
        """Why nothing but the data is shown; empty where topics are read."""

    async def open(self) -> None:
        """Raises OSError where nobody can listen there, or the certificate cannot be read; RtspUnavailable; H264Unavailable."""
        self._loop = asyncio.get_running_loop()
        app = web.Application(middlewares=[self._guard], client_max_size=MOST_BODY)
        app.add_routes([
            web.get('/ws', self._watch), web.get('/api/session', self._session), web.post('/api/session', self._sign_in),
            web.post('/api/sign-out', self._sign_out), web.post('/api/act', self._act), web.get('/api/gaps', self._tell_gaps),
            web.get('/api/doctor', self._tell_doctor), web.post('/api/label', self._label), web.post('/api/pull', self._pull),
            web.get('/foxglove', self._foxglove), web.get('/api/foxglove', self._tell_foxglove),
            web.get('/api/past/{do:robots|days|timeline|moment|kept|requests}', self._tell_past),
            web.get('/{name:.*}', self._file),
        ])  # fmt: skip
        logging.getLogger('aiohttp.server').addFilter(_is_ours)
        self._runner = web.AppRunner(app, access_log=None, handle_signals=False, keepalive_timeout=IDLE_S, lingering_time=1.0)
        await self._runner.setup()
        secure = None
        if self._settings.certificate is not None:
            secure = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
            secure.load_cert_chain(*self._settings.certificate)
        listener = _listener(self._settings.bind, self._settings.port)
        self.port = listener.getsockname()[1]
        timeout_s = REQUEST_S if secure is not None else None
        self._listening = await self._loop.create_server(
            self._connected, sock=listener, ssl=secure, backlog=64, ssl_handshake_timeout=timeout_s
        )
        self._open_topics()
        self._tickers = [asyncio.create_task(each) for each in (self._tick(), self._end_unknown())]
        for ticker in self._tickers:
            ticker.add_done_callback(_tell_failure)
        await self._find_h264()  # which may take a while, meanwhile the page is served
        if self._settings.rtsp is not None:
            password = rtsp_password(self._settings.tokens)
            self._rtsp = RtspServer(self._settings.bind, self._settings.rtsp, password, self._rewatch, self._h264)
            await self._rtsp.open()
            self._rtsp.serve(topic for topic in self._graph if self._kind_of(topic) == 'camera')
            self._rewatch()  # the topics of the graph are wanted even while nobody watches

    async def close(self) -> None:
        for ticker in self._tickers:
            ticker.cancel()
        await asyncio.gather(*self._tickers, return_exceptions=True)
        _end((*self._viewers, *self._foxgloves))
        if self._listening is not None:
            self._listening.close()
        if self._runner is not None:
            await self._runner.cleanup()
        await self._history.close()
        if self._video is not None:
            await self._video.close()
        if self._rtsp is not None:
            await self._rtsp.close()
        if self._relay is not None:
            await self._relay.close()
        if self._topics is not None:
            await asyncio.to_thread(self._topics.close)
        self._pool.shutdown()

    @property
    def h264(self) -> str:
        """The name of the encoder of GStreamer that encodes cameras as H.264; empty where none does."""
        return '' if self._h264 is None else self._h264.name

    @property
    def rtsp_url(self) -> str:
        """To which the name of a camera's topic is appended; empty where RTSP is not served."""
        return '' if self._rtsp is None else f'rtsp://{self._host}:{self._rtsp.port}'

    @property
    def url(self) -> str:
        return f'{self._scheme}://{self._host}:{self.port}/'

    @property
    def _host(self) -> str:
        bind = self._settings.bind
        return {'0.0.0.0': socket.gethostname(), '::': socket.gethostname()}.get(bind, f'[{bind}]' if ':' in bind else bind)  # noqa: S104 - compared

    @property
    def _scheme(self) -> str:
        return 'https' if self._settings.certificate is not None else 'http'

    async def _find_h264(self) -> None:
        """Where cameras may be sent as video."""
        has_cameras = not self._settings.is_of_store or bool(self._settings.robot_url)
        if not self._settings.h264 and (not has_cameras or (self._settings.rtsp is None and self.no_video)):
            return
        self._h264 = await find_h264(self._settings.h264)
        if self._video is not None:
            self._video.h264 = self._h264
        if self._h264 is not None:
            log.info('cameras are encoded as H.264 by %s where players and viewers take it', self.h264)
        else:
            log.info('cameras are not encoded as H.264: they are sent as JPEG over RTSP and as VP8 over WebRTC')

    def _open_topics(self) -> None:
        """Where ROS is, read topics; else the data alone is shown."""
        if self._settings.is_of_store:
            if self._settings.robot_url:
                self._relay = Relay(self._settings.robot_url, self._settings.robot_token, lambda: self._wanted, self._on_relayed)
                self._relay.open()
            return
        if find_spec('rclpy') is None:
            self.ros_problem = 'ROS is not sourced here: the page shows the data, and no camera, cloud or plots'
            return
        from shadowhound_data_logger.live.topics import Topics  # noqa: PLC0415 - rclpy

        def tell(graph: Mapping[str, str]) -> None:
            self._loop.call_soon_threadsafe(self._on_graph, graph)

        def show(items: list[LiveItem]) -> None:
            self._loop.call_soon_threadsafe(self._on_items, items)

        topics = Topics(lambda: self._wanted, tell, show)
        topics.open()
        self._topics = topics

    # -- connections -----------------------------------------------------------------------------------------------

    def _connected(self) -> asyncio.BaseProtocol:
        """Of somebody who comes: where too many are, the one leaves who asked for nothing for longest, or was here first."""
        assert self._runner is not None
        assert self._runner.server is not None
        here = self._runner.server.connections
        if len(here) >= MOST_CONNECTIONS:
            watching = {one.protocol for one in self._viewers} | {one.protocol for one in self._foxgloves}
            first = next((each for each in (*self._silent, *here) if each in here and each not in watching), None)
            if first is not None:
                self._drop(first)
        handler: asyncio.BaseProtocol = self._runner.server()
        self._silent[handler] = time.monotonic()
        return handler

    def _drop_silent(self) -> None:
        """Those whose first request does not come to its end, and viewers that say nothing any more."""
        before_s = time.monotonic() - REQUEST_S
        for each in [each for each, since_s in self._silent.items() if since_s < before_s]:
            self._drop(each)

        _end(one for one in self._viewers if one.heard_s < time.monotonic() - SILENT_S)

    async def _end_unknown(self) -> None:
        """A connection outlives neither the sign-in that it came by nor the token that signed it, whatever else hangs."""
        while True:
            await asyncio.sleep(ASK_AGAIN_S)
            _end(one for one in self._viewers if self._access.who(one.cookie) != one.who)
            _end(one for one in self._foxgloves if self._access.of_ticket(one.ticket, one.address) is None)

    def _drop(self, handler: Any) -> None:
        self._silent.pop(handler, None)
        if handler.transport is not None:
            handler.transport.abort()

    # -- what comes ------------------------------------------------------------------------------------------------

    def _on_graph(self, graph: Mapping[str, str]) -> None:
        self._graph = graph
        if self._rtsp is not None:
            self._rtsp.serve(topic for topic in graph if self._kind_of(topic) == 'camera')
        for one in self._viewers:
            self._offer_catalogue(one)
        for foxglove in self._foxgloves:
            foxglove.client.publish(graph)
        self._rewatch()

    def _on_items(self, items: list[LiveItem]) -> None:
        for item in items:
            if item.size == RAW:
                for foxglove in self._foxgloves:
                    foxglove.client.offer(item)
                continue
            for one in self._viewers:
                if item.topic in one.viewer.watched and one.viewer.size(item.topic) == item.size:
                    one.viewer.offer(item)
            self._offer_video(item)
        for one in self._viewers:
            one.flush()

    def _on_relayed(self, item: LiveItem) -> None:
        if item.kind == 'topics':
            self._told_topics = item
        for one in self._viewers:
            if not item.topic or item.topic in one.viewer.watched:
                one.tell(item)
        self._offer_video(item)

    def _offer_video(self, item: LiveItem) -> None:
        if item.kind != 'camera' or item.size != FULL:
            return
        for taker in (self._video, self._rtsp):
            if taker is not None:
                taker.offer(item)

    def _offer_catalogue(self, one: _Connected) -> None:
        if self._told_topics is not None:
            one.tell(self._told_topics)
            return
        topics = [[topic, KINDS[name].name, name] for topic, name in self._graph.items() if name in KINDS]
        one.tell(LiveItem('', 'topics', head={'topics': topics, 'problem': self.ros_problem}))

    def _rewatch_soon(self) -> None:
        """Who chooses again and again makes no more subscriptions than others."""
        if self._rewatching is None:
            wait_s = max(0.0, self._rewatched_s + REWATCH_S - time.monotonic())
            self._rewatching = self._loop.call_later(wait_s, self._rewatch)

    def _rewatch(self) -> None:
        """After any viewer came, went or chose."""
        if self._rewatching is not None:
            self._rewatching.cancel()
            self._rewatching = None
        self._rewatched_s = time.monotonic()
        wanted: dict[str, set[int]] = {}
        for one in self._viewers:
            for topic in one.viewer.watched:
                wanted.setdefault(topic, set()).add(one.viewer.size(topic))
        for taker in (self._video, self._rtsp):
            for topic in taker.topics if taker is not None else ():
                wanted.setdefault(topic, set()).add(FULL)
        for foxglove in self._foxgloves:
            for topic in foxglove.client.watched:
                wanted.setdefault(topic, set()).add(RAW)
        before = self._wanted
        self._wanted = (
            {topic: frozenset(sizes) for topic, sizes in wanted.items()}
            if self._viewers or self._foxgloves or self._rtsp
            else None
        )
        if self._wanted is None and before is not None:
            heap.give_back()
        if self._wanted != before:
            for source in (self._topics, self._relay):
                if source is not None:
                    source.wake()

    async def _tick(self) -> None:
        """Once a second: the figures, the sizes, the lease, and threads that died."""
        rounds = 0
        lease_s = 0.0
        while True:
            began_s = time.monotonic()
            self._drop_silent()
            if self._topics is not None:
                self._topics.worker.look()
            if self._video is not None:
                self._video.tick()
                for one in self._viewers:
                    one.viewer.has_video = self._video.has(one)
            for one in self._viewers:
                one.viewer.round_s = _round_s(one.transport)
            if self._viewers and not self._settings.is_of_store:
                try:
                    await self._tell_figures(with_ledger=rounds % LEDGER_EVERY == 0)
                except Exception:  # the one supervised catch-all: the page shows the age of what it has
                    log.exception('the figures cannot be read')
                for one in self._viewers:
                    one.viewer.choose_sizes()
                    self._suggest_video(one, began_s)
                self._rewatch()
            if self._settings.uploads_mbps and began_s >= lease_s and self._is_watched_from_afar:
                lease_s = began_s + LEASE_EVERY_S
                self._loop.run_in_executor(self._pool, self._lease)
            rounds += 1
            await asyncio.sleep(max(0.05, began_s + FIGURES_S - time.monotonic()))

    def _suggest_video(self, one: _Connected, now_s: float) -> None:
        """Once a link was narrow for a while."""
        sizes = [one.viewer.size(topic) for topic in one.viewer.watched if self._kind_of(topic) == 'camera']
        if self.no_video or all(size == FULL for size in sizes):
            one.narrow_s = None
        elif one.narrow_s is None:
            one.narrow_s = now_s
        elif now_s - one.narrow_s >= NARROW_S:
            one.narrow_s = now_s
            one.tell(LiveItem('', 'video', head={'narrow': True}))

    def _kind_of(self, topic: str) -> str:
        kind = KINDS.get(self._graph.get(topic, ''))
        return '' if kind is None else kind.name

    async def _tell_figures(self, *, with_ledger: bool) -> None:
        async with self._reading:
            item = await self._loop.run_in_executor(self._pool, partial(self._read_figures, with_ledger=with_ledger))
        for one in self._viewers:
            one.tell(item)

    def _read_figures(self, *, with_ledger: bool) -> LiveItem:
        """``at`` is when their ages were right: the ledger may take a while."""
        at_ms = round(time.monotonic() * 1e3, 1)
        return LiveItem('', 'figures', head={'at': at_ms, 'figures': self._figures.now(with_ledger=with_ledger)})

    @property
    def _is_watched_from_afar(self) -> bool:
        addresses = [one.address for one in self._viewers] + [one.address for one in self._foxgloves]
        addresses += self._rtsp.players if self._rtsp is not None else ()
        return not self._settings.is_of_store and any(not is_loopback(address) for address in addresses)

    def _lease(self) -> None:
        """Uploads yield for some seconds; a node that does not run uploads nothing."""
        with suppress(NodeUnavailable), closing(connect(self._settings.spool, self._settings.robot, 5.0)) as connection:
            connection.ask('yield', max_mbps=self._settings.uploads_mbps)

    # -- requests --------------------------------------------------------------------------------------------------

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Whom it is for, where it comes from; and the headers of each answer."""
        self._silent.pop(request.protocol, None)
        try:
            response = await self._guarded(request, handler)
        except web.HTTPException as error:
            response = _problem(error.status, error.text or error.reason)
        if not response.prepared:
            response.headers.update(SECURITY)
        return response

    async def _guarded(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        own = request.transport.get_extra_info('sockname') if request.transport is not None else None
        if not self._names.has(request.host, own[0] if own else ''):
            return _problem(403, f'this page is not called {request.host[:100]!r}: see --name')
        is_ws = request.path == '/ws'
        if is_ws or request.method not in ('GET', 'HEAD'):
            if not is_same_origin(request.headers.get('Origin'), request.host, self._scheme):
                return _problem(403, 'the request does not come from this page')
            if (request.content_length or 0) > MOST_BODY:
                return _problem(413, f'a request has at most {MOST_BODY} bytes')
        if request.path == '/ws' or request.path.startswith('/api/'):
            is_known = self._access.who(request.cookies.get(COOKIE)) is not None
            if not is_known and (request.method, request.path) != ('POST', '/api/session'):
                return _problem(401, 'sign in first')
        return await handler(request)

    def _who(self, request: web.Request) -> SignIn:
        """Of a request that came through the guard."""
        who = self._access.who(request.cookies.get(COOKIE))
        assert who is not None
        return who

    async def _file(self, request: web.Request) -> web.StreamResponse:
        found = self._files.get(request.match_info['name'] or 'index.html')
        if found is None:
            return _problem(404, 'there is no such page')
        body, packed, kind, tag = found
        headers = {'ETag': tag, 'Cache-Control': 'no-cache', 'Vary': 'Accept-Encoding'}
        if request.headers.get('If-None-Match') == tag:
            return web.Response(status=304, headers=headers)
        if 'gzip' in request.headers.get('Accept-Encoding', ''):
            return web.Response(body=packed, headers={**headers, 'Content-Encoding': 'gzip', 'Content-Type': kind})
        return web.Response(body=body, headers={**headers, 'Content-Type': kind})

    async def _session(self, request: web.Request) -> web.StreamResponse:
        who = self._who(request)
        return _json({'role': who.role, 'csrf': who.csrf, 'signed_in': bool(who.nonce), **self._about})

    @property
    def _about(self) -> dict[str, Any]:
        return {'robot': self._settings.robot, 'has_live': not self._settings.is_of_store or self._relay is not None,
                'no_video': self.no_video}  # fmt: skip

    async def _sign_in(self, request: web.Request) -> web.StreamResponse:
        address = request.remote or ''
        if wait_s := self._access.wait_s(address):
            return _problem(429, 'too many wrong tokens', {'Retry-After': str(round(wait_s))})
        token = (await _body(request)).get('token')
        before = self._access.who(request.cookies.get(COOKIE))
        try:
            found = self._access.sign_in(token, address, before) if isinstance(token, str) else None
        except TokenRefused as error:
            log.warning('nobody can sign in: %s', error)
            return _problem(503, str(error))
        if found is None:
            log.warning('a wrong token from %s', address)
            return _problem(401, 'this is not the token of a viewer or operator')
        who, cookie = found
        if before is not None and before.nonce:
            await self._keep_sign_outs(before.role)
        log.info('%s signed in from %s', who.role, address)
        response = _json({'role': who.role, 'csrf': who.csrf, 'signed_in': True, **self._about})
        response.set_cookie(COOKIE, cookie, max_age=LASTS_S, httponly=True, samesite='Strict', secure=self._scheme == 'https')
        return response

    async def _sign_out(self, request: web.Request) -> web.StreamResponse:
        who = self._who(request)
        if not self._access.is_csrf(who, request.headers.get('X-CSRF-Token', '')):
            return _problem(403, 'the request does not come from this page')
        self._access.sign_out(who)
        _end(one for one in self._viewers if one.who.nonce == who.nonce)
        _end(one for one in self._foxgloves if one.nonce == who.nonce)
        if await self._keep_sign_outs(who.role):
            response = _json({})
        else:
            response = _problem(503, 'signed out until this page restarts: the disk refused it; --new-tokens ends it for good')
        response.del_cookie(COOKIE)
        return response

    async def _keep_sign_outs(self, role: str) -> bool:
        try:
            await asyncio.to_thread(self._access.keep, role)
        except OSError as error:
            log.error('a sign-out is forgotten when this page restarts: %s', error)  # noqa: TRY400 - an operator's matter
            return False
        return True

    def _refused(self, request: web.Request) -> web.StreamResponse | None:
        """The answer to a request that acts and does not come from an operator at this page."""
        who = self._who(request)
        if not who.may_act:
            return _problem(403, 'only an operator may do that: sign in with the token of the operator')
        if not self._access.is_csrf(who, request.headers.get('X-CSRF-Token', '')):
            return _problem(403, 'the request does not come from this page')
        return None

    async def _act(self, request: web.Request) -> web.StreamResponse:
        """What an operator asks of the node, with the node's answer."""
        if (refused := self._refused(request)) is not None:
            return refused
        if self._settings.is_of_store:
            return _problem(404, "there is no node here: the buttons are on the robot's own page")
        asked = await _body(request)
        do = asked.get('do')
        takes = ACTS.get(do) if isinstance(do, str) else None
        given = {name: value for name, value in asked.items() if name != 'do'}
        if takes is None or not all(name in takes and isinstance(value, str) for name, value in given.items()):
            return _problem(400, f'"do" is one of {", ".join(ACTS)}')
        async with self._asking:
            answer = await self._loop.run_in_executor(self._pool, partial(self._ask, str(do), request.remote or '', given))
        return _json(answer)

    async def _label(self, request: web.Request) -> web.StreamResponse:
        """A label of a time, which an operator puts into the store."""
        if (refused := self._refused(request)) is not None:
            return refused
        asked = await _body(request)
        robot, label, note = asked.get('robot'), asked.get('label'), asked.get('note', '')
        times = [asked.get(name) for name in ('from', 'to')]
        if not all(isinstance(each, str) for each in (robot, label, note)) or not is_name(str(robot)):
            return _problem(400, 'a label has a robot, a label, a note, from and to')
        if not all(type(each) is int and 0 <= each < 10**14 for each in times):
            return _problem(400, 'from and to are times in UTC, in ms')
        address = request.remote or ''
        log.info('operator at %s labels %s', address, robot)
        said = {'label': label, 'note': note, 'by': f'operator at {address}', 'from': times[0], 'to': times[1]}
        return await self._of_past('label', str(robot), said)

    async def _pull(self, request: web.Request) -> web.StreamResponse:
        """An operator asks a robot for a sensor's objects of a time, or takes a request back."""
        if (refused := self._refused(request)) is not None:
            return refused
        asked = await _body(request)
        robot, cancel, sensor = asked.get('robot'), asked.get('cancel'), asked.get('sensor')
        times = [asked.get(name) for name in ('from', 'to')]
        if not isinstance(robot, str) or not is_name(robot):
            return _problem(400, 'a request names a robot')
        said: dict[str, Any] = {'by': f'operator_{request.remote or ""}'}
        if isinstance(cancel, str):
            said['cancel'] = cancel
        elif isinstance(sensor, str) and all(type(each) is int and 0 <= each < 10**14 for each in times):
            said |= {'sensor': sensor, 'from': times[0], 'to': times[1]}
        else:
            return _problem(400, 'a request has a robot, a sensor, from and to, which are times in UTC, in ms; or cancel, an id')
        log.info('operator at %s %s %s', request.remote, 'takes back what was asked of' if 'cancel' in said else 'asks', robot)
        return await self._of_past('pull', robot, said)

    def _ask(self, do: str, address: str, given: Mapping[str, str]) -> dict[str, Any]:
        try:
            with closing(connect(self._settings.spool, self._settings.robot)) as connection:
                by = {'by': 'page'} if do == 'event' else {}
                return connection.ask(do, who=f'operator at {address}', **given, **by)
        except NodeUnavailable as error:
            return {'ok': False, 'robot': self._settings.robot, 'error': str(error)}

    async def _tell_gaps(self, request: web.Request) -> web.StreamResponse:
        try:
            times = [None if given is None else given * SECOND // 1000 for given in (_ms(request, 'from'), _ms(request, 'to'))]
        except ValueError as error:
            return _problem(400, str(error))
        if self._settings.is_of_store:
            return await self._tell_today(times)
        try:
            async with self._reading:
                found = await self._loop.run_in_executor(self._pool, partial(self._figures.gaps, *times))
        except DataLoggerError as error:
            return _problem(503, str(error))
        response = _json(found)
        response.enable_compression()
        return response

    async def _tell_today(self, times: list[int | None]) -> web.StreamResponse:
        """The gaps of a robot whose spool is elsewhere."""
        now_ns = time.time_ns()
        since_ns, until_ns = times[0] or now_ns - now_ns % DAY_NS, times[1] or now_ns
        return await self._of_past('timeline', self._settings.robot, {'from': since_ns // 1_000_000, 'to': until_ns // 1_000_000})

    async def _tell_past(self, request: web.Request) -> web.StreamResponse:
        """Of a timeline JSON; of a moment its head as JSON and its items, each after a uint32 with its length."""
        do, robot = request.match_info['do'], request.query.get('robot', self._settings.robot)
        takes = {'timeline': ('from', 'to'), 'kept': ('from', 'to'), 'moment': ('at',)}.get(do, ())
        try:
            times = {name: _ms(request, name) for name in takes}
        except ValueError as error:
            return _problem(400, str(error))
        if not is_name(robot) or None in times.values():
            return _problem(400, f'{do} takes {" and ".join(("robot", *takes))}')
        return await self._of_past(do, robot, times)

    async def _of_past(self, do: str, robot: str, more: Mapping[str, Any]) -> web.StreamResponse:
        try:
            head, body = await self._history.ask({'do': do, 'robot': robot, **more})
        except PastUnavailable as error:
            return _problem(503, str(error), {'Retry-After': '2'})
        if 'error' in head:
            return _problem(400 if head.get('is_wrong') else 503, str(head['error']))
        if do == 'moment':
            told = json.dumps(head).encode()
            return web.Response(body=len(told).to_bytes(4, 'little') + told + body, headers={'Cache-Control': 'no-store'},
                                content_type='application/octet-stream')  # fmt: skip
        response = _json(head)
        response.enable_compression()
        return response

    async def _tell_doctor(self, _: web.Request) -> web.StreamResponse:
        async with self._examining:
            if self._doctor is None or time.monotonic() - self._doctor[0] > DOCTOR_S:
                self._doctor = time.monotonic(), await _examine(self._settings.spool.absolute(), self._settings.robot)
        return _json(self._doctor[1])

    # -- a viewer --------------------------------------------------------------------------------------------------

    async def _watch(self, request: web.Request) -> web.StreamResponse:
        if len(self._viewers) >= MOST_VIEWERS:
            return _problem(429, f'{MOST_VIEWERS} viewers are here, which is the most there may be', {'Retry-After': '10'})
        ws = web.WebSocketResponse(max_msg_size=MOST_MESSAGE, compress=False, timeout=2.0)
        own = request.transport.get_extra_info('sockname') if request.transport is not None else None
        one = _Connected(ws, Viewer(), request.cookies.get(COOKIE), self._who(request), request.remote or '',
                         own[0] if own else '', request.protocol)  # fmt: skip
        self._viewers.add(one)  # before anything waits: the cap counts those that are coming
        try:
            await ws.prepare(request)
            _quicken(request)
            one.transport = request.transport
            one.viewer.round_s = _round_s(one.transport)
            self._offer_catalogue(one)
            self._rewatch()
            one.tasks = [asyncio.create_task(self._receive(one))]
            await asyncio.wait(one.tasks)
        finally:
            self._viewers.discard(one)
            if one.asks is not None:
                one.asks.cancel()
            if self._video is not None:
                self._video.end(one)
            await self._leave(request, ws, one.tasks)
        return ws

    async def _leave(self, request: web.Request, ws: web.WebSocketResponse, tasks: list[asyncio.Task[None]]) -> None:
        """A connection has ended; it is in no set any more."""
        for task in tasks:
            task.cancel()
        for task in tasks:
            with suppress(asyncio.CancelledError, ConnectionError, RuntimeError, asyncio.TimeoutError):
                await task
        self._rewatch()
        if request.transport is not None and not ws.closed:
            request.transport.abort()  # one that reads nothing would not read a farewell either

    async def _tell_foxglove(self, request: web.Request) -> web.StreamResponse:
        """The address for a Foxglove at the same machine as this viewer."""
        if self._settings.is_of_store:
            return _problem(404, "Foxglove gets topics from the robot's own page")
        try:
            return _json({'path': f'/foxglove?ticket={self._access.ticket(self._who(request), request.remote or "")}'})
        except TokenRefused as error:
            return _problem(503, str(error))

    async def _foxglove(self, request: web.Request) -> web.StreamResponse:
        """A client that speaks Foxglove's protocol. Its ticket, which no foreign page knows, stands for sign-in and origin."""
        address = request.remote or ''
        ticket = request.query.get('ticket', '')
        nonce = self._access.of_ticket(ticket, address)
        if nonce is None:
            problem = "get a new address from the robot's page: this one has ended, or is for another computer"
            return await _refuse_foxglove(request, _problem(401, problem), problem, WSCloseCode.POLICY_VIOLATION)
        if len(self._foxgloves) >= MOST_FOXGLOVES:
            problem = f'{MOST_FOXGLOVES} clients are here, which is the most there may be'
            return await _refuse_foxglove(
                request, _problem(429, problem, {'Retry-After': '10'}), problem, WSCloseCode.TRY_AGAIN_LATER
            )
        ws = web.WebSocketResponse(
            protocols=PROTOCOLS, max_msg_size=MOST_MESSAGE, compress=False, timeout=2.0, heartbeat=SILENT_S
        )
        one = _Foxglove(FoxgloveClient(self._settings.robot, self._session_id), ticket, nonce, address, request.protocol)
        self._foxgloves.add(one)
        try:
            await ws.prepare(request)
            _quicken(request)
            _buffer_little(request)
            self._rewatch()
            await self._loop.run_in_executor(self._pool, _describe_all, frozenset(self._graph.values()))
            one.client.publish(self._graph)
            one.tasks = [asyncio.create_task(self._send_foxglove(ws, one.client)),
                         asyncio.create_task(self._hear_foxglove(ws, one.client))]  # fmt: skip
            await asyncio.wait(one.tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._foxgloves.discard(one)
            await self._leave(request, ws, one.tasks)
        return ws

    async def _send_foxglove(self, ws: web.WebSocketResponse, client: FoxgloveClient) -> None:
        while True:
            message = client.next()
            if message is None:
                client.ready.clear()
                await client.ready.wait()
            elif isinstance(message, str):
                await ws.send_str(message)
            else:
                await ws.send_bytes(message)

    async def _hear_foxglove(self, ws: web.WebSocketResponse, client: FoxgloveClient) -> None:
        async for message in ws:
            if message.type == WSMsgType.TEXT:
                client.take(_parsed(message.data))
                self._rewatch_soon()

    async def _receive(self, one: _Connected) -> None:
        viewer = one.viewer
        while True:
            message = await one.ws.receive()
            one.heard_s = time.monotonic()
            if message.type == WSMsgType.BINARY and len(message.data) == 4:
                viewer.acknowledge(int.from_bytes(message.data, 'little'))
                one.flush()
            elif message.type == WSMsgType.TEXT:
                said = _parsed(message.data)
                ping, watched = said.get('ping'), said.get('watch')
                if isinstance(ping, (int, float)):
                    one.tell(LiveItem('', 'pong', head={'ping': ping, 'now': round(time.monotonic() * 1e3, 2)}))
                if isinstance(watched, list):
                    viewer.watch(topic for topic in watched[:MOST_WATCHED] if isinstance(topic, str))
                    self._rewatch_soon()
                if 'video' in said:
                    self._ask_video(one, said['video'])
            elif message.type in (WSMsgType.CLOSE, WSMsgType.CLOSING, WSMsgType.CLOSED, WSMsgType.ERROR):
                return

    def _ask_video(self, one: _Connected, said: Any) -> None:
        """A viewer takes a topic as video, or no longer."""
        if one.asks is not None:
            one.asks.cancel()
            one.asks = None
        if isinstance(said, dict):
            one.asks = asyncio.create_task(self._take_video(one, said))
        elif self._video is not None:
            self._video.end(one)

    async def _take_video(self, one: _Connected, said: Mapping[str, Any]) -> None:
        def tell(what: Mapping[str, Any]) -> None:
            one.tell(LiveItem('', 'video', head=what))

        if not self.no_video and self._video is None:
            try:
                webrtc = await self._loop.run_in_executor(self._pool, import_module, 'shadowhound_data_logger.live.webrtc')
            except ImportError as error:
                self.no_video = f'{NO_WEBRTC} ({error})'
            else:
                if self._video is None:  # another viewer asked meanwhile
                    self._video = webrtc.CameraVideo(self._rewatch, self._h264)
        if self._video is None:
            tell({'problem': self.no_video})
        else:
            await self._video.take(one, said, (one.at, one.address), tell)


def _tell_failure(ticker: asyncio.Task[None]) -> None:
    """Nobody waits for a task that goes on until the page ends: should it fail, the log says so at once."""
    if not ticker.cancelled() and (error := ticker.exception()) is not None:
        log.error('a task of the page has failed: start the page again', exc_info=error)


def _end(connections: Iterable[_Connected | _Foxglove]) -> None:
    """Without a farewell, for which one that reads nothing would be waited for."""
    for task in [task for one in connections for task in one.tasks]:
        task.cancel()


def _message_header(size: int) -> bytes:
    """Before so many bytes that are a binary message from a server (RFC 6455, section 5.2)."""
    if size < 126:
        return bytes((0x82, size))
    return b'\x82\x7e' + size.to_bytes(2, 'big') if size < 1 << 16 else b'\x82\x7f' + size.to_bytes(8, 'big')


def _is_ours(record: logging.LogRecord) -> bool:
    """Whether it is more than that somebody sent what is no HTTP, which could fill the log."""
    return not (record.exc_info and isinstance(record.exc_info[1], HttpProcessingError))


def _describe_all(types: frozenset[str]) -> None:
    """Reads files, of which the definitions are remembered."""
    for name in types:
        describe(name)


def _parsed(text: str) -> dict[str, Any]:
    """What is no object says nothing."""
    try:
        said = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return said if isinstance(said, dict) else {}


async def _body(request: web.Request) -> dict[str, Any]:
    try:
        return _parsed((await asyncio.wait_for(request.read(), REQUEST_S)).decode())
    except UnicodeDecodeError:
        return {}
    except asyncio.TimeoutError as error:
        raise web.HTTPRequestTimeout(text=f'the request did not come within {REQUEST_S:g} s') from error


def _ms(request: web.Request, name: str) -> int | None:
    """A time of a request. Raises ValueError."""
    text = request.query.get(name, '')
    if text and not (text.isascii() and text.isdecimal() and len(text) < 15):
        raise ValueError(f'{name} is a time in UTC, in ms')
    return int(text) if text else None


def _json(content: Mapping[str, Any]) -> web.Response:
    return web.json_response(content, headers={'Cache-Control': 'no-store'})


async def _refuse_foxglove(request: web.Request, answer: web.Response, problem: str, code: WSCloseCode) -> web.StreamResponse:
    """In their protocol where it is spoken: a browser does not tell its page with which answer a WebSocket was refused."""
    ws = web.WebSocketResponse(protocols=PROTOCOLS, max_msg_size=MOST_MESSAGE, compress=False, timeout=2.0)
    offered = {name.strip() for name in request.headers.get('Sec-WebSocket-Protocol', '').split(',')}
    if not offered.intersection(PROTOCOLS) or not ws.can_prepare(request):
        return answer
    with suppress(ConnectionError):
        await ws.prepare(request)
        await ws.send_str(refusal(problem))
        await ws.close(code=code)
    return ws


def _problem(status: int, text: str, headers: Mapping[str, str] | None = None) -> web.Response:
    return web.json_response({'error': text}, status=status, headers={'Cache-Control': 'no-store', **(headers or {})})


def _static(folder: Path) -> list[tuple[str, tuple[bytes, bytes, str, str]]]:
    """All files of the page, as they are and packed: names are looked up among these, so that no path leads elsewhere."""
    found = []
    for path in sorted(path for path in folder.rglob('*') if path.is_file() and path.suffix != '.json'):
        body = path.read_bytes()
        kind = (
            {'.js': 'text/javascript', '.svg': 'image/svg+xml'}.get(path.suffix)
            or mimetypes.guess_type(path.name)[0]
            or 'text/plain'
        )
        tag = f'"{sha256(body).hexdigest()[:16]}"'
        found.append(
            (path.relative_to(folder).as_posix(), (body, gzip.compress(body, 9, mtime=0), f'{kind}; charset=utf-8', tag))
        )
    return found


def _listener(bind: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ':' in bind else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((bind, port))
        listener.listen(64)
        listener.setblocking(False)
    except BaseException:
        listener.close()
        raise
    return listener


def _round_s(transport: asyncio.BaseTransport | None) -> float:
    """The least time that a packet and its answer took lately, as the kernel of Linux says; 0 where it is unknown."""
    connection = transport.get_extra_info('socket') if transport is not None else None
    if connection is not None:
        with suppress(OSError, struct.error, AttributeError):
            told = int(_MIN_RTT.unpack_from(connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256))[0])
            return 0.0 if told == 0xFFFF_FFFF else told / 1e6
    return 0.0


def _quicken(request: web.Request) -> None:
    """Frames of a viewer leave at once, marked as interactive video where the system lets us, and few wait to be sent.

    What waits here is stale when it arrives; what is on its way is as much as the way holds.
    """
    transport = request.transport
    connection = transport.get_extra_info('socket') if transport is not None else None
    if connection is None:
        return
    with suppress(OSError):
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.IPPROTO_TCP, 25, 16 << 10)  # TCP_NOTSENT_LOWAT
        if connection.family == socket.AF_INET6:
            connection.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_TCLASS, AF41)
        connection.setsockopt(socket.IPPROTO_IP, socket.IP_TOS, AF41)  # of a socket of IPv6 too, which may speak IPv4


def _buffer_little(request: web.Request) -> None:
    """For who acknowledges nothing: all that is on its way to him waits in this buffer of the system as well."""
    connection = request.transport.get_extra_info('socket') if request.transport is not None else None
    if connection is not None:
        with suppress(OSError):
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, FOXGLOVE_BUFFER)


async def _examine(spool: Path, robot: str) -> dict[str, Any]:
    """What ``shadowhound-data doctor --json`` says of the node that has this spool, in a process of its own."""
    if spool.name != 'spool':
        return {'error': f'the doctor examines a node, which has its spool in SHADOWHOUND_HOME/spool, and not {spool}'}
    process = await asyncio.create_subprocess_exec(
        sys.executable, '-m', 'shadowhound_data_logger.cli.main', 'doctor', '--json', stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.DEVNULL,
        env={**os.environ, 'SHADOWHOUND_HOME': str(spool.parent), 'SHADOWHOUND_ROBOT': robot},
    )  # fmt: skip
    try:
        out, _ = await asyncio.wait_for(process.communicate(), 60.0)
        return {'doctor': json.loads(out)}
    except (asyncio.TimeoutError, ValueError) as error:
        if process.returncode is None:
            process.kill()
            await process.wait()
        return {'error': f'the doctor did not answer: {type(error).__name__}'}
