"""The subscriptions that a recording, or the ring of the events, needs besides the sensors', and which topics it wants.

Owned by the intake thread.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import ExitStack
from typing import Final

from rclpy.node import Node

from shadowhound_data_logger.bags.topics import Choice
from shadowhound_data_logger.capture.bag_tap import BagStream
from shadowhound_data_logger.capture.reader import PolledGroup
from shadowhound_data_logger.capture.source import Source
from shadowhound_data_logger.capture.stream import Shared, Tap
from shadowhound_data_logger.config import IntakeSettings, SensorSettings

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
        for topic in wanted.difference(shared, self._own):
            sensor = SensorSettings(name='bag', topics=(topic,), types=(self._types.get(topic, ''),))
            source = self._own[topic] = Source(self._node, sensor, self._settings, self._group, self._shared, BagStream)
            source.pause(now_s, paused=paused)
        for source in self._own.values():
            source.refresh(now_s)
        self._tap.topics = wanted.union(self._own) - (taken.keys() - shared)
        for topic in shared.intersection(self._own):
            self._own.pop(topic).close(now_s)

    def renew(self, now_s: float) -> None:
        """Before a ``refresh``: another recording follows without a pause, and is to begin with what is latched as well."""
        for topic in [topic for topic, source in self._own.items() if source.has_latched]:
            self._own.pop(topic).close(now_s)
        self._tap.topics = frozenset()

    def end(self, now_s: float) -> None:
        """Take what still waits; what comes from now on is recorded by nobody."""
        own, self._own = self._own, {}
        with ExitStack() as ending:
            for source in own.values():
                ending.callback(source.close, now_s)
        self._tap.topics = frozenset()
