"""Runs a node for a long time as on a robot: outages, kills of Tower and clock steps, with bags and the event ring enabled.

The simulated Go2 walks all the time. Memory, descriptors, threads, index and shared memory of the node are sampled every few
seconds:
none of them may grow. Afterwards every message must be accounted for, and every object must be in the store.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
from e2e.processes import HERE, Node, Process, Processes, is_accounted, published, until
from e2e.wire import HANG, PASS, REFUSE, Wire
from matplotlib.figure import Figure
from shadowhound_tower.embedded import Tower

from bench._proc import memory
from shadowhound_data_logger.missions.plots import AMBER, BLUE, DPI, INK, STYLE, TEAL
from shadowhound_data_logger.ros.shared_memory import FOLDER
from shadowhound_data_logger.spool import ledger
from shadowhound_data_logger.spool.control import NAME, Connection
from torture._command import Check, parser, progress, verdict, workshop
from torture.kills import ROBOT, running

MINUTES: Final = 15.0
SHORT_MINUTES: Final = 2.0
LOOK_S: Final = 5.0
CALM_S: Final = (20.0, 180.0)
"""Between two faults."""
FAULT_S: Final = (5.0, 120.0)
DELIVER_S: Final = 1800.0
STEPS_S: Final = (-300, 300)
"""The clock's error: not so large that the store rejects signatures."""
FLAT_MB: Final = 16.0
LOG_MB, INDEX_BYTES = 6.0, 2_000
"""Growth of the index: its write-ahead log, and three days of remembered objects."""
FLAT_COUNT: Final = 4
"""Descriptors and threads that come and go."""
BAD_ANSWER: Final = (503, 'SlowDown')
TOWER, CLOCK = 'kill of Tower', 'step of the clock'
PARAMETERS: Final[dict[str, Any]] = {
    'bag.record': 'always', 'events.topics': ['/imu', '/odom', '/camera/compressed'], 'upload.read_timeout_s': 5.0,
}  # fmt: skip
COLORS: Final = {REFUSE: AMBER, HANG: AMBER, BAD_ANSWER[1]: AMBER, TOWER: '#b23a3a', CLOCK: TEAL}


