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
"""How long the graph is looked at before it is concluded that it is not that of a Unitree."""
MIN_TOPICS: Final = 3
"""Topics with the names of the default sensors, in one namespace, that are those of a robot."""
_RELATIVE: Final = frozenset(topic for sensor in DEFAULT_SENSORS.values() for topic in sensor['topics'])
_SHARED: Final = ('/tf', '/tf_static')
MAX_FOUND: Final = 200
"""Sensors made of topics that no settings name: a subscription takes 100 KB, and who publishes decides how many there are."""


def is_unitree(node: Node, graph: Mapping[str, Collection[str]]) -> bool:
    """Whether something publishes what only a Unitree does: the default sensors are made for that robot."""
    topics = (topic for topic, types in graph.items() if any(map(is_of_unitree, types)))
    return any(is_of_unitree(each.type) for topic in topics for each in endpoints(node, topic))


def robots_in(topics: Collection[str], own: str) -> list[str]:
    """The namespaces below ``own`` that are each those of a robot: with several of the topics of the default sensors."""
    counts: Counter[str] = Counter()
    for topic in topics:
        for name in _RELATIVE:
            prefix = topic.removesuffix(f'/{name}')
            if prefix != topic and prefix.startswith(own) and prefix.strip('/') != own.strip('/'):
                counts[prefix] += 1
    return sorted(prefix for prefix, count in counts.items() if count >= MIN_TOPICS)


class FoundTopics:
    """Finds topics to log. New; ``poll`` at each look at the graph."""

    def __init__(self, node: Node, which: str, named: Collection[str]) -> None:
        """``which`` is ``capture.topics``; ``named`` are full names of the topics that sensors name."""
        self._node = node
        self._is_auto = which == AUTO
        self._named = frozenset(named)
        self._seen: set[str] = set()
        self._namespace = f'{node.get_namespace().rstrip("/")}/'
        self._since_s: float | None = None
        self._is_unitree = self._has_told = False
        self._count = 0
        self.not_logged: Mapping[str, str] = {}
        """Topic -> why it is not logged. Replaced as a whole."""

    def poll(self, sensors: Mapping[str, SensorSettings], now_s: float) -> Iterator[SensorSettings]:
        """The sensors to add. A topic is judged once: what its publishers are when it is first seen decides."""
        graph = {name: types for name, types in self._node.get_topic_names_and_types() if is_plain_name(name)}
        self._since_s = now_s if self._since_s is None else self._since_s
        self._is_unitree = self._is_auto and (self._is_unitree or is_unitree(self._node, graph))
        has_settled = now_s - self._since_s >= SETTLE_S
        if has_settled and not self._has_told:
            self._tell_of_robots(graph)
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
            why = self._why_not(topic, type_name, sensor, graph)
            if sensor is not None and not why:
                self._count += 1
                yield sensor
            else:
                left_out[topic] = why
                log.info('%s (%s) is not logged: %s', printable(topic), type_name, why)
        self.not_logged = left_out

    def _is_own(self, topic: str) -> bool:
        """Whether it is the robot's: below the namespace of the node, and tf, which several robots share."""
        return topic in _SHARED or topic.startswith(self._namespace)

    def _tell_of_robots(self, graph: Mapping[str, list[str]]) -> None:
        """Once: topics of robots in namespaces, of which this node logs none, or all under one name."""
        robots = robots_in(graph, self._node.get_namespace())
        is_mixed = len(robots) > 1 and not self._is_unitree
        if is_mixed or (robots and self._is_unitree and not any(map(self._node.count_publishers, self._named & graph.keys()))):
            self._has_told = True
            what = 'are logged under one name' if is_mixed else 'are not logged'
            launch = (
                f'ros2 launch shadowhound_data_logger sensor_logger.launch.py robots:={",".join(name[1:] for name in robots)}'
            )
            log.warning('the topics of %s %s: start a node for each robot, %s', ' and '.join(robots), what, launch)

    @property
    def _own_name(self) -> str:
        return str(self._node.get_fully_qualified_name())

    def _why_not(self, topic: str, type_name: str, sensor: SensorSettings | None, graph: Mapping[str, list[str]]) -> str:
        if why := not_logged(topic, type_name, graph):
            return why
        if sensor is None:
            return 'its name cannot be that of a sensor; name a sensor for it in the settings'
        if self._count >= MAX_FOUND:
            return f'{MAX_FOUND} topics that no settings name are logged already'
        return ''
