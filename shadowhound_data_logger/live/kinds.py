"""What the page shows of a message: its type decides the kind, and the kind what is sent to the browser.

A camera's frame is sent as JPEG, a cloud as uint16 in its bounding box, everything else as rows of float32. Frames and clouds
exist in three sizes (``FULL`` to ``SMALLEST``), for slower links. Raises Rejected for an invalid message.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import orjson
import simplejpeg

from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.core.options import COMPRESSED_IMAGE, IMAGE, POINT_CLOUD
from shadowhound_data_logger.core.untrusted import check_pixels
from shadowhound_data_logger.formats.image import JPEG_MAGIC
from shadowhound_data_logger.formats.pointcloud import xyz_of
from shadowhound_data_logger.formats.types import MessageTypes

if TYPE_CHECKING:
    from numpy.typing import NDArray

FULL, HALF, SMALLEST = 0, 1, 2
SIZES: Final = (FULL, HALF, SMALLEST)
_SIDE: Final = {HALF: 2, SMALLEST: 4}
"""The divisor of a smaller frame's sides."""
_QUALITY: Final = {FULL: 75, HALF: 60, SMALLEST: 45}
_EVERY: Final = {FULL: 1, HALF: 4, SMALLEST: 16}
"""Every n-th point of a smaller cloud."""
MAX_POINTS: Final = 200_000
"""Maximum points of a cloud that is sent; larger ones are decimated."""
_COLORSPACES: Final = {
    'bgr8': 'BGR', 'rgb8': 'RGB', 'bgra8': 'BGRA', 'rgba8': 'RGBA', 'mono8': 'GRAY', '8UC1': 'GRAY', '8UC3': 'BGR',
    '8UC4': 'BGRA',
}  # fmt: skip
_MEASURED: Final = {'16UC1': ('u2', 'm'), '32FC1': ('f4', 'm'), 'mono16': ('u2', '')}
"""Images of distances (REP 118: millimeters as uint16, meters as float32) and of other values, shown in colors: numpy's name of
the value type, and the unit.
"""
_RAMP: Final = ((250, 235, 110), (245, 150, 60), (220, 70, 90), (130, 40, 130), (50, 30, 110), (20, 25, 70))
"""Red, green and blue from near to far; ``page/style.css`` has the same for the legend."""
_NO_VALUE: Final = (118, 118, 118)
_ENDS: Final = tuple(
    step * ten for ten in (0.1, 1.0, 10.0, 100.0, 1000.0, 10_000.0) for step in (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)
)
"""Possible upper ends of the color scale, so that it rarely changes."""
_AXES: Final = ('x', 'y', 'z')
MAX_NAMES, MAX_NAME = 64, 64
"""Maximum values in a row, and letters in the name of one."""
_FAR: Final = 1e7
"""Meters: no point of a robot's lidar is further from the origin of its frame."""
_NO_FIX: Final = -1
_GO2_IMU_NAMES: Final = [*(f'{name}.{axis}' for name in ('rpy', 'gyro', 'accel') for axis in _AXES), 'temperature']
_GO2_IMU_BYTES: Final = range(57, 61)
"""Size of a serialized go2_interfaces/msg/IMU; some writers pad it."""
_GO2_IMU: Final = struct.Struct('<20x9fb')
"""Its gyro, accel, rpy and temperature."""
_GO2_IMU_ROW: Final = struct.Struct('<10f')
_POSE_NAMES: Final = ['x', 'y', 'z', 'qx', 'qy', 'qz', 'qw']
_POSE, _POSE_ROW = struct.Struct('<7d'), struct.Struct('<7f')
_ODOMETRY_BYTES: Final = 8 * (7 + 36 + 6 + 36)
"""Size of pose and twist, each with its covariance."""
_LITTLE: Final = 1
"""The second byte of little-endian CDR."""
_FRAME_ID: Final = 12
"""Offset of the frame id in the CDR of a message that starts with a header."""
_LENGTH: Final = struct.Struct('<I')


