"""Subscriptions that exist before the intake, over real DDS."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Final

import pytest

pytest.importorskip('rclpy')

from domains import free_domain
from node.intake.test_stream import Batches
from node.participants import Participant
from rclpy.serialization import deserialize_message
from std_msgs.msg import Int32, String

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.core.stamps import StampRule
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.intake.early import EarlyReaders
from shadowhound_data_logger.node.intake.intake import Intake
from shadowhound_data_logger.node.intake.sampling import Sampler
from shadowhound_data_logger.spool.accounts import Accounts

pytestmark = pytest.mark.ros
WAIT_S: Final = 60.0
QUALITIES: Final = {'best_effort': (False, False), 'reliable': (True, False), 'latched': (True, True)}
STRING: Final = 'std_msgs/msg/String'


class Start:
    """A starting node: its early readers, and later its intake."""

    def __init__(self, domain: int, stack: ExitStack) -> None:
        self._stack = stack
        self.robot, self.logger = Participant('robot', domain), Participant('logger', domain)
        stack.callback(self.robot.end)
        stack.callback(self.logger.end)
        self.accounts, self.batches = Accounts(), Batches()

    def sensor(self, name: str, types: tuple[str, ...] = (STRING,)) -> SensorSettings:
        return SensorSettings(name=name, topics=(f'/{name}',), types=types, rate_hz=0.0, batch_s=3600.0)

    def intake(self, early: EarlyReaders, *sensors: SensorSettings) -> Intake:
        named = {sensor.name: sensor for sensor in sensors}
        types = MessageTypes(os.environ.get('AMENT_PREFIX_PATH', '').split(':'))
        sampler = Sampler(named, self.accounts, types, self.batches)  # type: ignore[arg-type]
        stamps = StampRule(SystemClock.of_this_machine())
        intake = Intake(self.logger.node, named, self.accounts, types, stamps, [sampler], early=early)
        intake.open()
        self._stack.callback(intake.close, WAIT_S)
        return intake

    def received(self, topic: str) -> int:
        totals = self.accounts.totals().get(topic)
        return totals.received if totals is not None else 0

    def kept(self, topic: str) -> list[str]:
        return [deserialize_message(sample.cdr, String).data
                for batch in self.batches if batch.topic == topic for sample in batch.samples]  # fmt: skip


def until(condition: Callable[[], object], what: str) -> None:
    end_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end_s, what
        time.sleep(0.01)


@pytest.fixture
def start() -> Iterator[Start]:
    with free_domain() as domain, ExitStack() as stack:
        yield Start(domain, stack)


@pytest.mark.parametrize('quality', QUALITIES)
def test_messages_that_arrive_before_the_intake_exists_are_kept_once(start: Start, quality: str) -> None:
    """Everything published after the match, in order, with any QoS of the publisher, and the messages that follow as well."""
    reliable, latched = QUALITIES[quality]
    start.robot.create(String, '/a', reliable=reliable, latched=latched)
    early = EarlyReaders(start.logger.node, [start.sensor('a')])
    matches = 2 if reliable else 1  # a RELIABLE publisher matches both subscriptions
    until(lambda: start.robot.matched('/a') >= matches, 'the publisher is matched')
    pair = early._readers['/a', STRING]
    until(lambda: sum(reader.matched() for reader in pair) >= matches, 'its subscriptions are matched')
    texts = [str(number) for number in range(300)]
    start.robot.publish(*(String(data=text) for text in texts[:200]), topic='/a', period_s=0.001)
    intake = start.intake(early, start.sensor('a'))
    until(lambda: start.received('/a') >= 200, 'the messages of before are taken')
    start.robot.publish(*(String(data=text) for text in texts[200:]), topic='/a', period_s=0.001)
    until(lambda: start.received('/a') >= 300, 'those that follow are taken')
    assert intake.flush(WAIT_S)
    assert start.kept('/a') == texts


def test_an_unneeded_early_subscription_ends(start: Start) -> None:
    """It belongs to a sensor that is now disabled, or a topic with a type other than in the settings."""
    a, b = start.sensor('a'), start.sensor('b')
    start.robot.create(Int32, '/a')
    early = EarlyReaders(start.logger.node, [a, b])
    assert start.logger.node.count_subscribers('/b') == 2
    intake = start.intake(early, a)
    until(lambda: start.logger.node.count_subscribers('/b') == 0, 'the subscriptions of b end')
    assert intake.flush(WAIT_S)
    assert early.adopt('/b', STRING) == []


def test_topics_that_cannot_be_subscribed_to_early_are_left_to_the_intake(start: Start) -> None:
    """A type that is not installed, several possible types, or none: no exception and no subscription."""
    sensors = [
        start.sensor('a', ('no_such_package/msg/X',)),
        start.sensor('b', (f'{STRING}|std_msgs/msg/Int32',)),
        start.sensor('c', ()),
    ]
    early = EarlyReaders(start.logger.node, sensors)
    assert [start.logger.node.count_subscribers(f'/{name}') for name in 'abc'] == [0, 0, 0]
    early.close()
