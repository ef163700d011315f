"""Archives contain every message of a batch as a file and a JSON, named so that WebDataset pairs them."""

from __future__ import annotations

import io
import json
import re
import tarfile
import zipfile
from datetime import datetime, timezone
from typing import Any

import numpy as np
import pytest
import simplejpeg

from shadowhound_data_logger.core.keys import unique
from shadowhound_data_logger.formats.archive import ArchiveFile, pack_tar

COMPRESSED = 'sensor_msgs/msg/CompressedImage'
IMAGE = 'sensor_msgs/msg/Image'
CLOUD = 'sensor_msgs/msg/PointCloud2'
IMU = 'go2_interfaces/msg/IMU'
STAMP_NS = 1_760_788_800_250_000_000
HEADER = {'frame_id': 'front_camera'}
ARCHIVES = pytest.mark.parametrize('format_name', ['zip', 'tar'])
WEBDATASET_NAME = re.compile(r'^((?:.*/|)[^.]+)[.]([^/]*)$')
"""How WebDataset splits a name into the sample's key and the file's kind (webdataset/tariterators.py, base_plus_ext)."""


def members(made: Any) -> dict[str, bytes]:
    """Name -> content, in the order of the archive, read by the standard library."""
    file = io.BytesIO(made.body)
    if made.key.endswith('.zip'):
        with zipfile.ZipFile(file) as packed:
            assert packed.testzip() is None
            return {name: packed.read(name) for name in packed.namelist()}
    with tarfile.open(fileobj=file, mode='r:') as packed:
        found = {entry.name: packed.extractfile(entry) for entry in packed}
        return {name: content.read() for name, content in found.items() if content is not None}


def samples(made: Any) -> dict[str, dict[str, bytes]]:
    """Key -> kind -> content, assembled as WebDataset does: neighbors with the same name up to the first dot."""
    found: dict[str, dict[str, bytes]] = {}
    last = None
    for name, content in members(made).items():
        match = WEBDATASET_NAME.match(name)
        assert match is not None
        key, kind = match.groups()
        assert key == last or key not in found, 'the files of a sample follow each other'
        found.setdefault(key, {})[kind] = content
        last = key
    return found


def jpeg(shade: int) -> bytes:
    return bytes(simplejpeg.encode_jpeg(np.full((4, 6, 3), shade, np.uint8)))


def frame(ros: Any, data: bytes) -> bytes:
    return bytes(ros.cdr(COMPRESSED, header=HEADER, format='jpeg', data=np.frombuffer(data, np.uint8)))


def pack(ros: Any, type_name: str, *cdrs: bytes, format_name: str, **changes: Any) -> Any:
    return ros.encode(type_name, *cdrs, format=format_name, **({'batch_s': 1.0, 'rate_hz': 0.0} | changes))


@ARCHIVES
def test_an_archive_has_each_frame_and_its_description(ros: Any, format_name: str) -> None:
    """Each frame is there byte for byte, and its JSON has time, origin and size."""
    frames = [jpeg(shade) for shade in (10, 100, 200)]
    encoding = pack(ros, COMPRESSED, *(frame(ros, data) for data in frames), format_name=format_name)
    assert encoding.rejected == {}
    made = encoding.object
    assert [list(sample) for sample in samples(made).values()] == [['jpg', 'json']] * 3
    assert [sample['jpg'] for sample in samples(made).values()] == frames
    assert [json.loads(sample['json']) for sample in samples(made).values()] == [
        {'stamp_ns': STAMP_NS + index * 10_000_000, 'frame_id': 'front_camera', 'topic': '/camera', 'type': COMPRESSED,
         'width': 6, 'height': 4}
        for index in range(3)
    ]  # fmt: skip
    assert list(samples(made)) == [str(STAMP_NS + index * 10_000_000) for index in range(3)]


