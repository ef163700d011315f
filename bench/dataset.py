"""``MissionDataset`` through torch's DataLoader with two workers next to the integration guide's loop, from first byte to array.

Run it as ``python bench/dataset.py [--frames 900] [--rounds 3] [--json]`` with torch installed (the extra ``train``). The
guide's loop is its own: boto3's paginator, ``download_file`` one by one, then each file read and decoded (by Pillow). Both take
turns on the same frames, 640 x 480, in the same SeaweedFS; a round's ratio is of two consecutive runs. Ours is measured three
times: single JPEGs from the stream, the same by number (shuffled), and archives of a second. Creating the dataset (the
catalog's query) and starting the workers is included; importing torch, boto3 and Daft is not.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import boto3
import numpy as np
from _frames import fill, picture
from _report import Bar, Report, main, progress
from _world import make_bucket
from obstore.store import S3Store
from PIL import Image
from shadowhound_tower.embedded import Tower
from torch.utils.data import DataLoader

from shadowhound_data_logger.formats.rows import catalog
from shadowhound_data_logger.lake import MissionDataset
from shadowhound_data_logger.lake.bucket import Bucket

BAR: Final = 2.0
WORKERS: Final = 2
BATCH: Final = 32


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
