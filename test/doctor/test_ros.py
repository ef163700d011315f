"""Faults of a robot's topics, one at a time, over real DDS: several robots publish, and each is examined as the logger's."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from doctor.scene import Scene, assert_finding
from domains import free_domain

from shadowhound_data_logger.doctor.context import make
from shadowhound_data_logger.doctor.model import Result, Severity

pytest.importorskip('rclpy')
pytestmark = pytest.mark.ros

SENSORS = {'sensors': ['odom', 'imu', 'lidar']}
ARM = {'sensors': ['wrist'], 'wrist.topics': ['wrist/joint_states'], 'wrist.types': ['sensor_msgs/msg/JointState']}
ROBOTS = ('well', 'mute', 'soft', 'deaf', 'two', 'squatted', 'slow', 'unheard')
RATES = {'odom': 20.0, 'imu': 20.0, 'point_cloud2': 20.0}


@dataclass(frozen=True)
class Examined:
    """The findings for each robot, in their domain, and in another one."""

    domain: int
    robots: dict[str, list[Result]]
    elsewhere: list[Result]
    nowhere: list[Result]
    unnamed: list[Result]
    """For a logger without a namespace."""
    foreign: list[Result]
    """For a logger of another robot."""
    by_type: list[Result]
    """For a logger without settings."""


def examine(scene: Scene, namespace: str = '/', sensors: dict[str, Any] = SENSORS) -> list[Result]:
    """In this process, which loads ROS once; the check is the one that a child of the doctor runs."""
    from shadowhound_data_logger.doctor import ros

    context = make(scene.environ, role=scene.role, parameters=sensors, namespace=namespace, rates_hz=RATES, root=scene.root)
    return list(ros.check(context))


@pytest.fixture(scope='module')
def examined(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Examined]:
    with ExitStack() as stack, pytest.MonkeyPatch.context() as patch:
        domain, other = stack.enter_context(free_domain()), stack.enter_context(free_domain())
        scene = Scene.healthy(tmp_path_factory.mktemp('robots'), stack)
        publishers = Path(__file__).with_name('publishers.py')
        robots = subprocess.Popen([sys.executable, str(publishers)], env={**os.environ, 'ROS_DOMAIN_ID': str(domain)},
                                  stdin=subprocess.PIPE, stdout=subprocess.PIPE)  # fmt: skip
        stack.enter_context(robots)
        stack.callback(robots.kill)
        assert robots.stdout
        assert robots.stdout.readline() == b'ready\n'
        patch.setenv('ROS_DOMAIN_ID', str(domain))
        scene.environ['ROS_DOMAIN_ID'] = str(domain)
        with ThreadPoolExecutor(len(ROBOTS)) as pool:
            found = dict(zip(ROBOTS, pool.map(lambda name: examine(scene, f'/{name}'), ROBOTS), strict=True))
        unnamed, foreign, by_type = examine(scene), examine(scene, sensors=ARM), examine(scene, '/other', {})
        patch.setenv('ROS_DOMAIN_ID', str(other))
        scene.environ['ROS_DOMAIN_ID'] = str(other)
        nowhere = examine(scene, '/well')
        lines = ['head', f'   1: 00000000:{7400 + 250 * domain:04X} 00000000:0000 07']
        (scene.root / 'proc/net/udp').write_text('\n'.join(lines) + '\n')
        yield Examined(domain, found, examine(scene, '/well'), nowhere, unnamed, foreign, by_type)


def test_a_topic_under_another_name_is_proposed(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """With and without a slash they are the same in the root namespace: both sensors of it are checked."""
    from shadowhound_data_logger.doctor import ros, ros_watch

    here = SimpleNamespace(
        resolve_topic_name=lambda topic: '/' + topic.lstrip('/'), count_publishers=lambda _: 1,
        get_publishers_info_by_topic=lambda _: [],
    )  # fmt: skip
    monkeypatch.setattr(ros_watch, 'node', lambda **_: nullcontext(here))
    monkeypatch.setattr(ros_watch, 'discover', lambda _, names: {name: [SimpleNamespace(type='a/msg/B')] for name in names})
    monkeypatch.setattr(ros_watch, 'listen', lambda _, found, __, ___: [ros_watch.WatchedTopic(name, []) for name in found])
    own = {'sensors': ['imu', 'again'], 'again.topics': ['/imu'], 'again.types': ['sensor_msgs/msg/Imu']}
    context = make(scene.environ, role=scene.role, parameters=own, root=scene.root)
    assert [result.check for result in ros.check(context) if result.is_finding].count('ros.topic') == 2


def findings(results: list[Result]) -> list[Result]:
    return [result for result in results if result.is_finding]


def test_a_healthy_robot_gives_no_finding(examined: Examined) -> None:
    """Each topic has about the published rate; but a busy machine loses messages."""
    found = examined.robots['well']
    assert [each for each in findings(found) if each.check != 'ros.loss'] == []
    rates = {result.data['topic']: result.data['rate_hz'] for result in found if result.check == 'ros.rate'}
    assert rates == {f'/well/{name}': pytest.approx(20.0, rel=0.5) for name in RATES}


FAULTS = {
    'missing topic': ('unheard', 'ros.topic', ('ros2 topic list | grep /unheard/imu', 'imu.enabled: false')),
    'no message arrives': ('mute', 'ros.loss', ('ros2 topic hz /mute/odom', '--only sockets')),
    'wrong rate': ('slow', 'ros.rate', ('ros2 topic hz /slow/odom', '--rate /slow/odom=')),
    'wrong QoS of a publisher': ('soft', 'ros.qos', ('ros2 topic info -v /soft/odom',)),
    'wrong QoS of a subscriber': ('deaf', 'ros.qos', ('qos_profile_sensor_data',)),
    'two types on a topic': ('two', 'ros.type', ('ros2 topic info -v /two/odom',)),
    'another type than the expected one': (
        'squatted',
        'ros.type',
        ('ros2 topic info -v /squatted/odom', 'odom.types: [geometry_msgs/msg/PoseStamped]'),
    ),
}


@pytest.mark.parametrize(('robot', 'name', 'words'), FAULTS.values(), ids=FAULTS)
def test_a_fault_is_found_and_named(examined: Examined, robot: str, name: str, words: tuple[str, ...]) -> None:
    """By exactly one finding, with the correct remedy; but a busy machine loses messages of each of them."""
    found = findings(examined.robots[robot])
    assert_finding([each for each in found if each.check == name or each.check != 'ros.loss'], name, *words)


def test_a_wrong_domain_is_named(examined: Examined) -> None:
    """If the topics are in another domain, that one is named."""
    assert_finding(findings(examined.elsewhere), 'ros.domain', f'export ROS_DOMAIN_ID={examined.domain}')


def test_a_missing_driver_is_named(examined: Examined) -> None:
    """If there are no participants anywhere, the guide's three questions are in the remedy."""
    assert_finding(findings(examined.nowhere), 'ros.topics', 'go2_driver', 'robot.launch.py', 'ROS_DOMAIN_ID')


