"""How to listen to a topic, decided from its publishers in the graph (D4). Plain Python: rclpy's types end in ``Endpoint``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, inf
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


class Senders:
    """Who sent a message, where the middleware gives its number but not its sender's gid (Jazzy and older).

    With one publisher in the graph it is that one. Its successor is told from it before the graph shows the change: its
    numbers begin anew while the time of sending goes on. When the old numbers go on as well, there are two of them.
    """

    def __init__(self) -> None:
        self.gids: list[str] = []
        self.changed_s = -inf
        """When one came that was not there before, by the monotonic clock; the first ones are not counted."""
        self.several_s: float | None = None
        """Since when there are several."""
        self._successors = 0
        self._number = 0
        self._number_before = 0
        self._sent_ns = 0

    def look(self, gids: list[str], now_s: float = 0.0) -> None:
        """What the graph says now."""
        self.several_s = None if len(gids) < 2 else now_s if self.several_s is None else self.several_s
        if gids and gids != self.gids:
            if self.gids and not set(gids) <= set(self.gids):
                self.changed_s = now_s
            self.gids = gids
            self._successors = 0

    def name(self, number: int | None, sent_ns: int) -> str | None:
        """A name for the sender of this message; None where there is more than one, or no number."""
        if number is None or len(self.gids) != 1:
            return None
        if self._successors and self._number < self._number_before < number:
            return None
        if number <= self._number and sent_ns > self._sent_ns:
            self._successors += 1
            self._number_before = self._number
        if sent_ns >= self._sent_ns:
            self._number, self._sent_ns = number, sent_ns
        return f'{self.gids[0]}.{self._successors}'
