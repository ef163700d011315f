"""The number of topics for bags and events is limited, however many exist: over real DDS, with low limits."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, Final

import pytest

pytest.importorskip('rclpy')

import rclpy
from rclpy.node import Node
from std_msgs.msg import String

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import BagSettings
from shadowhound_data_logger.core.stamps import StampRule
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.intake import extra_topics as module
from shadowhound_data_logger.node.intake.consumers import TopicChoice
from shadowhound_data_logger.node.intake.extra_topics import ExtraTopics
from shadowhound_data_logger.node.intake.subscriber import Dependencies
from shadowhound_data_logger.ros.reader import PolledGroup
from shadowhound_data_logger.spool.accounts import Accounts

pytestmark = pytest.mark.ros
WAIT_S: Final = 60.0
GRAPH: Final = ('/imu', '/odom', '/camera/image_raw', '/_hidden', '/a/_hidden/b', '/rosout')
SENSORS: Final = ('/imu', '/camera/compressed')


@contextmanager
def a_node(name: str, domain: int) -> Iterator[Node]:
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=domain)
    made = Node(name, context=context, start_parameter_services=False, enable_rosout=False)
    try:
        yield made
    finally:
        made.destroy_node()
        rclpy.try_shutdown(context=context)


@pytest.fixture
def robot(domain: int) -> Iterator[Node]:
    with a_node('robot', domain) as made:
        yield made


class Recording:
    """The topics of a bag of ``/crowd/...`` and of the named topic ``/named``."""

    def __init__(self, node: Node) -> None:
        choice = TopicChoice(BagSettings(regex='^/crowd/'), ['/named'])
        self.bags: Any = SimpleNamespace(topics=frozenset(), wanted_topics=choice, wants_latched=True, take=lambda _: None,
                                         leave=lambda _: None)  # fmt: skip
        self.group = PolledGroup()
        stamps = StampRule(SystemClock.of_this_machine())
        around = Dependencies(node, self.group, Accounts(), MessageTypes(), stamps)
        self.extra = ExtraTopics(around, [self.bags], {})
        self.now_s = time.monotonic()

    def poll(self, seconds: float = 0.0) -> set[str]:
        self.now_s += seconds
        self.extra.refresh({}, (), self.now_s, paused=False)
        return {source.topic for source in self.extra.own if source.status().matched}

    def until(self, condition: Callable[[set[str]], object]) -> set[str]:
        end = time.monotonic() + WAIT_S
        while not condition(found := self.poll()):
            assert time.monotonic() < end, found
            time.sleep(0.02)
        return found


@pytest.fixture
def recording(domain: int) -> Iterator[Recording]:
    with a_node('logger', domain) as node:
        made = Recording(node)
        yield made
        made.extra.end(made.now_s)


def crowd(robot: Node, *names: str) -> list[Any]:
    return [robot.create_publisher(String, name, 1) for name in names]


def test_unconfigured_topics_are_limited(
    robot: Node, recording: Recording, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A topic above the limit is skipped, logged once and counted; a named topic always has a place."""
    monkeypatch.setattr(module, 'MAX_FOUND', 3)
    crowd(robot, *(f'/crowd/{letter}' for letter in 'abcde'))
    with caplog.at_level(logging.WARNING):
        recording.until(lambda found: len(found) == 3 and recording.extra.consumer.left_out == 2)
        crowd(robot, '/named')
        assert recording.until(lambda found: '/named' in found and len(found) == 4)
        recording.poll()
    reports = [record for record in caplog.records if 'not recorded' in record.message]
    assert len(reports) == 1
    assert recording.bags.topics == {source.topic for source in recording.extra.own}


def test_an_abandoned_topic_frees_its_place(robot: Node, recording: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    """The subscription is removed some time after its publisher left, and another topic takes its place."""
    monkeypatch.setattr(module, 'MAX_FOUND', 1)
    (first,) = crowd(robot, '/crowd/a')
    recording.until(lambda found: found == {'/crowd/a'})
    crowd(robot, '/crowd/b')
    recording.until(lambda _: recording.extra.consumer.left_out == 1)
    robot.destroy_publisher(first)
    recording.until(lambda found: not found)
    recording.poll(module.GONE_S + 1)
    recording.until(lambda found: found == {'/crowd/b'})
    assert [source.topic for source in recording.extra.own] == ['/named', '/crowd/b']


def test_topics_that_come_and_go_are_limited(robot: Node, recording: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    """The middleware keeps some memory for each name: new ones are followed only up to a limit."""
    monkeypatch.setattr(module, 'MAX_EVER', 2)
    for name in ('/crowd/a', '/crowd/b', '/crowd/c'):
        (publisher,) = crowd(robot, name)
        if name == '/crowd/c':
            recording.until(lambda _: recording.extra.consumer.left_out == 1)
        else:
            recording.until(lambda found, name=name: name in found)
            robot.destroy_publisher(publisher)
            recording.until(lambda found: not found)
            recording.poll(module.GONE_S + 1)
    (again,) = crowd(robot, '/crowd/a')
    recording.until(lambda found: '/crowd/a' in found)
    assert len(recording.group.entities) <= 3, 'rclpy keeps a mark of each subscription that ever was'
    assert again


@pytest.mark.parametrize(('named', 'regex', 'exclude', 'wanted'), [
    ((), '', '', SENSORS), (('/x',), '', '', ('/x',)), ((), '.*', '', ('/imu', '/odom', '/camera/image_raw', '/rosout')),
    ((), '.*', 'raw|rosout', ('/imu', '/odom')), (('/x', '/rosout'), 'im', 'raw|rosout', ('/x', '/rosout', '/imu')),
    ((), '^/imu$', '', ('/imu',)), ((), 'nothing', '', ()), ((), '/_hidden$', '', ('/_hidden',)),
    ((), '.*|/_', 'imu|odom|raw|rosout', ('/_hidden', '/a/_hidden/b')),
])  # fmt: skip
def test_topics_are_selected_by_name_and_pattern(
    named: tuple[str, ...], regex: str, exclude: str, wanted: tuple[str, ...]
) -> None:
    """Those that are named, or match and are neither excluded nor hidden (unless the regex has /_); by default the sensors'."""
    choice = TopicChoice(BagSettings(regex=regex, exclude=exclude), named)
    assert choice.needs_graph is bool(regex)
    assert choice.wanted(SENSORS, GRAPH) == set(wanted)


@pytest.mark.parametrize(
    'name', ['/%s%n', '/1digit', '//double', '/{curly}~', '/a b', '/a\x1b]0;owned\x07', '/ä', 'relative', '/a' * 150]
)
def test_names_that_are_invalid_in_ros_are_ignored(name: str) -> None:
    """A program without ROS may use any name; an expression that matches it still selects the other topics."""
    assert TopicChoice(BagSettings(regex='.*'), ()).wanted((), [name, '/good']) == {'/good'}
