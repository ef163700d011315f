"""The connected viewers: what each of them watches and is sent, and which topics are read for them."""

from __future__ import annotations

import asyncio
import logging
import socket
import struct
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final

from aiohttp import WSMsgType, web

from shadowhound_data_logger.core import heap
from shadowhound_data_logger.live.access import COOKIE, SignIn, is_loopback
from shadowhound_data_logger.live.answers import parsed, problem
from shadowhound_data_logger.live.auth import Auth
from shadowhound_data_logger.live.cameras import Cameras
from shadowhound_data_logger.live.kinds import FULL, LiveItem
from shadowhound_data_logger.live.panels import BULK, kind_of
from shadowhound_data_logger.live.viewer import Viewer

log = logging.getLogger(__name__)

MAX_VIEWERS: Final = 16
MAX_MESSAGE: Final = 16 << 10
"""Maximum size of a viewer's message."""
MAX_WATCHED: Final = 40
"""Topics that one viewer watches."""
REWATCH_S: Final = 0.1
"""Minimum interval between changes of what is read, when viewers choose."""
NARROW_S: Final = 10.0
"""A viewer whose link did not carry full frames for this long is offered video."""
SILENT_S: Final = 8.0
"""A viewer that sends nothing for this long is disconnected: the page sends something every second."""
AF41: Final = 34 << 2
"""DSCP of interactive video (RFC 4594), in the byte where IP has it."""
KEPT: Final = frozenset({*BULK, 'message', 'problem'})
"""Kinds whose newest item is sent to a new viewer: it may have been published once."""
Graph = Mapping[str, tuple[str, int]]
"""Topic -> its type and number of publishers."""
_MIN_RTT: Final = struct.Struct('=148xI')
"""Offset of tcp_info.tcpi_min_rtt in linux/tcp.h, in microseconds."""


@dataclass(eq=False)
class Connected:
    """A connected viewer and its sign-in."""

    ws: web.WebSocketResponse
    viewer: Viewer
    cookie: str | None
    who: SignIn
    address: str
    at: str
    """Our address that it connected to."""
    protocol: asyncio.BaseProtocol
    tasks: list[asyncio.Task[None]] = field(default_factory=list)
    received_s: float = field(default_factory=time.monotonic)
    """When it last sent something."""
    narrow_s: float | None = None
    """Since when its link does not carry full frames."""
    asks: asyncio.Task[None] | None = None
    """Its request for video."""
    transport: asyncio.BaseTransport | None = None
    """Its connection, once it is a WebSocket."""
    ready: asyncio.Event = field(default_factory=asyncio.Event)
    """Something can be sent."""

    def tell(self, item: LiveItem) -> None:
        """Send it, together with all other items of the same iteration of the event loop."""
        self.viewer.offer(item)
        self.ready.set()


