"""A robot's missions for the tests of datasets: objects made by the node's encoders, every value a formula of its stamp."""

from __future__ import annotations

import json
import math
import os
import signal
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import av
import numpy as np
import simplejpeg
from lake.gap_parts import tell
from lake.making import NOON_NS, add, folder_store
from lake.training import COMPRESSED, IMU, JOINTS, ODOMETRY, Drive

from shadowhound_data_logger.core.clock import SECOND, iso
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.formats.rows.catalog import BUCKET
from shadowhound_data_logger.formats.rows.gaps import GAP, Statement, complete, statement
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.stores import open_store

SIZE: Final = (64, 96)
"""Height and width of the images: the minimum for AV1."""
TOPICS: Final = {'camera': '/camera', 'odom': '/odom', 'imu': '/imu', 'joints': '/joints', 'cmd_vel': '/cmd_vel'}
"""The names that the encoder's tests use."""
TWIST: Final = 'geometry_msgs/msg/Twist'
Hits = Callable[[int, int], bool]
"""Whether the message with a number and a stamp exists."""


def every(_number: int, _stamp_ns: int) -> bool:
    return True


def x_of(stamp_ns: int) -> float:
    """The robot's x position: exact in a float32 for a minute of milliseconds."""
    return round((stamp_ns - NOON_NS) / SECOND % 4096, 3)


def pixels(stamp_ns: int) -> Any:
    """An image that shows its time: a moving bar on a color gradient."""
    height, width = SIZE
    rows, columns = np.mgrid[0:height, 0:width]
    tenth = (stamp_ns - NOON_NS) // (SECOND // 10)
    made = np.stack([rows * 2, columns * 2, np.full((height, width), 60 + tenth % 97)], axis=-1).astype(np.uint8)
    left = int(tenth * 7 % (width - 16))
    made[16:48, left : left + 16] = (250, 240, 30)
    return made


@dataclass
class Mission:
    """The published messages of a mission, and those that arrived."""

    name: str
    begin_s: float = 0.0
    seconds: float = 6.0
    camera_hz: float = 10.0
    odom_hz: float = 50.0
    task: str = 'walk round the house'
    jitter_ns: Callable[[str, int], int] = field(default=lambda _sensor, _number: 0)
    has: dict[str, Hits] = field(default_factory=dict)
    """Sensor -> which of its messages arrived."""
    gaps: Sequence[Statement] = ()
    told_until_s: float = 1.0
    """How long after its end the watermarks extend."""
    sensors: Sequence[str] = ('camera', 'odom', 'imu', 'joints')
    uncounted: Sequence[str] = ()
    """Sensors for which the robot cannot count losses: it never reports on them."""
    late_ns: Callable[[str, int], int] | None = None
    """Sensor and stamp -> the delay of the message; None for immediate arrival."""
    skipped: int = 0
    """Messages of each sensor that its settings skipped, by the watermark."""

    @property
    def begin_ns(self) -> int:
        return NOON_NS + round(self.begin_s * SECOND)

    @property
    def end_ns(self) -> int:
        return self.begin_ns + round(self.seconds * SECOND)

    def stamps(self, sensor: str) -> list[int]:
        """The stamps of the messages that arrived, from a second before the mission to a second after it."""
        rate = {'camera': self.camera_hz, 'odom': self.odom_hz, 'cmd_vel': 20.0}.get(sensor, 25.0)
        count = round((self.seconds + 2) * rate)
        every_one = [self.begin_ns - SECOND + round(number * SECOND / rate) for number in range(count)]
        moved = [stamp + self.jitter_ns(sensor, number) for number, stamp in enumerate(every_one)]
        hits = self.has.get(sensor, every)
        return sorted(stamp for number, stamp in enumerate(moved) if hits(number, stamp))


