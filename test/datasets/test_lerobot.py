"""LeRobot itself loads exports, offline, with each value as recorded; if its environment exists."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow.parquet as pq
import pytest
from datasets.recorded import House, Mission, x_of
from datasets.test_clocks import record_arm

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.datasets.export import export
from shadowhound_data_logger.datasets.features import SHARED, ExportOptions
from shadowhound_data_logger.datasets.imports import Imported, import_episodes, read_lerobot
from shadowhound_data_logger.datasets.lerobot import Lerobot
from shadowhound_data_logger.datasets.verify import verify
from shadowhound_data_logger.lake import decode
from shadowhound_data_logger.stores.directory import DirectoryStore

PYTHON: Final = Path(os.environ.get('SHADOWHOUND_LEROBOT', '~/.cache/shadowhound/lerobot/bin/python')).expanduser()
PROGRAM: Final = Path(__file__).with_name('with_lerobot.py')
PATROLS: Final = {'mission_type': 'patrol'}


def late(_sensor: str, number: int) -> int:
    return number % 7 * 1_000_000


pytestmark = [
    pytest.mark.slow,
    pytest.mark.long('imports torch and lerobot'),
    pytest.mark.timeout(1500),
    pytest.mark.skipif(not PYTHON.is_file(), reason=f'there is no lerobot at {PYTHON} (docs/development.md)'),
]


def with_lerobot(folder: Path, *arguments: str) -> None:
    libraries = os.pathsep.join([str(PYTHON.parent.parent / 'ffmpeg'), os.environ.get('LD_LIBRARY_PATH', '')])
    environ = {'PATH': os.environ['PATH'], 'HOME': str(folder), 'HF_HOME': str(folder / 'hf'), 'LD_LIBRARY_PATH': libraries}
    ran = subprocess.run(
        [str(PYTHON), str(PROGRAM), *arguments], env=environ, capture_output=True, text=True, check=False, timeout=1200
    )
    assert ran.returncode == 0, ran.stderr[-3000:]


@pytest.fixture(scope='module')
def house(tmp_path_factory: pytest.TempPathFactory) -> House:
    made = House(tmp_path_factory.mktemp('house'))
    for number in range(2):
        made.record(
            Mission(
                f'm{number}', begin_s=100 * number, seconds=2, task=f'walk {number}', jitter_ns=lambda _, n: n % 7 * 1_000_000
            )
        )
    return made


def sources_of(folder: Path, house: House) -> list[Any]:
    """The image of each frame, decoded from its source."""
    store = DirectoryStore(house.settings.directory)
    table = pq.read_table(folder / 'meta/shadowhound_sources.parquet').to_pylist()
    found = []
    for mission in Lerobot(folder).mission_ids:
        rows = [row for row in table if row['episode_mission'] == mission and row['stream'] == 'images.front']
        for row in sorted(rows, key=lambda row: int(row['frame'])):
            members = decode.members(store.get(row['bucket'], row['key']), 'tar')
            found.append(decode.image(next(each.body for each in members if each.stamp_ns == row['stamp_ns'])))
    return found


@pytest.mark.parametrize(
    'options',
    [ExportOptions(), ExportOptions(codec='h264', state=('imu', 'joints')), ExportOptions(is_lossless=True)],
    ids=['av1', 'h264', 'lossless'],
)
def test_lerobot_reads_what_was_recorded(house: House, tmp_path: Path, options: ExportOptions) -> None:
    """Every frame of every kind: numbers as in their sources, images within the codec's accuracy, windows padded correctly."""
    found = export(tmp_path / 'set', house.source, PATROLS, options)
    assert (found.refused, found.waiting) == ({}, {})
    with_lerobot(tmp_path, 'load', str(tmp_path / 'out.npz'), str(tmp_path / 'set'))
    report = np.load(tmp_path / 'out.npz', allow_pickle=False)
    count = sum(each['frames'] for each in found.added)
    assert (int(report['episodes']), len(report['index'])) == (2, count)
    assert report['index'].tolist() == list(range(count))
    stamps = report['shadowhound.stamp_ns']
    column = 0
    sensor = 'odom' if options.state == ('pose',) else 'imu'
    published = np.sort(
        np.concatenate([Mission('', 100 * n, 2, jitter_ns=lambda _, k: k % 7 * 1_000_000).stamps(sensor) for n in range(2)])
    )
    newest = published[np.searchsorted(published, stamps, 'right') - 1]
    assert report['observation.state'][:, column] == pytest.approx([x_of(int(stamp)) for stamp in newest], abs=1e-4)
    wanted = sources_of(tmp_path / 'set', house)
    away = np.abs(report['pictures'].astype(int) - np.array(wanted).astype(int))
    assert away.max() == 0 if options.is_lossless else away.mean() < 6
    assert report['windows'].shape == (count, 3, 3)
    assert report['windows'][0, 1] == pytest.approx(report['action'][1])
    assert set(report['task']) == {'walk 0', 'walk 1'}
    assert 'action=ACTION' in report['kinds']
    assert 'observation.state=STATE' in report['kinds']


