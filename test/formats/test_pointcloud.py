"""Point clouds in PCD are read back by an independent reader (pypcd4), bit for bit, however the cloud was laid out."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from profiles import examples
from pypcd4.pypcd4 import PointCloud

from shadowhound_data_logger.formats.pointcloud import xyz_of
from shadowhound_data_logger.formats.statistics import ALL, unpack_statistics
from shadowhound_data_logger.lake.values import statistics_of

CLOUD = 'sensor_msgs/msg/PointCloud2'
FIELD = 'sensor_msgs/msg/PointField'
FORMATS = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
XYZI = [('x', 0, 7, 1), ('y', 4, 7, 1), ('z', 8, 7, 1), ('intensity', 12, 7, 1)]


def cloud(ros: Any, fields: Any, data: bytes, *, little_endian: bool = True, **values: Any) -> bytes:
    """The CDR of a cloud; ``fields`` are (name, offset, datatype, count)."""
    described = [ros.make(FIELD, **dict(zip(('name', 'offset', 'datatype', 'count'), field, strict=True))) for field in fields]
    row_step = values['width'] * values['point_step']
    values = {'height': 1, 'row_step': row_step, 'is_dense': True, 'header': {'frame_id': 'odom'}} | values
    made = ros.make(CLOUD, fields=described, data=np.frombuffer(data, np.uint8), **values)
    return bytes(ros.cdr(CLOUD, made, little_endian=little_endian))


def xyzi(count: int = 5) -> Any:
    points = np.random.default_rng(3).normal(size=(count, 4)).astype('<f4')
    points[0, 2] = np.nan
    return points


def read(body: bytes) -> Any:
    return PointCloud.from_fileobj(io.BufferedReader(io.BytesIO(body)))


def header(body: bytes) -> dict[str, str]:
    text = body[: body.index(b'DATA binary\n') + 12].decode('ascii')
    return dict(line.split(' ', 1) for line in text.splitlines() if not line.startswith('#'))


def test_a_cloud_is_stored_as_pcd(ros: Any) -> None:
    """The header follows PCD v0.7, the points are the cloud's own bytes, NaN among them."""
    points = xyzi()
    result = ros.encode(CLOUD, cloud(ros, XYZI, points.tobytes(), width=5, point_step=16))
    body = result.object.body
    assert body.endswith(b'DATA binary\n' + points.tobytes())
    assert header(body) == {
        'VERSION': '0.7', 'FIELDS': 'x y z intensity', 'SIZE': '4 4 4 4', 'TYPE': 'F F F F', 'COUNT': '1 1 1 1', 'WIDTH': '5',
        'HEIGHT': '1', 'VIEWPOINT': '0 0 0 1 0 0 0', 'POINTS': '5', 'DATA': 'binary',
    }  # fmt: skip
    assert read(body).numpy().tobytes() == points.tobytes()
    assert result.object.key == 'thor/lidar/20251018/120000_scan.pcd'
    assert (result.object.metadata['points'], result.object.metadata['is_dense']) == ('5', 'true')


def test_padding_is_removed(ros: Any) -> None:
    """PCL's usual layout (x y z, four bytes of nothing, intensity, twelve of nothing) is packed."""
    padded = np.full((4, 32), 0xEE, np.uint8)
    points = xyzi(4)
    padded[:, :12] = points[:, :3].view(np.uint8)
    padded[:, 16:20] = points[:, 3:].copy().view(np.uint8)
    fields = [('x', 0, 7, 1), ('y', 4, 7, 1), ('z', 8, 7, 1), ('intensity', 16, 7, 1)]
    body = ros.encode(CLOUD, cloud(ros, fields, padded.tobytes(), width=4, point_step=32)).object.body
    assert body.endswith(b'binary\n' + points.tobytes())


def test_padded_rows_of_an_organized_cloud_are_removed(ros: Any) -> None:
    """Width and height survive, and the bytes at the end of each row do not get between the points."""
    points = xyzi(6).reshape(2, 3, 4)
    rows = np.hstack((points.reshape(2, -1).view(np.uint8), np.full((2, 8), 7, np.uint8)))
    body = ros.encode(CLOUD, cloud(ros, XYZI, rows.tobytes(), width=3, height=2, point_step=16, row_step=56)).object.body
    assert (header(body)['WIDTH'], header(body)['HEIGHT'], header(body)['POINTS']) == ('3', '2', '6')
    assert body.endswith(b'binary\n' + points.tobytes())


