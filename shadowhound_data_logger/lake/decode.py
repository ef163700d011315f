"""Decodes objects to numpy arrays: images, clouds, archives and the numbers in JSON, in the formats of docs/formats.md.

Invalid content raises LakeError. Nothing is unpacked to disk.
"""

from __future__ import annotations

import tarfile
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import orjson
import simplejpeg

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.core.untrusted import MAX_MEMBERS, check_pixels, check_size, limit_depth, open_image
from shadowhound_data_logger.formats.statistics import INFINITE

if TYPE_CHECKING:
    from numpy.typing import NDArray

IMAGES: Final = frozenset({'jpg', 'jpeg', 'png', 'tif', 'tiff'})
CLOUDS: Final = frozenset({'pcd'})
ARCHIVES: Final = frozenset({'tar', 'zip'})
POINT: Final = ('x', 'y', 'z', 'intensity')
_ZIP_ENTRY: Final = b'PK\x01\x02'
_JPEG: Final = b'\xff\xd8'
_DATA: Final = b'\nDATA '
_MAX_HEADER: Final = 1 << 16
_MAX_POINTS: Final = 1 << 22
"""Per cloud; the Go2's lidar has about 20,000."""
_MAX_JSON_BYTES: Final = 32 << 20
"""A batch is closed after 4 MiB of messages; as Python objects it is 24 times as large."""
_BROKEN: Final = (ValueError, KeyError, IndexError, TypeError, OSError, EOFError, tarfile.TarError, zipfile.BadZipFile,
                  NotImplementedError, RuntimeError, zlib.error, ArithmeticError, MemoryError, SyntaxError)  # fmt: skip
"""What the readers raise for invalid content: RuntimeError for a zip with a password, SyntaxError by Pillow."""

_POSE: Final = (*(f'position.{axis}' for axis in 'xyz'), *(f'orientation.{axis}' for axis in 'xyzw'))
_TWIST: Final = ('linear', 'angular')
ODOMETRY: Final = (*_POSE, *(f'{kind}_velocity.{axis}' for kind in _TWIST for axis in 'xyz'))
"""13 fields: meters, quaternion, m/s, rad/s. These are the names in the short document; they also work for the full message."""
_WHOLE_ODOMETRY: Final = (
    *(f'pose.pose.{name}' for name in _POSE),
    *(f'twist.twist.{kind}.{axis}' for kind in _TWIST for axis in 'xyz'),
)
_WHOLE: Final = dict(zip(ODOMETRY, _WHOLE_ODOMETRY, strict=True))
_SHORT: Final = {whole: short for short, whole in _WHOLE.items()}
FIELDS: Final[Mapping[str, tuple[str, ...]]] = {
    'go2_interfaces/msg/IMU': ('gyroscope', 'accelerometer', 'quaternion'),
    'sensor_msgs/msg/Imu': (
        *(f'angular_velocity.{axis}' for axis in 'xyz'), *(f'linear_acceleration.{axis}' for axis in 'xyz'),
        *(f'orientation.{axis}' for axis in 'wxyz'),
    ),
    'sensor_msgs/msg/JointState': ('position',),
    'go2_interfaces/msg/LowState': ('bms_state.soc', 'power_v', 'power_a'),
    'geometry_msgs/msg/Twist': tuple(f'{kind}.{axis}' for kind in _TWIST for axis in 'xyz'),
}  # fmt: skip
"""Type -> default fields; for other types all numbers. An IMU has rad/s, m/s^2 and the quaternion w x y z."""
_UNKNOWN: Final[Mapping[str, Mapping[str, str]]] = {
    'sensor_msgs/msg/Imu': {
        name: f'{name}_covariance' for name in ('orientation', 'angular_velocity', 'linear_acceleration')
    },
    'sensor_msgs/msg/NavSatFix': dict.fromkeys(('latitude', 'longitude', 'altitude'), 'status.status'),
}  # fmt: skip
"""See ``marker_of``; by the comments in Imu.msg and NavSatStatus.msg."""


STEADY_NS: Final = SECOND // 10
"""If the offsets of an object's first and last message differ by less, the offset is constant."""


