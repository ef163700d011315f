"""Subscriptions to topics that a consumer wants and no sensor has. Owned by the intake thread."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from typing import Final

from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.core.keys import printable
from shadowhound_data_logger.node.intake.consumers import Consumer
from shadowhound_data_logger.node.intake.subscriber import Dependencies, Subscriber

log = logging.getLogger(__name__)

MAX_FOUND: Final = 200
"""Maximum number of concurrent subscriptions to topics matched only by an expression: each takes some 100 KB, and publishers
decide how many topics exist. Topics that the settings name have no limit.
"""
MAX_EVER: Final = 1000
"""The maximum over the life of the node, because middleware and accounts keep some state for each name."""
GONE_S: Final = 30.0
"""How long such a topic must have no publisher before its subscription is closed."""
STANDARD: Final = {
    '/rosout': 'rcl_interfaces/msg/Log',
    '/parameter_events': 'rcl_interfaces/msg/ParameterEvent',
    '/clock': 'rosgraph_msgs/msg/Clock',
    '/tf': 'tf2_msgs/msg/TFMessage',
    '/tf_static': 'tf2_msgs/msg/TFMessage',
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
}
"""Types of ROS's own topics; this node publishes some of them, and a publisher of another type is wrong."""


class ExtraTopics:
    """Subscribes to the topics that one consumer wants and no sensor has.

    New; ``refresh`` while it listens, ``end`` afterwards.
    """

    def __init__(self, shared: Dependencies, consumers: Sequence[Consumer], types: Mapping[str, str]) -> None:
        """The first of ``consumers`` is the consumer; topics subscribed to here are also passed to the others.

        ``types`` are those that sensors name for topics, also for topics that they do not use at present.
        """
        assert consumers[0].wanted_topics is not None
        self.consumer, self._choice = consumers[0], consumers[0].wanted_topics
        self._consumers = consumers
        self._shared = shared
        self._node = shared.node
        self._types = {**STANDARD, **types}
        self._own: dict[str, Subscriber] = {}
        self._free: frozenset[str] = frozenset()
        self._ever: set[str] = set()
        self._unpublished_since_s: dict[str, float] = {}

    @property
    def own(self) -> Collection[Subscriber]:
        """Subscribers to topics that no sensor has."""
        return self._own.values()

    def refresh(self, taken: Mapping[str, bool], sensors: Collection[str], now_s: float, *, paused: bool) -> None:
        """Follow the graph, and the topics that are subscribed to elsewhere (True: latched), without losing messages.

        ``sensors`` are those among them that the consumer has by default. A consumer that wants latched messages has separate
        subscriptions for latched topics.
        """
        graph = [name for name, _ in self._node.get_topic_names_and_types()] if self._choice.needs_graph else []
        wanted = self._choice.wanted(sensors, graph)
        latched = {topic for topic, is_latched in taken.items() if is_latched and self.consumer.wants_latched}
        shared = taken.keys() - latched
        self._free = frozenset(sensors)
        for topic in self._admitted(wanted.difference(shared, self._own)):
            sensor = SensorSettings(name='bag', topics=(topic,), types=(self._types.get(topic, ''),))
            self._own[topic] = Subscriber(self._shared, sensor, self._consumers)
            self._own[topic].paused = paused
        for subscriber in self._own.values():
            subscriber.refresh(now_s)
        self._drop_abandoned(now_s)
        self.consumer.topics = frozenset(self._own).union(wanted & taken.keys()) - latched
        for topic in shared & self._own.keys():
            self._own.pop(topic).close(now_s)

    def _is_named(self, topic: str) -> bool:
        """Whether the settings of the consumer or of a sensor name the topic."""
        return self._choice.names(topic) or topic in self._free

    def _admitted(self, wanted: frozenset[str]) -> Iterator[str]:
        """The topics to subscribe to: all that are named, and others with a publisher up to the limit."""
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
        if left_out and not self.consumer.left_out:
            text = (
                '%d topics (%s, ...) are not recorded: besides those in the settings, at most %d are at a time, and %d in total'
            )
            log.warning(text, left_out, printable(found[-1]), MAX_FOUND, MAX_EVER)
        self.consumer.left_out = left_out

    def _drop_abandoned(self, now_s: float) -> None:
        """Close the subscriptions of topics that have had no publisher for a while, unless the settings name them."""
        for topic, subscriber in tuple(self._own.items()):
            if subscriber.status().publishers or self._is_named(topic):
                self._unpublished_since_s.pop(topic, None)
            elif now_s - self._unpublished_since_s.setdefault(topic, now_s) > GONE_S:
                del self._unpublished_since_s[topic]
                self._own.pop(topic).close(now_s)

    def renew(self, now_s: float) -> None:
        """Call before ``refresh`` when something new starts for the consumer, so that it receives latched messages again."""
        for topic in [topic for topic, subscriber in self._own.items() if subscriber.has_latched]:
            self._own.pop(topic).close(now_s)
        self.consumer.topics = frozenset()

    def end(self, now_s: float) -> None:
        """Take what still waits; later messages are not passed to the consumer."""
        own, self._own = self._own, {}
        self._unpublished_since_s.clear()
        self.consumer.left_out = 0
        with ExitStack() as ending:
            for subscriber in own.values():
                ending.callback(subscriber.close, now_s)
        self.consumer.topics = frozenset()
