"""Subscriptions that are created before the rest of the node is loaded, so that a start loses as little as possible.

Loading the node and recovering its spool takes about a second. The middleware keeps what these subscriptions receive during that
time (2 s of it, ``ros.endpoints.STALL_S``), and the intake takes it from there.
"""

from __future__ import annotations

import time
from collections.abc import Iterable

from rclpy.node import Node

from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.ros.endpoints import HistoryDepth, alternatives, plans
from shadowhound_data_logger.ros.reader import PolledGroup, Reader, SubscriptionRefused, TypeUnavailable, installed_class


class EarlyReaders:
    """Two subscriptions for each sensor whose first topic has one type; together they match any publisher of it.

    Lifecycle: made by the main thread, then owned by the intake thread: ``adopt`` any number, ``close`` once.
    """

    def __init__(self, node: Node, sensors: Iterable[SensorSettings]) -> None:
        """Skips types that are not installed and subscriptions that the middleware rejects: the intake reports them."""
        self.group = PolledGroup()
        self._readers: dict[tuple[str, str], list[Reader]] = {}
        for sensor in sensors:
            if sensor.enabled and sensor.types and len(alternatives(sensor.types[0])) == 1 and sensor.types[0]:
                topic, name = node.resolve_topic_name(sensor.topics[0]), sensor.types[0]
                try:
                    installed_class(name)  # to make another one takes half a second, in which the others would miss messages
                    for plan in plans(topic, name, (), HistoryDepth(name).depth):
                        reader = Reader(node, plan, self.group)
                        reader.drained_s = time.monotonic()
                        self._readers.setdefault((topic, name), []).append(reader)
                except (SubscriptionRefused, TypeUnavailable):
                    continue

    def adopt(self, topic: str, type_name: str) -> list[Reader]:
        """The subscriptions of a topic with this type, which the caller closes; empty on the second call."""
        return self._readers.pop((topic, type_name), [])

    def close(self) -> None:
        """Close those that were not adopted, because their sensors use another topic or type. Idempotent."""
        while self._readers:
            for reader in self._readers.popitem()[1]:
                reader.close()
