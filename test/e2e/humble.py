"""What Humble's rclpy lacks, taken away from a newer one: copied as sitecustomize.py to where a Python finds it at its start.

Source: rclpy 3.3 (Humble), src/rclpy/subscription.cpp, rclpy/qos_event.py, rclpy/node.py, and rmw 6.1, RMW_GID_STORAGE_SIZE.
"""

import os
import sys
from typing import Any

import rclpy.event_handler
from rclpy.impl import implementation_singleton
from rclpy.node import Node

rclpy_ = implementation_singleton.rclpy_implementation
take_message, publishers = rclpy_.Subscription.take_message, Node.get_publishers_info_by_topic


def take_without_numbers(subscription: Any, kind: Any, raw: bool) -> Any:
    """A message's info has its times only, with Cyclone DDS that of sending alone."""
    taken = take_message(subscription, kind, raw)
    return taken and (taken[0], {'source_timestamp': taken[1]['source_timestamp'], 'received_timestamp': 0})


def publishers_with_long_gids(node: Node, *arguments: Any) -> Any:
    """A gid has 24 bytes."""
    found = publishers(node, *arguments)
    for info in found:
        info.endpoint_gid = [*info.endpoint_gid, *[0] * (24 - len(info.endpoint_gid))]
    return found


class Implementation:
    """The events of a subscription have another name, and there are none where the middleware does not know their kind."""

    def __getattr__(self, name: str) -> Any:
        if name == 'EventHandle':
            raise AttributeError(name)
        if name == 'QoSEvent':
            return rclpy_.EventHandle if os.environ['MESSAGE_LOST_EVENTS'] == 'yes' else no_events
        return getattr(rclpy_, name)


def no_events(*_: Any) -> None:
    raise rclpy_.UnsupportedEventTypeError('not supported by this middleware')


rclpy_.Subscription.take_message = take_without_numbers
Node.get_publishers_info_by_topic = publishers_with_long_gids
for later in ('add_post_set_parameters_callback', 'add_pre_set_parameters_callback'):
    if hasattr(Node, later):
        delattr(Node, later)
implementation_singleton.rclpy_implementation = Implementation()
sys.modules['rclpy.qos_event'] = rclpy.event_handler
sys.modules['rclpy.event_handler'] = None  # type: ignore[assignment]  # importing it fails
