"""The node's memory while a backlog of bag slices and objects is uploaded, above its level before.

One node records a bag in slices of ten seconds, keeps a full ring for events and makes forty objects per second, next to a
simulated robot at its full rate. The S3 server is up (``--seconds``), down (``--away``), and up again (``--back``) for longer
than a period of the catalog, which has a row for each delivered object. Memory is the resident memory of the node's process
tree, sampled once per second; ``--table`` writes every sample, with glibc's and the queues' share.
"""

from __future__ import annotations

import argparse
import csv
import json
import statistics
import time
from pathlib import Path
from typing import Any

import _proc
from _report import Bar, Report, main, progress
from _world import Program, World, until

SETTINGS = Path(__file__).resolve().parents[1] / 'launch_configs' / 'go2_full_rate.yaml'
SENSORS = ('camera', 'camera_info', 'lidar', 'imu', 'states', 'joints', 'odom', 'lowstate')
RING = 64 << 20
PARAMETERS: dict[str, Any] = {
    'upload.max_backoff_s': 5.0, 'bag.record': 'always', 'bag.slice_s': 10.0, **{f'{sensor}.batch_s': 0.2 for sensor in SENSORS},
    'events.regex': '.*', 'events.exclude': 'rosout|parameter_events|sensor_logger_node|diagnostics', 'events.pre_s': 60.0,
    'events.max_bytes': RING,
}  # fmt: skip
BAR_MB = 60.0
PHASES = ('there', 'away', 'back')
ROLLUP = {'Pss': 'pss', 'Pss_Anon': 'pss_anon', 'Pss_File': 'pss_file', 'Private_Dirty': 'private_dirty'}


class Watch:
    """Samples a node; times are seconds since it was created."""

    def __init__(self, world: World, node: Program, sim: Program, reported: Path) -> None:
        self._world, self._node, self._sim, self._reported = world, node, sim, reported
        self._start = time.monotonic()
        self.rows: list[dict[str, Any]] = []
        """Of each sample: time, phase, CPU seconds until then, and MB."""

    @property
    def t(self) -> float:
        return time.monotonic() - self._start

    def phase(self, name: str, seconds: float) -> None:
        progress(f'backlog memory: {name}, {seconds:g} s')
        end = self.t + seconds
        while self.t < end:
            self.sample(name)

    def sample(self, name: str) -> dict[str, Any]:
        """Take a sample, then wait a second."""
        self._node.check()
        self._sim.check()
        memory = _proc.memory(self._node.pid)
        bytes_of = {'waiting': self._world.ledger()['bytes'].get('pending', 0), **rollup(self._node.pid), **self._report()}
        row = {'t': self.t, 'phase': name, 'cpu_s': self._node.cpu_s(), 'resident': memory.resident, **memory._asdict(),
               **{what: size / _proc.MEGA for what, size in bytes_of.items()}}  # fmt: skip
        self.rows.append({what: round(value, 2) if isinstance(value, float) else value for what, value in row.items()})
        time.sleep(1.0)
        return self.rows[-1]

    def resident(self, phase: str) -> list[float]:
        return [row['resident'] for row in self.rows if row['phase'] == phase]

    def cores(self, phase: str) -> float:
        """CPU used in a phase."""
        rows = [row for row in self.rows if row['phase'] == phase]
        return float((rows[-1]['cpu_s'] - rows[0]['cpu_s']) / max(rows[-1]['t'] - rows[0]['t'], 1.0))

    def write(self, path: Path) -> None:
        with path.open('w', encoding='utf-8', newline='') as file:
            writer = csv.DictWriter(file, list(self.rows[-1]), restval='')
            writer.writeheader()
            writer.writerows(self.rows)

    def _report(self) -> dict[str, int]:
        """The node's own report."""
        lines = self._reported.read_text(encoding='utf-8').splitlines()
        told: dict[str, int] = json.loads(lines[-1])
        return told


def rollup(pid: int) -> dict[str, int]:
    """Memory of a process, shared memory in proportion (proc(5), smaps_rollup)."""
    found = {}
    for line in Path(f'/proc/{pid}/smaps_rollup').read_text(encoding='ascii').splitlines()[1:]:
        name, _, value = line.partition(':')
        if name in ROLLUP:
            found[ROLLUP[name]] = int(value.split()[0]) * 1024
    return found


def measure(options: argparse.Namespace) -> Report:
    with World(options.folder) as world:
        assert world.tower is not None
        reported = world.folder / 'memory.jsonl'
        node = world.node(PARAMETERS, file=SETTINGS, program=('memory_node.py', str(reported)))
        sim = world.sim('image_raw:=false')
        until(lambda: reported.exists() and reported.stat().st_size, 'the node to tell of its memory', node, sim)
        watch = Watch(world, node, sim, reported)
        progress('backlog memory: until the ring is full')
        until(lambda: watch.sample('before')['ring'] > 0.95 * RING / _proc.MEGA, 'the ring to be full', node, sim)
        watch.phase('there', options.seconds)
        world.tower.stop_s3()
        watch.phase('away', options.away)
        world.tower.start_s3()
        backlog = watch.sample('back')
        objects = world.ledger()['objects']['pending']
        progress(f'backlog memory: back, {backlog["waiting"]:.0f} MB in {objects} objects')
        watch.phase('back', options.back)
        sim.stop()
        node.stop()
    if options.table:
        watch.write(options.table)
    level = statistics.median(watch.resident('there'))
    greatest = {name: max(watch.resident(name)) for name in PHASES}
    above = max(greatest.values()) - level
    progress(f'backlog memory: peak above level: {above:.0f} MB (bar {BAR_MB:g})')
    figures = {
        'level_mb': level, 'greatest_mb': greatest, 'cores': {name: watch.cores(name) for name in PHASES},
        'backlog_mb': backlog['waiting'], 'backlog_objects': objects, 'waiting_at_the_end_mb': watch.rows[-1]['waiting'],
    }  # fmt: skip
    what = f'resident memory of the node above its level, bag and ring on, store away for {options.away:g} s and back: greatest'
    return Report((Bar(what, f'at most {BAR_MB:g}', above, 'MB', above <= BAR_MB),), figures)


def _more(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--away', type=float, default=45.0, metavar='S', help='how long the store is away (default 45)')
    parser.add_argument('--back', type=float, default=95.0, metavar='S', help='how long it is back (default 95)')
    parser.add_argument('--table', type=Path, metavar='FILE', help='write every sample as CSV: seconds and MB')


if __name__ == '__main__':
    main(__doc__, measure, seconds=12.0, more=_more)
