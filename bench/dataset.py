"""``MissionDataset`` through torch's DataLoader with two workers next to the integration guide's loop, from first byte to array.

Run it as ``python bench/dataset.py [--frames 900] [--rounds 3] [--json]`` with torch installed (the extra ``train``). The
guide's loop is its own: boto3's paginator, ``download_file`` one by one, then each file read and decoded (by Pillow). Both take
turns on the same frames, 640 x 480, in the same SeaweedFS; a round's ratio is of two consecutive runs. Ours is measured three
times: single JPEGs from the stream, the same by number (shuffled), and archives of a second. Creating the dataset (the
catalog's query) and starting the workers is included; importing torch, boto3 and Daft is not.
"""

from __future__ import annotations

import argparse
import hashlib
import shutil
import statistics
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

import boto3
import numpy as np
import obstore
import simplejpeg
from _report import Bar, Report, main, progress
from _world import make_bucket
from obstore.store import S3Store
from PIL import Image
from shadowhound_tower.embedded import Tower
from torch.utils.data import DataLoader

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.formats.archive import ArchiveFile, pack_tar
from shadowhound_data_logger.formats.rows import catalog, parts
from shadowhound_data_logger.lake import MissionDataset
from shadowhound_data_logger.lake.bucket import Bucket

FIRST_NS: Final = 1_793_188_800 * SECOND
BAR: Final = 2.0
WORKERS: Final = 2
BATCH: Final = 32
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


def guide(settings: Any, folder: Path) -> int:
    """The guide's loop, and its second half: the downloads as arrays."""
    shutil.rmtree(folder, ignore_errors=True)
    s3 = boto3.client('s3', endpoint_url=settings.endpoint_url, aws_access_key_id=settings.access_key_id,
                      aws_secret_access_key=settings.secret_access_key, region_name=settings.region)  # fmt: skip
    files: list[Path] = []
    for page in s3.get_paginator('list_objects_v2').paginate(Bucket=catalog.BUCKET, Prefix='thor/camera/'):
        for found in page.get('Contents', []):
            path = folder / found['Key']
            path.parent.mkdir(parents=True, exist_ok=True)
            s3.download_file(catalog.BUCKET, found['Key'], str(path))
            files.append(path)
    return sum(np.asarray(Image.open(path)).shape == (480, 640, 3) for path in files)


def ours(settings: Any, robot: str, *, by_number: bool, workers: int = WORKERS, context: str = 'fork') -> int:
    source = Bucket(settings, catalog.BUCKET)
    dataset = MissionDataset(source, robot=robot)
    how: dict[str, Any] = {'batch_size': BATCH, 'num_workers': workers}
    if workers:
        how['multiprocessing_context'] = context
    loader: Any = DataLoader(dataset, shuffle=True, **how) if by_number else DataLoader(dataset.stream(shuffle=True), **how)
    seen = sum(len(batch['image']) for batch in loader)
    dataset.close()
    return seen


def measure(options: argparse.Namespace) -> Report:
    folder = options.folder / 'dataset'
    shutil.rmtree(folder, ignore_errors=True)
    (folder / 'tower').mkdir(parents=True)
    with Tower(folder / 'tower') as tower:
        settings = tower.store_settings()
        make_bucket(tower)
        bare = S3Store(catalog.BUCKET, endpoint=settings.endpoint_url, access_key_id=settings.access_key_id,
                       region=settings.region, secret_access_key=settings.secret_access_key, virtual_hosted_style_request=False,
                       client_options={'allow_http': True})  # fmt: skip
        pictures = [picture(number) for number in range(16)]
        size = fill(bare, [pictures[number % 16] for number in range(options.frames)])
        progress(f'{options.frames} frames of {size / options.frames / 1000:.0f} KB, once more in archives')
        ways: dict[str, Callable[[], int]] = {
            'guide': lambda: guide(settings, folder / 'downloaded'),
            'streamed': lambda: ours(settings, 'thor', by_number=False),
            'by number, shuffled': lambda: ours(settings, 'thor', by_number=True),
            'from archives': lambda: ours(settings, 'tachi', by_number=False),
        }
        took: dict[str, list[float]] = {name: [] for name in ways}
        for _ in range(options.rounds):
            for name, way in ways.items():
                began = time.perf_counter()
                if (seen := way()) != options.frames:
                    raise SystemExit(f'{name} made {seen} arrays of {options.frames}')
                took[name].append(round(time.perf_counter() - began, 3))
                progress(f'{name}: {options.frames / took[name][-1]:.0f} frames/s')
    shutil.rmtree(folder, ignore_errors=True)
    rates = {name: [round(options.frames / seconds, 1) for seconds in found] for name, found in took.items()}
    bars = []
    for name in list(ways)[1:]:
        ratios = tuple(round(theirs / mine, 2) for theirs, mine in zip(took['guide'], took[name], strict=True))
        value = statistics.median(ratios)
        bars.append(Bar(f"MissionDataset, {WORKERS} workers, {name}, against the guide's loop", f'at least {BAR:g}', value,
                        'of its frames a second', value >= BAR, ratios))  # fmt: skip
    return Report(tuple(bars), {'frames': options.frames, 'frame_bytes': size // options.frames, 'frames_per_s': rates})


def _more(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--frames', type=int, default=900)
    parser.add_argument('--rounds', type=int, default=3)


if __name__ == '__main__':
    main(__doc__ or '', measure, seconds=0, more=_more)
