"""Drawings of standard types besides images, clouds and plots: scans, maps, transforms, lists, the robot's model.

Each type has a function of the newest message, or an object that collects messages of a topic. Their output is bounded whatever a
message contains, and newer items replace older ones. Raises Rejected for an invalid message.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple, Protocol

import numpy as np

from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.live.kinds import FULL, KINDS, Kind, LiveItem

Messages = Sequence[tuple[float, bytes]]
"""Arrival (ms) and CDR of each."""
MAX_RAYS: Final = 4000
"""Maximum rays of a scan; larger ones are decimated."""
MAX_CELLS: Final = 512
"""Maximum cells per side of a map; larger ones are reduced."""
_UNKNOWN: Final = 255
"""An unknown cell of a map; others are 0 to 100."""
MAX_FRAMES: Final = 200
MAX_STATUSES, MAX_VALUES = 200, 24
"""Of diagnostics, and of one of them."""
MAX_LINES: Final = 100
"""Of a log."""
MAX_LINE: Final = 300
"""Characters of a text."""
MAX_MODEL: Final = 1 << 20
"""Bytes of a robot's description."""
_STALE_MS: Final = 10_000.0
_LITTLE: Final = 1
_LENGTH: Final = struct.Struct('<I')
_TRANSFORM: Final = struct.Struct('<7d')
_FIRST_HEADER: Final = 8
"""Offset of the first header of a TFMessage in CDR, after encapsulation and length."""


class Maker(Protocol):
    """Creates an item from the messages of one topic."""

    def __call__(self, topic: str, types: MessageTypes, type_name: str, messages: Messages) -> LiveItem: ...


class Panel(NamedTuple):
    """How messages of a type are drawn."""

    kind: Kind
    is_gathered: bool
    """Whether every message matters, and not only the newest one."""
    maker: Callable[[], Maker]
    is_latched: bool = False
    """Whether publishers usually send it once, for late subscribers."""


