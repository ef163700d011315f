"""The watched topics, read raw and polled. Importing this loads rclpy.

A subscription exists as long as its topic is watched: as a drawing (``/imu``), as a tree (``/imu#``), or as a number
(``/imu#orientation.w``); ``/imu#?`` has it sampled for the table (``sampling.py``). All are BEST_EFFORT and shallow, whatever the
publisher offers: no publisher waits for the live page or resends for it. Only latched topics (maps, static transforms) are
subscribed to as offered.
"""

from __future__ import annotations

import asyncio
import logging
import os
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import Final, TypeVar

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import get_default_context

from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.core.keys import printable
from shadowhound_data_logger.core.model import Taken
from shadowhound_data_logger.core.options import COMPRESSED_IMAGE, IMAGE
from shadowhound_data_logger.core.untrusted import visible
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.live.kinds import FULL, KINDS, Kind, LiveItem, clouds, frames, series, table_item
from shadowhound_data_logger.live.panels import Maker, kind_of, panel_of
from shadowhound_data_logger.live.sampling import Sampler
from shadowhound_data_logger.live.trees import numbers, parsed, tree
from shadowhound_data_logger.live.viewers import Graph
from shadowhound_data_logger.ros.endpoints import Plan
from shadowhound_data_logger.ros.fast_dds_profile import without_our_profile
from shadowhound_data_logger.ros.reader import (
    MAX_TAKES,
    PolledGroup,
    Reader,
    SubscriptionRefused,
    TypeUnavailable,
    endpoints,
    unavailable,
)
from shadowhound_data_logger.ros.shared_memory import PortGuard, dead_ports_avoided
from shadowhound_data_logger.ros.type_descriptions import TypeDescriptions

log = logging.getLogger(__name__)

NODE: Final = 'shadowhound_live'
POLL_S: Final = 1 / 18
"""What a poll costs hardly depends on what it finds: since the last one, its code has left the caches of the processor."""
GRAPH_S: Final = 1.0
PAUSE_S: Final = 5.0
"""After an error."""
LARGE_BYTES: Final = 1 << 20
"""A larger message is converted on a thread."""
BULK_DEPTH, ROWS_DEPTH = 2, 128
"""Depth for bulk topics, and for topics whose messages are all shown; for others only the newest is kept."""
MAX_GATHERED: Final = 500
MAX_TOPICS: Final = 2000
"""Maximum topics of the graph that are sent, those with a publisher first."""
MAX_PUBLISHERS: Final = 100
COUNTS: Final = 60
"""Topics whose publishers are counted per check; new ones are always counted."""
RATE_S: Final = 4.0
TREE, FIELD = Kind('message', 2.0, is_bulk=True), Kind('field', 20.0, is_bulk=False)
_Wanted = Mapping[str, frozenset[int]]
"""Watched keys (a topic, with ``#`` as a tree, with ``#path`` one of its numbers) -> the sizes."""
_SAMPLED: Final = '#?'
"""Suffix of a key whose topic is sampled."""


T = TypeVar('T')


class _View:
    """One way of watching a topic."""

    def __init__(self, topic: str, type_name: str, key: str) -> None:
        """Raises Rejected for an invalid key."""
        self.path: str | None = None
        self.maker: Maker | None = None
        self.is_latched = self._is_gathered = False
        if '#' in key:
            self.path = key.partition('#')[2]
            if self.path:
                parsed(self.path)
            self.kind, self.is_latched = FIELD if self.path else TREE, True
        elif (panel := panel_of(topic, type_name)) is not None:
            self.kind, self.maker = panel.kind, panel.maker()
            self.is_latched, self._is_gathered = panel.is_latched, panel.is_gathered
        else:
            self.kind = KINDS[type_name]
        self._is_each_shown = not self.kind.is_bulk and 2 / self.kind.max_hz < POLL_S  # of the others one a poll is enough
        self.depth = ROWS_DEPTH if self._is_gathered or self._is_each_shown else BULK_DEPTH if self.kind.is_bulk else 1
        self._next_s = 0.0
        self._waiting: list[Taken] = []

    def is_due(self, now_s: float) -> bool:
        """Whether to drain: messages that would not be shown are left to the middleware, which keeps the newest."""
        return self._is_each_shown or now_s >= self._next_s

    def shown(self, taken: list[Taken], now_s: float) -> list[Taken]:
        """The messages to show now, from these and earlier ones."""
        if self._is_each_shown:
            return taken[-round(2 * POLL_S * self.kind.max_hz) :]
        if taken:
            self._waiting = [*self._waiting, *taken][-MAX_GATHERED:] if self._is_gathered else taken[-1:]
        if not self._waiting or now_s < self._next_s:
            return []
        self._next_s = max(self._next_s + 1 / self.kind.max_hz, now_s - POLL_S)
        waiting, self._waiting = self._waiting, []
        return waiting


