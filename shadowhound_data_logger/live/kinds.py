"""What of a message the page shows: its type decides the kind, and the kind what is sent to a browser.

A camera's frame goes as JPEG, a cloud as uint16 in its bounding box, everything else as rows of float32. Frames and clouds exist
in three sizes (``FULL`` to ``SMALLEST``), for links that carry less. Raises Rejected for a message that is broken.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import simplejpeg

from shadowhound_data_logger.encode.image import JPEG_MAGIC
from shadowhound_data_logger.encode.types import MessageTypes
from shadowhound_data_logger.errors import Rejected
from shadowhound_data_logger.options import COMPRESSED_IMAGE, IMAGE, POINT_CLOUD
from shadowhound_data_logger.untrusted import check_pixels

if TYPE_CHECKING:
    from numpy.typing import NDArray

FULL, HALF, SMALLEST = 0, 1, 2
SIZES: Final = (FULL, HALF, SMALLEST)
RAW: Final = -1
"""In place of a size: serialized messages as they came."""
_SIDE: Final = {HALF: 2, SMALLEST: 4}
"""By how much a smaller frame's sides are divided."""
_QUALITY: Final = {FULL: 75, HALF: 60, SMALLEST: 45}
_EVERY: Final = {FULL: 1, HALF: 4, SMALLEST: 16}
"""Which points of a smaller cloud are kept."""
MOST_POINTS: Final = 200_000
"""Of a cloud that is sent; of a larger one each second, third, ... is."""
_COLORSPACES: Final = {'bgr8': 'BGR', 'rgb8': 'RGB', 'bgra8': 'BGRA', 'rgba8': 'RGBA', 'mono8': 'GRAY'}
_AXES: Final = ('x', 'y', 'z')
MOST_NAMES, MOST_NAME = 64, 64
"""Figures in a row, and letters in the name of one."""
_MOST_STEP: Final = 1 << 16
"""Bytes of a point."""
_FAR: Final = 1e7
"""Metres: no point of a robot's lidar is further from where its frame begins."""
_GO2_IMU_NAMES: Final = [*(f'{name}.{axis}' for name in ('rpy', 'gyro', 'accel') for axis in _AXES), 'temperature']
_GO2_IMU_BYTES: Final = range(57, 61)
"""A go2_interfaces/msg/IMU, serialized; some writers pad it."""
_GO2_IMU_ROW: Final = np.dtype({'names': ['gyro', 'accel', 'rpy', 'temperature'], 'formats': ['3<f4', '3<f4', '3<f4', 'i1'],
                                'offsets': [20, 32, 44, 56]})  # fmt: skip
_FLOAT32: Final = 7
"""sensor_msgs/msg/PointField.FLOAT32."""

_json = json.JSONEncoder(separators=(',', ':')).encode


@dataclass(frozen=True)
class LiveItem:
    """Something to be sent to whoever watches a topic; packed once for all of them."""

    topic: str
    kind: str
    size: int = FULL
    head: Mapping[str, Any] | None = None
    body: bytes = b''

    @cached_property
    def packed(self) -> bytes:
        """A uint32 with the length of the head, the head as JSON, spaces up to a multiple of 8 bytes, the body."""
        head = _json({'topic': self.topic, 'kind': self.kind, **(self.head or {})}).encode()
        head += b' ' * (-(4 + len(head)) % 8)
        return len(head).to_bytes(4, 'little') + head + self.body


class Kind(NamedTuple):
    """How the messages of some types are shown."""

    name: str
    most_hz: float
    """Messages beyond it are left out."""
    is_bulk: bool
    """Whether only the newest one matters."""
    values: Callable[[Any], Mapping[str, float]] | None = None
    """The figures of a message, where it goes as a row of them."""
    table: Callable[[Sequence[bytes]], tuple[list[str], NDArray[Any]] | None] | None = None
    """The same of serialized messages at once: names, and a row each (float32); None where they are not as usual."""


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
    rate, force = message.angular_velocity, message.linear_acceleration
    return dict([*_named('rpy', _turn(message.orientation)), *_named('gyro', (rate.x, rate.y, rate.z)),
                 *_named('accel', (force.x, force.y, force.z))])  # fmt: skip


def _go2_imu(message: Any) -> dict[str, float]:
    return dict([*_named('rpy', message.rpy), *_named('gyro', message.gyroscope), *_named('accel', message.accelerometer),
                 ('temperature', float(message.temperature))])  # fmt: skip