def _scan(topic: str, types: MessageTypes, type_name: str, messages: Messages) -> LiveItem:
    """Ranges as uint16: meters are ``value * step``; 0: no measurement."""
    at_ms, cdr = messages[-1]
    message = types.deserialize(type_name, memoryview(cdr))
    every = max(1, -(-len(message.ranges) // MAX_RAYS))
    ranges = np.asarray(message.ranges[::every], np.float32)
    first, turn, low, high = (
        float(value) for value in (message.angle_min, message.angle_increment, message.range_min, message.range_max)
    )
    if not (math.isfinite(first) and math.isfinite(turn)):
        raise Rejected('malformed', 'a scan whose angles are not finite')
    is_measured = np.isfinite(ranges) & (ranges > 0) & (ranges >= low)
    if math.isfinite(high):
        is_measured &= ranges <= high
    most = float(ranges[is_measured].max(initial=1.0))
    step = most / 65_535
    sent = np.where(is_measured, np.maximum(1, np.nan_to_num(ranges, nan=0.0, posinf=0.0, neginf=0.0) / step + 0.5), 0)
    head = {'at': round(at_ms, 1), 'frame': message.header.frame_id[:80], 'first': first, 'turn': turn * every, 'step': step}
    return LiveItem(topic, 'scan', FULL, head, np.minimum(sent, 65_535).astype('<u2').tobytes())


def _map(topic: str, types: MessageTypes, type_name: str, messages: Messages) -> LiveItem:
    """Cells as uint8 (0 to 100, 255: unknown), deflated; cells that are merged get their maximum occupancy."""
    at_ms, cdr = messages[-1]
    message = types.deserialize(type_name, memoryview(cdr))
    info, origin = message.info, message.info.origin
    width, height, resolution = int(info.width), int(info.height), float(info.resolution)
    numbers = [resolution, origin.position.x, origin.position.y, origin.orientation.z, origin.orientation.w]
    if not width or not height or len(message.data) != width * height:
        raise Rejected('size_mismatch', f'a map of {width} x {height} cells with {len(message.data)} values')
    if not all(map(math.isfinite, numbers)) or resolution <= 0:
        raise Rejected('malformed', 'a map without a resolution or an origin')
    cells = np.asarray(message.data, np.int8).reshape(height, width)
    by = max(1, -(-max(width, height) // MAX_CELLS))
    if by > 1:
        cells = np.pad(cells, ((0, -height % by), (0, -width % by)), constant_values=-1)
        cells = cells.reshape(cells.shape[0] // by, by, cells.shape[1] // by, by).max(axis=(1, 3))
    sent = np.where((cells < 0) | (cells > 100), _UNKNOWN, cells).astype(np.uint8)
    turn = 2 * math.atan2(origin.orientation.z, origin.orientation.w)
    head = {
        'at': round(at_ms, 1), 'frame': message.header.frame_id[:80], 'width': sent.shape[1], 'height': sent.shape[0],
        'resolution': resolution * by, 'x': float(origin.position.x), 'y': float(origin.position.y), 'yaw': turn,
    }  # fmt: skip
    return LiveItem(topic, 'map', FULL, head, zlib.compress(sent.tobytes(), 1))


def _model(topic: str, types: MessageTypes, type_name: str, messages: Messages) -> LiveItem:
    """The XML of a robot's description."""
    at_ms, cdr = messages[-1]
    body = types.deserialize(type_name, memoryview(cdr)).data.encode(errors='replace')
    if len(body) > MAX_MODEL:
        raise Rejected('too_large', f'a description of {len(body):,} bytes; more than {MAX_MODEL:,} are not drawn')
    return LiveItem(topic, 'model', FULL, {'at': round(at_ms, 1)}, body)


def _transforms(cdr: bytes) -> Iterator[tuple[str, str, tuple[float, ...]]]:
    """Parent, child, translation and quaternion of each transform of a TFMessage in little-endian CDR. Raises struct.error."""
    (count,) = _LENGTH.unpack_from(cdr, 4)
    place = _FIRST_HEADER
    for _ in range(min(count, MAX_FRAMES)):
        place += 8  # the stamp
        names = []
        for _ in range(2):
            place += -place % 4
            (length,) = _LENGTH.unpack_from(cdr, place)
            names.append(cdr[place + 4 : place + 3 + length].decode('utf-8', 'replace').lstrip('/')[:80])
            place += 4 + length
        place += (4 - place) % 8
        yield names[0], names[1], _TRANSFORM.unpack_from(cdr, place)
        place += _TRANSFORM.size


class _Frames:
    """All frames of a topic with transforms, as parent, child and seven float32: x, y, z and the quaternion."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[str, float, tuple[float, ...]]] = {}

    def __call__(self, topic: str, types: MessageTypes, type_name: str, messages: Messages) -> LiveItem:
        for at_ms, cdr in messages:
            for parent, child, values in self._read(types, type_name, cdr):
                if all(map(math.isfinite, values)) and (child in self._known or len(self._known) < MAX_FRAMES):
                    self._known[child] = parent, at_ms, values
        now_ms = messages[-1][0]
        if not topic.endswith('_static'):
            self._known = {child: row for child, row in self._known.items() if now_ms - row[1] < _STALE_MS}
        names = [[parent, child] for child, (parent, _, _) in self._known.items()]
        body = np.array([values for _, _, values in self._known.values()], '<f4').tobytes()
        return LiveItem(topic, 'tf', FULL, {'at': round(now_ms, 1), 'frames': names}, body)

    def _read(self, types: MessageTypes, type_name: str, cdr: bytes) -> list[tuple[str, str, tuple[float, ...]]]:
        try:
            if len(cdr) > 8 and cdr[1] == _LITTLE:
                return list(_transforms(cdr))
        except (struct.error, IndexError):  # read by field, which reports what is wrong
            pass
        found: list[tuple[str, str, tuple[float, ...]]] = []
        for each in types.deserialize(type_name, memoryview(cdr)).transforms[:MAX_FRAMES]:
            place, turn = each.transform.translation, each.transform.rotation
            values = place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w
            found.append((each.header.frame_id.lstrip('/')[:80], each.child_frame_id.lstrip('/')[:80], values))
        return found


class _Statuses:
    """The newest diagnostics of each name: [name, level, message, hardware, [[key, value], ...]]."""

    def __init__(self) -> None:
        self._known: dict[str, list[Any]] = {}

    def __call__(self, topic: str, types: MessageTypes, type_name: str, messages: Messages) -> LiveItem:
        for _, cdr in messages:
            for each in types.deserialize(type_name, memoryview(cdr)).status:
                name = each.name[:MAX_LINE]
                if name in self._known or len(self._known) < MAX_STATUSES:
                    values = [[pair.key[:80], pair.value[:80]] for pair in each.values[:MAX_VALUES]]
                    self._known[name] = [name, _level(each.level), each.message[:MAX_LINE], each.hardware_id[:80], values]
        return LiveItem(topic, 'diagnostics', FULL, {'at': round(messages[-1][0], 1), 'rows': list(self._known.values())})


def _level(level: Any) -> int:
    """The level of a DiagnosticStatus: ``byte``, which is a number or one byte."""
    return level[0] if isinstance(level, (bytes, bytearray)) else int(level)


class _Lines:
    """The last lines of the log: [time (ms), level, node, text]."""

    def __init__(self) -> None:
        self._lines: deque[list[Any]] = deque(maxlen=MAX_LINES)

    def __call__(self, topic: str, types: MessageTypes, type_name: str, messages: Messages) -> LiveItem:
        for at_ms, cdr in messages[-MAX_LINES:]:
            line = types.deserialize(type_name, memoryview(cdr))
            self._lines.append([round(at_ms), int(line.level), line.name[:80], line.msg[:MAX_LINE]])
        return LiveItem(topic, 'rosout', FULL, {'at': round(messages[-1][0], 1), 'rows': list(self._lines)})


def _stateless(make: Maker) -> Callable[[], Maker]:
    return lambda: make


PANELS: Final[Mapping[str, Panel]] = {
    'sensor_msgs/msg/LaserScan': Panel(Kind('scan', 10.0, is_bulk=True), False, _stateless(_scan)),
    'nav_msgs/msg/OccupancyGrid': Panel(Kind('map', 1.0, is_bulk=True), False, _stateless(_map), is_latched=True),
    'tf2_msgs/msg/TFMessage': Panel(Kind('tf', 10.0, is_bulk=True), True, _Frames, is_latched=True),
    'diagnostic_msgs/msg/DiagnosticArray': Panel(Kind('diagnostics', 1.0, is_bulk=True), True, _Statuses),
    'rcl_interfaces/msg/Log': Panel(Kind('rosout', 1.0, is_bulk=True), True, _Lines),
}  # fmt: skip
"""By type of message."""
MODEL: Final = Panel(Kind('model', 1.0, is_bulk=True), False, _stateless(_model), is_latched=True)
_DESCRIPTION: Final = '/robot_description'
BULK: Final = frozenset({*(panel.kind.name for panel in PANELS.values()), MODEL.kind.name})
"""Kinds with only one size, whose newest item alone counts."""


def panel_of(topic: str, type_name: str) -> Panel | None:
    """How this module draws a topic, if it does."""
    return MODEL if type_name == 'std_msgs/msg/String' and topic.endswith(_DESCRIPTION) else PANELS.get(type_name)


def kind_of(topic: str, type_name: str) -> Kind | None:
    """How any module draws a topic; None if none does."""
    panel = panel_of(topic, type_name)
    return KINDS.get(type_name) if panel is None else panel.kind
