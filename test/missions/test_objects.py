"""Objects of missions: spooled once, delivered and cataloged without a node, and delayed by a busy index only."""

from __future__ import annotations

import json
import random
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from statistics import median

import pytest
from missions.fakes import FakePictures, FakeTracking, journalling
from spool.making import make, new_spool, put, rows

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.durable_files import flock
from shadowhound_data_logger.core.errors import SpoolError
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.formats.rows.parts import read_rows
from shadowhound_data_logger.missions.folder import MissionFolder, Run, missions
from shadowhound_data_logger.missions.journal import read
from shadowhound_data_logger.missions.objects import Spooler, objects_of
from shadowhound_data_logger.missions.replay import OBJECTS, Replay
from shadowhound_data_logger.shipping.catalog_writer import SOON_S
from shadowhound_data_logger.spool.spool import Spool
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
    """A mission with two frames with the same id but different content, and a trajectory."""
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


def test_objects_added_twice_are_spooled_once(tmp_path: Path, spooler: Spooler, folder: MissionFolder) -> None:
    """A replayer that was killed before it recorded its progress adds nothing again, including frames with the same id."""
    prefix = 'thor/missions/abc'
    for _ in range(3):
        spooler.add(objects(folder, RUN))
    name = folder.mission_id.rpartition('_')[0]
    assert set(spooled(tmp_path)) == {
        f'{prefix}/camera/frame_000007.jpg', f'{prefix}/camera/frame_000007_1.jpg', f'{prefix}/trajectory.csv',
        f'thor/{name}.csv',
    }  # fmt: skip


def test_a_frame_with_a_longer_number_is_a_different_frame(tmp_path: Path, spooler: Spooler) -> None:
    """Though its image is the same, and its name has the same start."""
    for number in (100_000, 1_000_000):
        spooler.add([make(f'thor/missions/abc/camera/frame_{number:06d}.jpg', topic=None)])
    assert len(spooled(tmp_path)) == 2


def test_held_objects_get_the_name_of_the_run(tmp_path: Path, spooler: Spooler, folder: MissionFolder) -> None:
    """Under the run's id, which is also in the metadata; added again afterwards it is still there once."""
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


def test_without_a_node_the_agent_delivers(tmp_path: Path, spooler: Spooler, folder: MissionFolder) -> None:
    """The directory store has all of it, and the drain lock is free again afterwards."""
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


def test_a_running_node_delivers(tmp_path: Path, spooler: Spooler, folder: MissionFolder) -> None:
    """The process that drains the spool delivers it."""
    spooler.add(objects(folder, RUN))
    with flock(tmp_path / 'spool' / 'drain.lock', wait=False):
        spooler.drain()
    assert set(spooled(tmp_path).values()) == {'pending'}
    assert not spooler.has_unsent


def test_objects_of_an_earlier_process_are_delivered(tmp_path: Path, spooler: Spooler, folder: MissionFolder) -> None:
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


def test_a_larger_spool_is_left_to_the_node(tmp_path: Path, folder: MissionFolder) -> None:
    """An agent has no node parameters: with its defaults it would evict what the node keeps."""
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


def test_delivery_survives_the_loss_of_the_index(tmp_path: Path, spooler: Spooler, folder: MissionFolder) -> None:
    """Objects added after the loss are refused once, and accepted when they are added again."""
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