class ArchiveMember(NamedTuple):
    """One message of an archive; a repeat has the content of the file that it repeats."""

    stamp_ns: int
    """As in the archive, without the object's ``clock_offset_ns``."""
    body: bytes
    extension: str


def extension_of(key: str) -> str:
    """The extension of a key or member, in lower case, without the dot."""
    return key.rpartition('/')[2].rpartition('.')[2].lower()


def image(body: bytes, size: tuple[int, int] | None = None) -> NDArray[Any]:
    """An image object as an array: (height, width, 3) uint8 RGB; depth (uint16) and float images (height, width) unchanged.

    Args:
        body: the bytes of the object (JPEG, PNG, TIFF).
        size: (height, width) to scale to; a JPEG is then decoded no larger than necessary, which is faster.

    Raises:
        LakeError: this is not an image that can be read.
    """
    try:
        return _jpeg(body, size) if body.startswith(_JPEG) else _pillow(body, size)
    except _BROKEN as error:
        raise LakeError(f'the image cannot be read: {error}') from error


def _jpeg(body: bytes, size: tuple[int, int] | None) -> NDArray[Any]:
    height, width, _, _ = simplejpeg.decode_jpeg_header(body)
    check_pixels(width, height)
    if size is None:
        pixels: NDArray[Any] = simplejpeg.decode_jpeg(body, 'RGB')
        return pixels
    pixels = simplejpeg.decode_jpeg(body, 'RGB', min_height=size[0], min_width=size[1], min_factor=1)
    return pixels if pixels.shape[:2] == size else _resized(pixels, size)


def _resized(pixels: NDArray[Any], size: tuple[int, int]) -> NDArray[Any]:
    from PIL import Image  # noqa: PLC0415 - only for sizes to which a JPEG cannot be decoded directly

    return np.array(Image.fromarray(pixels).resize(size[::-1], Image.Resampling.BOX))


