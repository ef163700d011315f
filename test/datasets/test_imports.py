"""Recordings of an arm by other programs: once imported, they are sources like ours; next to a robot they are episodes."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner
from datasets.recorded import House, Mission
from datasets.test_clocks import CLOCK, LEKIWI
from shadowhound_sim import so_arm

from shadowhound_data_logger.cli.common import ExitCode
from shadowhound_data_logger.cli.export import export as command
from shadowhound_data_logger.core.clock import SECOND, iso
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import LakeError, SettingError
from shadowhound_data_logger.datasets.export import export
from shadowhound_data_logger.datasets.features import ExportOptions
from shadowhound_data_logger.datasets.imports import Imported, identity_of, import_episodes, read_hdf5, read_lerobot, read_times
from shadowhound_data_logger.datasets.lerobot import Lerobot
from shadowhound_data_logger.datasets.verify import verify
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
    """The start of the arm's recording, by the robot's clock: half a second before the mission."""
    return Mission('', begin_s=2000.0 * number).begin_ns - SECOND // 2 + 7_000_000


def positions(number: int) -> np.ndarray[Any, Any]:
    return np.array([so_arm.positions(begin_ns(number) + frame * SECOND // FPS) for frame in range(4 * FPS)])


def lerobot_set(folder: Path, version: str, numbers: Sequence[int] = (0, 1), *, fps: int = FPS, dtype: Any = np.float32,
                change: Callable[[list[np.ndarray[Any, Any]]], object] = lambda _: None, files: int = 1) -> Path:  # fmt: skip
    """In lerobot's layout: v2.1 one file per episode, v3.0 all in one file, or in several. In degrees.

    ``numbers`` are the recordings that are its episodes; ``change`` gets their positions.
    """
    names: Any = [f'{name}.pos' for name in so_arm.JOINTS]
    names = names if version == 'v3.0' else {'motors': [f'main_{each}' for each in so_arm.JOINTS]}
    vector = {'dtype': 'float32', 'shape': [6], 'names': names}
    info = {'codebase_version': version, 'fps': fps, 'features': {'observation.state': vector, 'action': vector}}
    (folder / 'meta').mkdir(parents=True)
    (folder / 'data/chunk-000').mkdir(parents=True)
    (folder / 'meta/info.json').write_text(json.dumps(info))
    states = [np.rad2deg(positions(number)).astype(np.float32).astype(dtype) for number in numbers]
    change(states)
    tables = []
    for episode, state in enumerate(states):
        column = pa.FixedSizeListArray.from_arrays(pa.array(state.ravel()), 6)
        tables.append(pa.table({
            'observation.state': column, 'action': column, 'timestamp': (np.arange(len(state)) / fps).astype(dtype),
            'frame_index': np.arange(len(state)), 'episode_index': np.full(len(state), episode),
        }))  # fmt: skip
    if version == 'v3.0':
        whole = pa.concat_tables(tables)
        for number in range(files):  # also if an episode is in two of them
            begin, end = (len(whole) * each // files for each in (number, number + 1))
            pq.write_table(whole.slice(begin, end - begin), folder / f'data/chunk-000/file-{number:03d}.parquet')
    else:
        for episode, table in enumerate(tables):
            pq.write_table(table, folder / f'data/chunk-000/episode_{episode:06d}.parquet')
    return folder


@pytest.fixture
def times(tmp_path: Path) -> Path:
    path = tmp_path / 'times.csv'
    path.write_text('episode,begin_ns\n' + ''.join(f'{number},{CLOCK.of(begin_ns(number))}\n' for number in range(2)))
    return path


def exported(house: House, folder: Path, arm: str) -> Lerobot:
    """Exported next to the robot, with its clock given by pairs: the imported data has none."""
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
def test_a_dataset_of_the_arm_is_imported(house: House, tmp_path: Path, times: Path, version: str) -> None:
    """Unchanged, joints in degrees: stored once, in the catalog, and each value traced to the object and the file."""
    arm, source = f'arm{version[1]}', lerobot_set(tmp_path / 'theirs', version)
    store = open_store(house.settings, UploadSettings())
    assert import_episodes(read_lerobot(source, read_times(times), is_degrees=True), arm, store).objects == 4
    again = import_episodes(read_lerobot(source, read_times(times), is_degrees=True), arm, store)
    assert (again.objects, again.present) == (0, 4)
    made = exported(house, tmp_path / 'set', arm)
    assert_is_as_recorded(made)
    assert made.info is not None
    assert made.info['features']['observation.state']['names'] == LEKIWI
    assert made.info['features']['observation.state']['info']['units'][:6] == ['rad'] * 6
    assert verify(tmp_path / 'set', DirectoryStore(house.settings.directory), is_read=True).wrong == []


@pytest.mark.long('a second of CPU or more')
def test_a_dataset_without_a_unit_claims_none(house: House, tmp_path: Path, times: Path) -> None:
    """The numbers are unchanged, and no unit is recorded."""
    store = open_store(house.settings, UploadSettings())
    import_episodes(read_lerobot(lerobot_set(tmp_path / 'theirs', 'v3.0'), read_times(times), is_degrees=False), 'bare', store)
    made = exported(house, tmp_path / 'set', 'bare')
    assert made.info is not None
    assert made.info['features']['observation.state']['info']['units'][:6] == ['as recorded'] * 6
    assert np.abs(made.numbers(made.rows[0], 'observation.state')[:, :6]).max() > 4


@pytest.mark.long('a second of CPU or more')
def test_demonstrations_in_hdf5_are_imported(house: House, tmp_path: Path, times: Path) -> None:
    """In the layout of ACT and ALOHA: qpos and action."""
    h5py = pytest.importorskip('h5py')
    paths = [tmp_path / f'episode_{number}.hdf5' for number in range(2)]
    for number, path in enumerate(paths):
        with h5py.File(path, 'w') as file:
            file.attrs['sim'] = False
            file['observations/qpos'] = positions(number).astype(np.float32)
            file['action'] = positions(number).astype(np.float32)
    store = open_store(house.settings, UploadSettings())
    import_episodes(read_hdf5(paths, read_times(times), fps=FPS, joints=so_arm.JOINTS), 'aloha', store)
    assert_is_as_recorded(exported(house, tmp_path / 'set', 'aloha'))
    with pytest.raises(LakeError, match='has 6 joints, not 2'):
        list(read_hdf5(paths, read_times(times), fps=FPS, joints=('a', 'b')))


def test_a_file_that_is_not_a_recording_is_refused(tmp_path: Path, times: Path) -> None:
    """With the reason and the remedy; the start of an episode is not guessed."""
    with pytest.raises(LakeError, match='not a LeRobotDataset'):
        list(read_lerobot(tmp_path, {}, is_degrees=False))
    source = lerobot_set(tmp_path / 'theirs', 'v3.0')
    with pytest.raises(LakeError, match='the start time of episode 0'):
        list(read_lerobot(source, {}, is_degrees=False))
    (source / 'data/chunk-000/file-000.parquet').write_bytes(b'PAR1 and more')
    with pytest.raises(LakeError, match='is not a data file of a LeRobotDataset'):
        list(read_lerobot(source, read_times(times), is_degrees=False))
    (tmp_path / 'odd.hdf5').write_bytes(b'\x89HDF\r\n\x1a\nand more')
    pytest.importorskip('h5py')
    with pytest.raises(LakeError, match='not a demonstration in the layout'):
        list(read_hdf5([tmp_path / 'odd.hdf5'], read_times(times), fps=50))
    times.write_text('episode,begin_ns\n0,soon\n')
    with pytest.raises(SettingError, match='--times'):
        read_times(times)


# -- again -----------------------------------------------------------------------------------------------------------------


class Shelf:
    """A store, and the datasets of an arm that are imported into it one after the other."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.settings = House(folder / 'house').settings
        self.settings.directory.mkdir(parents=True)
        self.store = open_store(self.settings, UploadSettings())
        self._count = 0

    def set(self, version: str = 'v3.0', numbers: Sequence[int] = (0, 1), **how: Any) -> Path:
        self._count += 1
        return lerobot_set(self.folder / f'theirs{self._count}', version, numbers, **how)

    def bring(self, folder: Path, begins: Sequence[int] | None = None, *, is_degrees: bool = True) -> Imported:
        """``begins`` are the recordings with the start times for its episodes."""
        times = {episode: begin_ns(number) for episode, number in enumerate(range(9) if begins is None else begins)}
        return import_episodes(read_lerobot(folder, times, is_degrees=is_degrees), 'arm', self.store)

    def contents(self) -> dict[str, bytes]:
        root = self.settings.directory / 'sensor-data/arm'
        return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob('*') if path.is_file()}