def test_an_agent_without_a_node_writes_the_catalog(tmp_path: Path) -> None:
    """Its sender delivers, writes a part for the delivered objects, and delivers that; rows have mission, run, time and pose."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        logger.log_camera_frame(b'\xff\xd8one', 7)
    (folder,) = missions(tmp_path)
    records = [line.record or {} for line in read(folder.journal)]
    (frame,) = (record for record in records if record['k'] == 'frame')
    marked = {**frame, 'marks': {'pose': '1.000 2.000 0.5000 odom'}}
    spooler = Spooler(Settings.load({'spool.min_free_bytes': 0}, {'SHADOWHOUND_HOME': str(tmp_path)}), SystemClock('boot'))
    try:
        spooler.add([item.content for item in objects_of(marked, records[0], folder, Run('abc', '1', 'x'))])
        spooler.drain()
        assert spooler.pending() == 1, 'the part'
        spooler.drain()
        assert spooler.pending() == 0
    finally:
        spooler.close()
    (part,) = (tmp_path / 'store').rglob('thor/_catalog/date=*/*.jsonl.zst')
    (row,) = read_rows(part.read_bytes(), 'thor').rows['_catalog']
    assert row['key'] == 'thor/missions/abc/camera/frame_000007.jpg'
    assert (row['robot'], row['sensor'], row['mission_id'], row['run_id'], row['mission_type']) == (
        'thor', 'missions', folder.mission_id, 'abc', 'patrol',
    )  # fmt: skip
    assert row['t_start_ns'] == frame['t']
    assert (row['x'], row['y'], row['yaw'], row['pose_frame']) == (1.0, 2.0, 0.5, 'odom')


@pytest.mark.parametrize('is_hastened', [True, False])
def test_the_sender_runs_until_the_last_row_is_written(tmp_path: Path, is_hastened: bool) -> None:
    """For a period of the catalog at most, or some seconds after a mission's end: no other process would write it."""
    with journalling(tmp_path) as logger:
        logger.start_mission('patrol', '')
        logger.log_camera_frame(b'\xff\xd8one', 1)
        logger.log_camera_frame(b'\xff\xd8two', 2)
    (folder,) = missions(tmp_path)
    start, *frames = [record for line in read(folder.journal) if (record := line.record or {})['k'] in {'start', 'frame'}]
    now = [0.0]
    settings = Settings.load({'spool.min_free_bytes': 0}, {'SHADOWHOUND_HOME': str(tmp_path)})
    spooler = Spooler(settings, SystemClock('boot'), monotonic=lambda: now[0])

    def rows() -> int:
        parts = (tmp_path / 'store').rglob('thor/_catalog/date=*/*.jsonl.zst')
        return sum(len(read_rows(part.read_bytes(), 'thor').rows['_catalog']) for part in parts)

    try:
        for frame in frames:
            spooler.add([item.content for item in objects_of(frame, start, folder, Run('abc', '1', 'x'))])
            for _ in range(3):
                spooler.drain()
        assert (spooler.pending(), rows(), spooler.has_unsent) == (0, 1, True)
        if is_hastened:
            spooler.expedite()
        now[0] += SOON_S if is_hastened else settings.catalog.period_s
        for _ in range(2):
            spooler.drain()
        assert (spooler.pending(), rows(), spooler.has_unsent) == (0, 2, False)
    finally:
        spooler.close()


CALLS = 100
FRAME = b'\xff\xd8' + bytes(50_000) + b'\xff\xd9'


@contextmanager
def held(home: Path) -> Iterator[None]:
    """A transaction of another process that stays open."""
    with closing(sqlite3.connect(home / 'spool/index.db', isolation_level=None)) as other:
        other.execute('BEGIN IMMEDIATE')
        yield
        other.execute('ROLLBACK')


def log(logger: MissionDataLogger, first: int) -> list[float]:
    """The duration of each call in seconds."""
    took: list[float] = []
    for number in range(first, first + CALLS):
        calls: tuple[Callable[[], object], ...] = (
            lambda number=number: logger.log_metric('a', number), lambda number=number: logger.log_camera_frame(FRAME, number),
            lambda number=number: logger.log_robot_state(50.0, 30.0, number),
        )  # fmt: skip
        for call in calls:
            began_s = time.perf_counter()
            call()
            took.append(time.perf_counter() - began_s)
    return took


@pytest.mark.long('a second of CPU or more')
def test_a_busy_index_delays_the_delivery_and_no_call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All calls return as fast as usual while it is locked; the sender waits, and continues when it is free."""
    settings = Settings.load({'spool.min_free_bytes': 0}, {'SHADOWHOUND_HOME': str(tmp_path)})
    clock = SystemClock.of_this_machine()
    with closing(Spool(settings.spool_path, settings.spool, clock, 'thor')) as spool:
        spool.open()
    now_s = [0.0]
    replay = Replay(tmp_path, FakeTracking(), Spooler(settings, clock), FakePictures(), monotonic=lambda: now_s[0],
                    rng=random.Random(1))  # type: ignore[arg-type]  # fmt: skip
    with closing(MissionDataLogger(home=tmp_path, replay=False, start_timeout_s=0.0)) as logger:
        logger.start_mission('patrol', '')
        free_s = log(logger, 0)
        with held(tmp_path):
            began_s = time.perf_counter()
            monkeypatch.setattr('shadowhound_data_logger.spool.index.BUSY_TIMEOUT_S', 0.5)
            busy_s = log(logger, CALLS)
            while replay.gates[OBJECTS].error is None:
                assert replay.step(), 'nothing is left to do, and the spool took it'
            assert time.perf_counter() - began_s > 0.5, 'the sender has waited for the index'
            assert not count_frames(tmp_path)
            logger.end_mission(True, 1.0, 1.0)
        assert median(busy_s) < 5 * median(free_s) + 0.001
        assert max(busy_s) < max(0.5, 5 * max(free_s)), 'no call has waited for it'
    while any(gate.error for gate in replay.gates.values()) or replay.step():
        now_s[0] += 100.0
        replay.step()
    replay.close()
    assert next(missions(tmp_path)).sent().complete
    assert count_frames(tmp_path) == 2 * CALLS


def count_frames(home: Path) -> int:
    """The number of frames."""
    return sum(row['key'].endswith('.jpg') for row in rows(home / 'spool'))
