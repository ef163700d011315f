"""Hostile messages for the encoders; used by test_hostile.py and by ``python -m torture.fuzz``.

They start as valid ones. Words are replaced by false lengths, bytes are flipped, ends are truncated, bytes of another type
replace them, or everything is noise.
"""

from __future__ import annotations

import random
import struct
import time
import tracemalloc
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, Final

import numpy as np

from shadowhound_data_logger.core.config import SensorSettings
from shadowhound_data_logger.core.model import Batch, Sample
from shadowhound_data_logger.core.options import FORMATS
from shadowhound_data_logger.formats.encoders import Encoding, encode
from shadowhound_data_logger.formats.types import MessageTypes, header_frame_id, header_stamp_ns

LENGTHS: Final = (0, 1, 2, 3, 4, 5, 0x7F, 0xFF, 0x100, 0xFFFF, 0x10000, 0xFF_FFFF, 0x3FFF_FFFF, 0x7FFF_FFFF, 0x8000_0000,
                  0xFFFF_FFFC, 0xFFFF_FFFE, 0xFFFF_FFFF)  # fmt: skip
"""Badly chosen lengths, sizes, offsets and enumerations."""
SHARE: Final = 100
"""Bytes that encoding may take for each byte of a message: Python objects of small records are the most wasteful."""
FLOOR_BYTES: Final = 2 << 20
SLOWEST_S: Final = 30.0
"""A second is enough on an idle machine."""
TYPES: Final = (
    'sensor_msgs/msg/CompressedImage', 'sensor_msgs/msg/Image', 'sensor_msgs/msg/PointCloud2', 'sensor_msgs/msg/JointState',
    'sensor_msgs/msg/CameraInfo', 'nav_msgs/msg/Odometry', 'nav_msgs/msg/OccupancyGrid', 'std_msgs/msg/String',
    'tf2_msgs/msg/TFMessage', 'diagnostic_msgs/msg/DiagnosticArray', 'go2_interfaces/msg/IMU', 'go2_interfaces/msg/Go2State',
    'go2_interfaces/msg/LowState', 'go2_interfaces/msg/VoxelMapCompressed', 'no_such_pkg/msg/Nothing',
)  # fmt: skip
Damage = Callable[[random.Random, bytearray], bytearray]


