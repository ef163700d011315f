"""The robot's position at an object's time, compared with the simulator's exact patrol."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from shadowhound_sim.floor_plan import FloorPlan
from shadowhound_sim.patrol import Patrol

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import MissionSettings
from shadowhound_data_logger.core.model import DataObject, Taken
from shadowhound_data_logger.formats.records import FIX, ODOMETRY
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.encoding.pose_track import RobotTrack
from shadowhound_data_logger.node.intake.consumers import Drained
from shadowhound_data_logger.node.recording.mission_observer import BATTERY_STATE

STORE = get_typestore(Stores.LATEST)
TYPES = MessageTypes()
START_NS = 1_760_788_800 * SECOND
CHARGE = 'std_msgs/msg/Float32'
SETTINGS = MissionSettings(battery='charge:data')


def odometry(x: float, y: float, yaw: float, frame: str = 'odom') -> bytes:
    of = STORE.types
    header = of['std_msgs/msg/Header'](of['builtin_interfaces/msg/Time'](0, 0), frame)
    turn = of['geometry_msgs/msg/Quaternion'](0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    pose = of['geometry_msgs/msg/Pose'](of['geometry_msgs/msg/Point'](x, y, 0.3), turn)
    still = of['geometry_msgs/msg/Vector3'](0.0, 0.0, 0.0)
    twist = of['geometry_msgs/msg/TwistWithCovariance'](of['geometry_msgs/msg/Twist'](still, still), np.zeros(36))
    message = of[ODOMETRY](header, 'base_link', of['geometry_msgs/msg/PoseWithCovariance'](pose, np.zeros(36)), twist)
    return bytes(STORE.serialize_cdr(message, ODOMETRY))


def charge(percent: float) -> bytes:
    return bytes(STORE.serialize_cdr(STORE.types[CHARGE](percent), CHARGE))


def battery_state(share: float) -> bytes:
    of = STORE.types
    header = of['std_msgs/msg/Header'](of['builtin_interfaces/msg/Time'](0, 0), '')
    none = np.empty(0, np.float32)
    message = of[BATTERY_STATE](header, 28.5, 31.0, -2.0, 10.0, 15.0, 15.0, share, 2, 1, 3, True, none, none, 'base', '1')
    return bytes(STORE.serialize_cdr(message, BATTERY_STATE))


def robot(settings: MissionSettings = SETTINGS) -> RobotTrack:
    return RobotTrack(settings, TYPES, lambda topic: f'/{topic}')


def walking(poses: Sequence[tuple[float, bytes]]) -> RobotTrack:
    """A track with odometry received at these seconds."""
    found = robot()
    take(found, '/odom', ODOMETRY, *poses)
    return found


def take(found: RobotTrack, topic: str, type_name: str, *sent: tuple[float, bytes]) -> None:
    """Messages as the intake passes them on."""
    messages = [Taken(cdr, ns(t), 'p', None, ns(t), ns(t)) for t, cdr in sent]
    found.take(Drained(topic, type_name, topic[1:], messages, None, 0.0, paused=False))


def ns(t: float) -> int:
    return START_NS + round(t * 1e9)


def marked(found: RobotTrack, start: float, end: float | None = None) -> dict[str, str]:
    """The pose recorded with an object of this time in seconds."""
    item = DataObject(bucket='b', key='k', body=b'', content_type='', sensor='s', topic=None, type='', samples=1,
                      t_start_ns=ns(start), t_end_ns=ns(start if end is None else end))  # fmt: skip
    return dict(found.mark(item).metadata)


def pose(found: RobotTrack, start: float, end: float | None = None) -> tuple[float, float, float] | None:
    words = marked(found, start, end).get('pose', '').split(' ')
    return (float(words[0]), float(words[1]), float(words[2])) if len(words) == 4 else None


@pytest.mark.parametrize(('rate_hz', 'bar_m', 'bar_rad'), [(50.0, 0.005, 0.04), (10.0, 0.005, 0.04), (5.0, 0.01, 0.2)])
def test_poses_are_exact_throughout_a_patrol(rate_hz: float, bar_m: float, bar_rad: float) -> None:
    """Around every corner, at any time between two messages, they match the simulator's within 10 cm."""
    patrol = Patrol.through(FloorPlan.build().patrol)
    count = round(50 * rate_hz)
    truths = [(number / rate_hz, patrol.at(number / rate_hz)) for number in range(count)]
    found = walking([(t, odometry(at.x, at.y, at.yaw)) for t, at in truths])
    turned = 0.0
    for t in np.arange(1.0, 49.0, 0.037).tolist():
        truth, at = patrol.at(t), pose(found, t)
        assert at is not None
        assert math.hypot(at[0] - truth.x, at[1] - truth.y) < bar_m
        assert abs((at[2] - truth.yaw + math.pi) % math.tau - math.pi) < bar_rad
        turned = max(turned, abs(truth.yaw_rate))
    assert turned > 1.0