class _Watched:
    """A watched topic with its views."""

    def __init__(self, node: Node, topic: str, type_name: str, keys: Collection[str]) -> None:
        """Raises TypeUnavailable, SubscriptionRefused or Rejected."""
        self.type = type_name
        self.views = {key: _View(topic, type_name, key) for key in sorted(keys)}
        depth = max(view.depth for view in self.views.values())
        self.most = MAX_TAKES if depth > 1 else 1
        is_latched = any(view.is_latched for view in self.views.values())
        publishers = endpoints(node, topic) if is_latched else []
        self.awaits_publisher = is_latched and not publishers
        latched = any(each.reliable and each.transient_local for each in publishers)
        self.reader = Reader(node, Plan(topic, type_name, reliable=latched, transient_local=latched, depth=depth), PolledGroup())
        self._counts: deque[tuple[float, int]] = deque()  # when, and messages until then
        self._numbers: dict[str | None, int] = {}
        self._count = 0

    def is_due(self, now_s: float) -> bool:
        return any(view.is_due(now_s) for view in self.views.values())

    def count(self, taken: list[Taken], now_s: float) -> None:
        """Count messages by sequence number if there are any: those left in the middleware count too."""
        for one in taken:
            last = self._numbers.get(one.publisher)
            self._count += 1 if last is None or one.number is None else max(1, min(one.number - last, 10_000))
            if one.number is not None and len(self._numbers) < MAX_PUBLISHERS:
                self._numbers[one.publisher] = one.number
        if taken:
            self._counts.append((now_s, self._count))
        while len(self._counts) > 2 and self._counts[0][0] < now_s - RATE_S:
            self._counts.popleft()

    @property
    def rate_hz(self) -> float | None:
        """Message rate of the last seconds; None before the second message."""
        if len(self._counts) < 2:
            return None
        (first_s, first), (last_s, last) = self._counts[0], self._counts[-1]
        return round((last - first) / max(last_s - first_s, 1e-3), 2)


