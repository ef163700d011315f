"""A hostile neighbor on the robot's network: what it publishes with forged stamps, through DDS, rewrites no day that is over."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip('rclpy')

from domains import free_domain
from nav_msgs.msg import Odometry
from node.participants import Participant
from node.test_publishers import until
from rclpy.serialization import serialize_message

from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.core.config import QueueSettings, SensorSettings
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.core.stamps import DAY_NS, StampRule
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.encoding.encode_pool import BatchQueue, EncodePool
from shadowhound_data_logger.node.intake.intake import Intake
from shadowhound_data_logger.node.intake.sampling import Sampler
from shadowhound_data_logger.spool.accounts import Accounts

TOPIC, TYPE = '/odom', 'nav_msgs/msg/Odometry'
YEAR_NS = 365 * DAY_NS
WAIT_S = 30.0


class Robot:
    """The way of odometry from DDS to finished objects, and a neighbor who publishes it too."""

    def __init__(self, domain: int, stack: ExitStack) -> None:
        self.objects: list[DataObject] = []
        self.accounts = Accounts(clock=SystemClock.of_this_machine())
        self.neighbor = Participant('neighbor', domain)
        stack.callback(self.neighbor.end)
        self.neighbor.create(Odometry, TOPIC)
        logger = Participant('logger', domain)
        stack.callback(logger.end)
        sensors = {'odom': SensorSettings(name='odom', topics=(TOPIC,), types=(TYPE,), rate_hz=0.0)}
        types, stamps, queue = MessageTypes(), StampRule(SystemClock.of_this_machine()), BatchQueue(QueueSettings())
        sampler = Sampler(sensors, self.accounts, types, queue)
        self.intake = Intake(logger.node, sensors, self.accounts, types, stamps, [sampler])
        writer: Any = SimpleNamespace(
            spool=SimpleNamespace(accounts=self.accounts), put=lambda *items: self.objects.extend(items)
        )
        self.pool = EncodePool('thor', queue, sensors, types, writer, [], lambda *_: None, threads=1)
        self.pool.open()
        self.intake.open()
        stack.callback(self.intake.close, WAIT_S)

    def send(self, stamp_ns: int, *, cut: int | None = None) -> None:
        """An odometry message with this stamp, whole or cut off."""
        message = Odometry()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, SECOND)
        self.neighbor.publish(bytes(serialize_message(message))[:cut])

    def finish(self, received: int) -> None:
        until(lambda: self._received() >= received, lambda: f'{received} messages came: {self._received()}')
        assert self.intake.flush(WAIT_S)
        assert self.pool.close(WAIT_S)

    def _received(self) -> int:
        totals = self.accounts.totals().get(TOPIC)
        return totals.received if totals is not None else 0


@pytest.fixture
def robot() -> Iterator[Robot]:
    with free_domain() as domain, ExitStack() as stack:
        yield Robot(domain, stack)


def test_a_neighbor_adds_nothing_to_a_day_that_is_over(robot: Robot) -> None:
    """Malformed and whole messages with stamps of a year ago, and ahead, are dated by their arrival, and counted by reason."""
    until(robot.neighbor.matched, lambda: 'the neighbor is matched')
    began_ns = time.time_ns()
    robot.send(began_ns)
    for years in (-1, 1):
        robot.send(began_ns + years * YEAR_NS, cut=40)
        robot.send(began_ns + years * YEAR_NS)
    robot.send(1, cut=40)
    robot.finish(6)
    ended_ns = time.time_ns()
    snapshot = robot.accounts.snapshot({})
    assert snapshot is not None
    assert {row.key.cause for row in snapshot.gaps} == {'malformed'}
    for row in snapshot.gaps:
        assert row.from_ns is not None
        assert row.to_ns is not None
        assert began_ns <= row.from_ns <= row.to_ns <= ended_ns
    assert sum(row.messages for row in snapshot.gaps) == 3
    assert len(robot.objects) == 3
    assert all(began_ns <= item.t_start_ns <= item.t_end_ns <= ended_ns for item in robot.objects)
    assert robot.accounts.totals()[TOPIC].by_arrival == {'stamp_too_old': 2, 'stamp_ahead': 2, 'stamp_before_2024': 1}
