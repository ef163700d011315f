"""Contents become the same arrays as with independent readers; invalid content is a LakeError."""

from __future__ import annotations

import io
import struct
import tarfile
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lake.making import NOON_NS, folder_store
from lake.training import COMPRESSED, Drive, jpeg
from PIL import Image
from profiles import examples
from pypcd4 import Encoding, PointCloud

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.lake import decode
from shadowhound_data_logger.lake.decode import arrivals, table


def packed(image: Any, kind: str) -> bytes:
    file = io.BytesIO()
    image.save(file, kind)
    return file.getvalue()


def test_images_as_pillow_reads_them() -> None:
    """Color PNGs are RGB bytes; 16-bit depth and float images keep their values."""
    colours = np.random.default_rng(1).integers(0, 255, (6, 9, 3), np.uint8)
    assert np.array_equal(decode.image(packed(Image.fromarray(colours), 'PNG')), colours)
    grey = decode.image(packed(Image.fromarray(colours[:, :, 0]), 'PNG'))
    assert grey.shape == (6, 9, 3)
    depth = np.arange(54, dtype=np.uint16).reshape(6, 9) * 1000
    read = decode.image(packed(Image.fromarray(depth), 'PNG'))
    assert read.dtype == np.uint16
    assert np.array_equal(read, depth)
    metres = np.linspace(0, 5, 54, dtype=np.float32).reshape(6, 9)
    assert np.array_equal(decode.image(packed(Image.fromarray(metres), 'TIFF')), metres)
    assert np.array_equal(decode.image(packed(Image.fromarray(depth), 'PNG'), (3, 3)), depth[::2, ::3])


def test_clouds_as_pypcd4_reads_them(tmp_path: Path) -> None:
    """X y z intensity in this order whatever the file's; what is not there is NaN."""
    points = np.random.default_rng(2).normal(size=(50, 4)).astype(np.float32)
    cloud = PointCloud.from_points(points, ('intensity', 'z', 'y', 'x'), (np.float32,) * 4)
    cloud.save(tmp_path / 'a.pcd', encoding=Encoding.BINARY)
    body = (tmp_path / 'a.pcd').read_bytes()
    assert np.array_equal(decode.cloud(body), points[:, ::-1])
    PointCloud.from_xyz_points(points[:, :3]).save(tmp_path / 'b.pcd', encoding=Encoding.BINARY)
    bare = decode.cloud((tmp_path / 'b.pcd').read_bytes())
    assert np.array_equal(bare[:, :3], points[:, :3])
    assert np.isnan(bare[:, 3]).all()


@pytest.mark.parametrize('kind', ['tar', 'zip'])
def test_archives_of_the_node(tmp_path: Path, kind: str) -> None:
    """Each message in order; one that repeats the last has its content."""
    still = Drive(folder_store(tmp_path), tmp_path)
    stamps = [NOON_NS + number for number in (0, 10, 20, 30)]
    made = still.one(COMPRESSED, stamps, [still.frame(number) for number in (1, 1, 2, 2)], format=kind, batch_s=1.0, dedup=True)
    assert isinstance(made.body, bytes)
    assert decode.members(made.body, kind) == [
        decode.ArchiveMember(stamp, jpeg(number), 'jpg') for stamp, number in zip(stamps, (1, 1, 2, 2), strict=True)
    ]


@pytest.mark.parametrize('unknown', ['orientation', 'angular_velocity', 'linear_acceleration'])
def test_what_an_imu_marks_as_unknown_is_nan(unknown: str) -> None:
    """By -1 as the first element of its covariance; the -1 of another element is a covariance, and 0 is not known to be one."""

    def sample(stamp_ns: int, first: float) -> dict[str, Any]:
        found: dict[str, Any] = {'stamp_ns': stamp_ns}
        for name, axes in (('orientation', 'xyzw'), ('angular_velocity', 'xyz'), ('linear_acceleration', 'xyz')):
            found[name] = dict.fromkeys(axes, 0.5)
            found[f'{name}_covariance'] = [first if name == unknown else 0.0, *[-1.0] * 8]
        return found

    values = table([sample(1, -1.0), sample(2, 0.0)], 'sensor_msgs/msg/Imu', (), 0).values
    columns = [name.partition('.')[0] == unknown for name in decode.FIELDS['sensor_msgs/msg/Imu']]
    assert np.isnan(values[0]).tolist() == columns
    assert (values[1] == 0.5).all()


def test_a_place_without_a_fix_is_nan() -> None:
    """A receiver that has no fix (``status.status`` -1) repeats the last place, or reports 0."""
    samples = [{'stamp_ns': number, 'status': {'status': status}, 'latitude': 48.1, 'longitude': 11.5, 'altitude': 520.0}
               for number, status in enumerate((-1, 0, 2))]  # fmt: skip
    found = table(samples, 'sensor_msgs/msg/NavSatFix', ('latitude', 'longitude', 'altitude', 'status.status'), 0).values
    assert np.isnan(found[0]).tolist() == [True, True, True, False]
    assert found[1:].tolist() == [[48.1, 11.5, 520.0, 0.0], [48.1, 11.5, 520.0, 2.0]]


