"""Where the robot was, and how full its battery was, at the time of an object: read from the messages of the last minute.

Some messages of the two topics are kept as they came; only those around an object's time are ever deserialized, by the encoder
that asks.
"""

from __future__ import annotations

import math
import re
import threading
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, NamedTuple

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import MissionSettings, fields_of
from shadowhound_data_logger.core.errors import Rejected
from shadowhound_data_logger.core.metadata_words import BATTERY, POSE
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.formats.records import ODOMETRY
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.intake.consumers import Consumer, Drained
from shadowhound_data_logger.node.recording.mission_observer import battery_pct, yaw_of

SPAN_NS: Final = 60 * SECOND
"""How far back is remembered: batches, queues and slow encoders ask late."""
POSE_EVERY_NS: Final = SECOND // 10
"""Between two poses that are kept: a straight line instead of the tightest bend that a Go2 trots is then 2 mm off."""
BATTERY_EVERY_NS: Final = 5 * SECOND
BATTERY_AGE_NS: Final = 30 * SECOND
"""A charge of that age is still the robot's."""
GAP_NS: Final = 3 * SECOND // 2
"""Over a longer silence nothing is interpolated."""
AHEAD_NS: Final = SECOND // 4
"""For so long the robot is taken to go on as it did: objects are encoded before the next odometry has come."""
AT_ONCE_NS: Final = SECOND // 20
"""For so long one pose alone holds, and the robot is taken to have gone as it does before the first of several."""
_NO_WORD: Final = re.compile(r'[^!-~]')


@dataclass(slots=True)
class _Kept:
    """A message and, once somebody asked for it, what it says."""

    stamp_ns: int
    cdr: bytes
    value: Any = None


class _Pose(NamedTuple):
    x: float
    y: float
    yaw: float
    frame: str


class KeptMessages:
    """Some messages of one topic and type: one each ``every_ns`` and the newest. One thread adds, any asks; ``_lock`` guards."""

    def __init__(self, every_ns: int, type_name: str, read: Callable[[str, bytes], Any]) -> None:
        """``read`` makes a value of a message; None where it says nothing."""
        self._every_ns = every_ns
        self.type = type_name
        self._read = read
        self._lock = threading.Lock()
        self._stamps: list[int] = []
        self._kept: list[_Kept] = []

    def add(self, stamp_ns: int, cdr: bytes) -> None:
        """A message, in the order of their times; after a step of the clock back the track starts again."""
        with self._lock:
            stamps, kept = self._stamps, self._kept
            if stamps and stamp_ns <= stamps[-1]:
                if stamps[-1] - stamp_ns < SECOND:
                    return
                stamps.clear()
                kept.clear()
            if len(stamps) > 1 and stamps[-1] - stamps[-2] < self._every_ns:
                stamps[-1], kept[-1] = stamp_ns, _Kept(stamp_ns, cdr)
                return
            stamps.append(stamp_ns)
            kept.append(_Kept(stamp_ns, cdr))
            if stamp_ns - stamps[0] > 2 * SPAN_NS:
                old = bisect_left(stamps, stamp_ns - SPAN_NS)
                del stamps[:old], kept[:old]

    def around(self, stamp_ns: int) -> list[tuple[int, Any]]:
        """(time, value) of the two messages about a time; at an end of the track the last two, or the only one."""
        with self._lock:
            after = bisect_left(self._stamps, stamp_ns)
            first = max(0, min(after - 1, len(self._stamps) - 2))
            found = self._kept[first : first + 2]
            if after == len(self._stamps) > 2 and self._stamps[-1] - self._stamps[-2] < self._every_ns // 2:
                found[0] = self._kept[-3]  # too near one another to tell a speed
        return [(kept.stamp_ns, value) for kept in found if (value := self._value(kept)) is not None]

    def _value(self, kept: _Kept) -> Any:
        if kept.value is None:
            kept.value = self._read(self.type, kept.cdr)
        return kept.value


class RobotTrack(Consumer):
    """Knows where the robot was, and its battery, over the last minute.

    New; ``take`` what the intake drained, ``mark`` each object on its way to the spool, on any thread.
    """

    def __init__(self, settings: MissionSettings, types: MessageTypes, resolve: Callable[[str], str]) -> None:
        """The topics are those of missions; ``resolve`` makes their full names."""
        self._types = types
        self.odometry = resolve(settings.odometry) if settings.odometry else ''
        self._batteries = {resolve(topic): path for topic, path in fields_of(settings.battery)}
        self._poses: KeptMessages | None = None
        self._charges: dict[str, KeptMessages] = {}
        """Topic of a battery -> its messages."""

    def take(self, drained: Drained) -> None:
        kept = self.of(drained.topic, drained.type)
        if kept is not None:
            for message in drained.messages:
                kept.add(message.stamp_ns, message.cdr)

    def of(self, topic: str, type_name: str) -> KeptMessages | None:
        """Where messages of a topic are kept; None where nobody needs them."""
        if topic == self.odometry and type_name == ODOMETRY:
            if self._poses is None:
                self._poses = KeptMessages(POSE_EVERY_NS, type_name, self._pose)
            return self._poses
        path = self._batteries.get(topic)
        if path is None:
            return None
        charges = self._charges.get(topic)
        if charges is None or charges.type != type_name:
            charges = self._charges[topic] = KeptMessages(BATTERY_EVERY_NS, type_name, partial(self._charge, path))
        return charges

    def mark(self, item: DataObject) -> DataObject:
        """The object with what is known of the middle of its time."""
        marks = self.marks((item.t_start_ns + item.t_end_ns) // 2)
        return replace(item, metadata={**item.metadata, **marks}) if marks else item

    def marks(self, stamp_ns: int) -> dict[str, str]:
        """Pose and battery at a time, as metadata; without what is not known."""
        marks: dict[str, str] = {}
        found = self._poses.around(stamp_ns) if self._poses is not None else []
        if found and (pose := _between(found, stamp_ns)) is not None:
            marks[POSE] = f'{_plain(pose.x, 3)} {_plain(pose.y, 3)} {_plain(pose.yaw, 4)} {pose.frame}'
        for charges in filter(None, map(self._charges.get, self._batteries)):
            near = min(charges.around(stamp_ns), key=lambda found: abs(found[0] - stamp_ns), default=None)
            if near is not None and abs(near[0] - stamp_ns) <= BATTERY_AGE_NS:
                marks[BATTERY] = f'{near[1]:g}'
                break
        return marks

    def _pose(self, type_name: str, cdr: bytes) -> _Pose | None:
        try:
            message = self._types.deserialize(type_name, cdr)
        except Rejected:  # the odometry's own objects tell of it
            return None
        at, yaw = message.pose.pose.position, yaw_of(message.pose.pose.orientation)
        if not all(map(math.isfinite, (at.x, at.y, yaw))):
            return None
        return _Pose(at.x, at.y, yaw, _NO_WORD.sub('_', message.header.frame_id)[:64] or '_')

    def _charge(self, path: list[str], type_name: str, cdr: bytes) -> float | None:
        try:
            return battery_pct(self._types.deserialize(type_name, cdr), path)
        except Rejected:
            return None


def _between(found: list[tuple[int, _Pose]], stamp_ns: int) -> _Pose | None:
    """The pose at a time between or near two others, straight on; yaw turns the shorter way."""
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