def _go2_imu_table(cdrs: Sequence[bytes]) -> tuple[list[str], NDArray[Any]] | None:
    """Read where little-endian CDR has them: 100 messages a second of which each field would be unpacked by itself."""
    if not all(len(cdr) in _GO2_IMU_BYTES and cdr[1] == 1 for cdr in cdrs):
        return None
    rows = np.frombuffer(b''.join([cdr[:57] for cdr in cdrs]), _GO2_IMU_ROW)
    table = np.empty((len(rows), 10), '<f4')
    table[:, :3], table[:, 3:6], table[:, 6:9], table[:, 9] = rows['rpy'], rows['gyro'], rows['accel'], rows['temperature']
    return _GO2_IMU_NAMES, table


def _odometry(message: Any) -> dict[str, float]:
    place, turn = message.pose.pose.position, message.pose.pose.orientation
    return {'x': place.x, 'y': place.y, 'z': place.z, 'qx': turn.x, 'qy': turn.y, 'qz': turn.z, 'qw': turn.w}


def _joints(message: Any) -> dict[str, float]:
    names = (name[:MOST_NAME] for name in message.name[:MOST_NAMES])
    return dict(zip(names, map(float, message.position), strict=False))


def _low_state(message: Any) -> dict[str, float]:
    battery = message.bms_state
    return {
        'battery': float(battery.soc), 'volts': float(message.power_v), 'amperes': battery.current / 1000,
        'body': float(message.temperature_ntc1), 'motor': float(max(motor.temperature for motor in message.motor_state)),
        'cells': float(max(battery.bq_ntc)),
    }  # fmt: skip


def _battery(message: Any) -> dict[str, float]:
    return {
        'battery': 100 * message.percentage,
        'volts': message.voltage,
        'amperes': message.current,
        'cells': message.temperature,
    }


def _go2_state(message: Any) -> dict[str, float]:
    return {'height': float(message.body_height), **dict(_named('velocity', message.velocity)),
            **{f'foot.{place}': float(force) for place, force in enumerate(message.foot_force)}}  # fmt: skip


KINDS: Final[Mapping[str, Kind]] = {
    COMPRESSED_IMAGE: Kind('camera', 30.0, is_bulk=True),
    IMAGE: Kind('camera', 15.0, is_bulk=True),
    POINT_CLOUD: Kind('cloud', 10.0, is_bulk=True),
    'sensor_msgs/msg/Imu': Kind('imu', 100.0, is_bulk=False, values=_imu),
    'go2_interfaces/msg/IMU': Kind('imu', 100.0, is_bulk=False, values=_go2_imu, table=_go2_imu_table),
    'nav_msgs/msg/Odometry': Kind('odom', 25.0, is_bulk=False, values=_odometry),
    'sensor_msgs/msg/JointState': Kind('joints', 20.0, is_bulk=False, values=_joints),
    'go2_interfaces/msg/LowState': Kind('battery', 2.0, is_bulk=False, values=_low_state),
    'sensor_msgs/msg/BatteryState': Kind('battery', 2.0, is_bulk=False, values=_battery),
    'go2_interfaces/msg/Go2State': Kind('state', 10.0, is_bulk=False, values=_go2_state),
}
"""By type of message; topics of other types are counted on the page and not drawn."""


def series(topic: str, kind: Kind, type_name: str, types: MessageTypes, messages: Sequence[tuple[float, bytes]]) -> LiveItem:
    """Rows of figures from messages and when each came (ms): all times as float64, then a row of float32 for each."""
    values = kind.values
    assert values is not None

    def read(at_ms: float, cdr: bytes) -> tuple[float, Mapping[str, float]]:
        return at_ms, values(types.deserialize(type_name, memoryview(cdr)))

    found = None if kind.table is None else kind.table([cdr for _, cdr in messages])
    if found is None:
        return table_item(topic, kind, [read(at_ms, cdr) for at_ms, cdr in messages])
    return _table_item(topic, kind, found[0], np.array([at_ms for at_ms, _ in messages], '<f8'), found[1])


def table_item(topic: str, kind: Kind, rows: Sequence[tuple[float, Mapping[str, float]]]) -> LiveItem:
    """Times and figures as an item: all times as float64, then a row of float32 for each that names what the last one names."""
    names = list(rows[-1][1])
    rows = [row for row in rows if list(row[1]) == names]
    times = np.array([at_ms for at_ms, _ in rows], '<f8')
    return _table_item(topic, kind, names, times, np.array([list(values.values()) for _, values in rows], '<f4'))


def _table_item(topic: str, kind: Kind, names: list[str], times: NDArray[Any], table: NDArray[Any]) -> LiveItem:
    head = {'names': names, 'rows': len(times), 'at': round(float(times[-1]), 1)}
    return LiveItem(topic, kind.name, FULL, head, times.tobytes() + table.tobytes())


