"""``MissionDataset`` on a store next to lerobot's loader on a local set of the same images: random windows of eight frames.

Run it as ``python bench/training_reads.py [--frames 900] [--windows 200] [--rounds 3] [--json]`` if lerobot has an environment
that has our package's dependencies too (docs/development.md). Ours reads single JPEGs, and archives of a second, from a
SeaweedFS; lerobot reads a set of AV1 on the local disk, which its own writer wrote. Both run in the same Python with torch's
DataLoader and two workers, and make the same tensors of float32; once ours leaves the bytes to where the model runs. Opening
the dataset and starting the workers is included, importing modules is not.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
from pathlib import Path
from typing import Final

import numpy as np
import simplejpeg
from _frames import fill
from _report import LEROBOT, Bar, Report, main, progress
from _world import make_bucket
from datasets import run
from obstore.store import S3Store
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger.formats.rows import catalog

HERE: Final = Path(__file__).resolve().parent
FPS: Final = 30
BAR: Final = 2.0


def images(frames: int) -> list[bytes]:
    """A room that moves by one pixel per frame, with sensor noise, as JPEGs of 640 x 480."""
    rng = np.random.default_rng(7)
    coarse = rng.integers(0, 200, (60, 80, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    made = []
    for number in range(frames):
        noise = rng.integers(0, 6, coarse.shape, np.uint8)
        pixels = np.ascontiguousarray(np.roll(coarse, number % 640, axis=1) + noise)
        made.append(bytes(simplejpeg.encode_jpeg(pixels, quality=85)))
    return made


def write_set(folder: Path, bodies: list[bytes]) -> Path:
    """A set of the same images, by lerobot's own writer."""
    plain = folder / 'jpegs'
    plain.mkdir()
    for number, body in enumerate(bodies):
        (plain / f'{number:06d}.jpg').write_bytes(body)
    np.save(plain / 'state.npy', np.zeros((len(bodies), 7)))
    writer = [str(LEROBOT), '-P', str(HERE / '_lerobot_writer.py'), str(plain), str(folder / 'set'), str(FPS), 'default']
    subprocess.run(writer, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return folder / 'set'


def measure(options: argparse.Namespace) -> Report:
    if not LEROBOT.is_file():
        raise SystemExit(f'there is no lerobot at {LEROBOT} (docs/development.md)')
    folder = options.folder / 'training_reads'
    shutil.rmtree(folder, ignore_errors=True)
    (folder / 'tower').mkdir(parents=True)
    bodies = images(options.frames)
    with Tower(folder / 'tower') as tower:
        settings = tower.store_settings()
        make_bucket(tower)
        bare = S3Store(catalog.BUCKET, endpoint=settings.endpoint_url, access_key_id=settings.access_key_id,
                       region=settings.region, secret_access_key=settings.secret_access_key, virtual_hosted_style_request=False,
                       client_options={'allow_http': True})  # fmt: skip
        size = fill(bare, bodies)
        progress(f'{options.frames} frames of {size / options.frames / 1000:.0f} KB in the store')
        made = write_set(folder, bodies)
        environ = {**tower.environment(), 'PYTHONPATH': str(HERE.parent)}
        os.environ.update(environ)
        ways = {
            'single images': ('float', 'thor'), 'archives of a second': ('float', 'tachi'),
            'archives of a second, as uint8': ('bytes', 'tachi'), 'lerobot': ('lerobot', str(made)),
        }  # fmt: skip
        found: dict[str, list[dict[str, float]]] = {name: [] for name in ways}
        for number in range(options.rounds):
            for name, (way, place) in ways.items():
                given = [way, str(options.windows), str(1000 * number), str(options.frames), place]
                each = run([str(LEROBOT), '-P', str(HERE / '_training_reader.py'), *given])
                each['frames_per_s'] = round(each['frames'] / each['seconds'], 1)
                found[name].append(each)
                progress(f'{name}: {each["frames_per_s"]:.0f} frames/s, {each["cpu_s"]:.1f} s of CPU, {each["memory_mb"]:.0f} MB')
    shutil.rmtree(folder, ignore_errors=True)
    bars = []
    for name in list(ways)[:-1]:
        ratios = tuple(round(mine['frames_per_s'] / other['frames_per_s'], 2)
                       for mine, other in zip(found[name], found['lerobot'], strict=True))  # fmt: skip
        value = statistics.median(ratios)
        bars.append(Bar(f"MissionDataset on {name}, random windows of 8 frames, against lerobot's loader", f'at least {BAR:g}',
                        value, 'of its frames a second', value >= BAR, ratios))  # fmt: skip
    return Report(tuple(bars), {'frames': options.frames, 'frame_bytes': size // options.frames, 'windows': options.windows,
                                'runs': found})  # fmt: skip


def _more(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--frames', type=int, default=900)
    parser.add_argument('--windows', type=int, default=200)
    parser.add_argument('--rounds', type=int, default=3)


if __name__ == '__main__':
    main(__doc__ or '', measure, seconds=0, more=_more)
