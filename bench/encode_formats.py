"""Prints the CPU microseconds per message of the encode stage, for the messages of a Go2.

Run it as ``python bench/encode_formats.py``; it needs no ROS and takes some ten seconds. ``--json > before.jsonl`` saves the
results, ``--against before.jsonl`` shows the change as a ratio (comparable only on one machine).
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from timeit import Timer
from typing import Any, NamedTuple

import numpy as np
import simplejpeg
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from shadowhound_data_logger.core.config import SensorSettings, Settings
from shadowhound_data_logger.core.model import Batch, Sample
from shadowhound_data_logger.formats.encoders import encode
from shadowhound_data_logger.formats.types import MessageTypes

INTERFACES = Path(__file__).parents[1] / 'interfaces' / 'go2_interfaces' / 'msg'
STAMP_NS = 1_760_788_800_250_000_000
REPEATS = 5
SECONDS_EACH = 0.2


class Case(NamedTuple):
    """One row: ``messages`` of a type in one object."""

    name: str
    sensor: str
    type: str
    cdr: bytes
    messages: int = 1
    format: str = ''
    """Set if it is not the sensor's own format."""


class Row(NamedTuple):
    """The measurement; microseconds are per message, bytes are of the complete object."""

    name: str
    decode_us: float
    encode_us: float
    bytes_in: int
    bytes_out: int


class Messages:
    """Creates the messages of the benchmark."""

    def __init__(self) -> None:
        self.store = get_typestore(Stores.LATEST)
        for path in sorted(INTERFACES.glob('*.msg')):
            self.store.register(get_types_from_msg(path.read_text(), f'go2_interfaces/msg/{path.stem}'))
        self.rng = np.random.default_rng(7)

    def of(self, type_name: str, *values: Any) -> Any:
        kind = self.store.types[type_name]
        names = [name for name, _ in self.store.fielddefs[type_name][1]]
        constants = {name: value for name, _, value in self.store.fielddefs[type_name][0]}
        extra = {name: value for name, value in constants.items() if name in getattr(kind, '__dataclass_fields__', {})}
        return kind(**dict(zip(names, values, strict=True)), **extra)

    def cdr(self, type_name: str, *values: Any) -> bytes:
        return bytes(self.store.serialize_cdr(self.of(type_name, *values), type_name))

    def header(self) -> Any:
        return self.of('std_msgs/msg/Header', self.of('builtin_interfaces/msg/Time', 1_760_788_800, 250_000_000), 'odom')

    def floats(self, count: int) -> Any:
        return self.rng.normal(size=count).astype(np.float32)

    def imu(self) -> tuple[Any, ...]:
        return self.floats(4), self.floats(3), self.floats(3), self.floats(3), 31

    def standard_imu(self) -> tuple[Any, ...]:
        """sensor_msgs/msg/Imu: nested vectors and three covariances, all float64."""
        turn = self.of('geometry_msgs/msg/Quaternion', *self.rng.normal(size=4).tolist())
        rate, push = (self.of('geometry_msgs/msg/Vector3', *self.rng.normal(size=3).tolist()) for _ in range(2))
        return self.header(), turn, self.rng.normal(size=9), rate, self.rng.normal(size=9), push, self.rng.normal(size=9)

    def depth(self) -> Any:
        """640 x 480 millimeters of a slanted wall, with noise and 10 % of holes."""
        wall = np.linspace(500, 6000, 640)[None, :] + np.linspace(0, 2000, 480)[:, None]
        noisy = (wall + self.rng.normal(0, 4, wall.shape)).astype(np.uint16)
        return np.where(self.rng.random(wall.shape) < 0.1, np.uint16(0), noisy)

    def lowstate(self) -> tuple[Any, ...]:
        pair, feet, ntc = np.zeros(2, np.uint32), np.full(4, 120, np.int16), np.full(2, 30, np.int8)
        motors = [self.of('go2_interfaces/msg/MotorState', 1, *self.floats(7).tolist(), 40, 0, pair) for _ in range(20)]
        bms = self.of('go2_interfaces/msg/BmsState', 1, 2, 3, 87, -1200, 40, ntc, ntc, np.full(15, 3900, np.uint16))
        imu = self.of('go2_interfaces/msg/IMU', *self.imu())
        start = (np.zeros(2, np.uint8), 0, 0, pair, pair, 0, imu, motors, bms, feet, feet, 7, np.zeros(40, np.uint8))
        return *start, 0, 0.1, 30, 31, 28.7, 1.3, np.zeros(4, np.uint16), 0, 99

    def cloud(self, points: int, floats: int) -> tuple[Any, ...]:
        """A cloud of x y z intensity with a stride of ``floats`` float32."""
        names = ('x', 'y', 'z', 'intensity')
        fields = [self.of('sensor_msgs/msg/PointField', name, 4 * index, 7, 1) for index, name in enumerate(names)]
        data = self.floats(points * floats).view(np.uint8)
        return self.header(), 1, points, fields, False, 4 * floats, data.size, data, True

    def picture(self) -> Any:
        """640 x 480 pixels that compress like a room: flat areas, edges and some noise."""
        blocks = np.kron(self.rng.integers(0, 230, (30, 40, 3), np.uint8), np.ones((16, 16, 1), np.uint8))
        return np.ascontiguousarray(blocks + self.rng.integers(0, 24, blocks.shape, np.uint8))

    def joints(self) -> tuple[Any, ...]:
        none = np.zeros(0)
        return self.header(), [f'joint_{index}' for index in range(12)], self.floats(12).astype(np.float64), none, none

    def cases(self) -> Iterator[Case]:
        """One per format, with the sensor and type that usually use it."""
        yield from self.numbers()
        yield from self.images()
        cloud = 'sensor_msgs/msg/PointCloud2'
        packed = self.cdr(cloud, *self.cloud(20_000, 4))
        yield Case('pcd    PointCloud2, 20,000 points', 'lidar', cloud, packed)
        yield Case('pcd    the same with padding', 'lidar', cloud, self.cdr(cloud, *self.cloud(20_000, 8)))
        yield Case('tar    PointCloud2, batch of 10', 'lidar', cloud, packed, 10, 'tar')
        yield Case('cdr    PointCloud2', 'lidar', cloud, packed, 1, 'cdr')

    def numbers(self) -> Iterator[Case]:
        imu, joints, low = 'go2_interfaces/msg/IMU', 'sensor_msgs/msg/JointState', 'go2_interfaces/msg/LowState'
        standard = 'sensor_msgs/msg/Imu'
        yield Case('json   IMU, batch of 100', 'imu', imu, self.cdr(imu, *self.imu()), 100)
        yield Case('json   IMU, batch of 2,000', 'imu', imu, self.cdr(imu, *self.imu()), 2000)
        yield Case('json   sensor_msgs Imu, batch of 2,000', 'imu', standard, self.cdr(standard, *self.standard_imu()), 2000)
        yield Case('json   JointState, batch of 50', 'joints', joints, self.cdr(joints, *self.joints()), 50)
        yield Case('json   LowState, batch of 10', 'lowstate', low, self.cdr(low, *self.lowstate()), 10)

    def images(self) -> Iterator[Case]:
        image, compressed = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
        picture, depth = self.picture(), self.depth()
        jpeg = np.frombuffer(simplejpeg.encode_jpeg(picture, 85, 'BGR', '420'), np.uint8)
        published = self.cdr(compressed, self.header(), 'jpeg', jpeg)
        raw = self.cdr(image, self.header(), 480, 640, 'bgr8', 0, 1920, picture.reshape(-1))
        deep = self.cdr(image, self.header(), 480, 640, '16UC1', 0, 1280, depth.reshape(-1).view(np.uint8))
        meters = (depth / 1000).astype(np.float32).reshape(-1).view(np.uint8)
        yield Case('jpeg   CompressedImage', 'camera', compressed, published)
        yield Case('jpeg   Image 640x480 bgr8', 'camera', image, raw)
        yield Case('jpeg   Image 640x480 16UC1: PNG', 'camera', image, deep)
        yield Case('jpeg   Image 640x480 32FC1: TIFF', 'camera', image,
                   self.cdr(image, self.header(), 480, 640, '32FC1', 0, 2560, meters))  # fmt: skip
        yield Case('png    Image 640x480 bgr8', 'camera', image, raw, 1, 'png')
        yield Case('tar    CompressedImage, batch of 30', 'camera', compressed, published, 30, 'tar')
        yield Case('zip    CompressedImage, batch of 30', 'camera', compressed, published, 30, 'zip')


