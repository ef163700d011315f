"""A node that observes topics. The only module of the doctor that loads rclpy.

It subscribes as the logger does, takes messages without decoding them, and publishes nothing.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Final

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSCompatibility, qos_check_compatible

from shadowhound_data_logger.core.type_rules import NOT_LOGGED
from shadowhound_data_logger.node.intake.consumers import is_plain_name
from shadowhound_data_logger.ros.endpoints import Endpoint, HistoryDepth, logged_type, plans
from shadowhound_data_logger.ros.reader import PolledGroup, Reader, SubscriptionRefused, TypeUnavailable, endpoints
from shadowhound_data_logger.ros.shared_memory import dead_ports_avoided

NODE: Final = 'shadowhound_doctor'
DISCOVER_S: Final = 3.0
"""Maximum time to find publishers; Fast DDS announces every 3 seconds by default."""
SETTLE_S: Final = 0.4
"""Wait after the last publisher was found, and for a subscription to be matched."""
POLL_S: Final = 0.02


@dataclass(slots=True)
class WatchedTopic:
    """A topic and its messages."""

    topic: str
    publishers: list[Endpoint]
    """Publishers of all types."""
    type: str = ''
    """The type that is logged; empty if none is."""
    incompatible: list[str] = field(default_factory=list)
    """Subscribers that request more than its publishers offer: they receive nothing, without a warning."""
    unavailable: str = ''
    """Why its type cannot be received here."""
    received: int = 0
    size: int = 0
    """Serialized size of the received messages."""
    newest: bytes = b''
    """The newest message; it may have arrived before counting started."""
    sent: int | None = None
    """Messages sent, by their sequence numbers; None if they have none."""
    window_s: float = 0.0
    _spans: dict[str, tuple[int, int]] = field(default_factory=dict)

    def note(self, cdr: bytes, publisher: str | None, number: int | None) -> None:
        self.received += 1
        self.size += len(cdr)
        if number is not None:
            first, last = self._spans.get(publisher or '', (number, number))
            self._spans[publisher or ''] = (min(first, number), max(last, number))
            self.sent = sum(last - first + 1 for first, last in self._spans.values())

    @property
    def rate_hz(self) -> float:
        """The publishing rate, if known; otherwise the rate received."""
        return max(self.received, self.sent or 0) / self.window_s if self.window_s else 0.0


@contextmanager
def node(domain: int | None = None, namespace: str = '/') -> Iterator[Node]:
    """A node in the domain of this process's environment, or another one."""
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=domain)
    with dead_ports_avoided(context.get_domain_id()):
        made = Node(NODE, context=context, namespace=namespace, start_parameter_services=False, enable_rosout=False)
    try:
        yield made
    finally:
        made.destroy_node()
        rclpy.try_shutdown(context=context)


def discover(ros_node: Node, topics: Sequence[str], patience_s: float = DISCOVER_S) -> dict[str, list[Endpoint]]:
    """The publishers of each topic; returns once all have one and the graph has been quiet for a moment."""
    end = time.monotonic() + patience_s
    found: dict[str, list[Endpoint]] = {}
    quiet_since = time.monotonic()
    while (now := time.monotonic()) < end:
        seen = {topic: endpoints(ros_node, topic) for topic in topics}
        if {topic: len(each) for topic, each in seen.items()} != {topic: len(each) for topic, each in found.items()}:
            found, quiet_since = seen, now
        if all(found.values()) and now - quiet_since > SETTLE_S:
            break
        time.sleep(POLL_S)
    return found


