"""``export lerobot`` next to lerobot's own writer on the same images, 640 x 480 at 30 Hz: frames per second, CPU, memory.

Run it as ``python bench/datasets.py [--frames 450] [--rounds 3] [--json]`` if lerobot has an environment (docs/development.md).
Ours reads the objects of a mission, aligns them with odometry, records the source of each value and writes AV1; lerobot reads
JPEGs of a folder, by default and with ``streaming_encoding``. Reading and decoding the JPEGs is included in all of them,
importing modules in none. Memory is the peak of a process.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
from _report import LEROBOT, Bar, Report, main, progress

HERE: Final = Path(__file__).resolve().parent
FPS: Final = 30
SIZE: Final = (480, 640)
OURS: Final = """
import json, sys, time
from pathlib import Path
from shadowhound_data_logger.formats.rows.catalog import BUCKET
from shadowhound_data_logger.datasets.export import export
from shadowhound_data_logger.datasets.features import ExportOptions
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.core.options import StoreSettings

begun = time.perf_counter()
source = Bucket(StoreSettings(directory=Path(sys.argv[1])), BUCKET)
found = export(Path(sys.argv[2]), source, {'mission': 'bench'}, ExportOptions())
print(json.dumps({'seconds': time.perf_counter() - begun, 'frames': found.added[0]['frames']}))
"""


def pictures(folder: Path, frames: int) -> Path:
    """A mission with this many frames in a store, and the same JPEGs in a folder; returns the store."""
    here = [str(HERE.parent / 'test'), str(HERE.parent / 'test/datasets')]
    sys.path[:] = [*here, *(path for path in sys.path if path != str(HERE))]  # a benchmark is called "lake" as a folder is there
    import recorded  # noqa: PLC0415 - the missions of the tests

    rng = np.random.default_rng(7)
    coarse = rng.integers(0, 200, (SIZE[0] // 8, SIZE[1] // 8, 3), np.uint8).repeat(8, 0).repeat(8, 1)

    def pixels(stamp_ns: int) -> Any:
        """A room that moves by one pixel per frame, with sensor noise."""
        number = stamp_ns * FPS // 1_000_000_000
        noise = rng.integers(0, 6, coarse.shape, np.uint8)
        return np.ascontiguousarray(np.roll(coarse, number % SIZE[1], axis=1) + noise)

    recorded.pixels = pixels
    house = recorded.House(folder)
    house.record(recorded.Mission('bench', seconds=frames / FPS, camera_hz=FPS, sensors=('camera', 'odom')))
    plain = folder / 'jpegs'
    plain.mkdir()
    state = rng.normal(size=(frames, 7))
    np.save(plain / 'state.npy', state)
    for number in range(frames):
        cdr = recorded.simplejpeg.encode_jpeg(pixels(number * 1_000_000_000 // FPS), quality=90)
        (plain / f'{number:06d}.jpg').write_bytes(cdr)
    assert house.settings.directory is not None
    return house.settings.directory


def run(command: list[str]) -> dict[str, float]:
    """The output of a process, with its CPU seconds and peak memory (MB)."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        reported = process.stdout.read()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f'{command[1]} exited with code {process.returncode}')
    return {
        **json.loads(reported.splitlines()[-1]),
        'cpu_s': used.ru_utime + used.ru_stime,
        'memory_mb': used.ru_maxrss * 1024 / 1e6,
    }


def measure(options: argparse.Namespace) -> Report:
    if not LEROBOT.is_file():
        raise SystemExit(f'there is no lerobot at {LEROBOT} (docs/development.md)')
    folder = options.folder / 'datasets'
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    store = pictures(folder, options.frames)
    size = sum(path.stat().st_size for path in (folder / 'jpegs').glob('*.jpg'))
    theirs = [str(LEROBOT), '-P', str(HERE / '_lerobot_writer.py'), str(folder / 'jpegs'), str(folder / 'set'), str(FPS)]
    ways = {
        'ours': [sys.executable, '-c', OURS, str(store), str(folder / 'set')],
        'lerobot': [*theirs, 'default'], 'lerobot, streaming': [*theirs, 'streaming'],
    }  # fmt: skip
    found: dict[str, list[dict[str, float]]] = {name: [] for name in ways}
    for _ in range(options.rounds):
        for name, command in ways.items():
            shutil.rmtree(folder / 'set', ignore_errors=True)
            each = run(command)
            each['frames_per_s'] = round(each.get('frames', options.frames) / each['seconds'], 1)
            found[name].append(each)
            progress(f'{name}: {each["frames_per_s"]:.1f} frames/s, {each["cpu_s"]:.1f} s of CPU, {each["memory_mb"]:.0f} MB')
            time.sleep(0.5)
    shutil.rmtree(folder, ignore_errors=True)
    bars = []
    for name in list(ways)[1:]:
        both = list(zip(found['ours'], found[name], strict=True))
        what = f'export lerobot against the writer of {name}'
        for figure, bar, unit in (
            ('frames_per_s', 'at least 1', 'of its frames a second'),
            ('memory_mb', 'at most 0.5', 'of its memory'),
        ):
            ratios = tuple(round(mine[figure] / other[figure], 2) for mine, other in both)
            value = statistics.median(ratios)
            bars.append(Bar(what, bar, value, unit, value >= 1 if figure == 'frames_per_s' else value <= 0.5, ratios))
    per_gb = statistics.median(each['seconds'] for each in found['ours']) * 1e9 / size
    bars.append(Bar('a gigabyte of JPEGs exported', 'at most 300', per_gb, 's', per_gb <= 300))
    return Report(tuple(bars), {'frames': options.frames, 'frame_bytes': size // options.frames, 'runs': found})


def _more(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--frames', type=int, default=450)
    parser.add_argument('--rounds', type=int, default=3)


if __name__ == '__main__':
    main(__doc__ or '', measure, seconds=0, more=_more)
