"""Topics with two types, and topics of services and actions, over real DDS: the configured type is logged, others counted."""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import pytest
from node.intake.test_stream import Batches
from node.participants import Participant
from rclpy.action import ActionClient, ActionServer
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.utilities import get_rmw_implementation_identifier
from rosbags.highlevel import AnyReader
from std_msgs.msg import Float64, Int32, String

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.core.model import Batch
from shadowhound_data_logger.core.stamps import StampRule
from shadowhound_data_logger.core.status import OtherType, Totals
from shadowhound_data_logger.formats.definitions import describe
from shadowhound_data_logger.formats.encoders import encode
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import metadata_yaml
from shadowhound_data_logger.formats.mcap.slice_info import Channel
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.intake import subscriber as module
from shadowhound_data_logger.node.intake.sampling import Sampler
from shadowhound_data_logger.node.intake.subscriber import Dependencies, OtherTypes, Subscriber
from shadowhound_data_logger.ros import endpoints
from shadowhound_data_logger.ros.endpoints import Endpoint
from shadowhound_data_logger.ros.reader import FAST_DDS, PolledGroup
from shadowhound_data_logger.spool.accounts import Accounts
from shadowhound_data_logger.spool.gaps import EXACT
from shadowhound_data_logger.spool.topic_account import RECEIVED_ONLY

pytest.importorskip('rclpy')

pytestmark = pytest.mark.ros
WAIT_S: Final = 60.0
INT, STRING, FLOAT = (f'std_msgs/msg/{name}' for name in ('Int32', 'String', 'Float64'))
ABSENT: Final = 'no_such_msgs/msg/Thing'
"""A history of ten messages: more than that published between two drains is missed."""
HISTORY: Final = 10
NUMBERED: Final = get_rmw_implementation_identifier() in FAST_DDS
"""Whether the RMW numbers messages: only then are missed messages known."""
NOTHING: Final = Totals('', None, 0, 0, 0, 0, 0, 0, None, None, 0)


class Listening(Participant):
    """A sensor's subscriber as in the intake, polled by the test."""

    def __init__(self, domain: int) -> None:
        super().__init__('logger', domain)
        self.accounts = Accounts()
        self.batches = Batches()
        self.sampler: Sampler
        self.others = OtherTypes(self.node, self.accounts)
        self.source: Subscriber

    def listen(self, topic: str, type_name: str = '', *, fallback: tuple[str, str] = ('', '')) -> None:
        topics = (topic, fallback[0]) if fallback[0] else (topic,)
        types = (type_name, fallback[1]) if fallback[0] else (type_name,) if type_name else ()
        sensor = SensorSettings(name='sensor', topics=topics, types=types, rate_hz=0.0, batch_s=3600.0)
        types_here = MessageTypes(os.environ.get('AMENT_PREFIX_PATH', '').split(':'))
        stamps = StampRule(SystemClock.of_this_machine())
        around = Dependencies(self.node, PolledGroup(), self.accounts, types_here, stamps)
        self.sampler = Sampler({sensor.name: sensor}, self.accounts, types_here, self.batches)
        self.source = Subscriber(around, sensor, [self.sampler], self.others)

    def turn(self) -> None:
        """One iteration of the intake."""
        now_s = time.monotonic()
        self.source.refresh(now_s)
        self.source.drain(now_s)
        self.others.drain()

    def until(self, condition: Callable[[], object], what: str) -> None:
        end = time.monotonic() + WAIT_S
        while not condition():
            assert time.monotonic() < end, f'{what}: {self.accounts.totals()}'
            self.turn()
            time.sleep(0.02)

    def refused(self, topic: str, squatter: Participant, *messages: Any) -> int:
        """The number of counted messages of another type, once all of these are: counting starts with the first one received."""
        while not self.totals(topic).rejected:
            squatter.publish(messages[0])
            self.until(squatter.matched, 'it is matched')
            self.turn()
        time.sleep(0.2)
        self.turn()
        before = self.totals(topic).rejected
        squatter.publish(*messages)
        self.until(lambda: self.totals(topic).rejected == before + len(messages), 'each is counted')
        return before + len(messages)

    def numbers(self) -> list[int]:
        """The numbers logged by the sensor so far, all of one type."""
        self.source.drain(time.monotonic())
        self.sampler.flush()
        assert {batch.type for batch in self.batches} <= {INT}
        return [deserialize_message(sample.cdr, Int32).data for batch in self.batches for sample in batch.samples]

    def depth(self) -> int:
        """Depth of its shortest history."""
        return min(reader.plan.depth for reader in self.source._readers)

    def totals(self, topic: str) -> Totals:
        return self.accounts.totals().get(topic, NOTHING)

    def end(self) -> None:
        self.others.close()
        self.source.close(time.monotonic())
        super().end()


