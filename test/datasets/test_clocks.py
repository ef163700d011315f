"""A robot and an arm with separate clocks: the values of a frame belong together, or the episode is refused."""

from __future__ import annotations

import os
import random
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from datasets.recorded import House, Mission, header, x_of
from lake.making import NOON_NS
from lake.training import JOINTS
from shadowhound_sim import so_arm

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.datasets.clocks import ClockOffset, measured
from shadowhound_data_logger.datasets.export import Exported, export
from shadowhound_data_logger.datasets.features import ExportOptions
from shadowhound_data_logger.datasets.lerobot import OURS, Lerobot
from shadowhound_data_logger.datasets.verify import verify
from shadowhound_data_logger.stores.directory import DirectoryStore

PATROLS = {'mission_type': 'patrol'}
TIME_REFERENCE: Final = 'sensor_msgs/msg/TimeReference'
EPISODES: Final = 20 if os.environ.get('SHADOWHOUND_TEST_LONG') else 3
LAST: Final = f'fetch{EPISODES - 1:02d}'
CLOCK: Final = so_arm.ArmClock(NOON_NS)
LEKIWI: Final = [
    'arm_shoulder_pan.pos', 'arm_shoulder_lift.pos', 'arm_elbow_flex.pos', 'arm_wrist_flex.pos', 'arm_wrist_roll.pos',
    'arm_gripper.pos', 'x.vel', 'y.vel', 'theta.vel',
]  # fmt: skip


def jittered(sensor: str, number: int) -> int:
    return (number * 7919 + len(sensor) * 104729) % 8 * 1_000_000


def arm_stamps(mission: Mission) -> list[int]:
    """Stamps by the robot's clock, 50 Hz, jittered."""
    count = round((mission.seconds + 2) * so_arm.RATE_HZ)
    return [mission.begin_ns - SECOND + round(number * SECOND / so_arm.RATE_HZ) + number * 6007 % 5 * 1_000_000
            for number in range(count)]  # fmt: skip


def record_arm(house: House, mission: Mission, clock: so_arm.ArmClock = CLOCK, *, events: bool = True) -> None:
    """The arm's stored data of a mission by its clock, and the events that the robot recorded."""
    ros, stamps = house.drive._ros, arm_stamps(mission)

    def stored(robot: str, topic: str, kind: str, own: Sequence[int], cdrs: Sequence[bytes]) -> None:
        made = house.drive.one(kind, own, cdrs, batch_s=1.0, rate_hz=0.0, sensor='joints')
        key = f'{robot}/{topic.rpartition("/")[2]}/{made.key.split("/", 2)[2]}'
        house.drive.store([replace(made, key=key, metadata={**made.metadata, 'robot': robot, 'sensor': 'arm', 'topic': topic})])

    own = [clock.of(stamp) for stamp in stamps]
    for topic, values in (('/soarm/joint_states', so_arm.positions), ('/soarm/joint_commands', so_arm.commanded)):
        cdrs = [ros.cdr(JOINTS, name=list(so_arm.JOINTS), position=np.array(values(stamp)), header=header(at))
                for stamp, at in zip(stamps, own, strict=True)]  # fmt: skip
        stored('soarm', topic, JOINTS, own, cdrs)
    if events:
        noise = random.Random(mission.name)
        seen = [mission.begin_ns + round(second * SECOND / 2) for second in range(round(mission.seconds * 2) + 2)]
        noted = [stamp + noise.randrange(-so_arm.JITTER_NS, so_arm.JITTER_NS) for stamp in seen]
        cdrs = [ros.cdr(TIME_REFERENCE, header=header(at), time_ref=header(clock.of(stamp))['stamp'])
                for stamp, at in zip(seen, noted, strict=True)]  # fmt: skip
        stored('thor', '/soarm/clock', TIME_REFERENCE, noted, cdrs)


@pytest.fixture(scope='module')
def house(tmp_path_factory: pytest.TempPathFactory) -> House:
    """A task of twenty episodes over half a day, in which the arm's clock drifts by nearly a second; the last has no event."""
    made = House(tmp_path_factory.mktemp('house'))
    for number in range(EPISODES):
        mission = Mission(f'fetch{number:02d}', begin_s=2000.0 * number, seconds=2, camera_hz=10, task='fetch the cup',
                          jitter_ns=jittered, sensors=('camera', 'odom'))  # fmt: skip
        made.record(mission)
        record_arm(made, mission, events=number < EPISODES - 1)
    return made


@pytest.fixture(scope='module')
def exported(house: House) -> Exported:
    return export(house.folder / 'set', house.source, PATROLS, ExportOptions(state=('velocity',), arm='soarm', max_stale=0.1))


def test_the_measured_offset_is_exact(exported: Exported) -> None:
    """Within a millisecond of the truth at each tick of all episodes, and never outside the uncertainty."""
    assert len(exported.added) == EPISODES - 1
    made = Lerobot(exported.folder)
    for row in made.rows:
        clock = ClockOffset(**{name: row[f'{OURS}clock/{name}'] for name in ClockOffset.__slots__})
        ticks = made.numbers(row, 'shadowhound.stamp_ns')[:, 0]
        away = np.array([CLOCK.of(int(tick)) for tick in ticks]) - clock.other_ns(ticks)
        assert np.abs(away).max() < SECOND // 1000
        assert np.abs(away).max() <= clock.uncertainty_ns < SECOND // 1000


