"""Contents become the same arrays as with independent readers; invalid content is a LakeError.

Images, clouds, archives, records and summaries that declare more than they contain: an error, before memory is allocated.
"""

from __future__ import annotations

import io
import json
import os
import struct
import subprocess
import sys
import tarfile
import zipfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest
from bags.test_description import LIMIT_BYTES
from hypothesis import given, settings
from hypothesis import strategies as st
from lake.making import NOON_NS, folder_store, row
from lake.training import COMPRESSED, Drive, jpeg
from PIL import Image
from profiles import examples
from pypcd4 import Encoding, PointCloud

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.core.untrusted import MAX_OBJECT_BYTES, MAX_PIXELS, decompress, from_json, from_yaml
from shadowhound_data_logger.formats.rows import catalog
from shadowhound_data_logger.lake import decode
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.decode import arrivals, table
from shadowhound_data_logger.lake.prefetch import Prefetch
from shadowhound_data_logger.lake.summaries import uploaded
from shadowhound_data_logger.lake.track import Object
from shadowhound_data_logger.missions.contact_sheet import LoggedFrame, contact_sheet


def packed(image: Any, kind: str) -> bytes:
    file = io.BytesIO()
    image.save(file, kind)
    return file.getvalue()


def test_images_are_read_like_pillow_does() -> None:
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


def test_clouds_are_read_like_pypcd4_does(tmp_path: Path) -> None:
    """X y z intensity in this order for any order in the file; missing fields are NaN."""
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
def test_archives_give_each_message_in_order(tmp_path: Path, kind: str) -> None:
    """Each message in order; a repeat has the content of the previous one."""
    still = Drive(folder_store(tmp_path), tmp_path)
    stamps = [NOON_NS + number for number in (0, 10, 20, 30)]
    made = still.one(COMPRESSED, stamps, [still.frame(number) for number in (1, 1, 2, 2)], format=kind, batch_s=1.0, dedup=True)
    assert isinstance(made.body, bytes)
    assert decode.members(made.body, kind) == [
        decode.ArchiveMember(stamp, jpeg(number), 'jpg') for stamp, number in zip(stamps, (1, 1, 2, 2), strict=True)
    ]


@pytest.mark.parametrize('unknown', ['orientation', 'angular_velocity', 'linear_acceleration'])
def test_what_an_imu_marks_as_unknown_is_nan(unknown: str) -> None:
    """With -1 as the first element of its covariance; -1 elsewhere is a covariance, and 0 need not mean unknown."""

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
    """A receiver without a fix (``status.status`` -1) repeats the last position, or reports 0."""
    samples = [{'stamp_ns': number, 'status': {'status': status}, 'latitude': 48.1, 'longitude': 11.5, 'altitude': 520.0}
               for number, status in enumerate((-1, 0, 2))]  # fmt: skip
    found = table(samples, 'sensor_msgs/msg/NavSatFix', ('latitude', 'longitude', 'altitude', 'status.status'), 0).values
    assert np.isnan(found[0]).tolist() == [True, True, True, False]
    assert found[1:].tolist() == [[48.1, 11.5, 520.0, 0.0], [48.1, 11.5, 520.0, 2.0]]


def test_records_become_numbers() -> None:
    """Lists and nested messages are columns in order, null is NaN, strings are skipped, times get their offset and are sorted."""
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
def test_invalid_content_is_a_lake_error(body: bytes, magic: str) -> None:
    """For any reader."""
    given_ = bytes.fromhex(magic) + body
    for read in (decode.image, decode.cloud, lambda it: decode.members(it, 'zip')):
        with pytest.raises(LakeError):
            read(given_)
    with pytest.raises(LakeError):
        decode.records(b'[' + given_)


def test_broken_archives_are_an_error() -> None:
    """A tar that ends inside a file, a member without content, a PCD that is too short, an image of 400 megapixels."""
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
    """With the spacing of the stamps if the offset is constant, otherwise evenly spread."""
    first, last = (round(each * SECOND) for each in received_s)
    stamps = np.array([round(each * SECOND) for each in stamps_s], np.int64)
    found = arrivals(stamps + first - stamps[0], first, last)
    assert found.tolist() == [round(each * SECOND) for each in expected_s]


SIDE = 12_000
"""An image of 144 megapixels, 430 MB: below the limit of Pillow."""


def png(side: int) -> bytes:
    """All black, of any size: equal rows compress a thousandfold."""
    packer = zlib.compressobj(9)
    rows = b''.join(packer.compress(bytes(1 + side)) for _ in range(side)) + packer.flush()

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack('>I', len(body)) + kind + body + struct.pack('>I', zlib.crc32(kind + body))

    head = struct.pack('>IIBBBBB', side, side, 8, 0, 0, 0, 0)
    return b'\x89PNG\r\n\x1a\n' + chunk(b'IHDR', head) + chunk(b'IDAT', rows) + chunk(b'IEND', b'')


