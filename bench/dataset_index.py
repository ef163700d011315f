"""The cost of a ``MissionDataset`` of a million rows before its first sample: seconds and memory.

Run it as ``python bench/dataset_index.py [--rows 1000000] [--rounds 3] [--json]``. The rows are frames of a second in hourly
parts, in a folder as written by ``shadowhound-data fetch``. Each round is a separate process that has created a dataset of one
part before, so that libraries are loaded and have planned once; the index is what one process passes to its workers.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Final

from _report import Bar, Report, main, progress

from shadowhound_data_logger.core.clock import SECOND, utc
from shadowhound_data_logger.formats.rows import catalog, parts

FIRST_NS: Final = 1_793_188_800 * SECOND
HOUR: Final = 3600
KIND: Final = 'sensor_msgs/msg/CompressedImage'
MEASURE: Final = """
import json, pickle, sys, time
from pathlib import Path
from shadowhound_data_logger.lake import MissionDataset

def resident_mb():
    return int(Path('/proc/self/statm').read_text().split()[1]) * 4096 / 1e6

MissionDataset(sys.argv[1]).close()
before = resident_mb()
began = time.monotonic()
made = MissionDataset(sys.argv[2])
print(json.dumps({'seconds': round(time.monotonic() - began, 2), 'rows': len(made), 'before_mb': round(before),
                  'after_mb': round(resident_mb()), 'index_mb': round(len(pickle.dumps(made)) / 1e6)}))
"""


def fill(folder: Path, first: int, last: int) -> None:
    """One part for each of these hours."""
    for hour in range(first, last):
        rows = []
        for second in range(hour * HOUR, (hour + 1) * HOUR):
            stamp = FIRST_NS + second * SECOND
            key = f'thor/camera/{utc(stamp):%Y%m%d/%H%M%S}_front.jpg'
            report = {'robot': 'thor', 'sensor': 'camera', 'topic': '/camera/compressed', 'type': KIND, 'count': '1',
                    't_start_ns': str(stamp), 't_end_ns': str(stamp), 'sha256': hashlib.sha256(key.encode()).hexdigest(),
                    'pose': f'{second}.0 2.0 0.5 odom', 'battery_pct': '80'}  # fmt: skip
            rows.append(catalog.row_of(catalog.BUCKET, key, 45_000, 'image/jpeg', report))
        name = f'{utc(rows[0]["t_start_ns"]):%Y%m%dT%H%M%S}_b'
        part = folder / catalog.OBJECTS.part_key('thor', catalog.date_of(rows[0]), name)
        part.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(parts.encode(rows))


def measure(options: argparse.Namespace) -> Report:
    folder = options.folder / 'dataset_index'
    shutil.rmtree(folder, ignore_errors=True)
    fill(folder / 'one', 0, 1)
    fill(folder / 'all', 0, -(-options.rows // HOUR))
    progress(f'{options.rows:,} rows')
    command = [sys.executable, '-c', MEASURE, str(folder / 'one'), str(folder / 'all')]
    found = [json.loads(subprocess.run(command, check=True, capture_output=True).stdout) for _ in range(options.rounds)]
    shutil.rmtree(folder, ignore_errors=True)
    bars = []
    for what, unit, most, values in (
        ('index of MissionDataset', 'MB', 300, [each['index_mb'] for each in found]),
        ('MissionDataset until it is made', 's', 5, [each['seconds'] for each in found]),
    ):
        value = statistics.median(values)
        bars.append(Bar(f'{what}, {found[0]["rows"]:,} rows', f'at most {most}', value, unit, value <= most, tuple(values)))
    return Report(tuple(bars), {'runs': found})


def _more(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--rows', type=int, default=1_000_000)
    parser.add_argument('--rounds', type=int, default=3)


if __name__ == '__main__':
    main(__doc__ or '', measure, seconds=0, more=_more)
