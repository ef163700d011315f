"""Hands the messages of a bag to its queue, as they came, and counts them in the bag's accounts. Owned by the intake thread.

A topic of a sensor comes from its one subscription, any other from one of the bag's own. While nothing is recorded it costs a
look at an empty set for each drain.
"""

from __future__ import annotations

from typing import Final

from rclpy.node import Node
from rclpy.qos import QoSProfile

from shadowhound_data_logger.bags.queue import QUEUE_FULL, BagQueue, Lot
from shadowhound_data_logger.capture.consumers import Consumer, Drained, TopicChoice
from shadowhound_data_logger.mcap.rosbag2_metadata import offered_qos
from shadowhound_data_logger.model import Taken
from shadowhound_data_logger.options import BagSettings
from shadowhound_data_logger.spool.accounts import BAG, PAUSED, Accounts, TopicAccount

MAX_AGAIN: Final = 10_000
"""Latched messages that a recording has again, of all publishers; each of these sends what it kept, some at most."""


class BagConsumer(Consumer):
    """Hands what a recording wants to its queue. New; it listens while something is recorded (``Intake.listen``)."""

    from_start = False
    wants_latched = True

    def __init__(self, node: Node, settings: BagSettings, accounts: Accounts, queue: BagQueue) -> None:
        self.wanted_topics = TopicChoice(settings, [node.resolve_topic_name(topic) for topic in settings.topics if topic])
        self._before: dict[str, dict[str, int]] = {}
        self._again: set[tuple[str, str, int]] = set()
        self._node = node
        self._accounts = accounts
        self._queue = queue
        self._qos: dict[tuple[str, str], str] = {}

    def begin(self) -> None:
        """A recording begins: what earlier ones had of latched topics belongs into it as well."""
        self._qos.clear()
        self._again.clear()
        self._before = self._accounts.last_numbers(BAG)

    def take(self, drained: Drained) -> None:
        """Count messages that are not repeats, and hand them on."""
        topic, type_name = drained.topic, drained.type
        paused = drained.paused or self._queue.paused
        with self._accounts.entry(f'{BAG}{topic}') as account:
            account.type = type_name
            receive, unknown = account.receive, account.unknown
            fresh = [
                message for message in drained.messages
                if receive(message.publisher, message.number, message.source_ns) or self._is_earlier(topic, message, account)
            ]  # fmt: skip
            newest_ns = drained.messages[-1].source_ns
            account.appraise(account.unknown - unknown, drained.lost, newest_ns)
            if paused and fresh:
                account.drop(PAUSED, len(fresh), fresh[0].source_ns, fresh[-1].source_ns)
            account.gaps.heard_ns = newest_ns
        if fresh and paused:
            self._queue.leave_out(topic, PAUSED, len(fresh))
        elif fresh:
            dropped = self._queue.put(Lot(topic, type_name, self._qos_of(topic, type_name), fresh))
            if dropped:
                self._accounts.drop(f'{BAG}{topic}', QUEUE_FULL, dropped, fresh[-dropped].source_ns, fresh[-1].source_ns)

    def _is_earlier(self, topic: str, message: Taken, account: TopicAccount) -> bool:
        """Whether it is a latched message that an earlier recording had already, and that this one has not yet: counted again."""
        last = self._before.get(f'{BAG}{topic}', {}).get(message.publisher or '')
        if last is None or message.number is None or message.number > last:
            return False
        mark = topic, message.publisher or '', message.number
        if mark in self._again or len(self._again) >= MAX_AGAIN:
            return False
        self._again.add(mark)
        account.receive_again(mark[1], message.number)
        return True

    def _qos_of(self, topic: str, type_name: str) -> str:
        """What the publishers of the topic offer, as it was when the recording first heard of it."""
        qos = self._qos.get((topic, type_name))
        if qos is None:
            qos = self._qos[topic, type_name] = offered_qos(profiles_offered(self._node, topic, type_name))
        return qos


def profiles_offered(node: Node, topic: str, type_name: str) -> list[QoSProfile]:
    """By the publishers of a topic with this type."""
    found = node.get_publishers_info_by_topic(topic)
    return [info.qos_profile for info in found if info.topic_type == type_name]