@pytest.fixture
def shelf(tmp_path: Path) -> Shelf:
    return Shelf(tmp_path)


def counts(found: Imported) -> tuple[int, int, int, int]:
    return found.episodes, found.unchanged, len(found.refused), len(found.absent)


@pytest.mark.parametrize('version', ['v2.1', 'v3.0'])
def test_only_the_new_episodes_of_a_grown_dataset_are_imported(shelf: Shelf, version: str) -> None:
    """Its shared file was rewritten: the new episode is added, and the store's data is unchanged."""
    assert counts(shelf.bring(shelf.set(version))) == (2, 0, 0, 0)
    before = shelf.contents()
    found = shelf.bring(shelf.set(version, (0, 1, 2)))
    assert counts(found) == (1, 2, 0, 0)
    assert (found.objects, found.present, found.samples) == (2, 4, 4 * FPS)
    after = shelf.contents()
    assert after == {**after, **before}
    assert sum('joint' in key for key in after) == sum('joint' in key for key in before) + 2
    assert counts(shelf.bring(shelf.set(version, (0, 1, 2)))) == (0, 3, 0, 0)
    assert shelf.contents() == after


@pytest.mark.parametrize(('version', 'how'), [('v2.1', {}), ('v3.0', {'files': 3}), ('v3.0', {'dtype': np.float64})])
def test_the_layout_does_not_change_an_episode(shelf: Shelf, version: str, how: dict[str, Any]) -> None:
    """Whatever files the episodes are in, also one episode in two of them, and for any column width."""
    assert counts(shelf.bring(shelf.set())) == (2, 0, 0, 0)
    assert counts(shelf.bring(shelf.set(version, **how))) == (0, 2, 0, 0)


