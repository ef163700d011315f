"""What the ring and the conditions get of what was taken, from the one subscription that serves objects and bags as well.

Owned by the intake thread: it counts nothing, copies nothing and waits for nothing.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Final

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy

from shadowhound_data_logger.bags.claims import Claims
from shadowhound_data_logger.bags.queue import Lot
from shadowhound_data_logger.bags.ring import Held, Ring
from shadowhound_data_logger.bags.topics import Choice
from shadowhound_data_logger.capture.bag_tap import qos_offered
from shadowhound_data_logger.capture.stream import Tap
from shadowhound_data_logger.conditions import Condition, conditions
from shadowhound_data_logger.model import Taken
from shadowhound_data_logger.options import EventSettings
from shadowhound_data_logger.spool.accounts import PAUSED, Losses

SEEN: Final = 10
"""Messages of one drain that conditions look at, evenly chosen: 50 a second."""
LARGE_BYTES: Final = 64 << 10
"""Of a topic with larger messages they look at the newest alone."""
MAX_QOS: Final = 1000
"""Publishers whose offers are remembered."""
LATCHED: Final = f'durability: {int(DurabilityPolicy.TRANSIENT_LOCAL)}\n'
"""In what rosbag2 writes of a topic with such a publisher (``bags.metadata``)."""


class Inbox:
    """Messages that conditions are to look at. ``put`` by the intake, ``take`` by one other thread; the oldest fall out."""

    def __init__(self, watched: Iterable[tuple[str, Condition]]) -> None:
        """Conditions with the full names of their topics."""
        self.conditions: dict[str, list[Condition]] = {}
        for topic, condition in watched:
            self.conditions.setdefault(topic, []).append(condition)
        self._heard: dict[str, deque[tuple[float, str, Taken]]] = {topic: deque(maxlen=2 * SEEN) for topic in self.conditions}
        self._fewest = {topic: all(each.hold_s for each in found) for topic, found in self.conditions.items()}

    def put(self, topic: str, type_name: str, taken: Sequence[Taken], now_s: float) -> None:
        """A condition that has to hold for a time is content with one message of a drain."""
        few = self._fewest[topic] or len(taken[-1].cdr) > LARGE_BYTES
        step = len(taken) if few else -(-len(taken) // SEEN)
        heard = self._heard[topic]
        if few:
            heard.clear()
        heard.extend((now_s, type_name, message) for message in taken[(len(taken) - 1) % step :: step])

    def take(self, topic: str) -> Iterable[tuple[float, str, Taken]]:
        """When it was drained, of which type, and the message; oldest first."""
        heard = self._heard[topic]
        while heard:
            try:
                yield heard.popleft()
            except IndexError:  # the intake has just cleared it
                return


class EventTap:
    """New; ``choice`` says which topics it wants, ``topics`` those that it gets."""

    def __init__(self, node: Node, settings: EventSettings, ring: Ring, claims: Claims) -> None:
        self.topics: frozenset[str] = frozenset()
        watched = [(node.resolve_topic_name(each.topic), each) for each in conditions(settings.conditions)]
        named = [node.resolve_topic_name(topic) for topic in settings.topics if topic]
        self.inbox = Inbox(watched)
        self.choice = Choice(settings, [*named, *self.inbox.conditions])
        kept = Choice(settings, named).wanted((), self.inbox.conditions)
        self._unkept = frozenset(self.inbox.conditions) - kept
        self._node = node
        self._ring = ring
        self._claims = claims
        self._qos: dict[tuple[str, str, str | None], str] = {}

    def add(self, topic: str, type_name: str, taken: Sequence[Taken], lost: Losses, *, paused: bool) -> None:
        """Take in messages, their senders named; repeats are left out by whoever writes them."""
        if not taken:
            return
        now_s = time.monotonic()
        if topic in self.inbox.conditions:
            self.inbox.put(topic, type_name, taken, now_s)
        if topic in self._unkept:
            return
        lot = Lot(topic, type_name, self._qos_of(topic, type_name, taken[-1].publisher), taken)
        if not paused:
            if gone := self._ring.put(lot, lost, now_s, self._latched(topic, type_name, lot.qos)):
                self._claims.lose(gone)
        elif self._ring.claimed:
            self._claims.lose([Held(lot, lost, now_s, 0)], PAUSED)

    def _qos_of(self, topic: str, type_name: str, publisher: str | None) -> str:
        """What the publishers of the topic offered when this one was first heard."""
        key = topic, type_name, publisher
        if key not in self._qos:
            if len(self._qos) >= MAX_QOS:
                self._qos.clear()
            self._qos[key] = qos_offered(self._node, topic, type_name)
        return self._qos[key]

    def _latched(self, topic: str, type_name: str, qos: str) -> int:
        """How many publishers of the topic are latched; asked again with each of their few messages."""
        if LATCHED not in qos:
            return 0
        found = self._node.get_publishers_info_by_topic(topic)
        durabilities = [int(info.qos_profile.durability) for info in found if info.topic_type == type_name]
        return max(1, durabilities.count(int(DurabilityPolicy.TRANSIENT_LOCAL)))


class Taps:
    """The bag's and the events' tap as one."""

    def __init__(self, *taps: Tap) -> None:
        self._taps = taps
        self.topics: frozenset[str] = frozenset()

    def look(self) -> None:
        """One of them may want other topics than before."""
        self.topics = frozenset().union(*(tap.topics for tap in self._taps))

    def add(self, topic: str, type_name: str, taken: Sequence[Taken], lost: Losses, *, paused: bool) -> None:
        for tap in self._taps:
            if topic in tap.topics:
                tap.add(topic, type_name, taken, lost, paused=paused)
