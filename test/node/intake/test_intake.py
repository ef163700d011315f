"""Publishers of every kind, early and late, alone and together: everything sent after the match is received once."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any, Final

import pytest
from domains import free_domain
from nav_msgs.msg import Odometry
from node.intake.test_stream import Batches
from node.participants import Participant
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.utilities import get_rmw_implementation_identifier
from std_msgs.msg import Int32, String

from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.core.config import QueueSettings, SensorSettings
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.core.stamps import DAY_NS, StampRule
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.encoding.encode_pool import BatchQueue, EncodePool
from shadowhound_data_logger.node.intake.intake import Intake, until_poll
from shadowhound_data_logger.node.intake.sampling import Sampler
from shadowhound_data_logger.ros.endpoints import POLL_S
from shadowhound_data_logger.ros.reader import FAST_DDS
from shadowhound_data_logger.ros.shared_memory import FOLDER
from shadowhound_data_logger.spool.accounts import Accounts
from shadowhound_data_logger.spool.gaps import EXACT


@pytest.mark.parametrize('wall_s', [0.0, 1764003000.0, 1764003000.05, 1764003000.09, 1764003000.11, 1764003000.1999, 5.15])
def test_polls_are_halfway_between_multiples_of_their_period(wall_s: float) -> None:
    """The next poll after any poll is at the nearest such time with at least a quarter of the period in between."""
    pause_s = until_poll(wall_s)
    assert POLL_S / 4 <= pause_s <= 1.25 * POLL_S
    assert (wall_s + pause_s) / POLL_S % 1 == pytest.approx(0.5, abs=1e-5)


pytest.importorskip('rclpy')
WAIT_S: Final = 60.0
NUMBERED: Final = get_rmw_implementation_identifier() in FAST_DDS
"""Whether the RMW numbers messages: only then are missed messages known."""
TYPES: Final = {f'std_msgs/msg/{kind.__name__}': kind for kind in (Int32, String)}
WARM_UP: Final = String(data='warm-up')
QUALITIES: Final = {
    'best_effort': {'reliable': False, 'latched': False},
    'reliable': {'reliable': True, 'latched': False},
    'transient_local': {'reliable': True, 'latched': True},
}
EARLY: Final = [f'early_{name}' for name in QUALITIES]
LATE: Final = [f'late_{name}' for name in QUALITIES]
EXPECTED: Final = ['expected_first', *(f'expected_{name}' for name in QUALITIES)]
OTHERS: Final = ['ended', 'two_best_effort', 'two_reliable', 'mixed', 'retyped', 'vanishing', 'both']
COUNT: Final = 300
HISTORY: Final = 20
PERIOD_S: Final = 0.001


class Listening:
    """A running intake that keeps every message, a program with publishers that started earlier, and one that started later.

    Each sensor has the name of its topic.
    """

    def __init__(self, domain: int, stack: ExitStack) -> None:
        self._domain, self._stack = domain, stack
        self.early = self.join('early')
        for topic, quality in zip(EARLY, QUALITIES.values(), strict=True):
            self.early.create(String, f'/{topic}', **quality)
            if quality['latched']:
                self.early.publish(*texts(range(HISTORY)), topic=f'/{topic}')
        sensors = {}
        for name in (*EARLY, *LATE, *EXPECTED, *OTHERS):
            types = ('std_msgs/msg/String',) if name in EXPECTED else ()
            sensors[name] = SensorSettings(name=name, topics=(f'/{name}',), types=types, rate_hz=0.0, batch_s=3600.0)
        self._accounts, self._batches = Accounts(), Batches()
        installed, queue = MessageTypes(os.environ.get('AMENT_PREFIX_PATH', '').split(':')), self._batches
        stamps = StampRule(SystemClock.of_this_machine())
        sampler = Sampler(sensors, self._accounts, installed, queue)  # type: ignore[arg-type]
        self.logger = self.join('logger')
        self._intake = Intake(self.logger.node, sensors, self._accounts, installed, stamps, [sampler])
        self._intake.open()
        stack.callback(self._intake.close, WAIT_S)
        self.late = self.join('late')

    def join(self, name: str) -> Participant:
        one = Participant(name, self._domain)
        self._stack.callback(one.end)
        return one

    def _graphs(self) -> str:
        """The endpoints each participant has discovered, and the shared memory ports; killed processes leave theirs behind."""
        seen = [f'{one.name} sees {sorted(one.node.get_node_names())}' for one in (self.early, self.logger, self.late)]
        ports = range(*(7400 + 250 * number for number in (self._domain, self._domain + 1)))
        left = [path.name for path in FOLDER.glob('fast*_port*') if int(''.join(filter(str.isdigit, path.name))) in ports]
        return f'in domain {self._domain} {", ".join(seen)}; {sorted(left)}'

    def received(self, topic: str, count: int) -> None:
        """Wait until the intake received this many messages of the topic."""
        until(
            lambda: self._count(topic) >= count, lambda: f'{count} of {topic} are received: {self._accounts.totals().get(topic)}'
        )

    def heard(self, publisher: Participant, topic: str, message: Any = WARM_UP) -> None:
        """Publish the message until the intake received it, so that whatever follows is published after the match."""
        until(lambda: publisher.matched(topic), lambda: f'{topic} is matched: {self._graphs()}')
        before = self._count(topic)

        def is_heard() -> bool:
            publisher.publish(message, topic=topic)
            return self._count(topic) > before

        until(is_heard, lambda: f'{topic} is received')

    def kept(self, sensor: str, least: int) -> dict[type, list[int]]:
        """Type -> the sorted numbers that were kept, once this many messages of the sensor arrived; none were missed."""
        topic = f'/{sensor}'
        self.received(topic, least)
        assert self._intake.flush(WAIT_S)
        totals = self._accounts.totals()[topic]
        assert (totals.rejected, totals.dropped, totals.skipped) == (0, 0, 0)
        assert (totals.accounting == EXACT, totals.missed) == (NUMBERED, 0 if NUMBERED else None)
        with self._accounts.entry(topic) as account:
            published = sum(span.published for span in account.publishers.values())
        assert published == (totals.received if NUMBERED else 0)
        batches = [batch for batch in self._batches if batch.topic == topic]
        assert sum(len(batch.samples) for batch in batches) == totals.received
        found: dict[type, list[int]] = {}
        for batch in batches:
            data = [deserialize_message(sample.cdr, TYPES[batch.type]).data for sample in batch.samples]
            found.setdefault(TYPES[batch.type], []).extend(int(each) for each in data if each not in {'warm-up', -1})
        return {kind: sorted(numbers) for kind, numbers in found.items()}

    def numbers(self, sensor: str, least: int) -> list[int]:
        """The same for a topic of Strings."""
        return self.kept(sensor, least)[String]

    def _count(self, topic: str) -> int:
        totals = self._accounts.totals().get(topic)
        return totals.received if totals is not None else 0


def until(condition: Callable[[], object], what: Callable[[], str]) -> None:
    end_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end_s, what()
        time.sleep(0.01)


def texts(numbers: range) -> list[String]:
    return [String(data=str(number)) for number in numbers]


@pytest.fixture(scope='module')
def listening() -> Iterator[Listening]:
    with free_domain() as domain, ExitStack() as stack:
        yield Listening(domain, stack)


@pytest.mark.ros
@pytest.mark.parametrize('topic', [name for name in EARLY if name != 'early_transient_local'])
def test_messages_of_an_earlier_publisher_are_taken_once(listening: Listening, topic: str) -> None:
    """Everything it publishes after the match is kept once."""
    listening.heard(listening.early, f'/{topic}')
    listening.early.publish(*texts(range(COUNT)), topic=f'/{topic}', period_s=PERIOD_S)
    assert listening.numbers(topic, COUNT + 1) == list(range(COUNT))


@pytest.mark.ros
def test_the_history_of_a_transient_local_publisher_is_taken_once(listening: Listening) -> None:
    """The history of a TRANSIENT_LOCAL publisher is kept too, and everything after it once."""
    listening.received('/early_transient_local', HISTORY)
    listening.early.publish(*texts(range(HISTORY, COUNT)), topic='/early_transient_local', period_s=PERIOD_S)
    assert listening.numbers('early_transient_local', COUNT) == list(range(COUNT))


@pytest.mark.ros
def test_a_latched_and_a_volatile_publisher_are_both_taken(listening: Listening) -> None:
    """The history of the TRANSIENT_LOCAL one and the messages of the other are kept once."""
    listening.late.create(String, '/both')
    listening.heard(listening.late, '/both')
    listening.early.create(String, '/both', latched=True)
    listening.early.publish(*texts(range(HISTORY)), topic='/both')
    for publisher, first in ((listening.early, HISTORY), (listening.late, COUNT)):
        publisher.publish(*texts(range(first, first + COUNT - HISTORY)), topic='/both', period_s=PERIOD_S)
    numbers = listening.numbers('both', 2 * (COUNT - HISTORY) + HISTORY + 1)
    assert numbers == [*range(COUNT), *range(COUNT, 2 * COUNT - HISTORY)]


@pytest.mark.ros
@pytest.mark.parametrize('kind', ['late', 'expected'])
@pytest.mark.parametrize('name', QUALITIES)
def test_messages_of_a_later_publisher_are_taken_once(listening: Listening, kind: str, name: str) -> None:
    """Everything is kept once, whether its type is configured or taken from the graph."""
    topic, publisher = f'{kind}_{name}', listening.late
    publisher.create(String, f'/{topic}', **QUALITIES[name])
    listening.heard(publisher, f'/{topic}')
    publisher.publish(*texts(range(COUNT)), topic=f'/{topic}', period_s=PERIOD_S)
    assert listening.numbers(topic, COUNT + 1) == list(range(COUNT))


@pytest.mark.ros
def test_an_expected_topic_is_matched_from_its_first_message_on(listening: Listening) -> None:
    """A publisher of the expected type that waits for its match loses no message."""
    listening.late.create(String, '/expected_first')
    until(lambda: listening.late.matched('/expected_first'), lambda: 'it is matched')
    listening.late.publish(*texts(range(COUNT)), topic='/expected_first', period_s=PERIOD_S)
    assert listening.numbers('expected_first', COUNT) == list(range(COUNT))


@pytest.mark.ros
def test_a_publisher_that_restarts_is_taken_once(listening: Listening) -> None:
    """The messages before and after the restart are kept once. A killed publisher needs a process: see test/e2e."""
    for life in range(2):
        publisher = listening.join(f'life{life}')
        publisher.create(String, '/ended')
        listening.heard(publisher, '/ended')
        publisher.publish(*texts(range(life * COUNT, (life + 1) * COUNT)), period_s=PERIOD_S)
        listening.received('/ended', (life + 1) * (COUNT + 1))
        publisher.end()
    assert listening.numbers('ended', 2 * COUNT + 2) == list(range(2 * COUNT))


@pytest.mark.ros
@pytest.mark.parametrize(
    ('topic', 'reliable'), [('two_best_effort', (False, False)), ('two_reliable', (True, True)), ('mixed', (False, True))]
)
def test_two_publishers_on_a_topic_are_taken_once(listening: Listening, topic: str, reliable: tuple[bool, bool]) -> None:
    """The messages of both are kept once, also if one is BEST_EFFORT and the other RELIABLE."""
    both = (listening.early, listening.late)
    for publisher, quality in zip(both, reliable, strict=True):
        publisher.create(String, f'/{topic}', reliable=quality)
        listening.heard(publisher, f'/{topic}')
    with ThreadPoolExecutor(2) as pool:
        halves = [texts(range(COUNT)), texts(range(COUNT, 2 * COUNT))]
        publishing = [pool.submit(publisher.publish, *half, topic=f'/{topic}', period_s=PERIOD_S)
                      for publisher, half in zip(both, halves, strict=True)]  # fmt: skip
        for each in publishing:
            each.result(WAIT_S)
    assert listening.numbers(topic, 2 * COUNT + 2) == list(range(2 * COUNT))


@pytest.mark.ros
def test_a_topic_may_change_its_type(listening: Listening) -> None:
    """Messages after the change are kept with the new type, those before it with the old one."""
    publisher = listening.late
    publisher.create(String, '/retyped')
    listening.heard(publisher, '/retyped')
    publisher.publish(*texts(range(COUNT)), topic='/retyped', period_s=PERIOD_S)
    listening.received('/retyped', COUNT + 1)
    publisher.leave('/retyped')
    publisher.create(Int32, '/retyped')
    listening.heard(publisher, '/retyped', Int32(data=-1))
    numbers = [Int32(data=number) for number in range(COUNT, 2 * COUNT)]
    publisher.publish(*numbers, topic='/retyped', period_s=PERIOD_S)
    assert listening.kept('retyped', 2 * COUNT + 2) == {String: list(range(COUNT)), Int32: list(range(COUNT, 2 * COUNT))}


@pytest.mark.ros
def test_a_publisher_that_vanishes_leaves_the_others_alone(listening: Listening) -> None:
    """When one of two publishers ends, nothing from the other is lost, though the subscriptions change."""
    staying, leaving = listening.early, listening.late
    for publisher, reliable in ((staying, False), (leaving, True)):
        publisher.create(String, '/vanishing', reliable=reliable)
        listening.heard(publisher, '/vanishing')
    with ThreadPoolExecutor(1) as pool:
        publishing = pool.submit(staying.publish, *texts(range(4 * COUNT)), topic='/vanishing', period_s=2 * PERIOD_S)
        leaving.leave('/vanishing')
        publishing.result(WAIT_S)
    assert listening.numbers('vanishing', 4 * COUNT + 2) == list(range(4 * COUNT))


pytest.importorskip('rclpy')

TOPIC, TYPE = '/odom', 'nav_msgs/msg/Odometry'
YEAR_NS = 365 * DAY_NS
FORGED_WAIT_S = 30.0


class Robot:
    """The path of odometry from DDS to finished objects, and another robot that publishes it too."""

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
        stack.callback(self.intake.close, FORGED_WAIT_S)

    def send(self, stamp_ns: int, *, cut: int | None = None) -> None:
        """An odometry message with this stamp, complete or truncated."""
        message = Odometry()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, SECOND)
        self.neighbor.publish(bytes(serialize_message(message))[:cut])

    def finish(self, received: int) -> None:
        until(lambda: self._received() >= received, lambda: f'{received} messages received: {self._received()}')
        assert self.intake.flush(FORGED_WAIT_S)
        assert self.pool.close(FORGED_WAIT_S)

    def _received(self) -> int:
        totals = self.accounts.totals().get(TOPIC)
        return totals.received if totals is not None else 0


@pytest.fixture
def robot() -> Iterator[Robot]:
    with free_domain() as domain, ExitStack() as stack:
        yield Robot(domain, stack)


def test_a_neighbor_adds_nothing_to_a_day_that_is_over(robot: Robot) -> None:
    """Malformed and valid messages with stamps a year in the past or future are dated by their arrival, and counted by reason."""
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
