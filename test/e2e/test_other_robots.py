"""Robots without any settings: a drone in a namespace, an arm, and a Unitree with its own topics on Cyclone DDS.

What has cameras walks for some seconds as a mission, which is then exported as a LeRobot dataset.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import simplejpeg
from e2e.processes import COMMANDS, Node, Processes, Publisher, until
from missions.server import complete
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.core.type_rules import RULES, is_of_unitree

pytestmark = pytest.mark.long('robots of their own')
ROUNDS = 40
ROUND_S = 0.1
STORE = get_typestore(Stores.LATEST)
UNITREE = Path(__file__).parents[2] / 'interfaces' / 'unitree_go' / 'msg'
for path in UNITREE.glob('*.msg'):
    STORE.register(get_types_from_msg(path.read_text(), f'unitree_go/msg/{path.stem}'))


class Sent(NamedTuple):
    """A topic of a robot."""

    type: str
    fields: Mapping[str, Any] = {}
    every: int = 1
    """Rounds from one message to the next; 0: once, latched."""
    sensor: str = ''
    """Of the logger; empty where it is not logged."""


def message(type_name: str, fields: Mapping[str, Any]) -> Any:
    """With these fields, by the names of their paths; all others are zero or empty."""
    made = _zero(type_name)
    for path, value in fields.items():
        *owners, last = path.split('.')
        owner = made
        for name in owners:
            owner = getattr(owner, name)
        object.__setattr__(owner, last, value)
    return made


def _zero(type_name: str) -> Any:
    values = []
    for _, (kind, what) in STORE.fielddefs[type_name][1]:
        if kind.name == 'BASE':
            values.append('' if what[0] == 'string' else False if what[0] == 'bool' else 0)
        elif kind.name == 'NAME':
            values.append(_zero(what))
        else:
            (inner, of), count = what
            if inner.name == 'BASE' and of[0] != 'string':
                dtype = {'byte': 'u1', 'octet': 'u1', 'char': 'u1'}.get(of[0], of[0])
                values.append(np.zeros(count or 0, dtype))
            else:
                values.append([_zero(of) if inner.name == 'NAME' else '' for _ in range(count or 0)])
    return STORE.types[type_name](*values)


class Robot:
    """A robot with some topics, and the logger beside it."""

    def __init__(
        self,
        processes: Processes,
        topics: Mapping[str, Sent],
        *arguments: str,
        robot: str,
        mission: str = '',
        cyclone: bool = False,
    ) -> None:
        """``mission``: the robot's name in the mission that it walks; empty: it walks without one."""
        self.topics = topics
        self._publisher: Publisher = processes.publisher(cyclone=cyclone)
        for topic, sent in topics.items():
            self._publisher.create(topic, sent.type, latched=not sent.every)
        environ = {'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp'} if cyclone else {}
        self.node: Node = processes.node(None, None, *arguments, robot=robot, environ=environ)
        for topic, sent in topics.items():
            if sent.sensor:
                self._publisher.matched(topic)
        if mission:
            with closing(MissionDataLogger(home=self.node.home, robot=mission)) as logger:
                logger.start_mission('walk', 'around the block')
                self.sent = self._walk()
                logger.end_mission(True, 0.0, 0.0)
                until(lambda: complete(self.node.home), lambda: f'the mission is sent: {logger.flush(0.0)}')
        else:
            self.sent = self._walk()

    def _walk(self) -> dict[str, int]:
        sent = dict.fromkeys(self.topics, 0)
        for number in range(ROUNDS):
            start = time.monotonic()
            for topic, each in self.topics.items():
                if number % each.every == 0 if each.every else not number:
                    made = message(each.type, each.fields)
                    if hasattr(made, 'header'):
                        made.header.stamp.sec, made.header.stamp.nanosec = divmod(time.time_ns(), 10**9)
                    self._publisher.publish(topic, [bytes(STORE.serialize_cdr(made, each.type))], 0.0)
                    sent[topic] += 1
            time.sleep(max(0.0, start + ROUND_S - time.monotonic()))
        return sent

    def finish(self) -> dict[str, Any]:
        """The ledger, once everything that is logged was received and the node has stopped."""
        for topic, each in self.topics.items():
            if each.sensor:
                until(lambda topic=topic: self.node.topic(topic).get('received') == self.sent[topic], f'{topic} is received')  # type: ignore[misc]
        ledger = self.node.stop()
        assert ledger['balanced']
        for topic, each in self.topics.items():
            if each.sensor:
                account = ledger['topics'][topic]
                assert (account['received'], account['rejected'], account['dropped']) == (self.sent[topic], {}, {}), topic
                assert account['stored'] > 0, topic
                assert account['received'] == account['stored'] + account['skipped'], topic
        return ledger

    def export(self, processes: Processes, folder: Path, config: Mapping[str, Any]) -> dict[str, Any]:
        """The features of a dataset of the mission, in ``folder``; it has a frame for each period of its length."""
        path = folder.with_suffix('.yaml')
        path.write_text(json.dumps(config))
        answer = self.ask(
            processes, 'export', 'lerobot', folder.name, '--to', str(folder), '--config', str(path), '--mission-type', 'walk'
        )
        info: dict[str, Any] = json.loads((folder / 'meta/info.json').read_bytes())
        assert info['total_episodes'] == 1, answer
        assert abs(info['total_frames'] / info['fps'] - ROUNDS * ROUND_S) < 2.0, answer
        return dict(info['features'])

    def ask(self, processes: Processes, *arguments: str) -> Any:
        """The JSON of a verb, about the folder that is the store."""
        environ = {**processes.environ, 'SHADOWHOUND_HOME': str(self.node.home)}
        command = [sys.executable, '-m', COMMANDS, *arguments, '--json']
        ran = subprocess.run(command, capture_output=True, text=True, env=environ, timeout=120, check=False)
        assert ran.returncode == 0, ran.stdout + ran.stderr
        return json.loads(ran.stdout)