@pytest.fixture
def make(domain: int) -> Iterator[Callable[[str], Participant]]:
    with ExitStack() as stack:

        def make_one(name: str) -> Participant:
            one = Listening(domain) if name == 'logger' else Participant(name, domain)
            stack.callback(one.end)
            return one

        yield make_one


def ints(count: int, first: int = 0) -> list[Int32]:
    return [Int32(data=number) for number in range(first, first + count)]


@pytest.mark.long('a second of CPU or more')
@pytest.mark.parametrize('order', ['squatter, node, robot', 'node, squatter, robot', 'robot, node, squatter'])
@pytest.mark.parametrize('reliable', [True, False])
def test_the_configured_type_wins(
    make: Callable[[str], Any], monkeypatch: pytest.MonkeyPatch, order: str, *, reliable: bool
) -> None:
    """In any order and with any QoS: the sensor's messages are logged and their gaps counted, the others refused."""
    monkeypatch.setattr(endpoints, 'SMALL_RATE_HZ', HISTORY / endpoints.STALL_S)
    logger, robot, squatter = make('logger'), make('robot'), make('squatter')
    steps = {
        'node': lambda: (logger.listen('/odom', INT), logger.turn()),
        'robot': lambda: robot.create(Int32, '/odom', reliable=False),
        'squatter': lambda: squatter.create(String, '/odom', reliable=reliable, latched=reliable),
    }
    for step in order.split(', '):
        steps[step]()
        if step == 'squatter' and order.startswith('node'):
            logger.until(lambda: logger.totals('/odom').other_types, 'the other type is seen')
    logger.until(lambda: logger.source.status().matched and robot.matched() and squatter.matched(), 'all are matched')
    logger.until(lambda: logger.source.status().publishers == 1, 'publishers of the type')
    refused = logger.refused('/odom', squatter, *[String(data='I am odometry')] * 5)
    robot.publish(*ints(5))
    logger.until(lambda: logger.totals('/odom').received == refused + 5, 'its own are received')
    robot.publish(*ints(4 * HISTORY, 5))  # not drained in between: all but the last ones are lost
    logger.until(lambda: logger.totals('/odom').received == refused + 5 + HISTORY, 'the last ones are received')
    assert logger.numbers() == [*range(5), *range(5 + 3 * HISTORY, 5 + 4 * HISTORY)]
    totals = logger.totals('/odom')
    assert (totals.type, totals.accounting == EXACT, totals.missed) == (INT, NUMBERED, 3 * HISTORY if NUMBERED else None)
    assert totals.open == 5 + HISTORY
    (row,) = logger.accounts.snapshot({}).topics  # type: ignore[union-attr]
    assert row.rejected == {'wrong_type': refused}
    fields = {STRING: OtherType(('/squatter',), refused)}
    logger.until(lambda: logger.totals('/odom').other_types == fields, 'its node is known, which its messages do not wait for')