@pytest.mark.parametrize(('format_name', 'content_type'), [('zip', 'application/zip'), ('tar', 'application/x-tar')])
def test_an_archive_is_an_object_of_its_sensor(ros: Any, format_name: str, content_type: str) -> None:
    """The archive has the sensor's key with its own extension, and the metadata of every object."""
    made = pack(ros, COMPRESSED, frame(ros, jpeg(1)), frame(ros, jpeg(2)), format_name=format_name).object
    assert (made.key, made.content_type) == (f'thor/camera/20251018/120000_front.{format_name}', content_type)
    assert (made.samples, made.metadata['count'], made.metadata['t_start_ns']) == (2, '2', str(STAMP_NS))
    assert unique(made.key, 1) == f'thor/camera/20251018/120000_front_1.{format_name}'


@ARCHIVES
def test_each_type_has_its_file_in_the_archive(ros: Any, format_name: str) -> None:
    """Raw images are JPEG or, where they are depth, PNG; clouds are PCD; everything else is CDR, with header or without."""
    pixels = {'height': 2, 'width': 2, 'data': np.zeros(12, np.uint8), 'step': 6, 'header': HEADER}
    field = ros.make('sensor_msgs/msg/PointField', name='x', datatype=7, count=1)
    points = {'height': 1, 'width': 3, 'point_step': 4, 'row_step': 12, 'fields': [field], 'data': np.zeros(12, np.uint8)}
    cdrs = {
        'jpg': (IMAGE, ros.cdr(IMAGE, encoding='bgr8', **pixels)),
        'png': (IMAGE, ros.cdr(IMAGE, encoding='16UC1', **pixels)),
        'pcd': (CLOUD, ros.cdr(CLOUD, **points)),
        'cdr': (IMU, ros.cdr(IMU)),
    }
    described = {}
    for kind, (type_name, cdr) in cdrs.items():
        (sample,) = samples(pack(ros, type_name, cdr, format_name=format_name).object).values()
        assert list(sample) == [kind, 'json']
        assert sample['json'].isascii()
        described[kind] = json.loads(sample['json'])
    assert (described['png']['frame_id'], described['png']['encoding'], described['png']['width']) == ('front_camera', '16UC1', 2)
    assert (described['pcd']['points'], described['pcd']['is_dense']) == (3, False)
    assert 'frame_id' not in described['cdr']
    info = ros.cdr('sensor_msgs/msg/CameraInfo', header={'frame_id': 'ünï'}, little_endian=False)
    (sample,) = samples(pack(ros, 'sensor_msgs/msg/CameraInfo', info, format_name=format_name).object).values()
    assert sample['cdr'] == info
    assert json.loads(sample['json'])['frame_id'] == 'ünï'


@ARCHIVES
def test_files_are_sorted_by_time(ros: Any, format_name: str) -> None:
    """Samples are sorted by time in any order of arrival; of two with one stamp the second is numbered, so that none is lost."""
    stamps = [STAMP_NS + 5, STAMP_NS, STAMP_NS + 5, STAMP_NS + 3, STAMP_NS + 5]
    cdrs = [frame(ros, jpeg(shade)) for shade in range(5)]
    made = pack(ros, COMPRESSED, *cdrs, format_name=format_name, stamps=stamps).object
    found = samples(made)
    assert list(found) == [str(STAMP_NS), str(STAMP_NS + 3), *(f'{STAMP_NS + 5}{tail}' for tail in ('', '_1', '_2'))]
    assert list(found) == sorted(found)
    assert [sample['jpg'] for sample in found.values()] == [jpeg(shade) for shade in (1, 3, 0, 2, 4)]
    assert [json.loads(sample['json'])['stamp_ns'] for sample in found.values()] == sorted(stamps)


@ARCHIVES
def test_bad_messages_are_rejected_and_the_rest_is_archived(ros: Any, format_name: str) -> None:
    """Failed messages are counted by reason and are not in the archive; if none is left there is no archive."""
    good = frame(ros, jpeg(1))
    encoding = pack(ros, COMPRESSED, b'', good, frame(ros, b''), good, format_name=format_name)
    assert encoding.rejected == {'malformed': 1, 'empty': 1}
    assert len(samples(encoding.object)) == encoding.object.samples == 2
    nothing = pack(ros, COMPRESSED, b'', b'', format_name=format_name)
    assert (nothing.object, nothing.rejected) == (None, {'malformed': 2})


