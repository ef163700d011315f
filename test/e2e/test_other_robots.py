"""Robots without any settings: a wheeled base, a drone in a namespace, an arm, and a Unitree with vendor topics on Cyclone DDS.

Those with cameras walk for some seconds as a mission, which is then exported as a LeRobot dataset.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import simplejpeg
from e2e.processes import Processes, until
from e2e.robots import ARM, ARM_JOINTS, BASE, DRONE, LATITUDE, LONGITUDE, STORE, UNITREE_TOPICS, Robot, Sent, message
from live.browsing import holds

from shadowhound_data_logger.core.type_rules import RULES, is_of_unitree

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.long('robots of their own')
EXAMPLES = Path(__file__).parents[2] / 'examples'


FIELDS: Mapping[str, Mapping[str, Any]] = {
    'sensor_msgs/msg/Image': {'height': 4, 'width': 4, 'encoding': 'rgb8', 'step': 12, 'data': np.zeros(48, np.uint8)},
    'sensor_msgs/msg/CompressedImage': {
        'format': 'jpeg', 'data': np.frombuffer(simplejpeg.encode_jpeg(np.zeros((8, 8, 3), np.uint8)), np.uint8),
    },
    'sensor_msgs/msg/PointCloud2': {
        'height': 1, 'width': 1, 'point_step': 12, 'row_step': 12, 'data': np.zeros(12, np.uint8),
        'fields': [STORE.types['sensor_msgs/msg/PointField'](name, 4 * place, 7, 1) for place, name in enumerate('xyz')],
    },
}  # fmt: skip


def test_every_type_with_a_rule_is_logged(processes: Processes) -> None:
    """Each message of it is stored or skipped by the rate, and none is rejected."""
    kinds = [kind for kind in RULES if not is_of_unitree(kind) and find_spec(kind.partition('/')[0])]
    assert len(kinds) > 50
    topics = {f'/topic_{number}': Sent(kind, FIELDS.get(kind, {}), 8, f'topic_{number}') for number, kind in enumerate(kinds)}
    robot = Robot(processes, topics, robot='all')
    robot.finish()
    stored = robot.ask('query', 'SELECT DISTINCT sensor FROM objects', '--robot', 'all')
    assert {row['sensor'] for row in stored} >= {each.sensor for each in topics.values()}


def test_a_wheeled_base(processes: Processes, browser: Browser, tmp_path: Path) -> None:
    """Like a TurtleBot 4: everything with a rule is stored and shown, and the example mapping file exports it."""
    robot = Robot(processes, BASE, robot='tb4', mission='tb4')
    with robot.walking():
        page = robot.shown(
            browser, 'Camera', '3D view', 'Path', 'Attitude', 'Acceleration', 'Joints', 'Battery', 'Temperature', 'Diagnostics',
            'Log', drawn=('camera', 'scan', 'map', 'model', 'odom', 'imu', 'joints', 'battery', 'diagnostics'),
        )  # fmt: skip
        holds(page, 'document.querySelector("[aria-label=Joints] .legend").innerText === "2 joints, rad"')
        page.close()
        assert_no_unitree(robot)
    ledger = robot.finish()
    assert_logs_itself_alone(robot, ledger)
    robot.fetched(tmp_path / 'data')
    features = robot.export(tmp_path / 'patrols', EXAMPLES / 'export_base.yaml')
    assert features['observation.state']['names'] == ['x', 'y', 'x.vel', 'theta.vel']
    assert features['action']['names'] == ['x.vel', 'theta.vel']


def test_a_drone_is_logged_with_its_gps(processes: Processes, browser: Browser, tmp_path: Path) -> None:
    """In a namespace: its name, its GPS position in each object, and --near-gps finds its recordings there."""
    robot = Robot(processes, DRONE, '-r', '__ns:=/drone1', robot='', mission='drone1')
    with robot.walking():
        page = robot.shown(
            browser, 'Camera', '3D view', 'Path', 'GPS', 'Attitude', 'Acceleration', 'Battery', 'Temperature', 'Diagnostics',
            'Log', drawn=('camera', 'odom', 'imu', 'battery', 'fix'),
        )  # fmt: skip
        page.close()
        assert_no_unitree(robot)
    ledger = robot.finish()
    assert_logs_itself_alone(robot, ledger)
    robot.fetched(tmp_path / 'all')
    here = f'{LATITUDE},{LONGITUDE},50'
    rows = robot.ask('query', '--sensor', 'drone1_camera_image', '--near-gps', here)
    assert len(rows) >= 3
    assert {row['robot'] for row in rows} == {'drone1'}
    last = rows[-1]
    assert abs(last['latitude'] - LATITUDE) < 1e-4
    assert (last['altitude'], last['pose_frame'], last['battery_pct']) == (120.0, 'map', 50.0)
    assert robot.ask('query', '--near-gps', f'{LATITUDE - 0.01},{LONGITUDE},50') == []
    robot.ask('fetch', '--sensor', 'drone1_camera_image', '--near-gps', here, '--to', str(tmp_path / 'data'))
    assert len(list((tmp_path / 'data').rglob('*.jpg'))) == len(rows)
    features = robot.export(tmp_path / 'flights', {
        'images': {'down': '/drone1/camera/image'}, 'fps': 1, 'max_stale': 0.5,
        'state': [{'topic': '/drone1/global_position/fix', 'fields': ['latitude', 'longitude', 'altitude']}],
        'action': {'topic': '/drone1/local_position/odom', 'fields': ['twist.twist.linear.x'], 'names': ['x.vel']},
    })  # fmt: skip
    assert features['observation.state']['names'] == ['latitude', 'longitude', 'altitude']


def test_an_arm_is_logged_without_a_place(processes: Processes, browser: Browser, tmp_path: Path) -> None:
    """Joints, the wrist camera, its description and its commands; it has no position, and so it is drawn at the origin."""
    robot = Robot(processes, ARM, robot='ur5', mission='ur5')
    with robot.walking():
        page = robot.shown(browser, 'Camera', '3D view', 'Joints', 'Diagnostics', 'Log', drawn=('camera', 'model', 'joints'))
        size = page.locator('td[data-topic="/colors"][data-field="size"]')
        until(lambda: size.inner_text() == '20 B', 'the size of a topic that is not logged')
        page.close()
        assert_no_unitree(robot)
    ledger = robot.finish()
    assert '/colors' not in ledger['topics']
    assert '/colors (std_msgs/msg/ColorRGBA) is not logged' in robot.node.log
    assert_logs_itself_alone(robot, ledger)
    robot.fetched(tmp_path / 'data')
    topics = robot.ask('query', 'SELECT sensor, messages FROM topics', '--robot', 'ur5')
    assert {row['sensor'] for row in topics} >= {each.sensor for each in robot.topics.values() if each.sensor}
    assert {row['sensor']: row['messages'] for row in topics}['joints'] == robot.sent['/joint_states']
    assert {row['x'] for row in robot.ask('query', '--sensor', 'wrench')} == {None}
    features = robot.export(tmp_path / 'picks', {
        'images': {'wrist': '/wrist/image_raw'}, 'fps': 1, 'state': [{'topic': '/joint_states', 'fields': ['position']}],
        'action': {'topic': '/wrench', 'fields': ['wrench.force.z'], 'names': ['force']},
    })  # fmt: skip
    assert features['observation.state']['names'] == [f'{name}.pos' for name in ARM_JOINTS]
    assert json.loads((tmp_path / 'picks/meta/info.json').read_bytes())['robot_type'] == 'ur5'
    assert features['observation.images.wrist']['shape'][:2] == [120, 160]


def assert_no_unitree(robot: Robot) -> None:
    """While it runs: its status, /diagnostics and the page's table contain no other topics."""
    report = robot.ask('status')
    names = {topic for topic, each in robot.topics.items() if each.sensor}
    assert report['topics'].keys() == names, report['topics'].keys() ^ names


