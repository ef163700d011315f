"""Every topic of a simulated Go2 at its full rate: whether anything is lost, and the node's memory while the store is down.

First with the S3 server up (``--seconds``), then down (``--away``), then up while the backlog drains. Node, robot and server
share the machine. Settings: launch_configs/go2_full_rate.yaml. Memory is the resident memory of the node's process tree,
sampled once per second, including the middleware's shared memory.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import _proc
from _report import Bar, Report, main, percentile, progress, slope
from _world import Program, World, until

SETTINGS = Path(__file__).resolve().parents[1] / 'launch_configs' / 'go2_full_rate.yaml'
BACK_S = 30.0
BACKOFF_S = 5.0
"""Maximum pause between two tries while the store is down: shorter than the default 60 s, so that uploads resume immediately."""
WARM_S = 3.0
MAX_MB = 200.0
FLAT_MB_PER_MIN = 2.0
"""A line through five minutes that rises less than this counts as flat: over an hour of outage it would be at most 120 MB."""
SETTLE_PART = 0.2
"""Share of the outage; from then on memory must be flat."""
FLAT_S = 120.0
"""Over a shorter time a rise cannot be distinguished from batches that come and go."""


class Watch:
    """Samples a node once per second; ``t`` is the time since it was created."""

    def __init__(self, world: World, node: Program, sim: Program) -> None:
        self._world, self._node, self._sim = world, node, sim
        self._start = time.monotonic()
        self.samples: dict[str, list[float]] = {name: [] for name in ('t', *_proc.Memory._fields, 'waiting_mb')}

    @property
    def t(self) -> float:
        return time.monotonic() - self._start

    def phase(self, seconds: float, what: str) -> dict[str, Any]:
        """Watch for this long; returns the span, and the CPU used."""
        progress(f'full rate, {what}, {seconds:g} s')
        programs = {'node': self._node, 'sim': self._sim}
        begin, before, busy = self.t, {name: program.cpu_s() for name, program in programs.items()}, _proc.busy_s()
        while (left := begin + seconds - self.t) > 0:
            self._sample()
            time.sleep(min(1.0, max(left, 0.0)))
        took = self.t - begin
        cpu = {name: (program.cpu_s() - before[name]) / took for name, program in programs.items()}
        return {'span': [begin, self.t], 'cores': cpu, 'cores_busy': (_proc.busy_s() - busy) / took}

    def _sample(self) -> None:
        self._node.check()
        self._sim.check()
        found = self._world.ledger()
        values = {'t': self.t, **_proc.memory(self._node.pid)._asdict(), 'waiting_mb': found['bytes'].get('pending', 0) / 1e6}
        for name, value in values.items():
            self.samples[name].append(round(value, 3))

    def resident(self, begin: float, end: float) -> tuple[list[float], list[float]]:
        """Times and resident memory of a span."""
        rows = zip(self.samples['t'], self.samples['anon'], self.samples['file'], self.samples['shmem'], strict=True)
        inside = [(t, anon + file + shmem) for t, anon, file, shmem in rows if begin <= t <= end]
        return [t for t, _ in inside], [value for _, value in inside]


def measure(options: argparse.Namespace) -> Report:
    with World(options.folder) as world:
        assert world.tower is not None
        node = world.node({'upload.max_backoff_s': BACKOFF_S}, file=SETTINGS)
        sim = world.sim()
        until(lambda: len(world.ledger()['topics']) > 1, 'the node to hear the robot', node, sim)
        time.sleep(WARM_S)
        watch = Watch(world, node, sim)
        phases = {'there': watch.phase(options.seconds, 'the store there')}
        if options.away:
            world.tower.stop_s3()
            phases['away'] = watch.phase(options.away, 'the store away')
            world.tower.start_s3()
            phases['back'] = watch.phase(BACK_S, 'the store back')
        published = json.loads(sim.stop().splitlines()[-1])['published']
        node.stop()
        ledger = world.ledger()
    topics = {name: _topic(row, published.get(name)) for name, row in ledger['topics'].items()}
    figures = {'phases': phases, 'topics': topics, 'balanced': ledger['balanced'], 'bytes': ledger['bytes']}
    figures['samples'] = watch.samples
    return Report((_loss(topics, phases, balanced=ledger['balanced']), *_memory(watch, phases, figures)), figures)


def _topic(row: dict[str, Any], published: int | None) -> dict[str, Any]:
    lost = {'missed': row['missed'], 'missed_by': row['missed_by'], 'dropped': sum(row['dropped'].values())}
    rest = {'rejected': sum(row['rejected'].values()), 'skipped': row['skipped'], 'accounting': row['accounting']}
    return {'published': published, 'received': row['received'], 'stored': row['stored'], **lost, **rest}


def _loss(topics: dict[str, Any], phases: dict[str, Any], *, balanced: bool) -> Bar:
    """Over all phases, which is more than required; a published topic with unknown losses fails."""
    lost = sum((row['missed'] or 0) + row['dropped'] + row['rejected'] + row['skipped'] for row in topics.values())
    known = all(row['missed'] is not None for row in topics.values() if row['published'] or row['received'])
    seconds = max(phase['span'][1] for phase in phases.values())
    what = f'every topic stored at its full rate, {seconds:.0f} s on this machine with the simulator beside it'
    return Bar(what, 'missed + dropped = 0', float(lost), 'messages lost', known and balanced and lost == 0)


def _memory(watch: Watch, phases: dict[str, Any], figures: dict[str, Any]) -> tuple[Bar, ...]:
    if 'away' not in phases:
        return ()
    begin, end = phases['away']['span']
    times, values = watch.resident(begin, end)
    later = [place for place, t in enumerate(times) if t >= begin + SETTLE_PART * (end - begin)]
    rise = 60.0 * slope([times[place] for place in later], [values[place] for place in later])
    peak = max(values)
    figures['memory'] = {'peak_mb': peak, 'median_mb': percentile(values, 50), 'rise_mb_per_min': rise,
                         'peak_after_mb': max(watch.resident(*phases['back']['span'])[1])}  # fmt: skip
    what = f'resident memory of the node, full rate, store away for {end - begin:.0f} s'
    bars = [Bar(f'{what}: greatest', f'at most {MAX_MB:g}', peak, 'MB', peak <= MAX_MB)]
    if end - begin >= FLAT_S:
        bars.append(Bar(f'{what}: rise', f'flat: at most {FLAT_MB_PER_MIN:g}', rise, 'MB a minute', rise <= FLAT_MB_PER_MIN))
    return tuple(bars)


def _more(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--away', type=float, default=300.0, metavar='S', help='how long the store is away (default 300)')


if __name__ == '__main__':
    main(__doc__, measure, seconds=60.0, more=_more)
