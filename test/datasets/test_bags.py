"""Where a bag has more of a sensor than the objects have, the dataset is made of the bag, and says so."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from datasets.recorded import TOPICS, House, Mission, cdr_of, x_of
from lake.gap_parts import tell
from lake.making import add
from lake.training import COMPRESSED, ODOMETRY
from rosbags.typesys import Stores, get_typestore

from shadowhound_data_logger.bags.manifest import COMPLETE, Manifest, SliceEntry, topics_of
from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.datasets import series
from shadowhound_data_logger.datasets.export import export
from shadowhound_data_logger.datasets.features import ExportOptions
from shadowhound_data_logger.datasets.lerobot import DATA, Lerobot, matrix
from shadowhound_data_logger.datasets.verify import verify
from shadowhound_data_logger.formats.definitions import describe
from shadowhound_data_logger.formats.mcap.slice_info import Channel
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.formats.rows.gaps import complete
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.directory import DirectoryStore


def record_bag(house: House, tmp_path: Path, *, is_there: bool = True) -> tuple[Mission, str]:
    """A dense recording beside the objects, and the key of its slice, which a robot may keep."""
    dense = Mission('bagged', seconds=2, camera_hz=10.0, odom_hz=50.0)
    path = tmp_path / 'bagged_0.mcap'
    writer = SliceWriter(path)
    for sensor, kind in (('camera', COMPRESSED), ('odom', ODOMETRY)):
        channel = Channel(TOPICS[sensor], kind, *describe(kind), '')
        for number, stamp in enumerate(dense.stamps(sensor)):
            writer.write(channel, stamp + 2_000_000, stamp, number, cdr_of(house.drive._ros, sensor, stamp))
    info = writer.close()
    key = 'thor/rosbags/bagged/bagged_0.mcap'
    manifest = Manifest('bagged', 'thor', None, COMPLETE, (), topics_of([info]), (SliceEntry.of(info, key),))
    with closing(open_store(house.settings, UploadSettings())) as store:
        if is_there:
            add(store, tmp_path / 'tmp', key, path.read_bytes())
        add(store, tmp_path / 'tmp', 'thor/rosbags/bagged/manifest.json', manifest.to_json())
    return dense, key


def test_a_bag_is_taken_where_it_has_more(tmp_path: Path) -> None:
    """The camera at its own rate of a bag, its sources the slices, and all of it proved."""
    house = House(tmp_path)
    mission = house.record(Mission('bagged', seconds=2, camera_hz=1.0, odom_hz=2.0, sensors=('camera', 'odom')))
    dense, key = record_bag(house, tmp_path)
    tell(house.settings, tmp_path, *(
        complete('thor', 'j', 99, sink='bags', topic=TOPICS[sensor], session=1, grade='exact', received=1, skipped=0,
                 from_ns=mission.begin_ns - 2 * SECOND, to_ns=mission.end_ns + SECOND,
                 received_from_ns=mission.begin_ns - 2 * SECOND, received_to_ns=mission.end_ns + SECOND)
        for sensor in ('camera', 'odom')
    ), name='bags')  # fmt: skip
    found = export(tmp_path / 'set', house.source, {'mission_type': 'patrol'}, ExportOptions())
    assert (found.refused, found.waiting, found.fps) == ({}, {}, 10)
    assert {each['from'] for each in found.added[0]['streams'].values()} == {'bags'}
    made = Lerobot(tmp_path / 'set')
    table = pq.read_table(made.path(DATA, made.rows[0], 'data'))
    stamps, published = table['shadowhound.stamp_ns'].to_numpy(), np.array(dense.stamps('odom'))
    newest = published[np.searchsorted(published, stamps, 'right') - 1]
    assert matrix(table['observation.state'])[:, 0] == pytest.approx([x_of(int(stamp)) for stamp in newest], abs=1e-4)
    sources = pq.read_table(tmp_path / 'set/meta/shadowhound_sources.parquet')
    assert set(sources['key'].to_pylist()) == {key}
    assert set((sources['received_ns'].to_numpy() - sources['stamp_ns'].to_numpy()).tolist()) == {2_000_000}
    proved = verify(tmp_path / 'set', DirectoryStore(house.settings.directory), frames=None)
    assert (proved.wrong, proved.frames) == ([], len(table))
    by_received = export(tmp_path / 'received', house.source, {'mission_type': 'patrol'}, ExportOptions(by='received'))
    assert {each['from'] for each in by_received.added[0]['streams'].values()} == {'bags'}
    (row,) = Lerobot(tmp_path / 'received').rows
    ticks = pq.read_table(Lerobot(tmp_path / 'received').path(DATA, row, 'data'))['shadowhound.stamp_ns'].to_numpy()
    sources = pq.read_table(tmp_path / 'received/meta/shadowhound_sources.parquet')
    assert set((sources['received_ns'].to_numpy() - sources['stamp_ns'].to_numpy()).tolist()) == {2_000_000}
    age_ns = ticks[sources['frame'].to_numpy()] - sources['received_ns'].to_numpy()
    assert sources['held_s'].to_numpy() * SECOND == pytest.approx(age_ns, abs=1000)


def test_slices_that_a_robot_keeps_are_not_missed(tmp_path: Path) -> None:
    """The store has the manifest of the bag alone: the dataset is made of the objects."""
    house = House(tmp_path)
    house.record(Mission('bagged', seconds=2, camera_hz=5.0, odom_hz=5.0, sensors=('camera', 'odom')))
    record_bag(house, tmp_path, is_there=False)
    found = export(tmp_path / 'set', house.source, {'mission_type': 'patrol'}, ExportOptions())
    assert (found.refused, found.waiting) == ({}, {})
    assert {each['from'] for each in found.added[0]['streams'].values()} == {'objects'}


def test_what_an_imu_marks_as_unknown_is_nan_in_a_bag_as_well() -> None:
    """As in an object: a set is not made of an orientation that the IMU does not measure."""
    types = get_typestore(Stores.ROS2_HUMBLE).types
    vector, covariance = types['geometry_msgs/msg/Vector3'](1.0, 2.0, 3.0), np.zeros(9)
    header = types['std_msgs/msg/Header'](types['builtin_interfaces/msg/Time'](1, 0), '')
    turn = types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0)
    for mark in (-1.0, 0.0):
        unknown = np.array([mark, *[0.0] * 8])
        message = types['sensor_msgs/msg/Imu'](header, turn, unknown, vector, covariance, vector, covariance)
        values = series._values(message, 'sensor_msgs/msg/Imu', ())
        assert values[:6].tolist() == [1.0, 2.0, 3.0] * 2
        assert np.isnan(values[6:]).all() == (mark == -1.0)