def published(ros_node: Node, within: str = '/') -> dict[str, list[Endpoint]]:
    """Each topic with publishers whose name starts with a namespace, once the graph has been quiet for a moment.

    Names that are invalid in ROS are skipped: any participant can choose them, and they would end up in commands and files.
    """
    end = time.monotonic() + DISCOVER_S
    found: dict[str, list[Endpoint]] = {}
    quiet_since = time.monotonic()
    while (now := time.monotonic()) < end or (now - quiet_since < SETTLE_S and now < end + DISCOVER_S):
        seen = in_graph(ros_node, within)
        if _nodes(seen) != _nodes(found):  # the name of a node arrives after its publishers
            found, quiet_since = seen, now
        time.sleep(POLL_S)
    return {topic: publishers for topic, publishers in found.items() if publishers}


def in_graph(ros_node: Node, within: str = '/') -> dict[str, list[Endpoint]]:
    """The same now, with topics that have no publisher."""
    named = [name for name, _ in ros_node.get_topic_names_and_types() if is_plain_name(name) and name not in NOT_LOGGED]
    return {name: endpoints(ros_node, name) for name in named if name.startswith(f'{within.rstrip("/")}/')}


def _nodes(found: Mapping[str, Sequence[Endpoint]]) -> dict[str, list[str]]:
    return {topic: sorted(each.node for each in publishers) for topic, publishers in found.items()}


def listen(ros_node: Node, found: dict[str, list[Endpoint]], window_s: float, types: Mapping[str, str]) -> list[WatchedTopic]:
    """Count the messages of each topic that has publishers; ``types`` are those in the settings, by topic."""
    watched = [WatchedTopic(topic, publishers, logged_type(publishers, types.get(topic))) for topic, publishers in found.items()]
    readers = [(one, reader) for one in watched for reader in _readers(ros_node, one)]
    try:
        settled = time.monotonic() + SETTLE_S
        while time.monotonic() < settled:
            _drain(readers, count=False)
            time.sleep(POLL_S)
        began = time.monotonic()
        while time.monotonic() < began + window_s:
            _drain(readers, count=True)
            time.sleep(POLL_S)
        _drain(readers, count=True)
        for one in watched:
            one.window_s = time.monotonic() - began
            one.incompatible = _incompatible_subscribers(ros_node, one.topic)
    finally:
        for _, reader in readers:
            reader.close()
    return watched


def publishers_of(ros_node: Node, topic: str) -> list[Endpoint]:
    """The publishers currently in the graph."""
    return endpoints(ros_node, topic)


def waiting_for_clock(ros_node: Node) -> list[str]:
    """Full names of the nodes that use sim time while /clock has no publisher."""
    if ros_node.count_publishers('/clock'):
        return []
    return sorted({_name(each) for each in ros_node.get_subscriptions_info_by_topic('/clock')})


def _readers(ros_node: Node, one: WatchedTopic) -> list[Reader]:
    """Subscribe as the logger does; if two kinds of publishers need two subscriptions, the first is enough for counting."""
    publishers = [each for each in one.publishers if each.type == one.type]
    if not publishers:
        return []
    try:
        wanted = plans(one.topic, one.type, publishers, HistoryDepth(one.type).depth)
        return [Reader(ros_node, wanted[-1], PolledGroup())]
    except (TypeUnavailable, SubscriptionRefused) as error:
        one.unavailable = str(error)
        return []


def _drain(readers: Sequence[tuple[WatchedTopic, Reader]], *, count: bool) -> None:
    for one, reader in readers:
        for taken in reader.drain():
            one.newest = taken.cdr
            if count:
                one.note(taken.cdr, taken.publisher, taken.number)


def _incompatible_subscribers(ros_node: Node, topic: str) -> list[str]:
    offers = ros_node.get_publishers_info_by_topic(topic)
    return sorted(
        {
            _name(asked)
            for asked in ros_node.get_subscriptions_info_by_topic(topic)
            if offers and asked.node_name != NODE and all(_is_incompatible(offer, asked) for offer in offers)
        }
    )


def _is_incompatible(offer: Any, asked: Any) -> bool:
    return bool(qos_check_compatible(offer.qos_profile, asked.qos_profile)[0] == QoSCompatibility.ERROR)


def _name(info: Any) -> str:
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'