@dataclass(frozen=True, slots=True)
class Sample:
    """The node's resources at one moment."""

    s: float
    own_mb: float
    """Private memory: without libraries and the middleware's shared memory."""
    descriptors: int
    threads: int
    index_mb: float
    """With its write-ahead log."""
    shm_mb: float
    """Of segments in /dev/shm that the node maps."""
    pending: int
    delivered: int


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault, with start and end."""

    what: str
    begin_s: float
    end_s: float


@dataclass(slots=True)
class Soak:
    """What happened. Times are seconds since the start."""

    samples: list[Sample] = field(default_factory=list)
    faults: list[Fault] = field(default_factory=list)
    published: dict[str, int] = field(default_factory=dict)
    ledger: dict[str, Any] = field(default_factory=dict)
    unbalanced: list[str] = field(default_factory=list)
    verified: dict[str, Any] = field(default_factory=dict)

    def bars(self) -> Iterator[Check]:
        rows = self.ledger['topics']
        report = {topic: rows[topic]['received'] + rows[topic]['missed'] if topic in rows else 0 for topic in self.published}
        open_ends = [
            f'{topic}: {count} published, {report[topic]} received or missed'
            for topic, count in self.published.items()
            if not is_accounted(report[topic], count)
        ]
        yield Check('every message is received or listed as missed', bool(report) and not open_ends, '; '.join(open_ends))
        dropped = {topic: row['dropped'] for topic, row in rows.items() if row['dropped']}
        yield Check('none that was received is dropped', not dropped, str(dropped or ''))
        yield Check('the ledger balances, at any time', not self.unbalanced, '; '.join(self.unbalanced[:3]))
        found = f'{self.verified["sound"]} of {self.verified["known"]} objects'
        yield Check('every object is in the store as it was delivered', bool(self.verified['ok']), found)
        for what, most in (('own_mb', FLAT_MB), ('descriptors', FLAT_COUNT), ('threads', FLAT_COUNT), ('shm_mb', 1.0)):
            early, late = self.early_and_late(what)
            yield Check(f'{what} do not grow' if what.endswith('s') else f'{what} does not grow', late - early <= most,
                      f'{early:.1f} in the second quarter, {late:.1f} in the last')  # fmt: skip

        early, late = self.samples[len(self.samples) // 4], self.samples[-1]
        grown, objects = late.index_mb - early.index_mb, late.delivered - early.delivered
        yield Check('the index grows with what it remembers alone', grown <= LOG_MB + objects * INDEX_BYTES / 1e6,
                  f'{grown:.1f} MB for {objects} objects')  # fmt: skip

    def early_and_late(self, what: str) -> tuple[float, float]:
        """Medians of the second and of the last quarter of the time in which the robot published."""
        values = [float(getattr(poll, what)) for poll in self.samples]
        quarter = max(1, len(values) // 4)
        return statistics.median(values[quarter : 2 * quarter] or values), statistics.median(values[-quarter:])

    def figures(self) -> dict[str, Any]:
        last = self.samples[-1]
        return {
            'minutes': round(last.s / 60, 1), 'faults': dict(Counter(fault.what for fault in self.faults)),
            'messages': sum(self.published.values()), 'missed': sum(row['missed'] or 0 for row in self.ledger['topics'].values()),
            'objects': self.ledger['objects']['delivered'],
            'most_pending': max(poll.pending for poll in self.samples), 'index_mb': last.index_mb,
            **{what: [round(value, 1) for value in self.early_and_late(what)]
               for what in ('own_mb', 'descriptors', 'threads', 'shm_mb')},
        }  # fmt: skip


class Robot:
    """A simulated Go2, its node and its Tower, which are disturbed. Lifecycle: New; run once."""

    def __init__(self, tower: Tower, wire: Wire, processes: Processes, rng: random.Random, scale: float) -> None:
        self._tower, self._wire, self._rng = tower, wire, rng
        self._behind = processes.folder / 'behind'
        shutil.copy(HERE / 'wrong_clock.py', processes.folder / 'sitecustomize.py')
        path = os.pathsep.join(filter(None, (str(processes.folder), os.environ.get('PYTHONPATH'))))
        self.environ = tower.environment() | {'AWS_ENDPOINT_URL': wire.url}
        own = {'PYTHONPATH': path, 'WRONG_CLOCK': str(self._behind)}
        self.node: Node = processes.node(self.environ, PARAMETERS, environ=own)
        self._sim: Process = processes.sim('image_raw:=false', f'rate_scale:={scale}')
        self._began_s = time.monotonic()
        self.soak = Soak()

    def run(self, seconds: float) -> None:
        until(lambda: self.node.topic('/imu').get('received'), 'the first messages are received')
        calm = True
        while (left := seconds - self._now()) > 0:
            wait = min(left, self._rng.uniform(*(CALM_S if calm else FAULT_S)))
            self._watch(wait) if calm else self._fail(wait)
            calm = not calm
        self._sim.signal(signal.SIGINT)
        self.soak.published = published(self._sim)
        progress('all that is left is delivered')
        self.node.delivered(1, DELIVER_S)
        self.soak.ledger = self.node.stop(seconds=120.0)

    def _now(self) -> float:
        return time.monotonic() - self._began_s

    def _fail(self, seconds: float) -> None:
        what = self._rng.choice((REFUSE, HANG, BAD_ANSWER[1], TOWER, CLOCK))
        begin_s = self._now()
        if what == CLOCK:
            self._behind.write_text(str(self._rng.randint(*STEPS_S) * 10**9))
        elif what == TOWER:
            _kill(self._tower)
        else:
            self._wire.set(BAD_ANSWER if what == BAD_ANSWER[1] else what)
        self._watch(seconds)
        if what == CLOCK:
            self._behind.unlink()
        elif what == TOWER:
            self._tower.start_s3()
        else:
            self._wire.set(PASS)
        self.soak.faults.append(Fault(what, begin_s, self._now()))
        progress(f'{self._now() / 60:.1f} min: {what} for {self._now() - begin_s:.0f} s, {self.soak.samples[-1]}')

    def _watch(self, seconds: float) -> None:
        """Sample the node until then; now and then trigger an event."""
        end_s = self._now() + seconds
        while self._now() < end_s:
            reported = ledger.read(self.node.home / 'spool', ROBOT)
            self.soak.unbalanced += ledger.imbalances(reported)
            self.soak.samples.append(_sample(self.node, reported, self._now()))
            if self._rng.random() < LOOK_S / 120.0:
                connection = Connection(self.node.home / 'spool', NAME)
                connection.ask('event', name='soak')
                connection.close()
            time.sleep(max(0.0, min(LOOK_S, end_s - self._now())))  # the sampling interval


def _sample(node: Node, reported: Mapping[str, Any], now_s: float) -> Sample:
    proc, index = Path('/proc', str(node.popen.pid)), node.home / 'spool' / 'index.db'
    mapped = {line.rpartition(' ')[2] for line in (proc / 'maps').read_text().splitlines() if f' {FOLDER}/' in line}
    sizes = [_size(Path(path)) for path in mapped]
    threads = next(line for line in (proc / 'status').read_text().splitlines() if line.startswith('Threads:'))
    objects = reported['objects']
    return Sample(
        round(now_s, 1), round(memory(node.popen.pid).anon, 1), len(list((proc / 'fd').iterdir())), int(threads.split()[1]),
        round((_size(index) + _size(index.with_name('index.db-wal'))) / 1e6, 2), round(sum(sizes) / 1e6, 1), objects['pending'],
        objects['delivered'],
    )  # fmt: skip


def _size(path: Path) -> int:
    try:
        return path.stat().st_blocks * 512
    except FileNotFoundError:
        return 0


def _kill(tower: Tower) -> None:
    """Kill the server with SIGKILL; its guard exits with it."""
    guard = tower._s3 and tower._s3._guard
    assert guard
    for child in Path(f'/proc/{guard.pid}/task/{guard.pid}/children').read_text().split():
        with suppress(ProcessLookupError):
            os.kill(int(child), signal.SIGKILL)
    guard.wait(60.0)
    tower.stop_s3()


def draw(samples: Sequence[Mapping[str, Any]], faults: Sequence[Mapping[str, Any]], target: Path) -> None:
    """Plot the node's resources over the minutes, and the faults."""
    minutes = [poll['s'] / 60 for poll in samples]
    lines = {'own_mb': 'memory [MB]', 'descriptors': 'descriptors', 'threads': 'threads', 'shm_mb': 'shared [MB]',
             'index_mb': 'index [MB]', 'pending': 'objects that wait'}  # fmt: skip
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9, 8), dpi=DPI, layout='constrained')
        for axes, (what, label) in zip(figure.subplots(len(lines), 1, sharex=True), lines.items(), strict=True):
            for fault in faults:
                axes.axvspan(fault['begin_s'] / 60, fault['end_s'] / 60, color=COLORS[fault['what']], alpha=0.25, lw=0)
            axes.plot(minutes, [poll[what] for poll in samples], color=BLUE if what != 'pending' else INK, lw=1.2)
            axes.set(ylabel=label, ylim=(0, None))
            axes.yaxis.label.set_size(8)
        axes.set(xlabel='minutes (yellow: the store is away, red: Tower is killed, green: the clock is wrong)', xlim=(0, None))
        figure.savefig(target)


