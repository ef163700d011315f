"""Objects that an agent delivers without a node are in the catalog, and a node's frames have the pose of the robot."""

from __future__ import annotations

from pathlib import Path

import pytest
from missions.fakes import journalling

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.formats.rows.parts import read_rows
from shadowhound_data_logger.missions.folder import Run, missions
from shadowhound_data_logger.missions.journal import read
from shadowhound_data_logger.missions.objects import Spooler, objects_of
from shadowhound_data_logger.shipping.catalog_writer import SOON_S


def test_an_agent_alone_writes_the_catalogue(tmp_path: Path) -> None:
    """Its sender delivers, writes a part of what it delivered, and delivers that; rows have mission, run, time and pose."""
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
def test_the_sender_stays_until_the_last_row_is_written(tmp_path: Path, is_hastened: bool) -> None:
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
