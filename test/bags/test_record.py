"""``record_and_upload_rosbag``: a bag is recorded on request, in a separate process, from real publishers into the store."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from bags.real_bags import by_rosbags
from e2e.processes import until

from shadowhound_data_logger.bags import record_and_upload_rosbag
from shadowhound_data_logger.bags.manifest import Manifest
from shadowhound_data_logger.bags.record import record
from shadowhound_data_logger.core.errors import BagError

pytestmark = pytest.mark.ros
long = pytest.mark.long('starts more processes')
PUBLISHER = """
import time, rclpy
from nav_msgs.msg import Odometry
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node('publisher')
odom, text = node.create_publisher(Odometry, '/odom', 10), node.create_publisher(String, '/text', 10)
while True:
    odom.publish(Odometry())
    text.publish(String(data='hello'))
    time.sleep(0.02)
"""


@pytest.fixture
def home(domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A home, while a program publishes odometry and text at 50 Hz."""
    environ = {'ROS_DOMAIN_ID': str(domain),
               'SHADOWHOUND_HOME': str(tmp_path / 'home'), 'AWS_ENDPOINT_URL': ''}  # fmt: skip
    for name, value in environ.items():
        monkeypatch.setenv(name, value)
    publisher = subprocess.Popen([sys.executable, '-c', PUBLISHER])
    yield tmp_path / 'home'
    publisher.kill()
    publisher.wait()


def rosbags_of(home: Path) -> Path:
    return home / 'store' / 'sensor-data' / 'thor' / 'rosbags'


@pytest.mark.long('starts more processes')
def test_the_function_of_the_guide_records_and_uploads(home: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """It returns when the store has the bag, with every published topic: the robot is not a Unitree."""
    found = record_and_upload_rosbag('patrol', 2)
    assert (found.delivered, found.dropped) == (True, 0)
    assert f'Uploaded: s3://sensor-data/thor/rosbags/{found.bag}/' in capfd.readouterr().out
    assert found.bag.startswith('patrol_')
    messages = by_rosbags(rosbags_of(home) / found.bag)
    assert {topic for topic, _, _ in messages} >= {'/odom', '/text'}
    assert len(messages) == found.messages == sum(found.topics.values())
    assert found.topics['/odom'] > 20
    manifest = Manifest.from_json((rosbags_of(home) / found.bag / 'manifest.json').read_bytes())
    assert (manifest.state, manifest.mission and manifest.mission.type) == ('complete', 'patrol')


@long
def test_only_the_named_topics_are_recorded(home: Path) -> None:
    """Only that topic; if no message arrives there is an error, and no bag is left."""
    found = record('words', 1.0, topics=['/text'])
    assert list(found.topics) == ['/text']
    with pytest.raises(BagError, match='nothing was published'):
        record('silence', 0.5, topics=['/nobody'])
    assert [path.name for path in rosbags_of(home).iterdir()] == [found.bag]


@long
def test_a_later_recorder_completes_and_uploads_the_bag_of_a_killed_one(home: Path) -> None:
    """After kill -9 during a recording: the next one completes the bag and records what may be missing."""
    program = 'shadowhound_data_logger.node.recording.bag_process'
    child = subprocess.Popen([sys.executable, '-m', program, '--robot=thor', '--duration=60', '--topic=/odom', 'cut_off'])
    end = time.monotonic() + 60
    while not any(path.stat().st_size > 4096 for path in (home / 'records').rglob('*.open')):
        assert time.monotonic() < end
        time.sleep(0.05)
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    found = record('next', 1.0, topics=['/text'])
    assert (found.delivered, list(found.topics)) == (True, ['/text'])
    (folder,) = rosbags_of(home).glob('cut_off_*')
    manifest = Manifest.from_json((folder / 'manifest.json').read_bytes())
    assert manifest.state == 'recovered'
    assert len(by_rosbags(folder)) == manifest.slices[0].messages > 0


@long
def test_a_recording_survives_a_damaged_index(home: Path) -> None:
    """The bag is completed and another one follows; both are in the store, and the call returns the last one."""
    program = 'shadowhound_data_logger.node.recording.bag_process'
    command = [sys.executable, '-m', program, '--robot=thor', '--duration=60', '--topic=/odom', 'patrol']
    with subprocess.Popen(command, stdout=subprocess.PIPE) as child:
        until(lambda: any(path.stat().st_size > 4096 for path in (home / 'records').rglob('*.open')), 'it records')
        for name in 'index.db', 'index.db-wal', 'index.db-shm':  # of one alone SQLite reads nothing for a while
            with (home / 'spool' / name).open('r+b') as file:
                file.write(os.urandom(os.fstat(file.fileno()).st_size))
        until(lambda: len(list(rosbags_of(home).glob('patrol_*/manifest.json'))) == 1, 'the first bag is whole')
        until(lambda: any(path.stat().st_size > 4096 for path in (home / 'records').rglob('*.open')), 'it records again')
        child.send_signal(signal.SIGINT)
        data = json.loads(child.communicate()[0].splitlines()[-1])
    assert (child.returncode, data['delivered']) == (0, True)
    folders = sorted(rosbags_of(home).iterdir())
    assert [folder.name for folder in folders][-1] == data['bag']
    for folder in folders:
        manifest = Manifest.from_json((folder / 'manifest.json').read_bytes())
        assert manifest.state == 'complete'
        assert len(by_rosbags(folder)) == sum(each.messages for each in manifest.slices) > 0
    assert len(folders) == 2
