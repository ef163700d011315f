"""The node's ROS interface besides parameters: services, ``~/mission`` and ``/diagnostics``, all through ``commands``.

The ROS node is the logger's own, with direct requests, or the front's in another process, with requests through a socket.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, Final

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

DIAGNOSTICS: Final = '/diagnostics'
TRIGGERS: Final[Mapping[str, Mapping[str, str]]] = {
    '~/flush': {'do': 'flush'},
    '~/bag/start': {'do': 'bag start'},
    '~/bag/stop': {'do': 'bag stop'},
    '~/bag/split': {'do': 'bag split'},
    '~/event/trigger': {'do': 'event', 'by': 'service'},
}
"""Services of type std_srvs/srv/Trigger, and their requests."""
SWITCHES: Final[Mapping[str, tuple[Mapping[str, str], Mapping[str, str]]]] = {
    '~/pause': ({'do': 'resume'}, {'do': 'pause'}),
    '~/bag/pause': ({'do': 'bag resume'}, {'do': 'bag pause'}),
}
"""Services of type std_srvs/srv/SetBool, and their requests for false and true."""
Handler = Callable[[Mapping[str, Any]], Mapping[str, Any]]
"""Handles a request and returns its answer (``commands``)."""


class Interface:
    """The node's services, topics and diagnostics in ROS.

    New; open once; ``publish_diagnostics`` once per second; close once.

    A service answers when it is done, on the thread of the executor: others wait for up to ``commands.FLUSH_S``.
    ``~/mission`` publishes the active mission, latched, as JSON in a std_msgs/msg/String, empty without one:
    {"mission_id": "patrol_20251018_120000_1f2e3d4c", "run_id": null, "type": "patrol", "started": "2025-10-18T12:00:00.000000Z"}
    """

    def __init__(self, node: Node, handle: Handler) -> None:
        self._node = node
        self._handle = handle
        self._prefix = f'{node.get_namespace()}/sensor_logger: '.lstrip('/')
        self._services: list[Any] = []
        self._mission: Any = None
        self._diagnostics: Any = None

    def open(self) -> None:
        latched = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._mission = self._node.create_publisher(String, '~/mission', latched)
        self.publish_mission({})
        self._diagnostics = self._node.create_publisher(DiagnosticArray, DIAGNOSTICS, 1)
        for name, request in TRIGGERS.items():
            self._services.append(self._node.create_service(Trigger, name, self._triggered(request)))
        for name, (off, on) in SWITCHES.items():
            self._services.append(self._node.create_service(SetBool, name, self._switched(off, on)))

    def close(self) -> None:
        while self._services:
            self._node.destroy_service(self._services.pop())
        for publisher in (self._mission, self._diagnostics):
            if publisher is not None:
                self._node.destroy_publisher(publisher)
        self._mission = self._diagnostics = None

    def publish_mission(self, mission: Mapping[str, Any]) -> None:
        """Publish the active mission. From one thread."""
        self._mission.publish(String(data=json.dumps(mission) if mission else ''))

    def publish_diagnostics(self) -> None:
        """Create and send the message only if there are subscribers."""
        if self._diagnostics is None or not self._diagnostics.get_subscription_count():
            return
        answer = self._handle({'do': 'diagnostics'})
        if not answer['ok']:
            return
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [
            DiagnosticStatus(
                name=self._prefix + entry['name'], level=bytes([entry['level']]), message=entry['message'],
                hardware_id=answer['robot'], values=[KeyValue(key=key, value=value) for key, value in entry['values'].items()],
            )
            for entry in answer['diagnostics']
        ]  # fmt: skip
        self._diagnostics.publish(message)

    def _triggered(self, request: Mapping[str, str]) -> Callable[[Trigger.Request, Trigger.Response], Trigger.Response]:
        def on_call(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            return self._answer(request, response)

        return on_call

    def _switched(
        self, off: Mapping[str, str], on: Mapping[str, str]
    ) -> Callable[[SetBool.Request, SetBool.Response], SetBool.Response]:
        def on_call(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
            return self._answer(on if request.data else off, response)

        return on_call

    def _answer(self, request: Mapping[str, str], response: Any) -> Any:
        answer = self._handle(request)
        response.success = answer['ok']
        response.message = answer['message' if answer['ok'] else 'error']
        return response
