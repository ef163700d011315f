"""A separate process that requests data kept on a robot, and records what it saw and requested: it may be killed."""

from __future__ import annotations

import json
import random
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Lock
from typing import Any

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.core.mailbox import BAG_SENSOR, KeptFilter
from shadowhound_data_logger.core.options import UploadSettings
from shadowhound_data_logger.lake import pull
from shadowhound_data_logger.lake.bucket import default_source
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.stores import open_store

SHORT_S = 3
RECENT_S = 120


def main(robot: str, output: str, name: str, count: int, threads: int, seed: int) -> None:
    """Send this many requests, each for a few seconds of a sensor, or of all bags: mostly for data known to be kept."""
    source, lock = default_source(), Lock()
    store = open_store(source.settings, UploadSettings(read_timeout_s=5.0))
    rng = random.Random(seed)

    def write(line: dict[str, object]) -> None:
        with lock, Path(output).open('a', encoding='utf-8') as file:
            file.write(json.dumps(line) + '\n')

    def recent() -> list[dict[str, Any]]:
        """What the store lists as kept, of the last minutes: older data may be gone."""
        want = KeptFilter(since_ns=time.time_ns() - RECENT_S * SECOND)
        return pull.kept(source, robot, want, Findings(lambda _: None)).to_pylist()

    def ask(number: int) -> None:
        now_ns = time.time_ns()
        with lock:
            sensor = rng.choice(['camera', 'camera', 'lidar', 'imu', BAG_SENSOR, BAG_SENSOR])
            early_ns, length_ns = (
                rng.randrange(2 * SECOND, 25 * SECOND),
                rng.randrange(SECOND, (4 if sensor == BAG_SENSOR else 15) * SECOND),
            )
            is_short, is_cancelled, is_blind = rng.random() < 0.15, rng.random() < 0.1, rng.random() < 0.15
            priority, place = rng.randrange(10), rng.random()
        try:
            since_ns = now_ns - early_ns
            kept = recent()
            there = [row['t_start_ns'] for row in kept if row['sensor'] == sensor]
            if there and not is_blind:
                since_ns = there[int(place * len(there))] - length_ns // 2
            want = KeptFilter(sensor=sensor, since_ns=since_ns, until_ns=since_ns + length_ns)
            seen = [row['key'] for row in kept if pull.matches(want, row)]
            expiry_ns = SHORT_S * SECOND if is_short else 3600 * SECOND
            asked = pull.put_request(
                store, source, robot, want, by=f'{name}-{number % 3}', priority=priority, expiry_ns=expiry_ns
            )
            write({'id': asked.id, 'by': asked.by, 'made_ns': asked.made_ns, 'keys': seen})
            if is_cancelled:
                pull.cancel(store, source, robot, asked.id, by=name)
        except (DataLoggerError, OSError) as error:  # the store is down, or the mailbox full: no request was sent
            write({'failed': str(error)[:200]})

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(ask, range(count)))
    store.close()


if __name__ == '__main__':
    robot_, output_, name_, *numbers = sys.argv[1:]
    main(robot_, output_, name_, *map(int, numbers))
