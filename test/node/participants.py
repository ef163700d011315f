"""ROS participants in the test's process: each is a separate DDS participant."""

from __future__ import annotations

import time
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from shadowhound_data_logger.ros.shared_memory import dead_ports_avoided


class Participant:
    """A node with one publisher per topic; ``end`` leaves as a program does when it exits. A participant has one type per topic.

    Without a topic argument its only publisher is used.
    """

    def __init__(self, name: str, domain: int) -> None:
        self.name = f'/{name}'
        self._context = rclpy.Context()
        with dead_ports_avoided(domain):  # as in each of our programs: other tests kill nodes at the same time
            rclpy.init(args=[], context=self._context, domain_id=domain)
            self.node = Node(name, context=self._context, start_parameter_services=False, enable_rosout=False)
        self._publishers: dict[str, Any] = {}

    def create(self, message_class: type, topic: str, *, reliable: bool = True, latched: bool = False) -> None:
        profile = QoSProfile(depth=1000)
        profile.reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        profile.durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        self._publishers[topic] = self.node.create_publisher(message_class, topic, profile)

    def matched(self, topic: str = '') -> int:
        """The number of matched subscriptions."""
        return int(self._of(topic).get_subscription_count())

    def publish(self, *messages: Any, topic: str = '', period_s: float = 0.0) -> None:
        """Publish messages, serialized or not; returns when the last one is sent."""
        publisher, due_s = self._of(topic), time.monotonic()
        for message in messages:
            time.sleep(max(0.0, due_s - time.monotonic()))
            due_s += period_s
            publisher.publish(message)

    def leave(self, topic: str = '') -> None:
        """Destroy its publisher."""
        publisher = self._of(topic)
        self.node.destroy_publisher(publisher)
        self._publishers = {name: other for name, other in self._publishers.items() if other is not publisher}

    def end(self) -> None:
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def _of(self, topic: str) -> Any:
        if topic:
            return self._publishers[topic]
        (publisher,) = self._publishers.values()
        return publisher