def huge_jpeg(side: int) -> bytes:
    """A JPEG that declares this size."""
    file = io.BytesIO()
    Image.new('RGB', (16, 16)).save(file, 'JPEG')
    body = file.getvalue()
    place = body.index(b'\xff\xc0') + 5
    return body[:place] + struct.pack('>HH', side, side) + body[place + 4 :]


def tiff(side: int) -> bytes:
    """A TIFF without any pixels."""
    tags = [(256, side), (257, side), (258, 8), (259, 1), (262, 1), (273, 8), (277, 1), (278, side), (279, side * side)]
    entries = b''.join(struct.pack('<HHII', tag, 4, 1, value) for tag, value in tags)
    return b'II*\0' + struct.pack('<I', 8) + struct.pack('<H', len(tags)) + entries + bytes(4)


READ = """
import pathlib, resource, sys
resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[2]),) * 2)
from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.lake import decode
try:
    decode.image(pathlib.Path(sys.argv[1]).read_bytes())
except LakeError as error:
    print(error)
"""


@pytest.mark.parametrize('make', [png, *(pytest.param(each, marks=pytest.mark.long('as for png')) for each in (huge_jpeg, tiff))])
def test_an_image_that_is_too_large_is_refused_by_its_header(tmp_path: Path, make: object) -> None:
    """In a process that could not hold half of it, and by the contact sheet, too."""
    body = make(SIDE)  # type: ignore[operator]
    (tmp_path / 'evil').write_bytes(body)
    command = [sys.executable, '-c', READ, str(tmp_path / 'evil'), str(LIMIT_BYTES // 4)]
    environ = {**os.environ, 'OPENBLAS_NUM_THREADS': '1'}
    ran = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60, env=environ)
    assert 'it claims 12,000 x 12,000 pixels' in ran.stdout, ran.stderr
    with pytest.raises(ValueError, match='none of 1 frames'):
        contact_sheet([LoggedFrame(NOON_NS, 1, tmp_path / 'evil')], '', NOON_NS, tmp_path / 'sheet.jpg')
    assert MAX_PIXELS >= 7680 * 4320, '8K is not a bomb'


def test_only_our_image_formats_are_tried() -> None:
    """Pillow supports dozens more, some through external programs."""
    for kind in ('GIF', 'BMP', 'EPS', 'PDF', 'ICO'):
        file = io.BytesIO()
        Image.new('RGB', (8, 8)).save(file, kind)
        with pytest.raises(LakeError, match='cannot be read'):
            decode.image(file.getvalue())


def pcd(**changed: str) -> bytes:
    lines = {
        'VERSION': '0.7',
        'FIELDS': 'x y z intensity',
        'SIZE': '4 4 4 4',
        'TYPE': 'F F F F',
        'COUNT': '1 1 1 1',
        'POINTS': '2',
    }
    return '\n'.join(f'{name} {value}' for name, value in {**lines, **changed}.items()).encode() + b'\nDATA binary\n' + bytes(32)


@pytest.mark.parametrize(
    'changed',
    [
        {'POINTS': '-1'}, {'POINTS': str(1 << 40)}, {'POINTS': '3'}, {'SIZE': '4 4 4 99'}, {'COUNT': f'1 1 1 {1 << 40}'},
        {'TYPE': 'O O O O'}, {'FIELDS': 'x y z'}, {'POINTS': '9' * 5000},
    ],
    ids=str,
)  # fmt: skip
def test_a_cloud_has_the_points_that_are_there(changed: dict[str, str]) -> None:
    """Declaring more in the header is an error."""
    assert decode.cloud(pcd()).shape == (2, 4)
    with pytest.raises(LakeError, match='not a PCD'):
        decode.cloud(pcd(**changed))


def sparse_tar() -> bytes:
    """An empty member declared as a file of a terabyte with a hole."""
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode='w', format=tarfile.PAX_FORMAT) as made:
        entry = tarfile.TarInfo('GNUSparseFile.0/1.jpg')
        entry.pax_headers = {
            'GNU.sparse.major': '1',
            'GNU.sparse.minor': '0',
            'GNU.sparse.name': '1.jpg',
            'GNU.sparse.realsize': str(1 << 40),
        }
        body = b'0\n'.ljust(512, b'\0')
        entry.size = len(body)
        made.addfile(entry, io.BytesIO(body))
    return file.getvalue()


def many(count: int, kind: str) -> bytes:
    file = io.BytesIO()
    if kind == 'zip':
        with zipfile.ZipFile(file, 'w') as made:
            for number in range(count):
                made.writestr(str(number), b'')
        return file.getvalue()
    with tarfile.open(fileobj=file, mode='w') as packed:
        for number in range(count):
            packed.addfile(tarfile.TarInfo(str(number)))
    return file.getvalue()