def test_records_become_numbers() -> None:
    """Lists and nested messages are columns in order, null is NaN, texts are skipped, times get their offset and are sorted."""
    samples = [{'stamp_ns': 20, 'a': {'b': [1, 2]}, 'c': None, 'text': 'x', 'm': [{'q': 1}, {'q': 2}]},
               {'stamp_ns': 10, 'a': {'b': [3, 4]}, 'c': 5, 'text': 'y', 'm': [{'q': 3}, {'q': 4}]}]  # fmt: skip
    found = decode.records(orjson.dumps({'samples': samples}))
    made = table(found, 'some/msg/Type', ('a.b', 'c', 'm.q'), 100)
    assert list(made.stamps) == [110, 120]
    assert np.array_equal(made.values, [[3, 4, 5, 3, 4], [1, 2, np.nan, 1, 2]], equal_nan=True)
    assert table(found, 'some/msg/Type', (), 0).values.shape == (2, 5)
    with pytest.raises(LakeError, match='have no numbers nothing'):
        table(found, 'some/msg/Type', ('nothing',), 0)


@settings(derandomize=True, deadline=None, max_examples=examples(60))
@given(st.binary(max_size=80), st.sampled_from(['', 'ffd8ffe0', '89504e470d0a1a0a', '49492a00']))
def test_rubbish_is_an_error_of_ours(body: bytes, magic: str) -> None:
    """Whatever reader it is given to."""
    given_ = bytes.fromhex(magic) + body
    for read in (decode.image, decode.cloud, lambda it: decode.members(it, 'zip')):
        with pytest.raises(LakeError):
            read(given_)
    with pytest.raises(LakeError):
        decode.records(b'[' + given_)


def test_archives_that_are_broken() -> None:
    """A tar that ends in a file, a member without its content, and a PCD that is too short, a picture of 400 megapixels."""
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode='w') as made:
        entry = tarfile.TarInfo('1.json')
        entry.size = 5000
        made.addfile(entry, io.BytesIO(bytes(5000)))
    with pytest.raises(LakeError):
        decode.members(file.getvalue()[:2000], 'tar')
    file = io.BytesIO()
    with zipfile.ZipFile(file, 'w') as packed_:
        packed_.writestr('1.json', '{"stamp_ns": 1}')
    with pytest.raises(LakeError):
        decode.members(file.getvalue(), 'zip')
    file = io.BytesIO()
    with zipfile.ZipFile(file, 'w', zipfile.ZIP_DEFLATED) as packed_:
        packed_.writestr('1.jpg', bytes(range(256)) * 4)
    with pytest.raises(LakeError):
        decode.members(file.getvalue().replace(file.getvalue()[35:60], 25 * b'\xff', 1), 'zip')
    head = b'IHDR' + struct.pack('>IIBBBBB', 20_000, 20_000, 8, 2, 0, 0, 0)
    with pytest.raises(LakeError):
        decode.image(b'\x89PNG\r\n\x1a\n' + struct.pack('>I', 13) + head + struct.pack('>I', zlib.crc32(head)))
    short = b'VERSION 0.7\nFIELDS x\nSIZE 4\nTYPE F\nCOUNT 1\nPOINTS 9\nDATA binary\n1234'
    with pytest.raises(LakeError):
        decode.cloud(short)


@pytest.mark.parametrize(('stamps_s', 'received_s', 'expected_s'), [
    pytest.param([0, 1, 1.5, 3], (146, 149.01), [146, 147, 147.5, 149], id='a constant offset'),
    pytest.param([0, 0, 0, 0], (5, 8), [5, 6, 7, 8], id='a stamp that is stuck'),
    pytest.param([0, 1, 2, 3], (9, 9.003), [9, 9.001, 9.002, 9.003], id='a queue that empties at once'),
    pytest.param([0, 1, 2, 3], (9, 9), [9, 10, 11, 12], id='the last arrival is unknown'),
    pytest.param([4], (9, 9), [9], id='one message'),
])  # fmt: skip
def test_arrivals_follow_from_those_of_first_and_last(
    stamps_s: list[float], received_s: tuple[float, float], expected_s: list[float]
) -> None:
    """As far apart as the stamps where the offset is constant, otherwise evenly spread."""
    first, last = (round(each * SECOND) for each in received_s)
    stamps = np.array([round(each * SECOND) for each in stamps_s], np.int64)
    found = arrivals(stamps + first - stamps[0], first, last)
    assert found.tolist() == [round(each * SECOND) for each in expected_s]
