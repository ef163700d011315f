"""A dataset has every message of its anchor once, with the messages of the other sensors at that time, as published.

The examples for researchers run unchanged.

Several processes read a dataset without shared state: each sample once per epoch, however they were started.
"""

from __future__ import annotations

import importlib.util
import json
import multiprocessing
import os
import pickle
import subprocess
import sys
import threading
import time
import types
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pytest
import simplejpeg
from lake.making import NOON_NS, folder_store, merge
from lake.training import FRAMES_HZ, IMU_HZ, LATE_NS, Drive, imu_reading, in_a_child, jpeg, seconds_of

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import LakeError, ObjectRefused, SettingError, UnknownName
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows.catalog import BUCKET
from shadowhound_data_logger.lake import MissionDataset, Near, Window, dataset, prefetch, query, selecting, shards
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.fetch import FetchRequest, fetch
from shadowhound_data_logger.lake.fetched import keep_rows
from shadowhound_data_logger.lake.tables import narrow
from shadowhound_data_logger.lake.track import NEEDED, Track, packed
from shadowhound_data_logger.stores.directory import DirectoryStore

if TYPE_CHECKING:
    from shadowhound_tower.embedded import Tower


ALIGN = {'odom': 0.5, 'imu': Window(0.5, rows=8), 'joints': 0.2, 'lowstate': 5.0, 'lidar': 0.5}
SECONDS = 6


def drive(tmp_path: Path, seconds: int = SECONDS, **how: Any) -> Bucket:
    settings = folder_store(tmp_path)
    Drive(settings, tmp_path).record(seconds, **how)
    return Bucket(settings, BUCKET)


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(one[name], other[name], equal_nan=True) for name in one)


def test_a_sample_is_what_was_published(tmp_path: Path) -> None:
    """Image, time, pose, and the nearest numbers of each sensor, with their distance in time."""
    dataset = MissionDataset(drive(tmp_path), align=ALIGN)
    assert len(dataset) == SECONDS
    for number in range(SECONDS):
        sample, stamp = dataset[number], NOON_NS + number * SECOND
        assert sample['stamp_ns'] == stamp
        assert np.array_equal(sample['image'], simplejpeg.decode_jpeg(jpeg(number)))
        assert sample['pose'] == pytest.approx([number, -number, 0.5])
        assert sample['battery_pct'] == 77.5
        assert sample['odom'].shape == (13,)
        assert (sample['odom'][0], sample['odom_dt_s']) == (number, LATE_NS / SECOND)
        assert sample['joints'] == pytest.approx(np.full(12, number))
        assert sample['lowstate'] == pytest.approx([77, 29.5, 0])
        assert sample['lidar'].shape == (number + 2, 4)
        assert np.array_equal(sample['lidar'].ravel(), np.arange(4 * (number + 2)))
        assert all(sample[f'{name}_ok'].all() for name in ALIGN if name != 'imu')
    dataset.close()


