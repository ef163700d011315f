"""The pose of the robot from tf: the transforms of the last minute, chained from its base to the map.

Messages are kept verbatim, one per 0.1 s for each publisher and set of frames. Only the first message of a set, and those
with a frame between the base and the root of the tree, are deserialized, by the encoder that asks.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.core.model import Taken
from shadowhound_data_logger.formats.records import TRANSFORMS
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.encoding.message_track import SPAN_NS, MessageTrack

EVERY_NS: Final = SECOND // 10
BASES: Final = ('base_link', 'base_footprint', 'body')
"""Frames of the robot itself (REP 105), the preferred one first."""
MAP, ODOM = 'map', 'odom'
ODOM_GAP_NS, GAP_NS = 3 * SECOND // 2, 3 * SECOND
"""Maximum time between two transforms: of a frame below ``odom``, and of others, because localization is slower than odometry."""
AHEAD_NS: Final = SECOND // 4
"""How far to extrapolate a frame below ``odom``; others are not extrapolated, because corrections of a map jump."""
MAX_KEPT: Final = 256
"""Limit on sets of frames, because publishers decide how many exist."""
MAX_DEPTH: Final = 32
"""Maximum frames between base and root."""
_LENGTH: Final = (struct.Struct('>I'), struct.Struct('<I'))


class Placed(NamedTuple):
    """The pose of the robot's base in a frame: meters and radians."""

    x: float
    y: float
    z: float
    yaw: float
    frame: str
    is_map: bool


class Transform(NamedTuple):
    """From a frame to its parent."""

    parent: str
    shift: NDArray[np.float64]
    turn: NDArray[np.float64]
    """A quaternion: x y z w."""


Frames = Mapping[str, Transform]
"""Transforms by frame."""


@dataclass(slots=True)
class _Set:
    """Messages of one publisher with the same frames."""

    messages: MessageTrack
    is_static: bool
    frames: frozenset[str] | None = None
    """None until the first message was read."""


class TransformTrack:
    """Tracks the robot's frames over the last minute. One thread adds, any thread reads."""

    def __init__(self, types: MessageTypes, robot: str) -> None:
        """``robot`` is the last part of its namespace: if several robots share a tree, it prefixes their frames."""
        self._types = types
        self._prefixes = (f'{robot}/', '') if robot else ('',)
        self._sets: Mapping[tuple[str | None, int, bytes], _Set] = {}
        """By publisher, and by size and first frames of the message. Replaced atomically."""

    def add(self, topic: str, message: Taken) -> None:
        """Add a message; ``topic`` is the full name: static transforms are on ``tf_static``."""
        key = message.publisher, len(message.cdr), _first_frames(message.cdr)
        found = self._sets.get(key)
        if found is None:
            known = self._sets
            if len(known) >= MAX_KEPT:
                known = {each: one for each, one in known.items()
                         if one.is_static or message.stamp_ns - one.messages.newest_ns < SPAN_NS}  # fmt: skip
            if len(known) >= MAX_KEPT:
                return
            found = _Set(MessageTrack(EVERY_NS, TRANSFORMS, self._read), topic.endswith('_static'))
            self._sets = {**known, key: found}
        found.messages.add(message.stamp_ns, message.cdr)

    def at(self, stamp_ns: int) -> Placed | None:
        """The base in the map, otherwise in its odometry frame; None if neither is known at that time."""
        by_frame: dict[str, list[_Set]] = {}
        for each in self._sets.values():
            if each.frames is None:
                each.frames = frozenset(each.messages.newest() or ())
            for frame in each.frames:
                by_frame.setdefault(frame, []).append(each)
        for prefix in self._prefixes:
            for base in BASES:
                if prefix + base in by_frame and (placed := _placed(by_frame, prefix, base, stamp_ns)) is not None:
                    return placed
        return None

    def _read(self, type_name: str, cdr: bytes) -> Mapping[str, Transform]:
        """Transforms by frame; those that are not finite are skipped."""
        try:
            message = self._types.deserialize(type_name, cdr)
        except Rejected:
            return {}
        found = {}
        for each in message.transforms:
            at, turn = each.transform.translation, each.transform.rotation
            shift, quaternion = np.array([at.x, at.y, at.z]), np.array([turn.x, turn.y, turn.z, turn.w])
            length = float(np.linalg.norm(quaternion))
            if np.isfinite(shift).all() and 0.5 < length < 2.0:
                parent = each.header.frame_id.lstrip('/')
                found[each.child_frame_id.lstrip('/')] = Transform(parent, shift, quaternion / length)
        return found