def test_the_odometry_may_come_a_little_late() -> None:
    """Up to 250 ms after the newest message the pose is within 10 cm in any turn; after that it is unknown."""
    patrol = Patrol.through(FloorPlan.build().patrol)
    for end in np.arange(1.0, 40.0, 0.21).tolist():
        times = np.arange(end - 0.5, end + 1e-9, 0.02).tolist()
        found = walking([(t, odometry(*patrol.at(t)[:3])) for t in times])
        truth, at = patrol.at(times[-1] + 0.25), pose(found, times[-1] + 0.25)
        assert at is not None
        assert math.hypot(at[0] - truth.x, at[1] - truth.y) < 0.1
        assert pose(found, times[-1] + 0.26) is None


@pytest.mark.long('a second of CPU or more')
def test_poses_are_exact_when_the_node_starts_during_a_turn() -> None:
    """Before the first odometry received there is no pose, except for a moment in which no robot turns much."""
    patrol = Patrol.through(FloorPlan.build().patrol)
    known = 0
    for start in np.arange(1.0, 40.0, 0.03).tolist():
        found = walking([(t, odometry(*patrol.at(t)[:3])) for t in np.arange(start, start + 0.5, 0.02).tolist()])
        for before in (0.25, 0.15, 0.06, 0.05, 0.02):
            truth, at = patrol.at(start - before), pose(found, start - before)
            assert at is None or abs((at[2] - truth.yaw + math.pi) % math.tau - math.pi) < 0.1
            known += at is not None
    assert known


def test_a_batch_has_the_pose_of_its_middle() -> None:
    """Its start and end do not matter."""
    found = walking([(t, odometry(t, 0.0, 0.0)) for t in range(11)])
    assert pose(found, 2.0, 8.0) == (5.0, 0.0, 0.0)


def test_yaw_is_interpolated_the_shorter_way() -> None:
    """From 179 to -179 degrees through 180; the text never contains a negative zero."""
    found = walking([(0.0, odometry(0, -1e-9, math.radians(179))), (0.1, odometry(0, 0, math.radians(-177)))])
    at = pose(found, 0.05)
    assert at is not None
    assert math.degrees(at[2]) == pytest.approx(-179, abs=0.1)
    assert marked(found, 0.05)['pose'].startswith('0.000 0.000 ')


@pytest.mark.parametrize(
    ('times', 'asked', 'known'),
    [
        ([], 0.0, False), ([1.0], 1.0, True), ([1.0], 1.04, True), ([1.0], 1.1, False), ([1.0, 2.0], 0.96, True),
        ([1.0, 2.0], 0.9, False), ([1.0, 4.0], 2.5, False), ([1.0, 4.0], 4.0, True), ([1.0, 4.0], 4.1, False),
    ],
)  # fmt: skip
def test_an_unknown_pose_is_not_invented(times: list[float], asked: float, known: bool) -> None:
    """Before the first message, in a gap and after the last there is no pose; a single message is valid for a moment."""
    assert (pose(walking([(t, odometry(1, 1, 0)) for t in times]), asked) is not None) is known


