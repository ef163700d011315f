"""Publishers that only the front discovers are reported after a while, until they are discovered or gone."""

from __future__ import annotations

import logging
from typing import Any

import pytest

from shadowhound_data_logger.node.intake.undiscovered import MAX_PUBLISHERS, SETTLED_S, SILENT_S, UndiscoveredPublishers

IMU = 'sensor_msgs/msg/Imu'
STEP_S = 2.0


class Robot:
    """A graph on each side; ``wait`` lets time pass while the front reports every two seconds."""

    def __init__(self, **topics: str) -> None:
        self.now_s = 100.0
        self.theirs: dict[str, list[list[str]]] = {}
        self.ours: dict[str, set[str]] = {}
        self.topics = {f'/{name}': type_name for name, type_name in topics.items()}
        self.undiscovered = UndiscoveredPublishers(
            'rmw_ours', 'rmw_theirs', lambda: self.topics, lambda topic: self.ours.get(topic, set()), monotonic=lambda: self.now_s
        )

    def wait(self, seconds: float) -> None:
        end_s = self.now_s + seconds
        while self.now_s <= end_s:
            self.undiscovered.compare(self.theirs)
            self.now_s += STEP_S

    @property
    def texts(self) -> dict[str, str] | None:
        rows = self.undiscovered.rows()
        return None if rows is None else {topic: row.text for topic, row in rows.items()}


def test_an_undiscovered_publisher_is_reported_until_it_is_found(caplog: pytest.LogCaptureFixture) -> None:
    """Once in the log, with topic, node, both RMWs and what to do; and again when it ends."""
    caplog.set_level(logging.INFO)
    robot = Robot(imu=IMU)
    robot.theirs = {'/imu': [['aa', IMU, '/go2_driver']]}
    robot.wait(SETTLED_S - 2 * STEP_S)
    assert robot.texts == {}
    robot.wait(4 * STEP_S)
    assert robot.texts == {
        '/imu': '/imu is not fully received: rmw_theirs finds a publisher (of /go2_driver) that rmw_ours, by which '
        'the node listens, has not found; what it sends is not logged'
    }
    (report,) = caplog.records
    assert report.levelno == logging.ERROR
    assert 'capture.rmw: robot' in report.message
    robot.ours = {'/imu': {'aa'}}
    robot.wait(STEP_S)
    assert robot.texts == {}
    assert caplog.records[-1].levelno == logging.INFO


@pytest.mark.parametrize('of', ['their ghost', 'a stop of ours', 'restarts'])
def test_a_short_difference_is_not_reported(of: str, caplog: pytest.LogCaptureFixture) -> None:
    """A killed publisher lingers; while this process was stopped nothing was compared; each publisher counts separately."""
    robot = Robot(imu=IMU)
    robot.theirs = {'/imu': [['aa', IMU, '']]}
    if of == 'their ghost':
        robot.ours = {'/imu': {'aa'}}
        robot.wait(SETTLED_S)
        robot.ours = {}
        robot.wait(20.0)
        robot.theirs = {}
    elif of == 'a stop of ours':
        robot.wait(STEP_S)
        robot.now_s += SILENT_S + SETTLED_S
    else:
        for number in range(10):
            robot.theirs = {'/imu': [[f'{number}', IMU, '']]}
            robot.wait(10.0)
    robot.wait(STEP_S)
    assert robot.texts == {}
    assert not caplog.records


def test_without_reports_nothing_is_known() -> None:
    """Before the first report, and after the front stopped."""
    robot = Robot(imu=IMU)
    assert robot.texts is None
    robot.theirs = {'/imu': [['aa', IMU, '']]}
    robot.wait(SETTLED_S + STEP_S)
    assert robot.texts
    robot.now_s += SILENT_S + STEP_S
    assert robot.texts is None


def test_only_topics_that_would_be_logged_count() -> None:
    """Topics of enabled sensors, and of the type configured for them; without one, of any type."""
    robot = Robot(imu=IMU, odom='')
    robot.theirs = {
        '/imu': [['aa', 'std_msgs/msg/String', '']],
        '/odom': [['bb', 'std_msgs/msg/String', '']],
        '/other': [['cc', '', '']],
    }
    robot.wait(SETTLED_S + STEP_S)
    assert list(robot.texts or ()) == ['/odom']
    del robot.topics['/odom']
    robot.wait(STEP_S)
    assert robot.texts == {}


@pytest.mark.parametrize('wrong', [7, {'a': 1}, [7], [['aa']], [['aa', 'b', 7]], [[['aa'], 'b', 'c']]])
def test_an_invalid_report_is_ignored(wrong: Any) -> None:
    """Any client of the control socket may send anything."""
    robot = Robot(imu=IMU)
    assert robot.undiscovered.compare({'/imu': wrong}) == {'topics': ['/imu'], 'gids': []}


def test_the_front_learns_the_known_publishers() -> None:
    """A report then has only the others, and is short."""
    robot = Robot(imu=IMU, odom='')
    robot.ours = {'/imu': {'bb', 'aa'}, '/odom': {'cc'}}
    assert robot.undiscovered.compare({}) == {'topics': ['/imu', '/odom'], 'gids': ['aa', 'bb', 'cc']}


@pytest.mark.parametrize(('count', 'words'), [
    (2, 'finds 2 publishers that'), (MAX_PUBLISHERS, f'finds {MAX_PUBLISHERS} or more publishers'),
])  # fmt: skip
def test_several_undiscovered_publishers_are_one_error(count: int, words: str, caplog: pytest.LogCaptureFixture) -> None:
    """The number in a report is limited, so the message contains no count then."""
    robot = Robot(imu=IMU)
    robot.theirs = {'/imu': [[f'{number}', IMU, ''] for number in range(count)]}
    robot.wait(SETTLED_S + STEP_S)
    assert words in (robot.texts or {})['/imu']
    assert len(caplog.records) == 1