@pytest.mark.parametrize('little_endian_cdr', [True, False])
def test_big_endian_points_are_swapped(ros: Any, little_endian_cdr: bool) -> None:
    """Values of a big-endian cloud are swapped, whichever endianness the message around them has."""
    points = xyzi()
    data = points.astype('>f4').tobytes()
    cdr = cloud(ros, XYZI, data, width=5, point_step=16, is_bigendian=True, little_endian=little_endian_cdr)
    assert ros.encode(CLOUD, cdr).object.body.endswith(b'binary\n' + points.tobytes())


def test_fields_keep_the_order_of_their_names(ros: Any) -> None:
    """Fields keep the order in which the cloud names them, even where their offsets go the other way."""
    fields = [('b', 4, 7, 1), ('a', 0, 6, 1)]
    data = np.array([(1, 2.5), (3, 4.5)], [('a', '<u4'), ('b', '<f4')])
    points = read(ros.encode(CLOUD, cloud(ros, fields, data.tobytes(), width=2, point_step=8)).object.body)
    assert points.fields == ('b', 'a')
    assert points.pc_data['b'].tolist() == [2.5, 4.5]
    assert points.pc_data['a'].tolist() == [1, 3]


def test_packed_color_keeps_its_bits(ros: Any) -> None:
    """``rgb`` packed into a float is copied as bits: a signalling NaN in it stays what it is, padding or not."""
    data = np.array([(1, 0x7F812345), (2, 0xFFA00001)], '<u4')
    for point_step, extra in ((8, 0), (12, 4)):
        rows = np.hstack((data.view(np.uint8).reshape(2, 8), np.zeros((2, extra), np.uint8)))
        fields = [('x', 0, 7, 1), ('rgb', 4, 7, 1)]
        for big in (False, True):
            sent = rows.reshape(2, -1, 4)[:, :, ::-1] if big else rows
            cdr = cloud(ros, fields, sent.tobytes(), width=2, point_step=point_step, is_bigendian=big)
            assert ros.encode(CLOUD, cdr).object.body.endswith(b'binary\n' + data.tobytes())


def test_metadata_that_pcd_cannot_hold_is_in_a_comment(ros: Any) -> None:
    """Stamp, frame and density are in a comment line, and a hostile frame_id cannot break out of it."""
    frame = 'odom\nPOINTS 9\r\n"é' + 'x' * 500
    cdr = cloud(ros, XYZI, xyzi().tobytes(), width=5, point_step=16, header={'frame_id': frame}, is_dense=False)
    body = ros.encode(CLOUD, cdr).object.body
    comment = body.splitlines()[1].decode('ascii')
    assert comment.startswith("# stamp_ns 1760788800250000000 frame_id '")
    assert comment.endswith('is_dense false')
    assert header(body)['POINTS'] == '5'
    assert read(body).points == 5


def test_underscore_fields_are_padding(ros: Any) -> None:
    """Fields called ``_`` are padding by PCL's convention and are skipped, also if there are several."""
    fields = [('_', 0, 2, 4), ('x', 4, 7, 1), ('_', 8, 2, 4)]
    data = np.array([(9, 1.5, 9)], [('a', '<u4'), ('x', '<f4'), ('b', '<u4')])
    body = ros.encode(CLOUD, cloud(ros, fields, data.tobytes(), width=1, point_step=12)).object.body
    assert header(body)['FIELDS'] == 'x'
    assert body.endswith(b'binary\n' + np.float32(1.5).tobytes())


def test_a_count_of_zero_is_one(ros: Any) -> None:
    """Old converters never set the count: PCL reads 0 as 1, and so do we."""
    fields = [(name, offset, datatype, 0) for name, offset, datatype, _ in XYZI]
    body = ros.encode(CLOUD, cloud(ros, fields, xyzi().tobytes(), width=5, point_step=16)).object.body
    assert header(body)['COUNT'] == '1 1 1 1'


def test_a_single_row_needs_no_row_step(ros: Any) -> None:
    """Sloppy drivers leave row_step unset for unorganized clouds; width, point_step and data say enough."""
    cdr = cloud(ros, XYZI, xyzi().tobytes(), width=5, point_step=16, row_step=0)
    assert ros.encode(CLOUD, cdr).object.body.endswith(xyzi().tobytes())


