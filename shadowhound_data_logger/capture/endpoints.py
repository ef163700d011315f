"""How to listen to a topic, decided from its publishers in the graph. Plain Python: rclpy's types end in ``Endpoint``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from typing import Final

from shadowhound_data_logger.config import IntakeSettings

LARGE_TYPES: Final = {
    'sensor_msgs/msg/Image': 2 << 20,
    'sensor_msgs/msg/PointCloud2': 1 << 20,
    'sensor_msgs/msg/CompressedImage': 256 << 10,
    'nav_msgs/msg/OccupancyGrid': 1 << 20,
    'go2_interfaces/msg/VoxelMapCompressed': 256 << 10,
}
"""Bytes a message of the types that are not small, for sizing the history; generous guesses, not limits."""
LARGE_RATE_HZ: Final = 60.0
SMALL_BYTES: Final = 4096
STALL_S: Final = 2.0
"""What a subscription can hold while nobody takes from it, at least four poll periods: on a machine that is busy with other
things the thread that polls was seen to get no turn for half a second. It costs memory only while that lasts."""
MIN_DEPTH: Final = 10
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
    """Full name of its node, safe to print; empty where it is not known: for a program that is no ROS node, for one."""


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


def logged_type(publishers: Sequence[Endpoint], named: str | None, current: str = '') -> str:
    """The one type of a topic that is listened to: the one that the settings name, whoever publishes what.

    Where they name none, ``current`` stays while it has a publisher, else it is the most common one; empty without any.
    """
    if named:
        return named
    counts = Counter(publisher.type for publisher in publishers)
    return max(counts, key=lambda name: (name == current, counts[name], name)) if counts else ''


def plans(topic: str, type_name: str, publishers: Sequence[Endpoint], settings: IntakeSettings) -> tuple[Plan, ...]:
    """The subscriptions that miss nothing of what these publishers, all of this type, send.

    A RELIABLE subscription gets nothing from a BEST_EFFORT publisher, and a BEST_EFFORT one may lose what a RELIABLE
    publisher would have repeated; one that asks for the history of a TRANSIENT_LOCAL publisher gets nothing from the others.
    So there is one for each kind of publisher that exists. While there is none yet, two match whatever comes from its first
    message on. What two of them receive is a repeat, and dropped.
    """
    offered = {(publisher.reliable, publisher.reliable and publisher.transient_local) for publisher in publishers}
    size = depth(type_name, settings)
    kinds = ((True, True), (True, False), (False, False))
    return tuple(
        Plan(topic, type_name, reliable=kind[0], transient_local=kind[1], depth=size)
        for kind in kinds
        if kind in (offered or UNKNOWN)
    )  # fmt: skip


def depth(type_name: str, settings: IntakeSettings) -> int:
    """Messages a subscription must hold between two drains, bounded in bytes."""
    size = LARGE_TYPES.get(type_name, SMALL_BYTES)
    rate_hz = LARGE_RATE_HZ if type_name in LARGE_TYPES else settings.max_rate_hz
    wanted = ceil(rate_hz * max(STALL_S, 4 * settings.poll_s))
    return max(1, min(max(wanted, MIN_DEPTH), settings.history_bytes // size))
