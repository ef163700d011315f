"""Bags get every message of a topic once, in separate accounts, whatever the sensor keeps."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip('rclpy')

from node.intake.test_stream import NOON_NS, TOPIC, TYPE, Batches

from shadowhound_data_logger.bags.queue import BagQueue, MessageBatch
from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.core.model import Taken
from shadowhound_data_logger.core.options import BagSettings
from shadowhound_data_logger.core.stamps import StampRule
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.intake.consumers import Consumer, Drained, TopicChoice
from shadowhound_data_logger.node.intake.extra_topics import ExtraTopics
from shadowhound_data_logger.node.intake.sampling import Sampler
from shadowhound_data_logger.node.intake.stream import Senders, SensorStream, TopicStream
from shadowhound_data_logger.node.intake.subscriber import Dependencies
from shadowhound_data_logger.node.recording.bags import BagConsumer
from shadowhound_data_logger.spool.accounts import Accounts
from shadowhound_data_logger.spool.topic_account import BAG, TopicAccount

STAMPS = StampRule(SystemClock.of_this_machine())


class Graph:
    """A node that knows one publisher with ordinary QoS; counts the queries."""

    def __init__(self, durability: int = 2, lifespan_ns: int = 0) -> None:
        self.asked = 0
        self._durability, self._lifespan = durability, SimpleNamespace(nanoseconds=lifespan_ns)

    def resolve_topic_name(self, topic: str) -> str:
        return topic

    def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
        assert topic == TOPIC
        self.asked += 1
        forever = SimpleNamespace(nanoseconds=0)
        qos = SimpleNamespace(history=1, depth=5, reliability=1, durability=self._durability, deadline=forever,
                              lifespan=self._lifespan, liveliness=1, liveliness_lease_duration=forever,
                              avoid_ros_namespace_conventions=False)  # fmt: skip
        return [SimpleNamespace(topic_type=TYPE, qos_profile=qos), SimpleNamespace(topic_type='other', qos_profile=qos)]


class Ear:
    """The bag's consumer behind a stream: of a sensor that keeps one message per second, or of the bag alone."""

    def __init__(self, *, own: bool, max_bytes: int = 1 << 20, graph: Graph | None = None) -> None:
        self.accounts, self.queue, self.batches = Accounts(), BagQueue(max_bytes), Batches()
        self.graph: Any = graph or Graph()
        batches: Any = self.batches
        self.bags = BagConsumer(self.graph, BagSettings(), self.accounts, self.queue)
        sensor, types = SensorSettings(name='talk', rate_hz=1.0), MessageTypes()
        self.sampler = Sampler({'talk': sensor}, self.accounts, types, batches)
        self.stream: TopicStream | SensorStream
        if own:
            self.stream = TopicStream(TOPIC, TYPE, MessageTypes(), STAMPS, [self.bags])
        else:
            self.stream = SensorStream(sensor, TOPIC, TYPE, self.accounts, types, STAMPS, [self.sampler, self.bags])
        self.begin()

    def begin(self) -> None:
        """Start as the intake does."""
        self.bags.begin()
        self.bags.topics = frozenset({TOPIC})

    def add(self, taken: list[Taken], *, paused: bool = False, idle: bool = False) -> None:
        self.sampler.set_idle(idle=idle)
        self.stream.add(taken, Senders(), 0.0, paused=paused)

    def heard(self) -> list[int]:
        """The numbers of the messages in the bag."""
        numbers = []
        while (item := self.queue.next()) is not None:
            assert isinstance(item, MessageBatch)
            assert (item.topic, item.type) == (TOPIC, TYPE)
            assert item.qos.count('history') == 1
            numbers += [message.number for message in item.messages]
        return [number for number in numbers if number is not None]

    def record_again(self) -> None:
        """The recording ends and another one starts, with a separate subscription."""
        self.begin()
        self.stream = TopicStream(TOPIC, TYPE, MessageTypes(), STAMPS, [self.bags])

    @property
    def account(self) -> TopicAccount:
        with self.accounts.entry(f'{BAG}{TOPIC}') as account:
            return account