@dataclass(frozen=True)
class LiveItem:
    """Data for the viewers of a topic; packed once for all of them."""

    topic: str
    kind: str
    size: int = FULL
    head: Mapping[str, Any] | None = None
    body: bytes = b''

    @property
    def packed(self) -> bytes:
        """A uint32 with the length of the head, the head as JSON, spaces up to a multiple of 8 bytes, the body."""
        packed: bytes | None = self.__dict__.get('_packed')  # ``cached_property`` takes a lock before Python 3.12
        if packed is None:
            head = _json({'topic': self.topic, 'kind': self.kind, **(self.head or {})})
            head += b' ' * (-(4 + len(head)) % 8)
            packed = self.__dict__['_packed'] = len(head).to_bytes(4, 'little') + head + self.body
        return packed


def _json(value: Mapping[str, Any]) -> bytes:
    try:
        return orjson.dumps(value)
    except TypeError:  # an unpaired surrogate in a name, or an integer of more than 64 bits
        return json.dumps(value, separators=(',', ':')).encode()


class Kind(NamedTuple):
    """How messages of some types are shown."""

    name: str
    max_hz: float
    """Maximum rate; other messages are skipped."""
    is_bulk: bool
    """Whether only the newest one matters."""
    values: Callable[[Any], Mapping[str, float]] | None = None
    """The values of a message, if it is sent as a row."""
    table: Callable[[Sequence[bytes]], tuple[list[str], bytes] | None] | None = None
    """The same for serialized messages, read from little-endian CDR, which is several times as fast: names, and a row each
    (float32).
    None, or an error of ``struct``, if the layout is unusual.
    """


def _turn(q: Any) -> tuple[float, float, float]:
    """Roll, pitch and yaw of a quaternion, rad."""
    x, y, z, w = q.x, q.y, q.z, q.w
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        pitch,
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )


def _named(prefix: str, values: Sequence[float]) -> Iterator[tuple[str, float]]:
    return zip((f'{prefix}.{axis}' for axis in _AXES), map(float, values), strict=False)


def _imu(message: Any) -> dict[str, float]:
    """Without values that the message marks as unknown, by -1 as the first element of the covariance (Imu.msg)."""
    found: dict[str, float] = {}
    rate, force = message.angular_velocity, message.linear_acceleration
    if message.orientation_covariance[0] != -1:
        found.update(_named('rpy', _turn(message.orientation)))
    if message.angular_velocity_covariance[0] != -1:
        found.update(_named('gyro', (rate.x, rate.y, rate.z)))
    if message.linear_acceleration_covariance[0] != -1:
        found.update(_named('accel', (force.x, force.y, force.z)))
    return found


def _go2_imu(message: Any) -> dict[str, float]:
    return dict([*_named('rpy', message.rpy), *_named('gyro', message.gyroscope), *_named('accel', message.accelerometer),
                 ('temperature', float(message.temperature))])  # fmt: skip


def _go2_imu_table(cdrs: Sequence[bytes]) -> tuple[list[str], bytes] | None:
    if not all(len(cdr) in _GO2_IMU_BYTES and cdr[1] == _LITTLE for cdr in cdrs):
        return None
    rows = [_GO2_IMU.unpack_from(cdr) for cdr in cdrs]
    return _GO2_IMU_NAMES, b''.join([_GO2_IMU_ROW.pack(*row[6:9], *row[:6], row[9]) for row in rows])


def _odometry(message: Any) -> dict[str, float]:
    place, turn = message.pose.pose.position, message.pose.pose.orientation
    return dict(zip(_POSE_NAMES, (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w), strict=True))


def _after_text(cdr: bytes, place: int) -> int:
    """Offset of a uint32 that follows the text at this offset."""
    end = place + 4 + int(_LENGTH.unpack_from(cdr, place)[0])
    return end + -end % 4


