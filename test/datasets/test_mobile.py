"""The folder of a task: robot and arm at their original rates, detections, and the relation between them."""

from __future__ import annotations

import csv
import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from datasets.recorded import House, Mission, video_frames, x_of
from datasets.test_clocks import CLOCK, arm_stamps, record_arm
from rosbags.highlevel import AnyReader
from shadowhound_sim import so_arm

from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.datasets.export import Exported, drop, export
from shadowhound_data_logger.datasets.features import ExportOptions
from shadowhound_data_logger.datasets.lerobot import Lerobot
from shadowhound_data_logger.datasets.mobile import SET, forget
from shadowhound_data_logger.stores import open_store

DETECTION = 'vision_msgs/msg/Detection2DArray'


@pytest.fixture(scope='module')
def house(tmp_path_factory: pytest.TempPathFactory) -> House:
    made = House(tmp_path_factory.mktemp('house'))
    for number in range(2):
        record_arm(
            made, made.record(Mission(f'fetch{number}', begin_s=100.0 * number, seconds=2, sensors=('camera', 'odom', 'joints')))
        )
    return made


@pytest.fixture(scope='module')
def task(house: House, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Exported]:
    folder = tmp_path_factory.mktemp('task') / 'fetch'
    return folder, export(folder / SET, house.source, {}, ExportOptions(state=('velocity',), arm='soarm'))


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline='', encoding='utf-8') as file:
        return list(csv.DictReader(file))


@pytest.mark.long('a second of CPU or more')
def test_what_each_recorded_is_there_at_its_own_rate(task: tuple[Path, Exported]) -> None:
    """Odometry as any bag reader reads it, joints of both, the video of the frames."""
    folder, _ = task
    mission = Mission('', begin_s=100, seconds=2)
    within = [stamp for stamp in mission.stamps('odom') if mission.begin_ns <= stamp <= mission.end_ns]
    with AnyReader([folder / 'go2/fetch1/odometry.mcap']) as reader:
        found = [(stamp, reader.deserialize(raw, connection.msgtype)) for connection, stamp, raw in reader.messages()]
    assert [stamp for stamp, _ in found] == within
    assert [message.pose.pose.position.x for _, message in found] == pytest.approx([x_of(stamp) for stamp in within])
    joints = rows_of(folder / 'go2/fetch1/joint_states.csv')
    assert [float(row['leg3']) for row in joints] == pytest.approx([x_of(int(row['stamp_ns'])) for row in joints])
    arm = rows_of(folder / 'soarm/fetch1/joint_states.csv')
    own = {CLOCK.of(stamp): stamp for stamp in arm_stamps(mission)}
    assert max(abs(own[int(row['arm_ns'])] - int(row['robot_ns'])) for row in arm) < 1_000_000
    wanted = [so_arm.positions(own[int(row['arm_ns'])])[5] for row in arm]
    assert [float(row['gripper']) for row in arm] == pytest.approx(wanted)
    assert len(rows_of(folder / 'soarm/fetch1/joint_commands.csv')) == len(arm)
    made = Lerobot(folder / SET)
    assert len(list(video_frames(folder / 'go2/fetch1/camera_front.mp4'))) == made.rows[1]['length']


@pytest.mark.long('a second of CPU or more')
def test_frames_are_listed_in_a_table(task: tuple[Path, Exported]) -> None:
    """One row each, with the messages used for it, by their clocks, and the offset."""
    folder, found = task
    rows = rows_of(folder / 'synchronized/timestamps.csv')
    made = Lerobot(folder / SET)
    assert len(rows) == sum(row['length'] for row in made.rows)
    for row in rows:
        tick = int(row['tick_ns'])
        assert abs(int(row['arm_offset_ns']) - (CLOCK.of(tick) - tick)) < int(row['arm_uncertainty_ns']) < 1_000_000
        assert 0 <= tick + int(row['arm_offset_ns']) - int(row['state.arm.stamp_ns']) < 40_000_000
        assert 0 <= tick - int(row['images.front.stamp_ns']) < 150_000_000
    assert found.absent == ['No detections were logged: there is no synchronized/detections.json.']
    assert not (folder / 'synchronized/detections.json').exists()


def test_detections_are_exported_and_a_mission_is_dropped(house: House, tmp_path: Path) -> None:
    """By episode, with their source objects; a dropped mission leaves nothing behind."""
    mission = Mission('', begin_s=100, seconds=2)
    fields: dict[str, Any] = {'samples': [{'stamp_ns': mission.begin_ns + 10, 'detections': [{'id': 'cup'}]}]}
    made = house.drive.one(
        'sensor_msgs/msg/JointState', [mission.begin_ns + 10], [house.drive._ros.cdr('sensor_msgs/msg/JointState')]
    )
    metadata = {**made.metadata, 'sensor': 'detections', 'topic': '/detections', 'type': DETECTION}
    key = made.key.replace('joints', 'detections')
    with closing(open_store(house.settings, UploadSettings())):
        house.drive.store([replace(made, key=key, body=json.dumps(fields).encode(), metadata=metadata)])
    task = tmp_path / 'fetch'
    assert export(task / SET, house.source, {}, ExportOptions(state=('velocity',))).absent == []
    found = json.loads((task / 'synchronized/detections.json').read_text())['episodes']
    assert [len(each['detections']) for each in found] == [0, 1]
    assert found[1]['detections'][0]['detections'] == [{'id': 'cup'}]
    assert found[1]['detections'][0]['source']['key'] == key
    assert not (task / 'soarm').exists()
    drop(task / SET, 'fetch1')
    assert not (task / 'go2/fetch1').exists()
    assert {row['mission_id'] for row in rows_of(task / 'synchronized/timestamps.csv')} == {'fetch0'}
    assert not (task / 'synchronized/detections.json').exists()
    assert np.all([path.name != 'fetch1' for path in task.rglob('*')])


def test_a_mission_id_stays_in_its_folder(tmp_path: Path) -> None:
    """Its id comes from a store: one that escapes the folder is refused, and nothing is removed."""
    kept = tmp_path / 'kept'
    kept.mkdir()
    for name in ('../../kept', '..', '', str(kept)):
        with pytest.raises(LakeError, match='a name that is invalid for a folder'):
            forget(tmp_path / 'fetch', name)
    assert kept.is_dir()