@pytest.mark.parametrize('big', [False, True])
@pytest.mark.parametrize(('shape', 'corrected'), [
    ({'width': 3, 'height': 2, 'row_step': 48}, ''), ({'width': 3, 'height': 2, 'row_step': 0}, 'row_step'),
    ({'width': 3, 'height': 2, 'row_step': 96}, 'row_step'), ({'width': 3, 'height': 2, 'row_step': 3}, 'row_step'),
    ({'width': 3, 'height': 2, 'row_step': 16}, 'row_step'), ({'width': 3, 'height': 2, 'row_step': 2**32 - 1}, 'row_step'),
    ({'width': 6, 'height': 1, 'row_step': 0}, 'row_step'), ({'width': 6, 'height': 0, 'row_step': 96}, 'height'),
    ({'width': 6, 'height': 0, 'row_step': 0}, 'height'), ({'width': 0, 'height': 6, 'row_step': 0}, 'width'),
])  # fmt: skip
def test_an_unambiguous_size_is_corrected_and_counted(ros: Any, shape: dict[str, Any], corrected: str, *, big: bool) -> None:
    """Where width, height and point_step account for every byte, the cloud is stored as those say, and counted as corrected."""
    points = xyzi(6)
    sent = points.astype('>f4' if big else '<f4').tobytes()
    made = ros.encode(CLOUD, cloud(ros, XYZI, sent, point_step=16, is_bigendian=big, **shape))
    assert (made.rejected, made.corrected) == ({}, {corrected: 1} if corrected else {})
    assert made.object.body.endswith(b'binary\n' + points.tobytes())
    organized = ('3', '2') if shape['width'] == 3 else ('6', '1')
    assert (header(made.object.body)['WIDTH'], header(made.object.body)['HEIGHT']) == organized
    assert made.object.metadata.get('corrected', '') == corrected


def test_the_last_row_may_lack_its_padding(ros: Any) -> None:
    """Rows of a padded cloud are read by row_step, also if the padding of the last one was not sent."""
    points = xyzi(6).reshape(2, 3, 4)
    rows = np.hstack((points.reshape(2, -1).view(np.uint8), np.full((2, 8), 7, np.uint8))).tobytes()
    made = ros.encode(CLOUD, cloud(ros, XYZI, rows[:-8], width=3, height=2, point_step=16, row_step=56))
    assert made.corrected == {'last_row': 1}
    assert made.object.body.endswith(b'binary\n' + points.tobytes())


@pytest.mark.parametrize('layout', ['packed', 'no row_step', 'padded'])
def test_padded_points_of_an_organized_cloud_are_read(ros: Any, layout: str) -> None:
    """Points with bytes between their fields, NaN among them, come out the same whatever row_step says."""
    kind = np.dtype(
        {'names': ['x', 'y', 'z', 'ring'], 'formats': ['<f4', '<f4', '<f4', '<u2'], 'offsets': [0, 4, 8, 20], 'itemsize': 32}
    )
    points = np.zeros((4, 5), kind)
    points['x'], points['ring'] = np.arange(20).reshape(4, 5), np.arange(20, 40).reshape(4, 5)
    points['z'][1, 2] = np.nan
    pad = 12 if layout == 'padded' else 0
    rows = np.hstack((points.view(np.uint8).reshape(4, -1), np.full((4, pad), 9, np.uint8)))
    fields = [('x', 0, 7, 1), ('y', 4, 7, 1), ('z', 8, 7, 1), ('ring', 20, 4, 1)]
    row_step = {'packed': 160, 'no row_step': 0, 'padded': 172}[layout]
    made = ros.encode(
        CLOUD, cloud(ros, fields, rows.tobytes(), width=5, height=4, point_step=32, row_step=row_step, is_dense=False)
    )
    found = read(made.object.body)
    assert (found.metadata.width, found.metadata.height) == (5, 4)
    assert found.pc_data['ring'].tolist() == list(range(20, 40))
    assert np.isnan(found.pc_data['z'][7])
    assert made.object.metadata['is_dense'] == 'false'


