"""The subscriptions that a recording, or the ring of the events, needs besides the sensors', and which topics it wants.

Owned by the intake thread.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack
from typing import Final

from rclpy.node import Node

from shadowhound_data_logger.bags.topics import Choice
from shadowhound_data_logger.capture.bag_tap import BagStream
from shadowhound_data_logger.capture.reader import PolledGroup
from shadowhound_data_logger.capture.source import Source
from shadowhound_data_logger.capture.stream import Shared, Tap
from shadowhound_data_logger.config import IntakeSettings, SensorSettings
from shadowhound_data_logger.keys import printable

log = logging.getLogger(__name__)

MAX_FOUND: Final = 200
"""Topics that only an expression names and that are listened to at once: a subscription takes some 100 KB of memory, and who
publishes decides how many topics there are. Topics that the settings name have no limit."""
MAX_EVER: Final = 1000
"""The same over the life of the node, whose middleware and accounts keep a little of each name."""
GONE_S: Final = 30.0
"""How long such a topic must be without a publisher before its subscription goes."""
STANDARD: Final = {
    '/rosout': 'rcl_interfaces/msg/Log',
    '/parameter_events': 'rcl_interfaces/msg/ParameterEvent',
    '/clock': 'rosgraph_msgs/msg/Clock',
    '/tf': 'tf2_msgs/msg/TFMessage',
    '/tf_static': 'tf2_msgs/msg/TFMessage',
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
}
"""Types of topics that ROS itself defines, some of which this node publishes: whoever publishes another type there is wrong."""


class BagSources:
    """New; ``refresh`` while a recording goes on, ``end`` after it."""

    def __init__(self, node: Node, choice: Choice, tap: Tap, settings: IntakeSettings, group: PolledGroup,
                 shared: Shared, types: Mapping[str, str]) -> None:  # fmt: skip
        """``tap`` is told its topics; what has a subscription of its own here goes to that of ``shared``.

        ``types`` are those that sensors name for topics, also for such as they do not take now.
        """
        self._node = node
        self._settings = settings
        self._group = group
        self._shared = shared
        self._choice = choice
        self._tap = tap
        self._types = {**STANDARD, **types}
        self._own: dict[str, Source] = {}
        self._free: frozenset[str] = frozenset()
        self._ever: set[str] = set()
        self._alone_since_s: dict[str, float] = {}
        self.left_out = 0
        """Topics that an expression names and that are not listened to, because there are too many of them."""

    @property
    def own(self) -> Collection[Source]:
        """Those of topics that no sensor takes."""
        return self._own.values()

    def refresh(self, taken: Mapping[str, bool], sensors: Collection[str], now_s: float, *, paused: bool) -> None:
        """Follow the graph and the topics that are taken by others now (True: latched); a topic changes hands without a loss.

        ``sensors`` are those among them that a bag has unless its settings name some. A latched topic is subscribed to anew,
        so that a bag begins with what was sent before it.
        """
        graph = [name for name, _ in self._node.get_topic_names_and_types()] if self._choice.asks_graph else []
        wanted = self._choice.wanted(sensors, graph)
        shared = {topic for topic, is_latched in taken.items() if not is_latched}
        self._free = frozenset(sensors)
        for topic in self._admitted(wanted.difference(shared, self._own)):
            sensor = SensorSettings(name='bag', topics=(topic,), types=(self._types.get(topic, ''),))
            source = self._own[topic] = Source(self._node, sensor, self._settings, self._group, self._shared, BagStream)
            source.pause(now_s, paused=paused)
        for source in self._own.values():
            source.refresh(now_s)
        self._drop_abandoned(now_s)
        self._tap.topics = frozenset(self._own).union(wanted & taken.keys()) - (taken.keys() - shared)
        for topic in shared.intersection(self._own):
            self._own.pop(topic).close(now_s)

    def _is_named(self, topic: str) -> bool:
        """By the settings: of a bag, or of a sensor."""
        return self._choice.names(topic) or topic in self._free

    def _admitted(self, wanted: frozenset[str]) -> Iterator[str]:
        """Those to listen to: all that are named, of the others those that somebody publishes, as far as there is room."""
        named = [topic for topic in wanted if self._is_named(topic)]
        yield from named
        found = sorted(topic for topic in wanted.difference(named) if self._node.count_publishers(topic))
        room = MAX_FOUND - sum(not self._is_named(topic) for topic in self._own)
        new = MAX_EVER - len(self._ever)
        left_out = 0
        for topic in found:
            if room > 0 and (topic in self._ever or new > 0):
                room, new = room - 1, new - (topic not in self._ever)
                self._ever.add(topic)
                yield topic
            else:
                left_out += 1
        if left_out and not self.left_out:
            text = '%d topics (%s, ...) are not recorded: beside those that the settings name at most %d are, and %d in all'
            log.warning(text, left_out, printable(found[-1]), MAX_FOUND, MAX_EVER)
        self.left_out = left_out

    def _drop_abandoned(self, now_s: float) -> None:
        """End the subscriptions of topics that nobody has published for a while, unless the settings name them."""
        for topic, source in tuple(self._own.items()):
            if source.status().publishers or self._is_named(topic):
                self._alone_since_s.pop(topic, None)
            elif now_s - self._alone_since_s.setdefault(topic, now_s) > GONE_S:
                del self._alone_since_s[topic]
                self._own.pop(topic).close(now_s)

    def renew(self, now_s: float) -> None:
        """Before a ``refresh``: another recording follows without a pause, and is to begin with what is latched as well."""
        for topic in [topic for topic, source in self._own.items() if source.has_latched]:
            self._own.pop(topic).close(now_s)
        self._tap.topics = frozenset()

    def end(self, now_s: float) -> None:
        """Take what still waits; what comes from now on is recorded by nobody."""
        own, self._own = self._own, {}
        self._alone_since_s.clear()
        self.left_out = 0
        with ExitStack() as ending:
            for source in own.values():
                ending.callback(source.close, now_s)
        self._tap.topics = frozenset()
