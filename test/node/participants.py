"""Programs that take part in ROS, in the process of the test: each is a separate DDS participant."""

from __future__ import annotations

import time
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from shadowhound_data_logger.ros.shared_memory import dead_ports_avoided


class Participant:
    """A node with publishers, one a topic; ``end`` leaves as a program does that ends. A participant has one type for a topic.

    Where no topic is said, its only publisher is meant.
    """

    def __init__(self, name: str, domain: int) -> None:
        self.name = f'/{name}'
        self._context = rclpy.Context()
        with dead_ports_avoided(domain):  # as each of our programs: other tests kill nodes meanwhile
            rclpy.init(args=[], context=self._context, domain_id=domain)
            self.node = Node(name, context=self._context, start_parameter_services=False, enable_rosout=False)
        self._publishers: dict[str, Any] = {}

    def create(self, message_class: type, topic: str, *, reliable: bool = True, latched: bool = False) -> None:
        profile = QoSProfile(depth=1000)
        profile.reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        profile.durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        self._publishers[topic] = self.node.create_publisher(message_class, topic, profile)

    def matched(self, topic: str = '') -> int:
        """How many subscriptions it is matched with."""
        return int(self._of(topic).get_subscription_count())

    def publish(self, *messages: Any, topic: str = '', period_s: float = 0.0) -> None:
        """Messages, serialized or not; returns when the last one is out."""
        publisher, due_s = self._of(topic), time.monotonic()
        for message in messages:
            time.sleep(max(0.0, due_s - time.monotonic()))
            due_s += period_s
            publisher.publish(message)

    def leave(self, topic: str = '') -> None:
        """Publish it no more."""
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