class House:
    """A store in a folder, and missions in it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.settings = folder_store(folder)
        self.source = Bucket(self.settings, BUCKET)
        self.drive = Drive(self.settings, folder)
        self._parts = 0

    def record(self, mission: Mission, *, archives: bool = True) -> Mission:
        """Objects of one second each (single images without ``archives``), the summary, the gaps and the watermarks."""
        made = []
        for sensor in mission.sensors:
            stamps = mission.stamps(sensor)
            if sensor == 'camera' and not archives:
                singles = [self.drive.one(COMPRESSED, [stamp], [self._cdr(sensor, stamp)], rate_hz=1000.0) for stamp in stamps]
                made += [_arrived(mission, sensor, [stamp], one) for stamp, one in zip(stamps, singles, strict=True)]
                continue
            for second in sorted({stamp // SECOND for stamp in stamps}):
                some = [stamp for stamp in stamps if stamp // SECOND == second]
                how: dict[str, Any] = {'format': 'tar'} if sensor == 'camera' else {}
                cdrs = [self._cdr(sensor, stamp) for stamp in some]
                one = self.drive.one(self._type(sensor), some, cdrs, batch_s=1.0, rate_hz=0.0, sensor=sensor, **how)
                made.append(_arrived(mission, sensor, some, one))
        marks = {'mission_id': mission.name, 'run_id': f'run{mission.name}', 'mission_type': 'patrol'}
        self.drive.store(made, **marks)
        fields = {
            'mission_id': mission.name, 'mission_type': 'patrol', 'mission_command': mission.task, 'success': True,
            'start': iso(mission.begin_ns), 'end': iso(mission.end_ns), 'result': 'FINISHED', 'duration_s': mission.seconds,
        }  # fmt: skip
        with closing(open_store(self.settings, UploadSettings())) as store:
            add(store, self.folder / 'tmp', f'thor/missions/run{mission.name}/summary.json', json.dumps(fields).encode())
        self.tell(mission, mission.told_until_s)
        return mission

    def tell(self, mission: Mission, until_s: float) -> None:
        """The robot's statements about this mission's losses, up to this time after its end."""
        until = mission.end_ns + round(until_s * SECOND)
        marks = [
            complete('thor', 'j', 10 + self._parts, sink='objects', topic=TOPICS[sensor], session=1 + round(mission.begin_s),
                     grade='exact', from_ns=mission.begin_ns - 2 * SECOND, to_ns=until, received=1000, skipped=mission.skipped,
                     received_from_ns=mission.begin_ns - 2 * SECOND, received_to_ns=until)
            for sensor in mission.sensors if sensor not in mission.uncounted
        ]  # fmt: skip
        tell(self.settings, self.folder, *mission.gaps, *marks, name=f'part{self._parts}')
        self._parts += 1

    def _type(self, sensor: str) -> str:
        return {'camera': COMPRESSED, 'odom': ODOMETRY, 'imu': IMU, 'joints': JOINTS, 'cmd_vel': TWIST}[sensor]

    def _cdr(self, sensor: str, stamp: int) -> bytes:
        return cdr_of(self.drive._ros, sensor, stamp)


def _arrived(mission: Mission, sensor: str, stamps: Sequence[int], made: DataObject) -> DataObject:
    """With both arrival times."""
    if mission.late_ns is None:
        return made
    received = [stamp + mission.late_ns(sensor, stamp) for stamp in stamps]
    pair = {'received_start_ns': str(min(received)), 'received_end_ns': str(max(received))}
    return replace(made, metadata={**made.metadata, **pair})


def cdr_of(ros: Any, sensor: str, stamp: int) -> bytes:
    """A message of this time; its numbers are formulas of the stamp."""
    x = x_of(stamp)
    if sensor == 'camera':
        body = simplejpeg.encode_jpeg(pixels(stamp), quality=90)
        return bytes(ros.cdr(COMPRESSED, format='jpeg', data=np.frombuffer(body, np.uint8), header=header(stamp)))
    if sensor == 'odom':
        turn = math.sin(x) / 2
        pose = {'position': {'x': x, 'y': math.cos(x), 'z': x / 10}, 'orientation': {'z': math.sin(turn), 'w': math.cos(turn)}}
        return bytes(ros.cdr(ODOMETRY, pose={'pose': pose}, header=header(stamp)))
    if sensor == 'imu':
        return bytes(ros.cdr(IMU, gyroscope=np.full(3, x, np.float32)))
    if sensor == 'cmd_vel':
        return bytes(ros.cdr(TWIST, linear={'x': x, 'y': 0.5}, angular={'z': -x}))
    return bytes(ros.cdr(JOINTS, name=[f'leg{n}' for n in range(12)], position=np.full(12, x), header=header(stamp)))


def video_frames(path: Path) -> list[tuple[float, Any]]:
    """(seconds, pixels RGB) of each frame of a video."""
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        return [(float(frame.pts * stream.time_base), frame.to_ndarray(format='rgb24')) for frame in file.decode(stream)]


def header(stamp: int) -> dict[str, Any]:
    return {'stamp': {'sec': stamp // SECOND, 'nanosec': stamp % SECOND}}


def lost(mission: Mission, sensor: str, first_s: float, last_s: float, cause: str = 'transport', **more: Any) -> Statement:
    """A gap from one second of a mission to another, as in the journal."""
    named = {
        'sink': 'objects',
        'topic': TOPICS[sensor],
        'session': 1,
        'grade': 'exact',
        'kind': 'missed',
        'count': 5,
        'merged': 1,
    }
    begin, end = (mission.begin_ns + round(each * SECOND) for each in (first_s, last_s))
    return statement('thor', GAP, f'j/{sensor}{first_s}', 5, **{**named, 'publisher': sensor, 'cause': cause, **more},
                     from_ns=begin, to_ns=end)  # fmt: skip


def kill_this_process(*_: Any) -> None:
    """In a worker, which imports this module: the tests' own modules cannot be imported there."""
    os.kill(os.getpid(), signal.SIGKILL)
