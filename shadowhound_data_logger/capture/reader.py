"""One subscription, drained instead of called back (D1). The seam to what rclpy of each distribution offers."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Mapping
from functools import lru_cache
from importlib import import_module
from importlib.machinery import PathFinder
from importlib.util import find_spec
from typing import Any, Final

from rclpy.callback_groups import CallbackGroup
from rclpy.exceptions import InvalidTopicNameException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.type_support import NoTypeSupportImportedException, check_for_type_support
from rosidl_generator_py.import_type_support_impl import UnsupportedTypeSupport

from shadowhound_data_logger.capture import librcl
from shadowhound_data_logger.capture.endpoints import Endpoint, Plan
from shadowhound_data_logger.clock import MAX_AGE_NS
from shadowhound_data_logger.keys import printable
from shadowhound_data_logger.model import Taken

try:
    from rclpy.event_handler import SubscriptionEventCallbacks
except ImportError:  # Humble
    from rclpy.qos_event import SubscriptionEventCallbacks

MAX_TAKES: Final = 20_000
"""Takes of one drain: beyond it the other topics have their turn first."""


class PolledGroup(CallbackGroup):  # type: ignore[misc]  # rclpy has no types
    """Keeps what is in it out of every wait set.

    That holds for event handlers too: in rmw_fastrtps a reader's events and its data share one condition, so a wait set
    with an event of an undrained subscription returns at once, for ever (a whole core, measured on Kilted).
    """

    def add_entity(self, entity: Any) -> None:
        """Forget those that are destroyed, which rclpy does not, and know this one."""
        self.entities: set[Any] = {known for known in self.entities if known() is not None}
        super().add_entity(entity)

    def can_execute(self, entity: Any) -> bool:  # noqa: ARG002 - the base class's arguments
        return False

    def beginning_execution(self, entity: Any) -> bool:  # noqa: ARG002
        return False

    def ending_execution(self, entity: Any) -> None:
        pass


_TYPE: Final = re.compile(r'([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)', re.ASCII)
"""https://design.ros2.org/articles/interface_definition.html"""
MAX_PUBLISHERS: Final = 1000
"""Senders that a subscription knows by name at once."""
UNKNOWN_NODE: Final = '_NODE_NAME_UNKNOWN_'
"""What rmw calls the node of a publisher that is no ROS node, or of which it does not know yet."""


class TypeUnavailable(LookupError):
    """The message package of a type is not installed here."""


class SubscriptionRefused(RuntimeError):
    """The middleware makes no such subscription: this node has the topic under another type, or the name is none of ROS."""


def message_class(type_name: str) -> type:
    """The rclpy class of ``package/msg/Name``; raises TypeUnavailable.

    The name may be any neighbour's in the network: a package is imported only where it has messages, because to import one
    runs what is in it.
    """
    match = _TYPE.fullmatch(type_name)
    if match is None:
        raise TypeUnavailable(f'{type_name}: this is no name of a message')
    package, name = match.groups()
    if not _has_messages(package):
        raise TypeUnavailable(f'{type_name}: no package {package} with messages')
    try:
        found: type = getattr(import_module(f'{package}.msg'), name)
        check_for_type_support(found)
    except (ImportError, AttributeError, ValueError, TypeError, NoTypeSupportImportedException) as error:
        raise TypeUnavailable(f'{type_name}: {error}') from error
    except UnsupportedTypeSupport as error:  # no ImportError, though it is about one
        text = f'{type_name}: a library of {package} does not load: is its workspace sourced, and built for this Python?'
        raise TypeUnavailable(text) from error
    return found


def _has_messages(package: str) -> bool:
    """Looked up without running anything."""
    try:
        spec = find_spec(package)
    except (ImportError, ValueError):
        return False
    return spec is not None and PathFinder.find_spec(f'{package}.msg', spec.submodule_search_locations or ()) is not None


@lru_cache
def unavailable(type_name: str) -> str:
    """Why messages of ``package/msg/Name`` cannot be received here; empty where they can."""
    try:
        message_class(type_name)
    except TypeUnavailable as error:
        return f'its message package is not installed here ({error})'
    return ''


def endpoints(node: Node, topic: str) -> list[Endpoint]:
    """The publishers of a resolved topic as the graph knows them."""
    return [
        Endpoint(
            gid=bytes(info.endpoint_gid).hex(),
            type=printable(info.topic_type),
            reliable=info.qos_profile.reliability is ReliabilityPolicy.RELIABLE,
            transient_local=info.qos_profile.durability is DurabilityPolicy.TRANSIENT_LOCAL,
            node='' if info.node_name == UNKNOWN_NODE else printable(f'{info.node_namespace.rstrip("/")}/{info.node_name}'),
        )
        for info in node.get_publishers_info_by_topic(topic)
    ]


class Reader:
    """A live subscription. Created, drained and closed by the intake thread alone: a take after a destroy raises."""

    def __init__(self, node: Node, plan: Plan, group: PolledGroup) -> None:
        """Raises TypeUnavailable when the message package is missing, SubscriptionRefused when the middleware does not do it."""
        self.plan = plan
        self._node = node
        self._class = message_class(plan.type)
        self._names: dict[bytes, str] = {}
        profile = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=plan.depth,
            reliability=ReliabilityPolicy.RELIABLE if plan.reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if plan.transient_local else DurabilityPolicy.VOLATILE,
        )
        try:
            self._subscription = node.create_subscription(
                self._class, plan.topic, _never_called, profile, callback_group=group, raw=True,
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            )  # fmt: skip
        except (rclpy_implementation.RCLError, InvalidTopicNameException) as error:
            raise SubscriptionRefused(f'no subscription of type {plan.type} can be made ({error})') from error

    def matched(self) -> int:
        """Number of publishers it is matched with."""
        handle = self._subscription.handle
        with handle:
            if hasattr(handle, 'get_publisher_count'):
                return int(handle.get_publisher_count())
            return librcl.publisher_count(handle.pointer)  # Humble

    def drain(self) -> Iterator[Taken]:
        """Everything that waits, oldest first."""
        handle = self._subscription.handle
        with handle:
            take, message_type = handle.take_message, self._class
            for _ in range(MAX_TAKES):
                taken = take(message_type, True)
                if taken is None:
                    return
                cdr, info = taken
                yield Taken(
                    cdr, info['source_timestamp'], self._publisher(info), info.get('publication_sequence_number'),
                    info['received_timestamp'] or _came_ns(info['source_timestamp']),
                )  # fmt: skip

    def close(self) -> None:
        self._node.destroy_subscription(self._subscription)

    def _publisher(self, info: Mapping[str, Any]) -> str | None:
        """The sender's gid in hex; Jazzy and older do not give it."""
        gid = info.get('publisher_gid')
        if gid is None:
            return None
        data = gid['data']
        name = self._names.get(data)
        if name is None:
            if len(self._names) >= MAX_PUBLISHERS:
                self._names.clear()
            name = self._names[data] = bytes(data).hex()
        return name


def _came_ns(sent_ns: int) -> int:
    """When a message came whose middleware does not say (Humble's Cyclone DDS): when it was sent, if that was just now.

    Source: rmw_cyclonedds_cpp, rmw_node.cpp; received_timestamp is 0 before its version 2.2.1 (Jazzy).
    """
    now_ns = time.time_ns()
    return sent_ns if 0 <= now_ns - sent_ns <= MAX_AGE_NS else now_ns


def _never_called(_: bytes) -> None:
    raise AssertionError('a polled subscription was executed')