def test_rows_in_another_order_give_the_same_episode(shelf: Shelf) -> None:
    """Frames are ordered by number, not by row."""
    shelf.bring(shelf.set())
    folder = shelf.set()
    path = folder / 'data/chunk-000/file-000.parquet'
    table = pq.read_table(path)
    pq.write_table(table.take(np.random.default_rng(3).permutation(len(table))), path, row_group_size=17)
    assert counts(shelf.bring(folder)) == (0, 2, 0, 0)


def test_an_episode_that_changed_is_refused(shelf: Shelf) -> None:
    """By one number: it is named, the others are imported, and the store keeps its data."""
    shelf.bring(shelf.set())
    before = shelf.contents()

    def change(states: list[np.ndarray[Any, Any]]) -> None:
        states[1][77, 3] = np.nextafter(states[1][77, 3], np.float32(1e9))

    found = shelf.bring(shelf.set(numbers=(0, 1, 2), change=change))
    assert counts(found) == (1, 1, 1, 0)
    ((name, why),) = found.refused.items()
    assert name == f'episode 1 ({iso(begin_ns(1))})'
    assert why.startswith('it changed: the recording with this start time was imported as ')
    assert {key: body for key, body in shelf.contents().items() if key in before} == before


@pytest.mark.parametrize('how', [
    {'fps': 15}, {'change': lambda states: states.__setitem__(1, states[1][:-1])},
    {'change': lambda states: states.__setitem__(1, states[1][1:])},
], ids=['fps', 'cut at its end', 'cut at its begin'])  # fmt: skip
def test_other_times_are_another_recording(shelf: Shelf, how: dict[str, Any]) -> None:
    """The same numbers at a different rate, or fewer of them."""
    shelf.bring(shelf.set())
    found = shelf.bring(shelf.set(**how))
    assert (found.episodes, f'episode 1 ({iso(begin_ns(1))})' in found.refused) == (0, True)


def test_another_unit_is_another_recording(shelf: Shelf) -> None:
    shelf.bring(shelf.set())
    assert counts(shelf.bring(shelf.set(), is_degrees=False)) == (0, 0, 2, 0)