def packed_zip(how: int) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, 'w', how) as made:
        made.writestr('1.jpg', bytes(1 << 24))
        made.writestr('1.json', '{"stamp_ns": 1}')
    return file.getvalue()


@pytest.mark.parametrize(
    ('make', 'kind'),
    [
        (sparse_tar, 'tar'), (partial(many, 20_001, 'tar'), 'tar'), (partial(many, 20_001, 'zip'), 'zip'),
        (partial(packed_zip, zipfile.ZIP_DEFLATED), 'zip'), (partial(packed_zip, zipfile.ZIP_LZMA), 'zip'),
    ],
    ids=['a hole of a terabyte', 'many in a tar', 'many in a zip', 'deflated', 'LZMA'],
)  # fmt: skip
@pytest.mark.long('archives of many')
def test_an_archive_cannot_exceed_its_size(make: Callable[[], bytes], kind: str) -> None:
    """Robots store its contents unchanged."""
    body = make()
    with pytest.raises(LakeError, match=f'the {kind} cannot be read'):
        decode.members(body, kind)


@pytest.mark.parametrize(
    'told',
    [
        {'stamp_ns': 1 << 63}, {'stamp_ns': True}, {'stamp_ns': '1'}, {}, {'samples': [[]]}, {'samples': {'stamp_ns': 1}},
        {'samples': [{'stamp_ns': 1}, 5]}, {'samples': 'no'},
    ],
    ids=str,
)  # fmt: skip
def test_records_have_times(told: object) -> None:
    with pytest.raises(LakeError):
        decode.records(json.dumps(told).encode())


def test_records_that_are_too_deep_or_too_large() -> None:
    """Both are LakeErrors, as are lists of different lengths."""
    deep: object = 5
    for _ in range(1000):
        deep = {'a': deep}
    for samples in ([{'stamp_ns': 1, 'deep': deep}], [{'stamp_ns': 1, 'x': [1, 2]}, {'stamp_ns': 2, 'x': [1]}]):
        with pytest.raises(LakeError):
            table(samples, 'a/msg/B', (), 0)  # type: ignore[arg-type]
    with pytest.raises(LakeError, match='are not read'):
        decode.records(b' ' * (33 << 20))


def test_at_most_the_size_in_the_row_is_read() -> None:
    """And no object above the maximum size for decoding."""
    asked: list[int] = []

    def read(bucket: str, key: str, most: int) -> bytes:
        asked.append(most)
        return b'content'

    with Prefetch(read, 1000, 1) as bodies:
        assert bodies.get(Object('b', 'k', 7, '')) == b'content'
        for size in (MAX_OBJECT_BYTES + 1, 0, -1, 1 << 62):
            with pytest.raises(LakeError, match='allowed are up to'):
                bodies.get(Object('b', f'k{size}', size, ''))
    assert asked == [7]


@pytest.mark.parametrize(
    'told', [b'[' * 100_000, b'{"result": "' + b'a' * (2 << 20) + b'"}', b'{' * 5 + b'1' * 5000], ids=range(3)
)
def test_an_invalid_summary_affects_only_its_mission(tmp_path: Path, told: bytes) -> None:
    """However deep or large it is."""
    settings = folder_store(tmp_path)
    path = settings.directory / catalog.BUCKET / 'thor/missions/run/summary.json'
    path.parent.mkdir(parents=True)
    path.write_bytes(told)
    assert len(uploaded(Bucket(settings, catalog.BUCKET), [('thor', 'run')])) == 0


def test_a_row_that_claims_a_million_messages_is_skipped(tmp_path: Path) -> None:
    """A dataset would have that many samples."""
    from lake import bad_parts

    from shadowhound_data_logger import lake
    from shadowhound_data_logger.formats.rows import parts

    rows = [
        row('camera', NOON_NS),
        {**row('camera', NOON_NS + 10**9), 'count': 1 << 62},
        {**row('camera', NOON_NS + 2 * 10**9), 'count': -1},
    ]
    bad_parts.put(folder_store(tmp_path), parts.encode(rows))
    frames = lake.MissionDataset(Bucket(folder_store(tmp_path), catalog.BUCKET))
    assert len(frames) == 1
    assert len(frames.skipped) == 2
    assert np.array_equal(frames.stamps_ns, [NOON_NS])


def test_documents_are_bounded() -> None:
    """Any depth, size or number of values is an error within a second in all readers."""
    for content in (b'[' * 200_000, b' ' * (17 << 20)):
        with pytest.raises(ValueError, match=r'deep|not read'):
            from_json(content)
    for text in ('[' * 200_000, '- ' * 100_000, ' ' * (5 << 20), 'a: &b [1]\nc: *b', '[' + 'a,' * 300 + ']' * 50):
        with pytest.raises(ValueError, match=r'.'):
            from_yaml(text)
    with pytest.raises(ValueError, match='is not supported'):
        decompress('brotli', b'', 5)
