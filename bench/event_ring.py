"""The cost of the event ring: memory at its byte limit, and the delay of the intake while the complete ring is written.

Two nodes one after the other, each next to a simulated robot, keep all its topics including raw images: one has a ring of four
mebibytes, the other one of 64. The difference in resident memory is the ring's. Then an event writes the complete ring: the
intake's rounds during that time are compared with those before, and the ledger shows whether anything was lost.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

import _proc
from _report import Bar, Report, main, progress
from _world import ROBOT, Program, World, lost, until

from shadowhound_data_logger.spool.status import file

SMALL, LARGE = 4 << 20, 64 << 20
NODE = ('event_node.py',)
PARAMETERS: dict[str, Any] = {
    'events.regex': '.*', 'events.exclude': 'rosout|parameter_events|sensor_logger_node|diagnostics', 'events.pre_s': 30.0,
    'events.post_s': 1.0, 'bag.compression': 'zstd',
}  # fmt: skip
BAR = 1.1
WARM_S = 3.0
SAMPLE_S = 0.2


def status(world: World) -> dict[str, Any]:
    path = file(world.spool, ROBOT)
    until(path.exists, 'the status')
    found: dict[str, Any] = json.loads(path.read_text(encoding='utf-8'))['events']
    return found


def resident(node: Program, seconds: float) -> float:
    """Private memory of the node, median over this time."""
    end, seen = time.monotonic() + seconds, []
    while time.monotonic() < end:
        seen.append(_proc.memory(node.pid).anon * 1e6)
        time.sleep(SAMPLE_S)
    return statistics.median(seen)


def highest(node: Program, world: World) -> float:
    """Maximum private memory until the event is written."""
    seen = [0.0]
    while status(world)['written'] == 0:
        node.check()
        seen.append(_proc.memory(node.pid).anon * 1e6)
        time.sleep(SAMPLE_S / 4)
    return max(seen)


def run(folder: Path, limit: int, seconds: float) -> dict[str, Any]:
    """A node with a full ring of this many bytes, and the effect of writing it."""
    with World(folder, store=False) as world:
        node = world.node({**PARAMETERS, 'events.max_bytes': limit}, program=NODE)
        switcher = world.program('bag_switch', 'bag_switch.py')
        sim = world.sim('image_raw:=true')
        until(lambda: status(world)['bytes'] > 0.7 * limit, 'the ring to fill', node, sim)
        time.sleep(WARM_S)
        kept, memory = status(world), resident(node, seconds)
        began_s = time.monotonic()
        switcher.ask(do='trigger')
        most = highest(node, world)
        sim.stop()
        report = json.loads(node.stop().splitlines()[-1])
        ledger = world.ledger()
        size = sum(path.stat().st_size for path in world.folder.glob('home/s*/**/event_*/*.mcap'))
    return {'memory': memory, 'most': most, 'kept': kept, 'began_s': began_s, 'ledger': ledger, 'bag_bytes': size, **report}


def measure(options: argparse.Namespace) -> Report:
    progress('a ring of 4 MiB')
    small = run(options.folder, SMALL, options.seconds / 4)
    progress(f'a ring of {LARGE >> 20} MiB')
    large = run(options.folder, LARGE, options.seconds / 4)
    grown = (large['memory'] - small['memory']) / (LARGE - SMALL)
    began, ended = max(large['writing'], key=lambda span: span[1] - span[0])
    before = sorted(took for at, took in large['rounds'] if large['began_s'] - options.seconds / 4 < at < large['began_s'])
    meanwhile = sorted(took for at, took in large['rounds'] if began - 0.2 <= at <= ended)
    gone = lost(row for sink in ('topics', 'events') for row in large['ledger'][sink].values())
    figures = {
        'ring_seconds': large['kept']['seconds'], 'ring_bytes': large['kept']['bytes'], 'writing_s': ended - began,
        'bag_bytes': large['bag_bytes'], 'memory_small': small['memory'], 'memory_large': large['memory'],
        'memory_most_while_writing': large['most'],
        'round_before_s': {'median': statistics.median(before), 'longest': before[-1], 'rounds': len(before)},
        'round_meanwhile_s': {'median': statistics.median(meanwhile), 'longest': meanwhile[-1], 'rounds': len(meanwhile)},
        'requested_rmw': sum(row['received'] for row in large['ledger']['events'].values()), 'lost': gone,
    }  # fmt: skip
    bars = (
        Bar('memory of a full ring over all topics, against its bytes', f'at most {BAR}', grown, 'of them', grown <= BAR),
        Bar(f'lost while a ring of {LARGE >> 20} MiB was written', 'none', float(gone), 'messages', gone == 0),
    )
    return Report(bars, figures)


if __name__ == '__main__':
    main(__doc__, measure, seconds=20.0)
