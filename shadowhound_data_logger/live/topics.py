"""The topics that somebody watches, read raw and polled. Importing this loads rclpy.

A subscription exists as long as somebody watches its topic. All are BEST_EFFORT and shallow, whatever the publisher offers:
nobody waits for the live page, and nothing is sent again for it.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Mapping
from typing import Final

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import get_default_context

from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.core.keys import printable
from shadowhound_data_logger.core.model import Taken
from shadowhound_data_logger.core.worker import Worker
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.live.kinds import KINDS, Kind, LiveItem, clouds, frames, series
from shadowhound_data_logger.ros.endpoints import Plan
from shadowhound_data_logger.ros.fast_dds_profile import without_our_profile
from shadowhound_data_logger.ros.reader import MAX_TAKES, PolledGroup, Reader, SubscriptionRefused, TypeUnavailable
from shadowhound_data_logger.ros.shared_memory import PortGuard, dead_ports_avoided

log = logging.getLogger(__name__)

NODE: Final = 'shadowhound_live'
POLL_S: Final = 1 / 30
GRAPH_S: Final = 1.0
BULK_DEPTH, ROWS_DEPTH = 2, 128
"""Of bulk, and of a topic of which all messages are shown; of others only the newest is kept."""
MAX_TOPICS: Final = 500
"""Of the graph that are told; whoever publishes more is not shown all of it."""
_Wanted = Mapping[str, frozenset[int]]
"""Topic -> the sizes in which it is watched."""


class _Watched:
    """One topic that is watched."""

    def __init__(self, node: Node, topic: str, type_name: str, kind: Kind) -> None:
        """Raises TypeUnavailable or SubscriptionRefused."""
        self.type, self.kind = type_name, kind
        self._is_each_shown = not kind.is_bulk and 1 / kind.most_hz < POLL_S
        self.most = MAX_TAKES if kind.is_bulk or self._is_each_shown else 1
        depth = BULK_DEPTH if kind.is_bulk else 1 if self.most == 1 else ROWS_DEPTH
        self.reader = Reader(node, Plan(topic, type_name, reliable=False, transient_local=False, depth=depth), PolledGroup())
        self._next_s = 0.0

    def is_due(self, now_s: float) -> bool:
        """Whether to look: what would not be shown is left to the middleware, which keeps the newest."""
        return self._is_each_shown or now_s >= self._next_s

    def shown(self, taken: list[Taken], now_s: float) -> list[Taken]:
        """Those of them that are shown."""
        if self._is_each_shown:
            return taken[-round(2 * POLL_S * self.kind.most_hz) :]
        if not taken or now_s < self._next_s:
            return []
        self._next_s = max(self._next_s + 1 / self.kind.most_hz, now_s - POLL_S)
        return taken[-1:]


class Topics:
    """Reads what is watched, on the thread ``topics``, which alone makes and ends subscriptions.

    New; open once; close once. ``wanted`` says what is watched, None while there is no viewer; ``found`` is told topics and
    types of the graph, ``came`` what there is to show. All three are called by the thread.
    """

    def __init__(self, wanted: Callable[[], _Wanted | None], found: Callable[[Mapping[str, str]], None],
                 came: Callable[[list[LiveItem]], None]) -> None:  # fmt: skip
        self._wanted, self._found, self._came = wanted, found, came
        self._types = MessageTypes(os.environ.get('AMENT_PREFIX_PATH', '').split(':'))
        self._node: Node | None = None
        self._guard: PortGuard | None = None
        self._graph: dict[str, str] = {}
        self._graph_s = self._next_s = 0.0
        self._watched: dict[str, _Watched] = {}
        self._followed: _Wanted | None = None  # the server replaces it when somebody chooses
        self._refused: dict[str, str] = {}
        self._wake = threading.Event()
        self.worker = Worker('topics', self._step)
        self.rejected: dict[str, int] = {}
        """Topic -> messages that could not be shown."""

    def open(self) -> None:
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        with without_our_profile(os.environ), dead_ports_avoided(get_default_context().get_domain_id()):
            self._node = Node(NODE, start_parameter_services=False, enable_rosout=False)
        self._guard = PortGuard()
        self.worker.start()

    def wake(self) -> None:
        """What is wanted has changed."""
        self._wake.set()

    def close(self) -> None:
        self.worker.stop()
        self._wake.set()
        if not self.worker.join(5.0):
            log.warning('the thread that reads topics does not end')
        for one in self._watched.values():
            one.reader.close()
        if self._node is not None:
            self._node.destroy_node()
        rclpy.try_shutdown()
        if self._guard is not None:
            self._guard.close()

    # -- the thread ------------------------------------------------------------------------------------------------

    def _step(self) -> None:
        wanted = self._wanted()
        if wanted:  # a sleep costs less than a wait, and ends soon enough
            time.sleep(max(0.0, self._next_s - time.monotonic()))
        else:
            self._wake.wait(GRAPH_S)
        self._wake.clear()
        wanted = self._wanted()
        now_s = time.monotonic()
        self._next_s = now_s + POLL_S
        if wanted is None:
            self._follow({})
            self._followed = None
            return
        if now_s - self._graph_s >= GRAPH_S:
            self._graph_s = now_s
            self._look()
            self._followed = None
        if wanted is not self._followed:
            self._follow(wanted)
            self._followed = wanted
        self._drain(wanted, now_s)

    def _look(self) -> None:
        assert self._node is not None
        seen = sorted(self._node.get_topic_names_and_types())[:MAX_TOPICS]
        graph = {
            printable(topic): next((name for name in types if name in KINDS), printable(types[0]))
            for topic, types in seen
            if types
        }
        if graph != self._graph:
            self._graph = graph
            self._found(graph)

    def _follow(self, wanted: _Wanted) -> None:
        assert self._node is not None
        for topic in [
            topic for topic, one in self._watched.items() if not wanted.get(topic) or self._graph.get(topic) != one.type
        ]:
            self._watched.pop(topic).reader.close()
        for topic in wanted.keys() - self._watched.keys():
            type_name = self._graph.get(topic, '')
            kind = KINDS.get(type_name)
            if kind is None or not wanted[topic] or self._refused.get(topic) == type_name:
                continue
            try:
                self._watched[topic] = _Watched(self._node, topic, type_name, kind)
            except (TypeUnavailable, SubscriptionRefused) as error:
                self._refused[topic] = type_name
                log.warning('%s is not shown: %s', topic, error)

    def _drain(self, wanted: _Wanted, now_s: float) -> None:
        items: list[LiveItem] = []
        for topic, one in self._watched.items():
            if not one.is_due(now_s):
                continue
            came = one.reader.drain(one.most)
            sizes = wanted.get(topic, frozenset())
            taken = one.shown(came, now_s)
            if not taken or not sizes:
                continue
            try:
                items += self._items(topic, one, taken, sorted(sizes))
            except Rejected as error:
                self.rejected[topic] = self.rejected.get(topic, 0) + 1
                if self.rejected[topic] == 1:
                    log.warning('%s: a message cannot be shown: %s', topic, error)
        if items:
            self._came(items)

    def _items(self, topic: str, one: _Watched, taken: list[Taken], sizes: list[int]) -> list[LiveItem]:
        # By this machine's own clocks: when it came here, as what ``time.monotonic`` will be compared with.
        offset_ns = time.monotonic_ns() - time.time_ns()
        messages = [((message.received_ns + offset_ns) / 1e6, message.cdr) for message in taken]
        if not one.kind.is_bulk:
            return [series(topic, one.kind, one.type, self._types, messages)]
        at_ms, cdr = messages[-1]
        if one.kind.name == 'cloud':
            return list(clouds(topic, self._types, at_ms, cdr, sizes))
        return list(frames(topic, one.type, self._types, at_ms, cdr, sizes))
