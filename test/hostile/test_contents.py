"""Pictures, clouds, archives, records and summaries that claim more than there is: an error, before it takes memory."""

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

import numpy as np
import pytest
from hostile.test_bags import LIMIT_BYTES
from lake.making import NOON_NS, folder_store, row
from PIL import Image

from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.core.untrusted import MAX_OBJECT_BYTES, MAX_PIXELS, decompress, from_json, from_yaml
from shadowhound_data_logger.formats.rows import catalog
from shadowhound_data_logger.lake import decode
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.decode import table
from shadowhound_data_logger.lake.prefetch import Prefetch
from shadowhound_data_logger.lake.summaries import uploaded
from shadowhound_data_logger.lake.track import Object
from shadowhound_data_logger.missions.contact_sheet import LoggedFrame, contact_sheet

SIDE = 12_000
"""Of a picture of 144 megapixels, 430 MB: below what Pillow itself refuses."""


def png(side: int) -> bytes:
    """All black, whatever its size: rows that are alike compress a thousandfold."""
    packer = zlib.compressobj(9)
    rows = b''.join(packer.compress(bytes(1 + side)) for _ in range(side)) + packer.flush()

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack('>I', len(body)) + kind + body + struct.pack('>I', zlib.crc32(kind + body))

    head = struct.pack('>IIBBBBB', side, side, 8, 0, 0, 0, 0)
    return b'\x89PNG\r\n\x1a\n' + chunk(b'IHDR', head) + chunk(b'IDAT', rows) + chunk(b'IEND', b'')


def jpeg(side: int) -> bytes:
    """One that says that it is so large."""
    file = io.BytesIO()
    Image.new('RGB', (16, 16)).save(file, 'JPEG')
    body = file.getvalue()
    place = body.index(b'\xff\xc0') + 5
    return body[:place] + struct.pack('>HH', side, side) + body[place + 4 :]


def tiff(side: int) -> bytes:
    """Without a pixel behind its claim."""
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


@pytest.mark.parametrize('make', [png, *(pytest.param(each, marks=pytest.mark.long('as for png')) for each in (jpeg, tiff))])
def test_a_picture_that_is_too_large_is_refused_by_its_header(tmp_path: Path, make: object) -> None:
    """In a process that could not even hold a half of it, and by the contact sheet, too."""
    body = make(SIDE)  # type: ignore[operator]
    (tmp_path / 'evil').write_bytes(body)
    command = [sys.executable, '-c', READ, str(tmp_path / 'evil'), str(LIMIT_BYTES // 4)]
    environ = {**os.environ, 'OPENBLAS_NUM_THREADS': '1'}
    ran = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60, env=environ)
    assert 'it claims 12,000 x 12,000 pixels' in ran.stdout, ran.stderr
    with pytest.raises(ValueError, match='none of 1 frames'):
        contact_sheet([LoggedFrame(NOON_NS, 1, tmp_path / 'evil')], '', NOON_NS, tmp_path / 'sheet.jpg')
    assert MAX_PIXELS >= 7680 * 4320, '8K is not a bomb'


def test_only_formats_of_ours_are_tried() -> None:
    """Pillow knows dozens more, some by way of other programs."""
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
    """What its header claims beyond that is an error."""
    assert decode.cloud(pcd()).shape == (2, 4)
    with pytest.raises(LakeError, match='not a PCD'):
        decode.cloud(pcd(**changed))


def sparse_tar() -> bytes:
    """A member of no bytes that says that it is a file of a terabyte with a hole."""
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
    """Robots store what is in it as it is."""
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
    """Both are errors of ours, as are lists of unlike lengths."""
    deep: object = 5
    for _ in range(1000):
        deep = {'a': deep}
    for samples in ([{'stamp_ns': 1, 'deep': deep}], [{'stamp_ns': 1, 'x': [1, 2]}, {'stamp_ns': 2, 'x': [1]}]):
        with pytest.raises(LakeError):
            table(samples, 'a/msg/B', (), 0)  # type: ignore[arg-type]
    with pytest.raises(LakeError, match='are not read'):
        decode.records(b' ' * (33 << 20))


def test_at_most_the_size_in_the_row_is_read() -> None:
    """And none that is larger than any that is decoded."""
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
    """A data set would have as many samples."""
    from hostile import bad_parts

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


def test_documents_have_an_end() -> None:
    """Of those who read them any depth, size or number of values is an error in a second."""
    for content in (b'[' * 200_000, b' ' * (17 << 20)):
        with pytest.raises(ValueError, match=r'deep|not read'):
            from_json(content)
    for text in ('[' * 200_000, '- ' * 100_000, ' ' * (5 << 20), 'a: &b [1]\nc: *b', '[' + 'a,' * 300 + ']' * 50):
        with pytest.raises(ValueError, match=r'.'):
            from_yaml(text)
    with pytest.raises(ValueError, match='is not supported'):
        decompress('brotli', b'', 5)
