"""Prints the cost of a durable commit, and of finding the next objects in a long spool.

Run it as ``python bench/spool_commits.py [--folder F] [--json]``; F should be on the disk that the spool will be on. It takes a
minute, most of it for creating the long spool.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from time import perf_counter, process_time

from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.core.config import SpoolSettings
from shadowhound_data_logger.core.model import DataObject, State
from shadowhound_data_logger.spool.spool import Spool

NOON_NS = 1_760_788_800 * SECOND
SECONDS_EACH = 3.0
PENDING_CALLS = 50


def make(number: int, size: int = 1000) -> DataObject:
    return DataObject(
        bucket='sensor-data', key=f'thor/camera/20251018/{number:06d}_front.jpg', body=bytes(size), content_type='image/jpeg',
        sensor='camera', topic=None, type='sensor_msgs/msg/CompressedImage', samples=1, t_start_ns=NOON_NS, t_end_ns=NOON_NS,
    )  # fmt: skip


def opened(root: Path) -> Spool:
    spool = Spool(root, SpoolSettings(min_free_bytes=0), SystemClock.of_this_machine(), 'thor')
    spool.open()
    return spool


def commits(root: Path, group: int, size: int) -> dict[str, float]:
    """Commits and objects per second, and the share of a core, with ``group`` objects of ``size`` bytes per commit."""
    spool = opened(root)
    done, start, cpu = 0, perf_counter(), process_time()
    while (elapsed := perf_counter() - start) < SECONDS_EACH:
        spool.commit([make(done * group + index, size) for index in range(group)])
        done += 1
    cpu_ms = (process_time() - cpu) * 1e3 / done
    spool.close()
    return {'commits_per_s': done / elapsed, 'objects_per_s': done * group / elapsed, 'cpu_ms_per_commit': cpu_ms}


def pending(root: Path, rows: int) -> dict[str, float]:
    """Milliseconds for querying 16 objects, a commit of one, and a start, with this many waiting objects."""
    spool = opened(root)
    with spool._connections.transaction() as index:  # without syncing commits, which is not measured here
        for number in range(rows):
            item = make(number)
            index.states.insert(item, item.key, '0' * 64, State.PENDING, None, {'sha256': '0' * 64}, NOON_NS)
            path = root / 'ready' / item.bucket / item.key
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(item.body)
    cost: dict[str, float] = {}
    for name, oldest in (('priority', False), ('oldest', True)):
        start = perf_counter()
        for _ in range(PENDING_CALLS):
            spool.pending(16, oldest=oldest)
        cost[f'pending_{name}_ms'] = (perf_counter() - start) * 1e3 / PENDING_CALLS
    start = perf_counter()
    for number in range(PENDING_CALLS):
        spool.commit([make(rows + number)])
    cost['commit_ms'] = (perf_counter() - start) * 1e3 / PENDING_CALLS
    spool.close()
    start = perf_counter()
    opened(root).close()
    return {**cost, 'start_ms': (perf_counter() - start) * 1e3}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--folder', type=Path, help='where to make the spools')
    parser.add_argument('--json', action='store_true')
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        result = {
            '1 object of 1 KB': commits(Path(folder, 'one'), 1, 1000),
            '8 objects of 1 KB': commits(Path(folder, 'eight'), 8, 1000),
            '8 objects of 50 KB': commits(Path(folder, 'large'), 8, 50_000),
            '1,000 waiting': pending(Path(folder, 'short'), 1000),
            '100,000 waiting': pending(Path(folder, 'long'), 100_000),
        }
    if arguments.json:
        print(json.dumps(result))
        return
    for name, figures in result.items():
        print(f'{name:20}', '  '.join(f'{what} {value:.2f}' for what, value in figures.items()))


if __name__ == '__main__':
    main()
