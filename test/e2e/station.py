"""An operator that uses a running node through ROS: services, parameters and ``/diagnostics``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from e2e.processes import WAIT_S
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger

NODE = '/sensor_logger_node'
ASK_S = WAIT_S / 3
"""After this time a request is sent again. A client that the server has not discovered yet may never get a response: ROS services
are pairs of topics, and with rmw_fastrtps and rmw_cyclonedds a client cannot know that the server has discovered both.
"""


class Station:
    """Uses the environment of the node's processes, and the namespace of the intended node; close once."""

    def __init__(self, environ: Mapping[str, str], namespace: str = '') -> None:
        self._name = namespace + NODE
        self._context = Context()
        rclpy.init(context=self._context, domain_id=int(environ['ROS_DOMAIN_ID']))
        self.node = Node('station', context=self._context, start_parameter_services=False, enable_rosout=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._clients: dict[str, Any] = {}

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def spin(self) -> None:
        """Handle pending messages."""
        self._executor.spin_once(timeout_sec=0.1)

    def flush(self) -> str:
        """The response of ``~/flush``; it must succeed."""
        answer = self.call(Trigger, '/flush', Trigger.Request())
        assert answer.success, answer.message
        return str(answer.message)

    def pause(self, *, paused: bool) -> str:
        """The response of ``~/pause``; it must succeed."""
        answer = self.call(SetBool, '/pause', SetBool.Request(data=paused))
        assert answer.success, answer.message
        return str(answer.message)

    def bag(self, what: str) -> tuple[bool, str]:
        """The response of ``~/bag/start``, ``stop`` or ``split``."""
        answer = self.call(Trigger, f'/bag/{what}', Trigger.Request())
        return bool(answer.success), str(answer.message)

    def bag_pause(self, *, paused: bool) -> tuple[bool, str]:
        """The response of ``~/bag/pause``."""
        answer = self.call(SetBool, '/bag/pause', SetBool.Request(data=paused))
        return bool(answer.success), str(answer.message)

    def event(self) -> tuple[bool, str]:
        """The response of ``~/event/trigger``."""
        answer = self.call(Trigger, '/event/trigger', Trigger.Request())
        return bool(answer.success), str(answer.message)

    def set(self, **values: Any) -> str:
        """Set parameters (``sensor__name``) together; returns the reason if they were refused, otherwise an empty string."""
        parameters = [Parameter(name.replace('__', '.'), value=value).to_parameter_msg() for name, value in values.items()]
        answer = self.call(SetParametersAtomically, '/set_parameters_atomically',
                            SetParametersAtomically.Request(parameters=parameters))  # fmt: skip
        assert bool(answer.result.reason) is not answer.result.successful
        return str(answer.result.reason)

    def get(self, name: str) -> Any:
        (value,) = self.call(GetParameters, '/get_parameters', GetParameters.Request(names=[name])).values
        return Parameter.from_parameter_msg(ParameterMessage(name=name, value=value)).value

    def diagnostics(self) -> dict[str, Any]:
        """The next message on ``/diagnostics``: its entries by name."""
        received: list[DiagnosticArray] = []
        subscription = self.node.create_subscription(DiagnosticArray, '/diagnostics', received.append, 1)
        try:
            end_ns = self.node.get_clock().now().nanoseconds + round(WAIT_S * 1e9)
            while not received:
                self._executor.spin_once(timeout_sec=0.5)
                assert self.node.get_clock().now().nanoseconds < end_ns, 'there are no diagnostics'
        finally:
            self.node.destroy_subscription(subscription)
        return {entry.name: entry for entry in received[0].status}

    def answers(self, seconds: float) -> bool:
        """Whether ``~/flush`` responds in that time. A call may still be sent to a killed server in the graph."""
        return self._ask(Trigger, '/flush', Trigger.Request(), seconds) is not None

    def call(self, kind: Any, name: str, request: Any) -> Any:
        """The response of one of the node's services."""
        tries = round(WAIT_S / ASK_S)
        answer = next((answer for _ in range(tries) if (answer := self._ask(kind, name, request, ASK_S)) is not None), None)
        assert answer is not None, f'{self._name + name} does not answer'
        return answer

    def _ask(self, kind: Any, name: str, request: Any, seconds: float) -> Any:
        """None without a response in that time."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, self._name + name)
        client = self._clients[name]
        assert client.wait_for_service(WAIT_S), f'there is no {self._name + name}'
        future = client.call_async(request)
        self._executor.spin_until_future_complete(future, seconds)
        if not future.done():
            client.remove_pending_request(future)
        return future.result() if future.done() else None