class Topics:
    """Reads the watched topics on the event loop, and does what takes longer (subscriptions, the graph, large images) on a
    thread, one step at a time.

    New; open once; close once. ``wanted`` returns what is watched, None without viewers; ``on_graph`` is called with the topics
    and types of the graph and their number, ``on_items`` with new items.
    """

    def __init__(self, wanted: Callable[[], _Wanted | None], on_graph: Callable[[Graph, int], None],
                 on_items: Callable[[list[LiveItem]], None]) -> None:  # fmt: skip
        self._wanted, self._on_graph, self._on_items = wanted, on_graph, on_items
        self._types = MessageTypes(os.environ.get('AMENT_PREFIX_PATH', '').split(':'))
        self._graph: Graph = {}
        self._total = self._counted = 0
        self._publishers: dict[str, int] = {}
        self._graph_s = self._next_s = 0.0
        self._watched: dict[str, _Watched] = {}
        self._followed: _Wanted | None = None  # the server replaces it when a viewer chooses
        self._refused: dict[str, tuple[str, set[str]]] = {}
        self._problems: dict[str, str] = {}
        self._is_closing = False
        self._wake = asyncio.Event()
        self._thread = ThreadPoolExecutor(1, 'topics')
        self.rejected: dict[str, int] = {}
        """Topic -> messages that could not be shown."""

    def open(self) -> None:
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        with without_our_profile(os.environ), dead_ports_avoided(get_default_context().get_domain_id()):
            self._node = Node(NODE, start_parameter_services=False, enable_rosout=False)
        self._descriptions = TypeDescriptions(self._node, PolledGroup())
        self._sampler = Sampler(self._node, self._descriptions)
        self._guard = PortGuard()
        self._task = asyncio.create_task(self._run())

    def wake(self) -> None:
        """The wanted topics have changed."""
        self._wake.set()

    async def close(self) -> None:
        self._is_closing = True  # until Python 3.12 wait_for loses a cancellation that arrives just as it ends
        self._task.cancel()
        await asyncio.wait([self._task])
        await asyncio.to_thread(self._thread.shutdown)
        for one in self._watched.values():
            one.reader.close()
        self._sampler.close()
        self._descriptions.close()
        self._node.destroy_node()
        rclpy.try_shutdown()
        self._guard.close()

    async def _run(self) -> None:
        while not self._is_closing:
            try:
                await self._step()
            except Exception:  # a supervised catch-all: the page shows the age of what it has
                log.exception('topics cannot be read; the next attempt is in %.0f s', PAUSE_S)
                await asyncio.sleep(PAUSE_S)

    async def _step(self) -> None:
        if self._wanted():
            await asyncio.sleep(max(0.0, self._next_s - time.monotonic()))
        else:
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._wake.wait(), GRAPH_S)
        self._wake.clear()
        wanted, now_s = self._wanted(), time.monotonic()
        self._next_s = now_s + POLL_S
        if wanted is not None and now_s - self._graph_s >= GRAPH_S:
            self._graph_s = now_s
            if await self._on_thread(self._check_graph):
                self._on_graph(self._graph, self._total)
            self._followed = None
        if wanted is not self._followed:
            self._on_items(await self._on_thread(lambda: self._follow(wanted or {})))
            self._followed = wanted
        if wanted:
            await self._drain(wanted, now_s)
            self._on_items(self._sampler.read(now_s))
            if self._sampler.is_due(now_s):
                self._on_items(await self._on_thread(lambda: self._sampler.start(now_s)))

    async def _on_thread(self, do: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, do)

    def _check_graph(self) -> bool:
        """Whether it has changed."""
        seen = {topic: types for topic, types in self._node.get_topic_names_and_types() if types}
        counted = [topic for topic in seen if topic not in self._publishers]
        known = [topic for topic in self._publishers if topic in seen]
        first = self._counted % max(1, len(known))
        self._counted = first + COUNTS
        counted += [*known[first:], *known[:first]][:COUNTS]
        own = {'/parameter_events': 1}  # every rclpy node publishes it
        counts = {topic: self._node.count_publishers(topic) - own.get(topic, 0) for topic in counted}
        self._publishers = {topic: counts.get(topic, self._publishers.get(topic, 0)) for topic in seen}
        rows = [
            (
                printable(topic),
                next((name for name in types if kind_of(topic, name)), printable(types[0])),
                self._publishers[topic],
            )
            for topic, types in seen.items()
        ]
        rows.sort(key=lambda row: (row[2] < 1, kind_of(row[0], row[1]) is None, row[0]))
        graph = {topic: (type_name, count) for topic, type_name, count in rows[:MAX_TOPICS]}
        before = self._graph, self._total
        self._graph, self._total = graph, len(rows)
        return before != (graph, len(rows))

    def _follow(self, wanted: _Wanted) -> list[LiveItem]:
        """Subscribe to exactly these; returns why others are not shown."""
        items: list[LiveItem] = []
        sampled = (key.removesuffix(_SAMPLED) for key in wanted if key.endswith(_SAMPLED))
        self._sampler.follow({topic: self._graph[topic][0] for topic in sampled if topic in self._graph})
        topics: dict[str, set[str]] = {}
        for key, sizes in wanted.items():
            topic = key.partition('#')[0]
            type_name, _ = self._graph.get(topic, ('', 0))
            if not key.endswith(_SAMPLED) and sizes and type_name and ('#' in key or kind_of(topic, type_name)):
                topics.setdefault(topic, set()).add(key)
        for topic, one in list(self._watched.items()):
            type_name, publishers = self._graph.get(topic, ('', 0))
            if type_name != one.type or topics.get(topic) != one.views.keys() or (one.awaits_publisher and publishers > 0):
                self._watched.pop(topic).reader.close()
        self._problems = {key: why for key, why in self._problems.items() if key in wanted}
        for topic, keys in topics.items():
            type_name, _ = self._graph[topic]
            if topic not in self._watched and self._refused.get(topic) != (type_name, keys):
                try:
                    self._watched[topic] = _Watched(self._node, topic, type_name, keys)
                except (TypeUnavailable, SubscriptionRefused, Rejected) as error:
                    if unavailable(type_name) and self._descriptions.poll(topic, type_name, time.monotonic()):
                        continue  # its publisher may answer until the next check of the graph
                    self._refused[topic] = type_name, keys
                    log.warning('%s is not shown: %s', topic, error)
                    items += [item for key in sorted(keys) for item in self._problem(key, str(error))]
        return items

    async def _drain(self, wanted: _Wanted, now_s: float) -> None:
        items: list[LiveItem] = []
        slow: list[tuple[str, _Watched, _View, list[Taken], list[int]]] = []
        for one in self._watched.values():
            if not one.is_due(now_s):
                continue
            received = one.reader.drain(one.most)
            for key, view in one.views.items():
                if view.kind is TREE:
                    one.count(received, now_s)
                taken = view.shown(received, now_s)
                sizes = wanted.get(key, frozenset())
                if not taken or not sizes:
                    continue
                shown = key, one, view, taken, sorted(sizes)
                if len(taken[-1].cdr) > LARGE_BYTES or one.type == IMAGE or (one.type == COMPRESSED_IMAGE and max(sizes) > FULL):
                    slow.append(shown)
                else:
                    items += self._shown(*shown)
        self._on_items(items)
        for shown in slow:
            self._on_items(await self._on_thread(partial(self._shown, *shown)))

    def _shown(self, key: str, one: _Watched, view: _View, taken: list[Taken], sizes: list[int]) -> list[LiveItem]:
        """Its items, or why it cannot be shown."""
        try:
            items = self._items(key, one, view, taken, sizes)
        except Rejected as error:
            topic = one.reader.plan.topic
            self.rejected[topic] = self.rejected.get(topic, 0) + 1
            if self.rejected[topic] == 1:
                log.warning('%s: a message cannot be shown: %s', topic, error)
            return self._problem(key, str(error))
        return items + self._problem(key, '') if key in self._problems else items

    def _problem(self, key: str, why: str) -> list[LiveItem]:
        """Report why a watched topic is not shown, when that changes; empty: it is shown again."""
        if self._problems.get(key, '') == why:
            return []
        self._problems[key] = why
        return [LiveItem(key, 'problem', head={'at': round(time.monotonic() * 1e3, 1), 'text': visible(why)[:300]})]

    def _items(self, key: str, one: _Watched, view: _View, taken: list[Taken], sizes: list[int]) -> list[LiveItem]:
        # By this machine's own clock: arrival here, for comparison with ``time.monotonic``.
        offset_ns = time.monotonic_ns() - time.time_ns()
        messages = [((message.received_ns + offset_ns) / 1e6, message.cdr) for message in taken]
        at_ms, cdr = messages[-1]
        if view.kind is TREE:
            built = tree(self._types, one.type, self._types.deserialize(one.type, memoryview(cdr)))
            head = {'at': round(at_ms, 1), 'bytes': len(cdr), 'hz': one.rate_hz, 'tree': built}
            return [LiveItem(key, 'message', head=head)]
        if view.path:
            rows = [(at_ms, self._types.deserialize(one.type, memoryview(cdr))) for at_ms, cdr in messages]
            return [table_item(key, view.kind, numbers(rows, view.path))]
        if view.maker is not None:
            return [view.maker(key, self._types, one.type, messages)]
        if not view.kind.is_bulk:
            return [series(key, view.kind, one.type, self._types, messages)]
        if view.kind.name == 'cloud':
            return list(clouds(key, self._types, at_ms, cdr, sizes))
        return list(frames(key, one.type, self._types, at_ms, cdr, sizes))
