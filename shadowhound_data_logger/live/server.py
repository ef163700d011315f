"""The server of the live page: HTTP and its connections, the files of the page, and the work done once per second.

``auth.py`` controls access, ``viewers.py`` decides what each viewer is sent, ``past_routes.py`` answers about the past,
``acts.py`` does what operators request, ``cameras.py`` sends video.
"""

from __future__ import annotations

import asyncio
import gzip
import logging
import mimetypes
import socket
import ssl
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.live.access import Access, OwnNames, is_loopback, make_tokens, rtsp_password
from shadowhound_data_logger.live.acts import Acts
from shadowhound_data_logger.live.alerts import Alerts, AlertSettings, Condition, conditions_of_fleet, conditions_of_robot
from shadowhound_data_logger.live.answers import REQUEST_S, problem
from shadowhound_data_logger.live.auth import MAX_BODY, Auth, Handler
from shadowhound_data_logger.live.cameras import Cameras
from shadowhound_data_logger.live.cuts import Cuts
from shadowhound_data_logger.live.figures import SpoolFigures
from shadowhound_data_logger.live.history_process import HistoryProcess, PastUnavailable
from shadowhound_data_logger.live.kinds import LiveItem
from shadowhound_data_logger.live.past_routes import PastRoutes
from shadowhound_data_logger.live.relay import Relay
from shadowhound_data_logger.live.viewers import SILENT_S, Viewers
from shadowhound_data_logger.spool.gaps import OBJECTS
from shadowhound_data_logger.spool.topic_account import WRONG_TYPE

if TYPE_CHECKING:
    from shadowhound_data_logger.live.topics import Topics

log = logging.getLogger(__name__)

PAGE: Final = Path(__file__).parent / 'page'
MAX_CONNECTIONS: Final = 200
"""Of viewers and all other clients."""
IDLE_S: Final = 15.0
"""Between requests."""
TICK_S: Final = 1.0
FIGURES_EVERY, LEDGER_EVERY = 2, 4
"""Ticks between two reads of the status and of the ledger, which takes twice as long."""
CHECK_S: Final = 5.0
"""Interval of checking whether viewers are still signed in."""
LEASE_EVERY_S: Final = 2.0


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
    """Further host names under which the page may be requested."""
    certificate: tuple[Path, Path] | None = None
    """Certificate and key, for https."""
    is_of_store: bool = False
    """Whether the page is that of a store, with the past of all its robots, and not a robot's own."""
    robot_url: str = ''
    """For a store's page: the URL of the robot's own page, whose live view is relayed; empty: none."""
    robot_token: Path | None = None
    """The file with a viewer's token for that page."""
    rtsp: int | None = None
    """The port of RTSP; None: it is not served."""
    tiles: str = ''
    """The URL of a map's tiles, with {z}, {x} and {y}; empty: places are shown on a plain grid."""
    waits: str = ''
    """What the page is waiting for, in words; empty: nothing."""
    uploads_mbps: float = 4.0
    """Upload limit while remote viewers watch; 0: none."""
    alerts: AlertSettings | None = None
    """Where alerts are sent; None: nowhere."""


