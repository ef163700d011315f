"""Converts PointCloud2 to binary PCD v0.7 with every field, bit for bit.

Source of the format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html. Fields keep the cloud's order, names
and types. Padding is omitted: a PCD has no place for bytes without a name, and PCL treats fields named ``_`` as padding.
Big-endian values are swapped, NaN points are kept, organized clouds stay organized. A cloud with fields that a PCD header cannot
describe is stored as CDR.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.core.model import Sample
from shadowhound_data_logger.core.options import ARCHIVES, POINT_CLOUD
from shadowhound_data_logger.formats.payload import Fact, Job, Payload, verbatim
from shadowhound_data_logger.formats.statistics import ALL, MAX_FIELDS, NONE, Statistic, object_row, pack_statistics, single_value

if TYPE_CHECKING:
    from numpy.typing import NDArray

_DATATYPES: Final = {1: ('I', 1), 2: ('U', 1), 3: ('I', 2), 4: ('U', 2), 5: ('I', 4), 6: ('U', 4), 7: ('F', 4), 8: ('F', 8)}
"""sensor_msgs/msg/PointField.datatype -> PCD TYPE and SIZE (bytes)."""
_NAME = re.compile(r'[!-~]{1,64}')
"""PCD separates names by white space; other printable ASCII is safe in a header."""
_PADDING: Final = '_'
_FLOAT32: Final = 7
_MAX_OVERLAP: Final = 4
"""Fields may overlap (``rgb`` and its bytes ``r`` ``g`` ``b``), each stored in full, up to this many times the point's size."""


class CloudShape(NamedTuple):
    """The layout of the points in a cloud's data."""

    width: int
    height: int
    row_step: int
    """Bytes from one row to the next."""
    corrected: str = ''
    """The field of the message that contradicted its data and was corrected; empty if there is none."""


@dataclass(frozen=True, slots=True)
class _Field:
    """One field of every point: ``count`` values of ``size`` bytes each, starting at byte ``offset`` of the point."""

    name: str
    kind: str
    size: int
    count: int
    offset: int

    @property
    def bytes(self) -> int:
        return self.size * self.count

    def format(self, order: str) -> str:
        """The numpy format, such as ``3<f4``."""
        return f'{self.count if self.count > 1 else ""}{order}{self.kind.lower()}{self.size}'


def encode_cloud(job: Job, sample: Sample) -> Payload:
    """The PCD of one PointCloud2.

    Raises Rejected: ``wrong_type``, ``unknown_type``, ``malformed`` (a field ends outside the point), ``size_mismatch`` (width,
    height, steps and data are inconsistent).
    """
    if job.batch.type != POINT_CLOUD:
        raise Rejected('wrong_type', f'{job.batch.type} is not a point cloud')
    cloud = job.types.deserialize(POINT_CLOUD, memoryview(sample.cdr))
    shape = shape_of(cloud)
    facts: dict[str, Fact] = {'points': shape.width * shape.height, 'is_dense': bool(cloud.is_dense)}
    if shape.corrected:
        facts['corrected'] = shape.corrected
    fields = _fields(cloud)
    if not fields:
        return verbatim(sample, 'unsupported_fields', facts, shape.corrected)
    points = _points(cloud, fields, shape)
    body = b''.join((_header(cloud, shape, fields, sample.stamp_ns), points.data))
    wants_statistics = job.sensor.statistics != (NONE,) and job.sensor.format not in ARCHIVES
    layout = [(field.name, field.format('<')) for field in fields]
    found = pack_statistics(point_statistics(points.reshape(-1).view(layout))) if wants_statistics else b''
    return Payload(body, (sample,), 'pcd', 'application/octet-stream', facts, found, shape.corrected)


def point_statistics(points: Any) -> dict[str, Statistic]:
    """Statistics, without means, of a structured array of points: their number, and each field with one value per point."""
    found = {ALL: object_row(1), 'points': single_value(len(points))}
    for name in (points.dtype.names or ())[: MAX_FIELDS - 1]:
        values = points[name]
        if values.ndim != 1:
            continue
        with np.errstate(invalid='ignore'):  # a signaling NaN would warn
            numbers = np.asarray(values, np.float64)
        finite = numbers[np.isfinite(numbers)]
        edges = (finite[0], finite[-1], finite.min(), finite.max()) if len(finite) else (None,) * 4
        first, last, minimum, maximum = (None if one is None else float(one) for one in edges)
        found[name] = Statistic(first, last, minimum, maximum, None, len(finite), len(numbers) - len(finite))
    return found


def shape_of(cloud: Any) -> CloudShape:
    """Rows, columns and step of a PointCloud2, corrected if its data allow only one reading.

    Some drivers set ``row_step`` to 0 or to that of the flat cloud, set ``height`` to 0, or omit the padding of the last row.
    Raises Rejected: ``size_mismatch``.
    """
    width, height, size = int(cloud.width), int(cloud.height), int(cloud.data.size)
    corrected = ''
    if not (width and height):
        if not size:
            return CloudShape(0, 1, 0)
        width, height, corrected = max(width, height), 1, 'height' if width else 'width'
    row = width * cloud.point_step
    if row and not corrected and cloud.row_step >= row and size == cloud.row_step * height:
        return CloudShape(width, height, int(cloud.row_step))
    if row and size == row * height:
        return CloudShape(width, height, row, corrected or 'row_step')
    if row and not corrected and cloud.row_step > row and size == cloud.row_step * (height - 1) + row:
        return CloudShape(width, height, int(cloud.row_step), 'last_row')
    layout = f'{cloud.width} x {cloud.height} points of {cloud.point_step} bytes, row step {cloud.row_step}'
    raise Rejected('size_mismatch', f'{layout}, {size} bytes of data')


