"""Recordings of an arm that others made: imported they are sources like ours, and beside a robot they are episodes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from datasets.recorded import House, Mission
from datasets.test_arm import CLOCK, LEKIWI

from shadowhound_data_logger.clock import SECOND
from shadowhound_data_logger.config import UploadSettings
from shadowhound_data_logger.datasets.export import export
from shadowhound_data_logger.datasets.features import ExportOptions
from shadowhound_data_logger.datasets.imports import bring, of_hdf5, of_lerobot, times_of
from shadowhound_data_logger.datasets.lerobot import Lerobot
from shadowhound_data_logger.datasets.verify import verify
from shadowhound_data_logger.errors import LakeError, SettingError
from shadowhound_data_logger.sim import so_arm
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.directory import DirectoryStore

FPS = 30


@pytest.fixture(scope='module')
def house(tmp_path_factory: pytest.TempPathFactory) -> House:
    made = House(tmp_path_factory.mktemp('house'))
    for number in range(2):
        made.record(Mission(f'fetch{number}', begin_s=2000.0 * number, seconds=2, sensors=('camera', 'odom')))
    return made


def begin_ns(number: int) -> int:
    """Of the arm's recording, by the robot's clock: half a second before the mission."""
    return Mission('', begin_s=2000.0 * number).begin_ns - SECOND // 2 + 7_000_000


def positions(number: int) -> np.ndarray[Any, Any]:
    return np.array([so_arm.positions(begin_ns(number) + frame * SECOND // FPS) for frame in range(4 * FPS)])


def lerobot_set(folder: Path, version: str) -> Path:
    """As lerobot lays it out: v2.1 a file an episode, v3.0 all in one. In degrees."""
    names: Any = [f'{name}.pos' for name in so_arm.JOINTS]
    names = names if version == 'v3.0' else {'motors': [f'main_{each}' for each in so_arm.JOINTS]}
    vector = {'dtype': 'float32', 'shape': [6], 'names': names}
    info = {'codebase_version': version, 'fps': FPS, 'features': {'observation.state': vector, 'action': vector}}
    (folder / 'meta').mkdir(parents=True)
    (folder / 'data/chunk-000').mkdir(parents=True)
    (folder / 'meta/info.json').write_text(json.dumps(info))
    tables = []
    for number in range(2):
        state = np.rad2deg(positions(number)).astype(np.float32)
        column = pa.FixedSizeListArray.from_arrays(pa.array(state.ravel()), 6)
        tables.append(pa.table({
            'observation.state': column, 'action': column, 'timestamp': (np.arange(len(state)) / FPS).astype(np.float32),
            'frame_index': np.arange(len(state)), 'episode_index': np.full(len(state), number),
        }))  # fmt: skip
    if version == 'v3.0':
        pq.write_table(pa.concat_tables(tables), folder / 'data/chunk-000/file-000.parquet')
    else:
        for number, table in enumerate(tables):
            pq.write_table(table, folder / f'data/chunk-000/episode_{number:06d}.parquet')
    return folder


@pytest.fixture
def times(tmp_path: Path) -> Path:
    path = tmp_path / 'times.csv'
    path.write_text('episode,begin_ns\n' + ''.join(f'{number},{CLOCK.of(begin_ns(number))}\n' for number in range(2)))
    return path


def exported(house: House, folder: Path, arm: str) -> Lerobot:
    """Beside the robot, with its clock given by pairs: what was imported has recorded none."""
    pairs = tuple((stamp, CLOCK.of(stamp)) for number in range(2) for stamp in (begin_ns(number), begin_ns(number) + 3 * SECOND))
    found = export(folder, house.source, {}, ExportOptions(state=('velocity',), arm=arm, clock_pairs=pairs))
    assert (found.refused, found.waiting, len(found.added)) == ({}, {}, 2)
    return Lerobot(folder)


def assert_is_as_recorded(made: Lerobot) -> None:
    for number, row in enumerate(made.rows):
        ticks = made.numbers(row, 'shadowhound.stamp_ns')[:, 0]
        recorded = begin_ns(number) + np.arange(4 * FPS) * SECOND // FPS
        newest = np.searchsorted(recorded, ticks, 'right') - 1
        sure = ticks - recorded[newest] > 1_000_000
        assert sure.sum() > len(ticks) / 2
        assert made.numbers(row, 'observation.state')[sure, :6] == pytest.approx(positions(number)[newest[sure]], abs=1e-4)


@pytest.mark.parametrize('version', [pytest.param('v2.1', marks=pytest.mark.long('as for v3.0')), 'v3.0'])
def test_a_data_set_of_the_arm(house: House, tmp_path: Path, times: Path, version: str) -> None:
    """As it is, joints in degrees: stored once, in the catalogue, and each value traced to the object and the file."""
    arm, source = f'arm{version[1]}', lerobot_set(tmp_path / 'theirs', version)
    store = open_store(house.settings, UploadSettings())
    assert bring(of_lerobot(source, times_of(times), is_degrees=True), arm, store).objects == 4
    again = bring(of_lerobot(source, times_of(times), is_degrees=True), arm, store)
    assert (again.objects, again.present) == (0, 4)
    made = exported(house, tmp_path / 'set', arm)
    assert_is_as_recorded(made)
    assert made.info is not None
    assert made.info['features']['observation.state']['names'] == LEKIWI
    assert made.info['features']['observation.state']['info']['units'][:6] == ['rad'] * 6
    assert verify(tmp_path / 'set', DirectoryStore(house.settings.directory), is_read=True).wrong == []


@pytest.mark.long('a second of CPU or more')
def test_a_data_set_without_a_unit(house: House, tmp_path: Path, times: Path) -> None:
    """The numbers stay as they are, and no unit is claimed."""
    store = open_store(house.settings, UploadSettings())
    bring(of_lerobot(lerobot_set(tmp_path / 'theirs', 'v3.0'), times_of(times), is_degrees=False), 'bare', store)
    made = exported(house, tmp_path / 'set', 'bare')
    assert made.info is not None
    assert made.info['features']['observation.state']['info']['units'][:6] == ['as recorded'] * 6
    assert np.abs(made.numbers(made.rows[0], 'observation.state')[:, :6]).max() > 4


@pytest.mark.long('a second of CPU or more')
def test_demonstrations_in_hdf5(house: House, tmp_path: Path, times: Path) -> None:
    """In the layout of ACT and ALOHA: qpos and action."""
    h5py = pytest.importorskip('h5py')
    paths = [tmp_path / f'episode_{number}.hdf5' for number in range(2)]
    for number, path in enumerate(paths):
        with h5py.File(path, 'w') as file:
            file.attrs['sim'] = False
            file['observations/qpos'] = positions(number).astype(np.float32)
            file['action'] = positions(number).astype(np.float32)
    store = open_store(house.settings, UploadSettings())
    bring(of_hdf5(paths, times_of(times), fps=FPS, joints=so_arm.JOINTS), 'aloha', store)
    assert_is_as_recorded(exported(house, tmp_path / 'set', 'aloha'))
    with pytest.raises(LakeError, match='has 6 joints, not 2'):
        list(of_hdf5(paths, times_of(times), fps=FPS, joints=('a', 'b')))


def test_what_is_no_recording_is_refused(tmp_path: Path, times: Path) -> None:
    """With what is wrong and what to do; nobody guesses when an episode began."""
    with pytest.raises(LakeError, match='no LeRobotDataset'):
        list(of_lerobot(tmp_path, {}, is_degrees=False))
    source = lerobot_set(tmp_path / 'theirs', 'v3.0')
    with pytest.raises(LakeError, match='when episode 0 began'):
        list(of_lerobot(source, {}, is_degrees=False))
    (source / 'data/chunk-000/file-000.parquet').write_bytes(b'PAR1 and more')
    with pytest.raises(LakeError, match='is no data of a LeRobotDataset'):
        list(of_lerobot(source, times_of(times), is_degrees=False))
    (tmp_path / 'odd.hdf5').write_bytes(b'\x89HDF\r\n\x1a\nand more')
    pytest.importorskip('h5py')
    with pytest.raises(LakeError, match='no demonstration in the layout'):
        list(of_hdf5([tmp_path / 'odd.hdf5'], times_of(times), fps=50))
    times.write_text('episode,begin_ns\n0,soon\n')
    with pytest.raises(SettingError, match='--times'):
        times_of(times)
