"""What an agent delivers without a node is in the catalogue, and a node's frames say where the robot was."""

from __future__ import annotations

import io
from pathlib import Path

import pyarrow.parquet
from missions.fakes import journalling

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.missions.folder import Run, missions
from shadowhound_data_logger.missions.journal import read
from shadowhound_data_logger.missions.objects import Spooler, objects_of


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
    (part,) = (tmp_path / 'store').rglob('thor/_catalog/date=*/*.parquet')
    (row,) = pyarrow.parquet.read_table(io.BytesIO(part.read_bytes())).to_pylist()
    assert row['key'] == 'thor/missions/abc/camera/frame_000007.jpg'
    assert (row['robot'], row['sensor'], row['mission_id'], row['run_id'], row['mission_type']) == (
        'thor', 'missions', folder.mission_id, 'abc', 'patrol',
    )  # fmt: skip
    assert row['t_start_ns'] == frame['t']
    assert (row['x'], row['y'], row['yaw'], row['pose_frame']) == (1.0, 2.0, 0.5, 'odom')