@ARCHIVES
@pytest.mark.parametrize('stamp_ns', [-5_000_000_000, 0, STAMP_NS, 2**62])
def test_the_same_batch_gives_the_same_bytes(ros: Any, format_name: str, stamp_ns: int) -> None:
    """An archive only depends on its messages; the files' times are their messages', as far as the format allows."""
    cdrs = [frame(ros, jpeg(shade)) for shade in range(2)]
    made, again = (pack(ros, COMPRESSED, *cdrs, format_name=format_name, stamps=[stamp_ns] * 2).object for _ in range(2))
    assert made.body == again.body
    assert len(samples(made)) == 2
    if stamp_ns != STAMP_NS:
        return
    if format_name == 'zip':
        with zipfile.ZipFile(io.BytesIO(made.body)) as decompress:
            (when,) = {entry.date_time for entry in decompress.infolist()}
        assert when == (2025, 10, 18, 12, 0, 0)
    else:
        with tarfile.open(fileobj=io.BytesIO(made.body)) as packed:
            (mtime,) = {entry.mtime for entry in packed}
        assert datetime.fromtimestamp(mtime, timezone.utc) == datetime(2025, 10, 18, 12, tzinfo=timezone.utc)


def test_the_files_are_plain_files(ros: Any) -> None:
    """A tar is ustar without extensions, a zip is stored and not compressed; both unpack to files that can be read."""
    cdr = frame(ros, jpeg(1))
    tar = pack(ros, COMPRESSED, cdr, format_name='tar').object.body
    assert tar[257:265] == b'ustar\x0000'
    assert len(tar) % 512 == 0
    assert tar.endswith(bytes(1024))
    with tarfile.open(fileobj=io.BytesIO(tar)) as decompress:
        entries = decompress.getmembers()
    assert [(entry.mode, entry.uid, entry.isfile(), entry.pax_headers) for entry in entries] == [(0o644, 0, True, {})] * 2
    with zipfile.ZipFile(io.BytesIO(pack(ros, COMPRESSED, cdr, format_name='zip').object.body)) as packed:
        entries = packed.infolist()
    assert [(entry.compress_type, entry.external_attr >> 16) for entry in entries] == [(zipfile.ZIP_STORED, 0o644)] * 2


@ARCHIVES
def test_equal_frames_are_packed_once(ros: Any, format_name: str) -> None:
    """With ``dedup`` each message keeps its JSON, which names the file that it repeats; a later recurrence is a file."""
    same, other = jpeg(10), jpeg(200)
    frames = [same, same, same, other, same]
    made = pack(ros, COMPRESSED, *(frame(ros, data) for data in frames), format_name=format_name, dedup=True).object
    found = list(samples(made).items())
    assert [sample.get('jpg') for _, sample in found] == [same, None, None, other, same]
    first = f'{found[0][0]}.jpg'
    assert [json.loads(sample['json']).get('repeat_of') for _, sample in found] == [None, first, first, None, None]
    assert (made.samples, made.metadata['repeats']) == (5, '2')
    plain = pack(ros, COMPRESSED, *(frame(ros, data) for data in frames), format_name=format_name).object
    assert [sample['jpg'] for sample in samples(plain).values()] == frames
    assert 'repeats' not in plain.metadata


@pytest.mark.parametrize('stamp_ns', [-1, 0, STAMP_NS, 1 << 62])
@pytest.mark.parametrize('size', [0, 1, 511, 512, 70_000])
def test_a_tar_is_as_the_standard_library_makes_it(stamp_ns: int, size: int) -> None:
    """Byte for byte, for any time and size of a file."""
    body, name = bytes(size), f'{stamp_ns:019d}.jpg'
    expected = io.BytesIO()
    with tarfile.open(fileobj=expected, mode='w', format=tarfile.USTAR_FORMAT) as packed:
        entry = tarfile.TarInfo(name)
        entry.size, entry.mode, entry.mtime = size, 0o644, min(max(stamp_ns // 10**9, 0), 8**11 - 1)
        packed.addfile(entry, io.BytesIO(body))
    made = pack_tar([ArchiveFile(name, stamp_ns, body)])
    assert made == expected.getvalue()[: len(made)]
    assert not any(expected.getvalue()[len(made) :])