def test_two_exports_are_merged_by_lerobot(house: House, tmp_path: Path) -> None:
    """With its own function, and our columns are still in the episodes."""
    for number in range(2):
        export(tmp_path / f'set{number}', house.source, {'mission': f'm{number}'}, ExportOptions())
    with_lerobot(tmp_path, 'merge', str(tmp_path / 'all'), str(tmp_path / 'set0'), str(tmp_path / 'set1'))
    rows = pq.read_table(next((tmp_path / 'all/meta/episodes').rglob('*.parquet'))).to_pylist()
    assert [row['shadowhound/mission_id'] for row in rows] == ['m0', 'm1']
    with_lerobot(tmp_path, 'load', str(tmp_path / 'out.npz'), str(tmp_path / 'all'))
    assert int(np.load(tmp_path / 'out.npz')['episodes']) == 2


def test_an_export_passes_verification(house: House, tmp_path: Path) -> None:
    """Also after lerobot has read it: it changes nothing."""
    export(tmp_path / 'set', house.source, PATROLS, ExportOptions())
    with_lerobot(tmp_path, 'load', str(tmp_path / 'out.npz'), str(tmp_path / 'set'))
    assert verify(tmp_path / 'set', DirectoryStore(house.settings.directory), frames=None).wrong == []


def test_a_robot_with_its_arm_is_loaded_by_lerobot(tmp_path: Path) -> None:
    """Two datasets of a task, each loaded by lerobot, and merged: the state at every tick is the written one, joint by joint."""
    place = House(tmp_path / 'house')
    for number in range(2):
        record_arm(place, place.record(Mission(f'm{number}', begin_s=100 * number, seconds=2, sensors=('camera', 'odom'))))
        export(
            tmp_path / f'set{number}', place.source, {'mission': f'm{number}'}, ExportOptions(state=('velocity',), arm='soarm')
        )
    with_lerobot(tmp_path, 'merge', str(tmp_path / 'all'), str(tmp_path / 'set0'), str(tmp_path / 'set1'))
    with_lerobot(tmp_path, 'load', str(tmp_path / 'out.npz'), str(tmp_path / 'all'))
    report, made = np.load(tmp_path / 'out.npz'), [Lerobot(tmp_path / f'set{number}') for number in range(2)]
    for key in ('observation.state', 'action'):
        written = np.concatenate([each.numbers(each.rows[0], key) for each in made])
        assert written.shape[1] == 9
        assert report[key] == pytest.approx(written)


LAYOUTS: Final = {
    'episode': ExportOptions(), 'shared': ExportOptions(layout=SHARED), 'shared-h264': ExportOptions(layout=SHARED, codec='h264'),
    'lossless': ExportOptions(is_lossless=True),
}  # fmt: skip


