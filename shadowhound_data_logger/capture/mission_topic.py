"""``~/mission``: which mission is active, latched, as JSON in a std_msgs/msg/String; empty while there is none.

{"mission_id": "patrol_20251018_120000_1f2e3d4c", "run_id": null, "type": "patrol", "started": "2025-10-18T12:00:00.000000Z"}
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String


class MissionTopic:
    """New; open once; close once. ``tell`` from one thread."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher: Any = None

    def open(self) -> None:
        profile = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._publisher = self._node.create_publisher(String, '~/mission', profile)
        self.tell({})

    def tell(self, mission: Mapping[str, Any]) -> None:
        """Publish what is active now."""
        self._publisher.publish(String(data=json.dumps(mission) if mission else ''))

    def close(self) -> None:
        if self._publisher is not None:
            self._node.destroy_publisher(self._publisher)
            self._publisher = None
