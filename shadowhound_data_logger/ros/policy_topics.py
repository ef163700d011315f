"""Publishes the active policy to the robot's nodes, and receives reports that it misbehaves.

The node ``shadowhound_policy`` publishes ``~/policy`` (std_msgs/msg/String, latched): the id of the active version, such as
``go2_patrol@7#0123456789abcdef``, empty if there is none. It subscribes to ``~/health`` (std_msgs/msg/String): JSON such as
``{"policy": "go2_patrol@7#0123456789abcdef", "failures": 4, "p99_ms": 180.0}``. A version that violates the limits in its
manifest is rolled back. So a client in the robot's ROS network can remove a policy, but not activate one.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String

from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.core.untrusted import from_json
from shadowhound_data_logger.policies.folder import PolicyFolder
from shadowhound_data_logger.policies.running import judge
from shadowhound_data_logger.ros.shared_memory import PortGuard, dead_ports_avoided

log = logging.getLogger(__name__)

NODE: Final = 'shadowhound_policy'
LOOK_S: Final = 0.1
"""Interval of checking the active version."""
MAX_HEALTH_BYTES: Final = 4096
MAX_VALUE: Final = 1e9
"""Maximum of failures, and of ms."""
END_S: Final = 5.0


class PolicyTopics:
    """The two topics of a node. New; used on the thread of the node's executor."""

    def __init__(self, node: Node, folder: PolicyFolder) -> None:
        self._folder = folder
        self._active: str | None = None
        self.ignored = Counter[str]()
        """Ignored health messages by reason: ``size`` ``json`` ``values`` ``other`` (another version)."""
        latched = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._publisher = node.create_publisher(String, '~/policy', latched)
        self._subscription = node.create_subscription(String, '~/health', self._on_health, 10)
        self._timer = node.create_timer(LOOK_S, self.poll)
        self.poll()

    def poll(self) -> None:
        """Publish the active version if it changed."""
        now = self._folder.current() or ''
        if now != self._active:
            self._active = now
            self._publisher.publish(String(data=now))

    def _on_health(self, message: String) -> None:
        reason = self._ignored_reason(message.data)
        if reason:
            self.ignored[reason] += 1
            if str(self.ignored[reason]).strip('0') == '1':
                log.warning('%d messages about the health of a policy are ignored so far (%s)', self.ignored[reason], reason)

    def _ignored_reason(self, text: str) -> str:
        """Why a health message is ignored; empty if it was evaluated."""
        if len(text) > MAX_HEALTH_BYTES:
            return 'size'
        try:
            report = from_json(text.encode(), MAX_HEALTH_BYTES)
            name, failures, p99_ms = report['policy'], report.get('failures', 0), report.get('p99_ms', 0.0)
        except (ValueError, KeyError, TypeError, AttributeError):
            return 'json'
        if type(failures) is not int or type(p99_ms) not in {int, float}:
            return 'values'
        if not (0 <= failures <= MAX_VALUE and 0 <= p99_ms <= MAX_VALUE):
            return 'values'
        if not name or name != self._folder.current():
            return 'other'
        try:
            manifest = self._folder.check(name, self._folder.state.read(), hashes=False)
            if not judge(self._folder, name, manifest, failures, p99_ms):
                log.warning('%s is rolled back: %d failures, p99 %g ms; active: %s', name, failures, p99_ms,
                            self._folder.current() or 'none')  # fmt: skip
        except (DataLoggerError, OSError) as error:
            log.warning('the health of %s cannot be evaluated: %s', name, error)
        self.poll()
        return ''


@contextmanager
def serve_policy_topics(folder: PolicyFolder) -> Iterator[PolicyTopics]:
    """Serve the topics on a separate thread."""
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        with dead_ports_avoided(context.get_domain_id()):
            node = Node(NODE, context=context)
        guard = PortGuard()
        topics = PolicyTopics(node, folder)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)

        def spin() -> None:
            try:
                executor.spin()
            except ExternalShutdownException:
                return

        thread = threading.Thread(target=spin, name='policy-topics', daemon=True)
        thread.start()
        try:
            yield topics
        finally:
            executor.shutdown(END_S)
            thread.join(END_S)
            node.destroy_node()
            guard.close()
    finally:
        rclpy.try_shutdown(context=context)
