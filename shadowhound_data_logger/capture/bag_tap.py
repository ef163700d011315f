"""What the bags get of what was taken: counted in their own accounts and handed on as it came. Owned by the intake thread.

A topic of a sensor comes from its one subscription (``Stream``), any other from one for the bag alone (``BagStream``).
While nothing is recorded it costs a look at an empty set for each drain.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from rclpy.node import Node

from shadowhound_data_logger.bags.queue import QUEUE_FULL, BagQueue, Lot
from shadowhound_data_logger.capture.endpoints import Senders
from shadowhound_data_logger.capture.stream import Pace, Repeats, Shared, is_named
from shadowhound_data_logger.config import SensorSettings
from shadowhound_data_logger.mcap.rosbag2_metadata import offered_qos
from shadowhound_data_logger.model import Taken
from shadowhound_data_logger.spool.accounts import BAG, PAUSED, Accounts, Losses, TopicAccount
from shadowhound_data_logger.spool.estimator import TopicEstimate

MAX_AGAIN: Final = 10_000
"""Latched messages that a recording has again, of all publishers; each of these sends what it kept, some at most."""


class BagTap:
    """New; ``topics`` says what is recorded now."""

    def __init__(self, node: Node, accounts: Accounts, queue: BagQueue) -> None:
        self._topics: frozenset[str] = frozenset()
        self._before: dict[str, dict[str, int]] = {}
        self._again: set[tuple[str, str, int]] = set()
        self._node = node
        self._accounts = accounts
        self._queue = queue
        self._qos: dict[tuple[str, str], str] = {}

    @property
    def topics(self) -> frozenset[str]:
        """Full names."""
        return self._topics

    @topics.setter
    def topics(self, topics: frozenset[str]) -> None:
        if topics and not self._topics:  # a recording begins: what earlier ones had of latched topics belongs into it as well
            self._qos.clear()
            self._again.clear()
            self._before = self._accounts.last_numbers(BAG)
        self._topics = topics

    def add(self, topic: str, type_name: str, taken: Sequence[Taken], lost: Losses, *, paused: bool) -> None:
        """Count messages that are no repeats, their senders named, and hand them on; ``lost`` as in ``TopicAccount.appraise``."""
        if not taken:
            return
        paused = paused or self._queue.paused
        with self._accounts.entry(f'{BAG}{topic}') as account:
            account.type = type_name
            receive, unknown = account.receive, account.unknown
            fresh = [
                message for message in taken
                if receive(message.publisher, message.number) or self._is_earlier(topic, message, account)
            ]  # fmt: skip
            account.appraise(account.unknown - unknown, lost)
            if paused:
                account.dropped[PAUSED] += len(fresh)
        if fresh and paused:
            self._queue.leave_out(topic, PAUSED, len(fresh))
        elif fresh:
            dropped = self._queue.put(Lot(topic, type_name, self._qos_of(topic, type_name), fresh))
            if dropped:
                self._accounts.drop(f'{BAG}{topic}', QUEUE_FULL, dropped)

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
            qos = self._qos[topic, type_name] = qos_offered(self._node, topic, type_name)
        return qos


def qos_offered(node: Node, topic: str, type_name: str) -> str:
    """By the publishers of a topic with this type, as rosbag2 writes it."""
    found = node.get_publishers_info_by_topic(topic)
    return offered_qos(info.qos_profile for info in found if info.topic_type == type_name)


class BagStream:
    """A topic that no sensor takes, with the face of a ``Stream``."""

    kept_ns = 0

    def __init__(self, sensor: SensorSettings, topic: str, type_name: str, last_kept_ns: int, shared: Shared) -> None:  # noqa: ARG002
        self._topic = topic
        self._type = type_name
        self._tap = shared.tap
        self._repeats = Repeats()
        self._pace = Pace()
        self._estimate = TopicEstimate()

    def update(self, sensor: SensorSettings) -> None:
        """Nothing of it is sampled."""

    def add(self, taken: Sequence[Taken], senders: Senders, now_s: float, *, paused: bool,
            idle: bool = False) -> None:  # noqa: ARG002  # fmt: skip
        """Take messages in the order in which they came."""
        fresh: list[Taken] = []
        sent: dict[str, list[int]] = {}
        for message in taken:
            publisher = message.publisher or senders.name(message.number, message.source_ns)
            if is_named(message) or not self._repeats.has(message):
                fresh.append(message if message.publisher else message._replace(publisher=publisher))
                if publisher is None or message.number is None:
                    sent.setdefault(message.publisher or '', []).append(message.source_ns)
        lost = self._estimate.observe(sent, self._pace.hear(senders, now_s)).lost if sent else None
        self._tap.add(self._topic, self._type, fresh, lost, paused=paused)

    def close_due(self, now_s: float, grace_s: float) -> None:  # noqa: ARG002
        """There are no batches."""
        self._pace.look(now_s)

    def close_batch(self) -> None:
        """There are no batches."""