def _align_double(place: int) -> int:
    """Offset of the next float64: CDR aligns it relative to byte 4."""
    return place + (4 - place) % 8


def _odometry_table(cdrs: Sequence[bytes]) -> tuple[list[str], bytes] | None:
    rows = []
    for cdr in cdrs:
        place = _align_double(_after_text(cdr, _after_text(cdr, _FRAME_ID)))  # after child_frame_id
        if cdr[1] != _LITTLE or len(cdr) < place + _ODOMETRY_BYTES:
            return None
        rows.append(_POSE_ROW.pack(*_POSE.unpack_from(cdr, place)))
    return _POSE_NAMES, b''.join(rows)


def _joints(message: Any) -> dict[str, float]:
    names = (name[:MAX_NAME] for name in message.name[:MAX_NAMES])
    return dict(zip(names, map(float, message.position), strict=False))


def _joints_table(cdrs: Sequence[bytes]) -> tuple[list[str], bytes] | None:
    name_bytes, rows = b'', []
    for cdr in cdrs:
        begin = place = _after_text(cdr, _FRAME_ID)
        (count,) = _LENGTH.unpack_from(cdr, place)
        if cdr[1] != _LITTLE or not 0 < count <= MAX_NAMES:
            return None
        place += 4
        for _ in range(count):
            place = _after_text(cdr, place)
        name_bytes = name_bytes or cdr[begin:place]
        position = _align_double(place + 4)
        lengths = []
        for _ in range(3):  # position, velocity, effort
            (length,) = _LENGTH.unpack_from(cdr, place)
            place = _align_double(place + 4) + 8 * length if length else place + 4
            lengths.append(length)
        if lengths[0] < count or len(cdr) < place or not cdr.startswith(name_bytes, begin):
            return None
        rows.append(struct.pack(f'<{count}f', *struct.unpack_from(f'<{count}d', cdr, position)))
    names = _joint_names(name_bytes)
    return None if names is None else (names, b''.join(rows))


@lru_cache(maxsize=16)
def _joint_names(name_bytes: bytes) -> list[str] | None:
    """Names in a sequence of strings in CDR; None if two are equal."""
    names, place = [], 4
    while place < len(name_bytes):
        (length,) = _LENGTH.unpack_from(name_bytes, place)
        names.append(name_bytes[place + 4 : place + 3 + length].decode('utf-8', 'replace')[:MAX_NAME])
        place = _after_text(name_bytes, place)
    return names if len({*names}) == len(names) else None


def _low_state(message: Any) -> dict[str, float]:
    battery = message.bms_state
    return {
        'battery': float(battery.soc), 'volts': float(message.power_v), 'amperes': battery.current / 1000,
        'body': float(message.temperature_ntc1), 'motor': float(max(motor.temperature for motor in message.motor_state)),
        'cells': float(max(battery.bq_ntc)),
    }  # fmt: skip


def _bms_state(message: Any) -> dict[str, float]:
    return {'battery': float(message.soc), 'amperes': message.current / 1000, 'cells': float(max(message.temperature))}


def _battery(message: Any) -> dict[str, float]:
    return {
        'battery': 100 * message.percentage,
        'volts': message.voltage,
        'amperes': message.current,
        'cells': message.temperature,
    }


def _go2_state(message: Any) -> dict[str, float]:
    return {'height': float(message.body_height), **dict(_named('velocity', message.velocity)),
            **{f'foot.{index}': float(force) for index, force in enumerate(message.foot_force)}}  # fmt: skip


def _fix(message: Any) -> dict[str, float]:
    """Degrees as a float32 plus the remainder: one float32 is off by up to a meter. NaN without a fix."""
    has_fix = message.status.status != _NO_FIX
    latitude, longitude = (value if has_fix else math.nan for value in (message.latitude, message.longitude))
    lat, lon = float(np.float32(latitude)), float(np.float32(longitude))
    error_m = math.sqrt(max(0.0, float(message.position_covariance[0]))) if message.position_covariance_type else math.nan
    return {
        'lat': lat, 'lat_rest': latitude - lat, 'lon': lon, 'lon_rest': longitude - lon, 'altitude': float(message.altitude),
        'status': float(message.status.status), 'error': error_m,
    }  # fmt: skip


