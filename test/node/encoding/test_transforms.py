"""The robot's position from tf at an object's time, compared with the published motion."""

from __future__ import annotations

import math
from typing import NamedTuple

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import MissionSettings
from shadowhound_data_logger.core.model import DataObject, Taken
from shadowhound_data_logger.formats.records import ODOMETRY, TRANSFORMS
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.encoding import transforms
from shadowhound_data_logger.node.encoding.pose_track import RobotTrack
from shadowhound_data_logger.node.intake.consumers import Drained

from .test_pose_track import odometry

STORE = get_typestore(Stores.LATEST)
if TRANSFORMS not in STORE.types:
    STORE.register(get_types_from_msg('geometry_msgs/TransformStamped[] transforms\n', TRANSFORMS))
TYPES = MessageTypes()
START_NS = 1_760_788_800 * SECOND


class Frame(NamedTuple):
    """A transform as it is published."""

    parent: str
    child: str
    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    z: float = 0.0


def tf(*frames: Frame) -> bytes:
    of, sent = STORE.types, []
    for each in frames:
        header = of['std_msgs/msg/Header'](of['builtin_interfaces/msg/Time'](0, 0), each.parent)
        turn = of['geometry_msgs/msg/Quaternion'](0.0, 0.0, math.sin(each.yaw / 2), math.cos(each.yaw / 2))
        moved = of['geometry_msgs/msg/Transform'](of['geometry_msgs/msg/Vector3'](each.x, each.y, each.z), turn)
        sent.append(of['geometry_msgs/msg/TransformStamped'](header, each.child, moved))
    return bytes(STORE.serialize_cdr(of[TRANSFORMS](sent), TRANSFORMS))


class Robot:
    """A track that receives transforms."""

    def __init__(self, name: str = '') -> None:
        self.track = RobotTrack(MissionSettings(), TYPES, lambda topic: f'/{topic}', name)

    def send(self, t: float, *frames: Frame, topic: str = '/tf', publisher: str = 'p') -> None:
        self.take(topic, TRANSFORMS, t, tf(*frames), publisher)

    def take(self, topic: str, type_name: str, t: float, cdr: bytes, publisher: str = 'p') -> None:
        stamp_ns = START_NS + round(t * SECOND)
        message = Taken(cdr, stamp_ns, publisher, None, stamp_ns, stamp_ns)
        self.track.take(Drained(topic, type_name, topic[1:], [message], None, 0.0, paused=False))

    def pose(self, t: float) -> tuple[float, float, float, str] | None:
        stamp_ns = START_NS + round(t * SECOND)
        item = DataObject(bucket='b', key='k', body=b'', content_type='', sensor='s', topic=None, type='', samples=1,
                          t_start_ns=stamp_ns, t_end_ns=stamp_ns)  # fmt: skip
        words = self.track.mark(item).metadata.get('pose', '').split(' ')
        return (float(words[0]), float(words[1]), float(words[2]), words[3]) if len(words) == 4 else None


def walking(robot: Robot, seconds: float = 2.0) -> Robot:
    """Along x at 1 m/s, with odometry at 20 Hz; the map is rotated by 90 degrees and shifted."""
    for number in range(round(seconds * 20) + 1):
        t = number / 20
        robot.send(t, Frame('odom', 'base_footprint', t))
        if number % 20 == 0:
            robot.send(t, Frame('map', 'odom', 10.0, 20.0, math.pi / 2), publisher='slam')
    robot.send(-1000.0, Frame('base_footprint', 'base_link', z=0.1), Frame('base_link', 'camera', 0.3), topic='/tf_static')
    return robot


def test_a_pose_is_in_the_map() -> None:
    """Odometry and localization are combined: 1.5 m ahead in odometry is 1.5 m to the left of the origin of the map."""
    assert walking(Robot()).pose(1.5) == (10.0, 21.5, round(math.pi / 2, 4), 'map')


def test_poses_are_interpolated_between_transforms() -> None:
    """It is interpolated, and extrapolated briefly; after that it is unknown."""
    robot = walking(Robot())
    assert robot.pose(1.026) == (10.0, 21.026, 1.5708, 'map')
    assert robot.pose(2.2) == (10.0, 22.2, 1.5708, 'map')
    assert robot.pose(2.3) is None
    assert robot.pose(-0.5) is None