def test_a_robot_in_a_namespace_is_named(examined: Examined) -> None:
    """As a driver of several robots publishes: the existing topics are named, and how to log one robot's."""
    assert_finding(findings(examined.unnamed), 'ros.topics', '-r __ns:=/', 'one node for each of', '/well')
    assert '/deaf/imu' in findings(examined.unnamed)[0].seen


def test_no_command_has_a_name_that_is_invalid_in_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another DDS participant chooses the names of its topics."""
    from shadowhound_data_logger.doctor import ros_watch

    names = ['/robot0/odom', '/$(reboot)/odom', '/a;b/odom', '/a b/odom', '/a\nb/odom', '/rosout', '/_hidden/odom']
    here = SimpleNamespace(get_topic_names_and_types=lambda: [(name, ['a/msg/B']) for name in names])
    monkeypatch.setattr(ros_watch, 'endpoints', lambda *_: [SimpleNamespace(type='a/msg/B', node='/robot')])
    monkeypatch.setattr(ros_watch, 'DISCOVER_S', 0.1)
    assert list(ros_watch.published(here)) == ['/robot0/odom']


def test_a_publisher_is_named_once_its_node_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """DDS announces publishers before the names of their nodes."""
    from shadowhound_data_logger.doctor import ros_watch

    nodes = iter(['', '', '/robot'])
    here = SimpleNamespace(get_topic_names_and_types=lambda: [('/odom', ['a/msg/B'])])
    monkeypatch.setattr(ros_watch, 'endpoints', lambda *_: [SimpleNamespace(type='a/msg/B', node=next(nodes, '/robot'))])
    monkeypatch.setattr(ros_watch, 'DISCOVER_S', 0.5)
    assert [each.node for each in ros_watch.published(here)['/odom']] == ['/robot']


@pytest.mark.parametrize(('of', 'findings'), [('go2_interfaces/msg/IMU', ['ros.qos', 'ros.rate']), ('sensor_msgs/msg/Imu', [])])
def test_other_robots_are_not_expected_to_be_a_go2(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, of: str, findings: list[str]
) -> None:
    """An IMU of another robot may be slow and BEST_EFFORT."""
    from shadowhound_data_logger.doctor import ros, ros_watch

    publisher = SimpleNamespace(type=of, node='/robot', reliable=False, transient_local=False)
    imu = ros_watch.WatchedTopic('/imu', [publisher], of, received=10, window_s=2.5)
    here = SimpleNamespace(
        resolve_topic_name=lambda topic: f'/{topic}', count_publishers=lambda _: 1, get_publishers_info_by_topic=lambda _: [],
    )  # fmt: skip
    monkeypatch.setattr(ros_watch, 'node', lambda **_: nullcontext(here))
    monkeypatch.setattr(ros_watch, 'discover', lambda *_: {'/imu': [publisher]})
    monkeypatch.setattr(ros_watch, 'publishers_of', lambda *_: [])
    monkeypatch.setattr(ros_watch, 'waiting_for_clock', lambda _: [])
    monkeypatch.setattr(ros_watch, 'listen', lambda *_: [imu])
    own = {'sensors': ['imu'], 'imu.topics': ['imu'], 'imu.types': [of]}
    context = make(scene.environ, role=scene.role, parameters=own, root=scene.root)
    assert sorted(result.check for result in ros.check(context) if result.is_finding) == findings


def test_a_robot_of_another_kind_is_named(examined: Examined) -> None:
    """With none of the configured topics in any namespace."""
    assert_finding(findings(examined.foreign), 'ros.topics', 'shadowhound-data init')
    assert '/deaf/imu' in findings(examined.foreign)[0].seen


def test_topics_that_are_logged_by_their_type_are_examined(examined: Examined) -> None:
    """A camera that publishes nothing is found, and no topic of a Go2 is missed; a command topic without messages is fine."""
    found = findings(examined.by_type)
    assert_finding([each for each in found if '/other/scan' not in each.seen], 'ros.loss', 'ros2 topic hz /other/front/image')
    assert '/other/scan' in {result.data.get('topic') for result in examined.by_type if result.check == 'ros.rate'}


@pytest.mark.long('a robot of its own')
def test_missing_go2_interfaces_are_named(scene: Scene, domain: int, tmp_path: Path) -> None:
    """In the doctor's child process for ROS, with a workspace that was not sourced, and without types made from definitions."""
    (tmp_path / 'go2_interfaces').mkdir()
    (tmp_path / 'go2_interfaces/__init__.py').write_text("raise ImportError('not sourced')")
    path = os.pathsep.join(filter(None, [str(tmp_path), scene.environ.get('PYTHONPATH')]))
    scene.environ |= {'PYTHONPATH': path, 'ROS_DOMAIN_ID': str(domain), 'SHADOWHOUND_TYPE_SUPPORT': 'off'}
    scene.parameters |= {'sensors': ['odom', 'imu', 'states']}  # an IMU can also publish a standard message
    found = {result.check: result for result in scene.ask('ros')}
    assert found['ros.types'].severity is Severity.ERROR
    assert 'go2_interfaces/msg/Go2State' in found['ros.types'].seen
    assert 'IMU' not in found['ros.types'].seen
    assert 'colcon build --packages-select go2_interfaces' in found['ros.types'].remedy
    assert 'ros.topics' in found  # and everything else was checked as well


