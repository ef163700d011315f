"""Topics that no sensor names: which of them become sensors (``capture.topics``). Owned by the intake thread."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from math import inf
from typing import Final

from rclpy.node import Node

from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.core.keys import printable
from shadowhound_data_logger.core.options import AUTO, DEFAULT_SENSORS
from shadowhound_data_logger.core.type_rules import NOT_LOGGED, RULES, is_of_unitree, not_logged, sensor_for
from shadowhound_data_logger.node.intake.consumers import is_plain_name
from shadowhound_data_logger.ros.endpoints import Endpoint, alternatives
from shadowhound_data_logger.ros.reader import endpoints

log = logging.getLogger(__name__)

SETTLE_S: Final = 3.0
"""How long to watch the graph before concluding that it is not a Unitree's."""
MIN_TOPICS: Final = 3
"""Minimum number of topics named as in the default sensors, in one namespace, that identify a robot."""
_RELATIVE: Final = frozenset(topic for sensor in DEFAULT_SENSORS.values() for topic in sensor['topics'])
_SHARED: Final = ('/tf', '/tf_static')
MAX_FOUND: Final = 200
"""Maximum sensors for topics that the settings do not name: a subscription takes 100 KB, and publishers decide how many exist."""


def is_unitree(node: Node, graph: Mapping[str, Collection[str]]) -> bool:
    """Whether a type that only a Unitree publishes is in the graph: the default sensors are for that robot."""
    topics = (topic for topic, types in graph.items() if any(map(is_of_unitree, types)))
    return any(is_of_unitree(each.type) for topic in topics for each in endpoints(node, topic))


def robots_in(topics: Collection[str], own: str) -> list[str]:
    """The namespaces below ``own`` that each belong to a robot: with several topics of the default sensors."""
    counts: Counter[str] = Counter()
    for topic in topics:
        for name in _RELATIVE:
            prefix = topic.removesuffix(f'/{name}')
            if prefix != topic and prefix.startswith(own) and prefix.strip('/') != own.strip('/'):
                counts[prefix] += 1
    return sorted(prefix for prefix, count in counts.items() if count >= MIN_TOPICS)


