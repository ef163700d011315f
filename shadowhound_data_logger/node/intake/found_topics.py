"""Topics that no sensor names: which of them become sensors (``capture.topics``). Owned by the intake thread."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from typing import Final

from rclpy.node import Node

from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.core.keys import printable
from shadowhound_data_logger.core.options import AUTO, DEFAULT_SENSORS
from shadowhound_data_logger.core.type_rules import NOT_LOGGED, RULES, is_of_unitree, not_logged, sensor_for
from shadowhound_data_logger.node.intake.consumers import is_plain_name
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
    """Finds topics to log. New; ``poll`` at each check of the graph."""

    def __init__(self, node: Node, which: str, named: Collection[str]) -> None:
        """``which`` is ``capture.topics``; ``named`` are full names of the topics that sensors name."""
        self._node = node
        self._is_auto = which == AUTO
        self._named = frozenset(named)
        self._seen: set[str] = set()
        self._namespace = f'{node.get_namespace().rstrip("/")}/'
        self._since_s: float | None = None
        self._is_unitree = self._has_warned = False
        self._count = 0
        self.not_logged: Mapping[str, str] = {}
        """Topic -> why it is not logged. Replaced atomically."""

    def poll(self, sensors: Mapping[str, SensorSettings], now_s: float) -> Iterator[SensorSettings]:
        """The sensors to add. A topic is decided once, from its publishers when it is first seen."""
        graph = {name: types for name, types in self._node.get_topic_names_and_types() if is_plain_name(name)}
        self._since_s = now_s if self._since_s is None else self._since_s
        self._is_unitree = self._is_auto and (self._is_unitree or is_unitree(self._node, graph))
        has_settled = now_s - self._since_s >= SETTLE_S
        if has_settled and not self._has_warned:
            self._warn_of_robots(graph)
        if not has_settled:
            return
        left_out = dict(self.not_logged)
        for topic in sorted(filter(self._is_own, graph.keys() - self._named - self._seen - NOT_LOGGED)):
            publishers = [each for each in endpoints(self._node, topic) if not each.node or each.node != self._own_name]
            if not publishers:
                continue
            self._seen.add(topic)
            type_name = publishers[0].type
            if self._is_unitree and not (is_of_unitree(type_name) and type_name in RULES):
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

    @property
    def is_of_another_robot(self) -> bool:
        """Whether it has been looked for a Unitree, and none was found: the default sensors are for one."""
        return self._is_auto and not self._is_unitree and bool(self._seen)

    def _is_own(self, topic: str) -> bool:
        """Whether it belongs to this robot: below the namespace of the node, or tf, which several robots share."""
        return topic in _SHARED or topic.startswith(self._namespace)

    def _warn_of_robots(self, graph: Mapping[str, list[str]]) -> None:
        """Log once: topics of robots in namespaces that this node does not log, or logs under one name."""
        robots = robots_in(graph, self._node.get_namespace())
        is_mixed = len(robots) > 1 and not self._is_unitree
        if is_mixed or (robots and self._is_unitree and not any(map(self._node.count_publishers, self._named & graph.keys()))):
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
