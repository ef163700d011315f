"""``export lerobot --config``: topics and fields become features; the examples export recordings of such robots."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner
from datasets.recorded import House, Mission, cdr_of, header, x_of
from lake.gap_parts import tell
from lake.making import add
from lake.training import COMPRESSED, JOINTS, ODOMETRY

from shadowhound_data_logger.cli.common import BadUsage
from shadowhound_data_logger.cli.export import export
from shadowhound_data_logger.core.clock import SECOND, iso
from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.core.options import UploadSettings
from shadowhound_data_logger.datasets import export_file
from shadowhound_data_logger.datasets.features import ExportOptions
from shadowhound_data_logger.datasets.lerobot import DATA, Lerobot, matrix
from shadowhound_data_logger.formats.rows.gaps import complete
from shadowhound_data_logger.stores import open_store

EXAMPLES: Final = Path(__file__).parents[2] / 'examples'
TWIST, NUMBERS = 'geometry_msgs/msg/Twist', 'std_msgs/msg/Float64MultiArray'
CAMERA, WRIST = '/oakd/rgb/preview/image_raw/compressed', '/wrist_camera/color/image_raw/compressed'
COMMANDS: Final = '/forward_position_controller/commands'
JOINT_NAMES: Final = ('shoulder', 'elbow', 'wrist')
BASE: Final = {CAMERA: ('camera', COMPRESSED, 10.0), '/odom': ('odom', ODOMETRY, 50.0), '/cmd_vel': ('cmd_vel', TWIST, 20.0)}
ARM: Final = {WRIST: ('camera', COMPRESSED, 10.0), '/joint_states': ('joints', JOINTS, 50.0), COMMANDS: ('imu', NUMBERS, 10.0)}
"""Topic -> the sensor with the settings for encoding it, its type and rate."""


def recorded(folder: Path, topics: dict[str, tuple[str, str, float]]) -> House:
    """A mission of four seconds of these topics."""
    house, mission = House(folder), Mission('m1', begin_s=100, seconds=4)
    made, marks = [], []
    for number, (topic, (sensor, kind, rate)) in enumerate(topics.items()):
        stamps = [mission.begin_ns - SECOND + round(count * SECOND / rate) for count in range(round(6 * rate))]
        for second in sorted({stamp // SECOND for stamp in stamps}):
            some = [stamp for stamp in stamps if stamp // SECOND == second]
            how: dict[str, Any] = {'format': 'tar'} if kind == COMPRESSED else {}
            one = house.drive.one(kind, some, [cdr(house, kind, sensor, stamp) for stamp in some], batch_s=1.0, rate_hz=0.0,
                                  sensor=sensor, **how)  # fmt: skip
            # As a robot without settings names its sensors: by their topics.
            made.append(replace(one, metadata={**one.metadata, 'topic': topic, 'sensor': topic.strip('/').replace('/', '_')}))
        span = {'from_ns': mission.begin_ns - 2 * SECOND, 'to_ns': mission.end_ns + SECOND}
        marks.append(complete('thor', 'j', 10 + number, sink='objects', topic=topic, session=1, grade='exact', received=1000,
                              **span, received_from_ns=span['from_ns'], received_to_ns=span['to_ns'], skipped=0))  # fmt: skip
    house.drive.store(made, mission_id='m1', run_id='runm1', mission_type='patrol')
    summary = {'mission_id': 'm1', 'mission_type': 'patrol', 'mission_command': 'go', 'success': True, 'result': 'FINISHED',
               'start': iso(mission.begin_ns), 'end': iso(mission.end_ns), 'duration_s': 4.0}  # fmt: skip
    with closing(open_store(house.settings, UploadSettings())) as store:
        add(store, folder / 'tmp', 'thor/missions/runm1/summary.json', json.dumps(summary).encode())
    tell(house.settings, folder, *marks, name='part0')
    return house


def cdr(house: House, kind: str, sensor: str, stamp: int) -> bytes:
    ros, x = house.drive._ros, x_of(stamp)
    if kind == NUMBERS:
        return bytes(ros.cdr(NUMBERS, data=np.array([x, -x, 2.0])))
    if kind == JOINTS:
        return bytes(ros.cdr(JOINTS, name=list(JOINT_NAMES), position=np.array([x, x / 2, -x]), header=header(stamp)))
    if kind == ODOMETRY:
        twist = {'twist': {'linear': {'x': x}, 'angular': {'z': -x}}}
        return bytes(ros.cdr(ODOMETRY, pose={'pose': {'position': {'x': x, 'y': 2 * x}}}, twist=twist, header=header(stamp)))
    return cdr_of(ros, sensor, stamp)


def exported(house: House, config: Path, *more: str) -> Lerobot:
    target = house.folder / 'set'
    env = {'SHADOWHOUND_HOME': str(house.folder / 'home'), 'AWS_ENDPOINT_URL': None}
    (house.folder / 'home').mkdir(exist_ok=True)
    if not (house.folder / 'home/store').exists():
        (house.folder / 'home/store').symlink_to(house.settings.directory)
    ran = CliRunner(env=env).invoke(export, ['lerobot', 'x', '--to', str(target), '--config', str(config), *more],
                                    standalone_mode=False, catch_exceptions=False)  # fmt: skip
    assert ran.return_value == 0, ran.output
    return Lerobot(target)


def values(made: Lerobot, *columns: str) -> list[Any]:
    table = pq.read_table(made.path(DATA, made.rows[0], 'data'))
    return [matrix(table[name]) for name in columns]


def test_a_wheeled_base_is_exported_by_its_file(tmp_path: Path) -> None:
    """Its numbers are from the messages at or before each tick, and ``info.json`` names their topics."""
    made = exported(recorded(tmp_path, BASE), EXAMPLES / 'export_base.yaml')
    assert made.info['robot_type'] == 'turtlebot4'
    features = made.info['features']
    assert features['observation.state']['names'] == ['x', 'y', 'x.vel', 'theta.vel']
    assert features['observation.state']['info']['units'] == ['m', 'm', 'm/s', 'rad/s']
    assert features['observation.state']['info']['source'] == ['/odom'] * 4
    assert features['action']['names'] == ['x.vel', 'theta.vel']
    assert (features['action']['info']['source'], features['action']['info']['derived']) == ('/cmd_vel', False)
    assert features['observation.images.front']['dtype'] == 'video'
    state, action, (ticks,) = *values(made, 'observation.state', 'action'), values(made, 'shadowhound.stamp_ns')
    wanted = [x_of(int(tick)) for tick in ticks.ravel()]
    assert np.abs(state - [[x, 2 * x, x, -x] for x in wanted]).max() < 0.0402, 'one period late, at 2 m/s for y'
    assert np.all((action[:, 0] <= np.array(wanted) + 1e-3) & (action[:, 0] > np.array(wanted) - 0.051))
    assert np.allclose(action[:, 1], -action[:, 0])


def test_an_arm_is_exported_by_its_file(tmp_path: Path) -> None:
    """Joint names come from the message if the file has none; images are as published."""
    made = exported(recorded(tmp_path, ARM), EXAMPLES / 'export_arm.yaml')
    features = made.info['features']
    assert features['observation.state']['names'] == [f'{name}.pos' for name in JOINT_NAMES]
    assert features['observation.state']['info']['units'] == ['rad'] * 3
    assert features['action']['names'] == ['shoulder.pos', 'elbow.pos', 'wrist.pos']
    assert features['observation.images.wrist']['dtype'] == 'image'
    state, action = values(made, 'observation.state', 'action')
    assert np.allclose(state[:, 1], state[:, 0] / 2)
    assert np.allclose(action[:, 2], 2.0)


def test_the_file_of_a_dataset_is_in_it(tmp_path: Path) -> None:
    """Its settings are those of the dataset: a different mapping is refused, with the difference."""
    house = recorded(tmp_path, BASE)
    made = exported(house, EXAMPLES / 'export_base.yaml')
    assert made.settings is not None
    assert made.settings['action_from'] == {
        'topic': '/cmd_vel', 'fields': ['linear.x', 'angular.z'], 'names': ['x.vel', 'theta.vel'], 'units': ['m/s', 'rad/s']
    }  # fmt: skip
    assert made.settings['images'] == {'front': CAMERA}
    assert exported(house, EXAMPLES / 'export_base.yaml').mission_ids == ['m1'], 'nothing is added again'
    other = tmp_path / 'other.yaml'
    other.write_text((EXAMPLES / 'export_base.yaml').read_text().replace('[linear.x, angular.z]', '[linear.x, linear.y]'))
    with pytest.raises(LakeError, match='was created with action_from'):
        exported(house, other)


def test_the_example_of_a_base_has_each_key_with_its_default(tmp_path: Path) -> None:
    """Except for those of an arm, which the other example has: a new key must be explained."""
    base, arm = ((EXAMPLES / f'export_{name}.yaml').read_text() for name in ('base', 'arm'))
    keys = set(export_file.ExportFile.__slots__)
    named = {line.lstrip('# ').partition(':')[0] for text in (base, arm) for line in text.splitlines() if ':' in line}
    assert keys - named == set()
    empty = tmp_path / 'empty.yaml'
    empty.write_text('')
    assert export_file.read(empty).options(tmp_path) == ExportOptions()


WRONG: Final = {
    'image: {front: camera}': "there is no key 'image': is it images?",
    'codec: vp9': 'codec',
    'fps: fast': 'fps is not auto',
    'max_stale: 2': 'max_stale',
    'max_gap_s: soon': 'max_gap_s is not float',
    'state: [mood]': 'state',
    'state: [pose, pose]': 'one or more different',
    'state: [{topic: odom, fields: [x]}]': 'a topic starts with a slash',
    'state: [{topic: /odom, field: [x]}]': "there is no key 'field' of state: is it fields?",
    'action: 3': 'is not a mapping',
    'images: {}': 'images',
    'by: now': 'by',
    'resample: {odom: cubic}': 'resample of odom',
    'a: &b [*b]': 'aliases',
    '[]': 'is not a mapping',
    'arm_clock: no.csv': 'no.csv',
}


@pytest.mark.parametrize('text', WRONG, ids=str)
def test_a_wrong_file_is_wrong_usage(tmp_path: Path, text: str) -> None:
    """The error names the key and what is allowed."""
    path = tmp_path / 'export.yaml'
    path.write_text(text)
    env = {'SHADOWHOUND_HOME': str(tmp_path), 'AWS_ENDPOINT_URL': None}
    with pytest.raises(BadUsage, match=WRONG[text].replace("'", '.')) as caught:
        CliRunner(env=env).invoke(export, ['lerobot', 'x', '--config', str(path)], standalone_mode=False, catch_exceptions=False)
    assert 'docs/' in caught.value.remedy or 'allowed is' in caught.value.message


def test_another_number_of_names_is_refused_by_mission(tmp_path: Path) -> None:
    """The report has the field's number of values."""
    house, path = recorded(tmp_path, ARM), tmp_path / 'arm.yaml'
    path.write_text((EXAMPLES / 'export_arm.yaml').read_text().replace('elbow.pos, ', ''))
    with pytest.raises(AssertionError, match='has 3 numbers in data, and 2 names are given'):
        exported(house, path)