@pytest.fixture(scope='module')
def three(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A dataset of three episodes, of 11, 21 and 16 frames, in each layout."""
    made = House(tmp_path_factory.mktemp('three'))
    for number, seconds in enumerate((1.0, 2.0, 1.5)):
        sensors = ('camera', 'odom')
        made.record(Mission(f'm{number}', begin_s=100 * number, seconds=seconds, task=f'walk {number % 2}', sensors=sensors))
    for name, options in LAYOUTS.items():
        assert len(export(made.folder / name, made.source, PATROLS, options).added) == 3
    return {name: made.folder / name for name in LAYOUTS}


@pytest.mark.parametrize('layout', LAYOUTS)
def test_lerobot_reads_a_dataset_in_every_way(three: dict[str, Path], tmp_path: Path, layout: str) -> None:
    """By index, with torchcodec and with PyAV; windows in two workers; and streamed, except with one video per episode.

    lerobot#4524: if this fails because lerobot can stream them, the layout ``shared`` is no longer needed.
    """
    with_lerobot(tmp_path, 'read', str(tmp_path / 'out.json'), str(three[layout]))
    data = json.loads((tmp_path / 'out.json').read_text())
    streamed = {name: data.pop(name) for name in ('streamed', 'streamed delta')}
    assert data == {f'{how} {backend}': {'seen': 48, 'wrong': [], 'error': ''}
                    for backend in ('torchcodec', 'pyav') for how in ('index', 'delta')}  # fmt: skip
    for each in streamed.values():
        if layout == 'episode':
            assert each['error'].startswith('IndexError: Invalid frame index=')
        else:
            assert each == {'seen': 48, 'wrong': [], 'error': ''}


@pytest.mark.parametrize('layout', ['episode', 'shared', 'lossless'])
def test_lerobots_tools_accept_a_dataset(three: dict[str, Path], tmp_path: Path, layout: str) -> None:
    """Each remaining frame has its numbers, and its image within the accuracy of another encoding."""
    with_lerobot(tmp_path, 'tools', str(tmp_path / 'made'), str(three[layout]))
    data = json.loads((tmp_path / 'made/said.json').read_text())
    streamed = data.pop('two files, streamed')
    assert {name: each['frames'] for name, each in data.items()} == {
        'deleted': 37, 'split/first': 11, 'split/others': 37, 'merged': 48, 'added': 48, 'removed': 48, 'tasks': 48, 'stats': 48,
        'encoded': 48, 'two files': 48,
    }  # fmt: skip
    assert {each['numbers'] for each in data.values()} == {0.0}
    assert max(each['pictures'] for each in data.values()) < 0.02
    assert all(each['pictures'] == 0 for name, each in data.items() if name in {'added', 'removed', 'tasks', 'stats'})
    assert (data['tasks']['tasks'], data['stats']['tasks']) == (['sit'], ['walk 0', 'walk 1'])
    if layout != 'lossless':  # lerobot cannot stream what it puts into two files itself either
        assert streamed['wrong'] or streamed['error']


def test_lerobots_viewer_shows_a_dataset(three: dict[str, Path], tmp_path: Path) -> None:
    """Its recording for Rerun contains an episode from the middle of a shared video."""
    with_lerobot(tmp_path, 'view', str(tmp_path / 'shown'), str(three['shared']))
    (path,) = (tmp_path / 'shown').iterdir()
    assert path.name == 'local_set_episode_1.rrd'
    assert path.read_bytes()[:4] == b'RRF2'
    assert path.stat().st_size > 21 * 64 * 96 * 3 // 2


def test_a_dataset_edited_with_lerobot_keeps_its_episodes(tmp_path: Path) -> None:
    """An episode is the same after the dataset has grown and after each tool, whatever the files and numbers are now."""
    with_lerobot(tmp_path, 'arm', str(tmp_path / 'arm'))
    house = House(tmp_path / 'house')
    house.settings.directory.mkdir(parents=True)
    store = DirectoryStore(house.settings.directory)
    begins = [Mission('', begin_s=100.0 * number).begin_ns for number in range(3)]

    def imported(name: str, *recordings: int) -> tuple[Imported, tuple[int, int, int, int]]:
        times = {episode: begins[recording] for episode, recording in enumerate(recordings)}
        found = import_episodes(read_lerobot(tmp_path / 'arm' / name, times, is_degrees=False), 'arm', store)
        return found, (found.episodes, found.unchanged, len(found.refused), len(found.absent))

    assert imported('two', 0, 1)[1] == (2, 0, 0, 0)
    assert imported('grown', 0, 1, 2)[1] == (1, 2, 0, 0)
    for name in ('grown', 'tasks', 'stats', 'encoded'):
        assert imported(name, 0, 1, 2)[1] == (0, 3, 0, 0), name
    assert imported('deleted', 0, 2)[1] == (0, 2, 0, 1)
    assert imported('split/first', 0)[1] == (0, 1, 0, 2)
    assert imported('split/others', 1, 2)[1] == (0, 2, 0, 1)
    assert imported('merged', 1, 2, 0)[1] == (0, 3, 0, 0)
    assert imported('merged', 0, 1, 2)[1] == (0, 0, 3, 0)
    late = {0: begins[0] + SECOND // 2}
    assert len(import_episodes(read_lerobot(tmp_path / 'arm/split/first', late, is_degrees=False), 'arm', store).refused) == 1