CLOUD = {
    'height': 1, 'width': 1, 'point_step': 12, 'row_step': 12, 'data': np.zeros(12, np.uint8),
    'fields': [STORE.types['sensor_msgs/msg/PointField'](name, 4 * place, 7, 1) for place, name in enumerate('xyz')],
}  # fmt: skip
IMAGE = {'height': 4, 'width': 4, 'encoding': 'rgb8', 'step': 12, 'data': np.zeros(48, np.uint8)}


FIELDS: Mapping[str, Mapping[str, Any]] = {
    'sensor_msgs/msg/Image': IMAGE,
    'sensor_msgs/msg/CompressedImage': {
        'format': 'jpeg', 'data': np.frombuffer(simplejpeg.encode_jpeg(np.zeros((8, 8, 3), np.uint8)), np.uint8),
    },
    'sensor_msgs/msg/PointCloud2': CLOUD,
}  # fmt: skip


def test_every_type_that_has_a_rule(processes: Processes) -> None:
    """Each message of it is stored or left out by the rate, and none is rejected."""
    kinds = [kind for kind in RULES if not is_of_unitree(kind) and find_spec(kind.partition('/')[0])]
    assert len(kinds) > 50
    topics = {f'/topic_{number}': Sent(kind, FIELDS.get(kind, {}), 8, f'topic_{number}') for number, kind in enumerate(kinds)}
    robot = Robot(processes, topics, robot='all')
    robot.finish()
    stored = robot.ask(processes, 'query', 'SELECT DISTINCT sensor FROM objects', '--robot', 'all')
    assert {row['sensor'] for row in stored} >= {each.sensor for each in topics.values()}


