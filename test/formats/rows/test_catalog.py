"""The catalog has the same values for an object as its metadata."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.keys import check_key
from shadowhound_data_logger.formats.rows import catalog

NOON_NS = 1_760_788_800 * SECOND
CAMERA = 'thor/camera/20251018/120000_front.jpg'
TOLD = {
    'robot': 'thor', 'sensor': 'camera', 'topic': '/camera/compressed', 'type': 'sensor_msgs/msg/CompressedImage', 'count': '1',
    't_start_ns': str(NOON_NS + 7), 't_end_ns': str(NOON_NS + SECOND), 'sha256': 'ab' * 32, 'mission_id': 'patrol_1',
    'run_id': 'r1', 'mission_type': 'patrol', 'pose': '1.500 -2.000 0.7854 odom', 'battery_pct': '78', 'clock': 'set_later',
    'clock_offset_ns': '-5', 'gps': '-33.8568000 151.2153000 5.00',
}  # fmt: skip


def row(metadata: dict[str, str], key: str = CAMERA, bucket: str = 'sensor-data') -> catalog.Row:
    return catalog.row_of(bucket, key, 50_000, 'image/jpeg', metadata)


def test_a_row_has_all_metadata_of_the_object() -> None:
    """Each column has its value, in the order of the columns."""
    found = row(TOLD)
    assert list(found) == list(catalog.COLUMNS)
    assert found == {
        'robot': 'thor', 'sensor': 'camera', 'topic': '/camera/compressed', 'type': 'sensor_msgs/msg/CompressedImage',
        'bucket': 'sensor-data', 'key': CAMERA, 'bytes': 50_000, 'sha256': 'ab' * 32, 't_start': NOON_NS // 1000,
        't_end': (NOON_NS + SECOND) // 1000, 't_start_ns': NOON_NS + 7, 't_end_ns': NOON_NS + SECOND, 'count': 1,
        'mission_id': 'patrol_1', 'run_id': 'r1', 'mission_type': 'patrol', 'x': 1.5, 'y': -2.0, 'yaw': 0.7854,
        'pose_frame': 'odom', 'battery_pct': 78.0, 'clock': 'set_later', 'clock_offset_ns': -5, 'content_type': 'image/jpeg',
        'format_version': 1, 'received_start_ns': None, 'received_end_ns': None, 'by_arrival': None,
        'latitude': -33.8568, 'longitude': 151.2153, 'altitude': 5.0,
    }  # fmt: skip


def test_missing_metadata_is_null() -> None:
    """A foreign object has robot and sensor from its key, its size, and nothing else."""
    found = row({})
    known = {name for name, value in found.items() if value is not None}
    assert known == {'robot', 'sensor', 'bucket', 'key', 'bytes', 'content_type', 'format_version'}
    assert (found['robot'], found['sensor']) == ('thor', 'camera')


@pytest.mark.parametrize('pose', ['', '1 2', '1 2 3', '1 2 x odom', '1 2 nan odom', '1 2 inf odom', '1 2 3 a b'])
def test_an_incomplete_pose_is_null(pose: str) -> None:
    """If any part of it is missing or not a number, all of it is null."""
    found = row({**TOLD, 'pose': pose})
    assert [found[name] for name in ('x', 'y', 'yaw', 'pose_frame')] == [None] * 4


@pytest.mark.parametrize('gps', ['', '1 2', '91 2 3', '1 181 3', '1 nan 3', 'inf 2 3', '1 2 3 4', 'x 2 3'])
def test_an_invalid_position_is_null(gps: str) -> None:
    """Whatever a foreign object has; a position without an altitude is valid."""
    found = row({**TOLD, 'gps': gps})
    assert [found[name] for name in ('latitude', 'longitude', 'altitude')] == [None] * 3
    found = row({**TOLD, 'gps': '1 2 nan'})
    assert [found[name] for name in ('latitude', 'longitude', 'altitude')] == [1.0, 2.0, None]


def test_a_time_since_boot_has_no_date() -> None:
    """An object of a clock that was never set has its times since boot, no date, and the folder of those."""
    fields = {'robot': 'thor', 'boot_start_ns': str(5 * SECOND), 'boot_end_ns': str(6 * SECOND), 'clock': 'unset'}
    found = row(fields, 'thor/_unsynced/b/camera/00000005_000_camera.jpg')
    assert (found['t_start_ns'], found['t_end_ns']) == (5 * SECOND, 6 * SECOND)
    assert (found['t_start'], found['t_end']) == (None, None)
    assert catalog.date_of(found) == '1970-01-01'
    assert catalog.date_of(row(TOLD)) == '2025-10-18'


def test_a_slice_of_a_bag_counts_its_messages() -> None:
    """``messages`` is the count if there is no other."""
    assert row({'messages': '42'})['count'] == 42
    assert row({'messages': '42', 'count': '7'})['count'] == 7


@given(st.dictionaries(st.sampled_from(sorted(TOLD)), st.text()), st.text())
def test_hostile_metadata_gives_a_valid_row(metadata: dict[str, str], key: str) -> None:
    """For any foreign values there is a row with 64-bit integers, and a folder for it."""
    found = row(metadata, key)
    assert all(abs(value) < 1 << 63 for value in found.values() if isinstance(value, int))
    assert re.fullmatch(r'\d{4}-\d\d-\d\d', catalog.date_of(found))


def test_the_catalog_does_not_list_itself() -> None:
    """Everything else is listed, including another bucket's folder of that name."""
    key = catalog.OBJECTS.part_key('thor', '2025-10-18', '20251018T120100_b00t')
    assert check_key(key) == 'thor/_catalog/date=2025-10-18/thor_20251018T120100_b00t.jsonl.zst'
    assert key.startswith(catalog.OBJECTS.prefix('thor'))
    assert not catalog.is_row('sensor-data', key)
    assert catalog.is_row('trajectories', key)
    assert catalog.is_row('sensor-data', CAMERA)
    assert catalog.is_row('sensor-data', 'thor/_ledger/20251018/120000_ledger.json')