def messages(*numbers: int, publisher: str | None = 'p') -> list[Taken]:
    return [Taken(b'%08d' % number, (ns := NOON_NS + number * 10**7), publisher, number, ns) for number in numbers]


@pytest.fixture(params=[True, False], ids=['own', 'shared'])
def ear(request: pytest.FixtureRequest) -> Ear:
    return Ear(own=request.param)


def test_every_message_is_passed_on_once(ear: Ear) -> None:
    """In order of arrival, also if two subscriptions deliver it; a gap is missed, as for the sensors."""
    ear.add(messages(1, 2, 3))
    ear.add(messages(3, 4, 7))
    assert ear.heard() == [1, 2, 3, 4, 7]
    assert (ear.account.received, ear.account.missed, ear.account.open, ear.account.type) == (5, 2, 5, TYPE)
    assert ear.graph.asked == 1


def test_repeats_without_a_sender_are_dropped(ear: Ear) -> None:
    """By send time and number."""
    ear.add(messages(1, 2, publisher=None))
    ear.add(messages(2, 3, publisher=None))
    assert ear.heard() == [1, 2, 3]


def test_estimated_losses_are_in_the_manifest(ear: Ear) -> None:
    """The time before the rhythm is known stays unknown; later losses are estimated, by the same rhythm as the sensor's."""
    senders = Senders()
    senders.poll(['a'])
    for start in (*range(0, 300, 20), *range(340, 400, 20)):
        taken = [message._replace(number=None) for message in messages(*range(start, start + 20), publisher=None)]
        ear.stream.add(taken, senders, (start + 20) / 100, paused=False)
        ear.stream.poll((start + 20) / 100)
    account = ear.account
    assert (account.received, account.estimated + account.unknown, account.unknown) == (360, 360, 220)
    assert (account.missed, account.missed_estimated, account.estimated_missed) == (None, None, {'transport': 40})


def test_a_pause_counts_and_drops(ear: Ear) -> None:
    """A pause of the node and one of the bag."""
    ear.add(messages(1, 2), paused=True)
    ear.queue.paused = True
    ear.add(messages(3))
    ear.queue.paused = False
    ear.add(messages(4))
    assert ear.heard() == [4]
    assert (ear.account.received, ear.account.dropped) == (4, {'paused': 3})


def test_recording_does_not_change_what_the_sensor_keeps() -> None:
    """With sampling, and with nothing outside a mission, the bag gets all messages."""
    ear = Ear(own=False)
    ear.add(messages(*range(1, 151)))
    ear.add(messages(200), idle=True)
    ear.sampler.flush()
    assert sum(len(batch.samples) for batch in ear.batches) == 2
    assert ear.heard() == [*range(1, 151), 200]
    with ear.accounts.entry(TOPIC) as account:
        assert (account.received, account.skipped) == (151, 149)


def test_a_topic_that_is_not_recorded_costs_nothing() -> None:
    """It has no account, and nothing is queued."""
    ear = Ear(own=False)
    ear.bags.topics = frozenset()
    ear.add(messages(1, 2))
    assert ear.heard() == []
    assert ear.accounts.totals(BAG) == {}


def test_a_full_queue_drops_the_newest() -> None:
    """And counts them; taking messages out makes room again."""
    ear = Ear(own=True, max_bytes=24)
    ear.add(messages(1, 2, 3, 4, 5))
    assert ear.account.dropped == {'queue_full': 2}
    assert ear.heard() == [1, 2, 3]
    ear.add(messages(6))
    assert ear.heard() == [6]


def test_latched_messages_are_in_each_bag() -> None:
    """A second recording gets the redelivered messages, once; none of them counts as missed."""
    ear = Ear(own=True)
    ear.add(messages(1, 2))
    assert ear.heard() == [1, 2]
    ear.record_again()
    ear.add(messages(1, 2))
    ear.add(messages(2, 3))
    assert ear.heard() == [1, 2, 3]
    assert (ear.account.received, ear.account.missed) == (5, 0)
    assert ear.account.publishers['p'].published == 5


