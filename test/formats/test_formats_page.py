"""The examples of docs/formats.md open what the encoder makes."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg

from shadowhound_data_logger.formats.definitions import describe
from shadowhound_data_logger.formats.mcap.rosbag2_metadata import metadata_yaml
from shadowhound_data_logger.formats.mcap.slice_info import Channel
from shadowhound_data_logger.formats.mcap.writer import SliceWriter
from shadowhound_data_logger.formats.rows.catalog import row_of
from shadowhound_data_logger.formats.rows.parts import encode

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / 'docs' / 'formats.md').read_text(encoding='utf-8')
START, *EXAMPLES = re.findall(r'^```python\n(.*?)^```', PAGE, re.DOTALL | re.MULTILINE)
COMPRESSED = 'sensor_msgs/msg/CompressedImage'
CLOUD = 'sensor_msgs/msg/PointCloud2'
IMAGE = 'sensor_msgs/msg/Image'


def write_bag(folder: Path, imu: bytes) -> None:
    """One slice with a message that can be read."""
    folder.mkdir()
    writer = SliceWriter(folder / f'{folder.name}_0.mcap')
    channel = Channel('/imu', 'go2_interfaces/msg/IMU', *describe('go2_interfaces/msg/IMU'), '')
    writer.write(channel, 1_800_000_000_000_000_000, 1_800_000_000_000_000_000, 1, imu)
    (folder / 'metadata.yaml').write_bytes(metadata_yaml([writer.close()], ros_distro='humble'))


@pytest.fixture
def bucket(ros: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with one object of each kind under the name that the page gives it."""
    field = [ros.make('sensor_msgs/msg/PointField', name=name, offset=4 * at, datatype=7, count=1)
             for at, name in enumerate(('x', 'y', 'z', 'intensity'))]  # fmt: skip
    points = np.arange(12, dtype='<f4').view(np.uint8)
    cloud = ros.cdr(CLOUD, height=1, width=3, point_step=16, row_step=48, fields=field, data=points)
    depth = ros.cdr(IMAGE, height=1, width=2, step=4, encoding='16UC1', data=np.array([0, 5000], '<u2').view(np.uint8))
    jpeg = np.frombuffer(simplejpeg.encode_jpeg(np.zeros((4, 6, 3), np.uint8)), np.uint8)
    frame = ros.cdr(COMPRESSED, header={'frame_id': 'front'}, data=jpeg)
    imu, voxels = ros.cdr('go2_interfaces/msg/IMU'), ros.cdr('go2_interfaces/msg/VoxelMapCompressed', data=points)
    made = {
        '120000_front.jpg': ros.encode(COMPRESSED, frame),
        '120000_depth.png': ros.encode(IMAGE, depth),
        '120000_scan.pcd': ros.encode(CLOUD, cloud),
        '120000_imu.json': ros.encode('go2_interfaces/msg/IMU', imu, imu),
        '120000_voxel_map.cdr': ros.encode('go2_interfaces/msg/VoxelMapCompressed', voxels, sensor='voxel_map'),
        '120000_front.tar': ros.encode(COMPRESSED, frame, frame, format='tar', batch_s=1.0),
        '120001_front.tar': ros.encode(COMPRESSED, frame, format='tar', batch_s=1.0),
    }
    for name, encoding in made.items():
        (tmp_path / name).write_bytes(encoding.object.body)
    day = tmp_path / 'thor' / '_catalog' / 'date=2025-10-18'
    day.mkdir(parents=True)
    (day / 'part.jsonl.zst').write_bytes(encode([row_of('sensor-data', 'thor/camera/a.jpg', 1, '', {'pose': '3 1 0 odom'})]))
    shutil.copy(ROOT / 'interfaces' / 'go2_interfaces' / 'msg' / 'VoxelMapCompressed.msg', tmp_path)
    write_bag(tmp_path / 'patrol_20261121_120000', imu)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize('example', EXAMPLES, ids=[example.splitlines()[0][:40] for example in EXAMPLES])
def test_the_examples(bucket: Path, example: str) -> None:
    """Each example runs unchanged; those of libraries that are not installed here are skipped."""
    for name in re.findall(r'^(?:import|from) (\w+)', example, re.MULTILINE):
        pytest.importorskip(name)
    exec(f'{START}\nfrom PIL import Image\n{example}', {})  # noqa: S102


def test_every_kind_is_shown() -> None:
    """The page opens a file of each extension that the encoder gives."""
    text = '\n'.join(EXAMPLES)
    assert not [ext for ext in ('jpg', 'png', 'tiff', 'pcd', 'json', 'cdr', 'tar', 'zip') if ext not in text]