KINDS: Final[Mapping[str, Kind]] = {
    COMPRESSED_IMAGE: Kind('camera', 30.0, is_bulk=True),
    IMAGE: Kind('camera', 15.0, is_bulk=True),
    POINT_CLOUD: Kind('cloud', 10.0, is_bulk=True),
    'sensor_msgs/msg/Imu': Kind('imu', 100.0, is_bulk=False, values=_imu),
    'go2_interfaces/msg/IMU': Kind('imu', 100.0, is_bulk=False, values=_go2_imu, table=_go2_imu_table),
    'nav_msgs/msg/Odometry': Kind('odom', 25.0, is_bulk=False, values=_odometry, table=_odometry_table),
    'sensor_msgs/msg/JointState': Kind('joints', 20.0, is_bulk=False, values=_joints, table=_joints_table),
    'go2_interfaces/msg/LowState': Kind('battery', 2.0, is_bulk=False, values=_low_state),
    'unitree_go/msg/LowState': Kind('battery', 2.0, is_bulk=False, values=_low_state),
    'unitree_hg/msg/BmsState': Kind('battery', 2.0, is_bulk=False, values=_bms_state),
    'sensor_msgs/msg/BatteryState': Kind('battery', 2.0, is_bulk=False, values=_battery),
    'go2_interfaces/msg/Go2State': Kind('state', 10.0, is_bulk=False, values=_go2_state),
    'unitree_go/msg/SportModeState': Kind('state', 10.0, is_bulk=False, values=_go2_state),
    'sensor_msgs/msg/NavSatFix': Kind('fix', 5.0, is_bulk=False, values=_fix),
}
"""By message type, live and past; ``panels.py`` has more that is only shown live."""


def series(topic: str, kind: Kind, type_name: str, types: MessageTypes, messages: Sequence[tuple[float, bytes]]) -> LiveItem:
    """Rows of values from messages and their arrival (ms): all times as float64, then a row of float32 for each."""
    values = kind.values
    assert values is not None

    def read(at_ms: float, cdr: bytes) -> tuple[float, Mapping[str, float]]:
        return at_ms, values(types.deserialize(type_name, memoryview(cdr)))

    found = None
    if kind.table is not None:
        with suppress(struct.error, IndexError, OverflowError):  # read by field, which reports what is wrong
            found = kind.table([cdr for _, cdr in messages])
    if found is None:
        return table_item(topic, kind, [read(at_ms, cdr) for at_ms, cdr in messages])
    return _table_item(topic, kind, found[0], [at_ms for at_ms, _ in messages], found[1])


def table_item(topic: str, kind: Kind, rows: Sequence[tuple[float, Mapping[str, float]]]) -> LiveItem:
    """Times and values as an item: all times as float64, then a row of float32 for each with the columns of the last one."""
    names = list(rows[-1][1])
    rows = [row for row in rows if list(row[1]) == names]
    table = np.array([list(values.values()) for _, values in rows], '<f4')
    return _table_item(topic, kind, names, [at_ms for at_ms, _ in rows], table.tobytes())


def _table_item(topic: str, kind: Kind, names: list[str], times: list[float], table: bytes) -> LiveItem:
    head = {'names': names, 'rows': len(times), 'at': round(times[-1], 1)}
    return LiveItem(topic, kind.name, FULL, head, struct.pack(f'<{len(times)}d', *times) + table)


