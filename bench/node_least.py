"""The cost of the node above its floor, relative to a program that only encodes, writes, commits and puts (least_node.py).

Both read the same simulated robot at the same time and put as many objects to the same S3 server. The floor is the node's
middleware and its intake, as in ``node_cpu.py``. The other program's steps are the cost of storing an object with these
encoders, one file and one put each, without accounting, reports, retries or recovery.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from itertools import pairwise
from typing import Any

import _proc
from _report import Bar, Report, main, progress, ratio
from _world import Failed, Program, World, until
from node_cpu import WARM_S, _floor

ROUNDS = 4
STEPS = ('encode', 'spool', 'put')
MOST = 2.5
UNEQUAL = 0.05
"""Allowed difference in objects: they are counted at different moments."""


def _used(world: World, node: Program, least: Program) -> dict[str, float]:
    """CPU seconds until now, and objects."""
    steps = least.ask()
    return {'node': node.cpu_s(), 'floor': _floor(node, world), 'least': least.cpu_s(), 'objects': steps.pop('objects'),
            'node_objects': world.ledger()['objects']['spooled'], **steps}  # fmt: skip


def measure(options: argparse.Namespace) -> Report:
    progress(f'the node beside the least program, {options.seconds:g} s')
    with World(options.folder) as world:
        sim, node = world.sim(), world.node()
        own = world.folder / 'least'
        own.mkdir()
        least = world.program('least_node', 'least_node.py', str(own))
        until(lambda: len(world.ledger()['topics']) > 1, 'the node to hear the robot', node, sim)
        topics = least.line()['topics']
        time.sleep(WARM_S)
        told = [_used(world, node, least)]
        for _ in range(ROUNDS):
            time.sleep(options.seconds / ROUNDS)
            told.append(_used(world, node, least))
    rounds = [{name: after[name] - before[name] for name in after} for before, after in pairwise(told)]
    total = sum(map(Counter, rounds), Counter[str]())
    if abs(total['objects'] / total['node_objects'] - 1) > UNEQUAL:
        raise Failed(f'the node made {total["node_objects"]} objects, the other program {total["objects"]}: nothing to compare')
    above = [used['node'] - used['floor'] for used in rounds]
    steps = [sum(used[step] for step in STEPS) for used in rounds]
    value, each = ratio(above, steps)
    figures: dict[str, Any] = {
        'seconds': options.seconds, 'topics': topics, 'load': _proc.load(), 'used': total,
        'node_of_its_floor': total['node'] / total['floor'], 'least_of_that_floor': 1 + sum(steps) / total['floor'],
    }  # fmt: skip
    what = 'CPU of the node above its floor, against that of a program that only encodes, writes, commits and puts the same'
    return Report((Bar(what, f'at most {MOST:g}', value, 'of it', value <= MOST, each),), figures)


if __name__ == '__main__':
    main(__doc__, measure, seconds=60.0)