def test_removed_episodes_are_reported(shelf: Shelf) -> None:
    """They stay in the store. With one removed from the middle, the others have new numbers, and are the same."""
    shelf.bring(shelf.set(numbers=(0, 1, 2)))
    before = shelf.contents()
    found = shelf.bring(shelf.set(numbers=(0, 2)), begins=(0, 2))
    assert counts(found) == (0, 2, 0, 1)
    assert found.absent[0].startswith(iso(begin_ns(1) // 1_000_000 * 1_000_000))
    assert shelf.contents() == before


def test_episodes_in_another_order_are_the_same(shelf: Shelf) -> None:
    """With their start times they are the same; with those of the old numbers they are refused, and nothing is stored twice."""
    shelf.bring(shelf.set(numbers=(0, 1, 2)))
    before = shelf.contents()
    assert counts(shelf.bring(shelf.set(numbers=(2, 0, 1)), begins=(2, 0, 1))) == (0, 3, 0, 0)
    found = shelf.bring(shelf.set(numbers=(2, 0, 1)))
    assert counts(found) == (0, 0, 3, 0)
    assert all('it has another number or time now' in why for why in found.refused.values())
    assert shelf.contents() == before


def test_a_merged_dataset_imports_nothing_twice(shelf: Shelf) -> None:
    """Episodes imported from either one exist already."""
    shelf.bring(shelf.set(numbers=(0, 1)), begins=(0, 1))
    shelf.bring(shelf.set(numbers=(2,)), begins=(2,))
    assert counts(shelf.bring(shelf.set(numbers=(2, 0, 1, 3)), begins=(2, 0, 1, 3))) == (1, 3, 0, 0)


@pytest.mark.parametrize('shift_s', [-1.5, 1.5, 3.9])
def test_two_recordings_of_the_same_time_are_refused(shelf: Shelf, shift_s: float) -> None:
    """An arm has one at a time: a second one is refused, also in the same dataset, and a later one is accepted."""
    shelf.bring(shelf.set(numbers=(0,)))
    other = shelf.set(numbers=(3, 4))
    times = {0: begin_ns(0) + round(shift_s * SECOND), 1: begin_ns(0) + 4 * SECOND}
    found = import_episodes(read_lerobot(other, times, is_degrees=True), 'arm', shelf.store)
    assert list(found.refused) == [f'episode 0 ({iso(times[0])})']
    assert found.episodes == 1
    double = import_episodes(read_lerobot(other, {0: begin_ns(7), 1: begin_ns(7)}, is_degrees=True), 'other', shelf.store)
    assert counts(double) == (1, 0, 1, 0)


def test_a_killed_import_is_completed(shelf: Shelf) -> None:
    """The second episode only has the joints, not the commands and not the rows of the catalog."""
    folder = shelf.set()
    shelf.bring(folder)
    whole = shelf.contents()
    gone = sorted(key for key in whole if 'joint_commands' in key or '_catalog' in key)
    for key in gone[1::2]:
        (shelf.settings.directory / 'sensor-data/arm' / key).unlink()
    shelf.bring(folder)
    assert shelf.contents() == whole


def test_a_long_episode_is_one_episode(shelf: Shelf, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is stored in several objects, and is still one episode."""
    monkeypatch.setattr('shadowhound_data_logger.datasets.imports.PART', 50)
    found = shelf.bring(shelf.set())
    assert (found.episodes, found.objects) == (2, 12)
    again = shelf.bring(shelf.set(numbers=(0, 1, 2)))
    assert (again.episodes, again.objects, again.present, again.absent) == (1, 6, 12, [])


def test_numbers_that_are_equal_have_one_identity() -> None:
    """0 and -0, any NaN, any byte order in memory; but not: joints with different names, commands or none."""
    stamps = np.arange(3, dtype=np.int64)
    values = np.array([[0.0, 1.0], [2.0, np.nan], [4.0, 5.0]])
    one = identity_of(stamps, ('a', 'b'), values, None, 'rad')
    other_nan = values.copy()
    other_nan.view(np.uint64)[1, 1] |= 1
    rounded = values.astype(np.float32)
    for same in (np.where(values == 0, -0.0, values), other_nan, np.asfortranarray(values), values.astype('>f8'), rounded):
        assert identity_of(stamps + 10**18, ('a', 'b'), same, None, 'rad') == one
    others = [
        (stamps, ('b', 'a'), values, None, 'rad'), (stamps, ('a', 'b'), values, values, 'rad'),
        (stamps * 2, ('a', 'b'), values, None, 'rad'), (stamps, ('a', 'b'), values, None, 'degrees'),
        (stamps, ('a', 'b'), values[::-1], None, 'rad'), (stamps[:2], ('a', 'b'), values[:2], None, 'rad'),
    ]  # fmt: skip
    assert len({one, *(identity_of(*other) for other in others)}) == 1 + len(others)


def test_a_repeated_frame_is_refused(shelf: Shelf) -> None:
    """A file of an earlier version is still in the folder."""
    folder = shelf.set(files=2)
    (folder / 'data/chunk-000/file-002.parquet').write_bytes((folder / 'data/chunk-000/file-001.parquet').read_bytes())
    with pytest.raises(LakeError, match='has a frame twice'):
        shelf.bring(folder)


def test_foreign_objects_are_not_taken_for_an_import(shelf: Shelf) -> None:
    """Keys like ours with an invalid date, the arm's own logs, and metadata that is not a number."""
    shelf.bring(shelf.set(numbers=(0,)))
    root = shelf.settings.directory / 'sensor-data/arm/joint_states'
    for name in ('20269999/999999_000_joint_states_0123456789abcdef_0.json', '20261028/120000_000_joint_states.json'):
        (root / name).parent.mkdir(exist_ok=True)
        (root / name).write_bytes(b'{}')
    (root / '20261028/115900_000_joint_states_0123456789abcdef_0.json').write_bytes(b'{}')  # starts before; its end is unknown
    found = shelf.bring(shelf.set(numbers=(0, 1)))
    assert counts(found) == (1, 1, 0, 1)


@pytest.mark.parametrize('column', ['episode_index', 'frame_index'])
def test_invalid_frame_numbers_are_refused(shelf: Shelf, column: str) -> None:
    folder = shelf.set()
    path = folder / 'data/chunk-000/file-000.parquet'
    table = pq.read_table(path)
    values = table[column].to_numpy().astype(np.float64)
    values[5] = np.nan
    pq.write_table(table.set_column(table.column_names.index(column), column, pa.array(values)), path)
    with pytest.raises(LakeError, match='that is not an integer'):
        shelf.bring(folder)


def test_the_command_reports_what_was_refused(shelf: Shelf, tmp_path: Path) -> None:
    """With exit code 1; existing or removed episodes are not findings."""
    home = tmp_path / 'home'
    home.mkdir()
    (home / 'store').symlink_to(shelf.settings.directory)
    times = tmp_path / 'times.csv'
    times.write_text('episode,begin_ns\n' + ''.join(f'{number},{begin_ns(number)}\n' for number in range(3)))

    def run(folder: Path, *more: str) -> tuple[int, str]:
        runner = CliRunner(env={'SHADOWHOUND_HOME': str(home), 'AWS_ENDPOINT_URL': None, 'COLUMNS': '200'})
        arguments = ['import-lerobot', str(folder), '--arm', 'arm', '--times', str(times), '--degrees', *more]
        ran = runner.invoke(command, arguments, standalone_mode=False, catch_exceptions=False)
        return ran.return_value, ran.stdout

    assert run(shelf.set(numbers=(0, 1, 2))) == (
        ExitCode.FINE, '3 new episodes of arm with 360 samples, 0 in the store already.\n')  # fmt: skip
    code, report = run(shelf.set(numbers=(0, 1)))
    assert code == ExitCode.FINE
    assert report.endswith('0 new episodes of arm with 0 samples, 2 in the store already, 1 imported before are not in it.\n')
    code, report = run(shelf.set(numbers=(0, 3, 2)))
    assert code == ExitCode.FINDING
    assert f'episode 1 ({iso(begin_ns(1))}) is refused: it changed' in report
    code, report = run(shelf.set(numbers=(0, 3, 2)), '--json')
    assert (code, len(json.loads(report)['refused'])) == (ExitCode.FINDING, 1)