@pytest.mark.long('a robot and a node with Cyclone DDS')
def test_a_robot_with_cyclone_dds_is_watched_through_the_nodes_rmw(scene: Scene, domain: int) -> None:
    """Through Fast DDS, with sequence numbers, though the variables of the shell name an RMW without them."""
    pytest.importorskip('cyclonedds')
    driver = Path(__file__).parents[1] / 'e2e/finding.py'
    own = {'ROS_DOMAIN_ID': str(domain)}
    path = os.pathsep.join([str(driver.parents[1]), *filter(None, [os.environ.get('PYTHONPATH')])])
    robot = subprocess.Popen([sys.executable, str(driver), 'publish', '/talk', json.dumps([own])], stdin=subprocess.PIPE,
                             stdout=subprocess.PIPE, env={**os.environ, 'PYTHONPATH': path})  # fmt: skip
    scene.stack.enter_context(robot)
    scene.stack.callback(robot.kill)
    assert robot.stdout
    assert robot.stdout.readline() == b'ready\n'
    scene.environ |= {**own, 'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp'}
    scene.parameters |= {
        'sensors': ['talk'],
        'talk.topics': ['/talk'],
        'talk.types': ['std_msgs/msg/String'],
        'talk.rate_hz': 20.0,
    }
    (rate,) = (result for result in scene.ask('ros') if result.check.startswith(('ros.rate', 'ros.loss')))
    assert rate.data['topic'] == '/talk'
    assert rate.data['sent'] >= rate.data['received'] > 0
