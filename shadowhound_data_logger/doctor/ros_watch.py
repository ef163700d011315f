"""What a node of our own finds and receives of topics. The only module of the doctor that loads rclpy.

It subscribes as the logger does, takes what comes without decoding it, and publishes nothing.
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
"""Longest time to find publishers; Fast DDS announces every 3 seconds by default."""
SETTLE_S: Final = 0.4
"""After the last one was found, and for a subscription to be matched."""
POLL_S: Final = 0.02


@dataclass(slots=True)
class Heard:
    """One topic."""

    topic: str
    publishers: list[Endpoint]
    """Of all types."""
    type: str = ''
    """The one that is logged; empty where there is none."""
    deaf: list[str] = field(default_factory=list)
    """Subscribers that ask for more than its publishers offer: they receive nothing, and nobody tells them."""
    unavailable: str = ''
    """Why nobody can listen to its type here."""
    received: int = 0
    size: int = 0
    """Bytes of the received messages, as serialized."""
    newest: bytes = b''
    """A message; it can be one that came before the time in which messages are counted."""
    sent: int | None = None
    """By the numbers of the messages; None where they have none."""
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
        """As it was sent, as far as that is known."""
        return max(self.received, self.sent or 0) / self.window_s if self.window_s else 0.0


@contextmanager
def node(domain: int | None = None, namespace: str = '/') -> Iterator[Node]:
    """In the domain of this process's environment, or another one."""
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=domain)
    with dead_ports_avoided(context.get_domain_id()):
        made = Node(NODE, context=context, namespace=namespace, start_parameter_services=False, enable_rosout=False)
    try:
        yield made
    finally:
        made.destroy_node()
        rclpy.try_shutdown(context=context)


def discover(of: Node, topics: Sequence[str], patience_s: float = DISCOVER_S) -> dict[str, list[Endpoint]]:
    """The publishers of each topic; returns once all have one and it has been quiet for a moment."""
    end = time.monotonic() + patience_s
    found: dict[str, list[Endpoint]] = {}
    quiet_since = time.monotonic()
    while (now := time.monotonic()) < end:
        seen = {topic: endpoints(of, topic) for topic in topics}
        if {topic: len(each) for topic, each in seen.items()} != {topic: len(each) for topic, each in found.items()}:
            found, quiet_since = seen, now
        if all(found.values()) and now - quiet_since > SETTLE_S:
            break
        time.sleep(POLL_S)
    return found


def published(of: Node, within: str = '/') -> dict[str, list[Endpoint]]:
    """Each topic with publishers whose name starts with a namespace, once the graph has been quiet for a moment.

    Names that are invalid in ROS are skipped: any participant chooses them, and they would end up in commands and files.
    """
    end = time.monotonic() + DISCOVER_S
    found: dict[str, list[Endpoint]] = {}
    quiet_since = time.monotonic()
    while (now := time.monotonic()) < end or (now - quiet_since < SETTLE_S and now < end + DISCOVER_S):
        named = [name for name, _ in of.get_topic_names_and_types() if is_plain_name(name) and name not in NOT_LOGGED]
        seen = {name: endpoints(of, name) for name in named if name.startswith(f'{within.rstrip("/")}/')}
        if {topic: len(each) for topic, each in seen.items()} != {topic: len(each) for topic, each in found.items()}:
            found, quiet_since = seen, now
        time.sleep(POLL_S)
    return {topic: publishers for topic, publishers in found.items() if publishers}


def listen(of: Node, found: dict[str, list[Endpoint]], window_s: float, types: Mapping[str, str]) -> list[Heard]:
    """Count what comes on each topic that has publishers; ``types`` are those that the settings name for topics."""
    heard = [Heard(topic, publishers, logged_type(publishers, types.get(topic))) for topic, publishers in found.items()]
    readers = [(one, reader) for one in heard for reader in _readers(of, one)]
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
        for one in heard:
            one.window_s = time.monotonic() - began
            one.deaf = _deaf(of, one.topic)
    finally:
        for _, reader in readers:
            reader.close()
    return heard


def publishers_of(of: Node, topic: str) -> list[Endpoint]:
    """As the graph knows them now."""
    return endpoints(of, topic)


def waiting_for_clock(of: Node) -> list[str]:
    """Full names of the nodes that use sim time while nothing publishes it."""
    if of.count_publishers('/clock'):
        return []
    return sorted({_name(each) for each in of.get_subscriptions_info_by_topic('/clock')})


def _readers(of: Node, one: Heard) -> list[Reader]:
    """As the logger would listen; where two kinds of publishers need two subscriptions, the first is enough to count."""
    publishers = [each for each in one.publishers if each.type == one.type]
    if not publishers:
        return []
    try:
        wanted = plans(one.topic, one.type, publishers, HistoryDepth(one.type).depth)
        return [Reader(of, wanted[-1], PolledGroup())]
    except (TypeUnavailable, SubscriptionRefused) as error:
        one.unavailable = str(error)
        return []


def _drain(readers: Sequence[tuple[Heard, Reader]], *, count: bool) -> None:
    for one, reader in readers:
        for taken in reader.drain():
            one.newest = taken.cdr
            if count:
                one.note(taken.cdr, taken.publisher, taken.number)


def _deaf(of: Node, topic: str) -> list[str]:
    offers = of.get_publishers_info_by_topic(topic)
    return sorted(
        {
            _name(asked)
            for asked in of.get_subscriptions_info_by_topic(topic)
            if offers and asked.node_name != NODE and all(_is_deaf(offer, asked) for offer in offers)
        }
    )


def _is_deaf(offer: Any, asked: Any) -> bool:
    return bool(qos_check_compatible(offer.qos_profile, asked.qos_profile)[0] == QoSCompatibility.ERROR)


def _name(info: Any) -> str:
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'