@pytest.mark.parametrize('shape', [{'width': 0, 'height': 0}, {'width': 0, 'height': 1}, {'width': 7, 'height': 0}])
def test_a_cloud_without_points_is_stored(ros: Any, shape: dict[str, int]) -> None:
    """An empty cloud says that nothing was seen: it is a PCD without points."""
    made = ros.encode(CLOUD, cloud(ros, XYZI, b'', point_step=16, **shape))
    assert (made.rejected, made.corrected, made.object.metadata['points']) == ({}, {}, '0')
    assert (read(made.object.body).points, header(made.object.body)['POINTS']) == (0, '0')
    assert statistics_of(made.object.key, made.object.body) == unpack_statistics(made.object.statistics)


def test_overlapping_fields_are_all_stored(ros: Any) -> None:
    """Each of them is stored, as for a color that is named as a whole and by its bytes."""
    fields = [('x', 0, 7, 1), ('rgb', 4, 7, 1), ('b', 4, 2, 1), ('g', 5, 2, 1), ('r', 6, 2, 1)]
    data = np.float32(1.5).tobytes() + bytes([1, 2, 3, 0])
    found = read(ros.encode(CLOUD, cloud(ros, fields, data, width=1, point_step=8)).object.body).pc_data
    assert [found[name][0] for name in 'xrgb'] == [1.5, 3, 2, 1]
    assert found['rgb'].tobytes() == bytes([1, 2, 3, 0])


@pytest.mark.parametrize('fields', [
    [], [('_', 0, 7, 1)], [('x', 0, 7, 1), ('x', 4, 7, 1)], [('x', 0, 0, 1)], [('x', 0, 9, 1)], [('a b', 0, 7, 1)],
    [('x\nPOINTS 1', 0, 7, 1)], [('', 0, 7, 1)], [('höhe', 0, 7, 1)], [('x' * 65, 0, 7, 1)],
    [(f'x{number}', 0, 7, 4) for number in range(5)],
], ids=str)  # fmt: skip
def test_fields_that_pcd_cannot_hold_are_rejected(ros: Any, fields: list[Any]) -> None:
    """The message is stored as it was serialized, and its metadata says why."""
    cdr = cloud(ros, fields, xyzi().tobytes(), width=5, point_step=16)
    made = ros.encode(CLOUD, cdr)
    assert made.rejected == {}
    assert (made.object.body, made.object.key) == (cdr, 'thor/lidar/20251018/120000_scan.cdr')
    assert (made.object.metadata['verbatim'], made.object.metadata['points']) == ('unsupported_fields', '5')


@pytest.mark.parametrize(
    ('changes', 'reason'),
    [
        ({'width': 0, 'height': 0}, 'size_mismatch'),
        ({'width': 4, 'height': 0}, 'size_mismatch'),
        ({'width': 0}, 'size_mismatch'),
        ({'width': 6}, 'size_mismatch'),
        ({'width': 4}, 'size_mismatch'),
        ({'width': 2**32 - 1, 'height': 2**32 - 1, 'row_step': 80}, 'size_mismatch'),
        ({'point_step': 0}, 'size_mismatch'),
        ({'point_step': 15}, 'size_mismatch'),
        ({'height': 4, 'width': 1, 'row_step': 19, 'point_step': 17}, 'size_mismatch'),
        ({'height': 4, 'width': 1, 'row_step': 21}, 'size_mismatch'),
        ({'data': xyzi().tobytes() + b'x'}, 'size_mismatch'),
        ({'data': xyzi().tobytes()[:-1]}, 'size_mismatch'),
        ({'data': b''}, 'size_mismatch'),
        ({'fields': [('x', 13, 7, 1)]}, 'malformed'),
        ({'fields': [('x', 2**32 - 1, 8, 2**32 - 1)]}, 'malformed'),
        ({'fields': [('x', 0, 7, 5)]}, 'malformed'),
    ],
)
def test_clouds_with_false_sizes_are_rejected(ros: Any, changes: dict[str, Any], reason: str) -> None:
    """Sizes that contradict each other and fields that end outside the point are rejected, by reason."""
    values = {'fields': XYZI, 'data': xyzi().tobytes(), 'width': 5, 'point_step': 16} | changes
    result = ros.encode(CLOUD, cloud(ros, values.pop('fields'), values.pop('data'), **values))
    assert result.object is None
    assert result.rejected == {reason: 1}


