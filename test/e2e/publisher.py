"""Program of a test: publishers controlled by standard input, one JSON object per line, each followed by ``done``."""

from __future__ import annotations

import json
import sys
import threading
import time
from functools import partial
from importlib import import_module
from typing import Any

import rclpy
from e2e.numbered import Numbered
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

MATCH_S = 120.0
ends: dict[str, threading.Event] = {}
"""Topics that are published evenly."""


def profile(order: dict[str, Any]) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=order['depth'],
        reliability=ReliabilityPolicy.RELIABLE if order['reliable'] else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if order['latched'] else DurabilityPolicy.VOLATILE,
    )


def message_class(type_name: str) -> Any:
    package, _, name = type_name.split('/')
    return getattr(import_module(f'{package}.msg'), name)


def obey(order: dict[str, Any], node: Node, publishers: dict[str, Any]) -> None:
    topic = order.get('topic', '')
    match order['do']:
        case 'create':
            publishers[topic] = node.create_publisher(message_class(order['type']), topic, profile(order))
        case 'matched':
            end = time.monotonic() + MATCH_S
            while publishers[topic].get_subscription_count() < order['count']:
                if time.monotonic() > end:
                    raise TimeoutError(f'no subscription to {topic}')
                time.sleep(0.005)
        case 'publish':
            due = time.monotonic()
            for message in order['messages']:
                time.sleep(max(0.0, due - time.monotonic()))
                due += order['period_s']
                publishers[topic].publish(bytes.fromhex(message))
        case 'again':
            message, due = bytes.fromhex(order['message']), time.monotonic()
            for _ in range(order['count']):
                time.sleep(max(0.0, due - time.monotonic()))
                due += order['period_s']
                publishers[topic].publish(message)
        case 'begin':
            stopped = ends[topic] = threading.Event()
            kind = message_class(order['type'])
            run = partial(publish_evenly, publishers[topic], kind, order['period_s'], order['size'], stopped)
            threading.Thread(target=run, daemon=True).start()
        case 'halt':
            ends.pop(topic).set()
        case 'destroy':
            node.destroy_publisher(publishers.pop(topic))


def publish_evenly(publisher: Any, kind: Any, period_s: float, size: int, stopped: threading.Event) -> None:
    """Numbers from 0 on, as text of a given size; a late message does not delay the next."""
    due = time.monotonic()
    number = 0
    while not stopped.wait(max(0.0, due - time.monotonic())):
        publisher.publish(kind(data=f'{number}'.ljust(size)))
        number += 1
        due += period_s


def answer(value: object = None) -> None:
    sys.stdout.write('done\n' if value is None else f'done {json.dumps(value)}\n')
    sys.stdout.flush()


def main() -> None:
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node('publisher', start_parameter_services=False, enable_rosout=False)
    publishers: dict[str, Any] = {}
    numbered = Numbered(lambda topic, message: publishers[topic].publish(message))
    for line in sys.stdin:
        order = json.loads(line)
        if order['do'] == 'end':
            break
        if numbered.takes(order):
            answer(numbered.obey(order))
        else:
            obey(order, node, publishers)
            answer()
    node.destroy_node()
    rclpy.try_shutdown()
    answer()


if __name__ == '__main__':
    main()