class LiveServer:
    """Serves the page until it is closed. Lifecycle: New; open once; close once; all on one event loop."""

    def __init__(self, settings: LiveSettings) -> None:
        self._settings = settings
        self._files = dict(_static(PAGE))
        self._figures = SpoolFigures(settings.spool, settings.robot, SystemClock.of_this_machine())
        self._pool = ThreadPoolExecutor(2, 'spool')
        self._reading = asyncio.Lock()
        names = OwnNames(settings.bind, settings.names)
        access = Access(make_tokens(settings.tokens), is_open=is_loopback(settings.bind))
        self.auth = Auth(
            access, names, self._scheme, self._about, lambda nonce: self.viewers.end(lambda one: one.who.nonce == nonce),
            settings.tiles,
        )  # fmt: skip
        self.cameras = Cameras(lambda: self.viewers.rewatch(), self._pool)  # noqa: PLW0108 - there are no viewers yet
        self.viewers = Viewers(self.auth, self.cameras, self._wake, is_of_store=settings.is_of_store)
        history = HistoryProcess([] if settings.is_of_store else [str(settings.spool), settings.robot])
        self.past = PastRoutes(
            history, self._figures, self._pool, self._reading, settings.robot, is_of_store=settings.is_of_store
        )
        self.cuts = Cuts(self.auth, settings.tokens, None if settings.is_of_store else settings.spool)
        self.acts = Acts(self.auth, self.past, self._pool, settings.spool, settings.robot, is_of_store=settings.is_of_store)
        self._alerts = (
            None if settings.alerts is None else Alerts(settings.alerts, settings.tokens / 'alerts.json', self._conditions)
        )
        self._topics: Topics | None = None
        self._relay: Relay | None = None
        self._runner: web.AppRunner | None = None
        self._listening: asyncio.Server | None = None
        self._silent: dict[asyncio.BaseProtocol, float] = {}  # connections without a request yet, and since when
        self._tickers: list[asyncio.Task[None]] = []
        self.port = settings.port

    async def open(self) -> None:
        """Raises OSError if the address cannot be listened on, or the certificate cannot be read; RtspUnavailable."""
        self._loop = asyncio.get_running_loop()
        app = web.Application(middlewares=[self._guard], client_max_size=MAX_BODY)
        app.add_routes([
            web.get('/ws', self.viewers.serve), *self.auth.routes(), *self.acts.routes(), *self.past.routes(),
            *self.cuts.routes(),
            web.get('/{name:.*}', self._file),
        ])  # fmt: skip
        logging.getLogger('aiohttp.server').addFilter(_is_worth_logging)
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
            ticker.add_done_callback(_log_failure)
        if self._alerts is not None:
            self._alerts.open()
        if self._settings.rtsp is not None:
            await self.cameras.open_rtsp(self._settings.bind, self._settings.rtsp, rtsp_password(self._settings.tokens))
            self.cameras.serve(self.viewers.camera_topics)
            self.viewers.rewatch()  # the topics of the graph are needed even without viewers

    async def close(self) -> None:
        for ticker in self._tickers:
            ticker.cancel()
        await asyncio.gather(*self._tickers, return_exceptions=True)
        if self._alerts is not None:
            await self._alerts.close()
        self.viewers.end(lambda _: True)
        if self._listening is not None:
            self._listening.close()
        if self._runner is not None:
            await self._runner.cleanup()
        await self.past.close()
        self.cuts.close()
        await self.cameras.close()
        if self._relay is not None:
            await self._relay.close()
        if self._topics is not None:
            await self._topics.close()
        self._pool.shutdown()

    @property
    def rtsp_url(self) -> str:
        """The prefix of the cameras' RTSP URLs; empty if RTSP is not served."""
        return '' if self.cameras.rtsp is None else f'rtsp://{self._host}:{self.cameras.rtsp.port}'

    @property
    def url(self) -> str:
        return f'{self._scheme}://{self._host}:{self.port}/'

    @property
    def _host(self) -> str:
        bind = self._settings.bind
        if bind in ('0.0.0.0', '::'):  # noqa: S104 - compared
            return socket.gethostname()
        return f'[{bind}]' if ':' in bind else bind

    @property
    def _scheme(self) -> str:
        return 'https' if self._settings.certificate is not None else 'http'

    def _about(self) -> dict[str, Any]:
        return {'robot': self._settings.robot, 'has_live': not self._settings.is_of_store or self._relay is not None,
                'no_video': self.cameras.no_video, 'tiles': self._settings.tiles, 'waits': self._settings.waits}  # fmt: skip

    # -- topics ----------------------------------------------------------------------------------------------------

    def _open_topics(self) -> None:
        """Read topics if ROS is available; otherwise only the data is shown."""
        if self._settings.is_of_store:
            if self._settings.robot_url:
                self._relay = Relay(self._settings.robot_url, self._settings.robot_token, lambda: self.viewers.wanted,
                                    self.viewers.on_relayed)  # fmt: skip
                self._relay.open()
            return
        if find_spec('rclpy') is None:
            self.viewers.ros_problem = 'ROS is not sourced here: the page shows the data, and no camera, cloud or plots'
            return
        from shadowhound_data_logger.live.topics import Topics  # noqa: PLC0415 - rclpy

        topics = Topics(lambda: self.viewers.wanted, self.viewers.on_graph, self.viewers.on_items)
        topics.open()
        self._topics = topics

    def _wake(self) -> None:
        for source in (self._topics, self._relay):
            if source is not None:
                source.wake()

    # -- once per second -------------------------------------------------------------------------------------------

    async def _tick(self) -> None:
        """The status values, the sizes and the lease."""
        rounds = 0
        lease_s = 0.0
        while True:
            began_s = time.monotonic()
            self._drop_silent()
            if self.viewers.connected and not self._settings.is_of_store and rounds % FIGURES_EVERY == 0:
                try:
                    await self._send_figures(with_ledger=rounds % LEDGER_EVERY == 0)
                except Exception:  # the one supervised catch-all: the page shows the age of its values
                    log.exception('the figures cannot be read')
            self.viewers.tick(began_s)
            if self._settings.uploads_mbps and began_s >= lease_s and self.viewers.is_watched_remotely:
                lease_s = began_s + LEASE_EVERY_S
                self._loop.run_in_executor(self._pool, self.acts.lease, self._settings.uploads_mbps)
            rounds = rounds + 1 if self.viewers.connected else 0
            await asyncio.sleep(max(0.05, began_s + TICK_S - time.monotonic()))

    async def _send_figures(self, *, with_ledger: bool) -> None:
        def read() -> LiveItem:
            """``at`` is when their ages were correct: reading the ledger may take a while."""
            at_ms = round(time.monotonic() * 1e3, 1)
            return LiveItem('', 'figures', head={'at': at_ms, 'figures': self._figures.now(with_ledger=with_ledger)})

        async with self._reading:
            item = await self._loop.run_in_executor(self._pool, read)
        self.viewers.on_figures(item)

    async def _conditions(self) -> list[Condition]:
        """What alerts are about: of all robots of a store, or of this robot."""
        alerts = self._settings.alerts
        assert alerts is not None
        if self._settings.is_of_store:
            head, _ = await self.past.history.ask({'do': 'fleet'})
            if 'error' in head:
                raise PastUnavailable(str(head['error']))
            return list(conditions_of_fleet(head['fleet'], alerts, time.time()))
        async with self._reading:
            return await self._loop.run_in_executor(self._pool, partial(self._conditions_here, alerts))

    def _conditions_here(self, alerts: AlertSettings) -> list[Condition]:
        figures = self._figures.now(with_ledger=False)
        lost = None
        with suppress(DataLoggerError):  # without a spool
            gaps = self._figures.gaps()
            sink, cause, count = (gaps['columns'].index(name) for name in ('sink', 'cause', 'count'))
            lost = sum(gap[count] for gap in gaps['gaps'] if gap[sink] == OBJECTS and gap[cause] != WRONG_TYPE)
        return list(conditions_of_robot(figures, lost, self._settings.spool.parent / 'policies', alerts))

    # -- connections and files -------------------------------------------------------------------------------------

    def _connected(self) -> asyncio.BaseProtocol:
        """The handler of a new connection: with too many, the one that has been idle longest is closed."""
        assert self._runner is not None
        assert self._runner.server is not None
        here = self._runner.server.connections
        if len(here) >= MAX_CONNECTIONS:
            watching = {one.protocol for one in self.viewers.connected}
            first = next((each for each in (*self._silent, *here) if each in here and each not in watching), None)
            if first is not None:
                self._drop(first)
        handler: asyncio.BaseProtocol = self._runner.server()
        self._silent[handler] = time.monotonic()
        return handler

    def _drop_silent(self) -> None:
        """Close connections without a first request, and viewers that stopped sending."""
        before_s = time.monotonic() - REQUEST_S
        for each in [each for each, since_s in self._silent.items() if since_s < before_s]:
            self._drop(each)
        silent_s = time.monotonic() - SILENT_S
        self.viewers.end(lambda one: one.received_s < silent_s)

    async def _end_unknown(self) -> None:
        """End the connections whose sign-in or token is no longer valid, even if other tasks hang."""
        while True:
            await asyncio.sleep(CHECK_S)
            self.viewers.end(lambda one: self.auth.access.who(one.cookie) != one.who)

    def _drop(self, handler: Any) -> None:
        self._silent.pop(handler, None)
        if handler.transport is not None:
            handler.transport.abort()

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        self._silent.pop(request.protocol, None)
        return await self.auth.guarded(request, handler)

    async def _file(self, request: web.Request) -> web.StreamResponse:
        found = self._files.get(request.match_info['name'] or 'index.html')
        if found is None:
            return problem(404, 'there is no such page')
        body, packed, kind, tag = found
        headers = {'ETag': tag, 'Cache-Control': 'no-cache', 'Vary': 'Accept-Encoding'}
        if request.headers.get('If-None-Match') == tag:
            return web.Response(status=304, headers=headers)
        if 'gzip' in request.headers.get('Accept-Encoding', ''):
            return web.Response(body=packed, headers={**headers, 'Content-Encoding': 'gzip', 'Content-Type': kind})
        return web.Response(body=body, headers={**headers, 'Content-Type': kind})


def _log_failure(ticker: asyncio.Task[None]) -> None:
    """Log the failure of a task that runs until the page ends, and that is never awaited."""
    if not ticker.cancelled() and (error := ticker.exception()) is not None:
        log.error('a task of the page has failed: start the page again', exc_info=error)


def _is_worth_logging(record: logging.LogRecord) -> bool:
    """Whether it is more than invalid HTTP from a client, which could fill the log."""
    return not (record.exc_info and isinstance(record.exc_info[1], HttpProcessingError))


def _static(folder: Path) -> list[tuple[str, tuple[bytes, bytes, str, str]]]:
    """All files of the page, plain and compressed: requests are looked up among these, so no path leads elsewhere."""
    found = []
    for path in sorted(path for path in folder.rglob('*') if path.is_file() and path.suffix != '.json'):
        body = path.read_bytes()
        kind = (
            {'.js': 'text/javascript', '.svg': 'image/svg+xml', '.webmanifest': 'application/manifest+json'}.get(path.suffix)
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