def xyz_of(cloud: Any, every: int = 1) -> NDArray[np.float32] | None:
    """x, y and z of every ``every``-th point, points x 3; None if they are not float32, or the cloud is inconsistent."""
    offsets = {field.name: field.offset for field in cloud.fields if field.datatype == _FLOAT32}
    names = ['x', 'y', 'z']
    if not offsets.keys() >= {*names} or max(offsets[name] for name in names) + 4 > cloud.point_step:
        return None
    try:
        shape = shape_of(cloud)
    except Rejected:
        return None
    if not shape.width:
        return np.zeros((0, 3), np.float32)
    kind = '>f4' if cloud.is_bigendian else '<f4'
    layout: Any = {'names': names, 'formats': [kind] * 3, 'offsets': [offsets[name] for name in names]}
    points: NDArray[Any] = np.ndarray(
        (shape.height, shape.width), np.dtype(layout), buffer=cloud.data, strides=(shape.row_step, cloud.point_step)
    )
    flat = points.reshape(-1)[::every]
    columns: NDArray[np.float32] = np.empty((3, len(flat)), np.float32)  # numpy is ten times as fast along contiguous columns
    for column, name in zip(columns, names, strict=True):
        column[:] = flat[name]
    table: NDArray[np.float32] = columns.T
    return table


def _fields(cloud: Any) -> tuple[_Field, ...]:
    """The fields of a point for a PCD header; () if it cannot describe them. Raises Rejected: ``malformed``."""
    fields = []
    for given in cloud.fields:
        if given.name == _PADDING:
            continue
        if not _NAME.fullmatch(given.name) or given.datatype not in _DATATYPES:
            return ()
        kind, size = _DATATYPES[given.datatype]
        # PCL reads a count of 0 as 1: older converters never set it.
        field = _Field(given.name, kind, size, given.count or 1, given.offset)
        if (end := field.offset + field.bytes) > cloud.point_step:
            raise Rejected('malformed', f'field {field.name} ends at byte {end} of a point of {cloud.point_step}')
        fields.append(field)
    are_named_twice = len({field.name for field in fields}) != len(fields)
    are_too_many = sum(field.bytes for field in fields) > _MAX_OVERLAP * cloud.point_step
    return () if are_named_twice or are_too_many else tuple(fields)


def _points(cloud: Any, fields: Sequence[_Field], shape: CloudShape) -> NDArray[np.uint8]:
    """The points in PCD's layout: packed, little-endian, row by row. Copied only if necessary."""
    offsets = list(accumulate((field.bytes for field in fields), initial=0))
    are_fields_packed = offsets == [*(field.offset for field in fields), cloud.point_step]
    are_rows_packed = shape.row_step == shape.width * cloud.point_step
    if are_fields_packed and are_rows_packed and not cloud.is_bigendian:
        return cloud.data  # type: ignore[no-any-return]
    keys = [str(index) for index in range(len(fields))]
    order = '>' if cloud.is_bigendian else '<'
    formats, offsets = [field.format(order) for field in fields], [field.offset for field in fields]
    layout: Any = {'names': keys, 'formats': formats, 'offsets': offsets}
    source: NDArray[Any] = np.ndarray(
        (shape.height, shape.width), np.dtype(layout), buffer=cloud.data, strides=(shape.row_step, cloud.point_step)
    )
    target = np.empty(source.shape, np.dtype([(key, field.format('<')) for key, field in zip(keys, fields, strict=True)]))
    for key in keys:
        target[key] = source[key]
    return target.reshape(-1).view(np.uint8)


def _header(cloud: Any, shape: CloudShape, fields: Sequence[_Field], stamp_ns: int) -> bytes:
    """The header; a comment has the facts for which PCD has no entry, because readers skip lines that start with ``#``."""
    frame_id = ascii(cloud.header.frame_id[:80])
    lines = (
        '# .PCD v0.7 - Point Cloud Data file format',
        f'# stamp_ns {stamp_ns} frame_id {frame_id} is_dense {str(bool(cloud.is_dense)).lower()}',
        'VERSION 0.7',
        'FIELDS ' + ' '.join(field.name for field in fields),
        'SIZE ' + ' '.join(str(field.size) for field in fields),
        'TYPE ' + ' '.join(field.kind for field in fields),
        'COUNT ' + ' '.join(str(field.count) for field in fields),
        f'WIDTH {shape.width}',
        f'HEIGHT {shape.height}',
        'VIEWPOINT 0 0 0 1 0 0 0',
        f'POINTS {shape.width * shape.height}',
        'DATA binary',
    )
    return ('\n'.join(lines) + '\n').encode('ascii')