@pytest.mark.long('a minute of poses')
def test_the_track_is_a_minute_long() -> None:
    """Older messages are removed, so that it stays bounded; of fast odometry a few messages per second are kept."""
    found = walking([(number / 200, odometry(number / 200, 0.0, 0.0)) for number in range(200 * 200)])
    ((_, track),) = found._poses
    assert len(track._kept) == len(track._stamps) < 1500
    assert pose(found, 100.0) is None
    assert pose(found, 145.03) == pytest.approx((145.03, 0.0, 0.0), abs=1e-3)


def test_a_clock_step_starts_a_new_track() -> None:
    """After a step back, poses use only the messages after it; a message that is slightly late changes nothing."""
    found = walking([(100.0, odometry(1, 0, 0)), (101.0, odometry(1, 0, 0)), (50.0, odometry(5, 0, 0)),
                     (51.0, odometry(5, 0, 0)), (50.5, odometry(9, 0, 0))])  # fmt: skip
    assert pose(found, 50.5) == (5.0, 0.0, 0.0)
    assert pose(found, 100.5) is None


@pytest.mark.parametrize('cdr', [b'', b'\x00\x01\x00\x00', odometry(math.nan, 0, 0), odometry(0, 0, 0)[:60]])
def test_unreadable_odometry_is_skipped(cdr: bytes) -> None:
    """Objects are not affected."""
    assert pose(walking([(0.0, cdr), (0.1, cdr)]), 0.05) is None


def test_a_frame_id_is_one_word() -> None:
    """Whatever the odometry contains, the pose is four words of ASCII; between two frames there is none."""
    report = marked(walking([(t, odometry(1, 2, 0, 'my odöm\n')) for t in (0.0, 0.1)]), 0.05)['pose']
    assert report == '1.000 2.000 0.0000 my_od_m_'
    found = walking([(0.0, odometry(1, 2, 0, 'odom')), (0.2, odometry(9, 9, 0, 'map'))])
    assert pose(found, 0.1) is None


def test_the_battery_is_the_nearest_one_known() -> None:
    """Within half a minute, before or after."""
    found = robot()
    track = found.of('/charge', CHARGE)
    assert track is not None
    track.add(ns(0.0), charge(80.0))
    track.add(ns(10.0), charge(79.5))
    reports = [marked(found, t).get('battery_pct') for t in (-31.0, -29.0, 4.0, 6.0, 39.0, 41.0)]
    assert reports == [None, '80', '80', '79.5', '79.5', None]


def test_any_battery_state_is_one_by_default() -> None:
    """On any topic; a preferred topic takes precedence."""
    found = robot(MissionSettings())
    take(found, '/power/main', BATTERY_STATE, (0.0, battery_state(0.25)))
    assert marked(found, 0.0)['battery_pct'] == '25'
    take(found, '/battery_state', BATTERY_STATE, (0.0, battery_state(0.75)))
    assert marked(found, 0.0)['battery_pct'] == '75'


def test_any_odometry_is_one_by_default() -> None:
    """On any topic; ``odom`` takes precedence."""
    found = robot(MissionSettings())
    take(found, '/wheels/odometry', ODOMETRY, (0.0, odometry(1, 2, 0)))
    assert pose(found, 0.0) == (1.0, 2.0, 0.0)
    take(found, '/odom', ODOMETRY, (0.0, odometry(3, 4, 0)))
    assert pose(found, 0.0) == (3.0, 4.0, 0.0)


def fix(latitude: float, longitude: float, altitude: float = 500.0, status: int = 0) -> bytes:
    of = STORE.types
    header = of['std_msgs/msg/Header'](of['builtin_interfaces/msg/Time'](0, 0), 'gps')
    message = of[FIX](header, of['sensor_msgs/msg/NavSatStatus'](status, 1), latitude, longitude, altitude, np.zeros(9), 0)
    return bytes(STORE.serialize_cdr(message, FIX))


