"""The node's part in a mission: its start and end, what is marked, what is logged."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
from missions.fakes import journalling
from missions.server import until
from rosbags.typesys import Stores, get_typestore

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.model import Batch, DataObject, Sample
from shadowhound_data_logger.core.options import POINT_CLOUD
from shadowhound_data_logger.core.status import MissionStatus
from shadowhound_data_logger.formats.encoders import encode
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.missions import journal
from shadowhound_data_logger.missions.folder import Run, missions
from shadowhound_data_logger.missions.node_log import Cloud, Frame, Reading
from shadowhound_data_logger.missions.odometer import Pose
from shadowhound_data_logger.node.encoding.encode_pool import BatchQueue
from shadowhound_data_logger.node.recording.mission import MissionWatch
from shadowhound_data_logger.node.recording.mission_observer import MissionObserver

SECOND = 10**9
NOON_NS = 1_760_788_800 * SECOND
STORE = get_typestore(Stores.LATEST)
JPEG = simplejpeg.encode_jpeg(np.zeros((8, 8, 3), np.uint8))


class Intake:
    """Runs requests immediately; also acts as the sampler."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def flush(self, _: float, then: Callable[[], None] | None = None) -> bool:
        self.asked.append('flush')
        if then is not None:
            then()
        return True

    def set_idle(self, *, idle: bool) -> None:
        """As the sampler's method."""
        self.asked.append('idle' if idle else 'busy')


def given(parameters: Mapping[str, object], home: Path) -> Settings:
    named = {f'mission.{name}': value for name, value in parameters.items()}
    return Settings.load(named, {'SHADOWHOUND_HOME': str(home), 'SHADOWHOUND_ROBOT': 'thor'})


class Setting:
    """A node's watch over the missions of a home."""

    def __init__(self, home: Path, **parameters: object) -> None:
        settings = given(parameters, home)
        self.intake: Any = Intake()
        self.told: list[MissionStatus] = []
        queue = BatchQueue(settings.queue)
        self.watch = MissionWatch(settings, self.intake, self.intake, queue, new_observer(**parameters), self.told.append)
        self.watch.open()

    def stop(self) -> None:
        self.watch.stop()
        self.watch.close()


@pytest.fixture
def opened() -> Iterator[ExitStack]:
    """Closes everything that a test opens."""
    with ExitStack() as stack:
        yield stack


def watching(opened: ExitStack, home: Path, **parameters: object) -> tuple[Setting, MissionDataLogger]:
    logger = opened.enter_context(journalling(home))
    setting = Setting(home, **parameters)
    opened.callback(setting.stop)
    return setting, logger


def new_observer(**parameters: object) -> MissionObserver:
    settings = given(parameters, Path('nowhere'))
    sensors = {sensor.name: sensor for sensor in settings.sensors}
    return MissionObserver(settings.mission, sensors, 'thor', MessageTypes(), lambda topic: f'/{topic}')