@pytest.mark.parametrize(
    ('durability', 'lifespan_ns', 'latched'), [(1, 0, 1), (1, (1 << 63) - 1, 1), (1, 10 * 10**9, 0), (2, 0, 0)]
)
def test_latched_messages_are_marked(durability: int, lifespan_ns: int, latched: int) -> None:
    """A publisher that is TRANSIENT_LOCAL counts, unless its messages expire, as those of ``/rosout`` do."""
    ear = Ear(own=True, graph=Graph(durability, lifespan_ns))
    for number in range(3):
        ear.add(messages(number))
        batch = ear.queue.next()
        assert isinstance(batch, MessageBatch)
        assert (batch.latched, batch.paused) == (latched, False)
    assert ear.graph.asked == (3 if latched else 1)


def test_messages_latched_during_a_pause_are_remembered() -> None:
    """They are counted and dropped as any other, and added to the slices that follow."""
    ear = Ear(own=True, graph=Graph(durability=1), max_bytes=8)
    ear.queue.paused = True
    ear.add(messages(1))
    ear.add(messages(2))
    batch = ear.queue.next()
    assert isinstance(batch, MessageBatch)
    assert ([message.number for message in batch.messages], batch.paused) == ([1], True)
    assert ear.queue.next() is None
    assert (ear.account.received, ear.account.dropped, ear.queue.dropped) == (2, {'paused': 2}, 0)


@pytest.mark.parametrize(('named', 'expected'), [((), {'/imu', '/odom'}), (('/rosout',), {'/rosout'})])
def test_topics_of_the_ring_alone_are_in_a_bag_only_if_named(named: tuple[str, ...], expected: set[str]) -> None:
    """By default a bag has the sensors' topics, whatever events keep; a named topic needs no extra subscription."""
    bags: Any = SimpleNamespace(topics=frozenset(), wants_latched=True, wanted_topics=TopicChoice(BagSettings(), named))
    nothing: Any = None
    extra = ExtraTopics(Dependencies(nothing, nothing, nothing, nothing, STAMPS), [bags], {})
    sensors = dict.fromkeys(('/imu', '/odom'), False)
    extra.refresh(sensors | {'/rosout': False}, sensors, 0.0, paused=False)
    assert bags.topics == expected
    assert not extra.own


class Listener(Consumer):
    """Records what it receives."""

    def __init__(self, choice: TopicChoice | None, *topics: str) -> None:
        self.wanted_topics = choice
        self.topics = frozenset(topics)
        self.given: list[tuple[str, str, list[int | None]]] = []

    def take(self, drained: Drained) -> None:
        self.given.append((drained.topic, drained.sensor, [message.number for message in drained.messages]))

    def leave(self, topic: str) -> None:
        self.given.append((topic, 'left', []))


def test_each_consumer_gets_its_own_topics() -> None:
    """All share the subscriptions: the sensors' topics also reach consumers without a choice, others only those that chose it."""
    choice = TopicChoice(BagSettings(), [])
    sensors_only, chose, chose_not = Listener(None), Listener(choice, TOPIC), Listener(choice, '/other')
    everyone = [chose, sensors_only, chose_not]
    sensor = SensorSettings(name='talk')
    of_sensor = SensorStream(sensor, TOPIC, TYPE, Accounts(), MessageTypes(), STAMPS, everyone)
    of_sensor.add(messages(1, 2, 2, 3), Senders(), 0.0, paused=False)
    of_sensor.add(messages(3), Senders(), 0.0, paused=False)
    of_sensor.close()
    for each in (sensors_only, chose):
        assert each.given == [(TOPIC, 'talk', [1, 2, 3]), (TOPIC, 'left', [])]
        each.given.clear()
    unsampled = TopicStream(TOPIC, TYPE, MessageTypes(), STAMPS, [chose_not, chose, sensors_only])
    unsampled.add(messages(1), Senders(), 0.0, paused=False)
    unsampled.close()
    assert chose_not.given == chose.given == [(TOPIC, '', [1]), (TOPIC, 'left', [])]
    assert not sensors_only.given