def _placed(by_frame: Mapping[str, list[_Set]], prefix: str, base: str, stamp_ns: int) -> Placed | None:
    """Walk up the tree from the base: in the map if that is above it, otherwise in its odometry frame."""
    frame, shift, turn = prefix + base, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
    found = None
    for _ in range(MAX_DEPTH):
        up = next(_at(by_frame.get(frame, []), frame, stamp_ns), None)
        if up is None:
            return found
        frame, shift, turn = up.parent, up.shift + _rotated(up.turn, shift), _product(up.turn, turn)
        if frame in {MAP, prefix + MAP, prefix + ODOM}:
            x, y, z, w = turn
            yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
            found = Placed(float(shift[0]), float(shift[1]), float(shift[2]), yaw, frame, is_map=frame != prefix + ODOM)
            if found.is_map:
                return found
    return found


def _at(sets: list[_Set], frame: str, stamp_ns: int) -> Iterator[Transform]:
    """The transform of a frame at a time, from each publisher of it."""
    for each in sets:
        if each.is_static:
            newest = each.messages.newest()
            if frame in newest:
                yield newest[frame]
            continue
        nearby = [(ns, value[frame]) for ns, value in each.messages.nearby(stamp_ns) if frame in value]
        if nearby and (moved := _between(nearby, stamp_ns)) is not None:
            yield moved


def _between(found: list[tuple[int, Transform]], stamp_ns: int) -> Transform | None:
    """Interpolate or extrapolate from two transforms of a frame."""
    (start_ns, a), (end_ns, b) = found[0], found[-1]
    is_odom = b.parent.rpartition('/')[2] == ODOM
    gap_ns, ahead_ns = (ODOM_GAP_NS, AHEAD_NS) if is_odom else (GAP_NS, GAP_NS)
    if not start_ns - SECOND // 20 <= stamp_ns <= end_ns + ahead_ns:
        return None
    if a.parent != b.parent or not 0 < end_ns - start_ns <= gap_ns:
        near_ns, near = min(found, key=lambda one: abs(one[0] - stamp_ns))
        return near if abs(near_ns - stamp_ns) <= ahead_ns else None
    part = (stamp_ns - start_ns) / (end_ns - start_ns)
    part = part if is_odom else min(max(part, 0.0), 1.0)
    other = b.turn if a.turn @ b.turn >= 0 else -b.turn
    turn = a.turn + part * (other - a.turn)
    return Transform(b.parent, a.shift + part * (b.shift - a.shift), turn / np.linalg.norm(turn))


def _first_frames(cdr: bytes) -> bytes:
    """The two frame names of the first transform, without deserializing the message; empty if there is none."""
    if len(cdr) < 20 or cdr[1] > 1:
        return b''
    (length,) = _LENGTH[cdr[1]].unpack_from(cdr, 16)
    child = 20 + (length + 3) // 4 * 4
    if child + 4 > len(cdr):
        return b''
    (more,) = _LENGTH[cdr[1]].unpack_from(cdr, child)
    return cdr[20 : min(child + 4 + more, len(cdr), 1024)]


def _product(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """The product of two quaternions."""
    (ax, ay, az, aw), (bx, by, bz, bw) = a, b
    return np.array([
        aw * bx + ax * bw + ay * bz - az * by, aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    ])  # fmt: skip


def _rotated(turn: NDArray[np.float64], shift: NDArray[np.float64]) -> NDArray[np.float64]:
    axis, w = turn[:3], turn[3]
    across = 2 * np.cross(axis, shift)
    return np.asarray(shift + w * across + np.cross(axis, across))
