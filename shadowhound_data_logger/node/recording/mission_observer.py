"""Extracts what a mission logs from batches that were just encoded, on the encoders' threads.

It is not a consumer of the intake (``consumers.py``). Only what is logged is deserialized: one message per period of the
battery's and the thermometer's topic, and every kept pose.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, NamedTuple

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import MissionSettings, SensorSettings, fields_of, is_type
from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.core.model import Batch, DataObject, Sample
from shadowhound_data_logger.core.options import POINT_CLOUD
from shadowhound_data_logger.formats.image import encode_jpeg
from shadowhound_data_logger.formats.payload import Job
from shadowhound_data_logger.formats.pointcloud import xyz_of
from shadowhound_data_logger.formats.records import ODOMETRY, TRANSFORMS
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.missions.node_log import Cloud, Frame, MissionFact, Reading
from shadowhound_data_logger.missions.odometer import Pose
from shadowhound_data_logger.missions.state import BATTERY, TEMPERATURE

log = logging.getLogger(__name__)

POSE, FRAMES = 'pose', 'frames'
JPEG: Final = 'image/jpeg'
BATTERY_STATE: Final = 'sensor_msgs/msg/BatteryState'
_ROUNDING: Final = 1e-6
"""Float32 rounding of a full battery."""


class Source(NamedTuple):
    """A topic that provides a value."""

    rank: int
    """0 for the preferred one."""
    topic: str
    path: list[str]
    """Path of the field."""


class Sources:
    """Sources of a value, from a mission's setting: alternatives that are topics, or message types for any topic with them."""

    def __init__(self, given: str, resolve: Callable[[str], str]) -> None:
        self._by_topic: dict[str, tuple[int, list[str]]] = {}
        self._by_type: dict[str, tuple[int, list[str]]] = {}
        for rank, (name, path) in enumerate(fields_of(given)):
            if is_type(name):
                self._by_type.setdefault(name, (rank, path))
            else:
                self._by_topic.setdefault(resolve(name), (rank, path))

    def find(self, topic: str, type_name: str) -> Source | None:
        """The source for a topic (full name) and type; None if it provides no value."""
        found = self._by_topic.get(topic) or self._by_type.get(type_name)
        return None if found is None else Source(found[0], topic, found[1])


