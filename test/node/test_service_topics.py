"""Event topics of services and topics of actions, over real DDS: received, counted, decoded and defined like every topic."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip('rclpy')

from node.participants import Participant
from node.test_other_types import Listening
from rclpy.action import ActionClient, ActionServer
from rclpy.executors import SingleThreadedExecutor
from rosbags.highlevel import AnyReader

from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.core.model import Batch
from shadowhound_data_logger.formats.definitions import describe
from shadowhound_data_logger.formats.encoders import encode
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import metadata_yaml
from shadowhound_data_logger.formats.mcap.slice_info import Channel
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.formats.types import MessageTypes

pytestmark = pytest.mark.ros


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
        """What calls the service once; both of its sides publish events with their contents."""
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
        """What sends a goal once; the action gives feedback once."""
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
    """What the logger receives of a topic when its publisher is made to publish."""
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
    """The messages of a batch as the JSON has them."""
    sensor = SensorSettings(name='sensor', topics=(batch.topic,), rate_hz=0.0, batch_s=1.0, format='json')
    made = encode(batch, sensor, 'thor', MessageTypes(os.environ['AMENT_PREFIX_PATH'].split(':')))
    assert made.object is not None
    assert not made.rejected
    found: list[dict[str, Any]] = json.loads(made.object.body)['samples']
    return found


def read_as_bag(batch: Batch, folder: Path) -> list[Any]:
    """The messages of a batch as another reader has them, from a slice that defines its type."""
    folder.mkdir()
    writer = SliceWriter(folder / f'{folder.name}_0.mcap')
    channel = Channel(batch.topic, batch.type, *describe(batch.type), '')
    for number, sample in enumerate(batch.samples):
        writer.write(channel, sample.stamp_ns, sample.stamp_ns, number, sample.cdr)
    (folder / 'metadata.yaml').write_bytes(metadata_yaml([writer.close()], ros_distro='jazzy'))
    with AnyReader([folder]) as reader:
        return [reader.deserialize(cdr, connection.msgtype) for connection, _, cdr in reader.messages()]


def test_service_events(robot: Robot, logger: Listening, tmp_path: Path) -> None:
    """The four events of a call are logged with request and response, and can be read from a bag without ROS."""
    call = robot.offer_trigger()
    batch = received(logger, '/bark/_service_event', 'std_srvs/srv/Trigger_Event', robot, call, 4)
    events = {sample['info']['event_type']: sample for sample in documents(batch)}
    assert events.keys() == {0, 1, 2, 3}
    assert [len(events[kind]['request']) for kind in range(4)] == [1, 1, 0, 0]
    assert events[3]['response'] == events[2]['response'] == [{'success': True, 'message': 'bark'}]
    assert sorted(event.info.event_type for event in read_as_bag(batch, tmp_path / 'bag')) == [0, 1, 2, 3]


def test_feedback(robot: Robot, logger: Listening, tmp_path: Path) -> None:
    """The feedback of an action is logged, and can be read from a bag without ROS."""
    call = robot.offer_fibonacci()
    batch = received(logger, '/count/_action/feedback', 'test_msgs/action/Fibonacci_FeedbackMessage', robot, call, 1)
    (sample,) = documents(batch)
    assert sample['feedback'] == {'sequence': [0, 1, 1, 2]}
    assert len(sample['goal_id']['uuid']) == 16
    (message,) = read_as_bag(batch, tmp_path / 'bag')
    assert message.feedback.sequence.tolist() == [0, 1, 1, 2]


def test_status_of_goals(robot: Robot, logger: Listening, tmp_path: Path) -> None:
    """The states of an action's goals are logged."""
    call = robot.offer_fibonacci()
    batch = received(logger, '/count/_action/status', 'action_msgs/msg/GoalStatusArray', robot, call, 3)
    assert [goal['status'] for goal in documents(batch)[-1]['status_list']] == [4]
    assert read_as_bag(batch, tmp_path / 'bag')[-1].status_list[0].status == 4