def assert_logs_itself_alone(robot: Robot, ledger: Mapping[str, Any]) -> None:
    """In the ledger, too."""
    assert ledger['topics'].keys() == {topic for topic, each in robot.topics.items() if each.sensor}


@pytest.mark.skipif(find_spec('cyclonedds') is None, reason='cyclonedds is not installed')
def test_a_unitree_is_logged_from_its_own_topics(processes: Processes, browser: Browser, tmp_path: Path) -> None:
    """Through Cyclone DDS, without the driver: they serve as the sensors of a Go2, and the battery is known.

    With or without the package ``unitree_go``.
    """
    robot = Robot(processes, UNITREE_TOPICS, robot='go2', mission='go2', cyclone=True)
    with robot.walking():
        page = robot.shown(
            browser, 'Camera', '3D view', 'Path', 'Attitude', 'Acceleration', 'Joints', 'Battery', 'Temperature', 'Log',
            drawn=('cloud', 'odom', 'imu', 'battery'),
        )  # fmt: skip
        page.close()
    robot.finish()
    robot.fetched(tmp_path / 'data')
    rows = robot.ask('query', '--robot', 'go2')
    assert {row['sensor'] for row in rows} >= {each.sensor for each in robot.topics.values() if each.sensor}
    assert 77.0 in {row['battery_pct'] for row in rows if row['sensor'] == 'lidar'}
    assert 'is not logged' not in robot.node.log
    refused = robot.refused('export', 'lerobot', 'walks', '--to', str(tmp_path / 'walks'), '--mission-type', 'walk')
    assert 'has no data of camera in it; a LeRobot dataset needs images' in refused, refused