def frames(topic: str, type_name: str, types: MessageTypes, at_ms: float, cdr: bytes, sizes: Sequence[int]) -> Iterator[LiveItem]:
    """A camera's message in each size that is asked for; a JPEG goes as it came. Raises Rejected."""
    message = types.deserialize(type_name, memoryview(cdr))
    if type_name == COMPRESSED_IMAGE:
        body = message.data.tobytes()
        if not body.startswith(JPEG_MAGIC):
            raise Rejected('unsupported_encoding', f'{message.format[:40]!r} is shown by no browser')
        check_jpeg(body)
        for size in sizes:
            yield LiveItem(topic, 'camera', size, {'at': round(at_ms, 1)}, body if size == FULL else _smaller(body, size))
        return
    pixels, colorspace = _pixels(message)
    for size in sizes:
        side = _SIDE.get(size, 1)
        chosen = np.ascontiguousarray(pixels[::side, ::side])
        sampling = 'Gray' if chosen.shape[2] == 1 else '420'
        jpeg = simplejpeg.encode_jpeg(chosen, _QUALITY[size], colorspace, sampling, fastdct=True)
        yield LiveItem(topic, 'camera', size, {'at': round(at_ms, 1)}, bytes(jpeg))


def check_jpeg(jpeg: bytes) -> None:
    """Raises Rejected for one that is broken, or of so many pixels that whoever shows it has no memory left."""
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


def clouds(topic: str, types: MessageTypes, at_ms: float, cdr: bytes, sizes: Sequence[int]) -> Iterator[LiveItem]:
    """A cloud's finite points in each size that is asked for: x, y, z as uint16, metres are ``low + value * step``."""
    cloud = types.deserialize(POINT_CLOUD, memoryview(cdr))
    offsets = {field.name: field.offset for field in cloud.fields if field.name in _AXES and field.datatype == _FLOAT32}
    count, step = cloud.width * cloud.height, cloud.point_step
    if len(offsets) != len(_AXES) or not max(offsets.values()) + 4 <= step <= _MOST_STEP or cloud.data.size < count * step:
        raise Rejected('size_mismatch', 'a cloud without x, y and z as float32, or with fewer bytes than it says')
    layout = np.dtype({'names': list(_AXES), 'formats': [('>' if cloud.is_bigendian else '<') + 'f4'] * 3,
                       'offsets': [offsets[axis] for axis in _AXES], 'itemsize': step})  # fmt: skip
    every = max(1, -(-count // MOST_POINTS))
    points = np.frombuffer(cloud.data, layout, count)[::every]
    columns = np.array([points[axis] for axis in _AXES], '<f4')
    yield from points_items(topic, at_ms, columns.T, cloud.header.frame_id, sizes)


def points_items(topic: str, at_ms: float, table: NDArray[Any], frame: str, sizes: Sequence[int]) -> Iterator[LiveItem]:
    """These points (n, 3; float32, metres) in each size that is asked for, without those that are not finite or absurdly far."""
    columns = np.ascontiguousarray(table.T, '<f4')  # numpy is ten times as fast along rows that are contiguous
    low, high = _box(columns)
    if not (np.all(low > -_FAR) and np.all(high < _FAR)):  # what is NaN is neither
        is_near = (np.abs(columns) < _FAR).all(axis=0)
        columns = np.array([column[is_near] for column in columns])
        low, high = _box(columns)
    span = high.astype('f8') - low
    scale = np.where(span > 0, span, 1.0) / 65_535
    for size in sizes:
        sent = columns[:, :: _EVERY[size]]
        chosen, steps = np.empty((sent.shape[1], 3), '<u2'), np.empty(sent.shape[1], '<f4')
        for axis, column in enumerate(sent):  # one axis after the other: to turn a whole table takes numpy twice as long
            np.subtract(column, low[axis], out=steps)
            steps *= np.float32(1 / scale[axis])
            steps += np.float32(0.5)
            chosen[:, axis] = steps
        head = {
            'at': round(at_ms, 1), 'low': [round(float(value), 4) for value in low], 'step': [float(value) for value in scale],
            'points': len(chosen), 'frame': frame[:80],
        }  # fmt: skip
        yield LiveItem(topic, 'cloud', size, head, chosen.tobytes())


def _box(columns: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Least and greatest of each of three rows; zeros where they are empty."""
    return (columns.min(axis=1), columns.max(axis=1)) if columns.size else (np.zeros(3, '<f4'), np.zeros(3, '<f4'))
