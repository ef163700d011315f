"""The pose of the robot and its battery level at the time of an object, from the messages of the last minute.

Messages of odometry, tf, GPS and batteries are sampled and kept verbatim; only those around an object's time are deserialized,
by the encoder that asks.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Final, NamedTuple

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import MissionSettings, SensorSettings
from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.core.metadata_keys import BATTERY, GPS, POSE
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.formats.records import FIX, ODOMETRY, TRANSFORMS
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.missions.odometer import Pose
from shadowhound_data_logger.node.encoding.message_track import MessageTrack
from shadowhound_data_logger.node.encoding.transforms import TransformTrack
from shadowhound_data_logger.node.intake.consumers import Consumer, Drained
from shadowhound_data_logger.node.recording.mission_observer import Source, Sources, battery_pct, yaw_of

POSE_EVERY_NS: Final = SECOND // 10
"""Time between two kept poses: linear interpolation is then within 2 mm on the tightest turn of a trotting Go2."""
BATTERY_EVERY_NS: Final = 5 * SECOND
BATTERY_AGE_NS: Final = 30 * SECOND
"""Maximum age of a battery level."""
FIX_EVERY_NS: Final = SECOND // 10
FIX_AGE_NS: Final = 2 * SECOND
"""Maximum age of a fix: many receivers have one per second."""
NO_FIX: Final = -1
"""NavSatStatus.STATUS_NO_FIX; -2, the default since Jazzy, means unknown."""
GAP_NS: Final = 3 * SECOND // 2
"""No interpolation across a longer gap."""
AHEAD_NS: Final = SECOND // 4
"""How far to extrapolate: objects are encoded before the next odometry message arrives."""
AT_ONCE_NS: Final = SECOND // 20
"""How long a single pose is valid, and how far to extrapolate before the first pose of several."""
MAX_TOPICS: Final = 16
"""Limit on topics of batteries, odometry and GPS, because publishers decide how many exist."""
_NO_WORD: Final = re.compile(r'[^!-~]')


class _Pose(NamedTuple):
    x: float
    y: float
    yaw: float
    frame: str


class _Fix(NamedTuple):
    latitude: float
    longitude: float
    altitude: float


class RobotTrack(Consumer):
    """Tracks the pose and battery of the robot over the last minute.

    New; ``take`` what the intake drained, ``mark`` each object on its way to the spool, on any thread.
    """

    def __init__(self, settings: MissionSettings, types: MessageTypes, resolve: Callable[[str], str], robot: str = '') -> None:
        """Odometry and batteries are those of missions; ``resolve`` makes full names, ``robot`` is the end of the namespace."""
        self._types = types
        self._odometry = Sources(settings.odometry, resolve)
        self._battery = Sources(settings.battery, resolve)
        self._transforms = TransformTrack(types, robot)
        self._poses: list[tuple[Source, MessageTrack]] = []
        self._charges: list[tuple[Source, MessageTrack]] = []
        self._fixes: list[tuple[Source, MessageTrack]] = []
        """The preferred source first. Replaced atomically."""

    def has_pose(self, sensor: SensorSettings) -> bool:
        """Whether its topics contain the pose of the robot: they are drained before the topics that are marked with it."""
        return any(name in {ODOMETRY, TRANSFORMS, FIX} for name in sensor.types)

    def take(self, drained: Drained) -> None:
        if drained.type == TRANSFORMS:
            for message in drained.messages:
                self._transforms.add(drained.topic, message)
            return
        kept = self.of(drained.topic, drained.type)
        if kept is not None:
            for message in drained.messages:
                kept.add(message.stamp_ns, message.cdr)

    def of(self, topic: str, type_name: str) -> MessageTrack | None:
        """The kept messages of a topic; None if they are not needed."""
        if type_name == ODOMETRY and (source := self._odometry.find(topic, type_name)) is not None:
            self._poses, kept = _added(self._poses, source, POSE_EVERY_NS, type_name, self._pose)
        elif type_name == FIX:
            self._fixes, kept = _added(self._fixes, Source(0, topic, []), FIX_EVERY_NS, type_name, self._fix)
        elif (source := self._battery.find(topic, type_name)) is not None:
            read = partial(self._charge, source.path)
            self._charges, kept = _added(self._charges, source, BATTERY_EVERY_NS, type_name, read)
        else:
            return None
        return kept

    def mark(self, item: DataObject) -> DataObject:
        """The object with the pose and battery at the middle of its time."""
        marks = self.marks((item.t_start_ns + item.t_end_ns) // 2)
        return replace(item, metadata={**item.metadata, **marks}) if marks else item

    def marks(self, stamp_ns: int) -> dict[str, str]:
        """Pose, GPS position and battery at a time, as metadata; unknown values are omitted."""
        marks: dict[str, str] = {}
        if (pose := self._pose_at(stamp_ns)) is not None:
            marks[POSE] = f'{_plain(pose.x, 3)} {_plain(pose.y, 3)} {_plain(pose.yaw, 4)} {pose.frame}'
        for _, fixes in self._fixes:
            if (fix := _fix_at(fixes.nearby(stamp_ns), stamp_ns)) is not None:
                marks[GPS] = f'{_plain(fix.latitude, 7)} {_plain(fix.longitude, 7)} {_plain(fix.altitude, 2)}'
                break
        for _, charges in self._charges:
            near = min(charges.nearby(stamp_ns), key=lambda found: abs(found[0] - stamp_ns), default=None)
            if near is not None and abs(near[0] - stamp_ns) <= BATTERY_AGE_NS:
                marks[BATTERY] = f'{near[1]:g}'
                break
        return marks

    def place(self, stamp_ns: int) -> Pose | None:
        """The pose from tf at a time, for missions of robots without odometry."""
        placed = self._transforms.at(stamp_ns)
        return None if placed is None else Pose(stamp_ns, placed.x, placed.y, placed.yaw, placed.z, placed.frame)

    def _pose_at(self, stamp_ns: int) -> _Pose | None:
        """In the map if possible, otherwise from odometry, otherwise from tf without a map."""
        placed = self._transforms.at(stamp_ns)
        of_tf = None if placed is None else _Pose(placed.x, placed.y, placed.yaw, _safe_frame(placed.frame))
        if placed is not None and placed.is_map:
            return of_tf
        for _, poses in self._poses:
            found = poses.nearby(stamp_ns)
            if found and (pose := _between(found, stamp_ns)) is not None:
                return pose
        return of_tf

    def _pose(self, type_name: str, cdr: bytes) -> _Pose | None:
        try:
            message = self._types.deserialize(type_name, cdr)
        except Rejected:  # the odometry's own objects already contain it
            return None
        at, yaw = message.pose.pose.position, yaw_of(message.pose.pose.orientation)
        if not all(map(math.isfinite, (at.x, at.y, yaw))):
            return None
        return _Pose(at.x, at.y, yaw, _safe_frame(message.header.frame_id))

    def _fix(self, type_name: str, cdr: bytes) -> _Fix | None:
        """None without a fix, and for an invalid position."""
        try:
            message = self._types.deserialize(type_name, cdr)
        except Rejected:
            return None
        latitude, longitude, altitude = message.latitude, message.longitude, message.altitude
        if message.status.status == NO_FIX or not (abs(latitude) <= 90 and abs(longitude) <= 180):
            return None
        return _Fix(latitude, longitude, altitude if math.isfinite(altitude) else math.nan)

    def _charge(self, path: list[str], type_name: str, cdr: bytes) -> float | None:
        try:
            return battery_pct(self._types.deserialize(type_name, cdr), path)
        except Rejected:
            return None


def _added(known: list[tuple[Source, MessageTrack]], source: Source, every_ns: int, type_name: str,
           read: Callable[[str, bytes], object]) -> tuple[list[tuple[Source, MessageTrack]], MessageTrack | None]:  # fmt: skip
    """Add the messages of a source; a topic whose type changed starts again. None if there are too many topics."""
    for of, kept in known:
        if of.topic == source.topic and kept.type == type_name:
            return known, kept
    others = [each for each in known if each[0].topic != source.topic]
    if len(others) >= MAX_TOPICS:
        return known, None
    made = MessageTrack(every_ns, type_name, read)
    return sorted([*others, (source, made)], key=lambda each: each[0][:2]), made


def _between(found: list[tuple[int, _Pose]], stamp_ns: int) -> _Pose | None:
    """The pose at a time, linearly interpolated or extrapolated from two others; yaw turns the shorter way."""
    (start_ns, a), (end_ns, b) = found[0], found[-1]
    if not (0 < end_ns - start_ns <= GAP_NS and start_ns - AT_ONCE_NS <= stamp_ns <= end_ns + AHEAD_NS and a.frame == b.frame):
        near_ns, near = min(found, key=lambda pose: abs(pose[0] - stamp_ns))
        return near if abs(near_ns - stamp_ns) <= AT_ONCE_NS else None
    part = (stamp_ns - start_ns) / (end_ns - start_ns)
    turn = (b.yaw - a.yaw + math.pi) % math.tau - math.pi
    yaw = (a.yaw + part * turn + math.pi) % math.tau - math.pi
    return _Pose(a.x + part * (b.x - a.x), a.y + part * (b.y - a.y), yaw, b.frame)


def _plain(value: float, digits: int) -> str:
    return f'{round(value, digits) + 0.0:.{digits}f}'  # no -0.000


def _fix_at(found: list[tuple[int, _Fix]], stamp_ns: int) -> _Fix | None:
    """The position at a time, linearly interpolated between two fixes, otherwise the nearest. Longitude takes the shorter way."""
    if not found:
        return None
    (start_ns, a), (end_ns, b) = found[0], found[-1]
    if not (0 < end_ns - start_ns <= 2 * FIX_AGE_NS and start_ns <= stamp_ns <= end_ns):
        near_ns, near = min(found, key=lambda fix: abs(fix[0] - stamp_ns))
        return near if abs(near_ns - stamp_ns) <= FIX_AGE_NS else None
    part = (stamp_ns - start_ns) / (end_ns - start_ns)
    turn = (b.longitude - a.longitude + 180) % 360 - 180
    longitude = (a.longitude + part * turn + 180) % 360 - 180
    return _Fix(a.latitude + part * (b.latitude - a.latitude), longitude, a.altitude + part * (b.altitude - a.altitude))


def _safe_frame(frame: str) -> str:
    return _NO_WORD.sub('_', frame)[:64] or '_'
