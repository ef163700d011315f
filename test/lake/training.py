"""A robot's drive for the tests of datasets: objects are made by the node's encoders, the expected values by a formula."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import simplejpeg
from formats.conftest import GO2_MESSAGES, Ros
from lake.making import NOON_NS, add, add_part

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.formats.rows import catalog
from shadowhound_data_logger.lake import MissionDataset
from shadowhound_data_logger.stores import open_store

COMPRESSED, CLOUD, IMU = 'sensor_msgs/msg/CompressedImage', 'sensor_msgs/msg/PointCloud2', 'go2_interfaces/msg/IMU'
ODOMETRY, JOINTS, LOWSTATE = 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/JointState', 'go2_interfaces/msg/LowState'
IMU_HZ: Final = 20
JOINTS_HZ: Final = 5
FRAMES_HZ: Final = 4
"""Of archives; single frames are at 1 Hz."""
_PREFIX: Final = TemporaryDirectory()
LATE_NS: Final = 30_000_000
"""The delay of odometry after the frame of its second."""


def pixels(number: int) -> Any:
    """The pixels of a frame before JPEG compression: no two are alike."""
    rows = np.arange(24, dtype=np.uint8)[:, None, None] * 4
    return np.broadcast_to(rows + np.array([number * 7 % 150, 60, number % 13], np.uint8), (24, 32, 3)).copy()


def jpeg(number: int) -> bytes:
    return bytes(simplejpeg.encode_jpeg(pixels(number), quality=90))


def seconds_of(stamp_ns: int) -> float:
    return (stamp_ns - NOON_NS) / SECOND


def imu_reading(stamp_ns: int) -> list[float]:
    """Gyroscope, accelerometer, quaternion."""
    t = seconds_of(stamp_ns)
    return [t, 0.0, -t, 0.0, 0.0, 9.81, 1.0, 0.0, 0.0, 0.0]


@lru_cache
def _ros() -> Ros:
    """One for all: it reads the message definitions from a prefix that exists as long as the process."""
    share = Path(_PREFIX.name) / 'share' / 'go2_interfaces'
    share.mkdir(parents=True)
    (share / 'msg').symlink_to(GO2_MESSAGES, target_is_directory=True)
    return Ros(share.parents[1])


class Drive:
    """Encodes the messages published in a period, and stores the objects."""

    def __init__(self, settings: StoreSettings, tmp: Path, robot: str = 'thor') -> None:
        self.settings, self.robot = settings, robot
        self._ros = _ros()
        self._folder = tmp / 'bodies'
        self.rows: list[catalog.Row] = []
        self.late_ns: dict[str, int] = {}
        """Sensor -> delay of its messages after their stamps."""
        self.has_arrivals = True

    def record(self, seconds: int, *, frames: str = 'jpeg', without: Sequence[str] = (), first: int = 0) -> None:
        """``frames``: jpeg, one per second; tar or zip, ``FRAMES_HZ`` frames in one archive per second."""
        made: list[DataObject] = []
        for second in range(first, first + seconds):
            begin = NOON_NS + second * SECOND
            made += self._frames(begin, second, frames)
            made += self._sides(begin, second, without)
        self.store(made)

    def store(self, made: Sequence[DataObject], **more: str) -> None:
        """The objects, and their rows as a part."""
        rows = []
        with closing(open_store(self.settings, UploadSettings())) as store:
            for one in made:
                body = bytes(one.body) if isinstance(one.body, bytes) else b''
                middle = seconds_of((one.t_start_ns + one.t_end_ns) // 2)
                metadata = {**one.metadata, 'pose': f'{middle:.6f} {-middle:.6f} 0.5 odom', 'battery_pct': '77.5', **more}
                late_ns = self.late_ns.get(one.sensor, 0)
                received = {name: str(at_ns + late_ns) for name, at_ns in
                            (('received_start_ns', one.t_start_ns), ('received_end_ns', one.t_end_ns))}  # fmt: skip
                metadata = {**(received if self.has_arrivals else {}), **metadata}
                add(store, self._folder, one.key, body, metadata, content_type=one.content_type)
                fields = {**metadata, 'sha256': hashlib.sha256(body).hexdigest()}
                rows.append(catalog.row_of(one.bucket, one.key, len(body), one.content_type, fields))
            add_part(store, rows, f'part{len(self.rows)}', self._folder)
        self.rows += rows

    def catalogue(self, told: Sequence[tuple[DataObject, Mapping[str, str]]]) -> None:
        """Rows without separate objects, such as those of repeats."""
        rows = []
        for one, metadata in told:
            assert isinstance(one.body, bytes)
            sha256 = hashlib.sha256(one.body).hexdigest()
            rows.append(catalog.row_of(one.bucket, one.key, len(one.body), one.content_type, {**metadata, 'sha256': sha256}))
        with closing(open_store(self.settings, UploadSettings())) as store:
            add_part(store, rows, f'part{len(self.rows)}', self._folder)
        self.rows += rows

    def one(self, kind: str, stamps: Sequence[int], cdrs: Sequence[bytes], **changes: Any) -> DataObject:
        found = self._ros.encode(kind, *cdrs, stamps=list(stamps), **changes).object
        assert found is not None
        key = f'{self.robot}/{found.key.partition("/")[2]}'
        return replace(found, key=key, metadata={**found.metadata, 'robot': self.robot})

    def _frames(self, begin: int, second: int, frames: str) -> list[DataObject]:
        if frames == 'jpeg':
            return [self.one(COMPRESSED, [begin], [self.frame(second)])]
        stamps = [begin + number * SECOND // FRAMES_HZ for number in range(FRAMES_HZ)]
        cdrs = [self.frame(second * FRAMES_HZ + number) for number in range(FRAMES_HZ)]
        return [self.one(COMPRESSED, stamps, cdrs, format=frames, batch_s=1.0, rate_hz=0.0, dedup=True)]

    def frame(self, number: int) -> bytes:
        return bytes(self._ros.cdr(COMPRESSED, format='jpeg', data=np.frombuffer(jpeg(number), np.uint8)))

    def _sides(self, begin: int, second: int, without: Sequence[str]) -> list[DataObject]:
        ros = self._ros
        made: dict[str, DataObject] = {}
        late = begin + LATE_NS
        made['odom'] = self.one(ODOMETRY, [late], [self._odometry(second)])
        imu = [begin + number * SECOND // IMU_HZ for number in range(IMU_HZ)]
        made['imu'] = self.one(IMU, imu, [self._imu(stamp) for stamp in imu], batch_s=1.0, rate_hz=0.0)
        joints = [begin + number * SECOND // JOINTS_HZ for number in range(JOINTS_HZ)]
        positions = [ros.cdr(JOINTS, position=np.full(12, seconds_of(stamp))) for stamp in joints]
        made['joints'] = self.one(JOINTS, joints, positions, batch_s=1.0, rate_hz=0.0)
        made['lowstate'] = self.one(LOWSTATE, [begin], [ros.cdr(LOWSTATE, bms_state={'soc': 77}, power_v=29.5)], batch_s=1.0)
        made['lidar'] = self.one(CLOUD, [begin], [self._cloud(second)])
        return [each for name, each in made.items() if name not in without]

    def _odometry(self, second: int) -> bytes:
        return bytes(self._ros.cdr(ODOMETRY, pose={'pose': {'position': {'x': float(second)}}}))

    def _imu(self, stamp_ns: int) -> bytes:
        report = np.array(imu_reading(stamp_ns), np.float32)
        return bytes(self._ros.cdr(IMU, gyroscope=report[:3], accelerometer=report[3:6], quaternion=report[6:]))

    def _cloud(self, second: int) -> bytes:
        points = np.arange(4 * (second + 2), dtype='<f4').reshape(-1, 4)
        names = ('x', 'y', 'z', 'intensity')
        fields = [self._ros.make('sensor_msgs/msg/PointField', name=name, offset=4 * place, datatype=7, count=1)
                  for place, name in enumerate(names)]  # fmt: skip
        values = {'height': 1, 'width': len(points), 'point_step': 16, 'row_step': 16 * len(points), 'fields': fields}
        return bytes(self._ros.cdr(CLOUD, **values, data=points.view(np.uint8).reshape(-1)))


def in_a_child(frames: MissionDataset, numbers: Sequence[int], out: Any) -> None:
    """The times of these samples, read in another process; a function that a spawned process can import."""
    out.put([int(sample['stamp_ns']) for sample in frames.__getitems__(numbers)])
    frames.close()
