"""Chooses subscriptions from a topic's publishers in the graph. Plain Python: rclpy's types are converted to ``Endpoint``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from typing import Final

LARGE_TYPES: Final = {
    'sensor_msgs/msg/Image': 1 << 20,
    'sensor_msgs/msg/PointCloud2': 1 << 20,
    'sensor_msgs/msg/CompressedImage': 256 << 10,
    'nav_msgs/msg/OccupancyGrid': 1 << 20,
    'go2_interfaces/msg/VoxelMapCompressed': 256 << 10,
}
"""Assumed size of messages of types that are not small, until one arrives."""
LARGE_RATE_HZ: Final = 60.0
SMALL_RATE_HZ: Final = 2000.0
SMALL_BYTES: Final = 4096
POLL_S: Final = 0.2
"""Seconds between two drains of the subscriptions."""
STALL_S: Final = 2.0
"""How long a subscription can buffer without being drained: on a busy machine the polling thread was seen to wait half a second.
It uses memory only while that lasts.
"""
HISTORY_BYTES: Final = 32 << 20
"""Bytes that one subscription may hold, if that is at least MIN_DEPTH messages."""
MIN_DEPTH: Final = 16
"""Minimum depth: two polls of large messages at 40 Hz."""
MAX_DEPTH: Final = 1 << 16
"""Maximum depth: 2 s at 32,000 Hz."""
UNKNOWN: Final = ((True, False), (False, False))
"""RELIABLE and TRANSIENT_LOCAL flags of the subscriptions that together match any publisher."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """One publisher of a topic."""

    gid: str
    type: str
    reliable: bool
    transient_local: bool
    node: str = ''
    """Full name of its node, safe to print; empty if unknown, for example for a program that is not a ROS node."""


@dataclass(frozen=True, slots=True)
class Plan:
    """The parameters of a subscription."""

    topic: str
    type: str
    reliable: bool
    transient_local: bool
    depth: int

    def describe(self) -> str:
        """For a log line: ``/odom (nav_msgs/msg/Odometry, RELIABLE, depth 400)``."""
        reliability = 'RELIABLE' if self.reliable else 'BEST_EFFORT'
        return f'{self.topic} ({self.type}, {reliability}{", TRANSIENT_LOCAL" * self.transient_local}, depth {self.depth})'


def alternatives(named: str) -> tuple[str, ...]:
    """The alternative types that the settings name for a topic."""
    return tuple(name.strip() for name in named.split('|'))


def logged_type(publishers: Sequence[Endpoint], named: str | None, current: str = '') -> str:
    """The single type of a topic to subscribe to: the one that the settings name, if any.

    Of alternatives (``a|b``) it is ``current`` while that has a publisher, otherwise the first with one, otherwise the first.
    If the settings name none, ``current`` stays while it has a publisher, otherwise it is the most common type; empty without
    any.
    """
    if named:
        names = alternatives(named)
        there = {publisher.type for publisher in publishers}.intersection(names)
        return next((each for each in (current, *names) if each in there), names[0])
    counts = Counter(publisher.type for publisher in publishers)
    return max(counts, key=lambda name: (name == current, counts[name], name)) if counts else ''


class HistoryDepth:
    """How many messages a topic's subscriptions must hold between two drains, learned from its messages.

    It starts with a typical value for the type. It grows for faster messages and shrinks for larger ones, so that the buffered
    messages stay within ``HISTORY_BYTES``. A new depth needs a new subscription, so it changes in powers of two, and one change
    covers all similar messages: it settles.
    """

    def __init__(self, type_name: str) -> None:
        is_large = type_name in LARGE_TYPES
        self._largest = LARGE_TYPES.get(type_name, SMALL_BYTES)
        self._rate_hz = LARGE_RATE_HZ if is_large else SMALL_RATE_HZ
        self._has_data = False
        self.depth = min(round(self._rate_hz * STALL_S), self._max_depth())

    def observe(self, sizes: Sequence[int], seconds: float) -> None:
        """Messages of these sizes (bytes) arrived within this time."""
        largest = max(sizes)
        self._largest = max(largest, self._largest) if self._has_data else largest
        self._has_data = True
        wanted, max_depth = len(sizes) / max(seconds, POLL_S) * STALL_S, self._max_depth()
        if len(sizes) >= self.depth:  # it was full, and may have lost some
            wanted = max(wanted, self.depth + 1)
        if wanted > self.depth and max_depth > self.depth:
            self.depth = min(_power(wanted), max_depth)
        elif self.depth >= 2 * max_depth:
            self.depth = max_depth

    def _max_depth(self) -> int:
        return min(max(MIN_DEPTH, HISTORY_BYTES // _power(self._largest)), MAX_DEPTH)


def _power(value: float) -> int:
    """The smallest power of two that is not below the value."""
    return 1 << max(0, ceil(value) - 1).bit_length()


def plans(topic: str, type_name: str, publishers: Sequence[Endpoint], depth: int) -> tuple[Plan, ...]:
    """The subscriptions that miss nothing from these publishers, all of this type.

    A RELIABLE subscription receives nothing from a BEST_EFFORT publisher, and a BEST_EFFORT one may lose what a RELIABLE
    publisher would resend; one that requests the history of a TRANSIENT_LOCAL publisher receives nothing from the others. So
    there is one for each kind of publisher present. While there is none, two match any publisher from its first message on. A
    message that both receive is a repeat, and is dropped.
    """
    offered = {(publisher.reliable, publisher.reliable and publisher.transient_local) for publisher in publishers}
    kinds = ((True, True), (True, False), (False, False))
    return tuple(
        Plan(topic, type_name, reliable=kind[0], transient_local=kind[1], depth=depth)
        for kind in kinds
        if kind in (offered or UNKNOWN)
    )  # fmt: skip
