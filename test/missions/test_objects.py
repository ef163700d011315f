"""A mission's objects in a real spool: each once, held until their run is known, delivered where no node does."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from missions.fakes import journalling
from spool.making import make, new_spool, put, rows

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.missions.folder import MissionFolder, Run, missions
from shadowhound_data_logger.missions.journal import read
from shadowhound_data_logger.missions.objects import Spooler, objects_of
from shadowhound_data_logger.spool.status import file

RUN = Run('abc', '1', 'x')


@pytest.fixture
def spooler(tmp_path: Path) -> Iterator[Spooler]:
    settings = Settings.load({'spool.min_free_bytes': 0}, {'SHADOWHOUND_HOME': str(tmp_path)})
    made = Spooler(settings, SystemClock('boot'))
    yield made
    made.close()


@pytest.fixture
def folder(tmp_path: Path) -> MissionFolder:
    """A mission with two frames of the same id and other content, and a trajectory."""
    csv = tmp_path / 't.csv'
    csv.write_text('timestamp,x,y,yaw\n')
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        logger.log_camera_frame(b'\xff\xd8one', 7)
        logger.log_camera_frame(b'\xff\xd8two', 7)
        logger.log_trajectory(csv)
    return next(missions(tmp_path))


def objects(folder: MissionFolder, run: Run | None) -> list[DataObject]:
    records = [line.record or {} for line in read(folder.journal)]
    return [item.content for record in records[:-1] for item in objects_of(record, records[0], folder, run)]


def spooled(home: Path) -> dict[str, str]:
    return {row['key']: row['state'] for row in rows(home / 'spool') if row['sensor'] != '_catalog'}


def test_what_is_handed_over_twice_is_spooled_once(tmp_path: Path, spooler: Spooler, folder: MissionFolder) -> None:
    """A replayer that was killed before it noted its progress adds nothing again, frames of one id included."""
    prefix = 'thor/missions/abc'
    for _ in range(3):
        spooler.add(objects(folder, RUN))
    name = folder.mission_id.rpartition('_')[0]
    assert set(spooled(tmp_path)) == {
        f'{prefix}/camera/frame_000007.jpg', f'{prefix}/camera/frame_000007_1.jpg', f'{prefix}/trajectory.csv',
        f'thor/{name}.csv',
    }  # fmt: skip


def test_a_frame_of_a_longer_number_is_another_one(tmp_path: Path, spooler: Spooler) -> None:
    """Though its picture is the same, and its name begins as the other's."""
    for number in (100_000, 1_000_000):
        spooler.add([make(f'thor/missions/abc/camera/frame_{number:06d}.jpg', topic=None)])
    assert len(spooled(tmp_path)) == 2


def test_what_is_held_gets_the_run_s_name(tmp_path: Path, spooler: Spooler, folder: MissionFolder) -> None:
    """Under the run's id, with it in the metadata; handed over again afterwards it is still there once."""
    spooler.add(objects(folder, None))
    assert set(spooled(tmp_path).values()) == {'held'}
    assert spooler.bind(folder.mission_id, 'abc')
    assert not spooler.bind(folder.mission_id, 'abc')
    spooler.add(objects(folder, RUN))
    assert set(spooled(tmp_path).values()) == {'pending'}
    assert len(spooled(tmp_path)) == 4
    assert all(f'"run_id": "{RUN.run_id}"' in row['metadata'] for row in rows(tmp_path / 'spool'))
    assert sorted(path.name for path in (tmp_path / 'spool' / 'ready').rglob('frame*')) == [
        'frame_000007.jpg',
        'frame_000007_1.jpg',
    ]


def test_without_a_node_it_is_delivered(tmp_path: Path, spooler: Spooler, folder: MissionFolder) -> None:
    """The folder store has all of it, and the drain is free again afterwards."""
    spooler.add(objects(folder, RUN))
    assert spooler.has_unsent
    spooler.drain()
    assert set(spooled(tmp_path).values()) == {'delivered'}
    assert spooler.has_unsent, 'their rows of the catalogue'
    spooler.drain()
    assert (tmp_path / 'store/sensor-data/thor/missions/abc/camera/frame_000007.jpg').read_bytes() == b'\xff\xd8one'
    assert not spooler.has_unsent
    with flock(tmp_path / 'spool' / 'drain.lock', wait=False) as free:
        assert free


def test_with_a_node_running_the_node_delivers(tmp_path: Path, spooler: Spooler, folder: MissionFolder) -> None:
    """The process that drains the spool delivers it."""
    spooler.add(objects(folder, RUN))
    with flock(tmp_path / 'spool' / 'drain.lock', wait=False):
        spooler.drain()
    assert set(spooled(tmp_path).values()) == {'pending'}
    assert not spooler.has_unsent


def test_what_an_earlier_process_left_is_delivered(tmp_path: Path, spooler: Spooler, folder: MissionFolder) -> None:
    """A new replayer without a mission empties the spool."""
    spooler.add(objects(folder, RUN))
    spooler.close()
    later = Spooler(Settings.load({}, {'SHADOWHOUND_HOME': str(tmp_path)}), SystemClock('boot'))
    try:
        later.drain()
        later.drain()
    finally:
        later.close()
    assert set(spooled(tmp_path).values()) == {'delivered'}


def test_a_node_s_larger_spool_is_left_to_it(tmp_path: Path, folder: MissionFolder) -> None:
    """The parameters of a node are not the agent's: by those that it has itself it would evict what the node keeps."""
    root = tmp_path / 'spool'
    node = new_spool(root, max_bytes=64 << 20)
    node.open()
    put(node, *(make(f'thor/lidar/{number}.pcd', bytes(100_000), priority=7) for number in range(20)))
    file(root, 'thor').write_text(json.dumps({'spool': {'max_bytes': 64 << 20, 'min_free_bytes': 0}}))
    settings = Settings.load({'spool.max_bytes': 1 << 20}, {'SHADOWHOUND_HOME': str(tmp_path)})
    spooler = Spooler(settings, SystemClock('boot'))
    try:
        spooler.add(objects(folder, RUN))
    finally:
        spooler.close()
        node.close()
    assert set(spooled(tmp_path).values()) == {'pending'}


def test_an_index_that_is_lost_during_delivery(tmp_path: Path, spooler: Spooler, folder: MissionFolder) -> None:
    """The objects that come then are refused once, and taken when they are handed over again."""
    first, *others = objects(folder, RUN)
    spooler.add([first])
    index = tmp_path / 'spool' / 'index.db'
    index.rename(index.with_name('index.db.damaged-1'))
    index.touch()
    other = new_spool(tmp_path / 'spool')
    other.open()
    other.close()
    with pytest.raises(SpoolError, match='was deleted or replaced'):
        spooler.add(others)
    spooler.add(others)
    prefix = 'thor/missions/abc/camera/'
    assert set(spooled(tmp_path)) == {item.key for item in (first, *others)} | {f'{prefix}frame_000007_1.jpg'}
