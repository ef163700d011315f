"""Passes the messages of a bag to its queue unchanged, and counts them in the bag's accounts. Owned by the intake thread.

A sensor's topic arrives through its one subscription, any other through a separate one. While nothing is recorded, each drain
costs one lookup in an empty set.
"""

from __future__ import annotations

from typing import Final

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from shadowhound_data_logger.bags.queue import QUEUE_FULL, BagQueue, MessageBatch
from shadowhound_data_logger.core.model import Taken
from shadowhound_data_logger.core.options import BagSettings
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import offered_qos
from shadowhound_data_logger.node.intake.consumers import Consumer, Drained, TopicChoice
from shadowhound_data_logger.spool.accounts import Accounts
from shadowhound_data_logger.spool.topic_account import BAG, PAUSED, TopicAccount

MAX_OFFERS: Final = 1000
"""Maximum number of publishers whose offered QoS is remembered."""
INFINITE_NS: Final = (1 << 63) - 10**9
"""A lifespan from here on is infinite: middlewares differ in the last digits."""
MAX_AGAIN: Final = 10_000
"""Maximum latched messages that a recording receives again, of all publishers; each sends at most a few."""


class BagConsumer(Consumer):
    """Passes the messages of a recording to its queue. New; active while something is recorded (``Intake.listen``)."""

    from_start = False
    wants_latched = True

    def __init__(self, node: Node, settings: BagSettings, accounts: Accounts, queue: BagQueue) -> None:
        self.wanted_topics = TopicChoice(settings, [node.resolve_topic_name(topic) for topic in settings.topics if topic])
        self._before: dict[str, dict[str, int]] = {}
        self._to_repeat: set[tuple[str, str, int]] = set()
        self._accounts = accounts
        self._queue = queue
        self._offers = Offers(node)

    def begin(self) -> None:
        """A recording starts: it also receives latched messages that earlier recordings had."""
        self._offers.clear()
        self._to_repeat.clear()
        self._before = self._accounts.last_numbers(BAG)

    def take(self, drained: Drained) -> None:
        """Count messages that are not repeats, and pass them on."""
        topic, type_name = drained.topic, drained.type
        paused = drained.paused or self._queue.paused
        with self._accounts.entry(f'{BAG}{topic}') as account:
            account.type = type_name
            receive, unknown = account.receive, account.unknown
            fresh = [
                message for message in drained.messages
                if receive(message.publisher, message.number, message.times) or self._is_earlier(topic, message, account)
            ]  # fmt: skip
            newest = drained.messages[-1].times
            account.add_estimate(account.unknown - unknown, drained.lost, newest)
            if paused and fresh:
                account.drop(PAUSED, len(fresh), fresh[0].times, fresh[-1].times)
            account.gaps.newest = newest
        if not fresh:
            return
        if paused:
            self._queue.count_dropped(topic, PAUSED, len(fresh))
        qos, latched = self._offers.of(topic, type_name, fresh[-1].publisher)
        if not paused or latched:  # slices after the pause start with messages latched during it
            dropped = self._queue.put(MessageBatch(topic, type_name, qos, fresh, latched, paused))
            if dropped and not paused:
                self._accounts.drop(f'{BAG}{topic}', QUEUE_FULL, dropped, fresh[-dropped].times, fresh[-1].times)

    def _is_earlier(self, topic: str, message: Taken, account: TopicAccount) -> bool:
        """Whether it is a latched message that an earlier recording had, and this one does not have yet: counted again."""
        last = self._before.get(f'{BAG}{topic}', {}).get(message.publisher or '')
        if last is None or message.number is None or message.number > last:
            return False
        mark = topic, message.publisher or '', message.number
        if mark in self._to_repeat or len(self._to_repeat) >= MAX_AGAIN:
            return False
        self._to_repeat.add(mark)
        account.receive_again(mark[1], message.number)
        return True


class Offers:
    """The QoS offered by the publishers of topics. New; owned by the intake thread."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._known: dict[tuple[str, str, str | None], tuple[str, bool]] = {}

    def clear(self) -> None:
        self._known.clear()

    def of(self, topic: str, type_name: str, publisher: str | None) -> tuple[str, int]:
        """The offered QoS as rosbag2 writes it, as of this publisher's first message; and how many publishers are latched at
        present.

        The latter is queried for each message of a topic with latched publishers; those publish rarely.
        """
        key = topic, type_name, publisher
        if (known := self._known.get(key)) is not None and not known[1]:
            return known[0], 0
        profiles = profiles_offered(self._node, topic, type_name)
        latched = sum(map(_is_latched, profiles))
        if known is None:
            if len(self._known) >= MAX_OFFERS:
                self._known.clear()
            known = self._known[key] = offered_qos(profiles), latched > 0
        return known[0], max(latched, 1) if known[1] else 0


def profiles_offered(node: Node, topic: str, type_name: str) -> list[QoSProfile]:
    """The QoS profiles offered by the publishers of a topic with this type."""
    found = node.get_publishers_info_by_topic(topic)
    return [info.qos_profile for info in found if info.topic_type == type_name]


def _is_latched(profile: QoSProfile) -> bool:
    """Whether the publisher keeps its last message for later subscribers; ``/rosout``, whose messages expire, does not count."""
    lifespan_ns = profile.lifespan.nanoseconds
    return int(profile.durability) == int(DurabilityPolicy.TRANSIENT_LOCAL) and (not lifespan_ns or lifespan_ns >= INFINITE_NS)