def test_a_drone(processes: Processes, tmp_path: Path) -> None:
    """In a namespace: its name, its GPS in each object, and --near-gps finds what it recorded there."""
    place = {'pose.pose.position.x': 4.0, 'header.frame_id': 'map', 'pose.pose.orientation.w': 1.0}
    fix = {'latitude': -36.8485, 'longitude': 174.7633, 'altitude': 120.0}
    robot = Robot(
        processes,
        {
            '/drone1/global_position/fix': Sent('sensor_msgs/msg/NavSatFix', fix, 2, 'drone1_global_position_fix'),
            '/drone1/local_position/odom': Sent('nav_msgs/msg/Odometry', place, 1, 'drone1_local_position_odom'),
            '/drone1/imu/data': Sent('sensor_msgs/msg/Imu', {}, 1, 'drone1_imu_data'),
            '/drone1/battery': Sent('sensor_msgs/msg/BatteryState', {'percentage': 0.5}, 10, 'drone1_battery'),
            '/drone1/camera/image': Sent('sensor_msgs/msg/Image', IMAGE, 5, 'drone1_camera_image'),
            '/drone1/rangefinder': Sent('sensor_msgs/msg/Range', {'range': 3.0}, 1, 'drone1_rangefinder'),
        },
        '-r', '__ns:=/drone1', robot='', mission='drone1',
    )  # fmt: skip
    robot.finish()
    rows = robot.ask(processes, 'query', '--sensor', 'drone1_camera_image', '--near-gps', '-36.8486,174.7633,50')
    assert len(rows) >= 3
    assert {row['robot'] for row in rows} == {'drone1'}
    last = rows[-1]
    assert (last['latitude'], last['longitude'], last['altitude']) == (-36.8485, 174.7633, 120.0)
    assert (last['x'], last['pose_frame'], last['battery_pct']) == (4.0, 'map', 50.0)
    assert robot.ask(processes, 'query', '--near-gps', '-36.85,174.7633,50') == []
    found = robot.ask(processes, 'fetch', '--sensor', 'drone1_camera_image', '--near-gps', '-36.8486,174.7633,50',
                      '--to', str(tmp_path / 'data'))  # fmt: skip
    assert found
    assert len(list((tmp_path / 'data').rglob('*.jpg'))) == len(rows)
    features = robot.export(processes, tmp_path / 'flights', {
        'images': {'down': '/drone1/camera/image'}, 'fps': 1, 'max_stale': 0.5,
        'state': [{'topic': '/drone1/global_position/fix', 'fields': ['latitude', 'longitude', 'altitude']}],
        'action': {'topic': '/drone1/local_position/odom', 'fields': ['twist.twist.linear.x'], 'names': ['x.vel']},
    })  # fmt: skip
    assert features['observation.state']['names'] == ['latitude', 'longitude', 'altitude']


def test_an_arm(processes: Processes, tmp_path: Path) -> None:
    """Joints, the camera at its wrist, its description and its commands; it has no place."""
    robot = Robot(
        processes,
        {
            '/joint_states': Sent('sensor_msgs/msg/JointState', {'name': ['shoulder'], 'position': np.array([0.5])}, 1, 'joints'),
            '/wrist/image_raw': Sent('sensor_msgs/msg/Image', IMAGE, 2, 'wrist_image_raw'),
            '/wrist/camera_info': Sent('sensor_msgs/msg/CameraInfo', {'width': 4, 'height': 4}, 2, 'wrist_camera_info'),
            '/wrench': Sent('geometry_msgs/msg/WrenchStamped', {'wrench.force.z': -2.5}, 1, 'wrench'),
            '/robot_description': Sent('std_msgs/msg/String', {'data': '<robot/>'}, 0, 'robot_description'),
            '/gripper/grasped': Sent('std_msgs/msg/Bool', {'data': True}, 5, 'gripper_grasped'),
            '/colors': Sent('std_msgs/msg/ColorRGBA', {}, 1),
        },
        robot='ur5', mission='ur5',
    )  # fmt: skip
    ledger = robot.finish()
    assert '/colors' not in ledger['topics']
    assert '/colors (std_msgs/msg/ColorRGBA) is not logged' in robot.node.log
    topics = robot.ask(processes, 'query', 'SELECT sensor, messages FROM topics', '--robot', 'ur5')
    assert {row['sensor'] for row in topics} >= {each.sensor for each in robot.topics.values() if each.sensor}
    assert {row['sensor']: row['messages'] for row in topics}['joints'] == ROUNDS
    assert {row['x'] for row in robot.ask(processes, 'query', '--sensor', 'wrench')} == {None}
    features = robot.export(processes, tmp_path / 'picks', {
        'images': {'wrist': '/wrist/image_raw'}, 'fps': 1, 'state': [{'topic': '/joint_states', 'fields': ['position']}],
        'action': {'topic': '/wrench', 'fields': ['wrench.force.z'], 'names': ['force']},
    })  # fmt: skip
    assert features['observation.state']['names'] == ['shoulder.pos']
    assert json.loads((tmp_path / 'picks/meta/info.json').read_bytes())['robot_type'] == 'ur5'
    assert features['observation.images.wrist']['shape'][:2] == [4, 4]


