"""A robot of another vendor, and a logger without any settings: every topic with a rule is stored by its type."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from e2e.processes import GENTLE, Node, Processes, Publisher, published, until
from e2e.reading import Objects
from geometry_msgs.msg import Twist
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.serialization import serialize_message
from sensor_msgs.msg import BatteryState, CameraInfo, Image, Imu, JointState, LaserScan, NavSatFix
from shadowhound_tower.embedded import Tower
from std_msgs.msg import ColorRGBA, String

SECONDS = 6
NS = '/tb4'
SENT: dict[str, tuple[Any, float, bool]] = {
    'scan': (LaserScan(ranges=[1.0] * 90), 10.0, False),
    'imu': (Imu(), 50.0, False),
    'odom': (Odometry(), 20.0, False),
    'joint_states': (JointState(name=['wheel'], position=[1.0]), 20.0, False),
    'battery_state': (BatteryState(percentage=0.5), 1.0, False),
    'fix': (NavSatFix(latitude=48.0, longitude=11.0), 5.0, False),
    'front/image_raw': (Image(height=4, width=4, encoding='rgb8', step=12, data=bytes(48)), 10.0, False),
    'cmd_vel': (Twist(), 10.0, False),
    'health': (DiagnosticArray(status=[DiagnosticStatus(name='motor')]), 1.0, False),
    'map': (OccupancyGrid(), 0.0, True),
    'robot_description': (String(data='<robot/>'), 0.0, True),
    'led': (ColorRGBA(), 5.0, False),
}
"""Topic -> a message, its rate in Hz (0: once), and whether it is latched."""
LATE = 'camera/camera_info'
"""A topic of a default sensor that is published once the node has found that the robot is not a Unitree."""
STAMPED = {name for name, (message, _, _) in SENT.items() if hasattr(message, 'header')}


def type_of(message: Any) -> str:
    return f'{type(message).__module__.split(".")[0]}/msg/{type(message).__name__}'


def messages(name: str) -> list[bytes]:
    message, rate_hz, _ = SENT[name]
    found, start_ns = [], time.time_ns()
    for number in range(max(1, round(rate_hz * SECONDS))):
        if name in STAMPED:
            stamp = start_ns + round(number / (rate_hz or 1.0) * 1e9)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        found.append(bytes(serialize_message(message)))
    return found


@pytest.fixture(scope='module')
def node(shared: Processes, seaweed: Tower) -> Node:
    publishers: dict[str, Publisher] = {}
    for name, (message, _, latched) in SENT.items():
        publishers[name] = shared.publisher()
        publishers[name].create(f'{NS}/{name}', type_of(message), latched=latched)
    found = shared.node(seaweed.environment(), None, '-r', f'__ns:={NS}', robot='tb4')
    for name in SENT:
        if name != 'led':
            publishers[name].matched(f'{NS}/{name}')
    with ThreadPoolExecutor(len(SENT)) as pool:
        list(pool.map(lambda name: publishers[name].publish(f'{NS}/{name}', messages(name), 1 / (SENT[name][1] or 1.0)), SENT))
    found.await_log('this is not a Unitree')
    publishers[LATE] = shared.publisher()
    publishers[LATE].create(f'{NS}/{LATE}', 'sensor_msgs/msg/CameraInfo')
    publishers[LATE].heard(f'{NS}/{LATE}', found, bytes(serialize_message(CameraInfo(width=4))))
    return found


def test_everything_is_stored_by_its_type(node: Node, stored: Callable[..., Objects]) -> None:
    """Each message is in the store or counted as skipped by the rate, and the ledger balances."""
    for name, (_, rate_hz, _) in SENT.items():
        if name != 'led':
            sent = max(1, round(rate_hz * SECONDS))
            until(lambda name=name, sent=sent: node.topic(f'{NS}/{name}').get('received') == sent, f'{name} is received')  # type: ignore[misc]
    ledger = node.stop()
    assert ledger['topics'].keys() == {f'{NS}/{name}' for name in (*SENT, LATE) if name != 'led'}, 'and of no Go2'
    for name in SENT.keys() - {'led'}:
        account = node.topic(f'{NS}/{name}')
        assert account['received'] == account['stored'] + account['skipped'], (name, account)
        assert account['stored'] > 0, (name, account)
    objects = stored('tb4')
    names = {key.split('/')[1] for key in objects.contents}
    assert names == {
        'imu', 'odom', 'joints', 'camera_info', 'tb4_cmd_vel', 'tb4_scan', 'tb4_battery_state', 'tb4_fix', 'tb4_front_image_raw',
        'tb4_health', 'tb4_map', 'tb4_robot_description',
    }  # fmt: skip
    charges = {info.metadata.get('battery_pct') for key, info in objects.infos.items() if key.split('/')[1] == 'tb4_scan'}
    assert '50' in charges, 'BatteryState says 0.5'
    places = {info.metadata.get('gps') for key, info in objects.infos.items() if key.split('/')[1] == 'tb4_scan'}
    assert '48.0000000 11.0000000 0.00' in places
    assert len(objects.samples('imu')) == 50 * SECONDS
    assert len(objects.samples('tb4_scan')) == 10 * SECONDS
    assert {key.rpartition('.')[2] for key in objects.sensor('tb4_front_image_raw')} == {'jpg'}
    assert SECONDS - 1 <= len(objects.sensor('tb4_front_image_raw')) <= SECONDS + 1
    assert len(objects.sensor('tb4_map')) == len(objects.sensor('tb4_robot_description')) == 1


def test_topics_without_a_rule_are_named(node: Node) -> None:
    """In the log, and none of their messages are stored."""
    assert f'{NS}/led (std_msgs/msg/ColorRGBA) is not logged: there is no rule for std_msgs/msg/ColorRGBA' in node.log


def test_a_go2_is_known_when_its_driver_starts_late(processes: Processes) -> None:
    """What another node published before does not permanently make it another robot."""
    early = processes.publisher()
    early.create('/joy', 'sensor_msgs/msg/Joy')
    node = processes.node()
    node.await_log('this is not a Unitree')
    assert published(processes.sim(GENTLE, 'duration_s:=4'))['/go2_states'] > 0
    for topic in ('/go2_states', '/lowstate', '/imu', '/camera/compressed'):
        until(lambda topic=topic: node.topic(topic).get('received', 0) > 0, f'{topic} is logged')  # type: ignore[misc]
    node.stop()