class MissionObserver:
    """Reads from batches what a mission logs: battery, temperature, poses, frames, floor.

    New; ``facts`` of each batch, on any thread. A topic that cannot be read is logged once.

    Two threads with batches of one topic may both take a value of one period: then there is one more.
    """

    def __init__(self, settings: MissionSettings, sensors: Mapping[str, SensorSettings], robot: str, types: MessageTypes,
                 resolve: Callable[[str], str], marks: Callable[[int], Mapping[str, str]] = lambda _: {},
                 place: Callable[[int], Pose | None] = lambda _: None) -> None:  # fmt: skip
        """``resolve`` makes a topic's full name, with the node's namespace and remappings.

        ``marks`` and ``place`` are those of ``RobotTrack``.
        """
        self._sensors = sensors
        self._robot = robot
        self._types = types
        self._period_ns = max(1, round(settings.period_s * SECOND))
        self._marks = marks
        self._pose_from_tf = place
        self._frames = Sources(settings.frames, str)
        self._frame_ns = max(1, round(settings.frame_every_s * SECOND))
        self._odometry = Sources(settings.odometry, resolve)
        self._fields = {BATTERY: Sources(settings.battery, resolve), TEMPERATURE: Sources(settings.temperature, resolve)}
        self._chosen: dict[str, Source] = {}
        """Metric -> the most preferred of its sources that was received."""
        self._periods: dict[tuple[str, int], int] = {}
        self._logged: set[str] = set()

    def facts(self, batch: Batch, item: DataObject | None = None) -> Iterator[MissionFact]:
        """What to log from a batch; ``item`` is its encoded object, None if there is none."""
        try:
            if batch.type == ODOMETRY and self._choose(POSE, self._odometry, batch):
                yield from (self._pose(sample) for sample in batch.samples)
            elif batch.type == TRANSFORMS and POSE not in self._chosen:
                yield from filter(None, (self._pose_from_tf(sample.stamp_ns) for sample in self._some(batch, SECOND // 10)))
            chosen = {key: self._choose(key, sources, batch) for key, sources in self._fields.items()}
            if fields := {key: source.path for key, source in chosen.items() if source is not None}:
                for sample in self._some(batch, self._period_ns):
                    yield from self._readings(batch.type, sample, fields)
            if batch.type == POINT_CLOUD:
                yield from (cloud for sample in self._some(batch, SECOND) if (cloud := self._cloud(sample)))
            if self._choose(FRAMES, self._frames, batch, batch.sensor):
                for sample in self._some(batch, self._frame_ns):
                    picture = self._jpeg(batch, sample, item)
                    if picture is not None:
                        yield Frame(sample.stamp_ns, picture, self._marks(sample.stamp_ns))
        except Rejected as error:
            self._log_once(batch.topic, str(error))

    def _choose(self, key: str, sources: Sources, batch: Batch, name: str = '') -> Source | None:
        """The source that the batch belongs to, unless a preferred one was received, or another topic of the same type.

        ``name`` is what the setting names, by default the topic.
        """
        found, before = sources.find(name or batch.topic, batch.type), self._chosen.get(key)
        if found is None or (before is not None and before.topic != found.topic and before.rank <= found.rank):
            return None
        self._chosen[key] = found
        return found

    def _jpeg(self, batch: Batch, sample: Sample, item: DataObject | None) -> bytes | None:
        """The JPEG of the sensor's object for this message, otherwise encode one; None if that is impossible."""
        if item is not None and len(batch.samples) == 1 and item.content_type == JPEG and isinstance(item.body, bytes):
            return item.body
        payload = encode_jpeg(Job(batch, self._sensors[batch.sensor], self._robot, self._types), sample)
        return payload.body if payload.content_type == JPEG else None

    def _some(self, batch: Batch, period_ns: int) -> Iterator[Sample]:
        """The first message of each period."""
        mark = batch.topic, period_ns
        for sample in batch.samples:
            period = sample.stamp_ns // period_ns
            if period != self._periods.get(mark):
                self._periods[mark] = period
                yield sample

    def _pose(self, sample: Sample) -> Pose:
        message = self._types.deserialize(ODOMETRY, sample.cdr)
        at, turn = message.pose.pose.position, message.pose.pose.orientation
        return Pose(sample.stamp_ns, at.x, at.y, yaw_of(turn), at.z, message.header.frame_id)

    def _cloud(self, sample: Sample) -> Cloud | None:
        """None for a cloud without x, y and z as float32."""
        message = self._types.deserialize(POINT_CLOUD, sample.cdr)
        xyz = xyz_of(message)
        return None if xyz is None else Cloud(sample.stamp_ns, message.header.frame_id, xyz)

    def _readings(self, type_name: str, sample: Sample, fields: Mapping[str, list[str]]) -> Iterator[Reading]:
        message = self._types.deserialize(type_name, sample.cdr)
        for key, path in fields.items():
            raw = number_at(message, path)
            value = battery_pct(message, path) if key == BATTERY else raw
            if raw is None:
                self._log_once(key, f'{type_name} has no number {".".join(path)}')
            elif value is not None and math.isfinite(value):
                yield Reading(sample.stamp_ns, key, value)
            elif math.isfinite(raw):
                self._log_once(key, f'{type_name} has {".".join(path)} = {raw:g}, which is not between 0 and 1')

    def _log_once(self, what: str, text: str) -> None:
        if what not in self._logged:
            self._logged.add(what)
            log.warning('%s is not logged to the mission: %s', what, text)


def number_at(message: Any, path: list[str]) -> float | None:
    """The number at the end of the path; None if there is none."""
    found = message
    try:
        for name in path:
            found = found[int(name)] if name.isdigit() else getattr(found, name)
        return float(found)
    except (AttributeError, IndexError, TypeError, ValueError):
        return None


def battery_pct(message: Any, path: list[str]) -> float | None:
    """The number at the end of the path as a charge in percent; None if it is unknown.

    ``sensor_msgs/msg/BatteryState.percentage`` is 0 to 1, and NaN if not measured. Other values do not follow the message's
    definition, so they count as unknown.
    """
    value = number_at(message, path)
    if value is None or not _is_share(message, path):
        return value if value is not None and math.isfinite(value) else None
    return 100 * value if 0 <= value <= 1 + _ROUNDING else None


def _is_share(message: Any, path: list[str]) -> bool:
    """Whether the path ends at the charge of a BatteryState, which may be part of another message or of an array."""
    found = message
    for name in path[:-1]:
        found = found[int(name)] if name.isdigit() else getattr(found, name)
    return path[-1] == 'percentage' and getattr(found, '__msgtype__', '') == BATTERY_STATE


def yaw_of(turn: Any) -> float:
    """The angle about z of a quaternion, radians in [-pi, pi]."""
    return math.atan2(2 * (turn.w * turn.z + turn.x * turn.y), 1 - 2 * (turn.y * turn.y + turn.z * turn.z))
