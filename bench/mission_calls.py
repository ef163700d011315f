"""Measures how long an agent waits for each call of MissionDataLogger, and for MLflow's own client.

Tower is up, unreachable and hung in turn; ``start_mission`` is also measured 10 ms after the constructor, on the idle machine
and next to ten busy processes, and compared with a bare request for a run. Run it as ``python bench/mission_calls.py [--seconds
S] [--folder F] [--json]``; S is for each of the three states.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from _report import Bar, Report, main, percentile, progress

sys.path.append(str(Path(__file__).parents[1] / 'test'))
from e2e.wire import HANG, PASS, REFUSE, Wire
from shadowhound_tower.embedded import Tower

from shadowhound_data_logger import MissionDataLogger
from shadowhound_data_logger.core.mlflow_rest import MlflowRest
from shadowhound_data_logger.missions.folder import MISSIONS
from shadowhound_data_logger.missions.tracking import ENVIRONMENT

RATE_HZ: Final = 100.0
FRAME_EVERY: Final = 10
JPEG: Final = b'\xff\xd8' + os.urandom(150_000)
MEDIAN_S, P99_S = 1e-3, 10e-3
PLAIN_CALLS: Final = 50
START_S: Final = {'up': 0.1, 'away': 0.1, 'hung': 2.1}
"""For ``start_mission`` right after the constructor."""
STARTS, AFTER_S, BUSY, START_MEDIAN_MS = 12, 0.01, 10, 100.0
"""Rounds, the time between constructor and call, busy processes, and the maximum for the median of the rounds."""


def timed(call: Callable[[], object]) -> float:
    began = time.perf_counter()
    call()
    return time.perf_counter() - began


def calls(home: Path, seconds: float) -> dict[str, list[float]]:
    """Seconds of each call of a mission at ``RATE_HZ``, by method."""
    took: dict[str, list[float]] = {'start_mission': [], 'log_robot_state': [], 'log_camera_frame': [], 'end_mission': []}
    logger = MissionDataLogger(home=home)
    try:
        took['start_mission'].append(timed(lambda: logger.start_mission('bench', 'calls')))
        end = time.monotonic() + seconds
        number = 0
        while time.monotonic() < end:
            took['log_robot_state'].append(timed(lambda n=number: logger.log_robot_state(90.0, 40.0, n)))  # type: ignore[misc]
            if number % FRAME_EVERY == 0:
                took['log_camera_frame'].append(timed(lambda n=number: logger.log_camera_frame(JPEG, n)))  # type: ignore[misc]
            number += 1
            time.sleep(1 / RATE_HZ)
        took['end_mission'].append(timed(lambda: logger.end_mission(True, 1.0, 1.0)))
    finally:
        logger.close()
    return took


@contextmanager
def busy(count: int) -> Iterator[None]:
    """This many processes that compute without a pause."""
    processes = [subprocess.Popen([sys.executable, '-c', 'while True: pass']) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def starts(folder: Path, rest: MlflowRest, experiment_id: str) -> dict[str, list[float]]:
    """Seconds of ``start_mission``, and of the bare request for a run right after it; they alternate.

    Each round has a new home, and waits at its end until the sender of that home has exited.
    """
    took: dict[str, list[float]] = {'start_mission': [], 'runs/create': [], 'ratio': []}
    for number in range(STARTS):
        home = folder / str(number)
        logger = MissionDataLogger(home=home)
        time.sleep(AFTER_S)
        began = time.perf_counter()
        run_id = logger.start_mission('bench', 'start')
        start = time.perf_counter() - began
        body = {'experiment_id': experiment_id, 'run_name': 'bare', 'start_time': 0, 'tags': []}
        bare = timed(lambda body=body: rest.json('POST', 'runs/create', body))  # type: ignore[misc]
        took['start_mission'].append(start)
        took['runs/create'].append(bare)
        took['ratio'].append(start / bare)
        rest.json('GET', f'runs/get?run_id={run_id}')  # raises if that is not a run
        logger.end_mission(True, 1.0, 1.0)
        logger.close(60.0)
        pid = json.loads((home / MISSIONS / 'replay.json').read_text(encoding='utf-8'))['pid']
        while Path(f'/proc/{pid}/exe').exists():
            time.sleep(0.1)
    return took


def plain(uri: str) -> list[float]:
    """MLflow's own log_metric against the same server, Tower up."""
    os.environ |= ENVIRONMENT
    from mlflow import MlflowClient  # noqa: PLC0415 - the logger's own process must not load it

    client = MlflowClient(uri)
    run_id = client.create_run(client.get_experiment_by_name('thor_missions').experiment_id).info.run_id
    return [timed(lambda n=number: client.log_metric(run_id, 'battery_pct', 90.0, step=n)) for number in range(PLAIN_CALLS)]  # type: ignore[misc]


