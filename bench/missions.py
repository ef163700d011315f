"""Prints how fast a backlog of missions is replayed, as a share of the rate of ``log_batch`` with 1,000 metrics.

Run it as ``python bench/missions.py [--points N] [--folder F] [--json]``. Both send to the same MLflow server on SQLite.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path
from typing import Final

from _report import Bar, Report, main, progress
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.missions.delivery import Delivery
from shadowhound_data_logger.missions.folder import missions
from shadowhound_data_logger.missions.objects import Spooler
from shadowhound_data_logger.missions.tracking import ENVIRONMENT, MlflowTracking

POINTS: Final = 100_000
SHARE: Final = 0.5
BATCH: Final = 1000


def alone(uri: str, points: int) -> float:
    """Points per second of MLflow's bare client."""
    from mlflow import MlflowClient  # noqa: PLC0415 - after its environment is set
    from mlflow.entities import Metric  # noqa: PLC0415

    client = MlflowClient(uri)
    run_id = client.create_run(client.get_experiment_by_name('thor_missions').experiment_id).info.run_id
    now_ms = time.time_ns() // 1_000_000
    began = time.perf_counter()
    for first in range(0, points, BATCH):
        client.log_batch(run_id, [Metric('battery_pct', 90.0, now_ms + n, n) for n in range(first, first + BATCH)])
    return points / (time.perf_counter() - began)


def replayed(uri: str, home: Path, points: int) -> float:
    """Points per second of a journal's delivery, from the first byte to the run's end."""
    logger = MissionDataLogger(home=home, replay=False, start_timeout_s=0.0)
    logger.start_mission('bench', 'backlog')
    for number in range(points):
        logger.log_metric('battery_pct', 90.0, step=number)
    logger.end_mission(True, 1.0, 1.0)
    logger.close()
    tracking = MlflowTracking(uri, 'thor_missions')
    tracking.open()
    delivery = Delivery(next(missions(home)), tracking, Spooler.__new__(Spooler))
    began = time.perf_counter()
    while delivery.track():
        pass
    return points / (time.perf_counter() - began)


def measure(options: argparse.Namespace) -> Report:
    """Both, one after the other."""
    os.environ |= ENVIRONMENT
    options.folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder, Tower(Path(folder) / 'tower', mlflow=True) as tower:
        os.environ |= tower.environment()
        progress('log_batch alone')
        theirs = alone(tower.tracking_uri, options.points)
        progress('the replay of a journal')
        ours = replayed(tower.tracking_uri, Path(folder) / 'home', options.points)
    share = ours / theirs
    bar = Bar('points replayed a second, of log_batch alone', f'at least {SHARE}', share, '', share >= SHARE)
    return Report((bar,), {'points': options.points, 'replayed_per_s': ours, 'log_batch_per_s': theirs})


if __name__ == '__main__':
    main(__doc__ or '', measure, seconds=0.0,
         more=lambda parser: parser.add_argument('--points', type=int, default=POINTS, metavar='N'))  # fmt: skip
