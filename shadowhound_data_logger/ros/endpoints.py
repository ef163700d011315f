"""How to listen to a topic, decided from its publishers in the graph. Plain Python: rclpy's types end in ``Endpoint``."""

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
"""Bytes a message of the types that are not small, until one has come."""
LARGE_RATE_HZ: Final = 60.0
SMALL_RATE_HZ: Final = 2000.0
SMALL_BYTES: Final = 4096
POLL_S: Final = 0.2
"""Seconds between two drains of the subscriptions."""
STALL_S: Final = 2.0
"""What a subscription can hold while nobody takes from it: on a machine that is busy with other things the thread that polls was
seen to get no turn for half a second. It costs memory only while that lasts."""
HISTORY_BYTES: Final = 32 << 20
"""Bytes that one subscription may hold, as long as that is MIN_DEPTH messages."""
MIN_DEPTH: Final = 16
"""Messages it can always hold: two polls of large messages at 40 Hz."""
MAX_DEPTH: Final = 1 << 16
"""Messages it holds at most: 2 s at 32,000 Hz."""
UNKNOWN: Final = ((True, False), (False, False))
"""Whether it is RELIABLE, and TRANSIENT_LOCAL, of the subscriptions that together match any publisher."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """One publisher of a topic."""

    gid: str
    type: str
    reliable: bool
    transient_local: bool
    node: str = ''
    """Full name of its node, safe to print; empty where it is not known: for a program that is not a ROS node, for one."""


@dataclass(frozen=True, slots=True)
class Plan:
    """A subscription as it should be."""

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
    """The types that the settings name for a topic."""
    return tuple(name.strip() for name in named.split('|'))


def logged_type(publishers: Sequence[Endpoint], named: str | None, current: str = '') -> str:
    """The one type of a topic that is listened to: the one that the settings name, whoever publishes what.

    Of alternatives (``a|b``) it is ``current`` while that has a publisher, else the first that has one, else the first.
    Where they name none, ``current`` stays while it has a publisher, else it is the most common one; empty without any.
    """
    if named:
        names = alternatives(named)
        there = {publisher.type for publisher in publishers}.intersection(names)
        return next((each for each in (current, *names) if each in there), names[0])
    counts = Counter(publisher.type for publisher in publishers)
    return max(counts, key=lambda name: (name == current, counts[name], name)) if counts else ''


class HistoryDepth:
    """How many messages the subscriptions of a topic must hold between two drains, from what was heard on it.

    It begins with what its type is mostly like. Where messages come faster it grows; where they are larger it shrinks, so that
    what is held stays within ``HISTORY_BYTES``. A new depth is a new subscription, so it changes in powers of two, and each
    message makes it fit for all that are like it: it settles.
    """

    def __init__(self, type_name: str) -> None:
        is_large = type_name in LARGE_TYPES
        self._largest = LARGE_TYPES.get(type_name, SMALL_BYTES)
        self._rate_hz = LARGE_RATE_HZ if is_large else SMALL_RATE_HZ
        self._has_heard = False
        self.depth = min(round(self._rate_hz * STALL_S), self._most())

    def hear(self, sizes: Sequence[int], seconds: float) -> None:
        """Messages of these sizes (bytes) were taken, which came in so many seconds."""
        largest = max(sizes)
        self._largest = max(largest, self._largest) if self._has_heard else largest
        self._has_heard = True
        wanted, most = len(sizes) / max(seconds, POLL_S) * STALL_S, self._most()
        if len(sizes) >= self.depth:  # it was full, and may have lost some
            wanted = max(wanted, self.depth + 1)
        if wanted > self.depth and most > self.depth:
            self.depth = min(_power(wanted), most)
        elif self.depth >= 2 * most:
            self.depth = most

    def _most(self) -> int:
        return min(max(MIN_DEPTH, HISTORY_BYTES // _power(self._largest)), MAX_DEPTH)


def _power(value: float) -> int:
    """The least power of two that is not below it."""
    return 1 << max(0, ceil(value) - 1).bit_length()


def plans(topic: str, type_name: str, publishers: Sequence[Endpoint], depth: int) -> tuple[Plan, ...]:
    """The subscriptions that miss nothing of what these publishers, all of this type, send.

    A RELIABLE subscription gets nothing from a BEST_EFFORT publisher, and a BEST_EFFORT one may lose what a RELIABLE
    publisher would have repeated; one that asks for the history of a TRANSIENT_LOCAL publisher gets nothing from the others.
    So there is one for each kind of publisher that exists. While there is none yet, two match whatever comes from its first
    message on. What two of them receive is a repeat, and dropped.
    """
    offered = {(publisher.reliable, publisher.reliable and publisher.transient_local) for publisher in publishers}
    kinds = ((True, True), (True, False), (False, False))
    return tuple(
        Plan(topic, type_name, reliable=kind[0], transient_local=kind[1], depth=depth)
        for kind in kinds
        if kind in (offered or UNKNOWN)
    )  # fmt: skip