def test_a_window_is_the_messages_before_the_frame(tmp_path: Path) -> None:
    """The last eight of the half second before it, oldest first, across the boundary of two batches; NaN if missing."""
    dataset = MissionDataset(drive(tmp_path), align={'imu': Window(0.5, rows=8)})
    stamp = NOON_NS + 2 * SECOND
    expected = [imu_reading(stamp - step * SECOND // IMU_HZ) for step in reversed(range(8))]
    assert dataset[2]['imu'] == pytest.approx(np.array(expected), abs=1e-6)
    assert dataset[2]['imu_ok'].all()
    first = dataset[0]
    assert list(first['imu_ok']) == [False] * 7 + [True]
    assert np.isnan(first['imu'][:7]).all()
    assert first['imu'][7] == pytest.approx(imu_reading(NOON_NS))


def test_by_received_samples_are_what_had_arrived(tmp_path: Path) -> None:
    """The IMU's messages arrive 2 s after their stamps: by stamp a frame has those of its time, by arrival older ones."""
    settings = folder_store(tmp_path)
    slow = Drive(settings, tmp_path)
    slow.late_ns = {'imu': 2 * SECOND, 'camera': SECOND // 10}
    slow.record(SECONDS)
    source = Bucket(settings, BUCKET)
    by_stamp = MissionDataset(source, align={'imu': Window(0.5, rows=8)})
    by_received = MissionDataset(source, align={'imu': Window(0.5, rows=8)}, by='received')
    at_ns = NOON_NS + 4 * SECOND
    assert by_stamp[4]['imu'][-1] == pytest.approx(imu_reading(at_ns), abs=1e-6)
    assert (by_received[4]['stamp_ns'], by_stamp[4]['stamp_ns']) == (at_ns + SECOND // 10, at_ns)
    assert by_received[4]['imu'][-1] == pytest.approx(imu_reading(at_ns + SECOND // 10 - 2 * SECOND), abs=1e-6)
    with pytest.raises(SettingError, match='stamp or received'):
        MissionDataset(source, by='arrival')
    by_stamp.close()
    by_received.close()


def test_a_causal_dataset_has_no_later_values(tmp_path: Path) -> None:
    """Odometry arrives shortly after each frame: the nearest is that one, the causal one is that of the second before."""
    dataset = MissionDataset(drive(tmp_path), align={'odom': 1.5, 'joints': 0.2}, causal=True)
    for number in range(1, SECONDS):
        sample = dataset[number]
        assert (sample['odom'][0], sample['odom_dt_s']) == (number - 1, LATE_NS / SECOND - 1)
        assert sample['joints_dt_s'] <= 0
    assert not dataset[0]['odom_ok']
    with pytest.raises(SettingError, match='after_s=0'):
        MissionDataset(drive(tmp_path / 'other'), align={'imu': Window(0.5, rows=8, after_s=0.1)}, causal=True)
    dataset.close()


@pytest.mark.parametrize('frames', ['tar', 'zip'])
def test_an_archive_is_as_many_samples_as_it_has_frames(tmp_path: Path, frames: str) -> None:
    """Each has a separate time, separate neighbors, and a pose interpolated between those of the archives."""
    dataset = MissionDataset(drive(tmp_path, frames=frames), align=ALIGN)
    assert len(dataset) == SECONDS * FRAMES_HZ
    for number in (0, 5, 11, 20):
        sample, stamp = dataset[number], NOON_NS + number * SECOND // FRAMES_HZ
        assert sample['stamp_ns'] == stamp
        assert np.array_equal(sample['image'], simplejpeg.decode_jpeg(jpeg(number)))
        assert sample['imu'][-1] == pytest.approx(imu_reading(stamp), abs=1e-6)
        assert sample['joints'][0] == pytest.approx(seconds_of(stamp), abs=0.11)
        assert sample['odom'][0] == round(number / FRAMES_HZ - LATE_NS / SECOND)
    assert dataset[9]['pose'] == pytest.approx([9 / FRAMES_HZ, -9 / FRAMES_HZ, 0.5])
    assert list(dataset.stamps_ns) == [NOON_NS + number * SECOND // FRAMES_HZ for number in range(len(dataset))]


def test_repeats_are_separate_samples(tmp_path: Path) -> None:
    """A frame stored once and repeated twice is three samples: as rows with different times, and in an archive."""
    settings = folder_store(tmp_path)
    still = Drive(settings, tmp_path)
    stamps = [NOON_NS + number * SECOND // 10 for number in range(3)]
    made = still.one('sensor_msgs/msg/CompressedImage', stamps, [still.frame(5)] * 3, format='tar', batch_s=1.0, dedup=True)
    still.store([made])
    one = still.one('sensor_msgs/msg/CompressedImage', [NOON_NS + SECOND], [still.frame(6)])
    still.store([one])
    repeats = [
        {**one.metadata, 't_start_ns': str(at), 't_end_ns': str(at)} for at in (NOON_NS + 2 * SECOND, NOON_NS + 3 * SECOND)
    ]
    still.catalogue([(one, report) for report in repeats])
    dataset = MissionDataset(Bucket(settings, BUCKET))
    assert [int(dataset[number]['stamp_ns']) for number in range(len(dataset))] == [
        *stamps, *(NOON_NS + second * SECOND for second in (1, 2, 3))
    ]  # fmt: skip
    shown = [simplejpeg.decode_jpeg(jpeg(number)) for number in (5, 5, 5, 6, 6, 6)]
    assert all(np.array_equal(dataset[number]['image'], shown[number]) for number in range(6))


def test_messages_too_far_in_time_are_missing(tmp_path: Path) -> None:
    """Numbers are NaN, a cloud has no points, the mask shows it; all samples have the same shape."""
    settings = folder_store(tmp_path)
    partly = Drive(settings, tmp_path)
    partly.record(4, without=['imu'])
    partly.record(1, first=9)
    dataset = MissionDataset(Bucket(settings, BUCKET), align={'odom': Near(0.02), 'lowstate': 0.1, 'imu': Window(0.5, rows=3)})
    sample = dataset[3]
    assert np.isnan(sample['odom']).all()
    assert sample['odom'].shape == (13,)
    assert (bool(sample['odom_ok']), bool(sample['lowstate_ok']), sample['imu_ok'].any()) == (False, True, False)
    assert sample['imu'].shape[0] == 3


def test_robots_may_have_different_sensors(tmp_path: Path) -> None:
    """One without any data of a sensor has samples of the same shape as the others, with all of it missing."""
    settings = folder_store(tmp_path)
    Drive(settings, tmp_path).record(1)
    Drive(settings, tmp_path, 'tachi').record(1, without=['imu', 'joints', 'lidar'])
    dataset = MissionDataset(Bucket(settings, BUCKET), align={'joints': 0.1, 'imu': Window(0.5, rows=3), 'lidar': 0.1})
    bare, full = dataset.__getitems__(range(2))
    assert {name: value.dtype for name, value in bare.items()} == {name: value.dtype for name, value in full.items()}
    assert [bare[name].shape for name in ('joints', 'imu', 'lidar')] == [(12,), (3, 10), (0, 4)]
    assert not any(bare[f'{name}_ok'].any() for name in ('joints', 'imu', 'lidar'))


def test_prefetched_objects_of_a_batch_are_released(tmp_path: Path) -> None:
    """A frame needs few of an archive's neighbors: the others would fill the memory, batch by batch."""
    dataset = MissionDataset(drive(tmp_path, frames='tar'), align={'imu': 1.0, 'odom': 1.0})
    for number in (0, 5, 9):
        dataset.__getitems__([number])
        assert dataset._reading is not None
        assert dataset._reading[1].waiting_bytes == 0
    dataset.close()


def test_a_known_pose_is_kept_next_to_an_unknown_one(tmp_path: Path) -> None:
    """Odometry ends within an archive: the known pose counts for frames whose next archive has none."""
    settings = folder_store(tmp_path)
    still = Drive(settings, tmp_path)
    for second, more in ((0, {}), (1, {'pose': ''})):
        stamps = [NOON_NS + second * SECOND + number * SECOND // 4 for number in range(4)]
        kind, how = 'sensor_msgs/msg/CompressedImage', {'format': 'tar', 'batch_s': 1.0}
        still.store([still.one(kind, stamps, [still.frame(number) for number in range(4)], **how)], **more)
    dataset = MissionDataset(Bucket(settings, BUCKET))
    assert [dataset[number]['pose'][0] for number in range(4)] == pytest.approx([0.375] * 4)
    assert all(np.isnan(dataset[number]['pose']).all() for number in range(4, 8))


def test_the_poses_of_all_samples_are_those_of_each(tmp_path: Path) -> None:
    """Also for the frames of an archive, during which the robot moved."""
    dataset = MissionDataset(drive(tmp_path, frames='tar'))
    assert dataset.poses == pytest.approx(np.array([dataset[number]['pose'] for number in range(len(dataset))]))


def test_incomplete_samples_can_be_dropped(tmp_path: Path) -> None:
    """According to the catalog for counting, and message by message in a stream."""
    settings = folder_store(tmp_path)
    partly = Drive(settings, tmp_path)
    partly.record(3, frames='tar')
    partly.record(3, frames='tar', without=['joints'], first=3)
    source = Bucket(settings, BUCKET)
    whole = MissionDataset(source, align={'joints': 0.05}, drop_incomplete=True)
    assert len(whole) == 3 * FRAMES_HZ
    streamed = list(whole.stream())
    assert len(streamed) == sum(bool(MissionDataset(source, align={'joints': 0.05})[number]['joints_ok']) for number in range(12))
    assert 0 < len(streamed) < len(whole)


@pytest.mark.parametrize('frames', ['jpeg', 'tar'])
def test_every_way_to_read_gives_the_same_samples(tmp_path: Path, frames: str) -> None:
    """By index, several at a time, streamed, and from a pickled copy."""
    dataset = MissionDataset(drive(tmp_path, frames=frames), align=ALIGN)
    expected = [dataset[number] for number in range(len(dataset))]
    assert all(map(same, expected, dataset.__getitems__(range(len(dataset)))))
    assert all(map(same, expected, dataset.stream()))
    copy = pickle.loads(pickle.dumps(dataset))  # noqa: S301 - our own
    assert all(map(same, expected, (copy[number] for number in range(len(copy)))))
    for each in (dataset, copy):
        each.close()


@pytest.mark.parametrize('frames', ['jpeg', 'tar'])
def test_a_fetched_folder_gives_the_same(tmp_path: Path, frames: str) -> None:
    """Objects and rows from two overlapping fetches are the same dataset as the store."""
    source, to = drive(tmp_path, frames=frames), tmp_path / 'data'
    for flags in ({'sensor': 'camera'}, {'robot': 'thor'}):
        rows = query.objects(source, **flags).to_pylist()
        requests = [FetchRequest(row['bucket'], row['key'], row['bytes'], row['sha256']) for row in rows]
        fetch(requests, to, DirectoryStore(source.settings.directory))
        keep_rows(to, rows)
    store, folder = MissionDataset(source, align=ALIGN), MissionDataset(to, align=ALIGN)
    assert len(store) == len(folder) > 0
    assert all(map(same, store.stream(), folder.stream()))
    assert len(query.objects(selecting.fetched(to)).to_pylist()) == len(query.objects(source).to_pylist())


def test_a_folder_without_rows_is_not_a_dataset(tmp_path: Path) -> None:
    """The folder does not exist, or its files were fetched by prefix: an empty dataset would mean that there are no frames."""
    (tmp_path / 'data' / 'thor' / 'camera').mkdir(parents=True)
    for folder in ('nowhere', 'data'):
        with pytest.raises(LakeError, match=f'{folder} has no catalog'):
            MissionDataset(tmp_path / folder)


def test_an_anchor_that_the_store_does_not_have_is_an_error(tmp_path: Path) -> None:
    """Except for a default sensor, which may have stored nothing yet; a time without frames is a dataset without samples."""
    source = drive(tmp_path, 2)
    with pytest.raises(UnknownName, match="there is no sensor 'wrist'"):
        MissionDataset(source, anchor='wrist')
    assert len(MissionDataset(source, since='2020-01-01', until='2020-01-02')) == 0


def test_an_unknown_sensor_cannot_be_aligned(tmp_path: Path) -> None:
    """A misspelled one, or one not fetched with the frames: an error, not a column of NaN."""
    source = drive(tmp_path, without=['imu'])
    for name in ('odometer', 'imu'):
        with pytest.raises(LakeError, match=f'{name} has no object in the time of camera'):
            MissionDataset(source, align={'odom': 0.5, name: 0.5})


def test_repeats_survive_a_merge(tmp_path: Path) -> None:
    """Rows with the same key and different times are different, also after files of tables were merged."""
    settings = folder_store(tmp_path)
    still = Drive(settings, tmp_path)
    one = still.one('sensor_msgs/msg/CompressedImage', [NOON_NS], [still.frame(6)])
    still.store([one])
    still.catalogue([(one, {**one.metadata, 't_start_ns': str(NOON_NS + SECOND), 't_end_ns': str(NOON_NS + SECOND)})])
    source = Bucket(settings, BUCKET)
    merge(settings)
    assert list(MissionDataset(source).stamps_ns) == [NOON_NS, NOON_NS + SECOND]


def test_an_image_is_averaged_when_it_is_resized(tmp_path: Path) -> None:
    """An image of half the size is the average, not every other pixel."""
    source = drive(tmp_path, 1)
    small = MissionDataset(source, size=(12, 16))[0]['image']
    whole = MissionDataset(source)[0]['image'].astype(float)
    assert small.shape == (12, 16, 3)
    assert np.abs(small - whole.reshape(12, 2, 16, 2, 3).mean(axis=(1, 3))).max() < 4
    assert MissionDataset(source, size=(10, 14))[0]['image'].shape == (10, 14, 3)


def test_the_selection_is_that_of_the_catalog(tmp_path: Path) -> None:
    """The flags restrict the frames but not the aligned sensors; robots are not mixed."""
    settings = folder_store(tmp_path)
    Drive(settings, tmp_path).record(4)
    Drive(settings, tmp_path, 'tachi').record(4, without=['odom'])
    source = Bucket(settings, BUCKET)
    near = MissionDataset(source, robot='thor', near=(2.0, -2.0, 0.5), align={'odom': 0.5})
    assert [sample['odom'][0] for sample in near.stream()] == [2]
    both = MissionDataset(source, align={'odom': 0.5})
    assert sorted(bool(sample['odom_ok']) for sample in both.stream()) == [False] * 4 + [True] * 4
    with pytest.raises(SettingError):
        MissionDataset(source, sensor='camera')
    with pytest.raises(SettingError):
        MissionDataset(source, align={'odom': 0.0})
    assert len(MissionDataset(source, mission='nobody')) == 0


def test_changed_content_is_an_error(tmp_path: Path) -> None:
    """The error names the object, as it does for a missing object."""
    source = drive(tmp_path, 2)
    dataset = MissionDataset(source)
    path = source.settings.directory / BUCKET / 'thor/camera/20261028/120000_front.jpg'
    path.write_bytes(jpeg(1))
    with pytest.raises(LakeError, match=r'120000_front\.jpg is damaged'):
        dataset[0]
    path.unlink()
    with pytest.raises(ObjectRefused, match=r'120000_front\.jpg'):
        dataset[0]
    assert dataset[1]['stamp_ns'] == NOON_NS + SECOND


@pytest.mark.long('a second of CPU or more')
@pytest.mark.seaweedfs
@pytest.mark.parametrize('frames', ['jpeg', 'tar'])
def test_an_s3_server_gives_the_same_samples(tmp_path: Path, seaweed: Tower, frames: str) -> None:
    robot = f'thor{frames}'
    ours = Drive(seaweed.store_settings(), tmp_path / 's3', robot)
    there = Drive(folder_store(tmp_path), tmp_path / 'folder', robot)
    for each in (ours, there):
        each.record(SECONDS, frames=frames)
    one, other = (MissionDataset(Bucket(each.settings, BUCKET), robot=robot, align=ALIGN) for each in (ours, there))
    assert len(one) == len(other) > 0
    assert all(map(same, one.stream(), other.stream()))
    assert all(same(one[number], other[number]) for number in range(len(one)))
    for each in (one, other):
        each.close()


@pytest.mark.long('a million rows')
def test_the_index_of_a_million_objects_is_small() -> None:
    """Every worker of a DataLoader gets one: at most 150 MB, keys and checksums included."""
    count = 1_000_000
    numbers = np.arange(count)
    names = pa.array([f'thor/camera/20261028/{number:06d}_front.jpg' for number in range(count)], pa.large_string())
    columns = {'robot': 'thor', 'sensor': 'camera', 'type': 'sensor_msgs/msg/CompressedImage', 'bucket': 'sensor-data'}
    rows = pa.table({
        **{name: pa.repeat(pa.scalar(value, pa.large_string()), count) for name, value in columns.items()},
        'key': names, 'sha256': pa.array([f'{number:064x}' for number in range(count)], pa.large_string()),
        **dict.fromkeys(('t_start_ns', 't_end_ns', 'bytes', 'clock_offset_ns'), numbers),
        'count': np.ones(count, np.int64), **dict.fromkeys(('x', 'y', 'yaw', 'battery_pct'), numbers / 2),
    })  # fmt: skip
    track = Track.of(rows)
    assert len(track) == count
    assert track.object(count - 1).sha256 == f'{count - 1:064x}'
    assert len(pickle.dumps(track)) < 150e6


@pytest.mark.parametrize(
    ('told', 'kept'),
    [('0123456789abcdef' * 4, '0123456789abcdef' * 4), (None, ''), ('', ''), ('AB' * 32, '00' * 32), ('ab' * 31, '00' * 32),
     ('no hex', '00' * 32), ('ab ' * 32, '00' * 32)],
)  # fmt: skip
def test_an_invalid_checksum_matches_no_content(told: str | None, kept: str) -> None:
    """It is stored in 32 bytes: only an unknown checksum skips the comparison."""
    row = {**dict.fromkeys(NEEDED), 'robot': 'thor', 'sensor': 'camera', 'key': 'thor/camera/1.jpg', 'bucket': BUCKET, 'bytes': 9,
           'sha256': told, 't_start_ns': NOON_NS}  # fmt: skip
    assert Track.of(pa.Table.from_pylist([row], schema=narrow(NEEDED))).object(0).sha256 == kept


def test_rows_of_several_frames_are_one_track_in_order() -> None:
    """The same object from two frames is there once, and strings have one dictionary."""

    def frame(*numbers: int) -> pa.Table:
        same = {**dict.fromkeys(NEEDED), 'robot': 'thor', 'sensor': 'camera', 'bytes': 9}
        return packed(pa.Table.from_pylist(
            [{**same, 'bucket': f'bucket-{number % 2}', 'key': f'{number}.jpg', 't_start_ns': number, 't_end_ns': number + 5}
             for number in numbers], schema=narrow(NEEDED),
        ))  # fmt: skip

    track = Track.of(pa.concat_tables([frame(4, 1), frame(3, 4), frame(2)]))
    assert [track.object(number)[:2] for number in range(len(track))] == [
        ('bucket-1', '1.jpg'), ('bucket-0', '2.jpg'), ('bucket-1', '3.jpg'), ('bucket-0', '4.jpg'),
    ]  # fmt: skip
    assert track.end_ns.tolist() == track.latest_ns.tolist() == [6, 7, 8, 9]
    some = track.only(np.array([1, 3]))
    assert [some.object(number).key for number in range(2)] == ['2.jpg', '4.jpg']


ROOT = Path(__file__).parents[2]
TIMEOUT_S = 200


def run(example: str, *arguments: str, **environ: str) -> subprocess.CompletedProcess[str]:
    """In a separate folder if SHADOWHOUND_HOME names one: MLflow writes artifacts to the working directory."""
    return subprocess.run([sys.executable, str(ROOT / 'examples' / example), *arguments], env={**os.environ, **environ},
                          capture_output=True, text=True, check=False, timeout=TIMEOUT_S,
                          cwd=environ.get('SHADOWHOUND_HOME'))  # fmt: skip


@pytest.mark.skipif(importlib.util.find_spec('torch') is None, reason='torch is not installed (the extra "train")')
def test_a_policy_is_trained_and_its_run_is_in_mlflow(tmp_path: Path) -> None:
    """Parameters, a loss for each epoch and a checkpoint, in the guide's experiment."""
    import mlflow

    home, uri = tmp_path / 'home', f'sqlite:///{tmp_path / "mlflow.db"}'
    home.mkdir()
    settings = type(folder_store(tmp_path))(directory=home / 'store')
    Drive(settings, tmp_path).record(24, without=['imu', 'joints', 'lidar', 'lowstate'])
    environ = {'SHADOWHOUND_HOME': str(home), 'MLFLOW_TRACKING_URI': uri, 'AWS_ENDPOINT_URL': ''}
    ran = run('train_navigation_policy.py', '--epochs', '2', **environ)
    assert ran.returncode == 0, ran.stderr
    client = mlflow.MlflowClient(uri)
    experiment = client.get_experiment_by_name('navigation_policy_training')
    run_ = client.search_runs([experiment.experiment_id])[0]
    assert run_.info.status == 'FINISHED'
    assert (run_.data.params['frames'], run_.data.params['validation_frames']) == ('18', '5')
    assert len(client.get_metric_history(run_.info.run_id, 'train_loss')) == 2
    assert {'val_loss', 'frames_per_s', 'val_loss_of_the_mean'} < run_.data.metrics.keys()


@pytest.mark.seaweedfs
@pytest.mark.long('processes that import much')
def test_several_processes_evaluate_all_frames(tmp_path: Path, seaweed: Tower) -> None:
    """Every frame of the robot once, and no secret in the output of the processes."""
    pytest.importorskip('daft')
    drive = Drive(seaweed.store_settings(), tmp_path, 'fleetrobot')
    drive.record(5, without=['imu', 'joints', 'lidar', 'lowstate', 'odom'])
    environ = seaweed.environment()
    ran = run(
        'fleet_frames.py', '--robot', 'fleetrobot', '--workers', '2', '--json', **environ, RUST_LOG='debug', DAFT_PROGRESS_BAR='0'
    )
    assert ran.returncode == 0, ran.stderr
    assert sorted(json.loads(ran.stdout)['keys']) == sorted(row['key'] for row in drive.rows)
    assert environ['AWS_SECRET_ACCESS_KEY'] not in ran.stdout + ran.stderr


@pytest.mark.long('a second of CPU or more')
@pytest.mark.parametrize('example', ['train_navigation_policy.py', 'fleet_frames.py'])
def test_each_example_has_a_usage_line(example: str) -> None:
    """``--help`` names the requirements."""
    if example.startswith('train') and importlib.util.find_spec('torch') is None:
        pytest.skip('torch is not installed (the extra "train")')
    ran = run(example, '--help')
    assert ran.returncode == 0
    assert '--since' in ran.stdout


WORKER_SECONDS = 10
CHILD_S = 60


@pytest.fixture(scope='module')
def source(tmp_path_factory: pytest.TempPathFactory) -> Bucket:
    """Ten archives of four frames each."""
    tmp = tmp_path_factory.mktemp('drive')
    Drive(folder_store(tmp), tmp).record(WORKER_SECONDS, frames='tar', without=['imu', 'joints', 'lidar', 'lowstate'])
    return Bucket(folder_store(tmp), BUCKET)


@pytest.fixture
def in_worker(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The worker information from torch, with torch loaded."""
    report = types.SimpleNamespace(id=0, num_workers=1)
    module: Any = types.ModuleType('torch.utils.data')
    module.get_worker_info = lambda: report
    module.IterableDataset = type('IterableDataset', (), {'register': classmethod(lambda _, kind: kinds.append(kind))})
    kinds: list[type] = module.__dict__.setdefault('kinds', [])
    monkeypatch.setitem(sys.modules, 'torch.utils.data', module)

    def be(number: int, count: int) -> Any:
        report.id, report.num_workers = number, count
        return module

    return be


def stamps(stream: Any) -> list[int]:
    return [int(sample['stamp_ns']) for sample in stream]


def test_workers_cover_all_shards_completely(source: Bucket, in_worker: Any) -> None:
    """Three workers: no archive is read by two, every frame is read once; a DataLoader accepts it as an IterableDataset."""
    frames = MissionDataset(source)
    got = []
    for number in range(3):
        module = in_worker(number, 3)
        got.append(stamps(frames.stream(shuffle=True)))
    assert dataset.MissionStream in module.kinds
    archives = [{stamp // 10**9 for stamp in mine} for mine in got]
    assert sum(map(len, archives)) == WORKER_SECONDS
    assert len(set().union(*archives)) == WORKER_SECONDS
    in_worker(0, 1)
    assert sorted(stamp for mine in got for stamp in mine) == stamps(frames.stream())


def test_ranks_split_what_their_workers_split(source: Bucket, in_worker: Any) -> None:
    """Two processes of two workers each: four complementary shares."""
    frames, got = MissionDataset(source), []
    for rank in range(2):
        for number in range(2):
            in_worker(number, 2)
            got += stamps(frames.stream(shuffle=True, rank=rank, ranks=2))
    in_worker(0, 1)
    assert sorted(got) == stamps(frames.stream())


def test_epochs_differ_and_can_be_repeated(source: Bucket) -> None:
    """Each iteration uses another epoch's order, ``set_epoch`` selects one, and seeds differ."""
    frames = MissionDataset(source)
    stream = frames.stream(shuffle=True, seed=7)
    first, second = stamps(stream), stamps(stream)
    assert first != second
    assert sorted(first) == sorted(second) == stamps(frames.stream())
    stream.set_epoch(1)
    assert stamps(stream) == second
    assert stamps(frames.stream(shuffle=True, seed=8)) != first
    assert stamps(pickle.loads(pickle.dumps(frames.stream(shuffle=True, seed=7)))) == first  # noqa: S301 - our own


def test_a_shuffled_stream_mixes_archives_and_reads_each_once(source: Bucket) -> None:
    """Neighbors in the stream come from several archives, and no object is fetched twice."""
    frames = MissionDataset(source)
    asked: list[str] = []
    read = frames._place.read

    class Place:
        def read(self, bucket: str, key: str, most: int) -> bytes:
            asked.append(key)
            return read(bucket, key, most)

    frames._place = Place()  # type: ignore[assignment]
    mixed = [stamp // 10**9 for stamp in stamps(frames.stream(shuffle=True))]
    assert len(set(mixed[: 2 * FRAMES_HZ])) > 2
    assert sorted(asked) == sorted(set(asked))
    assert len(asked) == WORKER_SECONDS


def test_a_shard_of_single_objects_is_bounded() -> None:
    """A track of single frames is split every 64 objects, an archive is one shard."""
    counts = np.array([1] * 70 + [30, 30] + [1] * 2)
    track = types.SimpleNamespace(count=counts)
    cut = shards.shards([track], [np.arange(len(counts))])  # type: ignore[list-item]
    assert [(each.first, each.last) for each in cut] == [(0, 64), (64, 70), (70, 71), (71, 72), (72, 74)]


def test_prefetching_is_bounded(source: Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    """After the first sample, no more than the limit and one object is requested."""
    frames = MissionDataset(source)
    size = int(frames._selection.anchors[0].size[0])
    monkeypatch.setattr(dataset, 'PREFETCH_BYTES', 3 * size)
    asked: list[str] = []
    read = frames._place.read
    frames._place = types.SimpleNamespace(read=lambda bucket, key, most: (asked.append(key), read(bucket, key, most))[1])  # type: ignore[assignment]
    streamed = iter(frames.stream())
    next(streamed)
    streamed.close()  # type: ignore[attr-defined]
    assert len(asked) <= 5


@pytest.mark.long('a second of CPU or more')
@pytest.mark.seaweedfs
@pytest.mark.parametrize('way', ['fork', 'spawn'])
def test_a_process_started_after_reading_reads_on_its_own(tmp_path: Path, seaweed: Tower, way: str) -> None:
    """Forked or spawned, it reads the same from the server, though its parent has connections and threads."""
    robot = f'worker{way}'
    Drive(seaweed.store_settings(), tmp_path, robot).record(4)
    frames = MissionDataset(Bucket(seaweed.store_settings(), BUCKET), robot=robot)
    expected = [int(sample['stamp_ns']) for sample in frames.__getitems__(range(4))]
    context: Any = multiprocessing.get_context(way)
    out = context.SimpleQueue()
    child = context.Process(target=in_a_child, args=(frames, range(4), out))
    child.start()
    try:
        child.join(CHILD_S)
        assert child.exitcode == 0
        assert out.get() == expected
    finally:
        child.kill()
        child.join()
        frames.close()


def test_a_pickled_dataset_is_a_value(source: Bucket) -> None:
    """It contains no threads, locks or connections, and no cached data."""
    frames = MissionDataset(source)
    before = len(pickle.dumps(frames))
    frames.__getitems__(range(len(frames)))
    assert len(pickle.dumps(frames)) == before
    frames.close()


@pytest.mark.long('a process of its own')
def test_importing_it_loads_no_torch() -> None:
    """Nor does creating an empty dataset."""
    load = 'import sys; from shadowhound_data_logger.lake import MissionDataset'
    program = f'{load}; print("torch" in sys.modules, MissionDataset.__name__)'
    ran = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, check=True, timeout=60)
    assert ran.stdout.split() == ['False', 'MissionDataset']


@pytest.mark.parametrize('style', ['number', 'stream'])
def test_torchs_data_loader_gives_every_frame_once(source: Bucket, style: str) -> None:
    """Two forked workers give every frame once, as tensors."""
    data = pytest.importorskip('torch.utils.data', reason='torch is not installed (the extra "train")')
    frames = MissionDataset(source, align={'odom': 0.5})
    given = frames if style == 'number' else frames.stream(shuffle=True)
    loader = data.DataLoader(given, batch_size=3, num_workers=2, shuffle=True if style == 'number' else None)
    batches = list(loader)
    assert sorted(int(stamp) for batch in batches for stamp in batch['stamp_ns']) == sorted(stamps(frames.stream()))
    assert tuple(batches[0]['image'].shape[1:]) == (24, 32, 3)
    assert tuple(batches[0]['odom'].shape[1:]) == (13,)


def test_the_threads_of_a_process_open_one_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Threads that start at the same time share one store: a client of S3 takes half a second and megabytes."""
    opened: list[object] = []
    begin = threading.Barrier(8)

    def open_slowly(*_: object) -> object:
        opened.append(object())
        time.sleep(0.05)  # a client takes longer
        return opened[-1]

    def ask(_: int) -> object:
        begin.wait()
        return prefetch._of_this_process(StoreSettings(directory=tmp_path))

    monkeypatch.setattr(prefetch, 'open_store', open_slowly)
    with ThreadPoolExecutor(8) as pool:
        found = set(pool.map(ask, range(8)))
    assert [*found] == opened
