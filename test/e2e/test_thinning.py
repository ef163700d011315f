"""A node without space for more kept data: the rate is reduced, the time span stays, also after kills."""

from __future__ import annotations

import json
import random
import signal
import sqlite3
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from e2e.processes import Processes, until
from spool.making import assert_whole

from shadowhound_data_logger.core.clock import SECOND

SETTINGS = {
    'camera.rate_hz': 0.0, 'camera.batch_s': 1.0, 'camera.format': 'tar', 'camera.ship': 'on_request', 'lidar.enabled': False,
    'bag.record': 'always', 'bag.topics': ['imu', 'point_cloud2'], 'bag.slice_s': 2.0, 'bag.ship': 'on_request',
    'keep.max_bytes': 32 << 20,
}  # fmt: skip
KILLS = 6


def objects(root: Path) -> list[dict[str, Any]]:
    with closing(sqlite3.connect(f'file:{root / "index.db"}?mode=ro', uri=True)) as db:
        db.row_factory = sqlite3.Row
        return [dict(row) for row in db.execute('SELECT * FROM objects ORDER BY id')]


def thinned(root: Path) -> int:
    return sum(row['reason'] == 'thinned' for row in objects(root))


def thins(root: Path, more: int) -> None:
    """Wait until this many more objects are thinned."""
    goal = more + (thinned(root) if (root / 'index.db').exists() else 0)
    until(lambda: thinned(root) >= goal, 'something is thinned')


@pytest.mark.slow
@pytest.mark.long('a robot for a minute, and six kills')
@pytest.mark.timeout(900)
def test_kept_data_is_thinned_before_the_oldest_is_evicted(processes: Processes) -> None:
    """Killed repeatedly while it thins: nothing is evicted completely, each second remains, the ledger has every message."""
    chance = random.Random(28)
    processes.sim('image_raw:=false')
    for _ in range(KILLS):
        node = processes.node({}, SETTINGS)
        root = node.home / 'spool'
        thins(root, 2 + chance.randrange(3))
        node.signal(signal.SIGKILL)
        node.wait()
    node = processes.node({}, SETTINGS)
    thins(root, 2)
    ledger = node.stop()
    assert ledger['balanced']
    assert_whole(root)
    rows = objects(root)
    assert set(Counter(row['reason'] for row in rows if row['state'] == 'evicted')) == {'thinned'}
    steps = [int(json.loads(row['metadata']).get('thinned', 1)) for row in rows if row['state'] == 'kept']
    assert max(steps) > 1
    assert sum(row['bytes'] for row in rows if row['state'] == 'kept') <= SETTINGS['keep.max_bytes']
    archives = [row for row in rows if row['state'] == 'kept' and row['sensor'] == 'camera']
    seconds = {row['t_start_ns'] // SECOND for row in archives}
    first, last = min(seconds), max(seconds)
    silent = set(range(first, last + 1)) - seconds - {second + 1 for second in seconds}
    assert len(silent) <= 5 * KILLS, 'what was published while no node ran, and nothing else'