def _lie(rng: random.Random, cdr: bytearray) -> bytearray:
    """Replace a 4-byte word, at a CDR position, by another number."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        if len(cdr) >= 8:
            at = 4 + 4 * rng.randrange((len(cdr) - 4) // 4)
            struct.pack_into(rng.choice('<>') + 'I', cdr, at, rng.choice(LENGTHS))
    return cdr


def _flip(rng: random.Random, cdr: bytearray) -> bytearray:
    for _ in range(rng.choice((1, 3, 30))):
        if cdr:
            cdr[rng.randrange(len(cdr))] ^= 1 << rng.randrange(8)
    return cdr


def _cut(rng: random.Random, cdr: bytearray) -> bytearray:
    return cdr[: rng.randrange(len(cdr) + 1)]


def _noise(rng: random.Random, cdr: bytearray) -> bytearray:
    return bytearray(rng.choice((b'', b'\0\1\0\0', b'\0\0\0\0', b'\0\3\0\0')) + rng.randbytes(rng.randrange(300)))


def _splice(rng: random.Random, cdr: bytearray) -> bytearray:
    at = rng.randrange(len(cdr) + 1)
    return cdr[:at] + bytearray(rng.randbytes(rng.choice((1, 4, 100)))) + cdr[at:]


def _keep(_: random.Random, cdr: bytearray) -> bytearray:
    return cdr


DAMAGES: Final[Sequence[Damage]] = (_lie, _lie, _lie, _flip, _cut, _noise, _splice, _keep)


class Fuzzer:
    """New with message definitions and a way to serialize valid messages (conftest's Ros); ``round`` as often as wanted."""

    def __init__(self, ros: Any) -> None:
        self._types: MessageTypes = ros.types
        self._sensors: list[SensorSettings] = list(ros.sensors.values())
        self._valid = {name: content(ros, name) for name in TYPES if name in ros.store.fielddefs}
        self.outcomes: Counter[str] = Counter()
        for name, format_name in product(self._valid, FORMATS):  # load everything that is loaded on first use
            sensor = replace(self._sensors[0], format=format_name)
            for cdr in self._valid[name]:
                encode(Batch(sensor.name, '/valid', name, (Sample(0, cdr),), len(cdr)), sensor, 'thor', self._types)

    def round(self, seed: int) -> None:
        """One batch; AssertionError, or an encoder's exception, if it is not handled as it must be."""
        rng = random.Random(seed)
        type_name = rng.choice(TYPES)
        samples = tuple(Sample(rng.choice((0, 1, 1_760_788_800 * 10**9, 2**62, -1)), self.message(rng, type_name))
                        for _ in range(rng.choice((1, 1, 2, 5))))  # fmt: skip
        batched = rng.random() < 0.5
        sensor = replace(
            rng.choice(self._sensors), format=rng.choice(FORMATS), batch_s=float(batched), quality=rng.choice((1, 85))
        )
        batch = Batch(sensor.name, '/hostile', type_name, samples, sum(len(sample.cdr) for sample in samples))
        encoding, peak, took_s = measured(lambda: encode(batch, sensor, 'thor', self._types))
        kept = 0 if encoding.object is None else encoding.object.samples
        assert kept + sum(encoding.rejected.values()) == len(samples)
        assert encoding.details.keys() == encoding.rejected.keys()
        assert peak <= FLOOR_BYTES + SHARE * batch.size, f'{peak} bytes for {batch.size}'
        assert took_s <= SLOWEST_S, f'{took_s} s'
        self.outcomes.update(encoding.rejected)
        self.outcomes['encoded'] += kept

    def message(self, rng: random.Random, type_name: str) -> bytes:
        """Hostile bytes for this type; the intake's own reads of them must succeed, too."""
        name = type_name if type_name in self._valid and rng.random() < 0.9 else rng.choice(list(self._valid))
        cdr = bytes(rng.choice(DAMAGES)(rng, bytearray(rng.choice(self._valid[name]))))
        assert isinstance(header_stamp_ns(cdr), int)
        assert len(header_frame_id(cdr)) <= len(cdr)
        return cdr


def measured(work: Callable[[], Encoding]) -> tuple[Encoding, int, float]:
    """The result, the peak memory of Python and numpy (bytes), and the seconds."""
    tracemalloc.start()
    began = time.monotonic()
    try:
        return work(), tracemalloc.get_traced_memory()[1], time.monotonic() - began
    finally:
        tracemalloc.stop()


def content(ros: Any, type_name: str) -> list[bytes]:
    """Valid messages of a type, in both byte orders, with content in the fields that encoders read."""
    values: dict[str, Any] = {}
    variants = [values]
    if type_name.endswith('/Image'):
        of_encoding = {
            'bgr8': (12, 48),
            'yuv422_yuy2': (8, 32),
            'yuv422': (12, 48),
            'nv12': (4, 24),
            'nv24': (4, 48),
            'mono8': (4, 16),
            'rgb16': (24, 96),
            'rgba16': (32, 128),
            'bayer_rggb16': (8, 32),
            '32FC1': (16, 64),
            '64FC1': (32, 128),
        }
        variants = [
            {
                'width': 4,
                'height': 4,
                'step': step,
                'encoding': encoding,
                'data': np.arange(size, dtype=np.uint8),
                'header': {'frame_id': 'camera'},
            }
            for encoding, (step, size) in of_encoding.items()
        ]
    elif type_name.endswith('/CompressedImage'):
        variants = [
            {'format': 'jpeg', 'data': np.frombuffer(JPEG, np.uint8)},
            {'format': '16UC1; compressedDepth rvl', 'data': np.frombuffer(RVL, np.uint8)},
        ]
    elif type_name.endswith('/PointCloud2'):
        fields = [ros.make('sensor_msgs/msg/PointField', name=name, offset=4 * number, datatype=7, count=1)
                  for number, name in enumerate('xyz')]  # fmt: skip
        values |= {'width': 2, 'height': 2, 'point_step': 12, 'row_step': 24, 'fields': fields, 'data': np.zeros(48, np.uint8)}
    elif type_name.endswith('/JointState'):
        values |= {'name': ['a', 'bb'], 'position': np.ones(2), 'velocity': np.ones(2), 'effort': np.ones(2)}
    return [ros.cdr(type_name, little_endian=little, **each) for each in variants for little in (True, False)]


JPEG: Final = bytes.fromhex('ffd8ffe000104a46494600010100000100010000ffc0000b080001000101011100ffda0008010100003f00d2cf20ffd9')
"""Headers of a JPEG of one pixel, and something of a scan."""
RVL: Final = struct.pack('<iffIII', 0, 1.0, 2.0, 4, 2, 0x1382_2222) + struct.pack('<I', 0x2220_0000)
"""A depth image of 4 x 2 pixels: one that is 0, then numbers that rise."""