def test_an_uninstalled_type_is_reported(make: Callable[[str], Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """The number of such messages is unknown, not 0; the sensor's account stays exact."""
    real = module.unavailable
    monkeypatch.setattr(module, 'unavailable', lambda name: 'not here' if name == STRING else real(name))
    logger, robot, squatter = make('logger'), make('robot'), make('squatter')
    squatter.create(String, '/odom')
    robot.create(Int32, '/odom')
    logger.listen('/odom', INT)
    logger.until(lambda: logger.source.status().matched and robot.matched(), 'its own is matched')
    logger.until(lambda: logger.totals('/odom').other_types.get(STRING, OtherType()).publishers, 'the other one is seen')
    squatter.publish(String())
    robot.publish(*ints(3))
    logger.until(lambda: logger.totals('/odom').received == 3, 'its own are received')
    totals = logger.totals('/odom')
    assert (totals.accounting == EXACT, totals.missed, totals.rejected) == (NUMBERED, 0 if NUMBERED else None, 0)
    assert totals.other_types == {STRING: OtherType(('/squatter',), None)}
    assert not squatter.matched()


def test_a_type_is_not_reported_while_its_definition_is_requested(make: Callable[[str], Any], monkeypatch: pytest.MonkeyPatch,
                                                                  caplog: pytest.LogCaptureFixture) -> None:  # fmt: skip
    """Its publisher may answer; once it did the topic is received, and nothing was logged about its package."""
    real, known = module.unavailable, set[str]()
    monkeypatch.setattr(module, 'unavailable', lambda name: real(name) if name in known else 'not here')
    monkeypatch.setattr(module, 'is_installed', lambda _: False)
    logger, robot = make('logger'), make('robot')
    robot.create(Int32, '/odom')
    logger.listen('/odom', INT)
    answers = iter([True, True])
    asked: list[str] = []

    def poll(topic: str, type_name: str, now_s: float) -> bool:
        asked.append(f'{topic} {type_name}')
        if not next(answers, False):
            known.add(INT)
        return True

    logger.source._descriptions = SimpleNamespace(poll=poll)
    logger.until(robot.matched, 'it is subscribed to')
    assert set(asked) == {f'/odom {INT}'}
    assert 'is not logged' not in caplog.text
    assert not logger.source.status().unavailable


def test_a_third_type_is_not_counted(make: Callable[[str], Any]) -> None:
    """One other type per topic is received; for more the count is unknown."""
    logger, first, second = make('logger'), make('first'), make('second')
    logger.listen('/odom', INT)
    first.create(String, '/odom')
    logger.until(first.matched, 'the first is counted')
    second.create(Float64, '/odom')
    logger.until(lambda: len(logger.totals('/odom').other_types) == 2, 'the second is seen')
    refused = logger.refused('/odom', first, String())
    messages = {name: row.messages for name, row in logger.totals('/odom').other_types.items()}
    assert messages == {STRING: refused, FLOAT: None}


def test_the_number_of_types_is_limited(make: Callable[[str], Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that creates many types costs no more subscriptions than that."""
    monkeypatch.setattr(module, 'MAX_OTHERS', 0)
    logger, squatter = make('logger'), make('squatter')
    logger.listen('/odom', INT)
    squatter.create(String, '/odom')
    logger.until(lambda: logger.totals('/odom').other_types, 'it is seen')
    assert logger.totals('/odom').other_types[STRING].messages is None
    assert not squatter.matched()


def test_without_a_configured_type_the_first_is_kept(make: Callable[[str], Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """More publishers of another type change nothing while it has one; the loss of messages it cannot receive is unknown."""
    logger, robot = make('logger'), make('robot')
    robot.create(Int32, '/odom')
    logger.listen('/odom')
    logger.until(robot.matched, 'the first publisher is matched')
    for name in ('one', 'two'):
        make(name).create(String, '/odom')
    logger.until(lambda: logger.totals('/odom').other_types, 'the others are seen')
    robot.publish(*ints(3))
    logger.until(lambda: logger.totals('/odom').received == 3, 'messages of the first publisher arrive')
    assert logger.numbers() == [0, 1, 2]
    assert logger.totals('/odom').missed == (0 if NUMBERED else None)
    real = module.unavailable
    monkeypatch.setattr(module, 'unavailable', lambda name: 'not here' if name == FLOAT else real(name))
    make('three').create(Float64, '/odom')
    logger.until(lambda: FLOAT in logger.totals('/odom').other_types, 'the third is seen')
    assert (logger.totals('/odom').accounting, logger.totals('/odom').missed) == (RECEIVED_ONLY, None)


def test_a_dead_publisher_in_the_graph_does_not_count(make: Callable[[str], Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Its type is replaced by the one published now: no node has it any more (Fast DDS 2.6 next to Cyclone DDS)."""
    logger, robot = make('logger'), make('robot')
    real, seen = module.endpoints, {}

    def kept(node: Node, topic: str) -> list[Endpoint]:
        found = {each.gid: each for each in real(node, topic)}
        seen.update(found)
        return [*found.values(), *(replace(each, node='') for gid, each in seen.items() if gid not in found)]

    monkeypatch.setattr(module, 'endpoints', kept)
    robot.create(String, '/odom')
    logger.listen('/odom')
    logger.until(lambda: any(each.node for each in seen.values()), 'it is known as of its node')
    logger.until(robot.matched, 'the publisher is matched')
    robot.leave()
    robot.create(Int32, '/odom')
    logger.until(lambda: logger.source.status().publishers == 1 and logger.totals('/odom').type == INT, 'the other type is taken')
    logger.until(robot.matched, 'its successor is matched')
    robot.publish(*ints(3))
    logger.until(lambda: logger.totals('/odom').received == 3, 'it is received')
    assert logger.numbers() == [0, 1, 2]


def test_a_publisher_of_another_type_does_not_make_a_topic_preferred(make: Callable[[str], Any]) -> None:
    """A sensor uses its second topic while the first has no publisher of its type."""
    logger, robot, squatter = make('logger'), make('robot'), make('squatter')
    squatter.create(String, '/preferred')
    robot.create(Int32, '/second')
    logger.listen('/preferred', INT, fallback=('/second', INT))
    logger.until(robot.matched, 'the second topic is taken')
    robot.publish(*ints(3))
    logger.until(lambda: logger.totals('/second').received == 3, 'it is received')
    assert logger.source.topic == '/second'


def test_an_abandoned_topic_gets_its_new_type(make: Callable[[str], Any]) -> None:
    """A disabled sensor has no subscription to its topic any more."""
    logger, squatter = make('logger'), make('squatter')
    logger.listen('/odom', INT)
    squatter.create(String, '/odom')
    logger.until(squatter.matched, 'it is counted')
    logger.source.update(replace(logger.source.sensor, enabled=False), time.monotonic())
    logger.until(lambda: not squatter.matched(), 'it is not listened to')


@pytest.mark.skipif(get_rmw_implementation_identifier() not in FAST_DDS, reason='Cyclone DDS lets a program have both types')
def test_a_topic_that_the_node_publishes_keeps_its_type(make: Callable[[str], Any]) -> None:
    """What this node publishes itself can be received in that type only: another one is reported, and stops nothing."""
    logger, squatter = make('logger'), make('squatter')
    logger.create(Int32, '/own')
    logger.leave()
    logger.create(Int32, '/own')
    squatter.create(String, '/own')
    logger.listen('/own', STRING)
    logger.until(lambda: logger.source.status().unavailable, 'the other type is reported')
    assert f'no subscription of type {STRING} can be made' in logger.source.status().unavailable  # Humble's rcl drops the reason


def test_a_topic_faster_than_its_history_gets_a_longer_one(make: Callable[[str], Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is lost or counted twice as one subscription replaces the other, and afterwards a stall fits into it."""
    monkeypatch.setattr(endpoints, 'SMALL_RATE_HZ', HISTORY / endpoints.STALL_S)
    logger, robot = make('logger'), make('robot')
    logger.listen('/odom', INT)
    robot.create(Int32, '/odom', reliable=False)
    logger.until(lambda: logger.source.status().matched and robot.matched(), 'they are matched')
    robot.publish(*ints(HISTORY - 1))
    logger.until(lambda: logger.totals('/odom').received == HISTORY - 1, 'the first ones are received')
    logger.until(lambda: logger.depth() >= 3 * HISTORY, 'the shorter history is gone')
    robot.publish(*ints(3 * HISTORY, HISTORY - 1))
    logger.until(lambda: logger.totals('/odom').received == 4 * HISTORY - 1, 'all are received')
    assert logger.numbers() == [*range(4 * HISTORY - 1)]
    assert logger.totals('/odom').missed == (0 if NUMBERED else None)


pytest.importorskip('rclpy')


class Robot(Participant):
    """Offers a service or an action, and calls it, while its executor runs."""

    def __init__(self, domain: int) -> None:
        super().__init__('robot', domain)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._executor.spin)
        self._leaving = ExitStack()

    def run(self) -> None:
        self._thread.start()

    def end(self) -> None:
        self._executor.shutdown()
        self._thread.join()
        self._leaving.close()
        super().end()

    def offer_trigger(self) -> Callable[[], Any]:
        """Calls the service once; both sides publish service events with contents."""
        introspection = pytest.importorskip('rclpy.service_introspection', reason='Humble has no service events')
        from rclpy.qos import qos_profile_system_default
        from std_srvs.srv import Trigger

        def answer(_: Any, response: Any) -> Any:
            response.success, response.message = True, 'bark'
            return response

        service = self.node.create_service(Trigger, '/bark', answer)
        client = self.node.create_client(Trigger, '/bark')
        for side in (service, client):
            side.configure_introspection(
                self.node.get_clock(), qos_profile_system_default, introspection.ServiceIntrospectionState.CONTENTS
            )
        return lambda: client.wait_for_service(10.0) and client.call_async(Trigger.Request())

    def offer_fibonacci(self) -> Callable[[], Any]:
        """Sends a goal once; the action gives feedback once."""
        action = pytest.importorskip('test_msgs.action').Fibonacci

        def execute(goal: Any) -> Any:
            goal.publish_feedback(action.Feedback(sequence=[0, 1, 1, 2]))
            goal.succeed()
            return action.Result(sequence=[0, 1, 1, 2, 3])

        server, client = (ActionServer(self.node, action, '/count', execute), ActionClient(self.node, action, '/count'))
        for each in (server, client):
            self._leaving.callback(each.destroy)
        return lambda: client.wait_for_server(10.0) and client.send_goal_async(action.Goal(order=5))


@pytest.fixture
def robot(domain: int) -> Iterator[Robot]:
    one = Robot(domain)
    yield one
    one.end()


@pytest.fixture
def logger(domain: int) -> Iterator[Listening]:
    one = Listening(domain)
    yield one
    one.end()


def received(logger: Listening, topic: str, type_name: str, robot: Robot, call: Callable[[], Any], count: int) -> Batch:
    """Messages that the logger receives from a topic when its publisher is made to publish."""
    logger.listen(topic)
    robot.run()
    logger.until(lambda: logger.source.status().matched, 'it is matched')
    call()
    logger.until(lambda: logger.totals(topic).received >= count, 'it is received')
    logger.sampler.flush()
    totals = logger.totals(topic)
    assert (totals.type, totals.rejected) == (type_name, 0)
    (batch,) = logger.batches
    assert (batch.topic, batch.type) == (topic, type_name)
    return batch


def documents(batch: Batch) -> list[dict[str, Any]]:
    """The messages of a batch as JSON."""
    sensor = SensorSettings(name='sensor', topics=(batch.topic,), rate_hz=0.0, batch_s=1.0, format='json')
    made = encode(batch, sensor, 'thor', MessageTypes(os.environ['AMENT_PREFIX_PATH'].split(':')))
    assert made.object is not None
    assert not made.rejected
    found: list[dict[str, Any]] = json.loads(made.object.body)['samples']
    return found


def read_as_bag(batch: Batch, folder: Path) -> list[Any]:
    """The messages of a batch as another reader decodes them, from a slice that defines its type."""
    folder.mkdir()
    writer = SliceWriter(folder / f'{folder.name}_0.mcap')
    channel = Channel(batch.topic, batch.type, *describe(batch.type), '')
    for number, sample in enumerate(batch.samples):
        writer.write(channel, sample.stamp_ns, sample.stamp_ns, number, sample.cdr)
    (folder / 'metadata.yaml').write_bytes(metadata_yaml([writer.close()], ros_distro='jazzy'))
    with AnyReader([folder]) as reader:
        return [reader.deserialize(cdr, connection.msgtype) for connection, _, cdr in reader.messages()]


def test_service_events_are_logged(robot: Robot, logger: Listening, tmp_path: Path) -> None:
    """The four events of a call are logged with request and response, and can be read from a bag without ROS."""
    call = robot.offer_trigger()
    batch = received(logger, '/bark/_service_event', 'std_srvs/srv/Trigger_Event', robot, call, 4)
    events = {sample['info']['event_type']: sample for sample in documents(batch)}
    assert events.keys() == {0, 1, 2, 3}
    assert [len(events[kind]['request']) for kind in range(4)] == [1, 1, 0, 0]
    assert events[3]['response'] == events[2]['response'] == [{'success': True, 'message': 'bark'}]
    assert sorted(event.info.event_type for event in read_as_bag(batch, tmp_path / 'bag')) == [0, 1, 2, 3]


def test_feedback_of_an_action_is_logged(robot: Robot, logger: Listening, tmp_path: Path) -> None:
    """It can be read from a bag without ROS."""
    call = robot.offer_fibonacci()
    batch = received(logger, '/count/_action/feedback', 'test_msgs/action/Fibonacci_FeedbackMessage', robot, call, 1)
    (sample,) = documents(batch)
    assert sample['feedback'] == {'sequence': [0, 1, 1, 2]}
    assert len(sample['goal_id']['uuid']) == 16
    (message,) = read_as_bag(batch, tmp_path / 'bag')
    assert message.feedback.sequence.tolist() == [0, 1, 1, 2]


def test_the_status_of_goals_is_logged(robot: Robot, logger: Listening, tmp_path: Path) -> None:
    call = robot.offer_fibonacci()
    batch = received(logger, '/count/_action/status', 'action_msgs/msg/GoalStatusArray', robot, call, 3)
    assert [goal['status'] for goal in documents(batch)[-1]['status_list']] == [4]
    assert read_as_bag(batch, tmp_path / 'bag')[-1].status_list[0].status == 4