def frames(topic: str, type_name: str, types: MessageTypes, at_ms: float, cdr: bytes, sizes: Sequence[int]) -> Iterator[LiveItem]:
    """A camera's message in each requested size; a JPEG is passed on unchanged. Raises Rejected."""
    if type_name == COMPRESSED_IMAGE:
        body = _compressed(types, cdr)
        check_jpeg(body)
        for size in sizes:
            yield LiveItem(topic, 'camera', size, {'at': round(at_ms, 1)}, body if size == FULL else _smaller(body, size))
        return
    message = types.deserialize(type_name, memoryview(cdr))
    head: dict[str, Any] = {'at': round(at_ms, 1)}
    if message.encoding in _MEASURED:
        pixels, head['scale'] = _measured(message, _SIDE.get(min(sizes), 1))
        colorspace = 'RGB'
    else:
        pixels, colorspace = _pixels(message)
    for size in sizes:
        side = _SIDE.get(size, 1) // (_SIDE.get(min(sizes), 1) if 'scale' in head else 1)
        chosen = np.ascontiguousarray(pixels[::side, ::side])
        sampling = 'Gray' if chosen.shape[2] == 1 else '444' if 'scale' in head else '420'
        jpeg = simplejpeg.encode_jpeg(chosen, _QUALITY[size], colorspace, sampling, fastdct=True)
        yield LiveItem(topic, 'camera', size, head, bytes(jpeg))


def _compressed(types: MessageTypes, cdr: bytes) -> bytes:
    """The JPEG of a CompressedImage, sliced from little-endian CDR. Raises Rejected."""
    with suppress(struct.error, IndexError):  # it is another type of message
        begin = _after_text(cdr, _after_text(cdr, _FRAME_ID)) + 4  # after its format
        end = begin + int(_LENGTH.unpack_from(cdr, begin - 4)[0])
        if cdr[1] == _LITTLE and end <= len(cdr) < end + 4 and cdr.startswith(JPEG_MAGIC, begin):
            return cdr[begin:end]
    message = types.deserialize(COMPRESSED_IMAGE, memoryview(cdr))
    body: bytes = message.data.tobytes()
    if not body.startswith(JPEG_MAGIC):
        raise Rejected('unsupported_encoding', f'{message.format[:40]!r} cannot be shown by browsers')
    return body


def check_jpeg(jpeg: bytes) -> None:
    """Raises Rejected for an invalid JPEG, or one with so many pixels that a viewer runs out of memory."""
    try:
        height, width, *_ = simplejpeg.decode_jpeg_header(jpeg)
        check_pixels(width, height)
    except ValueError as error:
        raise Rejected('malformed', str(error)) from error


def _smaller(jpeg: bytes, size: int) -> bytes:
    try:
        height, width, *_ = simplejpeg.decode_jpeg_header(jpeg)
        side = _SIDE[size]
        pixels = simplejpeg.decode_jpeg(
            jpeg, 'BGR', fastdct=True, fastupsample=True, min_height=height // side, min_width=width // side
        )
        return bytes(simplejpeg.encode_jpeg(pixels, _QUALITY[size], 'BGR', '420', fastdct=True))
    except ValueError as error:
        raise Rejected('malformed', str(error)) from error


def _pixels(message: Any) -> tuple[NDArray[Any], str]:
    colorspace = _COLORSPACES.get(message.encoding)
    if colorspace is None:
        raise Rejected('unsupported_encoding', f'{message.encoding[:40]!r} is not shown')
    height, width, step, channels = message.height, message.width, message.step, {'GRAY': 1}.get(colorspace, len(colorspace))
    if not 0 < width * channels <= step or not height or message.data.size != step * height or max(width, height) > 65_500:
        raise Rejected('size_mismatch', f'{width} x {height} {message.encoding}, step {step}, {message.data.size} bytes')
    return message.data.reshape(height, step)[:, : width * channels].reshape(height, width, channels), colorspace