def measure(case: Case, sensor: SensorSettings, types: MessageTypes) -> Row:
    """The best of several runs: other load can only add time."""
    samples = tuple(Sample(STAMP_NS + index, case.cdr) for index in range(case.messages))
    batch = Batch(case.sensor, f'/{case.sensor}', case.type, samples, len(case.cdr) * case.messages)
    encoding = encode(batch, sensor, 'thor', types)
    if encoding.object is None:
        raise SystemExit(f'{case.name}: {dict(encoding.rejected)}')
    cdr = case.cdr if sensor.format == 'json' else memoryview(case.cdr)
    decode_us = best_us(lambda: types.deserialize(case.type, cdr))
    encode_us = best_us(lambda: encode(batch, sensor, 'thor', types)) / case.messages
    return Row(case.name, decode_us, encode_us, batch.size, len(encoding.object.body))


def best_us(call: Callable[[], object]) -> float:
    timer = Timer(call, timer=time.thread_time)  # CPU of other processes does not count
    number = max(1, int(timer.autorange()[0] * SECONDS_EACH / 0.2 / REPEATS))
    return min(timer.repeat(REPEATS, number)) / number * 1e6


def rows() -> Iterator[Row]:
    with tempfile.TemporaryDirectory() as prefix:
        share = Path(prefix, 'share', 'go2_interfaces')
        share.mkdir(parents=True)
        (share / 'msg').symlink_to(INTERFACES, target_is_directory=True)
        types = MessageTypes([prefix])
        sensors = {sensor.name: sensor for sensor in Settings.load({}, {}).sensors}
        for case in Messages().cases():
            sensor = sensors[case.sensor]
            yield measure(case, replace(sensor, format=case.format or sensor.format), types)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--json', action='store_true', help='print one JSON object a line')
    parser.add_argument('--against', type=argparse.FileType(), metavar='FILE', help='compare with the output of --json')
    arguments = parser.parse_args()
    before = {row['name']: row['encode_us'] for row in map(json.loads, arguments.against or ())}
    if not arguments.json:
        print(f'{"":40}{"decode us":>10}{"all us":>10}{"bytes in":>12}{"bytes out":>12}{"ratio" if before else "":>10}')
    for row in rows():
        if arguments.json:
            print(json.dumps(row._asdict()), flush=True)
        else:
            ratio = f'{row.encode_us / before[row.name]:10.2f}' if row.name in before else ''
            print(f'{row.name:40}{row.decode_us:10.1f}{row.encode_us:10.1f}{row.bytes_in:12,}{row.bytes_out:12,}{ratio}')


if __name__ == '__main__':
    main()