def measure(options: argparse.Namespace) -> Report:
    """The three states of Tower one after the other."""
    options.folder.mkdir(parents=True, exist_ok=True)
    bars: list[Bar] = []
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(dir=options.folder, ignore_cleanup_errors=True) as folder:  # noqa: SIM117 - one is too long
        with Tower(Path(folder) / 'tower', mlflow=True) as tower, Wire(tower.tracking_uri) as wire:
            os.environ |= tower.environment() | {'MLFLOW_TRACKING_URI': wire.url}
            for name, mode in (('up', PASS), ('away', REFUSE), ('hung', HANG)):
                progress(f'Tower {name}')
                wire.set(mode)
                took = calls(Path(folder) / name, options.seconds)
                logged = took['log_robot_state'] + took['log_camera_frame']
                median, p99 = statistics.median(logged), percentile(logged, 99)
                bars.append(Bar(f'median of a log call, Tower {name}', 'under 1 ms', median * 1e3, 'ms', median < MEDIAN_S))
                bars.append(Bar(f'p99 of a log call, Tower {name}', 'under 10 ms', p99 * 1e3, 'ms', p99 < P99_S))
                start = took['start_mission'][0]
                most_s = START_S[name]
                bars.append(Bar(f'start_mission, Tower {name}', f'at most {most_s:g} s', start, 's', start < most_s))
                figures[name] = {
                    call: {'calls': len(all_), 'median_ms': statistics.median(all_) * 1e3, 'p99_ms': percentile(all_, 99) * 1e3}
                    for call, all_ in took.items()
                }
            wire.set(PASS)
            os.environ['MLFLOW_TRACKING_URI'] = tower.tracking_uri
            rest = MlflowRest(tower.tracking_uri, os.environ, Path('/'))
            experiment = rest.experiment('thor_missions') or {}
            for name, count in (('idle', 0), ('busy', BUSY)):
                progress(f'{STARTS} starts, {count} busy processes')
                with busy(count):
                    took = starts(Path(folder) / f'starts_{name}', rest, experiment['experiment_id'])
                took_ms = [each * 1e3 for each in took['start_mission']]
                median_ms = statistics.median(took_ms)
                where = f'next to {count} busy processes' if count else 'on the idle machine'
                bars.append(Bar(f'start_mission {AFTER_S * 1e3:g} ms after the constructor, {where}', 'median under 100 ms',
                                median_ms, 'ms', median_ms < START_MEDIAN_MS, tuple(took_ms)))  # fmt: skip
                figures[f'start_{name}'] = {
                    'start_mission_ms': took_ms, 'bare_ms': [each * 1e3 for each in took['runs/create']],
                    'ratio': statistics.median(took['ratio']), 'load': os.getloadavg()[0],
                }  # fmt: skip
            own = plain(tower.tracking_uri)
            figures['mlflow_log_metric'] = {'median_ms': statistics.median(own) * 1e3, 'p99_ms': percentile(own, 99) * 1e3}
    return Report(tuple(bars), figures)


if __name__ == '__main__':
    main(__doc__ or '', measure, seconds=20.0)