def _measured(message: Any, side: int) -> tuple[NDArray[Any], dict[str, Any]]:
    """Pixels of an image of values in colors, one of ``side`` rows and columns, and the scale of the colors."""
    name, unit = _MEASURED[message.encoding]
    dtype = np.dtype(name).newbyteorder('>' if message.is_bigendian else '<')
    height, width, step = message.height, message.width, message.step
    if not 0 < width * dtype.itemsize <= step or not height or message.data.size != step * height or max(width, height) > 65_500:
        raise Rejected('size_mismatch', f'{width} x {height} {message.encoding}, step {step}, {message.data.size} bytes')
    values = message.data.reshape(height, step)[:, : width * dtype.itemsize].copy().view(dtype)[::side, ::side]
    if name == 'f4':  # in millimeters too: colors are looked up
        values = np.clip(np.nan_to_num(values * np.float32(1000), nan=0, posinf=0, neginf=0), 0, 65_535).astype('<u2')
    some = values[::4, ::4]
    some = some[some > 0]
    most = float(np.percentile(some, 98)) / (1000 if unit else 1) if some.size else 1.0
    end = next((each for each in _ENDS if each >= most), _ENDS[-1])
    return _color_table(end * 1000 if unit else end)[values], {'low': 0, 'high': round(end, 1), 'unit': unit}


@lru_cache(maxsize=8)
def _color_table(end: float) -> NDArray[Any]:
    """The color of each uint16, up to ``end``; 0 means no value."""
    place = np.minimum(np.arange(65_536) / end, 1.0) * (len(_RAMP) - 1)
    table = np.stack([np.interp(place, range(len(_RAMP)), channel) for channel in zip(*_RAMP, strict=True)], axis=1)
    table[0] = _NO_VALUE
    return table.astype(np.uint8)


def clouds(topic: str, types: MessageTypes, at_ms: float, cdr: bytes, sizes: Sequence[int]) -> Iterator[LiveItem]:
    """A cloud's finite points in each requested size: x, y, z as uint16, meters are ``low + value * step``."""
    cloud = types.deserialize(POINT_CLOUD, memoryview(cdr))
    xyz = xyz_of(cloud, max(1, -(-cloud.width * cloud.height // MAX_POINTS)))
    if xyz is None:
        raise Rejected('size_mismatch', 'a cloud without x, y and z as float32, or with a wrong number of bytes')
    yield from points_items(topic, at_ms, xyz, cloud.header.frame_id, sizes)


def points_items(topic: str, at_ms: float, table: NDArray[Any], frame: str, sizes: Sequence[int]) -> Iterator[LiveItem]:
    """These points (n, 3; float32, meters) in each requested size, without those that are not finite or absurdly far."""
    columns = np.ascontiguousarray(table.T, '<f4')
    low, high = _box(columns)
    if not (min(low) > -_FAR and max(high) < _FAR) or any(map(math.isnan, low)):
        is_near = (np.abs(columns) < _FAR).all(axis=0)
        columns = np.array([column[is_near] for column in columns])
        low, high = _box(columns)
    scale = [(most - least or 1.0) / 65_535 for least, most in zip(low, high, strict=True)]
    lowest, factor = (np.array([[value] for value in values], '<f4') for values in (low, [1 / value for value in scale]))
    for size in sizes:
        sent = columns[:, :: _EVERY[size]]
        steps = np.subtract(sent, lowest)
        steps *= factor
        steps += np.float32(0.5)
        chosen = np.empty((sent.shape[1], 3), '<u2')
        for axis, column in enumerate(steps):  # numpy takes twice as long to transpose the complete table
            chosen[:, axis] = column
        head = {
            'at': round(at_ms, 1), 'low': [round(value, 4) for value in low], 'step': scale, 'points': len(chosen),
            'frame': frame[:80],
        }  # fmt: skip
        yield LiveItem(topic, 'cloud', size, head, chosen.tobytes())


def _box(columns: NDArray[Any]) -> tuple[list[float], list[float]]:
    """Minimum and maximum of each of three rows; zeros if they are empty, NaN if a row contains one."""
    if not columns.size:
        return [0.0] * 3, [0.0] * 3
    return np.minimum.reduce(columns, axis=1).tolist(), np.maximum.reduce(columns, axis=1).tolist()