@pytest.mark.skipif(find_spec('cyclonedds') is None, reason='cyclonedds is not installed')
def test_a_unitree_with_its_own_topics(processes: Processes) -> None:
    """Through Cyclone DDS, without the driver: the sensors of a Go2 are taken from them, and the battery is known.

    Messages of unitree_go need the package; without it the log says how to build it, and all else is stored.
    """
    has_package = find_spec('unitree_go') is not None
    pose = {'header.frame_id': 'odom', 'pose.pose.orientation.w': 1.0}

    def of_package(sensor: str) -> str:
        return sensor if has_package else ''

    robot = Robot(
        processes,
        {
            '/utlidar/cloud': Sent('sensor_msgs/msg/PointCloud2', CLOUD, 1, 'lidar'),
            '/utlidar/imu': Sent('sensor_msgs/msg/Imu', {}, 1, 'imu'),
            '/utlidar/robot_odom': Sent('nav_msgs/msg/Odometry', pose, 1, 'odom'),
            '/lowstate': Sent('unitree_go/msg/LowState', {'bms_state.soc': 77}, 1, of_package('lowstate')),
            '/sportmodestate': Sent('unitree_go/msg/SportModeState', {'body_height': 0.3}, 1, of_package('states')),
            '/wirelesscontroller': Sent('unitree_go/msg/WirelessController', {'lx': 0.5}, 1, of_package('wirelesscontroller')),
            '/frontvideostream': Sent('unitree_go/msg/Go2FrontVideoData', {'video720p': np.arange(9, dtype=np.uint8)}, 1,
                                      of_package('frontvideostream')),
        },
        robot='go2', cyclone=True,
    )  # fmt: skip
    robot.finish()
    rows = robot.ask(processes, 'query', '--robot', 'go2')
    assert {row['sensor'] for row in rows} >= {each.sensor for each in robot.topics.values() if each.sensor}
    if has_package:
        assert 77.0 in {row['battery_pct'] for row in rows if row['sensor'] == 'lidar'}
    else:
        assert '/lowstate is not logged: its message package is not installed here' in robot.node.log
        assert 'colcon build --base-paths interfaces/unitree_go' in robot.node.log


def test_two_robots_in_one_graph(processes: Processes) -> None:
    """A node in the namespace of each logs that robot alone, under its name; one without says what to start instead."""
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
    ledger = nodes[1].stop()  # of both: they share a spool
    assert {topic: row['received'] for topic, row in ledger['topics'].items() if row['received']} == {
        f'/{name}/{topic}': count for name, count in zip(names, (5, 7), strict=True) for topic in kinds
    }
    assert {path.name for path in (store / 'robot1').iterdir()} >= {'imu', 'odom', 'joints'}
