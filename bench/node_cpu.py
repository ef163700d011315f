"""CPU of the node at its default profile relative to a plain node, at the same time, on the same simulated robot and S3 server.

The complete process tree of each counts, user and system time. Two runs: the plain node once as sketched in the guide, once with
odometry at 1 Hz as the node stores it by default. Each run is split into rounds for the spread.

The node is also compared with its own floor: the threads of its middleware and its intake thread, without which it would receive
nothing. The rest is the cost of encoders, spool, uploads and the main loop.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import _proc
from _report import Bar, Report, main, progress, ratio
from _world import ROBOT, Program, World, until

from shadowhound_data_logger.core.clock import SystemClock
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.spool import status
from shadowhound_data_logger.stores import open_store

WARM_S = 5.0
ROUNDS = 6
INTAKE = 'intake'
COMM_BYTES = 15
"""Maximum bytes of a thread's name in the kernel."""
VARIANTS = {'guide': 1, 'kinder': 50}
"""The plain node uploads every n-th odometry message."""


def run(folder: Path, odom_skip: int, seconds: float) -> dict[str, Any]:
    """CPU seconds of each program in each round, and the fate of the messages."""
    with World(folder) as world:
        node = world.node()
        plain = world.program('baseline_node', 'baseline_node.py', '--odom-skip', str(odom_skip))
        sim = world.sim()
        until(lambda: len(world.ledger()['topics']) > 1, 'the node to hear the robot', node, plain, sim)
        time.sleep(WARM_S)
        programs = {'node': node, 'baseline': plain, 'sim': sim}
        busy, floors = _proc.busy_s(), [_floor(node, world)]
        rounds = _rounds(programs, seconds, lambda: floors.append(_floor(node, world)))
        machine = (_proc.busy_s() - busy) / seconds
        published = json.loads(sim.stop().splitlines()[-1])['published']
        baseline = json.loads(plain.stop().splitlines()[-1])
        node.stop()
        return {
            'round_s': seconds / ROUNDS, 'cpu_s': rounds, 'floor_s': [after - before for before, after in pairwise(floors)],
 'cores_busy': machine, 'published': published, 'baseline': baseline,
            'baseline_objects': _objects(world), 'node': _node(world),
        }  # fmt: skip


def _floor(node: Program, world: World) -> float:
    """CPU seconds of the intake and of the middleware's threads, which are those without a name of the node."""
    workers = status.read(world.spool, ROBOT, SystemClock.of_this_machine()).node.workers
    ours = {'main', *(name[:COMM_BYTES] for name in workers)} - {INTAKE}
    return sum(used for name, used in _proc.threads(node.pid).items() if name not in ours)


def _rounds(programs: dict[str, Program], seconds: float, after: Callable[[], object]) -> dict[str, list[float]]:
    used: dict[str, list[float]] = {name: [] for name in programs}
    before = {name: program.cpu_s() for name, program in programs.items()}
    for _ in range(ROUNDS):
        time.sleep(seconds / ROUNDS)
        now = {name: program.cpu_s() for name, program in programs.items()}
        for name in programs:
            used[name].append(now[name] - before[name])
        before = now
        after()
    return used


def _objects(world: World) -> int:
    """Objects left in the bucket of all that the plain node put there."""
    assert world.tower is not None
    store = open_store(world.tower.store_settings(), UploadSettings())
    try:
        return sum(1 for _ in store.list('sensor-data', 'baseline/'))
    finally:
        store.close()


def _node(world: World) -> dict[str, Any]:
    """The node's own account of the run."""
    found = world.ledger()
    rows = found['topics'].values()
    missed = [row['missed'] for row in rows]
    return {
        'received': sum(row['received'] for row in rows), 'missed': None if None in missed else sum(missed),
        'dropped': sum(sum(row['dropped'].values()) for row in rows), 'objects': found['objects'],
    }  # fmt: skip


def measure(options: argparse.Namespace) -> Report:
    figures: dict[str, Any] = {}
    bars: list[Bar] = []
    for name, odom_skip in VARIANTS.items():
        progress(f'node CPU beside the {name} baseline, {options.seconds:g} s')
        figures[name] = found = run(options.folder, odom_skip, options.seconds)
        value, rounds = ratio(found['cpu_s']['node'], found['cpu_s']['baseline'])
        found['ratio'], found['ratios'] = value, rounds
        if name == 'guide':
            what = 'CPU of the node at the default profile, whole process tree, against the baseline node'
            bars.append(Bar(what, 'at most 0.25 (aim: 0.15)', value, 'of the baseline', value <= 0.25, rounds))
            value, rounds = ratio(found['cpu_s']['node'], found['floor_s'])
            found['floor_ratio'] = value
            what = 'CPU of the node at the default profile, against that of its middleware and its intake alone'
            bars.append(Bar(what, 'at most 2.5 (aim: 1.6)', value, 'of its floor', value <= 2.5, rounds))
    return Report(tuple(bars), figures)


if __name__ == '__main__':
    main(__doc__, measure, seconds=30.0)
