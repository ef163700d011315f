"""A publisher of messages of all kinds, or a raw subscriber to them: ``raw_types.py publish|installed|made COUNT``.

``installed`` subscribes with the classes of the message packages, ``made`` with those that are made from the definitions. Each
prints one JSON object: by type the hashes of the endpoints in the graph, or the messages in hex.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import rclpy
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message

from shadowhound_data_logger.ros import type_support
from shadowhound_data_logger.ros.reader import PolledGroup, SubscriptionEventCallbacks, installed_class
from shadowhound_data_logger.ros.shared_memory import dead_ports_avoided

KINDS = 'Arrays', 'BasicTypes', 'BoundedSequences', 'Empty', 'MultiNested', 'Nested', 'Strings', 'UnboundedSequences', 'WStrings'
TYPES = [
    'diagnostic_msgs/msg/DiagnosticArray', 'nav_msgs/msg/Odometry', 'rcl_interfaces/msg/ParameterEvent',
    'sensor_msgs/msg/PointCloud2',
    *(f'test_msgs/msg/{kind}' for kind in KINDS if find_spec('test_msgs')),
]  # fmt: skip
QOS = QoSProfile(depth=1000)
PATIENCE_S = 60.0


def topic_of(type_name: str) -> str:
    return '/' + type_name.rpartition('/')[2].lower()


def messages(type_name: str) -> list[bytes]:
    """Of the default values, and of those that rosidl tests with."""
    default = installed_class(type_name)()
    if not type_name.startswith('test_msgs'):
        return [bytes(serialize_message(default))] * 2
    from test_msgs import message_fixtures

    kind = type_name.rpartition('/')[2]
    name = ''.join(f'_{letter.lower()}' if letter.isupper() else letter for letter in kind)
    fixtures = getattr(message_fixtures, f'get_msg{name}'.replace('_w_strings', '_wstrings'))()
    return [bytes(serialize_message(each)) for each in (*fixtures, default)]


def until(is_done: Callable[[], object], what: str) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not is_done():
        if time.monotonic() > end_s:
            sys.exit(f'timeout: {what}')
        time.sleep(0.01)


def publish(node: Any, subscribers: int) -> dict[str, list[str]]:
    """Until the standard input ends, when all others have what they wait for."""
    sent = {name: messages(name) for name in TYPES}
    publishers = {name: node.create_publisher(installed_class(name), topic_of(name), QOS) for name in TYPES}
    until(lambda: all(each.get_subscription_count() == subscribers for each in publishers.values()), 'all are matched')
    found: dict[str, list[str]] = {}

    def has_graph() -> bool:
        for name in TYPES:
            infos = *node.get_publishers_info_by_topic(topic_of(name)), *node.get_subscriptions_info_by_topic(topic_of(name))
            found[name] = [str(getattr(each, 'topic_type_hash', '')) for each in infos]
        return all(len(each) == subscribers + 1 for each in found.values())

    until(has_graph, 'the graph has all')
    for name, publisher in publishers.items():
        for message in sent[name]:
            publisher.publish(message)
    sys.stdin.read()
    return found


def take(node: Any, class_of: Callable[[str], type]) -> dict[str, list[str]]:
    silent = SubscriptionEventCallbacks(use_default_callbacks=False)
    classes = {name: class_of(name) for name in TYPES}
    subscriptions = {
        name: node.create_subscription(kind, topic_of(name), print, QOS, callback_group=PolledGroup(), raw=True,
                                       event_callbacks=silent)
        for name, kind in classes.items()
    }  # fmt: skip
    taken: dict[str, list[str]] = {name: [] for name in TYPES}
    counts = {name: len(messages(name)) for name in TYPES}

    def has_all() -> bool:
        for name, subscription in subscriptions.items():
            with subscription.handle:
                while (one := subscription.handle.take_message(classes[name], True)) is not None:
                    taken[name].append(one[0].hex())
        return {name: len(each) for name, each in taken.items()} == counts

    until(has_all, 'all arrive')
    for subscription in subscriptions.values():
        node.destroy_subscription(subscription)
    return taken


def main() -> None:
    rclpy.init()
    with dead_ports_avoided(rclpy.utilities.get_default_context().get_domain_id()):
        node = rclpy.create_node(sys.argv[1])
    if sys.argv[1] == 'publish':
        result = publish(node, int(sys.argv[2]))
    else:
        result = take(node, installed_class if sys.argv[1] == 'installed' else type_support.make)
    node.destroy_node()
    rclpy.shutdown()
    json.dump(result, sys.stdout)


if __name__ == '__main__':
    main()
