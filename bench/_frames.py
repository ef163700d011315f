"""Frames of cameras in a store, single and in archives, with their catalog, as benchmarks of readers need them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import numpy as np
import obstore
import simplejpeg
from obstore.store import S3Store

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.formats.archive import ArchiveFile, pack_tar
from shadowhound_data_logger.formats.rows import catalog, parts

FIRST_NS: Final = 1_793_188_800 * SECOND
FRAMES_HZ: Final = 30
KIND: Final = 'sensor_msgs/msg/CompressedImage'


def picture(number: int) -> bytes:
    """A JPEG of 640 x 480 of a camera's size, about 45 KB."""
    rng = np.random.default_rng(number % 16)
    coarse = rng.integers(0, 255, (60, 80, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    noise = rng.integers(0, 12, coarse.shape, np.uint8)
    return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(coarse // 2 + noise), quality=85))


def fill(store: S3Store, bodies: Sequence[bytes]) -> int:
    """Single frames of the robot thor, archives of the same of tachi, and their catalogs; returns the bytes of the frames."""
    frames = len(bodies)
    puts: list[tuple[str, bytes, dict[str, str]]] = []
    for number in range(frames):
        stamp = FIRST_NS + number * SECOND
        puts.append(_object('thor', 'jpg', bodies[number], stamp, stamp, 1))
    for begin in range(0, frames, FRAMES_HZ):
        numbers = range(begin, min(begin + FRAMES_HZ, frames))
        stamps = [FIRST_NS + number * SECOND // FRAMES_HZ for number in numbers]
        report = [b'{"stamp_ns":%d,"topic":"/camera/compressed"}' % stamp for stamp in stamps]
        pairs = [
            (stamp, (('jpg', bodies[number]), ('json', about)))
            for number, stamp, about in zip(numbers, stamps, report, strict=True)
        ]
        packed = pack_tar(ArchiveFile(f'{stamp:019d}.{kind}', stamp, body) for stamp, files in pairs for kind, body in files)
        puts.append(_object('tachi', 'tar', packed, stamps[0], stamps[-1], len(stamps)))
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda put: obstore.put(store, put[0], put[1]), puts))
    for robot in ('thor', 'tachi'):
        rows = [
            catalog.row_of(catalog.BUCKET, key, len(body), 'image/jpeg', report)
            for key, body, report in puts
            if key.startswith(robot)
        ]
        for start in range(0, len(rows), 60):
            name = f'{utc(rows[start]["t_start_ns"]):%Y%m%dT%H%M%S}_b'
            obstore.put(
                store, catalog.OBJECTS.part_key(robot, catalog.date_of(rows[start]), name), parts.encode(rows[start : start + 60])
            )
    return sum(map(len, bodies))


def _object(robot: str, extension: str, body: bytes, first: int, last: int, count: int) -> tuple[str, bytes, dict[str, str]]:
    key = f'{robot}/camera/{utc(first):%Y%m%d/%H%M%S}_front.{extension}'
    return key, body, {'robot': robot, 'sensor': 'camera', 'topic': '/camera/compressed', 'type': KIND, 'count': str(count),
                       't_start_ns': str(first), 't_end_ns': str(last), 'sha256': hashlib.sha256(body).hexdigest(),
                       'pose': '1.0 2.0 0.5 odom', 'battery_pct': '80'}  # fmt: skip