def batch(sensor: str, topic: str, kind: str, *messages: Any, start_ns: int = NOON_NS, step_ns: int = SECOND // 10) -> Batch:
    samples = tuple(
        Sample(start_ns + number * step_ns, bytes(STORE.serialize_cdr(message, kind))) for number, message in enumerate(messages)
    )
    return Batch(sensor, topic, kind, samples, 1)


def a_header(frame_id: str = '') -> Any:
    return STORE.types['std_msgs/msg/Header'](STORE.types['builtin_interfaces/msg/Time'](0, 0), frame_id)


def odometry(x: float, yaw: float) -> Any:
    types = STORE.types
    turn = types['geometry_msgs/msg/Quaternion'](0, 0, np.sin(yaw / 2), np.cos(yaw / 2))
    pose = types['geometry_msgs/msg/Pose'](types['geometry_msgs/msg/Point'](x, 2.0, 0.3), turn)
    zero = types['geometry_msgs/msg/Vector3'](0, 0, 0)
    header = a_header('odom')
    return types['nav_msgs/msg/Odometry'](
        header, 'base_link', types['geometry_msgs/msg/PoseWithCovariance'](pose, np.zeros(36)),
        types['geometry_msgs/msg/TwistWithCovariance'](types['geometry_msgs/msg/Twist'](zero, zero), np.zeros(36)),
    )  # fmt: skip


def thing(t_start_ns: int) -> DataObject:
    return DataObject(bucket='b', key='k', body=b'', content_type='', sensor='imu', topic='/imu', type='', samples=1,
                      t_start_ns=t_start_ns, t_end_ns=t_start_ns, metadata={'robot': 'thor'})  # fmt: skip


# -- when --------------------------------------------------------------------------------------------------------------


def test_objects_of_the_missions_time_are_marked(tmp_path: Path, opened: ExitStack) -> None:
    """With its id, and the run's once it is known; objects that started before it or follow the end are not."""
    setting, logger = watching(opened, tmp_path)
    assert setting.watch.mark(thing(NOON_NS)).metadata == {'robot': 'thor'}
    mission_id = logger.start_mission('patrol', '')
    until(setting.watch.status, 'the mission is noticed')
    assert setting.watch.status().policy is None
    (tmp_path / 'policies').mkdir()
    (tmp_path / 'policies' / 'current').symlink_to('versions/go2_patrol@7#0123456789abcdef')
    assert setting.watch.status().policy == 'go2_patrol@7#0123456789abcdef'
    (folder,) = missions(tmp_path)
    start_ns = int(journal.first(folder.journal)['t'])
    marked = {'robot': 'thor', 'mission_id': mission_id, 'mission_type': 'patrol'}
    assert setting.watch.mark(thing(start_ns)).metadata == marked
    assert setting.watch.mark(thing(start_ns - 1)).metadata == {'robot': 'thor'}
    folder.set_run(Run('run7', '1', ''))
    until(lambda: setting.watch.mark(thing(start_ns)).metadata.get('run_id') == 'run7', 'the run is noticed')
    logger.end_mission(True, 1.0, 1.0)
    until(lambda: not setting.watch.status(), 'the end is noticed')
    end_ns = int(journal.last(folder.journal)['t'])
    assert setting.watch.mark(thing(end_ns)).metadata == {**marked, 'run_id': 'run7'}, 'it was on its way'
    assert setting.watch.mark(thing(end_ns + 1)).metadata == {'robot': 'thor'}
    assert [(bool(report), report.run_id) for report in setting.told] == [(True, None), (True, 'run7'), (False, None)]


def test_a_mark_has_the_agents_spelling(tmp_path: Path, opened: ExitStack) -> None:
    """However the agent spells the name of its mission."""
    setting, logger = watching(opened, tmp_path)
    logger.start_mission('Küche\n\N{DOG FACE}', '')
    until(setting.watch.status, 'the mission is noticed')
    (folder,) = missions(tmp_path)
    marks = setting.watch.mark(thing(int(journal.first(folder.journal)['t']))).metadata
    assert marks['mission_type'] == 'Küche\n\N{DOG FACE}'


@pytest.mark.parametrize(
    ('capture', 'asked'), [('always', ['flush', 'flush']), ('mission', ['idle', 'flush', 'busy', 'flush', 'idle'])]
)
def test_batches_end_where_missions_begin_and_end(tmp_path: Path, opened: ExitStack, capture: str, asked: list[str]) -> None:
    """No object spans a mission and other time; with ``capture: mission`` nothing is stored outside a mission."""
    setting, logger = watching(opened, tmp_path, capture=capture)
    logger.start_mission('patrol', '')
    until(setting.watch.status, 'the mission is noticed')
    logger.end_mission(True, 1.0, 1.0)
    until(lambda: not setting.watch.status(), 'the end is noticed')
    assert setting.intake.asked == asked


def test_robot_state_is_journaled(tmp_path: Path, opened: ExitStack) -> None:
    """From start to end; then the journal is released; with ``join: false`` there is none."""
    setting, logger = watching(opened, tmp_path)
    logger.start_mission('patrol', '')
    until(setting.watch.status, 'the mission is noticed')
    (folder,) = missions(tmp_path)
    start_ns = int(journal.first(folder.journal)['t'])
    poses = odometry(0, 0), odometry(0.3, 1.0)
    setting.watch.observe(batch('odom', '/odom', 'nav_msgs/msg/Odometry', *poses, start_ns=start_ns), None)
    until(lambda: time.time_ns() > start_ns + SECOND // 10, 'the second pose is of the mission')
    logger.end_mission(True, 1.0, 1.0)
    until(lambda: not setting.watch.status(), 'the end is noticed')
    until(lambda: not journal.is_locked(folder.node.journal), 'the journal is let go of')
    points = [line.record['m'] for line in journal.read(folder.node.journal) if line.record and 'm' in line.record]
    assert points[-1]['distance_traveled_m'] == pytest.approx(0.3)


def test_the_node_joins_a_mission_only_if_configured(tmp_path: Path, opened: ExitStack) -> None:
    """Without ``join`` objects are still marked, and the mission's folder is not touched."""
    setting, logger = watching(opened, tmp_path, join=False)
    logger.start_mission('patrol', '')
    until(setting.watch.status, 'the mission is noticed')
    setting.watch.observe(batch('odom', '/odom', 'nav_msgs/msg/Odometry', odometry(0, 0)), None)
    (folder,) = missions(tmp_path)
    assert not folder.node.path.exists()


# -- what --------------------------------------------------------------------------------------------------------------


def test_poses_are_read_from_odometry() -> None:
    """All logged values, with the heading in radians."""
    found = list(new_observer().facts(batch('odom', '/odom', 'nav_msgs/msg/Odometry', odometry(1, 0.5), odometry(1.5, -3.0))))
    assert [pose for pose in found if isinstance(pose, Pose)] == [
        Pose(NOON_NS, 1.0, 2.0, pytest.approx(0.5), 0.3, 'odom'),
        Pose(NOON_NS + SECOND // 10, 1.5, 2.0, pytest.approx(-3.0), 0.3, 'odom'),
    ]  # fmt: skip


def test_a_field_is_read_once_per_period() -> None:
    """Any number of any type, including an element of an array."""
    observer = new_observer(battery='joint_states:position.1', temperature='')
    joints = STORE.types['sensor_msgs/msg/JointState']
    empty = np.zeros(0)
    messages = [joints(a_header(), [], np.array([0.0, float(number)]), empty, empty) for number in range(25)]
    found = list(observer.facts(batch('joints', '/joint_states', 'sensor_msgs/msg/JointState', *messages)))
    assert found == [Reading(NOON_NS + number * SECOND // 10, 'battery_pct', float(number)) for number in (0, 10, 20)]


def test_a_missing_field_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    """The mission continues without it."""
    observer = new_observer(battery='talk:no.such', temperature='')
    messages = [STORE.types['std_msgs/msg/String']('hi')] * 20
    assert list(observer.facts(batch('talk', '/talk', 'std_msgs/msg/String', *messages))) == []
    assert [record.getMessage() for record in caplog.records] == [
        'battery_pct is not logged to the mission: std_msgs/msg/String has no number no.such'
    ]


def test_a_battery_state_is_logged_in_percent(caplog: pytest.LogCaptureFixture) -> None:
    """Its ``percentage`` is 0 to 1; an unmeasured value is not logged, an invalid one is reported once."""
    observer = new_observer(battery='battery:percentage', temperature='battery:temperature')
    kind, none = STORE.types['sensor_msgs/msg/BatteryState'], np.empty(0, np.float32)
    some = [kind(a_header(), 28.5, 31.0, -2.0, 10.0, 15.0, 15.0, share, 2, 1, 3, True, none, none, '', '')
            for share in (0.5, float('nan'), 73.0, 74.0)]  # fmt: skip
    found = list(observer.facts(batch('battery', '/battery', 'sensor_msgs/msg/BatteryState', *some, step_ns=SECOND)))
    assert [each.value for each in found if each.key == 'battery_pct'] == [50.0]
    assert [each.value for each in found if each.key == 'temperature_c'] == [31.0] * 4
    assert [record.getMessage() for record in caplog.records] == [
        'battery_pct is not logged to the mission: sensor_msgs/msg/BatteryState has percentage = 73, which is not between 0 and 1'
    ]


def test_a_frame_is_taken_every_few_seconds() -> None:
    """As the camera published it; images of other sensors are not part of the mission."""
    observer, kind = new_observer(frame_every_s=5.0), 'sensor_msgs/msg/CompressedImage'
    image = STORE.types[kind](a_header(), 'jpeg', np.frombuffer(JPEG, np.uint8))
    batches = [batch('camera', '/c', kind, image, start_ns=NOON_NS + second * SECOND) for second in range(11)]
    found = [fact for one in batches for fact in observer.facts(one)]
    assert found == [Frame(NOON_NS + second * SECOND, JPEG) for second in (0, 5, 10)]
    assert list(observer.facts(batch('other', '/c', kind, image))) == []


def test_without_a_camera_sensor_the_first_image_sensor_is_used() -> None:
    """The first sensor with images, until there is a ``camera``."""
    settings = given({}, Path('nowhere'))
    camera = next(sensor for sensor in settings.sensors if sensor.name == 'camera')
    shown = dict.fromkeys(('wrist', 'side', 'camera'), camera)
    observer = MissionObserver(settings.mission, shown, 'thor', MessageTypes(), lambda topic: f'/{topic}')
    kind = 'sensor_msgs/msg/CompressedImage'
    image = STORE.types[kind](a_header(), 'jpeg', np.frombuffer(JPEG, np.uint8))
    sensors = ('wrist', 'side', 'wrist', 'camera', 'wrist')
    taken = [batch(name, f'/{name}', kind, image, start_ns=NOON_NS + 10 * place * SECOND) for place, name in enumerate(sensors)]
    found = [[type(fact) for fact in observer.facts(each)] for each in taken]
    assert found == [[Frame], [], [Frame], [Frame], []]


def test_without_odometry_poses_come_from_tf() -> None:
    """They come from tf until there is odometry."""
    kind = 'tf2_msgs/msg/TFMessage'
    settings = given({}, Path('nowhere'))
    place = Pose(NOON_NS, 1.0, 2.0, 0.5, 0.1, 'map')
    observer = MissionObserver(settings.mission, {}, 'thor', MessageTypes(), lambda topic: f'/{topic}', place=lambda _: place)
    moved = Batch('tf', '/tf', kind, (Sample(NOON_NS, b''),), 0)
    assert list(observer.facts(moved)) == [place]
    assert len(list(observer.facts(batch('odom', '/wheels', 'nav_msgs/msg/Odometry', odometry(1, 0.5))))) == 1
    assert list(observer.facts(Batch('tf', '/tf', kind, (Sample(NOON_NS + SECOND, b''),), 0))) == []


@pytest.mark.parametrize(
    ('parameters', 'again'), [({}, 0), ({'camera.format': 'png'}, 1), ({'camera.format': 'zip', 'camera.batch_s': 1.0}, 1)]
)
def test_a_raw_frame_is_encoded_once(monkeypatch: pytest.MonkeyPatch, parameters: dict[str, object], again: int) -> None:
    """The mission has the JPEG that was made for the sensor, and encodes one only if the sensor's object is not a JPEG."""
    made: list[int] = []

    def counting(*given: Any, **options: Any) -> bytes:
        made.append(1)
        return simplejpeg_encode(*given, **options)

    simplejpeg_encode = simplejpeg.encode_jpeg
    monkeypatch.setattr(simplejpeg, 'encode_jpeg', counting)
    settings = Settings.load({'robot': 'thor', **parameters}, {})
    camera = next(sensor for sensor in settings.sensors if sensor.name == 'camera')
    pixels = np.arange(64 * 48 * 3, dtype=np.uint32).astype(np.uint8)
    raw = STORE.types['sensor_msgs/msg/Image'](a_header(), 48, 64, 'bgr8', 0, 64 * 3, pixels)
    taken = batch('camera', '/c', 'sensor_msgs/msg/Image', raw)
    item = encode(taken, camera, 'thor', MessageTypes()).object
    assert item is not None
    of_sensor = len(made)
    observer = MissionObserver(settings.mission, {'camera': camera}, 'thor', MessageTypes(), lambda topic: f'/{topic}')
    (frame,) = observer.facts(taken, item)
    assert isinstance(frame, Frame)
    assert simplejpeg.is_jpeg(frame.body)
    assert (frame.body == item.body, len(made) - of_sensor) == (not again, again)


@pytest.mark.parametrize(('row_step', 'pad'), [(48, 0), (0, 0), (96, 0), (60, 12)])
def test_an_organized_cloud_gives_the_floor_plan(row_step: int, pad: int) -> None:
    """Each point of a cloud with several rows is at its position in the floor plan, with any memory layout."""
    types = STORE.types
    points = np.arange(24, dtype='<f4').reshape(6, 4)
    rows = np.hstack((points.view(np.uint8).reshape(2, -1), np.full((2, pad), 9, np.uint8)))
    fields = [types['sensor_msgs/msg/PointField'](name, 4 * number, 7, 1) for number, name in enumerate('xyzi')]
    cloud = types[POINT_CLOUD](a_header('odom'), 2, 3, fields, False, 16, row_step, rows.reshape(-1), True)
    (fact,) = new_observer().facts(batch('lidar', '/point_cloud2', POINT_CLOUD, cloud))
    assert isinstance(fact, Cloud)
    np.testing.assert_array_equal(fact.xyz, points[:, :3])