def _pillow(body: bytes, size: tuple[int, int] | None) -> NDArray[Any]:
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')  # for a damaged file Pillow warns before it raises
        with open_image(body) as opened:
            plain = opened.mode in {'I;16', 'I', 'F'}
            pixels = np.array(opened if plain else opened.convert('RGB'))
            if opened.mode == 'I':  # older Pillows open 16-bit images in this mode
                pixels = pixels.astype(np.uint16)
    if size is None or pixels.shape[:2] == size:
        return pixels
    if not plain:
        return _resized(pixels, size)
    rows, columns = (np.arange(wanted) * have // wanted for wanted, have in zip(size, pixels.shape[:2], strict=True))
    return np.array(pixels[rows][:, columns])  # not averaged: a mean of two depths is on neither surface


def cloud(body: bytes) -> NDArray[np.float32]:
    """A PCD object as (n, 4) float32: x, y, z in meters and intensity; a missing field is NaN. Raises LakeError."""
    try:
        return _cloud(body)
    except _BROKEN as error:
        raise LakeError(f'this is not a PCD that can be read: {error}') from error


def cloud_points(body: bytes) -> NDArray[Any]:
    """A PCD object as a structured array (n,) with all fields of its points. Raises LakeError."""
    try:
        found = _points(body)
        return found.view(np.dtype([(name.partition(':')[2], found.dtype[name]) for name in found.dtype.names or ()]))
    except _BROKEN as error:
        raise LakeError(f'this is not a PCD that can be read: {error}') from error


def _points(body: bytes) -> NDArray[Any]:
    at = body.index(_DATA, 0, _MAX_HEADER) + len(_DATA)
    end = body.index(b'\n', at, at + 64)
    if body[at:end].strip() != b'binary':
        raise ValueError(f'its data is {body[at:end][:30]!r}, not binary')
    lines = (line.split() for line in body[:at].decode('ascii').splitlines() if not line.startswith('#'))
    header = {line[0]: line[1:] for line in lines if line}
    points = int(header['POINTS'][0])
    if not 0 <= points <= _MAX_POINTS:
        raise ValueError(f'it claims {points:,} points')
    fields = zip(
        header['FIELDS'], header['TYPE'], header['SIZE'], header.get('COUNT', ['1'] * len(header['FIELDS'])), strict=True
    )
    layout = np.dtype([(f'{number}:{name}', f'<{kind.lower()}{int(size)}', (int(count),) if int(count) > 1 else ())
                       for number, (name, kind, size, count) in enumerate(fields)])  # fmt: skip
    return np.frombuffer(body, layout, points, end + 1)


def _cloud(body: bytes) -> NDArray[np.float32]:
    data = _points(body)
    found = np.full((len(data), len(POINT)), np.nan, np.float32)
    for name in data.dtype.names or ():
        if (plain := name.partition(':')[2]) in POINT and data[name].ndim == 1:
            found[:, POINT.index(plain)] = data[name]
    return found


def records(body: bytes) -> list[dict[str, Any]]:
    """The messages of a JSON object: the samples of a batch, or its one document as a list. Raises LakeError."""
    try:
        check_size(len(body), _MAX_JSON_BYTES)
        document = limit_depth(orjson.loads(body))
        found = document.get('samples', [document])
        if not all(isinstance(each, dict) and _is_stamp(each['stamp_ns']) for each in found):
            raise ValueError('a sample has no stamp')
        return list(found)
    except (*_BROKEN, AttributeError) as error:
        raise LakeError(f"this is not a sensor's JSON: {error}") from error


def members(body: bytes, extension: str) -> list[ArchiveMember]:
    """The messages of a tar or zip object in order, including repeats. Raises LakeError."""
    try:
        return list(_members(dict(_tar(body) if extension == 'tar' else _zip(body))))
    except _BROKEN as error:
        raise LakeError(f'the {extension} cannot be read: {error}') from error


def _members(files: dict[str, bytes]) -> Iterator[ArchiveMember]:
    contents = {name.partition('.')[0]: name for name in files if not name.endswith('.json')}
    for name, body in files.items():
        if name.endswith('.json'):
            info = limit_depth(orjson.loads(body))
            if not isinstance(info, dict) or not _is_stamp(info['stamp_ns']):
                raise ValueError(f'{name} has no stamp')
            content = info.get('repeat_of') or contents[name[:-5]]
            yield ArchiveMember(info['stamp_ns'], files[content], extension_of(content))


def _tar(body: bytes) -> Iterator[tuple[str, bytes]]:
    left = len(body)  # a sparse file claims more
    with tarfile.open(fileobj=BytesIO(body), mode='r:') as packed:
        for number, entry in enumerate(packed):
            left -= entry.size if entry.isreg() else 0
            if number >= MAX_MEMBERS or left < 0:
                raise ValueError('it claims more or larger files than it has bytes for')
            content = packed.extractfile(entry) if entry.isreg() else None
            if content is not None:
                yield entry.name, content.read()


def _zip(body: bytes) -> Iterator[tuple[str, bytes]]:
    if body.count(_ZIP_ENTRY) > MAX_MEMBERS:
        raise ValueError(f'it has more than {MAX_MEMBERS:,} files')
    with zipfile.ZipFile(BytesIO(body)) as packed:
        entries = packed.infolist()
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise ValueError('its files are compressed; a robot stores them uncompressed')
        check_size(sum(entry.file_size for entry in entries), len(body))
        for entry in entries:
            yield entry.filename, packed.read(entry)


def _is_stamp(value: object) -> bool:
    return type(value) is int and -(1 << 63) <= value < 1 << 63


@dataclass(frozen=True, slots=True)
class Table:
    """The numbers of the messages of one object, ordered by time.

    A field is a path such as ``pose.pose.position.x``; a list, or a field of a list's elements, becomes several columns.
    """

    stamps: NDArray[np.int64]
    """ns since 1970."""
    values: NDArray[np.float64]
    """(messages, columns); null and values that the message marks as unknown are NaN, ``"Infinity"`` is an infinity."""

    @property
    def nbytes(self) -> int:
        """How much memory it takes."""
        return self.stamps.nbytes + self.values.nbytes


def arrivals(times_ns: NDArray[np.int64], first_ns: int, last_ns: int) -> NDArray[np.int64]:
    """The arrival times of an object's messages, in stored order, from those of the first and the last message.

    ``times_ns`` are the stamps, shifted by the delay of the first message. If the last one matches its arrival, they are the
    arrivals; otherwise the delay changed (a stuck stamp, a blocked queue), and the arrivals are spread evenly. If first and last
    are equal, the last arrival is unknown.
    """
    if len(times_ns) < 2 or last_ns <= first_ns or abs(int(times_ns.max()) - last_ns) <= STEADY_NS:
        return times_ns
    return first_ns + np.arange(len(times_ns), dtype=np.int64) * (last_ns - first_ns) // (len(times_ns) - 1)


def table(samples: Sequence[Mapping[str, Any]], kind: str, fields: Sequence[str], offset_ns: int,
          received_ns: tuple[int, int] | None = None) -> Table:  # fmt: skip
    """The numbers of the messages that ``records`` returned, as arrays.

    Args:
        samples: the messages.
        kind: their type, such as ``nav_msgs/msg/Odometry``.
        fields: paths of numbers; none for the usual ones of the type (``FIELDS``), or all.
        offset_ns: is added to the stamps: ``clock_offset_ns`` of the object's metadata, otherwise 0.
        received_ns: when the first and the last of them arrived; the times are then those of arrival.

    Raises:
        LakeError: a field is missing or not a number.
    """
    asked = tuple(fields)
    stamps = np.array([sample['stamp_ns'] for sample in samples], np.int64) + offset_ns
    stamps = stamps if received_ns is None else arrivals(stamps, *received_ns)
    try:
        asked = asked or _of_type(samples, kind)
        if kind == 'nav_msgs/msg/Odometry' and samples and 'pose' in samples[0]:
            asked = whole_odometry(asked)
        elif kind == 'nav_msgs/msg/Odometry':
            asked = tuple(_SHORT.get(name, name) for name in asked)
        columns = [_column(samples, name, marker_of(kind, name)) for name in asked]
        values = np.hstack(columns) if columns else np.empty((len(samples), 0))
    except (LookupError, TypeError, ValueError, RecursionError, ArithmeticError, MemoryError) as error:
        raise LakeError(f'messages of {kind} have no numbers {", ".join(asked)}: {error}') from error
    order = np.argsort(stamps, kind='stable')
    return Table(stamps[order], values[order])


def marker_of(kind: str, field: str) -> str | None:
    """The field whose first element is -1 if the given field has no value; None if the type has no such mark."""
    return _UNKNOWN.get(kind, {}).get(field.partition('.')[0])


def whole_odometry(fields: Sequence[str]) -> tuple[str, ...]:
    """Translate fields of the short odometry document (``ODOMETRY``) to those of the full message; others are unchanged."""
    return tuple(_WHOLE.get(name, name) for name in fields)


def _of_type(samples: Sequence[Mapping[str, Any]], kind: str) -> tuple[str, ...]:
    if kind == 'nav_msgs/msg/Odometry':
        return ODOMETRY
    return FIELDS.get(kind) or (tuple(_numbers('', samples[0])) if samples else ())


def _numbers(path: str, value: Any) -> Iterator[str]:
    """The paths of all numbers in a message, in its order, without texts and lists of other values."""
    if isinstance(value, Mapping):
        for name, inner in value.items():
            if not (path or name not in {'stamp_ns', 'header', 'robot', 'non_finite'}):
                continue
            yield from _numbers(f'{path}.{name}' if path else name, inner)
    elif isinstance(value, list):
        if value and isinstance(value[0], Mapping):
            yield from _numbers(path, value[0])
        elif value and all(map(_is_number, value)):
            yield path
    elif _is_number(value):
        yield path


def _is_number(value: Any) -> bool:
    """Whether a JSON value is a number: null is NaN, and infinities are texts."""
    return value is None or isinstance(value, (int, float)) or (isinstance(value, str) and value in INFINITE)


def _column(samples: Sequence[Mapping[str, Any]], name: str, marker: str | None) -> NDArray[np.float64]:
    path = name.split('.')
    found = np.array([_at(sample, path) for sample in samples], np.float64).reshape(len(samples), -1)
    if marker is not None:
        marks = np.array([_at(sample, marker.split('.')) for sample in samples], np.float64).reshape(len(samples), -1)
        found[marks[:, 0] == -1] = np.nan
    return found


def _at(value: Any, path: Sequence[str]) -> Any:
    for number, name in enumerate(path):
        if isinstance(value, list):
            return [_at(item, path[number:]) for item in value]
        value = value[name]
    return value
