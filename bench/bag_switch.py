"""Program of a benchmark: calls the node's bag services. A request is a line ``{"do": "start"}``, stop or trigger."""

from __future__ import annotations

import json
import sys

import rclpy
from rclpy.node import Node
from std_srvs.srv import Trigger

WAIT_S = 30.0


def main() -> None:
    """Answers ``{"success": true, "message": "..."}``."""
    rclpy.init()
    node = Node('bag_switch', start_parameter_services=False, enable_rosout=False)
    names = {'start': 'bag/start', 'stop': 'bag/stop', 'trigger': 'event/trigger'}
    clients = {what: node.create_client(Trigger, f'/sensor_logger_node/{name}') for what, name in names.items()}
    for line in sys.stdin:
        client = clients[json.loads(line)['do']]
        answer = Trigger.Response(success=False, message='there is no such service')
        if client.wait_for_service(WAIT_S):
            future = client.call_async(Trigger.Request())
            rclpy.spin_until_future_complete(node, future, timeout_sec=WAIT_S)
            answer = future.result() or Trigger.Response(success=False, message='no answer')
        print(json.dumps({'success': answer.success, 'message': answer.message}), flush=True)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