def test_the_map_takes_precedence_over_odometry() -> None:
    """And odometry over tf without a map."""
    robot = walking(Robot())
    robot.take('/odom', ODOMETRY, 1.0, odometry(7.0, 7.0, 0.0))
    assert robot.pose(1.0) == (10.0, 21.0, 1.5708, 'map')
    robot = Robot()
    robot.send(1.0, Frame('odom', 'base_link', 3.0))
    assert robot.pose(1.0) == (3.0, 0.0, 0.0, 'odom')
    robot.take('/odom', ODOMETRY, 1.0, odometry(7.0, 7.0, 0.0))
    assert robot.pose(1.0) == (7.0, 7.0, 0.0, 'odom')


def test_an_outdated_map_is_not_used() -> None:
    """After localization stopped, the pose is that of odometry again, in its frame."""
    robot = walking(Robot(), 1.0)
    for number in range(21, 200):
        robot.send(number / 20, Frame('odom', 'base_footprint', number / 20))
    assert robot.pose(3.5) == (10.0, 23.5, 1.5708, 'map')
    assert robot.pose(8.0) == (8.0, 0.0, 0.0, 'odom')


def test_robots_in_one_tree_are_kept_apart() -> None:
    """Each has separate frames, identified by its namespace."""
    for name, x in (('robot0', 1.0), ('robot1', 2.0)):
        robot = Robot(name)
        for other, at in (('robot0', 1.0), ('robot1', 2.0)):
            robot.send(0.0, Frame('map', f'{other}/odom'), topic='/tf_static', publisher=other)
            robot.send(0.0, Frame(f'{other}/odom', f'{other}/base_link', at), publisher=other)
        assert robot.pose(0.0) == (x, 0.0, 0.0, 'map')


def test_transforms_sent_one_by_one_are_all_kept() -> None:
    """A publisher may send each transform in a separate message: none of those kept is lost."""
    robot = Robot()
    for number in range(100):
        t = number / 100
        robot.send(t, Frame('map', 'odom', 1.0))
        robot.send(t + 0.001, Frame('odom', 'base_link', t))
    assert robot.pose(0.505) == (1.504, 0.0, 0.0, 'map')


@pytest.mark.parametrize(
    'frames',
    [
        (), (Frame('base_link', 'base_link'),), (Frame('a', 'base_link'), Frame('base_link', 'a')),
        (Frame('world', 'base_link', 1.0),), (Frame('odom', 'wheel', 1.0),), (Frame('odom', 'base_link', math.nan),),
    ],
)  # fmt: skip
def test_frames_without_a_transform_have_no_pose(frames: tuple[Frame, ...]) -> None:
    """Trees without a map and odometry, invalid trees, and invalid numbers."""
    robot = Robot()
    robot.send(0.0, *frames)
    assert robot.pose(0.0) is None


@pytest.mark.parametrize('cdr', [b'', b'\0\1\0\0', b'\0\1\0\0' + b'\xff' * 40, tf(Frame('odom', 'base_link'))[:50], b'\0\7' * 30])
def test_hostile_transforms_are_ignored(cdr: bytes) -> None:
    """Invalid transforms are ignored, and those of others are found."""
    robot = walking(Robot())
    robot.take('/tf', TRANSFORMS, 1.0, cdr)
    assert robot.pose(1.5) == (10.0, 21.5, 1.5708, 'map')


def test_the_number_of_frames_is_bounded() -> None:
    """However many a publisher invents; frames still being sent are kept, and old ones are replaced."""
    track = transforms.TransformTrack(TYPES, '')
    for number in range(2 * transforms.MAX_KEPT):
        stamp_ns = START_NS + number * SECOND
        track.add('/tf', Taken(tf(Frame('odom', f'frame_{number}')), stamp_ns, 'p', None, stamp_ns, stamp_ns))
        track.add('/tf', Taken(tf(Frame('odom', 'base_link', number)), stamp_ns, 'p', None, stamp_ns, stamp_ns))
    assert len(track._sets) <= transforms.MAX_KEPT
    found = track.at(stamp_ns)
    assert found is not None
    assert found.x == number