def test_two_robots_in_one_graph_are_logged_separately(processes: Processes) -> None:
    """A node in the namespace of each logs that robot alone, under its name; one without reports what to start instead."""
    names, kinds = ('robot0', 'robot1'), {'odom': 'nav_msgs/msg/Odometry', 'imu': 'sensor_msgs/msg/Imu',
                                          'joint_states': 'sensor_msgs/msg/JointState'}  # fmt: skip
    publisher = processes.publisher()
    for name in names:
        for topic, kind in kinds.items():
            publisher.create(f'/{name}/{topic}', kind)
    nodes = [processes.node(None, None, '-r', f'__ns:=/{name}', robot='') for name in names]
    lost = processes.node(None, None, robot='lost', home='home-of-lost')
    lost.await_log('the topics of /robot0 and /robot1 are logged under one name')
    lost.await_log('sensor_logger.launch.py robots:=robot0,robot1')
    for name, count in zip(names, (5, 7), strict=True):
        for topic, kind in kinds.items():
            publisher.matched(f'/{name}/{topic}', 2)
            made = message(kind, {})
            made.header.stamp.sec = int(time.time())
            publisher.publish(f'/{name}/{topic}', [bytes(STORE.serialize_cdr(made, kind))] * count, 0.01)
    for node, name, count in zip(nodes, names, (5, 7), strict=True):
        until(lambda node=node, name=name, count=count: node.topic(f'/{name}/imu').get('received') == count, name)  # type: ignore[misc]
    nodes[0].stop()
    store = nodes[0].home / 'store' / 'sensor-data'
    until(lambda: {path.name for path in store.iterdir()} == set(names), 'the other node takes over the uploads')
    until(lambda: {path.name for path in (store / 'robot1').iterdir()} >= {'imu', 'odom', 'joints'}, 'what it uploads')
    ledger = nodes[1].stop()  # of both, since they share a spool
    assert {topic: row['received'] for topic, row in ledger['topics'].items() if row['received']} == {
        f'/{name}/{topic}': count for name, count in zip(names, (5, 7), strict=True) for topic in kinds
    }