def campaign(folder: Path, seconds: float, seed: int, scale: float = 1.0) -> Soak:
    """Run and audit; ``folder`` needs some 250 MB per minute at the robot's own rates."""
    with Tower(folder / 'tower') as tower:
        with Wire(tower.endpoint_url) as wire, running(folder) as processes:
            robot = Robot(tower, wire, processes, random.Random(seed), scale)
            robot.run(seconds)
        progress('every object is asked for')
        command = [sys.executable, '-m', 'shadowhound_data_logger.cli.main', 'ledger', '--verify', '--json']
        environ = {**os.environ, **tower.environment(), 'SHADOWHOUND_HOME': str(robot.node.home), 'SHADOWHOUND_ROBOT': ROBOT}
        answer = subprocess.run(command, env=environ, stdout=subprocess.PIPE, check=False)
        robot.soak.verified = json.loads(answer.stdout)
    return robot.soak


def main(argv: Sequence[str] | None = None) -> int:
    """The campaign; 0 if all requirements were met."""
    options = parser('soak', __doc__ or '')
    options.add_argument('--minutes', type=float, default=0.0, help=f'how long, {MINUTES:g} by default; 480 is a night')
    options.add_argument('--scale', type=float, default=1.0, help="of the robot's rates: a night at 1 needs 120 GB (default 1)")
    options.add_argument('--picture', type=Path, metavar='FILE.png', help='draw what the node had over the time')
    given = options.parse_args(argv)
    minutes = given.minutes or (SHORT_MINUTES if given.short else MINUTES)
    progress(f'{minutes:g} minutes, seed {given.seed}')
    with workshop(given) as shop:
        soak = campaign(shop.folder, 60.0 * minutes, given.seed, given.scale)
        happened = asdict(soak)
        (shop.folder / 'soak.json').write_text(json.dumps(happened))
        if given.picture:
            draw(happened['looks'], happened['faults'], given.picture)
        bars = list(soak.bars())
        shop.passed = all(bar.holds for bar in bars)
    figures = {'seed': given.seed, **soak.figures()}
    if not given.json:
        for name, value in figures.items():
            print(f'{name}: {value}')
    return verdict(figures, bars, as_json=given.json)


if __name__ == '__main__':
    sys.exit(main())