class FoundTopics:
    """Finds topics to log. New; ``poll`` at each check of the graph.

    The default sensors are for a Unitree. On another robot those that its topics do not need are removed, and added again when
    one of their topics is published.
    """

    def __init__(self, node: Node, which: str, sensors: Sequence[SensorSettings], assumed: Collection[str]) -> None:
        """``which`` is ``capture.topics``; ``sensors`` are those of the settings, which do not mention the ``assumed`` ones."""
        self._node = node
        self._is_auto = which == AUTO
        self._topics = {sensor.name: [str(node.resolve_topic_name(topic)) for topic in sensor.topics] for sensor in sensors}
        self._assumed = assumed
        self._removed: dict[str, SensorSettings] = {}
        self._seen: set[str] = set()
        self._namespace = f'{node.get_namespace().rstrip("/")}/'
        self._since_s = self._published_since_s = inf
        self._is_unitree = self._is_of_another = self._has_warned = self._has_removed = False
        self._count = 0
        self.not_logged: Mapping[str, str] = {}
        """Topic -> why it is not logged. Replaced atomically."""

    def poll(self, sensors: Mapping[str, SensorSettings], now_s: float) -> Iterator[SensorSettings]:
        """The sensors to add. A topic is decided once, from its publishers when it is first seen."""
        graph = {name: types for name, types in self._node.get_topic_names_and_types() if is_plain_name(name)}
        self._since_s = min(self._since_s, now_s)
        self._is_unitree = self._is_unitree or is_unitree(self._node, graph)
        if self._published_since_s == inf and any(map(self._publishers_of, self._own(graph))):
            self._published_since_s = now_s
        self._is_of_another = not self._is_unitree and now_s - self._published_since_s >= SETTLE_S
        yield from self._returning(sensors, graph)
        has_settled = now_s - self._since_s >= SETTLE_S
        if has_settled and not self._has_warned:
            self._warn_of_robots(graph)
        if not has_settled:
            return
        left_out = dict(self.not_logged)
        for topic in sorted(self._own(graph).difference(self._named, self._seen)):
            publishers = self._publishers_of(topic)
            if not publishers:
                continue
            self._seen.add(topic)
            type_name = publishers[0].type
            if self._has_default_sensors and not (is_of_unitree(type_name) and type_name in RULES):
                continue
            latched = all(each.transient_local for each in publishers)
            sensor = sensor_for(topic, type_name, sensors.keys(), is_latched=latched)
            why = self._reason_skipped(topic, type_name, sensor, graph)
            if sensor is not None and not why:
                self._count += 1
                yield sensor
            else:
                left_out[topic] = why
                log.info('%s (%s) is not logged: %s', printable(topic), type_name, why)
        self.not_logged = left_out

    def may_remove(self, sensor: SensorSettings) -> bool:
        """Whether the sensor is only there because the robot could have been a Unitree."""
        return self._is_of_another and sensor.name in self._assumed and sensor.topics == DEFAULT_SENSORS[sensor.name]['topics']

    def remove(self, sensors: Sequence[SensorSettings]) -> None:
        """These sensors were removed."""
        self._removed.update((sensor.name, sensor) for sensor in sensors)
        if not self._has_removed:
            self._has_removed = True
            topics = ' '.join(topic for sensor in sensors if sensor.enabled for topic in self._topics[sensor.name])
            log.info('this is not a Unitree: until they are published, %s are not subscribed to', topics)

    def update(self, sensors: Iterable[SensorSettings]) -> None:
        """Apply other settings to sensors that are removed."""
        self._removed.update((sensor.name, sensor) for sensor in sensors if sensor.name in self._removed)

    def _returning(self, sensors: Mapping[str, SensorSettings], graph: Mapping[str, Collection[str]]) -> Iterator[SensorSettings]:
        """The removed sensors to add again."""
        for name, sensor in tuple(self._removed.items()):
            if name not in sensors and (self._is_unitree or (sensor.enabled and self._is_published(sensor, graph))):
                del self._removed[name]
                yield sensor

    def _is_published(self, sensor: SensorSettings, graph: Mapping[str, Collection[str]]) -> bool:
        """Whether one of its topics has a publisher of the type that it expects."""
        pairs = zip(self._topics[sensor.name], sensor.types, strict=True)
        return any(
            publisher.type in alternatives(types)
            for topic, types in pairs if topic in graph and topic not in self._seen
            for publisher in self._publishers_of(topic)
        )  # fmt: skip

    @property
    def _named(self) -> frozenset[str]:
        """The topics of sensors of the settings, without those that are removed."""
        return frozenset(topic for name, topics in self._topics.items() if name not in self._removed for topic in topics)

    @property
    def _has_default_sensors(self) -> bool:
        """Whether the default sensors are for this robot, and what is logged of it."""
        return self._is_auto and self._is_unitree

    def _own(self, graph: Mapping[str, Collection[str]]) -> set[str]:
        """The topics of this robot."""
        return {topic for topic in graph.keys() - NOT_LOGGED if self._is_own(topic)}

    def _publishers_of(self, topic: str) -> list[Endpoint]:
        """Without this node itself."""
        return [each for each in endpoints(self._node, topic) if not each.node or each.node != self._own_name]

    def _is_own(self, topic: str) -> bool:
        """Whether it belongs to this robot: below the namespace of the node, or tf, which several robots share."""
        return topic in _SHARED or topic.startswith(self._namespace)

    def _warn_of_robots(self, graph: Mapping[str, list[str]]) -> None:
        """Log once: topics of robots in namespaces that this node does not log, or logs under one name."""
        robots = robots_in(graph, self._node.get_namespace())
        is_mixed = len(robots) > 1 and not self._has_default_sensors
        is_elsewhere = self._has_default_sensors and not any(map(self._node.count_publishers, self._named & graph.keys()))
        if is_mixed or (robots and is_elsewhere):
            self._has_warned = True
            what = 'are logged under one name' if is_mixed else 'are not logged'
            launch = (
                f'ros2 launch shadowhound_data_logger sensor_logger.launch.py robots:={",".join(name[1:] for name in robots)}'
            )
            log.warning('the topics of %s %s: start a node for each robot, %s', ' and '.join(robots), what, launch)

    @property
    def _own_name(self) -> str:
        return str(self._node.get_fully_qualified_name())

    def _reason_skipped(self, topic: str, type_name: str, sensor: SensorSettings | None, graph: Mapping[str, list[str]]) -> str:
        if why := not_logged(topic, type_name, graph):
            return why
        if sensor is None:
            return 'its name is not valid for a sensor; name a sensor for it in the settings'
        if self._count >= MAX_FOUND:
            return f'{MAX_FOUND} topics that no settings name are logged already'
        return ''