def test_an_episode_with_an_unknown_offset_is_rejected(exported: Exported) -> None:
    """With the reason."""
    assert exported.refused == {LAST: "the offset of the arm's clock is unknown: no event was timed by both machines"}
    assert exported.waiting == {}


def test_each_tick_has_the_newest_value_of_both_machines(house: House, exported: Exported) -> None:
    """The newest of each at or before it, by the robot's clock, under LeKiwi's names."""
    made = Lerobot(exported.folder)
    assert made.info is not None
    features = made.info['features']
    assert features['observation.state']['names'] == features['action']['names'] == LEKIWI
    assert features['action']['info']['source'] == '/soarm/joint_commands, odom, derived'
    streams = features['shadowhound.age_s']['names']
    for row in made.rows:
        number = int(row[f'{OURS}mission_id'][5:])
        mission = Mission('', begin_s=2000.0 * number, seconds=2)
        ticks = made.numbers(row, 'shadowhound.stamp_ns')[:, 0]
        state, action, age = (made.numbers(row, key) for key in ('observation.state', 'action', 'shadowhound.age_s'))
        published = np.array(arm_stamps(mission))
        newest = published[np.searchsorted(published, ticks, 'right') - 1]
        # If a message arrived within the uncertainty of the tick, the previous one may be used.
        sure = ticks - newest > 400_000
        assert sure.sum() > len(ticks) / 2
        assert state[sure, :6] == pytest.approx(np.array([so_arm.positions(int(stamp)) for stamp in newest[sure]]), abs=1e-5)
        assert action[sure, :6] == pytest.approx(np.array([so_arm.commanded(int(stamp)) for stamp in newest[sure]]), abs=1e-5)
        assert age[sure, streams.index('state.arm')] == pytest.approx((ticks - newest)[sure] / SECOND, abs=1e-3)
        odometry = np.array(Mission('', begin_s=2000.0 * number, seconds=2, jitter_ns=jittered).stamps('odom'))
        place = np.searchsorted(odometry, ticks, 'right') - 1
        step = np.array([x_of(int(stamp)) for stamp in odometry])
        later, before = odometry[place], odometry[place - 1]
        speed = np.hypot(step[place] - step[place - 1], np.cos(step[place]) - np.cos(step[place - 1])) / (
            (later - before) / SECOND
        )
        assert np.hypot(state[:, 6], state[:, 7]) == pytest.approx(speed, rel=1e-3)


def test_the_arm_is_a_source_like_the_robot(house: House, exported: Exported) -> None:
    """Each value names the object, its hash and the time by the arm's clock; all of them are verified."""
    sources = pq.read_table(exported.folder / 'meta/shadowhound_sources.parquet')
    of_arm = sources.filter(pc.equal(sources['stream'], 'state.arm')).to_pylist()
    assert {each['key'].split('/')[0] for each in of_arm} == {'soarm'}
    own = {CLOCK.of(stamp) for number in range(EPISODES) for stamp in arm_stamps(Mission('', begin_s=2000.0 * number, seconds=2))}
    assert {each['stamp_ns'] for each in of_arm} <= own
    assert all(len(each['sha256']) == 64 for each in of_arm)
    found = verify(exported.folder, DirectoryStore(house.settings.directory), is_read=True)
    assert found.wrong == []


@pytest.mark.long('a second of CPU or more')
def test_an_offset_beyond_half_a_tick_is_refused(house: House, tmp_path: Path) -> None:
    """With one given pair, half an hour away, the offset is unknown; near a pair it drifts by 0.2 ms per second."""
    mission = Mission('', begin_s=2000.0 * (EPISODES - 1), seconds=2)
    flags: dict[str, Any] = {'mission': LAST}
    for away_s, refused in ((1800, 'is unknown'), (500, r'is known to 100\.\d ms, half a tick is 50\.0 ms')):
        at = mission.begin_ns - away_s * SECOND
        options = ExportOptions(state=('velocity',), arm='soarm', max_stale=0.1, clock_pairs=((at, CLOCK.of(at)),))
        found = export(tmp_path / f'{away_s}', house.source, flags, options)
        assert re.search(refused, found.refused[LAST])
    at = mission.begin_ns - SECOND
    options = ExportOptions(state=('velocity',), arm='soarm', max_stale=0.1, clock_pairs=((at, CLOCK.of(at)),))
    assert [each['mission_id'] for each in export(tmp_path / 'near', house.source, flags, options).added] == [LAST]


def test_without_an_arm_there_are_no_columns_of_it(house: House, tmp_path: Path) -> None:
    """With the same code and the same missions."""
    export(tmp_path / 'set', house.source, {'mission': 'fetch00'}, ExportOptions(state=('velocity',), max_stale=0.1))
    made = Lerobot(tmp_path / 'set')
    assert made.info is not None
    assert made.info['features']['observation.state']['names'] == LEKIWI[6:]
    assert not [name for name in made.rows[0] if 'arm' in name or 'clock' in name]


def test_a_clock_that_steps_has_no_offset() -> None:
    """A step during an episode is not a drift."""
    times = NOON_NS + np.arange(30) * SECOND
    stepped = np.column_stack([times, times + np.where(np.arange(30) < 15, 0, SECOND // 2)])
    with pytest.raises(LakeError, match='was set during that time'):
        measured(stepped, NOON_NS, NOON_NS + 30 * SECOND)