@settings(derandomize=True, deadline=None, max_examples=examples(120))
@given(data=st.data())
def test_any_layout_reads_back(ros: Any, data: st.DataObject) -> None:
    """Any mix of datatypes, counts, gaps, order of fields, row padding and byte order reads back bit for bit."""
    shape = st.tuples(st.sampled_from(sorted(FORMATS)), st.integers(1, 3), st.integers(0, 5))
    columns = data.draw(st.lists(shape, min_size=1, max_size=6))
    width, height, row_pad = data.draw(st.tuples(st.integers(1, 4), st.integers(1, 3), st.integers(0, 9)))
    big, tail, seed = data.draw(st.tuples(st.booleans(), st.integers(0, 5), st.integers(0, 2**32 - 1)))
    fields, end = [], 0
    for index, (datatype, count, gap) in enumerate(columns):
        fields.append((f'f{index}', end + gap, datatype, count))
        end += gap + count * np.dtype(FORMATS[datatype]).itemsize
    point_step = end + tail
    row_step = width * point_step + row_pad
    sent = np.random.default_rng(seed).integers(0, 256, (height, row_step), np.uint8)
    fields = data.draw(st.permutations(fields))
    size: dict[str, Any] = {'width': width, 'height': height, 'point_step': point_step, 'row_step': row_step}
    cdr = cloud(ros, fields, sent.tobytes(), is_bigendian=big, **size)
    points = read(ros.encode(CLOUD, cdr).object.body)
    each = sent[:, : width * point_step].reshape(-1, point_step)
    assert (points.metadata.width, points.metadata.height, points.points) == (width, height, width * height)
    assert points.metadata.count == tuple(count for _, _, _, count in fields)
    for name, offset, datatype, count in fields:
        kind = np.dtype(FORMATS[datatype])
        raw = each[:, offset : offset + count * kind.itemsize].reshape(width * height, count, kind.itemsize)
        expected = raw[:, :, ::-1] if big else raw
        names = [name] if count == 1 else [f'{name}__{index:04d}' for index in range(count)]
        for index, column in enumerate(names):
            assert points.pc_data[column].dtype == kind
            assert points.pc_data[column].tobytes() == expected[:, index].tobytes()


def test_a_cloud_has_its_number_of_points_and_their_bounds(ros: Any) -> None:
    """Field by field, with the count of non-finite values; a reader of the object computes the same."""
    points = xyzi()
    made = ros.encode(CLOUD, cloud(ros, XYZI, points.tobytes(), width=5, point_step=16)).object
    report = unpack_statistics(made.statistics)
    assert report == statistics_of(made.key, made.body)
    assert (set(report), report['points'].max) == ({ALL, 'points', 'x', 'y', 'z', 'intensity'}, 5)
    assert (report['x'].min, report['x'].max, report['x'].count) == (points[:, 0].min(), points[:, 0].max(), 5)
    assert (report['z'].first, report['z'].count, report['z'].nan_count) == (points[1, 2], 4, 1)


@pytest.mark.parametrize('big', [False, True])
@pytest.mark.parametrize(('row_step', 'pad'), [(48, 0), (0, 0), (96, 0), (60, 12)])
def test_positions_of_points_are_read(ros: Any, row_step: int, pad: int, *, big: bool) -> None:
    """x, y and z are those of the PCD, whatever the rows are like; every so many of them if asked for."""
    points = xyzi(6)
    rows = np.hstack((points.astype('>f4' if big else '<f4').view(np.uint8).reshape(2, -1), np.full((2, pad), 9, np.uint8)))
    cdr = cloud(ros, XYZI, rows.tobytes(), width=3, height=2, point_step=16, row_step=row_step, is_bigendian=big)
    message = ros.types.deserialize(CLOUD, cdr)
    for every in (1, 2, 4):
        np.testing.assert_array_equal(xyz_of(message, every), points[::every, :3])


@pytest.mark.parametrize('changes', [{'width': 6}, {'fields': XYZI[:2]}, {'fields': [*XYZI[:2], ('z', 8, 8, 1)]},
                                     {'fields': [*XYZI[:2], ('z', 13, 7, 1)]}])  # fmt: skip
def test_a_cloud_without_xyz_has_no_positions(ros: Any, changes: dict[str, Any]) -> None:
    """A contradictory cloud, or one without x, y and z as float32, has none."""
    values = {'fields': XYZI, 'width': 5, 'point_step': 16} | changes
    message = ros.types.deserialize(CLOUD, cloud(ros, values.pop('fields'), xyzi().tobytes(), **values))
    assert xyz_of(message) is None