@pytest.mark.parametrize(
    ('t', 'gps'),
    [
        (0.0, '10.0000000 20.0000000 500.00'), (0.25, '10.0000250 20.0000250 500.00'), (1.0, '10.0001000 20.0001000 500.00'),
        (2.9, '10.0001000 20.0001000 500.00'), (3.1, None), (-2.1, None),
    ],
)  # fmt: skip
def test_the_position_on_earth_is_that_of_the_nearest_fixes(t: float, gps: str | None) -> None:
    """Interpolated between the fixes around it, or a single one at most two seconds away."""
    found = robot()
    take(found, '/fix', FIX, (0.0, fix(10.0, 20.0)), (1.0, fix(10.0001, 20.0001, status=-2)))
    assert marked(found, t).get('gps') == gps


def test_positions_are_interpolated_across_the_antimeridian() -> None:
    """180 is between 179.9999 and -179.9999."""
    found = robot()
    take(found, '/fix', FIX, (0.0, fix(0.0, 179.9999)), (1.0, fix(0.0, -179.9999)))
    assert marked(found, 0.5)['gps'] == '0.0000000 -180.0000000 500.00'


@pytest.mark.parametrize('cdr', [b'', fix(1.0, 1.0, status=-1), fix(math.nan, math.nan), fix(95.0, 0.0), fix(0.0, 200.0)])
def test_without_a_fix_there_is_no_position(cdr: bytes) -> None:
    """Without a fix, and for coordinates that are not on Earth."""
    found = robot()
    take(found, '/fix', FIX, (0.0, cdr))
    assert 'gps' not in marked(found, 0.0)


@pytest.mark.parametrize(
    ('published', 'known'),
    [(0.73, '73'), (0.0, '0'), (1.0, '100'), (math.nan, None), (-1.0, None), (73.0, None)],
)
def test_the_charge_of_a_battery_state_is_in_percent(published: float, known: str | None) -> None:
    """``BatteryState.percentage`` is defined as 0 to 1, and NaN if it is not measured; a value outside is unknown."""
    found = robot(MissionSettings(battery='battery:percentage'))
    take(found, '/battery', BATTERY_STATE, (0.0, battery_state(published)))
    assert marked(found, 0.0).get('battery_pct') == known


def test_other_fields_of_a_battery_state_are_unchanged() -> None:
    """Volts stay volts."""
    found = robot(MissionSettings(battery='battery:voltage'))
    take(found, '/battery', BATTERY_STATE, (0.0, battery_state(0.5)))
    assert marked(found, 0.0)['battery_pct'] == '28.5'


def test_only_requested_topics_are_kept() -> None:
    """Other topics, invalid odometry and empty settings create no track, and objects are unchanged."""
    found = robot()
    assert found.of('/odom', CHARGE) is None
    assert found.of('/imu', 'sensor_msgs/msg/Imu') is None
    nothing = robot(MissionSettings(battery='', odometry=''))
    assert nothing.of('/', ODOMETRY) is None
    assert marked(nothing, 0.0) == {}


def test_encoders_ask_while_the_intake_adds() -> None:
    """Every pose they get is on the straight line of the robot's motion."""
    found = robot()
    track: Any = found.of('/odom', ODOMETRY)
    reports: list[tuple[float, tuple[float, float, float]]] = []
    ended = threading.Event()

    def ask() -> None:
        while not ended.is_set():
            reports.extend((t, at) for t in (0.5, 5.5, 9.9) if (at := pose(found, t)) is not None)

    asking = threading.Thread(target=ask)
    asking.start()
    for number in range(500):
        track.add(ns(number / 50), odometry(number / 50, 0.0, 0.0))
    while pose(found, 9.9) is None or not reports:
        pass
    ended.set()
    asking.join()
    assert reports
    assert all(at[0] == pytest.approx(t, abs=0.002) for t, at in reports)
