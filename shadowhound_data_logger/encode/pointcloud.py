"""PointCloud2 to binary PCD v0.7 with every field, bit for bit.

Source of the format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html. Fields keep the cloud's order,
names and types. Padding between them is left out (a PCD has no place for bytes without a name; fields called ``_`` are padding by
PCL's convention and are left out too), big-endian values are swapped, NaN points stay, organized clouds stay organized.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from shadowhound_data_logger.encode.payload import Fact, Job, Payload
from shadowhound_data_logger.encode.statistics import ALL, MOST_FIELDS, NONE, Statistic, of_number, of_whole, packed
from shadowhound_data_logger.errors import Rejected
from shadowhound_data_logger.model import Sample
from shadowhound_data_logger.options import ARCHIVES, POINT_CLOUD

if TYPE_CHECKING:
    from numpy.typing import NDArray

_DATATYPES: Final = {1: ('I', 1), 2: ('U', 1), 3: ('I', 2), 4: ('U', 2), 5: ('I', 4), 6: ('U', 4), 7: ('F', 4), 8: ('F', 8)}
"""sensor_msgs/msg/PointField.datatype -> PCD TYPE and SIZE (bytes)."""
_NAME = re.compile(r'[!-~]{1,64}')
"""PCD separates names by white space; everything that is printable ASCII is safe in a header."""
_PADDING: Final = '_'


@dataclass(frozen=True, slots=True)
class _Field:
    """One field of every point: ``count`` values of ``size`` bytes each, from byte ``offset`` of the point on."""

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

    Raises Rejected: ``wrong_type``, ``unknown_type``, ``malformed`` (fields that overlap, leave the point, have no usable
    name or type), ``empty`` (no points), ``size_mismatch`` (width, height, steps and data contradict each other).
    """
    if job.batch.type != POINT_CLOUD:
        raise Rejected('wrong_type', f'{job.batch.type} is not a point cloud')
    cloud = job.types.deserialize(POINT_CLOUD, memoryview(sample.cdr))
    if not cloud.width or not cloud.height:
        raise Rejected('empty', f'{cloud.width} x {cloud.height} points')
    row_step = _row_step(cloud)
    fields = _fields(cloud)
    points = _points(cloud, fields, row_step)
    body = b''.join((_header(cloud, fields, sample.stamp_ns), points.data))
    facts: dict[str, Fact] = {'points': cloud.width * cloud.height, 'is_dense': bool(cloud.is_dense)}
    is_asked = job.sensor.statistics != (NONE,) and job.sensor.format not in ARCHIVES
    layout = [(field.name, field.format('<')) for field in fields]
    found = packed(of_points(points.reshape(-1).view(layout))) if is_asked else b''
    return Payload(body, (sample,), 'pcd', 'application/octet-stream', facts, found)


def of_points(points: Any) -> dict[str, Statistic]:
    """Of a structured array of points: their number, and each field of one value a point. There is no mean."""
    found = {ALL: of_whole(1), 'points': of_number(len(points))}
    for name in (points.dtype.names or ())[: MOST_FIELDS - 1]:
        values = points[name]
        if values.ndim != 1:
            continue
        with np.errstate(invalid='ignore'):  # a NaN may be of a kind that signals
            whole = np.asarray(values, np.float64)
        present = whole[np.isfinite(whole)]
        missing = len(whole) - len(present)
        ends = (present[0], present[-1], present.min(), present.max()) if len(present) else (None,) * 4
        first, last, least, greatest = (None if one is None else float(one) for one in ends)
        found[name] = Statistic(first, last, least, greatest, None, len(present), missing)
    return found


def _row_step(cloud: Any) -> int:
    """Bytes from one row to the next; a single row without padding needs no valid ``row_step``, as for PCL and RViz."""
    row = cloud.width * cloud.point_step
    if cloud.height == 1 and row and cloud.data.size == row:
        return int(row)
    if not row or cloud.row_step < row or cloud.data.size != cloud.row_step * cloud.height:
        layout = f'{cloud.width} x {cloud.height} points of {cloud.point_step} bytes, row step {cloud.row_step}'
        raise Rejected('size_mismatch', f'{layout}, {cloud.data.size} bytes of data')
    return int(cloud.row_step)


def _fields(cloud: Any) -> tuple[_Field, ...]:
    fields = []
    for given in cloud.fields:
        if given.name == _PADDING:
            continue
        if not _NAME.fullmatch(given.name):
            raise Rejected('malformed', f'field name {given.name[:80]!r}')
        if given.datatype not in _DATATYPES:
            raise Rejected('malformed', f'field {given.name} has the unknown datatype {given.datatype}')
        kind, size = _DATATYPES[given.datatype]
        # PCL reads a count of 0 as 1: older converters never set it.
        fields.append(_Field(given.name, kind, size, given.count or 1, given.offset))
    _check_layout(fields, cloud.point_step)
    return tuple(fields)


def _check_layout(fields: Sequence[_Field], point_step: int) -> None:
    if not fields or len({field.name for field in fields}) != len(fields):
        raise Rejected('malformed', 'no fields, or two of one name')
    end = 0
    for field in sorted(fields, key=lambda field: field.offset):
        if field.offset < end:
            raise Rejected('malformed', f'field {field.name} overlaps the one before it')
        end = field.offset + field.bytes
        if end > point_step:
            raise Rejected('malformed', f'field {field.name} ends at byte {end} of a point of {point_step}')


def _points(cloud: Any, fields: Sequence[_Field], row_step: int) -> NDArray[np.uint8]:
    """The points as PCD wants them: packed, little-endian, row after row. Untouched where they already are."""
    packed = list(accumulate((field.bytes for field in fields), initial=0))
    as_is = packed == [*(field.offset for field in fields), cloud.point_step] and row_step == cloud.width * cloud.point_step
    if as_is and not cloud.is_bigendian:
        return cloud.data  # type: ignore[no-any-return]
    keys = [str(index) for index in range(len(fields))]
    order = '>' if cloud.is_bigendian else '<'
    formats, offsets = [field.format(order) for field in fields], [field.offset for field in fields]
    layout: Any = {'names': keys, 'formats': formats, 'offsets': offsets}
    source: NDArray[Any] = np.ndarray(
        (cloud.height, cloud.width), np.dtype(layout), buffer=cloud.data, strides=(row_step, cloud.point_step)
    )
    target = np.empty(source.shape, np.dtype([(key, field.format('<')) for key, field in zip(keys, fields, strict=True)]))
    for key in keys:
        target[key] = source[key]
    return target.reshape(-1).view(np.uint8)


def _header(cloud: Any, fields: Sequence[_Field], stamp_ns: int) -> bytes:
    """The header, with what PCD has no entry for in a comment: readers skip lines that begin with ``#``."""
    frame_id = ascii(cloud.header.frame_id[:80])
    lines = (
        '# .PCD v0.7 - Point Cloud Data file format',
        f'# stamp_ns {stamp_ns} frame_id {frame_id} is_dense {str(bool(cloud.is_dense)).lower()}',
        'VERSION 0.7',
        'FIELDS ' + ' '.join(field.name for field in fields),
        'SIZE ' + ' '.join(str(field.size) for field in fields),
        'TYPE ' + ' '.join(field.kind for field in fields),
        'COUNT ' + ' '.join(str(field.count) for field in fields),
        f'WIDTH {cloud.width}',
        f'HEIGHT {cloud.height}',
        'VIEWPOINT 0 0 0 1 0 0 0',
        f'POINTS {cloud.width * cloud.height}',
        'DATA binary',
    )
    return ('\n'.join(lines) + '\n').encode('ascii')