class Viewers:
    """All viewers of the page. Lifecycle: New; ``serve`` each connection; ``end_all`` once. Used by one event loop."""

    def __init__(self, auth: Auth, cameras: Cameras, wake: Callable[[], None], *, is_of_store: bool) -> None:
        """``wake`` is called when the set of topics to read changes."""
        self._auth, self._cameras, self._wake, self._is_of_store = auth, cameras, wake, is_of_store
        self.connected: set[Connected] = set()
        self.graph: Graph = {}
        """Those with a publisher first."""
        self._total = 0
        self._kept: dict[tuple[str, bool], LiveItem] = {}
        self.wanted: dict[str, frozenset[int]] | None = None
        """Topic -> the sizes in which it is shown; None without viewers."""
        self.ros_problem = ''
        """Why only the data is shown; empty if topics are read."""
        self._relayed_topics: LiveItem | None = None
        self._figures: LiveItem | None = None
        self._rewatching: asyncio.TimerHandle | None = None
        self._rewatched_s = 0.0

    # -- connections -----------------------------------------------------------------------------------------------

    async def serve(self, request: web.Request) -> web.StreamResponse:
        """The WebSocket of one viewer, until it ends."""
        if len(self.connected) >= MAX_VIEWERS:
            return problem(429, f'{MAX_VIEWERS} viewers are connected, which is the maximum', {'Retry-After': '10'})
        ws = web.WebSocketResponse(max_msg_size=MAX_MESSAGE, compress=False, timeout=2.0)
        own = request.transport.get_extra_info('sockname') if request.transport is not None else None
        one = Connected(ws, Viewer(), request.cookies.get(COOKIE), self._auth.who(request), request.remote or '',
                        own[0] if own else '', request.protocol)  # fmt: skip
        self.connected.add(one)  # before any await: the maximum includes viewers that are connecting
        try:
            await ws.prepare(request)
            _prioritize(request.transport)
            one.transport = request.transport
            one.viewer.round_s = _round_s(one.transport)
            self._offer_topics(one)
            if self._figures is not None and len(self.connected) > 1:  # the first viewer is sent new ones at once
                one.tell(self._figures)
            self.rewatch()
            one.tasks = [asyncio.create_task(self._receive(one)), asyncio.create_task(_send(one))]
            await asyncio.wait(one.tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self.connected.discard(one)
            if one.asks is not None:
                one.asks.cancel()
            self._cameras.end(one)
            await self._leave(request, one)
        return ws

    async def _leave(self, request: web.Request, one: Connected) -> None:
        for task in one.tasks:
            task.cancel()
        for task in one.tasks:
            with suppress(asyncio.CancelledError, ConnectionError, RuntimeError, asyncio.TimeoutError):
                await task
        self.rewatch()
        if request.transport is not None and not one.ws.closed:
            request.transport.abort()  # one that reads nothing would not read a close frame either

    def end(self, ends: Callable[[Connected], bool]) -> None:
        """Disconnect matching viewers, without a close frame: one that reads nothing would delay it."""
        for task in [task for one in self.connected if ends(one) for task in one.tasks]:
            task.cancel()

    @property
    def is_watched_remotely(self) -> bool:
        """Whether a viewer or a player is on another machine than the robot."""
        addresses = [one.address for one in self.connected]
        addresses += self._cameras.rtsp.players if self._cameras.rtsp is not None else ()
        return not self._is_of_store and any(not is_loopback(address) for address in addresses)

    # -- what they are sent ----------------------------------------------------------------------------------------

    def on_figures(self, item: LiveItem) -> None:
        """New values of the status and the ledger."""
        self._figures = item
        for one in self.connected:
            one.tell(item)

    def on_graph(self, graph: Graph, total: int = 0) -> None:
        """The topics have changed; ``total`` also counts those beyond the limit."""
        self.graph, self._total = graph, max(total, len(graph))
        self._cameras.serve(self.camera_topics)
        for one in self.connected:
            self._offer_topics(one)
        self.rewatch()

    def on_items(self, items: Iterable[LiveItem]) -> None:
        """Messages of watched topics, and samples of topics for all viewers."""
        for item in items:
            self._keep(item)
            for one in self.connected:
                if not item.topic or (item.topic in one.viewer.watched and one.viewer.size(item.topic) == item.size):
                    one.tell(item)
            self._cameras.offer(item)

    def on_relayed(self, item: LiveItem) -> None:
        """An item from the robot's own page."""
        if item.kind == 'topics':
            self._relayed_topics = item
        self._keep(item)
        for one in self.connected:
            if not item.topic or item.topic in one.viewer.watched:
                one.tell(item)
        self._cameras.offer(item)

    @property
    def camera_topics(self) -> list[str]:
        return [topic for topic in self.graph if self._kind_of(topic) == 'camera']

    def tick(self, now_s: float) -> None:
        """Once per second: update the sizes for each viewer."""
        for one in self.connected:
            one.viewer.has_video = self._cameras.has(one)
            one.viewer.round_s = _round_s(one.transport)
        if self.connected and not self._is_of_store:
            for one in self.connected:
                one.viewer.choose_sizes()
                self.suggest_video(one, now_s)
            self.rewatch()

    def suggest_video(self, one: Connected, now_s: float) -> None:
        """Offer video to a viewer whose link was slow for a while."""
        sizes = [one.viewer.size(topic) for topic in one.viewer.watched if self._kind_of(topic) == 'camera']
        if self._cameras.no_video or all(size == FULL for size in sizes):
            one.narrow_s = None
        elif one.narrow_s is None:
            one.narrow_s = now_s
        elif now_s - one.narrow_s >= NARROW_S:
            one.narrow_s = now_s
            one.tell(LiveItem('', 'video', head={'narrow': True}))

    def _offer_topics(self, one: Connected) -> None:
        if self._relayed_topics is not None:
            one.tell(self._relayed_topics)
            return
        topics = [[topic, self._kind_of(topic), name, count] for topic, (name, count) in self.graph.items()]
        one.tell(LiveItem('', 'topics', head={'topics': topics, 'total': self._total, 'problem': self.ros_problem}))

    def _kind_of(self, topic: str) -> str:
        """How the topic is drawn; empty if it is not."""
        kind = kind_of(topic, self.graph.get(topic, ('', 0))[0])
        return '' if kind is None else kind.name

    def _keep(self, item: LiveItem) -> None:
        if item.kind in KEPT and item.topic and self.wanted is not None and item.topic in self.wanted:
            self._kept[item.topic, item.kind == 'problem'] = item

    # -- what is read for them -------------------------------------------------------------------------------------

    def _rewatch_soon(self) -> None:
        """Delayed, so that a viewer that keeps choosing creates no more subscriptions than others."""
        if self._rewatching is None:
            wait_s = max(0.0, self._rewatched_s + REWATCH_S - time.monotonic())
            self._rewatching = asyncio.get_running_loop().call_later(wait_s, self.rewatch)

    def rewatch(self) -> None:
        """After a viewer connected, disconnected or chose."""
        if self._rewatching is not None:
            self._rewatching.cancel()
            self._rewatching = None
        self._rewatched_s = time.monotonic()
        wanted: dict[str, set[int]] = {topic: {FULL} for topic in self._cameras.topics}
        for one in self.connected:
            for topic in one.viewer.watched:
                wanted.setdefault(topic, set()).add(one.viewer.size(topic))
        before = self.wanted
        is_watched = self.connected or self._cameras.rtsp is not None
        self.wanted = {topic: frozenset(sizes) for topic, sizes in wanted.items()} if is_watched else None
        if self.wanted is None and before is not None:
            heap.trim()
        self._kept = {key: item for key, item in self._kept.items() if self.wanted and key[0] in self.wanted}
        if self.wanted != before:
            self._wake()

    # -- what they send --------------------------------------------------------------------------------------------

    async def _receive(self, one: Connected) -> None:
        while True:
            message = await one.ws.receive()
            one.received_s = time.monotonic()
            if message.type == WSMsgType.BINARY and len(message.data) == 4:
                one.viewer.acknowledge(int.from_bytes(message.data, 'little'))
                if one.viewer.is_waiting:
                    one.ready.set()
            elif message.type == WSMsgType.TEXT:
                self._take(one, parsed(message.data))
            elif message.type in (WSMsgType.CLOSE, WSMsgType.CLOSING, WSMsgType.CLOSED, WSMsgType.ERROR):
                return

    def _take(self, one: Connected, request: Mapping[str, Any]) -> None:
        ping, watched = request.get('ping'), request.get('watch')
        if isinstance(ping, (int, float)):
            one.tell(LiveItem('', 'pong', head={'ping': ping, 'now': round(time.monotonic() * 1e3, 2)}))
        if isinstance(watched, list):
            before = one.viewer.watched
            one.viewer.watch(topic for topic in watched[:MAX_WATCHED] if isinstance(topic, str))
            for (topic, _), item in self._kept.items():
                if topic in one.viewer.watched and topic not in before:
                    one.tell(item)
            self._rewatch_soon()
        if 'video' in request:
            self._take_video(one, request['video'])

    def _take_video(self, one: Connected, request: Any) -> None:
        """A viewer takes a topic as video, or stops."""
        if one.asks is not None:
            one.asks.cancel()
            one.asks = None
        if isinstance(request, dict):
            taken = self._cameras.take(
                one, request, (one.at, one.address), lambda what: one.tell(LiveItem('', 'video', head=what))
            )
            one.asks = asyncio.create_task(taken)
        else:
            self._cameras.end(one)


async def _send(one: Connected) -> None:
    """Send the viewer's frames until its connection ends."""
    while True:
        await one.ready.wait()
        one.ready.clear()
        while (frame := one.viewer.next_frame()) is not None:
            await one.ws.send_bytes(frame)


def _round_s(transport: asyncio.BaseTransport | None) -> float:
    """The shortest recent round trip, as the kernel of Linux measures it; 0 if it is unknown."""
    connection = transport.get_extra_info('socket') if transport is not None else None
    if connection is not None:
        with suppress(OSError, struct.error, AttributeError):
            shortest = int(_MIN_RTT.unpack_from(connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256))[0])
            return 0.0 if shortest == 0xFFFF_FFFF else shortest / 1e6
    return 0.0


def _prioritize(transport: asyncio.BaseTransport | None) -> None:
    """Send frames immediately, marked as interactive video where the system allows it, and keep few queued in the kernel.

    Data queued there is stale when it arrives.
    """
    connection = transport.get_extra_info('socket') if transport is not None else None
    if connection is None:
        return
    with suppress(OSError):
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.IPPROTO_TCP, 25, 16 << 10)  # TCP_NOTSENT_LOWAT
        if connection.family == socket.AF_INET6:
            connection.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_TCLASS, AF41)
        connection.setsockopt(socket.IPPROTO_IP, socket.IP_TOS, AF41)  # also for an IPv6 socket, which may carry IPv4
