"""The default settings and the simulated Go2: everything published is in the store unchanged and accounted for."""

from __future__ import annotations

import io
import re
from datetime import datetime, timezone

import numpy as np
import pypcd4
import pytest
from e2e.reading import TYPES, assert_same
from e2e.session import DURATION_S, Session

SECOND = 10**9
SENSORS = {
    '/camera/compressed': 'camera', '/camera/camera_info': 'camera_info', '/point_cloud2': 'lidar', '/imu': 'imu',
    '/odom': 'odom', '/go2_states': 'states', '/joint_states': 'joints', '/lowstate': 'lowstate',
}  # fmt: skip
EVERY_MESSAGE = ('/imu', '/go2_states', '/joint_states')
KEYS = {
    'camera': r'camera/\d{8}/\d{6}_front\.jpg', 'lidar': r'lidar/\d{8}/\d{6}_scan\.pcd', 'odom': r'odom/\d{8}/\d{6}_odom\.json',
    'camera_info': r'camera_info/\d{8}/\d{6}_front\.json',
    **{name: rf'{name}/\d{{8}}/\d{{6}}_{name}\.json' for name in ('imu', 'states', 'joints', 'lowstate')},
}  # fmt: skip

pytestmark = pytest.mark.timeout(300 + 2 * DURATION_S)


def test_the_default_profile_is_accounted_for(session: Session) -> None:
    """Every topic is accounted exactly, nothing is missed, dropped, rejected or open, and all of it is delivered."""
    assert session.ledger['balanced']
    assert set(session.ledger['topics']) == set(TYPES)
    for topic, row in session.ledger['topics'].items():
        assert (topic, row['missed'], row['rejected'], row['dropped'], row['open']) == (topic, session.node.known(0), {}, {}, 0)
        assert (row['accounting'] == 'exact') is session.node.hears_numbers
    objects = session.ledger['objects']
    assert objects['delivered'] == objects['spooled']


def test_the_default_profile_counts_what_the_robot_published(session: Session) -> None:
    """The robot's count of each topic equals the ledger's, from the first message on."""
    counted = 'published' if session.node.hears_numbers else 'received'
    assert {topic: row[counted] for topic, row in session.ledger['topics'].items()} == {
        topic: count for topic, count in session.said.items() if topic in TYPES
    }


def test_the_store_has_what_the_ledger_states(session: Session) -> None:
    """The samples inside the objects of the store are as many as the ledger calls stored."""
    assert session.objects.counted() == {topic: row['stored'] for topic, row in session.ledger['topics'].items()}
    for name in ('imu', 'states', 'joints', 'lowstate'):
        topic = next(topic for topic, sensor in SENSORS.items() if sensor == name)
        assert len(session.objects.samples(name)) == session.ledger['topics'][topic]['stored']


def test_objects_have_the_documented_keys(session: Session) -> None:
    """Objects have the documented keys, in the UTC second of their first sample, and a type and hash."""
    for key, info in session.objects.infos.items():
        sensor = key.split('/')[1]
        first = re.sub(r'_\d{1,2}(?=\.\w+$)', '', key)  # messages after a stall get a separate key
        assert first == key or first in session.objects.infos
        assert re.fullmatch(f'{session.robot}/{KEYS[sensor]}', first)
        when = datetime.fromtimestamp(int(info.metadata['t_start_ns']) // SECOND, timezone.utc)
        assert f'{when:%Y%m%d}/{when:%H%M%S}_' in key
        assert info.metadata['sha256']
        assert info.content_type == {'jpg': 'image/jpeg', 'json': 'application/json'}.get(key[-3:], info.content_type)


@pytest.mark.parametrize('topic', EVERY_MESSAGE)
def test_every_sample_is_in_the_store(session: Session, topic: str) -> None:
    """For a topic without downsampling every message is in the store, once, under its time."""
    stamps = [sample['stamp_ns'] for sample in session.objects.samples(SENSORS[topic])]
    assert sorted(stamps) == sorted(session.by_stamp[topic])
    assert len(stamps) == session.said[topic]


@pytest.mark.parametrize('topic', ['/imu', '/go2_states', '/joint_states', '/lowstate'])
def test_batches_are_as_published(session: Session, topic: str) -> None:
    """Every field of every sample is the published one, floats bit for bit."""
    for sample in session.objects.samples(SENSORS[topic]):
        assert_same(sample, session.decoded(topic, sample['stamp_ns']), TYPES[topic], topic)


@pytest.mark.parametrize('topic', ['/camera/compressed', '/point_cloud2', '/odom', '/lowstate'])
def test_the_first_message_of_each_second_is_kept(session: Session, topic: str) -> None:
    """At 1 Hz the first message of each full second of UTC is kept, and no other."""
    firsts: dict[int, int] = {}
    for stamp in sorted(session.by_stamp[topic]):
        firsts.setdefault(stamp // SECOND, stamp)
    if topic == '/lowstate':
        kept = [sample['stamp_ns'] for sample in session.objects.samples('lowstate')]
    else:
        prefix = f'/{SENSORS[topic]}/'
        kept = [int(info.metadata['t_start_ns']) for key, info in session.objects.infos.items() if prefix in key]
    assert sorted(kept) == sorted(firsts.values())


def test_images_are_as_published(session: Session) -> None:
    """A camera object is the published JPEG, byte for byte."""
    images = session.objects.sensor('camera')
    assert len(images) >= DURATION_S
    for key, body in images.items():
        stamp = int(session.objects.infos[key].metadata['t_start_ns'])
        assert body == bytes(session.decoded('/camera/compressed', stamp).data)


def test_clouds_are_as_published(session: Session) -> None:
    """With another library, a cloud has the published points bit for bit."""
    clouds = session.objects.sensor('lidar')
    assert len(clouds) >= DURATION_S
    for key, body in clouds.items():
        message = session.decoded('/point_cloud2', int(session.objects.infos[key].metadata['t_start_ns']))
        cloud = pypcd4.PointCloud.from_fileobj(io.BytesIO(body))
        assert cloud.fields == ('x', 'y', 'z', 'intensity')
        points = np.frombuffer(bytes(message.data), '<f4').reshape(-1, 4)
        assert np.stack([cloud.pc_data[name] for name in cloud.fields], axis=1).tobytes() == points.tobytes()


def test_odometry_is_as_published(session: Session) -> None:
    """An odometry record has the published pose and twist, and its time as text."""
    records = session.objects.documents('odom')
    assert len(records) >= DURATION_S
    for record in records:
        message = session.decoded('/odom', record['stamp_ns'])
        pose, twist = message.pose.pose, message.twist.twist
        for name, value in (('position', pose.position), ('orientation', pose.orientation),
                            ('linear_velocity', twist.linear), ('angular_velocity', twist.angular)):  # fmt: skip
            assert_same(record[name], value, 'geometry_msgs/msg/Any', name)
        assert (record['frame_id'], record['child_frame_id']) == (message.header.frame_id, message.child_frame_id)
        assert datetime.fromisoformat(record['timestamp'].replace('Z', '+00:00')).timestamp() == record['stamp_ns'] // 1000 / 1e6


def test_calibration_is_kept_once(session: Session) -> None:
    """A calibration that never changes is stored once, as published."""
    (record,) = session.objects.documents('camera_info')
    message = session.decoded('/camera/camera_info', record['stamp_ns'])
    own = {'robot', 'sensor', 'topic', 'type', 'timestamp'}
    assert_same({name: value for name, value in record.items() if name not in own}, message, TYPES['/camera/camera_info'])
